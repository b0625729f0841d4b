"""Quantisation as coarse as a bound on the loss allows."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scenes import tiny_scene

from kpc.encoder.compress import compress, compress_to_size, relative_steps, scaled
from kpc.encoder.field import Field
from kpc.format import file
from kpc.format.quantise import QuantisedScene
from kpc.format.scene import Scene

SCENE = replace(tiny_scene(), occupancy=np.ones((1, 2, 2, 2), bool))  # every texel is needed
EQUAL = [{name: np.ones(plane.shape[2]) for name, plane in scale.items()} for scale in SCENE.scales]


def fidelity(scene: Scene) -> float:
    """A stand-in for the PSNR of pictures: noise of 1e-3, and what the planes err."""
    error = np.mean(
        [
            np.square(ours[name] - theirs[name]).mean()
            for ours, theirs in zip(scene.scales, SCENE.scales)
            for name in ours
        ]
    )
    return -10 * math.log10(1e-3 + float(error))


def size(scene: QuantisedScene) -> int:
    return len(file.encode(scene))


@pytest.mark.parametrize("most", [0.02, 0.15, 1.0])
def test_the_loss_is_bounded_and_reported(most: float) -> None:
    quantised, loss = compress(SCENE, EQUAL, fidelity, most)
    assert loss <= most
    assert loss == pytest.approx(fidelity(SCENE) - fidelity(quantised.dequantise()), abs=1e-9)


def test_more_loss_gives_a_smaller_file() -> None:
    sizes = [size(compress(SCENE, EQUAL, fidelity, most)[0]) for most in (0.02, 0.15, 1.0, 10.0)]
    assert sizes == sorted(sizes, reverse=True) and sizes[-1] < 0.7 * sizes[0]


def test_the_bound_is_used() -> None:
    """Seven bisections of 14 octaves leave 2^0.11: the loss reached is within that step of the bound, squared."""
    _, loss = compress(SCENE, EQUAL, fidelity, 0.15)
    assert 0.15 * 2 ** (-2 * 14 / 2**7) * 0.8 < loss <= 0.15


def test_where_nothing_is_good_enough_the_finest_is_taken() -> None:
    finest, loss = compress(SCENE, EQUAL, fidelity, -1.0)
    assert -1.0 < loss < 0.1
    fine, _ = compress(SCENE, EQUAL, fidelity, 0.02)
    assert size(finest) >= size(fine)


def test_a_target_is_met_from_below_and_nearly() -> None:
    """Steps 2^0.11 apart, the last of seven bisections, change the size by some tenths of a bit a symbol at most."""
    largest, smallest = (size(compress(SCENE, EQUAL, fidelity, most)[0]) for most in (-1.0, 1e9))
    for share in (0.1, 0.5, 0.9):
        target = int(smallest + share * (largest - smallest))
        found = size(compress_to_size(SCENE, EQUAL, target, size))
        assert 0.85 * target < found <= target, (share, target, found)


def test_a_target_that_is_too_small_gets_the_coarsest() -> None:
    smallest = size(compress(SCENE, EQUAL, fidelity, 1e9)[0])
    assert size(compress_to_size(SCENE, EQUAL, 10, size)) == pytest.approx(smallest, rel=0.02)


def test_a_psnr_that_is_not_a_number_does_not_pass() -> None:
    seen = []

    def broken(scene: Scene) -> float:
        seen.append(scene)
        return fidelity(scene) if len(seen) < 3 else math.nan

    quantised, loss = compress(SCENE, EQUAL, broken, 0.15)
    assert math.isfinite(loss) and size(quantised) > 0


def test_steps_follow_the_curvature() -> None:
    field = Field.from_scene(SCENE)
    M = field.layout.channels
    curvature = np.zeros(field.layout.size, np.float32)
    h = {}
    for k, (s, name, start, rows, columns) in enumerate(field.layout.planes()):
        h[s, name] = 4.0**-k * np.arange(1, M + 1)
        curvature[start : start + rows * columns * M] = np.tile(h[s, name], rows * columns)
    steps = relative_steps(field, curvature)
    products = [h[s, name] * steps[s][name] ** 2 for s, name in h if h[s, name].min() > 8 * 1e-8]
    np.testing.assert_allclose(products, h[0, "xy"].max(), rtol=1e-5)  # h d^2 is the same everywhere
    assert steps[0]["xy"].min() == 1.0


def test_channels_that_no_gradient_reached_get_the_coarsest_step() -> None:
    field = Field.from_scene(SCENE)
    curvature = np.ones(field.layout.size, np.float32)
    curvature.reshape(-1, field.layout.channels)[:, 2] = 0
    for scale in relative_steps(field, curvature):
        for step in scale.values():
            assert step[2] == pytest.approx(1e4) and (np.delete(step, 2) == 1).all()


def test_without_any_curvature_all_steps_are_equal() -> None:
    field = Field.from_scene(SCENE)
    for scale in relative_steps(field, np.zeros(field.layout.size, np.float32)):
        assert all((step == 1).all() for step in scale.values())


def test_scaled() -> None:
    out = scaled([{"xy": np.array([1.0, 2.0])}], 0.25)
    assert out[0]["xy"].dtype == np.float32
    np.testing.assert_array_equal(out[0]["xy"], [0.25, 0.5])
