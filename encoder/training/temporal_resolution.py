"""How finely a scene has to be divided in time, found from its pictures before anything is trained.

Where a camera stands still, each pixel is a signal in time. Between rows of a space-time plane the model knows straight lines;
what straight lines between rows so far apart cannot follow, the model cannot either, so rows nearer to each other are only
needed where that is much. (With a motion grid they need not follow: it leads along what moves.)
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from kpc.encoder.datasets import Dataset
from kpc.encoder.field.config import TrainConfig
from kpc.encoder.field.field import time_rows
from kpc.encoder.training.importance import group_by_camera, has_static_cameras, premultiply_alpha

CAMERAS, SPANS, SPAN = 6, 3, 240
"""At most so many cameras are looked at, each over so many spans of the clip of so many pictures at most."""

LINES = 24
"""Rows of pixels of a picture that are looked at."""

VALUES = 1 << 19
"""Pixels of a camera's span, counted in every picture, that are looked at: 6 MB of float32. More only take longer."""

SEEN_OFTEN = 0.5
"""Share of the clip's frames that every camera must show; else what lies between its pictures is not known."""

CHANGING = 0.03
"""Standard deviation over time, as a share of the full range, from which on a pixel counts as changing."""

NOISE_FACTOR = 3.0
"""That, in standard deviations of the noise, too."""


@dataclass(frozen=True)
class TimeResolution:
    """What was measured on pixels that change.

    Attributes:
        frames_per_row: the widest spacing within the tolerance, frames.
        error, next_error: root mean squared error that straight lines between rows leave with it, and with the next wider spacing
            (NaN where there is none), as a share of the full range, without what noise alone would leave.
        noise: standard deviation of a still pixel's noise, as a share of the full range.
        changing: share of the pixels that change.
    """

    frames_per_row: int
    error: float
    next_error: float
    noise: float
    changing: float


def fit_frames_per_row(config: TrainConfig, dataset: Dataset) -> tuple[TrainConfig, TimeResolution | None]:
    """A config whose `frames_per_row` is what the pictures ask for, and what was measured.

    The config as it is and None where the pictures cannot tell: cameras that move, a motion grid, or `time_tolerance` 0. Follows
    from the dataset and the config alone, so a run that is resumed finds the same.
    """
    if not config.time_tolerance or config.motion_cells or not has_static_cameras(dataset):
        return config, None
    found = measure_time_resolution(dataset, config.time_tolerance)
    return (config if found is None else replace(config, frames_per_row=float(found.frames_per_row))), found


def measure_time_resolution(dataset: Dataset, tolerance: float) -> TimeResolution | None:
    """The widest spacing of rows, in frames, whose error is at most `tolerance` (a share of the full range).

    For n colours y over time of a pixel and the hat functions H of the rows, least squares leave |y - H H^+ y|^2, of which noise of
    variance s^2 alone makes s^2 (n - rank H). Its excess over that is averaged over the pixels that change. s^2 is a sixth
    of the mean squared second difference, the median over the tenth of the pixels that change least. None where a camera shows
    too few of the clip's frames.

    Memory: VALUES pixels at a time, whatever the length of the clip.
    """
    frame_count = dataset.clip.frame_count
    cameras = group_by_camera(dataset)
    if min(len(numbers) for numbers in cameras) < SEEN_OFTEN * frame_count:
        return None
    spacings = _spacings(frame_count)
    bases: dict[tuple[bytes, int], np.ndarray] = {}
    excess, values, changing, pixels, noises = np.zeros(len(spacings)), 0, 0, 0, []
    for times, colours in _spans(dataset, cameras):
        n, count, channels = colours.shape
        colours -= colours.mean(0)
        variance = np.square(colours).mean((0, 2), dtype=np.float64)
        noise = _noise(colours, variance)
        moves = variance > max(CHANGING**2, NOISE_FACTOR**2 * noise)
        signal = colours[:, moves].reshape(n, -1)
        for k, spacing in enumerate(spacings):
            key = times.tobytes(), spacing
            if key not in bases:
                bases[key] = _basis(times, time_rows(frame_count, spacing))
            follows = np.square(bases[key].T @ signal).sum(dtype=np.float64)
            left = float(np.square(signal).sum(dtype=np.float64) - follows)
            excess[k] += left - noise * (n - bases[key].shape[1]) * signal.shape[1]
        values, changing, pixels = values + signal.size, changing + int(moves.sum()), pixels + count
        noises.append(noise)
    errors = np.sqrt(np.maximum(excess, 0) / max(values, 1))
    # A row for every frame leaves nothing, whatever rounding says.
    within = next((k for k, error in enumerate(errors) if k and error > tolerance), len(spacings)) - 1
    beyond = float(errors[within + 1]) if within + 1 < len(spacings) else float("nan")
    return TimeResolution(
        spacings[within], float(errors[within]), beyond, float(np.sqrt(np.mean(noises))), changing / max(pixels, 1)
    )


def _spacings(frame_count: int) -> list[int]:
    """1, 2, 3, 4, 6, 8, 12, ... frames, as long as a wider one saves a row."""
    powers = sorted({m << k for m in (1, 3) for k in range(frame_count.bit_length())})
    rows = [time_rows(frame_count, spacing) for spacing in powers]
    return [spacing for k, spacing in enumerate(powers) if k == 0 or rows[k] < rows[k - 1]]


def _basis(times: np.ndarray, rows: int) -> np.ndarray:
    """Orthonormal columns (n, rank) that span what `rows` rows can say at (n,) times in [0, 1]."""
    position = times.astype(np.float64) * (rows - 1)
    hats = np.maximum(0, 1 - np.abs(position[:, None] - np.arange(rows)))
    u, s, _ = np.linalg.svd(hats, full_matrices=False)
    return np.ascontiguousarray(u[:, s > 1e-6 * s[0]], np.float32)


def _noise(colours: np.ndarray, variance: np.ndarray) -> float:
    """Variance of the noise of (n, pixels, channels) colours in time; 0 where there are too few to tell."""
    if len(colours) < 3:
        return 0.0
    stillest = np.argsort(variance, kind="stable")[: max(1, len(variance) // 10)]
    second = np.diff(colours[:, stillest], n=2, axis=0)
    return float(np.median(np.square(second).mean((0, 2), dtype=np.float64)) / 6)


def _spans(dataset: Dataset, cameras: list[np.ndarray]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Times (n,) and float32 colours (n, pixels, channels) in [0, 1] of spans of the clip, cameras and lines chosen evenly."""
    pictures, pixels = dataset.pictures, dataset.pixels
    for camera in _evenly(len(cameras), CAMERAS):
        numbers = cameras[camera]
        for start in np.unique(np.linspace(0, max(0, len(numbers) - SPAN), SPANS).astype(int)):
            some = numbers[start : start + SPAN]
            height, width = int(pictures.height[some[0]]), int(pictures.width[some[0]])
            lines = _evenly(height, LINES)
            usable = np.ones((height, width), bool)
            for number in some if dataset.masks is not None else ():
                usable &= dataset.usable(int(number))
            row, column = np.nonzero(usable[lines])
            kept = _evenly(len(row), VALUES // len(some))
            row, column = row[kept], column[kept]
            colours = np.empty((len(some), len(row), pixels.channels), np.float32)
            for k, number in enumerate(some):
                shown = np.concatenate(
                    [premultiply_alpha(pixels.picture(int(number), int(line), int(line) + 1)) for line in lines]
                )
                colours[k] = shown[row, column]
            yield pictures.time[some], colours / np.float32(255)


def _evenly(count: int, most: int) -> np.ndarray:
    """`most` of `count` numbers from 0 on, or all of them, the middles of as many equal parts."""
    most = min(count, most)
    return ((np.arange(most) + 0.5) * count / most).astype(np.int64) if most else np.zeros(0, np.int64)
