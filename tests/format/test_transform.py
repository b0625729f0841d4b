"""TRANSFORM in integers: near to exact cosines, the same comes back, and damage is refused."""

import importlib
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from codec_inputs import random_blocks
from core_decoders import decode_blocks, decode_symbols
from kpc.encoder.coding.predictive import encode_symbols
from kpc.encoder.coding.segments import choose_codec, encode_segment
from kpc.encoder.coding.transform import (
    DEFAULT_OFFSET,
    HEAD,
    LARGEST,
    SIDES,
    UNITS_PER_SYMBOL,
    TransformBlocks,
    dct_basis,
    decode_levels,
    encode_blocks,
    frequency_weights,
    largest_side,
    step_table,
)
from kpc.format.common.errors import FormatError
from kpc.format.container import segments
from kpc.format.container.container import Codec
from kpc.format.container.segments import WEIGHT_COUNT, PredictionWeights

SIZES = ((4, 1, 1), (4, 9, 30), (8, 4, 5), (8, 37, 50), (16, 20, 35), (16, 8, 8))


@pytest.fixture(scope="module")
def twin() -> ModuleType:
    """Return the readable decoder in spec/, with a function that decodes a segment under TRANSFORM."""
    return importlib.import_module("decoder.planes")


def float_symbols(blocks: TransformBlocks, coded: np.ndarray) -> np.ndarray:
    """What exact cosines make of levels, before they are rounded."""
    side, k = blocks.levels.shape[-1], np.arange(blocks.levels.shape[-1])
    basis = np.cos(np.pi * np.outer(k, 2 * k + 1) / (2 * side)) * np.sqrt(2 / side)
    basis[0] /= np.sqrt(2)
    factors = blocks.levels * step_table(side, blocks.quantiser)[blocks.step_offsets] / UNITS_PER_SYMBOL
    texels = basis.T @ factors @ basis
    down, across = blocks.step_offsets.shape
    whole = texels.transpose(1, 3, 2, 4, 0).reshape(down * side, across * side, -1)
    return np.where(coded[..., None], whole[: coded.shape[0], : coded.shape[1]], 0)


@pytest.mark.parametrize("side", SIDES)
def test_the_basis_is_nearly_orthogonal(side: int) -> None:
    rows = dct_basis(side) / (128 * np.sqrt(side))
    np.testing.assert_allclose(rows @ rows.T, np.eye(side), atol=0.01)
    assert (np.diff(frequency_weights(side)) >= 0).all() and frequency_weights(side)[0] == 52  # 64 / sqrt(1.5)


@pytest.mark.parametrize(("side", "rows", "columns"), SIZES)
@pytest.mark.parametrize("share", [0.0, 0.6, 1.0])
def test_blocks_come_back_and_are_near_to_exact_cosines(side: int, rows: int, columns: int, share: float) -> None:
    for seed in range(4):
        blocks, coded = random_blocks(side, rows, columns, share, seed)
        symbols, where = decode_blocks(encode_blocks(blocks, coded), rows, columns, 3)
        np.testing.assert_array_equal(where, coded)
        body = encode_blocks(blocks, coded)
        assert encode_blocks(decode_levels(body, rows, columns, 3), coded) == body
        exact = float_symbols(blocks, coded)
        # A rounded cosine errs by 1 / 256 of 1 at most, in each of two sums over levels; then half a symbol, and a 1
        # / 16 after the first sum.
        side_sum = (
            np.abs(blocks.levels * step_table(side, blocks.quantiser)[blocks.step_offsets] / UNITS_PER_SYMBOL)
            .sum((3, 4))
            .max(initial=0)
        )
        bound = 0.5 + 1 / 16 + 2 * side_sum * 2 / side * np.sqrt(2) / 256
        assert np.abs(np.clip(exact, -128, 127) - symbols).max(initial=0) <= bound
        assert not symbols[~coded].any()


@pytest.mark.parametrize(("side", "rows", "columns"), SIZES)
@pytest.mark.parametrize("share", [0.6, 1.0])
def test_the_readable_decoder_agrees(twin: ModuleType, side: int, rows: int, columns: int, share: float) -> None:
    for seed in range(3):
        blocks, coded = random_blocks(side, rows, columns, share, seed + 10)
        blocks.levels[0, 0, 0, -1, -1], blocks.levels[-1, -1, -1, 0, -1] = (
            -1,
            LARGEST,
        )  # the quickest alone, and the largest there is
        body = encode_blocks(blocks, coded)
        symbols, _ = decode_blocks(body, rows, columns, 3)
        content = SimpleNamespace(data=body, is_coded=True, raw_length=symbols.size, codec=Codec.TRANSFORM)
        plane = {"rows": rows, "columns": columns, "channels": 3}
        where, slow = twin.decode_segment(None, "xy", plane, 0, rows, content)
        assert all(where[index] == coded[index] for index in np.ndindex(coded.shape))
        assert all(slow.get(index, 0) == symbols[index] for index in np.ndindex(symbols.shape))


def test_the_largest_side_never_makes_much_more_of_a_segment_than_it_is() -> None:
    assert [largest_side(*size) for size in ((1, 900), (2, 2), (3, 9), (4, 4), (7, 50), (8, 8), (500, 500))] == [
        4,
        4,
        4,
        8,
        8,
        16,
        16,
    ]
    for rows in range(1, 40):
        for columns in range(1, 40):
            side = largest_side(rows, columns)
            padded = -(-rows // side) * side * -(-columns // side) * side
            assert padded <= 4 * rows * columns or side == 4


def test_flat_blocks_take_next_to_no_bytes() -> None:
    coded = np.ones((64, 64), bool)
    flat = TransformBlocks(np.zeros((8, 4, 4, 16, 16), np.int64), np.full((4, 4), DEFAULT_OFFSET), 64)
    flat.levels[..., 0, 0] = 5  # predicted from the second block on
    body = encode_blocks(flat, coded)
    assert len(body) < 60
    symbols, _ = decode_blocks(body, 64, 64, 8)
    assert len(np.unique(symbols)) == 1 and len(encode_symbols(symbols, coded)) < 60


def test_prediction_from_borders_saves_bits_on_a_smooth_plane(monkeypatch: pytest.MonkeyPatch) -> None:
    """The signs of noise cost a bit each; those of a smooth plane, which borders predict, cost less."""
    v, u = np.mgrid[:96, :96] / 16
    smooth = np.stack([60 * np.sin(1.3 * u + 0.7 * v + m) + 30 * np.cos(2.1 * v - u * m) for m in range(3)], axis=2)
    basis, sizes = dct_basis(8) / (128 * np.sqrt(8)), []
    factors = basis @ smooth.reshape(12, 8, 12, 8, 3).transpose(4, 0, 2, 1, 3) @ basis.T
    levels = np.rint(factors * UNITS_PER_SYMBOL / step_table(8, 48)[DEFAULT_OFFSET]).astype(np.int64)
    signs = np.random.default_rng(4).choice([-1, 1], levels.shape)
    signs[..., 0, 0] = 1
    for values in (levels, levels * signs):
        blocks = TransformBlocks(values, np.full((12, 12), DEFAULT_OFFSET), 48)
        sizes.append(len(encode_blocks(blocks, np.ones((96, 96), bool))))
    assert sizes[0] < 0.95 * sizes[1]


def test_an_implied_map_takes_no_bytes() -> None:
    blocks, coded = random_blocks(8, 37, 50, 0.6, 8)
    body, longer = encode_blocks(blocks, coded, coded), encode_blocks(blocks, coded)
    assert len(body) < len(longer) - 100
    np.testing.assert_array_equal(decode_blocks(body, 37, 50, 3, coded)[0], decode_blocks(longer, 37, 50, 3)[0])
    assert encode_segment(*decode_blocks(body, 37, 50, 3, coded), body, coded) == body
    with pytest.raises(FormatError, match="an occupancy that is not known"):
        decode_blocks(body, 37, 50, 3)
    other = encode_segment(*decode_blocks(body, 37, 50, 3, coded), body, ~coded)  # such side information is useless
    assert len(other) != len(body) and decode_symbols(other, 37, 50, 3)[1].any()


def test_truncated_and_longer_bodies_are_refused() -> None:
    blocks, coded = random_blocks(8, 20, 20, 1.0, 5)
    body = encode_blocks(blocks, coded)
    for cut in range(len(body)):
        with pytest.raises(FormatError, match=r"plane segment"):
            decode_blocks(body[:cut], 20, 20, 3)
    with pytest.raises(FormatError, match="do not end where they should"):
        decode_blocks(body + b"\0\0", 20, 20, 3)
    for at, value in ((0, 5), (0, 0), (2, 0)):
        with pytest.raises(FormatError, match="unknown side of blocks or flag, or a step of 0"):
            decode_blocks(body[:at] + bytes([value]) + body[at + 1 :], 20, 20, 3)
    with pytest.raises(FormatError, match="more than twice its 3 rows or columns"):
        decode_blocks(body, 3, 20, 3)


def test_no_body_makes_a_symbol_leave_its_eight_bits() -> None:
    """Levels, means and their sums are clamped."""
    rng = np.random.default_rng(8)
    read = 0
    for _ in range(300):
        blocks, coded = random_blocks(int(rng.choice(SIDES)), 17, 18, 1.0, int(rng.integers(1 << 30)))
        blocks.levels[:] = rng.integers(-LARGEST // 2, LARGEST // 2, blocks.levels.shape)
        body = encode_blocks(TransformBlocks(blocks.levels, blocks.step_offsets, 255), coded)
        symbols, _ = decode_blocks(body, 17, 18, 3)
        read += int(symbols.min() == -128 and symbols.max() == 127)
    assert read == 300


def test_side_information_is_used_only_for_its_own_symbols() -> None:
    blocks, coded = random_blocks(8, 20, 20, 0.8, 6)
    body = encode_blocks(blocks, coded)
    symbols, _ = decode_blocks(body, 20, 20, 3)
    assert encode_segment(symbols, coded, body) == body and segments.side_info_of(Codec.TRANSFORM, body) == body
    moved = symbols.copy()
    moved[tuple(np.argwhere(coded)[0])] ^= 1
    other = encode_segment(moved, coded, body)
    assert choose_codec(moved, coded, body, None)[0] == Codec.PREDICTIVE
    np.testing.assert_array_equal(decode_symbols(other, 20, 20, 3)[0], moved)


def test_side_information_of_segments_is_merged() -> None:
    blocks, coded = random_blocks(8, 20, 20, 0.8, 6)
    body = encode_blocks(blocks, coded)
    plane = segments.merge_side_info({0: body, 20: body})
    assert (
        isinstance(plane, segments.TransformSegments)
        and segments.side_info_at(plane, 20) == body
        and segments.side_info_at(plane, 3) is None
    )
    part = segments.merge_side_info({0: body, 20: None})  # of which one was smaller without
    assert (
        isinstance(part, segments.TransformSegments)
        and segments.side_info_at(part, 20) is None
        and segments.merge_side_info({0: None}) is None
    )
    one, other = (
        PredictionWeights(np.ones((1, WEIGHT_COUNT), np.int8)),
        PredictionWeights(np.zeros((1, WEIGHT_COUNT), np.int8)),
    )
    assert (
        segments.merge_side_info({0: one, 20: None, 30: one}) == one
        and segments.merge_side_info({0: one, 20: other}) is None
    )
    assert HEAD == 3
