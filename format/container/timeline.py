"""Which frames of a clip its groups cover, and which group is shown when (spec/kpc-format.md, "Groups")."""

import itertools
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from kpc.format.common.errors import FormatError
from kpc.format.container.scene_layout import FRAME_LIMIT
from kpc.format.scene.scene import Clip


@dataclass(frozen=True)
class Span:
    """The frames `start` to `last` of a clip, `count` of them."""

    start: int
    count: int

    @property
    def last(self) -> int:
        """The last frame, inclusive."""
        return self.start + self.count - 1


@dataclass(frozen=True)
class Timeline:
    """Which frames of a clip each of its groups covers.

    Neighbouring groups share frames, or one begins right after the other ends.

    Attributes:
        spans: the frames of each group, in order; the clip begins with the first frame of the first group.
        fps: frames per second.
    """

    spans: tuple[Span, ...]
    fps: float

    @property
    def clip(self) -> Clip:
        """The time axis of the whole clip."""
        return Clip(self.spans[-1].last - self.spans[0].start + 1, self.fps)

    def at(self, time: float) -> tuple[int, float]:
        """Return the group shown at `time` in [0, 1] over the clip, and the time in [0, 1] within that group.

        A group takes over in the middle between its first frame and the last frame of the group before it.
        """
        frame = self.spans[0].start + time * (self.clip.frame_count - 1)
        number = bisect_right(self._switch_frames, frame)
        return number, self.local_time(number, time)

    def blend_at(self, time: float) -> list[tuple[int, float, float]]:
        """Return the (group, time in it, weight) triples blended at `time` in [0, 1] over the clip.

        There are two of them between shared frames, else one. The weight of the later group grows linearly from 0 at
        the first shared frame to 1 at the last.
        """
        number, local_time = self.at(time)
        frame = self.spans[0].start + time * (self.clip.frame_count - 1)
        for later in range(max(number, 1), min(number + 2, len(self.spans))):
            first, last = self.spans[later].start, self.spans[later - 1].last
            if first < frame < last:
                share = (frame - first) / (last - first)
                return [
                    (later - 1, self.local_time(later - 1, time), 1 - share),
                    (later, self.local_time(later, time), share),
                ]
        return [(number, local_time, 1.0)]

    def local_time(self, number: int, time: float) -> float:
        """Return the time in [0, 1] within a group at a time of the clip, clamped to the frames of the group."""
        span, frame = self.spans[number], self.spans[0].start + time * (self.clip.frame_count - 1)
        return min(max((frame - span.start) / (span.count - 1), 0.0), 1.0) if span.count > 1 else 0.0

    def clip_time(self, number: int, local_time: float) -> float:
        """Return the time of the clip at a time in [0, 1] within a group: the inverse of `local_time`."""
        span = self.spans[number]
        frame = span.start + local_time * (span.count - 1) - self.spans[0].start
        return min(max(frame / max(self.clip.frame_count - 1, 1), 0.0), 1.0)

    def display_span(self, number: int) -> tuple[float, float]:
        """Return from when to when a group is the one shown, in [0, 1] over the clip."""
        frames, start = max(self.clip.frame_count - 1, 1), self.spans[0].start
        ends = [0.0, *((frame - start) / frames for frame in self._switch_frames), 1.0]
        return ends[number], ends[number + 1]

    @cached_property
    def _switch_frames(self) -> list[float]:
        """The frame of the clip at which each group but the first takes over."""
        return [(before.last + after.start) / 2 for before, after in itertools.pairwise(self.spans)]


def check_spans(spans: Sequence[Span], names: str | Sequence[str]) -> None:
    """Check that the frames of groups make up a clip.

    Each group must begin and end later than the one before, without a gap, and no frame may be in more than two groups.

    Args:
        spans: the frames of each group.
        names: of the file, or of one file per group, for messages.

    Raises:
        FormatError: they do not, or there are more than FRAME_LIMIT frames.
    """
    labels = [f"{names}: group {k}" for k in range(len(spans))] if isinstance(names, str) else names
    for number, (before, after) in enumerate(itertools.pairwise(spans)):
        if not before.start < after.start <= before.last + 1 or not before.last < after.last:
            one, other = labels[number : number + 2]
            raise FormatError(
                f"{one} holds frames {before.start} to {before.last}, {other} frames {after.start} to {after.last}: "
                "each must begin and end later than the one before, and leave no frame out; join them again"
            )
    for number, (before, after) in enumerate(zip(spans, spans[2:], strict=False)):
        if after.start <= before.last:
            raise FormatError(
                f"{labels[number + 2]} begins with frame {after.start}, which two groups before it hold: "
                "a frame may be in two groups at most"
            )
    if (frames := spans[-1].last - spans[0].start + 1) > FRAME_LIMIT:
        raise FormatError(f"{labels[-1]}: {frames:,} frames exceed the limit of {FRAME_LIMIT:,}; split the clip")
