"""The extent of a scene: its axis-aligned box, its space mapping, and the cells that the cameras see."""

import numpy as np
from numba import njit, prange

from kpc.encoder.datasets import Pictures
from kpc.encoder.datasets.rays import covering_pinholes
from kpc.format.common.errors import DatasetError
from kpc.format.scene.space import Contraction, DeviceCoordinates, SpaceMapping, uncontract

# Radius around a camera in which nothing is, as a share of its distance to the point that all cameras look at.
CLEARANCE = 0.3

# Half the edge of a contracted scene's box, as a share of the cameras' distance from the point that they look at
# (measured: docs/design/training.md).
CONTRACTION_BOX = 0.5


def find_box(pictures: Pictures, has_alpha: bool) -> np.ndarray:
    """Return the (2, 3) float32 box that the scene lies in.

    * Where near and far are known: the bounds of all frustums between them.
    * Where cameras look at a common point: a cube around it, as large as the widest view contains (pictures with alpha:
      a single object), or out to twice the cameras' distance (a subject in surroundings).

    Raises:
        DatasetError: neither is the case.
    """
    cameras = _distinct_cameras(pictures)
    pinholes = covering_pinholes(pictures)
    if _near_and_far_known(pictures, cameras):
        corners = np.concatenate([_frustum(pictures, p, pinholes[p]) for p in cameras])
        return np.stack([corners.min(0), corners.max(0)]).astype(np.float32)
    focus = _focus(pictures, cameras)
    if focus is None:
        raise DatasetError(
            "the cameras share no point they look at and have no near and far; give --box x0,y0,z0,x1,y1,z1"
        )
    distance = np.linalg.norm(focus - pictures.camera_to_world[cameras, :3, 3], axis=1)
    if has_alpha:
        fl_x, fl_y = pinholes[cameras, :2].T
        size = np.maximum(pictures.width[cameras] / fl_x, pictures.height[cameras] / fl_y)
        half = np.max(distance * np.sin(np.arctan(size / 2)))
    else:
        half = 2 * np.median(distance)
    return np.stack([focus - half, focus + half]).astype(np.float32)


def is_unbounded(pictures: Pictures, has_alpha: bool) -> tuple[bool, str]:
    """Return whether the pictures show more than a box can hold, and the reason for the log.

    They do unless they have alpha, as of a single object, or near and far of every camera are known.
    """
    if has_alpha:
        return False, "the pictures have alpha: an object on its own"
    if _near_and_far_known(pictures, _distinct_cameras(pictures)):
        return False, "the cameras' near and far are known"
    return True, "nothing bounds what the cameras see"


def find_contraction_box(pictures: Pictures) -> np.ndarray:
    """Return the (2, 3) float32 box of a contracted scene, a cube.

    * Where cameras look at a common point: around it, out to CONTRACTION_BOX times their median distance.
    * Elsewhere: around their mean position, out to twice the distance of the farthest.

    Raises:
        DatasetError: all cameras have the same position.
    """
    cameras = _distinct_cameras(pictures)
    eyes, focus = pictures.camera_to_world[cameras, :3, 3], _focus(pictures, cameras)
    if focus is not None:
        centre, half = focus, CONTRACTION_BOX * np.median(np.linalg.norm(eyes - focus, axis=1))
    else:
        centre = eyes.mean(0)
        half = 2 * np.max(np.linalg.norm(eyes - centre, axis=1))
    if not half > 0:
        raise DatasetError("all cameras have the same position; give --box x0,y0,z0,x1,y1,z1")
    return np.stack([centre - half, centre + half]).astype(np.float32)


def fit_contraction(pictures: Pictures, aabb: np.ndarray) -> Contraction:
    """Return the contraction whose uniform steps reach the box's farthest corner from 90 % of the cameras."""
    eyes = pictures.camera_to_world[_distinct_cameras(pictures), :3, 3]
    corners = np.abs(eyes - aabb.mean(0)) + (aabb[1] - aabb[0]) / 2
    return Contraction(float(np.quantile(np.linalg.norm(corners, axis=1), 0.9)))


def fit_device_coordinates(pictures: Pictures) -> tuple[DeviceCoordinates, np.ndarray]:
    """Return device coordinates for a forward-facing rig, and the (2, 3) float32 box there of all frustums.

    They are those of a camera with the mean orientation of all, in the middle of the rig and as far forward as the
    foremost camera. The baseline is twice the distance of the outermost camera from the middle; near is the least depth
    of a near plane's corner.

    Raises:
        DatasetError: near or far of a camera are not known; or the cameras do not face one way, so that a corner of a
            near plane is nearer to the foremost camera's plane than a tenth of the median near.
    """
    cameras = _distinct_cameras(pictures)
    if not _near_and_far_known(pictures, cameras):
        raise DatasetError("device coordinates need each camera's near and far; try --space contracted")
    poses = pictures.camera_to_world[cameras, :3]
    eyes, back = poses[:, :, 3], poses[:, :, 2].mean(0)
    back = back / max(np.linalg.norm(back), 1e-9)
    right = np.cross(poses[:, :, 1].mean(0), back)
    right = right / max(np.linalg.norm(right), 1e-9)
    middle = eyes.mean(0)
    eye = middle + back * ((eyes - middle) @ back).min()
    pinholes = covering_pinholes(pictures)
    corners = np.concatenate([_frustum(pictures, p, pinholes[p]) for p in cameras])
    near, typical = float(((eye - corners) @ back).min()), float(np.median(pictures.near[cameras]))
    baseline = 2 * float(np.linalg.norm(eyes - middle, axis=1).max())
    if not (near > typical / 10 and baseline > 0):
        raise DatasetError("the cameras do not face one way; try --space box or contracted")
    mapping = DeviceCoordinates(np.stack([right, np.cross(back, right), back, eye], axis=1), near, baseline)
    coordinates = mapping.to_device(corners)
    return mapping, np.stack([coordinates.min(0), coordinates.max(0)]).astype(np.float32)


def cell_centres(shape: tuple[int, int, int]) -> np.ndarray:
    """Return the centres of the cells of an (Nz, Ny, Nx) grid over the planes, (Nz Ny Nx, 3) x, y, z in [0, 1]."""
    z, y, x = np.meshgrid(*((np.arange(n) + 0.5) / n for n in shape), indexing="ij")
    return np.stack([x, y, z], axis=-1).reshape(-1, 3)


def world_points(points: np.ndarray, aabb: np.ndarray, mapping: SpaceMapping | None) -> np.ndarray:
    """Return the world coordinates (N, 3) of points of the planes, (N, 3) in [0, 1]."""
    if isinstance(mapping, Contraction):
        return uncontract(points, aabb)
    inside: np.ndarray = aabb[0] + points * (aabb[1] - aabb[0])
    return inside if mapping is None else mapping.to_world(inside)


def visible_cells(
    pictures: Pictures,
    aabb: np.ndarray,
    shape: tuple[int, int, int],
    mapping: SpaceMapping | None = None,
    at_least: int = 2,
) -> np.ndarray:
    """Return the cells of an (Nz, Ny, Nx) grid over the planes whose centre enough cameras see, (Nz, Ny, Nx) bool.

    The depth of what a single camera sees is unknown; leaving such cells empty keeps floaters from growing in front of
    lenses. For the same reason cells within CLEARANCE of a camera are never visible: a moving camera could otherwise
    carry each of its pictures along.

    Args:
        shape: Nz, Ny, Nx.
        at_least: distinct cameras that must see a cell; all of them if there are fewer.
    """
    centres = world_points(cell_centres(shape), aabb, mapping)
    cameras = _distinct_cameras(pictures)
    focus = _focus(pictures, cameras)
    poses = pictures.camera_to_world[cameras, :3].astype(np.float64)
    near = np.where(np.isfinite(pictures.near[cameras]), pictures.near[cameras], 0.0)
    clear = np.zeros(len(cameras)) if focus is None else CLEARANCE * np.linalg.norm(focus - poses[:, :, 3], axis=1)
    sizes = np.stack([pictures.width[cameras], pictures.height[cameras]], axis=1)
    intrinsics = covering_pinholes(pictures)[cameras]
    count, blocked = _views(centres.astype(np.float64), poses, intrinsics, sizes, 0.9 * near, clear)
    return ((count >= min(at_least, len(cameras))) & ~blocked).reshape(shape)


@njit(parallel=True, cache=True)
def _views(points, poses, intrinsics, sizes, near, clear):
    """Return how many cameras see each point, (N,) int32, and whether any is closer than its clearance, (N,) bool.

    Args:
        points: (N, 3) world coordinates. poses: (C, 3, 4), camera-to-world. intrinsics: (C, 4), fx fy cx cy.
        sizes: (C, 2), width and height. near: (C,), the least depth at which a camera sees. clear: (C,), clearances.
    """
    count, blocked = np.zeros(len(points), np.int32), np.zeros(len(points), np.bool_)
    for n in prange(len(points)):
        for c in range(len(poses)):
            pose = poses[c]
            x, y, z = points[n, 0] - pose[0, 3], points[n, 1] - pose[1, 3], points[n, 2] - pose[2, 3]
            if x * x + y * y + z * z < clear[c] * clear[c]:
                blocked[n] = True
            depth = -(x * pose[0, 2] + y * pose[1, 2] + z * pose[2, 2])
            if not depth > max(near[c], 0.0):
                continue
            fx, fy, cx, cy = intrinsics[c]
            i = cx + fx * (x * pose[0, 0] + y * pose[1, 0] + z * pose[2, 0]) / depth
            j = cy - fy * (x * pose[0, 1] + y * pose[1, 1] + z * pose[2, 1]) / depth
            width, height = sizes[c]
            margin = 0.02 * width  # part of a cell whose centre is just outside is visible
            count[n] += -margin < i < width + margin and -margin < j < height + margin
    return count, blocked


def _distinct_cameras(pictures: Pictures) -> np.ndarray:
    """Return one training picture for each distinct pose."""
    train = np.flatnonzero(~pictures.is_test)
    poses = np.round(pictures.camera_to_world[train].reshape(len(train), 16), 9)
    _, first = np.unique(poses, axis=0, return_index=True)
    return train[np.sort(first)]


def _near_and_far_known(pictures: Pictures, cameras: np.ndarray) -> bool:
    """Return whether near and far of all cameras are known."""
    return bool(np.all(np.isfinite(pictures.near[cameras])) and np.all(np.isfinite(pictures.far[cameras])))


def _frustum(pictures: Pictures, p: int, pinhole: np.ndarray) -> np.ndarray:
    """Return the eight corners of a picture's frustum between near and far, (8, 3) world coordinates."""
    fx, fy, cx, cy = pinhole
    w, h = pictures.width[p], pictures.height[p]
    local = np.array(
        [
            [(i - cx) / fx * d, -(j - cy) / fy * d, -d]
            for d in (pictures.near[p], pictures.far[p])
            for i in (0, w)
            for j in (0, h)
        ]
    )
    pose = pictures.camera_to_world[p]
    return local @ pose[:3, :3].T + pose[:3, 3]


def _focus(pictures: Pictures, cameras: np.ndarray) -> np.ndarray | None:
    """Return the point that the cameras look at, of least squared distance to all optical axes, (3,).

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
