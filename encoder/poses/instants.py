"""The pictures of a still rig from which its cameras are found: what stays, and what moves at several instants."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from kpc.encoder.datasets.video import read_video
from kpc.encoder.poses.clocks import Clock
from kpc.encoder.poses.footage import Footage
from kpc.encoder.poses.survey import Survey
from kpc.format.common.images import luma, read_image

# Frames of two cameras show the same instant if they are no further apart than this share of a frame.
SAME_INSTANT = 0.3


@dataclass(frozen=True)
class Picture:
    """A picture for structure from motion.

    Attributes:
        view: number of the camera at a place.
        instant: pictures of the same one are matched.
        grey: (H, W) uint8.
        mask: (H, W) bool, where features count; None for everywhere.
    """

    view: int
    instant: int
    grey: np.ndarray
    mask: np.ndarray | None


def still_pictures(surveys: Sequence[Survey]) -> Iterator[Picture]:
    """Yield for each camera the median picture, without what moves."""
    for view, found in enumerate(surveys):
        yield Picture(view, 0, found.median, ~found.moving)


def moving_pictures(
    footage: Sequence[Footage], surveys: Sequence[Survey], clocks: Sequence[Clock], count: int
) -> Iterator[Picture]:
    """Yield for each camera what moves at instants spread over the common time, where each has a frame."""
    times = [clock.offset_s + clock.rate * frame_times(one) for one, clock in zip(footage, clocks, strict=True)]
    step = max(float(np.median(np.diff(t))) if len(t) > 1 else 0.0 for t in times)
    first, last = max(t[0] for t in times), min(t[-1] for t in times)
    if not step or last <= first:
        return
    candidates = times[0][(times[0] >= first - SAME_INSTANT * step) & (times[0] <= last + SAME_INSTANT * step)]
    nearest = [np.abs(t[:, None] - candidates).argmin(0) for t in times]
    apart = np.max([np.abs(t[n] - candidates) for t, n in zip(times, nearest, strict=True)], axis=0)
    shared = np.flatnonzero(apart <= SAME_INSTANT * step)
    chosen = shared[np.linspace(0, len(shared) - 1, min(count, len(shared))).round().astype(int)]
    for view, (one, found) in enumerate(zip(footage, surveys, strict=True)):
        if found.moving.any():
            wanted = {int(nearest[view][k]): instant for instant, k in enumerate(chosen, 1)}
            for number, grey in _frames(one, sorted(wanted)):
                yield Picture(view, wanted[number], grey, found.moving)


def frame_times(footage: Footage) -> np.ndarray:
    """Return when each frame is shown by the camera's own clock; frame numbers in seconds for images."""
    return np.arange(len(footage.files), dtype=float) if footage.video is None else footage.video.times


def _frames(footage: Footage, numbers: list[int]) -> Iterator[tuple[int, np.ndarray]]:
    """Yield numbered frames as (H, W) uint8."""
    if footage.video is None:
        for number in numbers:
            yield number, grey_of(read_image(footage.files[number], upright=True))
    elif numbers:
        frames = enumerate(read_video(footage.files[0], footage.video, 0, numbers[-1] + 1))
        for number, frame in frames:
            if number in numbers:
                yield number, grey_of(frame)


def grey_of(picture: np.ndarray) -> np.ndarray:
    """Return the luma of a picture, (H, W) uint8."""
    return luma(picture).round().astype(np.uint8)
