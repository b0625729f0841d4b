"""Long clips: files that hold several groups, each a scene over some of the clip's frames (spec/kpc-format.md,
"Groups").

    GRUP chunk    a whole .kpc file: one group. Its index entry says which frames of the clip the group covers.

Planes that groups store alike lie beside them (`kpc.format.container.shared_planes`), and are read as if they lay in
each of these groups.

Each group has planes, occupancy, motion grid and decoder of its own and is encoded, fetched and released like any
scene. Encoding and playing therefore take the memory of one or two groups, however long the clip. Over frames that two
groups share the picture is blended from one to the other, since a hard switch between their different errors would be
visible.

    groups = Groups("long.kpc")                    # a file without groups counts as one group
    number, time = groups.timeline.at(0.7)         # the group shown, and the time in it
    scene = read(groups.open(number)).dequantise()
"""

import itertools
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import google_crc32c

from kpc.format.common.cli import atomic_write
from kpc.format.common.errors import FormatError, UsageError
from kpc.format.common.memory import DEFAULT_BUDGET
from kpc.format.common.text import agreeing
from kpc.format.container.container import ENTRY, HEADER, Codec, Entry, Reader, header_and_index, stored_frame
from kpc.format.container.metadata_chunk import META_LIMIT, pack_metadata, parse_metadata
from kpc.format.container.scene_io import SceneReader, read
from kpc.format.container.scene_layout import GROUP_KIND, PLANE_KIND
from kpc.format.container.shared_planes import SharedPlanes, put_back, stored_alike, without_shared
from kpc.format.container.slices import sliced
from kpc.format.container.sources import AnySource, RemoteSource, Source, open_source
from kpc.format.container.timeline import Span, Timeline, check_spans
from kpc.format.scene.cameras import Camera
from kpc.format.scene.metadata import Metadata, merged
from kpc.format.scene.scene import Appearance, Clip, Scene


class Groups:
    """Random access to the groups of a file. A file without GRUP chunks counts as a single group.

    Opening reads header and index of the file, and header, index and SCNE chunk of the first group.

    Args:
        source: as for `Reader`.
        memory_budget: bytes that one group may take.
        allow_partial, in_parts: as for `SceneReader`.
        reads_metadata: whether metadata beside the groups are read, and refused if they are wrong, at once rather than
            when they are asked for.
        needs_first: whether the first group must be readable; if not, the rate of the clip is that of the first one
            that is.

    Attributes:
        timeline: which group is shown when.
        reader: of the file.
        is_single: whether the file is a scene without groups.

    Raises:
        FormatError, BudgetError: as `SceneReader`, or the groups do not make up a clip.
    """

    def __init__(
        self,
        source: AnySource,
        *,
        memory_budget: int = DEFAULT_BUDGET,
        allow_partial: bool = False,
        in_parts: bool = False,
        reads_metadata: bool = True,
        needs_first: bool = True,
    ) -> None:
        source = open_source(source, limit=memory_budget)
        self.reader = Reader(source, allow_partial=allow_partial)
        self.name, self._budget, self._in_parts = self.reader.name, memory_budget, in_parts
        self._shared: SharedPlanes | None = None
        self._chunks = [number for number, entry in enumerate(self.reader.index) if entry.kind == GROUP_KIND]
        self.is_single, self._first_number = not self._chunks, 0
        if self.is_single:
            self._first = SceneReader(
                self.reader, memory_budget=memory_budget, allow_partial=allow_partial, in_parts=in_parts
            )
            spans: tuple[Span, ...] = (Span(0, self._first.head.clip.frame_count),)
        else:
            if isinstance(source, RemoteSource) and not source.has_ranges:
                # Groups are read concurrently, but such a server sends everything in one response.
                self.reader.source = open_source(source.read_at(0, source.size))
            spans = self._spans()
            self._shared = SharedPlanes(self.reader, len(spans), memory_budget)
            self._first_number, self._first = self._first_readable(1 if needs_first else len(spans))
        if reads_metadata:
            _ = self._beside
        self.timeline = Timeline(spans, self._first.head.clip.fps)
        self._check(self._first_number, self._first)

    def __len__(self) -> int:
        return len(self.timeline.spans)

    @property
    def clip(self) -> Clip:
        """The time axis of the whole clip."""
        return self.timeline.clip

    @property
    def size_bytes(self) -> list[int]:
        """The size of each group in bytes."""
        if self.is_single:
            return [self.reader.header.file_length]
        return [self.reader.index[chunk].stored_length for chunk in self._chunks]

    def available(self, number: int) -> bool:
        """Return whether a group is complete; False only in a partial file."""
        if self._shared is None:
            return True
        if not self.reader.available(self._chunks[number]) or self._shared.are_there(number):
            return self.reader.available(self._chunks[number])
        reader = self._reader(number, self._slice(number, self.reader.source))
        return all(plane.is_there for plane in reader.beside.values())

    def open(self, number: int, apart: bool = False) -> SceneReader:
        """Open the scene of a group.

        Args:
            number: of the group, from 0 on.
            apart: whether to open a source of its own, so that another thread can read it beside other groups.

        Raises:
            FormatError, BudgetError: as `SceneReader`, or the group contradicts the index.
        """
        if number == self._first_number and not apart:
            return self._first
        scene = self._opened(number, self.source_of(number) if apart else self._slice(number, self.reader.source))
        self._check(number, scene)
        return scene

    def source_of(self, number: int) -> Source:
        """Return the bytes of a group as a source that another thread can read beside other groups. Planes that it
        shares are not among them, see `whole`.
        """
        source = self.reader.source
        if isinstance(source, RemoteSource) and source.has_ranges:
            source = source.clone()
        return source if self.is_single else self._slice(number, source)

    def whole(self, number: int) -> Source:
        """Return a group as a file of its own, in which the planes lie that it shares.

        Raises:
            FormatError: as `SceneReader`, or a plane that it shares is not in the file.
        """
        source = self.source_of(number)
        return source if self._shared is None else put_back(self._reader(number, source))

    def cameras(self) -> tuple[Camera, ...]:
        """Return the cameras of the first group, which stand for all."""
        return self.open(0).cameras()

    def metadata(self) -> Metadata:
        """Return the metadata beside the groups, which are those of the clip; without any, those of the first group."""
        return self.open(0).metadata() if self._beside is None else self._beside

    @cached_property
    def _beside(self) -> Metadata | None:
        """The metadata beside the groups; None if there are none, or not yet."""
        if self.is_single:
            return None
        found = [number for number, entry in enumerate(self.reader.index) if entry.kind == "meta"]
        if len(found) > 1:
            raise FormatError(f"{self.name}: holds {len(found)} meta chunks, not one")
        if not found or not self.reader.available(found[0]):
            return None
        content = self.reader.chunk(found[0], META_LIMIT)
        try:
            return parse_metadata(content)
        except FormatError as error:
            raise FormatError(f"{self.name}: {error}") from error

    def _spans(self) -> tuple[Span, ...]:
        """Sort the groups by number and return their frames, after checking them."""
        entries = self.reader.index
        for number, entry in enumerate(entries):
            if entry.is_critical and entry.kind not in (GROUP_KIND, PLANE_KIND):
                raise FormatError(f"{self.name}: chunk {number} ({entry.kind}) lies outside the groups; update kpc")
            if entry.kind == GROUP_KIND and (
                entry.codec != Codec.RAW
                or entry.raw_length != entry.stored_length
                or entry.scale
                or entry.plane
                or not entry.row_count
            ):
                raise FormatError(
                    f"{self.name}: chunk {number} ({GROUP_KIND}) has a codec, a plane position or "
                    "no frames; encode the clip again"
                )
        self._chunks.sort(key=lambda chunk: entries[chunk].group)
        if [entries[chunk].group for chunk in self._chunks] != list(range(len(self._chunks))):
            raise FormatError(f"{self.name}: its groups are not numbered consecutively from 0; join them again")
        spans = tuple(Span(entries[chunk].row_start, entries[chunk].row_count) for chunk in self._chunks)
        check_spans(spans, self.name)
        return spans

    def _first_readable(self, count: int) -> tuple[int, SceneReader]:
        """Open the first group of so many that can be opened; raise what is wrong with the first one if none can."""
        wrong: list[FormatError] = []
        for number in range(count):
            try:
                return number, self._opened(number, self._slice(number, self.reader.source))
            except FormatError as error:
                wrong.append(error)
        raise wrong[0]

    def _slice(self, number: int, source: Source) -> Source:
        entry = self.reader.index[self._chunks[number]]
        return sliced(source, entry.offset, entry.stored_length, f"{self.name}, group {number}", self._shared)

    def _opened(self, number: int, source: Source) -> SceneReader:
        reader = self._reader(number, source)
        return SceneReader(reader, memory_budget=self._budget, in_parts=self._in_parts)

    def _reader(self, number: int, source: Source) -> Reader:
        """Return a reader of a group, with the planes that it shares in their places."""
        is_partial = not (self.is_single or self.reader.available(self._chunks[number]))
        if is_partial and source.size < HEADER.size:
            raise FormatError(f"{self.reader.cut_off}: group {number} is not there; fetch the file again")
        reader = Reader(source, allow_partial=is_partial)
        if self._shared is not None:
            self._shared.resolve(reader, number)
        return reader

    def _check(self, number: int, scene: SceneReader) -> None:
        clip, span = scene.head.clip, self.timeline.spans[number]
        if clip != Clip(span.count, self.timeline.fps):
            raise FormatError(
                f"{scene.name}: holds {clip.frame_count} frames at {clip.fps:g} fps, not {span.count} at "
                f"{self.timeline.fps:g} as the index says; encode the clip again"
            )
        if scene.head.value_count > self.reader.header.value_count:
            raise FormatError(
                f"{scene.name}: holds {scene.head.value_count:,} values, more than the header's "
                f"{self.reader.header.value_count:,}; encode the clip again"
            )


class GroupedScene:
    """A clip in groups, with the interface of `Scene` that rendering at a time needs.

    One group is held in memory at a time, or two while they are blended.

    Attributes:
        groups: of the file.
        clip: the time axis of the whole clip.
        cameras: some of the cameras that the first group was captured with.
        metadata: of the clip.
        timeline: which group is shown when.
    """

    def __init__(self, groups: Groups) -> None:
        self.groups = groups
        self._held: dict[int, Scene] = {}
        self.timeline, self.clip, self.cameras = groups.timeline, groups.clip, groups.cameras()
        self.metadata = groups.metadata()

    def at(self, time: float) -> tuple[Scene, float]:
        """Return the scene shown at `time` in [0, 1] over the clip, and the time in it; read it if it is not held.

        Raises:
            FormatError, BudgetError, NetworkError: as `read`.
        """
        number, time = self.timeline.at(time)
        return self._scene(number, {number}), time

    def blend_at(self, time: float) -> list[tuple[Scene, float, float]]:
        """Return the (scene, time in it, weight) triples blended at `time` in [0, 1] over the clip.

        Raises:
            FormatError, BudgetError, NetworkError: as `read`.
        """
        parts = self.timeline.blend_at(time)
        wanted = {number for number, *_ in parts}
        return [(self._scene(number, wanted), local_time, weight) for number, local_time, weight in parts]

    def appearances_at(self, times: Iterable[float]) -> list[tuple[Appearance, ...]]:
        """Return the appearances of each group that is shown at one of some times, without decoding it.

        Raises:
            FormatError, BudgetError, NetworkError: as `read`.
        """
        numbers = {number for time in times for number, *_ in self.timeline.blend_at(time)}
        return [self.groups.open(number).appearances() for number in sorted(numbers)]

    def _scene(self, number: int, wanted: set[int]) -> Scene:
        # Release what is no longer needed before another group is read.
        self._held = {held: scene for held, scene in self._held.items() if held in wanted}
        if number not in self._held:
            scene = read(self.groups.open(number)).dequantise()
            self._held[number] = replace(scene, cameras=scene.cameras or self.cameras, metadata=self.metadata)
        return self._held[number]


def load(source: AnySource, memory_budget: int = DEFAULT_BUDGET) -> Scene | GroupedScene:
    """Read a file: its scene, or a clip in groups, each of which is read when it is needed."""
    groups = Groups(source, memory_budget=memory_budget)
    return read(groups.open(0)).dequantise() if groups.is_single else GroupedScene(groups)


@dataclass(frozen=True)
class GroupInput:
    """A scene file that becomes a group of a clip.

    Attributes:
        source: the file.
        span: the frames of the clip that it covers.
        fps: frames per second.
        value_count: number of values in its planes, from its header.
        metadata: of the file that it was part of.
    """

    source: Source
    span: Span
    fps: float
    value_count: int
    metadata: Metadata

    @staticmethod
    def of(source: AnySource, start: int, metadata: Metadata | None = None) -> "GroupInput":
        """Open a scene file that covers the frames from `start` on; its own metadata stand for None."""
        scene = SceneReader(source, in_parts=True)
        clip = scene.head.clip
        found = scene.metadata() if metadata is None else metadata
        return GroupInput(scene.source, Span(start, clip.frame_count), clip.fps, scene.header.value_count, found)


def group_inputs(files: Sequence[AnySource]) -> list[GroupInput]:
    """Return the groups of all files, as inputs of `write`.

    Files of groups know their frames; if all files do, they are sorted. What begins with frame 0, as scenes and whole
    clips do, follows the file before it.
    """
    opened = [Groups(source, in_parts=True) for source in files]
    if not any(groups.is_single for groups in opened):
        opened.sort(key=lambda groups: groups.timeline.spans[0].start)
    parts: list[GroupInput] = []
    for groups in opened:
        spans = groups.timeline.spans
        start = parts[-1].span.last + 1 if parts and spans[0].start == 0 else 0
        if groups.is_single:
            parts.append(GroupInput.of(groups.reader.source, start))
        else:
            parts += [
                GroupInput.of(groups.whole(number), start + span.start, groups.metadata())
                for number, span in enumerate(spans)
            ]
    return parts


def check_parts(parts: Sequence[GroupInput]) -> None:
    """Check that the frames of parts make up a clip, see `check_spans`.

    Raises:
        UsageError: they do not.
    """
    try:
        check_spans([part.span for part in parts], [part.source.name for part in parts])
    except FormatError as error:
        raise UsageError(_missing_or_twice(parts) or str(error)) from error


def _missing_or_twice(parts: Sequence[GroupInput]) -> str | None:
    """Return which frames are missing between parts, or which part is given twice; None if neither is so."""
    for before, after in itertools.pairwise(parts):
        first, last = before.span.last + 1, after.span.start - 1
        if first <= last:
            frames = f"frame {first} is" if first == last else f"frames {first} to {last} are"
            between = f"between {before.source.name} and {after.source.name}"
            return (
                f"{frames} missing {between}; give the part that holds {agreeing(last - first + 1, 'it', 'them')}, too"
            )
        if before.span.start < after.span.start and before.span.last < after.span.last:
            continue
        by_name: dict[str, GroupInput] = {}
        by_span: dict[Span, GroupInput] = {}
        for part in parts:
            if part.source.name in by_name:
                return f"{part.source.name}: is given twice; give it once"
            if part.span in by_span:
                frames = f"frames {part.span.start} to {part.span.last}"
                return f"{part.source.name}: holds {frames}, as {by_span[part.span].source.name} does; give one of both"
            by_name[part.source.name] = by_span[part.span] = part
    return None


def write(parts: Sequence[GroupInput], path: str | os.PathLike[str], metadata: Metadata | None = None) -> int:
    """Write a clip in groups and return its size in bytes.

    Planes that groups next to each other store alike are stored once, before the first of these groups. One group is in
    memory at a time. On failure an existing file at `path` is left unchanged.

    Args:
        parts: the groups, in order.
        path: of the file.
        metadata: of the clip; None for what the parts agree on.

    Raises:
        UsageError: the parts do not make up a clip.
        FormatError: a part is damaged.
    """
    check_parts(parts)
    odd = next((part for part in parts if part.fps != parts[0].fps), None)
    if odd is not None:
        raise UsageError(
            f"{odd.source.name}: runs at {odd.fps:g} fps, {parts[0].source.name} at {parts[0].fps:g}; "
            "join them with kpjoin --fps, or encode both at one rate"
        )
    metadata = merged([part.metadata for part in parts]) if metadata is None else metadata
    beside = [pack_metadata(metadata)] if metadata else []
    readers = [Reader(part.source) for part in parts]
    shared = stored_alike(readers)
    planes = [[chunk for chunk, first in chunks.items() if first == number] for number, chunks in enumerate(shared)]
    count = len(parts) + len(beside) + sum(map(len, planes))
    entries: list[Entry] = []
    with atomic_write(path) as temporary, temporary.open("wb") as opened:
        # Header and index come first but hold checksums of the groups, so they are written last.
        opened.seek(HEADER.size + len(stored_frame(bytes(ENTRY.size * count))))
        for body in beside:  # before the groups, so that it comes with the first request
            opened.write(body)
            crc, size = google_crc32c.value(body), len(body)
            entries.append(Entry("meta", 0, 0, 0, 0, 0, Codec.RAW, size, size, crc))
        for number, (part, reader) in enumerate(zip(parts, readers, strict=True)):
            for chunk in sorted(planes[number]):
                opened.write(reader.stored(chunk))
                entries.append(replace(reader.index[chunk], group=number))
            body, span = _body(reader, shared[number]), part.span
            opened.write(body)
            crc, size = google_crc32c.value(body), len(body)
            entries.append(Entry(GROUP_KIND, number, 0, 0, span.start, span.count, Codec.RAW, size, size, crc))
        size_bytes = opened.tell()
        opened.seek(0)
        opened.write(header_and_index(entries, max(part.value_count for part in parts), compress=False))
    return size_bytes


def _body(reader: Reader, shared: Mapping[int, int]) -> bytes:
    """Return the file that becomes a group, without the chunks that are shared. The CRC32C of every chunk is checked,
    since that of the group would vouch for its damage.

    Raises:
        FormatError: one differs.
    """
    if shared:
        return without_shared(reader, shared)
    _check_all(reader)
    return reader.source.read_at(0, reader.source.size)


def _check_all(reader: Reader) -> None:
    """Check the CRC32C of every chunk.

    Raises:
        FormatError: one differs.
    """
    for number in range(len(reader.index)):
        reader.stored(number)


def check_checksums(groups: Groups) -> None:
    """Check the CRC32C of every chunk of a file, those within groups first, so that an error names the smallest part.

    Raises:
        FormatError: one differs, or the file is cut off.
    """
    for number in range(len(groups)):
        _check_all(Reader(groups.source_of(number)))
    if not groups.is_single:
        _check_all(groups.reader)
