"""Rays of a dataset's pixels: pinhole cameras, downscaling and lens distortion."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import datasets as make
from datasets import all_rays, distorted, load, pictures_of
from kpc.encoder.datasets import pixel_rays
from kpc.encoder.datasets.rays import covering_pinholes, undistort
from kpc.format.scene.camera_checks import DISTORTION_KEYS


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
    u, v = undistort(*distorted(x, y, coefficients), np.pad(coefficients, ((0, 0), (0, 4))))
    np.testing.assert_allclose(np.stack([u, v]), np.stack([x, y]), atol=1e-9)


def test_undistortion_beyond_the_fold_is_finite() -> None:
    coefficients = np.tile([-0.9] + 7 * [0.0], (50, 1))
    x = np.linspace(-3, 3, 50)
    assert np.isfinite(undistort(x, x, coefficients)).all()


@pytest.mark.parametrize(
    ("model", "lens"),
    [
        ("OPENCV", {"k1": 0.06, "k2": -0.08, "p1": -0.001, "p2": 0.0002}),  # of a real lens
        ("OPENCV", {"k1": 0.06, "k2": -0.08, "p1": -0.001, "p2": 0.0002, "k3": 0.02}),
        ("FULL_OPENCV", dict(zip(DISTORTION_KEYS, (0.4, -0.1, 1e-3, -5e-4, 0.02, 0.35, -0.05, 0.01), strict=True))),
        ("OPENCV_FISHEYE", {"k1": -0.04, "k2": 0.02, "k3": -0.01, "k4": 0.002}),
        ("SIMPLE_RADIAL_FISHEYE", {"k1": 0.05}),
        ("FISHEYE", {}),
    ],
)
def test_distorted_rays_pass_through_the_projected_points(tmp_path: Path, model: str, lens: dict[str, float]) -> None:
    make.write_nerfstudio(tmp_path / "set", images=3, camera_model=model, **lens)
    dataset = load(tmp_path / "set")
    fisheye = "FISHEYE" in model
    assert ("fisheye" if fisheye else "distortion") in dataset.describe()
    camera, p = dataset.camera(1), dataset.pictures
    points = np.random.default_rng(0).uniform(-0.7, 0.7, (20, 3))
    local = (points - camera.camera_to_world[:3, 3]) @ camera.camera_to_world[:3, :3]
    names = ("k1", "k2", "k3", "k4") if fisheye else DISTORTION_KEYS
    coefficients = np.array([[lens.get(name, 0.0) for name in names]])
    x, y = distorted(local[:, 0] / -local[:, 2], local[:, 1] / local[:, 2], coefficients, fisheye)
    column, row = camera.cx + camera.fl_x * x - 0.5, camera.cy + camera.fl_y * y - 0.5
    origins, directions = pixel_rays(p, np.ones(20, int), column, row)
    along = ((points - origins) * directions).sum(1, keepdims=True)
    assert np.abs(origins + along * directions - points).max() < 1e-5  # float32 at a distance of 4 units


def test_a_fisheye_lens_shows_what_lies_beside_it() -> None:
    """Equidistant: a pixel that is a quarter turn's arc from the principal point shows what lies at right angles."""
    pictures = pictures_of([make.Camera(400, 300, 100.0, 100.0, 200.0, 150.0, np.eye(4))])
    pictures = replace(pictures, is_fisheye=np.ones(1, bool))
    quarter, number = 100 * np.pi / 2, np.zeros(3, int)
    column, row = np.array([200 + quarter, 200.0, 199.5]) - 0.5, np.array([150.0, 150 - quarter, 149.5]) - 0.5
    _, directions = pixel_rays(pictures, number, column, row)
    np.testing.assert_allclose(directions[:2], [[1, 0, 0], [0, 1, 0]], atol=1e-6)
    np.testing.assert_allclose(directions[2], [-0.005, 0.005, -1], atol=1e-4)


def test_covering_pinholes_hold_all_that_a_fisheye_lens_shows() -> None:
    """At a focal length of 300, 1.2 half widths of 240 pixels are 0.8 and 0.96 radians."""
    pictures = pictures_of([make.Camera(480, 360, 300.0, 300.0, 240.0, 180.0, np.eye(4))] * 2)
    pictures = replace(pictures, is_fisheye=np.array([False, True]))
    plain, covering = covering_pinholes(pictures)
    np.testing.assert_array_equal(plain, pictures.intrinsics[0])
    corner = np.hypot(0.8, 0.6)  # radians from the axis
    np.testing.assert_allclose(covering[:2], [240, 180] / (np.tan(corner) * np.array([0.8, 0.6])), rtol=1e-12)
    np.testing.assert_allclose(covering[2:], [240, 180])
