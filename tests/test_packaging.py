"""What the wheel must hold, and what a viewer's install must do without."""

import importlib
import re
import subprocess
import sys
import tomllib
from importlib.resources import files
from pathlib import Path

import pytest

from without_packages import without

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
FLOORS = ("encoder", "format", "player", "tools")


def test_every_package_is_listed() -> None:
    inits = [init for floor in FLOORS for init in (ROOT / floor).rglob("__init__.py")]
    found = {"kpc", *("kpc." + ".".join(init.parent.relative_to(ROOT).parts) for init in inits)}
    assert set(PROJECT["tool"]["setuptools"]["packages"]) == found
    folders = {file.parent for floor in FLOORS for file in (ROOT / floor).rglob("*.py")}
    assert folders <= {init.parent for init in inits}, "a folder of modules lacks __init__.py"


def test_every_file_that_is_no_module_is_package_data() -> None:
    data = PROJECT["tool"]["setuptools"]["package-data"]
    for floor in FLOORS:
        for file in (ROOT / floor).rglob("*"):
            if file.is_dir() or file.suffix in (".py", ".sh") or "__pycache__" in file.parts:
                continue
            if ROOT / "player" / "web" in file.parents:  # all but the built player is no part of the Python package
                continue
            package = "kpc." + ".".join(file.parent.relative_to(ROOT).parts)
            assert any(file.match(pattern) for pattern in data.get(package, ())), file.relative_to(ROOT)


def test_the_built_browser_player_is_package_data() -> None:
    assert "web/dist/*.js" in PROJECT["tool"]["setuptools"]["package-data"]["kpc.player"]
    assert (files("kpc.player") / "web" / "dist" / "kpc-player.js").is_file()


def test_the_repository_holds_no_symbolic_link() -> None:
    listed = subprocess.run(["git", "-C", str(ROOT), "ls-files", "--stage"], capture_output=True, text=True)
    if listed.returncode:
        pytest.skip("this is no git checkout")
    assert not [line for line in listed.stdout.splitlines() if line.startswith("120000")]


@pytest.mark.parametrize("command", PROJECT["project"]["scripts"])
def test_commands_exist(command: str) -> None:
    module, _, function = PROJECT["project"]["scripts"][command].partition(":")
    assert callable(getattr(importlib.import_module(module), function))


def test_constraints_pin_all_that_is_asked_for_and_no_build_of_it() -> None:
    pins = dict(re.findall(r"^([\w.-]+)==(\S+)$", (ROOT / "constraints.txt").read_text(), re.MULTILINE))
    project = PROJECT["project"]
    asked = project["dependencies"] + [line for extra in project["optional-dependencies"].values() for line in extra]
    canonical = {re.sub(r"[-_.]+", "-", name).lower() for name in pins}
    for line in asked:
        assert re.sub(r"[-_.]+", "-", re.split(r"[^\w.-]", line)[0]).lower() in canonical, line
    assert not [pin for pin in pins.values() if "+" in pin]


WITHOUT_TORCH = without("torch")
WITHOUT_NUMBA = without("numba", "llvmlite", "zstandard", "imageio_ffmpeg")


VIEWERS = (
    *("player.gl.renderer", "player.app.kpplay", "player.app.player"),
    *(
        "tools.cli.kprender",
        "tools.cli.kpinfo",
        "tools.bench.kpbench",
        "tools.dev.scenegen",
        "tools.bench.results",
        "tools.cli.contactsheet",
    ),
)


def import_all(beginning: str, *modules: str) -> None:
    """Import modules of kpc in one process, after the beginning of its program."""
    imports = "\n".join(f"import kpc.{module}" for module in modules)
    subprocess.run([sys.executable, "-c", f"{beginning}\n{imports}"], check=True)


def test_viewers_need_no_numba() -> None:
    import_all(WITHOUT_NUMBA, *VIEWERS, "tools.cli.kpedit", "tools.cli.kpjoin", "tools.cli.kpexport")


def run_without_numba(module: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    program = f"{WITHOUT_NUMBA}\nimport kpc.{module} as c; sys.exit(c.main({list(arguments)}))"
    return subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)


def test_reading_needs_no_numba(tmp_path: Path) -> None:
    sample = str(ROOT / "samples" / "default.kpc")
    assert run_without_numba("tools.cli.kpinfo", "--verify", sample).returncode == 0
    picture = ("--backend", "reference", "--time", "0.5", "--size", "16x12", "-o", str(tmp_path / "a.png"))
    assert run_without_numba("tools.cli.kprender", sample, *picture).returncode == 0
    titled = run_without_numba("tools.cli.kpedit", sample, "-o", str(tmp_path / "a.kpc"), "--title", "A corner")
    assert titled.returncode == 0 and (tmp_path / "a.kpc").stat().st_size > 1000


def test_exr_pictures_without_their_package_are_one_line(tmp_path: Path) -> None:
    program = f"{without('OpenEXR')}\nimport kpc.tools.cli.kprender as c; sys.exit(c.main(sys.argv[1:]))"
    options = [str(ROOT / "samples" / "default.kpc"), "--backend", "reference", "--time", "0", "--size", "8x6", "-o"]
    for suffix, code, lines in ((".png", 0, 1), (".exr", 1, 2)):  # the first names the renderer
        command = [sys.executable, "-c", program, *options, str(tmp_path / f"a{suffix}")]
        done = subprocess.run(command, capture_output=True, text=True)
        assert done.returncode == code and done.stderr.count("\n") == lines, done.stderr
    assert 'needs OpenEXR, which is not installed; pip install "kpc[film]"' in done.stderr


def test_writing_without_numba_is_one_line(tmp_path: Path) -> None:
    sample, cut = str(ROOT / "samples" / "default.kpc"), str(tmp_path / "cut.kpc")
    done = run_without_numba("tools.cli.kpedit", sample, "-o", cut, "--to", "0.5")
    assert done.returncode == 1 and done.stderr.count("\n") == 1 and 'pip install "kpc[cpu]"' in done.stderr


def test_viewers_need_no_torch() -> None:
    import_all(WITHOUT_TORCH, *VIEWERS)


def test_nobody_needs_what_tests_and_benches_do() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    named = {re.split(r"[<>=]", requirement)[0] for extra in ("bench", "test") for requirement in extras[extra]}
    assert "scipy" in named
    tools = (f"tools.cli.{name}" for name in ("kprender", "kpinfo", "kpjoin", "contactsheet"))
    import_all(without(*sorted(named)), "player.app.kpplay", *tools, "encoder.cli.kpenc")


def test_scripts_are_sound_shell() -> None:
    for script in [*sorted((ROOT / "tools").glob("*.sh")), ROOT / ".ci" / "run"]:
        subprocess.run(["bash", "-n", str(script)], check=True)
