"""Scenes of which only some segments are there (spec/kpc-format.md, section 10): what is missing, and what it counts as.

    reader = SceneReader("https://host/scene.kpc", in_parts=True)
    scene = PartialScene(reader)
    scene.fetch(scene.needed(scales=1, start=0.0, end=0.2))       nothing else is read
    kpc.render(scene.scene, scene.scene.cameras[0], time=0.1)

Space planes that are not there have the value 0, rows of time that are not there 1. They take no memory.
"""

from bisect import bisect_right
from collections.abc import Iterable, Sequence
from typing import cast

import numpy as np
from kpc.format.coding.quantise import dequantise_symbols
from kpc.format.container.container import Entry, Reader
from kpc.format.container.scene_io import SceneReader
from kpc.format.container.scene_layout import KNOWN_KINDS, PlaneHead
from kpc.format.scene.scene import ALL_PLANES, TIME_PLANES, Scene

HAIR = 1e-6
"""Of the clip: which rows a time lies between is worked out in float32."""


class SegmentedPlane:
    """A time plane held as symbols, in segments, of which any may be missing.

    `plane[row]` is (columns, M) float32, and (rows, columns, M) its `shape`, so that it can stand where an array does of which
    only single rows are looked at (`kpc.format.scene.grid.sample_linear`).
    """

    ndim = 3

    def __init__(self, head: PlaneHead, starts: Iterable[int]) -> None:
        self.shape = head.rows, head.columns, head.channels
        self.size = head.value_count
        self._head = head
        self._starts = sorted(starts)
        self._segments: dict[int, np.ndarray] = {}
        self._missing = np.broadcast_to(head.offset, self.shape[1:])

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, row: int) -> np.ndarray:
        start = self._starts[bisect_right(self._starts, int(row)) - 1]
        symbols = self._segments.get(start)
        return (
            self._missing
            if symbols is None
            else dequantise_symbols(symbols[int(row) - start], self._head.step, self._head.offset)
        )

    def put(self, start: int, symbols: np.ndarray) -> None:
        """The segment that begins at row `start`: (row_count, columns, M) int8."""
        self._segments[start] = symbols

    def drop(self, start: int) -> None:
        self._segments.pop(start, None)


class PartialScene:
    """A scene with the segments that have been put into it.

    Opening it reads the chunks without which there is no picture, and the cameras and appearances.

    Attributes:
        scene: to be rendered like any other. Its planes change as segments come and go; time planes are `SegmentedPlane`.
        numbers: (N,) of the PLNE chunks in the index; the other arrays are in the same order, that of the file.
        scales: (N,) their scale; moves: (N,) bool, whether they are of a time plane.
        since, until: (N,) the times between which they are needed, [0, 1] over the clip.
        sizes: (N,) bytes of their symbols once decoded.
    """

    def __init__(self, reader: SceneReader) -> None:
        head = reader.head
        chosen = [(number, entry) for number, entry in enumerate(reader.index) if entry.kind == "PLNE"]
        self.reader = reader
        self.numbers = np.array([number for number, _ in chosen])
        self.scales = np.array([entry.scale for _, entry in chosen])
        self.moves = np.array([ALL_PLANES[entry.plane] in TIME_PLANES for _, entry in chosen])
        rows = np.array([head.scales[entry.scale][ALL_PLANES[entry.plane]].rows for _, entry in chosen])
        first, count = (np.array([getattr(entry, name) for _, entry in chosen]) for name in ("row_start", "row_count"))
        last = np.maximum(rows - 1, 1)
        self.since = np.where(self.moves, (first - 1) / last, -1.0) - HAIR
        self.until = np.where(self.moves, (first + count) / last, 2.0) + HAIR
        self.sizes = count * np.array([plane.columns * plane.channels for plane in map(self.head_of, self.numbers)])
        first_picture = {
            number for number, entry in enumerate(reader.index) if entry.kind in KNOWN_KINDS and entry.kind != "PLNE"
        }
        announce(reader, adjacent_runs(reader.index, sorted(first_picture.union(self.needed(1, 0.0, 0.0))))[0])
        motion = reader.motion()
        self._planes: list[dict[str, np.ndarray]] = []
        starts: dict[tuple[int, str], list[int]] = {}
        for _, entry in chosen:
            starts.setdefault((entry.scale, ALL_PLANES[entry.plane]), []).append(entry.row_start)
        for s, scale in enumerate(head.scales):
            self._planes.append({name: cast(np.ndarray, SegmentedPlane(plane, starts[s, name])) if name in TIME_PLANES
                                 else _unseen(plane) for name, plane in scale.items()})  # fmt: skip
        self.scene = Scene(head.aabb, head.clip, tuple(self._planes), reader.decoder(), reader.occupancy(), head.background,
                           head.step, reader.cameras(), reader.mapping(), None if motion is None else motion.dequantise(),
                           reader.appearances())  # fmt: skip

    def entry(self, number: int) -> Entry:
        return self.reader.index[number]

    def head_of(self, number: int) -> PlaneHead:
        """The plane that chunk `number` is of."""
        entry = self.entry(number)
        return self.reader.head.scales[entry.scale][ALL_PLANES[entry.plane]]

    def is_needed(self, start: float, end: float) -> np.ndarray:
        """(N,) bool: which segments a time in [start, end] needs; those of space planes always."""
        return np.asarray((self.since < end) & (start < self.until))

    def needed(self, scales: int, start: float, end: float) -> list[int]:
        """The chunks that the first `scales` scales need from `start` to `end`, [0, 1] over the clip; in the order of the file."""
        return [int(number) for number in self.numbers[self.is_needed(start, end) & (self.scales < scales)]]

    def fetch(self, numbers: Iterable[int]) -> None:
        """Read chunks and put them into the scene; those that lie side by side in one go."""
        for run in adjacent_runs(self.reader.index, numbers):
            announce(self.reader, run)
            for number in run:
                self.put(number, self.reader.segment(number)[0])

    def put(self, number: int, symbols: np.ndarray) -> None:
        """Put a segment into the scene: (row_count, columns, M) int8."""
        entry, plane = self.entry(number), self.head_of(number)
        name = ALL_PLANES[entry.plane]
        if name in TIME_PLANES:
            self._segmented(entry).put(entry.row_start, symbols)
        else:
            self._planes[entry.scale][name] = dequantise_symbols(symbols, plane.step, plane.offset)

    def drop(self, number: int) -> None:
        """Take a segment out of the scene again."""
        entry = self.entry(number)
        name = ALL_PLANES[entry.plane]
        if name in TIME_PLANES:
            self._segmented(entry).drop(entry.row_start)
        else:
            self._planes[entry.scale][name] = _unseen(self.head_of(number))

    def _segmented(self, entry: Entry) -> SegmentedPlane:
        return cast(SegmentedPlane, self._planes[entry.scale][ALL_PLANES[entry.plane]])


def adjacent_runs(index: Sequence[Entry], numbers: Iterable[int], most_bytes: float = float("inf")) -> list[list[int]]:
    """Chunks, in the order given, in groups that lie side by side in the file; a group of several is at most `most_bytes`."""
    found: list[list[int]] = []
    end = size = 0
    for number in numbers:
        entry = index[number]
        if found and entry.offset == end and size + entry.stored_length <= most_bytes:
            found[-1].append(number)
        else:
            found.append([number])
            size = 0
        end, size = entry.offset + entry.stored_length, size + entry.stored_length
    return found


def announce(reader: Reader, run: Sequence[int]) -> None:
    """Tell the source that chunks will be read that lie side by side, in their order."""
    start, last = reader.index[run[0]].offset, reader.index[run[-1]]
    reader.source.will_read(start, last.offset + last.stored_length - start)


def _unseen(plane: PlaneHead) -> np.ndarray:
    return np.broadcast_to(np.float32(0), (plane.rows, plane.columns, plane.channels))
