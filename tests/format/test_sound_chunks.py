"""Sound in files: packets, chunks, parts, and where they lie."""

from dataclasses import replace

import numpy as np
import pytest

from kpc.encoder.coding import scene_writer
from kpc.format.coding.quantise import quantise_scene
from kpc.format.common.errors import BudgetError, FormatError
from kpc.format.container.container import Reader
from kpc.format.container.scene_io import SceneReader, read
from kpc.format.scene.scene import Clip
from kpc.format.scene.sound import PRE_ROLL, SAMPLE_RATE, Sound, packet_samples
from scenes import tiny_scene

CELT_20 = 31 << 3  # the first byte of a packet of one frame of 20 ms, 960 samples


def make_sound(seconds: int) -> Sound:
    """Return a sound of distinct packets of 20 ms."""
    packets = tuple(bytes([CELT_20, number % 256, number // 256]) for number in range(50 * seconds + 1))
    return Sound(1, 312, SAMPLE_RATE * seconds, packets)


def file_of(sound: Sound | None, seconds: int = 4) -> bytes:
    """Return the file of a scene of two scales with a sound."""
    scene = tiny_scene(scales=2, channels=2, resolution=(5, 5, 5), time=33)
    scene = replace(scene, sound=sound, clip=Clip(10 * seconds + 1, 10.0))
    return scene_writer.encode(quantise_scene(scene, [dict.fromkeys(scene.scales[0], 0.1)] * 2), segment_rows=16)


def test_a_sound_survives_and_silence_takes_no_byte():
    sound = make_sound(4)
    data = file_of(sound)
    assert read(data).sound == read(data).dequantise().sound == sound
    assert read(file_of(None)).sound is None and "soun" not in {entry.kind for entry in Reader(file_of(None)).index}


def test_sound_lies_behind_the_coarsest_planes_of_its_time():
    index = Reader(file_of(make_sound(4))).index
    order = [("s", entry.row_start) if entry.kind == "soun" else (entry.scale, entry.row_start)
             for entry in index if entry.kind in ("soun", "PLNE")]  # fmt: skip
    first, second = order.index(("s", 0)), order.index(("s", 2 * SAMPLE_RATE))
    assert set(order[:first]) == {(0, 0)} and order[first + 1][0] == "s"
    assert order.index((1, 0)) > first  # before the finer scale
    assert set(order[second - 3 : second]) == {(0, 16)} and order[second + 1] == ("s", 3 * SAMPLE_RATE)
    assert sum(kind == "s" for kind, _ in order) == 5  # of a second each, and what is left


def test_a_file_that_is_cut_off_has_the_sound_before_the_cut():
    data, sound = file_of(make_sound(4)), make_sound(4)
    third = [entry for entry in Reader(data).index if entry.kind == "soun"][2]
    found = read(data[: third.offset + 5], allow_partial=True).sound
    assert found == replace(sound, packets=sound.packets[:100])
    first = next(entry for entry in Reader(data).index if entry.kind == "soun")
    assert read(data[: first.offset], allow_partial=True).sound is None


def test_sound_counts_against_the_memory_budget():
    data = file_of(replace(make_sound(4), packets=tuple(bytes([CELT_20]) * 1200 for _ in range(201))))
    needed = SceneReader(data).planes_bytes
    with pytest.raises(BudgetError, match="with its sound"):
        SceneReader(data, memory_budget=needed + 500_000).sound()


@pytest.mark.parametrize("first, count", [(0, 1), (0, 48000), (100, 960), (50_000, 12_345), (SAMPLE_RATE - 1, 999_999)])
def test_a_part_holds_its_samples_and_their_pre_roll(first, count):
    sound = make_sound(2)
    part = sound.part(first, count)
    assert part.sample_count == min(count, sound.sample_count - first)
    offset = sound.packets.index(part.packets[0]) * 960  # the decoded sample of the whole that the part begins with
    assert offset + part.pre_skip == sound.pre_skip + first
    assert part.pre_skip >= min(PRE_ROLL, sound.pre_skip + first) and part.pre_skip < PRE_ROLL + 960
    end = part.pre_skip + part.sample_count
    assert end <= part.starts[-1] < end + 960  # no packet that is not needed


def test_a_part_of_a_part_is_a_part_of_the_whole():
    sound = make_sound(3)
    assert sound.part(10_000, 100_000).part(40_000, 20_000) == sound.part(50_000, 20_000)
    assert sound.part(3 * SAMPLE_RATE, 10) is None


def test_the_writer_refuses_what_readers_refuse():
    for wrong in ({"channels": 3}, {"pre_skip": 70_000}, {"sample_count": 10**6}, {"packets": (b"",)}):
        with pytest.raises(FormatError, match="soun"):
            file_of(replace(make_sound(1), **wrong))


def test_samples_of_packets_are_those_of_rfc_6716():
    # Table 2 of section 3.1: milliseconds of a frame by configuration.
    silk, hybrid, celt = [10, 20, 40, 60], [10, 20], [2.5, 5, 10, 20]
    frames_ms = np.array(3 * silk + 2 * hybrid + 4 * celt)
    found = [packet_samples(bytes([configuration << 3])) for configuration in range(32)]
    assert found == (48 * frames_ms).astype(int).tolist()
    assert packet_samples(bytes([CELT_20 | 1])) == packet_samples(bytes([CELT_20 | 2])) == 1920
    assert packet_samples(bytes([CELT_20 | 3, 0x80 | 0x40 | 6])) == 5760
