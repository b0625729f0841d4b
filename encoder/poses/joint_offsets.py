"""Offsets of several cameras that agree best with the evidence of all pairs, and how sure each is."""

from dataclasses import dataclass

import numpy as np
from scipy import optimize, special

from kpc.encoder.poses.motion_sync import STEPS_PER_FRAME, Evidence, together
from kpc.encoder.poses.sound_sync import parabola_peak

# Pairs see the same motion, so that their evidence is not independent: of n pairs, n / DEPENDENT counts.
DEPENDENT = 2.0
# An offset is right if it is so many steps off at most: half a frame.
RIGHT = STEPS_PER_FRAME // 2
# Motion that repeats itself agrees with a smaller overlap as well: such an overlap is taken for up to so many times
# what it is when the best offset is compared with others.
REPEATED = 2.0
PASSES = 10


@dataclass(frozen=True)
class JointOffset:
    """The offset of a camera: in steps, to be added to its times, and the probability that it is right."""

    steps: float
    confidence: float


def joint_offsets(pairs: dict[tuple[int, int], Evidence], known: set[int]) -> dict[int, JointOffset]:
    """Return the offsets of all cameras that are connected, by number.

    Groups of cameras are joined, the surest two first, by the evidence of all pairs between them; a camera is as sure
    as the least sure joint between it and the rest. Then each camera is moved to where all others want it.

    Args:
        pairs: what two cameras say, the lower number first.
        known: cameras whose offsets are 0.
    """
    both = pairs | {(j, i): found.swapped() for (i, j), found in pairs.items()}
    offsets, confidence = _joined(both, known)
    if not offsets:
        return {}
    free = sorted(set(offsets) - known)
    for _ in range(PASSES):
        before = dict(offsets)
        for number in free:
            found = _between(both, {n: o for n, o in offsets.items() if n != number}, {number: 0})
            if found is not None:
                offsets[number], _ = _likeliest(*found)
        if offsets == before:
            break
    for number in free:
        found = _between(both, {n: o for n, o in offsets.items() if n != number}, {number: 0})
        own = 0.0 if found is None else float(special.expit(_likeliest(*found)[1]))
        confidence[number] = min(confidence[number], own)
    finer = _finer(pairs, offsets, known)
    start = 0.0 if known else finer[min(finer)]
    return {number: JointOffset(finer[number] - start, confidence[number]) for number in offsets}


def _joined(both: dict[tuple[int, int], Evidence], known: set[int]) -> tuple[dict[int, int], dict[int, float]]:
    """Return offsets in whole steps and how sure each joint was, of the largest group or that of the known cameras."""
    numbers = {number for pair in both for number in pair} | known
    groups = [dict.fromkeys(known, 0)] if known else []
    groups += [{number: 0} for number in sorted(numbers - known)]
    confidence = dict.fromkeys(numbers, 1.0)
    joints: dict[tuple[int, int], tuple[int, float]] = {}

    def compare(one: int, two: int) -> None:
        found = _between(both, groups[one], groups[two])
        if found is not None:
            joints[one, two] = _likeliest(*found)

    alive = set(range(len(groups)))
    for two in alive:
        for one in range(two):
            compare(one, two)
    while joints:
        one, two = max(joints, key=lambda pair: (joints[pair][1], -pair[0], -pair[1]))
        shift, odds = joints[one, two]
        smaller = two if (one == 0 and known) or len(groups[one]) >= len(groups[two]) else one
        for number in groups[smaller]:
            confidence[number] = min(confidence[number], float(special.expit(odds)))
        groups[one] = groups[one] | {number: offset + shift for number, offset in groups[two].items()}
        alive.remove(two)
        joints = {pair: joint for pair, joint in joints.items() if one not in pair and two not in pair}
        for other in alive - {one}:
            compare(*sorted((one, other)))
    chosen = groups[0] if known else max((groups[n] for n in sorted(alive)), key=len, default={})
    return (chosen, confidence) if len(chosen) > 1 else ({}, confidence)


def _between(
    both: dict[tuple[int, int], Evidence], one: dict[int, int], two: dict[int, int]
) -> tuple[Evidence, int] | None:
    """Return the evidence on the offset of a group to another, and the number of pairs; None if there is none."""
    parts = [
        both[i, j].shifted(offset - other) for i, offset in one.items() for j, other in two.items() if (i, j) in both
    ]
    return (together(parts), len(parts)) if parts else None


def _likeliest(total: Evidence, count: int) -> tuple[int, float]:
    """Return the likeliest offset in steps, and the logarithm of the odds that it is right."""
    best = int(total.likelihood.argmax())
    longer = np.clip(total.frames[best] / np.maximum(total.frames, 1), 1, REPEATED)
    likelihood = np.where(total.likelihood > 0, total.likelihood * longer, total.likelihood)
    likelihood = likelihood / max(count / DEPENDENT, 1)
    right = np.abs(np.arange(len(likelihood)) - best) <= RIGHT
    wrong = likelihood[~right]
    odds = special.logsumexp(likelihood[right]) - special.logsumexp(wrong) if len(wrong) else 0.0
    return total.first + best, float(odds)


def _finer(pairs: dict[tuple[int, int], Evidence], offsets: dict[int, int], known: set[int]) -> dict[int, float]:
    """Return offsets between steps, with which the peaks of most pairs agree: a robust least-squares fit."""
    peaks = {}
    for (i, j), found in pairs.items():
        if i in offsets and j in offsets:
            place = offsets[j] - offsets[i] - found.first
            near = np.arange(max(place - STEPS_PER_FRAME, 1), min(place + STEPS_PER_FRAME + 1, len(found.frames) - 1))
            if len(near):
                at = int(near[found.likelihood[near].argmax()])
                height = float(found.likelihood[at])
                if height > 0:
                    finer = parabola_peak(*found.likelihood[at - 1 : at + 2])
                    peaks[i, j] = found.first + at + finer, height
    fixed = known or {min(offsets, default=0)}
    free = [number for number in offsets if number not in fixed]
    start = {number: float(offset) for number, offset in offsets.items()}
    if not free or not peaks:
        return start

    def residuals(values: np.ndarray) -> np.ndarray:
        now = start | dict(zip(free, values.tolist(), strict=True))
        return np.array([height**0.5 * (now[j] - now[i] - peak) for (i, j), (peak, height) in peaks.items()])

    fit = optimize.least_squares(residuals, [start[n] for n in free], loss="soft_l1", f_scale=0.2 * RIGHT)
    return start | dict(zip(free, fit.x.tolist(), strict=True))
