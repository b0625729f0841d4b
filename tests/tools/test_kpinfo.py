import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest

from kpc.encoder.coding.scene_writer import write
from kpc.format.coding.quantise import quantise_scene
from kpc.format.container import groups
from kpc.format.container.container import Reader
from kpc.format.scene.metadata import Metadata
from kpc.format.scene.motion import FINEST_STEP
from kpc.player.app import kpplay
from kpc.tools.cli import kpinfo, kprender
from scenes import in_device_coordinates, tiny_scene, with_appearances, with_contraction, with_motion

SCHEMA = json.loads((Path(__file__).parents[2] / "docs" / "kpinfo.schema.json").read_text())


def json_of(capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    """Return what kpinfo printed, after checking it against the schema."""
    printed = json.loads(capsys.readouterr().out)
    jsonschema.validate(printed, SCHEMA, jsonschema.Draft202012Validator)
    return printed


def scene_of(capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    """Return what kpinfo printed about the scene of the one file."""
    ((group,),) = (info["groups"] for info in json_of(capsys)["files"])
    return group["scene"]


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
        "11 frames at 10 fps, 1.10 s, dynamic",
        "(-1, -0.8, -0.6) to (1.2, 0.9, 0.7)",
        "3 x 12x10x8 cells",
        "scale 1     8 channels; xy 24x20, xz 24x16, yz 20x16;\n              xt 24x6",
        "bits each",
        "identity",
        "SCNE",
        "came",
        "RAW",
        "PREDICTIVE",
    ):
        assert part in page, page
    assert "cut off" not in page and "verified" not in page
    assert all(len(line) <= 80 for line in page.splitlines()[1:]), page  # the first names the file
    assert re.search(r"PLNE +1 xt +0-3 ", page) and re.search(r"PLNE +1 xt +4-5 ", page)  # both included


def test_json_adds_up(scene_file, capsys):
    assert kpinfo.main([str(scene_file), "--json", "--verify"]) == 0
    printed = json_of(capsys)
    (file,) = printed["files"]
    info, size = file["groups"][0]["scene"], scene_file.stat().st_size
    assert printed["schema"] == SCHEMA["properties"]["schema"]["const"] and printed["totals"]["size_bytes"] == size
    assert (
        file["size_bytes"]
        == file["expected_bytes"]
        == size
        == info["overhead_bytes"] + sum(c["stored_bytes"] for c in info["chunks"])
    )
    assert info["bits_per_parameter"] == pytest.approx(8 * size / info["parameter_count"])
    assert file["clip"]["duration_s"] == 1.1 and file["groups"][0]["shown_s"] == [0, 1.1]
    assert (
        file["verified"]
        and file["error"] is None
        and info["missing_chunks"] == 0
        and info["space"] == {"mapping": "box"}
    )
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
    assert scene_of(capsys)["space"] == {
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
    assert scene_of(capsys)["space"]["near"] == 0.8


def test_a_scene_with_a_motion_grid(tmp_path, capsys):
    scene = with_motion(tiny_scene(), most=0.25)
    path = tmp_path / "moved.kpc"
    write(quantise_scene(scene, [dict.fromkeys(scale, 0.02) for scale in scene.scales]), path)
    assert kpinfo.main([str(path), "--verify"]) == 0
    page = capsys.readouterr().out
    assert "6 x 4x2x3 nodes, displacements up to 0.25 of the box"[:30] in page and "MOVE" in page
    assert kpinfo.main([str(path), "--json"]) == 0
    page = scene_of(capsys)
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
    assert "appearances 11: 00.jpg, 01.jpg" in page and "08.jpg" not in page and "appe" in page
    assert "07.jpg (3 more; --json lists all)" in " ".join(page.split())
    assert kpinfo.main([str(path), "--json"]) == 0
    assert scene_of(capsys)["appearances"] == [*names]
    data = bytearray(path.read_bytes())
    data[Reader(bytes(data)).index[4].offset + 2] ^= 1
    path.write_bytes(data)
    assert kpinfo.main([str(path), "--verify"]) == 1 and "4 (appe)" in capsys.readouterr().err


def test_metadata_are_shown(tmp_path, capsys):
    metadata = Metadata({"title": "A dance", "author": "M\u00fcller", "notes": {"take": 3}})
    scene, path = replace(tiny_scene(), metadata=metadata), tmp_path / "named.kpc"
    write(quantise_scene(scene, [dict.fromkeys(scale, 0.02) for scale in scene.scales]), path)
    assert kpinfo.main([str(path), "--verify"]) == 0
    page = capsys.readouterr().out
    assert "  title       A dance\n  author      M\u00fcller\n" in page and "licence" not in page
    assert kpinfo.main([str(path), "--json"]) == 0
    (info,) = json_of(capsys)["files"]
    assert info["metadata"] == metadata.document


def test_verify_lists_every_damaged_chunk(scene_file, capsys):
    data = bytearray(scene_file.read_bytes())
    index = Reader(bytes(data)).index
    for number in (1, 6):
        data[index[number].offset + 3] ^= 0x10
    scene_file.write_bytes(data)
    assert kpinfo.main([str(scene_file), "--verify"]) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert f"{scene_file}: 2 chunks are damaged: 1 (DECO), 6 (PLNE); fetch the file again" in error
    assert kpinfo.main([str(scene_file), "--verify", "--json"]) == 1
    (info,) = json_of(capsys)["files"]
    assert [(one["chunk"], one["kind"]) for one in info["damaged_chunks"]] == [(1, "DECO"), (6, "PLNE")]
    assert not info["verified"] and "2 chunks are damaged" in info["error"] and info["clip"]["frame_count"] == 11


def test_verify_names_no_plane_that_only_lacks_the_occupancy(scene_file, capsys):
    data = bytearray(scene_file.read_bytes())
    index = Reader(bytes(data)).index
    planes = [number for number, entry in enumerate(index) if entry.kind == "PLNE"]
    (occupancy,) = (number for number, entry in enumerate(index) if entry.kind == "OCCU")
    for number in (occupancy, planes[-1]):
        data[index[number].offset + index[number].stored_length // 2] ^= 0x10
    scene_file.write_bytes(data)
    assert kpinfo.main([str(scene_file), "--verify", "--json"]) == 1
    (info,) = json_of(capsys)["files"]
    assert [one["chunk"] for one in info["damaged_chunks"]] == [occupancy, planes[-1]]


@pytest.mark.parametrize("chunk", [1, 6])  # DECO, PLNE
def test_a_damaged_chunk_is_reported_in_every_form(scene_file, tmp_path, capsys, chunk):
    whole = tmp_path / "whole.kpc"
    data = bytearray(scene_file.read_bytes())
    whole.write_bytes(data)
    data[Reader(bytes(data)).index[chunk].offset + 3] ^= 0x10
    scene_file.write_bytes(data)
    for files in ([scene_file], [scene_file, whole]):
        for options in ([], ["--json"], ["--verify"]):
            assert kpinfo.main([*map(str, files), *options]) == 1
            printed, said = capsys.readouterr()
            assert f"kpinfo: {scene_file}: chunk {chunk} " in said
            assert ("(damaged)" in printed) == (len(files) > 1 and "--json" not in options)


def test_a_file_whose_end_is_missing_is_described_but_not_verified(scene_file, capsys):
    data = scene_file.read_bytes()
    cut = data[: Reader(data).index[-2].offset]
    scene_file.write_bytes(cut)
    assert kpinfo.main([str(scene_file)]) == 0
    page = capsys.readouterr().out
    assert f"cut off at {len(cut):,} of {len(data):,} bytes" in " ".join(page.splitlines()[:2])
    assert "missing     2 of 22 chunks" in page and page.count(" missing\n") == 2
    assert not any(word in page for word in ("identity", "never changes", "not coded"))
    assert kpinfo.main([str(scene_file), "--json"]) == 0
    info = scene_of(capsys)
    assert info["identity_share"] is info["static"] is info["uncoded_share"] is None
    assert [chunk["share"] is None for chunk in info["chunks"]] == [False] * 20 + [True] * 2
    planes = info["scales"][1]["planes"]
    assert planes["zt"]["coded_share"] is None and 0 < planes["xy"]["coded_share"] <= 1
    assert kpinfo.main([str(scene_file), "--verify", "--json"]) == 1
    captured = capsys.readouterr()
    assert f"cut off at {len(cut):,} of {len(data):,} bytes; fetch the file again" in captured.err
    (file,) = json.loads(captured.out)["files"]
    assert (file["size_bytes"], file["expected_bytes"]) == (len(cut), len(data)) and not file["verified"]


def test_control_codes_of_names_are_escaped(capsys):
    assert kpinfo.main(["\x1b[1m.kpc", "none.kpc"]) == 1
    printed, errors = capsys.readouterr()
    assert "  \\x1b[1m.kpc  (not read)" in printed and "\x1b" not in printed + errors


def test_several_files_with_totals(scene_file, tmp_path, capsys):
    other, cut, size = tmp_path / "other.kpc", tmp_path / "cut.kpc", scene_file.stat().st_size
    other.write_bytes(scene_file.read_bytes())
    cut.write_bytes(scene_file.read_bytes()[:-1])
    assert kpinfo.main([str(scene_file), str(other), "--verify"]) == 0
    table = capsys.readouterr().out
    assert table.count(f"{size:,}") == 2 and f"{2 * size:,} " in table and "2 files, all verified" in table
    assert "      22 " in table and "2.20 s" in table
    files = [str(scene_file), str(cut), str(tmp_path / "none.kpc")]
    assert kpinfo.main(files) == 1
    table, errors = capsys.readouterr()
    assert (
        f"cut.kpc  (cut off from {size:,})" in table
        and "none.kpc  (not read)" in table
        and "3 files, 1 failed" in table
    )
    assert errors.splitlines() == [
        f"kpinfo: {files[2]}: No such file or directory",
        "kpinfo: 1 of 3 files is damaged or cannot be read",
    ]
    assert kpinfo.main([*files, "--verify", "--json"]) == 1
    printed = json_of(capsys)
    assert [info["verified"] for info in printed["files"]] == [True, False, False]
    assert printed["totals"] == {
        "files": 3,
        "failed": 2,
        "size_bytes": 2 * size - 1,
        "frame_count": 22,
        "duration_s": 2.2,
        "groups": 2,
    }
    assert kpinfo.main([*files, "--group", "0"]) == 2


def test_totals_are_of_files_that_can_be_read(scene_file, tmp_path, capsys):
    other = tmp_path / "other.kpc"
    other.write_bytes(b"not a scene" * 1000)
    assert kpinfo.main([str(scene_file), str(other), "--json"]) == 1
    totals = json_of(capsys)["totals"]
    assert (totals["files"], totals["failed"], totals["size_bytes"]) == (2, 1, scene_file.stat().st_size)


def test_single_and_grouped_files_have_the_same_keys(scene_file, tmp_path, capsys):
    long = tmp_path / "long.kpc"
    groups.write([groups.GroupInput.of(scene_file, start) for start in (0, 11)], long)
    found = []
    for arguments in ([scene_file], [long], [long, "--group", "1"]):
        assert kpinfo.main([*map(str, arguments), "--json"]) == 0
        found += json_of(capsys)["files"]
    assert all(info.keys() == found[0].keys() for info in found)
    described = [[group["scene"] is not None for group in info["groups"]] for info in found]
    assert described == [[True], [False, False], [False, True]]
    one = json.loads(json.dumps(found[0]["groups"][0]["scene"]))
    other = found[2]["groups"][1]["scene"]
    # The planes lie beside the groups, and what is left has a smaller index.
    assert {key for key in one if other[key] != one[key]} <= {"overhead_bytes", "bits_per_parameter", "chunks"}
    for before, after in zip(one["chunks"], other["chunks"], strict=True):
        assert before.keys() == after.keys() and before["stored_bytes"] == after["stored_bytes"]
        assert (after["offset"] is None) == (after["shared_chunk"] is not None)
    assert {chunk["shared_chunk"] for chunk in one["chunks"]} == {None} and not found[0]["shared_planes"]
    shared = [chunk["shared_chunk"] for chunk in other["chunks"] if chunk["shared_chunk"] is not None]
    assert shared and shared == [plane["chunk"] for plane in found[1]["shared_planes"] if plane["group_count"] == 2]
    assert kpinfo.main([str(long)]) == 0 and "2, from 0 on" in capsys.readouterr().out
    assert kpinfo.main([str(long), "--group", "1"]) == 0 and "SHARED" in capsys.readouterr().out
    assert kpinfo.main([str(scene_file), "--group", "1"]) == 2
    assert "there is no group 1: it has 1 group, numbered from 0" in capsys.readouterr().err


@pytest.mark.parametrize("address", ["ftp://me:secret@a.example/x.kpc?key=token", "s3://bucket/x.kpc", "file:///x.kpc"])
def test_addresses_of_other_schemes_are_refused_by_name(address, tmp_path, capsys):
    for command in (kpinfo.main, kpplay.main, lambda argv: kprender.main([*argv, "-o", str(tmp_path / "x.png")])):
        assert command([address]) == 1
        error = capsys.readouterr().err
        assert "x.kpc: no http or https address; other schemes cannot be read" in error
        assert "secret" not in error and "token" not in error


def test_json_names_addresses_of_other_schemes_without_what_is_secret(capsys):
    assert kpinfo.main(["--json", "ftp://me:secret@a.example/x.kpc?key=token", "file:///a/x.kpc", "s3://[/x.kpc"]) == 1
    named = [one["file"] for one in json_of(capsys)["files"]]
    assert named == ["ftp://a.example/x.kpc", "file:///a/x.kpc", "s3://..."]


@pytest.mark.parametrize(
    "address", ["localhost:8765/x.kpc", "localhost/x.kpc", "example.org/a/x.kpc", "10.0.0.1/x.kpc", "nas:8000/x.kpc"]
)
def test_an_address_without_its_scheme_is_recognised(address, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert kpinfo.main([address]) == 1
    assert f"{address}: no such file; an address begins with http:// or https://" in capsys.readouterr().err


@pytest.mark.parametrize("path", ["takes/x.kpc", "../x.kpc", "v1.2/x.kpc", "./localhost/x.kpc", "a.b.kpc"])
def test_a_path_is_no_address_without_its_scheme(path, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert kpinfo.main([path]) == 1
    assert "http" not in capsys.readouterr().err


@pytest.mark.parametrize(
    "content, complaint",
    [
        (b"", "not a .kpc file, since it is empty"),
        (b"RIFF" * 40, "not a .kpc file"),
        (b"\x89KPC\r\n\x1a\n", "cut off within the header"),
    ],
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
    assert kpinfo.main([str(scene_file), "--memory", "1KB"]) == 1
    assert "budget of 1,000; give more with --memory" in capsys.readouterr().err
    assert kpinfo.main([str(scene_file), "--memory", "500MB"]) == 0
    with pytest.raises(SystemExit, match="2"):
        kpinfo.main([str(scene_file), "--memory", "0"])
