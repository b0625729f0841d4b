"""The conformance vectors of sound. Packets hold noise behind a valid first byte: no decoder of Opus is needed."""

import struct
from collections.abc import Callable, Sequence

from kpc.encoder.coding.scene_writer import scene_chunks
from kpc.format.container.container import Chunk, Reader
from kpc.format.container.sound_chunk import DURATION_LIMIT
from kpc.tools.vectors.files import Stored, assemble, raw, sealed, value_count, with_entry, zstd
from kpc.tools.vectors.scenes import make_scene, noise

# First bytes of packets: configuration, stereo and code of the number of frames (RFC 6716, section 3.1).
SILK_60, HYBRID_20, CELT_2_5, CELT_20 = 3 << 3, 15 << 3, 16 << 3, 31 << 3
TWO_FRAMES, MANY_FRAMES = 1, 3

Part = tuple[int, int, bytes]  # first sample, samples, content


def packet(first: int, length: int = 9, seed: int = 0) -> bytes:
    """Return a packet of some bytes."""
    return bytes([first]) + (noise((length,), 200 + seed) + 128).astype("u1").tobytes()[1:]


def content(
    packets: Sequence[bytes], channels: int = 1, pre_skip: int = 312, sample_count: int = 3000, count: int | None = None
) -> bytes:
    """Return the content of a chunk."""
    head = struct.pack("<BHIH", channels, pre_skip, sample_count, len(packets) if count is None else count)
    return head + struct.pack(f"<{len(packets)}H", *map(len, packets)) + b"".join(packets)


def valid() -> dict[str, tuple[bytes, bool]]:
    """Return files by name, and whether they are prefixes."""
    first, second = [packet(CELT_20, 60, k) for k in range(3)], [packet(HYBRID_20, 7, 9), packet(CELT_20, 1)]
    two = [(0, 2880, content(first)), (2880, 1920, content(second))]
    many = [packet(SILK_60 | TWO_FRAMES), bytes([CELT_2_5 | MANY_FRAMES, 48]), packet(CELT_2_5 | TWO_FRAMES, 2)]
    stereo = [(0, 11760, content(many, channels=2, pre_skip=11759, sample_count=1))]
    large, small = bytes([SILK_60 | TWO_FRAMES]).ljust(65535, b"\0"), bytes([SILK_60 | TWO_FRAMES])
    limits = content([large, *82 * [small], bytes([CELT_20 | TWO_FRAMES])], 2, 65535, DURATION_LIMIT - 65535)
    data = _file(two)
    return {
        "sound": (data, False),
        "sound-prefix": (data[: Reader(data).index[-1].offset], True),
        "sound-stereo": (_file(stereo), False),
        "sound-order": (_file(two[::-1]), False),
        "sound-zstd": (_file(two, zstd), False),
        "limits-sound": (_file([(0, DURATION_LIMIT, limits)], zstd), False),
    }


def invalid() -> dict[str, tuple[bytes, str, str]]:
    """Return files by name, the error and a part of its message."""
    packets = [packet(CELT_20, 60, k) for k in range(3)]

    def one(raw_content: bytes, samples: int = 2880) -> bytes:
        return _file([(0, samples, raw_content)])

    def of(*parts: bytes, samples: int = 960) -> bytes:
        return one(content(parts, pre_skip=0, sample_count=1), samples)

    good = content(packets, sample_count=2568)
    after = content(packets[:1], sample_count=2568)
    positioned = _file([(0, 2880, good)])
    number = len(Reader(positioned).index) - 1
    files = {
        "short": (one(good[:8]), "ends after 8 bytes"),
        "table": (one(good[:12]), "ends after"),
        "cut": (one(good[:-1]), "packets of 180 bytes where there are 179"),
        "long": (one(good + bytes(1)), "packets of 180 bytes where there are 181"),
        "channels": (one(content(packets, channels=3, sample_count=2568)), "3 channels"),
        "channels-none": (one(content(packets, channels=0, sample_count=2568)), "0 channels"),
        "nothing": (one(content(packets, sample_count=0)), "make no sense"),
        "beyond": (one(content(packets, sample_count=2569)), "make no sense"),
        "pre-skip": (one(content(packets, pre_skip=2881, sample_count=1)), "make no sense"),
        "samples": (one(good, 2881), "packets of 2880 samples where the index claims 2881"),
        "packet-empty": (of(b""), "too short"),
        "packet-short": (of(bytes([CELT_20 | MANY_FRAMES])), "too short"),
        "packet-none": (of(bytes([CELT_20 | MANY_FRAMES, 0])), "0 frames"),
        "packet-long": (of(bytes([CELT_20 | MANY_FRAMES, 7]), samples=6720), "7 frames"),
        "gap": (_file([(0, 2880, good), (2881, 960, after)]), "no chunk starts at sample 2880"),
        "overlap": (_file([(0, 2880, good), (2879, 960, after)]), "no chunk starts at sample 2880"),
        "start": (_file([(960, 2880, good)]), "no chunk starts at sample 0"),
        "empty": (_file([(0, 0, content([], sample_count=2568)), (0, 2880, good)]), "has no or too many"),
        "many": (_file([(0, DURATION_LIMIT + 1, good)]), "has no or too many"),
        "disagree": (_file([(0, 2880, good), (2880, 960, content(packets[:1], sample_count=2567))]), "disagree"),
        "scale": (sealed(with_entry(positioned, number, "scale", 1)), "claims a position"),
        "group": (sealed(with_entry(positioned, number, "group", 1)), "claims a position"),
        "codec": (sealed(with_entry(positioned, number, "codec", 2)), "uses codec 2"),
        "large": (_file([(0, 2880, content(17 * [65535 * b"\xf8"]))], zstd), "at most"),
    }
    return {f"sound-{name}": (found, "FormatError", message) for name, (found, message) in files.items()}


def _file(parts: Sequence[Part], store: Callable[[Chunk], Stored] = raw) -> bytes:
    """Return the file of a scene with soun chunks at its end."""
    scene = make_scene(dynamic=False, sizes=[(1, 2, 2, 2, 0)], cameras=1)
    chunks = [raw(chunk) for chunk in scene_chunks(scene)]
    sound = (store(Chunk("soun", body, row_start=start, row_count=count)) for start, count, body in parts)
    return assemble([*chunks, *sound], value_count(scene))
