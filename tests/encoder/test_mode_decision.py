"""Planes on the trellis or in blocks: what costs less, of which nobody needs to know anything."""

from dataclasses import replace

import numpy as np
import pytest
from kpc.encoder.rdo import dct_rdo as search
from kpc.encoder.rdo import mode_decision
from kpc.encoder.rdo.distortion import NO_CORRELATION, total_distortion
from kpc.encoder.rdo.mode_decision import quantise_by_cost, requested_step
from kpc.encoder.rdo.trellis import LOW_RATE_BITS, trellis_quantise
from kpc.format.coding.predictive import PredictionWeights
from kpc.format.coding.quantise import QuantisedPlane, quantise_plane
from kpc.format.coding.transform import DEFAULT_OFFSET, OFFSET_COUNT
from kpc.format.container import scene_io
from kpc.format.container.segments import TransformSegments
from scenes import tiny_scene
from test_trellis import waves


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
    found = search.transform_quantise(rounded, values, steps, significant, identity, NO_CORRELATION, side)
    assert found is not None
    return found


@pytest.mark.parametrize("step", [1.0, 2.0, 4.0])
def test_what_hardly_changes_costs_less_in_blocks(step: float) -> None:
    """Errors, as pictures see them, and what bits are worth; the more so, the less is told."""
    values, steps, alike = waves(3), np.full(3, step), np.ones((60, 70, 3), np.float32)
    told, size = in_blocks(values, step)
    steered = trellis_quantise(quantise_plane(values, steps, identity=False), values, steps, alike, False)

    def in_all(plane: QuantisedPlane, size_bytes: int) -> float:
        return (
            total_distortion((plane.dequantise() - values) / np.float32(step), NO_CORRELATION)
            + mode_decision.DECISION_LAM * 8 * size_bytes
        )

    gain = in_all(steered, mode_decision._size(steered, False, np.ones((60, 70), bool))) / in_all(told, size)
    assert gain > {1.0: 0.9, 2.0: 1.0, 4.0: 1.1}[step]


def test_a_time_plane_that_is_nearly_1_is_told_without_a_map_and_is_1_where_nothing_changes() -> None:
    v, u = np.mgrid[:48, :96]
    swell = np.exp(-((u - 24) ** 2 + (v - 20) ** 2) / 120)[..., None] * np.array([4.0, -3.0, 2.0])
    values, steps, everywhere = (1 + swell).astype(np.float32), np.full(3, 1.0), np.ones((48, 96), bool)
    rounded = quantise_plane(values, steps, identity=True)
    found = mode_decision._cheapest(
        rounded, values, steps, np.ones_like(values), True, NO_CORRELATION, LOW_RATE_BITS, everywhere, everywhere
    )
    assert isinstance(found.side_info, TransformSegments) and found.coded.all()
    assert (found.dequantise()[:, 64:] == 1).all()
    mapped = in_blocks(values, 1.0, identity=True, side=16)[0]
    assert (
        not mapped.coded.all()
        and np.square(found.dequantise() - values).sum() < 0.7 * np.square(mapped.dequantise() - values).sum()
    )
    assert mode_decision._size(found, True, everywhere) < mode_decision._size(mapped, True, everywhere)


def test_what_nobody_needs_changes_nothing() -> None:
    values, rng = waves(4), np.random.default_rng(1)
    needed = np.zeros((60, 70), bool)
    needed[10:45, 7:60] = rng.random((35, 53)) < 0.7
    painted = np.where(needed[..., None], values, rng.normal(0, 100, values.shape)).astype(np.float32)
    one, other = in_blocks(values, 2.0, needed=needed)[0], in_blocks(painted, 2.0, needed=needed)[0]
    np.testing.assert_array_equal(one.symbols, other.symbols)
    np.testing.assert_array_equal(one.coded, needed)
    assert not one.symbols[~needed].any()


def test_errors_are_smaller_where_they_are_worth_more() -> None:
    values, significant = waves(5, 64, 64), np.ones((64, 64, 3), np.float32)
    significant[:, 32:] = 30
    plane, size = in_blocks(values, 2.0, significant)
    alike, as_ever = in_blocks(values, 2.0)

    def error(plane: QuantisedPlane, half: slice) -> float:
        return float(np.square(plane.dequantise() - values)[:, half].mean())

    assert (
        error(plane, slice(32, None)) < 1.05 * error(alike, slice(32, None)) < 0.7 * error(plane, slice(0, 32))
        and size < 0.9 * as_ever
    )
    told = search._quantiser_offsets(significant, np.ones((64, 64), bool), np.ones((8, 8), bool), 8)
    assert (told[:, 4:] > told[:, :4]).all() and told.min() >= 0 and told.max() < OFFSET_COUNT
    assert (
        search._quantiser_offsets(np.ones_like(significant), np.ones((64, 64), bool), np.ones((8, 8), bool), 8)
        == DEFAULT_OFFSET
    ).all()


def test_time_planes_are_told_by_segments_and_the_identity_stays() -> None:
    values = np.ones((96, 40, 3), np.float32)
    values[:64, 20:] += waves(6, 64, 20) / 10
    plane, size = in_blocks(values, 0.5, identity=True)
    assert isinstance(plane.side_info, TransformSegments) and sorted(plane.side_info.segments) == [0, 32, 64]
    assert (
        size == sum(map(len, plane.side_info.segments.values())) and len(plane.side_info.segments[64]) < 20
    )  # nothing to tell
    assert (
        (plane.dequantise()[:, :20] == 1).all() and not plane.coded[:, :20].any() and plane.coded[:64, 20:].mean() > 0.5
    )


def test_levels_are_near_to_the_best_ones() -> None:
    """Where all is worth the same, cosines are orthogonal: no level is more than one from the plane's own factor, and errors no more than that."""
    values = waves(7, 64, 64)
    plane, _ = in_blocks(values, 1.0)
    quantiser = 1.0 * search.STEPS_PER_QUANTISER
    assert np.sqrt(np.square(plane.dequantise() - values).mean()) < quantiser / 2
    assert np.abs(plane.dequantise() - values).max() < 4 * quantiser


def test_where_eight_bits_are_too_few_there_are_no_blocks() -> None:
    values, steps = waves(8), np.full(3, 0.01)
    assert (
        search.transform_quantise(
            quantise_plane(values, steps, identity=False), values, steps, np.ones_like(values), False, NO_CORRELATION, 8
        )
        is None
    )
    nothing = np.ones((9, 9, 2), np.float32)
    assert (
        search.transform_quantise(
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


def test_files_keep_what_is_told_and_say_for_which_steps() -> None:
    scene = tiny_scene(3, resolution=(40, 36, 32), time=34)
    steps = [
        {name: np.full(plane.shape[2], 0.4, np.float32) for name, plane in scale.items()} for scale in scene.scales
    ]
    quantised = quantise_by_cost(scene, steps)
    kinds = {type(plane.side_info) for scale in quantised.scales for plane in scale.values()}
    assert TransformSegments in kinds
    data = scene_io.encode(quantised)
    back = scene_io.read(data)
    assert scene_io.encode(back) == data
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
    assert len(scene_io.encode(forgotten)) > len(data)
    assert (
        scene_io.read(scene_io.encode(forgotten)).scales[0]["xy"].symbols.tobytes()
        == back.scales[0]["xy"].symbols.tobytes()
    )
    without = quantise_by_cost(scene, steps, blocks=False)
    assert {type(plane.side_info) for scale in without.scales for plane in scale.values()} <= {
        PredictionWeights,
        type(None),
    }
