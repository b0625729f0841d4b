"""Pictures in memory, as the processor's renderer draws them."""

from typing import NamedTuple

import numpy as np

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
