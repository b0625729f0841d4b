"""The browser player (player/web): its own tests, and the built files that are part of the Python package."""

import gzip
import json
import os
import re
import shutil
import subprocess
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from kpc.format.container.partial import PartialScene
from kpc.format.container.scene_io import SceneReader
from kpc.player.streaming.prefetch import Playhead, fetch_order, min_segment_bytes, segments_to_keep
from partial_scenes import coded
from scenes import tiny_scene

WEB = Path(__file__).parent.parent / "player" / "web"
BUILT = ("kpc-player.js", "kpc-three.js", "kpc-worker.js")
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


def run(*command: str | Path, **environment: str) -> None:
    done = subprocess.run(command, capture_output=True, text=True, cwd=WEB, env=os.environ | environment)
    failed = re.findall(r"^not ok .*?^ *\.\.\.$", done.stdout, re.DOTALL | re.MULTILINE)  # of node's tests
    assert done.returncode == 0, ("\n".join(failed) or done.stdout + done.stderr)[-4000:]


def test_types_and_style_are_in_order(node: str) -> None:
    run(node, "node_modules/typescript/bin/tsc", "--noEmit")
    run(node, "node_modules/@biomejs/biome/bin/biome", "check")


def test_the_tests_of_node_pass(node: str) -> None:
    run(node, "build.mjs", "--test")


def test_segments_are_fetched_in_the_order_of_the_desktop_player(node: str, tmp_path: Path) -> None:
    file = coded(tiny_scene(4, time=20), 2)
    scene, numbers = PartialScene(SceneReader(file, in_parts=True)), np.random.default_rng(3)
    cases = []
    for shown in (0, 0, 1, 2) * 10:
        head = Playhead(float(numbers.random()), float(numbers.choice([0, 0.05, 0.5])), bool(numbers.integers(2)))
        available = int(numbers.integers(scene.sizes.sum()))
        order, keep = fetch_order(scene, head, shown).tolist(), segments_to_keep(scene, head, available).tolist()
        cases.append({"head": asdict(head), "shown": shown, "available": available, "order": order, "keep": keep})
    (tmp_path / "scene.kpc").write_bytes(file)
    described = {"file": str(tmp_path / "scene.kpc"), "least": min_segment_bytes(scene), "cases": cases}
    (tmp_path / "cases.json").write_text(json.dumps(described))
    run(node, "build.mjs", "--test", "prefetch", KPC_PREFETCH_CASES=str(tmp_path / "cases.json"))


def test_the_built_files_are_those_of_the_sources(node: str, tmp_path: Path) -> None:
    run(node, "build.mjs", "--out", tmp_path)
    for name in BUILT:
        assert (tmp_path / name).read_bytes() == (WEB / "dist" / name).read_bytes(), (
            f"player/web/dist/{name} is out of date: npm run build --prefix player/web"
        )


def test_the_player_is_small() -> None:
    assert len(gzip.compress((WEB / "dist" / "kpc-player.js").read_bytes(), 9)) <= COMPRESSED_LIMIT_BYTES
