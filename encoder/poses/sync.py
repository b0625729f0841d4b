"""Bringing the clocks of several cameras in step: by sound where there is some, else by what moves."""

import itertools
from collections.abc import Sequence

import numpy as np

from kpc.encoder.datasets.sound_tracks import clarity, has_sound, read_samples
from kpc.encoder.poses.clocks import UNKNOWN, Clock
from kpc.encoder.poses.epipolar_motion import FRAMES_AS_ONE, directions, sheaf_signal, sheaves
from kpc.encoder.poses.footage import Footage
from kpc.encoder.poses.joint_offsets import joint_offsets
from kpc.encoder.poses.motion_sync import (
    STEPS_PER_FRAME,
    TREND_S,
    Evidence,
    curve_evidence,
    evidence,
    sampled,
    together,
)
from kpc.encoder.poses.sound_sync import align_sound
from kpc.encoder.poses.structure import PlacedView
from kpc.encoder.poses.survey import LONGEST, Survey
from kpc.format.common.progress import progress
from kpc.format.scene.sound import SAMPLE_RATE

# Alignments of sound are used if at least this share of its pieces agrees.
LEAST_AGREEING = 0.6
# Offsets from what moves are used if they are right with at least this probability, and are sure with the other.
LEAST_CONFIDENCE, SURE = 0.5, 0.9
# Seconds of sound that are compared: of a longer recording, the beginning.
LONGEST_S = 600.0


def clocks_by_sound(footage: Sequence[Footage], mode: str) -> list[Clock]:
    """Find the clock of each camera that has sound, if `mode` allows, one of `wishes.SYNC_MODES`."""
    clocks = [UNKNOWN] * len(footage)
    if mode not in ("auto", "audio") or not _are_videos(footage):
        return clocks
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


def wants_motion(footage: Sequence[Footage], clocks: Sequence[Clock], mode: str) -> bool:
    """Return whether clocks are missing that are to be found by what moves."""
    return mode in ("auto", "motion") and _are_videos(footage) and any(clock.method == "none" for clock in clocks)


def _are_videos(footage: Sequence[Footage]) -> bool:
    return len(footage) > 1 and all(one.video is not None for one in footage)


def clocks_by_motion(
    footage: Sequence[Footage], surveys: Sequence[Survey], clocks: Sequence[Clock], views: dict[int, PlacedView]
) -> list[Clock]:
    """Find the clocks that are unknown, by what moves in all pairs of cameras together.

    Args:
        footage, surveys, clocks: of each camera.
        views: places of cameras, as far as known: two of these are compared along epipolar lines.
    """
    known = {number for number, clock in enumerate(clocks) if clock.method != "none"}
    times = [
        clock.offset_s + clock.rate * one.video.times for clock, one in zip(clocks, footage, strict=True) if one.video
    ]
    intervals = [float(np.median(np.diff(t))) for t in times if len(t) > 1]
    if not intervals:
        return list(clocks)
    step_s = min(intervals) / STEPS_PER_FRAME
    pairs = _pairs(times, surveys, known, views, step_s)
    result = list(clocks)
    for number, found in joint_offsets(pairs, known).items():
        if number not in known and found.confidence >= LEAST_CONFIDENCE:
            result[number] = Clock(found.steps * step_s, 1.0, "motion", found.confidence)
    return result


def _pairs(
    times: list[np.ndarray], surveys: Sequence[Survey], known: set[int], views: dict[int, PlacedView], step_s: float
) -> dict[tuple[int, int], Evidence]:
    """Return what each two cameras say of the offset between them."""
    curves = [sampled(t, seen.motion[:, None], step_s, TREND_S) for t, seen in zip(times, surveys, strict=True)]
    rays = {number: directions(view, surveys[number]) for number, view in views.items()}
    found = {}
    numbers = [pair for pair in itertools.combinations(range(len(times)), 2) if not known.issuperset(pair)]
    for i, j in progress(numbers, "comparing motion", unit="pair"):
        parts = []
        lines = sheaves(views[i], views[j], (rays[i], rays[j])) if i in views and j in views else None
        if lines is not None:
            one, two = (sheaf_signal(times[n], surveys[n], k, step_s) for n, k in zip((i, j), lines, strict=True))
            if one is not None and two is not None:
                parts.append(evidence(one, two, frames_as_one=FRAMES_AS_ONE))
        one, two = curves[i], curves[j]
        if (not parts or max(len(times[i]), len(times[j])) > LONGEST) and one is not None and two is not None:
            parts.append(curve_evidence(one, two, step_s))
        said = [part for part in parts if part is not None]
        if said:
            found[i, j] = together(said)
    return found
