"""The extent of a scene: how its box and mapping are found, when that fails, and which cells cameras see."""

from dataclasses import replace

import numpy as np
import pytest

import datasets as make
from datasets import pictures_of
from kpc.encoder.field.bounds import (
    CLEARANCE,
    CONTRACTION_BOX,
    find_box,
    find_contraction_box,
    fit_contraction,
    fit_device_coordinates,
    is_unbounded,
    visible_cells,
)
from kpc.format.common.errors import DatasetError
from kpc.format.scene.cameras import Camera
from kpc.format.scene.space import Contraction, uncontract


def straight(x: float = 0.0, turned: bool = False) -> Camera:
    """Return a camera at (x, 0, 0) that looks along -z, or +z if turned: 90 degrees wide, 53 high."""
    pose = np.eye(4)
    pose[0, 3] = x
    if turned:
        pose[[0, 2], [0, 2]] = -1.0
    return Camera(40, 20, 20.0, 20.0, 20.0, 10.0, pose)


def test_known_near_and_far_give_the_bounds_of_the_frustums() -> None:
    box = find_box(pictures_of([straight(), straight(1.0)], near=1.0, far=4.0), has_alpha=False)
    assert box.dtype == np.float32
    # 90 degrees wide and 53 high: at depth 4, 4 to each side and 2 up and down; the second camera one to the right.
    np.testing.assert_allclose(box, [[-4, -2, -4], [5, 2, -1]], atol=1e-6)


def test_pictures_held_out_do_not_count() -> None:
    far_off = pictures_of([straight(), straight(1.0), straight(50.0)], near=1.0, far=4.0, tests=(2,))
    np.testing.assert_allclose(find_box(far_off, has_alpha=False), [[-4, -2, -4], [5, 2, -1]], atol=1e-6)


def test_the_box_of_a_single_object_fits_the_widest_view() -> None:
    rig = make.ring(5, width=20, height=20)
    box = find_box(pictures_of(rig), has_alpha=True)
    distance = np.linalg.norm(rig[0].camera_to_world[:3, 3])
    half = distance * np.sin(np.arctan(0.5 / 1.2))  # the sphere that touches the sides of a view 1 / 1.2 wide
    np.testing.assert_allclose(box, [[-half] * 3, [half] * 3], atol=1e-5)


def test_the_box_of_a_subject_in_surroundings_reaches_behind_the_cameras() -> None:
    rig = make.ring(5)
    half = 2 * np.linalg.norm(rig[0].camera_to_world[:3, 3])
    np.testing.assert_allclose(find_box(pictures_of(rig), has_alpha=False), [[-half] * 3, [half] * 3], atol=1e-5)


@pytest.mark.parametrize("has_alpha", [True, False])
def test_parallel_cameras_share_no_point(has_alpha: bool) -> None:
    with pytest.raises(DatasetError, match="--box"):
        find_box(pictures_of([straight(), straight(1.0)]), has_alpha)


def test_cameras_that_look_away_from_each_other_share_no_point() -> None:
    rig = [make.look_at((3 * np.sin(a), -3 * np.cos(a), 0.5)) for a in (0.0, 2.0, 4.0)]
    flipped = [
        Camera(c.width, c.height, c.fl_x, c.fl_y, c.cx, c.cy, c.camera_to_world @ np.diag([-1.0, 1, -1, 1]))
        for c in rig
    ]
    find_box(pictures_of(rig), False)
    with pytest.raises(DatasetError, match="no point they look at"):
        find_box(pictures_of(flipped), False)


def test_a_scene_is_unbounded_without_alpha_and_far() -> None:
    rig = make.ring(5)
    assert is_unbounded(pictures_of(rig), has_alpha=False)[0]
    assert not is_unbounded(pictures_of(rig), has_alpha=True)[0]
    assert not is_unbounded(pictures_of(rig, near=1.0, far=4.0), has_alpha=False)[0]
    assert is_unbounded(pictures_of(rig, near=1.0), has_alpha=False)[0]
    words = {is_unbounded(pictures_of(rig, near), alpha)[1] for near in (np.nan, 1.0) for alpha in (False, True)}
    assert len(words) == 2 and all(words)


def test_a_contraction_box_surrounds_what_the_cameras_look_at() -> None:
    rig = make.ring(5)
    half = CONTRACTION_BOX * np.linalg.norm(rig[0].camera_to_world[:3, 3])
    np.testing.assert_allclose(find_contraction_box(pictures_of(rig)), [[-half] * 3, [half] * 3], atol=1e-5)
    # Parallel ones look at nothing in common: then it is about them.
    apart = pictures_of([straight(), straight(1.0)])
    np.testing.assert_allclose(find_contraction_box(apart), [[-0.5, -1, -1], [1.5, 1, 1]], atol=1e-6)
    with pytest.raises(DatasetError, match="--box"):
        find_contraction_box(pictures_of([straight()]))


def test_uniform_steps_reach_the_far_corner_of_the_box() -> None:
    rig = pictures_of(make.ring(5))
    aabb = np.array([[-1, -2, -1], [1, 2, 3]], np.float32)
    corners = np.stack(np.meshgrid(*aabb.T, indexing="ij"), -1).reshape(-1, 3)
    farthest = np.linalg.norm(rig.camera_to_world[:, None, :3, 3] - corners, axis=2).max(1)
    even = fit_contraction(rig, aabb).uniform_distance
    assert farthest.min() <= even <= farthest.max() and even == pytest.approx(np.quantile(farthest, 0.9))


def test_visible_cells_of_contracted_space() -> None:
    """Cells ahead of the cameras are visible out to infinity, those behind are not."""
    aabb = np.array([[-1, -1, -1], [1, 1, 1]], np.float32)
    cameras = pictures_of([straight(), straight(0.1)])
    visible = visible_cells(cameras, aabb, (32, 32, 32), Contraction(2.0))
    z, y, x = (np.argwhere(np.ones_like(visible)).T + 0.5) / 32
    centres = uncontract(np.stack([x, y, z], axis=1), aabb)
    assert np.abs(centres).max() == pytest.approx(16)
    depth, clear = -centres[:, 2], 0.02 * 2  # the margin of a view 90 degrees wide and 53 high
    in_view = (depth > 0) & (np.abs(centres[:, 1]) < (0.5 + clear) * depth)
    for shift in (0.0, 0.1):
        in_view &= np.abs(centres[:, 0] - shift) < (1 + clear) * depth
    np.testing.assert_array_equal(visible.ravel(), in_view)
    assert visible[0].any() and not visible[16:].any()


def test_device_coordinates_of_a_row_of_cameras() -> None:
    mapping, box = fit_device_coordinates(pictures_of([straight(-0.5), straight(0.5)], near=1.0, far=4.0))
    np.testing.assert_allclose(mapping.frame, np.eye(4)[:3], atol=1e-12)
    assert mapping.near == pytest.approx(1) and mapping.baseline == pytest.approx(1)
    # x / z from -0.5 - 1 at the near plane to 0.5 + 1, y / z half as wide as one camera sees, 1 / 1 - 1 / 4 deep.
    np.testing.assert_allclose(box, [[-1.5, -0.5, 0], [1.5, 0.5, 0.75]], atol=1e-6)
    shape = (3, 4, 6)
    visible = visible_cells(pictures_of([straight(-0.5), straight(0.5)], near=1.0, far=4.0), box, shape, mapping)
    assert (
        visible[-1, :, 1:-1].all() and not visible[0, :, 0].any()
    )  # at the far end both see nearly all, at the near end not the sides


def test_device_coordinates_start_at_the_foremost_camera() -> None:
    ahead = straight()
    ahead.camera_to_world[2, 3] = -0.4
    mapping, box = fit_device_coordinates(pictures_of([straight(-0.5), straight(0.5), ahead], near=1.0, far=4.0))
    assert mapping.frame[2, 3] == pytest.approx(-0.4) and mapping.near == pytest.approx(0.6)
    assert box[1, 2] < mapping.baseline / mapping.near


@pytest.mark.parametrize(
    "rig", [[straight(), straight(turned=True)], [straight(), straight()]], ids=["apart", "one place"]
)
def test_rigs_without_device_coordinates(rig: list[Camera]) -> None:
    with pytest.raises(DatasetError, match="do not face one way"):
        fit_device_coordinates(pictures_of(rig, near=1.0, far=4.0))
    with pytest.raises(DatasetError, match="near and far"):
        fit_device_coordinates(pictures_of([straight(), straight(1.0)]))


def test_near_without_far_is_not_enough() -> None:
    with pytest.raises(DatasetError, match="--box"):
        find_box(pictures_of([straight(), straight(1.0)], near=1.0), False)


def test_cells_are_visible_from_two_cameras_on() -> None:
    box = np.array([[-2, -0.1, -2.2], [3, 0.1, -1.8]], np.float32)  # a bar 2 in front, in cells of 0.5
    shape = (1, 1, 10)
    x = -2 + 0.5 * (np.arange(10) + 0.5)
    both = visible_cells(pictures_of([straight(), straight(1.0)]), box, shape)
    assert both.shape == shape and both.dtype == bool
    margin = 0.02 * 2 * 2  # of the picture's width, 2 away
    np.testing.assert_array_equal(both[0, 0], (np.abs(x) < 2 + margin) & (np.abs(x - 1) < 2 + margin))
    either = visible_cells(pictures_of([straight(), straight(1.0)]), box, shape, at_least=1)
    assert either.all()
    alone = visible_cells(pictures_of([straight(), straight(1.0)], tests=(1,)), box, shape)
    np.testing.assert_array_equal(alone[0, 0], np.abs(x) < 2 + margin)


def test_cells_behind_a_camera_and_before_near_are_not_visible() -> None:
    box = np.array([[-0.1, -0.1, -4], [0.1, 0.1, 4]], np.float32)
    rig = pictures_of([straight(), straight(0.05)], near=2.0, far=9.0)
    z = -4 + 0.5 * (np.arange(16) + 0.5)
    np.testing.assert_array_equal(visible_cells(rig, box, (16, 1, 1))[:, 0, 0], -z > 1.8)


def test_the_same_camera_twice_is_one() -> None:
    box = np.array([[-0.1, -0.1, -4], [0.1, 0.1, -1]], np.float32)
    twice_and_turned = pictures_of([straight(), straight(), straight(turned=True)])
    assert not visible_cells(twice_and_turned, box, (2, 2, 2)).any()
    assert visible_cells(pictures_of([straight(), straight()]), box, (2, 2, 2)).all()


def test_cells_close_to_a_camera_are_not_visible() -> None:
    rig = make.ring(6, width=20, height=20)
    distance = np.linalg.norm(rig[0].camera_to_world[:3, 3])
    aabb = np.array([[-distance] * 3, [distance] * 3], np.float32)
    shape = (40, 40, 40)
    visible = visible_cells(pictures_of(rig), aabb, shape)
    z, y, x = (np.argwhere(visible).T + 0.5) / 40
    centres = aabb[0] + np.stack([x, y, z], axis=1) * (aabb[1] - aabb[0])
    nearest = min(np.linalg.norm(centres - c.camera_to_world[:3, 3], axis=1).min() for c in rig)
    assert visible.any() and CLEARANCE * distance <= nearest < (CLEARANCE + 0.1) * distance


def test_cameras_that_look_apart_have_no_clearance() -> None:
    turned = np.diag([-1.0, 1.0, -1.0, 1.0])
    apart = [replace(c, camera_to_world=c.camera_to_world @ turned) for c in make.ring(6, width=20, height=20)]
    distance = np.linalg.norm(apart[0].camera_to_world[:3, 3])
    aabb = np.array([[-2 * distance] * 3, [2 * distance] * 3], np.float32)
    visible = visible_cells(pictures_of(apart), aabb, (40, 40, 40), at_least=1)
    z, y, x = (np.argwhere(visible).T + 0.5) / 40
    centres = aabb[0] + np.stack([x, y, z], axis=1) * (aabb[1] - aabb[0])
    assert np.linalg.norm(centres - apart[0].camera_to_world[:3, 3], axis=1).min() < CLEARANCE * distance / 2
