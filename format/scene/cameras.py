"""Pinhole cameras, and the `cameras.json` file that lists views to render.

The world is right-handed. Camera axes follow OpenGL: x right, y up, looking along -z. Pixel (i, j) covers
[i, i+1] x [j, j+1] with row j = 0 at the top, so its centre is (i + 0.5, j + 0.5).
"""

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from kpc.format.common.cli import atomic_write
from kpc.format.common.errors import DatasetError
from kpc.format.scene.camera_checks import check_lens, check_pinhole, number_of, pose_of
from kpc.format.scene.camera_documents import rewritten

# The largest `cameras.json` that is read, in bytes: enough for more than a hundred thousand frames.
MAX_FILE_BYTES = 1 << 26

# The largest image side that `cameras.json` may name, in pixels.
MAX_SIDE = 1 << 14


@dataclass(frozen=True)
class Camera:
    """A pinhole camera without lens distortion.

    Attributes:
        width, height: image size in pixels.
        fl_x, fl_y: focal lengths in pixels, > 0.
        cx, cy: principal point in pixels from the left and top edges.
        camera_to_world: (4, 4) float64 pose, OpenGL convention.

    Raises:
        DatasetError: a value is out of range or not finite.
    """

    width: int
    height: int
    fl_x: float
    fl_y: float
    cx: float
    cy: float
    camera_to_world: np.ndarray

    def __post_init__(self) -> None:
        numbers = [self.fl_x, self.fl_y, self.cx, self.cy, *np.ravel(self.camera_to_world)]
        if np.shape(self.camera_to_world) != (4, 4):
            raise DatasetError(f"camera: pose has shape {np.shape(self.camera_to_world)}, not 4x4")
        if not all(math.isfinite(n) for n in numbers):
            raise DatasetError("camera: pose or intrinsics hold NaN or infinity; correct them")
        if self.width < 1 or self.height < 1:
            raise DatasetError(f"camera: picture size {self.width}x{self.height} is empty; give at least 1x1")
        if self.fl_x <= 0 or self.fl_y <= 0:
            raise DatasetError(f"camera: focal length {self.fl_x} x {self.fl_y} must be positive")

    def resized(self, width: int, height: int) -> "Camera":
        """Return the same view at another image size; each axis is scaled independently."""
        sx, sy = width / self.width, height / self.height
        return Camera(width, height, self.fl_x * sx, self.fl_y * sy, self.cx * sx, self.cy * sy, self.camera_to_world)

    def rays(self, dtype: type[np.floating] = np.float32) -> tuple[np.ndarray, np.ndarray]:
        """Return the rays through all pixel centres, row by row.

            d = normalise(R [(i + 0.5 - cx) / fl_x, -(j + 0.5 - cy) / fl_y, -1])

        Returns:
            Origins and unit directions in the world, both (height * width, 3) of `dtype`.
        """
        i, j = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
        local = np.stack([(i - self.cx) / self.fl_x, -(j - self.cy) / self.fl_y, -np.ones_like(i)], axis=-1)
        directions = local.reshape(-1, 3) @ self.camera_to_world[:3, :3].T
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        origins = np.broadcast_to(self.camera_to_world[:3, 3], directions.shape)
        return np.ascontiguousarray(origins, dtype), directions.astype(dtype)


def has_unit_axes(pose: np.ndarray) -> bool:
    """Return whether the axes of a pose, (4, 4), are of about the length 1, as files must have them; or NaN."""
    lengths = np.linalg.norm(pose[:3, :3], axis=0)
    return not bool(lengths.min() < 0.5 or lengths.max() > 2.0)


@dataclass(frozen=True)
class View:
    """One frame of `cameras.json`: a camera, a time, and the image file that belongs to it.

    Attributes:
        camera: the camera.
        time: in [0, 1] over the clip.
        file: name of the image that shows this view, or that rendering it writes.
        at_s: when a camera path passes through the view, in seconds from its start; None if the file does not say.
    """

    camera: Camera
    time: float
    file: str
    at_s: float | None = None


def load_views(path: str | os.PathLike[str]) -> list[View]:
    """Read the views of a `cameras.json`.

    The document has the intrinsics `w h fl_x fl_y cx cy` and a list `frames`. Each frame has a `transform_matrix` and
    may have `time`, `file`, `at` (keyframes of a camera path, seconds) and intrinsics that replace those of the
    document. Files of nerfstudio are read, too; see `kpc.format.scene.camera_documents`.

    Raises:
        DatasetError: the file is too large or not JSON, a key is missing or malformed, or a camera is none that can be
            rendered (`camera_checks`); the message names the frame.
    """
    with open(path, "rb") as file:
        content = file.read(MAX_FILE_BYTES + 1)
    if len(content) > MAX_FILE_BYTES:
        raise DatasetError(
            f"{path}: larger than {MAX_FILE_BYTES >> 20} MiB, so it is not a camera file; check the path"
        )
    try:
        document = json.loads(content)
    except (ValueError, RecursionError) as error:
        reason = "it is no text" if isinstance(error, UnicodeDecodeError) else error
        raise DatasetError(f"{path}: not JSON ({reason}); write it anew") from error
    document = rewritten(str(path), document)
    views = [_parse_view(f"{path} frame {n}", {**document, **frame}, n) for n, frame in enumerate(document["frames"])]
    if not views:
        raise DatasetError(f"{path}: lists no frames; add some")
    return views


def _parse_view(where: str, frame: Mapping[str, Any], number: int) -> View:
    check_pinhole(where, frame)
    w, h = number_of(where, frame, "w"), number_of(where, frame, "h")
    if not (w == int(w) and h == int(h)):
        raise DatasetError(f"{where}: picture size {w:g}x{h:g} is not of whole pixels; correct the file")
    if max(w, h) > MAX_SIDE:
        raise DatasetError(
            f"{where}: an image of {w:g}x{h:g} is too large; at most {MAX_SIDE} pixels a side are allowed"
        )
    fl_x = number_of(where, frame, "fl_x")
    intrinsics = (
        fl_x,
        number_of(where, frame, "fl_y", fl_x),
        number_of(where, frame, "cx", w / 2),
        number_of(where, frame, "cy", h / 2),
    )
    check_lens(where, (w, h), intrinsics)
    camera = Camera(int(w), int(h), *intrinsics, pose_of(where, frame))
    time = number_of(where, frame, "time", 0.0)
    if not 0.0 <= time <= 1.0:
        raise DatasetError(f"{where}: time {time:g} lies outside [0, 1]; correct the file")
    at_s = None if frame.get("at") is None else number_of(where, frame, "at")
    return View(camera, time, str(frame.get("file") or f"{number:04d}.png"), at_s)


def save_views(path: str | os.PathLike[str], views: Sequence[View]) -> None:
    """Write a `cameras.json` that `load_views` reads back unchanged."""
    shared = _intrinsics(views[0].camera) if views else {}
    frames = []
    for view in views:
        own = {key: value for key, value in _intrinsics(view.camera).items() if shared[key] != value}
        at = {} if view.at_s is None else {"at": view.at_s}
        pose = view.camera.camera_to_world.tolist()
        frames.append({"file": view.file, "time": view.time, **at, **own, "transform_matrix": pose})
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps({**shared, "frames": frames}, indent=1))


def _intrinsics(camera: Camera) -> dict[str, float]:
    return {
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.fl_x,
        "fl_y": camera.fl_y,
        "cx": camera.cx,
        "cy": camera.cy,
    }
