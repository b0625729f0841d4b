"""How many time rows a scene needs, found from its pictures before training.

With a static camera each pixel is a signal over time. Between rows of a space-time plane the model interpolates
linearly; what linear interpolation between rows cannot follow, the model cannot either. So rows are only as close as
the interpolation error requires. (With a motion grid they need not be, as it follows what moves.)
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from kpc.encoder.datasets import Dataset
from kpc.encoder.field.config import TrainConfig
from kpc.encoder.field.layout import time_rows
from kpc.encoder.training.importance import group_by_camera, has_static_cameras, premultiply_alpha

# The most cameras that are measured, spans of the clip for each, and pictures in a span.
CAMERAS, SPANS, SPAN = 6, 3, 240

# Rows of pixels of a picture that are measured.
LINES = 24

# Pixels of a camera's span that are measured, counted in every picture: 6 MB of float32. More only takes longer.
VALUES = 1 << 19

# The least share of the clip's frames that every camera must show; else the signal between its pictures is unknown.
MIN_COVERAGE = 0.5

# Standard deviation over time from which on a pixel counts as changing: as a share of the full range, and in standard
# deviations of the noise.
CHANGING = 0.03
NOISE_FACTOR = 3.0


@dataclass(frozen=True)
class TimeResolution:
    """What was measured on changing pixels. Errors and noise are shares of the full range.

    Attributes:
        frames_per_row: the widest spacing of rows within the tolerance, in frames.
        error: root mean square interpolation error with it, without what noise alone would leave.
        next_error: the same with the next wider spacing; NaN where there is none.
        noise: standard deviation of the noise of still pixels.
        changing: share of the pixels that change.
    """

    frames_per_row: int
    error: float
    next_error: float
    noise: float
    changing: float


def fit_frames_per_row(config: TrainConfig, dataset: Dataset) -> tuple[TrainConfig, TimeResolution | None]:
    """Return a configuration whose `frames_per_row` follows from the pictures, and what was measured.

    The configuration is unchanged, and the second None, where pictures cannot show it: with moving cameras, a motion
    grid, or `time_tolerance` 0. The result depends on dataset and configuration only.
    """
    if not config.time_tolerance or config.motion_cells or not has_static_cameras(dataset):
        return config, None
    found = measure_time_resolution(dataset, config.time_tolerance)
    return (config if found is None else replace(config, frames_per_row=float(found.frames_per_row))), found


def measure_time_resolution(dataset: Dataset, tolerance: float) -> TimeResolution | None:
    """Find the widest spacing of rows whose interpolation error is at most `tolerance`, a share of the full range.

    For the n colours y of a pixel over time and the hat functions H of the rows, least squares leave |y - H H^+ y|^2,
    of which noise of variance s^2 alone makes s^2 (n - rank H). The excess over that is averaged over changing pixels.
    s^2 is a sixth of the mean squared second difference, the median over the tenth of the pixels that change least.

    It takes the memory of VALUES pixels, whatever the length of the clip.

    Returns:
        None where a camera shows less than MIN_COVERAGE of the clip's frames.
    """
    frame_count = dataset.clip.frame_count
    cameras = group_by_camera(dataset)
    if min(len(numbers) for numbers in cameras) < MIN_COVERAGE * frame_count:
        return None
    spacings = _spacings(frame_count)
    bases: dict[tuple[bytes, int], np.ndarray] = {}
    excess, values, changing, pixels, noises = np.zeros(len(spacings)), 0, 0, 0, []
    for times, colours in _spans(dataset, cameras):
        n, count, _ = colours.shape
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
    # A row for every frame leaves no error but for rounding.
    within = next((k for k, error in enumerate(errors) if k and error > tolerance), len(spacings)) - 1
    beyond = float(errors[within + 1]) if within + 1 < len(spacings) else float("nan")
    return TimeResolution(
        spacings[within], float(errors[within]), beyond, float(np.sqrt(np.mean(noises))), changing / max(pixels, 1)
    )


def _spacings(frame_count: int) -> list[int]:
    """Return spacings 1, 2, 3, 4, 6, 8, 12, ... in frames, as long as a wider one saves a row."""
    powers = sorted({m << k for m in (1, 3) for k in range(frame_count.bit_length())})
    rows = [time_rows(frame_count, spacing) for spacing in powers]
    return [spacing for k, spacing in enumerate(powers) if k == 0 or rows[k] < rows[k - 1]]


def _basis(times: np.ndarray, rows: int) -> np.ndarray:
    """Return orthonormal columns (n, rank) that span the linear interpolations of rows at times (n,) in [0, 1]."""
    position = times.astype(np.float64) * (rows - 1)
    hats = np.maximum(0, 1 - np.abs(position[:, None] - np.arange(rows)))
    u, s, _ = np.linalg.svd(hats, full_matrices=False)
    return np.ascontiguousarray(u[:, s > 1e-6 * s[0]], np.float32)


def _noise(colours: np.ndarray, variance: np.ndarray) -> float:
    """Return the variance of the noise of colours (n, pixels, channels) over time; 0 with fewer than 3 pictures."""
    if len(colours) < 3:
        return 0.0
    stillest = np.argsort(variance, kind="stable")[: max(1, len(variance) // 10)]
    second = np.diff(colours[:, stillest], n=2, axis=0)
    return float(np.median(np.square(second).mean((0, 2), dtype=np.float64)) / 6)


def _spans(dataset: Dataset, cameras: list[np.ndarray]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield times (n,) and float32 colours (n, pixels, channels) in [0, 1] of evenly chosen spans and lines."""
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
    """Return `most` of the numbers below `count`, the middles of as many equal parts; or all if they are fewer."""
    most = min(count, most)
    return ((np.arange(most) + 0.5) * count / most).astype(np.int64) if most else np.zeros(0, np.int64)
