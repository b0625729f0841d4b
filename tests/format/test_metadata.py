"""Metadata: what a file says of itself, checked on reading and kept on writing."""

import argparse
import copy
import json
import re
from dataclasses import replace

import numpy as np
import pytest
from decoder import Refused
from decoder.metadata import decode_metadata
from hypothesis import given, settings
from hypothesis import strategies as st

from kpc.encoder.coding.scene_writer import encode
from kpc.format.coding.quantise import quantise_scene
from kpc.format.common.errors import FormatError
from kpc.format.container import groups
from kpc.format.container.metadata_chunk import pack_metadata, parse_metadata
from kpc.format.container.metadata_options import add_metadata_options, members_from
from kpc.format.container.partial import PartialScene
from kpc.format.container.scene_io import SceneReader, read
from kpc.format.scene.metadata import (
    Metadata,
    camera_document,
    camera_from,
    differences,
    limits_document,
    merged,
)
from kpc.tools.vectors.metadata_vectors import FULL
from scenes import tiny_scene

METADATA = Metadata(FULL)


def encoded(metadata: Metadata) -> bytes:
    scene = replace(tiny_scene(scales=1, channels=2, resolution=(6, 5, 4), time=3), metadata=metadata)
    return encode(quantise_scene(scene, [dict.fromkeys(scene.scales[0], 0.1)]))


def test_metadata_comes_back_whole_in_every_way_of_reading():
    data = encoded(METADATA)
    assert read(data).metadata == read(data).dequantise().metadata == METADATA
    assert PartialScene(SceneReader(data, in_parts=True)).scene.metadata == METADATA
    assert groups.load(data).metadata == METADATA


@pytest.mark.parametrize(
    ("names", "text", "number"),
    [
        (["0019", "0003", "1"], "0003", 1),
        (["0019", "0003", "1"], "1", 2),
        (["0019", "0003", "1"], "0", 0),
        (["0019", "0003", "1"], "7", 7),
        (["0019", "0003", "1"], "0002", None),
        (["0019", "0003", "1"], "left", None),
        ([], "2", 2),
    ],
)
def test_the_name_of_a_camera_wins_over_its_number(names: list[str], text: str, number: int | None) -> None:
    assert Metadata({"camera_names": names}).camera_number(text, 3) == number


def test_a_file_without_metadata_has_no_such_chunk():
    data = encoded(Metadata())
    assert "meta" not in {entry.kind for entry in SceneReader(data).index}
    assert not read(data).metadata


def test_all_other_chunks_are_those_of_the_file_without_metadata():
    with_it, without = SceneReader(encoded(METADATA)), SceneReader(encoded(Metadata()))
    kept = [n for n, entry in enumerate(with_it.index) if entry.kind != "meta"]
    assert [with_it.stored(n) for n in kept] == [without.stored(n) for n in range(len(without.index))]


def test_view_limits_and_cameras_survive_as_json():
    limits, opening = METADATA.view_limits, METADATA.opening
    again = METADATA.with_members(view_limits=limits_document(limits)).view_limits
    for name, value in vars(limits).items():
        assert getattr(again, name) == pytest.approx(value, abs=1e-6), name
    assert camera_document(camera_from(camera_document(opening.camera))) == FULL["opening"]["camera"]
    assert limits.up @ limits.forward == pytest.approx(0) and np.linalg.norm(limits.forward) == pytest.approx(1)


def test_a_writer_refuses_what_a_reader_would():
    for broken in ({"title": ""}, {"later": float("nan")}, {"later": {1, 2}}, {"later": 70_000 * "a"}):
        with pytest.raises(FormatError, match="meta"):
            pack_metadata(Metadata(broken))


def test_merging_keeps_what_all_agree_on():
    other = METADATA.with_members(title="Another").with_provenance(seed=8)
    found = merged([METADATA, other])
    assert "title" not in found.document and found.document["date"] == FULL["date"]
    assert "seed" not in found.provenance and found.provenance["preset"] == "balanced"
    assert found.document["later"] == FULL["later"]
    assert not merged([Metadata(), Metadata()])


def test_merging_leaves_out_what_some_lack():
    """A licence, or a quality that was measured of one part, does not hold for the others."""
    other = METADATA.with_members(licence=None).with_provenance(held_out=None)
    found = merged([METADATA, other])
    assert {"licence", "provenance"} <= FULL.keys() and "held_out" in FULL["provenance"]
    assert "licence" not in found.document and "held_out" not in found.provenance
    assert merged([METADATA, Metadata()]).document.keys() == {"opening"}


def test_merging_keeps_the_options_that_all_parts_share_and_names_the_others():
    one, other = (
        METADATA.with_members(title=title, view_limits=None).with_provenance(options={"max_loss_db": 0.15, **options})
        for title, options in (("One", {"steps": 6000}), ("Other", {"steps": 8000, "downscale": 2}))
    )
    assert merged([one, other]).provenance["options"] == {"max_loss_db": 0.15}
    assert differences([one, other]) == ["title", "--steps", "--downscale"]
    assert differences([one, one]) == [] and "held-out quality" in differences([one, Metadata()])


def test_merging_keeps_the_view_limits_that_hold_in_all_parts():
    limits = FULL["view_limits"]
    narrower = METADATA.with_members(view_limits={**limits, "azimuth": [-50, 20], "reach": 0.5})
    found = merged([METADATA, narrower]).document["view_limits"]
    assert found == {**limits, "azimuth": [-30, 20], "reach": 0.5}
    for other in ({"focus": [1, 0, 0]}, {"distance": [5, 6]}):
        moved = METADATA.with_members(view_limits={**limits, **other})
        assert "view_limits" not in merged([METADATA, moved]).document


def test_a_clip_has_its_own_metadata_and_groups_keep_theirs(tmp_path):
    one, other = encoded(METADATA), encoded(METADATA.with_members(title="Another"))
    parts = [groups.GroupInput.of(one, 0), groups.GroupInput.of(other, 11)]
    groups.write(parts, tmp_path / "clip.kpc")
    clip = groups.Groups(tmp_path / "clip.kpc")
    assert clip.metadata() == METADATA.with_members(title=None)
    assert clip.open(1).metadata().title == "Another"
    assert groups.load(tmp_path / "clip.kpc").at(1.0)[0].metadata == clip.metadata()
    groups.write(parts, tmp_path / "named.kpc", Metadata({"title": "Both"}))
    again = groups.group_inputs([tmp_path / "named.kpc", tmp_path / "named.kpc"][:1])
    assert [part.metadata.title for part in again] == ["Both", "Both"]


@pytest.mark.parametrize(
    ("members", "words"),
    [
        ({"title": "a\tb"}, "title: a text holds tabs"),
        ({"description": "x" * 4097}, "a text is longer than 4,096 characters, by 1"),
        ({"metres_per_unit": 1e30}, "is 1e+30, outside its range from "),
    ],
)
def test_what_is_wrong_with_metadata_is_said(members, words):
    with pytest.raises(FormatError, match=re.escape(words)):
        pack_metadata(Metadata(members))


def places(value, path=()):
    """Yield the path of every value in a JSON object."""
    yield path
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for name, item in items:
        yield from places(item, (*path, name))


VALUES = st.one_of(
    st.none(), st.booleans(), st.integers(-(10**40), 10**40), st.floats(allow_nan=False), st.text(max_size=300),
    st.lists(st.integers(-2, 2), max_size=13), st.dictionaries(st.text(max_size=3), st.integers(), max_size=2),
)  # fmt: skip


@settings(max_examples=300, deadline=None)
@given(path=st.sampled_from(list(places(FULL))[1:]), value=VALUES, drops=st.booleans())
def test_package_and_readable_decoder_refuse_the_same_metadata(path, value, drops):
    document = copy.deepcopy(FULL)
    *parents, last = path
    inner = document
    for name in parents:
        inner = inner[name]
    if drops:
        del inner[last]
    else:
        inner[last] = value
    raw = json.dumps(document, ensure_ascii=True).encode()
    try:
        expected = parse_metadata(raw).document
    except FormatError as error:
        assert "\n" not in str(error)
        with pytest.raises(Refused):
            decode_metadata(raw)
    else:
        assert decode_metadata(raw) == expected


@settings(max_examples=200, deadline=None)
@given(raw=st.binary(max_size=40))
def test_arbitrary_bytes_are_read_or_refused(raw):
    for content in (raw, b'{"later":"' + raw + b'"}'):
        try:
            parse_metadata(content)
        except FormatError as error:
            assert str(error).isprintable()


def test_cameras_without_names_have_numbers() -> None:
    named = Metadata({"camera_names": ["left", "right"]})
    assert named.names_of(2) == ("left", "right") and named.names_of(3) == ("0", "1", "2")


@pytest.mark.parametrize(("given", "found"), [("Gr\u00f6\u00dfe", "Gr\u00f6\u00dfe"), ("caf\udce9", "caf\ufffd")])
def test_texts_that_are_not_in_the_encoding_of_the_terminal(given: str, found: str) -> None:
    parser = argparse.ArgumentParser()
    add_metadata_options(parser)
    assert members_from(parser.parse_args(["--title", given])) == {"title": found}
