"""Pictures of a dataset as rendered pictures are compared with them."""

import numpy as np

from kpc.encoder.datasets import Dataset

WHITE = np.ones(3, np.float32)


def ground_truth(dataset: Dataset, number: int, top: int = 0, bottom: int | None = None) -> np.ndarray:
    """Return a picture of the dataset as (H, W, 3) float32 in [0, 1], on white where it is transparent.

    Args:
        dataset: holds the picture.
        number: of the picture.
        top, bottom: first row, and the row after the last; None for all rows from `top` on.
    """
    picture = dataset.pixels.picture(number, top, bottom).astype(np.float32) / np.float32(255)
    if dataset.has_alpha:
        return picture[..., :3] * picture[..., 3:] + WHITE * (1 - picture[..., 3:])
    return picture[..., :3]
