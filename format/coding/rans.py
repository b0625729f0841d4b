"""Adaptive binary decisions under rANS, in integers (spec/kpc-format.md, section 6, "Decisions").

A *counter* estimates how likely its decision is 1, out of 2^16, and notes how often it was asked. rANS (arXiv:1311.2540) turns
decisions and their probabilities into bits: the low 12 bits of a decoder's state hold the next decision. Encoding runs backwards,
so an encoder first writes down every decision and its probability (the *trace*), then turns the trace into words.

Compiled with numba; with NUMBA_DISABLE_JIT=1 the same lines run as plain Python.
"""

import numpy as np
from kpc.format.common.errors import FormatError
from kpc.format.common.jit import compiled, inlined

LOWEST_STATE = 1 << 16
"""The state lies in [2^16, 2^32) between decisions. An encoder begins at 2^16, so there a decoder must end."""
SCALE_BITS = 12
SCALE = 1 << SCALE_BITS
WORD_BITS = 16

EVEN_PROBABILITY = 1 << 15
"""A counter that knows nothing."""
ADAPTATION_LIMIT = 120
"""Decisions after which a counter no longer slows down: it forgets with a time constant of that many."""
RATES = np.array([327680 // (5 * n + 8) for n in range(ADAPTATION_LIMIT + 1)])
"""How far, out of 2^16, the nth decision moves its counter: 1 / (n + 1.6), a little faster than the plain mean of n."""


@compiled()
def new_models(count):
    """(count,) int32 of counters that know nothing: the probability of a 1 out of 2^16, times 256, plus decisions seen."""
    return np.full(count, EVEN_PROBABILITY << 8, np.int32)


@inlined
def code_bit(bit, probability, state, at, words, trace):
    """One decision of a given probability of 1, out of SCALE: (bit, state, at).

    Encoding (`words` is None): trace[at] = probability, negative for a 0. Decoding (`trace` is None): the bit comes from `state`
    and, where that runs low, from words[at]; past the end zeros come, and `at` goes on, for the caller to see.
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
            if at < words.size:
                state |= int(words[at])
            at += 1
    if trace is not None:
        trace[at] = probability if bit else -probability
        at += 1
    return bit, state, at


@inlined
def code_bit_adaptive(bit, table, which, state, at, words, trace):
    """`code_bit` with the probability of a counter, which then learns the bit."""
    counter = int(table[which])
    p, n = counter >> 8, counter & 255
    bit, state, at = code_bit(bit, p >> 16 - SCALE_BITS, state, at, words, trace)
    if bit:
        p += (65536 - p) * RATES[n] >> 16
    else:
        p -= p * RATES[n] >> 16
    table[which] = p << 8 | min(n + 1, ADAPTATION_LIMIT)
    return bit, state, at


@inlined
def log_class(number):
    """The logarithm of a number from 0 on, two for each doubling: 0, 1, 2, 3, then 4 from 4 on, 5 from 6 on, 6 from 8 on."""
    bits = 0
    while number >> bits:
        bits += 1
    return 2 * bits - 2 + (number >> bits - 2 & 1) if bits > 1 else bits


@inlined
def code_signed(value, table, first, unary, escapes, state, at, words, trace):
    """Code or decode an integer in the context whose 2 + 2 (unary + escapes) counters begin at `first`: (value, state, at).

    Magnitudes of 1 to `unary` take a decision each; of larger ones the number of bits, up to `escapes`, comes first.
    """
    bit, state, at = code_bit_adaptive(1 if value != 0 else 0, table, first, state, at, words, trace)
    if not bit:
        return 0, state, at
    positive, state, at = code_bit_adaptive(1 if value > 0 else 0, table, first + 1, state, at, words, trace)
    first += 2 if positive else 2 + unary + escapes
    magnitude, state, at = code_unsigned(abs(value), table, first, unary, escapes, state, at, words, trace)
    return magnitude if positive else -magnitude, state, at


@inlined
def code_unsigned(value, table, first, unary, escapes, state, at, words, trace):
    """Code or decode a number from 1 on, by unary + escapes counters from `first` on: (value, state, at)."""
    beyond, found = value - 1, 0
    while found < unary:
        bit, state, at = code_bit_adaptive(1 if beyond > found else 0, table, first + found, state, at, words, trace)
        if not bit:
            break
        found += 1
    if found == unary:  # Exp-Golomb: as many ones as bits follow, a zero, the bits
        rest, bits = beyond - unary + 1, 0
        while bits < escapes:
            bit, state, at = code_bit_adaptive(
                1 if rest >> bits + 1 != 0 else 0, table, first + unary + bits, state, at, words, trace
            )
            if not bit:
                break
            bits += 1
        low = 1
        for place in range(bits - 1, -1, -1):
            bit, state, at = code_bit(rest >> place & 1, SCALE >> 1, state, at, words, trace)
            low = low << 1 | bit
        found += low - 1
    return found + 1, state, at


@compiled()
def trace_words(trace):
    """A trace as the words that a decoder reads, the first two of them its state: (N,) uint16."""
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
    """A trace as the bytes that `open_stream` takes: state (u32) and words (u16)."""
    return bytes(trace_words(trace).astype("<u2").tobytes())


def open_stream(body: bytes, what: str) -> tuple[int, np.ndarray]:
    """The first state and the (N,) uint16 words of a `encode_trace`; `what` it is of, for messages.

    Raises:
        FormatError: it is cut, or its state is none.
    """
    if len(body) < 4 or len(body) % 2:
        raise FormatError(f"{what}: cut off within its words")
    state = int.from_bytes(body[:4], "little")
    if state < LOWEST_STATE:
        raise FormatError(f"{what}: its first state is too small")
    return state, np.frombuffer(body, "<u2", offset=4).astype(np.uint16)


def check_end(state: int, at: int, words: np.ndarray, what: str) -> None:
    """Check that after the last decision all words are taken and the state is an encoder's first.

    Raises:
        FormatError: it is not so.
    """
    if at != len(words) or state != LOWEST_STATE:
        raise FormatError(f"{what}: its words do not end where they should")
