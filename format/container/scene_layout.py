"""The content of each kind of chunk, as bytes and as objects (spec/kpc-format.md, "Scene chunks" and the sections
after it).

    SCNE  box, clip, sizes, quantisation steps and offsets of every plane     WARP  mapping of space beyond the box
    MOVE  motion grid            DECO, HYBR  weights of a decoder             OCCU  occupancy grid
    came  cameras                appe        appearances                  meta  metadata (`metadata_chunk`)
    soun  sound (`sound_chunk`)

`pack_...` makes the content, `parse_...` reads and checks it. Every parser raises a FormatError if the content is too
short, too long or breaks a rule of the format.
"""

import math
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from kpc.format.coding.quantise import VALUE_LIMIT, QuantisedScene
from kpc.format.common.errors import DatasetError, FormatError
from kpc.format.core.decoding import decode_motion, decode_occupancy, decode_poses, decode_weights
from kpc.format.scene.cameras import Camera, has_unit_axes
from kpc.format.scene.motion import DISPLACEMENT_LIMIT, QuantisedMotion
from kpc.format.scene.scene import ALL_PLANES, SPACE_PLANES, Appearance, Clip, Decoder, HybridDecoder
from kpc.format.scene.space import Contraction, DeviceCoordinates, SpaceMapping

SCENE_STRUCT = struct.Struct("<6fIdd3fBB")  # aabb, frame_count, fps, step, background, scale_count, dynamic
SCALE_STRUCT = struct.Struct("<5H")  # channels, Nx, Ny, Nz, T (0 in a static scene)
WARP_STRUCT = struct.Struct("<Id")  # mapping (CONTRACTED), extent of even steps
NDC_STRUCT = struct.Struct("<I12ddd")  # mapping (DEVICE_COORDINATES), rows of the frame, near, baseline
MOTION_STRUCT = struct.Struct("<4Hf")  # T, Nz, Ny, Nx, step
DECODER_STRUCT = struct.Struct("<HHf")  # features, hidden, density_bias
HYBRID_STRUCT = struct.Struct("<HHHf")  # features, width, hidden, density_bias
OCCUPANCY_STRUCT = struct.Struct("<4H")  # slots, Nz, Ny, Nx
CAMERA_STRUCT = struct.Struct("<HH16f")  # width, height, fl_x, fl_y, cx, cy, first three rows of camera_to_world
APPEARANCE_STRUCT = struct.Struct("<HH")  # count, hidden

CONTRACTED, DEVICE_COORDINATES = 1, 2  # mappings of space

SCALE_LIMIT = 16
CHANNEL_LIMIT = 256  # of a scale
AXIS_LIMIT = 16384  # texels along an axis, rows in time, occupancy cells along an axis
MOTION_LIMIT = 256  # nodes of the motion grid along an axis of space
HIDDEN_LIMIT = 256  # hidden units of a decoder's layer
CAMERA_LIMIT = 4096
APPEARANCE_LIMIT = 16384
NAME_LIMIT = 255  # bytes of an appearance's name in UTF-8
FRAME_LIMIT = 1 << 24
# Samples along the box's diagonal, or along a ray through contracted space, so that no file can make a ray endless.
SAMPLE_LIMIT = 65536
FRAME_TOLERANCE = 1e-4  # of the products of the axes of a frame, which should be 0 or 1
# Magnitude of a corner of the box or of a camera's numbers, in world units; 1 over it bounds the box's edges below.
BOX_LIMIT = 1 << 30

PLANE_KIND = "PLNE"  # a segment of a plane, or beside groups a plane that they share
GROUP_KIND = "GRUP"  # a scene's file in a file of several, `kpc.format.container.groups`
KNOWN_KINDS = frozenset({"SCNE", "WARP", "MOVE", "DECO", "HYBR", "OCCU", "came", "appe", "meta", "soun", "PLNE"})
HEAD_LIMIT = SCENE_STRUCT.size + SCALE_LIMIT * (SCALE_STRUCT.size + 9 * 4 * CHANNEL_LIMIT)  # bytes of SCNE, at most


@dataclass(frozen=True)
class PlaneHead:
    """What SCNE says of a plane: its size, and how symbols become values (`kpc.format.coding.quantise`)."""

    rows: int
    columns: int
    step: np.ndarray  # (M,) float32
    offset: np.ndarray  # (M,) float32

    @property
    def channels(self) -> int:
        return len(self.step)

    @property
    def value_count(self) -> int:
        return self.rows * self.columns * self.channels


@dataclass(frozen=True)
class SceneHead:
    """The SCNE chunk: everything but the planes' symbols, the decoder, the occupancy, the cameras and the
    appearances.
    """

    aabb: np.ndarray  # (2, 3) float32
    clip: Clip
    step: float
    background: np.ndarray  # (3,) float32
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


class Cursor:
    """Reads the content of a chunk from its start to its end, never beyond."""

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


# --- SCNE


def pack_head(scene: QuantisedScene) -> bytes:
    """Return the SCNE chunk of a scene.

    Raises:
        FormatError: the arrays do not have the shapes of a scene.
    """
    if np.shape(scene.aabb) != (2, 3) or np.shape(scene.background) != (3,) or not 0 < len(scene.scales) < 256:
        raise FormatError("scene: the box must be (2, 3), the background (3,), and there must be 1 to 255 scales")
    clip = scene.clip
    fields = *np.ravel(scene.aabb), clip.frame_count, clip.fps, scene.step, *scene.background
    parts = [SCENE_STRUCT.pack(*fields, len(scene.scales), scene.is_dynamic)]
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


def parse_head(raw: bytes) -> SceneHead:
    """Read the SCNE chunk."""
    cursor = Cursor(raw, "SCNE")
    fields = cursor.unpack(SCENE_STRUCT)
    aabb = np.array(fields[:6], np.float32).reshape(2, 3)
    frame_count, fps, step = fields[6:9]
    background = np.array(fields[9:12], np.float32)
    scale_count, dynamic = fields[12:]
    within = bool((np.abs(aabb) <= BOX_LIMIT).all())  # False for NaN, too
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


def _parse_scale(cursor: Cursor, number: int, dynamic: bool) -> dict[str, PlaneHead]:
    channels, nx, ny, nz, nt = cursor.unpack(SCALE_STRUCT)
    size = {"x": nx, "y": ny, "z": nz, "t": nt}
    sizes_fit = 0 < channels <= CHANNEL_LIMIT and all(0 < n <= AXIS_LIMIT for n in (nx, ny, nz))
    if not sizes_fit or dynamic != (nt > 0) or nt > AXIS_LIMIT:
        raise FormatError(
            f"SCNE: scale {number} claims {channels} channels on a grid of {nx}x{ny}x{nz}, {nt} rows in time"
        )
    planes = {}
    for name in ALL_PLANES if dynamic else SPACE_PLANES:
        step, offset = cursor.array("<f4", channels).astype(np.float32), np.ones(channels, np.float32)
        if name in SPACE_PLANES:
            offset = cursor.array("<f4", channels).astype(np.float32)
        with np.errstate(over="ignore", invalid="ignore"):
            in_range = (step > 0) & (step * np.float32(128) + np.abs(offset) <= VALUE_LIMIT)
        if not in_range.all():
            raise FormatError(f"SCNE: scale {number}, plane {name}: a step or an offset lies outside its range")
        planes[name] = PlaneHead(size[name[1]], size[name[0]], step, offset)
    return planes


# --- WARP


def pack_mapping(mapping: SpaceMapping) -> bytes:
    """Return the WARP chunk."""
    if isinstance(mapping, Contraction):
        return WARP_STRUCT.pack(CONTRACTED, mapping.uniform_distance)
    return NDC_STRUCT.pack(DEVICE_COORDINATES, *np.ravel(mapping.frame), mapping.near, mapping.baseline)


def parse_mapping(raw: bytes, head: SceneHead) -> SpaceMapping:
    """Read the WARP chunk."""
    cursor, kind = Cursor(raw, "WARP"), int.from_bytes(raw[:4], "little")
    if kind == DEVICE_COORDINATES:
        return _parse_device_coordinates(cursor, head)
    if kind != CONTRACTED:
        raise FormatError(f"WARP: mapping {kind} of space, unknown to this reader; update kpc")
    _, even = cursor.unpack(WARP_STRUCT)
    cursor.finish()
    if not (1 / BOX_LIMIT <= even <= BOX_LIMIT and 2 * even / head.step <= SAMPLE_LIMIT):  # False for NaN, too
        raise FormatError(f"WARP: even steps of {head.step} up to a distance of {even} make no sense")
    return Contraction(even)


def _parse_device_coordinates(cursor: Cursor, head: SceneHead) -> DeviceCoordinates:
    _, *frame, near, baseline = cursor.unpack(NDC_STRUCT)
    cursor.finish()
    mapping = DeviceCoordinates(np.reshape(frame, (3, 4)), near, baseline)
    in_range = all(1 / BOX_LIMIT <= x <= BOX_LIMIT for x in (near, baseline))  # False for NaN, too
    if (
        not (in_range and (np.abs(mapping.frame) <= BOX_LIMIT).all())  # else products might be infinite
        or not (np.abs(mapping.frame[:, :3].T @ mapping.frame[:, :3] - np.eye(3)) < FRAME_TOLERANCE).all()
        or not head.aabb[1, 2] < baseline / near
    ):
        raise FormatError(
            f"WARP: device coordinates of near {near} and baseline {baseline}, their frame or the box in them "
            "make no sense"
        )
    return mapping


# --- MOVE


def pack_motion(motion: QuantisedMotion) -> bytes:
    """Return the MOVE chunk under RAW; the first `MOTION_STRUCT.size` bytes come first under MOTION, too."""
    symbols = motion.symbols
    if symbols.ndim != 5 or symbols.shape[4] != 3 or symbols.dtype != np.int16:
        raise FormatError(f"motion: is {symbols.dtype} {symbols.shape}, not int16 (T, Nz, Ny, Nx, 3)")
    return MOTION_STRUCT.pack(*symbols.shape[:4], motion.step) + symbols.astype("<i2").tobytes()


def parse_motion(raw: bytes, dynamic: bool) -> QuantisedMotion:
    """Read the MOVE chunk under RAW."""
    cursor = Cursor(raw, "MOVE")
    sizes, step = _parse_motion_head(cursor, dynamic)
    symbols = cursor.array("<i2", 3 * math.prod(sizes)).astype(np.int16).reshape(*sizes, 3)
    cursor.finish()
    return QuantisedMotion(symbols, step)


def parse_coded_motion(body: bytes, raw_length: int, dynamic: bool) -> QuantisedMotion:
    """Read the MOVE chunk under MOTION."""
    sizes, _ = _parse_motion_head(Cursor(body, "MOVE"), dynamic)
    if raw_length != MOTION_STRUCT.size + 6 * math.prod(sizes):
        raise FormatError(f"MOVE: claims {raw_length:,} bytes, not those of a grid of {sizes} nodes")
    return parse_motion(decode_motion(body, raw_length), dynamic)


def _parse_motion_head(cursor: Cursor, dynamic: bool) -> tuple[list[int], float]:
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


# --- DECO and HYBR

# Reads the arrays of a decoder, of these names and shapes, from the rest of a chunk.
WeightsParser = Callable[[Cursor, Mapping[str, tuple[int, ...]]], dict[str, np.ndarray]]


def pack_decoder(decoder: Decoder | HybridDecoder, features: int) -> tuple[bytes, dict[str, np.ndarray]]:
    """Return the fields of a DECO or HYBR chunk before the weights, and the weights by name.

    Raises:
        FormatError: an array has another shape, or is not rounded to float16.
    """
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
    return head, weights


def parse_decoder(cursor: Cursor, expected_features: int, parse_weights: WeightsParser) -> Decoder:
    """Read the DECO chunk."""
    features, hidden, bias = cursor.unpack(DECODER_STRUCT)
    if features != expected_features or not 0 < hidden <= HIDDEN_LIMIT or not math.isfinite(bias):
        raise FormatError(
            f"DECO: {features} features (the planes give {expected_features}), {hidden} hidden units "
            f"(1 to {HIDDEN_LIMIT} allowed), density bias {bias}"
        )
    return Decoder(density_bias=bias, **parse_weights(cursor, Decoder.shapes(features, hidden)))


def parse_hybrid(cursor: Cursor, expected_features: int, parse_weights: WeightsParser) -> HybridDecoder:
    """Read the HYBR chunk."""
    features, width, hidden, bias = cursor.unpack(HYBRID_STRUCT)
    units_fit = 0 < min(width, hidden) <= max(width, hidden) <= HIDDEN_LIMIT
    if features != expected_features or not units_fit or not math.isfinite(bias):
        raise FormatError(
            f"HYBR: {features} features (the planes give {expected_features}), {width} and {hidden} hidden units "
            f"(1 to {HIDDEN_LIMIT} allowed), density bias {bias}"
        )
    return HybridDecoder(density_bias=bias, **parse_weights(cursor, HybridDecoder.shapes(features, width, hidden)))


def parse_half_weights(cursor: Cursor, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, np.ndarray]:
    """Read weights under RAW: float16 numbers."""
    with np.errstate(invalid="ignore"):  # casting a signalling NaN warns
        weights = {
            name: cursor.array("<f2", math.prod(shape)).astype(np.float32).reshape(shape)
            for name, shape in shapes.items()
        }
    cursor.finish()
    if not all(np.isfinite(w).all() for w in weights.values()):
        raise FormatError(f"{cursor.kind}: a weight is NaN or infinite")
    return weights


def parse_coded_weights(
    cursor: Cursor, shapes: Mapping[str, tuple[int, ...]], raw_length: int
) -> dict[str, np.ndarray]:
    """Read weights under WEIGHTS, of which `raw_length` bytes are claimed."""
    if raw_length != 2 * sum(map(math.prod, shapes.values())):
        raise FormatError(f"{cursor.kind}: claims {raw_length:,} bytes of weights, not those of its sizes")
    raw = decode_weights(cursor.kind == "HYBR", cursor.raw, cursor.position + raw_length)
    return parse_half_weights(Cursor(raw[cursor.position :], cursor.kind), shapes)


# --- OCCU


def pack_occupancy(occupancy: np.ndarray) -> bytes:
    """Return the OCCU chunk under RAW; the first `OCCUPANCY_STRUCT.size` bytes come first under OCCUPANCY, too."""
    if occupancy.ndim != 4 or occupancy.dtype != bool or not all(0 < n <= AXIS_LIMIT for n in occupancy.shape):
        raise FormatError(f"occupancy: is {occupancy.dtype} {occupancy.shape}, not bool (slots, Nz, Ny, Nx)")
    return OCCUPANCY_STRUCT.pack(*occupancy.shape) + np.packbits(occupancy, bitorder="little").tobytes()


def parse_occupancy(raw: bytes) -> np.ndarray:
    """Read the OCCU chunk under RAW: (slots, Nz, Ny, Nx) bool."""
    cursor = Cursor(raw, "OCCU")
    shape = _parse_occupancy_shape(cursor)
    cells = math.prod(shape)
    packed = cursor.array("u1", -(-cells // 8))
    cursor.finish()
    if cells % 8 and packed[-1] >> cells % 8:
        raise FormatError("OCCU: the unused bits of its last byte are not 0")
    return np.unpackbits(packed, bitorder="little", count=cells).reshape(shape).view(bool)


def parse_coded_occupancy(body: bytes, raw_length: int) -> np.ndarray:
    """Read the OCCU chunk under OCCUPANCY: (slots, Nz, Ny, Nx) bool."""
    shape = _parse_occupancy_shape(Cursor(body, "OCCU"))
    if raw_length != OCCUPANCY_STRUCT.size + -(-math.prod(shape) // 8):
        raise FormatError(f"OCCU: claims {raw_length:,} bytes, not those of a grid of {shape} cells")
    return parse_occupancy(decode_occupancy(body, raw_length))


def _parse_occupancy_shape(cursor: Cursor) -> tuple[int, ...]:
    shape = cursor.unpack(OCCUPANCY_STRUCT)
    if not all(0 < n <= AXIS_LIMIT for n in shape):
        raise FormatError(f"OCCU: a grid of {shape} cells makes no sense")
    return shape


# --- came


def pack_cameras(cameras: tuple[Camera, ...]) -> bytes:
    """Return the came chunk under RAW."""
    return struct.pack("<H", len(cameras)) + b"".join(
        CAMERA_STRUCT.pack(c.width, c.height, c.fl_x, c.fl_y, c.cx, c.cy, *np.ravel(c.camera_to_world[:3]))
        for c in cameras
    )


def parse_cameras(raw: bytes) -> tuple[Camera, ...]:
    """Read the came chunk under RAW."""
    cursor = Cursor(raw, "came")
    (count,) = cursor.unpack(struct.Struct("<H"))
    if not 0 < count <= CAMERA_LIMIT:
        raise FormatError(f"came: {count} cameras (1 to {CAMERA_LIMIT} allowed)")
    cameras = tuple(_make_camera(number, cursor.unpack(CAMERA_STRUCT)) for number in range(count))
    cursor.finish()
    return cameras


def parse_coded_cameras(body: bytes, raw_length: int) -> tuple[Camera, ...]:
    """Read the came chunk under POSES."""
    return parse_cameras(decode_poses(body, raw_length))


def _make_camera(number: int, numbers: tuple[Any, ...]) -> Camera:
    """Return the camera of the fields of CAMERA_STRUCT."""
    width, height, fl_x, fl_y, cx, cy, *pose = numbers
    matrix = np.vstack([np.reshape(pose, (3, 4)), [0.0, 0.0, 0.0, 1.0]])
    if max(map(abs, (fl_x, fl_y, cx, cy, *pose))) > BOX_LIMIT or not has_unit_axes(matrix):
        raise FormatError(f"came: camera {number} lies absurdly far, or its axes are not of length 1")
    try:
        return Camera(width, height, fl_x, fl_y, cx, cy, matrix)
    except DatasetError as error:
        raise FormatError(f"came: camera {number}: {error}") from error


# --- appe


def pack_appearances(appearances: tuple[Appearance, ...], hidden: int) -> bytes:
    """Return the appe chunk.

    Raises:
        FormatError: a code has another shape, or is not rounded to float16.
    """
    codes = [appearance.code for appearance in appearances]
    if any(np.shape(code) != (hidden,) for code in codes):
        raise FormatError(f"appearances: codes of shapes {sorted({np.shape(code) for code in codes})}, not {(hidden,)}")
    if any(not np.array_equal(code, code.astype(np.float16)) for code in codes):
        raise FormatError("appearances: the codes are not rounded to float16 (kpc.format.coding.quantise.to_half)")
    names = [one.name.encode(errors="surrogatepass") for one in appearances]  # the parser refuses surrogates
    head = APPEARANCE_STRUCT.pack(len(codes), hidden) + np.stack(codes).astype("<f2").tobytes()
    return head + b"".join(struct.pack("<B", len(name)) + name for name in names)


def parse_appearances(raw: bytes, expected_hidden: int) -> tuple[Appearance, ...]:
    """Read the appe chunk."""
    cursor = Cursor(raw, "appe")
    count, hidden = cursor.unpack(APPEARANCE_STRUCT)
    if not 0 < count <= APPEARANCE_LIMIT or hidden != expected_hidden:
        raise FormatError(
            f"appe: {count} appearances (1 to {APPEARANCE_LIMIT} allowed) of {hidden} numbers (the decoder has "
            f"{expected_hidden} hidden units)"
        )
    with np.errstate(invalid="ignore"):  # casting a signalling NaN warns
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
    """Return whether an appearance may have this name: 1 to NAME_LIMIT bytes of UTF-8 and no control characters."""
    encoded = text.encode(errors="replace")
    controls = any(c < " " or "\x7f" <= c <= "\x9f" for c in text)
    return 0 < len(encoded) <= NAME_LIMIT and encoded.decode() == text and not controls
