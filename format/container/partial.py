"""Scenes of which only some segments are in memory (spec/kpc-format.md, "Partial and streamed reading").

    reader = SceneReader("https://host/scene.kpc", in_parts=True)
    scene = PartialScene(reader)
    scene.fetch(scene.needed(scales=1, start=0.0, end=0.2))       nothing else is read
    kpc.render(scene.scene, scene.scene.cameras[0], time=0.1)

Missing space planes have the value 0, missing rows of time planes the value 1; neither takes memory.
"""

from bisect import bisect_right
from collections.abc import Iterable
from typing import cast

import numpy as np

from kpc.format.coding.quantise import dequantise_symbols
from kpc.format.container.container import Entry
from kpc.format.container.runs import adjacent_runs, announce
from kpc.format.container.scene_io import SceneReader
from kpc.format.container.scene_layout import KNOWN_KINDS, PlaneHead
from kpc.format.scene.scene import ALL_PLANES, TIME_PLANES, Scene

# Tolerance of times, as a share of the clip: renderers compute the rows that a time lies between in float32.
TIME_TOLERANCE = 1e-6


class SegmentedPlane:
    """A time plane held as symbols in segments, any of which may be missing.

    `plane[row]` is (columns, M) float32 and `shape` is (rows, columns, M), so that it can replace an array of which
    single rows are read (`kpc.format.scene.grid.sample_linear`).
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
        if not 0 <= row < len(self):
            raise IndexError(row)  # which ends a loop over all rows
        start = self._starts[bisect_right(self._starts, int(row)) - 1]
        symbols = self._segments.get(start)
        return (
            self._missing
            if symbols is None
            else dequantise_symbols(symbols[int(row) - start], self._head.step, self._head.offset)
        )

    def put(self, start: int, symbols: np.ndarray) -> None:
        """Put the segment that begins at row `start`: (row_count, columns, M) int8."""
        self._segments[start] = symbols

    def drop(self, start: int) -> None:
        self._segments.pop(start, None)


class PartialScene:
    """A scene with the segments that have been put into it.

    Opening it reads the chunks without which there is no picture, the cameras, the appearances and the metadata.

    Attributes:
        scene: rendered like any other. Its planes change as segments come and go; time planes are `SegmentedPlane`.
        numbers: (N,) numbers of the PLNE chunks in the index; the other arrays are in the same order, that of the file.
        scales: (N,) their scale.
        moves: (N,) bool, whether they are of a time plane.
        since, until: (N,) the times between which they are needed, in [0, 1] over the clip.
        sizes: (N,) bytes of their decoded symbols.
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
        self.since = np.where(self.moves, (first - 1) / last, -1.0) - TIME_TOLERANCE
        self.until = np.where(self.moves, (first + count) / last, 2.0) + TIME_TOLERANCE
        self.sizes = count * np.array([plane.columns * plane.channels for plane in map(self.head_of, self.numbers)])
        first_picture = {
            number
            for number, entry in enumerate(reader.index)
            if entry.kind in KNOWN_KINDS and entry.kind not in ("PLNE", "soun")
        }
        announce(reader, adjacent_runs(reader.index, sorted(first_picture.union(self.needed(1, 0.0, 0.0))))[0])
        motion = reader.motion()
        self._planes: list[dict[str, np.ndarray]] = []
        starts: dict[tuple[int, str], list[int]] = {}
        for _, entry in chosen:
            starts.setdefault((entry.scale, ALL_PLANES[entry.plane]), []).append(entry.row_start)
        for s, scale in enumerate(head.scales):
            planes = {}
            for name, plane in scale.items():
                is_time = name in TIME_PLANES
                planes[name] = (
                    cast(np.ndarray, SegmentedPlane(plane, starts[s, name])) if is_time else _missing_plane(plane)
                )
            self._planes.append(planes)
        self.scene = Scene(
            head.aabb,
            head.clip,
            tuple(self._planes),
            reader.decoder(),
            reader.occupancy(),
            head.background,
            head.step,
            reader.cameras(),
            reader.mapping(),
            None if motion is None else motion.dequantise(),
            reader.appearances(),
            reader.metadata(),
        )

    def entry(self, number: int) -> Entry:
        return self.reader.index[number]

    def head_of(self, number: int) -> PlaneHead:
        """Return the head of the plane that chunk `number` is a segment of."""
        entry = self.entry(number)
        return self.reader.head.scales[entry.scale][ALL_PLANES[entry.plane]]

    def is_needed(self, start: float, end: float) -> np.ndarray:
        """Return (N,) bool: the segments that times in [start, end] need; those of space planes always."""
        return np.asarray((self.since < end) & (start < self.until))

    def needed(self, scales: int, start: float, end: float) -> list[int]:
        """Return the chunks that the first `scales` scales need from time `start` to `end`, in file order."""
        return [int(number) for number in self.numbers[self.is_needed(start, end) & (self.scales < scales)]]

    def fetch(self, numbers: Iterable[int]) -> None:
        """Read chunks and put them into the scene; adjacent ones with one request."""
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
            self._planes[entry.scale][name] = _missing_plane(self.head_of(number))

    def _segmented(self, entry: Entry) -> SegmentedPlane:
        return cast(SegmentedPlane, self._planes[entry.scale][ALL_PLANES[entry.plane]])


def _missing_plane(plane: PlaneHead) -> np.ndarray:
    return np.broadcast_to(np.float32(0), (plane.rows, plane.columns, plane.channels))
