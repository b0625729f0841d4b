"""The content of a plane segment under codecs RAW and ZSTD (spec/kpc-format.md, "RAW and ZSTD").

map mode (1 byte) | map (ceil(H W / 8) bytes, if the mode is MAP_CODED) | symbols (M x coded texels bytes)
"""

import numpy as np

from kpc.format.coding.texel_map import MAP_ALL, MAP_CODED
from kpc.format.common.errors import FormatError


def encode_raw_segment(symbols: np.ndarray, coded: np.ndarray) -> bytes:
    """Pack a plane segment: the map of its coded texels, unless all are, then the symbols of coded texels channel by
    channel.

    Args:
        symbols: (H, W, M) int8, 0 where not coded.
        coded: (H, W) bool.
    """
    channels = np.ascontiguousarray(symbols.transpose(2, 0, 1))[:, coded].tobytes()
    if coded.all():
        return bytes([MAP_ALL]) + channels
    return bytes([MAP_CODED]) + np.packbits(coded, bitorder="little").tobytes() + channels


def decode_raw_segment(payload: bytes, rows: int, columns: int, channels: int) -> tuple[np.ndarray, np.ndarray]:
    """Undo `encode_raw_segment`.

    Returns:
        (rows, columns, channels) int8 symbols and (rows, columns) bool, the coded texels.

    Raises:
        FormatError: the payload does not have the one length that its map implies, or names an unknown map mode.
    """
    texels, mode, start = rows * columns, payload[:1], 1
    if mode == bytes([MAP_CODED]):
        packed = np.frombuffer(payload[start : start + -(-texels // 8)], np.uint8)
        if packed.size * 8 < texels:
            raise FormatError("plane segment: too short for its map")
        if np.unpackbits(packed, bitorder="little")[texels:].any():
            raise FormatError("plane segment: the unused bits of its map are not 0")
        coded = np.unpackbits(packed, bitorder="little", count=texels).astype(bool).reshape(rows, columns)
        start += packed.size
    elif mode == bytes([MAP_ALL]):
        coded = np.ones((rows, columns), bool)
    else:
        raise FormatError("plane segment: unknown map mode")
    count = int(coded.sum())
    if len(payload) != start + channels * count:
        raise FormatError(f"plane segment: holds {len(payload)} bytes where its map implies {start + channels * count}")
    raster = np.zeros((channels, rows, columns), np.int8)
    raster[:, coded] = np.frombuffer(payload, np.int8, offset=start).reshape(channels, count)
    return np.ascontiguousarray(raster.transpose(1, 2, 0)), coded
