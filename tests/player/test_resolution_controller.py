import math

import numpy as np
import pytest
from kpc.player.app.resolution_controller import ResolutionController


@pytest.mark.parametrize(("full_s", "low", "high"), [(1.0, 0.2, 0.32), (0.001, 1.0, 1.0), (100.0, 0.125, 0.15)])
def test_the_pace_settles_where_pictures_come_in_time(full_s: float, low: float, high: float) -> None:
    pace = ResolutionController(budget_s=1 / 15)
    for _ in range(40):
        pace.record(full_s * pace.scale**2)
    assert low <= pace.scale <= high


def test_the_pace_asks_for_few_rasters_and_stands_still_in_noise() -> None:
    rng, pace, scales = np.random.default_rng(0), ResolutionController(1 / 15), []
    for _ in range(500):
        pace.record(0.4 * pace.scale**2 * float(np.exp(rng.normal(0, 0.1))))
        scales.append(pace.scale)
    assert len(set(scales)) <= 5 and sum(a != b for a, b in zip(scales[50:], scales[51:])) <= 25
    pace.record(100.0)  # an exception
    assert pace.scale > 0.55 * scales[-1]
    assert {round(4 * math.log2(scale), 9) % 1 for scale in scales} == {0.0}


@pytest.mark.parametrize(("fixed_s", "low", "high"), [(0.02, 0.34, 0.43), (0.05, 0.24, 0.5), (0.2, 0.35, 1.0)])
def test_a_raster_gets_no_coarser_than_helps(fixed_s: float, low: float, high: float) -> None:
    rng, pace, scales = np.random.default_rng(0), ResolutionController(1 / 15), []
    for _ in range(300):
        pace.record((fixed_s + 0.3 * pace.scale**2) * float(np.exp(rng.normal(0, 0.1))))
        scales.append(pace.scale)
    assert low <= np.median(scales[100:]) <= high and np.std(scales[100:]) < 0.2 * high


@pytest.mark.parametrize("whole", [1.0, 3.0, 5.0])
def test_the_pace_is_that_of_pictures_that_follow_one_another(whole: float) -> None:
    """What follows none takes so many times as long: the first on a raster, and one a lap."""
    rng, pace, scales, raster = np.random.default_rng(0), ResolutionController.of(software=True), [], None
    for number in range(600):
        follows = pace.scale == raster and number % 40
        scales.append(raster := pace.scale)
        pace.record(0.15 * pace.scale**2 * (1.0 if follows else whole) * float(np.exp(rng.normal(0, 0.1))))
    assert 0.55 < min(scales[100:]) and max(scales[100:]) < 0.8  # 1 / 15 s
    assert sum(a != b for a, b in zip(scales[100:], scales[101:])) <= 6


@pytest.mark.parametrize("slow", [2.0, 3.5, 6.0])
@pytest.mark.parametrize("pictures", [3, 5, 8, 12])
def test_a_slow_start_does_not_last(slow: float, pictures: int) -> None:
    """As while a scene is read beside the first pictures."""
    pace, raster = ResolutionController.of(software=True), None
    for number in range(100):
        whole, raster = (1.0 if pace.scale == raster else 3.0), pace.scale
        pace.record((0.015 + 0.12 * pace.scale**2) * whole * (slow if number < pictures else 1.0))
    assert 0.55 < pace.scale < 0.75


@pytest.mark.parametrize("settled", [1, 2, 5, 50])
def test_slowness_is_met_soon(settled: int) -> None:
    """As where a camera begins to turn, and pictures cannot follow: on a raster that is new as on one that is not."""
    pace = ResolutionController(1 / 15, 0.5)
    for _ in range(settled):
        pace.record(0.05)
    scales = []
    for _ in range(12):
        pace.record(0.8 * pace.scale**2)
        scales.append(pace.scale)
    assert scales[0] == pytest.approx(0.5) and scales[2] < 0.49 and scales[-1] < 0.36


def test_a_processor_begins_coarsely() -> None:
    assert ResolutionController.of(software=True).scale < 0.5 and ResolutionController.of(software=False).scale == 1.0
