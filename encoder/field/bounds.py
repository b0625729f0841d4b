"""Where the scene is: its axis-aligned box, and which parts of it the cameras see."""

import numpy as np
from kpc.encoder.datasets import Pictures
from kpc.format.common.errors import DatasetError
from kpc.format.scene.space import Contraction, DeviceCoordinates, SpaceMapping, uncontract
from numba import njit, prange

CLEARANCE = 0.3
"""Share of a camera's distance to the scene's middle, around it, where nothing is."""

CONTRACTION_BOX = 0.5
"""Half the edge of a contracted scene's box over the cameras' distance from what they look at. Held-out PSNR of fox at a
quarter of its size after 1,500 steps of `fast`: 26.2 dB with 1, 27.3 with 0.5, 27.1 with 0.35."""


def find_box(pictures: Pictures, has_alpha: bool) -> np.ndarray:
    """The (2, 3) float32 box the scene lies in.

    * Near and far known: the bounds of all frustums between them.
    * Cameras that look at a common point: a cube around it, as large as the widest view contains (pictures with alpha,
      an object on its own), or out to twice the cameras' distance (a subject in its surroundings).

    Raises:
        DatasetError: neither holds.
    """
    cameras = _distinct_cameras(pictures)
    if _near_and_far_known(pictures, cameras):
        corners = np.concatenate([_frustum(pictures, p) for p in cameras])
        return np.stack([corners.min(0), corners.max(0)]).astype(np.float32)
    focus = _focus(pictures, cameras)
    if focus is None:
        raise DatasetError(
            "the cameras share no point they look at and have no near and far; give --box x0,y0,z0,x1,y1,z1"
        )
    distance = np.linalg.norm(focus - pictures.camera_to_world[cameras, :3, 3], axis=1)
    if has_alpha:
        size = np.maximum(
            pictures.width[cameras] / pictures.intrinsics[cameras, 0],
            pictures.height[cameras] / pictures.intrinsics[cameras, 1],
        )
        half = np.max(distance * np.sin(np.arctan(size / 2)))
    else:
        half = 2 * np.median(distance)
    return np.stack([focus - half, focus + half]).astype(np.float32)


def is_unbounded(pictures: Pictures, has_alpha: bool) -> tuple[bool, str]:
    """Whether the pictures show more than a box can hold, and why, in words for the log.

    They do, but where

    * they have alpha: what was filmed is an object on its own;
    * every camera's near and far are known: they bound what it sees.
    """
    if has_alpha:
        return False, "the pictures have alpha: an object on its own"
    if _near_and_far_known(pictures, _distinct_cameras(pictures)):
        return False, "the cameras' near and far are known"
    return True, "nothing bounds what the cameras see"


def find_contraction_box(pictures: Pictures) -> np.ndarray:
    """The (2, 3) float32 box of a contracted scene, a cube.

    * Cameras that look at a common point: around it, out to INNER of their median distance.
    * Others: around their mean position, out to twice the farthest of them.

    Raises:
        DatasetError: all cameras are in one place.
    """
    cameras = _distinct_cameras(pictures)
    eyes, focus = pictures.camera_to_world[cameras, :3, 3], _focus(pictures, cameras)
    if focus is not None:
        centre, half = focus, CONTRACTION_BOX * np.median(np.linalg.norm(eyes - focus, axis=1))
    else:
        centre = eyes.mean(0)
        half = 2 * np.max(np.linalg.norm(eyes - centre, axis=1))
    if not half > 0:
        raise DatasetError("all cameras are in one place; give --box x0,y0,z0,x1,y1,z1")
    return np.stack([centre - half, centre + half]).astype(np.float32)


def fit_contraction(pictures: Pictures, aabb: np.ndarray) -> Contraction:
    """The contraction around a box whose even steps reach its farthest corner from nine cameras of ten."""
    eyes = pictures.camera_to_world[_distinct_cameras(pictures), :3, 3]
    corners = np.abs(eyes - aabb.mean(0)) + (aabb[1] - aabb[0]) / 2
    return Contraction(float(np.quantile(np.linalg.norm(corners, axis=1), 0.9)))


def fit_device_coordinates(pictures: Pictures) -> tuple[DeviceCoordinates, np.ndarray]:
    """Device coordinates for a rig that faces one way, and the (2, 3) float32 box there of all that lies between near and far.

    They are those of a camera that looks as all cameras look on average, from the middle of the rig as far forward as the
    foremost. The baseline is twice the distance of the outermost camera from the middle; near is the least depth of any
    camera's near plane.

    Raises:
        DatasetError: a camera's near or far is not known, or the cameras do not face one way: what one of them sees from near on
            lies less than a tenth of that depth before the foremost camera.
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
    corners = np.concatenate([_frustum(pictures, p) for p in cameras])
    near, typical = float(((eye - corners) @ back).min()), float(np.median(pictures.near[cameras]))
    baseline = 2 * float(np.linalg.norm(eyes - middle, axis=1).max())
    if not (near > typical / 10 and baseline > 0):
        raise DatasetError("the cameras do not face one way; try --space box or contracted")
    mapping = DeviceCoordinates(np.stack([right, np.cross(back, right), back, eye], axis=1), near, baseline)
    places = mapping.to_device(corners)
    return mapping, np.stack([places.min(0), places.max(0)]).astype(np.float32)


def visible_cells(
    pictures: Pictures,
    aabb: np.ndarray,
    shape: tuple[int, int, int],
    mapping: SpaceMapping | None = None,
    at_least: int = 2,
) -> np.ndarray:
    """Cells of an (Nz, Ny, Nx) grid over what the planes cover whose centre at least so many distinct cameras see: bool.

    What a single camera sees cannot be placed in depth; leaving it empty keeps floaters from growing in front of lenses.
    Where fewer cameras than that exist, all of them must see a cell. Nothing is within CLEAR of the way from a camera to the
    point all of them look at, in any direction: a camera that moves would else carry each of its pictures before it.
    """
    nz, ny, nx = shape
    low, edges = (np.zeros(3), np.ones(3)) if isinstance(mapping, Contraction) else (aabb[0], aabb[1] - aabb[0])
    axes = [low[a] + (np.arange(n) + 0.5) / n * edges[a] for a, n in enumerate((nx, ny, nz))]
    z, y, x = np.meshgrid(axes[2], axes[1], axes[0], indexing="ij")
    centres = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    if isinstance(mapping, Contraction):
        centres = uncontract(centres, aabb)
    elif mapping is not None:
        centres = mapping.to_world(centres)
    cameras = _distinct_cameras(pictures)
    focus = _focus(pictures, cameras)
    poses = pictures.camera_to_world[cameras, :3].astype(np.float64)
    near = np.where(np.isfinite(pictures.near[cameras]), pictures.near[cameras], 0.0)
    clear = np.zeros(len(cameras)) if focus is None else CLEARANCE * np.linalg.norm(focus - poses[:, :, 3], axis=1)
    sizes = np.stack([pictures.width[cameras], pictures.height[cameras]], axis=1)
    intrinsics = pictures.intrinsics[cameras].astype(np.float64)
    count, blocked = _views(centres.astype(np.float64), poses, intrinsics, sizes, 0.9 * near, clear)
    return ((count >= min(at_least, len(cameras))) & ~blocked).reshape(shape)


@njit(parallel=True, cache=True)
def _views(points, poses, intrinsics, sizes, near, clear):
    """How many cameras see each of (N, 3) points at a depth beyond `near` (C,), and whether it is nearer than `clear` (C,) to
    any: (N,) int32 and (N,) bool. `poses` (C, 3, 4) are camera-to-world."""
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
            margin = 0.02 * width  # a cell whose centre is just outside still shows an edge
            count[n] += -margin < i < width + margin and -margin < j < height + margin
    return count, blocked


def _distinct_cameras(pictures: Pictures) -> np.ndarray:
    """One training picture for each distinct pose."""
    train = np.flatnonzero(~pictures.is_test)
    poses = np.round(pictures.camera_to_world[train].reshape(len(train), 16), 9)
    _, first = np.unique(poses, axis=0, return_index=True)
    return train[np.sort(first)]


def _near_and_far_known(pictures: Pictures, cameras: np.ndarray) -> bool:
    return bool(np.all(np.isfinite(pictures.near[cameras])) and np.all(np.isfinite(pictures.far[cameras])))


def _frustum(pictures: Pictures, p: int) -> np.ndarray:
    """The eight corners of a picture's view between near and far, world coordinates."""
    fx, fy, cx, cy = pictures.intrinsics[p]
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
