import math
from dataclasses import replace

import numpy as np
import pytest

from kpc.format.scene.cameras import Camera
from kpc.format.scene.rig import Rig, look_at, surround_focus
from kpc.format.scene.scene import Scene
from kpc.player.viewpoints import fit_camera, orbit, presets
from scenes import tiny_scene

UP = np.array([0.0, 0.0, 1.0])


def scene_of(eyes: list[tuple[float, float, float]], target: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Scene:
    cameras = tuple(
        Camera(64, 48, 60, 60, 32, 24, look_at(np.array(eye, float), np.array(target, float), UP)) for eye in eyes
    )
    return replace(tiny_scene(0), cameras=cameras)


RING = [(3 * math.cos(a), 3 * math.sin(a), 1.0) for a in np.linspace(0, 2 * math.pi, 7)[:-1]]
WALL = [(x, -4.0, z) for x in (-0.8, 0.0, 0.8) for z in (0.4, 0.9)]


def test_focus_and_up_follow_from_the_cameras() -> None:
    for eyes in (RING, WALL):
        rig = Rig.of(scene_of(eyes))
        assert rig.focus == pytest.approx(np.zeros(3), abs=1e-6)
        assert rig.up @ UP > math.cos(math.radians(0.5 if eyes is RING else 12))


def test_surrounding_cameras_give_a_full_circle_from_the_first_camera() -> None:
    scene = scene_of(RING)
    path = orbit(scene, 36)
    eyes = np.stack([camera.camera_to_world[:3, 3] for camera in path])
    assert eyes[0] == pytest.approx(RING[0], abs=1e-6)
    assert np.linalg.norm(eyes[:, :2], axis=1) == pytest.approx(np.full(36, 3.0), abs=1e-6)
    assert eyes[:, 2] == pytest.approx(np.ones(36), abs=1e-6)
    azimuth = np.unwrap(np.arctan2(eyes[:, 1], eyes[:, 0]))
    assert abs(azimuth[-1] - azimuth[0]) == pytest.approx(2 * math.pi * 35 / 36)


def test_cameras_on_one_side_give_an_ellipse_between_them() -> None:
    scene = scene_of(WALL)
    eyes = np.stack([camera.camera_to_world[:3, 3] for camera in orbit(scene, 40)])
    assert np.abs(eyes[:, 0]).max() < 0.8 and np.ptp(eyes[:, 0]) > 0.8
    assert eyes[:, 2].min() > 0.4 and eyes[:, 2].max() < 0.9
    assert eyes[:, 1].max() < -3.5


@pytest.mark.parametrize("eyes", [RING, WALL, WALL[:1], [], [(0.0, 0.0, 3.0)], [(0.3, 0.1, 0.2)]])
def test_every_path_looks_at_the_focus_and_is_upright(eyes: list[tuple[float, float, float]]) -> None:
    scene = scene_of(eyes)
    rig = Rig.of(scene)
    for camera in orbit(scene, 9):
        pose = camera.camera_to_world
        assert pose[:3, :3].T @ pose[:3, :3] == pytest.approx(np.eye(3), abs=1e-9)
        assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)
        to_focus = rig.focus - pose[:3, 3]
        assert to_focus / np.linalg.norm(to_focus) == pytest.approx(-pose[:3, 2], abs=1e-9)
        assert pose[:3, 1] @ rig.up > -1e-9


def test_parallel_cameras_focus_on_the_centre_of_the_box() -> None:
    pose = look_at(np.array([0.0, 0.0, 4.0]), np.zeros(3), np.array([0.0, 1.0, 0.0]))
    moved = pose.copy()
    moved[0, 3] += 0.5
    cameras = tuple(Camera(8, 8, 8, 8, 4, 4, p) for p in (pose, moved))
    rig = Rig.of(replace(tiny_scene(0), cameras=cameras))
    assert rig.focus[2] == pytest.approx(tiny_scene(0).aabb[:, 2].mean(), abs=1e-6)


def test_surrounding_cameras_are_recognised() -> None:
    assert surround_focus(np.radians([0.0, 100.0, -110.0]))
    assert not surround_focus(np.radians([0.0, 60.0, -60.0]))
    assert not surround_focus(np.array([0.0]))


def test_fitting_keeps_the_vertical_field_of_view() -> None:
    camera = Camera(64, 48, 60, 62, 30, 25, np.eye(4))
    wide = fit_camera(camera, 128, 72)
    assert (wide.fl_y / wide.height, wide.cy / wide.height) == pytest.approx((62 / 48, 25 / 48))
    assert wide.fl_x / wide.fl_y == pytest.approx(60 / 62)
    assert (wide.cx - 64) / wide.fl_x == pytest.approx((30 - 32) / 60)
    assert fit_camera(camera, 64, 48) == camera


def test_presets_stay_within_the_filmed_angles() -> None:
    around, ahead = presets(scene_of(RING)), presets(scene_of(WALL))
    assert list(around) == ["front", "right", "back", "left", "above", "near", "far"]
    eyes = {name: camera.camera_to_world[:3, 3] for name, camera in around.items()}
    assert eyes["front"][:2] == pytest.approx(-eyes["back"][:2], abs=1e-6) and eyes["left"][:2] == pytest.approx(
        -eyes["right"][:2], abs=1e-6
    )
    assert eyes["above"][2] > 0.95 * np.linalg.norm(eyes["above"])
    assert np.linalg.norm(eyes["near"]) < np.linalg.norm(eyes["front"]) < np.linalg.norm(eyes["far"])
    xs = {name: camera.camera_to_world[0, 3] for name, camera in ahead.items()}
    assert -0.8 < xs["left"] < xs["middle"] < xs["right"] < 0.8 and ahead["below"].camera_to_world[2, 3] > 0.3
    for camera in (*around.values(), *ahead.values()):  # all look at the focus
        pose = camera.camera_to_world
        assert -pose[:3, 2] @ -pose[:3, 3] == pytest.approx(np.linalg.norm(pose[:3, 3]))
