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
# An area that fills more of the space than this leaves next to nothing that stands still.
LARGEST = 0.9


@dataclass(frozen=True)
class MovingArea:
    """Where things move, in shares of the space that the planes cover.

    Attributes:
        box: `TrainConfig.moving_area`.
        times: (T,) in [0, 1], rising, at which the hull was found.
        hulls: (T, POINTS, POINTS, POINTS) bool, indexed [t, z, y, x]: the points that are seen to move at each.
    """

    box: tuple[float, ...]
    times: np.ndarray
    hulls: np.ndarray

    def cells(self, shape: tuple[int, int, int]) -> np.ndarray:
        """Return the cells of a grid of (Nz, Ny, Nx) cells that lie in a hull or beside it, bool."""
        at = np.ix_(*(((np.arange(count) + 0.5) / count * POINTS).astype(int) for count in shape))
        cells: np.ndarray = dilate(np.asarray(self.hulls.any(0)))[at]
        return cells

    def between(self, start: float, end: float) -> "MovingArea":
        """Return the same area with the hulls from one time to another, and the next one before and after.

        What moves may be anywhere between where it is seen at one time and at the next.
        """
        first = max(int(np.searchsorted(self.times, start, side="right")) - 1, 0)
        last = min(int(np.searchsorted(self.times, end)), len(self.times) - 1)
        own = slice(first, last + 1)
        times = np.clip((self.times[own] - start) / max(end - start, 1e-9), 0, 1)
        return MovingArea(self.box, times, self.hulls[own])


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
    times, hulls = _hulls(dataset, world_points(points, aabb, mapping))
    hull = points[hulls.any(0)]
    if not len(hull):
        return None, "no point is seen to move by several cameras"
    margin = MARGIN + 0.5 / POINTS
    low, high = np.maximum(hull.min(0) - margin, 0), np.minimum(hull.max(0) + margin, 1)
    share = float(np.prod(high - low))
    if share > LARGEST:
        return None, f"things move in {share:.0%} of the space"
    box = tuple(np.concatenate([low, high]).round(4).tolist())
    return MovingArea(box, times, hulls.reshape(-1, POINTS, POINTS, POINTS)), f"things move in {share:.0%} of the space"


def _hulls(dataset: Dataset, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return several times, (T,), and whether points (N, 3) lie in what moves at each: (T, N) bool."""
    pictures, moving, pinholes = dataset.pictures, MovingPixels(dataset), covering_pinholes(dataset.pictures)
    train = np.flatnonzero(~pictures.is_test)
    cameras, times = np.unique(pictures.camera[train]), np.unique(pictures.time[train])
    count = min(max(TIMES, -(-len(times) // FRAMES_APART)), len(times))
    times = times[np.linspace(0, len(times) - 1, count).round().astype(int)]
    seen = np.zeros(len(points), np.uint16)
    moves = np.zeros((len(times), len(points)), np.uint16)
    for camera in progress(cameras, "finding where things move", unit="cameras"):
        own = train[pictures.camera[train] == camera]
        numbers = [int(own[np.argmin(np.abs(pictures.time[own] - time))]) for time in times]
        if (mask := moving.mask(numbers[0])) is None:
            continue
        pose, pinhole = pictures.camera_to_world[numbers[0]], pinholes[numbers[0]]
        is_seen, row, column = _project(points, pose, pinhole, mask.shape)
        seen += is_seen
        for k, number in enumerate(numbers):
            mask = moving.mask(number)
            assert mask is not None
            moves[k] += is_seen & mask[row, column]
    enough = max(2, math.ceil(SEEN * len(cameras)))
    return times, (seen >= enough) & (moves >= np.ceil(MOVING * seen))


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
