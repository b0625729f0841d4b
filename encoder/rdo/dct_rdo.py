"""Which levels a plane becomes where it is told in blocks of cosines, `kpc.format.coding.transform`: as few bits as errors are worth.

Of each block in its turn, those levels are sought, one after the other, that make least of

    worth * (symbol - wanted)^2, summed over known texels, in squared quantisers, as pictures see it + PRICE * bits(level | those before it)

with `worth` as in `kpc.encoder.rdo.distortion`, and what is wanted moved by what the errors of other channels make of it. Texels that nobody needs
count for nothing, so what is there follows from the others; cosines are orthogonal only where all texels are worth the same, so a search
knows what all levels of a block make together, and each is found again where the others now are (coordinate descent). How pictures see
an error depends on how quick it is, `kpc.format.coding.transform.frequency_weights`. Then the quickest are left out as long as that pays. Bits are counted in the
contexts of the coder, from what the search before chose; the first begins with the cosines of the plane itself, what nobody needs filled
in from around.

Room and liam, whose planes are quick and of which some texels are worth far more than their neighbours, gain nothing by blocks; what others
gain says `kpc.encoder.rdo.mode_decision`.
"""

import math
from dataclasses import replace

import numpy as np
from kpc.encoder.rdo.curvature import BLOCK_SIDE
from kpc.encoder.rdo.distortion import LAM, cross_channel_errors, distortion_weights, magnitude_bits
from kpc.encoder.rdo.texel_map_rdo import choose_coded_texels
from kpc.format.coding.quantise import QuantisedPlane, bfloat16_ceil, quantise_plane
from kpc.format.coding.transform import (
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
    dct_basis,
    decode_blocks,
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
from kpc.format.common.jit import compiled, inlined
from kpc.format.container.segments import TransformSegments, rows_per_segment

TRANSFORM_LAM = 0.03
"""Squared quantisers that a bit is worth: so quantisers are sqrt(LAM / PRICE) steps of the trellis at which bits are worth as much. With more
levels that would be small become none, and pictures lose of all planes what is quick: soldier, all planes, at equal error of pictures (40 and
34 dB): files are 7 and 8 % larger with 0.12."""
STEPS_PER_QUANTISER = math.sqrt(LAM / TRANSFORM_LAM)
"""Of those that are asked for, in a quantiser."""
MIN_QUANTISER, MAX_QUANTISER = 24, 64
"""In 1 / PARTS of a symbol. With less, rounding to symbols errs too much where blocks are fine; with more, it hardly matters."""
USABLE_LEVELS = 250
"""Symbols of 256 that a plane's range may take: what is wanted moves."""
PASSES = 4
"""Searches. With two, errors and what bits are worth are 1 % more, with eight half a percent less."""
FILL_ITERATIONS = 6
"""Texels from what is needed that are filled in for the first search."""
FIRST_DEAD_ZONE = 0.1
"""What the first search needs less than half a quantiser."""
MAGNITUDE_BINS = 20
"""Magnitudes of levels whose bits are told apart."""


def transform_quantise(
    plane: QuantisedPlane,
    values: np.ndarray,
    step: np.ndarray,
    significant: np.ndarray,
    identity: bool,
    together: np.ndarray,
    side: int,
    implied: np.ndarray | None = None,
    needed: np.ndarray | None = None,
) -> tuple[QuantisedPlane, int] | None:
    """A plane told in blocks of a side, or of smaller ones where a segment is small; and the bytes that takes. None where 8 bits are too few.

    Args:
        plane: quantised to the nearest: what it leaves out stays so. values: (H, W, M) float32.
        step: (M,) for which bits are worth as much as `kpc.encoder.rdo.distortion.LAM` says.
        significant, together: as of `kpc.encoder.rdo.trellis.trellis_quantise`.
        implied: as of `kpc.format.coding.transform.encode_blocks`, for the plane.
        needed: of a time plane, (H, W) bool: the texels that are told. None: those of `kpc.encoder.rdo.texel_map_rdo`.
    """
    worth, known = distortion_weights(significant, plane.coded), plane.coded
    if needed is not None:
        known = needed
    elif identity:
        known = choose_coded_texels((values - plane.offset) / step, worth, known)
    if not known.any():
        return None
    wanted = values[known].astype(np.float64)
    reach = 2 * np.abs(wanted - 1).max(0) if identity else np.ptp(wanted, axis=0)
    quantiser = int(
        min(
            MAX_QUANTISER,
            (UNITS_PER_SYMBOL * USABLE_LEVELS * STEPS_PER_QUANTISER * step / np.maximum(reach, 1e-30)).min(),
        )
    )
    if quantiser < MIN_QUANTISER:
        return None
    symbol = bfloat16_ceil((STEPS_PER_QUANTISER * UNITS_PER_SYMBOL / quantiser * step).astype(np.float32))
    finer = quantise_plane(values, symbol, identity=identity, needed=known)
    wanted = (values.astype(np.float64) - finer.offset) / finer.step * (UNITS_PER_SYMBOL / quantiser)
    rows = rows_per_segment(len(values), identity)
    symbols, told = np.zeros(values.shape, np.int8), {}
    for start in range(0, len(values), rows):
        own = slice(start, start + rows)
        there = np.ascontiguousarray(known[own])
        blocks = search_blocks(
            wanted[own],
            worth[own],
            there,
            _own_blocks(together, start, rows),
            min(side, largest_side(*there.shape)),
            quantiser,
        )
        of_occupancy = None if implied is None else implied[own]
        told[start] = encode_blocks(blocks, there, of_occupancy)
        symbols[own], _ = decode_blocks(told[start], *symbols[own].shape, implied=of_occupancy)
    return replace(finer, symbols=symbols, coded=known, side_info=TransformSegments(told), starts=tuple(told)), sum(
        map(len, told.values())
    )


def requested_transform_step(plane: QuantisedPlane) -> np.ndarray:
    """(M,) float64: for which steps `transform_quantise` was asked when it made this plane."""
    assert isinstance(plane.side_info, TransformSegments)
    quantiser = next(iter(plane.side_info.segments.values()))[2]
    return plane.step.astype(np.float64) * quantiser / (STEPS_PER_QUANTISER * UNITS_PER_SYMBOL)


def _own_blocks(together: np.ndarray, start: int, rows: int) -> np.ndarray:
    """What goes together in some rows; segments are whole blocks of it."""
    return np.ascontiguousarray(together[start // BLOCK_SIDE : -(-(start + rows) // BLOCK_SIDE)])


def search_blocks(
    wanted: np.ndarray, worth: np.ndarray, known: np.ndarray, together: np.ndarray, side: int, quantiser: int
) -> TransformBlocks:
    """Blocks of a segment.

    Args:
        wanted: (H, W, M) float64, in quantisers. worth: (H, W, M) float32. known: (H, W) bool.
    """
    H, W, M = wanted.shape
    busy = coded_blocks(known, side)
    filled, step_offsets = _filled(wanted, known, side), _fineness(worth, known, busy, side)
    finer = step_table(side, quantiser) / quantiser
    basis = dct_basis(side) / (128 * math.sqrt(side))
    along = frequency_weights(side) / 64
    seen = 1 / np.outer(along, along) ** 2
    blocks = TransformBlocks(np.zeros((M, *busy.shape, side, side), np.int64), step_offsets, quantiser)
    errors = np.zeros((H + 2, W + 2, M), np.float32)
    counts, end_counts = (
        np.zeros((MAGNITUDE_CONTEXTS * FREQUENCY_CLASSES, MAGNITUDE_BINS + 1)),
        np.zeros((END_CONTEXTS, 2 * side)),
    )
    for number in range(PASSES):
        counts, end_counts = _search(wanted, worth, known, busy, blocks.levels, step_offsets, finer, basis, seen, filled if number == 0 else None,
                                     _bits(counts), _end_bits(end_counts), errors, together)  # fmt: skip
    return blocks


def _fineness(worth: np.ndarray, known: np.ndarray, busy: np.ndarray, side: int) -> np.ndarray:
    """(blocks down, blocks across) int64: quantisers of a block go with the fourth root of what errors in it are worth, in the
    mean. With the square root, as it would be if levels were not rounded but by rate and distortion, files are about the same."""

    def summed(values: np.ndarray) -> np.ndarray:
        rows, columns = values.shape
        padded = np.pad(values, ((0, -rows % side), (0, -columns % side)))
        total: np.ndarray = padded.reshape(busy.shape[0], side, busy.shape[1], side).sum((1, 3))
        return total

    mean = summed(worth.mean(axis=2) * known) / np.maximum(summed(known.astype(np.float32)), 1)
    return np.clip(np.rint(DEFAULT_OFFSET + np.log2(np.maximum(mean, 1e-6)) / 2), 0, OFFSET_COUNT - 1).astype(np.int64)


def _filled(wanted: np.ndarray, known: np.ndarray, side: int) -> np.ndarray:
    """(whole blocks of rows, of columns, M) float64: what is wanted, and where nothing is, what is around it."""
    rows, columns = known.shape
    border = ((0, -rows % side), (0, -columns % side), (0, 0))
    weights = np.pad(known[..., None].astype(np.float64), border)
    sums = np.pad(wanted * known[..., None], border)
    mean = sums.sum((0, 1)) / max(weights.sum(), 1)
    filled, done = np.where(weights > 0, sums, mean), weights > 0
    for _ in range(FILL_ITERATIONS):
        sums, weights = _blurred(sums), _blurred(weights)
        new = ~done & (weights > 1e-9)
        filled = np.where(new, sums / np.maximum(weights, 1e-9), filled)
        done |= new
    return filled


def _blurred(values: np.ndarray) -> np.ndarray:
    """By (1 2 1) / 4 along both axes."""
    bordered = np.pad(values, ((1, 1), (1, 1), (0, 0)), mode="edge")
    down = (bordered[:-2] + 2 * bordered[1:-1] + bordered[2:]) / 4
    blurred: np.ndarray = (down[:, :-2] + 2 * down[:, 1:-1] + down[:, 2:]) / 4
    return blurred


def _bits(counts: np.ndarray) -> np.ndarray:
    """(contexts, TOLD_APART + 1) bits of levels by their magnitude, that came so often in each context. What is expected is the mean of the levels
    that the context stands for."""
    total = (
        0.75 * 2.0 ** (np.arange(MAGNITUDE_CONTEXTS) / 2 + 1) * (np.arange(MAGNITUDE_CONTEXTS) > 0)
    )  # of 36 levels, as `level_context` sums them
    mean = np.repeat(total / 36 + 0.02, FREQUENCY_CLASSES)
    mean[FREQUENCY_CLASSES - 1 :: FREQUENCY_CLASSES] *= 3
    return magnitude_bits(counts, mean)


def _end_bits(counts: np.ndarray) -> np.ndarray:
    """(ENDS, 2 N) bits of ends that came so often in each context."""
    shares = counts + 0.3
    bits: np.ndarray = -np.log2(shares / shares.sum(1, keepdims=True))
    return bits


@compiled()
def _search(
    wanted, worth, known, busy, levels, step_offsets, finer, basis, seen, filled, price, end_price, errors, together
):
    """Find `levels` anew, of which the search before is known, or `filled`; counts of levels and ends in their contexts, as `_bits` and
    `_end_bits` take them.

    Args:
        finer: (FINENESSES, N, N) of a level, in quantisers. basis: (N, N), orthonormal. seen: (N, N), what errors cost by how quick they are.
        price, end_price: bits. errors: as of `kpc.encoder.rdo.distortion.cross_channel_errors`, known here.
    """
    H, W, M = wanted.shape
    BY, BX = busy.shape
    N = len(basis)
    counts, end_counts = np.zeros(price.shape), np.zeros(end_price.shape)
    size, before = empty_magnitudes(BY, BX, N), empty_magnitudes(BY, BX, N)
    end, end_before = np.zeros((BY + 1, BX + 1), np.int64), np.zeros((BY + 1, BX + 1), np.int64)
    mean = np.zeros((BY + 1, BX + 1))
    error, weight, curve, told = np.zeros((N, N)), np.zeros((N, N)), np.zeros((N, N)), np.zeros((N, N), np.int64)
    right, bottom = np.zeros(N), np.zeros((BX, N))
    for m in range(M):
        moved = cross_channel_errors(errors, together, m)
        for by in range(BY):
            for bx in range(BX):
                Y, X, quantiser, block = by + 1, bx + 1, finer[step_offsets[by, bx]], levels[m, by, bx]
                here, left, above, past = size[Y, X], size[Y, X - 1], size[Y - 1, X], before[Y, X]
                mean[Y, X] = predict_mean(mean, by, bx)
                here[:], end[Y, X] = 0, 0
                if not busy[by, bx]:
                    continue
                expected, beside, over = mean[Y, X], bx > 0 and busy[by, bx - 1], by > 0 and busy[by - 1, bx]
                if beside or over:
                    expected = border_sum(right, bottom[bx], beside, over) / 4 + expected / 2
                foreseen = int(math.floor(expected / quantiser[0, 0] + 0.5))
                if filled is not None:
                    _begin(filled[by * N : by * N + N, bx * N : bx * N + N, m], quantiser, basis, block)
                _misses(block, quantiser, basis, error)
                for y in range(N):
                    for x in range(N):
                        v, u, weight[y, x] = by * N + y, bx * N + x, 0.0
                        if v < H and u < W and known[v, u]:
                            weight[y, x] = worth[v, u, m]
                            away = moved[v, u] / math.sqrt(weight[y, x])
                            error[y, x] -= wanted[v, u, m] - min(max(away, -1.0), 1.0)
                _curve(weight, basis, curve)
                for diagonal in range(2 * N - 2, -1, -1):
                    usual = foreseen if diagonal == 0 else 0
                    for i in range(max(0, diagonal - N + 1), min(diagonal, N - 1) + 1):
                        j = diagonal - i
                        bits = price[level_context(here, left, above, past, i, j, N)]
                        steep = max(curve[i, j], 1e-9) * quantiser[i, j]
                        best = block[i, j] - _slope(error, weight, basis, i, j) / steep
                        found = _cheapest(best, usual, seen[i, j] * steep * quantiser[i, j], bits)
                        if found != block[i, j]:
                            _add(error, basis, i, j, (found - block[i, j]) * quantiser[i, j])
                            block[i, j] = found
                        here[i, j] = abs(found - usual)
                told[:] = here[:N, :N]
                place = end_context(end[Y, X - 1], end[Y - 1, X], end_before[Y, X])
                last = _trimmed(
                    block,
                    here,
                    told,
                    left,
                    above,
                    past,
                    last_diagonal(told),
                    quantiser,
                    basis,
                    seen,
                    curve,
                    error,
                    weight,
                    price,
                    end_price[place],
                )
                end[Y, X], mean[Y, X] = last, block[0, 0] * quantiser[0, 0]
                _edges(block, quantiser, basis, right, bottom[bx])
                end_counts[place, last] += 1
                for diagonal in range(last):
                    for i in range(max(0, diagonal - N + 1), min(diagonal, N - 1) + 1):
                        context = level_context(here, left, above, past, i, diagonal - i, N)
                        counts[context, min(here[i, diagonal - i], MAGNITUDE_BINS)] += 1
                for y in range(N):
                    for x in range(N):
                        if weight[y, x] > 0:
                            v, u, root = by * N + y, bx * N + x, math.sqrt(weight[y, x])
                            errors[v + 1, u + 1, m] = root * (error[y, x] - min(max(moved[v, u] / root, -1.0), 1.0))
        size, before = before, size
        end, end_before = end_before, end
    return counts, end_counts


@compiled()
def _begin(values, quantiser, basis, block):
    """The levels nearest to (N, N) values, but nearer to 0."""
    N = len(basis)
    for i in range(N):
        for j in range(N):
            total = 0.0
            for y in range(N):
                along = 0.0
                for x in range(N):
                    along += values[y, x] * basis[j, x]
                total += along * basis[i, y]
            level = total / quantiser[i, j]
            size = int(abs(level) + 0.5 - (FIRST_DEAD_ZONE if i + j else 0.0))
            block[i, j] = size if level > 0 else -size


@compiled()
def _misses(block, quantiser, basis, error):
    """What levels make, into `error`."""
    error[:] = 0
    for i in range(len(block)):
        for j in range(len(block)):
            if block[i, j]:
                _add(error, basis, i, j, block[i, j] * quantiser[i, j])


@compiled()
def _edges(block, quantiser, basis, right, bottom):
    """What levels make in the last column and in the last row."""
    N = len(basis)
    right[:], bottom[:] = 0, 0
    for i in range(N):
        for j in range(N):
            if block[i, j]:
                factor = block[i, j] * quantiser[i, j]
                for k in range(N):
                    right[k] += factor * basis[j, N - 1] * basis[i, k]
                    bottom[k] += factor * basis[i, N - 1] * basis[j, k]


@inlined
def _add(values, basis, i, j, factor):
    """A cosine more."""
    for y in range(len(basis)):
        for x in range(len(basis)):
            values[y, x] += factor * basis[i, y] * basis[j, x]


@compiled()
def _curve(weight, basis, curve):
    """The sum of squares of each cosine, weighed."""
    N = len(basis)
    for j in range(N):
        for y in range(N):
            along = 0.0
            for x in range(N):
                along += weight[y, x] * basis[j, x] * basis[j, x]
            for i in range(N):
                curve[i, j] = (curve[i, j] if y else 0.0) + along * basis[i, y] * basis[i, y]


@inlined
def _slope(error, weight, basis, i, j):
    """The sum of products of a cosine with errors, weighed."""
    total = 0.0
    for y in range(len(basis)):
        along = 0.0
        for x in range(len(basis)):
            along += weight[y, x] * error[y, x] * basis[j, x]
        total += along * basis[i, y]
    return total


@inlined
def _cheapest(best, usual, worth, bits):
    """Of the level nearest to the best, the next towards the usual one, and that, the one of least cost."""
    nearest = int(math.floor(min(max(best + 0.5, usual - LARGEST), usual + LARGEST)))
    found, least = usual, np.inf
    for which in range(3):
        level = nearest if which == 0 else usual if which == 2 else nearest - 1 if nearest > usual else nearest + 1
        cost = worth * (level - best) ** 2 + TRANSFORM_LAM * bits[min(abs(level - usual), MAGNITUDE_BINS)]
        if cost < least:
            found, least = level, cost
    return found


@compiled()
def _trimmed(
    block, here, told, left, above, past, last, quantiser, basis, seen, curve, error, weight, price, end_price
):
    """The end of a block after the quickest diagonals are left out, one after the other, as long as that costs less than it saves."""
    N = len(basis)
    while last > 1:
        saved, lost, before = 0.0, 0.0, last - 1
        while before > 0 and not _any_on(told, before - 1):  # those of 0 next to it need not be told either
            before -= 1
        for diagonal in range(before, last):
            for i in range(max(0, diagonal - N + 1), min(diagonal, N - 1) + 1):
                j = diagonal - i
                saved += price[level_context(here, left, above, past, i, j, N), min(told[i, j], MAGNITUDE_BINS)]
                if told[i, j]:
                    factor = block[i, j] * quantiser[i, j]
                    lost += seen[i, j] * factor * (curve[i, j] * factor - 2 * _slope(error, weight, basis, i, j))
        if lost + TRANSFORM_LAM * (end_price[before] - end_price[last] - saved) >= 0:
            break
        for i in range(max(0, last - N), min(last - 1, N - 1) + 1):
            j = last - 1 - i
            if told[i, j]:
                _add(error, basis, i, j, -block[i, j] * quantiser[i, j])
                block[i, j] = here[i, j] = told[i, j] = 0
        last = before
    return last


@inlined
def _any_on(told, diagonal):
    N = len(told)
    for i in range(max(0, diagonal - N + 1), min(diagonal, N - 1) + 1):
        if told[i, diagonal - i]:
            return True
    return False
