"""Motion grids under codec 3: corners first, then what lies between, coarse to fine (spec, section 5).

At first the ends of each axis are there. Whatever lies between two nodes that are there is halved, axis after axis, until none is missing: a new
node is foreseen from the two at its sides and the two beyond them, by the cubic through all four. So what rounding did to them is averaged, where
prediction from one side alone adds it up (`kpc.format.coding.motion_raster`); and what nobody needs can be what is foreseen.

Naming as in `kpc.format.coding.motion_raster`: r is by how much predictions missed; table, state, at, words, trace are of `kpc.format.coding.rans`.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from kpc.format.coding.motion_raster import CONTEXTS, DECISIONS, ESCAPES, MOST_DECISIONS, UNARY
from kpc.format.coding.rans import check_end, code_signed, encode_trace, log_class, new_models, open_stream
from kpc.format.common.errors import FormatError
from kpc.format.common.jit import compiled, inlined

WEIGHT_BITS = 6
"""Weights are multiples of 2^-WEIGHT_BITS."""


@dataclass(frozen=True)
class CodingPass:
    """Nodes that are told one after the other: `new` along an axis, and all that are there along the others.

    Attributes:
        axis: 0 to 3 for t, z, y, x.
        new: (n,) int64, places along it.
        sides: (n, 4) int64, the places of those by which they are foreseen: two before, two behind, the nearer ones in the middle.
        weights: (n, 4) int64, of these, 0 of one that is not there.
        there: places along the three other axes, in their order.
        level: halvings to come, this one included; of the first nodes, one more than of any.
    """

    axis: int
    new: np.ndarray
    sides: np.ndarray
    weights: np.ndarray
    there: tuple[np.ndarray, np.ndarray, np.ndarray]
    level: int


def coding_passes(sizes: tuple[int, ...]) -> Iterator[CodingPass]:
    """All nodes of a grid of four sizes, each at least 2, once; whatever a node is foreseen by comes before it."""
    there = [np.zeros(1, np.int64) for _ in sizes]
    halvings = [(size - 2).bit_length() for size in sizes]
    first = max(halvings) + 1

    def told(axis: int, new: list[int], sides: list[list[int]], weights: list[list[int]], level: int) -> CodingPass:
        others = tuple(places for other, places in enumerate(there) if other != axis)
        there[axis] = np.sort(np.append(there[axis], new)) if any(new) else there[axis]
        return CodingPass(axis, np.array(new), np.array(sides), np.array(weights), others, level)

    yield told(0, [0], [[0] * 4], [[0] * 4], first)
    for axis, size in enumerate(sizes):
        yield told(axis, [size - 1], [[0] * 4], [[0, 1 << WEIGHT_BITS, 0, 0]], first)
    for level in range(first - 1, 0, -1):
        for axis in range(4):
            if halvings[axis] >= level:
                places = there[axis].tolist()
                gaps = [k for k in range(1, len(places)) if places[k] - places[k - 1] > 1]
                new = [places[k - 1] + places[k] >> 1 for k in gaps]
                around = [[places[i] if 0 <= i < len(places) else None for i in range(k - 2, k + 2)] for k in gaps]
                yield told(
                    axis,
                    new,
                    [[0 if place is None else place for place in four] for four in around],
                    [cubic_weights(middle, four) for middle, four in zip(new, around, strict=True)],
                    level,
                )


def cubic_weights(middle: int, places: list[int | None]) -> list[int]:
    """What values at four places, or as many of them as are there, count in the polynomial through them, at a place in the middle."""
    weights = []
    for own in places:
        over, under = 1 << WEIGHT_BITS, 1
        for other in places:
            if own is not None and other is not None and other != own:
                over, under = over * (middle - other), under * (own - other)
        weights.append(
            0 if own is None else (2 * over + under) // (2 * under)
        )  # rounded; signs of both may be negative
    weights[1] += (1 << WEIGHT_BITS) - sum(weights)
    return weights


def encode_motion(symbols: np.ndarray) -> bytes:
    """Code (T, Nz, Ny, Nx, 3) int16, the sizes at least 2."""
    trace = np.empty(symbols.size * MOST_DECISIONS, np.int16)
    _, at, _ = _walk(symbols.astype(np.int32), 0, None, trace)
    return encode_trace(trace[:at])


def decode_motion(body: bytes, shape: tuple[int, ...]) -> np.ndarray:
    """Undo `encode_motion`: int16 of that shape.

    Raises:
        FormatError: the body is cut, too long, or says what only a damaged one would.
    """
    state, words = open_stream(body, "motion")
    symbols = np.zeros(shape, np.int32)
    state, at, fit = _walk(symbols, state, words, None)
    if not fit:
        raise FormatError("motion: a symbol leaves its 16 bits")
    check_end(state, at, words, "motion")
    return symbols.astype(np.int16)


def _walk(symbols: np.ndarray, state: int, words: np.ndarray | None, trace: np.ndarray | None) -> tuple[int, int, bool]:
    """Code int32 `symbols`, or decode into them: (state, at, whether all fit 16 bits)."""
    table, missed, at, fit = new_models(CONTEXTS * DECISIONS), np.zeros(symbols.shape, np.int32), 0, True
    for one in coding_passes(symbols.shape[:4]):
        values, r = (np.moveaxis(a, one.axis, 0) for a in (symbols, missed))
        state, at, fit = walk(values, r, one.new, one.sides, one.weights, *one.there, table, state, at, words, trace)
        if not fit or words is not None and at > words.size:
            break
    return state, at, fit


@compiled()
def walk(values, r, new, sides, weights, first, second, third, table, state, at, words, trace):
    """Code or decode the nodes of a `CodingPass`, along whose axis (n, ., ., ., M) `values` and `r` go first."""
    for n in range(new.size):
        for i in range(first.size):
            for j in range(second.size):
                for k in range(third.size):
                    a, b, c = first[i], second[j], third[k]
                    beside = neighbour_residuals(r, new[n], first, second, third, i, j, k)
                    for m in range(values.shape[4]):
                        predicted = interpolate(values, sides[n], weights[n], a, b, c, m)
                        context = residual_context(r, new[n], sides[n], weights[n], beside, a, b, c, m)
                        error = values[new[n], a, b, c, m] - predicted
                        error, state, at = code_signed(
                            error, table, context * DECISIONS, UNARY, ESCAPES, state, at, words, trace
                        )
                        value = predicted + error
                        if not -32768 <= value <= 32767:
                            return state, at, False
                        values[new[n], a, b, c, m] = value
                        r[new[n], a, b, c, m] = abs(error)
                if words is not None and at > words.size:
                    return state, at, True
    return state, at, True


@inlined
def neighbour_residuals(r, new, first, second, third, i, j, k):
    """The sum of r of the same pass at the nodes one back along the other axes."""
    total = 0
    for m in range(r.shape[4]):
        if i > 0:
            total += r[new, first[i - 1], second[j], third[k], m]
        if j > 0:
            total += r[new, first[i], second[j - 1], third[k], m]
        if k > 0:
            total += r[new, first[i], second[j], third[k - 1], m]
    return total


@inlined
def interpolate(values, sides, weights, a, b, c, m):
    """The weighted sum of those at the sides, as a symbol."""
    total = 1 << WEIGHT_BITS - 1
    for k in range(4):
        if weights[k] != 0:
            total += weights[k] * values[sides[k], a, b, c, m]
    return min(max(total >> WEIGHT_BITS, -32768), 32767)


@inlined
def residual_context(r, new, sides, weights, beside, a, b, c, m):
    """Of the r around, the logarithm."""
    total = beside
    for k in range(4):
        if weights[k] != 0:
            total += (2 if k == 1 or k == 2 else 1) * r[sides[k], a, b, c, m]
    for one in range(m):
        total += 3 * r[new, a, b, c, one]
    return min(log_class(total), CONTEXTS - 1)
