"""MOTION: every node is coded once and after its references, the same comes back, and damage is refused."""

import time
from fractions import Fraction

import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st

from codec_inputs import GRID_PATTERNS, drifting, grid_pattern, swaying
from core_decoders import decode_motion
from kpc.encoder.coding.motion_codec import WEIGHT_BITS, coding_passes, cubic_weights, encode_motion
from kpc.format.common.errors import FormatError
from without_numba import assert_same_without_numba

sizes = st.tuples(*4 * [st.integers(2, 6)])


def assert_decodes(body: bytes, symbols: np.ndarray) -> None:
    found = decode_motion(body, symbols.shape)
    assert found.dtype == np.int16 and found.shape == symbols.shape and np.array_equal(found, symbols)


@given(paint=st.sampled_from(sorted(GRID_PATTERNS)), shape=sizes, seed=st.integers(0, 2**32 - 1))
@settings(deadline=None)
def test_symbols_come_back(paint, shape, seed):
    symbols = grid_pattern(paint, (*shape, 3), seed)
    assert_decodes(encode_motion(symbols), symbols)


@pytest.mark.parametrize("axis", range(4))
def test_long_and_thin_grids_come_back(axis):
    shape = [2, 2, 2, 2, 3]
    shape[axis] = 256 if axis else 500
    symbols = grid_pattern("extremes", tuple(shape), axis)
    assert_decodes(encode_motion(symbols), symbols)


@given(shape=sizes | st.tuples(st.integers(2, 40), *3 * [st.integers(2, 4)]))
@settings(deadline=None)
def test_each_node_is_coded_once_and_after_its_references(shape):
    coded = np.zeros(shape, bool)
    for one in coding_passes(shape):
        along = np.moveaxis(coded, one.axis, 0)
        for new, sides, weights in zip(one.new, one.references, one.weights, strict=True):
            nodes = (..., *np.ix_(*one.others))
            assert not along[new][nodes].any()
            assert all(along[side][nodes].all() for side, weight in zip(sides, weights, strict=True) if weight)
            along[new][nodes] = True
    assert coded.all()


@pytest.mark.parametrize("places", [[0, 3, 5, 8], [None, 0, 2, 3], [1, 2, 5, None], [None, 0, 3, None], [0, 1, 3, 5]])
def test_weights_are_those_of_the_polynomial_through_all_references(places):
    there = [place for place in places if place is not None]
    middle = (places[1] + places[2]) // 2
    weights = cubic_weights(middle, places)
    assert sum(weights) == 1 << WEIGHT_BITS and all(
        weight == 0 for weight, place in zip(weights, places, strict=True) if place is None
    )
    for power in range(len(there)):
        exact = sum(
            Fraction(weight, 1 << WEIGHT_BITS) * place**power
            for weight, place in zip(weights, places, strict=True)
            if place is not None
        )
        assert abs(exact - middle**power) <= Fraction(2, 1 << WEIGHT_BITS) * sum(abs(place) ** power for place in there)


def test_smooth_and_slightly_noisy_fields_take_far_less_than_with_zstd():
    for symbols, share in ((swaying(), 0.55), (drifting(), 0.6)):
        body = encode_motion(symbols)
        assert_decodes(body, symbols)
        differences = np.diff(symbols, axis=0, prepend=np.int16(0)).reshape(-1, 1).view(np.uint8).T.tobytes()
        assert len(body) < share * len(zstandard.ZstdCompressor(level=19).compress(differences))


def test_noise_takes_hardly_more_than_it_holds():
    symbols = grid_pattern("noise", (10, 6, 6, 6, 3), 0)
    assert len(encode_motion(symbols)) < 1.15 * symbols.nbytes


def test_arrays_may_have_any_layout_and_are_left_as_they_are():
    symbols = swaying(4, 3, 4, 5)
    across = np.asfortranarray(symbols)
    symbols.flags.writeable = across.flags.writeable = False
    assert encode_motion(across) == encode_motion(symbols)


# The same lines, not compiled.
PLAIN = """
import hashlib
import numpy as np
from codec_inputs import grid_pattern, swaying
from core_decoders import decode_motion
from kpc.encoder.coding.motion_codec import encode_motion

patterns = grid_pattern("noise", (3, 2, 3, 4, 3), 1), grid_pattern("extremes", (2, 3, 3, 2, 3), 2)
for symbols in (swaying(5, 3, 4, 4), *patterns):
    body = encode_motion(symbols)
    assert np.array_equal(decode_motion(body, symbols.shape), symbols)
    print(hashlib.sha256(body).hexdigest())
"""


def test_compiled_code_and_plain_python_give_the_same_bytes():
    assert_same_without_numba(PLAIN, "kpc.encoder.coding.motion_codec:code_pass")


# --- damage and hostility


SHAPE = (4, 3, 4, 4, 3)


def decodes_or_is_refused(body: bytes, shape: tuple[int, ...] = SHAPE) -> bool:
    try:
        return decode_motion(body, shape).shape == shape
    except FormatError:
        return False


def test_every_truncation_and_excess_is_refused():
    body = encode_motion(swaying(*SHAPE[:4]))
    assert decodes_or_is_refused(body)
    assert not any(decodes_or_is_refused(body[:length]) for length in range(len(body)))
    assert not any(decodes_or_is_refused(body + more) for more in (b"\0", b"\0\0", b"\xff\xff"))


@given(body=st.binary(max_size=80), shape=sizes)
@settings(deadline=None)
def test_any_bytes_decode_or_are_refused(body, shape):
    decodes_or_is_refused(body, (*shape, 3))


def test_a_body_of_another_shape_is_refused():
    body = encode_motion(swaying(*SHAPE[:4]))
    assert not any(
        decodes_or_is_refused(body, other)
        for other in ((5, *SHAPE[1:]), (3, *SHAPE[1:]), (4, 4, 4, 3, 3), (2, 2, 2, 2, 3))
    )


def test_a_symbol_that_leaves_its_16_bits_is_refused():
    symbols = np.zeros((2, 2, 2, 2, 3), np.int32)
    symbols[0, 0, 0, 0, 0] = 40_000
    with pytest.raises(FormatError, match="16 bits"):
        decode_motion(encode_motion(symbols), symbols.shape)


def test_a_stream_that_ends_early_is_given_up_at_once():
    body = encode_motion(grid_pattern("noise", (2, 2, 2, 8, 3), 0))
    start = time.perf_counter()
    with pytest.raises(FormatError, match="motion"):
        decode_motion(body, (1000, 40, 100, 100, 3))
    assert time.perf_counter() - start < 2.0
