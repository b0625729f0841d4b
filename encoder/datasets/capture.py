"""What every layout is read into: a list of views, each an image or the video of a camera that stands still."""

import errno
import math
import os
import re
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from kpc.format.common.errors import DatasetError
from kpc.format.common.media import IMAGE_SUFFIXES, VideoInfo, image_size

HOLD_OUT_EVERY = 8
"""Where neither the dataset nor the user names test images, every eighth is one (LLFF's custom, arXiv:1905.00889)."""


@dataclass(frozen=True)
class CapturedView:
    """One file seen through one camera.

    Attributes:
        file: an image, or a video if `video` is given.
        time: as the dataset tells it, in any unit; None for videos and where nothing is told.
        width, height, has_alpha: of the file as it is.
        intrinsics: fl_x fl_y cx cy, pixels of that raster; distortion: k1 k2 p1 p2 (OpenCV's model).
        camera_to_world: (4, 4) float64, OpenGL convention.
        near, far: depth along the optical axis, NaN where unknown.
    """

    file: Path
    video: VideoInfo | None
    time: float | None
    is_test: bool
    width: int
    height: int
    has_alpha: bool
    intrinsics: tuple[float, float, float, float]
    distortion: tuple[float, float, float, float]
    camera_to_world: np.ndarray
    near: float = math.nan
    far: float = math.nan


@dataclass(frozen=True)
class Capture:
    """A dataset before its pixels are read. `fps` is None where nothing tells it."""

    layout: str
    views: tuple[CapturedView, ...]
    fps: float | None


def image_view(
    file: Path,
    *,
    where: str,
    time: float | None,
    is_test: bool,
    declared: tuple[float, float] | None,
    intrinsics: tuple[float, float, float, float],
    distortion: tuple[float, float, float, float],
    camera_to_world: np.ndarray,
    near: float,
    far: float,
) -> CapturedView:
    """A view of an image. `declared` is the raster that the intrinsics belong to, None for the image's own."""
    width, height, has_alpha = image_size(file)
    intrinsics = fit_intrinsics(where, file, intrinsics, declared or (width, height), (width, height))
    pose = check_pose(where, camera_to_world)
    return CapturedView(file, None, time, is_test, width, height, has_alpha, intrinsics, distortion, pose, near, far)


def fit_intrinsics(
    where: str,
    file: Path,
    intrinsics: tuple[float, float, float, float],
    declared: tuple[float, float],
    actual: tuple[int, int],
) -> tuple[float, float, float, float]:
    """Scale fl_x fl_y cx cy from the declared raster to the actual one, each axis on its own.

    Raises:
        DatasetError: the focal length is not a positive number, or the two rasters differ in shape by more than 1 %
            and a pixel's rounding: then the picture was cropped, and nobody says where.
    """
    fl_x, fl_y, cx, cy = intrinsics
    if not (all(map(math.isfinite, intrinsics)) and fl_x > 0 and fl_y > 0):
        raise DatasetError(f"{where}: focal length {fl_x:g} x {fl_y:g} must be positive; correct the calibration")
    if not (declared[0] >= 1 and declared[1] >= 1):
        raise DatasetError(f"{where}: picture size {declared[0]:g}x{declared[1]:g} is empty; correct the calibration")
    sx, sy = actual[0] / declared[0], actual[1] / declared[1]
    if abs(declared[0] * sy - actual[0]) > 1 + 0.01 * actual[0]:
        raise DatasetError(
            f"{file}: is {actual[0]}x{actual[1]}, but {where} is for {declared[0]:g}x{declared[1]:g}, another shape; "
            "undo the crop or correct the size there"
        )
    return fl_x * sx, fl_y * sy, cx * sx, cy * sy


def check_pose(where: str, pose: np.ndarray) -> np.ndarray:
    """The pose as (4, 4) float64 with a scale taken out of its axes.

    Raises:
        DatasetError: not 3x4 or 4x4, NaN or infinity, or axes that are not at right angles or left-handed.
    """
    if pose.shape not in ((3, 4), (4, 4)):
        raise DatasetError(f"{where}: pose has shape {pose.shape}, not 4x4")
    if not np.isfinite(pose).all():
        raise DatasetError(f"{where}: pose holds NaN or infinity; remove the camera or calibrate it anew")
    lengths = np.linalg.norm(pose[:3, :3], axis=0)
    axes = pose[:3, :3] / np.where(lengths > 0, lengths, 1)
    if np.abs(axes.T @ axes - np.eye(3)).max() > 1e-2 or np.linalg.det(axes) < 0:
        raise DatasetError(f"{where}: pose is not a rotation and a position; calibrate the camera anew")
    checked = np.eye(4)
    checked[:3, :3], checked[:3, 3] = axes, pose[:3, 3]
    return checked


def natural_key(name: str) -> list[tuple[int, str]]:
    """Sorts cam2 before cam10. A number goes by its length, then by its digits: no name is too long or too odd for that."""
    parts = re.split(r"(\d+)", name)
    numbers = [part.lstrip("0") for part in parts[1::2]]
    return [(len(numbers[k // 2]), numbers[k // 2]) if k % 2 else (-1, part) for k, part in enumerate(parts)]


def holdout_flags(path: Path, names: Sequence[str], holdout: str | None, default: Iterable[bool]) -> list[bool]:
    """Which of the files named (relative to `path`) are for testing.

    `holdout`: None for the layout's own custom, "none", or a file's name with or without folder and suffix.

    Raises:
        DatasetError: no file has that name.
    """
    if holdout is None:
        return list(default)
    if holdout == "none":
        return [False] * len(names)
    chosen = [holdout in (name, Path(name).name, Path(name).stem) for name in names]
    if not any(chosen):
        shown = ", ".join(Path(name).stem for name in names[:4])
        raise DatasetError(
            f"{path}: nothing is named {holdout!r} to hold out; there are {shown}{' ...' if len(names) > 4 else ''}"
        )
    return chosen


def find_image(root: Path, file: Path, name: str) -> Path | None:
    """The image that `file` knows by a name relative to `root`, with or without its suffix; None if there is none.

    Raises:
        DatasetError: it leads out of `root`. (A link inside the folder may: who put it there meant it.)
    """
    relative = os.path.normpath(name.replace("\\", "/"))
    if os.path.isabs(relative) or relative.split(os.sep)[0] in (os.curdir, os.pardir) or "\0" in relative:
        raise DatasetError(f"{file}: {name!r} leads out of {root} or names no file; make it relative to that folder")
    bare = root / relative
    for candidate in (bare, *(bare.with_name(bare.name + suffix) for suffix in (*IMAGE_SUFFIXES, ".JPG", ".PNG"))):
        if candidate.suffix.lower() in IMAGE_SUFFIXES and file_exists(candidate):
            return candidate
    return None


def file_exists(path: Path) -> bool:
    """As `Path.is_file`; what no file system could hold is not there."""
    try:
        return path.is_file()
    except OSError as error:
        if error.errno == errno.ENAMETOOLONG:
            return False
        raise


def report_missing(file: Path, missing: list[str], total: int) -> None:
    """One line for all frames whose image is not there.

    Raises:
        DatasetError: none is there.
    """
    if len(missing) == total:
        raise DatasetError(
            f"{file}: none of its {total} images exists ({printable(missing[0])} ...); copy them beside it"
        )
    if missing:
        print(
            f"{file}: {len(missing)} of {total} frames have no image and are skipped: {first_names(missing)}",
            file=sys.stderr,
        )


def first_names(names: Sequence[str]) -> str:
    """The first few of them, for a message."""
    return ", ".join(map(printable, names[:6])) + (" ..." if len(names) > 6 else "")


def printable(text: str) -> str:
    """On one line and not endless, whatever a file holds."""
    return (text if text.isprintable() else repr(text))[:160]
