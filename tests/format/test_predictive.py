"""PREDICTIVE: the same comes back for every quantiser, smooth planes shrink, and damage is refused."""

import time
from types import FunctionType

import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit

from codec_inputs import PLANE_PATTERNS, followed, on_trellis, plane_pattern, textured
from core_decoders import decode_symbols
from kpc.encoder.coding import predictive as module
from kpc.encoder.coding.predictive import (
    ACTIVITIES,
    SET_COUNTS,
    collect_neighbours,
    encode_symbols,
    encode_with_weights,
    fit_weights,
    follows_trellis,
    trellis_transition,
)
from kpc.encoder.coding.raw_planes import encode_raw_segment
from kpc.format.common.errors import FormatError
from kpc.format.container.container import Codec
from kpc.format.container.segments import (
    DEPENDENT,
    MODE_BITS,
    SCALAR,
    TRELLIS,
    WEIGHT_COUNT,
    PredictionWeights,
    side_info_of,
)
from without_numba import assert_same_without_numba

shapes = st.tuples(st.integers(1, 12), st.integers(1, 12), st.integers(1, 5))


def assert_decodes(body: bytes, symbols: np.ndarray, coded: np.ndarray) -> None:
    decoded, where = decode_symbols(body, *symbols.shape)
    assert decoded.dtype == np.int8 and np.array_equal(decoded, symbols)
    assert where.dtype == bool and np.array_equal(where, coded)


@given(
    paint=st.sampled_from(sorted(PLANE_PATTERNS)),
    shape=shapes,
    seed=st.integers(0, 2**32 - 1),
    share=st.sampled_from([0.0, 0.3, 0.8, 1.0]),
)
@settings(deadline=None)
def test_symbols_come_back(paint, shape, seed, share):
    symbols, coded = plane_pattern(paint, shape, seed, share)
    assert_decodes(encode_symbols(symbols, coded), symbols, coded)


@given(shape=shapes, seed=st.integers(0, 2**32 - 1), count=st.sampled_from(SET_COUNTS), extreme=st.booleans())
@settings(deadline=None)
def test_any_weights_will_do(shape, seed, count, extreme):
    symbols, coded = plane_pattern("noise", shape, seed, 0.8)
    rng = np.random.default_rng(seed)
    weights = (
        rng.choice([-128, 127], (count, WEIGHT_COUNT)) if extreme else rng.integers(-128, 128, (count, WEIGHT_COUNT))
    )
    assert_decodes(encode_with_weights(weights.astype(np.int8), symbols, coded, SCALAR), symbols, coded)


@given(
    paint=st.sampled_from(sorted(PLANE_PATTERNS)),
    shape=shapes,
    seed=st.integers(0, 2**32 - 1),
    share=st.sampled_from([0.3, 0.8, 1.0]),
)
@settings(deadline=None)
def test_symbols_on_the_trellis_come_back(paint, shape, seed, share):
    symbols, coded = plane_pattern(paint, shape, seed, share)
    symbols = on_trellis(symbols, coded)
    assert follows_trellis(symbols, coded)
    body = encode_symbols(symbols, coded)
    assert body[1] >> MODE_BITS == TRELLIS and side_info_of(Codec.PREDICTIVE, body) is None
    assert_decodes(body, symbols, coded)


def test_the_trellis_saves_a_bit_a_symbol():
    rng = np.random.default_rng(0)
    symbols, coded = rng.integers(-40, 40, (60, 60, 4)).astype(np.int8), np.ones((60, 60), bool)
    moved = on_trellis(symbols, coded)
    assert not follows_trellis(symbols, coded)
    assert len(encode_symbols(moved, coded)) < len(encode_symbols(symbols, coded)) - 0.95 * symbols.size / 8


@given(
    paint=st.sampled_from(sorted(PLANE_PATTERNS)),
    shape=shapes,
    seed=st.integers(0, 2**32 - 1),
    share=st.sampled_from([0.3, 0.8, 1.0]),
    count=st.sampled_from(SET_COUNTS),
)
@settings(deadline=None)
def test_dependent_symbols_come_back(paint, shape, seed, share, count):
    symbols, coded = plane_pattern(paint, shape, seed, share)
    side_info = PredictionWeights(
        np.random.default_rng(seed).integers(-128, 128, (count, WEIGHT_COUNT)).astype(np.int8)
    )
    symbols = followed(symbols, coded, side_info)
    body = encode_symbols(symbols, coded, side_info)
    assert_decodes(body, symbols, coded)
    assert side_info_of(Codec.PREDICTIVE, body) == side_info and body == encode_with_weights(
        side_info.weights, symbols, coded, DEPENDENT
    )


@pytest.mark.parametrize("flat", [0, ACTIVITIES])
def test_dependent_offsets_in_odd_states_are_odd_or_zero(monkeypatch, flat):
    """Check the definition with weights of 0, where the prediction is the mean of left and above."""
    monkeypatch.setattr(module, "FLAT_ACTIVITY", flat)
    kernel = FunctionType(module.code_symbols.py_func.__code__, vars(module), "code_symbols")
    monkeypatch.setattr(module, "code_symbols", njit(kernel))
    v = np.random.default_rng(5).integers(-40, 40, (9, 30, 2)).astype(np.int8)
    trace, nothing = np.empty(v.size * module.MAX_DECISIONS, np.int16), module.new_neighbours(0)
    module.code_symbols(
        v, np.ones((9, 30), bool), DEPENDENT, np.zeros((1, WEIGHT_COUNT), np.int8), 0, 0, None, trace, nothing
    )
    assert follows_trellis(v, np.ones((9, 30), bool)) == (flat == 0)
    odd_ones, v = 0, v.astype(int)
    for y, m in np.ndindex(9, 2) if flat else ():
        place = 0
        for x in range(30):
            left = v[y, x - 1, m] if x else v[y - 1, 0, m] if y else 0
            above = v[y - 1, x, m] if y else left
            away = v[y, x, m] - (left + above + 1 >> 1)
            size, rest = divmod(abs(away) + (place & 1), 2)
            assert rest == 0 or away == 0
            odd_ones += away != 0 and place & 1
            place = trellis_transition(place, 2 * size)
    assert odd_ones > 100 or not flat


def test_symbols_that_do_not_follow_their_side_information_are_encoded_without():
    symbols, coded = textured(40, 50, 3)
    symbols //= 16
    side_info = PredictionWeights(fit_weights(collect_neighbours(symbols, coded), 1))
    assert encode_with_weights(side_info.weights, symbols, coded, DEPENDENT) is None
    assert encode_symbols(symbols, coded, side_info) == encode_symbols(symbols, coded)
    follows = followed(symbols, coded, side_info)
    assert len(encode_symbols(follows, coded, side_info)) < 0.95 * len(encode_symbols(follows, coded))


def test_one_symbol_off_the_trellis_is_enough_to_leave_it():
    symbols, coded = textured(9, 11, 3)
    moved = on_trellis(symbols, coded)
    y, x = np.argwhere(coded)[20]
    moved[y, x, 1] ^= 1
    assert not follows_trellis(moved, coded)
    assert_decodes(encode_symbols(moved, coded), moved, coded)


def test_smooth_planes_take_far_less_than_with_zstd():
    symbols, coded = textured()
    body = encode_symbols(symbols, coded)
    assert_decodes(body, symbols, coded)
    frame = zstandard.ZstdCompressor(level=19).compress(encode_raw_segment(symbols, coded))
    assert len(body) < 0.85 * len(frame)


def test_arrays_may_have_any_layout_and_are_left_as_they_are():
    symbols, coded = textured(9, 11, 3)
    body = encode_symbols(symbols, coded)
    across = np.asfortranarray(symbols)[:, :, :]
    for array in (symbols, across, coded):
        array.flags.writeable = False
    assert encode_symbols(symbols, coded) == encode_symbols(across, np.asfortranarray(coded)) == body


def test_noise_takes_hardly_more_than_it_holds():
    symbols, coded = plane_pattern("noise", (40, 40, 4), 0, 1.0)
    assert len(encode_symbols(symbols, coded)) < 1.15 * symbols.size


def test_uncoded_texels_cost_their_map_and_a_simple_map_costs_little():
    still, nowhere = np.zeros((100, 200, 8), np.int8), np.zeros((100, 200), bool)
    assert len(encode_symbols(still, nowhere)) < 40
    assert len(encode_symbols(still, ~nowhere)) < 120
    half = nowhere | (np.arange(200) < 90)
    assert len(encode_symbols(still, half)) < 200


# The same lines, not compiled: what numba makes of integers must be what Python makes of them.
PLAIN = """
import hashlib
import numpy as np
from codec_inputs import followed, on_trellis, plane_pattern, textured
from kpc.encoder.coding.predictive import DEPENDENT, SCALAR, TRELLIS, PredictionWeights
from core_decoders import decode_symbols
from kpc.encoder.coding.predictive import encode_with_weights

smooth, coded = textured(14, 12, 3)
weights = np.random.default_rng(3).integers(-128, 128, (4, 9)).astype(np.int8)
for symbols, coded, lattice in (
        (smooth, coded, SCALAR), (on_trellis(smooth, coded), coded, TRELLIS),
        (*plane_pattern("noise", (7, 9, 3), 1, 0.7), SCALAR),
        (*plane_pattern("extremes", (9, 5, 2), 2, 1.0), SCALAR),
        (followed(smooth, coded, PredictionWeights(weights)), coded, DEPENDENT),
        (followed(smooth // 30, coded, PredictionWeights(weights // 8)), coded, DEPENDENT)):
    body = encode_with_weights(weights // 8 if symbols.max() < 8 else weights, symbols, coded, lattice)
    assert np.array_equal(decode_symbols(body, *symbols.shape)[0], symbols)
    print(hashlib.sha256(body).hexdigest())
"""


def test_compiled_code_and_plain_python_give_the_same_bytes():
    assert_same_without_numba(PLAIN, "kpc.encoder.coding.rans:code_bit_adaptive")


# --- damage and hostility


def decodes_or_is_refused(body: bytes, shape: tuple[int, int, int]) -> bool:
    try:
        symbols, coded = decode_symbols(body, *shape)
    except FormatError:
        return False
    assert symbols.shape == shape and coded.shape == shape[:2] and not symbols[~coded].any()
    return True


@pytest.fixture(scope="module")
def small() -> tuple[bytes, tuple[int, int, int]]:
    symbols, coded = textured(9, 11, 3)
    return encode_symbols(symbols, coded), symbols.shape


def test_every_truncation_is_refused(small):
    body, shape = small
    assert decodes_or_is_refused(body, shape)
    assert not any(decodes_or_is_refused(body[:length], shape) for length in range(len(body)))


def test_flipped_bits_are_refused_or_mean_something_else(small):
    """Nearly all are refused, since the last state must come out right; none leads outside of the arrays."""
    body, shape = small
    accepted = 0
    for position in range(len(body)):
        for bit in range(8):
            damaged = bytearray(body)
            damaged[position] ^= 1 << bit
            accepted += decodes_or_is_refused(bytes(damaged), shape)
    assert accepted <= len(body) // 100


@given(
    body=st.binary(max_size=80), shape=shapes, count=st.sampled_from([0, 1, 2, 3, 4, 8, 255]), flag=st.integers(0, 11)
)
@settings(deadline=None)
def test_any_bytes_decode_or_are_refused(body, shape, count, flag):
    decodes_or_is_refused(body, shape)
    decodes_or_is_refused(bytes([count, flag]) + body, shape)


def test_a_body_of_another_shape_is_refused(small):
    body, (rows, columns, channels) = small
    for other in ((rows, columns, channels + 1), (rows + 1, columns, channels), (columns, rows, channels), (1, 1, 1)):
        assert not decodes_or_is_refused(body, other)


def test_a_stream_that_ends_early_is_given_up_at_once():
    """Within a row of its end: the hundreds of millions of symbols after it would take ten seconds and more."""
    symbols, coded = plane_pattern("noise", (8, 8, 1), 0, 1.0)
    body = encode_symbols(symbols, coded)
    start = time.perf_counter()
    with pytest.raises(FormatError, match="plane segment"):
        decode_symbols(body, 4, 16, 1 << 22)
    assert time.perf_counter() - start < 2.0


@pytest.mark.parametrize(
    "change, complaint",
    [
        (lambda body: b"", "number of sets"),
        (lambda body: b"\3" + body[1:], "number of sets"),
        (lambda body: b"\0" + body[1:], "number of sets"),
        (lambda body: body[:1] + b"\x03" + body[2:], "or flag"),
        (lambda body: body[:1] + b"\x0c" + body[2:], "or flag"),
        (lambda body: body[:1] + b"\x10" + body[2:], "or flag"),
        (lambda body: body[: 2 + WEIGHT_COUNT + 3], "cut off"),
        (lambda body: body + b"\0", "cut off"),
        (lambda body: body + b"\0\0", "do not end"),
        (lambda body: body[: 2 + WEIGHT_COUNT] + b"\xff\xff\0\0" + body[2 + WEIGHT_COUNT + 4 :], "first state"),
    ],
)
def test_what_is_wrong_is_said(change, complaint):
    body = encode_with_weights(
        np.zeros((1, WEIGHT_COUNT), np.int8),
        np.arange(8, dtype=np.int8).reshape(2, 2, 2),
        np.ones((2, 2), bool),
        SCALAR,
    )
    with pytest.raises(FormatError, match=complaint):
        decode_symbols(change(body), 2, 2, 2)
