"""Reading a scene from a file, whole or in parts."""

import math
import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cached_property, partial
from itertools import takewhile
from typing import TypeVar

import numpy as np

from kpc.format.coding.quantise import QuantisedPlane, QuantisedScene, project_occupancy
from kpc.format.common.errors import BudgetError, FormatError
from kpc.format.common.memory import DEFAULT_BUDGET
from kpc.format.container.container import Codec, Entry, Reader
from kpc.format.container.metadata_chunk import META_LIMIT, parse_metadata
from kpc.format.container.runs import adjacent_runs, announce
from kpc.format.container.scene_layout import (
    APPEARANCE_LIMIT,
    APPEARANCE_STRUCT,
    CAMERA_LIMIT,
    CAMERA_STRUCT,
    DECODER_STRUCT,
    GROUP_KIND,
    HEAD_LIMIT,
    HIDDEN_LIMIT,
    HYBRID_STRUCT,
    KNOWN_KINDS,
    NAME_LIMIT,
    NDC_STRUCT,
    PLANE_KIND,
    Cursor,
    WeightsParser,
    parse_appearances,
    parse_cameras,
    parse_coded_cameras,
    parse_coded_motion,
    parse_coded_occupancy,
    parse_coded_weights,
    parse_decoder,
    parse_half_weights,
    parse_head,
    parse_hybrid,
    parse_mapping,
    parse_motion,
    parse_occupancy,
)
from kpc.format.container.segments import (
    SegmentSideInfo,
    merge_side_info,
    needs_occupancy,
    side_info_of,
    stores_map,
)
from kpc.format.container.sound_chunk import SOUND_LIMIT, SoundSegment, parse_sound, sound_chunks, sound_of
from kpc.format.container.sources import AnySource, RemoteSource, open_source
from kpc.format.core.decoding import decode_segment, implied_rows
from kpc.format.scene.cameras import Camera
from kpc.format.scene.metadata import Metadata
from kpc.format.scene.motion import QuantisedMotion
from kpc.format.scene.scene import (
    ALL_PLANES,
    SPACE_PLANES,
    TIME_PLANES,
    AnyDecoder,
    Appearance,
    Decoder,
    HybridDecoder,
)
from kpc.format.scene.sound import Sound
from kpc.format.scene.space import SpaceMapping

Parsed = TypeVar("Parsed")


def read(
    source: AnySource | Reader, *, memory_budget: int = DEFAULT_BUDGET, allow_partial: bool = False
) -> QuantisedScene:
    """Read a whole scene; every byte of the file is verified.

    Args:
        memory_budget: bytes that the scene may take, its float32 planes included.
        allow_partial: accept a file whose end is missing, as long as the chunks before the planes are there. Space
            planes that are not there have the value 0, rows of time planes 1.

    Raises:
        FormatError: the file is damaged, hostile or of an unknown version.
        BudgetError: it needs more than `memory_budget`; raised before the memory is taken.
    """
    reader = SceneReader(source, memory_budget=memory_budget, allow_partial=allow_partial)
    if isinstance(reader.source, RemoteSource):
        _fetch_shared(reader)
    reader.source.will_read(0, reader.source.size)
    scales = _read_planes(reader)
    for number, entry in enumerate(reader.index):
        if entry.kind not in KNOWN_KINDS and reader.available(number):
            reader.stored(number)  # its content is ignored, but it must not be damaged
    head = reader.head
    return QuantisedScene(
        head.aabb,
        head.clip,
        scales,
        reader.decoder(),
        reader.occupancy(),
        head.background,
        head.step,
        reader.cameras(),
        reader.mapping(),
        reader.motion(),
        reader.appearances(),
        reader.metadata(),
        reader.sound(),
    )


def _fetch_shared(reader: "SceneReader") -> None:
    """Fetch planes that the groups of a clip share, unless another group has, neighbours with one request."""
    for run in adjacent_runs(reader.index, filter(reader.available, reader.beside)):
        announce(reader, run)
        for number in run:
            reader.stored(number)


def _read_planes(reader: "SceneReader") -> tuple[dict[str, QuantisedPlane], ...]:
    """Decode all segments that are there, in threads."""
    entries = [(number, entry) for number, entry in enumerate(reader.index) if entry.kind == "PLNE"]
    segments = largest_first(reader, [number for number, _ in entries if reader.available(number)])
    scales = _empty_planes(reader, segments)
    side_info: dict[tuple[int, str], dict[int, SegmentSideInfo | None]] = {}
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        decoded = pool.map(reader.segment_with_side_info, segments)
        for number, (symbols, coded, info, has_map) in zip(segments, decoded, strict=True):
            entry = reader.index[number]
            name = ALL_PLANES[entry.plane]
            plane, rows = scales[entry.scale][name], slice(entry.row_start, entry.row_start + entry.row_count)
            if entry.row_count == len(plane.symbols):  # spares a copy
                has_map = has_map and name in SPACE_PLANES
                scales[entry.scale][name] = replace(plane, symbols=symbols, coded=coded, stores_map=has_map)
            else:
                plane.symbols[rows], plane.coded[rows] = symbols, coded
            side_info.setdefault((entry.scale, name), {})[entry.row_start] = info
    for (s, name), infos in side_info.items():
        starts = sorted(e.row_start for _, e in entries if (e.scale, ALL_PLANES[e.plane]) == (s, name))
        scales[s][name] = replace(scales[s][name], side_info=merge_side_info(infos), starts=tuple(starts))
    return scales


def largest_first(reader: "SceneReader", numbers: Sequence[int]) -> list[int]:
    """Return chunks in an order in which threads that share them end at about the same time."""
    return sorted(numbers, key=lambda number: -reader.index[number].stored_length)


def _empty_planes(reader: "SceneReader", segments: Iterable[int]) -> tuple[dict[str, QuantisedPlane], ...]:
    """Return planes of which nothing is coded; space planes without any segment have the value 0."""
    held = {(reader.index[number].scale, ALL_PLANES[reader.index[number].plane]) for number in segments}
    return tuple(
        {
            name: QuantisedPlane(
                np.zeros((p.rows, p.columns, p.channels), np.int8),
                p.step,
                p.offset if name in TIME_PLANES or (s, name) in held else np.zeros_like(p.offset),
                np.zeros((p.rows, p.columns), bool),
            )
            for name, p in scale.items()
        }
        for s, scale in enumerate(reader.head.scales)
    )


class SceneReader(Reader):
    """A `Reader` that knows what the chunks mean: random access to the parts of a scene.

    Opening reads header, index and SCNE, and checks that the index lists a whole scene that fits the memory budget.

    Args:
        in_parts: the caller never holds all planes, and accounts for the memory of those that it holds.

    Attributes:
        head: the SCNE chunk.
        sound_numbers: of the soun chunks, in the order of time.

    Raises:
        FormatError, BudgetError: as `read`.
    """

    def __init__(
        self,
        source: AnySource | Reader,
        *,
        memory_budget: int = DEFAULT_BUDGET,
        allow_partial: bool = False,
        in_parts: bool = False,
    ):
        opened = source if isinstance(source, Reader) else open_source(source, limit=memory_budget)
        super().__init__(opened, allow_partial=allow_partial)
        self.memory_budget = memory_budget
        self._check_kinds()
        self.head = self._parsed(parse_head, self.chunk(self._only("SCNE"), HEAD_LIMIT))
        if self.head.value_count != self.header.value_count:
            raise FormatError(
                f"{self.name}: the header claims {self.header.value_count:,} values, "
                f"the scene {self.head.value_count:,}"
            )
        self._other_bytes = {"planes that groups share": self.kept_bytes}
        self._projections: dict[str, np.ndarray] = {}
        self.planes_bytes = 0 if in_parts else 5 * self.head.value_count  # one int8 symbol and one float32 each
        if self.planes_bytes > memory_budget:
            raise BudgetError(
                f"{self.name}: needs {self.planes_bytes:,} bytes of memory, more than the budget of {memory_budget:,}"
            )
        self._check_segments()
        self.sound_numbers = self._parsed(lambda _: sound_chunks(self.index), b"")
        self._decoder_number()
        self._only("OCCU")

    def segment(self, number: int) -> tuple[np.ndarray, np.ndarray]:
        """Decode a PLNE chunk: (row_count, W, M) int8 symbols and (row_count, W) bool coded texels."""
        symbols, coded, *_ = self.segment_with_side_info(number)
        return symbols, coded

    def segment_with_side_info(self, number: int) -> tuple[np.ndarray, np.ndarray, SegmentSideInfo | None, bool]:
        """Decode a PLNE chunk, and return with what it can be encoded again.

        Returns:
            Symbols and coded texels as `segment`, its side information, and whether its texel map is stored under one
            of the codecs that could imply it.
        """
        entry = self.index[number]
        plane = self.head.scales[entry.scale][ALL_PLANES[entry.plane]]
        texels, shape = entry.row_count * plane.columns, (entry.row_count, plane.columns, plane.channels)
        limit = self.memory_budget
        if entry.codec not in (Codec.PREDICTIVE, Codec.TRANSFORM):
            payload = self.chunk(number, 1 + -(-texels // 8) + plane.channels * texels)
            return *self._parsed(lambda raw: decode_segment(Codec.RAW, raw, *shape, None, limit), payload), None, False
        if entry.raw_length != texels * plane.channels:
            raise FormatError(
                f"{self.name}: chunk {number} (PLNE) claims {entry.raw_length:,} symbols, not the "
                f"{texels * plane.channels:,} of its rows"
            )
        body, implied = self.context_coded(number), None
        if needs_occupancy(body):
            rows = range(entry.row_start, entry.row_start + entry.row_count)
            implied = implied_rows(self._projection(ALL_PLANES[entry.plane]), plane.rows, plane.columns, rows)
        return self._parsed(
            lambda body: (
                *decode_segment(entry.codec, body, *shape, implied, limit),
                side_info_of(entry.codec, body),
                stores_map(body),
            ),
            body,
        )

    def mapping(self) -> SpaceMapping | None:
        """Return the WARP chunk; None if the scene is bounded by its box."""
        number = self._at_most_one("WARP")
        if number is None:
            return None
        return self._parsed(lambda raw: parse_mapping(raw, self.head), self.chunk(number, NDC_STRUCT.size))

    def motion(self) -> QuantisedMotion | None:
        """Return the MOVE chunk; None if the scene has no motion grid."""
        number = self._at_most_one("MOVE")
        if number is None:
            return None
        entry, dynamic = self.index[number], self.head.is_dynamic
        self._afford(8 * entry.raw_length, "its motion grid")  # int16, float32 and intermediate arrays
        if entry.codec != Codec.MOTION:
            return self._parsed(lambda raw: parse_motion(raw, dynamic), self.chunk(number))
        return self._parsed(
            lambda body: parse_coded_motion(body, entry.raw_length, dynamic), self.context_coded(number)
        )

    def decoder(self) -> AnyDecoder:
        """Return the DECO or HYBR chunk."""
        return self._decoder

    @cached_property
    def _decoder(self) -> AnyDecoder:
        features, number = self.head.feature_count, self._decoder_number()
        entry = self.index[number]
        parse: Callable[[Cursor, int, WeightsParser], AnyDecoder]
        if entry.kind == "HYBR":
            head, parse = HYBRID_STRUCT, parse_hybrid
            shapes = HybridDecoder.shapes(features, HIDDEN_LIMIT, HIDDEN_LIMIT)
        else:
            head, parse, shapes = DECODER_STRUCT, parse_decoder, Decoder.shapes(features, HIDDEN_LIMIT)
        if entry.codec == Codec.WEIGHTS:
            weights: WeightsParser = partial(parse_coded_weights, raw_length=entry.raw_length - head.size)
            content = self.context_coded(number)
        else:
            weights = parse_half_weights
            content = self.chunk(number, head.size + 2 * sum(map(math.prod, shapes.values())))
        return self._parsed(lambda content: parse(Cursor(content, entry.kind), features, weights), content)

    def occupancy(self) -> np.ndarray:
        """Return the OCCU chunk: (slots, Nz, Ny, Nx) bool."""
        return self._occupancy

    @cached_property
    def _occupancy(self) -> np.ndarray:
        number = self._only("OCCU")
        entry = self.index[number]
        self._afford(8 * entry.raw_length, "its occupancy grid")  # a byte for each bit
        if entry.codec != Codec.OCCUPANCY:
            return self._parsed(parse_occupancy, self.chunk(number))
        return self._parsed(lambda body: parse_coded_occupancy(body, entry.raw_length), self.context_coded(number))

    def _projection(self, plane: str) -> np.ndarray:
        """Return the occupancy projected onto a plane, from which its implied map follows."""
        if plane not in self._projections:
            occupancy = self.occupancy()
            self._afford(occupancy.size, "projections of its occupancy")
            self._projections[plane] = project_occupancy(occupancy, plane)
        return self._projections[plane]

    def cameras(self) -> tuple[Camera, ...]:
        """Return the cameras; none if the file has (or has yet) no such chunk."""
        number = self._at_most_one("came")
        if number is None or not self.available(number):
            return ()
        entry = self.index[number]
        if entry.codec == Codec.POSES:
            return self._parsed(lambda body: parse_coded_cameras(body, entry.raw_length), self.context_coded(number))
        return self._parsed(parse_cameras, self.chunk(number, 2 + CAMERA_LIMIT * CAMERA_STRUCT.size))

    def appearances(self) -> tuple[Appearance, ...]:
        """Return the appearances; none if the file has (or has yet) no such chunk."""
        number = self._at_most_one("appe")
        if number is None or not self.available(number):
            return ()
        hidden = len(self.decoder().b1)
        most = APPEARANCE_STRUCT.size + APPEARANCE_LIMIT * (2 * hidden + 1 + NAME_LIMIT)
        self._afford(4 * self.index[number].raw_length, "its appearances")  # stored bytes, float32 codes and names
        return self._parsed(lambda raw: parse_appearances(raw, hidden), self.chunk(number, most))

    def metadata(self) -> Metadata:
        """Return the metadata; none if the file has (or has yet) no such chunk."""
        number = self._at_most_one("meta")
        if number is None or not self.available(number):
            return Metadata()
        return self._parsed(parse_metadata, self.chunk(number, META_LIMIT))

    def sound(self) -> Sound | None:
        """Return the sound, of whose packets those are there that come before the first that is missing; None if the
        file has (or has yet) none.
        """
        held = list(takewhile(self.available, self.sound_numbers))
        self._afford(3 * sum(self.index[number].stored_length for number in held), "its sound")
        return self._parsed(lambda _: sound_of(map(self.sound_segment, held)), b"")

    def sound_segment(self, number: int) -> SoundSegment:
        """Return the content of a soun chunk."""
        content, samples = self.chunk(number, SOUND_LIMIT), self.index[number].row_count
        return self._parsed(lambda raw: parse_sound(raw, samples, self.sound_samples), content)

    @property
    def sound_samples(self) -> int:
        """The samples that all soun chunks decode to."""
        return sum(self.index[number].row_count for number in self.sound_numbers)

    def _only(self, kind: str) -> int:
        """Return the number of the one chunk of a kind."""
        found = [number for number, entry in enumerate(self.index) if entry.kind == kind]
        if len(found) != 1:
            raise FormatError(f"{self.name}: holds {len(found)} {kind} chunks, not one")
        return found[0]

    def _at_most_one(self, kind: str) -> int | None:
        return self._only(kind) if any(entry.kind == kind for entry in self.index) else None

    def _decoder_number(self) -> int:
        kinds = [entry.kind for entry in self.index]
        if "DECO" in kinds and "HYBR" in kinds:
            raise FormatError(f"{self.name}: holds two decoders, DECO and HYBR")
        return self._only("HYBR" if "HYBR" in kinds else "DECO")

    def _afford(self, more_bytes: int, what: str) -> None:
        """Count memory beside the planes against the budget, together with all that was counted before."""
        self._other_bytes[what] = more_bytes
        needed = self.planes_bytes + sum(self._other_bytes.values())
        if needed > self.memory_budget:
            raise BudgetError(
                f"{self.name}: needs {needed:,} bytes of memory with {what}, more than the budget of "
                f"{self.memory_budget:,}"
            )

    def _parsed(self, parse: Callable[[bytes], Parsed], raw: bytes) -> Parsed:
        """Parse, with the name of the file in errors."""
        try:
            return parse(raw)
        except BudgetError as error:
            raise BudgetError(f"{self.name}: {error}") from error
        except FormatError as error:
            raise FormatError(f"{self.name}: {error}") from error

    def _check_kinds(self) -> None:
        for number, entry in enumerate(self.index):
            if entry.kind == PLANE_KIND and entry.codec == Codec.SHARED:
                raise FormatError(
                    f"{self.name}: chunk {number} (PLNE) stands for a shared plane, which a group of a clip alone has; "
                    "encode it again"
                )
        if any(entry.kind == GROUP_KIND for entry in self.index):
            raise FormatError(f"{self.name}: a clip in groups, where a single scene is wanted")
        for number, entry in enumerate(self.index):
            if entry.is_critical and entry.kind not in KNOWN_KINDS:
                raise FormatError(
                    f"{self.name}: chunk {number} is of the critical kind {entry.kind}, unknown to this "
                    "reader; update kpc"
                )

    def _check_segments(self) -> None:
        """Check that every plane is listed whole: its segments, in order of their rows, neither overlap nor leave a
        gap.
        """
        names = ALL_PLANES if self.head.is_dynamic else SPACE_PLANES
        found: dict[tuple[int, int], list[Entry]] = {
            (scale, plane): [] for scale in range(len(self.head.scales)) for plane in range(len(names))
        }
        for number, entry in enumerate(self.index):
            if entry.kind != "PLNE":
                position = entry.group, entry.scale, entry.plane, entry.row_start, entry.row_count
                if entry.kind in KNOWN_KINDS and entry.kind != "soun" and any(position):
                    raise FormatError(f"{self.name}: chunk {number} ({entry.kind}) claims a position among the planes")
                continue
            if entry.group != 0 or (entry.scale, entry.plane) not in found:
                raise FormatError(
                    f"{self.name}: chunk {number} belongs to group {entry.group}, scale {entry.scale}, "
                    f"plane {entry.plane}, which the scene does not have"
                )
            found[entry.scale, entry.plane].append(entry)
        for (scale, plane), entries in found.items():
            where, head, row = f"scale {scale}, plane {names[plane]}", self.head.scales[scale][names[plane]], 0
            if names[plane] in SPACE_PLANES and len(entries) > 1:
                raise FormatError(f"{self.name}: {where}: a space plane is one segment, not {len(entries)}")
            for entry in sorted(entries, key=lambda e: e.row_start):
                if entry.row_start != row or entry.row_count < 1:
                    raise FormatError(f"{self.name}: {where}: no segment starts at row {row}, or two do")
                row += entry.row_count
            if row != head.rows:
                raise FormatError(f"{self.name}: {where}: its segments hold {row} rows, not {head.rows}")
