"""Offsets between videos from when things move in them.

The curves of motion of two cameras rise and fall together, whatever they see it from. They are correlated at all
offsets; a step is a quarter of a frame, and a parabola through the best one and its neighbours is finer.
"""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from kpc.encoder.poses.sound_sync import parabola_peak

STEPS_PER_FRAME = 4
# Slow changes, such as of light, are taken out over this time.
TREND_S = 1.5
# Least overlap of two videos: seconds, and a share of the shorter one.
OVERLAP_S, OVERLAP = 0.5, 0.3
# What counts as another peak: offsets that are further away, in seconds.
APART_S = 0.15


@dataclass(frozen=True)
class PairOffset:
    """The offset between two videos.

    Attributes:
        offset_s: to be added to the times of the second to have those of the first.
        correlation: of the curves there, -1 to 1.
        margin: by how much the correlation is lower at any other offset.
    """

    offset_s: float
    correlation: float
    margin: float


def align_motion(
    first_times: np.ndarray, first: np.ndarray, second_times: np.ndarray, second: np.ndarray, fps: float
) -> PairOffset | None:
    """Find the offset between two curves of motion.

    Args:
        first_times, second_times: (N,) seconds of the frames.
        first, second: (N,) motion before each frame.
        fps: the higher of their frame rates.

    Returns:
        None if they are too short, or nothing moves.
    """
    step = 1 / (STEPS_PER_FRAME * fps)
    one, two = _curve(first_times, first, step), _curve(second_times, second, step)
    least = max(round(OVERLAP_S / step), round(OVERLAP * min(len(one), len(two))), 8)
    if min(len(one), len(two)) < least or min(one.std(), two.std()) < 1e-9:
        return None
    lags = np.arange(least - len(two), len(one) - least + 1)  # of the second's start within the first
    found = np.array([_correlation(one, two, int(lag)) for lag in lags])
    peak = int(found.argmax())
    far = np.abs(lags - lags[peak]) * step > APART_S
    margin = float(found[peak] - found[far].max()) if far.any() else 0.0
    finer = parabola_peak(*found[peak - 1 : peak + 2]) if 0 < peak < len(found) - 1 else 0.0
    offset = float(first_times[1] - second_times[1] + (lags[peak] + finer) * step)
    return PairOffset(offset, float(found[peak]), margin)


def _curve(times: np.ndarray, motion: np.ndarray, step: float) -> np.ndarray:
    """Return the motion from the second frame on at even steps of time, in logarithms and without its trend."""
    if len(times) < 4:
        return np.zeros(0)
    grid = np.arange(times[1], times[-1], step)
    level = np.log(motion[1:] + 0.1 * float(motion[1:].mean()) + 1e-3)
    curve = np.interp(grid, times[1:], level)
    return curve - ndimage.uniform_filter1d(curve, max(round(TREND_S / step), 3), mode="nearest")


def _correlation(one: np.ndarray, two: np.ndarray, lag: int) -> float:
    """Return the correlation of two curves where they overlap, the second moved by `lag` steps."""
    a = one[max(lag, 0) : len(two) + lag]
    b = two[max(-lag, 0) :][: len(a)]
    a, b = a[: len(b)] - a[: len(b)].mean(), b - b.mean()
    size = float(np.sqrt((a**2).sum() * (b**2).sum()))
    return float((a * b).sum()) / size if size > 1e-12 else 0.0
