"""The decoder core as the tests of the codecs call it: a function for each codec, of its body alone."""

import struct
from collections.abc import Sequence

import numpy as np

from kpc.format.container.container import Codec
from kpc.format.core import decoding

Segment = tuple[np.ndarray, np.ndarray]


def decode_symbols(body: bytes, *shape: int, implied: np.ndarray | None = None) -> Segment:
    return decoding.decode_segment(Codec.PREDICTIVE, body, *shape, implied)


def decode_blocks(body: bytes, rows: int, columns: int, channels: int, implied: np.ndarray | None = None) -> Segment:
    return decoding.decode_segment(Codec.TRANSFORM, body, rows, columns, channels, implied)


def decode_raw_segment(body: bytes, *shape: int) -> Segment:
    return decoding.decode_segment(Codec.RAW, body, *shape)


def decode_motion(body: bytes, shape: Sequence[int]) -> np.ndarray:
    """Return int16 symbols of that shape, (t, z, y, x, 3)."""
    raw = decoding.decode_motion(struct.pack("<4Hf", *shape[:4], 1.0) + body, 12 + 2 * int(np.prod(shape)))
    return np.frombuffer(raw, "<i2", offset=12).reshape(shape)


def decode_occupancy(body: bytes, shape: Sequence[int]) -> np.ndarray:
    """Return bool of that shape, (slots, z, y, x)."""
    cells = int(np.prod(shape))
    raw = decoding.decode_occupancy(struct.pack("<4H", *shape) + body, 8 + -(-cells // 8))
    return np.unpackbits(np.frombuffer(raw, np.uint8, offset=8), bitorder="little", count=cells).reshape(shape) == 1


def decode_weights(body: bytes, shapes: Sequence[tuple[int, ...]]) -> list[np.ndarray]:
    """Return float32 arrays of the shapes of DECO's, density_weight (features,) first."""
    features, hidden = shapes[0][0], shapes[2][0]
    sizes = [int(np.prod(shape)) for shape in shapes]
    raw = decoding.decode_weights(False, struct.pack("<HHf", features, hidden, 0.0) + body, 8 + 2 * sum(sizes))
    parts = np.split(np.frombuffer(raw, "<f2", offset=8).astype(np.float32), np.cumsum(sizes)[:-1])
    return [part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)]


def decode_poses(body: bytes) -> list[tuple[float, ...]]:
    """Return the 18 numbers of each camera."""
    raw = decoding.decode_poses(body, 2 + 68 * int.from_bytes(body[:2], "little"))
    return list(struct.Struct("<HH16f").iter_unpack(raw[2:]))
