"""The checks that a camera passes where it enters: from a dataset, a `cameras.json`, or a camera path.

Whoever reads a camera calls these, so that the encoder, the renderers and the player refuse the same cameras in the
same words. Each takes `where`, the file and entry that begin its message.
"""

import functools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from kpc.format.common.errors import DatasetError
from kpc.format.scene.camera_models import FISHEYE_MODELS, NO_PINHOLE_KEYS, check_unknown_keys, understood_model

# Numbers of a camera lie within this magnitude: a .kpc file holds no larger ones (BOX_LIMIT of the specification).
NUMBER_LIMIT = 2.0**30

# Focal lengths as a share of the picture's larger side. The least makes a field of view of 179 degrees.
LEAST_FOCAL, GREATEST_FOCAL = 0.01, 1e5

# The most that the focal lengths of both axes differ by, as a factor. Pixels of anamorphic film differ by 2.
GREATEST_ASPECT = 10.0

# The farthest that a principal point lies from the picture's corner, in widths and heights of the picture.
FARTHEST_CENTRE = 100

# How far the products of a pose's axes may be from those of a rotation.
SKEW_TOLERANCE = 1e-2

# The factor by which distortion may move a point away from the principal point or towards it.
GREATEST_STRETCH = 10.0

# The picture counts as larger by this factor when folds are looked for, since only some directions are tried.
SAFETY = 1.005

# The largest angle from the optical axis that a picture of a fisheye lens may show, in radians.
GREATEST_ANGLE = math.radians(170)

# Coefficients of OpenCV's lens models, in its order. The fisheye model has no others than k1 to k4.
DISTORTION_KEYS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
Distortion = tuple[float, ...]
NO_DISTORTION: Distortion = (0.0,) * len(DISTORTION_KEYS)

# Keys of a camera in a JSON document.
_CAMERA_KEYS = frozenset(
    (
        *("w", "h", "fl_x", "fl_y", "cx", "cy", "transform_matrix", "time", "at", "camera_model", "camera_type"),
        *(*DISTORTION_KEYS, "distortion_params"),
    )
)


def number_of(where: str, keys: Mapping[str, Any], key: str, default: float | None = None) -> float:
    """Return a number of a JSON document, or its default.

    Raises:
        DatasetError: it is missing without a default, not a number (a string or a boolean is none), or NaN, infinite
            or beyond NUMBER_LIMIT.
    """
    if key not in keys and default is not None:
        return default
    value = keys.get(key)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise DatasetError(f"{where}: {key} is {'missing' if value is None else 'not a number'}; add it or export anew")
    if not abs(value) <= NUMBER_LIMIT:  # false for NaN; compared as it is, since integers may be too large for a float
        raise DatasetError(f"{where}: {key} is NaN, infinite or larger than {NUMBER_LIMIT:g}; correct it")
    return float(value)


def pose_of(where: str, keys: Mapping[str, Any], key: str = "transform_matrix") -> np.ndarray:
    """Return a camera-to-world matrix of a JSON document as (4, 4) float64; see `check_pose`."""
    rows = keys.get(key)
    if not (isinstance(rows, list) and len(rows) in (3, 4) and all(isinstance(r, list) and len(r) == 4 for r in rows)):
        raise DatasetError(f"{where}: {key} is {'missing' if rows is None else 'not 4x4 numbers'}; export it anew")
    entries = {f"{key}[{i}][{j}]": number for i, row in enumerate(rows) for j, number in enumerate(row)}
    return check_pose(where, np.array([number_of(where, entries, name) for name in entries]).reshape(-1, 4))


def check_pose(where: str, pose: np.ndarray) -> np.ndarray:
    """Return a camera-to-world matrix, (3, 4) or (4, 4), as (4, 4) float64 with axes of length 1.

    Raises:
        DatasetError: it has another shape; a number is NaN, infinite or beyond NUMBER_LIMIT; the last row is not
            0 0 0 1; or it does more than turn and shift: it mirrors, scales or skews.
    """
    if pose.shape not in ((3, 4), (4, 4)):
        raise DatasetError(f"{where}: pose has shape {pose.shape}, not 4x4; export it anew")
    if not (np.abs(pose) <= NUMBER_LIMIT).all():
        raise DatasetError(
            f"{where}: pose holds NaN, infinity or a number larger than {NUMBER_LIMIT:g}; remove the camera or "
            "calibrate it anew"
        )
    if len(pose) == 4 and np.abs(pose[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise DatasetError(f"{where}: the last row of the pose is not 0 0 0 1; is it transposed? export it anew")
    axes = pose[:3, :3]
    if np.abs(axes.T @ axes - np.eye(3)).max() > SKEW_TOLERANCE or np.linalg.det(axes) < 0:
        raise DatasetError(
            f"{where}: pose is scaled, skewed or mirrored, not a rotation and a translation; calibrate it anew"
        )
    lengths = np.linalg.norm(axes, axis=0)
    if np.abs(lengths - 1).max() < 1e-12:
        lengths = np.ones(3)  # a pose that was saved comes back as it was
    checked = np.eye(4)
    checked[:3, :3], checked[:3, 3] = axes / lengths, pose[:3, 3]
    return checked


def check_lens(
    where: str,
    size: tuple[float, float],
    intrinsics: tuple[float, float, float, float],
    distortion: Distortion = NO_DISTORTION,
    is_fisheye: bool = False,
) -> None:
    """Check the lens of a camera.

    Args:
        where: as above.
        size: width and height of the picture.
        intrinsics: fl_x fl_y cx cy in pixels of that size.
        distortion: the coefficients DISTORTION_KEYS.
        is_fisheye: whether they are those of OpenCV's fisheye model.

    Raises:
        DatasetError: the picture is empty, a number is not finite, the focal length or principal point is not that of
            a camera, or the distortion folds within the picture.
    """
    width, height = size
    fl_x, fl_y, cx, cy = intrinsics
    if not (width >= 1 and height >= 1 and max(size) <= NUMBER_LIMIT):
        raise DatasetError(f"{where}: picture size {width:g}x{height:g} is empty or too large; correct the calibration")
    if not all(map(math.isfinite, (*intrinsics, *distortion))):
        names = ("fl_x", "fl_y", "cx", "cy", *DISTORTION_KEYS)
        bad = [name for name, n in zip(names, (*intrinsics, *distortion), strict=True) if not math.isfinite(n)]
        raise DatasetError(f"{where}: {' '.join(bad)} holds NaN or infinity; correct the calibration")
    if not (fl_x > 0 and fl_y > 0):
        raise DatasetError(f"{where}: focal length {fl_x:g} x {fl_y:g} must be positive; correct the calibration")
    side = max(size)
    if min(fl_x, fl_y) < LEAST_FOCAL * side or max(fl_x, fl_y) > GREATEST_FOCAL * side:
        raise DatasetError(
            f"{where}: a focal length of {fl_x:g} x {fl_y:g} pixels does not fit a picture of {width:g}x{height:g}; "
            "give it in pixels of that size"
        )
    if max(fl_x, fl_y) > GREATEST_ASPECT * min(fl_x, fl_y):
        raise DatasetError(
            f"{where}: focal lengths of {fl_x:g} x {fl_y:g} pixels differ more than those of any lens; correct the "
            "calibration"
        )
    if max(abs(cx / width - 0.5), abs(cy / height - 0.5)) > FARTHEST_CENTRE:
        raise DatasetError(
            f"{where}: the principal point {cx:g}, {cy:g} lies far outside a picture of {width:g}x{height:g}; "
            "give it in pixels of that size"
        )
    if (any(distortion) or is_fisheye) and _folds(size, intrinsics, distortion, is_fisheye):
        values = " ".join(f"{name} {value:g}" for name, value in zip(DISTORTION_KEYS, distortion, strict=True) if value)
        beyond = f", or shows more than {math.degrees(GREATEST_ANGLE):g} degrees from the axis" if is_fisheye else ""
        raise DatasetError(
            f"{where}: {'fisheye ' if is_fisheye else ''}distortion {values or 'of 0'} folds within the picture or "
            f"stretches it more than {GREATEST_STRETCH:g} times{beyond}; calibrate anew or undistort the images"
        )


def check_depths(where: str, near: float, far: float) -> None:
    """Check a depth range, whose ends are NaN where they are unknown.

    Raises:
        DatasetError: not 0 < near < far <= NUMBER_LIMIT.
    """
    low, high = (0.0 if math.isnan(near) else near), (math.inf if math.isnan(far) else far)
    ends_fit = (math.isnan(near) or near > 0) and (math.isnan(far) or far <= NUMBER_LIMIT)
    if not (ends_fit and low < high):
        raise DatasetError(
            f"{where}: near {near:g} and far {far:g} are not 0 < near < far < {NUMBER_LIMIT:g}; calibrate anew"
        )


def check_pinhole(where: str, keys: Mapping[str, Any]) -> None:
    """Check that a camera of a JSON document is a pinhole without distortion, since renderers draw no other.

    Raises:
        DatasetError: the document names another model, or coefficients of distortion that are not 0, or has the keys
            of a camera in other letters.
    """
    check_unknown_keys(where, keys, _CAMERA_KEYS, _CAMERA_KEYS | {*NO_PINHOLE_KEYS, "is_fisheye", "file", "file_path"})
    for key in ("camera_model", "camera_type"):
        if keys.get(key) is not None:
            name = ascii(str(keys[key]))[1:-1][:80]
            if understood_model(where, name) in FISHEYE_MODELS:
                raise DatasetError(f"{where}: camera model {name} is not rendered; only pinholes are")
    for key in ("is_fisheye", *NO_PINHOLE_KEYS):
        if keys.get(key):
            raise DatasetError(f"{where}: {key} is not supported; only pinholes are rendered")
    listed = keys.get("distortion_params") or []
    coefficients = [number_of(where, keys, key, 0.0) for key in DISTORTION_KEYS]
    if any(coefficients) or not isinstance(listed, list) or any(number != 0 for number in listed):
        raise DatasetError(
            f"{where}: has lens distortion, which is not rendered; set its coefficients to 0 for pictures without it"
        )


def distort(
    x: np.ndarray, y: np.ndarray, distortion: Sequence[Any], is_fisheye: Any = False
) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Apply OpenCV's lens distortion, and return its Jacobian.

    x_d = x q + 2 p1 x y + p2 (r^2 + 2 x^2)
    y_d = y q + p1 (r^2 + 2 y^2) + 2 p2 x y,  r^2 = x^2 + y^2

    q = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6) in the rational model, where x and y are slopes;
    q = 1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8 in the fisheye model, where r is the angle from the optical axis
    (Kannala and Brandt 2006).

    Source: https://docs.opencv.org/4.x/d9/d0c/group__calib3d.html and .../db/d58/group__calib3d__fisheye.html

    Args:
        x, y: coordinates normalised by focal length and principal point, y down.
        distortion: the coefficients DISTORTION_KEYS, numbers or arrays like x.
        is_fisheye: whether the model is the fisheye model, a bool or an array like x.

    Returns:
        x_d and y_d, and the derivatives d x_d / d x, d y_d / d y, and d x_d / d y, which equals d y_d / d x.
    """
    k1, k2, p1, p2, k3, k4, k5, k6 = distortion
    last, first = np.where(is_fisheye, k4, 0.0), np.where(is_fisheye, 0.0, k4)  # of numerator and denominator
    r2 = x * x + y * y
    above, below = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * last))), 1 + r2 * (first + r2 * (k5 + r2 * k6))
    above_slope = k1 + r2 * (2 * k2 + r2 * (3 * k3 + r2 * 4 * last))  # by r^2
    below_slope = first + r2 * (2 * k5 + r2 * 3 * k6)
    radial = above / below
    slope = 2 * (above_slope - radial * below_slope) / below
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        (
            radial + x * x * slope + 2 * p1 * y + 6 * p2 * x,
            radial + y * y * slope + 6 * p1 * y + 2 * p2 * x,
            x * y * slope + 2 * p1 * x + 2 * p2 * y,
        ),
    )


@functools.lru_cache(maxsize=256)
def _folds(
    size: tuple[float, float],
    intrinsics: tuple[float, float, float, float],
    distortion: Distortion,
    is_fisheye: bool,
) -> bool:
    """Return whether distortion is not one-to-one within the picture, or stretches by more than GREATEST_STRETCH.

    Walks from the principal point outwards in many directions until the distorted point leaves the rectangle around
    the picture and the principal point. On the way the Jacobian's determinant must stay positive, and the angle of a
    fisheye lens below GREATEST_ANGLE.
    """
    fl_x, fl_y, cx, cy = intrinsics
    left, right = SAFETY * min(-cx, 0.0) / fl_x, SAFETY * max(size[0] - cx, 0.0) / fl_x
    top, bottom = SAFETY * min(-cy, 0.0) / fl_y, SAFETY * max(size[1] - cy, 0.0) / fl_y
    corners = np.array([math.atan2(y, x) for x in (left, right) for y in (top, bottom)])
    near_corners = (corners[:, None] + np.radians([-2, -1, 0, 1, 2])).ravel()
    angles = np.concatenate([np.linspace(0, 2 * math.pi, 96, endpoint=False), near_corners])[:, None]
    reach = math.hypot(max(-left, right), max(-top, bottom))
    radius = reach * np.geomspace(1e-2, GREATEST_STRETCH, 400)
    # What overflows fails the comparisons below.
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        x, y, (xx, yy, xy) = distort(radius * np.cos(angles), radius * np.sin(angles), distortion, is_fisheye)
        stretch = np.hypot(x, y) / radius
        is_sound = (xx * yy - xy * xy > 0) & (1 / GREATEST_STRETCH <= stretch) & (stretch <= GREATEST_STRETCH)
        is_sound &= (radius < GREATEST_ANGLE) | (not is_fisheye)
        is_outside = ~((left <= x) & (x <= right) & (top <= y) & (y <= bottom))
    leaves = np.argmax(is_outside, axis=1)  # the first radius beyond the rectangle
    before = np.arange(len(radius)) <= leaves[:, None]
    return not bool(is_outside.any(axis=1).all() and (is_sound | ~before).all())
