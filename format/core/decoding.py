"""What the decoder core decodes, as arrays: plane segments, maps, and the contents of other chunks.

All functions take `memory_limit`, the bytes that the core may take beside CORE_BYTES, and raise

    FormatError     the body is cut off, too long or damaged
    BudgetError     decoding takes more memory
"""

import struct

import numpy as np

from kpc.format.core.core import ADDRESSES, borrow_core

# Memory that the core takes for itself, at most: its tables, and rows of what it keeps of a segment.
CORE_BYTES = 32 << 20

POSES_HEAD = struct.Struct("<HHb")  # count, lens count and exponent, which messages name


def decode_segment(
    codec: int,
    body: bytes,
    rows: int,
    columns: int,
    channels: int,
    implied: np.ndarray | None = None,
    memory_limit: int = ADDRESSES,
) -> tuple[np.ndarray, np.ndarray]:
    """Decode a plane segment under any codec; a Zstandard frame must have been decompressed.

    Args:
        codec: its number.
        implied: (rows, columns) bool, the map that the occupancy implies; needed where the body says so.

    Returns:
        (rows, columns, channels) int8 symbols and (rows, columns) bool, the coded texels.
    """
    texels, values = rows * columns, rows * columns * channels
    with borrow_core() as core:
        coded = core.begin(memory_limit + CORE_BYTES, values, texels + values + len(body))
        symbols, at = coded + texels, coded + texels + values
        core.put(at, body)
        if implied is not None:
            core.put(coded, implied.tobytes())
        arguments = codec, at, len(body), rows, columns, channels, int(implied is not None), coded, symbols
        details = {"length": len(body), "side": body[0] if body else 0, "shorter": min(rows, columns)}
        core.run("kpc_segment", *arguments, what="plane segment", **details)
        found = core.get(symbols, values).view(np.int8).reshape(rows, columns, channels)
        return found, core.get(coded, texels).view(bool).reshape(rows, columns)


def implied_rows(projected: np.ndarray, rows: int, columns: int, some: range) -> np.ndarray:
    """Return rows of the map that the occupancy implies for a plane: (len(some), columns) bool.

    Args:
        projected: (cells down, cells across) bool, the occupancy projected onto the plane.
        rows, columns: of the plane.
        some: consecutive rows.
    """
    with borrow_core() as core:
        texels = len(some) * columns
        coded = core.begin(ADDRESSES, texels + projected.size, texels + projected.size)
        core.put(coded + texels, projected.tobytes())
        sizes = *projected.shape, rows, columns, some.start, len(some)
        core.run("kpc_implied_map", coded + texels, *sizes, coded, what="implied map")
        return core.get(coded, texels).view(bool).reshape(-1, columns)


def decode_motion(body: bytes, raw_length: int, memory_limit: int = ADDRESSES) -> bytes:
    """Decode MOVE under MOTION to its content under RAW."""
    return _decode_content("kpc_motion", body, raw_length, memory_limit, what="motion")


def decode_occupancy(body: bytes, raw_length: int, memory_limit: int = ADDRESSES) -> bytes:
    """Decode OCCU under OCCUPANCY to its content under RAW."""
    return _decode_content("kpc_occupancy", body, raw_length, memory_limit, what="occupancy")


def decode_weights(is_hybrid: bool, body: bytes, raw_length: int, memory_limit: int = ADDRESSES) -> bytes:
    """Decode DECO, or HYBR, under WEIGHTS to its content under RAW."""
    return _decode_content("kpc_weights", body, raw_length, memory_limit, int(is_hybrid), what="weights")


def decode_poses(body: bytes, raw_length: int, memory_limit: int = ADDRESSES) -> bytes:
    """Decode came under POSES to its content under RAW."""
    count, lens_count, exponent = POSES_HEAD.unpack(body[:5].ljust(5, b"\0"))
    details = {"count": count, "lens_count": lens_count, "exponent": exponent}
    return _decode_content("kpc_poses", body, raw_length, memory_limit, what="came", **details)


def _decode_content(
    function: str, body: bytes, raw_length: int, memory_limit: int, *options: int, what: str, **details: int
) -> bytes:
    with borrow_core() as core:
        raw = core.begin(memory_limit + CORE_BYTES, 8 * raw_length, raw_length + len(body))
        at = raw + raw_length
        core.put(at, body)
        details |= {"length": len(body), "raw_length": raw_length}
        core.run(function, *options, at, len(body), raw, raw_length, what=what, **details)
        return core.get(raw, raw_length).tobytes()
