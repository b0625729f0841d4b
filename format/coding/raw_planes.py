"""The payload of a plane segment under codecs 0 and 1: symbols as prediction residuals (spec/kpc-format.md, section 6).

    map flag (1 byte) | map (ceil(H W / 8) bytes, if the flag is 1) | filter (M bytes) | residuals (M x coded texels)

All arithmetic is modulo 256. Inside a segment an uncoded texel takes whatever its prediction says (residual 0) while
its neighbours are decoded, and symbol 0 afterwards; so every filter is a running sum over the raster, and uncoded
texels cost nothing but their bit in the map.
"""

import numpy as np
from kpc.format.common.errors import FormatError

FILTER_NONE, FILTER_LEFT, FILTER_UP, FILTER_PLANE = range(4)
FILTER_COUNT = 4

MAP_ABSENT, MAP_PRESENT = 0, 1


def encode_raw_segment(symbols: np.ndarray, coded: np.ndarray) -> list[bytes]:
    """Pack (H, W, M) int8 symbols, 0 wherever (H, W) `coded` is False; each channel gets the filter of least entropy.

    Returns:
        The payload in parts: what precedes the residuals, then the residuals of each channel.
    """
    channels = symbols.shape[2]
    raster = np.ascontiguousarray(symbols.transpose(2, 0, 1)).view(np.uint8)  # (M, H, W)
    candidates = [residual[:, coded] for residual in _residuals(raster, coded)]
    bits = np.array([[_entropy_bits(residual[m]) for m in range(channels)] for residual in candidates])
    filters = bits.argmin(axis=0).astype(np.uint8)
    coded_map = b"" if coded.all() else np.packbits(coded, bitorder="little").tobytes()
    flag = MAP_PRESENT if coded_map else MAP_ABSENT
    return [bytes([flag]) + coded_map + filters.tobytes(), *(candidates[f][m].tobytes() for m, f in enumerate(filters))]


def decode_raw_segment(payload: bytes, rows: int, columns: int, channels: int) -> tuple[np.ndarray, np.ndarray]:
    """Undo `encode_raw_segment`: (rows, columns, channels) int8 symbols and (rows, columns) bool, the coded texels.

    Raises:
        FormatError: the payload does not have the one length that its map implies, or names an unknown filter.
    """
    texels = rows * columns
    flag, start = payload[:1], 1
    if flag == bytes([MAP_PRESENT]):
        packed = np.frombuffer(payload[start : start + -(-texels // 8)], np.uint8)
        if packed.size * 8 < texels:
            raise FormatError("plane segment: too short for its map")
        if np.unpackbits(packed, bitorder="little")[texels:].any():
            raise FormatError("plane segment: the unused bits of its map are not 0")
        coded = np.unpackbits(packed, bitorder="little", count=texels).astype(bool).reshape(rows, columns)
        start += packed.size
    elif flag == bytes([MAP_ABSENT]):
        coded = np.ones((rows, columns), bool)
    else:
        raise FormatError("plane segment: unknown map flag")
    count = int(coded.sum())
    if len(payload) != start + channels + channels * count:
        raise FormatError(
            f"plane segment: holds {len(payload)} bytes where its map implies {start + channels + channels * count}"
        )
    filters = np.frombuffer(payload, np.uint8, channels, start)
    if (filters >= FILTER_COUNT).any():
        raise FormatError(f"plane segment: unknown filter {filters.max()}")

    raster = np.zeros((channels, rows, columns), np.uint8)
    raster[:, coded] = np.frombuffer(payload, np.uint8, offset=start + channels).reshape(channels, count)
    along_row = np.isin(filters, (FILTER_LEFT, FILTER_PLANE))
    raster[along_row] = np.cumsum(raster[along_row], axis=2, dtype=np.uint8)
    along_column = np.isin(filters, (FILTER_UP, FILTER_PLANE))
    raster[along_column] = np.cumsum(raster[along_column], axis=1, dtype=np.uint8)
    raster[:, ~coded] = 0
    return np.ascontiguousarray(raster.transpose(1, 2, 0)).view(np.int8), coded


def _residuals(raster: np.ndarray, coded: np.ndarray) -> list[np.ndarray]:
    """Residuals of (M, H, W) symbols under every filter, in the order of their numbers; meaningless where not coded.

    With v the symbols as the decoder sees them before it clears uncoded texels, and v = 0 outside the segment:
        none v, left v - v_left, up v - v_up, plane v - (v_left + v_up - v_upleft)
    """
    rows = raster.shape[1]
    left = _difference(_filled(raster, coded), axis=2)
    up = _difference(_filled(raster.swapaxes(1, 2), coded.T).swapaxes(1, 2), axis=1)
    plane = np.empty_like(raster)
    above = np.zeros_like(raster[:, 0])
    for row in range(rows):
        step = _filled(raster[:, row] - above, coded[row])
        plane[:, row] = _difference(step, axis=1)
        above = above + step
    return [raster, left, up, plane]


def _filled(values: np.ndarray, coded: np.ndarray) -> np.ndarray:
    """Replace each uncoded value by the nearest coded one before it along the last axis, 0 where there is none."""
    columns = np.arange(1, values.shape[-1] + 1)
    source = np.maximum.accumulate(np.where(coded, columns, 0), axis=-1)
    padded = np.concatenate([np.zeros_like(values[..., :1]), values], axis=-1)
    return np.take_along_axis(padded, np.broadcast_to(source, values.shape), axis=-1)


def _difference(values: np.ndarray, axis: int) -> np.ndarray:
    return np.diff(values, axis=axis, prepend=np.uint8(0))


def _entropy_bits(residual: np.ndarray) -> float:
    """Bits that an ideal order-0 code of these bytes would take."""
    counts = np.bincount(residual, minlength=1)
    counts = counts[counts > 0]
    return float((counts * np.log2(residual.size / counts)).sum())
