"""Drawing coarse to fine: where a picture of half the resolution is interpolated well enough, and the interpolation.

The error of interpolation is estimated from how much colours bend: second differences of the coarse picture, over
eight. For a parabola that is exact between its pixels; for an edge it is not, but over all blocks of a picture
(soldier, room, liam) the squares of bends sum up to 62 to 75 times those of the errors.
"""

import numpy as np

from kpc.jit import compiled
from kpc.player.cpu.interpolation import interpolate_pixel
from kpc.player.cpu.lanes import FAST, F
from kpc.player.cpu.picture import BLOCK, Picture
from kpc.player.cpu.threads import share_out

# Pixels of the finer picture to one of the coarser, along each axis.
FACTOR = 2
# Mean over 4 points of a block and 3 channels, of squares of bends over 8.
SCALE = F(1 / (3 * 4 * 64))


def interpolation_errors(coarse: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Estimate the mean squared error of each block of a picture of (width, height) that is interpolated from a coarse
    one.

    Args:
        coarse: (h, w, 4) float32, rgba.

    Returns:
        (rows, columns) float32, squares of the full range.
    """
    width, height = size
    errors = np.empty((-(-height // BLOCK), -(-width // BLOCK)), np.float32)
    share_out(lambda part: _errors(part.start, part.stop, coarse, width, height, errors), len(errors))
    return errors


def blocks_over(errors: np.ndarray, allowed: float) -> np.ndarray:
    """Choose the blocks of the largest errors, so that the mean over all blocks of the errors of the others is at most
    `allowed`: bool, as `errors`."""
    ordered = np.sort(errors, axis=None)
    kept = int(np.searchsorted(np.cumsum(ordered, dtype=np.float64), allowed * errors.size, side="right"))
    return np.asarray(errors > (ordered[kept - 1] if kept else -1.0))


def upsample(coarse: Picture, fine: Picture) -> None:
    """Interpolate a picture bilinearly to a finer raster."""
    share_out(lambda part: _upsample(part.start, part.stop, coarse, fine), len(fine.rgba))


@compiled(**FAST)
def _errors(first, last, coarse, width, height, errors):
    """Fill rows of `errors`."""
    last_row, last_column = coarse.shape[0] - 1, coarse.shape[1] - 1
    for row in range(first, last):
        for column in range(errors.shape[1]):
            squares = F(0)
            for point in range(4):
                # The middles of the block's quarters, in quarters of pixels of the fine picture.
                x, y = (
                    4 * BLOCK * column + BLOCK * (1 + 2 * (point & 1)),
                    4 * BLOCK * row + BLOCK * (1 + 2 * (point >> 1)),
                )
                i = min(y * (last_row + 1) // (4 * height), last_row)
                j = min(x * (last_column + 1) // (4 * width), last_column)
                below, above, left, right = max(i - 1, 0), min(i + 1, last_row), max(j - 1, 0), min(j + 1, last_column)
                for channel in range(3):
                    here = F(2) * coarse[i, j, channel]
                    bend = abs(coarse[i, left, channel] + coarse[i, right, channel] - here)
                    bend += abs(coarse[below, j, channel] + coarse[above, j, channel] - here)
                    squares += bend * bend
            errors[row, column] = squares * SCALE


@compiled(**FAST)
def _upsample(first, last, coarse, fine):
    """Fill rows of the fine picture."""
    height, width = fine.rgba.shape[:2]
    scale_x, scale_y = F(coarse.rgba.shape[1]) / F(width), F(coarse.rgba.shape[0]) / F(height)
    for row in range(first, last):
        y = (F(row) + F(0.5)) * scale_y
        for column in range(width):
            x = (F(column) + F(0.5)) * scale_x
            interpolate_pixel(coarse.rgba, x, y, fine.rgba[row, column])
            interpolate_pixel(coarse.sums, x, y, fine.sums[row, column])
