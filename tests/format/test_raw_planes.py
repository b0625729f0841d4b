"""The content of plane segments under RAW: the same comes back, and damage is refused."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from core_decoders import decode_raw_segment
from kpc.encoder.coding.raw_planes import encode_raw_segment
from kpc.format.common.errors import FormatError

shapes = st.tuples(st.integers(1, 9), st.integers(1, 9), st.integers(1, 4))


@given(shape=shapes, seed=st.integers(0, 2**32 - 1), share=st.sampled_from([0.0, 0.3, 0.8, 1.0]))
def test_symbols_come_back(shape, seed, share):
    rng = np.random.default_rng(seed)
    symbols = rng.integers(-128, 128, shape)
    symbols = symbols.astype(np.int8)
    coded = rng.random(shape[:2]) < share
    symbols[~coded] = 0
    decoded, where = decode_raw_segment(encode_raw_segment(symbols, coded), *shape)
    assert decoded.dtype == np.int8 and np.array_equal(decoded, symbols)
    assert where.dtype == bool and np.array_equal(where, coded)


def test_symbols_lie_channel_by_channel_behind_the_map():
    symbols = np.int8([[[1, -1], [2, -2]], [[0, 0], [4, -4]]])
    coded = np.array([[True, True], [False, True]])
    payload = encode_raw_segment(symbols, coded)
    assert payload == bytes([1, 0b1011]) + np.int8([1, 2, 4, -1, -2, -4]).tobytes()
    assert encode_raw_segment(symbols, coded | True) == b"\0" + np.int8([1, 2, 0, 4, -1, -2, 0, -4]).tobytes()


def test_uncoded_texels_cost_their_map_and_nothing_else():
    symbols = np.zeros((16, 200, 8), np.int8)
    assert len(encode_raw_segment(symbols, np.zeros((16, 200), bool))) == 1 + 16 * 200 // 8
    assert len(encode_raw_segment(symbols, np.ones((16, 200), bool))) == 1 + 16 * 200 * 8


@given(payload=st.binary(max_size=64), shape=shapes)
def test_any_bytes_decode_or_are_refused(payload, shape):
    try:
        symbols, coded = decode_raw_segment(payload, *shape)
    except FormatError:
        return
    assert symbols.shape == shape and not symbols[~coded].any()


@pytest.mark.parametrize(
    "payload, complaint",
    [
        (b"", "map mode"),
        (b"\2" + bytes(9), "map mode"),
        (b"\1", "too short for its map"),
        (b"\1\xf0" + bytes(9), "unused bits"),
        (b"\1\x0f", "its map implies"),
        (b"\0\0\0\0", "its map implies"),
        (b"\0\0\0\0\0\0", "its map implies"),
    ],
)
def test_what_is_wrong_is_said(payload, complaint):
    with pytest.raises(FormatError, match=complaint):
        decode_raw_segment(payload, 2, 2, 1)
