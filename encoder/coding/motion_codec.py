"""MOTION, the codec of motion grids: hierarchical, from the corners to what lies between (spec/kpc-format.md,
"MOTION").

At first the ends of each axis are known. Then every gap between known nodes is halved, axis after axis, until none is
left: a new node is predicted from the two nodes beside it and the two beyond those, by the cubic polynomial through
all four. So rounding errors are averaged, where a prediction from one side alone would add them up; and nodes that do
not matter can be what is predicted.

Symbols are 16-bit; r is the magnitude of a residual.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from kpc.encoder.coding.rans import code_signed, encode_trace, log_class, new_models
from kpc.jit import compiled, inlined

WEIGHT_BITS = 6  # weights are multiples of 2^-WEIGHT_BITS
UNARY, ESCAPES = 4, 15  # of `code_signed`: residuals reach +-65535
MODELS_PER_CONTEXT = 2 + 2 * (UNARY + ESCAPES)
CONTEXTS = 20  # classes of the residuals around
MAX_DECISIONS = 2 + UNARY + 2 * ESCAPES  # bits that a symbol takes in a trace, at most


@dataclass(frozen=True)
class CodingPass:
    """Nodes that are coded one after the other: new positions along one axis, at all known positions along the others.

    Attributes:
        axis: 0 to 3 for t, z, y, x.
        new: (n,) int64, the new positions.
        references: (n, 4) int64, the positions that each is predicted from: two before it and two after it, the
            nearer in the middle.
        weights: (n, 4) int64, of these, in 2^-WEIGHT_BITS; 0 where there is none.
        others: known positions along the three other axes, in their order.
        level: halvings to come, this one included; of the first nodes, one more than of any other.
    """

    axis: int
    new: np.ndarray
    references: np.ndarray
    weights: np.ndarray
    others: tuple[np.ndarray, ...]
    level: int


def coding_passes(sizes: tuple[int, ...]) -> Iterator[CodingPass]:
    """Yield passes that code every node of a grid of four sizes, each at least 2, once and after what it is predicted
    from.
    """
    known = [np.zeros(1, np.int64) for _ in sizes]
    halvings = [(size - 2).bit_length() for size in sizes]
    first = max(halvings) + 1

    def make(
        axis: int, new: list[int], references: list[list[int]], weights: list[list[int]], level: int
    ) -> CodingPass:
        others = tuple(positions for other, positions in enumerate(known) if other != axis)
        known[axis] = np.sort(np.append(known[axis], new)) if any(new) else known[axis]
        return CodingPass(axis, np.array(new), np.array(references), np.array(weights), others, level)

    yield make(0, [0], [[0] * 4], [[0] * 4], first)
    for axis, size in enumerate(sizes):
        yield make(axis, [size - 1], [[0] * 4], [[0, 1 << WEIGHT_BITS, 0, 0]], first)
    for level in range(first - 1, 0, -1):
        for axis in range(4):
            if halvings[axis] >= level:
                at = known[axis].tolist()
                gaps = [k for k in range(1, len(at)) if at[k] - at[k - 1] > 1]
                new = [at[k - 1] + at[k] >> 1 for k in gaps]
                around = [[at[i] if 0 <= i < len(at) else None for i in range(k - 2, k + 2)] for k in gaps]
                weights = [cubic_weights(middle, four) for middle, four in zip(new, around, strict=True)]
                yield make(axis, new, [[position or 0 for position in four] for four in around], weights, level)


def cubic_weights(middle: int, positions: list[int | None]) -> list[int]:
    """Return the weights, in 2^-WEIGHT_BITS, of values at four positions in the polynomial through them, at a
    position in the middle.

    Lagrange's: w_k = product of (middle - p_j) / (p_k - p_j) over the other positions p_j that there are, rounded;
    what is missing to 1 goes to the second.
    """
    weights = []
    for own in positions:
        over, under = 1 << WEIGHT_BITS, 1
        for other in positions:
            if own is not None and other is not None and other != own:
                over, under = over * (middle - other), under * (own - other)
        weights.append(0 if own is None else (2 * over + under) // (2 * under))
    weights[1] += (1 << WEIGHT_BITS) - sum(weights)
    return weights


def encode_motion(symbols: np.ndarray) -> bytes:
    """Encode (T, Nz, Ny, Nx, 3) int16 symbols, the sizes at least 2."""
    trace, position = np.empty(symbols.size * MAX_DECISIONS, np.int16), 0
    models, residuals = new_models(CONTEXTS * MODELS_PER_CONTEXT), np.zeros(symbols.shape, np.int32)
    wide = symbols.astype(np.int32)
    for one in coding_passes(symbols.shape[:4]):
        values, r = (np.moveaxis(a, one.axis, 0) for a in (wide, residuals))
        position = code_pass(values, r, one.new, one.references, one.weights, *one.others, models, position, trace)
    return encode_trace(trace[:position])


@compiled()
def code_pass(values, r, new, references, weights, first, second, third, models, position, trace):
    """Code the nodes of a `CodingPass`, whose axis is the first of (n, ., ., ., M) `values` and `r`; return the
    position in the trace.

    Its parameters are many because numba takes no dataclass such as `CodingPass`.
    """
    state = 0
    for n in range(new.size):
        for i in range(first.size):
            for j in range(second.size):
                for k in range(third.size):
                    a, b, c = first[i], second[j], third[k]
                    beside = neighbour_residuals(r, new[n], first, second, third, i, j, k)
                    for m in range(values.shape[4]):
                        predicted = interpolate(values, references[n], weights[n], a, b, c, m)
                        context = residual_context(r, new[n], references[n], weights[n], beside, a, b, c, m)
                        residual, model = values[new[n], a, b, c, m] - predicted, context * MODELS_PER_CONTEXT
                        _, state, position = code_signed(
                            residual, models, model, UNARY, ESCAPES, state, position, None, trace
                        )
                        r[new[n], a, b, c, m] = abs(residual)
    return position


@inlined
def neighbour_residuals(r, new, first, second, third, i, j, k):
    """Return the sum of r, in this pass, at the nodes one step back along each of the other axes."""
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
def interpolate(values, references, weights, a, b, c, m):
    """Return the prediction of a symbol: the weighted sum of its references."""
    total = 1 << WEIGHT_BITS - 1
    for k in range(4):
        if weights[k] != 0:
            total += weights[k] * values[references[k], a, b, c, m]
    return min(max(total >> WEIGHT_BITS, -32768), 32767)


@inlined
def residual_context(r, new, references, weights, beside, a, b, c, m):
    """Return the context of a residual: the class of r around it."""
    total = beside
    for k in range(4):
        if weights[k] != 0:
            total += (2 if k == 1 or k == 2 else 1) * r[references[k], a, b, c, m]
    for one in range(m):
        total += 3 * r[new, a, b, c, one]
    return min(log_class(total), CONTEXTS - 1)
