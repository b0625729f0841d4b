"""View limits of a wall: a plane of which only a square is there, seen by cameras along an arc before it."""

import math
from dataclasses import replace

import numpy as np
import pytest

from kpc.format.scene.rig import Rig, look_at
from kpc.format.scene.view_limits import find_view
from scenes import tiny_scene

UP = np.array([0.0, 0.0, 1.0])


def wall(half: float):
    """Return what looks at the square |x|, |z| <= half of the plane y = 0."""

    def look(camera):
        origins, directions = (a.astype(np.float64) for a in camera.rays())
        distance = -origins[:, 1] / np.where(directions[:, 1] > 1e-6, directions[:, 1], np.nan)
        points = origins + np.nan_to_num(distance)[:, None] * directions
        hit = (distance > 0) & (np.abs(points[:, [0, 2]]) <= half).all(1)
        return np.where(hit, distance, 0.0), hit.astype(float)

    return look


def scene_of(angles, distance=4.0):
    eyes = [distance * np.array([math.sin(math.radians(a)), -math.cos(math.radians(a)), 0.1]) for a in angles]
    camera = tiny_scene(scales=1, channels=1, resolution=(3, 3, 3), time=2).cameras[0].resized(64, 48)
    camera = replace(camera, fl_x=60.0, fl_y=60.0, cx=32.0, cy=24.0)
    cameras = tuple(replace(camera, camera_to_world=look_at(eye, np.zeros(3), UP)) for eye in eyes)
    return replace(tiny_scene(scales=1, channels=1, resolution=(3, 3, 3), time=2), cameras=cameras)


def test_limits_hold_what_two_cameras_saw_and_end_where_nothing_was_filmed():
    scene = scene_of((0, -20, -10, 10, 20))
    _, limits = find_view(scene, wall(2.6))
    azimuth, elevation = np.degrees(limits.azimuth), np.degrees(limits.elevation)
    assert limits.focus == pytest.approx([0, 0, 0], abs=1e-3) and limits.up == pytest.approx(UP, abs=1e-6)
    assert azimuth[0] <= -10 and azimuth[1] >= 10 and elevation[0] < elevation[1]
    assert np.abs(azimuth).max() <= 40 and np.abs(elevation).max() <= 25  # 20 degrees beyond the cameras
    near, far = limits.distance
    assert near < 4 < far + 0.1
    _, wider = find_view(scene, wall(20.0))  # a wall without end
    assert wider.azimuth[0] <= limits.azimuth[0] and wider.azimuth[1] >= limits.azimuth[1]


def test_the_opening_view_shows_nothing_that_was_not_filmed():
    scene = scene_of((0, -20, -10, 10, 20))
    opening, _ = find_view(scene, wall(2.6))
    first = scene.cameras[0]
    assert opening.camera.fl_y > first.fl_y  # the first camera sees past the wall
    wide = replace(opening.camera, width=85, cx=42.5)
    assert wall(2.6)(wide)[1].mean() >= 0.99 > wall(2.6)(replace(first, width=85, cx=42.5))[1].mean()
    assert np.array_equal(opening.camera.camera_to_world, first.camera_to_world)


def test_an_object_before_a_plain_background_is_seen_from_all_around_its_cameras():
    _, limits = find_view(scene_of((0, -20, -10, 10, 20)), wall(0.5))
    assert np.degrees(limits.azimuth) == pytest.approx([-40, 40], abs=5)


def test_two_cameras_and_cameras_that_look_outwards_give_no_limits():
    assert find_view(scene_of((0, 10)), wall(2.6)) == (None, None)
    scene = scene_of((0, 60, 120, 180, 240, 300))
    turn = np.diag([-1.0, 1.0, -1.0, 1.0])
    outward = tuple(replace(c, camera_to_world=c.camera_to_world @ turn) for c in scene.cameras)
    assert find_view(replace(scene, cameras=outward), wall(2.6)) == (None, None)


def test_up_of_the_metadata_is_that_of_the_rig():
    scene = scene_of((0, -20, 20))
    tilted = replace(scene, metadata=scene.metadata.with_members(up=[0, 0.6, 0.8]))
    assert Rig.of(tilted).up == pytest.approx([0, 0.6, 0.8])
