"""The resolution controller with simulated devices, whose frame times follow from the number of pixels."""

import itertools
import math

import numpy as np
import pytest

from kpc.player.app.resolution_controller import ResolutionController


@pytest.mark.parametrize(("full_s", "low", "high"), [(1.0, 0.2, 0.32), (0.001, 1.0, 1.0), (100.0, 0.125, 0.15)])
def test_it_settles_where_frames_come_in_time(full_s: float, low: float, high: float) -> None:
    controller = ResolutionController(budget_s=1 / 15)
    for _ in range(40):
        controller.record(full_s * controller.scale**2)
    assert low <= controller.scale <= high


def test_it_uses_few_resolutions_and_is_stable_under_noise() -> None:
    rng, controller, scales = np.random.default_rng(0), ResolutionController(1 / 15), []
    for _ in range(500):
        controller.record(0.4 * controller.scale**2 * float(np.exp(rng.normal(0, 0.1))))
        scales.append(controller.scale)
    assert len(set(scales)) <= 5 and sum(a != b for a, b in itertools.pairwise(scales[50:])) <= 25
    controller.record(100.0)  # an outlier
    assert controller.scale > 0.55 * scales[-1]
    assert {round(4 * math.log2(scale), 9) % 1 for scale in scales} == {0.0}


@pytest.mark.parametrize(("fixed_s", "low", "high"), [(0.02, 0.34, 0.43), (0.05, 0.24, 0.5), (0.2, 0.35, 1.0)])
def test_it_does_not_lower_the_resolution_where_that_does_not_help(fixed_s: float, low: float, high: float) -> None:
    rng, controller, scales = np.random.default_rng(0), ResolutionController(1 / 15), []
    for _ in range(300):
        controller.record((fixed_s + 0.3 * controller.scale**2) * float(np.exp(rng.normal(0, 0.1))))
        scales.append(controller.scale)
    assert low <= np.median(scales[100:]) <= high and np.std(scales[100:]) < 0.2 * high


@pytest.mark.parametrize("whole", [1.0, 3.0, 5.0])
def test_frames_that_are_not_predicted_do_not_count(whole: float) -> None:
    """The first frame at a resolution, and one in forty, take `whole` times as long."""
    rng, controller, scales, raster = np.random.default_rng(0), ResolutionController.of(software=True), [], None
    for number in range(600):
        predicted = controller.scale == raster and number % 40
        scales.append(raster := controller.scale)
        controller.record(
            0.15 * controller.scale**2 * (1.0 if predicted else whole) * float(np.exp(rng.normal(0, 0.1)))
        )
    assert 0.55 < min(scales[100:]) and max(scales[100:]) < 0.8  # 1 / 15 s
    assert sum(a != b for a, b in itertools.pairwise(scales[100:])) <= 6


@pytest.mark.parametrize("slow", [2.0, 3.5, 6.0])
@pytest.mark.parametrize("pictures", [3, 5, 8, 12])
def test_a_slow_start_does_not_last(slow: float, pictures: int) -> None:
    """As while a scene is being read during the first frames."""
    controller, raster = ResolutionController.of(software=True), None
    for number in range(100):
        whole, raster = (1.0 if controller.scale == raster else 3.0), controller.scale
        controller.record((0.015 + 0.12 * controller.scale**2) * whole * (slow if number < pictures else 1.0))
    assert 0.55 < controller.scale < 0.75


@pytest.mark.parametrize("settled", [1, 2, 5, 50])
def test_it_reacts_to_slow_frames_soon(settled: int) -> None:
    """As where the camera begins to move and frames cannot be predicted, whether the resolution is new or not."""
    controller = ResolutionController(1 / 15, 0.5)
    for _ in range(settled):
        controller.record(0.05)
    scales = []
    for _ in range(12):
        controller.record(0.8 * controller.scale**2)
        scales.append(controller.scale)
    assert scales[0] == pytest.approx(0.5) and scales[2] < 0.49 and scales[-1] < 0.36


def test_a_processor_begins_at_a_low_resolution() -> None:
    assert ResolutionController.of(software=True).scale < 0.5 and ResolutionController.of(software=False).scale == 1.0
