"""Reading of `transforms*.json`, common to the layouts of Blender and nerfstudio.

The document describes a camera and lists frames, which may override it.
"""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from kpc.encoder.datasets.capture import CapturedView, image_view
from kpc.format.common.errors import DatasetError
from kpc.format.common.images import image_info

# Camera models of nerfstudio that are not a pinhole with k1 k2 p1 p2.
_UNSUPPORTED = {
    "OPENCV_FISHEYE",
    "EQUIRECTANGULAR",
    "OMNIDIRECTIONALSTEREO_L",
    "OMNIDIRECTIONALSTEREO_R",
    "FISHEYE624",
    "ORTHOPHOTO",
}


def load_transforms(file: Path) -> dict[str, Any]:
    """Read the document and check that it has a list `frames` of objects with `file_path` and `transform_matrix`.

    Raises:
        DatasetError: it is not JSON or lacks those.
    """
    try:
        document = json.loads(file.read_text())
    except (ValueError, RecursionError) as error:
        raise DatasetError(f"{file}: not JSON ({error}); export it anew") from error
    frames = document.get("frames") if isinstance(document, dict) else None
    if not isinstance(frames, list) or not frames:
        raise DatasetError(f"{file}: lists no frames; export it anew")
    for number, frame in enumerate(frames):
        if not (isinstance(frame, dict) and isinstance(frame.get("file_path"), str) and "transform_matrix" in frame):
            raise DatasetError(f"{file}: frame {number} lacks file_path or transform_matrix; export it anew")
    return document


def frame_view(file: Path, number: int, document: dict[str, Any], image: Path, is_test: bool) -> CapturedView:
    """Return the view of a frame, whose keys override those of the document.

    Args:
        file: the document's path, for messages.
        number: of the frame.
        document: from `load_transforms`.
        image: the frame's image.
        is_test: whether it is held out.

    Raises:
        DatasetError: a number is missing or malformed, or the camera is not a pinhole with at most k1 k2 p1 p2.
    """
    where = f"{file} frame {number}"
    keys = {**{k: v for k, v in document.items() if k != "frames"}, **document["frames"][number]}
    if keys.get("camera_model") in _UNSUPPORTED or keys.get("is_fisheye"):
        model = keys.get("camera_model", "fisheye")
        raise DatasetError(f"{where}: camera model {model} is not supported; undistort the images to a pinhole")
    if any(_number(where, keys, k, 0.0) != 0 for k in ("k3", "k4", "k5", "k6")):
        raise DatasetError(f"{where}: distortion beyond k1 k2 p1 p2 is not supported; undistort the images")
    declared = (_number(where, keys, "w"), _number(where, keys, "h")) if "w" in keys and "h" in keys else None
    if declared is None:
        info = image_info(image)
        width, height = float(info.width), float(info.height)
    else:
        width, height = declared
    fl_x = _focal(where, keys, width)
    intrinsics = (
        fl_x,
        _number(where, keys, "fl_y", fl_x),
        _number(where, keys, "cx", width / 2),
        _number(where, keys, "cy", height / 2),
    )
    k1, k2, p1, p2 = (_number(where, keys, k, 0.0) for k in ("k1", "k2", "p1", "p2"))
    try:
        pose = np.array(keys["transform_matrix"], np.float64)
    except (TypeError, ValueError) as error:
        raise DatasetError(f"{where}: transform_matrix is not 4x4 numbers; export it anew") from error
    return image_view(
        image,
        where=where,
        is_test=is_test,
        declared=declared,
        intrinsics=intrinsics,
        distortion=(k1, k2, p1, p2),
        camera_to_world=pose,
        time=_number(where, keys, "time") if keys.get("time") is not None else None,
        near=_number(where, keys, "near", math.nan),
        far=_number(where, keys, "far", math.nan),
    )


def frame_rate(file: Path, document: dict[str, Any]) -> float | None:
    """Return the frame rate from the key `fps`, an extension of KPC; None if it is absent."""
    if document.get("fps") is None:
        return None
    fps = _number(str(file), document, "fps")
    if not (math.isfinite(fps) and fps > 0):
        raise DatasetError(f"{file}: fps {fps:g} must be a positive number; correct it")
    return fps


def _focal(where: str, keys: dict[str, Any], width: float) -> float:
    """Return fl_x in pixels, from that key or from the horizontal angle of view: width / 2 / tan(angle / 2)."""
    if "fl_x" in keys or "camera_angle_x" not in keys:
        return _number(where, keys, "fl_x")
    angle = _number(where, keys, "camera_angle_x")
    if not 0 < angle < math.pi:
        raise DatasetError(f"{where}: camera_angle_x {angle:g} does not lie between 0 and pi; correct the calibration")
    return width / 2 / math.tan(angle / 2)


def _number(where: str, keys: dict[str, Any], key: str, default: float | None = None) -> float:
    """Return a number of the document, or its default.

    Raises:
        DatasetError: it is missing without a default, or not a number.
    """
    value = keys.get(key, default)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise DatasetError(f"{where}: {key} is {'missing' if value is None else 'not a number'}; add it or export anew")
    return float(value)
