"""Plane segments as blocks of cosines: the other way to tell one under codec 2, and codec 3 (spec, section 6, "Blocks").

    N (1 byte) | flags (1 byte) | quantiser (1 byte) | rANS words: of the map, of how fine blocks are, then of levels, channel by channel

Where little is told of each symbol, predictions from what was told before hold mostly the errors of that. There it is better to tell
what is slow in a plane and what is quick apart: each block of N x N texels of a channel is a sum of cosines, whose factors, the *levels*,
are told in contexts of those of higher frequency, of the blocks to the left and above, and of the channel before. The means of
blocks are foreseen from their neighbours. Where errors are worth more, a block is told more finely. What a decoder makes of levels are
symbols, like any other: all in integers, 32 bits hold them.

Under codec 3 blocks go on from the *borders* of those to the left and above: what lies next to a block there is about what lies within it. So its mean is foreseen,
and the sign of each level that would make the step across the border smaller is the likelier one (Clare, Henry and Jung, JCTVC-A114, 2010, of
video). Of shelf_hand, blocks take 4 % fewer bytes at 33 dB of agreement and 6 at 43, ends told in other contexts included.

Naming, throughout this module
    side        N, of a block
    level       the factor of a cosine, in quantisers; i down, j across are how quick it is
    diagonal    i + j; of a block those before its `end` are told, the quickest first
    step_offsets    of a block, in all channels: one more, and quantisers are sqrt(2) smaller
    mean        the level that does not change in a block, i = j = 0, in 1 / PARTS of a symbol; told as it differs from what is foreseen
    rest        (2, N), along the left side of a block and along its upper one: by how much what lies across the border exceeds what a block has so far
                been told to be there, in 1 / PARTS of a symbol
    table       counters of `kpc.format.coding.rans`
    state at words trace    of `kpc.format.coding.rans.code_bit`
"""

from dataclasses import dataclass

import numpy as np
from kpc.format.coding.predictive import LATTICE_BIT, MAP, THIRD, code_map, initial_map, known_flags, map_mode
from kpc.format.coding.rans import (
    SCALE,
    check_end,
    code_bit,
    code_bit_adaptive,
    code_signed,
    code_unsigned,
    encode_trace,
    log_class,
    new_models,
    open_stream,
)
from kpc.format.common.errors import FormatError
from kpc.format.common.jit import compiled, inlined

SIDES = (4, 8, 16)
BLOCKS = 3
"""In the place of a lattice, `kpc.format.coding.predictive`, in the flags."""
HEAD = 3
"""Bytes before the words."""

COSINES = np.rint(128 * np.sqrt(2) * np.cos(np.pi * np.arange(17) / 32)).astype(np.int64)
"""128 sqrt(2) cos(pi k / 32)."""
MEAN = 128
"""In their place for the mean."""
UNITS_PER_SYMBOL = 8
"""Of a symbol, in which quantisers are told."""
COEFFICIENT_MIN, COEFFICIENT_MAX = -(1 << 15), (1 << 15) - 1
COARSER_BITS = 6
"""Of `frequency_weights` and FINER."""
OFFSET_COUNT, DEFAULT_OFFSET = 8, 3
FINER = np.rint((1 << COARSER_BITS) * 2.0 ** ((DEFAULT_OFFSET - np.arange(OFFSET_COUNT)) / 2)).astype(np.int64)
"""Quantisers by step_offsets, in 1 / 64 of what the segment says."""

MAGNITUDE_CONTEXTS, FREQUENCY_CLASSES = 16, 9
"""Contexts: how large levels are around; how quick it is, the mean last."""
UNARY, ESCAPES = 5, 12
"""Magnitudes of 1 to UNARY take a decision each; of larger ones the number of bits, up to ESCAPES, comes first."""
MODELS_PER_CONTEXT = 1 + UNARY + ESCAPES
LARGEST = UNARY + (2 << ESCAPES) - 1
"""Magnitude that can be told."""
LIKELY = np.array(
    [
        [27, 66, 61, 86, 79, 96, 118, 143, 168, 190, 206, 220, 230, 238, 243, 248],
        [19, 26, 24, 37, 37, 48, 67, 90, 120, 151, 179, 201, 217, 229, 235, 244],
        [110, 100, 90, 86, 82, 80, 87, 98, 117, 135, 160, 184, 204, 220, 230, 243],
    ]
)
"""What counters begin with, of 256, by how large levels are around: that there is one, that it is more than 1, than any more up to UNARY."""
KNOWN = 8
"""Decisions that this counts for."""
LIKELY_MEANS = np.array([243, 210, 220])
"""The same of means, whatever is around."""
END_CONTEXTS, END_UNARY, END_ESCAPES = 10, 2, 4
"""Contexts of ends: what those around are. One more than an end is told as `kpc.format.coding.rans.code_unsigned` tells it."""
END_DECISIONS = END_UNARY + END_ESCAPES
PLAIN_ENDS, PLAIN_END_UNARY = 8, 6
"""The same without borders, where an end is told as it differs from those around, as `kpc.format.coding.rans.code_signed` tells it."""
PLAIN_END_DECISIONS = 2 + 2 * (PLAIN_END_UNARY + END_ESCAPES)
MOST_END_DECISIONS = 2 + PLAIN_END_UNARY + 2 * END_ESCAPES
SIGN_PROBABILITIES = np.array(
    [134, 135, 138, 141, 152, 159, 164, 170, 178, 184, 190, 197, 205, 212, 218, 224, 229, 234, 239, 244]
)
"""What counters of signs begin with, of 256, by how much likelier one is than the other: that it is that one."""
SURENESS = 11
"""The context of a sign that halves, to its square, what is missing of a step of the quantiser of means."""
LARGEST_REST = (1 << 12) - 1
MAX_DECISIONS = 2 + UNARY + 2 * ESCAPES
"""That a level takes."""


@dataclass(frozen=True, eq=False)
class TransformBlocks:
    """What a segment tells.

    Attributes:
        levels: (M, blocks down, blocks across, N, N) int64; of blocks without a coded texel nothing is told.
        step_offsets: (blocks down, blocks across) int64, 0 to FINENESSES - 1.
        quantiser: 1 to 255, of USUAL step_offsets, in 1 / PARTS of a symbol.
    """

    levels: np.ndarray
    step_offsets: np.ndarray
    quantiser: int


def dct_basis(side: int) -> np.ndarray:
    """(N, N) int64: of each frequency, a row, what it is at each texel, in 1 / (128 sqrt(N)) of orthonormal cosines."""
    k = 16 // side * np.outer(np.arange(side), 2 * np.arange(side) + 1) % 64
    k = np.minimum(k, 64 - k)
    rows = np.where(k <= 16, COSINES[np.minimum(k, 16)], -COSINES[np.minimum(32 - np.minimum(k, 32), 16)])
    rows[0] = MEAN
    return rows


def frequency_weights(side: int) -> np.ndarray:
    """(N,) int64: how much coarser each frequency is told along an axis, in 1 / 64. Look-ups, which lie between texels, see less of quick
    errors: (1 + cos(pi k / N) / 2)^(-1/2), as errors of neighbours count together by a quarter (`kpc.encoder.rdo.distortion`)."""
    return np.rint((1 << COARSER_BITS) / np.sqrt(1 + 0.5 * np.cos(np.pi * np.arange(side) / side))).astype(np.int64)


def step_table(side: int, quantiser: int) -> np.ndarray:
    """(FINENESSES, N, N) int64: of each level, in 1 / PARTS of a symbol."""
    along = frequency_weights(side)
    bits = 3 * COARSER_BITS
    return np.maximum(quantiser * FINER[:, None, None] * np.outer(along, along) + (1 << bits - 1) >> bits, 1)


def largest_side(rows: int, columns: int) -> int:
    """Of blocks of a segment: so that padding does not make much more of it than it is."""
    return max((side for side in SIDES if side <= 2 * min(rows, columns)), default=SIDES[0])


def coded_blocks(coded: np.ndarray, side: int) -> np.ndarray:
    """(blocks down, blocks across) bool: those with any coded texel."""
    rows, columns = coded.shape
    padded = np.pad(coded, ((0, -rows % side), (0, -columns % side)))
    return padded.reshape(-(-rows // side), side, -1, side).any((1, 3))


def encode_blocks(
    blocks: TransformBlocks, coded: np.ndarray, implied: np.ndarray | None = None, borders: bool = True
) -> bytes:
    """Code a segment whose (H, W) `coded` texels are those. `implied`: the map that needs not be told. `borders`: whether blocks go on from
    them; codec 2 has neither."""
    levels, coded = np.ascontiguousarray(blocks.levels), np.array(coded, order="C")
    side, busy = levels.shape[-1], coded_blocks(coded, levels.shape[-1])
    trace, at = (
        np.empty(
            coded.size + busy.size * (3 + MOST_END_DECISIONS * len(levels)) + levels.size * MAX_DECISIONS, np.int16
        ),
        0,
    )
    flags = map_mode(coded, implied)
    if flags & MAP:
        _, at = code_map(coded, 0, at, None, trace)
    step_offsets, finer = np.array(blocks.step_offsets, np.int64), step_table(side, blocks.quantiser)
    _, at = code_offsets(step_offsets, busy, 0, at, None, trace)
    _, at = code_levels(levels, step_offsets, busy, finer, borders, 0, at, None, trace, None, dct_basis(side), coded)
    return bytes([side, flags | BLOCKS << LATTICE_BIT | THIRD * borders, blocks.quantiser]) + encode_trace(trace[:at])


def holds_blocks(body: bytes) -> bool:
    """Whether a segment under codec 2 or 3 is told in blocks, else symbol by symbol."""
    return len(body) > 1 and known_flags(body[1]) and body[1] >> LATTICE_BIT & 3 == BLOCKS


def decode_blocks(
    body: bytes, rows: int, columns: int, channels: int, implied: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """What `encode_blocks` coded: (rows, columns, channels) int8 symbols, and (rows, columns) bool, the coded texels.

    Raises:
        FormatError: the body is cut, too long, or says what only a damaged one would.
    """
    symbols, coded, _ = _decoded(body, rows, columns, channels, implied, None)
    return symbols, coded


def decode_levels(
    body: bytes, rows: int, columns: int, channels: int, implied: np.ndarray | None = None
) -> TransformBlocks:
    """What `encode_blocks` was given, of a body that `decode_blocks` decodes; levels of blocks without a coded texel are 0."""
    side = body[0]
    levels = np.zeros((channels, *coded_blocks(np.zeros((rows, columns), bool), side).shape, side, side), np.int64)
    _, _, step_offsets = _decoded(body, rows, columns, channels, implied, levels)
    return TransformBlocks(levels, step_offsets, body[2])


def _decoded(
    body: bytes, rows: int, columns: int, channels: int, implied: np.ndarray | None, levels: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Symbols, coded texels and how fine blocks are; `levels`, as of `TransformBlocks`, are filled in."""
    if len(body) < HEAD or not holds_blocks(body) or body[0] not in SIDES or body[2] == 0:
        raise FormatError("plane segment: unknown side of blocks, or a quantiser of 0")
    side = body[0]
    if side > largest_side(rows, columns):
        raise FormatError(f"plane segment: blocks of {side}, more than twice its {min(rows, columns)} rows or columns")
    state, words = open_stream(body[HEAD:], "plane segment")
    symbols, coded, at = np.zeros((rows, columns, channels), np.int8), initial_map(body[1], rows, columns, implied), 0
    if body[1] & MAP:
        state, at = code_map(coded, state, at, words, None)
    busy = coded_blocks(coded, side)
    step_offsets = np.zeros(busy.shape, np.int64)
    if at <= len(words):
        state, at = code_offsets(step_offsets, busy, state, at, words, None)
    if at <= len(words):
        borders, finer = body[1] & THIRD != 0, step_table(side, body[2])
        state, at = code_levels(
            levels, step_offsets, busy, finer, borders, state, at, words, None, symbols, dct_basis(side), coded
        )
    check_end(state, at, words, "plane segment")
    return symbols, coded, step_offsets


# --- the walk that encoder and decoder share


@compiled()
def code_offsets(step_offsets, busy, state, at, words, trace):
    """Code how fine blocks are that are `busy`, or decode into it: (state, at). Others are as foreseen, the mean of left and above."""
    BY, BX = busy.shape
    table = new_models(OFFSET_COUNT * OFFSET_COUNT)
    for by in range(BY):
        for bx in range(BX):
            left = step_offsets[by, bx - 1] if bx > 0 else step_offsets[by - 1, bx] if by > 0 else DEFAULT_OFFSET
            above = step_offsets[by - 1, bx] if by > 0 else left
            foreseen = left + above + 1 >> 1
            node, place = 1, OFFSET_COUNT >> 1
            if busy[by, bx]:
                while place:
                    bit, state, at = code_bit_adaptive(
                        1 if step_offsets[by, bx] & place else 0,
                        table,
                        foreseen * OFFSET_COUNT + node,
                        state,
                        at,
                        words,
                        trace,
                    )
                    node = node << 1 | bit
                    place >>= 1
                step_offsets[by, bx] = node - OFFSET_COUNT
            else:
                step_offsets[by, bx] = foreseen
        if words is not None and at > words.size:
            break
    return state, at


@compiled()
def code_levels(levels, step_offsets, busy, step_table, borders, state, at, words, trace, symbols, dct_basis, coded):
    """Code `levels` of blocks that are `busy`, or decode what they make into `symbols`, and, where they are wanted, into `levels`: (state, at).
    `borders`: whether blocks go on from them."""
    BY, BX = busy.shape
    N = len(dct_basis)
    M = 0
    if levels is not None:
        M = len(levels)
    if symbols is not None:
        M = symbols.shape[2]
    table, sign_table = level_counters(), sign_counters()
    end_table = new_models(END_CONTEXTS * END_DECISIONS if borders else PLAIN_ENDS * PLAIN_END_DECISIONS)
    size, before = empty_magnitudes(BY, BX, N), empty_magnitudes(BY, BX, N)
    end, end_before = np.zeros((BY + 1, BX + 1), np.int64), np.zeros((BY + 1, BX + 1), np.int64)
    mean = np.zeros((BY + 1, BX + 1), np.int64)
    block, columns, rest = np.zeros((N, N), np.int64), np.zeros((N, N), np.int64), np.zeros((2, N), np.int64)
    right, bottom = np.zeros(N, np.int64), np.zeros((BX, N), np.int64)
    for m in range(M):
        for by in range(BY):
            for bx in range(BX):
                Y, X, quantiser = by + 1, bx + 1, step_table[step_offsets[by, bx]]
                here, left, above, past = size[Y, X], size[Y, X - 1], size[Y - 1, X], before[Y, X]
                mean[Y, X] = predict_mean(mean, by, bx)
                here[:], end[Y, X] = 0, 0
                if not busy[by, bx]:
                    continue
                beside, over = borders and bx > 0 and busy[by, bx - 1], borders and by > 0 and busy[by - 1, bx]
                expected = mean[Y, X]
                if beside or over:
                    expected = (UNITS_PER_SYMBOL >> 1) * border_sum(right, bottom[bx], beside, over) + expected >> 1
                foreseen = (expected + (quantiser[0, 0] >> 1)) // quantiser[0, 0]
                block[:] = 0
                if levels is not None and words is None:
                    block[:] = levels[m, by, bx]
                    block[0, 0] -= foreseen
                ends = end[Y, X - 1], end[Y - 1, X], end_before[Y, X]
                if borders:
                    first = end_context(*ends) * END_DECISIONS
                    last, state, at = code_unsigned(
                        last_diagonal(block) + 1, end_table, first, END_UNARY, END_ESCAPES, state, at, words, trace
                    )
                    end[Y, X] = min(last - 1, 2 * N - 1)
                else:
                    usual = usual_end(*ends)
                    first = plain_end_context(usual, N) * PLAIN_END_DECISIONS
                    last, state, at = code_signed(
                        last_diagonal(block) - usual,
                        end_table,
                        first,
                        PLAIN_END_UNARY,
                        END_ESCAPES,
                        state,
                        at,
                        words,
                        trace,
                    )
                    end[Y, X] = min(max(last + usual, 0), 2 * N - 1)
                for diagonal in range(end[Y, X] - 1, -1, -1):
                    signed = not borders or diagonal == 0
                    for i in range(max(0, diagonal - N + 1), min(diagonal, N - 1) + 1):
                        j = diagonal - i
                        first = level_context(here, left, above, past, i, j, N) * MODELS_PER_CONTEXT
                        here[i, j], state, at = code_magnitude(abs(block[i, j]), table, first, state, at, words, trace)
                        positive = 1
                        if signed and here[i, j]:
                            positive, state, at = code_bit(
                                1 if block[i, j] > 0 else 0, SCALE >> 1, state, at, words, trace
                            )
                        if words is not None:
                            block[i, j] = here[i, j] if positive else -here[i, j]
                block[0, 0] += foreseen
                mean[Y, X] = coefficient(block[0, 0], quantiser[0, 0])
                if borders:
                    init_border_residual(rest, right, bottom[bx], beside, over)
                    state, at = code_signs(
                        block, end[Y, X], quantiser, dct_basis, rest, beside, over, sign_table, state, at, words, trace
                    )
                if levels is not None and words is not None:
                    levels[m, by, bx] = block
                if borders or symbols is not None:
                    inverse_transform(block, quantiser, dct_basis, columns)
                    right[:], bottom[bx] = block[:, N - 1], block[N - 1]
                if symbols is not None:
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
def code_signs(block, end, step_table, dct_basis, rest, beside, over, table, state, at, words, trace):
    """Code the signs of all levels but the mean, the slowest first, or decode them, which makes `block` negative where they are: (state, at)."""
    N = len(block)
    subtract_from_border(rest, dct_basis, 0, 0, coefficient(block[0, 0], step_table[0, 0]))
    for diagonal in range(1, end):
        for i in range(max(0, diagonal - N + 1), min(diagonal, N - 1) + 1):
            j = diagonal - i
            if block[i, j]:
                size = coefficient(abs(block[i, j]), step_table[i, j])
                pull = sign_bias(rest, dct_basis, i, j, beside, over)
                positive = 1 if block[i, j] > 0 else 0
                if pull == 0:
                    positive, state, at = code_bit(positive, SCALE >> 1, state, at, words, trace)
                else:
                    likelier = 1 if pull > 0 else 0
                    context = sign_context(abs(pull), size, step_table[0, 0], N)
                    agrees, state, at = code_bit_adaptive(
                        1 if positive == likelier else 0, table, context, state, at, words, trace
                    )
                    positive = likelier if agrees else 1 - likelier
                if words is not None and not positive:
                    block[i, j] = -block[i, j]
                subtract_from_border(rest, dct_basis, i, j, size if positive else -size)
    return state, at


@inlined
def border_sum(right, bottom, beside, over):
    """Of what lies across both borders; where there is one alone, of that twice. So the mean of a block is, by that, half as much."""
    total = 0 * right[0]
    for k in range(len(right)):
        total += (right if beside else bottom)[k] + (bottom if over else right)[k]
    return total


@inlined
def init_border_residual(rest, right, bottom, beside, over):
    """Nothing is known of a block yet."""
    for k in range(len(right)):
        rest[0, k], rest[1, k] = (
            UNITS_PER_SYMBOL * right[k] if beside else 0,
            UNITS_PER_SYMBOL * bottom[k] if over else 0,
        )


@inlined
def subtract_from_border(rest, dct_basis, i, j, coefficient):
    """A block is told to hold so much of a cosine."""
    shift = 7  # 14 bits of dct_basis and log2 N, of which 7 are taken before
    while 1 << shift - 7 < len(dct_basis):
        shift += 1
    beside, over = dct_basis[j, 0] * coefficient + 64 >> 7, dct_basis[i, 0] * coefficient + 64 >> 7
    for k in range(len(dct_basis)):
        rest[0, k] -= dct_basis[i, k] * beside + (1 << shift - 1) >> shift
        rest[1, k] -= dct_basis[j, k] * over + (1 << shift - 1) >> shift


@inlined
def sign_bias(rest, dct_basis, i, j, beside, over):
    """How much of a cosine what lies across borders asks for, in 1 / (128 N PARTS) of a symbol."""
    left, above = 0, 0
    for k in range(len(dct_basis)):
        left += min(max(rest[0, k], -LARGEST_REST), LARGEST_REST) * dct_basis[i, k]
        above += min(max(rest[1, k], -LARGEST_REST), LARGEST_REST) * dct_basis[j, k]
    return (dct_basis[j, 0] * (left >> 7) if beside else 0) + (dct_basis[i, 0] * (above >> 7) if over else 0)


@inlined
def sign_context(pull, size, quantiser, side):
    """How much likelier the sign is that `pull` asks for, of a cosine of that size."""
    likelier = log_class(pull) + log_class(size) - 2 * log_class(quantiser) - log_class(side) - 14
    return min(max(likelier + SURENESS, 0), len(SIGN_PROBABILITIES) - 1)


@compiled()
def sign_counters():
    """Counters of signs that know what is likely."""
    table = new_models(len(SIGN_PROBABILITIES))
    for context in range(len(SIGN_PROBABILITIES)):
        table[context] = SIGN_PROBABILITIES[context] << 16 | KNOWN
    return table


@compiled()
def level_counters():
    """Counters of levels, DECISIONS a context, that know what is likely."""
    table = new_models(MAGNITUDE_CONTEXTS * FREQUENCY_CLASSES * MODELS_PER_CONTEXT)
    for context in range(MAGNITUDE_CONTEXTS * FREQUENCY_CLASSES):
        for which in range(1 + UNARY):
            rank, is_mean = min(which, 2), context % FREQUENCY_CLASSES == FREQUENCY_CLASSES - 1
            likely = LIKELY_MEANS[rank] if is_mean else LIKELY[rank, context // FREQUENCY_CLASSES]
            table[context * MODELS_PER_CONTEXT + which] = likely << 16 | KNOWN
    return table


@compiled()
def empty_magnitudes(down, across, side):
    """Magnitudes of levels as they were told, of no blocks yet: with one more above and to the left, and two frequencies beyond each."""
    return np.zeros((down + 1, across + 1, side + 2, side + 2), np.int32)


@inlined
def coefficient(level, quantiser):
    return min(max(level * quantiser, COEFFICIENT_MIN), COEFFICIENT_MAX)


@inlined
def predict_mean(mean, by, bx):
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
def plain_end_context(usual, side):
    """One of PLAIN_ENDS."""
    return 0 if usual == 0 else 1 + (usual - 1) * (PLAIN_ENDS - 1) // (2 * side - 1)


@inlined
def end_context(left, above, before):
    """One of ENDS, by ends to the left and above and of the channel before."""
    return min(log_class(left + above + before), END_CONTEXTS - 1)


@inlined
def level_context(here, left, above, before, i, j, side):
    """How large a level may be, by those of higher frequencies, of neighbours and of the channel before; and how quick it is."""
    quicker = 2 * (here[i, j + 1] + here[i + 1, j]) + here[i + 1, j + 1] + here[i, j + 2] + here[i + 2, j]
    beside = left[i, j] + above[i, j] + left[i, j + 1] + above[i, j + 1] + left[i + 1, j] + above[i + 1, j]
    total = 3 * quicker + 2 * beside + 3 * before[i, j]
    large = min(log_class(total), MAGNITUDE_CONTEXTS - 1)
    quick = min(5 * (i + j) // side, FREQUENCY_CLASSES - 2) if i + j else FREQUENCY_CLASSES - 1
    return large * FREQUENCY_CLASSES + quick


@inlined
def code_magnitude(size, table, first, state, at, words, trace):
    """Code or decode the magnitude of a level by DECISIONS counters from `first` on: (size, state, at)."""
    bit, state, at = code_bit_adaptive(1 if size else 0, table, first, state, at, words, trace)
    if not bit:
        return 0, state, at
    return code_unsigned(size, table, first + 1, UNARY, ESCAPES, state, at, words, trace)


@compiled()
def inverse_transform(block, step_table, dct_basis, columns):
    """Turn levels into symbols, as far as 8 bits reach: dct_basis added up down the columns first, then along the rows."""
    N, quickest = len(block), 0
    shift = 10  # 14 bits of dct_basis, 3 of PARTS and log2 N, of which 7 are taken before
    while 1 << shift - 10 < N:
        shift += 1
    columns[:] = 0
    for i in range(N):
        for j in range(N):
            if block[i, j]:
                quickest = max(quickest, j)
                c = coefficient(block[i, j], step_table[i, j])
                for y in range(N):
                    columns[y, j] += dct_basis[i, y] * c
    for y in range(N):
        for j in range(quickest + 1):
            columns[y, j] = columns[y, j] + 64 >> 7
        for x in range(N):
            total = 1 << shift - 1
            for j in range(quickest + 1):
                total += dct_basis[j, x] * columns[y, j]
            block[y, x] = min(max(total >> shift, -128), 127)
