"""Which sound is heard when in a clip in groups (spec/kpc-format.md, "Groups").

Samples count from the first frame of the clip, at SAMPLE_RATE.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

from kpc.format.container.groups import Groups, Timeline
from kpc.format.scene.sound import SAMPLE_RATE, Sound

# A sample that no sound reaches; floats are exact up to there.
LAST_SAMPLE = 2.0**53


@dataclass(frozen=True)
class SoundSpan:
    """The samples of a clip that are those of one group.

    Attributes:
        group: its number.
        first, stop: the first sample of the clip, and the one after the last.
        start: the sample of the clip that is sample 0 of the sound of the group.
    """

    group: int
    first: int
    stop: int
    start: int


def sample_at(frame: float, fps: float) -> int:
    """Return the sample that is heard when a frame of a clip, counted from 0, is first shown.

    At a rate that is almost 0 this may be no finite number; LAST_SAMPLE, later than any sound, stands for it.
    """
    return math.floor(min(SAMPLE_RATE * frame / fps + 0.5, LAST_SAMPLE))


def sound_spans(timeline: Timeline) -> tuple[SoundSpan, ...]:
    """Return the spans of all groups, which follow one another from 0 to the end of the clip."""
    origin, fps = timeline.spans[0].start, timeline.fps
    takeovers = [0]
    for before, after in zip(timeline.spans, timeline.spans[1:], strict=False):
        takeovers.append(sample_at(max((before.last + after.start) / 2, after.start) - origin, fps))
    takeovers.append(sample_at(timeline.clip.frame_count, fps))
    return tuple(
        SoundSpan(number, takeovers[number], takeovers[number + 1], sample_at(span.start - origin, fps))
        for number, span in enumerate(timeline.spans)
    )


def parts_of(groups: Groups, first: int, stop: int) -> Iterator[tuple[int, Sound | None]]:
    """Yield what is heard from sample `first` to `stop` of a clip: sounds in their order, each with how many samples it
    lasts. A sound may be shorter than that, and silence, None, may be between them.
    """
    spans = sound_spans(groups.timeline)
    for span in spans:
        begin, end = max(first, span.first), min(stop, span.stop)
        if begin < end:
            sound = groups.open(span.group).sound() if groups.available(span.group) else None
            yield end - begin, None if sound is None else sound.part(begin - span.start, end - begin)
    if stop > (last := spans[-1].stop):
        yield stop - max(first, last), None


def has_sound(groups: Groups) -> bool:
    """Return whether a group of a file has sound, by what is there of the file."""
    return any(groups.available(number) and groups.open(number).sound_numbers for number in range(len(groups)))
