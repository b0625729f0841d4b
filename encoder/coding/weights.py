"""WEIGHTS, the codec of decoders' weights: integers times a power of two for each array (spec/kpc-format.md,
"WEIGHTS").

An integer is coded by its magnitude alone, with adaptive models for each array: neighbouring weights say next to
nothing of it. What this saves is in docs/design/entropy-coding.md.
"""

from collections.abc import Sequence

import numpy as np

from kpc.encoder.coding.rans import code_signed, encode_trace, new_models
from kpc.format.coding.quantise import FINEST
from kpc.jit import compiled

UNARY, ESCAPES = 4, 10  # of `code_signed`
MODELS_PER_ARRAY = 2 + 2 * (UNARY + ESCAPES)
MAX_DECISIONS = 2 + UNARY + ESCAPES + 1 + ESCAPES  # bits that a weight takes in a trace, at most
LARGEST = 2048  # magnitude of an integer, so that it is exact in float16
COARSEST = 15  # the last exponent whose power of two is a float16


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
    position = 0
    for values in integers:
        position = code_array(values, position, trace)
    return np.array(exponents, np.int8).tobytes() + encode_trace(trace[:position])


@compiled()
def code_array(values, position, trace):
    """Code the integers of an array, with models of its own; return the position in the trace."""
    models, state = new_models(MODELS_PER_ARRAY), 0
    for i in range(values.size):
        _, state, position = code_signed(values[i], models, 0, UNARY, ESCAPES, state, position, None, trace)
    return position
