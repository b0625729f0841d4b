"""Tiny videos for tests, made by ffmpeg, whose frames can be distinguished."""

import subprocess
from pathlib import Path

import numpy as np

from kpc.format.common.films import ffmpeg_binary

# Kr and Kb of ITU-R BT.601 and BT.709.
LUMA = {"bt601": (0.299, 0.114), "bt709": (0.2126, 0.0722)}

PATCH = 16  # side of a patch of uniform colour, pixels

FPS = 10  # frame rate of `film`

# Options of x264 with which every third frame is reordered.
B_FRAMES = ("-bf", 2, "-b_strategy", 0, "-sc_threshold", 0)


def patches(seed: int = 0) -> np.ndarray:
    """Return 2 x 4 patches of uniform random colour, uint8 (32, 64, 3), which survive coding and chroma subsampling."""
    colours = np.random.default_rng(seed).integers(20, 236, (2, 4, 3), dtype=np.uint8)
    return colours.repeat(PATCH, 0).repeat(PATCH, 1)


def _binary() -> str:
    """Return the ffmpeg that makes videos: that of imageio-ffmpeg, since the one of Debian 12 cannot turn pictures."""
    try:
        import imageio_ffmpeg

        return str(imageio_ffmpeg.get_ffmpeg_exe())
    except (ModuleNotFoundError, RuntimeError):
        return ffmpeg_binary()


def ffmpeg(*arguments: object, frames: bytes | None = None) -> None:
    """Run ffmpeg, with raw frames on its standard input."""
    command = [_binary(), "-v", "error", "-y", *map(str, arguments)]
    done = subprocess.run(command, input=frames or b"", capture_output=True, check=False)
    assert done.returncode == 0, done.stderr.decode()


def film(path: Path, *options: object, count: int = 12, fps: float = FPS) -> Path:
    """Write `patches(0)`, `patches(1)`, ... with the given options of ffmpeg; without a codec, as good H.264."""
    raw = b"".join(patches(number).tobytes() for number in range(count))
    coding = () if "-c:v" in options else ("-c:v", "libx264", "-crf", 1, "-pix_fmt", "yuv444p", *B_FRAMES)
    source = ("-f", "rawvideo", "-pix_fmt", "rgb24", "-s", "64x32", "-r", fps, "-i", "pipe:")
    ffmpeg(*source, *coding, *options, path, frames=raw)
    return path


def copy(source: Path, path: Path, *options: object, before: tuple[object, ...] = ()) -> Path:
    """Copy the streams of a video into another file; `before` are options of reading."""
    ffmpeg(*before, "-i", source, "-c", "copy", *options, path)
    return path


def psnr(found: np.ndarray, expected: np.ndarray) -> float:
    """Return the PSNR of uint8 pictures in dB."""
    return float(10 * np.log10(255**2 / max(np.mean((found.astype(float) - expected) ** 2), 1e-9)))


def numbers(frames: list[np.ndarray], count: int = 12) -> list[int]:
    """Return which of the pictures of `film` each frame shows; every frame must show one of them well."""
    found = []
    for frame in frames:
        similar = [psnr(frame, patches(number)) for number in range(count)]
        assert max(similar) > 25, similar
        found.append(int(np.argmax(similar)))
    return found


def yuv(rgb: np.ndarray, matrix: str, full: bool, bits: int, subsampled: bool) -> bytes:
    """Return planar Y'CbCr of one frame by the equations of the recommendations."""
    kr, kb = LUMA[matrix]
    r, g, b = np.moveaxis(rgb / 255.0, -1, 0)
    y = kr * r + (1 - kr - kb) * g + kb * b
    cb, cr = (b - y) / (2 * (1 - kb)), (r - y) / (2 * (1 - kr))
    top, half = 2**bits - 1, 2 ** (bits - 1)
    luma = y * top if full else (16 + 219 * y) * 2 ** (bits - 8)
    chroma = [half + c * (top if full else 224 * 2 ** (bits - 8)) for c in (cb, cr)]
    if subsampled:
        chroma = [c[::2, ::2] for c in chroma]
    dtype = np.dtype("<u2") if bits > 8 else np.dtype("u1")
    return b"".join(np.clip(np.rint(p), 0, top).astype(dtype).tobytes() for p in (luma, *chroma))


def colour_tolerance(matrix: str, full: bool, bits: int) -> float:
    """Return the largest error of a decoded channel, in 8-bit levels.

    It is half a step of each of Y, Cb and Cr through the inverse matrix to the channel with the largest coefficients,
    half a level for rounding the result, and one level for the fixed-point arithmetic of swscale.
    """
    kr, kb = LUMA[matrix]
    steps_per_level = 2 ** (bits - 8)
    luma, chroma = (1.0, 1.0) if full else (255 / 219, 255 / 224)
    green = 2 * (kb * (1 - kb) + kr * (1 - kr)) / (1 - kr - kb)
    return 0.5 / steps_per_level * (luma + chroma * max(2 * (1 - kb), 2 * (1 - kr), green)) + 1.5
