"""Writing of films through ffmpeg: codecs, bit depth, alpha and colour tags.

All films are tagged BT.709 (primaries, transfer, matrix) in limited range. Alpha is straight: colours are not
multiplied by it.
"""

import contextlib
import errno
import functools
import itertools
import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

import ffmpeg
import numpy as np

from kpc.format.common import extras
from kpc.format.common.cli import atomic_write
from kpc.format.common.errors import MediaError, UsageError
from kpc.format.common.text import valid_unicode

# Options of ffmpeg's scale filter for an exact colour conversion.
SCALE_FLAGS = "bicubic+accurate_rnd+full_chroma_int+full_chroma_inp"

# What ffmpeg's log says where a disk is full or fails. Its exit code may be 0 even so.
DISK_FAILURES = tuple(os.strerror(code) for code in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO))

FFMPEG_WHITE = 0xFF00  # white in the R'G'B' of 16 bits that ffmpeg's scale filter converts, as 8-bit white times 256


@dataclass(frozen=True)
class Codec:
    """A codec that films can have.

    Attributes:
        encoder: ffmpeg's name.
        suffixes: of the containers that hold it.
        pix_fmts: ffmpeg's pixel format by bits per channel and whether there is alpha; the first is the default.
        crf: lowest, highest and default constant rate factor; None if quality is fixed.
        options: of the encoder.
    """

    encoder: str
    suffixes: tuple[str, ...]
    pix_fmts: Mapping[tuple[int, bool], str]
    crf: tuple[int, int, int] | None
    options: Mapping[str, str] = field(default_factory=dict)


CODECS = {
    "h264": Codec(
        "libx264", (".mp4", ".mov", ".mkv"), {(8, False): "yuv420p", (10, False): "yuv420p10le"}, (0, 51, 18)
    ),
    "hevc": Codec(
        "libx265",
        (".mp4", ".mov", ".mkv"),
        {(8, False): "yuv420p", (10, False): "yuv420p10le"},
        (0, 51, 20),
        {"x265-params": "log-level=error"},
    ),
    "prores": Codec("prores_ks", (".mov", ".mkv"), {(10, False): "yuv422p10le", (10, True): "yuva444p10le"}, None),
    "vp9": Codec(
        "libvpx-vp9",
        (".webm", ".mkv"),
        {(8, False): "yuv420p", (10, False): "yuv420p10le", (8, True): "yuva420p"},
        (0, 63, 24),
        {"video_bitrate": "0", "row-mt": "1", "cpu-used": "2"},
    ),
    "av1": Codec(
        "libsvtav1",
        (".mp4", ".mkv", ".webm"),
        {(8, False): "yuv420p", (10, False): "yuv420p10le"},
        (0, 63, 28),
        {"preset": "6"},
    ),
}
# What sound is encoded as: the codec that players of the container expect.
SOUND_CODECS = {
    ".mp4": {"acodec": "aac", "audio_bitrate": "160k"},
    ".mov": {"acodec": "pcm_s16le"},
    ".mkv": {"acodec": "libopus", "audio_bitrate": "128k"},
    ".webm": {"acodec": "libopus", "audio_bitrate": "128k"},
}
# The codec of each container if none is asked for.
DEFAULT_CODECS = {".mp4": "h264", ".mkv": "h264", ".mov": "prores", ".webm": "vp9"}


@dataclass(frozen=True)
class FilmFormat:
    """How a film is encoded.

    Attributes:
        encoder: ffmpeg's name.
        pix_fmt: ffmpeg's name of the pixel format.
        crf: constant rate factor; None where the encoder has none.
        options: of the encoder.
    """

    encoder: str = "libx264"
    pix_fmt: str = "yuv420p"
    crf: int | None = 18
    options: Mapping[str, str] = field(default_factory=dict)

    @staticmethod
    def of(
        suffix: str, codec: str | None = None, *, crf: int | None = None, bits: int | None = None, alpha: bool = False
    ) -> "FilmFormat":
        """Return the format that is asked for; what is None is chosen by the suffix or the codec.

        Args:
            suffix: of the film, in small letters; a key of DEFAULT_CODECS.
            codec: a key of CODECS.
            crf: constant rate factor.
            bits: per channel.
            alpha: whether there is alpha.

        Raises:
            UsageError: there is no such film; the message lists what there is.
        """
        name = codec or DEFAULT_CODECS[suffix]
        chosen = CODECS[name]
        if suffix not in chosen.suffixes:
            able = ", ".join(one for one, other in CODECS.items() if suffix in other.suffixes)
            raise UsageError(f"{suffix} does not hold {name}: it holds {able}; {name} goes into {_list(chosen)}")
        if alpha and not any(has_alpha for _, has_alpha in chosen.pix_fmts):
            able = ", ".join(
                f"{one} ({_list(other)})" for one, other in CODECS.items() if any(a for _, a in other.pix_fmts)
            )
            raise UsageError(f"{name} has no alpha; films with alpha are {able}")
        possible = [some_bits for some_bits, has_alpha in chosen.pix_fmts if has_alpha == alpha]
        if bits is not None and bits not in possible:
            with_alpha = " with alpha" if alpha else ""
            raise UsageError(f"{name}{with_alpha} has {' or '.join(map(str, possible))} bits, not {bits}")
        if crf is not None and (chosen.crf is None or not chosen.crf[0] <= crf <= chosen.crf[1]):
            bounds = "none, its quality is fixed" if chosen.crf is None else f"{chosen.crf[0]} to {chosen.crf[1]}"
            raise UsageError(f"the constant rate factor of {name} is {bounds}; not {crf}")
        options = dict(chosen.options)
        if name == "prores":
            options["profile"] = "4444" if alpha else "hq"
        if name == "hevc" and suffix != ".mkv":
            options["vtag"] = "hvc1"  # what Apple's players want
        quality = crf if crf is not None else chosen.crf[2] if chosen.crf is not None else None
        return FilmFormat(chosen.encoder, chosen.pix_fmts[bits or possible[0], alpha], quality, options)

    @property
    def bits(self) -> int:
        """Bits per channel."""
        return 10 if "10" in self.pix_fmt else 8

    @property
    def has_alpha(self) -> bool:
        """Whether frames have an alpha channel."""
        return self.pix_fmt.startswith("yuva")

    def padded(self, width: int, height: int) -> tuple[int, int]:
        """Return the size of a film of such frames: where chroma is subsampled, an odd side grows by one pixel."""
        sides = (width, "444" not in self.pix_fmt), (height, "420" in self.pix_fmt)
        padded_width, padded_height = (side + (side % 2 if is_even else 0) for side, is_even in sides)
        return padded_width, padded_height


def write_film(
    path: str | os.PathLike[str],
    frames: Iterable[np.ndarray],
    fps: float,
    film_format: FilmFormat,
    sound: Path | None = None,
) -> int:
    """Encode frames and return their number. The file appears when it is complete.

    Odd sides are made even by repeating the last row or column; see `FilmFormat.padded`.

    Args:
        path: of the film; its suffix chooses the container.
        frames: (height, width, 3 or 4) uint8 or uint16 R'G'B' and straight alpha.
        fps: frames per second.
        film_format: how to encode them.
        sound: a WAV file that begins with the first frame.

    Raises:
        MediaError: there are no frames, frames differ in size or type, ffmpeg fails, or the disk does or is full.
    """
    frames = iter(frames)
    first = next(frames, None)
    if first is None:
        raise MediaError(f"{path}: no frames to write")
    height, width, channels = first.shape
    padded = film_format.padded(width, height)
    pad = ((0, padded[1] - height), (0, padded[0] - width), (0, 0))
    count = 0
    with atomic_write(path) as temporary, tempfile.TemporaryFile() as log:
        pixels = {(1, 3): "rgb24", (1, 4): "rgba", (2, 3): "rgb48le", (2, 4): "rgba64le"}[first.itemsize, channels]
        process = _encoder(temporary, pixels, padded, fps, film_format, log, sound)
        assert process.stdin is not None
        try:
            for frame in itertools.chain([first], frames):
                if frame.shape != first.shape or frame.dtype != first.dtype:
                    raise MediaError(
                        f"{path}: frame {count} is {frame.dtype} {frame.shape}, the first {first.dtype} {first.shape}"
                    )
                process.stdin.write(np.pad(_for_ffmpeg(frame), pad, mode="edge").tobytes())
                count += 1
            process.stdin.close()
            code = process.wait()
        except BrokenPipeError:
            code = process.wait() or 1
        finally:
            process.kill()
            process.wait()
            with contextlib.suppress(BrokenPipeError):
                process.stdin.close()
        said = read_log(log)
        if (failure := next((text for text in DISK_FAILURES if text in said), None)) is not None:
            raise MediaError(f"{path}: {failure}; make room there, or choose another place")
        if code != 0:
            reason = main_error(said)
            raise MediaError(f"{path}: ffmpeg's encoder {film_format.encoder} cannot write {width}x{height} ({reason})")
    return count


def _for_ffmpeg(frame: np.ndarray) -> np.ndarray:
    """Return a frame whose 16-bit colours are multiples of 1/65280, as ffmpeg's scale filter takes them to be when it
    converts to Y'CbCr; its alpha is of 65535.
    """
    if frame.dtype != np.uint16:
        return frame
    scaled = frame.copy()
    scaled[..., :3] = np.rint(frame[..., :3] * (FFMPEG_WHITE / np.iinfo(np.uint16).max))
    return scaled


def write_video(
    path: str | os.PathLike[str], frames: Iterable[np.ndarray], fps: float, *, crf: int = 18, pix_fmt: str = "yuv420p"
) -> int:
    """Encode frames as H.264; see `write_film`."""
    return write_film(path, frames, fps, FilmFormat(pix_fmt=pix_fmt, crf=crf))


def _encoder(
    path: Path,
    pixels: str,
    size: tuple[int, int],
    fps: float,
    film_format: FilmFormat,
    log: IO[bytes],
    sound: Path | None,
) -> "subprocess.Popen[bytes]":
    """Start ffmpeg, which encodes raw frames of a pixel format and size from its standard input, and a WAV file."""
    raw = ffmpeg.input("pipe:", format="rawvideo", pix_fmt=pixels, framerate=fps, video_size=size)
    scaled = raw.filter("scale", flags=SCALE_FLAGS, out_color_matrix="bt709", out_range="limited")
    # The encoders take primaries and transfer from the frames alone.
    tagged = scaled.filter("setparams", color_primaries="bt709", color_trc="bt709", colorspace="bt709", range="limited")
    crf = {} if film_format.crf is None else {"crf": film_format.crf}
    faststart = {"movflags": "+faststart"} if path.suffix.lower() in (".mp4", ".mov") else {}
    heard = {} if sound is None else SOUND_CODECS[path.suffix.lower()]
    streams = [tagged] if sound is None else [tagged, ffmpeg.input(file_url(sound)).audio]
    stream = ffmpeg.output(
        *streams,
        file_url(path),
        vcodec=film_format.encoder,
        pix_fmt=film_format.pix_fmt,
        **crf,
        **faststart,
        **heard,
        **film_format.options,
    )
    command = stream.global_args("-v", "error", "-y").compile(cmd=ffmpeg_binary())
    # SVT-AV1 writes to its standard error what is no error.
    environment = {**os.environ, "SVT_LOG": "1"}
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=log, env=environment)


def _list(codec: Codec) -> str:
    return ", ".join(codec.suffixes)


@functools.cache
def ffmpeg_binary() -> str:
    """Return the ffmpeg to run: the one on PATH, else the one that the package imageio-ffmpeg (extra `film`) brings.

    Raises:
        MediaError: there is none.
    """
    found = shutil.which("ffmpeg")
    if found:
        return found
    try:
        import imageio_ffmpeg

        return str(imageio_ffmpeg.get_ffmpeg_exe())
    except (ModuleNotFoundError, RuntimeError) as error:
        raise MediaError(
            "ffmpeg: films need it, and PATH has none; install it (Debian: apt install ffmpeg) or "
            f"{extras.install('film')}"
        ) from error


class _Url(str):
    """A URL whose `str()`, which ffmpeg-python hashes, is valid Unicode; ffmpeg gets the bytes of the file's name."""

    __slots__ = ()

    def __str__(self) -> str:
        return valid_unicode(super().__str__())


def file_url(path: str | os.PathLike[str]) -> str:
    """Return a URL that ffmpeg takes for a local file, whatever characters the path contains."""
    return _Url(f"file:{Path(path).absolute()}")


def read_log(log: IO[bytes]) -> str:
    """Return the text of an error log."""
    log.seek(0)
    return log.read().decode(errors="replace").strip()


def main_error(log: str) -> str:
    """Return the line of ffmpeg's log that most likely names the error, without its prefix."""
    lines = [line.strip() for line in log.splitlines() if line.strip()]
    errors = [
        line for line in lines if re.search(r"error|invalid|denied|no such|not found|partial|corrupt|fail", line, re.I)
    ]
    return re.sub(r"^\[[^]]*\]\s*", "", (errors or lines or ["it ends early"])[0])[:160]
