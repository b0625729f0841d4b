"""Pinhole cameras and the JSON that lists them.

World: right-handed. Camera: x right, y up, looking along -z (OpenGL). Pixel (i, j) covers [i, i+1] x [j, j+1], row 0 on
top, so that its centre is (i + 0.5, j + 0.5).
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

LARGEST_FILE = 1 << 26
"""Bytes of a camera file: a hundred thousand frames, and some."""
LARGEST_SIDE = 1 << 16


@dataclass(frozen=True)
class Camera:
    """A pinhole camera without distortion.

    Attributes:
        width, height: picture size, pixels.
        fl_x, fl_y: focal length, pixels.
        cx, cy: principal point, pixels from the left and top edges.
        camera_to_world: (4, 4) float64, OpenGL convention.
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
            raise DatasetError("camera: pose or intrinsics hold NaN or infinity; correct the camera file")
        if self.width < 1 or self.height < 1:
            raise DatasetError(f"camera: picture size {self.width}x{self.height} is empty")
        if self.fl_x <= 0 or self.fl_y <= 0:
            raise DatasetError(f"camera: focal length {self.fl_x} x {self.fl_y} must be positive")

    def resized(self, width: int, height: int) -> "Camera":
        """The same view on another raster; each axis is scaled on its own."""
        sx, sy = width / self.width, height / self.height
        return Camera(width, height, self.fl_x * sx, self.fl_y * sy, self.cx * sx, self.cy * sy, self.camera_to_world)

    def rays(self) -> tuple[np.ndarray, np.ndarray]:
        """Origins and unit directions of all pixels, row by row: two (height * width, 3) float32 arrays.

        d = normalise(R [(i + 0.5 - cx) / fl_x, -(j + 0.5 - cy) / fl_y, -1])
        """
        i, j = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
        local = np.stack([(i - self.cx) / self.fl_x, -(j - self.cy) / self.fl_y, -np.ones_like(i)], axis=-1)
        directions = local.reshape(-1, 3) @ self.camera_to_world[:3, :3].T
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        origins = np.broadcast_to(self.camera_to_world[:3, 3], directions.shape)
        return np.ascontiguousarray(origins, np.float32), directions.astype(np.float32)


@dataclass(frozen=True)
class View:
    """One picture to take: a camera at a time, and the name of the file that holds (or shall hold) it.

    Attributes:
        time: [0, 1] over the clip.
        at_s: when a path through such views passes it, seconds; None: not said.
    """

    camera: Camera
    time: float
    file: str
    at_s: float | None = None


def load_views(path: str | os.PathLike[str]) -> list[View]:
    """Read a `cameras.json`: `w h fl_x fl_y cx cy` and `frames`, each of which may override them, and has `transform_matrix`,
    `time`, `file`, and for paths `at`.

    Raises:
        DatasetError: the file is too large, or a key is missing or of the wrong kind; the message names the file and the frame.
    """
    with open(path, "rb") as file:
        content = file.read(LARGEST_FILE + 1)
    if len(content) > LARGEST_FILE:
        raise DatasetError(f"{path}: larger than {LARGEST_FILE >> 20} MiB, which no camera file is")
    try:
        document = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise DatasetError(f"{path}: not JSON ({error})") from error
    shots: list[View] = []
    try:
        for number, frame in enumerate(document["frames"]):
            shots.append(_shot({**document, **frame}, number))
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise DatasetError(f"{path}: frame {len(shots)}: missing or malformed {error}") from error
    except DatasetError as error:
        raise DatasetError(f"{path}: frame {len(shots)}: {error}") from error
    if not shots:
        raise DatasetError(f"{path}: lists no frames")
    return shots


def _shot(frame: Mapping[str, Any], number: int) -> View:
    w, h = int(frame["w"]), int(frame["h"])
    if max(w, h) > LARGEST_SIDE:
        raise DatasetError(f"a picture of {w}x{h} is too large, at most {LARGEST_SIDE} a side")
    camera = Camera(
        w, h, float(frame["fl_x"]), float(frame.get("fl_y", frame["fl_x"])),
        float(frame.get("cx", w / 2)), float(frame.get("cy", h / 2)),
        np.array(frame["transform_matrix"], np.float64),
    )  # fmt: skip
    time = float(frame.get("time", 0.0))
    if not 0.0 <= time <= 1.0:
        raise DatasetError(f"time {time} lies outside [0, 1]")
    at_s = None if frame.get("at") is None else float(frame["at"])
    return View(camera, time, str(frame.get("file", f"{number:04d}.png")), at_s)


def save_views(path: str | os.PathLike[str], shots: Sequence[View]) -> None:
    """Write a `cameras.json` from which `load_views` reads the same again."""
    shared = _intrinsics(shots[0].camera) if shots else {}
    frames = []
    for shot in shots:
        own = {key: value for key, value in _intrinsics(shot.camera).items() if shared[key] != value}
        at = {} if shot.at_s is None else {"at": shot.at_s}
        pose = shot.camera.camera_to_world.tolist()
        frames.append({"file": shot.file, "time": shot.time, **at, **own, "transform_matrix": pose})
    with atomic_write(path) as aside:
        aside.write_text(json.dumps({**shared, "frames": frames}, indent=1))


def _intrinsics(camera: Camera) -> dict[str, float]:
    return {
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.fl_x,
        "fl_y": camera.fl_y,
        "cx": camera.cx,
        "cy": camera.cy,
    }
