"""Reading of videos, through ffmpeg.

Colour: `read_video` returns R'G'B' in [0, 255] and honours the file's tags for matrix, range and chroma layout. Where
tags are missing it does as players do: limited range, BT.601 below 720 lines and BT.709 from there on. HDR transfer
curves (PQ, HLG) are refused, since they would be shown wrong.
"""

import functools
import os
import re
import subprocess
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass

import ffmpeg
import numpy as np

from kpc.format.common.errors import MediaError
from kpc.format.common.films import SCALE_FLAGS, ffmpeg_binary, file_url, main_error, read_log
from kpc.format.common.media_files import require_file


@dataclass(frozen=True)
class VideoInfo:
    """Properties of a video, from its container and its stream header.

    Attributes:
        width, height: pixels, after the display rotation that phones record.
        frame_count: coded frames.
        fps: frames per second; rates such as 29.97 are exactly n * 1000/1001.
        pix_fmt: ffmpeg's name of the pixel format, such as "yuv420p10le".
        matrix: colour matrix, "bt601", "bt709", "bt2020" or "rgb".
        full_range: whether values use the full range; False for 16..235.
    """

    width: int
    height: int
    frame_count: int
    fps: float
    pix_fmt: str
    matrix: str
    full_range: bool


def video_info(path: str | os.PathLike[str]) -> VideoInfo:
    """Return a video's size, length and colour tags. Packets are counted, not decoded.

    Raises:
        MediaError: the file is missing, damaged, not a video, or HDR.
    """
    require_file(path)
    stream = ffmpeg.input(file_url(path)).output("pipe:", format="null", codec="copy", map="0:V:0")
    command = stream.global_args("-nostdin", "-hide_banner", "-nostats", "-progress", "pipe:1").compile(
        cmd=ffmpeg_binary()
    )
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, check=False)
    log = done.stderr.decode(errors="replace")
    found = _STREAM.search(log)
    counts = re.findall(r"^frame=\s*(\d+)", done.stdout.decode(errors="replace"), re.MULTILINE)
    if done.returncode != 0 or found is None or not counts or int(counts[-1]) == 0:
        raise MediaError(f"{path}: not a video ffmpeg can read ({main_error(log)}); encode or copy it anew")
    pix_fmt, tags, width, height = found["pix_fmt"], found["tags"] or "", int(found["width"]), int(found["height"])
    if re.search(r"smpte2084|arib-std-b67", tags):
        raise MediaError(f"{path}: HDR video ({tags}); tone-map it to BT.709 first")
    rotated = re.search(r"rotation of (-?\d+)", log[found.end() : _end_of_stream(log, found.end())])
    if rotated and int(rotated[1]) % 180 == 90:
        width, height = height, width
    return VideoInfo(
        width,
        height,
        int(counts[-1]),
        _fps(found["rest"]),
        pix_fmt,
        _matrix(pix_fmt, tags, height),
        "pc" in re.split(r"[,\s]+", tags) or pix_fmt.startswith("yuvj"),
    )


def read_video(
    path: str | os.PathLike[str], info: VideoInfo | None = None, limit: int | None = None
) -> Iterator[np.ndarray]:
    """Decode a video, frame by frame. Every coded frame is returned once, whatever its time stamp.

    Args:
        path: of the video.
        info: its properties, if `video_info` has already been called.
        limit: the most frames to decode; None for all.

    Yields:
        (height, width, 3) uint8 R'G'B'.

    Raises:
        MediaError: ffmpeg fails or reports an error, or the file ends inside a frame.
    """
    info = info or video_info(path)
    rgb = info.matrix == "rgb"
    video = ffmpeg.input(file_url(path))["V:0"].filter(
        "scale",
        info.width,
        info.height,
        flags=SCALE_FLAGS,
        out_range="full",
        **({} if rgb else {"in_color_matrix": info.matrix, "in_range": "full" if info.full_range else "limited"}),
    )
    size = {} if limit is None else {"vframes": limit}
    stream = video.output("pipe:", format="rawvideo", pix_fmt="rgb24", **_each_frame_once(), **size)
    command = stream.global_args("-nostdin", "-v", "error").compile(cmd=ffmpeg_binary())
    frame_bytes = info.width * info.height * 3
    with tempfile.TemporaryFile() as log:
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=log)
        assert process.stdout is not None  # for the type checker: it is a pipe
        try:
            while data := process.stdout.read(frame_bytes):
                if len(data) < frame_bytes:
                    break
                yield np.frombuffer(data, np.uint8).reshape(info.height, info.width, 3)
            code = process.wait()
        finally:
            process.kill()
            process.stdout.close()
            process.wait()
        message = read_log(log)
    if code != 0 or message or data:
        raise MediaError(f"{path}: does not decode ({main_error(message)}); encode or copy it anew")


# The line of ffmpeg's log that describes a video stream.
_STREAM = re.compile(
    r"Stream #0:\d+[^\n]*?: Video: (?P<codec>[^\n]*?), (?P<pix_fmt>[a-z][a-z0-9_]*)(?:\((?P<tags>[^)\n]*)\))?"
    r", (?P<width>\d+)x(?P<height>\d+)(?P<rest>(?:(?!attached pic)[^\n])*)$",
    re.MULTILINE,
)


@functools.cache
def _each_frame_once() -> dict[str, str]:
    """Return the option that keeps ffmpeg from dropping or repeating frames; it was renamed in ffmpeg 5.1."""
    options = subprocess.run(
        [ffmpeg_binary(), "-hide_banner", "-h", "long"], stdin=subprocess.DEVNULL, capture_output=True, check=False
    )
    return {"fps_mode" if b"-fps_mode" in options.stdout else "vsync": "passthrough"}


def _end_of_stream(log: str, start: int) -> int:
    end = log.find("Stream ", start)
    return len(log) if end < 0 else end


def _fps(rest: str) -> float:
    found = re.search(r"([\d.]+)(k?) fps", rest) or re.search(r"([\d.]+)(k?) tbr", rest)
    if found is None or float(found[1]) == 0:
        return 25.0
    fps = float(found[1]) * (1000 if found[2] else 1)
    ntsc = round(fps * 1.001) * 1000 / 1001
    return ntsc if abs(fps - ntsc) < 0.006 and abs(fps - round(fps)) > 0.006 else fps


def _matrix(pix_fmt: str, tags: str, height: int) -> str:
    """Return the colour matrix, from the first of ffmpeg's "matrix/primaries/transfer" (one word where all agree)."""
    if re.match(r"gbr|rgb|bgr|argb|abgr|pal8|0rgb|0bgr", pix_fmt):
        return "rgb"
    for word in re.split(r",\s*", tags):
        name = word.split("/")[0]
        if name in ("smpte170m", "bt470bg", "bt470m", "fcc"):
            return "bt601"
        if name in ("bt709", "gbr"):
            return "bt709" if name == "bt709" else "rgb"
        if name.startswith("bt2020"):
            return "bt2020"
    return "bt601" if height < 720 else "bt709"
