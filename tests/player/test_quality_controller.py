"""The quality controller with simulated devices: a frame time for each level, and noise."""

from itertools import pairwise

import numpy as np
import pytest

from kpc.player.app.quality_controller import (
    LEVEL_NAMES,
    TOO_SLOW,
    QualityController,
    quality_controller_for,
)
from kpc.player.app.resolution_controller import ResolutionController
from kpc.player.quality import DEFAULT

FACTOR = 1.6  # between the frame times of neighbouring levels
COSTS_MS = {level: 4.0 * FACTOR**number for number, level in enumerate(LEVEL_NAMES)}


def rate_for(level: str, load: float = 0.8) -> float:
    """Return a frame rate at which a level takes `load` of the time; at 0.8 the next finer level is too slow."""
    return load * 1e3 / COSTS_MS[level]


def draw(
    controller: QualityController,
    frames: int,
    load: float = 1.0,
    noise: float = 0.0,
    seed: int = 0,
    spikes: float = 0.0,
) -> list[str]:
    """Draw frames on a simulated device, and return the level of each.

    Args:
        controller: the controller.
        frames: how many to draw.
        load: frames take this many times COSTS_MS, in proportion to the number of pixels.
        noise: standard deviation of the logarithm of the frame time.
        seed: of the noise.
        spikes: probability that a frame takes 20 times as long.
    """
    rng, levels = np.random.default_rng(seed), []
    for _ in range(frames):
        levels.append(controller.level)
        spike = 20.0 if rng.random() < spikes else 1.0
        time_ms = COSTS_MS[controller.level] * load * controller.resolution.scale**2
        controller.record(1e-3 * time_ms * float(np.exp(rng.normal(0, noise))) * spike)
    return levels


def changes(levels: list[str]) -> int:
    return sum(a != b for a, b in pairwise(levels))


def holding(fps: float, start: str = DEFAULT, scale: float = 1.0) -> QualityController:
    controller = QualityController(start, ResolutionController(1 / 15, scale))
    controller.hold(fps)
    return controller


@pytest.mark.parametrize("start", LEVEL_NAMES)
@pytest.mark.parametrize("level", LEVEL_NAMES)
@pytest.mark.parametrize("scale", [1.0, 0.25])
def test_it_settles_on_the_finest_level_that_is_fast_enough(start: str, level: str, scale: float) -> None:
    controller = holding(rate_for(level), start, scale)
    draw(controller, 200)
    assert set(draw(controller, 500)) == {level}


@pytest.mark.parametrize("noise", [0.02, 0.1, 0.2])
@pytest.mark.parametrize("load", np.linspace(0.5, 1.5, 9))
def test_it_does_not_oscillate_wherever_the_target_lies_between_two_levels(load: float, noise: float) -> None:
    controller = holding(rate_for(LEVEL_NAMES[2], load))
    draw(controller, 300, noise=noise)
    levels = draw(controller, 3000, noise=noise, seed=1)
    assert changes(levels) <= (2 if noise <= 0.1 else 20)


def test_single_slow_frames_do_not_change_the_level() -> None:
    controller = holding(rate_for(LEVEL_NAMES[3]))
    draw(controller, 200, spikes=0.02, seed=3)
    assert changes(draw(controller, 1000, spikes=0.02, seed=4)) <= 2


def test_it_follows_views_that_are_slower_and_faster_to_draw() -> None:
    controller = holding(rate_for(LEVEL_NAMES[3]))
    draw(controller, 200)
    assert controller.level == LEVEL_NAMES[3]
    assert set(draw(controller, 200, load=FACTOR**2)[50:]) == {LEVEL_NAMES[1]}
    assert set(draw(controller, 400, load=1.0)[200:]) == {LEVEL_NAMES[3]}
    assert len(set(draw(controller, 20, load=5.0))) >= 3  # it reacts to slow frames at once


def test_below_the_fastest_level_the_resolution_is_lowered_and_raised_again() -> None:
    controller = holding(30)
    draw(controller, 200, load=40.0)
    assert controller.level == LEVEL_NAMES[0] and 0.3 < controller.resolution.scale < 0.5
    assert 1e-3 * COSTS_MS[LEVEL_NAMES[0]] * 40 * controller.resolution.scale**2 < TOO_SLOW * 1.3 / 30
    draw(controller, 300, load=0.01)
    assert controller.resolution.scale == 1.0 and controller.level == LEVEL_NAMES[-1]


def test_a_chosen_level_stays_and_stills_are_no_coarser_than_it() -> None:
    controller = holding(rate_for(LEVEL_NAMES[2]), LEVEL_NAMES[4])
    draw(controller, 100)
    assert controller.level == LEVEL_NAMES[2] and controller.still_level == LEVEL_NAMES[4]
    controller.choose(LEVEL_NAMES[1])
    assert set(draw(controller, 100, load=0.1)) == {LEVEL_NAMES[1]} == {controller.still_level}
    assert controller.target_s is None
    controller.hold(30)
    draw(controller, 200, load=40.0)
    assert controller.level == LEVEL_NAMES[0]
    controller.hold(None)
    assert controller.chosen_level == controller.level == LEVEL_NAMES[1]
    controller.hold(30)
    draw(controller, 200, load=0.01)
    assert controller.level == controller.still_level == LEVEL_NAMES[-1]
    controller.hold(None)
    assert controller.chosen_level == controller.level == LEVEL_NAMES[-1]
    assert set(draw(controller, 50, load=9.0)) == {LEVEL_NAMES[-1]}


def test_defaults_of_devices() -> None:
    processor = quality_controller_for(True, None, None)
    assert processor.level == DEFAULT and processor.target_s is None
    processor = quality_controller_for(True, LEVEL_NAMES[1], 25.0)
    assert (processor.level, processor.still_level) == (LEVEL_NAMES[0], LEVEL_NAMES[1])  # its resolution is reduced
    assert processor.target_s == pytest.approx(0.04)
    card = quality_controller_for(False, LEVEL_NAMES[-2], None)
    assert card.level == LEVEL_NAMES[-2] and card.target_s is None


@pytest.mark.parametrize("finest", LEVEL_NAMES)
def test_a_card_begins_with_the_reference_and_keeps_full_resolution_while_a_level_is_in_time(finest: str) -> None:
    controller = quality_controller_for(False, None, None)
    assert controller.level == LEVEL_NAMES[-1]
    load = 20.0 * 0.8 / COSTS_MS[finest]  # the card draws this level in 16 ms
    draw(controller, 100, load)
    assert set(draw(controller, 100, load)) == {finest}
    assert controller.resolution.scale == 1.0 and controller.still_level == LEVEL_NAMES[-1]


def test_a_card_keeps_a_level_that_was_chosen() -> None:
    controller = quality_controller_for(False, LEVEL_NAMES[4], None)
    assert set(draw(controller, 50, load=10.0)) == {LEVEL_NAMES[4]}


def test_a_slow_card_does_not_try_every_level() -> None:
    controller, load, times_s = quality_controller_for(False, None, None), 4.0, []
    while controller.level != LEVEL_NAMES[0]:  # which takes 16 ms
        times_s.append(1e-3 * COSTS_MS[controller.level] * load)
        draw(controller, 1, load)
    every_level_s = 4 * 1e-3 * load * sum(COSTS_MS[level] for level in LEVEL_NAMES[1:])  # with four frames each
    assert sum(times_s) < every_level_s / 2
    assert set(draw(controller, 100, load)) == {LEVEL_NAMES[0]} and controller.resolution.scale == 1.0


def test_a_level_that_was_left_out_on_the_way_down_is_tried_again() -> None:
    controller = holding(1e3 / COSTS_MS[LEVEL_NAMES[4]] * 0.8, start=LEVEL_NAMES[-1])
    assert set(draw(controller, 2, load=10.0)) == {LEVEL_NAMES[-1]} and controller.level == LEVEL_NAMES[-3]
    draw(controller, 200)
    assert set(draw(controller, 500)) == {LEVEL_NAMES[4]}
