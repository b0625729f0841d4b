"""What an extra brings may be missing: commands then say which extra it is, and their versions need none."""

import ast
import re
import subprocess
import sys
import tomllib
from functools import cache
from importlib.metadata import PackageNotFoundError, packages_distributions, requires, version
from pathlib import Path

import pytest

from kpc.format.common import extras
from without_packages import without

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
FOLDERS = ("encoder", "format", "player", "tools", "src")
SAMPLE = ROOT / "samples" / "default.kpc"
ALL = sorted({package for packages in extras.PACKAGES.values() for package in packages})

# Modules that some versions of Python bring, and one whose absence has a message of its own.
ASKED_FOR = {"compression", "backports", "pillow_heif"}


def canonical(requirement: str) -> str:
    """Return the name of what is required, as package indices compare it."""
    name = re.match(r"[\w.-]+", requirement)
    assert name is not None
    return re.sub(r"[-_.]+", "-", name[0]).lower()


@cache
def installed() -> dict[str, list[str]]:
    """Return what brought each module at the top that is installed, where that is known."""
    return dict(packages_distributions())


def brought_by(package: str) -> set[str]:
    """Return what may have to be installed for a module."""
    return {canonical(name) for name in installed().get(package, [package])}


def imported() -> set[str]:
    """Return the packages of others that modules of kpc import, anywhere in their text."""
    names: set[str] = set()
    for file in (file for folder in FOLDERS for file in (ROOT / folder).rglob("*.py")):
        if "node_modules" in file.parts:
            continue
        for node in ast.walk(ast.parse(file.read_text(), str(file))):
            if isinstance(node, ast.Import):
                names |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                names.add((node.module or "").partition(".")[0])
    return names - sys.stdlib_module_names - {"kpc"}


def test_every_package_that_is_imported_is_a_dependency_or_of_an_extra() -> None:
    core = {canonical(line) for line in PROJECT["dependencies"]}
    found = imported()
    assert {"torch", "numpy", "yaml"} <= found
    others = found - set(ALL) - ASKED_FOR
    assert not [name for name in others if not brought_by(name) & core]
    assert set(ALL) <= found, "a package of an extra is not used"


@pytest.mark.parametrize("extra", extras.PACKAGES)
def test_extras_bring_their_packages(extra: str) -> None:
    direct = {canonical(line) for line in PROJECT["optional-dependencies"][extra]}
    try:
        required = {line for name in direct for line in requires(name) or () if "extra ==" not in line}
    except PackageNotFoundError as error:
        pytest.skip(f"{error.name} is not installed")
    brought = [brought_by(package) for package in extras.PACKAGES[extra]]
    assert all(names & (direct | set(map(canonical, required))) for names in brought)
    assert direct <= set().union(*brought), "a requirement brings no package that the table names"


def run(missing: tuple[str, ...], call: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run `call`, a function below kpc, where packages are missing."""
    module, _, function = call.rpartition(".")
    program = f"{without(*missing)}\nfrom kpc.{module} import {function} as main\nsys.exit(main({list(arguments)}))"
    return subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)


@pytest.mark.parametrize("command", PROJECT["scripts"])
def test_every_version_is_known_without_extras(command: str) -> None:
    done = run(tuple(ALL), f"commands.{command}", "--version")
    assert (done.returncode, done.stdout, done.stderr) == (0, f"{command} {version('kpc')}\n", "")


@pytest.mark.parametrize("call", [*(f"commands.{name}" for name in PROJECT["scripts"]), "tools.bench.plot.main"])
def test_help_needs_no_extra_or_says_which(call: str) -> None:
    done = run(tuple(ALL), call, "--help")
    if call in ("commands.kpenc", "commands.kpposes"):  # whose options are those of the encoder
        assert done.returncode == 1 and done.stderr.count("\n") == 1
        assert done.stderr.endswith('which is not installed; pip install "kpc[encoder]"\n')
    else:
        assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize(
    ("missing", "call", "words", "extra"),
    [
        ("torch", "commands.kpenc", "set -o x.kpc", "encoder"),
        ("numba", "commands.kpenc", "set -o x.kpc", "encoder"),
        ("scipy", "commands.kpposes", "set", "poses"),
        ("fsspec", "commands.kpbatch", f"{SAMPLE} -o out", "cluster"),
        ("dask", "commands.kpbatch", f"{SAMPLE} -o out", "cluster"),
        ("skimage", "commands.kpexport", "x.kpc --mesh -o x.ply", "exchange"),
        ("pxr", "commands.kpexport", f"x.usda --scene {SAMPLE} -o x.json", "exchange"),
        ("matplotlib", "commands.kpbench", "report x.json -o x.html", "bench"),
        ("matplotlib", "tools.bench.plot.main", "x.json -o x.svg", "bench"),
        ("zstandard", "commands.kpbench", "codec x.kpck", "bench"),
        ("av", "commands.kpbench", "quality x.kpc set", "encoder"),
        ("numba", "commands.kpbench", "encode set", "encoder"),
        ("numba", "commands.kpbench", f"stream {SAMPLE}", "encoder"),
    ],
)
def test_what_is_missing_is_named_in_one_line(
    missing: str, call: str, words: str, extra: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "set").mkdir()
    (tmp_path / "x.usda").touch()
    done = run((missing,), call, *words.split())
    name = "plot" if call.endswith("plot.main") else call.partition(".")[2]
    assert done.returncode == 1
    lacks = "finding cameras needs COLMAP" if extra == "poses" else f"needs {missing}, which is not installed"
    assert done.stderr == f'{name}: {lacks}; pip install "kpc[{extra}]"\n'


def test_what_no_extra_brings_is_a_bug() -> None:
    assert extras.remedy("kpc.nowhere", "kpenc") is None and extras.remedy(None, "kpenc") is None
