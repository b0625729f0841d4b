"""OCCUPANCY: the same comes back, real grids shrink, and damage is refused."""

import time

import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st

from codec_inputs import rolling
from core_decoders import decode_occupancy
from kpc.encoder.coding.occupancy_codec import encode_occupancy
from kpc.format.common.errors import FormatError
from without_numba import assert_same_without_numba

shapes = st.tuples(*4 * [st.integers(1, 7)])


@given(shape=shapes, seed=st.integers(0, 2**32 - 1), share=st.sampled_from([0.0, 0.02, 0.5, 0.98, 1.0]))
@settings(deadline=None)
def test_cells_come_back(shape, seed, share):
    occupancy = np.random.default_rng(seed).random(shape) < share
    found = decode_occupancy(encode_occupancy(occupancy), shape)
    assert found.dtype == bool and found.shape == shape and np.array_equal(found, occupancy)


@pytest.mark.parametrize("axis", range(4))
@pytest.mark.parametrize("others", [1, 2])
def test_long_and_thin_grids_come_back(axis, others):
    shape = [others] * 4
    shape[axis] = 1000
    occupancy = np.random.default_rng(axis).random(shape) < 0.3
    assert np.array_equal(decode_occupancy(encode_occupancy(occupancy), tuple(shape)), occupancy)


def test_what_stays_and_hangs_together_takes_far_less_than_with_zstd():
    occupancy = rolling()
    packed = np.packbits(np.moveaxis(occupancy, 0, -1), bitorder="little").tobytes()
    assert len(encode_occupancy(occupancy)) < 0.7 * len(zstandard.ZstdCompressor(level=19).compress(packed))


def test_noise_takes_hardly_more_than_it_holds():
    noise = np.random.default_rng(0).random((4, 20, 20, 40)) < 0.5
    assert len(encode_occupancy(noise)) < 1.12 * noise.size / 8


def test_arrays_may_have_any_layout_and_are_left_as_they_are():
    occupancy = rolling(2, 5, 6, 7)
    across = np.asfortranarray(occupancy)
    occupancy.flags.writeable = across.flags.writeable = False
    assert encode_occupancy(across) == encode_occupancy(occupancy)


# The same lines, not compiled.
PLAIN = """
import hashlib
import numpy as np
from codec_inputs import rolling
from core_decoders import decode_occupancy
from kpc.encoder.coding.occupancy_codec import encode_occupancy

for occupancy in (rolling(3, 8, 9, 10), np.random.default_rng(1).random((2, 5, 1, 7)) < 0.5):
    body = encode_occupancy(occupancy)
    assert np.array_equal(decode_occupancy(body, occupancy.shape), occupancy)
    print(hashlib.sha256(body).hexdigest())
"""


def test_compiled_code_and_plain_python_give_the_same_bytes():
    assert_same_without_numba(PLAIN, "kpc.encoder.coding.occupancy_codec:code_cells")


# --- damage and hostility


SHAPE = (3, 8, 9, 10)


def decodes_or_is_refused(body: bytes, shape: tuple[int, ...] = SHAPE) -> bool:
    try:
        return decode_occupancy(body, shape).shape == shape
    except FormatError:
        return False


def test_every_truncation_and_excess_is_refused():
    body = encode_occupancy(rolling(*SHAPE))
    assert decodes_or_is_refused(body)
    assert not any(decodes_or_is_refused(body[:length]) for length in range(len(body)))
    assert not any(decodes_or_is_refused(body + more) for more in (b"\0", b"\0\0", b"\xff\xff"))


def test_flipped_bits_are_refused_or_mean_something_else():
    body, accepted = encode_occupancy(rolling(*SHAPE)), 0
    for position in range(8 * len(body)):
        damaged = bytearray(body)
        damaged[position >> 3] ^= 1 << (position & 7)
        accepted += decodes_or_is_refused(bytes(damaged))
    assert accepted <= len(body) // 100


@given(body=st.binary(max_size=60), shape=shapes)
@settings(deadline=None)
def test_any_bytes_decode_or_are_refused(body, shape):
    decodes_or_is_refused(body, shape)


def test_a_body_of_another_shape_is_refused():
    body = encode_occupancy(rolling(*SHAPE))
    assert not any(
        decodes_or_is_refused(body, other) for other in ((4, 8, 9, 10), (2, 8, 9, 10), (3, 8, 9, 11), (1, 1, 1, 1))
    )


def test_a_stream_that_ends_early_is_given_up_at_once():
    """Within a row of its end; all of these cells would take a minute and more."""
    body = encode_occupancy(np.random.default_rng(0).random((1, 1, 1, 500)) < 0.5)
    start = time.perf_counter()
    with pytest.raises(FormatError, match="do not end"):
        decode_occupancy(body, (4096, 100, 100, 100))
    assert time.perf_counter() - start < 2.0
