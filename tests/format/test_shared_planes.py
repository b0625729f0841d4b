"""Planes that groups of a clip share: what is stored once reads as before, and comes once from a server."""

from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from kpc.encoder.coding import scene_writer
from kpc.format.coding.quantise import quantise_scene
from kpc.format.common.errors import BudgetError, FormatError
from kpc.format.container import groups, http, scene_io, shared_planes
from kpc.format.container.container import ENTRY, Codec, Reader
from kpc.format.container.groups import GroupInput, Groups
from kpc.format.container.partial import PartialScene
from kpc.format.container.slices import Pieces
from kpc.format.container.sources import open_source
from kpc.player.sharing.file_server import Handler, serving
from scenes import tiny_scene

STARTS = (0, 11, 22, 33)


@pytest.fixture(scope="module")
def scenes() -> list[bytes]:
    """Four scenes of 11 frames, of which the first three have the same planes."""
    scene = tiny_scene(0, scales=1, channels=2)
    later = replace(scene, background=scene.background[::-1].copy()), tiny_scene(1, scales=1, channels=2)
    coded = [
        scene_writer.encode(quantise_scene(one, [dict.fromkeys(scale, 0.02) for scale in one.scales]))
        for one in (scene, *later)
    ]
    return [coded[0], coded[1], coded[0], coded[2]]


@pytest.fixture(scope="module")
def clip(scenes: list[bytes], tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("shared") / "long.kpc"
    groups.write([GroupInput.of(scene, start) for scene, start in zip(scenes, STARTS, strict=True)], path)
    return path


def planes_beside(path: Path) -> list[int]:
    return [number for number, entry in enumerate(Reader(path).index) if entry.kind == "PLNE"]


def test_planes_that_groups_store_alike_are_stored_once(clip, scenes):
    reader = Reader(clip)
    beside, whole = planes_beside(clip), Reader(scenes[0]).index
    assert beside == list(range(len(beside))) and len(beside) >= 3  # before the first group
    assert all(reader.index[number].stored_length > ENTRY.size for number in beside)
    shared = sum(reader.index[number].stored_length for number in beside)
    assert clip.stat().st_size < sum(map(len, scenes)) - 2 * shared + 1000
    opened = Groups(clip)
    used = [[plane.chunk for plane in opened.open(number).beside.values()] for number in range(4)]
    assert used == [beside, beside, beside, []]
    codecs = [[entry.codec for entry in Reader(opened.source_of(number)).index] for number in (0, 3)]
    assert codecs[0].count(Codec.SHARED) == len(beside) and Codec.SHARED not in codecs[1]
    assert all(entry.codec in list(Codec) for entry in whole)


def test_groups_read_and_split_and_join_as_if_nothing_was_shared(clip, scenes, tmp_path):
    opened = Groups(clip)
    for number, scene in enumerate(scenes):
        whole = opened.whole(number)
        assert whole.read_at(0, whole.size) == scene
        found, expected = scene_io.read(opened.open(number)), scene_io.read(scene)
        assert scene_writer.encode(found) == scene_writer.encode(expected)
        part = PartialScene(opened.open(number, apart=True))
        part.fetch(map(int, part.numbers))
        assert np.array_equal(part.scene.scales[0]["xy"], expected.dequantise().scales[0]["xy"])
    groups.write(groups.group_inputs([clip]), tmp_path / "again.kpc")
    assert (tmp_path / "again.kpc").read_bytes() == clip.read_bytes()
    groups.check_checksums(opened)


def test_pieces_are_read_at_any_place():
    data = bytes(range(100))
    pieces = Pieces(b"head", open_source(data), [(10, 5), (50, 0), (90, 8), (0, 3)], "pieces")
    whole = b"head" + data[10:15] + data[90:98] + data[:3]
    assert pieces.size == len(whole)
    for offset in range(len(whole) + 1):
        for length in (0, 1, 7, 100):
            assert pieces.read_at(offset, length) == whole[offset : offset + length]


def test_a_group_too_small_for_its_values_shares_nothing(scenes, tmp_path, monkeypatch):
    monkeypatch.setattr(shared_planes, "EXPANSION_LIMIT", 1)
    groups.write([GroupInput.of(scenes[0], start) for start in STARTS[:2]], tmp_path / "long.kpc")
    assert planes_beside(tmp_path / "long.kpc") == []


class Counting(Handler):
    """Counts how often each byte of a file is asked for."""

    asked: ClassVar[Counter[int]] = Counter()

    def do_GET(self) -> None:
        first, last = self.headers["Range"].removeprefix("bytes=").split("-")
        self.asked.update(range(int(first), int(last) + 1))
        super().do_GET()


@pytest.fixture
def url(clip: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """The address of the clip, of which the beginning is not fetched for header and index."""
    monkeypatch.setattr(http, "FIRST_BYTES", 100)
    monkeypatch.setattr(http, "BEGINNING_BYTES", 100)
    Counting.asked.clear()
    with serving(clip.parent, handler=Counting) as address:
        yield f"{address}/{clip.name}"


def test_a_server_sends_each_shared_plane_once_for_all_groups(clip, url):
    index = Reader(clip).index
    places = [k for n in planes_beside(clip) for k in range(index[n].offset, index[n].offset + index[n].stored_length)]
    remote = Groups(url, in_parts=True)

    def fetch(number: int) -> np.ndarray:
        part = PartialScene(remote.open(number, apart=True))
        part.fetch(map(int, part.numbers))
        part.reader.source.close()
        return part.scene.scales[0]["yz"]

    found = [fetch(0), fetch(1)]
    scene_io.read(remote.open(2))
    assert {Counting.asked[place] for place in places} == {1}
    remote.reader.source.close()
    remote = Groups(url, in_parts=True)
    with ThreadPoolExecutor(2) as pool:
        found += pool.map(fetch, (1, 2))  # threads that race may ask for one twice
    expected = scene_io.read(Groups(clip).open(1)).dequantise().scales[0]["yz"]
    assert all(np.array_equal(one, expected) for one in found)
    remote.reader.source.close()


def test_kept_planes_are_counted_and_bounded(clip, scenes, url, monkeypatch):
    needed = 5 * Reader(clip).header.value_count
    kept = sum(Reader(clip).index[number].stored_length for number in planes_beside(clip))
    remote = Groups(url)
    assert remote.open(0).kept_bytes == kept and Groups(clip).open(0).kept_bytes == 0
    remote.reader.source.close()
    tight = Groups(url, memory_budget=needed + 1)
    with pytest.raises(BudgetError, match="more than the budget"):
        scene_io.read(tight.open(0), memory_budget=needed + 1)
    tight.reader.source.close()
    monkeypatch.setattr(shared_planes, "KEPT_SHARE", 0.0)
    remote = Groups(url)
    for number in range(3):
        assert scene_writer.encode(scene_io.read(remote.open(number))) == scenes[number]
    remote.reader.source.close()


def test_a_damaged_shared_plane_is_named(clip, tmp_path):
    data, number = bytearray(clip.read_bytes()), planes_beside(clip)[0]
    data[Reader(clip).index[number].offset] ^= 1
    (tmp_path / "damaged.kpc").write_bytes(data)
    opened = Groups(tmp_path / "damaged.kpc")
    with pytest.raises(FormatError, match=r"group 1: chunk \d+ \(PLNE\), the shared plane xy of scale 0, is damaged"):
        scene_io.read(opened.open(1))
    with pytest.raises(FormatError, match=rf"chunk {number} \(PLNE\), the shared plane xy of scale 0, is damaged"):
        groups.check_checksums(opened)
    assert scene_io.read(opened.open(3)).clip.frame_count == 11
    with pytest.raises(FormatError, match="is damaged"):
        groups.write(groups.group_inputs([tmp_path / "damaged.kpc"]), tmp_path / "again.kpc")
