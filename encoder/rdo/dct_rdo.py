"""Rate-distortion optimised quantisation of planes in transform blocks (`kpc.encoder.coding.transform`).

For each block in turn those levels are sought, one after the other, that minimise J = D + lambda R:

    sum over coded texels of weight * (symbol - wanted)^2 * error weight of the frequency, in squared quantisers
        + TRANSFORM_LAM * bits(level | levels before it)

with the distortion weights of `kpc.encoder.rdo.distortion`; what is wanted is moved so as to compensate the errors of
other channels. The basis functions are orthogonal only where all texels weigh the same and all are needed. So the
search keeps the error that all levels of a block make together, and chooses each level where the others are
(coordinate descent). How visible an error is depends on its frequency
(`kpc.encoder.coding.transform.frequency_weights`). Then the highest frequencies are removed as long as that pays. Bits
are those of the entropy coder's contexts, estimated from the result of the search before; the first search starts
from the transform of the plane itself, with texels that are not needed filled in from around.

When transform blocks pay: docs/design/rate-distortion.md, "Transform blocks".

It is one module because the search and its kernels share one state.
"""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from kpc.encoder.coding.transform import (
    DEFAULT_OFFSET,
    END_CONTEXTS,
    FREQUENCY_CLASSES,
    LARGEST,
    MAGNITUDE_CONTEXTS,
    OFFSET_COUNT,
    UNITS_PER_SYMBOL,
    TransformBlocks,
    border_sum,
    coded_blocks,
    copy_matrix,
    dct_basis,
    empty_magnitudes,
    encode_blocks,
    end_context,
    frequency_weights,
    largest_side,
    last_diagonal,
    level_context,
    predict_mean,
    step_table,
)
from kpc.encoder.rdo.curvature import BLOCK_SIDE
from kpc.encoder.rdo.distortion import LAM, cross_channel_errors, distortion_weights, magnitude_bits
from kpc.encoder.rdo.texel_map_rdo import choose_coded_texels
from kpc.format.coding.quantise import QuantisedPlane, bfloat16_ceil, quantise_plane
from kpc.format.container.container import Codec
from kpc.format.container.segments import SEGMENT_NS, TransformSegments, rows_of_segments, transform_ns
from kpc.format.core.decoding import decode_segment
from kpc.jit import compiled, inlined

# Figures behind these constants: docs/design/rate-distortion.md, "Transform blocks".
TRANSFORM_LAM = 0.03  # lambda, in squared quantisers
STEPS_PER_QUANTISER = math.sqrt(LAM / TRANSFORM_LAM)  # quantiser in steps, so that a bit costs the same distortion
# Range of quantisers, in 1 / UNITS_PER_SYMBOL of a symbol: below it, rounding to symbols errs too much where blocks are
# quantised finely; above it there is hardly any gain.
MIN_QUANTISER, MAX_QUANTISER = 24, 64
USABLE_LEVELS = 250  # symbols of 256 that the range of a plane may take, since wanted values are moved
PASSES = 4  # searches
FILL_ITERATIONS = 6  # distance in texels up to which texels that are not needed are filled in, for the first search
FIRST_DEAD_ZONE = 0.1  # by which the first search rounds towards 0, in quantisers
MAGNITUDE_BINS = 20  # magnitudes of levels whose bits are distinguished


def transform_quantise(
    plane: QuantisedPlane,
    values: np.ndarray,  # (H, W, M) float32
    step: np.ndarray,  # (M,)
    significant: np.ndarray,  # (H, W, M)
    identity: bool,
    correlation: np.ndarray,
    side: int,
    implied: np.ndarray | None = None,  # (H, W) bool
    needed: np.ndarray | None = None,  # (H, W) bool
) -> tuple[QuantisedPlane, int] | None:
    """Requantise a plane in transform blocks.

    Args:
        plane: quantised to the nearest symbols; texels that are not coded stay so.
        values: of the plane.
        step: steps that were asked for, at which a bit costs the distortion LAM (`kpc.encoder.rdo.distortion`).
        significant: as for `kpc.encoder.rdo.trellis.trellis_quantise`.
        identity: whether texels that are not coded are 1 (a time plane).
        correlation: as for `kpc.encoder.rdo.trellis.trellis_quantise`.
        side: of the blocks; smaller where a segment is small.
        implied: as for `kpc.encoder.coding.transform.encode_blocks`, for the plane.
        needed: the texels to code, of a time plane; None to choose them (`kpc.encoder.rdo.texel_map_rdo`).

    Returns:
        The plane, and its size in bytes; None where 8 bits are too few.
    """
    weight, coded = distortion_weights(significant, plane.coded), plane.coded
    if needed is not None:
        coded = needed
    elif identity:
        coded = choose_coded_texels((values - plane.offset) / step, weight, coded)
    if not coded.any():
        return None
    quantiser = _choose_quantiser(values[coded].astype(np.float64), step, identity)
    if quantiser < MIN_QUANTISER:
        return None
    symbol_step = bfloat16_ceil((STEPS_PER_QUANTISER * UNITS_PER_SYMBOL / quantiser * step).astype(np.float32))
    finer = quantise_plane(values, symbol_step, identity=identity, needed=coded)
    wanted = (values.astype(np.float64) - finer.offset) / finer.step * (UNITS_PER_SYMBOL / quantiser)

    def encoded(start: int, rows: int) -> bytes:
        own = slice(start, start + rows)
        coded_here = np.ascontiguousarray(coded[own])
        blocks = search_blocks(
            wanted[own],
            weight[own],
            coded_here,
            _correlation_of_rows(correlation, start, rows),
            min(side, largest_side(*coded_here.shape)),
            quantiser,
        )
        return encode_blocks(blocks, coded_here, None if implied is None else implied[own])

    choices = rows_of_segments(len(values), identity)
    for rows in choices:
        bodies: dict[int, bytes] = {}
        for start in range(0, len(values), rows):
            bodies[start] = encoded(start, rows)
            if rows != choices[-1] and transform_ns(bodies[start], values[start : start + rows].size) > SEGMENT_NS:
                break
        else:
            break
    symbols = np.zeros(values.shape, np.int8)
    for start, body in bodies.items():
        own = slice(start, start + rows)
        implied_here = None if implied is None else implied[own]
        own_rows, columns, channels = symbols[own].shape
        symbols[own], _ = decode_segment(Codec.TRANSFORM, body, own_rows, columns, channels, implied_here)
    found = replace(finer, symbols=symbols, coded=coded, side_info=TransformSegments(bodies), starts=tuple(bodies))
    return found, sum(map(len, bodies.values()))


def _choose_quantiser(values: np.ndarray, step: np.ndarray, identity: bool) -> int:
    """Return the quantiser, in 1 / UNITS_PER_SYMBOL of a symbol, at which the range of (n, M) values fits 8 bits."""
    extent = 2 * np.abs(values - 1).max(0) if identity else np.ptp(values, axis=0)
    fitting = UNITS_PER_SYMBOL * USABLE_LEVELS * STEPS_PER_QUANTISER * step / np.maximum(extent, 1e-30)
    return int(min(MAX_QUANTISER, fitting.min()))


def requested_transform_step(plane: QuantisedPlane) -> np.ndarray:
    """Return the steps, (M,) float64, that `transform_quantise` was given to make this plane."""
    assert isinstance(plane.side_info, TransformSegments)
    quantiser = next(iter(plane.side_info.segments.values()))[2]
    return plane.step.astype(np.float64) * quantiser / (STEPS_PER_QUANTISER * UNITS_PER_SYMBOL)


def _correlation_of_rows(correlation: np.ndarray, start: int, rows: int) -> np.ndarray:
    """Return the blocks of the correlation for some rows; segments start at multiples of BLOCK_SIDE."""
    return np.ascontiguousarray(correlation[start // BLOCK_SIDE : -(-(start + rows) // BLOCK_SIDE)])


class _Problem(NamedTuple):
    """What the search for the levels of a segment is given; blocks have N x N texels.

    Attributes:
        wanted: (H, W, M) float64, values in quantisers.
        weight: (H, W, M) float32 distortion weights.
        coded: (H, W) bool.
        coded_blocks: (blocks down, blocks across) bool: those with a coded texel.
        offsets: (blocks down, blocks across) int64 quantiser offsets.
        steps: (OFFSET_COUNT, N, N), step of a level in quantisers, by quantiser offset.
        basis: (N, N) orthonormal basis functions, one per row.
        error_weights: (N, N), weight of errors by frequency.
        correlation: as for `kpc.encoder.rdo.distortion.cross_channel_errors`.
    """

    wanted: np.ndarray
    weight: np.ndarray
    coded: np.ndarray
    coded_blocks: np.ndarray
    offsets: np.ndarray
    steps: np.ndarray
    basis: np.ndarray
    error_weights: np.ndarray
    correlation: np.ndarray


class _Rates(NamedTuple):
    """Bits, or counts, of levels by context and magnitude, and of block ends by context."""

    levels: np.ndarray  # (contexts, MAGNITUDE_BINS + 1)
    ends: np.ndarray  # (END_CONTEXTS, 2 N)


class _Scratch(NamedTuple):
    """State of the current block, all (N, N): errors and weights of texels, curvature and magnitudes of levels."""

    error: np.ndarray
    weight: np.ndarray
    curvature: np.ndarray
    magnitudes: np.ndarray


class _Magnitudes(NamedTuple):
    """Magnitudes of the levels of a block, and of the blocks that its contexts depend on."""

    here: np.ndarray
    left: np.ndarray
    above: np.ndarray
    earlier: np.ndarray  # same position in the channel before


def search_blocks(
    wanted: np.ndarray,  # (H, W, M) float64
    weight: np.ndarray,  # (H, W, M) float32
    coded: np.ndarray,  # (H, W) bool
    correlation: np.ndarray,
    side: int,
    quantiser: int,
) -> TransformBlocks:
    """Search for the levels of a segment; `wanted` is in quantisers."""
    H, W, M = wanted.shape
    with_texels = coded_blocks(coded, side)
    offsets = quantiser_offsets(weight, coded, with_texels, side)
    frequency = frequency_weights(side) / 64
    # Arrays of one memory layout, so that the search is compiled once.
    problem = _Problem(
        np.ascontiguousarray(wanted),
        np.ascontiguousarray(weight),
        coded,
        with_texels,
        offsets,
        step_table(side, quantiser) / quantiser,
        dct_basis(side) / (128 * math.sqrt(side)),
        1 / np.outer(frequency, frequency) ** 2,
        correlation,
    )
    blocks = TransformBlocks(np.zeros((M, *with_texels.shape, side, side), np.int64), offsets, quantiser)
    errors = np.zeros((H + 2, W + 2, M), np.float32)
    initial = _fill_in(wanted, coded, side)
    counts = _Rates(
        np.zeros((MAGNITUDE_CONTEXTS * FREQUENCY_CLASSES, MAGNITUDE_BINS + 1)), np.zeros((END_CONTEXTS, 2 * side))
    )
    _transform_blocks(problem, initial, blocks.levels)
    for _ in range(PASSES):
        bits = _Rates(_level_bits(counts.levels), _end_bits(counts.ends))
        counts = _search(problem, blocks.levels, bits, errors)
    return blocks


def quantiser_offsets(weight: np.ndarray, coded: np.ndarray, with_texels: np.ndarray, side: int) -> np.ndarray:
    """Choose the quantiser offset of each block, (blocks down, blocks across) int64.

    The quantiser goes with the inverse fourth root of the block's mean distortion weight. With the square root, which
    would be right without rate-distortion optimisation, files are about the same.
    """

    def block_sums(values: np.ndarray) -> np.ndarray:
        rows, columns = values.shape
        padded = np.pad(values, ((0, -rows % side), (0, -columns % side)))
        total: np.ndarray = padded.reshape(with_texels.shape[0], side, with_texels.shape[1], side).sum((1, 3))
        return total

    mean = block_sums(weight.mean(axis=2) * coded) / np.maximum(block_sums(coded.astype(np.float32)), 1)
    return np.clip(np.rint(DEFAULT_OFFSET + np.log2(np.maximum(mean, 1e-6)) / 2), 0, OFFSET_COUNT - 1).astype(np.int64)


def _fill_in(wanted: np.ndarray, coded: np.ndarray, side: int) -> np.ndarray:
    """Pad to whole blocks, (rows, columns, M) float64, and fill in texels that are not coded from those around."""
    rows, columns = coded.shape
    border = ((0, -rows % side), (0, -columns % side), (0, 0))
    weights = np.pad(coded[..., None].astype(np.float64), border)
    sums = np.pad(wanted * coded[..., None], border)
    mean = sums.sum((0, 1)) / max(weights.sum(), 1)
    filled, done = np.where(weights > 0, sums, mean), weights > 0
    for _ in range(FILL_ITERATIONS):
        sums, weights = _blur(sums), _blur(weights)
        new = ~done & (weights > 1e-9)
        filled = np.where(new, sums / np.maximum(weights, 1e-9), filled)
        done |= new
    return filled


def _blur(values: np.ndarray) -> np.ndarray:
    """Filter by (1 2 1) / 4 along both axes."""
    bordered = np.pad(values, ((1, 1), (1, 1), (0, 0)), mode="edge")
    down = (bordered[:-2] + 2 * bordered[1:-1] + bordered[2:]) / 4
    blurred: np.ndarray = (down[:, :-2] + 2 * down[:, 1:-1] + down[:, 2:]) / 4
    return blurred


def _level_bits(counts: np.ndarray) -> np.ndarray:
    """Return the bits of levels by context and magnitude, from their counts.

    The expected magnitude is the mean of the neighbouring levels that the context stands for.
    """
    # Sum of the weighted neighbours, whose weights add to 36 (`level_context`).
    total = 0.75 * 2.0 ** (np.arange(MAGNITUDE_CONTEXTS) / 2 + 1) * (np.arange(MAGNITUDE_CONTEXTS) > 0)
    mean = np.repeat(total / 36 + 0.02, FREQUENCY_CLASSES)
    mean[FREQUENCY_CLASSES - 1 :: FREQUENCY_CLASSES] *= 3
    return magnitude_bits(counts, mean)


def _end_bits(counts: np.ndarray) -> np.ndarray:
    """Return the bits of block ends by context, (END_CONTEXTS, 2 N), from their counts."""
    shares = counts + 0.3
    bits: np.ndarray = -np.log2(shares / shares.sum(1, keepdims=True))
    return bits


@compiled()
def _transform_blocks(problem, initial, levels):
    """Set the levels of all coded blocks to the transform of `initial`, wanted values of whole blocks."""
    BY, BX = problem.coded_blocks.shape
    N, M = len(problem.basis), problem.wanted.shape[2]
    for m in range(M):
        for by in range(BY):
            for bx in range(BX):
                if problem.coded_blocks[by, bx]:
                    area = initial[by * N : by * N + N, bx * N : bx * N + N, m]
                    _transform(area, problem.steps[problem.offsets[by, bx]], problem.basis, levels[m, by, bx])


@compiled()
def _search(problem, levels, bits, errors):
    """Search for all levels anew, and count levels and ends by context.

    Args:
        problem: of a segment.
        levels: (M, blocks down, blocks across, N, N) int64, from the search before; updated.
        bits: of the search before.
        errors: (H + 2, W + 2, M) float32 weighted errors; updated.
    """
    BY, BX = problem.coded_blocks.shape
    N, M = len(problem.basis), problem.wanted.shape[2]
    counts = _Rates(np.zeros(bits.levels.shape), np.zeros(bits.ends.shape))
    sizes, earlier = empty_magnitudes(BY, BX, N), empty_magnitudes(BY, BX, N)
    ends, earlier_ends = np.zeros((BY + 1, BX + 1), np.int64), np.zeros((BY + 1, BX + 1), np.int64)
    means = np.zeros((BY + 1, BX + 1))
    scratch = _Scratch(np.zeros((N, N)), np.zeros((N, N)), np.zeros((N, N)), np.zeros((N, N), np.int64))
    right, bottom = np.zeros(N), np.zeros((BX, N))
    for m in range(M):
        from_channels = cross_channel_errors(errors, problem.correlation, m)
        for by in range(BY):
            for bx in range(BX):
                Y, X, step, block = by + 1, bx + 1, problem.steps[problem.offsets[by, bx]], levels[m, by, bx]
                magnitudes = _Magnitudes(sizes[Y, X], sizes[Y, X - 1], sizes[Y - 1, X], earlier[Y, X])
                means[Y, X] = predict_mean(means, by, bx)
                magnitudes.here[:], ends[Y, X] = 0, 0
                if not problem.coded_blocks[by, bx]:
                    continue
                expected = means[Y, X]
                has_left = bx > 0 and problem.coded_blocks[by, bx - 1]
                has_above = by > 0 and problem.coded_blocks[by - 1, bx]
                if has_left or has_above:
                    expected = border_sum(right, bottom[bx], has_left, has_above) / 4 + expected / 2
                predicted = math.floor(expected / step[0, 0] + 0.5)
                _load_errors(problem, scratch, from_channels, block, step, by, bx, m)
                _descend(problem, scratch, magnitudes, bits.levels, block, step, predicted)
                copy_matrix(magnitudes.here, scratch.magnitudes)
                context = end_context(ends[Y, X - 1], ends[Y - 1, X], earlier_ends[Y, X])
                end = _trim(problem, scratch, magnitudes, bits.levels, bits.ends[context], block, step)
                ends[Y, X], means[Y, X] = end, block[0, 0] * step[0, 0]
                _border_of(block, step, problem.basis, right, bottom[bx])
                counts.ends[context, end] += 1
                _count_levels(magnitudes, counts.levels, end, N)
                _store_errors(scratch, from_channels, errors, by, bx, m)
        sizes, earlier = earlier, sizes
        ends, earlier_ends = earlier_ends, ends
    return counts


@compiled()
def _transform(values, step, basis, block):
    """Set a block to the levels nearest to the transform of (N, N) values, rounded towards 0 by FIRST_DEAD_ZONE."""
    N = len(basis)
    for i in range(N):
        for j in range(N):
            total = 0.0
            for y in range(N):
                along = 0.0
                for x in range(N):
                    along += values[y, x] * basis[j, x]
                total += along * basis[i, y]
            level = total / step[i, j]
            size = int(abs(level) + 0.5 - (FIRST_DEAD_ZONE if i + j else 0.0))
            block[i, j] = size if level > 0 else -size


@compiled()
def _load_errors(problem, scratch, from_channels, block, step, by, bx, m):
    """Set the scratch's errors, weights and curvature for a block with the given levels."""
    H, W, _ = problem.wanted.shape
    error, weight, basis, N = scratch.error, scratch.weight, problem.basis, len(problem.basis)
    error[:] = 0
    for i in range(N):
        for j in range(N):
            if block[i, j]:
                _add(error, basis, i, j, block[i, j] * step[i, j])
    for y in range(N):
        for x in range(N):
            v, u, weight[y, x] = by * N + y, bx * N + x, 0.0
            if v < H and u < W and problem.coded[v, u]:
                weight[y, x] = problem.weight[v, u, m]
                away = from_channels[v, u] / math.sqrt(weight[y, x])
                error[y, x] -= problem.wanted[v, u, m] - min(max(away, -1.0), 1.0)
    _sum_squares(weight, basis, scratch.curvature)


@compiled()
def _store_errors(scratch, from_channels, errors, by, bx, m):
    """Store the weighted errors of a block's coded texels."""
    N = len(scratch.error)
    for y in range(N):
        for x in range(N):
            if scratch.weight[y, x] > 0:
                v, u, root = by * N + y, bx * N + x, math.sqrt(scratch.weight[y, x])
                moved = min(max(from_channels[v, u] / root, -1.0), 1.0)
                errors[v + 1, u + 1, m] = root * (scratch.error[y, x] - moved)


@compiled()
def _descend(problem, scratch, magnitudes, bits, block, step, predicted):
    """Choose each level of a block in turn, from high to low frequencies, the others fixed.

    Magnitudes are those of residuals: the mean level is coded relative to `predicted`, all others relative to 0.
    """
    error, weight, curvature, basis = scratch.error, scratch.weight, scratch.curvature, problem.basis
    here, left, above, earlier = magnitudes.here, magnitudes.left, magnitudes.above, magnitudes.earlier
    N = len(basis)
    for diagonal in range(2 * N - 2, -1, -1):
        usual = predicted if diagonal == 0 else 0
        for i in range(max(0, diagonal - N + 1), min(diagonal, N - 1) + 1):
            j = diagonal - i
            level_bits = bits[level_context(here, left, above, earlier, i, j, N)]
            steep = max(curvature[i, j], 1e-9) * step[i, j]
            best = block[i, j] - _slope(error, weight, basis, i, j) / steep
            found = _cheapest(best, usual, problem.error_weights[i, j] * steep * step[i, j], level_bits)
            if found != block[i, j]:
                _add(error, basis, i, j, (found - block[i, j]) * step[i, j])
                block[i, j] = found
            here[i, j] = abs(found - usual)


@compiled()
def _count_levels(magnitudes, counts, end, N):
    """Count the levels of a block before its end, by context and magnitude."""
    here = magnitudes.here
    for diagonal in range(end):
        for i in range(max(0, diagonal - N + 1), min(diagonal, N - 1) + 1):
            j = diagonal - i
            context = level_context(here, magnitudes.left, magnitudes.above, magnitudes.earlier, i, j, N)
            counts[context, min(here[i, j], MAGNITUDE_BINS)] += 1


@compiled()
def _border_of(block, step, basis, right, bottom):
    """Reconstruct the last column and the last row of a block."""
    N = len(basis)
    right[:], bottom[:] = 0, 0
    for i in range(N):
        for j in range(N):
            if block[i, j]:
                coefficient = block[i, j] * step[i, j]
                for k in range(N):
                    right[k] += coefficient * basis[j, N - 1] * basis[i, k]
                    bottom[k] += coefficient * basis[i, N - 1] * basis[j, k]


@inlined
def _add(values, basis, i, j, coefficient):
    """Add a basis function to (N, N) values."""
    for y in range(len(basis)):
        for x in range(len(basis)):
            values[y, x] += coefficient * basis[i, y] * basis[j, x]


@compiled()
def _sum_squares(weight, basis, curvature):
    """Set the curvature of each level: the weighted sum of squares of its basis function."""
    N = len(basis)
    for j in range(N):
        for y in range(N):
            along = 0.0
            for x in range(N):
                along += weight[y, x] * basis[j, x] * basis[j, x]
            for i in range(N):
                curvature[i, j] = (curvature[i, j] if y else 0.0) + along * basis[i, y] * basis[i, y]


@inlined
def _slope(error, weight, basis, i, j):
    """Return the weighted sum of products of a basis function with the errors."""
    total = 0.0
    for y in range(len(basis)):
        along = 0.0
        for x in range(len(basis)):
            along += weight[y, x] * error[y, x] * basis[j, x]
        total += along * basis[i, y]
    return total


@inlined
def _cheapest(best, usual, weight, bits):
    """Return the cheapest of three levels: nearest to the best, next to it towards the usual level, and the usual."""
    nearest = math.floor(min(max(best + 0.5, usual - LARGEST), usual + LARGEST))
    found, least = usual, np.inf
    for which in range(3):
        level = nearest if which == 0 else usual if which == 2 else nearest - 1 if nearest > usual else nearest + 1
        cost = weight * (level - best) ** 2 + TRANSFORM_LAM * bits[min(abs(level - usual), MAGNITUDE_BINS)]
        if cost < least:
            found, least = level, cost
    return found


@compiled()
def _trim(problem, scratch, magnitudes, bits, end_bits, block, step):
    """Remove the highest diagonals of a block, one after the other, as long as that pays; return the block's end."""
    error, weight, curvature, basis = scratch.error, scratch.weight, scratch.curvature, problem.basis
    here, left, above, earlier = magnitudes.here, magnitudes.left, magnitudes.above, magnitudes.earlier
    sizes, N = scratch.magnitudes, len(basis)
    end = last_diagonal(sizes)
    while end > 1:
        saved, lost, before = 0.0, 0.0, end - 1
        while before > 0 and not _any_on(sizes, before - 1):  # diagonals of 0 before it need not be coded, either
            before -= 1
        for diagonal in range(before, end):
            for i in range(max(0, diagonal - N + 1), min(diagonal, N - 1) + 1):
                j = diagonal - i
                context = level_context(here, left, above, earlier, i, j, N)
                saved += bits[context, min(sizes[i, j], MAGNITUDE_BINS)]
                if sizes[i, j]:
                    coefficient = block[i, j] * step[i, j]
                    change = curvature[i, j] * coefficient - 2 * _slope(error, weight, basis, i, j)
                    lost += problem.error_weights[i, j] * coefficient * change
        if lost + TRANSFORM_LAM * (end_bits[before] - end_bits[end] - saved) >= 0:
            break
        for i in range(max(0, end - N), min(end - 1, N - 1) + 1):
            j = end - 1 - i
            if sizes[i, j]:
                _add(error, basis, i, j, -block[i, j] * step[i, j])
                block[i, j] = here[i, j] = sizes[i, j] = 0
        end = before
    return end


@inlined
def _any_on(magnitudes, diagonal):
    """Return whether a diagonal has a level that is not 0."""
    N = len(magnitudes)
    for i in range(max(0, diagonal - N + 1), min(diagonal, N - 1) + 1):
        if magnitudes[i, diagonal - i]:
            return True
    return False
