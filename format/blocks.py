"""Plane segments as blocks of cosines: the other way to tell one under codec 2 (spec, section 6, "Blocks").

    N (1 byte) | flags (1 byte) | quantiser (1 byte) | rANS words: of the map, of how fine blocks are, then of levels, channel by channel

Where little is told of each symbol, predictions from what was told before hold mostly the errors of that. There it is better to tell
what is slow in a plane and what is quick apart: each block of N x N texels of a channel is a sum of cosines, whose factors, the *levels*,
are told in contexts of those of higher frequency, of the blocks to the left and above, and of the channel before. The means of
blocks are foreseen from their neighbours. Where errors are worth more, a block is told more finely. What a decoder makes of levels are
symbols, like any other: all in integers, 32 bits hold them.

Naming, throughout this module
    side        N, of a block
    level       the factor of a cosine, in quantisers; i down, j across are how quick it is
    diagonal    i + j; of a block those before its `end` are told, the quickest first
    fineness    of a block, in all channels: one more, and quantisers are sqrt(2) smaller
    mean        the level that does not change in a block, i = j = 0, in 1 / PARTS of a symbol; told as it differs from what is foreseen
    table       counters of `kpc.format.rans`
    state at words trace    of `kpc.format.rans.decide`
"""

from dataclasses import dataclass

import numpy as np

from kpc.format.errors import FormatError
from kpc.format.rans import SCALE, adapt, compiled, counters, decide, doublings, ended, inlined, integer, natural, opened, stream
from kpc.format.symbols import LATTICE_BIT, MAP, walk_map

SIDES = (4, 8, 16)
BLOCKS = 3
"""In the place of a lattice, `kpc.format.symbols`, in the flags."""
HEAD = 3
"""Bytes before the words."""

COSINES = np.rint(128 * np.sqrt(2) * np.cos(np.pi * np.arange(17) / 32)).astype(np.int64)
"""128 sqrt(2) cos(pi k / 32)."""
MEAN = 128
"""In their place for the mean."""
PARTS = 8
"""Of a symbol, in which quantisers are told."""
COEFFICIENT_MIN, COEFFICIENT_MAX = -(1 << 15), (1 << 15) - 1
COARSER_BITS = 6
"""Of `coarser` and FINER."""
FINENESSES, USUAL = 8, 3
FINER = np.rint((1 << COARSER_BITS) * 2.0 ** ((USUAL - np.arange(FINENESSES)) / 2)).astype(np.int64)
"""Quantisers by fineness, in 1 / 64 of what the segment says."""

SIZES, FREQUENCIES = 16, 9
"""Contexts: how large levels are around; how quick it is, the mean last."""
UNARY, ESCAPES = 5, 12
"""Magnitudes of 1 to UNARY take a decision each; of larger ones the number of bits, up to ESCAPES, comes first."""
DECISIONS = 1 + UNARY + ESCAPES
LARGEST = UNARY + (2 << ESCAPES) - 1
"""Magnitude that can be told."""
LIKELY = np.array([
    [27, 66, 61, 86, 79, 96, 118, 143, 168, 190, 206, 220, 230, 238, 243, 248],
    [19, 26, 24, 37, 37, 48, 67, 90, 120, 151, 179, 201, 217, 229, 235, 244],
    [110, 100, 90, 86, 82, 80, 87, 98, 117, 135, 160, 184, 204, 220, 230, 243],
])
"""What counters begin with, of 256, by how large levels are around: that there is one, that it is more than 1, than any more up to UNARY."""
KNOWN = 8
"""Decisions that this counts for."""
LIKELY_MEANS = np.array([243, 210, 220])
"""The same of means, whatever is around."""
ENDS, END_UNARY, END_ESCAPES = 8, 6, 4
"""Contexts of ends: what those around are. An end is told as it differs from them, as `kpc.format.rans.integer` tells it."""
END_DECISIONS = 2 + 2 * (END_UNARY + END_ESCAPES)
MOST_END_DECISIONS = 2 + END_UNARY + 2 * END_ESCAPES
MOST_DECISIONS = 2 + UNARY + 2 * ESCAPES
"""That a level takes."""


@dataclass(frozen=True, eq=False)
class Blocks:
    """What a segment tells.

    Attributes:
        levels: (M, blocks down, blocks across, N, N) int64; of blocks without a coded texel nothing is told.
        fineness: (blocks down, blocks across) int64, 0 to FINENESSES - 1.
        quantiser: 1 to 255, of USUAL fineness, in 1 / PARTS of a symbol.
    """

    levels: np.ndarray
    fineness: np.ndarray
    quantiser: int


def cosines(side: int) -> np.ndarray:
    """(N, N) int64: of each frequency, a row, what it is at each texel, in 1 / (128 sqrt(N)) of orthonormal cosines."""
    k = 16 // side * np.outer(np.arange(side), 2 * np.arange(side) + 1) % 64
    k = np.minimum(k, 64 - k)
    rows = np.where(k <= 16, COSINES[np.minimum(k, 16)], -COSINES[np.minimum(32 - np.minimum(k, 32), 16)])
    rows[0] = MEAN
    return rows


def coarser(side: int) -> np.ndarray:
    """(N,) int64: how much coarser each frequency is told along an axis, in 1 / 64. Look-ups, which lie between texels, see less of quick
    errors: (1 + cos(pi k / N) / 2)^(-1/2), as errors of neighbours count together by a quarter (`kpc.encoder.worth`)."""
    return np.rint((1 << COARSER_BITS) / np.sqrt(1 + 0.5 * np.cos(np.pi * np.arange(side) / side))).astype(np.int64)


def quantisers(side: int, quantiser: int) -> np.ndarray:
    """(FINENESSES, N, N) int64: of each level, in 1 / PARTS of a symbol."""
    along = coarser(side)
    bits = 3 * COARSER_BITS
    return np.maximum(quantiser * FINER[:, None, None] * np.outer(along, along) + (1 << bits - 1) >> bits, 1)


def largest_side(rows: int, columns: int) -> int:
    """Of blocks of a segment: so that padding does not make much more of it than it is."""
    return max((side for side in SIDES if side <= 2 * min(rows, columns)), default=SIDES[0])


def blocks_of(coded: np.ndarray, side: int) -> np.ndarray:
    """(blocks down, blocks across) bool: those with any coded texel."""
    rows, columns = coded.shape
    padded = np.pad(coded, ((0, -rows % side), (0, -columns % side)))
    return padded.reshape(-(-rows // side), side, -1, side).any((1, 3))


def encode_blocks(blocks: Blocks, coded: np.ndarray) -> bytes:
    """Code a segment whose (H, W) `coded` texels are those."""
    levels, coded = np.ascontiguousarray(blocks.levels), np.array(coded, order="C")
    side, busy = levels.shape[-1], blocks_of(coded, levels.shape[-1])
    trace, at = np.empty(coded.size + busy.size * (3 + MOST_END_DECISIONS * len(levels)) + levels.size * MOST_DECISIONS, np.int16), 0
    if has_map := not coded.all():
        _, at = walk_map(coded, 0, at, None, trace)
    fineness, finer = np.array(blocks.fineness, np.int64), quantisers(side, blocks.quantiser)
    _, at = walk_fineness(fineness, busy, 0, at, None, trace)
    _, at = walk_levels(levels, fineness, busy, finer, 0, at, None, trace, None, cosines(side), coded)
    return bytes([side, MAP * has_map | BLOCKS << LATTICE_BIT, blocks.quantiser]) + stream(trace[:at])


def holds_blocks(body: bytes) -> bool:
    """Whether a segment under codec 2 is told in blocks, else symbol by symbol."""
    return len(body) > 1 and body[1] >> LATTICE_BIT == BLOCKS


def decode_blocks(body: bytes, rows: int, columns: int, channels: int) -> tuple[np.ndarray, np.ndarray]:
    """What `encode_blocks` coded: (rows, columns, channels) int8 symbols, and (rows, columns) bool, the coded texels.

    Raises:
        FormatError: the body is cut, too long, or says what only a damaged one would.
    """
    if len(body) < HEAD or not holds_blocks(body) or body[0] not in SIDES or body[2] == 0:
        raise FormatError("plane segment: unknown side of blocks, or a quantiser of 0")
    side = body[0]
    if side > largest_side(rows, columns):
        raise FormatError(f"plane segment: blocks of {side}, more than twice its {min(rows, columns)} rows or columns")
    state, words = opened(body[HEAD:], "plane segment")
    symbols, coded, at = np.zeros((rows, columns, channels), np.int8), np.ones((rows, columns), bool), 0
    if body[1] & MAP:
        state, at = walk_map(coded, state, at, words, None)
    busy = blocks_of(coded, side)
    fineness = np.zeros(busy.shape, np.int64)
    if at <= len(words):
        state, at = walk_fineness(fineness, busy, state, at, words, None)
    if at <= len(words):
        state, at = walk_levels(None, fineness, busy, quantisers(side, body[2]), state, at, words, None, symbols, cosines(side), coded)
    ended(state, at, words, "plane segment")
    return symbols, coded


# --- the walk that encoder and decoder share


@compiled()
def walk_fineness(fineness, busy, state, at, words, trace):
    """Code how fine blocks are that are `busy`, or decode into it: (state, at). Others are as foreseen, the mean of left and above."""
    BY, BX = busy.shape
    table = counters(FINENESSES * FINENESSES)
    for by in range(BY):
        for bx in range(BX):
            left = fineness[by, bx - 1] if bx > 0 else fineness[by - 1, bx] if by > 0 else USUAL
            above = fineness[by - 1, bx] if by > 0 else left
            foreseen = left + above + 1 >> 1
            node, place = 1, FINENESSES >> 1
            if busy[by, bx]:
                while place:
                    bit, state, at = adapt(1 if fineness[by, bx] & place else 0, table, foreseen * FINENESSES + node, state, at, words, trace)
                    node = node << 1 | bit
                    place >>= 1
                fineness[by, bx] = node - FINENESSES
            else:
                fineness[by, bx] = foreseen
        if words is not None and at > words.size:
            break
    return state, at


@compiled()
def walk_levels(levels, fineness, busy, quantisers, state, at, words, trace, symbols, cosines, coded):
    """Code `levels` of blocks that are `busy`, or decode them into `symbols`: (state, at)."""
    BY, BX = busy.shape
    N = len(cosines)
    M = 0
    if levels is not None:
        M = len(levels)
    if symbols is not None:
        M = symbols.shape[2]
    table, end_table = level_counters(), counters(ENDS * END_DECISIONS)
    size, before = around(BY, BX, N), around(BY, BX, N)
    end, end_before = np.zeros((BY + 1, BX + 1), np.int64), np.zeros((BY + 1, BX + 1), np.int64)
    mean = np.zeros((BY + 1, BX + 1), np.int64)
    block, columns = np.zeros((N, N), np.int64), np.zeros((N, N), np.int64)
    for m in range(M):
        for by in range(BY):
            for bx in range(BX):
                Y, X, quantiser = by + 1, bx + 1, quantisers[fineness[by, bx], 0, 0]
                here, left, above, past = size[Y, X], size[Y, X - 1], size[Y - 1, X], before[Y, X]
                mean[Y, X] = foreseen_mean(mean, by, bx)
                foreseen = (mean[Y, X] + (quantiser >> 1)) // quantiser
                here[:], end[Y, X] = 0, 0
                if not busy[by, bx]:
                    continue
                block[:] = 0
                if levels is not None:
                    block[:] = levels[m, by, bx]
                    block[0, 0] -= foreseen
                usual = usual_end(end[Y, X - 1], end[Y - 1, X], end_before[Y, X])
                context = end_context(usual, N) * END_DECISIONS
                last, state, at = integer(last_diagonal(block) - usual, end_table, context, END_UNARY, END_ESCAPES, state, at, words, trace)
                end[Y, X] = min(max(last + usual, 0), 2 * N - 1)
                for diagonal in range(end[Y, X] - 1, -1, -1):
                    for i in range(max(0, diagonal - N + 1), min(diagonal, N - 1) + 1):
                        j = diagonal - i
                        context = level_context(here, left, above, past, i, j, N)
                        block[i, j], state, at = walk_level(block[i, j], table, context * DECISIONS, state, at, words, trace)
                        here[i, j] = abs(block[i, j])
                block[0, 0] += foreseen
                mean[Y, X] = coefficient(block[0, 0], quantiser)
                if symbols is not None:
                    rebuild(block, quantisers[fineness[by, bx]], cosines, columns)
                    for y in range(by * N, min(by * N + N, len(coded))):
                        for x in range(bx * N, min(bx * N + N, coded.shape[1])):
                            if coded[y, x]:
                                symbols[y, x, m] = block[y - by * N, x - bx * N]
            if words is not None and at > words.size:
                return state, at
        size, before = before, size
        end, end_before = end_before, end
    return state, at


@compiled()
def level_counters():
    """Counters of levels, DECISIONS a context, that know what is likely."""
    table = counters(SIZES * FREQUENCIES * DECISIONS)
    for context in range(SIZES * FREQUENCIES):
        for which in range(1 + UNARY):
            rank, is_mean = min(which, 2), context % FREQUENCIES == FREQUENCIES - 1
            likely = LIKELY_MEANS[rank] if is_mean else LIKELY[rank, context // FREQUENCIES]
            table[context * DECISIONS + which] = likely << 16 | KNOWN
    return table


@compiled()
def around(down, across, side):
    """Magnitudes of levels as they were told, of no blocks yet: with one more above and to the left, and two frequencies beyond each."""
    return np.zeros((down + 1, across + 1, side + 2, side + 2), np.int32)


@inlined
def coefficient(level, quantiser):
    return min(max(level * quantiser, COEFFICIENT_MIN), COEFFICIENT_MAX)


@inlined
def foreseen_mean(mean, by, bx):
    """The mean of a block by those to the left, above, and above to the left; `mean`: with one more above and to the left."""
    left, above = mean[by + 1, bx], mean[by, bx + 1]
    if by == 0:
        return left
    if bx == 0:
        return above
    return min(max(left, above), max(min(left, above), left + above - mean[by, bx]))


@compiled()
def last_diagonal(block):
    """One more than that of the quickest level that is not 0."""
    last = 0
    for i in range(len(block)):
        for j in range(len(block)):
            if block[i, j]:
                last = max(last, i + j + 1)
    return last


@inlined
def usual_end(left, above, before):
    """What an end may be, by those to the left and above and of the channel before."""
    return left + above + 2 * before + 2 >> 2


@inlined
def end_context(usual, side):
    """One of ENDS."""
    return 0 if usual == 0 else 1 + (usual - 1) * (ENDS - 1) // (2 * side - 1)


@inlined
def level_context(here, left, above, before, i, j, side):
    """How large a level may be, by those of higher frequencies, of neighbours and of the channel before; and how quick it is."""
    quicker = 2 * (here[i, j + 1] + here[i + 1, j]) + here[i + 1, j + 1] + here[i, j + 2] + here[i + 2, j]
    beside = left[i, j] + above[i, j] + left[i, j + 1] + above[i, j + 1] + left[i + 1, j] + above[i + 1, j]
    total = 3 * quicker + 2 * beside + 3 * before[i, j]
    large = min(doublings(total), SIZES - 1)
    quick = min(5 * (i + j) // side, FREQUENCIES - 2) if i + j else FREQUENCIES - 1
    return large * FREQUENCIES + quick


@inlined
def walk_level(value, table, first, state, at, words, trace):
    """Code or decode a level by DECISIONS counters from `first` on: (value, state, at)."""
    bit, state, at = adapt(1 if value != 0 else 0, table, first, state, at, words, trace)
    if not bit:
        return 0, state, at
    size, state, at = natural(abs(value), table, first + 1, UNARY, ESCAPES, state, at, words, trace)
    positive, state, at = decide(1 if value > 0 else 0, SCALE >> 1, state, at, words, trace)
    return size if positive else -size, state, at


@compiled()
def rebuild(block, quantisers, cosines, columns):
    """Turn levels into symbols, as far as 8 bits reach: cosines added up down the columns first, then along the rows."""
    N, quickest = len(block), 0
    shift = 10  # 14 bits of cosines, 3 of PARTS and log2 N, of which 7 are taken before
    while 1 << shift - 10 < N:
        shift += 1
    columns[:] = 0
    for i in range(N):
        for j in range(N):
            if block[i, j]:
                quickest = max(quickest, j)
                c = coefficient(block[i, j], quantisers[i, j])
                for y in range(N):
                    columns[y, j] += cosines[i, y] * c
    for y in range(N):
        for j in range(quickest + 1):
            columns[y, j] = columns[y, j] + 64 >> 7
        for x in range(N):
            total = 1 << shift - 1
            for j in range(quickest + 1):
                total += cosines[j, x] * columns[y, j]
            block[y, x] = min(max(total >> shift, -128), 127)
