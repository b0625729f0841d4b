"""What cameras that move filmed together: the views of each, when they were taken, and which are matched."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np

from kpc.encoder.datasets.timeline import align_times, even_times, frame_rate, in_step
from kpc.encoder.poses.clocks import Clock
from kpc.encoder.poses.footage import Footage
from kpc.encoder.poses.instants import Picture, frame_times
from kpc.encoder.poses.structure import Pairing
from kpc.encoder.poses.survey import Survey, greys
from kpc.format.common.errors import DatasetError

# Frames of a camera are matched with those so many frames away; so many that look most alike are sought in each camera.
STEPS, ALIKE = (1, 2, 4, 8, 16, 32), 5
# These are sought among frames so many apart, and so are those of other cameras at the same instant.
EVERY = 3
# Frames of two cameras show the same instant if they are at most so many frames of the clip apart.
SIMULTANEOUS = 0.5


@dataclass(frozen=True)
class Track:
    """The frames of one camera.

    Attributes:
        camera: its name; empty if it is the only one.
        frames: numbers of those that are used.
        times: (F,) float64, when each of these is shown, in [0, 1] of the clip.
        first: number of the view of the first one.
        is_still: whether the camera stands still, so that all its frames are one view.
    """

    camera: str
    frames: range
    times: np.ndarray
    first: int
    is_still: bool

    @property
    def views(self) -> range:
        """The numbers of its views."""
        return range(self.first, self.first + (1 if self.is_still else len(self.frames)))

    @property
    def names(self) -> list[str]:
        """The names of its views, such as "cam00/000012"; of a camera that stands still, its own."""
        return [self.camera] if self.is_still else self.frame_names

    @property
    def frame_names(self) -> list[str]:
        """The names of its frames, such as "cam00/000012"."""
        return frame_names(self.camera, self.frames)

    def view_of(self, frame: int) -> int:
        """Return the number of the view of a frame."""
        return self.first + (0 if self.is_still else frame - self.frames.start)


def frame_names(camera: str, frames: range) -> list[str]:
    """Return the names of a camera's frames, such as "cam00/000012"; without a name of the camera, "000012"."""
    return [f"{camera}/{frame:06d}" if camera else f"{frame:06d}" for frame in frames]


@dataclass(frozen=True)
class Take:
    """The common time of cameras that move.

    Attributes:
        tracks: of each camera.
        frame_count: of the clip.
        fps: frames per second; None for images.
        start_s: when the clip begins by the common clock; None for images.
    """

    tracks: tuple[Track, ...]
    frame_count: int
    fps: float | None
    start_s: float | None

    @property
    def names(self) -> tuple[str, ...]:
        """The names of all views."""
        return tuple(name for track in self.tracks for name in track.names)

    @property
    def cameras(self) -> list[int]:
        """The number of each view's camera."""
        return [number for number, track in enumerate(self.tracks) for _ in track.views]


def take_of(root: Path, footage: Sequence[Footage], clocks: Sequence[Clock], are_still: Sequence[bool]) -> Take:
    """Return the frames of cameras in the time that all of them filmed, and say in one line if some are left out.

    Args:
        root: the folder, for messages.
        footage, clocks: of each camera. The frames of images are a second apart.
        are_still: whether each stands still.

    Raises:
        DatasetError: they have no time in common, or a single instant.
    """
    rates, seconds = [], []
    for one, clock in zip(footage, clocks, strict=True):
        if one.video is None:
            rates.append(1 / clock.rate)
            seconds.append(clock.offset_s + clock.rate * frame_times(one))
        else:
            video = in_step(one.video, (clock.offset_s, clock.rate))
            rates.append(frame_rate(video))
            seconds.append(even_times(video, rates[-1]))
    timeline = align_times(root, [one.name for one in footage], rates, seconds)
    if timeline.clip.frame_count < 2:
        raise DatasetError(f"{root}: the videos have a single instant in common; give clocks with --sync offsets.json")
    tracks: list[Track] = []
    for one, frames, times, still in zip(footage, timeline.frames, timeline.times, are_still, strict=True):
        first = tracks[-1].views.stop if tracks else 0
        tracks.append(Track(one.name if len(footage) > 1 else "", frames, times, first, still))
    are_videos = footage[0].video is not None
    clip = timeline.clip
    return Take(
        tuple(tracks), clip.frame_count, clip.fps if are_videos else None, timeline.start_s if are_videos else None
    )


def pictures_of(footage: Sequence[Footage], surveys: Sequence[Survey], take: Take) -> Iterator[Picture]:
    """Yield the picture of each view: a frame, or of a camera that stands still the median, without what moves.

    Args:
        footage: of each camera.
        surveys: of each; may be empty if none stands still.
        take: of these.
    """
    for number, (one, track) in enumerate(zip(footage, take.tracks, strict=True)):
        if track.is_still:
            yield Picture(track.first, 0, surveys[number].median, ~surveys[number].moving)
        else:
            for view, grey in zip(track.views, greys(one, track.frames), strict=True):
                yield Picture(view, 0, grey.round().astype(np.uint8), None)


def pairing_of(take: Take, in_step: Sequence[bool]) -> Pairing:
    """Return which frames are matched.

    Args:
        take: the frames.
        in_step: whether the clock of each camera is known; frames of the same instant of two of these are matched.
    """
    pairs = []
    moving = [track for track, known in zip(take.tracks, in_step, strict=True) if known and not track.is_still]
    for one, two in combinations(moving, 2):
        apart = np.abs(one.times[::EVERY, None] - two.times)  # (F / EVERY, G)
        nearest = apart.argmin(1)
        near = apart.min(1) * (take.frame_count - 1) <= SIMULTANEOUS
        pairs += [(one.first + EVERY * k, two.first + int(nearest[k])) for k in np.flatnonzero(near).tolist()]
    return Pairing(STEPS, ALIKE, EVERY, by_camera=True, besides=tuple(pairs))
