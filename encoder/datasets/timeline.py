"""Alignment of videos in time: which frames of each lie in their common span, and the clip that they make.

All videos count from one origin (`kpc.encoder.datasets.video`), so that frames belong together that are shown at the
same time, whatever their numbers. Each picture keeps its own time; frames of a video of constant rate are put where
that rate has them, since time stamps are rounded.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from kpc.encoder.datasets.capture import printable
from kpc.encoder.datasets.video import VideoInfo
from kpc.format.common.errors import DatasetError
from kpc.format.common.text import notice
from kpc.format.scene.scene import Clip

# Frame rates of cameras and files, frames per second.
WHOLE_RATES = (5, 6, 8, 10, 12, 12.5, 15, 20, 24, 25, 30, 48, 50, 60, 72, 90, 100, 120, 240)
STANDARD_RATES = np.array([*WHOLE_RATES, *(rate * 1000 / 1001 for rate in (24, 30, 48, 60, 120, 240))])

# The most by which a rate may differ from a standard one to be taken for it: as declared, and as measured.
DECLARED_TOLERANCE, MEASURED_TOLERANCE = 4e-4, 5e-3

ON_FRAME = 1e-2  # a picture that is this close to a whole frame of the clip, in frames, is put there

# Frames are simultaneous if they are at most this many frames of the clip apart.
SIMULTANEOUS = 0.5


@dataclass(frozen=True)
class Timeline:
    """The common time axis of several videos.

    Attributes:
        clip: the time axis.
        frames: of each video, the numbers of the frames that are used.
        times: of each video, the times of these frames in [0, 1], float64.
        start_s: when the clip begins, in the seconds of the videos.
    """

    clip: Clip
    frames: tuple[range, ...]
    times: tuple[np.ndarray, ...]
    start_s: float


def align(root: Path, videos: Mapping[str, VideoInfo]) -> Timeline:
    """Align videos by presentation time; as `align_times`."""
    rates = [frame_rate(video) for video in videos.values()]
    seconds = [even_times(video, rate) for video, rate in zip(videos.values(), rates, strict=True)]
    return align_times(root, list(videos), rates, seconds)


def align_times(root: Path, names: Sequence[str], rates: Sequence[float], seconds: Sequence[np.ndarray]) -> Timeline:
    """Align videos by the times of their frames, and print one line if they do not show the same instants.

    The clip spans what all videos show, to within half a frame. Its rate is that of the video of the highest rate.

    Args:
        root: the dataset's folder, for messages.
        names: of the videos.
        rates: frames per second of each.
        seconds: of each, the times of its frames, (N,) float64, increasing.

    Raises:
        DatasetError: the videos have no time in common.
    """
    fps = max(rates)
    starts, ends = np.array([t[0] for t in seconds]), np.array([t[-1] for t in seconds])
    reach = (SIMULTANEOUS - ON_FRAME) / fps
    used = [np.flatnonzero((t > starts.max() - reach) & (t < ends.min() + reach)) for t in seconds]
    if not all(map(len, used)):
        late, early = names[int(starts.argmax())], names[int(ends.argmin())]
        raise DatasetError(
            f"{root}: videos have no time in common: {early} ends at {ends.min():.6g} s, {late} starts at "
            f"{starts.max():.6g} s; cut them to the same take, or correct their time stamps"
        )
    frames = [range(int(numbers[0]), int(numbers[-1]) + 1) for numbers in used]
    shown = [t[numbers] for t, numbers in zip(seconds, used, strict=True)]
    start = min(t[0] for t in shown)
    positions = [_on_frames((t - start) * fps) for t in shown]  # in frames of the clip
    last = max(p[-1] for p in positions)
    line = _describe(
        list(map(printable, names)), rates, starts * fps, positions, [len(t) for t in seconds], frames, fps
    )
    if line:
        notice(f"{root}: {line}")
    times = tuple(p / max(last, 1e-9) for p in positions)
    return Timeline(Clip(round(float(last)) + 1, fps), tuple(frames), times, float(start))


def in_step(video: VideoInfo, clock: tuple[float, float]) -> VideoInfo:
    """Return the properties of a video with its times by the common clock.

    Args:
        video: by its own clock.
        clock: seconds to be added to its times after they are multiplied by the second number.
    """
    offset_s, rate = clock
    return replace(video, times=offset_s + rate * video.times, tick_s=rate * video.tick_s, fps=video.fps / rate)


def frame_rate(video: VideoInfo) -> float:
    """Return the nominal frame rate of a video: its constant rate, or the usual one where it varies.

    The rate that the container declares is an average, which dropped frames lower.
    """
    steps = np.diff(video.times)
    if not len(steps):
        return _standard(video.fps, DECLARED_TOLERANCE)
    measured = _measured_rate(steps, video.tick_s)
    for rate in (_standard(video.fps, DECLARED_TOLERANCE), _standard(measured, MEASURED_TOLERANCE), video.fps):
        if _is_constant(video, rate):
            return rate
    return _standard(measured, MEASURED_TOLERANCE)


def even_times(video: VideoInfo, rate: float) -> np.ndarray:
    """Return the times of a video's frames in seconds, without the rounding of time stamps if its rate is constant."""
    return video.times[0] + np.arange(len(video.times)) / rate if _is_constant(video, rate) else video.times


def _is_constant(video: VideoInfo, rate: float) -> bool:
    """Return whether frames come at a rate, but for the rounding of time stamps."""
    ideal = video.times[0] + np.arange(len(video.times)) / rate
    rounding = min(1.01 * video.tick_s, 0.25 / rate) + 1e-6
    return bool(np.abs(video.times - ideal).max() <= rounding)


def _measured_rate(steps: np.ndarray, tick_s: float) -> float:
    """Return the rate of most steps; the mean rate if they are too uneven to have one."""
    median = float(np.median(steps))
    regular = np.abs(steps - median) <= 0.1 * median + tick_s
    return 1 / float(steps[regular].mean() if 2 * regular.sum() >= len(steps) else steps.mean())


def _standard(rate: float, tolerance: float) -> float:
    nearest = float(STANDARD_RATES[np.abs(STANDARD_RATES / rate - 1).argmin()])
    return nearest if abs(nearest / rate - 1) <= tolerance else rate


def _on_frames(positions: np.ndarray) -> np.ndarray:
    whole = np.rint(positions)
    return np.where(np.abs(positions - whole) <= ON_FRAME, whole, positions)


def _largest_distances(positions: Sequence[np.ndarray]) -> np.ndarray:
    """Return for each video how far an instant of any of them is at most from its own nearest frame, in frames."""
    instants = np.unique(np.concatenate(positions))
    distances = []
    for own in positions:
        after = np.searchsorted(own, instants).clip(max=len(own) - 1)
        before = (after - 1).clip(min=0)
        distances.append(np.minimum(np.abs(own[after] - instants), np.abs(own[before] - instants)).max())
    return np.array(distances)


def _describe(
    names: Sequence[str],
    rates: Sequence[float],
    starts: np.ndarray,
    positions: Sequence[np.ndarray],
    counts: Sequence[int],
    frames: Sequence[range],
    fps: float,
) -> str:
    """Say where videos differ and what was done; an empty text if they show the same instants.

    Args:
        starts: (V,) when each begins, in frames of the clip.
        positions: of the used frames of each, in frames of the clip.
        counts: frames of each.
        frames: those that are used.
    """
    differ = []
    if max(rates) - min(rates) > 1e-3:
        slow, fast = (names[rates.index(rate)] for rate in (min(rates), max(rates)))
        differ.append(f"run at {min(rates):.5g} ({slow}) to {max(rates):.5g} fps ({fast})")
    if np.ptp(starts) > SIMULTANEOUS:
        differ.append(f"start up to {np.ptp(starts) / fps:.3g} s apart ({names[int(starts.argmax())]} last)")
    distances = _largest_distances(positions)
    if distances.max() > SIMULTANEOUS + ON_FRAME and max(rates) - min(rates) <= 1e-3:
        name = names[int(distances.argmax())]
        differ.append(
            f"lack frames at different times (the nearest of {name} is up to {distances.max() / fps:.3g} s off)"
        )
    before, after = sum(f.start for f in frames), sum(n - f.stop for n, f in zip(counts, frames, strict=True))
    used = f"{sum(map(len, frames))} of {sum(counts)}"
    if not differ:
        fewest, most = min(counts), max(counts)
        short = names[counts.index(fewest)]
        have = f"{fewest} ({short}) to {most} frames" if fewest < most else f"{most} frames, half a frame apart"
        some = f"videos have {have}; the {used} in their common span are used"
        return some if before + after else ""
    span_s = max(p[-1] for p in positions) / fps
    return (
        f"videos {' and '.join(differ)}; each frame keeps its own time: {used} are in their common {span_s:.3g} s; "
        f"{before} before it and {after} after it are left out"
    )
