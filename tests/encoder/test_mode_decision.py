"""Mode decision between the trellis and transform blocks, and quantisation in transform blocks."""

from dataclasses import replace

import numpy as np
import pytest
from test_trellis import waves

from kpc.encoder.coding import scene_writer
from kpc.encoder.coding.transform import DEFAULT_OFFSET, OFFSET_COUNT
from kpc.encoder.rdo import dct_rdo, mode_decision
from kpc.encoder.rdo.distortion import NO_CORRELATION, total_distortion
from kpc.encoder.rdo.mode_decision import quantise_by_cost, requested_step
from kpc.encoder.rdo.trellis import LOW_RATE_BITS, trellis_quantise
from kpc.format.coding.quantise import QuantisedPlane, quantise_plane
from kpc.format.container import scene_io
from kpc.format.container.segments import PredictionWeights, TransformSegments
from scenes import tiny_scene


def in_blocks(
    values: np.ndarray,
    step: float,
    significant: np.ndarray | None = None,
    needed: np.ndarray | None = None,
    identity: bool = False,
    side: int = 8,
) -> tuple[QuantisedPlane, int]:
    steps = np.full(values.shape[2], step)
    rounded = quantise_plane(values, steps, identity=identity, needed=needed)
    significant = np.ones_like(values) if significant is None else significant
    found = dct_rdo.transform_quantise(rounded, values, steps, significant, identity, NO_CORRELATION, side)
    assert found is not None
    return found


@pytest.mark.parametrize("step", [1.0, 2.0, 4.0])
def test_transform_blocks_cost_less_at_coarse_steps(step: float) -> None:
    """The Lagrangian cost of transform blocks, relative to that of the trellis, falls as the step grows."""
    values, steps, equal = waves(3), np.full(3, step), np.ones((60, 70, 3), np.float32)
    coded, size = in_blocks(values, step)
    on_trellis = trellis_quantise(quantise_plane(values, steps, identity=False), values, steps, equal, False)

    def cost_of(plane: QuantisedPlane, size_bytes: int) -> float:
        return (
            total_distortion((plane.dequantise() - values) / np.float32(step), NO_CORRELATION)
            + mode_decision.DECISION_LAM * 8 * size_bytes
        )

    gain = cost_of(on_trellis, mode_decision.coded_size(on_trellis, False, np.ones((60, 70), bool))) / cost_of(
        coded, size
    )
    assert gain > {1.0: 0.9, 2.0: 1.0, 4.0: 1.1}[step]


def test_a_time_plane_close_to_identity_needs_no_significance_map() -> None:
    v, u = np.mgrid[:48, :96]
    swell = np.exp(-((u - 24) ** 2 + (v - 20) ** 2) / 120)[..., None] * np.array([4.0, -3.0, 2.0])
    values, steps, everywhere = (1 + swell).astype(np.float32), np.full(3, 1.0), np.ones((48, 96), bool)
    rounded = quantise_plane(values, steps, identity=True)
    plane = mode_decision.Plane(rounded, values, steps, np.ones_like(values), True, NO_CORRELATION, LOW_RATE_BITS)
    found = mode_decision.cheapest_mode(plane, everywhere, everywhere)
    assert isinstance(found.side_info, TransformSegments) and found.coded.all()
    assert (found.dequantise()[:, 64:] == 1).all()
    mapped = in_blocks(values, 1.0, identity=True, side=16)[0]
    assert (
        not mapped.coded.all()
        and np.square(found.dequantise() - values).sum() < 0.7 * np.square(mapped.dequantise() - values).sum()
    )
    assert mode_decision.coded_size(found, True, everywhere) < mode_decision.coded_size(mapped, True, everywhere)


def test_texels_that_are_not_looked_up_do_not_matter() -> None:
    values, rng = waves(4), np.random.default_rng(1)
    needed = np.zeros((60, 70), bool)
    needed[10:45, 7:60] = rng.random((35, 53)) < 0.7
    painted = np.where(needed[..., None], values, rng.normal(0, 100, values.shape)).astype(np.float32)
    one, other = in_blocks(values, 2.0, needed=needed)[0], in_blocks(painted, 2.0, needed=needed)[0]
    np.testing.assert_array_equal(one.symbols, other.symbols)
    np.testing.assert_array_equal(one.coded, needed)
    assert not one.symbols[~needed].any()


def test_errors_are_smaller_where_distortion_weights_are_larger() -> None:
    values, significant = waves(5, 64, 64), np.ones((64, 64, 3), np.float32)
    significant[:, 32:] = 30
    plane, size = in_blocks(values, 2.0, significant)
    equal, as_ever = in_blocks(values, 2.0)

    def error(plane: QuantisedPlane, half: slice) -> float:
        return float(np.square(plane.dequantise() - values)[:, half].mean())

    assert (
        error(plane, slice(32, None)) < 1.05 * error(equal, slice(32, None)) < 0.7 * error(plane, slice(0, 32))
        and size < 0.9 * as_ever
    )
    offsets = dct_rdo.quantiser_offsets(significant, np.ones((64, 64), bool), np.ones((8, 8), bool), 8)
    assert (offsets[:, 4:] > offsets[:, :4]).all() and offsets.min() >= 0 and offsets.max() < OFFSET_COUNT
    assert (
        dct_rdo.quantiser_offsets(np.ones_like(significant), np.ones((64, 64), bool), np.ones((8, 8), bool), 8)
        == DEFAULT_OFFSET
    ).all()


def test_time_planes_are_coded_in_segments_and_identity_is_kept() -> None:
    values = np.ones((96, 40, 3), np.float32)
    values[:64, 20:] += waves(6, 64, 20) / 10
    plane, size = in_blocks(values, 0.5, identity=True)
    assert isinstance(plane.side_info, TransformSegments) and sorted(plane.side_info.segments) == [0, 32, 64]
    assert (
        size == sum(map(len, plane.side_info.segments.values())) and len(plane.side_info.segments[64]) < 20
    )  # all of it is the identity
    assert (
        (plane.dequantise()[:, :20] == 1).all() and not plane.coded[:, :20].any() and plane.coded[:64, 20:].mean() > 0.5
    )


def test_levels_are_close_to_the_nearest() -> None:
    """Basis functions are orthogonal where all weights are equal, so that errors stay small."""
    values = waves(7, 64, 64)
    plane, _ = in_blocks(values, 1.0)
    quantiser = 1.0 * dct_rdo.STEPS_PER_QUANTISER
    assert np.sqrt(np.square(plane.dequantise() - values).mean()) < quantiser / 2
    assert np.abs(plane.dequantise() - values).max() < 4 * quantiser


def test_no_transform_blocks_where_eight_bits_are_too_few() -> None:
    values, steps = waves(8), np.full(3, 0.01)
    assert (
        dct_rdo.transform_quantise(
            quantise_plane(values, steps, identity=False), values, steps, np.ones_like(values), False, NO_CORRELATION, 8
        )
        is None
    )
    nothing = np.ones((9, 9, 2), np.float32)
    assert (
        dct_rdo.transform_quantise(
            quantise_plane(nothing, np.full(2, 0.1), identity=True),
            nothing,
            np.full(2, 0.1),
            nothing,
            True,
            NO_CORRELATION,
            8,
        )
        is None
    )


def test_files_keep_symbols_and_requested_steps() -> None:
    scene = tiny_scene(3, resolution=(40, 36, 32), time=34)
    steps = [
        {name: np.full(plane.shape[2], 0.4, np.float32) for name, plane in scale.items()} for scale in scene.scales
    ]
    quantised = quantise_by_cost(scene, steps)
    kinds = {type(plane.side_info) for scale in quantised.scales for plane in scale.values()}
    assert TransformSegments in kinds
    data = scene_writer.encode(quantised)
    back = scene_io.read(data)
    assert scene_writer.encode(back) == data
    for ours, theirs in zip(back.scales, quantised.scales, strict=True):
        for name in ours:
            np.testing.assert_array_equal(ours[name].symbols, theirs[name].symbols)
            np.testing.assert_array_equal(ours[name].coded, theirs[name].coded)
            if isinstance(ours[name].side_info, TransformSegments):
                np.testing.assert_allclose(requested_step(ours[name]), 0.4, rtol=2**-7)
    forgotten = replace(
        back,
        scales=tuple({name: replace(plane, side_info=None) for name, plane in scale.items()} for scale in back.scales),
    )
    assert len(scene_writer.encode(forgotten)) > len(data)
    assert (
        scene_io.read(scene_writer.encode(forgotten)).scales[0]["xy"].symbols.tobytes()
        == back.scales[0]["xy"].symbols.tobytes()
    )
    without = quantise_by_cost(scene, steps, block_sides=())
    assert {type(plane.side_info) for scale in without.scales for plane in scale.values()} <= {
        PredictionWeights,
        type(None),
    }
