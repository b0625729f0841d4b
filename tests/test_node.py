"""The browser player (player/web): its own tests, and the built files that are part of the Python package."""

import gzip
import re
import shutil
import subprocess
from pathlib import Path

import pytest

WEB = Path(__file__).parent.parent / "player" / "web"
BUILT = ("kpc-player.js", "kpc-worker.js")
COMPRESSED_LIMIT_BYTES = 200_000


@pytest.fixture(scope="module")
def node() -> str:
    """Skip without node or the packages of player/web."""
    program = shutil.which("node")
    version = subprocess.run([program, "--version"], capture_output=True, text=True).stdout if program else ""
    found = re.match(r"v(\d+)\.(\d+)", version)
    if program is None or found is None or (int(found[1]), int(found[2])) < (20, 11):
        pytest.skip(f"needs node 20.11 or newer, not {version.strip() or 'none'}")
    if not (WEB / "node_modules" / "esbuild").is_dir():
        pytest.skip("needs the packages of player/web: npm ci --prefix player/web")
    return program


def run(*command: str | Path) -> None:
    done = subprocess.run(command, capture_output=True, text=True, cwd=WEB)
    assert done.returncode == 0, (done.stdout + done.stderr)[-4000:]


def test_types_and_style_are_in_order(node: str) -> None:
    run(node, "node_modules/typescript/bin/tsc", "--noEmit")
    run(node, "node_modules/@biomejs/biome/bin/biome", "check")


def test_the_tests_of_node_pass(node: str) -> None:
    run(node, "build.mjs", "--test")


def test_the_built_files_are_those_of_the_sources(node: str, tmp_path: Path) -> None:
    run(node, "build.mjs", "--out", tmp_path)
    for name in BUILT:
        assert (tmp_path / name).read_bytes() == (WEB / "dist" / name).read_bytes(), (
            f"player/web/dist/{name} is out of date: npm run build --prefix player/web"
        )


def test_the_player_is_small() -> None:
    assert len(gzip.compress((WEB / "dist" / "kpc-player.js").read_bytes(), 9)) <= COMPRESSED_LIMIT_BYTES
