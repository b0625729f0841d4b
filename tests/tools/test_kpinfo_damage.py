"""kpinfo --verify names damaged chunks of every kind, in files with groups and without, and shows what can be read."""

import json

import pytest

from kpc.format.common.errors import FormatError
from kpc.format.container import groups
from kpc.format.container.container import Reader
from kpc.format.container.rewriting import with_metadata
from kpc.format.scene.metadata import Metadata
from kpc.format.scene.sound import SAMPLE_RATE, Sound
from kpc.tools.cli import kpinfo
from sounds import scene_with_sound

SOUND = Sound(1, 312, 4 * SAMPLE_RATE, tuple(bytes([31 << 3, number]) for number in range(201)))


def damaged(data, *places):
    """Return a file with other bytes at some places."""
    changed = bytearray(data)
    for place in places:
        changed[place] ^= 1
    return bytes(changed)


def offsets(data):
    return {entry.kind: entry.offset for entry in Reader(data).index}


def verified(path, data, capsys):
    """Return what kpinfo --verify says of a damaged file beside one line on stderr, and the totals."""
    path.write_bytes(data)
    assert kpinfo.main([str(path), "--verify", "--json"]) == 1
    printed, said = capsys.readouterr()
    found = json.loads(printed)
    (info,) = found["files"]
    assert said == f"kpinfo: {info['error']}\n" and not info["verified"]
    return info, found["totals"]


@pytest.fixture(scope="module")
def scene():
    return with_metadata(scene_with_sound(SOUND, 0, 22), Metadata({"title": "A dance"}))


@pytest.mark.parametrize("kinds", [["soun"], ["came"], ["meta"], ["came", "meta", "soun"], ["SCNE", "soun"]])
def test_chunks_that_are_no_planes(scene, kinds, tmp_path, capsys):
    info, sums = verified(tmp_path / "x.kpc", damaged(scene, *(offsets(scene)[kind] for kind in kinds)), capsys)
    assert {(one["group"], one["kind"]) for one in info["damaged_chunks"]} == {(None, kind) for kind in kinds}
    assert all(kind in info["error"] for kind in kinds)
    is_described = "SCNE" not in kinds
    assert info["metadata"] == ({"title": "A dance"} if is_described and "meta" not in kinds else None)
    assert (info["cameras"] is None) == (not is_described or "came" in kinds)
    assert (sums["groups"], sums["frame_count"]) == ((1, 22) if is_described else (0, 0))


def test_a_file_that_is_cut_off_and_damaged(scene, tmp_path, capsys):
    cut = damaged(scene, offsets(scene)["came"])[: Reader(scene).index[-1].offset]
    info, _ = verified(tmp_path / "x.kpc", cut, capsys)
    (found,) = info["damaged_chunks"]
    assert found["kind"] == "came" and f"chunk {found['chunk']} (came) is damaged" in info["error"]
    assert f"cut off at {len(cut):,} of {len(scene):,} bytes" in info["error"]


def test_chunks_of_several_groups_and_beside_them(scene, tmp_path, capsys):
    path = tmp_path / "long.kpc"
    parts = [groups.GroupInput.of(scene, first) for first in (0, 22, 44)]
    groups.write(parts, path, Metadata({"title": "Dances"}))
    whole, inner = path.read_bytes(), offsets(groups.Groups(path).source_of(0))
    places = [entry.offset for entry in Reader(whole).index if entry.kind == "GRUP"]
    wrong = [places[0] + inner["soun"], places[1] + inner["SCNE"], places[2] + 9, offsets(whole)["meta"]]
    info, sums = verified(path, damaged(whole, *wrong), capsys)
    found = {(one["group"], one["kind"]) for one in info["damaged_chunks"]}
    assert found == {(0, "soun"), (1, "SCNE"), (None, "GRUP"), (None, "meta")} and "4 chunks" in info["error"]
    assert (info["metadata"], sums["groups"], sums["frame_count"]) == (None, 3, 66)
    assert [one["value_count"] is None for one in info["groups"]] == [False, True, True]
    info, sums = verified(path, damaged(whole, places[0] + inner["SCNE"]), capsys)
    assert "group 0: chunk" in info["error"] and [one["group"] for one in info["damaged_chunks"]] == [0]
    assert (info["metadata"], sums["groups"], sums["frame_count"]) == ({"title": "Dances"}, 3, 66)
    assert [one["is_complete"] for one in info["groups"]] == [False, True, True] and info["cameras"] is None
    assert kpinfo.main([str(path)]) == 1
    printed, said = capsys.readouterr()
    lines = printed.splitlines()
    table = lines[lines.index("") + 2 :][:3]
    assert [line.endswith("damaged") for line in table] == [True, False, False], printed
    assert "group 0: chunk" in said and said.count("\n") == 1
    assert kpinfo.main([str(path), "--group", "1", "--verify"]) == 0 and "group 1" in capsys.readouterr().out
    with pytest.raises(FormatError, match=r"group 0: chunk \d \(SCNE\) is damaged"):
        groups.Groups(path)
    info, _ = verified(path, damaged(whole, wrong[0]), capsys)
    assert info["metadata"] == {"title": "Dances"} and [one["kind"] for one in info["damaged_chunks"]] == ["soun"]
    assert kpinfo.main([str(path), "--verify", "--group", "2"]) == 0


def test_a_damaged_plane_that_groups_share_is_named_once(scene, tmp_path, capsys):
    path = tmp_path / "long.kpc"
    groups.write([groups.GroupInput.of(scene, first) for first in (0, 22)], path)
    (number, entry), *others = ((k, one) for k, one in enumerate(Reader(path).index) if one.kind == "PLNE")
    info, _ = verified(path, damaged(path.read_bytes(), entry.offset), capsys)
    assert info["damaged_chunks"] == [{"group": None, "chunk": number, "kind": "PLNE"}]
    assert f"chunk {number} (PLNE), the shared plane xy of scale 0, is damaged" in info["error"]
    listed = [(one["chunk"], one["first_group"], one["group_count"]) for one in info["shared_planes"]]
    assert listed == [(number, 0, 2), *((other, 0, 2) for other, _ in others)]
