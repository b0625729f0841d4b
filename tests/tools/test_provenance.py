import os
import shutil
import subprocess
from pathlib import Path

import pytest

import kpc
from kpc.format.common.memory import peak_memory_bytes
from kpc.tools.bench import provenance


def test_the_hash_of_a_folder_covers_names_and_contents(tmp_path: Path) -> None:
    def write(folder: str, files: dict[str, str]) -> str:
        for name, text in files.items():
            (tmp_path / folder / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / folder / name).write_text(text)
        return provenance.data_hash(tmp_path / folder)

    first = write("a", {"x.txt": "one", "sub/y.txt": "two"})
    assert write("b", {"sub/y.txt": "two", "x.txt": "one", ".hidden": "!", ".git/z": "!"}) == first
    others = [
        {"x.txt": "one", "sub/y.txt": "2"},
        {"x.txt": "one", "y.txt": "two"},
        {"x.txt": "onesub/y.txt", "z": "two"},
    ]
    assert len({first, *(write(f"c{n}", files) for n, files in enumerate(others))}) == 4


def test_the_hash_of_a_file_is_its_sha256(tmp_path: Path) -> None:
    (tmp_path / "f").write_bytes(b"abc")
    assert provenance.data_hash(tmp_path / "f").startswith("ba7816bf8f01cfea414140de5dae2223")


def test_the_commit_is_that_of_a_checkout_that_tracks_the_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if shutil.which("git") is None:
        pytest.skip("no git")

    def git(*arguments: str) -> str:
        identity = ["-c", "user.name=t", "-c", "user.email=t@example.org", "-c", "commit.gpgsign=false"]
        done = subprocess.run(
            ["git", "-C", str(tmp_path), *identity, *arguments], capture_output=True, text=True, check=True
        )
        return done.stdout.strip()

    source = tmp_path / "src" / "__init__.py"
    source.parent.mkdir()
    source.write_text("")
    monkeypatch.setattr(kpc, "__file__", str(source))
    for name in [name for name in os.environ if name.startswith("GIT_")]:
        monkeypatch.delenv(name)  # set when tests run from a git hook
    assert provenance.commit() == "unknown"
    git("init", "-q")
    git("commit", "-q", "--allow-empty", "-m", "empty")
    assert provenance.commit() == "unknown"  # as in a virtual environment inside some checkout
    git("add", "src")
    git("commit", "-q", "-m", "source")
    assert provenance.commit() == git("rev-parse", "HEAD")
    source.write_text("changed")
    assert provenance.commit() == git("rev-parse", "HEAD") + "+dirty"


def test_machine_and_versions() -> None:
    machine = provenance.machine()
    assert machine["cpu"] and machine["os"] and machine["cores"] >= 1 and machine["memory_bytes"] > 1 << 28
    assert {"kpc", "numpy", "moderngl"} <= set(provenance.versions())
    assert 1 << 20 < peak_memory_bytes() < machine["memory_bytes"]
