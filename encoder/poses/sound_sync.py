"""Offset and drift between two sound tracks of one event.

First the onsets of sounds, 100 values a second, are correlated in windows, which finds any offset and survives drift.
Then the samples themselves are, by the phase of their cross-spectrum (GCC-PHAT: Knapp and Carter, "The generalized
correlation method for estimation of time delay", IEEE TASSP 1976), in short pieces along the clip.
"""

from dataclasses import dataclass

import numpy as np
from scipy import signal, stats

from kpc.format.scene.sound import SAMPLE_RATE

HOP = SAMPLE_RATE // 100  # samples between onset values
BANDS_HZ = np.geomspace(200.0, 8000.0, 17)

WINDOW_S = 8.0  # of onsets that are looked for in the other track
# A window is found if its correlation exceeds the mean by so many standard deviations.
FOUND = 6.0
# A track of no more than one window is tried at so many of the highest correlations,
# and with these rates, of 29.97 frames for 30, since it is too short to show its rate.
CANDIDATES, RATES = 8, (1.0, 1000 / 1001, 1001 / 1000)
DRIFT_LIMIT = 0.02  # seconds a second

# Pieces of the samples that are compared are so long, or a third of a shorter overlap, and shifted so far.
PIECE_S, LEAST_PIECE_S, REACH_S = 1.0, 0.15, 0.04
PIECES = 40  # at most, along the clip
AGREES_S = 0.002  # from the line through the pieces
# Drift is believed if it amounts to so much over the clip; less is an error of measurement.
LEAST_DRIFT_S = 0.004


@dataclass(frozen=True)
class Alignment:
    """How the clock of a track follows that of a reference: reference time = offset_s + rate * time.

    Attributes:
        offset_s: seconds.
        rate: 1 without drift.
        confidence: share of the pieces that agree, 0 to 1; 0 if nothing was found.
    """

    offset_s: float
    rate: float
    confidence: float


NOTHING = Alignment(0.0, 1.0, 0.0)


def align_sound(reference: np.ndarray, other: np.ndarray) -> Alignment:
    """Align two tracks of one channel, (N,) float32 at SAMPLE_RATE."""
    candidates = _align_onsets(onsets(reference), onsets(other))
    aligned = max(
        (_align_pieces(reference, other, offset_s, rate) for offset_s, rate in candidates),
        key=lambda found: found.confidence,
        default=NOTHING,
    )
    return aligned if aligned.rate == 1 else _align_pieces(reference, other, aligned.offset_s, aligned.rate)


def _align_pieces(reference: np.ndarray, other: np.ndarray, offset_s: float, rate: float) -> Alignment:
    """Align two tracks more finely than `offset_s` and `rate` do, by a line through the offsets of pieces."""
    times, offsets = _piece_offsets(reference, other, offset_s, rate)
    if len(times) < 3:
        return NOTHING
    slope = stats.theilslopes(offsets, times)[0] if len(times) >= 8 else 0.0
    if abs(slope) * np.ptp(times) < LEAST_DRIFT_S:
        slope = 0.0
    start = float(np.median(offsets - slope * times))
    agreeing = np.abs(offsets - slope * times - start) <= AGREES_S
    if agreeing.sum() < 3:
        return NOTHING
    if slope:
        slope, start = np.polyfit(times[agreeing], offsets[agreeing], 1)
    else:
        start = float(offsets[agreeing].mean())
    return Alignment(float(start), 1.0 + float(slope), float(agreeing.mean()))


def onsets(samples: np.ndarray) -> np.ndarray:
    """Return how much louder the bands of a track become, (N / HOP,) float64."""
    if len(samples) < 2 * HOP:
        return np.zeros(0)
    frequencies, _, spectrum = signal.stft(samples, SAMPLE_RATE, nperseg=1024, noverlap=1024 - HOP)
    power = np.abs(spectrum) ** 2
    band = np.digitize(frequencies, BANDS_HZ)
    bands = np.stack([power[band == number].sum(0) for number in range(1, len(BANDS_HZ))])
    floor = max(1e-10, 1e-4 * float(bands.mean()))
    return np.maximum(np.diff(np.log(bands + floor), axis=1), 0).sum(0)


def _align_onsets(reference: np.ndarray, other: np.ndarray) -> list[tuple[float, float]]:
    """Return offsets in seconds and rates by windows of onsets: of a short track, the most likely ones."""
    length = min(len(other), int(WINDOW_S * SAMPLE_RATE / HOP))
    if length < 50 or len(reference) < 50:
        return []
    if length == len(other):
        found = signal.correlate(reference - reference.mean(), other - other.mean(), mode="full", method="fft")
        peaks, _ = signal.find_peaks(found)
        highest = peaks[np.argsort(-found[peaks])[:CANDIDATES]]
        return [((int(peak) - (length - 1)) * HOP / SAMPLE_RATE, rate) for rate in RATES for peak in highest]
    times, lags, heights = [], [], []
    for start in range(0, len(other) - length + 1, max(length // 2, 1)):
        window = other[start : start + length] - other[start : start + length].mean()
        found = signal.correlate(reference - reference.mean(), window, mode="full", method="fft")
        peak = int(found.argmax())
        times.append((start + length / 2) * HOP / SAMPLE_RATE)
        finer = parabola_peak(*found[peak - 1 : peak + 2]) if 0 < peak < len(found) - 1 else 0.0
        lags.append((peak + finer - (length - 1) - start) * HOP / SAMPLE_RATE)
        heights.append((found[peak] - found.mean()) / max(float(found.std()), 1e-12))
    good = np.array(heights) >= FOUND
    if not good.any():
        return []
    t, lag = np.array(times)[good], np.array(lags)[good]
    slope = float(stats.theilslopes(lag, t)[0]) if len(t) >= 3 else 0.0
    slope = slope if abs(slope) <= DRIFT_LIMIT else 0.0
    return [(float(np.median(lag - slope * t)), 1.0 + slope)]


def _piece_offsets(
    reference: np.ndarray, other: np.ndarray, offset_s: float, rate: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the times of pieces of a track and the reference's time less theirs, both (N,) float64 in seconds."""
    first = max(0.0, (-offset_s + REACH_S) / rate)
    end = min(len(other) / SAMPLE_RATE, (len(reference) / SAMPLE_RATE - offset_s - REACH_S) / rate)
    piece_s = min(max((end - first) / 3, LEAST_PIECE_S), PIECE_S)
    last = end - piece_s
    if last <= first:
        return np.zeros(0), np.zeros(0)
    piece, reach = int(piece_s * SAMPLE_RATE), int(REACH_S * SAMPLE_RATE)
    times, offsets = [], []
    for time in np.linspace(first, last, min(PIECES, 1 + int((last - first) / (piece_s / 4)))):
        middle = time + piece_s / 2
        there = round((offset_s + rate * middle) * SAMPLE_RATE - piece / 2)
        begin = max(there - reach, 0)
        its = reference[begin : there + piece + reach]
        places = ((there + np.arange(piece)) / SAMPLE_RATE - offset_s) / rate * SAMPLE_RATE  # in the other track
        if len(its) < piece or places[0] < 0 or places[-1] > len(other) - 1:
            continue
        low = int(places[0])
        part = other[low : int(places[-1]) + 2]
        own = np.interp(places - low, np.arange(len(part)), part)
        delay = _delay(its, own)
        if delay is not None:
            times.append(middle)
            offsets.append(offset_s + rate * middle + (begin + delay - there) / SAMPLE_RATE - middle)
    return np.array(times), np.array(offsets)


def _delay(longer: np.ndarray, piece: np.ndarray) -> float | None:
    """Return where in `longer` a piece begins, in samples; None if it is silent."""
    if min(float(np.abs(longer).max()), float(np.abs(piece).max())) < 1e-4:
        return None
    size = 1 << (len(longer) + len(piece) - 1).bit_length()
    spectrum = np.fft.rfft(longer, size) * np.conj(np.fft.rfft(piece, size))
    found = np.fft.irfft(spectrum / np.maximum(np.abs(spectrum), 1e-12), size)[: len(longer) - len(piece) + 1]
    peak = int(found.argmax())
    return peak + (parabola_peak(*found[peak - 1 : peak + 2]) if 0 < peak < len(found) - 1 else 0.0)


def parabola_peak(before: float, at: float, after: float) -> float:
    """Return where the parabola through three values is greatest, from -0.5 to 0.5 of a step from the middle one."""
    bend = before - 2 * at + after
    return float(np.clip(0.5 * (before - after) / bend, -0.5, 0.5)) if bend < 0 else 0.0
