"""Rays through pixels of posed cameras, with OpenCV's models of lenses."""

from collections.abc import Sequence

import numpy as np

from kpc.encoder.datasets.dataset import Pictures
from kpc.format.scene.camera_checks import distort
from kpc.format.scene.cameras import Camera
from kpc.format.scene.space import DeviceCoordinates, SpaceMapping

# How to invert distortion: Newton steps at most; the share of its distance from the principal point by which a weak
# lens moves a point; parts of the way from there in which a strong lens is followed.
MOST_STEPS = 40
WEAK = 0.2
STAGES = 16

# The angle from the optical axis at which `covering_pinholes` end, in radians.
WIDEST = np.radians(80)


def pixel_rays(
    pictures: Pictures,
    picture: np.ndarray,  # (N,) int
    column: np.ndarray,  # (N,) int
    row: np.ndarray,  # (N,) int
    mapping: SpaceMapping | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the rays through the centres of pixels.

    d = normalise(R [x, -y, -1]),  (x, y) = undistort((column + 0.5 - cx) / fl_x, (row + 0.5 - cy) / fl_y)

    Of a fisheye lens, (x, y) has the length of the angle a from the optical axis: d = R [x s, -y s, -cos a] with
    s = sin(a) / a.

    Args:
        pictures: the dataset's pictures.
        picture, column, row: number of the picture and position of each pixel.
        mapping: the scene's; device coordinates give rays in those, any other mapping gives world rays.

    Returns:
        Origins and unit directions, both (N, 3) float32.
    """
    fl_x, fl_y, cx, cy = pictures.intrinsics[picture].T
    x, y = (column + 0.5 - cx) / fl_x, (row + 0.5 - cy) / fl_y
    local = local_directions(x, y, pictures.distortion[picture], pictures.is_fisheye[picture])
    return _rays_through(*local, pictures.camera_to_world[picture], mapping)


def camera_rays(
    camera: Camera,
    positions: np.ndarray,  # (N, 2) float, pixels from the left and top edges
    mapping: SpaceMapping | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the rays through image positions of a pinhole camera; see `pixel_rays`."""
    x, y = ((positions - (camera.cx, camera.cy)) / (camera.fl_x, camera.fl_y)).T
    return _rays_through(x, y, np.ones(1), camera.camera_to_world[None], mapping)


def covering_pinholes(pictures: Pictures) -> np.ndarray:
    """Return fl_x fl_y cx cy of pinholes that show what the pictures show, (P, 4): for bounds, not for rays.

    They differ from the intrinsics for fisheye lenses only, and end at WIDEST from the optical axis.
    """
    covering = pictures.intrinsics.copy()
    fisheyes = np.flatnonzero(pictures.is_fisheye)
    _, first = np.unique(pictures.camera[fisheyes], return_index=True)
    share = np.linspace(0, 1, 65)
    edge_x, edge_y = (
        np.concatenate([share, share, 0 * share, 0 * share + 1, [0.5]]),
        np.concatenate([0 * share, 0 * share + 1, share, share, [0.5]]),
    )
    for p in fisheyes[first].tolist():
        width, height = float(pictures.width[p]), float(pictures.height[p])
        fl_x, fl_y, cx, cy = pictures.intrinsics[p]
        number = np.full(len(edge_x), p)
        x, y, z = local_directions(
            (edge_x * width - cx) / fl_x,
            (edge_y * height - cy) / fl_y,
            pictures.distortion[number],
            pictures.is_fisheye[number],
        )
        depth = np.maximum(z, np.cos(WIDEST))
        (left, right), (top, bottom) = ((float((v / depth).min()), float((v / depth).max())) for v in (x, y))
        across, down = width / (right - left), height / (bottom - top)
        covering[fisheyes[pictures.camera[fisheyes] == pictures.camera[p]]] = across, down, -left * across, -top * down
    return covering


def local_directions(
    x: np.ndarray, y: np.ndarray, distortion: np.ndarray, is_fisheye: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return directions in the camera's frame, y down and z forward, through normalised points of pictures.

    Args:
        x, y: (N,) coordinates normalised by focal length and principal point, y down.
        distortion: (N, 8) coefficients DISTORTION_KEYS.
        is_fisheye: (N,) bool, whether they are those of the fisheye model.

    Returns:
        x and y, (N,) each, and z, (N,), or (1,) of pinholes alone: of depth 1, or for fisheye lenses of length 1.
    """
    if distortion.any():
        x, y = undistort(x, y, distortion, is_fisheye)
    if not is_fisheye.any():
        return x, y, np.ones(1)
    angle = np.hypot(x, y)
    scale = np.where(is_fisheye, np.sinc(angle / np.pi), 1.0)  # NumPy's sinc(t) is sin(pi t) / (pi t)
    return x * scale, y * scale, np.where(is_fisheye, np.cos(angle), 1.0)


def _rays_through(
    x: np.ndarray,  # (N,) directions in the camera's frame, y down and z forward
    y: np.ndarray,  # (N,)
    z: np.ndarray,  # (N or 1,)
    pose: np.ndarray,  # (N or 1, 4, 4)
    mapping: SpaceMapping | None,
) -> tuple[np.ndarray, np.ndarray]:
    directions = pose[:, :3, 0] * x[:, None] - pose[:, :3, 1] * y[:, None] - pose[:, :3, 2] * z[:, None]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = np.broadcast_to(pose[:, :3, 3], directions.shape)
    if isinstance(mapping, DeviceCoordinates):
        mapped = mapping.rays(origins, directions)
        origins, directions = mapped.origins, mapped.directions
    return origins.astype(np.float32), directions.astype(np.float32)


def undistort(
    x: np.ndarray, y: np.ndarray, distortion: np.ndarray, is_fisheye: np.ndarray | bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Invert OpenCV's lens distortion (`camera_checks.distort`) by Newton's method.

    A weak lens starts at the distorted point. A strong one could lead from there beyond a fold, so that its points are
    followed from the principal point outwards, in STAGES parts of the way. Ends where no step is longer than 1e-10,
    after MOST_STEPS at the latest. Within the picture the model is one-to-one (`check_lens`); far outside it may fold
    over, and there the result is finite but meaningless.

    Args:
        x, y: (N,) distorted coordinates, normalised by focal length and principal point, y down.
        distortion: (N, 8) coefficients DISTORTION_KEYS.
        is_fisheye: (N,) bool, whether they are those of the fisheye model.

    Returns:
        The undistorted coordinates, (N,) each: slopes, or for fisheye lenses the angle from the axis, by direction.
    """
    lens = (tuple(distortion.T), is_fisheye)
    moved_x, moved_y, _ = distort(x, y, *lens)
    u, v = x, y
    if (np.hypot(moved_x - x, moved_y - y) > WEAK * np.hypot(x, y)).any():
        u, v = np.zeros_like(x), np.zeros_like(y)
        for stage in range(1, STAGES):
            for _ in range(2):
                u, v, _ = _newton_step(u, v, x * stage / STAGES, y * stage / STAGES, lens)
    for _ in range(MOST_STEPS):
        u, v, length = _newton_step(u, v, x, y, lens)
        if length < 1e-10:
            break
    return u, v


def _newton_step(
    u: np.ndarray, v: np.ndarray, x: np.ndarray, y: np.ndarray, lens: tuple[Sequence[np.ndarray], np.ndarray | bool]
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return undistorted coordinates after a step towards those of x and y, and the longest step along an axis."""
    distorted_x, distorted_y, (xx, yy, xy) = distort(u, v, *lens)
    residual_x, residual_y = distorted_x - x, distorted_y - y
    determinant = xx * yy - xy * xy
    determinant = np.where(np.abs(determinant) < 1e-6, 1e-6, determinant)
    step_u = np.clip((yy * residual_x - xy * residual_y) / determinant, -1, 1)
    step_v = np.clip((xx * residual_y - xy * residual_x) / determinant, -1, 1)
    return u - step_u, v - step_v, max(np.abs(step_u).max(initial=0), np.abs(step_v).max(initial=0))
