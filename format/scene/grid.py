"""Operations on grids: linear interpolation between corner-aligned samples, and dilation of boolean cells."""

import numpy as np

# The last three axes of an occupancy grid, z y x, and the last four, with time slots before them.
SPACE_AXES = (-3, -2, -1)
SPACE_TIME_AXES = (-4, *SPACE_AXES)


def dilate(grid: np.ndarray, axes: tuple[int, ...] = SPACE_AXES) -> np.ndarray:
    """Return a grid in which each cell has the largest value in a box of three cells a side along `axes` around it.

    A boolean grid is dilated by one cell, and diagonal neighbours are set, too.
    """
    for axis in axes:
        low, high = [slice(None)] * grid.ndim, [slice(None)] * grid.ndim
        low[axis], high[axis] = slice(None, -1), slice(1, None)
        wide = grid.copy()
        np.maximum(wide[tuple(low)], grid[tuple(high)], out=wide[tuple(low)])
        np.maximum(wide[tuple(high)], grid[tuple(low)], out=wide[tuple(high)])
        grid = wide
    return grid


def texel_and_fraction(u: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Split corner-aligned positions u (size - 1) into the lower texel and the fraction towards the next one.

    Args:
        u: any shape, clamped to [0, 1].
        size: texels along the axis, at least 1.

    Returns:
        int32 texels in [0, max(size - 2, 0)] and float32 fractions in [0, 1], in the shape of u.
    """
    position = np.clip(u, 0, 1) * np.float32(size - 1)
    lower = np.minimum(position.astype(np.int32), max(size - 2, 0))
    return lower, (position - lower).astype(np.float32)


def sample_linear(row: np.ndarray, u: np.ndarray | float) -> np.ndarray:
    """Interpolate a (size, ..., M) array linearly along its first axis: (1 - f) row[i] + f row[i + 1].

    Args:
        u: position in [0, 1], shape (N,) or a scalar.

    Returns:
        (N, ..., M), or (..., M) for a scalar.
    """
    i, f = texel_and_fraction(np.asarray(u, np.float32), len(row))
    f = f.reshape(f.shape + (1,) * (row.ndim - 1))
    return row[i] * (1 - f) + row[np.minimum(i + 1, len(row) - 1)] * f
