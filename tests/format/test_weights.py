"""Weights of decoders under WEIGHTS: the same comes back, in fewer bytes than float16 or zstd
takes, and damage is refused.
"""

import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st

from core_decoders import decode_weights
from kpc.encoder.coding.weights import COARSEST, LARGEST, encode_weights
from kpc.format.coding.quantise import FINEST, decoder_arrays, round_decoder
from kpc.format.common.errors import FormatError
from scenes import tiny_scene
from without_numba import assert_same_without_numba

# The fields of DECO: density_weight, w1, b1, w2 and b2.
SHAPES = [(5,), (2, 9), (2,), (3, 5, 2), (3, 5)]


def some(seed: int, largest: int = 60, power: int = -5, shapes: list[tuple[int, ...]] = SHAPES) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [(np.rint(rng.normal(0, largest / 3, shape)).clip(-largest, largest)
             * 2.0 ** (power - number)).astype(np.float32)
            for number, shape in enumerate(shapes)]  # fmt: skip


def encoded(arrays: list[np.ndarray]) -> bytes:
    body = encode_weights(arrays)
    assert body is not None
    return body


def assert_decodes(body: bytes, arrays: list[np.ndarray]) -> None:
    found = decode_weights(body, [array.shape for array in arrays])
    for one, other in zip(found, arrays, strict=True):
        assert one.dtype == np.float32 and np.array_equal(one, other)


def decodes_or_is_refused(body: bytes, shapes: list[tuple[int, ...]] = SHAPES) -> bool:
    try:
        decode_weights(body, shapes)
    except FormatError:
        return False
    return True


@given(seed=st.integers(0, 2**32 - 1), largest=st.integers(1, LARGEST), power=st.integers(FINEST + 4, 4))
@settings(deadline=None)
def test_weights_come_back(seed: int, largest: int, power: int) -> None:
    arrays = some(seed, largest, power)
    assert_decodes(encoded(arrays), arrays)


def test_the_ends_of_float16_come_back() -> None:
    least = np.float32(0.5**24)
    arrays = [
        np.float32([2.0**15]),
        np.float32([[65504, -65504, 32, 0, 0, 0, 0, 0, 0]]),
        np.zeros(1, np.float32),
        least * np.float32([[[1]], [[-2048]], [[3]]]),
        np.zeros((3, 1), np.float32),
    ]
    body = encoded(arrays)
    assert_decodes(body, arrays)
    assert np.frombuffer(body[:5], np.int8).tolist() == [COARSEST, 5, 0, FINEST, 0]


def test_what_has_too_many_digits_is_left_to_other_codecs() -> None:
    assert encode_weights([np.float32([1, 0.5**12])]) is None
    assert encode_weights([np.float32([1, 0.5**11])]) is not None


def test_weights_of_a_decoder_take_fewer_bytes_than_zstd_makes_of_them() -> None:
    """At the errors that rounding each to so many significant bits makes, which is best for zstd."""
    decoder = tiny_scene(6, channels=24).decoder
    arrays = list(decoder_arrays(round_decoder(decoder, dict.fromkeys(decoder_arrays(decoder), 6))).values())
    halves = b"".join(values.astype("<f2").tobytes() for values in arrays)
    assert len(encoded(arrays)) < 0.8 * len(zstandard.ZstdCompressor(level=19).compress(halves)) < 0.9 * len(halves)


def test_plain_python_codes_the_same() -> None:
    assert_same_without_numba(
        "from test_weights import encoded, some\n"
        "for seed in range(3):\n"
        "    print(encoded(some(seed, 60 * 6 ** seed)).hex())",
        "kpc.encoder.coding.weights:code_array",
    )


def test_every_truncation_is_refused_and_every_flipped_bit_decodes_or_is() -> None:
    body = encoded(some(1))
    assert decodes_or_is_refused(body)
    assert not any(decodes_or_is_refused(body[:length]) for length in range(len(body)))
    assert not any(decodes_or_is_refused(body + more) for more in (b"\0", b"\0\0", b"\xff\xff"))
    for bit in range(8 * len(body)):
        flipped = bytearray(body)
        flipped[bit // 8] ^= 1 << bit % 8
        decodes_or_is_refused(bytes(flipped))


@given(body=st.binary(max_size=80))
@settings(deadline=None)
def test_any_bytes_decode_or_are_refused(body: bytes) -> None:
    decodes_or_is_refused(body)


def test_what_is_no_number_of_float16_is_refused() -> None:
    shapes = [(1,), (1, 9), (1,), (3, 1, 1), (3, 1)]
    body = encoded([np.full(shape, 2047 if shape == (1,) else 1, np.float32) for shape in shapes])
    for power, message in (
        (FINEST - 1, "power of two"),
        (COARSEST + 1, "power of two"),
        (COARSEST, "no number of float16"),
    ):
        with pytest.raises(FormatError, match=message):
            decode_weights(np.int8([power]).tobytes() + body[1:], shapes)
