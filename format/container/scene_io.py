"""A scene in a file: what each kind of chunk means (spec/kpc-format.md, sections 5 to 9).

    SCNE  box, clip, sizes, steps and offsets of every plane      needed before anything else
    WARP  how space beyond the box is held; absent where it is not
    MOVE  the motion grid; absent where nothing is displaced
    DECO  weights of the explicit decoder, or HYBR of the hybrid one        OCCU  occupancy grid
    came  cameras (may be ignored)                                          PLNE  one segment of one plane
    appe  appearances (may be ignored)

The order in the file is the order in which a player wants them: the coarsest picture of the first seconds, then finer
scales, then later seconds. A plane segment that has not arrived is uncoded: it reads as its offset.
"""

import math
import os
import struct
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, TypeVar

import numpy as np
from kpc.format.coding.motion_codec import decode_motion, encode_motion
from kpc.format.coding.motion_raster import decode_nodes, encode_nodes
from kpc.format.coding.occupancy_codec import decode_occupancy, encode_occupancy
from kpc.format.coding.poses import decode_poses, encode_poses
from kpc.format.coding.quantise import (
    VALUE_LIMIT,
    QuantisedPlane,
    QuantisedScene,
    needed_rows,
    needed_texels,
    project_occupancy,
)
from kpc.format.coding.raw_planes import decode_raw_segment, encode_raw_segment
from kpc.format.coding.weights import decode_weights, encode_weights
from kpc.format.common.cli import atomic_write
from kpc.format.common.errors import BudgetError, DatasetError, FormatError
from kpc.format.container.container import (
    CODEC_MIDPOINTS,
    CODEC_SYMBOLS,
    CODEC_THIRD,
    DEFAULT_BUDGET,
    EXPANSION_LIMIT,
    AnySource,
    Chunk,
    Entry,
    Reader,
    open_source,
    pack,
)
from kpc.format.container.segments import (
    SegmentSideInfo,
    choose_codec,
    codec_of,
    decode_segment,
    merge_side_info,
    needs_occupancy,
    rows_per_segment,
    side_info_at,
    side_info_of,
)
from kpc.format.scene.cameras import Camera
from kpc.format.scene.motion import DISPLACEMENT_LIMIT, QuantisedMotion
from kpc.format.scene.scene import (
    ALL_PLANES,
    SPACE_PLANES,
    TIME_PLANES,
    AnyDecoder,
    Appearance,
    Clip,
    Decoder,
    HybridDecoder,
)
from kpc.format.scene.space import Contraction, DeviceCoordinates, SpaceMapping

Parsed = TypeVar("Parsed")
Weights = Callable[["_Cursor", Mapping[str, tuple[int, ...]]], dict[str, np.ndarray]]
"""What reads arrays of these shapes."""

SCENE_STRUCT = struct.Struct("<6fIdd3fBB")
"""aabb, frame_count, fps, step, background, scale_count, dynamic"""
SCALE_STRUCT = struct.Struct("<5H")
"""channels, Nx, Ny, Nz, T (0 in a static scene)"""
WARP_STRUCT = struct.Struct("<Id")
"""which mapping (CONTRACTED), even"""
NDC_STRUCT = struct.Struct("<I12ddd")
"""which mapping (DEVICE_COORDINATES), rows of the frame, near, baseline"""
MOTION_STRUCT = struct.Struct("<4Hf")
"""T, Nz, Ny, Nx, step"""
MOTION_CODECS = {CODEC_SYMBOLS: decode_nodes, CODEC_MIDPOINTS: decode_motion}
"""What decodes a motion grid that is context-coded."""
DECODER_STRUCT = struct.Struct("<HHf")
"""features, hidden, density_bias"""
HYBRID_STRUCT = struct.Struct("<HHHf")
"""features, width, hidden, density_bias"""
OCCUPANCY_STRUCT = struct.Struct("<4H")
"""slots, Nz, Ny, Nx"""
CAMERA_STRUCT = struct.Struct("<HH16f")
"""width, height, fl_x, fl_y, cx, cy, the first three rows of camera_to_world"""
APPEARANCE_STRUCT = struct.Struct("<HH")
"""count, hidden"""

CONTRACTED, DEVICE_COORDINATES = 1, 2

SCALE_LIMIT = 16
CHANNEL_LIMIT = 256
AXIS_LIMIT = 16384
MOTION_LIMIT = 256
"""Nodes of the motion grid along an axis of space."""
HIDDEN_LIMIT = 256
CAMERA_LIMIT = 4096
APPEARANCE_LIMIT = 16384
NAME_LIMIT = 255
"""Bytes of an appearance's name in UTF-8."""
FRAME_LIMIT = 1 << 24
SAMPLE_LIMIT = 65536
"""Samples along the box's diagonal, or along a ray through contracted space, so that no file can make a ray endless."""
FRAME_TOLERANCE = 1e-4
"""Of the products of the axes of a frame that should be 0 or 1."""
BOX_LIMIT = 1 << 30
"""Magnitude of a corner of the box or a number of a camera, world units; a 1 over it bounds the box's edges below."""


@dataclass(frozen=True)
class PlaneHead:
    """What is known of a plane before any of its segments: size, and how symbols become values."""

    rows: int
    columns: int
    step: np.ndarray
    offset: np.ndarray

    @property
    def channels(self) -> int:
        return len(self.step)

    @property
    def value_count(self) -> int:
        return self.rows * self.columns * self.channels


@dataclass(frozen=True)
class SceneHead:
    """The SCNE chunk: everything but the planes' symbols, the decoder, the occupancy, the cameras and the appearances."""

    aabb: np.ndarray
    clip: Clip
    step: float
    background: np.ndarray
    scales: tuple[Mapping[str, PlaneHead], ...]

    @property
    def is_dynamic(self) -> bool:
        return "xt" in self.scales[0]

    @property
    def value_count(self) -> int:
        return sum(plane.value_count for scale in self.scales for plane in scale.values())

    @property
    def feature_count(self) -> int:
        return sum(scale["xy"].channels for scale in self.scales)


# --- writing


def write(scene: QuantisedScene, path: str | os.PathLike[str], *, segment_rows: int | None = None) -> int:
    """Write a scene; return the size in bytes. On failure `path` is left as it was.

    Args:
        segment_rows: rows of a time plane in one segment, the unit in which a player fetches time; None: as many as is usual. Planes whose
            symbols were chosen for other segments keep those.

    Raises:
        FormatError: the scene breaks a rule that every reader checks; the message says which.
    """
    return save(encode(scene, segment_rows=segment_rows), path)


def save(data: bytes, path: str | os.PathLike[str]) -> int:
    """Write what `encode` made; return its size. On failure `path` is left as it was."""
    try:
        with atomic_write(path) as aside:
            aside.write_bytes(data)
    except OSError as error:
        raise OSError(error.errno, error.strerror, os.fspath(path)) from error
    return len(data)


def encode(scene: QuantisedScene, *, segment_rows: int | None = None, compress: bool = True) -> bytes:
    """The bytes of the file that `write` makes; without `compress` every chunk is stored raw."""
    chunks = scene_chunks(scene, segment_rows=segment_rows)
    return pack(chunks, sum(p.symbols.size for scale in scene.scales for p in scale.values()), compress=compress)


def scene_chunks(scene: QuantisedScene, *, segment_rows: int | None = None) -> list[Chunk]:
    """The chunks of a scene's file, in their order."""
    if segment_rows is not None and segment_rows < 1:
        raise FormatError(f"segment_rows {segment_rows} is not positive")
    try:
        head = _pack_head(scene)
        parsed = _parse_head(head)  # the same rules that a reader applies
        _check_planes(scene, parsed)
        chunks = [Chunk("SCNE", [head])]
        if scene.mapping is not None:
            warp = _pack_mapping(scene.mapping)
            _parse_mapping(warp, parsed)
            chunks.append(Chunk("WARP", [warp]))
        if scene.motion is not None:
            move = _motion_chunk(scene.motion)
            _parse_motion(move.parts[0], parsed.is_dynamic)
            chunks.append(move)
        kind = "HYBR" if isinstance(scene.decoder, HybridDecoder) else "DECO"
        chunks += [_decoder_chunk(kind, scene.decoder, parsed.feature_count), _occupancy_chunk(scene.occupancy)]
        if scene.cameras:
            chunks.append(_cameras_chunk(scene.cameras))
        if scene.appearances:
            appe = _pack_appearances(scene.appearances, len(scene.decoder.b1))
            _parse_appearances(appe, len(scene.decoder.b1))
            chunks.append(Chunk("appe", [appe]))
    except (struct.error, OverflowError) as error:
        raise FormatError(f"scene: a number does not fit its field ({error})") from error
    segments = [
        (start / len(plane.symbols), number, ALL_PLANES.index(name), start, stop)
        for number, scale in enumerate(scene.scales)
        for name, plane in scale.items()
        for start, stop in _segments_of(plane, name in TIME_PLANES, segment_rows)
    ]
    implied = [
        {name: needed_texels(scene.occupancy, name, *plane.coded.shape) for name, plane in scale.items()}
        for scale in scene.scales
    ]
    for _, number, of_plane, start, stop in sorted(segments):
        plane = scene.scales[number][ALL_PLANES[of_plane]]
        segment, coded = plane.symbols[start:stop], plane.coded[start:stop]
        form = choose_codec(
            segment, coded, side_info_at(plane.side_info, start), implied[number][ALL_PLANES[of_plane]][start:stop]
        )
        chunks.append(
            Chunk(
                "PLNE",
                encode_raw_segment(segment, coded),
                number,
                of_plane,
                start,
                stop - start,
                dict([form]),
                segment.size,
            )
        )
    return chunks


def _segments_of(plane: QuantisedPlane, over_time: bool, segment_rows: int | None) -> list[tuple[int, int]]:
    """First rows, and the rows after the last."""
    rows = len(plane.symbols)
    usual = rows_per_segment(rows, over_time)
    starts = plane.starts or range(0, rows, segment_rows if segment_rows and over_time else usual)
    return list(pairwise([*starts, rows]))


def _pack_head(scene: QuantisedScene) -> bytes:
    if np.shape(scene.aabb) != (2, 3) or np.shape(scene.background) != (3,) or not 0 < len(scene.scales) < 256:
        raise FormatError("scene: the box must be (2, 3), the background (3,), and there must be 1 to 255 scales")
    parts = [
        SCENE_STRUCT.pack(
            *np.ravel(scene.aabb),
            scene.clip.frame_count,
            scene.clip.fps,
            scene.step,
            *scene.background,
            len(scene.scales),
            scene.is_dynamic,
        )
    ]
    names = ALL_PLANES if scene.is_dynamic else SPACE_PLANES
    for number, scale in enumerate(scene.scales):
        if set(scale) != set(names):
            raise FormatError(f"scene: scale {number} holds planes {sorted(scale)}, not {sorted(names)}")
        ny, nx, channels = scale["xy"].symbols.shape
        nz = scale["xz"].symbols.shape[0]
        nt = scale["xt"].symbols.shape[0] if scene.is_dynamic else 0
        parts.append(SCALE_STRUCT.pack(channels, nx, ny, nz, nt))
        for name in names:
            parts.append(scale[name].step.astype("<f4").tobytes())
            if name in SPACE_PLANES:
                parts.append(scale[name].offset.astype("<f4").tobytes())
    return b"".join(parts)


def _check_planes(scene: QuantisedScene, head: SceneHead) -> None:
    for number, (scale, heads) in enumerate(zip(scene.scales, head.scales, strict=True)):
        for name, plane in scale.items():
            where, expected = f"scale {number}, plane {name}", heads[name]
            shape = (expected.rows, expected.columns, expected.channels)
            if plane.symbols.shape != shape or plane.coded.shape != shape[:2] or plane.symbols.dtype != np.int8:
                raise FormatError(f"{where}: is {plane.symbols.dtype} {plane.symbols.shape}, not int8 {shape}")
            if not np.array_equal(plane.offset, expected.offset):
                raise FormatError(f"{where}: the offset of a time plane must be 1")
            if plane.symbols[~plane.coded].any():
                raise FormatError(f"{where}: an uncoded texel holds a symbol other than 0")


def _decoder_chunk(kind: str, decoder: AnyDecoder, features: int) -> Chunk:
    hidden, bias = len(decoder.b1), decoder.density_bias
    if isinstance(decoder, HybridDecoder):
        width = len(decoder.v_bias)
        head, shapes = HYBRID_STRUCT.pack(features, width, hidden, bias), HybridDecoder.shapes(features, width, hidden)
    else:
        head, shapes = DECODER_STRUCT.pack(features, hidden, bias), Decoder.shapes(features, hidden)
    weights = {name: getattr(decoder, name) for name in shapes}
    for name, shape in shapes.items():
        if np.shape(weights[name]) != shape:
            raise FormatError(f"decoder: {name} is {np.shape(weights[name])}, not {shape}")
    if any(not np.array_equal(w, w.astype(np.float16)) for w in weights.values()):
        raise FormatError("decoder: the weights are not rounded to float16 (kpc.format.coding.quantise.round_decoder)")
    raw = b"".join([head, *(np.asarray(w).astype("<f2").tobytes() for w in weights.values())])
    told = encode_weights(list(weights.values()))
    return Chunk(kind, [raw], coded={} if told is None else {CODEC_SYMBOLS: lambda: head + told}, symbol_count=len(raw))


def _pack_mapping(mapping: SpaceMapping) -> bytes:
    if isinstance(mapping, Contraction):
        return WARP_STRUCT.pack(CONTRACTED, mapping.uniform_distance)
    return NDC_STRUCT.pack(DEVICE_COORDINATES, *np.ravel(mapping.frame), mapping.near, mapping.baseline)


def _motion_chunk(motion: QuantisedMotion) -> Chunk:
    symbols = motion.symbols
    if symbols.ndim != 5 or symbols.shape[4] != 3 or symbols.dtype != np.int16:
        raise FormatError(f"motion: is {symbols.dtype} {symbols.shape}, not int16 (T, Nz, Ny, Nx, 3)")
    differences = np.diff(symbols.astype("<i2").view("<u2"), axis=0, prepend=np.uint16(0))  # modulo 2^16
    low_bytes_first = np.ascontiguousarray(differences.reshape(-1, 1).view(np.uint8).T)
    head = MOTION_STRUCT.pack(*symbols.shape[:4], motion.step)
    raw = head + low_bytes_first.tobytes()
    return Chunk(
        "MOVE",
        [raw],
        symbol_count=len(raw),
        coded={
            CODEC_SYMBOLS: lambda: head + encode_nodes(symbols),
            CODEC_MIDPOINTS: lambda: head + encode_motion(symbols),
        },
    )


def _occupancy_chunk(occupancy: np.ndarray) -> Chunk:
    if occupancy.ndim != 4 or occupancy.dtype != bool or not all(0 < n <= AXIS_LIMIT for n in occupancy.shape):
        raise FormatError(f"occupancy: is {occupancy.dtype} {occupancy.shape}, not bool (slots, Nz, Ny, Nx)")
    slots_last = np.moveaxis(occupancy, 0, -1)  # a cell that never changes makes a run of equal bits
    head = OCCUPANCY_STRUCT.pack(*occupancy.shape)
    raw = head + np.packbits(slots_last, bitorder="little").tobytes()
    return Chunk(
        "OCCU", [raw], coded={CODEC_SYMBOLS: lambda: head + encode_occupancy(occupancy)}, symbol_count=len(raw)
    )


def _cameras_chunk(cameras: tuple[Camera, ...]) -> Chunk:
    raw = struct.pack("<H", len(cameras)) + b"".join(
        CAMERA_STRUCT.pack(c.width, c.height, c.fl_x, c.fl_y, c.cx, c.cy, *np.ravel(c.camera_to_world[:3]))
        for c in cameras
    )
    _parse_cameras(raw)
    told = encode_poses(cameras)
    return Chunk("came", [raw], coded={} if told is None else {CODEC_SYMBOLS: lambda: told}, symbol_count=len(raw))


def _pack_appearances(appearances: tuple[Appearance, ...], hidden: int) -> bytes:
    codes = [appearance.code for appearance in appearances]
    if any(np.shape(code) != (hidden,) for code in codes):
        raise FormatError(f"appearances: codes of shapes {sorted({np.shape(code) for code in codes})}, not {(hidden,)}")
    if any(not np.array_equal(code, code.astype(np.float16)) for code in codes):
        raise FormatError("appearances: the codes are not rounded to float16 (kpc.format.coding.quantise.to_half)")
    names = [
        appearance.name.encode(errors="surrogatepass") for appearance in appearances
    ]  # the parser refuses surrogates
    return b"".join(
        [
            APPEARANCE_STRUCT.pack(len(codes), hidden),
            np.stack(codes).astype("<f2").tobytes(),
            *(struct.pack("<B", len(name)) + name for name in names),
        ]
    )


# --- reading


def read(
    source: AnySource | Reader, *, memory_budget: int = DEFAULT_BUDGET, allow_partial: bool = False
) -> QuantisedScene:
    """Read a whole scene; every byte of the file is verified.

    Args:
        memory_budget: bytes that the scene may take, its float32 planes included.
        allow_partial: accept a file whose end is missing, as long as SCNE, DECO and OCCU are there. Space planes that
            are not there have the value 0, rows of time planes 1.

    Raises:
        FormatError: the file is damaged, hostile or of an unknown version.
        BudgetError: it needs more than `memory_budget`; raised before the memory is taken.
    """
    reader = SceneReader(source, memory_budget=memory_budget, allow_partial=allow_partial)
    reader.source.will_read(0, reader.source.size)
    segments = [
        number for number, entry in enumerate(reader.index) if entry.kind == "PLNE" and reader.available(number)
    ]
    held = {(reader.index[number].scale, ALL_PLANES[reader.index[number].plane]) for number in segments}
    scales = tuple(
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
    starts: dict[tuple[int, str], list[int]] = {}
    for entry in reader.index:
        if entry.kind == "PLNE":
            starts.setdefault((entry.scale, ALL_PLANES[entry.plane]), []).append(entry.row_start)
    guides: dict[tuple[int, str], dict[int, SegmentSideInfo | None]] = {}
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for number, (decoded, coded, side_info) in zip(
            segments, pool.map(reader.segment_with_side_info, segments), strict=True
        ):
            entry = reader.index[number]
            name = ALL_PLANES[entry.plane]
            plane, rows = scales[entry.scale][name], slice(entry.row_start, entry.row_start + entry.row_count)
            if entry.row_count == len(plane.symbols):  # spares a copy
                scales[entry.scale][name] = replace(plane, symbols=decoded, coded=coded)
            else:
                plane.symbols[rows], plane.coded[rows] = decoded, coded
            guides.setdefault((entry.scale, name), {})[entry.row_start] = side_info
    for (s, name), of_segments in guides.items():
        scales[s][name] = replace(
            scales[s][name], side_info=merge_side_info(of_segments), starts=tuple(sorted(starts[s, name]))
        )
    for number, entry in enumerate(reader.index):
        if entry.kind not in KNOWN_KINDS and reader.available(number):
            reader.stored(number)  # ignored, but never damaged
    return QuantisedScene(
        reader.head.aabb,
        reader.head.clip,
        scales,
        reader.decoder(),
        reader.occupancy(),
        reader.head.background,
        reader.head.step,
        reader.cameras(),
        reader.mapping(),
        reader.motion(),
        reader.appearances(),
    )


class SceneReader(Reader):
    """A `Reader` that knows what the chunks mean: random access to the parts of a scene.

    Opening reads header, index and SCNE, and checks that the index lists a whole scene that fits the memory budget.

    Args:
        in_parts: the caller never holds all of the planes, and minds himself what those take that he holds.

    Attributes:
        head: the SCNE chunk.

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
        if any(entry.kind == GROUP_KIND for entry in self.index):
            raise FormatError(f"{self.name}: a clip in groups, where a single scene is wanted")
        for number, entry in enumerate(self.index):
            if entry.is_critical and entry.kind not in KNOWN_KINDS:
                raise FormatError(
                    f"{self.name}: chunk {number} is of the critical kind {entry.kind}, unknown to this "
                    "reader; update kpc"
                )
        self.head = self._parsed(_parse_head, self.chunk(self._only("SCNE"), HEAD_LIMIT))
        if self.head.value_count != self.header.value_count:
            raise FormatError(
                f"{self.name}: the header claims {self.header.value_count:,} values, "
                f"the scene {self.head.value_count:,}"
            )
        self._beside: dict[str, int] = {}
        self._seen: dict[str, np.ndarray] = {}
        self.planes_bytes = 0 if in_parts else 5 * self.head.value_count  # one int8 symbol and one float32 each
        if self.planes_bytes > memory_budget:
            raise BudgetError(
                f"{self.name}: needs {self.planes_bytes:,} bytes of memory, more than the budget of {memory_budget:,}"
            )
        self._check_segments()
        self._decoder_number()
        self._only("OCCU")

    def segment(self, number: int) -> tuple[np.ndarray, np.ndarray]:
        """Decode a PLNE chunk: (row_count, W, M) int8 symbols and (row_count, W) bool coded texels."""
        symbols, coded, _ = self.segment_with_side_info(number)
        return symbols, coded

    def segment_with_side_info(self, number: int) -> tuple[np.ndarray, np.ndarray, SegmentSideInfo | None]:
        """The same, and by which the symbols were chosen, if by any."""
        entry = self.index[number]
        plane = self.head.scales[entry.scale][ALL_PLANES[entry.plane]]
        texels, shape = entry.row_count * plane.columns, (entry.row_count, plane.columns, plane.channels)
        if entry.codec not in (CODEC_SYMBOLS, CODEC_THIRD):
            payload = self.chunk(number, 1 + -(-texels // 8) + plane.channels * (1 + texels))
            return *self._parsed(lambda raw: decode_raw_segment(raw, *shape), payload), None
        if entry.raw_length != texels * plane.channels:
            raise FormatError(
                f"{self.name}: chunk {number} (PLNE) claims {entry.raw_length:,} symbols, not the "
                f"{texels * plane.channels:,} of its rows"
            )
        body = self._context_coded(number)
        if codec_of(body) != entry.codec:
            raise FormatError(
                f"{self.name}: chunk {number} (PLNE): codec {entry.codec} has no such number of sets of weights or flag"
            )

        implied = None
        if needs_occupancy(body):
            rows = range(entry.row_start, entry.row_start + entry.row_count)
            implied = needed_rows(self._seen_along(ALL_PLANES[entry.plane]), plane.rows, plane.columns, rows)
        return self._parsed(lambda body: (*decode_segment(body, *shape, implied), side_info_of(body)), body)

    def mapping(self) -> SpaceMapping | None:
        """The WARP chunk; None, a scene that is its box, if the file has no such chunk."""
        number = self._at_most_one("WARP")
        if number is None:
            return None
        return self._parsed(lambda raw: _parse_mapping(raw, self.head), self.chunk(number, NDC_STRUCT.size))

    def motion(self) -> QuantisedMotion | None:
        """The MOVE chunk; None, a scene in which nothing is displaced, if the file has no such chunk."""
        number = self._at_most_one("MOVE")
        if number is None:
            return None
        self._afford(8 * self.index[number].raw_length, "its motion grid")  # int16 and float32, and their making
        decode = MOTION_CODECS.get(self.index[number].codec)
        if decode is None:
            return self._parsed(lambda raw: _parse_motion(raw, self.head.is_dynamic), self.chunk(number))
        raw_length = self.index[number].raw_length
        return self._parsed(
            lambda body: _parse_coded_motion(body, raw_length, self.head.is_dynamic, decode),
            self._context_coded(number),
        )

    def decoder(self) -> AnyDecoder:
        """The DECO or HYBR chunk."""
        return self._decoder

    @cached_property
    def _decoder(self) -> AnyDecoder:
        features, number = self.head.feature_count, self._decoder_number()
        parse: Callable[[_Cursor, int, Weights], AnyDecoder]
        kind, raw_length = self.index[number].kind, self.index[number].raw_length
        if kind == "HYBR":
            head, parse, shapes = (
                HYBRID_STRUCT,
                _parse_hybrid,
                HybridDecoder.shapes(features, HIDDEN_LIMIT, HIDDEN_LIMIT),
            )
        else:
            head, parse, shapes = DECODER_STRUCT, _parse_decoder, Decoder.shapes(features, HIDDEN_LIMIT)
        if self.index[number].codec == CODEC_SYMBOLS:
            weights: Weights = lambda cursor, of: _coded_weights(cursor, of, raw_length - head.size)
            return self._parsed(lambda body: parse(_Cursor(body, kind), features, weights), self._context_coded(number))
        most = head.size + 2 * sum(map(math.prod, shapes.values()))
        return self._parsed(lambda raw: parse(_Cursor(raw, kind), features, _half_weights), self.chunk(number, most))

    def occupancy(self) -> np.ndarray:
        """The OCCU chunk: (slots, Nz, Ny, Nx) bool."""
        return self._occupancy

    def _seen_along(self, plane: str) -> np.ndarray:
        """`kpc.format.coding.quantise.project_occupancy` of the occupancy."""
        if plane not in self._seen:
            occupancy = self.occupancy()
            self._afford(occupancy.size, "what its occupancy implies")
            self._seen[plane] = project_occupancy(occupancy, plane)
        return self._seen[plane]

    @cached_property
    def _occupancy(self) -> np.ndarray:
        number = self._only("OCCU")
        self._afford(8 * self.index[number].raw_length, "its occupancy grid")  # a byte for each bit
        if self.index[number].codec != CODEC_SYMBOLS:
            return self._parsed(_parse_occupancy, self.chunk(number))
        raw_length = self.index[number].raw_length
        return self._parsed(lambda body: _parse_coded_occupancy(body, raw_length), self._context_coded(number))

    def cameras(self) -> tuple[Camera, ...]:
        """The cameras, none if the file has (or has yet) no such chunk."""
        number = self._at_most_one("came")
        if number is None or not self.available(number):
            return ()
        if self.index[number].codec == CODEC_SYMBOLS:
            raw_length = self.index[number].raw_length
            return self._parsed(lambda body: _parse_coded_cameras(body, raw_length), self._context_coded(number))
        return self._parsed(_parse_cameras, self.chunk(number, 2 + CAMERA_LIMIT * CAMERA_STRUCT.size))

    def appearances(self) -> tuple[Appearance, ...]:
        """The appearances, none if the file has (or has yet) no such chunk."""
        number = self._at_most_one("appe")
        if number is None or not self.available(number):
            return ()
        hidden = len(self.decoder().b1)
        most = APPEARANCE_STRUCT.size + APPEARANCE_LIMIT * (2 * hidden + 1 + NAME_LIMIT)
        self._afford(4 * self.index[number].raw_length, "its appearances")  # as they are stored, float32, and names
        return self._parsed(lambda raw: _parse_appearances(raw, hidden), self.chunk(number, most))

    def _context_coded(self, number: int) -> bytes:
        """A chunk of codec 2 or 3 as it is stored, if it may stand for as much as it claims."""
        entry = self.index[number]
        if entry.raw_length > entry.stored_length * EXPANSION_LIMIT:
            raise FormatError(
                f"{self.name}: chunk {number} ({entry.kind}) claims a length of {entry.raw_length:,}, more than "
                f"{entry.stored_length:,} bytes can hold"
            )
        return self.stored(number)

    def _only(self, kind: str) -> int:
        found = [number for number, entry in enumerate(self.index) if entry.kind == kind]
        if len(found) != 1:
            raise FormatError(f"{self.name}: holds {len(found)} {kind} chunks, not one")
        return found[0]

    def _decoder_number(self) -> int:
        kinds = [entry.kind for entry in self.index]
        if "DECO" in kinds and "HYBR" in kinds:
            raise FormatError(f"{self.name}: holds two decoders, DECO and HYBR")
        return self._only("HYBR" if "HYBR" in kinds else "DECO")

    def _at_most_one(self, kind: str) -> int | None:
        return self._only(kind) if any(entry.kind == kind for entry in self.index) else None

    def _afford(self, more_bytes: int, what: str) -> None:
        """Count what else is read against the budget, together with the planes and all that was read before."""
        self._beside[what] = more_bytes
        needed = self.planes_bytes + sum(self._beside.values())
        if needed > self.memory_budget:
            raise BudgetError(
                f"{self.name}: needs {needed:,} bytes of memory with {what}, more than the budget of "
                f"{self.memory_budget:,}"
            )

    def _parsed(self, parse: Callable[[bytes], Parsed], raw: bytes) -> Parsed:
        try:
            return parse(raw)
        except FormatError as error:
            raise FormatError(f"{self.name}: {error}") from error

    def _check_segments(self) -> None:
        """Every plane is listed whole: its segments, in order of their rows, neither overlap nor leave a gap."""
        names = ALL_PLANES if self.head.is_dynamic else SPACE_PLANES
        runs: dict[tuple[int, int], list[Entry]] = {
            (scale, plane): [] for scale in range(len(self.head.scales)) for plane in range(len(names))
        }
        for number, entry in enumerate(self.index):
            if entry.kind != "PLNE":
                if entry.kind in KNOWN_KINDS and any(
                    (entry.group, entry.scale, entry.plane, entry.row_start, entry.row_count)
                ):
                    raise FormatError(f"{self.name}: chunk {number} ({entry.kind}) claims a place among the planes")
                continue
            if entry.group != 0 or (entry.scale, entry.plane) not in runs:
                raise FormatError(
                    f"{self.name}: chunk {number} belongs to group {entry.group}, scale {entry.scale}, "
                    f"plane {entry.plane}, which the scene does not have"
                )
            runs[entry.scale, entry.plane].append(entry)
        for (scale, plane), entries in runs.items():
            where, head, row = f"scale {scale}, plane {names[plane]}", self.head.scales[scale][names[plane]], 0
            if names[plane] in SPACE_PLANES and len(entries) > 1:
                raise FormatError(f"{self.name}: {where}: a space plane is one segment, not {len(entries)}")
            for entry in sorted(entries, key=lambda e: e.row_start):
                if entry.row_start != row or entry.row_count < 1:
                    raise FormatError(f"{self.name}: {where}: no segment starts at row {row}, or two do")
                row += entry.row_count
            if row != head.rows:
                raise FormatError(f"{self.name}: {where}: its segments hold {row} rows, not {head.rows}")


GROUP_KIND = "GRUP"
"""A scene's file in a file of several, `kpc.format.container.groups`."""
KNOWN_KINDS = frozenset({"SCNE", "WARP", "MOVE", "DECO", "HYBR", "OCCU", "came", "appe", "PLNE"})
HEAD_LIMIT = SCENE_STRUCT.size + SCALE_LIMIT * (SCALE_STRUCT.size + 9 * 4 * CHANNEL_LIMIT)


def _parse_head(raw: bytes) -> SceneHead:
    cursor = _Cursor(raw, "SCNE")
    fields = cursor.unpack(SCENE_STRUCT)
    aabb = np.array(fields[:6], np.float32).reshape(2, 3)
    frame_count, fps, step = fields[6:9]
    background = np.array(fields[9:12], np.float32)
    scale_count, dynamic = fields[12:]
    within = bool((np.abs(aabb) <= BOX_LIMIT).all())  # not so with NaN
    edges = aabb[1].astype(np.float64) - aabb[0] if within else np.zeros(3)
    if not (edges >= 1 / BOX_LIMIT).all():
        raise FormatError("SCNE: the box is empty, not finite or absurdly large")
    if not (math.isfinite(fps) and fps > 0 and 0 < frame_count <= FRAME_LIMIT):
        raise FormatError(f"SCNE: a clip of {frame_count} frames at {fps} fps makes no sense")
    diagonal = float(np.linalg.norm(edges))
    if not (math.isfinite(step) and step > 0 and diagonal / step <= SAMPLE_LIMIT):
        raise FormatError(f"SCNE: a ray step of {step} in a box of diagonal {diagonal} makes no sense")
    if not ((background >= 0) & (background <= 1)).all():
        raise FormatError("SCNE: the background lies outside [0, 1]")
    if not 0 < scale_count <= SCALE_LIMIT or dynamic > 1:
        raise FormatError(f"SCNE: {scale_count} scales (1 to {SCALE_LIMIT} allowed), dynamic flag {dynamic}")
    scales = tuple(_parse_scale(cursor, number, bool(dynamic)) for number in range(scale_count))
    cursor.finish()
    return SceneHead(aabb, Clip(frame_count, fps), step, background, scales)


def _parse_mapping(raw: bytes, head: SceneHead) -> SpaceMapping:
    cursor, step = _Cursor(raw, "WARP"), head.step
    kind = int.from_bytes(raw[:4], "little")
    if kind == DEVICE_COORDINATES:
        _, *frame, near, baseline = cursor.unpack(NDC_STRUCT)
        cursor.finish()
        mapping = DeviceCoordinates(np.reshape(frame, (3, 4)), near, baseline)
        within = (
            all(1 / BOX_LIMIT <= x <= BOX_LIMIT for x in (near, baseline))
            and (np.abs(mapping.frame) <= BOX_LIMIT).all()
        )
        # False for NaN, too; only what is within has products that are none of them infinite
        if (
            not within
            or not (np.abs(mapping.frame[:, :3].T @ mapping.frame[:, :3] - np.eye(3)) < FRAME_TOLERANCE).all()
            or not head.aabb[1, 2] < baseline / near
        ):
            raise FormatError(
                f"WARP: device coordinates of near {near} and baseline {baseline}, their frame or the box in them "
                "make no sense"
            )
        return mapping
    if kind != CONTRACTED:
        raise FormatError(f"WARP: mapping {kind} of space, unknown to this reader; update kpc")
    _, even = cursor.unpack(WARP_STRUCT)
    cursor.finish()
    if not (1 / BOX_LIMIT <= even <= BOX_LIMIT and 2 * even / step <= SAMPLE_LIMIT):  # False for NaN, too
        raise FormatError(f"WARP: even steps of {step} up to a distance of {even} make no sense")
    return Contraction(even)


def _parse_motion(raw: bytes, dynamic: bool) -> QuantisedMotion:
    cursor = _Cursor(raw, "MOVE")
    sizes, step = _motion_head(cursor, dynamic)
    count = 3 * math.prod(sizes)
    low, high = cursor.array("u1", count).astype(np.uint16), cursor.array("u1", count).astype(np.uint16)
    cursor.finish()
    differences = (low | high << np.uint16(8)).reshape(*sizes, 3)
    return QuantisedMotion(differences.cumsum(axis=0, dtype=np.uint16).view(np.int16), step)


def _parse_coded_motion(
    body: bytes, raw_length: int, dynamic: bool, decode: Callable[[bytes, tuple[int, ...]], np.ndarray]
) -> QuantisedMotion:
    cursor = _Cursor(body, "MOVE")
    sizes, step = _motion_head(cursor, dynamic)
    if raw_length != MOTION_STRUCT.size + 6 * math.prod(sizes):
        raise FormatError(f"MOVE: claims {raw_length:,} bytes, not those of a grid of {sizes} nodes")
    return QuantisedMotion(decode(cursor.rest(), (*sizes, 3)), step)


def _motion_head(cursor: "_Cursor", dynamic: bool) -> tuple[list[int], float]:
    *sizes, step = cursor.unpack(MOTION_STRUCT)
    rows, *nodes = sizes
    if not dynamic or not 2 <= rows <= AXIS_LIMIT or not all(2 <= n <= MOTION_LIMIT for n in nodes):
        raise FormatError(
            f"MOVE: a motion grid of {rows} rows of {nodes} nodes in a {'moving' if dynamic else 'static'} scene "
            "makes no sense"
        )
    if not (step > 0 and 32768 * step <= DISPLACEMENT_LIMIT):  # False for NaN, too
        raise FormatError(f"MOVE: a step of {step} lies outside its range")
    return sizes, step


def _parse_scale(cursor: "_Cursor", number: int, dynamic: bool) -> dict[str, PlaneHead]:
    channels, nx, ny, nz, nt = cursor.unpack(SCALE_STRUCT)
    size = {"x": nx, "y": ny, "z": nz, "t": nt}
    if (
        not 0 < channels <= CHANNEL_LIMIT
        or not all(0 < n <= AXIS_LIMIT for n in (nx, ny, nz))
        or dynamic != (nt > 0)
        or nt > AXIS_LIMIT
    ):
        raise FormatError(
            f"SCNE: scale {number} claims {channels} channels on a grid of {nx}x{ny}x{nz}, {nt} rows in time"
        )
    planes = {}
    for name in ALL_PLANES if dynamic else SPACE_PLANES:
        step = cursor.array("<f4", channels).astype(np.float32)
        offset = (
            cursor.array("<f4", channels).astype(np.float32) if name in SPACE_PLANES else np.ones(channels, np.float32)
        )
        with np.errstate(over="ignore", invalid="ignore"):
            in_range = (step > 0) & (step * np.float32(128) + np.abs(offset) <= VALUE_LIMIT)
        if not in_range.all():
            raise FormatError(f"SCNE: scale {number}, plane {name}: a step or an offset lies outside its range")
        planes[name] = PlaneHead(size[name[1]], size[name[0]], step, offset)
    return planes


def _parse_decoder(cursor: "_Cursor", expected_features: int, weights: Weights) -> Decoder:
    features, hidden, bias = cursor.unpack(DECODER_STRUCT)
    if features != expected_features or not 0 < hidden <= HIDDEN_LIMIT or not math.isfinite(bias):
        raise FormatError(
            f"DECO: {features} features (the planes give {expected_features}), {hidden} hidden units "
            f"(1 to {HIDDEN_LIMIT} allowed), density bias {bias}"
        )
    return Decoder(density_bias=bias, **weights(cursor, Decoder.shapes(features, hidden)))


def _parse_hybrid(cursor: "_Cursor", expected_features: int, weights: Weights) -> HybridDecoder:
    features, width, hidden, bias = cursor.unpack(HYBRID_STRUCT)
    if (
        features != expected_features
        or not 0 < min(width, hidden) <= max(width, hidden) <= HIDDEN_LIMIT
        or not math.isfinite(bias)
    ):
        raise FormatError(
            f"HYBR: {features} features (the planes give {expected_features}), {width} and {hidden} hidden units "
            f"(1 to {HIDDEN_LIMIT} allowed), density bias {bias}"
        )
    return HybridDecoder(density_bias=bias, **weights(cursor, HybridDecoder.shapes(features, width, hidden)))


def _half_weights(cursor: "_Cursor", shapes: Mapping[str, tuple[int, ...]]) -> dict[str, np.ndarray]:
    with np.errstate(invalid="ignore"):  # a signalling NaN says so when it is cast
        weights = {
            name: cursor.array("<f2", math.prod(shape)).astype(np.float32).reshape(shape)
            for name, shape in shapes.items()
        }
    cursor.finish()
    if not all(np.isfinite(w).all() for w in weights.values()):
        raise FormatError(f"{cursor.kind}: a weight is NaN or infinite")
    return weights


def _coded_weights(cursor: "_Cursor", shapes: Mapping[str, tuple[int, ...]], raw_length: int) -> dict[str, np.ndarray]:
    if raw_length != 2 * sum(map(math.prod, shapes.values())):
        raise FormatError(f"{cursor.kind}: claims {raw_length:,} bytes of weights, not those of its sizes")
    return dict(zip(shapes, decode_weights(cursor.rest(), list(shapes.values())), strict=True))


def _parse_occupancy(raw: bytes) -> np.ndarray:
    cursor = _Cursor(raw, "OCCU")
    shape = _occupancy_shape(cursor)
    cells = math.prod(shape)
    packed = cursor.array("u1", -(-cells // 8))
    cursor.finish()
    if cells % 8 and packed[-1] >> cells % 8:
        raise FormatError("OCCU: the unused bits of its last byte are not 0")
    slots_last = np.unpackbits(packed, bitorder="little", count=cells).reshape(*shape[1:], shape[0])
    return np.ascontiguousarray(np.moveaxis(slots_last, -1, 0)).view(bool)


def _parse_coded_occupancy(body: bytes, raw_length: int) -> np.ndarray:
    cursor = _Cursor(body, "OCCU")
    shape = _occupancy_shape(cursor)
    if raw_length != OCCUPANCY_STRUCT.size + -(-math.prod(shape) // 8):
        raise FormatError(f"OCCU: claims {raw_length:,} bytes, not those of a grid of {shape} cells")
    return decode_occupancy(cursor.rest(), shape)


def _occupancy_shape(cursor: "_Cursor") -> tuple[int, ...]:
    shape = cursor.unpack(OCCUPANCY_STRUCT)
    if not all(0 < n <= AXIS_LIMIT for n in shape):
        raise FormatError(f"OCCU: a grid of {shape} cells makes no sense")
    return shape


def _parse_cameras(raw: bytes) -> tuple[Camera, ...]:
    cursor = _Cursor(raw, "came")
    (count,) = cursor.unpack(struct.Struct("<H"))
    if not 0 < count <= CAMERA_LIMIT:
        raise FormatError(f"came: {count} cameras (1 to {CAMERA_LIMIT} allowed)")
    cameras = tuple(_camera(number, cursor.unpack(CAMERA_STRUCT)) for number in range(count))
    cursor.finish()
    return cameras


def _parse_coded_cameras(body: bytes, raw_length: int) -> tuple[Camera, ...]:
    told = decode_poses(body, CAMERA_LIMIT)
    if raw_length != 2 + len(told) * CAMERA_STRUCT.size:
        raise FormatError(f"came: claims {raw_length:,} bytes, not those of {len(told)} cameras")
    return tuple(_camera(number, numbers) for number, numbers in enumerate(told))


def _camera(number: int, numbers: tuple[Any, ...]) -> Camera:
    """Of those of CAMERA_STRUCT."""
    width, height, fl_x, fl_y, cx, cy, *pose = numbers
    matrix = np.vstack([np.reshape(pose, (3, 4)), [0.0, 0.0, 0.0, 1.0]])
    lengths = np.linalg.norm(matrix[:3, :3], axis=0)
    if max(map(abs, (fl_x, fl_y, cx, cy, *pose))) > BOX_LIMIT or lengths.min() < 0.5 or lengths.max() > 2.0:
        raise FormatError(f"came: camera {number} lies absurdly far, or its axes are not of length 1")
    try:
        return Camera(width, height, fl_x, fl_y, cx, cy, matrix)
    except DatasetError as error:
        raise FormatError(f"came: camera {number}: {error}") from error


def _parse_appearances(raw: bytes, expected_hidden: int) -> tuple[Appearance, ...]:
    cursor = _Cursor(raw, "appe")
    count, hidden = cursor.unpack(APPEARANCE_STRUCT)
    if not 0 < count <= APPEARANCE_LIMIT or hidden != expected_hidden:
        raise FormatError(
            f"appe: {count} appearances (1 to {APPEARANCE_LIMIT} allowed) of {hidden} numbers (the decoder has "
            f"{expected_hidden} hidden units)"
        )
    with np.errstate(invalid="ignore"):  # a signalling NaN says so when it is cast
        codes = cursor.array("<f2", count * hidden).astype(np.float32).reshape(count, hidden)
    if not np.isfinite(codes).all():
        raise FormatError("appe: a code is NaN or infinite")
    appearances, known = [], set()
    for number, code in enumerate(codes):
        (length,) = cursor.unpack(struct.Struct("<B"))
        try:
            name = cursor.take(length).decode()
        except UnicodeDecodeError as error:
            raise FormatError(f"appe: the name of appearance {number} is not UTF-8") from error
        if not is_valid_name(name) or name in known:
            raise FormatError(
                f"appe: the name of appearance {number} is empty, holds a control character, or is there twice"
            )
        known.add(name)
        appearances.append(Appearance(name, code))
    cursor.finish()
    return tuple(appearances)


def is_valid_name(text: str) -> bool:
    """Whether an appearance may be called so: 1 to NAME_LIMIT bytes of UTF-8, no control characters, which a terminal
    might obey."""
    encoded = text.encode(errors="replace")
    controls = any(c < " " or "\x7f" <= c <= "\x9f" for c in text)
    return 0 < len(encoded) <= NAME_LIMIT and encoded.decode() == text and not controls


class _Cursor:
    """Reads a chunk from its start to its end, never beyond."""

    def __init__(self, raw: bytes, kind: str):
        self.raw, self.kind, self.position = raw, kind, 0

    def take(self, length: int) -> bytes:
        taken = self.raw[self.position : self.position + length]
        if len(taken) != length:
            raise FormatError(f"{self.kind}: ends after {len(self.raw)} bytes, {self.position + length} needed")
        self.position += length
        return taken

    def unpack(self, layout: struct.Struct) -> tuple[Any, ...]:
        return layout.unpack(self.take(layout.size))

    def array(self, dtype: str, count: int) -> np.ndarray:
        return np.frombuffer(self.take(np.dtype(dtype).itemsize * count), dtype)

    def rest(self) -> bytes:
        return self.take(len(self.raw) - self.position)

    def finish(self) -> None:
        if self.position != len(self.raw):
            raise FormatError(f"{self.kind}: {len(self.raw) - self.position} bytes too long")
