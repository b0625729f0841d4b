"""Commands print names that are not UTF-8 on terminals that are not UTF-8, with replaced letters."""

import errno
import io
import json
import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from kpc.encoder.coding.scene_writer import write
from kpc.format.coding.quantise import quantise_scene
from kpc.format.common import cli
from kpc.format.common.images import write_image
from kpc.tools.cli import contactsheet, kpedit, kpexport, kpinfo, kpjoin, kprender
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


@pytest.mark.parametrize("closed", ["2>&-", "0<&-", "0<&- 1>&- 2>&-"])
def test_standard_streams_may_be_closed(closed: str, tmp_path: Path) -> None:
    scene = tiny_scene()
    write(quantise_scene(scene, [dict.fromkeys(scale, 0.02) for scale in scene.scales]), tmp_path / "a.kpc")
    film = "kprender a.kpc --backend reference --size 16x12 --to 0.2 -o a.mp4"
    for words in (film, "kpedit a.kpc --turn x:90 -o b.kpc", "kpexport a.kpc -o c.gltf"):
        command, _, options = words.partition(" ")
        call = f"{shlex.quote(sys.executable)} -m kpc.tools.cli.{command} {options} {closed}"
        done = subprocess.run(["sh", "-c", call], cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 0, (words, done.stderr)
        assert command not in done.stdout, "what is meant for stderr is printed on stdout"
        assert (tmp_path / words.split()[-1]).stat().st_size > 100


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


@pytest.mark.skipif(os.name == "nt", reason="such names are no names on Windows")
def test_line_breaks_and_control_codes_of_names_are_escaped(
    tmp_path: Path, scene_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = tmp_path / "a\n\x1b[31mb.kpc"
    shutil.copy(scene_file, source)
    edited, joined, film = (tmp_path / f"{name}\n\x1b[31m.kpc" for name in ("edited", "joined", "film"))
    assert kpedit.main([str(source), "-o", str(edited), "--title", "t"]) == 0
    assert kpjoin.main([str(source), str(source), "-o", str(joined)]) == 0
    picture = ["--time", "0", "--size", "8x6", "--backend", "reference"]
    assert kprender.main([str(source), *picture, "-o", str(film.with_suffix(".png"))]) == 0
    assert kpexport.main([str(source), "-o", str(film.with_suffix(".usda"))]) == 0
    printed, said = capsys.readouterr()
    assert "\x1b" not in printed + said
    assert [line.partition(":")[0] for line in printed.splitlines()] == [
        str(tmp_path / f"{name}\\n\\x1b[31m{suffix}")
        for name, suffix in (("edited", ".kpc"), ("joined", ".kpc"), ("film", ".png"), ("film", ".usda"))
    ]
    assert (
        cli.message_of(FileNotFoundError(errno.ENOENT, "none", str(source))) == f"{tmp_path}/a\\n\\x1b[31mb.kpc: none"
    )
