"""Rays of a dataset's pixels: pinhole cameras, downscaling and lens distortion."""

from pathlib import Path

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

import datasets as make
from datasets import all_rays, distorted, load
from kpc.encoder.datasets import pixel_rays
from kpc.encoder.datasets.rays import undistort


def test_rays_equal_those_of_the_pinhole_camera(tmp_path: Path) -> None:
    make.write_n3dv(tmp_path / "set")
    dataset = load(tmp_path / "set")
    for n in (0, 5, 11):
        origins, directions = all_rays(dataset, n)
        expected_origins, expected_directions = dataset.camera(n).rays()
        np.testing.assert_allclose(origins, expected_origins, atol=1e-6)
        np.testing.assert_allclose(directions, expected_directions, atol=1e-6)


def test_downscaled_intrinsics_keep_directions(tmp_path: Path) -> None:
    """A pixel of the downscaled picture has the direction of the centre of its block."""
    make.write_nerfstudio(tmp_path / "set", images=3)
    large, small = load(tmp_path / "set"), load(tmp_path / "set", downscale=4)
    assert small.pixels.picture(0).shape == (6, 8, 3)
    _, fine = all_rays(large, 1)
    _, coarse = all_rays(small, 1)
    corners = fine.reshape(6, 4, 8, 4, 3)[:, 1:3, :, 1:3]  # the four pixels around the centre
    middle = corners.mean((1, 3)).reshape(-1, 3)
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    # The mean of four unit vectors half a pixel off the centre errs by less than (half a pixel)^2 = (0.5 / 38.4)^2.
    assert np.abs(middle - coarse).max() < (0.5 / 38.4) ** 2 * 2


@given(st.integers(0, 2**32 - 1))
def test_undistortion_inverts_distortion(seed: int) -> None:
    rng = np.random.default_rng(seed)
    coefficients = rng.uniform(-1, 1, (40, 4)) * [0.15, 0.08, 0.01, 0.01]
    x, y = rng.uniform(-0.7, 0.7, (2, 40))  # from 0.8 on the strongest of these lenses fold over
    u, v = undistort(*distorted(x, y, coefficients), coefficients)
    np.testing.assert_allclose(np.stack([u, v]), np.stack([x, y]), atol=1e-9)


def test_undistortion_beyond_the_fold_is_finite() -> None:
    coefficients = np.tile([-0.9, 0.0, 0.0, 0.0], (50, 1))
    x = np.linspace(-3, 3, 50)
    assert np.isfinite(undistort(x, x, coefficients)).all()


def test_distorted_rays_pass_through_the_projected_points(tmp_path: Path) -> None:
    coefficients = np.array([[0.06, -0.08, -0.001, 0.0002]])  # of a real lens
    make.write_nerfstudio(
        tmp_path / "set", images=3, **dict(zip(("k1", "k2", "p1", "p2"), coefficients[0].tolist(), strict=True))
    )
    dataset = load(tmp_path / "set")
    assert "distortion" in dataset.describe()
    camera, p = dataset.camera(1), dataset.pictures
    points = np.random.default_rng(0).uniform(-0.7, 0.7, (20, 3))
    local = (points - camera.camera_to_world[:3, 3]) @ camera.camera_to_world[:3, :3]
    x, y = distorted(local[:, 0] / -local[:, 2], local[:, 1] / local[:, 2], coefficients)
    column, row = camera.cx + camera.fl_x * x - 0.5, camera.cy + camera.fl_y * y - 0.5
    origins, directions = pixel_rays(p, np.ones(20, int), column, row)
    along = ((points - origins) * directions).sum(1, keepdims=True)
    assert np.abs(origins + along * directions - points).max() < 1e-5  # float32 at a distance of 4 units
