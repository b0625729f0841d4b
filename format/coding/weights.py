"""Weights of decoders under codec 2: whole multiples of a power of two, told one after the other (spec, section 7).

What they cost is how often each multiple comes, by magnitude, in its array. Neighbours in rows, or other colours, say next to nothing of them.
Where each array has as few bits as its errors allow (`kpc.encoder.rdo.rate_control.choose_decoder_bits`) shelf_hand's take 0.8 to 1.1 KB from 2.5 to 0.1 dB of loss,
where zstd made 1.2 to 1.5 of float16 that is rounded weight by weight; room's take 1.9 KB at 0.1 dB, in place of 2.6 at 0.15.
"""

import math
from collections.abc import Sequence

import numpy as np
from kpc.format.coding.rans import check_end, code_signed, encode_trace, new_models, open_stream
from kpc.format.common.errors import FormatError
from kpc.format.common.jit import compiled

UNARY, ESCAPES = 4, 10
DECISIONS = 2 + 2 * (UNARY + ESCAPES)
"""Counters of an array's weights."""
MOST_DECISIONS = 2 + UNARY + ESCAPES + 1 + ESCAPES
"""That a weight takes."""
LARGEST = 2048
"""Multiple, so that each is exact in float16."""
FINEST, COARSEST = -24, 15
"""Powers of two, of the least float16 number above 0 and of the last that is not beyond the largest."""
HALF_LIMIT = 65504.0


def encode_weights(arrays: Sequence[np.ndarray]) -> bytes | None:
    """Code arrays of float16 numbers; None where one has too many digits for it."""
    powers, multiples = [], []
    for values in arrays:
        wholes = np.rint(np.ldexp(np.ravel(values).astype(np.float64), -FINEST)).astype(np.int64)
        bits = int(np.bitwise_or.reduce(wholes))
        shift = min((bits & -bits).bit_length() - 1, COARSEST - FINEST) if bits else -FINEST
        if abs(wholes >> shift).max() > LARGEST:
            return None
        powers.append(shift + FINEST)
        multiples.append(wholes >> shift)
    trace = np.empty(sum(map(len, multiples)) * MOST_DECISIONS, np.int16)
    _, at = _walk(multiples, 0, None, trace)
    return np.array(powers, np.int8).tobytes() + encode_trace(trace[:at])


def decode_weights(body: bytes, shapes: Sequence[tuple[int, ...]]) -> list[np.ndarray]:
    """Undo `encode_weights`: float32 arrays of these shapes.

    Raises:
        FormatError: the body is cut, too long, or says what only a damaged one would.
    """
    powers = np.frombuffer(body[: len(shapes)], np.int8).tolist()
    if any(not FINEST <= power <= COARSEST for power in powers):
        raise FormatError("weights: a power of two is not one of float16's")
    state, words = open_stream(body[len(shapes) :], "weights")
    multiples = [np.zeros(math.prod(shape), np.int64) for shape in shapes]
    state, at = _walk(multiples, state, words, None)
    check_end(state, at, words, "weights")
    arrays = [np.ldexp(wholes.astype(np.float64), power) for wholes, power in zip(multiples, powers, strict=True)]
    if any((abs(wholes) > LARGEST).any() for wholes in multiples) or any(
        (abs(values) > HALF_LIMIT).any() for values in arrays
    ):
        raise FormatError("weights: one is no number of float16")
    return [values.astype(np.float32).reshape(shape) for values, shape in zip(arrays, shapes, strict=True)]


def _walk(
    multiples: Sequence[np.ndarray], state: int, words: np.ndarray | None, trace: np.ndarray | None
) -> tuple[int, int]:
    """Code int64 `multiples`, or decode into them: (state, at)."""
    at = 0
    for values in multiples:
        state, at = walk(values, state, at, words, trace)
        if words is not None and at > words.size:
            break
    return state, at


@compiled()
def walk(values, state, at, words, trace):
    """Code or decode the multiples of an array, by counters of its own: (state, at). The rest as `kpc.format.coding.rans.code_bit`."""
    table = new_models(DECISIONS)
    for i in range(values.size):
        value, state, at = code_signed(values[i], table, 0, UNARY, ESCAPES, state, at, words, trace)
        values[i] = value
    return state, at
