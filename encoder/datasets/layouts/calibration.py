"""Calibrated cameras as OpenCV has them, which many layouts store in one document or another.

x_camera = R x_world + t, with x right, y down and z forward; pixels = K distort(x / z, y / z), where the centre of the
first pixel is at 0.

Source: https://docs.opencv.org/4.x/d9/d0c/group__calib3d.html
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from kpc.encoder.datasets.capture import Lens, first_names, opengl_pose, printable
from kpc.format.common.errors import DatasetError
from kpc.format.common.text import notice
from kpc.format.scene.camera_checks import NO_DISTORTION, NUMBER_LIMIT, Distortion
from kpc.format.scene.rotations import rotation_of

# The most numbers that a value of a calibration holds.
_MOST_NUMBERS = 64

# How OpenCV's pixel coordinates become ours, in pixels.
PIXEL_CENTRE = 0.5

# The largest skew as a share of the focal length: a tenth of a pixel at the edge of the picture.
_SKEW = 1e-4

# How many coefficients OpenCV has; those after the eighth are of thin prisms and tilted sensors.
_COUNTS, _FISHEYE_COUNTS = (0, 1, 2, 4, 5, 8, 12, 14), (0, 4)

_NUMBER = re.compile(r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?")


@dataclass(frozen=True)
class RigCamera:
    """A calibrated camera of a rig that stands still.

    Attributes:
        name: by which its pictures are found.
        where: the calibration's file and entry, for messages.
        lens, camera_to_world: as in `Lens` and `CapturedView`.
    """

    name: str
    where: str
    lens: Lens
    camera_to_world: np.ndarray


def first_calibration(root: Path, files: Sequence[Path]) -> Path:
    """Return the first of a folder's calibrations, and name the others in one line."""
    chosen, *others = files
    if others:
        notice(f"{root}: {chosen.name} is read; {first_names([o.name for o in others])} are not")
    return chosen


def opencv_camera(
    name: str,
    where: str,
    keys: Mapping[str, Any],
    size: tuple[float, float] | None,
    *,
    is_fisheye: bool = False,
    unit_m: float = 1.0,
) -> RigCamera:
    """Return a camera from OpenCV's numbers.

    Args:
        name: the camera's.
        where: the file and entry, for messages.
        keys: `K` (3x3), `dist` (None or coefficients in OpenCV's order), `R` (3x3, or a Rodrigues vector) and `t` (3),
            as lists, nested or not, or OpenCV's matrices; numbers may be texts.
        size: width and height of the calibrated pictures, if known.
        is_fisheye: whether the coefficients are those of OpenCV's fisheye model.
        unit_m: the unit of `t`.

    Raises:
        DatasetError: a value is missing or malformed, or the lens is of a kind that is not understood.
    """
    translation = numbers(where, keys, "t", (3,))
    intrinsics = _intrinsics(where, numbers(where, keys, "K", (9,)))
    lens = Lens(size, intrinsics, _distortion(where, keys, is_fisheye), is_fisheye)
    return RigCamera(name, where, lens, opengl_pose(rotation(where, keys, "R"), unit_m * translation))


def numbers(where: str, keys: Mapping[str, Any], key: str, counts: Sequence[int]) -> np.ndarray:
    """Return a value of a document as a flat array of one of these lengths, (N,) float64.

    Raises:
        DatasetError: it is missing, or not so many finite numbers.
    """
    value = keys.get(key)
    if value is None:
        raise DatasetError(f"{where}: {key} is missing; add it or calibrate anew")
    if isinstance(value, Mapping):  # OpenCV's matrix
        value = value.get("data")
    rows = value if isinstance(value, list) else [value]
    flat = [
        entry for row in rows[:_MOST_NUMBERS] for entry in (row[:_MOST_NUMBERS] if isinstance(row, list) else [row])
    ]
    if len(rows) > _MOST_NUMBERS or len(flat) not in counts:
        many = " or ".join(map(str, counts))
        raise DatasetError(f"{where}: {key} holds {len(flat)} numbers, not {many}; export it anew")
    return np.array([_number(where, key, entry) for entry in flat])


def size_of(where: str, keys: Mapping[str, Any], *names: str) -> tuple[float, float] | None:
    """Return width and height from one key that holds both, or from two; None if they are missing, 0 or negative."""
    if all(keys.get(name) is None for name in names):
        return None
    if len(names) == 1:
        width, height = numbers(where, keys, names[0], (2,))
    else:
        width, height = (numbers(where, keys, name, (1,))[0] for name in names)
    return (float(width), float(height)) if width > 0 and height > 0 else None


def rotation(where: str, keys: Mapping[str, Any], key: str) -> np.ndarray:
    """Return a (3, 3) matrix of a document, which it may have as a Rodrigues vector: the axis times the angle."""
    values = numbers(where, keys, key, (3, 9))
    if len(values) == 9:
        return values.reshape(3, 3)
    angle = float(np.linalg.norm(values))
    return rotation_of(np.array([math.cos(angle / 2), *(values * 0.5 * float(np.sinc(angle / 2 / math.pi)))]))


def _intrinsics(where: str, matrix: np.ndarray) -> tuple[float, float, float, float]:
    fl_x, skew, cx, below, fl_y, cy, *last = matrix.tolist()
    if abs(skew) > _SKEW * abs(fl_x) or below != 0 or last != [0, 0, 1]:
        raise DatasetError(f"{where}: K is not fx 0 cx, 0 fy cy, 0 0 1 by rows; undistort the images or export it anew")
    return fl_x, fl_y, cx + PIXEL_CENTRE, cy + PIXEL_CENTRE


def _distortion(where: str, keys: Mapping[str, Any], is_fisheye: bool) -> Distortion:
    if keys.get("dist") is None:
        return NO_DISTORTION
    values = numbers(where, keys, "dist", _FISHEYE_COUNTS if is_fisheye else _COUNTS).tolist()
    if any(values[len(NO_DISTORTION) :]):
        raise DatasetError(
            f"{where}: distortion of a thin prism or tilted sensor is not supported; undistort the images"
        )
    if is_fisheye and values:
        k1, k2, k3, k4 = values
        return k1, k2, 0.0, 0.0, k3, k4, 0.0, 0.0
    values = values[: len(NO_DISTORTION)]
    return (*values, *NO_DISTORTION[len(values) :])


def _number(where: str, key: str, value: Any) -> float:
    if isinstance(value, str) and _NUMBER.fullmatch(value):
        value = float(value)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise DatasetError(f"{where}: {key} holds {printable(str(value))}, which is no number; correct it")
    if not abs(value) <= NUMBER_LIMIT:  # false for NaN
        raise DatasetError(f"{where}: {key} holds NaN, infinity or a number beyond {NUMBER_LIMIT:g}; correct it")
    return float(value)
