"""Section 7: plane segments under each codec, and their dequantisation."""

from . import predictive, transform
from .common import ByteReader, f32, require, unpack_bits
from .container import PREDICTIVE
from .entropy import EntropyDecoder
from .texel_map import ALL_CODED, IMPLIED, STORED, all_coded, decode_map, implied_map


def decode_segment(scene, name, plane, row_start, row_count, content):
    """Return (coded, symbols) of a segment: {(y, x): 0 or 1} and {(y, x, c): symbol}."""
    H, W, M = row_count, plane["columns"], plane["channels"]
    chunk = ByteReader(content.data)
    if not content.is_coded:
        return decode_raw(chunk, H, W, M)
    require(content.raw_length == H * W * M, "invalid number of symbols")
    implied = scene, name, plane["rows"], plane["columns"], row_start, row_count
    if content.codec == PREDICTIVE:
        set_count, flags = chunk.unpack("BB")
        require(set_count in (1, 2, 4, 8) and flags >> 4 == 0, "invalid weight sets or flags")
        map_mode, quantiser = flags & 3, flags >> 2
        require(map_mode <= 2 and quantiser <= 2, "invalid map mode or quantiser")
        weights = [chunk.unpack("9b") for _ in range(set_count)]
        decisions = EntropyDecoder(chunk)
        coded = map_of(map_mode, decisions, H, W, implied)
        symbols = predictive.decode_symbols(decisions, coded, H, W, M, quantiser, weights)
    else:
        N, map_mode, base_step = chunk.unpack("BBB")
        require(N in (4, 8, 16) and (N == 4 or N <= 2 * min(H, W)), "invalid side of a block")
        require(map_mode <= 2 and base_step > 0, "invalid map mode or step")
        decisions = EntropyDecoder(chunk)
        coded = map_of(map_mode, decisions, H, W, implied)
        symbols = transform.decode_symbols(decisions, coded, H, W, M, N, base_step)
    decisions.finish()
    return coded, symbols


def map_of(map_mode, decisions, H, W, implied):
    if map_mode == ALL_CODED:
        return all_coded(H, W)
    return decode_map(decisions, H, W) if map_mode == STORED else implied_map(*implied)


def decode_raw(chunk, H, W, M):  # section 7.3
    (map_mode,) = chunk.unpack("B")
    require(map_mode < IMPLIED, "invalid map mode")
    coded = all_coded(H, W)
    if map_mode == STORED:
        stored = unpack_bits(chunk.take(-(-H * W // 8)), H * W)
        coded = dict(zip(coded, stored))
    symbols = {}
    for c in range(M):
        for y, x in coded:
            if coded[y, x]:
                (symbols[y, x, c],) = chunk.unpack("b")
    chunk.finish()
    return coded, symbols


def dequantise(plane):  # section 7.6
    """Return the values of a plane, row-major (row, column, channel)."""
    M, step, offset = plane["channels"], plane["step"], plane["offset"]
    return [f32(f32(symbol * step[i % M]) + offset[i % M]) for i, symbol in enumerate(plane["symbols"])]
