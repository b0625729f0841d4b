"""Pictures in memory, as the processor's renderer draws them, and interpolation in them."""

from typing import NamedTuple

import numpy as np

from kpc.player.cpu.lanes import F, I, kernel_part

# Pixels a side of the blocks that a picture is divided into.
BLOCK = 4


class Picture(NamedTuple):
    """A picture, rows from below."""

    rgba: np.ndarray  # (H, W, 4) float32: colour and opacity
    sums: np.ndarray  # (H, W, 2) float32: sum of weight times distance, number of samples

    @staticmethod
    def empty(size: tuple[int, int]) -> "Picture":
        """Make a picture of (width, height)."""
        width, height = size
        return Picture(np.zeros((height, width, 4), np.float32), np.zeros((height, width, 2), np.float32))


# Left, bottom, right and top of a part of a picture, pixels, rows from below; right and top are exclusive.
Rectangle = tuple[int, int, int, int]


def union(one: Rectangle, other: Rectangle) -> Rectangle:
    """Return the smallest rectangle that holds both; an empty one holds nothing."""
    parts = [part for part in (one, other) if part[0] < part[2] and part[1] < part[3]]
    if not parts:
        return 0, 0, 0, 0
    left, bottom, right, top = zip(*parts, strict=True)
    return min(left), min(bottom), max(right), max(top)


@kernel_part
def interpolate_pixel(picture, x, y, out):
    """Interpolate a (H, W, C) picture bilinearly at a point of its raster, to (C,); beyond its edges all is as at
    them."""
    height, width, channels = picture.shape
    x, y = min(max(x - F(0.5), F(0)), F(width - 1)), min(max(y - F(0.5), F(0)), F(height - 1))
    column, row = I(x), I(y)
    right, above = min(column + 1, width - 1), min(row + 1, height - 1)
    f, g = x - F(column), y - F(row)
    for channel in range(channels):
        low = picture[row, column, channel] + f * (picture[row, right, channel] - picture[row, column, channel])
        high = picture[above, column, channel] + f * (picture[above, right, channel] - picture[above, column, channel])
        out[channel] = low + g * (high - low)
