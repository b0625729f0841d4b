"""The dial against made-up devices: a time for each rung, and noise."""

import numpy as np
import pytest
from kpc.player.app.controls import Pace
from kpc.player.app.quality_controller import NOT_FOR_CARDS, RUNGS, TOO_SLOW, Dial, dial_for
from kpc.player.quality import DEFAULT

GROWTH = 1.6
COSTS_MS = {rung: 4.0 * GROWTH**number for number, rung in enumerate(RUNGS)}


def rate_for(rung: str, share: float = 0.8) -> float:
    """Pictures a second that leave a rung, of which each takes this share of the time; the next finer one takes too long."""
    return share * 1e3 / COSTS_MS[rung]


def turns(
    dial: Dial, frames: int, load: float = 1.0, noise: float = 0.0, seed: int = 0, spikes: float = 0.0
) -> list[str]:
    """Draw so many pictures on a device whose rungs take COSTS_MS times `load`, in proportion to pixels; the rung of each."""
    rng, rungs = np.random.default_rng(seed), []
    for _ in range(frames):
        rungs.append(dial.rung)
        slowed = 20.0 if rng.random() < spikes else 1.0
        dial.saw(1e-3 * COSTS_MS[dial.rung] * load * dial.pace.scale**2 * float(np.exp(rng.normal(0, noise))) * slowed)
    return rungs


def changes(rungs: list[str]) -> int:
    return sum(a != b for a, b in zip(rungs, rungs[1:]))


def held(fps: float, start: str = DEFAULT, scale: float = 1.0) -> Dial:
    dial = Dial(start, Pace(1 / 15, scale))
    dial.hold(fps)
    return dial


@pytest.mark.parametrize("start", RUNGS)
@pytest.mark.parametrize("rung", RUNGS)
@pytest.mark.parametrize("scale", [1.0, 0.25])
def test_comes_to_the_finest_rung_that_is_fast_enough_and_stays(start: str, rung: str, scale: float) -> None:
    dial = held(rate_for(rung), start, scale)
    turns(dial, 200)
    assert set(turns(dial, 500)) == {rung}


@pytest.mark.parametrize("noise", [0.02, 0.1, 0.2])
@pytest.mark.parametrize("share", np.linspace(0.5, 1.5, 9))
def test_does_not_flicker_wherever_the_target_lies_between_two_rungs(share: float, noise: float) -> None:
    dial = held(rate_for(RUNGS[2], share))
    turns(dial, 300, noise=noise)
    after = turns(dial, 3000, noise=noise, seed=1)
    assert changes(after) <= (2 if noise <= 0.1 else 20)


def test_a_hiccup_moves_nothing() -> None:
    dial = held(rate_for(RUNGS[3]))
    turns(dial, 200, spikes=0.02, seed=3)
    assert changes(turns(dial, 1000, spikes=0.02, seed=4)) <= 2


def test_follows_a_heavier_and_a_lighter_view() -> None:
    dial = held(rate_for(RUNGS[3]))
    turns(dial, 200)
    assert dial.rung == RUNGS[3]
    assert set(turns(dial, 200, load=GROWTH**2)[50:]) == {RUNGS[1]}
    assert set(turns(dial, 400, load=1.0)[200:]) == {RUNGS[3]}
    assert len(set(turns(dial, 20, load=5.0))) >= 3  # slowness is met soon


def test_below_the_fastest_rung_the_raster_gets_coarser_and_finer_again() -> None:
    dial = held(30)
    turns(dial, 200, load=40.0)
    assert dial.rung == RUNGS[0] and 0.3 < dial.pace.scale < 0.5
    assert 1e-3 * COSTS_MS[RUNGS[0]] * 40 * dial.pace.scale**2 < TOO_SLOW * 1.3 / 30
    turns(dial, 300, load=0.01)
    assert dial.pace.scale == 1.0 and dial.rung == RUNGS[-1]


def test_by_hand_it_stays_and_a_still_picture_is_no_coarser_than_asked_for() -> None:
    dial = held(rate_for(RUNGS[2]), RUNGS[4])
    turns(dial, 100)
    assert dial.rung == RUNGS[2] and dial.resting == RUNGS[4]
    dial.choose(RUNGS[1])
    assert set(turns(dial, 100, load=0.1)) == {RUNGS[1]} and dial.target_s is None and dial.resting == RUNGS[1]
    dial.hold(30)
    turns(dial, 200, load=0.01)
    assert dial.rung == dial.resting == RUNGS[-1]
    dial.hold(None)
    assert dial.chosen == dial.rung == RUNGS[-1] and set(turns(dial, 50, load=9.0)) == {RUNGS[-1]}


def test_where_a_device_begins() -> None:
    assert dial_for(True, None, None).rung == DEFAULT and dial_for(True, None, None).target_s is None
    dial = dial_for(True, RUNGS[1], 25.0)  # a processor begins with a coarse raster
    assert (dial.rung, dial.resting) == (RUNGS[0], RUNGS[1]) and dial.target_s == pytest.approx(0.04)
    asked = dial_for(False, RUNGS[-2], None)
    assert asked.rung == RUNGS[-2] and asked.target_s is None


@pytest.mark.parametrize("finest", [rung for rung in RUNGS if rung not in NOT_FOR_CARDS])
def test_a_card_begins_on_the_reference_and_keeps_its_raster_as_long_as_a_lower_rung_is_in_time(finest: str) -> None:
    dial = dial_for(False, None, None)
    assert dial.rung == RUNGS[-1]
    load = 20.0 * 0.8 / COSTS_MS[finest]  # a card that draws this rung in 16 ms
    turns(dial, 100, load)
    assert set(turns(dial, 100, load)) == {finest} and dial.pace.scale == 1.0 and dial.resting == RUNGS[-1]


def test_a_card_far_too_slow_is_not_waited_for_on_every_rung() -> None:
    dial, load, taken = dial_for(False, None, None), 4.0, []
    while dial.rung != RUNGS[0]:  # of 16 ms; the reference takes 429
        taken.append(1e-3 * COSTS_MS[dial.rung] * load)
        turns(dial, 1, load)
    assert sum(taken) < 2.0  # four pictures on each rung would take 4.3 s
    assert set(turns(dial, 100, load)) == {RUNGS[0]} and dial.pace.scale == 1.0


def test_a_rung_that_was_left_out_on_the_way_down_is_tried_again() -> None:
    dial = held(1e3 / COSTS_MS[RUNGS[4]] * 0.8, start=RUNGS[-1])
    assert set(turns(dial, 2, load=10.0)) == {RUNGS[-1]} and dial.rung == RUNGS[-3]
    turns(dial, 200)
    assert set(turns(dial, 500)) == {RUNGS[4]}


@pytest.mark.parametrize("rung", sorted(NOT_FOR_CARDS))
def test_a_card_is_not_moved_to_what_takes_it_longer_than_the_next_finer_rung(
    rung: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    below, above = (RUNGS[RUNGS.index(rung) + way] for way in (-1, 1))
    monkeypatch.setitem(COSTS_MS, rung, 1.9 * COSTS_MS[below])
    monkeypatch.setitem(COSTS_MS, above, 1.1 * COSTS_MS[below])
    for start in (RUNGS[-1], below):
        dial = dial_for(False, start, 1e3 / COSTS_MS[above] * 0.6)
        assert rung not in turns(dial, 300) and set(turns(dial, 300)) == {above}
    by_hand = dial_for(False, rung, None)
    assert set(turns(by_hand, 50)) == {rung}
