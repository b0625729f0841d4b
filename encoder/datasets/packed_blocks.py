"""Lossless coding of pictures of a still camera: a background, and blocks of pixels that differ from it.

The residual of a picture is its difference from the background modulo 256; red and blue less green, since what changes
is mostly brightness; and folded so that small numbers of either sign have few bits: 0, -1, 1, -2 become 0, 1, 2, 3. A
block of SIDE x SIDE pixels without residual takes nothing. Of others, the planes of equal bits are compressed by LZ4:
the upper ones are mostly empty, so LZ4, which has no entropy coder and is fast for that, halves the noise of a sensor,
too. Measured against other codecs in docs/design/datasets.md.
"""

from collections.abc import Sequence

import lz4.block
import numpy as np

# Pixels along the side of a block. Smaller ones need a longer index, larger ones take longer to decode.
SIDE = 16
AREA = SIDE * SIDE

# Pictures, evenly spread, whose median is the background; an odd number.
SAMPLES = 9


def block_bytes(channels: int) -> int:
    """Return the bytes of a block that is not compressed."""
    return AREA * channels


def blocks_across(pixels: int) -> int:
    """Return how many blocks cover a row or column of pixels."""
    return -(-pixels // SIDE)


def find_background(pictures: np.ndarray) -> np.ndarray:
    """Return the median of some of the pictures, (K, H, W, C) to (H, W, C) uint8, evenly spread over them."""
    count = min(SAMPLES, len(pictures) - (1 - len(pictures) % 2))
    chosen = np.linspace(0, len(pictures) - 1, count).round().astype(int) if count > 1 else [len(pictures) // 2]
    some = [pictures[k].copy() for k in chosen]
    # An odd-even transposition sort of all pixels at once; whole arrays sort a hundred times faster than each pixel.
    for turn in range(len(some)):
        for k in range(turn % 2, len(some) - 1, 2):
            some[k], some[k + 1] = np.minimum(some[k], some[k + 1]), np.maximum(some[k], some[k + 1])
    return some[len(some) // 2]


def pack(picture: np.ndarray, background: np.ndarray) -> tuple[bytes, np.ndarray]:
    """Code a picture.

    Args:
        picture, background: (H, W, C) uint8, with 3 or 4 channels.

    Returns:
        The coded blocks, row by row, and where they end: (blocks,) uint32. An empty block is like the background, and
        one of `block_bytes` is not compressed.
    """
    height, width, channels = picture.shape
    tall, wide = blocks_across(height), blocks_across(width)
    folded = np.pad(_fold(picture - background), ((0, tall * SIDE - height), (0, wide * SIDE - width), (0, 0)))
    blocks = folded.reshape(tall, SIDE, wide, SIDE * channels).swapaxes(1, 2)
    differs = np.bitwise_or.reduce(np.bitwise_or.reduce(blocks, axis=2), axis=2) != 0
    chosen = np.ascontiguousarray(blocks[differs].reshape(-1, AREA, channels).swapaxes(1, 2)).ravel()
    planes = np.empty((int(differs.sum()), 8, channels, AREA // 8), np.uint8)
    for bit in range(8):
        planes[:, bit] = np.packbits(chosen & np.uint8(1 << bit)).reshape(-1, channels, AREA // 8)
    size = block_bytes(channels)
    raw = memoryview(planes.tobytes())
    coded = [_compress(raw[start : start + size]) for start in range(0, len(raw), size)]
    lengths = np.zeros(tall * wide, np.uint32)
    lengths[differs.ravel()] = [len(block) for block in coded]
    return b"".join(coded), np.cumsum(lengths, dtype=np.uint32)


def expand(coded: Sequence[bytes], channels: int) -> np.ndarray:
    """Return the bit planes of coded blocks that are not empty, (N, 8, C, AREA / 8) uint8.

    Raises:
        ValueError: one is damaged.
    """
    size = block_bytes(channels)
    try:
        raw = b"".join(
            [block if len(block) == size else lz4.block.decompress(block, uncompressed_size=size) for block in coded]
        )
    except lz4.block.LZ4BlockError as error:
        raise ValueError(str(error)) from error
    return np.frombuffer(raw, np.uint8).reshape(len(coded), 8, channels, AREA // 8)


def residual_of_pixels(planes: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Return the residual of one pixel of each block.

    Args:
        planes: (N, 8, C, AREA / 8) uint8, from `expand`.
        position: (N,) int, the pixel, counted row by row.

    Returns:
        (N, C) uint8, to be added to the background modulo 256.
    """
    found = planes[np.arange(len(planes)), :, :, position >> 3]
    bits = found >> (7 - (position & 7)).astype(np.uint8)[:, None, None] & 1
    return _unfold(np.packbits(bits, axis=1, bitorder="little")[:, 0])


def residual_of_blocks(planes: np.ndarray) -> np.ndarray:
    """Return the residual of whole blocks, (N, 8, C, AREA / 8) to (N, SIDE, SIDE, C) uint8."""
    folded = np.zeros((len(planes), planes.shape[2], AREA), np.uint8)
    for bit in range(8):
        folded |= np.unpackbits(planes[:, bit], axis=-1) << np.uint8(bit)
    return _unfold(np.moveaxis(folded, 1, 2)).reshape(len(planes), SIDE, SIDE, -1)


def _fold(residual: np.ndarray) -> np.ndarray:
    residual[..., 0] -= residual[..., 1]
    residual[..., 2] -= residual[..., 1]
    return (residual << 1) ^ (0 - (residual >> 7))


def _unfold(folded: np.ndarray) -> np.ndarray:
    residual: np.ndarray = (folded >> 1) ^ (0 - (folded & 1))
    residual[..., 0] += residual[..., 1]
    residual[..., 2] += residual[..., 1]
    return residual


def _compress(block: memoryview) -> bytes:
    coded: bytes = lz4.block.compress(block, store_size=False)
    return coded if len(coded) < len(block) else bytes(block)
