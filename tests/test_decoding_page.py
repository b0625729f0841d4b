"""The examples of docs/decoding.md run as they stand."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from kpc.format.container.scene_io import read

ROOT = Path(__file__).parent.parent
PAGE = (ROOT / "docs" / "decoding.md").read_text()
MODULE = ROOT / "format" / "core" / "kpc_core.wasm"


def example(language: str) -> str:
    (found,) = re.findall(rf"^```{language}\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
    assert found.count("\n") < 40
    return found


def test_the_example_in_python_shows_the_symbols_of_a_plane(tmp_path: Path) -> None:
    (tmp_path / "show.py").write_text(example("python"))
    file = ROOT / "spec" / "vectors" / "valid" / "minimal.kpc"
    command = [sys.executable, "show.py", MODULE, file, "2", "2", "1"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == str(tuple(read(file).scales[0]["xy"].symbols.ravel().tolist()))


def test_the_example_in_javascript_shows_the_planes_of_a_scene(tmp_path: Path) -> None:
    node = shutil.which("node")
    if node is None:
        pytest.skip("needs node")
    (tmp_path / "show.mjs").write_text(example("javascript").replace("./player", ROOT.as_uri() + "/player"))
    file = ROOT / "samples" / "default.kpc"
    done = subprocess.run([node, "show.mjs", file], cwd=tmp_path, capture_output=True, text=True, check=True)
    scene = read(file)
    assert done.stdout.startswith(
        f"{scene.clip.frame_count} frames at {scene.clip.fps:g} fps, {len(scene.cameras)} cam"
    )
    for number, scale in enumerate(scene.dequantise().scales):
        for name, values in scale.items():
            rows, columns, channels = values.shape
            line = rf"scale {number}, plane {name}: {rows} x {columns} x {channels}, mean (\S+)"
            (mean,) = re.findall(line, done.stdout)
            assert float(mean) == pytest.approx(float(values.mean(dtype="f8")), abs=1e-4)
