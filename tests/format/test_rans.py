import numpy as np
import pytest

from kpc.encoder.coding.rans import (
    ADAPTATION_LIMIT,
    EVEN_PROBABILITY,
    LOWEST_STATE,
    SCALE,
    code_bit,
    code_bit_adaptive,
    new_models,
    trace_words,
)
from kpc.jit import compiled


def encode_bits(bits: list[int], probabilities: list[int]) -> np.ndarray:
    trace = np.empty(len(bits), np.int16)
    for at, (bit, probability) in enumerate(zip(bits, probabilities, strict=True)):
        assert code_bit(bit, probability, 0, at, None, trace) == (bit, 0, at + 1)
    return trace_words(trace)


@pytest.mark.parametrize("seed", range(5))
def test_decisions_come_back_and_end_where_they_began(seed):
    rng = np.random.default_rng(seed)
    probabilities = rng.choice([1, 7, SCALE // 2, SCALE - 7, SCALE - 1], 3000).tolist()
    bits = (rng.random(3000) * SCALE < probabilities).astype(int).tolist()
    words = encode_bits(bits, probabilities)
    state, at, rest = int(words[0]) | int(words[1]) << 16, 0, words[2:]
    for bit, probability in zip(bits, probabilities, strict=True):
        found, state, at = code_bit(0, probability, state, at, rest, None)
        assert found == bit and LOWEST_STATE <= state < 1 << 32
    assert state == LOWEST_STATE and at == len(rest)
    ideal = sum(-np.log2((p if b else SCALE - p) / SCALE) for b, p in zip(bits, probabilities, strict=True))
    assert 16 * len(words) < 1.002 * ideal + 48


def test_past_the_end_there_are_zeros():
    state, at = LOWEST_STATE, 0
    for _ in range(100):
        _, state, at = code_bit(0, 1, state, at, np.zeros(0, np.uint16), None)
        assert state >= 0
    assert at > 0


@pytest.mark.parametrize("pattern", ["0", "1", "01", "0000000001", "1111111110", "00000000000000000000000000000000001"])
def test_a_counter_s_probability_never_reaches_0_or_1(pattern):
    table, trace, seen = new_models(1), np.empty(1, np.int16), set()
    for k in range(2000):
        code_bit_adaptive(int(pattern[k % len(pattern)]), table, 0, 0, 0, None, trace)
        seen.add(abs(int(trace[0])))
        p, n = int(table[0]) >> 8, int(table[0]) & 255
        assert 0 < p < 65536 and n == min(k + 1, ADAPTATION_LIMIT)
    assert 1 <= min(seen) and max(seen) <= SCALE - 1


def test_no_string_of_decisions_leads_a_counter_out_of_its_range():
    """All 2^16 strings of 16 decisions, and from the extremes of these on the string that pushes on."""
    for extreme, push in ((min, 0), (max, 1)):
        reached = {EVEN_PROBABILITY}
        for n in range(3 * ADAPTATION_LIMIT):
            rate = 327680 // (5 * min(n, ADAPTATION_LIMIT) + 8)
            bits = (0, 1) if n < 16 else (push,)
            reached = {p + ((65536 - p) * rate >> 16) if bit else p - (p * rate >> 16) for p in reached for bit in bits}
            reached = reached if n < 16 else {extreme(reached)}
            assert all(16 <= p < 65536 - 15 for p in reached)


def test_where_nothing_can_be_cached_functions_are_compiled_all_the_same():
    names: dict = {}
    exec("def doubled(x):\n    return 2 * x\n", names)  # no file, hence no folder beside it
    assert compiled()(names["doubled"])(21) == 42
