"""The content of a plane segment under codecs RAW and ZSTD (spec/kpc-format.md, "RAW and ZSTD").

map mode (1 byte) | map (ceil(H W / 8) bytes, if the mode is MAP_CODED) | symbols (M x coded texels bytes)
"""

import numpy as np

from kpc.format.container.segments import MAP_ALL, MAP_CODED


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
