"""How many held-out pictures are tested: as many as a share of the training time permits, on this machine."""

import time

import numpy as np

from kpc.encoder.datasets import Dataset, pixel_rays
from kpc.encoder.evaluation.evaluate import SceneRenderer, testable_pictures

TEST_SHARE = 0.1  # of the training time that testing may take
FEWEST_PICTURES = 4  # that are tested whatever that takes
RENDERINGS = 2  # of each picture: from the coded file and from the model
TIMED_RAYS = 1 << 14


def affordable_pictures(train_s: float, picture_s: float) -> int:
    """Return how many held-out pictures can be tested in TEST_SHARE of the training time, at least FEWEST_PICTURES.

    Args:
        train_s: seconds of training.
        picture_s: seconds of testing one picture.
    """
    return max(FEWEST_PICTURES, int(TEST_SHARE * train_s / max(picture_s, 1e-9)))


def picture_seconds(renderer: SceneRenderer, dataset: Dataset) -> float:
    """Return the seconds of testing one held-out picture, about, from TIMED_RAYS of its rays; 0 without any."""
    pictures, rng = dataset.pictures, np.random.default_rng(0)
    held_out = testable_pictures(dataset, right_halves=bool(renderer.scene.appearances))
    if not len(held_out):
        return 0.0
    number = rng.choice(held_out, TIMED_RAYS)
    column, row = (rng.integers(size[number]) for size in (pictures.width, pictures.height))
    origins, directions = pixel_rays(pictures, number, column, row, renderer.scene.mapping)
    pixels = float(np.mean(pictures.width[held_out].astype(np.int64) * pictures.height[held_out]))
    seconds = pixels * ray_seconds(renderer, origins, directions, pictures.time[number])
    if renderer.scene.appearances:
        started = time.perf_counter()
        renderer.fit_left_half(dataset, int(held_out[0]))
        seconds = seconds / 2 + time.perf_counter() - started
    return RENDERINGS * seconds


def ray_seconds(renderer: SceneRenderer, origins: np.ndarray, directions: np.ndarray, times: np.ndarray) -> float:
    """Return the seconds of rendering one of (N, 3) rays, after a first rendering that compiles."""
    rays = origins, directions, times
    renderer.rgb(*(a[:16] for a in rays))
    started = time.perf_counter()
    renderer.rgb(*rays)
    return (time.perf_counter() - started) / len(times)
