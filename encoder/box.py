"""Where the scene is: its axis-aligned box, and which parts of it the cameras see."""

import numpy as np

from kpc.encoder.datasets.dataset import Pictures
from kpc.format.errors import DatasetError

CLEAR = 0.3
"""Share of a camera's distance to the scene's middle, around it, where nothing is."""


def find_box(pictures: Pictures, has_alpha: bool) -> np.ndarray:
    """The (2, 3) float32 box the scene lies in.

    * Near and far known: the bounds of all frustums between them.
    * Cameras that look at a common point: a cube around it, as large as the widest view contains (pictures with alpha,
      an object on its own), or out to twice the cameras' distance (a subject in its surroundings).

    Raises:
        DatasetError: neither holds.
    """
    cameras = _distinct_cameras(pictures)
    if np.all(np.isfinite(pictures.near[cameras])) and np.all(np.isfinite(pictures.far[cameras])):
        corners = np.concatenate([_frustum(pictures, p) for p in cameras])
        return np.stack([corners.min(0), corners.max(0)]).astype(np.float32)
    focus = _focus(pictures, cameras)
    if focus is None:
        raise DatasetError("the cameras share no point they look at and have no near and far; give --box x0,y0,z0,x1,y1,z1")
    distance = np.linalg.norm(focus - pictures.camera_to_world[cameras, :3, 3], axis=1)
    if has_alpha:
        size = np.maximum(pictures.width[cameras] / pictures.intrinsics[cameras, 0],
                          pictures.height[cameras] / pictures.intrinsics[cameras, 1])
        half = np.max(distance * np.sin(np.arctan(size / 2)))
    else:
        half = 2 * np.median(distance)
    return np.stack([focus - half, focus + half]).astype(np.float32)


def seen_cells(pictures: Pictures, aabb: np.ndarray, shape: tuple[int, int, int], at_least: int = 2) -> np.ndarray:
    """Cells of an (Nz, Ny, Nx) grid over the box whose centre lies in view of at least so many distinct cameras: bool.

    What a single camera sees cannot be placed in depth; leaving it empty keeps floaters from growing in front of lenses.
    Where fewer cameras than that exist, all of them must see a cell. Nothing is within CLEAR of the way from a camera to the
    point all of them look at, in any direction: a camera that moves would else carry each of its pictures before it.
    """
    nz, ny, nx = shape
    axes = [aabb[0, a] + (np.arange(n) + 0.5) / n * (aabb[1, a] - aabb[0, a]) for a, n in enumerate((nx, ny, nz))]
    z, y, x = np.meshgrid(axes[2], axes[1], axes[0], indexing="ij")
    centres = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    cameras = _distinct_cameras(pictures)
    focus = _focus(pictures, cameras)
    count, blocked = np.zeros(len(centres), np.int32), np.zeros(len(centres), bool)
    for p in cameras:
        pose = pictures.camera_to_world[p]
        local = (centres - pose[:3, 3]) @ pose[:3, :3]
        depth = -local[:, 2]
        fx, fy, cx, cy = pictures.intrinsics[p]
        with np.errstate(divide="ignore", invalid="ignore"):
            i = cx + fx * local[:, 0] / depth
            j = cy - fy * local[:, 1] / depth
        near = pictures.near[p] if np.isfinite(pictures.near[p]) else 0.0
        margin = 0.02 * pictures.width[p]  # a cell whose centre is just outside still shows an edge
        inside = (i > -margin) & (i < pictures.width[p] + margin) & (j > -margin) & (j < pictures.height[p] + margin)
        count += (depth > 0.9 * near) & (depth > 0) & inside
        if focus is not None:
            blocked |= np.linalg.norm(local, axis=1) < CLEAR * np.linalg.norm(focus - pose[:3, 3])
    return ((count >= min(at_least, len(cameras))) & ~blocked).reshape(shape)


def _distinct_cameras(pictures: Pictures) -> np.ndarray:
    """One training picture for each distinct pose."""
    train = np.flatnonzero(~pictures.is_test)
    poses = np.round(pictures.camera_to_world[train].reshape(len(train), 16), 9)
    _, first = np.unique(poses, axis=0, return_index=True)
    return train[np.sort(first)]


def _frustum(pictures: Pictures, p: int) -> np.ndarray:
    """The eight corners of a picture's view between near and far, world coordinates."""
    fx, fy, cx, cy = pictures.intrinsics[p]
    w, h = pictures.width[p], pictures.height[p]
    local = np.array([
        [(i - cx) / fx * d, -(j - cy) / fy * d, -d]
        for d in (pictures.near[p], pictures.far[p]) for i in (0, w) for j in (0, h)
    ])
    pose = pictures.camera_to_world[p]
    return local @ pose[:3, :3].T + pose[:3, 3]


def _focus(pictures: Pictures, cameras: np.ndarray) -> np.ndarray | None:
    """What the cameras look at: the point of least squared distance to all optical axes.

    None where the axes are parallel, or the point lies behind more than a tenth of the cameras.
    """
    pose = pictures.camera_to_world[cameras]
    centres, forward = pose[:, :3, 3], -pose[:, :3, 2]
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    A = across.sum(0)
    if np.linalg.cond(A) > 1e6:
        return None
    focus = np.linalg.solve(A, np.einsum("nij,nj->i", across, centres))
    return focus if np.mean(np.sum((focus - centres) * forward, axis=1) > 0) >= 0.9 else None
