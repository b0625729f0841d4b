"""Rays through pixels of posed cameras, with OpenCV's lens distortion."""

import numpy as np

from kpc.encoder.datasets.dataset import Pictures
from kpc.format.scene.cameras import Camera
from kpc.format.scene.space import DeviceCoordinates, SpaceMapping


def pixel_rays(
    pictures: Pictures,
    picture: np.ndarray,  # (N,) int
    column: np.ndarray,  # (N,) int
    row: np.ndarray,  # (N,) int
    mapping: SpaceMapping | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the rays through the centres of pixels.

    d = normalise(R [x, -y, -1]),  (x, y) = undistort((column + 0.5 - cx) / fl_x, (row + 0.5 - cy) / fl_y)

    Args:
        pictures: the dataset's pictures.
        picture, column, row: number of the picture and position of each pixel.
        mapping: the scene's; device coordinates give rays in those, any other mapping gives world rays.

    Returns:
        Origins and unit directions, both (N, 3) float32.
    """
    fl_x, fl_y, cx, cy = pictures.intrinsics[picture].T
    x, y = (column + 0.5 - cx) / fl_x, (row + 0.5 - cy) / fl_y
    distortion = pictures.distortion[picture]
    if distortion.any():
        x, y = undistort(x, y, distortion)
    return _rays_through(x, y, pictures.camera_to_world[picture], mapping)


def camera_rays(
    camera: Camera,
    positions: np.ndarray,  # (N, 2) float, pixels from the left and top edges
    mapping: SpaceMapping | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the rays through image positions of a pinhole camera; see `pixel_rays`."""
    x, y = ((positions - (camera.cx, camera.cy)) / (camera.fl_x, camera.fl_y)).T
    return _rays_through(x, y, camera.camera_to_world[None], mapping)


def _rays_through(
    x: np.ndarray,  # (N,) slopes in the camera's frame
    y: np.ndarray,  # (N,)
    pose: np.ndarray,  # (N or 1, 4, 4)
    mapping: SpaceMapping | None,
) -> tuple[np.ndarray, np.ndarray]:
    directions = pose[:, :3, 0] * x[:, None] - pose[:, :3, 1] * y[:, None] - pose[:, :3, 2]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = np.broadcast_to(pose[:, :3, 3], directions.shape)
    if isinstance(mapping, DeviceCoordinates):
        mapped = mapping.rays(origins, directions)
        origins, directions = mapped.origins, mapped.directions
    return origins.astype(np.float32), directions.astype(np.float32)


def undistort(x: np.ndarray, y: np.ndarray, distortion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Invert OpenCV's lens distortion by Newton's method.

    x_d = x (1 + k1 r^2 + k2 r^4) + 2 p1 x y + p2 (r^2 + 2 x^2)
    y_d = y (1 + k1 r^2 + k2 r^4) + p1 (r^2 + 2 y^2) + 2 p2 x y

    Far outside the calibrated image the model may fold over. There the result is finite but meaningless.

    Args:
        x, y: (N,) distorted coordinates, normalised by focal length and principal point, y down.
        distortion: (N, 4) coefficients k1 k2 p1 p2.

    Returns:
        The undistorted coordinates, (N,) each.
    """
    k1, k2, p1, p2 = distortion.T
    u, v = x, y
    for _ in range(12):
        r2 = u * u + v * v
        radial = 1 + r2 * (k1 + r2 * k2)
        slope = 2 * (k1 + 2 * k2 * r2)
        residual_x = u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u) - x
        residual_y = v * radial + p1 * (r2 + 2 * v * v) + 2 * p2 * u * v - y
        xx = radial + u * u * slope + 2 * p1 * v + 6 * p2 * u
        yy = radial + v * v * slope + 6 * p1 * v + 2 * p2 * u
        xy = u * v * slope + 2 * p1 * u + 2 * p2 * v
        determinant = xx * yy - xy * xy
        determinant = np.where(np.abs(determinant) < 1e-6, 1e-6, determinant)
        step_u = np.clip((yy * residual_x - xy * residual_y) / determinant, -1, 1)
        step_v = np.clip((xx * residual_y - xy * residual_x) / determinant, -1, 1)
        u, v = u - step_u, v - step_v
        if max(np.abs(step_u).max(initial=0), np.abs(step_v).max(initial=0)) < 1e-10:
            break
    return u, v
