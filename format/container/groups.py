"""Long clips: a file of groups, each a scene of its own over some of the clip's frames (spec/kpc-format.md, section 4).

    GRUP chunk    a whole .kpc file: one group. Its entry in the index says which frames of the clip those of the scene are.

A group is coded, fetched, held and let go as any scene is, with planes, occupancy, motion and decoder of its own; so encoding and
playing take the memory of a group or two, however long the clip. In the frames that two groups share the picture goes over from one
to the other: what each misses of the truth is its own, and would be seen to jump.

    groups = Groups("long.kpc")                 a file without groups is one group, itself
    number, time = groups.timeline.at(0.7)      which group shows, and where in it that is
    scene = read(groups.open(number)).dequantise()
"""

import os
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import google_crc32c
from kpc.format.common.cli import atomic_write
from kpc.format.common.errors import FormatError, UsageError
from kpc.format.container.container import (
    CODEC_RAW,
    DEFAULT_BUDGET,
    ENTRY,
    HEADER,
    AnySource,
    Entry,
    Reader,
    RemoteSource,
    Source,
    header_and_index,
    open_source,
)
from kpc.format.container.scene_io import FRAME_LIMIT, GROUP_KIND, SceneReader, read
from kpc.format.container.slices import sliced
from kpc.format.scene.cameras import Camera
from kpc.format.scene.scene import Clip, Scene


@dataclass(frozen=True)
class Span:
    """Frames `start` to `last` of a clip, `count` of them."""

    start: int
    count: int

    @property
    def last(self) -> int:
        return self.start + self.count - 1


@dataclass(frozen=True)
class Timeline:
    """Which frames of a clip each of its groups holds, in their order; the clip begins with the first frame of the first.

    Neighbours share frames, or one begins where the other ends.
    """

    spans: tuple[Span, ...]
    fps: float

    @property
    def clip(self) -> Clip:
        return Clip(self.spans[-1].last - self.spans[0].start + 1, self.fps)

    def at(self, time: float) -> tuple[int, float]:
        """The group that shows at `time`, [0, 1] over the clip, and the time in that group, [0, 1] over its own.

        One takes over from another in the middle between its own first frame and the other's last.
        """
        frame = self.spans[0].start + time * (self.clip.frame_count - 1)
        number = bisect_right(self._takes_over, frame)
        return number, self.local_time(number, time)

    def blend_at(self, time: float) -> list[tuple[int, float, float]]:
        """What makes the picture at `time`: a group, the time in it, and its share; of one group, or of two amid frames that they share.

        The share of the later one grows evenly from 0 at the first frame that they share to 1 at the last.
        """
        number, time_in_it = self.at(time)
        frame = self.spans[0].start + time * (self.clip.frame_count - 1)
        for later in range(max(number, 1), min(number + 2, len(self.spans))):
            first, last = self.spans[later].start, self.spans[later - 1].last
            if first < frame < last:
                share = (frame - first) / (last - first)
                return [
                    (later - 1, self.local_time(later - 1, time), 1 - share),
                    (later, self.local_time(later, time), share),
                ]
        return [(number, time_in_it, 1.0)]

    def local_time(self, number: int, time: float) -> float:
        """The time in a group at a time of the clip; its first or last where it holds none such."""
        span, frame = self.spans[number], self.spans[0].start + time * (self.clip.frame_count - 1)
        return min(max((frame - span.start) / (span.count - 1), 0.0), 1.0) if span.count > 1 else 0.0

    def clip_time(self, number: int, time_in_it: float) -> float:
        """The time of the clip, at a time in a group."""
        span = self.spans[number]
        frame = span.start + time_in_it * (span.count - 1) - self.spans[0].start
        return min(max(frame / max(self.clip.frame_count - 1, 1), 0.0), 1.0)

    def display_span(self, number: int) -> tuple[float, float]:
        """From when to when a group shows, [0, 1] over the clip."""
        frames, start = max(self.clip.frame_count - 1, 1), self.spans[0].start
        ends = [0.0, *((frame - start) / frames for frame in self._takes_over), 1.0]
        return ends[number], ends[number + 1]

    @cached_property
    def _takes_over(self) -> list[float]:
        """Where in the clip, in frames, each group but the first takes over."""
        return [(before.last + after.start) / 2 for before, after in zip(self.spans, self.spans[1:])]


class Groups:
    """Random access to the groups of a file. One without GRUP chunks is taken for a single group: itself.

    Opening reads header and index, and of the first group header, index and SCNE.

    Args:
        source: as for `Reader`.
        memory_budget: bytes that a group may take.
        allow_partial, in_parts: as for `SceneReader`.

    Attributes:
        timeline: when which group shows.
        reader: of the file.
        is_single: whether the file is but a scene.

    Raises:
        FormatError, BudgetError: as `SceneReader`, or the groups do not make a clip.
    """

    def __init__(
        self,
        source: AnySource,
        *,
        memory_budget: int = DEFAULT_BUDGET,
        allow_partial: bool = False,
        in_parts: bool = False,
    ) -> None:
        source = open_source(source, limit=memory_budget)
        self.reader = Reader(source, allow_partial=allow_partial)
        self.name, self._budget, self._in_parts = self.reader.name, memory_budget, in_parts
        self._chunks = [number for number, entry in enumerate(self.reader.index) if entry.kind == GROUP_KIND]
        self.is_single = not self._chunks
        if self.is_single:
            self._first = SceneReader(
                self.reader, memory_budget=memory_budget, allow_partial=allow_partial, in_parts=in_parts
            )
            spans: tuple[Span, ...] = (Span(0, self._first.head.clip.frame_count),)
        else:
            if isinstance(source, RemoteSource) and not source.has_ranges:  # groups are read at the same time
                self.reader.source = open_source(source.read_at(0, source.size))
            spans = self._spans()
            self._first = self._opened(0, self._slice(0, self.reader.source))
        self.timeline = Timeline(spans, self._first.head.clip.fps)
        self._check(0, self._first)

    def __len__(self) -> int:
        return len(self.timeline.spans)

    @property
    def clip(self) -> Clip:
        return self.timeline.clip

    @property
    def size_bytes(self) -> list[int]:
        """Of each group."""
        if self.is_single:
            return [self.reader.header.file_length]
        return [self.reader.index[chunk].stored_length for chunk in self._chunks]

    def available(self, number: int) -> bool:
        """Whether all of a group is there; False only in a partial file."""
        return self.is_single or self.reader.available(self._chunks[number])

    def open(self, number: int, apart: bool = False) -> SceneReader:
        """The scene of a group; `apart`: through a source of its own, for another thread to read beside those of other groups.

        Raises:
            FormatError, BudgetError: as `SceneReader`, or the index tells of another scene.
        """
        if number == 0 and not apart:
            return self._first
        scene = self._opened(number, self.source_of(number) if apart else self._slice(number, self.reader.source))
        self._check(number, scene)
        return scene

    def source_of(self, number: int) -> Source:
        """The bytes of a group, for another thread to read beside those of other groups."""
        source = self.reader.source
        if isinstance(source, RemoteSource) and source.has_ranges:
            source = source.clone()
        return source if self.is_single else self._slice(number, source)

    def cameras(self) -> tuple[Camera, ...]:
        """Those of the first group stand for all."""
        return self._first.cameras()

    def _spans(self) -> tuple[Span, ...]:
        """Of all groups, which are put in order; checked against one another."""
        entries = self.reader.index
        for number, entry in enumerate(entries):
            if entry.is_critical and entry.kind != GROUP_KIND:
                raise FormatError(
                    f"{self.name}: chunk {number} ({entry.kind}) lies beside groups, not in one; update kpc"
                )
            if entry.kind == GROUP_KIND and (
                entry.codec != CODEC_RAW
                or entry.raw_length != entry.stored_length
                or entry.scale
                or entry.plane
                or not entry.row_count
            ):
                raise FormatError(
                    f"{self.name}: chunk {number} ({GROUP_KIND}) claims a codec, a place among the planes, or no frame"
                )
        self._chunks.sort(key=lambda chunk: entries[chunk].group)
        if [entries[chunk].group for chunk in self._chunks] != list(range(len(self._chunks))):
            raise FormatError(f"{self.name}: its groups are not numbered from 0 on, each once")
        spans = tuple(Span(entries[chunk].row_start, entries[chunk].row_count) for chunk in self._chunks)
        check_spans(spans, self.name)
        return spans

    def _slice(self, number: int, source: Source) -> Source:
        entry = self.reader.index[self._chunks[number]]
        return sliced(source, entry.offset, entry.stored_length, f"{self.name}, group {number}")

    def _opened(self, number: int, source: Source) -> SceneReader:
        return SceneReader(
            source, memory_budget=self._budget, allow_partial=not self.available(number), in_parts=self._in_parts
        )

    def _check(self, number: int, scene: SceneReader) -> None:
        clip, span = scene.head.clip, self.timeline.spans[number]
        if clip != Clip(span.count, self.timeline.fps):
            raise FormatError(
                f"{scene.name}: holds {clip.frame_count} frames at {clip.fps:g} fps, not {span.count} at "
                f"{self.timeline.fps:g} as the file says"
            )
        if scene.head.value_count > self.reader.header.value_count:
            raise FormatError(
                f"{scene.name}: holds {scene.head.value_count:,} values, more than the header's "
                f"{self.reader.header.value_count:,}"
            )


class GroupedScene:
    """A clip in groups, of which one is held at a time, or two that are mixed.

    Attributes:
        clip: of all groups together. cameras: a few that the first group was filmed from.
        timeline: when which group shows.
    """

    def __init__(self, groups: Groups) -> None:
        self._groups = groups
        self._held: dict[int, Scene] = {}
        self.timeline, self.clip, self.cameras = groups.timeline, groups.clip, groups.cameras()

    def at(self, time: float) -> tuple[Scene, float]:
        """The scene that shows at `time`, [0, 1] over the clip, and the time in it. It is read unless it is the last that was.

        Raises:
            FormatError, BudgetError, NetworkError: as `read`.
        """
        number, time = self.timeline.at(time)
        return self._scene(number, {number}), time

    def blend_at(self, time: float) -> list[tuple[Scene, float, float]]:
        """As `Timeline.mixed`, scenes in place of groups.

        Raises:
            As `at`.
        """
        parts = self.timeline.blend_at(time)
        return [
            (self._scene(number, {number for number, *_ in parts}), time_in_it, share)
            for number, time_in_it, share in parts
        ]

    def _scene(self, number: int, wanted: set[int]) -> Scene:
        self._held = {
            held: scene for held, scene in self._held.items() if held in wanted
        }  # let go before there is another
        if number not in self._held:
            scene = read(self._groups.open(number)).dequantise()
            self._held[number] = replace(scene, cameras=scene.cameras or self.cameras)
        return self._held[number]


def load(source: AnySource, memory_budget: int = DEFAULT_BUDGET) -> Scene | GroupedScene:
    """Read a file: its scene, or of a clip in groups one after the other when it is asked for."""
    groups = Groups(source, memory_budget=memory_budget)
    return read(groups.open(0)).dequantise() if groups.is_single else GroupedScene(groups)


# --- writing


@dataclass(frozen=True)
class GroupInput:
    """A scene's file, and the frames of a clip that it is to be."""

    source: Source
    span: Span
    fps: float
    value_count: int

    @staticmethod
    def of(source: AnySource, start: int) -> "GroupInput":
        """A file that holds a scene, of frames from `start` on."""
        scene = SceneReader(source, in_parts=True)
        clip = scene.head.clip
        return GroupInput(scene.source, Span(start, clip.frame_count), clip.fps, scene.header.value_count)


def group_inputs(files: Sequence[AnySource]) -> list[GroupInput]:
    """The groups of all files. Files of groups know their frames, and are put in order if all do; a scene follows what is before
    it."""
    opened = [Groups(source, in_parts=True) for source in files]
    if not any(groups.is_single for groups in opened):
        opened.sort(key=lambda groups: groups.timeline.spans[0].start)
    parts: list[GroupInput] = []
    for groups in opened:
        if groups.is_single:
            parts.append(GroupInput.of(groups.reader.source, parts[-1].span.last + 1 if parts else 0))
        else:
            parts += [
                GroupInput.of(groups.source_of(number), span.start) for number, span in enumerate(groups.timeline.spans)
            ]
    return parts


def write(parts: Sequence[GroupInput], path: str | os.PathLike[str]) -> int:
    """Write a clip in groups; return the size in bytes. A group is in memory at a time. On failure `path` is left as it was.

    Raises:
        UsageError: the parts do not make a clip.
    """
    try:
        check_spans([part.span for part in parts], [part.source.name for part in parts])
    except FormatError as error:
        raise UsageError(str(error)) from error
    odd = next((part for part in parts if part.fps != parts[0].fps), None)
    if odd is not None:
        raise UsageError(
            f"{odd.source.name}: runs at {odd.fps:g} fps, {parts[0].source.name} at {parts[0].fps:g}; encode them alike"
        )
    entries: list[Entry] = []
    with atomic_write(path) as aside, aside.open("wb") as opened:
        opened.seek(
            HEADER.size + ENTRY.size * len(parts)
        )  # the index, which comes first, holds checksums of what follows
        for number, part in enumerate(parts):
            body, span = part.source.read_at(0, part.source.size), part.span
            opened.write(body)
            entries.append(
                Entry(
                    GROUP_KIND,
                    number,
                    0,
                    0,
                    span.start,
                    span.count,
                    CODEC_RAW,
                    len(body),
                    len(body),
                    google_crc32c.value(body),
                )
            )
        size = opened.tell()
        opened.seek(0)
        opened.write(header_and_index(entries, max(part.value_count for part in parts)))
    return size


def check_spans(spans: Sequence[Span], names: str | Sequence[str]) -> None:
    """Refuse frames that do not make a clip: each group begins and ends after the one before, none is left out between them, and none is
    in three.

    `names`: of the file, or of one for each group, for messages.
    """
    called = [f"{names}: group {k}" for k in range(len(spans))] if isinstance(names, str) else names
    for number, (before, after) in enumerate(zip(spans, spans[1:])):
        if not before.start < after.start <= before.last + 1 or not before.last < after.last:
            one, other = called[number : number + 2]
            raise FormatError(
                f"{one} holds frames {before.start} to {before.last}, {other} frames {after.start} to {after.last}: "
                "each must begin and end later than the one before, and leave no frame out"
            )
    for number, (before, after) in enumerate(zip(spans, spans[2:])):
        if after.start <= before.last:
            raise FormatError(
                f"{called[number + 2]} begins with frame {after.start}, which two groups before it hold: a frame may be in "
                "two groups, not in three"
            )
    if (frames := spans[-1].last - spans[0].start + 1) > FRAME_LIMIT:
        raise FormatError(f"{called[-1]}: {frames:,} frames are more than {FRAME_LIMIT:,}")
