"""General-purpose codecs for planes, as baselines for KPC's coder: byte compressors, image codecs and video codecs.

Each has several settings, from the finest to the coarsest. A baseline codes float32 planes into bytes, with everything
needed to decode them. Texels that no occupied point reads are filled with a constant first, so that they cost next to
nothing.
"""

import functools
import io
import lzma
import math
import subprocess
import time
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import zstandard
from PIL import Image, features

from kpc.format.coding.quantise import looked_up_cells, needed_texels
from kpc.format.common.errors import MediaError
from kpc.format.common.films import ffmpeg_binary
from kpc.format.scene.scene import TIME_PLANES, Scene

# Planes (H, W, M) by name for each scale, as in `Scene.scales`, and their shapes.
Planes = Sequence[Mapping[str, np.ndarray]]
Shapes = Sequence[Mapping[str, tuple[int, ...]]]
Decoded = list[dict[str, np.ndarray]]

# The largest level of 10-bit video.
TEN_BITS = 1023

# Longest time of an ffmpeg process.
TIMEOUT_S = 600


@dataclass(frozen=True)
class Coding:
    """The coded size, the times of encoding and decoding, and the decoded planes."""

    size_bytes: int
    encode_s: float
    decode_s: float
    planes: Decoded


class Baseline(ABC):
    """A codec for planes.

    Attributes:
        name: its name in tables.
        settings: values of its quality parameter, the finest first.
    """

    name: str
    settings: tuple[int, ...]

    def missing(self) -> str | None:
        """Return why it cannot be used on this machine; None if it can."""
        return None

    def code(self, planes: Planes, setting: int) -> Coding:
        """Encode and decode planes."""
        started = time.perf_counter()
        blobs = self.encode(planes, setting)
        encoded = time.perf_counter()
        shapes = [{name: plane.shape for name, plane in scale.items()} for scale in planes]
        back = self.decode(blobs, shapes, setting)
        return Coding(sum(map(len, blobs)), encoded - started, time.perf_counter() - encoded, back)

    @abstractmethod
    def encode(self, planes: Planes, setting: int) -> list[bytes]:
        """Return the coded bytes, in any number of parts."""

    @abstractmethod
    def decode(self, blobs: list[bytes], shapes: Shapes, setting: int) -> Decoded:
        """Return the planes of the given shapes, float32."""


def fill_unread_texels(scene: Scene) -> Planes:
    """Return the planes with unread texels set to the mean of the others, or to 1 on time planes."""
    reached, scales = looked_up_cells(scene), []
    for scale in scene.scales:
        filled = {}
        for name, plane in scale.items():
            needed = needed_texels(reached, name, *plane.shape[:2])
            filling = 1.0 if name in TIME_PLANES or not needed.any() else plane[needed].mean(0)
            filled[name] = np.where(needed[..., None], plane, np.float32(filling))
        scales.append(filled)
    return scales


# --- byte compressors


def _zstd(data: bytes) -> bytes:
    return zstandard.ZstdCompressor(level=19).compress(data)


def _zstd_back(data: bytes) -> bytes:
    return zstandard.ZstdDecompressor().decompress(data)


def _xz(data: bytes) -> bytes:
    return lzma.compress(data, preset=9)


class Float16(Baseline):
    """Channels in float16 with zstd -19 or xz -9. The setting is the number of mantissa bits that are kept."""

    settings = (10, 8, 6, 5, 4, 3)

    def __init__(self, tool: str) -> None:
        self.name = f"fp16 + {tool}"
        self.pack, self.unpack = {"zstd -19": (_zstd, _zstd_back), "xz -9": (_xz, lzma.decompress)}[tool]

    def encode(self, planes: Planes, setting: int) -> list[bytes]:
        drop = 10 - setting
        parts = []
        for plane in _each(planes):
            bits = plane.transpose(2, 0, 1).astype("<f2").view("<u2").astype(np.uint32)
            rounded = (bits + (1 << drop >> 1)) >> drop << drop
            parts.append(np.minimum(rounded, 0xFFFF).astype("<u2").tobytes())
        return [self.pack(b"".join(parts))]

    def decode(self, blobs: list[bytes], shapes: Shapes, setting: int) -> Decoded:
        values = np.frombuffer(self.unpack(blobs[0]), "<f2").astype(np.float32)
        return _split(values, shapes)


class Uint8(Baseline):
    """Channels quantised uniformly between their extremes, with zstd -19. The setting is the number of bits."""

    name = "uint8 + zstd -19"
    settings = (8, 7, 6, 5, 4)

    def encode(self, planes: Planes, setting: int) -> list[bytes]:
        levels, side = _levels(planes, 2**setting - 1)
        return [_zstd(b"".join(plane.transpose(2, 0, 1).astype(np.uint8).tobytes() for plane in _each(levels))), side]

    def decode(self, blobs: list[bytes], shapes: Shapes, setting: int) -> Decoded:
        return _dequantise(_split(np.frombuffer(_zstd_back(blobs[0]), np.uint8), shapes), blobs[1])


# --- image codecs


class LosslessImages(Baseline):
    """The levels of `Uint8` as lossless grey pictures, one for each plane. The setting is the number of bits."""

    settings = Uint8.settings

    def __init__(self, kind: str) -> None:
        self.kind, self.name = kind, {"png": "PNG", "webp": "WebP lossless"}[kind]

    def missing(self) -> str | None:
        return "this Pillow has no WebP" if self.kind == "webp" and not features.check("webp") else None

    def encode(self, planes: Planes, setting: int) -> list[bytes]:
        levels, side = _levels(planes, 2**setting - 1)
        blobs = []
        for plane in _each(levels):
            picture, file = Image.fromarray(_canvas(plane.astype(np.uint8))), io.BytesIO()
            if self.kind == "png":
                picture.save(file, "png", optimize=True)
            else:
                picture.convert("RGB").save(file, "webp", lossless=True, quality=100, method=6)
            blobs.append(file.getvalue())
        return [*blobs, side]

    def decode(self, blobs: list[bytes], shapes: Shapes, setting: int) -> Decoded:
        pictures = (np.asarray(Image.open(io.BytesIO(blob)).convert("L")) for blob in blobs[:-1])
        planes = [{name: _from_canvas(next(pictures), shape) for name, shape in scale.items()} for scale in shapes]
        return _dequantise(planes, blobs[-1])


def _canvas(plane: np.ndarray) -> np.ndarray:
    """Arrange the channels of a plane (H, W, M) in a nearly square grid."""
    rows, columns, channels = plane.shape
    across = math.ceil(math.sqrt(channels))
    down = -(-channels // across)
    filled = np.zeros((rows, columns, down * across), plane.dtype)
    filled[..., :channels] = plane
    return filled.reshape(rows, columns, down, across).transpose(2, 0, 3, 1).reshape(down * rows, across * columns)


def _from_canvas(picture: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Undo `_canvas`."""
    rows, columns, channels = shape
    across = picture.shape[1] // columns
    tiles = picture.reshape(-1, rows, across, columns).transpose(1, 3, 0, 2)
    return tiles.reshape(rows, columns, -1)[..., :channels]


# --- video codecs


class Video(Baseline):
    """10-bit grey video through ffmpeg, one for each scale: a frame is a channel and holds all planes.

    All frames are intra-coded, since prediction between channels made files larger. The setting is the encoder's
    quantisation parameter.
    """

    PIX_FMT = "gray10le"

    def __init__(self, name: str, encoder: str, settings: tuple[int, ...], options: tuple[str, ...]) -> None:
        self.name, self.encoder, self.settings, self.options = name, encoder, settings, options

    def missing(self) -> str | None:
        return None if self.encoder in _encoders() else f"this ffmpeg has no {self.encoder}"

    def encode(self, planes: Planes, setting: int) -> list[bytes]:
        levels, side = _levels(planes, TEN_BITS)
        return [*(self._video(_packed(scale), setting) for scale in levels), side]

    def decode(self, blobs: list[bytes], shapes: Shapes, setting: int) -> Decoded:
        planes = []
        for blob, scale in zip(blobs[:-1], shapes, strict=True):
            height, width = _canvas_size(scale)
            raw = np.frombuffer(_ffmpeg(["-i", "-", "-f", "rawvideo", "-pix_fmt", self.PIX_FMT, "-"], blob), "<u2")
            planes.append(_unpacked(raw.reshape(-1, height, width), scale))
        return _dequantise(planes, blobs[-1])

    def _video(self, frames: np.ndarray, setting: int) -> bytes:
        _, height, width = frames.shape
        kind = "hevc" if "265" in self.encoder else "obu"
        options = [option.format(setting) for option in self.options]
        source = ["-f", "rawvideo", "-pix_fmt", self.PIX_FMT, "-s", f"{width}x{height}", "-r", "25", "-i", "-"]
        return _ffmpeg([*source, "-c:v", self.encoder, *options, "-f", kind, "-"], frames.astype("<u2").tobytes())


def _canvas_size(shapes: Mapping[str, tuple[int, ...]]) -> tuple[int, int]:
    """Return height and width of the planes of a scale one below the other, in multiples of 8."""
    height = sum(_round_up(rows) for rows, _, _ in shapes.values())
    return max(height, 64), max(64, *(_round_up(columns) for _, columns, _ in shapes.values()))


def _round_up(size: int) -> int:
    """Return the next multiple of 8."""
    return -(-size // 8) * 8


def _packed(planes: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return frames (M, height, width) uint16; the edges of planes are extended into the space around them."""
    height, width = _canvas_size({name: plane.shape for name, plane in planes.items()})
    frames = np.zeros((next(iter(planes.values())).shape[2], height, width), np.uint16)
    row = 0
    for plane in planes.values():
        rows, columns, _ = plane.shape
        margin = ((0, _round_up(rows) - rows), (0, width - columns), (0, 0))
        frames[:, row : row + _round_up(rows)] = np.pad(plane.astype(np.uint16), margin, mode="edge").transpose(2, 0, 1)
        row += _round_up(rows)
    return frames


def _unpacked(frames: np.ndarray, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, np.ndarray]:
    """Undo `_packed`."""
    planes, row = {}, 0
    for name, (rows, columns, channels) in shapes.items():
        planes[name] = frames[:channels, row : row + rows, :columns].transpose(1, 2, 0)
        row += _round_up(rows)
    return planes


@functools.cache
def _encoders() -> frozenset[str]:
    """Return the names of ffmpeg's encoders."""
    try:
        listed = _ffmpeg(["-encoders"], b"").decode(errors="replace")
    except MediaError:
        return frozenset()
    return frozenset(line.split()[1] for line in listed.splitlines() if len(line.split()) > 1)


def _ffmpeg(words: Sequence[str], data: bytes) -> bytes:
    """Run ffmpeg on `data` as stdin and return its stdout."""
    command = [ffmpeg_binary(), "-hide_banner", "-v", "error", *words]
    try:
        done = subprocess.run(command, input=data, capture_output=True, check=False, timeout=TIMEOUT_S)
    except subprocess.TimeoutExpired as error:
        raise MediaError(f"ffmpeg: took longer than {TIMEOUT_S} s") from error
    if done.returncode != 0:
        lines = done.stderr.decode(errors="replace").strip().splitlines() or ["no message"]
        raise MediaError(f"ffmpeg: {lines[-1]}")
    return done.stdout


# --- uniform quantisation


def _each(planes: Planes) -> list[np.ndarray]:
    """Return the planes of all scales."""
    return [plane for scale in planes for plane in scale.values()]


def _levels(planes: Planes, highest: int) -> tuple[Planes, bytes]:
    """Quantise each channel to integers from 0 to `highest`; return them and float32 minimum and step of each."""
    scales, side = [], []
    for scale in planes:
        levels = {}
        for name, plane in scale.items():
            low = plane.min((0, 1))
            width = np.maximum(plane.max((0, 1)) - low, np.float32(1e-9)) / np.float32(highest)
            levels[name] = np.clip(np.rint((plane - low) / width), 0, highest)
            side.append(np.stack([low, width]).astype("<f4").tobytes())
        scales.append(levels)
    return scales, b"".join(side)


def _dequantise(planes: Planes, side: bytes) -> Decoded:
    """Undo `_levels`."""
    numbers, start, scales = np.frombuffer(side, "<f4"), 0, []
    for scale in planes:
        values = {}
        for name, plane in scale.items():
            channels = plane.shape[2]
            low, width = numbers[start : start + 2 * channels].reshape(2, channels)
            values[name] = np.float32(plane) * width + low
            start += 2 * channels
        scales.append(values)
    return scales


def _split(values: np.ndarray, shapes: Shapes) -> Decoded:
    """Return planes (H, W, M) from values stored plane by plane, channel by channel."""
    start, scales = 0, []
    for scale in shapes:
        planes = {}
        for name, (rows, columns, channels) in scale.items():
            size = rows * columns * channels
            planes[name] = values[start : start + size].reshape(channels, rows, columns).transpose(1, 2, 0)
            start += size
        scales.append(planes)
    return scales


BASELINES: tuple[Baseline, ...] = (
    Float16("zstd -19"),
    Float16("xz -9"),
    Uint8(),
    LosslessImages("png"),
    LosslessImages("webp"),
    Video(
        "HEVC",
        "libx265",
        (10, 14, 18, 22, 27, 33, 39, 45),
        ("-preset", "slow", "-tune", "psnr", "-x265-params", "qp={}:keyint=1:info=0"),
    ),
    Video(
        "AV1",
        "libaom-av1",
        (4, 8, 12, 18, 26, 36, 46, 56),
        ("-usage", "allintra", "-cpu-used", "4", "-crf", "{}", "-b:v", "0"),
    ),
)
