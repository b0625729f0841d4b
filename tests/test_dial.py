"""The dial against made-up devices: a time for each rung, and noise."""

import numpy as np
import pytest

from kpc.player.controls import Pace
from kpc.player.dial import RUNGS, TOO_SLOW, Dial, dial_for
from kpc.player.quality import DEFAULT

COSTS_MS = dict(zip(RUNGS, (4.0, 6.0, 9.0, 14.0, 22.0, 60.0), strict=True))


def turns(dial: Dial, frames: int, load: float = 1.0, noise: float = 0.0, seed: int = 0, spikes: float = 0.0) -> list[str]:
    """Draw so many pictures on a device whose rungs take COSTS_MS times `load`, in proportion to pixels; the rung of each."""
    rng, rungs = np.random.default_rng(seed), []
    for _ in range(frames):
        rungs.append(dial.rung)
        slowed = 20.0 if rng.random() < spikes else 1.0
        dial.saw(1e-3 * COSTS_MS[dial.rung] * load * dial.pace.scale**2 * float(np.exp(rng.normal(0, noise))) * slowed)
    return rungs


def changes(rungs: list[str]) -> int:
    return sum(a != b for a, b in zip(rungs, rungs[1:]))


def held(fps: float, start: str = DEFAULT) -> Dial:
    dial = Dial(start, Pace(1 / 15))
    dial.hold(fps)
    return dial


@pytest.mark.parametrize("start", RUNGS)
@pytest.mark.parametrize(("fps", "rung"), [(30, RUNGS[4]), (60, RUNGS[3]), (90, RUNGS[2]), (200, RUNGS[0]), (10, RUNGS[5])])
def test_comes_to_the_finest_rung_that_is_fast_enough_and_stays(start: str, fps: float, rung: str) -> None:
    dial = held(fps, start)
    turns(dial, 200)
    assert set(turns(dial, 500)) == {rung}


@pytest.mark.parametrize("noise", [0.02, 0.1, 0.2])
@pytest.mark.parametrize("load", np.linspace(0.5, 2.0, 7))
def test_does_not_flicker_wherever_the_target_lies_between_two_rungs(load: float, noise: float) -> None:
    dial = held(30)
    turns(dial, 300, load, noise)
    after = turns(dial, 3000, load, noise, seed=1)
    assert changes(after) <= (2 if noise <= 0.1 else 20)


def test_a_hiccup_moves_nothing() -> None:
    dial = held(30)
    turns(dial, 200, spikes=0.02, seed=3)
    assert changes(turns(dial, 1000, spikes=0.02, seed=4)) <= 2


def test_follows_a_heavier_and_a_lighter_view() -> None:
    dial = held(30)
    turns(dial, 200)
    assert dial.rung == RUNGS[4]
    assert set(turns(dial, 200, load=3.0)[50:]) == {RUNGS[2]}
    assert set(turns(dial, 400, load=1.0)[200:]) == {RUNGS[4]}
    assert len(set(turns(dial, 20, load=5.0))) >= 3  # slowness is met soon


def test_below_the_fastest_rung_the_raster_gets_coarser_and_finer_again() -> None:
    dial = held(30)
    turns(dial, 200, load=40.0)
    assert dial.rung == RUNGS[0] and 0.3 < dial.pace.scale < 0.5
    took = 1e-3 * COSTS_MS[RUNGS[0]] * 40 * dial.pace.scale**2
    assert took < TOO_SLOW * 1.3 / 30
    turns(dial, 300, load=1.0)
    assert dial.pace.scale == 1.0 and dial.rung == RUNGS[4]


def test_by_hand_it_stays_and_a_still_picture_is_no_coarser_than_asked_for() -> None:
    dial = held(30, "fine")
    turns(dial, 100, load=3.0)
    assert dial.rung == RUNGS[2] and dial.resting == "fine"
    dial.choose("faster")
    assert set(turns(dial, 100, load=0.1)) == {"faster"} and dial.target_s is None and dial.resting == "faster"
    dial.hold(30)
    turns(dial, 100, load=0.1)
    assert dial.rung == dial.resting == RUNGS[-1]
    dial.hold(None)
    assert dial.chosen == dial.rung == RUNGS[-1] and set(turns(dial, 50, load=9.0)) == {RUNGS[-1]}


def test_where_a_device_begins() -> None:
    assert dial_for(True, None, None).rung == DEFAULT and dial_for(False, None, None).rung == RUNGS[-1]
    dial = dial_for(True, "faster", 25.0)
    assert dial.rung == "faster" and dial.target_s == pytest.approx(0.04)
