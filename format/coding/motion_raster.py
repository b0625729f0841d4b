"""Motion grids under codec 2: every symbol predicted from its neighbours back in time and space (spec, section 5).

    weights (30 bytes) | rANS words of the symbols

A node has 15 neighbours one step back along time, z, y or x, or several of them. A field whose changes along one axis change slowly
along the others is what the Lorenzo predictor says (doi:10.1111/1467-8659.00681): their sum, with a minus for an even number of
steps. As that adds up what rounding did to all of them, a grid has weights of its own for nodes that have all 15.

Naming as in `kpc.format.coding.predictive`: r is by how much predictions missed; table, state, at, words, trace are of `kpc.format.coding.rans`.
"""

import numpy as np
from kpc.format.coding.predictive import FIT_VALUES, least_absolute
from kpc.format.coding.rans import check_end, code_signed, encode_trace, log_class, new_models, open_stream
from kpc.format.common.errors import FormatError
from kpc.format.common.jit import compiled, inlined

NEIGHBOURS = 15
"""Number k is one step back along time if its bit 3 is set, along z if bit 2, y bit 1, x bit 0; weight k - 1 is its own."""
WEIGHT_BITS = 10
"""Weights are multiples of 2^-WEIGHT_BITS: they are of whole symbols, not of differences, and what rounds them counts."""
LORENZO = np.array([-1 << WEIGHT_BITS if k.bit_count() % 2 == 0 else 1 << WEIGHT_BITS for k in range(1, 16)], np.int16)

UNARY, ESCAPES = 4, 15
"""Of `kpc.format.coding.rans.code_signed`: errors reach +-65535."""
DECISIONS = 2 + 2 * (UNARY + ESCAPES)
"""Counters of a context, of which there are CONTEXTS: how large r is around."""
CONTEXTS = 20
MOST_DECISIONS = 2 + UNARY + 2 * ESCAPES
"""That a symbol takes."""
UNKNOWN = 64
"""r at the first node."""


def encode_nodes(symbols: np.ndarray) -> bytes:
    """Code (T, Nz, Ny, Nx, 3) int16, with the weights that make it shorter: fitted ones, or Lorenzo's."""
    return min((encode_with(weights, symbols) for weights in (LORENZO, fitted(symbols))), key=len)


def encode_with(weights: np.ndarray, symbols: np.ndarray) -> bytes:
    """The same, with (NEIGHBOURS,) int16 weights that are given."""
    symbols = np.array(symbols, order="C")  # compiled for this layout; and `walk` writes
    trace = np.empty(symbols.size * MOST_DECISIONS, np.int16)
    _, at, _ = walk(symbols, np.stack([LORENZO, weights]).astype(np.int64), 0, 0, None, trace)
    return weights.astype("<i2").tobytes() + encode_trace(trace[:at])


def decode_nodes(body: bytes, shape: tuple[int, ...]) -> np.ndarray:
    """Undo `encode_nodes`: int16 of that shape.

    Raises:
        FormatError: the body is cut, too long, or says what only a damaged one would.
    """
    if len(body) < 2 * NEIGHBOURS:
        raise FormatError("motion: cut off within its weights")
    weights = np.stack([LORENZO, np.frombuffer(body, "<i2", NEIGHBOURS)]).astype(np.int64)
    state, words = open_stream(body[2 * NEIGHBOURS :], "motion")
    symbols = np.zeros(shape, np.int16)
    state, at, fit = walk(symbols, weights, state, 0, words, None)
    if not fit:
        raise FormatError("motion: a symbol leaves its 16 bits")
    check_end(state, at, words, "motion")
    return symbols


def fitted(symbols: np.ndarray) -> np.ndarray:
    """(NEIGHBOURS,) int16: weights that make the sum of absolute errors small where all neighbours are there; any would do."""
    inner = symbols[1:, 1:, 1:, 1:].reshape(-1)
    every = -(-inner.size // FIT_VALUES) or 1
    around = np.empty((inner[::every].size, NEIGHBOURS))
    for k in range(1, NEIGHBOURS + 1):
        steps = (k >> 3, k >> 2 & 1, k >> 1 & 1, k & 1)
        where = tuple(slice(1 - step, size - step) for step, size in zip(steps, symbols.shape, strict=False))
        around[:, k - 1] = symbols[where].reshape(-1)[::every]
    missed = inner[::every] - around @ (LORENZO / 2**WEIGHT_BITS)
    return np.clip(np.rint(LORENZO + 2**WEIGHT_BITS * least_absolute(missed, around)), -32768, 32767).astype(np.int16)


@compiled()
def walk(symbols, weights, state, at, words, trace):
    """Code `symbols`, or decode into them: (state, at, whether all fit 16 bits).

    Args:
        weights: (2, NEIGHBOURS) int64: of nodes that lack neighbours, and of the others.
    """
    T, Z, Y, X, M = symbols.shape
    table = new_models(CONTEXTS * DECISIONS)
    r = np.zeros((2, Z, Y, X, M), np.int64)  # of this row and the one before
    for t in range(T):
        for z in range(Z):
            for y in range(Y):
                for x in range(X):
                    inner = weights[1 if min(t, z, y, x) > 0 else 0]
                    for m in range(M):
                        predicted = _predicted(symbols, inner, t, z, y, x, m)
                        context = _context(r, t, z, y, x, m)
                        error = int(symbols[t, z, y, x, m]) - predicted
                        error, state, at = code_signed(
                            error, table, context * DECISIONS, UNARY, ESCAPES, state, at, words, trace
                        )
                        value = predicted + error
                        if not -32768 <= value <= 32767:
                            return state, at, False
                        symbols[t, z, y, x, m] = value
                        r[t & 1, z, y, x, m] = abs(error)
                if words is not None and at > words.size:
                    return state, at, True
    return state, at, True


@inlined
def _predicted(symbols, weights, t, z, y, x, m):
    """The weighted sum of the neighbours that are there, as a symbol."""
    total = 0
    for k in range(1, NEIGHBOURS + 1):
        i, j, u, v = t - (k >> 3), z - (k >> 2 & 1), y - (k >> 1 & 1), x - (k & 1)
        if min(i, j, u, v) >= 0:
            total += int(weights[k - 1]) * int(symbols[i, j, u, v, m])
    return min(max(total + (1 << WEIGHT_BITS - 1) >> WEIGHT_BITS, -32768), 32767)


@inlined
def _context(r, t, z, y, x, m):
    """Of the mean r of the neighbours one step back along one axis, the logarithm."""
    now = t & 1
    total, count = 0, 0
    if t > 0:
        total, count = total + r[1 - now, z, y, x, m], count + 1
    if z > 0:
        total, count = total + r[now, z - 1, y, x, m], count + 1
    if y > 0:
        total, count = total + r[now, z, y - 1, x, m], count + 1
    if x > 0:
        total, count = total + r[now, z, y, x - 1, m], count + 1
    mean = (int(total) // count if count > 0 else UNKNOWN) + 2
    return min(log_class(mean) - 2, CONTEXTS - 1)
