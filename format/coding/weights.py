"""WEIGHTS, the codec of decoders' weights: integers times a power of two for each array (spec/kpc-format.md,
"WEIGHTS").

An integer is coded by its magnitude alone, with adaptive models for each array: neighbouring weights say next to
nothing of it. What this saves is in docs/design/entropy-coding.md.
"""

import math
from collections.abc import Sequence

import numpy as np

from kpc.format.coding.rans import check_end, code_signed, encode_trace, new_models, open_stream
from kpc.format.common.errors import FormatError
from kpc.format.common.jit import compiled

UNARY, ESCAPES = 4, 10  # of `code_signed`
MODELS_PER_ARRAY = 2 + 2 * (UNARY + ESCAPES)
MAX_DECISIONS = 2 + UNARY + ESCAPES + 1 + ESCAPES  # bits that a weight takes in a trace, at most
LARGEST = 2048  # magnitude of an integer, so that it is exact in float16
# Exponents: of the smallest float16 number above 0, and the last whose power of two is not beyond the largest.
FINEST, COARSEST = -24, 15
HALF_LIMIT = 65504.0  # the largest float16 number


def encode_weights(arrays: Sequence[np.ndarray]) -> bytes | None:
    """Encode arrays of float16 numbers; None where the weights of one need more than 12 bits together."""
    exponents, integers = [], []
    for values in arrays:
        wholes = np.rint(np.ldexp(np.ravel(values).astype(np.float64), -FINEST)).astype(np.int64)
        bits = int(np.bitwise_or.reduce(wholes))
        shift = min((bits & -bits).bit_length() - 1, COARSEST - FINEST) if bits else -FINEST
        if abs(wholes >> shift).max() > LARGEST:
            return None
        exponents.append(shift + FINEST)
        integers.append(wholes >> shift)
    trace = np.empty(sum(map(len, integers)) * MAX_DECISIONS, np.int16)
    _, position = _code_arrays(integers, 0, None, trace)
    return np.array(exponents, np.int8).tobytes() + encode_trace(trace[:position])


def decode_weights(body: bytes, shapes: Sequence[tuple[int, ...]]) -> list[np.ndarray]:
    """Undo `encode_weights`: return float32 arrays of these shapes.

    Raises:
        FormatError: the body is cut off, too long or damaged.
    """
    exponents = np.frombuffer(body[: len(shapes)], np.int8).tolist()
    if any(not FINEST <= exponent <= COARSEST for exponent in exponents):
        raise FormatError("weights: a power of two is not one of float16's")
    state, words = open_stream(body[len(shapes) :], "weights")
    integers = [np.zeros(math.prod(shape), np.int64) for shape in shapes]
    state, position = _code_arrays(integers, state, words, None)
    check_end(state, position, words, "weights")
    arrays = [np.ldexp(k.astype(np.float64), exponent) for k, exponent in zip(integers, exponents, strict=True)]
    too_large = any((abs(k) > LARGEST).any() for k in integers)
    if too_large or any((abs(values) > HALF_LIMIT).any() for values in arrays):
        raise FormatError("weights: one is no number of float16")
    return [values.astype(np.float32).reshape(shape) for values, shape in zip(arrays, shapes, strict=True)]


def _code_arrays(
    integers: Sequence[np.ndarray], state: int, words: np.ndarray | None, trace: np.ndarray | None
) -> tuple[int, int]:
    """Code int64 arrays: (state, position)."""
    position = 0
    for values in integers:
        state, position = code_array(values, state, position, words, trace)
        if words is not None and position > words.size:
            break
    return state, position


@compiled()
def code_array(values, state, position, words, trace):
    """Code the integers of an array, with models of its own: (state, position), as of `kpc.format.coding.rans`."""
    models = new_models(MODELS_PER_ARRAY)
    for i in range(values.size):
        value, state, position = code_signed(values[i], models, 0, UNARY, ESCAPES, state, position, words, trace)
        values[i] = value
    return state, position
