"""A view comes back to the limits from where a scene holds."""

import math
from dataclasses import replace

import numpy as np
import pytest

from kpc.format.scene.metadata import ViewLimits
from kpc.format.scene.rig import Rig
from kpc.player.app.controls import OrbitView
from kpc.player.app.view_keeper import kept
from scenes import tiny_scene

RIG = Rig.of(tiny_scene(0))
OPENING = OrbitView.of(RIG, RIG.camera(0.0, 0.3, 3.0))
AHEAD, _ = RIG.compass()
LIMITS = ViewLimits(RIG.focus, AHEAD, RIG.up, (-0.4, 0.5), (0.1, 0.6), (2.0, 4.0), 0.2)


def angles(view):
    """Return azimuth, elevation, distance of the eye and how far the point looked at is from the focus."""
    offset = view.eye - LIMITS.focus
    distance = np.linalg.norm(offset)
    azimuth = math.atan2(offset @ np.cross(LIMITS.up, LIMITS.forward), offset @ LIMITS.forward)
    away = np.linalg.norm(view.focus - LIMITS.focus)
    return azimuth, math.asin(offset @ LIMITS.up / distance), distance, away


def at_rest(view, seconds=1 / 60):
    for _ in range(400):
        moved = kept(view, LIMITS, seconds)
        if moved is view:
            return view
        view = moved
    raise AssertionError("the view does not come to rest")


def test_a_view_within_the_limits_stays_as_it_is():
    for view in (OPENING, OPENING.orbit(0.2, 0.1), OPENING.zoom(2), OPENING.pan(0.02, 0.0)):
        assert kept(view, LIMITS, 1.0) is view


@pytest.mark.parametrize(
    "view, number, bound",
    [
        (OPENING.orbit(-1.2, 0.0), 0, 0.5),
        (OPENING.orbit(2.5, 0.0), 0, -0.4),
        (OPENING.orbit(0.0, 0.6), 1, 0.1),
        (OPENING.orbit(0.0, -0.8), 1, 0.6),
        (OPENING.zoom(9), 2, 2.0),
        (OPENING.zoom(-9), 2, 4.0),
        (OPENING.pan(1.0, 0.0), 3, 0.2),
    ],
)
def test_a_view_outside_comes_back_step_by_step(view, number, bound):
    before, first = angles(view)[number], angles(kept(view, LIMITS, 1 / 60))[number]
    assert 0 < (first - before) * np.sign(bound - before) < abs(bound - before)  # softly
    end = at_rest(view)
    assert angles(end)[number] == pytest.approx(bound, abs=2e-3)
    assert end.axes.T @ end.axes == pytest.approx(np.eye(3), abs=1e-9) and end.axes[:, 1] @ LIMITS.up > 0


def test_limits_of_a_full_turn_bound_no_azimuth():
    around = replace(LIMITS, azimuth=(-math.pi, math.pi))
    for turn in (-3, -1, 2, 3.1):
        view = OPENING.orbit(turn, 0.0)
        assert kept(view, around, 1.0) is view
