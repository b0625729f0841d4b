"""The controller against made-up devices: a time for each level, and noise."""

import numpy as np
import pytest
from kpc.player.app.quality_controller import (
    LEVEL_NAMES,
    SKIPPED_ON_GPUS,
    TOO_SLOW,
    QualityController,
    quality_controller_for,
)
from kpc.player.app.resolution_controller import ResolutionController
from kpc.player.quality import DEFAULT

GROWTH = 1.6
COSTS_MS = {level: 4.0 * GROWTH**number for number, level in enumerate(LEVEL_NAMES)}


def rate_for(level: str, share: float = 0.8) -> float:
    """Pictures a second that leave a level, of which each takes this share of the time; the next finer one takes too long."""
    return share * 1e3 / COSTS_MS[level]


def turns(
    controller: QualityController,
    frames: int,
    load: float = 1.0,
    noise: float = 0.0,
    seed: int = 0,
    spikes: float = 0.0,
) -> list[str]:
    """Draw so many pictures on a device whose levels take COSTS_MS times `load`, in proportion to pixels; the level of each."""
    rng, levels = np.random.default_rng(seed), []
    for _ in range(frames):
        levels.append(controller.level)
        slowed = 20.0 if rng.random() < spikes else 1.0
        controller.record(
            1e-3
            * COSTS_MS[controller.level]
            * load
            * controller.resolution.scale**2
            * float(np.exp(rng.normal(0, noise)))
            * slowed
        )
    return levels


def changes(levels: list[str]) -> int:
    return sum(a != b for a, b in zip(levels, levels[1:]))


def held(fps: float, start: str = DEFAULT, scale: float = 1.0) -> QualityController:
    controller = QualityController(start, ResolutionController(1 / 15, scale))
    controller.hold(fps)
    return controller


@pytest.mark.parametrize("start", LEVEL_NAMES)
@pytest.mark.parametrize("level", LEVEL_NAMES)
@pytest.mark.parametrize("scale", [1.0, 0.25])
def test_comes_to_the_finest_rung_that_is_fast_enough_and_stays(start: str, level: str, scale: float) -> None:
    controller = held(rate_for(level), start, scale)
    turns(controller, 200)
    assert set(turns(controller, 500)) == {level}


@pytest.mark.parametrize("noise", [0.02, 0.1, 0.2])
@pytest.mark.parametrize("share", np.linspace(0.5, 1.5, 9))
def test_does_not_flicker_wherever_the_target_lies_between_two_rungs(share: float, noise: float) -> None:
    controller = held(rate_for(LEVEL_NAMES[2], share))
    turns(controller, 300, noise=noise)
    after = turns(controller, 3000, noise=noise, seed=1)
    assert changes(after) <= (2 if noise <= 0.1 else 20)


def test_a_hiccup_moves_nothing() -> None:
    controller = held(rate_for(LEVEL_NAMES[3]))
    turns(controller, 200, spikes=0.02, seed=3)
    assert changes(turns(controller, 1000, spikes=0.02, seed=4)) <= 2


def test_follows_a_heavier_and_a_lighter_view() -> None:
    controller = held(rate_for(LEVEL_NAMES[3]))
    turns(controller, 200)
    assert controller.level == LEVEL_NAMES[3]
    assert set(turns(controller, 200, load=GROWTH**2)[50:]) == {LEVEL_NAMES[1]}
    assert set(turns(controller, 400, load=1.0)[200:]) == {LEVEL_NAMES[3]}
    assert len(set(turns(controller, 20, load=5.0))) >= 3  # slowness is met soon


def test_below_the_fastest_rung_the_raster_gets_coarser_and_finer_again() -> None:
    controller = held(30)
    turns(controller, 200, load=40.0)
    assert controller.level == LEVEL_NAMES[0] and 0.3 < controller.resolution.scale < 0.5
    assert 1e-3 * COSTS_MS[LEVEL_NAMES[0]] * 40 * controller.resolution.scale**2 < TOO_SLOW * 1.3 / 30
    turns(controller, 300, load=0.01)
    assert controller.resolution.scale == 1.0 and controller.level == LEVEL_NAMES[-1]


def test_by_hand_it_stays_and_a_still_picture_is_no_coarser_than_asked_for() -> None:
    controller = held(rate_for(LEVEL_NAMES[2]), LEVEL_NAMES[4])
    turns(controller, 100)
    assert controller.level == LEVEL_NAMES[2] and controller.still_level == LEVEL_NAMES[4]
    controller.choose(LEVEL_NAMES[1])
    assert (
        set(turns(controller, 100, load=0.1)) == {LEVEL_NAMES[1]}
        and controller.target_s is None
        and controller.still_level == LEVEL_NAMES[1]
    )
    controller.hold(30)
    turns(controller, 200, load=0.01)
    assert controller.level == controller.still_level == LEVEL_NAMES[-1]
    controller.hold(None)
    assert controller.chosen_level == controller.level == LEVEL_NAMES[-1] and set(turns(controller, 50, load=9.0)) == {
        LEVEL_NAMES[-1]
    }


def test_where_a_device_begins() -> None:
    assert (
        quality_controller_for(True, None, None).level == DEFAULT
        and quality_controller_for(True, None, None).target_s is None
    )
    controller = quality_controller_for(True, LEVEL_NAMES[1], 25.0)  # a processor begins with a coarse raster
    assert (controller.level, controller.still_level) == (
        LEVEL_NAMES[0],
        LEVEL_NAMES[1],
    ) and controller.target_s == pytest.approx(0.04)
    asked = quality_controller_for(False, LEVEL_NAMES[-2], None)
    assert asked.level == LEVEL_NAMES[-2] and asked.target_s is None


@pytest.mark.parametrize("finest", [level for level in LEVEL_NAMES if level not in SKIPPED_ON_GPUS])
def test_a_card_begins_on_the_reference_and_keeps_its_raster_as_long_as_a_lower_rung_is_in_time(finest: str) -> None:
    controller = quality_controller_for(False, None, None)
    assert controller.level == LEVEL_NAMES[-1]
    load = 20.0 * 0.8 / COSTS_MS[finest]  # a card that draws this level in 16 ms
    turns(controller, 100, load)
    assert (
        set(turns(controller, 100, load)) == {finest}
        and controller.resolution.scale == 1.0
        and controller.still_level == LEVEL_NAMES[-1]
    )


def test_a_card_far_too_slow_is_not_waited_for_on_every_rung() -> None:
    controller, load, taken = quality_controller_for(False, None, None), 4.0, []
    while controller.level != LEVEL_NAMES[0]:  # of 16 ms; the reference takes 429
        taken.append(1e-3 * COSTS_MS[controller.level] * load)
        turns(controller, 1, load)
    assert sum(taken) < 2.0  # four pictures on each level would take 4.3 s
    assert set(turns(controller, 100, load)) == {LEVEL_NAMES[0]} and controller.resolution.scale == 1.0


def test_a_rung_that_was_left_out_on_the_way_down_is_tried_again() -> None:
    controller = held(1e3 / COSTS_MS[LEVEL_NAMES[4]] * 0.8, start=LEVEL_NAMES[-1])
    assert set(turns(controller, 2, load=10.0)) == {LEVEL_NAMES[-1]} and controller.level == LEVEL_NAMES[-3]
    turns(controller, 200)
    assert set(turns(controller, 500)) == {LEVEL_NAMES[4]}


@pytest.mark.parametrize("level", sorted(SKIPPED_ON_GPUS))
def test_a_card_is_not_moved_to_what_takes_it_longer_than_the_next_finer_rung(
    level: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    below, above = (LEVEL_NAMES[LEVEL_NAMES.index(level) + way] for way in (-1, 1))
    monkeypatch.setitem(COSTS_MS, level, 1.9 * COSTS_MS[below])
    monkeypatch.setitem(COSTS_MS, above, 1.1 * COSTS_MS[below])
    for start in (LEVEL_NAMES[-1], below):
        controller = quality_controller_for(False, start, 1e3 / COSTS_MS[above] * 0.6)
        assert level not in turns(controller, 300) and set(turns(controller, 300)) == {above}
    by_hand = quality_controller_for(False, level, None)
    assert set(turns(by_hand, 50)) == {level}
