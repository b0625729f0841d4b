"""Pinhole cameras and the JSON that lists them.

World: right-handed. Camera: x right, y up, looking along -z (OpenGL). Pixel (i, j) covers [i, i+1] x [j, j+1], row 0 on
top, so that its centre is (i + 0.5, j + 0.5).
"""

import json
import math
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kpc.format.errors import DatasetError


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
class Shot:
    """One picture to take: a camera at a time, and the name of the file that holds (or shall hold) it."""

    camera: Camera
    time: float  # [0, 1] over the clip
    file: str


def load_shots(path: str | os.PathLike[str]) -> list[Shot]:
    """Read a `cameras.json`: `w h fl_x fl_y cx cy` and `frames`, each of which may override them.

    Raises:
        DatasetError: a key is missing or of the wrong kind; the message names the file and the frame.
    """
    try:
        document = json.loads(Path(path).read_text())
    except ValueError as error:
        raise DatasetError(f"{path}: not JSON ({error})") from error
    shots = []
    try:
        frames = document["frames"]
        for number, frame in enumerate(frames):
            merged = {**document, **frame}
            w, h = int(merged["w"]), int(merged["h"])
            camera = Camera(
                w, h, float(merged["fl_x"]), float(merged.get("fl_y", merged["fl_x"])),
                float(merged.get("cx", w / 2)), float(merged.get("cy", h / 2)),
                np.array(merged["transform_matrix"], np.float64),
            )
            time = float(merged.get("time", 0.0))
            if not 0.0 <= time <= 1.0:
                raise DatasetError(f"time {time} lies outside [0, 1]")
            shots.append(Shot(camera, time, str(merged.get("file", f"{number:04d}.png"))))
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise DatasetError(f"{path}: frame {len(shots)}: missing or malformed {error}") from error
    except DatasetError as error:
        raise DatasetError(f"{path}: frame {len(shots)}: {error}") from error
    if not shots:
        raise DatasetError(f"{path}: lists no frames")
    return shots
