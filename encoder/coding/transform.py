"""TRANSFORM, a codec of plane segments: DCT blocks with prediction from the borders of their neighbours.

    side N (1 byte) | flags (1 byte) | step (1 byte) | rANS words: of the map, of step offsets, then of levels,
    channel by channel

(spec/kpc-format.md, "TRANSFORM".) Where a symbol takes few bits, predictions from coded neighbours mostly carry their
errors on. There it is better to separate low from high frequencies: each block of N x N texels of a channel is a sum
of cosines, whose quantised coefficients, the *levels*, are coded in contexts of higher frequencies, of the blocks to
the left and above, and of the channel before. A decoder turns levels into symbols like any others. All arithmetic is
on integers of 32 bits. The codec is one module because encoder and decoder share its kernels, which are compiled into
each other.

Blocks are predicted from the *borders* of their neighbours: the mean from the texels next to the block, and the sign
of each level from which sign makes the step across the border smaller (Clare, Henry and Jung, JCTVC-A114, 2010). This
saves 4 % at 33 dB and 6 % at 43 dB of agreement (shelf_hand), the contexts of ends included.

Names in this module
    side        N, of a block: 4, 8 or 16
    level       a quantised coefficient; i counts frequencies down, j across
    diagonal    i + j; the diagonals before the `end` of a block are coded, highest frequency first
    step offset of a block, in all channels: one more makes the quantisation steps sqrt(2) finer
    mean        the coefficient of i = j = 0, in 1/UNITS_PER_SYMBOL; coded as its difference from the prediction
    gap         (2, N), along the left and upper side of a block: by how much the texels across the border exceed what
                block is so far known to be there, in 1/UNITS_PER_SYMBOL
    state position words trace      of `kpc.encoder.coding.rans`

Kernels have more than ten parameters and the module more than 500 lines, since numba keeps
their state in registers only as scalars.
"""

from dataclasses import dataclass

import numpy as np

from kpc.encoder.coding.rans import (
    SCALE,
    code_bit,
    code_bit_adaptive,
    code_unsigned,
    encode_trace,
    log_class,
    new_models,
)
from kpc.encoder.coding.texel_map import code_map, map_mode
from kpc.format.container.segments import MAP_CODED, MAP_IMPLIED
from kpc.jit import compiled, inlined

SIDES = (4, 8, 16)
HEAD = 3  # bytes before the words

# Cosines: 128 sqrt(2) cos(pi k / 32), and what stands in their place for the mean.
COSINES = np.rint(128 * np.sqrt(2) * np.cos(np.pi * np.arange(17) / 32)).astype(np.int64)
MEAN_COSINE = 128
UNITS_PER_SYMBOL = 8  # quantisation steps are in eighths of a symbol
COEFFICIENT_MIN, COEFFICIENT_MAX = -(1 << 15), (1 << 15) - 1
WEIGHT_BITS = 6  # fractional bits of `frequency_weights` and OFFSET_SCALES
OFFSET_COUNT, DEFAULT_OFFSET = 8, 3
# Quantisation step by step offset, in 1/64 of that of the segment: 64 sqrt(2)^(3 - offset).
OFFSET_SCALES = np.rint((1 << WEIGHT_BITS) * 2.0 ** ((DEFAULT_OFFSET - np.arange(OFFSET_COUNT)) / 2)).astype(np.int64)

# Contexts of a level: how large the levels around it are, and its frequency, the mean last.
MAGNITUDE_CONTEXTS, FREQUENCY_CLASSES = 16, 9
UNARY, ESCAPES = 5, 12  # of `code_unsigned`, for magnitudes
MODELS_PER_CONTEXT = 1 + UNARY + ESCAPES
LARGEST = UNARY + (2 << ESCAPES) - 1  # magnitude that can be coded
MAX_DECISIONS = 2 + UNARY + 2 * ESCAPES  # bits that a level takes in a trace, at most

# Initial probabilities of level models, out of 256, by magnitude context: that there is a level, that it is more than
# 1, that it is more than 2 to UNARY; the same of means, in any context; and the number of uses that this counts for.
INITIAL_PROBABILITIES = np.array(
    [
        [27, 66, 61, 86, 79, 96, 118, 143, 168, 190, 206, 220, 230, 238, 243, 248],
        [19, 26, 24, 37, 37, 48, 67, 90, 120, 151, 179, 201, 217, 229, 235, 244],
        [110, 100, 90, 86, 82, 80, 87, 98, 117, 135, 160, 184, 204, 220, 230, 243],
    ]
)
INITIAL_MEAN_PROBABILITIES = np.array([243, 210, 220])
INITIAL_USES = 8

END_CONTEXTS, END_UNARY, END_ESCAPES = 10, 2, 4  # contexts of ends; an end plus 1 is coded by `code_unsigned`
MODELS_PER_END = END_UNARY + END_ESCAPES
MAX_END_DECISIONS = END_UNARY + 2 * END_ESCAPES

# Initial probabilities of sign models, out of 256, that the sign is the likelier one, by how much likelier it is.
SIGN_PROBABILITIES = np.array(
    [134, 135, 138, 141, 152, 159, 164, 170, 178, 184, 190, 197, 205, 212, 218, 224, 229, 234, 239, 244]
)
SIGN_CENTRE = (
    11  # the context in which the likelier sign halves the squared step across the border, at the step of means
)
GAP_LIMIT = (1 << 12) - 1


@dataclass(frozen=True, eq=False)
class TransformBlocks:
    """The content of a segment.

    Attributes:
        levels: (M, blocks down, blocks across, N, N) int64; those of blocks without a coded texel are ignored.
        step_offsets: (blocks down, blocks across) int64, 0 to OFFSET_COUNT - 1.
        quantiser: quantisation step at DEFAULT_OFFSET, 1 to 255, in 1/UNITS_PER_SYMBOL of a symbol.
    """

    levels: np.ndarray
    step_offsets: np.ndarray
    quantiser: int


def dct_basis(side: int) -> np.ndarray:
    """Return (N, N) int64: row i is the cosine of frequency i at each texel, 128 sqrt(N) times the orthonormal one."""
    k = 16 // side * np.outer(np.arange(side), 2 * np.arange(side) + 1) % 64
    k = np.minimum(k, 64 - k)
    rows = np.where(k <= 16, COSINES[np.minimum(k, 16)], -COSINES[np.minimum(32 - np.minimum(k, 32), 16)])
    rows[0] = MEAN_COSINE
    return rows


def frequency_weights(side: int) -> np.ndarray:
    """Return (N,) int64: by how much coarser each frequency is quantised along an axis, in 1/64.

    (1 + cos(pi k / N) / 2)^(-1/2): bilinear look-ups between texels see less of errors of high frequency, since those
    of neighbours count together by a quarter (`kpc.encoder.rdo.distortion`).
    """
    return np.rint((1 << WEIGHT_BITS) / np.sqrt(1 + 0.5 * np.cos(np.pi * np.arange(side) / side))).astype(np.int64)


def step_table(side: int, quantiser: int) -> np.ndarray:
    """Return (OFFSET_COUNT, N, N) int64: the quantisation step of each level, in 1/UNITS_PER_SYMBOL of a symbol."""
    along, bits = frequency_weights(side), 3 * WEIGHT_BITS
    scales = quantiser * OFFSET_SCALES[:, None, None] * np.outer(along, along)
    return np.maximum(scales + (1 << bits - 1) >> bits, 1)


def largest_side(rows: int, columns: int) -> int:
    """Return the largest side of blocks that a segment may have, so that padding does not make it much larger."""
    return max((side for side in SIDES if side <= 2 * min(rows, columns)), default=SIDES[0])


def coded_blocks(coded: np.ndarray, side: int) -> np.ndarray:
    """Return (blocks down, blocks across) bool: the blocks with any coded texel."""
    rows, columns = coded.shape
    padded = np.pad(coded, ((0, -rows % side), (0, -columns % side)))
    return np.asarray(padded.reshape(-(-rows // side), side, -1, side).any((1, 3)))


def encode_blocks(blocks: TransformBlocks, coded: np.ndarray, implied: np.ndarray | None = None) -> bytes:
    """Encode a segment.

    Args:
        coded: (H, W) bool, the coded texels.
        implied: (H, W) bool, the map that the occupancy implies; None where it is not known.
    """
    levels, coded = np.ascontiguousarray(blocks.levels), np.array(coded, order="C")
    side, busy = levels.shape[-1], coded_blocks(coded, levels.shape[-1])
    decisions = coded.size + busy.size * (3 + MAX_END_DECISIONS * len(levels)) + levels.size * MAX_DECISIONS
    trace, position, mode = np.empty(decisions, np.int16), 0, map_mode(coded, implied)
    if mode == MAP_CODED:
        _, position = code_map(coded, 0, position, None, trace)
    offsets, steps = np.array(blocks.step_offsets, np.int64), step_table(side, blocks.quantiser)
    _, position = code_offsets(offsets, busy, 0, position, None, trace)
    _, position = code_levels(levels, offsets, busy, steps, 0, position, None, trace, None, dct_basis(side), coded)
    return bytes([side, mode, blocks.quantiser]) + encode_trace(trace[:position])


def decode_levels(
    body: bytes, rows: int, columns: int, channels: int, implied: np.ndarray | None = None
) -> TransformBlocks:
    """Return what `encode_blocks` was given, from what it made; levels that are not coded are 0.

    The decoder core does not hand out levels, which only those need who encode the blocks again.

    Args:
        body: that the core has decoded with the same arguments.
    """
    side, mode, quantiser = body[0], body[1], body[2]
    coded = np.ones((rows, columns), bool) if implied is None or mode != MAP_IMPLIED else np.array(implied, order="C")
    state, words, position = int.from_bytes(body[HEAD : HEAD + 4], "little"), np.frombuffer(body, "<u2", offset=7), 0
    words = words.astype(np.uint16)
    if mode == MAP_CODED:
        state, position = code_map(coded, state, position, words, None)
    busy = coded_blocks(coded, side)
    levels, offsets = np.zeros((channels, *busy.shape, side, side), np.int64), np.zeros(busy.shape, np.int64)
    state, position = code_offsets(offsets, busy, state, position, words, None)
    symbols, steps = np.zeros((rows, columns, channels), np.int8), step_table(side, quantiser)
    code_levels(levels, offsets, busy, steps, state, position, words, None, symbols, dct_basis(side), coded)
    return TransformBlocks(levels, offsets, quantiser)


# --- kernels that encoder and decoder share


@compiled()
def code_offsets(offsets, busy, state, position, words, trace):
    """Code the step offsets of blocks that are `busy`: (state, position). Others are as predicted, the mean of left
    and above.
    """
    BY, BX = busy.shape
    models = new_models(OFFSET_COUNT * OFFSET_COUNT)
    for by in range(BY):
        for bx in range(BX):
            left = offsets[by, bx - 1] if bx > 0 else offsets[by - 1, bx] if by > 0 else DEFAULT_OFFSET
            above = offsets[by - 1, bx] if by > 0 else left
            predicted = left + above + 1 >> 1
            node, mask = 1, OFFSET_COUNT >> 1
            if busy[by, bx]:
                while mask:
                    bit, state, position = code_bit_adaptive(
                        1 if offsets[by, bx] & mask else 0,
                        models,
                        predicted * OFFSET_COUNT + node,
                        state,
                        position,
                        words,
                        trace,
                    )
                    node = node << 1 | bit
                    mask >>= 1
                offsets[by, bx] = node - OFFSET_COUNT
            else:
                offsets[by, bx] = predicted
        if words is not None and position > words.size:
            break
    return state, position


@compiled()
def code_levels(levels, offsets, busy, step_table, state, position, words, trace, symbols, dct_basis, coded):
    """Code the levels of blocks that are `busy`: (state, position). Decoding fills `symbols` and, unless it is None,
    `levels`.

    One function, since its state (magnitudes, ends, means and borders of the blocks around) would be the parameters
    of any part of it.
    """
    BY, BX = busy.shape
    N = len(dct_basis)
    M = 0
    if levels is not None:
        M = len(levels)
    if symbols is not None:
        M = symbols.shape[2]
    models, sign_models, end_models = new_level_models(), new_sign_models(), new_models(END_CONTEXTS * MODELS_PER_END)
    size, before = empty_magnitudes(BY, BX, N), empty_magnitudes(BY, BX, N)
    end, end_before = np.zeros((BY + 1, BX + 1), np.int64), np.zeros((BY + 1, BX + 1), np.int64)
    mean = np.zeros((BY + 1, BX + 1), np.int64)
    block, columns, gap = np.zeros((N, N), np.int64), np.zeros((N, N), np.int64), np.zeros((2, N), np.int64)
    right, bottom = np.zeros(N, np.int64), np.zeros((BX, N), np.int64)
    for m in range(M):
        for by in range(BY):
            for bx in range(BX):
                Y, X, steps = by + 1, bx + 1, step_table[offsets[by, bx]]
                here, left, above, past = size[Y, X], size[Y, X - 1], size[Y - 1, X], before[Y, X]
                mean[Y, X] = predict_mean(mean, by, bx)
                here[:], end[Y, X] = 0, 0
                if not busy[by, bx]:
                    continue
                has_left, has_above = bx > 0 and busy[by, bx - 1], by > 0 and busy[by - 1, bx]
                expected = mean[Y, X]
                if has_left or has_above:
                    across = border_sum(right, bottom[bx], has_left, has_above)
                    expected = (UNITS_PER_SYMBOL >> 1) * across + expected >> 1
                predicted = (expected + (steps[0, 0] >> 1)) // steps[0, 0]
                block[:] = 0
                if levels is not None and words is None:
                    copy_matrix(levels[m, by, bx], block)
                    block[0, 0] -= predicted
                first = end_context(end[Y, X - 1], end[Y - 1, X], end_before[Y, X]) * MODELS_PER_END
                last, state, position = code_unsigned(
                    last_diagonal(block) + 1, end_models, first, END_UNARY, END_ESCAPES, state, position, words, trace
                )
                end[Y, X] = min(last - 1, 2 * N - 1)
                for diagonal in range(end[Y, X] - 1, -1, -1):
                    for i in range(max(0, diagonal - N + 1), min(diagonal, N - 1) + 1):
                        j = diagonal - i
                        first = level_context(here, left, above, past, i, j, N) * MODELS_PER_CONTEXT
                        here[i, j], state, position = code_magnitude(
                            abs(block[i, j]), models, first, state, position, words, trace
                        )
                        positive = 1
                        if diagonal == 0 and here[i, j]:
                            positive, state, position = code_bit(
                                1 if block[i, j] > 0 else 0, SCALE >> 1, state, position, words, trace
                            )
                        if words is not None:
                            block[i, j] = here[i, j] if positive else -here[i, j]
                block[0, 0] += predicted
                mean[Y, X] = coefficient(block[0, 0], steps[0, 0])
                init_gap(gap, right, bottom[bx], has_left, has_above)
                state, position = code_signs(
                    block,
                    end[Y, X],
                    steps,
                    dct_basis,
                    gap,
                    has_left,
                    has_above,
                    sign_models,
                    state,
                    position,
                    words,
                    trace,
                )
                if levels is not None and words is not None:
                    copy_matrix(block, levels[m, by, bx])
                inverse_transform(block, steps, dct_basis, columns)
                for i in range(N):
                    right[i], bottom[bx, i] = block[i, N - 1], block[N - 1, i]
                if symbols is not None:
                    store_block(block, symbols, coded, by, bx, m)
            if words is not None and position > words.size:
                return state, position
        size, before = before, size
        end, end_before = end_before, end
    return state, position


@inlined
def copy_matrix(source, target):
    """Fill a matrix from another that is at least as large.

    With `target[:] = source`, numba would also compile the message about unequal shapes, which takes seconds.
    """
    for i in range(len(target)):
        for j in range(target.shape[1]):
            target[i, j] = source[i, j]


@inlined
def store_block(block, symbols, coded, by, bx, m):
    """Copy the coded texels of a block into the symbols of channel m."""
    N = len(block)
    for y in range(by * N, min(by * N + N, len(coded))):
        for x in range(bx * N, min(bx * N + N, coded.shape[1])):
            if coded[y, x]:
                symbols[y, x, m] = block[y - by * N, x - bx * N]


@compiled()
def code_signs(block, end, steps, dct_basis, gap, has_left, has_above, models, state, position, words, trace):
    """Code the signs of all levels but the mean, lowest frequency first: (state, position). Decoding negates levels
    of `block`.

    Its parameters are many because it is a part of `code_levels`, whose state it shares.
    """
    N = len(block)
    reduce_gap(gap, dct_basis, 0, 0, coefficient(block[0, 0], steps[0, 0]))
    for diagonal in range(1, end):
        for i in range(max(0, diagonal - N + 1), min(diagonal, N - 1) + 1):
            j = diagonal - i
            if block[i, j]:
                size = coefficient(abs(block[i, j]), steps[i, j])
                bias = sign_bias(gap, dct_basis, i, j, has_left, has_above)
                positive = 1 if block[i, j] > 0 else 0
                if bias == 0:
                    positive, state, position = code_bit(positive, SCALE >> 1, state, position, words, trace)
                else:
                    likelier = 1 if bias > 0 else 0
                    context = sign_context(abs(bias), size, steps[0, 0], N)
                    agrees, state, position = code_bit_adaptive(
                        1 if positive == likelier else 0, models, context, state, position, words, trace
                    )
                    positive = likelier if agrees else 1 - likelier
                if words is not None and not positive:
                    block[i, j] = -block[i, j]
                reduce_gap(gap, dct_basis, i, j, size if positive else -size)
    return state, position


@inlined
def border_sum(right, bottom, has_left, has_above):
    """Return the sum of the symbols across both borders; where there is only one border, twice the sum across that."""
    total = 0 * right[0]
    for k in range(len(right)):
        total += (right if has_left else bottom)[k] + (bottom if has_above else right)[k]
    return total


@inlined
def init_gap(gap, right, bottom, has_left, has_above):
    """Set the gap of a block of which nothing is known yet: the symbols across the border."""
    for k in range(len(right)):
        gap[0, k] = UNITS_PER_SYMBOL * right[k] if has_left else 0
        gap[1, k] = UNITS_PER_SYMBOL * bottom[k] if has_above else 0


@inlined
def reduce_gap(gap, dct_basis, i, j, coefficient):
    """Subtract from the gap what a coefficient contributes along the borders."""
    shift = 7  # 14 bits of cosines and log2 N, of which 7 are taken before
    while 1 << shift - 7 < len(dct_basis):
        shift += 1
    left, above = dct_basis[j, 0] * coefficient + 64 >> 7, dct_basis[i, 0] * coefficient + 64 >> 7
    for k in range(len(dct_basis)):
        gap[0, k] -= dct_basis[i, k] * left + (1 << shift - 1) >> shift
        gap[1, k] -= dct_basis[j, k] * above + (1 << shift - 1) >> shift


@inlined
def sign_bias(gap, dct_basis, i, j, has_left, has_above):
    """Return the correlation of the gap with a cosine, in 1/(128 N UNITS_PER_SYMBOL): its sign is the likelier one of
    the level.
    """
    left, above = 0, 0
    for k in range(len(dct_basis)):
        left += min(max(gap[0, k], -GAP_LIMIT), GAP_LIMIT) * dct_basis[i, k]
        above += min(max(gap[1, k], -GAP_LIMIT), GAP_LIMIT) * dct_basis[j, k]
    return (dct_basis[j, 0] * (left >> 7) if has_left else 0) + (dct_basis[i, 0] * (above >> 7) if has_above else 0)


@inlined
def sign_context(bias, size, mean_step, side):
    """Return the context of the sign of a coefficient of that size: how much likelier the sign of the bias is."""
    likelier = log_class(bias) + log_class(size) - 2 * log_class(mean_step) - log_class(side) - 14
    return min(max(likelier + SIGN_CENTRE, 0), len(SIGN_PROBABILITIES) - 1)


@compiled()
def new_sign_models():
    """Return models of signs with their initial probabilities."""
    models = new_models(len(SIGN_PROBABILITIES))
    for context in range(len(SIGN_PROBABILITIES)):
        models[context] = SIGN_PROBABILITIES[context] << 16 | INITIAL_USES
    return models


@compiled()
def new_level_models():
    """Return models of levels, MODELS_PER_CONTEXT a context, with their initial probabilities."""
    models = new_models(MAGNITUDE_CONTEXTS * FREQUENCY_CLASSES * MODELS_PER_CONTEXT)
    for context in range(MAGNITUDE_CONTEXTS * FREQUENCY_CLASSES):
        for which in range(1 + UNARY):
            rank, is_mean = min(which, 2), context % FREQUENCY_CLASSES == FREQUENCY_CLASSES - 1
            magnitude = context // FREQUENCY_CLASSES
            probability = INITIAL_MEAN_PROBABILITIES[rank] if is_mean else INITIAL_PROBABILITIES[rank, magnitude]
            models[context * MODELS_PER_CONTEXT + which] = probability << 16 | INITIAL_USES
    return models


@compiled()
def empty_magnitudes(down, across, side):
    """Return int32 zeros for the magnitudes of levels of blocks: one block more above and to the left, two
    frequencies beyond.
    """
    return np.zeros((down + 1, across + 1, side + 2, side + 2), np.int32)


@inlined
def coefficient(level, step):
    """Return the dequantised coefficient of a level, in 1/UNITS_PER_SYMBOL, clamped to 16 bits."""
    return min(max(level * step, COEFFICIENT_MIN), COEFFICIENT_MAX)


@inlined
def predict_mean(mean, by, bx):
    """Return the median prediction of a block's mean from left, above and above left; `mean` has one more row and
    column before.
    """
    left, above = mean[by + 1, bx], mean[by, bx + 1]
    if by == 0:
        return left
    if bx == 0:
        return above
    return min(max(left, above), max(min(left, above), left + above - mean[by, bx]))


@compiled()
def last_diagonal(block):
    """Return one more than the highest diagonal that has a level other than 0."""
    last = 0
    for i in range(len(block)):
        for j in range(len(block)):
            if block[i, j]:
                last = max(last, i + j + 1)
    return last


@inlined
def end_context(left, above, before):
    """Return the context of an end, from those to the left, above and of the channel before."""
    return min(log_class(left + above + before), END_CONTEXTS - 1)


@inlined
def level_context(here, left, above, before, i, j, side):
    """Return the context of a level: magnitudes of higher frequencies, of neighbours and of the channel before; its
    frequency.
    """
    higher = 2 * (here[i, j + 1] + here[i + 1, j]) + here[i + 1, j + 1] + here[i, j + 2] + here[i + 2, j]
    beside = left[i, j] + above[i, j] + left[i, j + 1] + above[i, j + 1] + left[i + 1, j] + above[i + 1, j]
    magnitude = min(log_class(3 * higher + 2 * beside + 3 * before[i, j]), MAGNITUDE_CONTEXTS - 1)
    frequency = min(5 * (i + j) // side, FREQUENCY_CLASSES - 2) if i + j else FREQUENCY_CLASSES - 1
    return magnitude * FREQUENCY_CLASSES + frequency


@inlined
def code_magnitude(size, models, first, state, position, words, trace):
    """Code the magnitude of a level with MODELS_PER_CONTEXT models from `first` on: (size, state, position)."""
    bit, state, position = code_bit_adaptive(1 if size else 0, models, first, state, position, words, trace)
    if not bit:
        return 0, state, position
    return code_unsigned(size, models, first + 1, UNARY, ESCAPES, state, position, words, trace)


@compiled()
def inverse_transform(block, steps, dct_basis, columns):
    """Turn levels into symbols, clamped to 8 bits, in place: the inverse DCT down the columns first, then along the
    rows.
    """
    N, highest = len(block), 0
    shift = 10  # 14 bits of cosines, 3 of UNITS_PER_SYMBOL and log2 N, of which 7 are taken before
    while 1 << shift - 10 < N:
        shift += 1
    columns[:] = 0
    for i in range(N):
        for j in range(N):
            if block[i, j]:
                highest = max(highest, j)
                c = coefficient(block[i, j], steps[i, j])
                for y in range(N):
                    columns[y, j] += dct_basis[i, y] * c
    for y in range(N):
        for j in range(highest + 1):
            columns[y, j] = columns[y, j] + 64 >> 7
        for x in range(N):
            total = 1 << shift - 1
            for j in range(highest + 1):
                total += dct_basis[j, x] * columns[y, j]
            block[y, x] = min(max(total >> shift, -128), 127)
