"""Where something that moves may be: where it has to be for all cameras that stand still to see a change there at once.

What moves fast is at each place for so short a part of the clip that the fog which every training begins with has long been cleared
away there before the planes have found it, and where no rays take samples nothing is ever found. These cells stay open.
"""

import numpy as np
from numba import njit, prange

from kpc.encoder.box import cell_centres, depth_limit, projected
from kpc.encoder.datasets import Dataset
from kpc.encoder.importance import faded, of_each_camera, tile_means
from kpc.format.space import SpaceMapping

TILE = 8
"""Pixels along the side of a tile; all in one have changed or none."""

CHANGE = 0.08
"""Of the full range, by which the pixels of a tile that has changed are off on average from what its camera mostly sees. Of the default
scene's ball at each instant nine tenths are found with 3 % of all cells; with 0.04, all with 6 %; with 0.15, two thirds with 1 %."""

AGREEING = 0.75
"""Share of the cameras that look at a cell which must see a change there: the others may have something in front of it."""

MOST = 0.1
"""Share of the cells that cameras look at: where more would be open, none are, for that part of the clip. Light has changed then, or a
camera was pushed, and rays would take samples everywhere. Of the default scene 3 % are
open at a time, of room 0.7 %."""

PICTURES = 25
"""Of a camera, spread over the clip, whose median is what it mostly sees."""

ROWS = 64
"""Of pixels at a time, whatever the height of a picture."""


def moving_cells(
    dataset: Dataset, aabb: np.ndarray, shape: tuple[int, int, int], slots: int, mapping: SpaceMapping | None = None
) -> np.ndarray:
    """(slots, Nz, Ny, Nx) bool: the cells over what the planes cover in which something may be, in each of `slots` equal parts of the
    clip, that is not there for most of it.

    For at least AGREEING of the training cameras that look at the middle of such a cell, and for two at least, the tile where they
    see it differs by CHANGE from the median of PICTURES in some picture of that part: the visual hull (Laurentini 1994) of changes.
    Where that is more than MOST of all cells, it is none.
    The dataset is one for which `cameras_stand_still`; lenses are taken to be straight.
    """
    pictures = dataset.pictures
    centres = cell_centres(aabb, shape, mapping)
    looking, agreeing = np.zeros(len(centres), np.uint16), np.zeros((slots, len(centres)), np.uint16)
    for numbers in of_each_camera(dataset):
        watched, changed = _tiles(dataset, numbers, slots)
        p = numbers[0]
        _add_camera(
            centres, pictures.camera_to_world[p, :3].astype(np.float64), pictures.intrinsics[p].astype(np.float64),
            np.array([pictures.width[p], pictures.height[p]]), depth_limit(pictures, p), watched, changed, looking, agreeing,
        )
    looked_at = looking >= 2
    found = looked_at & (agreeing >= AGREEING * looking)
    found[found.sum(1) > MOST * looked_at.sum()] = False
    return found.reshape(slots, *shape)


def _tiles(dataset: Dataset, numbers: np.ndarray, slots: int) -> tuple[np.ndarray, np.ndarray]:
    """Of the pictures of one camera: which tiles have usable pixels, (rows, columns) bool, and which change in each part of the clip,
    (slots, rows, columns) bool."""
    pictures = dataset.pictures
    height, width = int(pictures.height[numbers[0]]), int(pictures.width[numbers[0]])
    most = np.zeros((slots, -(-height // TILE), -(-width // TILE)), np.uint8)
    typical = numbers[np.unique(np.linspace(0, len(numbers) - 1, PICTURES).astype(int))]
    slot = np.minimum((pictures.time[numbers] * slots).astype(int), slots - 1)
    for row in range(0, height, ROWS):
        end = min(row + ROWS, height)
        median = np.median(np.stack([_rows(dataset, p, row, end) for p in typical]), axis=0).astype(np.int16)
        for s, p in zip(slot, numbers, strict=True):
            change = np.abs(_rows(dataset, p, row, end) - median).max(2).astype(np.uint8)
            means = tile_means(change[None], dataset.usable(int(p))[None, row:end], TILE)[0]
            part = most[s, row // TILE :][: len(means)]
            np.maximum(part, means, out=part)
    return most.max(0) > 0, most > round(255 * CHANGE)


def _rows(dataset: Dataset, number: int, start: int, end: int) -> np.ndarray:
    return faded(dataset.pixels.picture(int(number), start, end))


@njit(parallel=True, cache=True)
def _add_camera(points, pose, intrinsics, size, least_depth, watched, changed, looking, agreeing):
    """Count a camera in `looking` (N,) for all of (N, 3) points that it looks at, and in `agreeing` (slots, N) where it sees a change."""
    for n in prange(len(points)):
        i, j, depth = projected(points[n], pose, intrinsics)
        if not depth > least_depth or not (0 <= i < size[0] and 0 <= j < size[1]):
            continue
        down, along = int(j) // TILE, int(i) // TILE
        looking[n] += watched[down, along]
        for slot in range(len(changed)):
            agreeing[slot, n] += changed[slot, down, along]
