"""Motion grids under codec 2 (spec, section 5): the same comes back, smooth fields shrink, and damage is refused."""

import time

import numpy as np
import pytest
import zstandard
from codec_inputs import GRID_PATTERNS, grid_pattern, swaying
from hypothesis import given, settings
from hypothesis import strategies as st
from kpc.format.coding.motion_raster import LORENZO, NEIGHBOURS, decode_nodes, encode_nodes, encode_with
from kpc.format.common.errors import FormatError
from without_numba import assert_same_without_numba

shapes = st.tuples(*4 * [st.integers(1, 5)], st.just(3))


def assert_decodes(body: bytes, symbols: np.ndarray) -> None:
    found = decode_nodes(body, symbols.shape)
    assert found.dtype == np.int16 and found.shape == symbols.shape and np.array_equal(found, symbols)


@given(paint=st.sampled_from(sorted(GRID_PATTERNS)), shape=shapes, seed=st.integers(0, 2**32 - 1))
@settings(deadline=None)
def test_symbols_come_back(paint, shape, seed):
    symbols = grid_pattern(paint, shape, seed)
    assert_decodes(encode_nodes(symbols), symbols)


@given(shape=shapes, seed=st.integers(0, 2**32 - 1), extreme=st.booleans())
@settings(deadline=None)
def test_any_weights_will_do(shape, seed, extreme):
    rng = np.random.default_rng(seed)
    weights = rng.choice([-32768, 32767], NEIGHBOURS) if extreme else rng.integers(-1500, 1501, NEIGHBOURS)
    symbols = grid_pattern("noise", shape, seed)
    assert_decodes(encode_with(weights.astype(np.int16), symbols), symbols)


@pytest.mark.parametrize("axis", range(4))
def test_long_and_thin_grids_come_back(axis):
    shape = [1, 1, 1, 1, 3]
    shape[axis] = 500
    symbols = grid_pattern("extremes", tuple(shape), axis)
    assert_decodes(encode_nodes(symbols), symbols)


def test_smooth_fields_take_far_less_than_with_zstd_and_fitted_weights_less_than_lorenzo_s():
    symbols = swaying()
    body = encode_nodes(symbols)
    assert_decodes(body, symbols)
    halves = np.diff(symbols, axis=0, prepend=np.int16(0)).reshape(-1, 1).view(np.uint8).T.tobytes()
    assert len(body) < 0.5 * len(zstandard.ZstdCompressor(level=19).compress(halves))
    assert len(body) < 0.9 * len(encode_with(LORENZO, symbols))


def test_a_product_of_what_changes_along_single_axes_is_hit_by_lorenzo():
    """A field that is a sum of functions of three axes each has no mixed difference: past the borders every error is 0."""
    t, z, y, x, _ = np.indices((12, 7, 7, 7, 3))
    symbols = (t * t * z - 2 * z * y * x + y * y * t + 3 * x * t).astype(np.int16)
    border = symbols.size - 11 * 6 * 6 * 6 * 3
    assert len(encode_with(LORENZO, symbols)) < 1.5 * border


def test_noise_takes_hardly_more_than_it_holds():
    symbols = grid_pattern("noise", (10, 6, 6, 6, 3), 0)
    assert len(encode_nodes(symbols)) < 1.15 * symbols.nbytes


def test_arrays_may_have_any_layout_and_are_left_as_they_are():
    symbols = swaying(4, 3, 4, 5)
    across = np.asfortranarray(symbols)
    symbols.flags.writeable = across.flags.writeable = False
    assert encode_nodes(across) == encode_nodes(symbols)


# The same lines, not compiled.
PLAIN = """
import hashlib
import numpy as np
from codec_inputs import grid_pattern, swaying
from kpc.format.coding.motion_raster import decode_nodes, encode_with

for symbols in (swaying(5, 3, 4, 4), grid_pattern("noise", (3, 2, 3, 4, 3), 1), grid_pattern("extremes", (2, 3, 3, 2, 3), 2)):
    weights = np.random.default_rng(3).integers(-1500, 1501, 15).astype(np.int16)
    body = encode_with(weights, symbols)
    assert np.array_equal(decode_nodes(body, symbols.shape), symbols)
    print(hashlib.sha256(body).hexdigest())
"""


def test_compiled_code_and_plain_python_give_the_same_bytes():
    assert_same_without_numba(PLAIN, "kpc.format.coding.motion_raster:walk")


# --- damage and hostility


SHAPE = (4, 3, 4, 4, 3)


def decodes_or_is_refused(body: bytes, shape: tuple[int, ...] = SHAPE) -> bool:
    try:
        return decode_nodes(body, shape).shape == shape
    except FormatError:
        return False


def test_every_truncation_and_excess_is_refused():
    body = encode_nodes(swaying(*SHAPE[:4]))
    assert decodes_or_is_refused(body)
    assert not any(decodes_or_is_refused(body[:length]) for length in range(len(body)))
    assert not any(decodes_or_is_refused(body + more) for more in (b"\0", b"\0\0", b"\xff\xff"))


def test_flipped_bits_are_refused_or_mean_something_else():
    """Other weights, and other low bits of large errors, leave all else that is told as it is; a checksum is to tell them."""
    body, accepted = encode_nodes(swaying(*SHAPE[:4])), 0
    for position in range(8 * 2 * NEIGHBOURS, 8 * len(body)):
        damaged = bytearray(body)
        damaged[position >> 3] ^= 1 << (position & 7)
        accepted += decodes_or_is_refused(bytes(damaged))
    assert accepted <= 8 * len(body) // 16


@given(body=st.binary(max_size=80), shape=shapes)
@settings(deadline=None)
def test_any_bytes_decode_or_are_refused(body, shape):
    decodes_or_is_refused(body, shape)


def test_a_body_of_another_shape_is_refused():
    body = encode_nodes(swaying(*SHAPE[:4]))
    others = ((5, *SHAPE[1:]), (3, *SHAPE[1:]), (4, 4, 4, 3, 3), (1, 1, 1, 1, 3))
    assert not any(decodes_or_is_refused(body, other) for other in others)


def test_a_symbol_that_leaves_its_16_bits_is_refused():
    symbols = np.zeros((2, 2, 2, 2, 3), np.int32)
    symbols[0, 0, 0, 0, 0] = 40_000
    with pytest.raises(FormatError, match="16 bits"):
        decode_nodes(encode_with(LORENZO, symbols), symbols.shape)


def test_a_stream_that_ends_early_is_given_up_at_once():
    """Within a row of nodes of its end; all of these would take half a minute and more."""
    body = encode_nodes(grid_pattern("noise", (2, 2, 2, 8, 3), 0))
    start = time.perf_counter()
    with pytest.raises(FormatError, match="motion"):
        decode_nodes(body, (1000, 40, 100, 100, 3))
    assert time.perf_counter() - start < 2.0
