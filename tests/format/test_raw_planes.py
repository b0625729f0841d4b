import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from kpc.format.coding.raw_planes import (
    FILTER_LEFT,
    FILTER_NONE,
    FILTER_PLANE,
    FILTER_UP,
    decode_raw_segment,
    encode_raw_segment,
)
from kpc.format.common.errors import FormatError

shapes = st.tuples(st.integers(1, 9), st.integers(1, 9), st.integers(1, 4))


def packed(symbols: np.ndarray, coded: np.ndarray) -> bytes:
    return b"".join(encode_raw_segment(symbols, coded))


@given(shape=shapes, seed=st.integers(0, 2**32 - 1), share=st.sampled_from([0.0, 0.3, 0.8, 1.0]), smooth=st.booleans())
def test_symbols_come_back(shape, seed, share, smooth):
    rng = np.random.default_rng(seed)
    symbols = rng.integers(-128, 128, shape)
    if smooth:  # sums that wrap, so that the filters are worth choosing
        symbols = (symbols % 7).cumsum(0).cumsum(1)
    symbols = symbols.astype(np.int8)
    coded = rng.random(shape[:2]) < share
    symbols[~coded] = 0
    decoded, where = decode_raw_segment(packed(symbols, coded), *shape)
    assert decoded.dtype == np.int8 and np.array_equal(decoded, symbols)
    assert where.dtype == bool and np.array_equal(where, coded)


def test_decoding_is_what_the_spec_says_texel_by_texel():
    """Section 6, in loops."""
    rng = np.random.default_rng(3)
    rows, columns, channels = 6, 7, 4
    coded = rng.random((rows, columns)) < 0.6
    residuals = rng.integers(0, 256, (channels, coded.sum())).astype(np.uint8)
    payload = b"\1" + np.packbits(coded, bitorder="little").tobytes() + bytes([0, 1, 2, 3]) + residuals.tobytes()
    expected = np.zeros((rows, columns, channels), np.int8)
    for c in range(channels):
        v = np.zeros((rows + 1, columns + 1), int)
        waiting = iter(residuals[c])
        for y in range(rows):
            for x in range(columns):
                left, up, corner = v[y + 1, x], v[y, x + 1], v[y, x]
                r = int(next(waiting)) if coded[y, x] else 0
                v[y + 1, x + 1] = (r + [0, left, up, left + up - corner][c]) % 256
                if coded[y, x]:
                    expected[y, x, c] = v[y + 1, x + 1] - 256 * (v[y + 1, x + 1] > 127)
    assert np.array_equal(decode_raw_segment(payload, rows, columns, channels)[0], expected)


def test_the_filter_fits_the_channel():
    rng = np.random.default_rng(0)
    across, down = rng.integers(-60, 60, (1, 32)), rng.integers(-60, 60, (32, 1))
    symbols = np.stack([0 * across + down, across + 0 * down, across + down, rng.integers(-2, 2, (32, 32))], axis=2)
    header, *residuals = encode_raw_segment(symbols.astype(np.int8), np.ones((32, 32), bool))
    assert list(header[1:]) == [FILTER_LEFT, FILTER_UP, FILTER_PLANE, FILTER_NONE]
    assert len(residuals) == 4
    assert np.count_nonzero(np.frombuffer(residuals[2], np.uint8)) <= 63  # its borders, no more


def test_uncoded_texels_cost_their_map_and_nothing_else():
    symbols = np.zeros((16, 200, 8), np.int8)
    assert len(packed(symbols, np.zeros((16, 200), bool))) == 1 + 16 * 200 // 8 + 8
    assert len(packed(symbols, np.ones((16, 200), bool))) == 1 + 8 + 16 * 200 * 8


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
        (b"", "map flag"),
        (b"\2" + bytes(9), "map flag"),
        (b"\1", "too short for its map"),
        (b"\1\xf0" + bytes(9), "unused bits"),
        (b"\1\x0f", "its map implies"),
        (b"\0\4\0\0\0\0", "filter 4"),
        (b"\0\0\0\0\0", "its map implies"),
        (b"\0\0\0\0\0\0\0", "its map implies"),
    ],
)
def test_what_is_wrong_is_said(payload, complaint):
    with pytest.raises(FormatError, match=complaint):
        decode_raw_segment(payload, 2, 2, 1)
