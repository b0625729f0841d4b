"""Which files are images or videos, judged by their names alone."""

import os
from pathlib import Path, PurePath

from kpc.format.common.errors import MediaError

# Suffixes of still images, most frequent first: those of the formats that `images.py` decodes.
IMAGE_SUFFIXES = (
    *(".png", ".jpg", ".jpeg", ".exr", ".tif", ".tiff", ".webp", ".heic", ".heif", ".hif", ".avif", ".bmp", ".dib"),
    *(".jpe", ".jfif", ".mpo", ".apng", ".gif", ".jp2", ".j2k", ".j2c", ".jpc", ".jpf", ".jpx", ".tga", ".icb"),
    *(".vda", ".vst", ".ppm", ".pgm", ".pbm", ".pnm", ".pfm", ".pcx", ".qoi", ".sgi", ".rgb", ".rgba", ".bw"),
)

# Suffixes of containers and streams of video that ffmpeg reads.
VIDEO_SUFFIXES = (
    *(".mp4", ".m4v", ".mov", ".qt", ".mkv", ".webm", ".avi", ".divx", ".mpg", ".mpeg", ".mpe", ".m1v", ".m2v"),
    *(".mts", ".m2ts", ".m2t", ".ts", ".vob", ".wmv", ".asf", ".flv", ".f4v", ".3gp", ".3g2", ".ogv", ".ogm"),
    *(".mxf", ".dv", ".y4m", ".nut", ".ivf", ".mjpeg", ".mjpg", ".h264", ".264", ".h265", ".265", ".hevc"),
)

# Files that Windows leaves in folders, in lower case. (macOS and Linux begin such names with a full stop.)
_SYSTEM_FILES = ("thumbs.db", "ehthumbs.db", "desktop.ini")


def is_image(path: str | os.PathLike[str]) -> bool:
    """Return whether a name is that of an image, with its suffix in any case; hidden files are none."""
    return PurePath(path).suffix.lower() in IMAGE_SUFFIXES and not is_hidden(path)


def is_video(path: str | os.PathLike[str]) -> bool:
    """Return whether a name is that of a video, with its suffix in any case; hidden files are none."""
    return PurePath(path).suffix.lower() in VIDEO_SUFFIXES and not is_hidden(path)


def is_hidden(path: str | os.PathLike[str]) -> bool:
    """Return whether a name is that of a hidden or system file, such as ._0001.png, .DS_Store or Thumbs.db."""
    name = PurePath(path).name
    return name.startswith(".") or name.lower() in _SYSTEM_FILES


def require_file(path: str | os.PathLike[str]) -> None:
    """Refuse what is not a regular file: a pipe or device would make a reader wait forever.

    Raises:
        MediaError: there is no such file, or it is not a regular one.
    """
    if not Path(path).is_file():
        raise MediaError(
            f"{path}: no such file; check the path"
            if not Path(path).exists()
            else f"{path}: not a regular file; copy it to one"
        )
