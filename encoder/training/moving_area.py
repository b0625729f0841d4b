"""The area in which things move, found from what still cameras see change, before training.

What stands still then needs no space-time planes, and what moves gets texels of its own (`TrainConfig.moving_area`).
"""

import math
from dataclasses import dataclass

import numpy as np

from kpc.encoder.datasets import Dataset
from kpc.encoder.datasets.rays import covering_pinholes
from kpc.encoder.evaluation.moving import MovingPixels
from kpc.encoder.field.bounds import cell_centres, world_points
from kpc.encoder.field.occupancy_grid import dilate
from kpc.encoder.training.importance import has_static_cameras
from kpc.format.common.progress import progress
from kpc.format.scene.space import SpaceMapping

# Points along each axis at which the visual hull of what moves is found.
POINTS = 64
# The least number of times for that, and the most frames from one to the next.
TIMES, FRAMES_APART = 12, 4
# Share of the cameras that must see a point, and of those that must see something move there.
SEEN, MOVING = 0.6, 0.9
# Added on every side, in shares of the space, besides half the distance between points: nothing moves beyond.
MARGIN = 0.01
# An area that fills more of the space than this saves too little.
LARGEST = 0.5


@dataclass(frozen=True)
class MovingArea:
    """Where things move, in shares of the space that the planes cover.

    Attributes:
        box: `TrainConfig.moving_area`.
        hull: (POINTS, POINTS, POINTS) bool, indexed [z, y, x]: the points that are seen to move.
    """

    box: tuple[float, ...]
    hull: np.ndarray

    def cells(self, shape: tuple[int, int, int]) -> np.ndarray:
        """Return the cells of a grid of (Nz, Ny, Nx) cells that lie in the hull or beside it, bool."""
        at = np.ix_(*(((np.arange(count) + 0.5) / count * POINTS).astype(int) for count in shape))
        cells: np.ndarray = dilate(self.hull)[at]
        return cells


def find_moving_area(dataset: Dataset, aabb: np.ndarray, mapping: SpaceMapping | None) -> tuple[MovingArea | None, str]:
    """Find the area in which things move.

    A point belongs to the visual hull of what moves if, at one time at least, nearly all cameras that see it see
    something move there (`kpc.encoder.evaluation.moving`). The area is the hull's box.

    Args:
        aabb: (2, 3), the box. mapping: how space beyond it is held.

    Returns:
        The area, or None where there is none, and the reason for the log.
    """
    if not has_static_cameras(dataset):
        return None, "cameras move, or show one picture each"
    points = cell_centres((POINTS, POINTS, POINTS))
    is_hull = _hull(dataset, world_points(points, aabb, mapping))
    hull = points[is_hull]
    if not len(hull):
        return None, "no point is seen to move by several cameras"
    margin = MARGIN + 0.5 / POINTS
    low, high = np.maximum(hull.min(0) - margin, 0), np.minimum(hull.max(0) + margin, 1)
    share = float(np.prod(high - low))
    if share > LARGEST:
        return None, f"things move in {share:.0%} of the space"
    box = tuple(np.concatenate([low, high]).round(4).tolist())
    return MovingArea(box, is_hull.reshape(POINTS, POINTS, POINTS)), f"things move in {share:.0%} of the space"


def _hull(dataset: Dataset, points: np.ndarray) -> np.ndarray:
    """Return whether points (N, 3) lie in what moves, at any of several times: (N,) bool."""
    pictures, moving, pinholes = dataset.pictures, MovingPixels(dataset), covering_pinholes(dataset.pictures)
    train = np.flatnonzero(~pictures.is_test)
    cameras, times = np.unique(pictures.camera[train]), np.unique(pictures.time[train])
    count = min(max(TIMES, -(-len(times) // FRAMES_APART)), len(times))
    times = times[np.linspace(0, len(times) - 1, count).round().astype(int)]
    seen = np.zeros((len(times), len(points)), np.int32)
    moves = np.zeros_like(seen)
    for camera in progress(cameras, "finding where things move", unit="cameras"):
        own = train[pictures.camera[train] == camera]
        for k, time in enumerate(times):
            number = int(own[np.argmin(np.abs(pictures.time[own] - time))])
            mask = moving.mask(number)
            if mask is None:
                continue
            is_seen, row, column = _project(points, pictures.camera_to_world[number], pinholes[number], mask.shape)
            seen[k] += is_seen
            moves[k] += is_seen & mask[row, column]
    enough = max(2, math.ceil(SEEN * len(cameras)))
    found: np.ndarray = ((seen >= enough) & (moves >= np.ceil(MOVING * seen))).any(0)
    return found


def _project(
    points: np.ndarray, pose: np.ndarray, pinhole: np.ndarray, shape: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return which points (N, 3) lie in a picture, and their rows and columns there, 0 for those that do not."""
    apart = points - pose[:3, 3]
    depth = -(apart @ pose[:3, 2])
    ahead = np.maximum(depth, 1e-9)
    column = pinhole[2] + pinhole[0] * (apart @ pose[:3, 0]) / ahead
    row = pinhole[3] - pinhole[1] * (apart @ pose[:3, 1]) / ahead
    is_seen = (depth > 0) & (column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0])
    return is_seen, np.where(is_seen, row, 0).astype(int), np.where(is_seen, column, 0).astype(int)
