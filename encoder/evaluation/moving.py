"""Which pixels of a fixed camera's picture move: those that differ from their median over time."""

import numpy as np

from kpc.encoder.datasets import Dataset
from kpc.encoder.evaluation.ground_truth import ground_truth

MEDIAN_PICTURES = 31  # of a camera, at most, whose median over time shows what stands still
FEWEST_PICTURES = 3  # of a camera, without which nothing is known to move
MOVING = 0.04  # difference from the median, as a share of the range in one channel, from which on a pixel moves
GROWTH = 3  # pixels by which moving regions are grown
ROWS_AT_ONCE = 64  # bounds the memory of medians


class MovingPixels:
    """Finds the moving pixels of a dataset's pictures; it keeps the median of one camera at a time.

    Args:
        dataset: with the pictures.
        stride: every how many pixels of a row or column count.
    """

    def __init__(self, dataset: Dataset, stride: int = 1) -> None:
        self.dataset, self.stride = dataset, stride
        self._median: tuple[int, np.ndarray | None] = (-1, None)

    def mask(self, number: int) -> np.ndarray | None:
        """Return (H, W) bool, the pixels of a picture that move; None where its camera has too few pictures."""
        camera = int(self.dataset.pictures.camera[number])
        if self._median[0] != camera:
            self._median = camera, self._median_of(camera)
        median = self._median[1]
        return None if median is None else moving_pixels(self._picture(number), median)

    def _median_of(self, camera: int) -> np.ndarray | None:
        pictures = self.dataset.pictures
        numbers = np.flatnonzero(pictures.camera == camera)
        if not self.dataset.is_dynamic or len(numbers) < FEWEST_PICTURES:
            return None
        numbers = numbers[np.argsort(pictures.time[numbers], kind="stable")]
        some = numbers[np.linspace(0, len(numbers) - 1, min(len(numbers), MEDIAN_PICTURES)).round().astype(int)]
        rows, height = ROWS_AT_ONCE * self.stride, int(pictures.height[numbers[0]])
        strips = [
            np.median([self._picture(int(number), top, min(top + rows, height)) for number in some], axis=0)
            for top in range(0, height, rows)
        ]
        return np.concatenate(strips)

    def _picture(self, number: int, top: int = 0, bottom: int | None = None) -> np.ndarray:
        return ground_truth(self.dataset, number, top, bottom)[:: self.stride, :: self.stride]


def moving_pixels(picture: np.ndarray, median: np.ndarray) -> np.ndarray:
    """Return (H, W) bool: where a picture differs by more than MOVING from the median over time, grown by GROWTH.

    Args:
        picture: (H, W, 3) in [0, 1].
        median: (H, W, 3), of pictures of the same camera at all times.
    """
    moving = (np.abs(picture - median) > MOVING).any(axis=-1)
    padded = np.pad(moving, GROWTH)
    size = 2 * GROWTH + 1
    windows = np.lib.stride_tricks.sliding_window_view(padded, (size, size))
    return np.asarray(windows.any(axis=(2, 3)))
