"""Grids over the box: cells, and the places between corner-aligned nodes."""

import numpy as np

SPACE_AXES = (-3, -2, -1)
SPACE_TIME_AXES = (-4, *SPACE_AXES)


def dilate(grid: np.ndarray, axes: tuple[int, ...] = SPACE_AXES) -> np.ndarray:
    """Cells that are set or share a face, an edge or a corner with one that is; over the last three axes, or those named."""
    for axis in axes:
        low, high = [slice(None)] * grid.ndim, [slice(None)] * grid.ndim
        low[axis], high[axis] = slice(None, -1), slice(1, None)
        wide = grid.copy()
        wide[tuple(low)] |= grid[tuple(high)]
        wide[tuple(high)] |= grid[tuple(low)]
        grid = wide
    return grid


def texel_and_fraction(u: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Corner-aligned position u (size - 1), u in [0, 1], as a lower texel and the fraction towards the next."""
    position = np.clip(u, 0, 1) * np.float32(size - 1)
    lower = np.minimum(position.astype(np.int32), max(size - 2, 0))
    return lower, (position - lower).astype(np.float32)


def sample_linear(row: np.ndarray, u: np.ndarray | float) -> np.ndarray:
    """Sample a (size, ..., M) row at u in [0, 1], shape (N,) or a scalar: (1 - f) row[i] + f row[i + 1]."""
    i, f = texel_and_fraction(np.asarray(u, np.float32), len(row))
    f = f.reshape(f.shape + (1,) * (row.ndim - 1))
    return row[i] * (1 - f) + row[np.minimum(i + 1, len(row) - 1)] * f
