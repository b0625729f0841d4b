"""The files of a COLMAP model, binary or text: `cameras` and `images`.

COLMAP 3.12 and later write `rigs` and `frames` beside them; the poses in `images` already contain those.

Sources: https://colmap.github.io/format.html, https://colmap.github.io/cameras.html
"""

import contextlib
import math
import os
import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from kpc.encoder.datasets.capture import Lens, opengl_pose, printable
from kpc.format.common.errors import DatasetError
from kpc.format.common.text import open_text
from kpc.format.scene.camera_checks import DISTORTION_KEYS, check_lens
from kpc.format.scene.camera_models import (
    COLMAP_NUMBERS,
    FISHEYE_MODELS,
    PARAMETERS,
    understood_model,
)
from kpc.format.scene.rotations import rotation_of

# The longest image name in bytes; no file system takes longer ones.
MAX_NAME_BYTES = 4096

# The line of an image's points: triplets of x, y and the number of a point. Possessive, so that time is linear.
_POINTS = re.compile(r"(?:[-+.0-9eE]++\s++[-+.0-9eE]++\s++-?[0-9]++(?:\s++|\Z))++\Z")


@dataclass(frozen=True)
class ModelImage:
    """A posed image, with the number of its camera."""

    number: int
    camera: int
    name: str
    camera_to_world: np.ndarray


def count_images(file: Path) -> int:
    """Return how many images a model's `images` file lists, up to where it is damaged."""
    count = 0
    with contextlib.suppress(EOFError, ValueError, OverflowError):
        for _ in _images(file):
            count += 1
    return count


def read_cameras(file: Path) -> dict[int, Lens]:
    """Read the cameras of a model by their numbers.

    Raises:
        DatasetError: the file is damaged, or a camera model is not understood.
    """
    found: dict[int, Lens] = {}
    with _damage(file):
        for number, model, size, params in _binary_cameras(file) if file.suffix == ".bin" else _text_cameras(file):
            if number in found:
                raise DatasetError(f"{file}: camera {number} is listed twice; export the model anew")
            found[number] = _camera(f"{file} camera {number}", model, size, params)
    return found


def _camera(where: str, model: str, size: tuple[int, int], params: tuple[float, ...]) -> Lens:
    """Return a camera from COLMAP's parameters, whose pixel coordinates are ours: pixel centres are at + 0.5."""
    names = PARAMETERS[model].split()
    if len(params) != len(names):
        raise DatasetError(f"{where}: {len(params)} parameters, but {model} has {len(names)}; export the model anew")
    if not all(map(math.isfinite, params)):
        raise DatasetError(f"{where}: holds NaN or infinity; calibrate it anew")
    value = dict(zip(names, params, strict=True))
    fl_x = value["f"] if "f" in value else value["fx"]
    fl_y = value.get("fy", fl_x)
    intrinsics, distortion = (fl_x, fl_y, value["cx"], value["cy"]), tuple(value.get(k, 0.0) for k in DISTORTION_KEYS)
    lens = Lens((float(size[0]), float(size[1])), intrinsics, distortion, model in FISHEYE_MODELS)
    check_lens(where, size, lens.intrinsics, lens.distortion, lens.is_fisheye)
    return lens


def read_images(file: Path) -> list[ModelImage]:
    """Read the images of a model, in its order.

    Raises:
        DatasetError: the file is damaged, or lists an image twice or none.
    """
    images, numbers, names = [], set(), set()
    with _damage(file):
        for number, pose, camera, name in _images(file):
            if number in numbers or name in names:
                raise DatasetError(f"{file}: image {number} ({printable(name)}) is listed twice; export the model anew")
            numbers.add(number)
            names.add(name)
            images.append(ModelImage(number, camera, name, _camera_to_world(f"{file} image {number}", pose)))
    if not images:
        raise DatasetError(f"{file}: lists no images; export the model that holds the scene")
    return images


def _camera_to_world(where: str, pose: tuple[float, ...]) -> np.ndarray:
    """Return the (4, 4) OpenGL pose of x_camera = R x_world + t (y down, z forward); `pose` is w x y z of R, then t."""
    length = math.hypot(*pose[:4])
    if not (all(map(math.isfinite, pose)) and 0 < length < math.inf):
        raise DatasetError(f"{where}: pose holds NaN, infinity or no rotation; remove the image or calibrate it anew")
    rotation = rotation_of(np.array(pose[:4]) / length)  # normalised first, since large entries would overflow
    return opengl_pose(rotation, np.array(pose[4:]))


def _binary_cameras(file: Path) -> Iterator[tuple[int, str, tuple[int, int], tuple[float, ...]]]:
    with open(file, "rb") as stream:
        for _ in range(_unpack(stream, "<Q")[0]):
            number, model_number, width, height = _unpack(stream, "<IiQQ")
            name = COLMAP_NUMBERS.get(model_number, f"number {model_number}")
            model = understood_model(f"{file} camera {number}", name)
            yield number, model, (width, height), _unpack(stream, f"<{len(PARAMETERS[model].split())}d")


def _text_cameras(file: Path) -> Iterator[tuple[int, str, tuple[int, int], tuple[float, ...]]]:
    for line in _text_lines(file):
        words = line.split()
        if not words:
            continue
        if len(words) < 4:
            raise ValueError(f"a line of {len(words)} words")
        number, name, width, height, *params = words
        model = understood_model(f"{file} camera {int(number)}", printable(name))
        yield int(number), model, (int(width), int(height)), tuple(map(float, params))


def _images(file: Path) -> Iterator[tuple[int, tuple[float, ...], int, str]]:
    """Yield number, quaternion and translation, camera and name of each image in an `images` file."""
    return _binary_images(file) if file.suffix == ".bin" else _text_images(file)


def _binary_images(file: Path) -> Iterator[tuple[int, tuple[float, ...], int, str]]:
    with open(file, "rb") as stream:
        left = os.fstat(stream.fileno()).st_size
        for _ in range(_unpack(stream, "<Q")[0]):
            number, *pose, camera = _unpack(stream, "<I7dI")
            name = _name(stream)
            points_bytes = _unpack(stream, "<Q")[0] * struct.calcsize("<ddQ")
            if points_bytes > left - stream.tell():
                raise EOFError("it ends early")
            stream.seek(points_bytes, os.SEEK_CUR)
            yield number, tuple(pose), camera, name


def _text_images(file: Path) -> Iterator[tuple[int, tuple[float, ...], int, str]]:
    """Read the lines of images. The line of points after each may be empty or, in files written by hand, missing.

    A line of points consists of triplets of numbers; a line of an image has nine numbers and a name.
    """
    is_after_image = False
    for line in _text_lines(file):
        is_of_points = is_after_image and (not line or _POINTS.match(line) is not None)
        is_after_image = False
        if is_of_points or not line:
            continue
        words = line.split(maxsplit=9)
        if len(words) < 10:
            raise ValueError(f"a line of {len(words)} words")
        number, *pose, camera, name = words
        yield int(number), tuple(map(float, pose)), int(camera), name
        is_after_image = True


def _unpack(stream: BinaryIO, layout: str) -> tuple[int, ...]:
    """Read the next numbers of a binary file, by a format of `struct`; nothing is allocated by a count from the
    file."""
    data = stream.read(struct.calcsize(layout))
    if len(data) < struct.calcsize(layout):
        raise EOFError("it ends early")
    return struct.unpack(layout, data)


def _name(stream: BinaryIO) -> str:
    name = bytearray()
    while (byte := stream.read(1)) != b"\0":
        if not byte:
            raise EOFError("it ends early")
        if len(name) == MAX_NAME_BYTES:
            raise ValueError(f"a name of more than {MAX_NAME_BYTES} bytes")
        name += byte
    return name.decode("utf-8", "surrogateescape")


def _text_lines(file: Path) -> Iterator[str]:
    """Yield the lines of a text file that are no comments, stripped."""
    with open_text(file) as lines:
        yield from (line.strip() for line in lines if not line.lstrip().startswith("#"))


@contextlib.contextmanager
def _damage(file: Path) -> Iterator[None]:
    """Turn the exceptions raised by a malformed file into a DatasetError."""
    try:
        yield
    except (EOFError, ValueError, OverflowError) as error:
        raise DatasetError(f"{file}: not a COLMAP model ({printable(str(error))}); export or copy it anew") from error
