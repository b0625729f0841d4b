import json

import numpy as np
import pytest

from kpc.format.coding.quantise import quantise_scene
from kpc.format.container.container import Reader
from kpc.format.container.scene_io import write
from kpc.format.scene.motion import FINEST_STEP
from kpc.tools.cli import kpinfo
from scenes import in_device_coordinates, tiny_scene, with_appearances, with_contraction, with_motion


@pytest.fixture
def scene_file(tmp_path):
    scene = tiny_scene()
    path = tmp_path / "scene.kpc"
    write(quantise_scene(scene, [dict.fromkeys(scale, 0.02) for scale in scene.scales]), path, segment_rows=4)
    return path


def test_the_page(scene_file, capsys):
    assert kpinfo.main([str(scene_file)]) == 0
    page = capsys.readouterr().out
    for part in (
        "11 frames at 10 fps, 1.00 s, dynamic",
        "(-1, -0.8, -0.6) to (1.2, 0.9, 0.7)",
        "3 x 12x10x8 cells",
        "scale 1     8 channels; xy 24x20, xz 24x16, yz 20x16, xt 24x6",
        "bits each",
        "identity",
        "SCNE",
        "came",
        "RAW",
        "PREDICTIVE",
    ):
        assert part in page, page
    assert "cut off" not in page and "verified" not in page


def test_json_adds_up(scene_file, capsys):
    assert kpinfo.main([str(scene_file), "--json", "--verify"]) == 0
    info = json.loads(capsys.readouterr().out)
    size = scene_file.stat().st_size
    assert info["size_bytes"] == size == info["overhead_bytes"] + sum(c["stored_bytes"] for c in info["chunks"])
    assert info["bits_per_parameter"] == pytest.approx(8 * size / info["parameter_count"])
    assert info["verified"] and info["missing_chunks"] == 0 and info["space"] == {"mapping": "box"}
    assert info["scales"][0]["planes"]["xt"]["rows"] == 6
    assert 0 < info["uncoded_share"] < 1 and 0.5 < info["identity_share"] < 1
    assert info["cameras"] == 2 and info["camera_box"] == [
        pytest.approx([-1.8, 1.0, 2.2], abs=2e-5),
        pytest.approx([2.4, 1.4, 2.6], abs=2e-5),
    ]
    assert sum(c["share"] for c in info["chunks"]) < 1
    assert {c["plane"] for c in info["chunks"]} == {None, "xy", "xz", "yz", "xt", "yt", "zt"}


def test_a_static_scene(tmp_path, capsys):
    scene = tiny_scene(dynamic=False)
    path = tmp_path / "still.kpc"
    write(quantise_scene(scene, [dict.fromkeys(scale, 0.02) for scale in scene.scales]), path)
    assert kpinfo.main([str(path), "--verify"]) == 0
    page = capsys.readouterr().out
    assert (
        "100.0% of the occupied space-time has time planes of 1" in page
        and "100.0% of the occupied space never changes" in page
    )
    assert "static" in page and "verified" in page and "xt" not in page


def test_a_contracted_scene(tmp_path, capsys):
    scene = with_contraction(tiny_scene())
    path = tmp_path / "around.kpc"
    write(quantise_scene(scene, [dict.fromkeys(scale, 0.02) for scale in scene.scales]), path)
    assert kpinfo.main([str(path), "--verify"]) == 0
    page = capsys.readouterr().out
    assert "contracted beyond the box; uniform steps up to 5, rays end at 1280" in page and "WARP" in page
    assert kpinfo.main([str(path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["space"] == {
        "mapping": "contracted",
        "uniform_distance": 5.0,
        "far": 1280.0,
    }


def test_a_scene_in_device_coordinates(tmp_path, capsys):
    scene = in_device_coordinates(tiny_scene())
    path = tmp_path / "faced.kpc"
    write(quantise_scene(scene, [dict.fromkeys(scale, 0.02) for scale in scene.scales]), path)
    assert kpinfo.main([str(path), "--verify"]) == 0
    assert "normalised device coordinates, as is the box; near 0.8, baseline 2" in capsys.readouterr().out
    assert kpinfo.main([str(path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["space"]["near"] == 0.8


def test_a_scene_with_a_motion_grid(tmp_path, capsys):
    scene = with_motion(tiny_scene(), most=0.25)
    path = tmp_path / "moved.kpc"
    write(quantise_scene(scene, [dict.fromkeys(scale, 0.02) for scale in scene.scales]), path)
    assert kpinfo.main([str(path), "--verify"]) == 0
    page = capsys.readouterr().out
    assert "6 x 4x2x3 nodes, displacements up to 0.25 of the box"[:30] in page and "MOVE" in page
    assert kpinfo.main([str(path), "--json"]) == 0
    page = json.loads(capsys.readouterr().out)
    motion, codecs = page["motion"], {chunk["kind"]: chunk["codec"] for chunk in page["chunks"]}
    assert codecs["MOVE"] == "MOTION"
    assert motion["rows"] == 6 and motion["nodes_zyx"] == [3, 2, 4]
    assert motion["max_displacement"] == pytest.approx(np.abs(scene.motion).max(), abs=FINEST_STEP / 2 + 1e-7)


def test_a_scene_with_appearances(tmp_path, capsys):
    names = tuple(f"{k:02}.jpg" for k in range(11))
    scene = with_appearances(tiny_scene(), names)
    path = tmp_path / "varied.kpc"
    write(quantise_scene(scene, [dict.fromkeys(scale, 0.02) for scale in scene.scales]), path)
    assert kpinfo.main([str(path), "--verify"]) == 0
    page = capsys.readouterr().out
    assert (
        "appearances 11: 00.jpg, 01.jpg" in page and "07.jpg, ..." in page and "08.jpg" not in page and "appe" in page
    )
    assert kpinfo.main([str(path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["appearances"] == [*names]
    data = bytearray(path.read_bytes())
    data[Reader(bytes(data)).index[4].offset + 2] ^= 1
    path.write_bytes(data)
    assert kpinfo.main([str(path), "--verify"]) == 1 and "4 (appe)" in capsys.readouterr().err


def test_verify_lists_every_damaged_chunk(scene_file, capsys):
    data = bytearray(scene_file.read_bytes())
    index = Reader(bytes(data)).index
    for number in (1, 6):
        data[index[number].offset + 3] ^= 0x10
    scene_file.write_bytes(data)
    assert kpinfo.main([str(scene_file), "--verify"]) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert f"{scene_file}: 2 of 22 chunks are damaged: 1 (DECO), 6 (PLNE); fetch the file again" in error
    assert kpinfo.main([str(scene_file)]) == 1


def test_a_file_whose_end_is_missing_is_described_but_not_verified(scene_file, capsys):
    data = scene_file.read_bytes()
    scene_file.write_bytes(data[: Reader(data).index[-2].offset])
    assert kpinfo.main([str(scene_file)]) == 0
    page = capsys.readouterr().out
    assert "2 of 22 chunks are missing" in page and page.count("  missing") == 2
    assert kpinfo.main([str(scene_file), "--verify"]) == 1
    assert "cut off at" in capsys.readouterr().err


@pytest.mark.parametrize(
    "content, complaint",
    [(b"", "not a .kpc file"), (b"RIFF" * 40, "not a .kpc file"), (b"\x89KPC\r\n\x1a\n", "cut off within the header")],
)
def test_other_files(tmp_path, capsys, content, complaint):
    path = tmp_path / "other.kpc"
    path.write_bytes(content)
    assert kpinfo.main([str(path)]) == 1
    captured = capsys.readouterr()
    assert captured.out == "" and f"{path}: {complaint}" in captured.err and captured.err.count("\n") == 1


def test_a_missing_file_and_a_folder(tmp_path, capsys):
    for path in (tmp_path / "none.kpc", tmp_path):
        assert kpinfo.main([str(path)]) == 1
        assert str(path) in capsys.readouterr().err


def test_the_budget_is_an_option(scene_file, capsys):
    assert kpinfo.main([str(scene_file), "--memory-budget", "1000"]) == 1
    assert "budget of 1,000" in capsys.readouterr().err
    assert kpinfo.main([str(scene_file), "--memory-budget", "0"]) == 2
