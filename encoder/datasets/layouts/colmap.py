"""The layout of COLMAP: a sparse model in `sparse/0/` (or `sparse/`), binary or text, beside `images/`.

Sources: https://colmap.github.io/format.html, https://colmap.github.io/cameras.html
"""

import contextlib
import math
import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, TextIO

import numpy as np

from kpc.encoder.datasets.capture import (
    HOLD_OUT_EVERY,
    Capture,
    CapturedView,
    find_image,
    holdout_flags,
    image_view,
    natural_key,
    printable,
    report_missing,
)
from kpc.format.common.errors import DatasetError
from kpc.format.scene.rotations import rotation_of

# The supported camera models: number in binary files, and parameters in order.
MODELS = {
    "SIMPLE_PINHOLE": (0, "f cx cy"),
    "PINHOLE": (1, "fx fy cx cy"),
    "SIMPLE_RADIAL": (2, "f cx cy k1"),
    "RADIAL": (3, "f cx cy k1 k2"),
    "OPENCV": (4, "fx fy cx cy k1 k2 p1 p2"),
}
# Names of all camera models by number, so that messages can name unsupported ones.
_MODEL_NAMES = {number: name for name, (number, _) in MODELS.items()} | {
    5: "OPENCV_FISHEYE",
    6: "FULL_OPENCV",
    7: "FOV",
    8: "SIMPLE_RADIAL_FISHEYE",
    9: "RADIAL_FISHEYE",
    10: "THIN_PRISM_FISHEYE",
    11: "RAD_TAN_THIN_PRISM_FISHEYE",
}

# The longest image name in bytes; no file system takes longer ones.
MAX_NAME_BYTES = 4096


@dataclass(frozen=True)
class _Camera:
    """A camera; `intrinsics` are in pixels of the image size `size`, and `distortion` is k1 k2 p1 p2."""

    size: tuple[float, float]
    intrinsics: tuple[float, float, float, float]
    distortion: tuple[float, float, float, float]


@dataclass(frozen=True)
class _Image:
    """A posed image, with the number of its camera."""

    number: int
    camera: int
    name: str
    camera_to_world: np.ndarray


def recognise(path: Path) -> bool:
    """Return whether the folder has this layout."""
    return _model(path) is not None


def read(path: Path, holdout: str | None) -> Capture:
    """Read the folder. Test pictures are every eighth existing image, in natural order of names.

    The model gives neither times nor depth ranges.

    Raises:
        DatasetError: the model is damaged or inconsistent, or has a camera model that is not in MODELS.
        MediaError: an image cannot be read.
    """
    model = _model(path)
    if model is None:
        raise DatasetError(f"{path}: no COLMAP model in sparse/0; export one there")
    cameras_file, images_file = model
    cameras, images = _read_cameras(cameras_file), _read_images(images_file)
    images.sort(key=lambda image: natural_key(image.name))
    found = [(image, find_image(path / "images", images_file, image.name)) for image in images]
    report_missing(images_file, [image.name for image, file in found if file is None], len(found))
    existing = [(image, file) for image, file in found if file is not None]
    default = [k % HOLD_OUT_EVERY == 0 for k in range(len(existing))]
    tests = holdout_flags(path, [str(file.relative_to(path)) for _, file in existing], holdout, default)
    views = [_view(images_file, cameras, *item, is_test) for item, is_test in zip(existing, tests, strict=True)]
    return Capture("COLMAP", tuple(views), None)


def _model(path: Path) -> tuple[Path, Path] | None:
    """Return the files of cameras and images, binary if both forms exist; None without a model."""
    for folder in (path / "sparse" / "0", path / "sparse"):
        for suffix in (".bin", ".txt"):
            files = folder / f"cameras{suffix}", folder / f"images{suffix}"
            if all(file.is_file() for file in files):
                return files
    return None


def _view(images_file: Path, cameras: dict[int, _Camera], image: _Image, file: Path, is_test: bool) -> CapturedView:
    where = f"{images_file} image {image.number}"
    if image.camera not in cameras:
        raise DatasetError(f"{where}: its camera {image.camera} is missing from the model; export the model anew")
    camera = cameras[image.camera]
    return image_view(
        file,
        where=where,
        time=None,
        is_test=is_test,
        declared=camera.size,
        intrinsics=camera.intrinsics,
        distortion=camera.distortion,
        camera_to_world=image.camera_to_world,
        near=math.nan,
        far=math.nan,
    )


def _read_cameras(file: Path) -> dict[int, _Camera]:
    found: dict[int, _Camera] = {}
    with _damage(file):
        for number, model, size, params in _binary_cameras(file) if file.suffix == ".bin" else _text_cameras(file):
            if number in found:
                raise DatasetError(f"{file}: camera {number} is listed twice; export the model anew")
            found[number] = _camera(f"{file} camera {number}", model, size, params)
    return found


def _camera(where: str, model: str, size: tuple[int, int], params: tuple[float, ...]) -> _Camera:
    """Return a camera from COLMAP's parameters, whose pixel coordinates are ours: pixel centres are at + 0.5."""
    names = MODELS[model][1].split()
    if len(params) != len(names):
        raise DatasetError(f"{where}: {len(params)} parameters, but {model} has {len(names)}; export the model anew")
    if not all(map(math.isfinite, params)):
        raise DatasetError(f"{where}: holds NaN or infinity; calibrate it anew")
    value = dict(zip(names, params, strict=True))
    fl_x = value["f"] if "f" in value else value["fx"]
    fl_y = value.get("fy", fl_x)
    if not (fl_x > 0 and fl_y > 0 and min(size) > 0):
        raise DatasetError(
            f"{where}: focal length {fl_x:g} x {fl_y:g} and size {size[0]}x{size[1]} must be positive; "
            "calibrate it anew"
        )
    k1, k2, p1, p2 = (value.get(name, 0.0) for name in ("k1", "k2", "p1", "p2"))
    return _Camera((float(size[0]), float(size[1])), (fl_x, fl_y, value["cx"], value["cy"]), (k1, k2, p1, p2))


def _read_images(file: Path) -> list[_Image]:
    images, numbers, names = [], set(), set()
    with _damage(file):
        for number, pose, camera, name in _binary_images(file) if file.suffix == ".bin" else _text_images(file):
            if number in numbers or name in names:
                raise DatasetError(f"{file}: image {number} ({printable(name)}) is listed twice; export the model anew")
            numbers.add(number)
            names.add(name)
            images.append(_Image(number, camera, name, _camera_to_world(f"{file} image {number}", pose)))
    if not images:
        raise DatasetError(f"{file}: lists no images; export the model that holds the scene")
    return images


def _camera_to_world(where: str, pose: tuple[float, ...]) -> np.ndarray:
    """Return the (4, 4) OpenGL pose of x_camera = R x_world + t (y down, z forward); `pose` is w x y z of R, then t."""
    length = math.hypot(*pose[:4])
    if not (all(map(math.isfinite, pose)) and 0 < length < math.inf):
        raise DatasetError(f"{where}: pose holds NaN, infinity or no rotation; remove the image or calibrate it anew")
    rotation = rotation_of(np.array(pose[:4]) / length)  # normalised first, since large entries would overflow
    camera_to_world = np.eye(4)
    camera_to_world[:3, :3] = rotation.T * [1, -1, -1]
    # A translation that overflows is refused later, with other poses that are not finite.
    with np.errstate(over="ignore", invalid="ignore"):
        camera_to_world[:3, 3] = -rotation.T @ np.array(pose[4:])
    return camera_to_world


def _binary_cameras(file: Path) -> Iterator[tuple[int, str, tuple[int, int], tuple[float, ...]]]:
    with open(file, "rb") as stream:
        for _ in range(_unpack(stream, "<Q")[0]):
            number, model_number, width, height = _unpack(stream, "<IiQQ")
            model = _supported(f"{file} camera {number}", _MODEL_NAMES.get(model_number, f"number {model_number}"))
            yield number, model, (width, height), _unpack(stream, f"<{len(MODELS[model][1].split())}d")


def _text_cameras(file: Path) -> Iterator[tuple[int, str, tuple[int, int], tuple[float, ...]]]:
    with _text(file) as lines:
        for line in _records(lines):
            words = line.split()
            if len(words) < 4:
                raise ValueError(f"a line of {len(words)} words")
            number, model, width, height, *params = words
            _supported(f"{file} camera {int(number)}", model)
            yield int(number), model, (int(width), int(height)), tuple(map(float, params))


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
    """Read two lines per image; the second, its points, may be empty or missing at the end of the file."""
    with _text(file) as lines:
        for line in _records(lines):
            words = line.split(maxsplit=9)
            if len(words) < 10:
                raise ValueError(f"a line of {len(words)} words")
            number, *pose, camera, name = words
            yield int(number), tuple(map(float, pose)), int(camera), name
            lines.readline()


def _supported(where: str, model: str) -> str:
    if model not in MODELS:
        raise DatasetError(
            f"{where}: camera model {printable(model)} is not supported; undistort the images to PINHOLE"
        )
    return model


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
    return os.fsdecode(bytes(name))


def _text(file: Path) -> TextIO:
    return open(file, encoding="utf-8", errors="surrogateescape")


def _records(lines: TextIO) -> Iterator[str]:
    """Yield stripped lines that are neither empty nor comments. The caller may read lines in between."""
    while line := lines.readline():
        if line.strip() and not line.lstrip().startswith("#"):
            yield line.strip()


@contextlib.contextmanager
def _damage(file: Path) -> Iterator[None]:
    """Turn the exceptions raised by a malformed file into a DatasetError."""
    try:
        yield
    except (EOFError, ValueError, OverflowError) as error:
        raise DatasetError(f"{file}: not a COLMAP model ({printable(str(error))}); export or copy it anew") from error
