"""The soun chunks: the Opus packets of a sound, cut in segments of about a second (spec/kpc-format.md, "soun: sound").

The index says which decoded samples each chunk holds, in the fields that say of a PLNE chunk which rows it holds, so
that a player finds the chunk of a time without reading others.
"""

import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from kpc.format.common.errors import FormatError
from kpc.format.container.container import Chunk, Entry
from kpc.format.scene.sound import SAMPLE_RATE, Sound, packet_samples

KIND = "soun"
SOUND_STRUCT = struct.Struct("<BHIH")  # channels, pre_skip, sample_count, packet_count
SOUND_LIMIT = 1 << 20  # bytes of a chunk
DURATION_LIMIT = 480000  # samples of a chunk, 10 s


@dataclass(frozen=True)
class SoundSegment:
    """The content of a soun chunk.

    Attributes:
        channels, pre_skip, sample_count: of the whole sound, the same in all of its chunks.
        packets: of the segment.
    """

    channels: int
    pre_skip: int
    sample_count: int
    packets: tuple[bytes, ...]


def pack_sound(sound: Sound) -> list[Chunk]:
    """Return the soun chunks of a sound.

    Raises:
        FormatError: a reader would refuse them.
    """
    chunks: list[Chunk] = []
    first = 0
    while first < len(sound.packets):
        start, last = sound.starts[first], first + 1
        while last < len(sound.packets) and sound.starts[last + 1] - start <= SAMPLE_RATE:
            last += 1
        packets = sound.packets[first:last]
        try:
            head = SOUND_STRUCT.pack(sound.channels, sound.pre_skip, sound.sample_count, len(packets))
            raw = head + struct.pack(f"<{len(packets)}H", *map(len, packets)) + b"".join(packets)
        except struct.error as error:
            raise FormatError(f"soun: a number does not fit its field ({error})") from error
        parse_sound(raw, sound.starts[last] - start, sound.starts[-1])
        chunks.append(Chunk(KIND, raw, row_start=start, row_count=sound.starts[last] - start))
        first = last
    return chunks


def parse_sound(raw: bytes, samples: int, total: int) -> SoundSegment:
    """Read a soun chunk.

    Args:
        raw: the content.
        samples: that its packets decode to, by the index.
        total: samples of all chunks.

    Raises:
        FormatError: it breaks a rule.
    """
    if len(raw) < SOUND_STRUCT.size:
        raise FormatError(f"soun: ends after {len(raw)} bytes, {SOUND_STRUCT.size} needed")
    channels, pre_skip, sample_count, count = SOUND_STRUCT.unpack_from(raw)
    if not 1 <= channels <= 2 or not sample_count or pre_skip + sample_count > total:
        raise FormatError(
            f"soun: {channels} channels (1 or 2 allowed), "
            f"{pre_skip} and {sample_count} of {total} samples make no sense"
        )
    position = SOUND_STRUCT.size + 2 * count
    if position > len(raw):
        raise FormatError(f"soun: ends after {len(raw)} bytes, {position} needed")
    lengths = struct.unpack_from(f"<{count}H", raw, SOUND_STRUCT.size)
    if position + sum(lengths) != len(raw):
        raise FormatError(f"soun: packets of {sum(lengths)} bytes where there are {len(raw) - position}")
    packets = []
    for length in lengths:
        packets.append(raw[position : position + length])
        position += length
    if (found := sum(map(packet_samples, packets))) != samples:
        raise FormatError(f"soun: packets of {found} samples where the index claims {samples}")
    return SoundSegment(channels, pre_skip, sample_count, tuple(packets))


def sound_chunks(index: Sequence[Entry]) -> list[int]:
    """Return the numbers of the soun chunks in the order of time, once their fields in the index are checked.

    Raises:
        FormatError: they overlap, leave samples out, or claim another position.
    """
    numbers = [number for number, entry in enumerate(index) if entry.kind == KIND]
    numbers.sort(key=lambda number: index[number].row_start)
    sample = 0
    for number in numbers:
        entry = index[number]
        if entry.group or entry.scale or entry.plane:
            raise FormatError(f"chunk {number} (soun) claims a position among the planes")
        if entry.row_start != sample or not 0 < entry.row_count <= DURATION_LIMIT:
            raise FormatError(f"soun: no chunk starts at sample {sample}, or two do, or one has no or too many samples")
        sample += entry.row_count
    if sample >= 1 << 32:
        raise FormatError(f"soun: {sample} samples are more than a file may have")
    return numbers


def sound_of(segments: Iterable[SoundSegment]) -> Sound | None:
    """Return the sound of segments that follow one another from the first on; None without any.

    Raises:
        FormatError: they disagree.
    """
    segments = list(segments)
    heads = {(one.channels, one.pre_skip, one.sample_count) for one in segments}
    if len(heads) > 1:
        raise FormatError("soun: chunks disagree about channels, pre_skip or sample_count")
    packets = tuple(packet for one in segments for packet in one.packets)
    return Sound(*heads.pop(), packets) if heads else None
