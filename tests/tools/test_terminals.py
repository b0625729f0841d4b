"""Commands print names that are not UTF-8 on terminals that are not UTF-8, with replaced letters."""

import io
import json
import os
import subprocess
import sys

import numpy as np
import pytest

from kpc.encoder.coding.scene_writer import write
from kpc.format.coding.quantise import quantise_scene
from kpc.format.common.images import write_image
from kpc.tools.cli import contactsheet, kpinfo, kpjoin
from scenes import tiny_scene


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """Return a folder whose name is not UTF-8, with a scene and two folders of a picture."""
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


def test_commands(folder: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    here = os.fsdecode(folder)
    for command, *arguments in (
        [kpinfo, f"{here}/scene.kpc"],
        [kpinfo, "--json", f"{here}/scene.kpc"],
        [contactsheet, f"{here}/truth", f"{here}/rendered", "-o", f"{here}/sheet.png"],
        [kpjoin, f"{here}/scene.kpc", f"{here}/scene.kpc", "-o", f"{here}/joined.kpc"],
    ):
        streams = [io.TextIOWrapper(io.BytesIO(), encoding="ascii") for _ in range(2)]
        monkeypatch.setattr(sys, "stdout", streams[0])
        monkeypatch.setattr(sys, "stderr", streams[1])
        code = command.main(arguments)
        for stream in streams:
            stream.flush()
        out, err = (stream.buffer.getvalue().decode("ascii") for stream in streams)
        assert code == 0, (command, err)
        if "--json" in arguments:
            assert json.loads(out)["files"][0]["file"].endswith("caf\ufffd/scene.kpc")


def test_a_locale_that_is_not_utf8(folder: bytes) -> None:
    environment = {**os.environ, "LC_ALL": "C", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"}
    command = [sys.executable, "-m", "kpc.tools.cli.kpinfo", folder + b"/none.kpc"]
    done = subprocess.run(command, env=environment, capture_output=True, check=False)
    assert done.returncode == 1 and done.stdout == b""
    assert done.stderr.startswith(b"kpinfo: ") and b"caf?" in done.stderr and len(done.stderr.splitlines()) == 1
