"""Commands print names that are not UTF-8 on terminals that are not UTF-8, with replaced letters."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest

from kpc.format.coding.quantise import quantise_scene
from kpc.format.common.images import write_image
from kpc.format.container.scene_io import write
from scenes import tiny_scene

ENVIRONMENTS = [
    {"PYTHONIOENCODING": "ascii"},
    {"PYTHONIOENCODING": "latin-1:strict"},
    {"LC_ALL": "C", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"},
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """Return a folder whose name is not UTF-8, with a scene, two folders of a picture and views to render."""
    made = tmp_path_factory.mktemp("names") / "plain"
    made.mkdir()
    scene = tiny_scene()
    write(quantise_scene(scene, [dict.fromkeys(scale, 0.02) for scale in scene.scales]), made / "scene.kpc")
    for name in ("truth", "rendered"):
        (made / name).mkdir()
        write_image(made / name / "0.png", np.zeros((4, 4, 3), np.uint8))
    renamed = os.fsencode(made.parent) + b"/caf\xe9"
    try:
        os.rename(made, renamed)
    except OSError:
        pytest.skip("this file system holds Unicode names only")
    return renamed


def run(folder: bytes, environment: dict[str, str], module: str, *arguments: str) -> tuple[int, bytes, bytes]:
    """Run a command in the folder of that name; return its exit code and what it printed."""
    command = [sys.executable, "-m", f"kpc.tools.cli.{module}", *(os.fsencode(a) for a in arguments)]
    done = subprocess.run(command, cwd=folder, env={**os.environ, **environment}, capture_output=True, check=False)
    return done.returncode, done.stdout, done.stderr


@pytest.mark.parametrize("environment", ENVIRONMENTS, ids=["ascii", "latin-1", "C"])
def test_commands(folder: bytes, environment: dict[str, str]) -> None:
    here = os.fsdecode(folder)
    for module, *arguments in (
        ["kpinfo", f"{here}/scene.kpc"],
        ["contactsheet", f"{here}/truth", f"{here}/rendered", "-o", f"{here}/sheet.png"],
        ["kpjoin", f"{here}/scene.kpc", f"{here}/scene.kpc", "-o", f"{here}/joined.kpc"],
        [
            "kprender",
            f"{here}/scene.kpc",
            "--size",
            "8x6",
            "--backend",
            "reference",
            "--time",
            "0",
            "-o",
            f"{here}/0.png",
        ],
    ):
        code, out, err = run(folder, environment, module, *arguments)
        assert b"Traceback" not in err, err
        assert code == 0, (module, err)
        assert out.isascii() or environment == ENVIRONMENTS[1], out
    code, out, err = run(folder, environment, "kpinfo", "--json", f"{here}/scene.kpc")
    assert json.loads(out)["file"].endswith("caf\ufffd/scene.kpc") and out.isascii(), err
    code, out, err = run(folder, environment, "kpinfo", f"{here}/none.kpc")
    assert code == 1 and out == b"" and err.startswith(b"kpinfo: ") and len(err.splitlines()) == 1
