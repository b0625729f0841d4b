"""Bringing the clocks of several cameras in step: by sound where there is some, else by what moves."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import optimize

from kpc.encoder.datasets.sound_tracks import clarity, has_sound, read_samples
from kpc.encoder.poses.footage import Footage
from kpc.encoder.poses.motion_sync import PairOffset, align_motion
from kpc.encoder.poses.sound_sync import align_sound
from kpc.encoder.poses.survey import Survey
from kpc.format.common.progress import progress
from kpc.format.scene.sound import SAMPLE_RATE

# Alignments with less confidence are not used: shares of the pieces of sound, and of the pairs of curves, that agree.
LEAST_AGREEING, LEAST_CONFIDENCE = 0.6, 0.4
# Least correlation of two curves of motion, and least margin to any other offset, to be used.
LEAST_CORRELATION, LEAST_MARGIN = 0.5, 0.02
# Seconds of sound that are compared: of a longer recording, the beginning.
LONGEST_S = 600.0


@dataclass(frozen=True)
class Clock:
    """The clock of a camera: time of the clip = offset_s + rate * time of its file.

    Attributes:
        offset_s: seconds.
        rate: 1 without drift.
        method: "audio", "motion", "given", "reference" or "none".
        confidence: 0 to 1; NaN if nothing was measured.
    """

    offset_s: float
    rate: float
    method: str
    confidence: float


UNKNOWN = Clock(0.0, 1.0, "none", float("nan"))


def synchronise(footage: Sequence[Footage], surveys: Sequence[Survey], mode: str) -> list[Clock]:
    """Find the clock of each camera; one that cannot be found keeps the time of its file.

    Args:
        mode: one of `wishes.SYNC_MODES`.
    """
    clocks: list[Clock] = [UNKNOWN] * len(footage)
    if mode == "none" or len(footage) < 2 or any(one.video is None for one in footage):
        return clocks
    if mode in ("auto", "audio"):
        clocks = _by_sound(footage)
    if mode in ("auto", "motion") and any(clock.method == "none" for clock in clocks):
        clocks = _by_motion(footage, surveys, clocks)
    return clocks


def _by_sound(footage: Sequence[Footage]) -> list[Clock]:
    clocks = [UNKNOWN] * len(footage)
    tracks = {}
    for number, one in enumerate(footage):
        if has_sound(one.files[0]):
            samples = read_samples(one.files[0], 0.0, LONGEST_S)
            if samples is not None and not clarity(samples).is_silent:
                tracks[number] = samples.mean(1)
    if len(tracks) < 2:
        return clocks
    reference = max(
        tracks, key=lambda number: (len(tracks[number]) // (10 * SAMPLE_RATE), clarity(tracks[number][:, None]).rank)
    )
    clocks[reference] = Clock(0.0, 1.0, "reference", 1.0)
    for number in progress([n for n in tracks if n != reference], "aligning sound", unit="track"):
        found = align_sound(tracks[reference], tracks[number])
        if found.confidence >= LEAST_AGREEING:
            clocks[number] = Clock(found.offset_s, found.rate, "audio", found.confidence)
    return clocks if any(clock.method == "audio" for clock in clocks) else [UNKNOWN] * len(footage)


def _by_motion(footage: Sequence[Footage], surveys: Sequence[Survey], clocks: list[Clock]) -> list[Clock]:
    """Find the clocks that are unknown from the offsets between all pairs, most of which are to agree."""
    known = {number for number, clock in enumerate(clocks) if clock.method != "none"}
    times = [
        clock.offset_s + clock.rate * one.video.times for clock, one in zip(clocks, footage, strict=True) if one.video
    ]
    rate = [1 / float(np.median(np.diff(t))) if len(t) > 1 else 0.0 for t in times]
    pairs: dict[tuple[int, int], PairOffset] = {}
    for i, j in itertools.combinations(range(len(footage)), 2):
        if i in known and j in known:
            continue
        found = align_motion(times[i], surveys[i].motion, times[j], surveys[j].motion, max(rate[i], rate[j]))
        if found is not None and found.correlation >= LEAST_CORRELATION and found.margin >= LEAST_MARGIN:
            pairs[i, j] = found
    start = _spanning_offsets(pairs, known)
    if not known and not start:
        return clocks
    half_frame = 0.5 / max(rate)
    offsets = _agreed_offsets(pairs, start, known, half_frame)
    result = list(clocks)
    for number in offsets:
        if number in known:
            continue
        own = {pair: found for pair, found in pairs.items() if number in pair and all(n in offsets for n in pair)}
        agreeing = sum(
            found.margin for (i, j), found in own.items() if abs(offsets[j] - offsets[i] - found.offset_s) <= half_frame
        )
        share = agreeing / sum(found.margin for found in own.values()) if own else 0.0
        if share >= LEAST_CONFIDENCE:
            result[number] = Clock(offsets[number], 1.0, "motion", share)
    return result


def _spanning_offsets(pairs: dict[tuple[int, int], PairOffset], known: set[int]) -> dict[int, float]:
    """Return offsets to begin with, along the pairs of the widest margin from what is known, or the best pair."""
    if not pairs:
        return {}
    ranked = sorted(pairs, key=lambda pair: -pairs[pair].margin)
    offsets = dict.fromkeys(known or {ranked[0][0]}, 0.0)
    while True:
        pair = next((pair for pair in ranked if (pair[0] in offsets) != (pair[1] in offsets)), None)
        if pair is None:
            return offsets
        i, j = pair
        if i in offsets:
            offsets[j] = offsets[i] + pairs[pair].offset_s
        else:
            offsets[i] = offsets[j] - pairs[pair].offset_s


def _agreed_offsets(
    pairs: dict[tuple[int, int], PairOffset], start: dict[int, float], known: set[int], scale_s: float
) -> dict[int, float]:
    """Return the offsets that most pairs agree with: a robust least-squares fit."""
    fixed = known or {min(start)}
    free = [number for number in start if number not in fixed]
    used = [(pair, found) for pair, found in pairs.items() if pair[0] in start and pair[1] in start]
    if not free or not used:
        return start

    def residuals(values: np.ndarray) -> np.ndarray:
        now = start | dict(zip(free, values.tolist(), strict=True))
        return np.array([found.margin**0.5 * (now[j] - now[i] - found.offset_s) for (i, j), found in used])

    fit = optimize.least_squares(residuals, [start[n] for n in free], loss="soft_l1", f_scale=0.2 * scale_s)
    return start | dict(zip(free, fit.x.tolist(), strict=True))
