"""Grids of cells over the box."""

import numpy as np


SPACE = (-3, -2, -1)
SPACE_AND_TIME = (-4, *SPACE)


def dilate(grid: np.ndarray, axes: tuple[int, ...] = SPACE) -> np.ndarray:
    """Cells that are set or share a face, an edge or a corner with one that is; over the last three axes, or those named."""
    for axis in axes:
        low, high = [slice(None)] * grid.ndim, [slice(None)] * grid.ndim
        low[axis], high[axis] = slice(None, -1), slice(1, None)
        wide = grid.copy()
        wide[tuple(low)] |= grid[tuple(high)]
        wide[tuple(high)] |= grid[tuple(low)]
        grid = wide
    return grid
