"""Offsets between two videos from when things move in them.

What moves rises and falls at the same time for both cameras, whatever they see it from. A `Signal` says how much moves
at even steps of time: in the whole picture, or in each of several parts that both cameras see
(`epipolar_motion`). Two signals are correlated at all offsets, and each offset gets a log-likelihood ratio.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

STEPS_PER_FRAME = 2
# Slow changes of whole pictures, such as of light, are taken out over this time.
TREND_S = 1.5
# Least overlap of two videos, in frames, and for whole pictures also in seconds and as a share of the shorter one.
LEAST_FRAMES = 5
OVERLAP_S, OVERLAP = 0.5, 0.3
# How much a change of motion over two steps counts beside the motion itself: it makes peaks narrow.
CHANGE = 2.0


@dataclass(frozen=True)
class Signal:
    """How much moves in a video, at even steps of its time.

    Attributes:
        first: number of the first step, counted from time 0.
        values: (N, 2K) logarithms, of K parts of the picture, and their changes from step to step.
    """

    first: int
    values: np.ndarray


@dataclass(frozen=True)
class Evidence:
    """How well each offset between two cameras agrees with what both see.

    Attributes:
        first: the least offset in steps; an offset is added to the times of the second to have those of the first.
        likelihood: (N,) logarithm of how much likelier what is seen is at an offset than at none.
        frames: (N,) frames by which the videos overlap there.
    """

    first: int
    likelihood: np.ndarray
    frames: np.ndarray

    def shifted(self, steps: int) -> "Evidence":
        return Evidence(self.first + steps, self.likelihood, self.frames)

    def swapped(self) -> "Evidence":
        """Return the evidence of the second camera and the first."""
        return Evidence(1 - self.first - len(self.likelihood), self.likelihood[::-1], self.frames[::-1])


def together(parts: Sequence[Evidence]) -> Evidence:
    """Return the evidence of all parts, over all offsets of any; there is one part or more."""
    first = min(part.first for part in parts)
    count = max(part.first + len(part.frames) for part in parts) - first
    total = Evidence(first, np.zeros(count), np.zeros(count))
    for part in parts:
        place = slice(part.first - first, part.first - first + len(part.frames))
        total.likelihood[place] += part.likelihood
        total.frames[place] += part.frames
    return total


def sampled(times: np.ndarray, motion: np.ndarray, step_s: float, trend_s: float = 0.0) -> Signal | None:
    """Return a signal at even steps of time; None of fewer than four frames.

    Args:
        times: (N,) seconds of the frames.
        motion: (N, K) how much moves before each frame; the first counts for nothing.
        step_s: seconds.
        trend_s: the mean over so many seconds is taken out; 0 for none.
    """
    if len(times) < 4:
        return None
    middles = (times[1:] + times[:-1]) / 2
    values = np.log(motion[1:] + 0.1 * float(motion[1:].mean()) + 0.05)
    first = int(np.ceil(middles[0] / step_s - 1e-6))
    steps = np.arange(first, int(np.floor(middles[-1] / step_s + 1e-6)) + 1)
    place = np.interp(steps * step_s, middles, np.arange(len(middles)))
    before = np.minimum(place.astype(int), len(middles) - 2)
    share = (place - before)[:, None]
    values = values[before] * (1 - share) + values[before + 1] * share
    values = values - ndimage.uniform_filter1d(values, max(round(trend_s / step_s), 3), axis=0) if trend_s else values
    changes = np.zeros_like(values)
    changes[1:-1] = values[2:] - values[:-2]
    return Signal(first, np.concatenate([values, CHANGE * changes], axis=1))


def curve_evidence(one: Signal, two: Signal, step_s: float) -> Evidence | None:
    """Return what two signals of whole pictures say; None if they are too short.

    What moves slowly says less: frames count as Bartlett has it ("Some aspects of the time-correlation problem",
    Journal of the Royal Statistical Society 98, 1935), n / (1 + 2 sum r1(k) r2(k)) with the autocorrelations r.
    """
    shorter = min(len(one.values), len(two.values))
    least = max(OVERLAP_S / step_s, OVERLAP * shorter, LEAST_FRAMES * STEPS_PER_FRAME)
    if shorter < least:
        return None
    reach = shorter // 3
    product = _autocorrelation(one.values)[1:reach] * _autocorrelation(two.values)[1:reach]
    return evidence(one, two, round(least), max(1 + 2 * float(product.sum()) / STEPS_PER_FRAME, 1.0))


def _autocorrelation(values: np.ndarray) -> np.ndarray:
    centred = values - values.mean(0)
    power = np.square(np.abs(np.fft.rfft(centred, 2 * len(values), axis=0))).sum(1)
    found = np.fft.irfft(power)[: len(values)]
    return found / max(float(found[0]), 1e-12)


def evidence(
    one: Signal, two: Signal, least: int = LEAST_FRAMES * STEPS_PER_FRAME, frames_as_one: float = 1.0
) -> Evidence | None:
    """Correlate two signals at all offsets by which they overlap long enough.

    With the correlation r of all parts over n frames, each part without its mean there, the logarithm of the
    likelihood ratio of normal variables is -n/2 log(1 - r^2).

    Args:
        one, two: signals of equal parts.
        least: steps by which they overlap at least.
        frames_as_one: n counts so many frames once.

    Returns:
        None if they are too short, or nothing moves.
    """
    a, b = (signal.values - signal.values.mean(0) for signal in (one, two))
    if min(len(a), len(b)) < least or min(float(np.square(x).mean()) for x in (a, b)) < 1e-9:
        return None
    lags = np.arange(least - len(b), len(a) - least + 1)  # of the start of b within a
    size = 1 << (len(a) + len(b) - 1).bit_length()
    spectrum = (np.fft.rfft(a, size, axis=0) * np.conj(np.fft.rfft(b, size, axis=0))).sum(1)
    products = np.fft.irfft(spectrum, size)[lags % size]
    start, end = np.maximum(lags, 0), np.minimum(len(a), len(b) + lags)
    steps = end - start
    sum_a, square_a = _sums(a, start, end)
    sum_b, square_b = _sums(b, start - lags, end - lags)
    covariance = products - (sum_a * sum_b).sum(1) / steps
    spread = (square_a - np.square(sum_a).sum(1) / steps) * (square_b - np.square(sum_b).sum(1) / steps)
    least_spread = 1e-6 * float(np.square(a).mean() * np.square(b).mean()) * a.shape[1] ** 2 * steps**2
    r = covariance / np.sqrt(np.maximum(spread, np.maximum(least_spread, 1e-12)))
    frames = steps / STEPS_PER_FRAME
    likelihood = -0.5 * frames / frames_as_one * np.sign(r) * np.log(1 - np.minimum(np.square(r), 0.9999))
    return Evidence(one.first - two.first + int(lags[0]), likelihood, frames)


def _sums(values: np.ndarray, start: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the sums of (N, K) values over spans of rows, (S, K), and of their squares over parts, too, (S,)."""
    sums = np.concatenate([np.zeros((1, values.shape[1])), values.cumsum(0)])
    squares = np.concatenate([[0.0], np.square(values).sum(1).cumsum()])
    return sums[end] - sums[start], squares[end] - squares[start]
