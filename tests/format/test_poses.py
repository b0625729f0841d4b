"""Cameras under codec 2: what comes back, and how near it is."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from core_decoders import decode_poses
from kpc.format.coding.poses import are_rigid, encode_poses, round_poses
from kpc.format.scene.cameras import Camera
from kpc.format.scene.rotations import rotation_of


def camera(quaternion, place, lens=80.0):
    """A camera turned by a quaternion w x y z of any length."""
    pose = np.eye(4)
    pose[:3, :3] = rotation_of(np.asarray(quaternion))
    pose[:3, 3] = place
    return Camera(64, 48, lens, lens, 32.0, 24.0, pose)


def poses_of(cameras):
    return np.stack([one.camera_to_world for one in cameras])


def numbers_of(cameras):
    return [(c.width, c.height, c.fl_x, c.fl_y, c.cx, c.cy, *c.camera_to_world[:3].ravel().tolist()) for c in cameras]


@st.composite
def captures(draw):
    """Cameras anywhere, turned in any way, most often a right angle or nearly so."""
    count, span, away = (
        draw(st.integers(1, 9)),
        draw(st.sampled_from([0.0, 1e-30, 1e-3, 1.0, 3e4])),
        draw(st.sampled_from([0.0, 1.0, 2e4])),
    )
    part = st.one_of(st.sampled_from([-1.0, 0.0, 1.0, 1e-9, -1e-5]), st.floats(-1, 1))
    rng = np.random.default_rng(draw(st.integers(0, 1000)))
    turns = [draw(st.tuples(part, part, part, part).filter(lambda q: np.linalg.norm(q) > 0.1)) for _ in range(count)]
    lenses = [80.0] * count if draw(st.booleans()) else [80.0 + k for k in range(count)]
    return [camera(turn, away + span * rng.standard_normal(3), lens) for turn, lens in zip(turns, lenses, strict=True)]


@given(captures())
def test_rounded_cameras_come_back_as_they_are(cameras):
    near = round_poses(cameras)
    body = encode_poses(near)
    if body is not None:  # else one lies so near to two quaternions that either may be taken
        assert decode_poses(body) == numbers_of(near)
    assert np.abs(poses_of(near)[:, :3, :3] - poses_of(cameras)[:, :3, :3]).max() < 1.5e-5
    places = poses_of(cameras)[:, :3, 3]
    most = max(np.ptp(places, axis=0).max() / (2**18 - 1), np.abs(places).max() / 2**24)
    assert np.abs(poses_of(near)[:, :3, 3] - places).max() <= 1.01 * most


def test_most_cameras_take_fourteen_bytes_each():
    rng = np.random.default_rng(1)
    near = round_poses([camera(rng.standard_normal(4), rng.standard_normal(3)) for _ in range(500)])
    assert len(encode_poses(near)) == 17 + 20 + 14 * 500
    assert decode_poses(encode_poses(near)) == numbers_of(near)


@pytest.mark.parametrize(
    "quaternion", [(1, 0, 0, 0), (1, 1, 0, 0), (1, -1, 0, 0), (0, 0, 1, 1), (0, 1, 0, 0), (-1, 0, 0, 1)]
)
def test_right_angles_are_exact(quaternion):
    near = round_poses([camera(quaternion, (1.0, 2.0, 3.0))])
    assert np.array_equal(near[0].camera_to_world, np.rint(near[0].camera_to_world))
    assert decode_poses(encode_poses(near)) == numbers_of(near)


@pytest.mark.parametrize("change", [np.diag([1.0, 1.0, -1.0]), 1.1 * np.eye(3), np.eye(3) + np.diag([0.1, 0.0], 1)])
def test_what_is_more_than_a_turn_is_left_to_others(change):
    one = camera((1, 0, 0, 0), (0, 0, 0))
    one.camera_to_world[:3, :3] = change
    assert not are_rigid([one]) and encode_poses([one]) is None


def test_what_is_not_rounded_is_left_to_others():
    assert encode_poses([camera((1, 0.1, 0.2, 0.3), (0, 0, 0))]) is None
