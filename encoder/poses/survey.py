"""A first look at each camera's footage: how much moves at each frame, and what stays where it is."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from kpc.encoder.datasets.video import read_video
from kpc.encoder.poses.footage import Footage
from kpc.format.common.images import luma, read_image

# Frames, spread over the clip, from which the median picture is made.
SPREAD_FRAMES = 15
# Motion is measured on squares of so many pixels, so that noise does not count.
SQUARE = 4
# Where things move is kept on about so many squares across, of at most so many frames.
ACROSS, LONGEST = 96, 1500
# A pixel is textured if its neighbours differ by at least so many levels of 255, and it stays if it differs from the
# median picture by no more than so many in half of the frames.
TEXTURE, STAYS = 12.0, 8.0
# A camera stands still if at least this share of its textured pixels stays.
STILL_SHARE = 0.5
# A pixel moves if it leaves its median by more than so many levels, and so many times its usual deviation.
MOVES, MOVES_BY_NOISE = 10.0, 6.0


@dataclass(frozen=True)
class Survey:
    """What a first look at a camera's footage found.

    Attributes:
        motion: (N,) float64, mean change of the picture before each frame, in levels of 255; 0 before the first.
        changes: (F, h, w) float16, mean change before each frame, of squares of `square` pixels; F = min(N, LONGEST).
        square: side of the squares of `changes` in pixels.
        median: (H, W) uint8, the median over the spread frames.
        moving: (H, W) bool, pixels that leave their median in some frame.
        still_share: share of the textured pixels that stay; NaN without texture, or with one frame.
    """

    motion: np.ndarray
    changes: np.ndarray
    square: int
    median: np.ndarray
    moving: np.ndarray
    still_share: float

    @property
    def is_still(self) -> bool:
        """Whether the camera stands still; so does one that shows no texture."""
        return not self.still_share < STILL_SHARE


def greys(footage: Footage, numbers: range | None = None) -> Iterator[np.ndarray]:
    """Yield the frames as (H, W) float32 luma in [0, 255]: all, or those of consecutive numbers."""
    numbers = range(frame_count(footage)) if numbers is None else numbers
    frames = (
        read_video(footage.files[0], footage.video, numbers.start, numbers.stop)
        if footage.video is not None
        else (read_image(file, upright=True) for file in footage.files[numbers.start : numbers.stop])
    )
    yield from map(luma, frames)


def frame_count(footage: Footage) -> int:
    return len(footage.files) if footage.video is None else footage.video.frame_count


def survey(footage: Footage) -> Survey:
    """Read all frames of a camera once."""
    count = frame_count(footage)
    wanted = set(np.linspace(0, count - 1, min(SPREAD_FRAMES, count)).round().astype(int).tolist())
    motion, changes, spread, before, side = np.zeros(count), [], [], None, 1
    for number, grey in enumerate(greys(footage)):
        if number in wanted:
            spread.append(grey.round().astype(np.uint8))
        small = _squares(grey, SQUARE)
        change = np.zeros_like(small) if before is None else np.abs(small - before)
        motion[number] = change.mean()
        if number < LONGEST:
            side = -(-small.shape[1] // ACROSS)
            changes.append(_squares(change, side).astype(np.float16))
        before = small
    frames = np.stack(spread)
    median = np.median(frames, axis=0).astype(np.float32)
    deviations = np.abs(frames - median)
    usual = float(np.median(deviations)) / 0.6745  # standard deviation of Gaussian noise
    moving = _grown(deviations.max(0) > max(MOVES, MOVES_BY_NOISE * usual))
    where = np.stack(changes)
    return Survey(motion, where, SQUARE * side, median.astype(np.uint8), moving, _still_share(median, deviations))


def _still_share(median: np.ndarray, deviations: np.ndarray) -> float:
    across, down = np.abs(np.diff(median, axis=1))[:-1], np.abs(np.diff(median, axis=0))[:, :-1]
    textured = np.maximum(across, down) >= TEXTURE
    if len(deviations) < 2 or not textured.any():
        return float("nan")
    return float((np.median(deviations, axis=0)[:-1, :-1][textured] <= STAYS).mean())


def _squares(grey: np.ndarray, side: int) -> np.ndarray:
    """Average squares of so many pixels a side; the remainder is cut off."""
    rows, columns = (size // side for size in grey.shape)
    return grey[: rows * side, : columns * side].reshape(rows, side, columns, side).mean((1, 3))


def _grown(mask: np.ndarray) -> np.ndarray:
    """Grow a mask by two pixels in each direction."""
    for axis in (0, 1):
        padded = np.pad(mask, [(2, 2) if own == axis else (0, 0) for own in (0, 1)])
        mask = np.any(np.lib.stride_tricks.sliding_window_view(padded, 5, axis=axis), axis=-1)
    return mask
