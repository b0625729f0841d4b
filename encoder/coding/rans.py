"""Adaptive binary entropy coding with rANS, in integers (spec/kpc-format.md, "Entropy coder").

An adaptive *model* estimates the probability that its bit is 1, out of 2^16, and counts how often it was used. rANS
(arXiv:1311.2540) turns bits and their probabilities into 16-bit words. It encodes backwards, so an encoder first
records every bit with its probability (the *trace*) and then turns the trace into words.

Encoder and decoder share one function for each syntax element. The coder's state is explicit:

    value, state, position = code_...(value, ..., state, position, words, trace)

    encoding    `words` is None; each bit is written to `trace` at `position`; `state` is not used
    decoding    `trace` is None; `value` is ignored and returned as decoded; `position` is that of the next word

A decoder that runs out of words reads zeros, and `position` goes on beyond the end, for the caller to notice.
"""

import numpy as np

from kpc.jit import compiled, inlined

# The state lies in [LOWEST_STATE, 2^32) between bits. An encoder begins with LOWEST_STATE, so there a decoder must end.
LOWEST_STATE = 1 << 16
SCALE_BITS = 12  # bits of a probability, as the coder uses it
SCALE = 1 << SCALE_BITS
WORD_BITS = 16

EVEN_PROBABILITY = 1 << 15  # of a new model, out of 2^16
ADAPTATION_LIMIT = 120  # uses after which a model no longer slows down: from then on its memory is that many bits long
# How far the nth use moves a model's probability, out of 2^16: 1 / (n + 1.6), a little faster than the plain mean of n.
RATES = np.array([327680 // (5 * n + 8) for n in range(ADAPTATION_LIMIT + 1)])


@compiled()
def new_models(count):
    """Return (count,) int32 models of even probability: each the probability of a 1 out of 2^16, times 256, plus its
    uses.
    """
    return np.full(count, EVEN_PROBABILITY << 8, np.int32)


@inlined
def code_bit(bit, probability, state, position, words, trace):
    """Code one bit whose probability of being 1 is given, 1 to SCALE - 1 out of SCALE: (bit, state, position).

    The trace holds the probability, negated for a 0.
    """
    if words is not None:
        low = state & (SCALE - 1)
        if low < probability:
            bit = 1
            state = probability * (state >> SCALE_BITS) + low
        else:
            bit = 0
            state = (SCALE - probability) * (state >> SCALE_BITS) + low - probability
        if state < LOWEST_STATE:
            state <<= WORD_BITS
            if position < words.size:
                state |= int(words[position])
            position += 1
    if trace is not None:
        trace[position] = probability if bit else -probability
        position += 1
    return bit, state, position


@inlined
def code_bit_adaptive(bit, models, index, state, position, words, trace):
    """Code one bit with the probability of a model, which then adapts: (bit, state, position)."""
    model = int(models[index])
    p, n = model >> 8, model & 255
    bit, state, position = code_bit(bit, p >> 16 - SCALE_BITS, state, position, words, trace)
    if bit:
        p += (65536 - p) * RATES[n] >> 16
    else:
        p -= p * RATES[n] >> 16
    models[index] = p << 8 | min(n + 1, ADAPTATION_LIMIT)
    return bit, state, position


@inlined
def code_signed(value, models, first, unary, escapes, state, position, words, trace):
    """Code an integer with the 2 + 2 (unary + escapes) models from `first` on: (value, state, position).

    In order: whether it is not 0; whether it is positive; its magnitude as of `code_unsigned`, with models for either
    sign.
    """
    bit, state, position = code_bit_adaptive(1 if value != 0 else 0, models, first, state, position, words, trace)
    if not bit:
        return 0, state, position
    positive, state, position = code_bit_adaptive(
        1 if value > 0 else 0, models, first + 1, state, position, words, trace
    )
    first += 2 if positive else 2 + unary + escapes
    magnitude, state, position = code_unsigned(abs(value), models, first, unary, escapes, state, position, words, trace)
    return magnitude if positive else -magnitude, state, position


@inlined
def code_unsigned(value, models, first, unary, escapes, state, position, words, trace):
    """Code an integer from 1 on with the unary + escapes models from `first` on: (value, state, position).

    Values up to `unary` take a bit each, with a model for each. Larger ones are escaped: an Exp-Golomb code of value
    - unary - 1, whose prefix of at most `escapes` bits has a model for each bit, and whose suffix bits are of even
    probability.
    """
    beyond, found = value - 1, 0
    while found < unary:
        bit, state, position = code_bit_adaptive(
            1 if beyond > found else 0, models, first + found, state, position, words, trace
        )
        if not bit:
            break
        found += 1
    if found == unary:
        rest, bits = beyond - unary + 1, 0
        while bits < escapes:
            bit, state, position = code_bit_adaptive(
                1 if rest >> bits + 1 != 0 else 0, models, first + unary + bits, state, position, words, trace
            )
            if not bit:
                break
            bits += 1
        low = 1
        for shift in range(bits - 1, -1, -1):
            bit, state, position = code_bit(rest >> shift & 1, SCALE >> 1, state, position, words, trace)
            low = low << 1 | bit
        found += low - 1
    return found + 1, state, position


@inlined
def log_class(number):
    """Return the logarithmic class of an integer from 0 on, two classes for each doubling: 0, 1, 2, 3, 4 from 4, 5
    from 6, 6 from 8 on.

    With b the number of binary digits: 2 b - 2 + the second most significant digit; 0 and 1 are classes of their own.
    """
    bits = 0
    while number >> bits:
        bits += 1
    return 2 * bits - 2 + (number >> bits - 2 & 1) if bits > 1 else bits


@compiled()
def trace_words(trace):
    """Return the words that a decoder reads back as the (N,) int16 trace: (K,) uint16, the first two of which are its
    first state.
    """
    backwards = np.empty(trace.size + 2, np.uint16)
    state, count = LOWEST_STATE, 0
    for at in range(trace.size - 1, -1, -1):
        probability = int(trace[at])
        if probability > 0:
            size, start = probability, 0
        else:
            size, start = SCALE + probability, -probability
        if state >= size << 32 - SCALE_BITS:
            backwards[count] = state & 0xFFFF
            state >>= WORD_BITS
            count += 1
        state = (state // size << SCALE_BITS) + state % size + start
    backwards[count] = state >> WORD_BITS
    backwards[count + 1] = state & 0xFFFF
    return backwards[: count + 2][::-1].copy()


def encode_trace(trace: np.ndarray) -> bytes:
    """Return a trace as the bytes that a decoder takes: state (u32) and words (u16)."""
    return bytes(trace_words(trace).astype("<u2").tobytes())
