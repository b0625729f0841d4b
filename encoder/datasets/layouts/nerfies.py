"""The layout of Nerfies, HyperNeRF and DyCheck: `dataset.json`, `camera/ID.json` and images in `rgb/Nx/`.

`dataset.json` lists `train_ids` and `val_ids`, `metadata.json` has the instant of each image (`warp_id`), `scene.json`
the `scale` and `center` of the scene, and `near` and `far` after that scaling; `extra.json` of DyCheck has `fps`. A
camera has `orientation` (world to camera, y down and z forward), `position`, `focal_length`, `pixel_aspect_ratio`,
`principal_point` (the centre of the first pixel is at 0.5), `skew`, `radial_distortion`, `tangential_distortion` (also
`tangential`) and `image_size`, for images in `rgb/1x`; those in `rgb/4x` are a quarter as large.

Sources: README.md and `nerfies/camera.py` in https://github.com/google/nerfies, `docs/DATASETS.md` in
https://github.com/KAIR-BAIR/dycheck
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from kpc.encoder.datasets.capture import (
    Capture,
    CapturedView,
    Lens,
    find_image,
    first_names,
    holdout_flags,
    image_view,
    natural_key,
    opengl_pose,
    printable,
    report_missing,
)
from kpc.encoder.datasets.layouts.calibration import numbers, rotation, size_of
from kpc.encoder.datasets.layouts.documents import MAX_BYTES, read_json
from kpc.encoder.datasets.layouts.transforms import frame_rate
from kpc.encoder.datasets.left_out import media_in
from kpc.format.common.errors import DatasetError
from kpc.format.common.text import agreeing, counted, notice
from kpc.format.scene.camera_checks import number_of

# The layout's name in messages.
NAME = "Nerfies"

# Keys of an image's instant in metadata.json.
_TIMES = ("warp_id", "time_id")

# Documents that list every image; a hundred thousand of them take a tenth of it.
_MOST_BYTES = 64 << 20


@dataclass(frozen=True)
class Scene:
    """How a world is scaled: (point - centre) * scale; near and far, NaN if unknown, hold after it."""

    scale: float = 1.0
    centre: np.ndarray | None = None
    near: float = math.nan
    far: float = math.nan


def recognise(path: Path) -> bool:
    """Return whether the folder has this layout."""
    return (path / "dataset.json").is_file() and (path / "camera").is_dir() and (path / "rgb").is_dir()


def read(path: Path, holdout: str | None) -> Capture:
    """Read the folder, of several scales the largest images. Test pictures are what `val_ids` lists.

    With `holdout`, the lists are ignored, and all other pictures are trained on.

    Raises:
        DatasetError, MediaError: a document or an image cannot be used.
    """
    file = path / "dataset.json"
    train, val = _ids(file)
    folder = _images(path)
    found = {name: find_image(folder, file, name) for name in sorted({*train, *val}, key=natural_key)}
    report_missing(file, folder, [name for name, image in found.items() if image is None], len(found))
    images = {name: image for name, image in found.items() if image is not None}
    times = _instants(path / "metadata.json", list(images))
    scene = _scene(path / "scene.json")
    if both := [name for name in images if name in val and name in train]:
        notice(f"{file}: {len(both)} ids are in both lists and held out: {first_names(both)}")
    tests = holdout_flags(path, [f"{name}.png" for name in images], holdout, [name in val for name in images])
    views = tuple(
        _view(path / "camera" / f"{name}.json", image, scene, times.get(name), is_test)
        for (name, image), is_test in zip(images.items(), tests, strict=True)
    )
    extra = path / "extra.json"
    fps = frame_rate(extra, _object(extra)) if extra.is_file() else None
    return Capture(NAME, views, fps, tuple(media_in(folder)))


def _object(file: Path) -> dict[str, Any]:
    document = read_json(file, _MOST_BYTES)
    if not isinstance(document, dict):
        raise DatasetError(f"{file}: is no JSON object; copy it anew")
    return document


def _ids(file: Path) -> tuple[set[str], set[str]]:
    """Return the ids of training and of validation, and name those in neither list."""
    document = _object(file)
    listed = {key: document.get(key, []) for key in ("ids", "train_ids", "val_ids")}
    for key, ids in listed.items():
        if not isinstance(ids, list) or not all(isinstance(i, str | int) and not isinstance(i, bool) for i in ids):
            raise DatasetError(f"{file}: {key} is not a list of ids; copy it anew")
        if wrong := next((str(i) for i in ids if "/" in str(i) or "\\" in str(i) or str(i).startswith(".")), None):
            raise DatasetError(f"{file}: the id {printable(wrong)!r} leads out of the folder; rename it")
    every, train, val = ({str(i) for i in ids} for ids in listed.values())
    if not train | val:
        raise DatasetError(f"{file}: train_ids and val_ids list nothing; copy it anew")
    if left := sorted(every - train - val, key=natural_key):
        ids = f"{counted(len(left), 'id')} {agreeing(len(left), 'is', 'are')}"
        notice(f"{file}: {ids} in neither train_ids nor val_ids: {first_names(left)}")
    return train, val


def _images(path: Path) -> Path:
    """Return the folder of the largest images, and name the others."""
    folders = {}
    for folder in (path / "rgb").iterdir():
        digits = folder.name.removesuffix("x")
        if folder.is_dir() and digits != folder.name and digits.isdecimal() and len(digits) < 4 and media_in(folder):
            folders[int(digits)] = folder
    if not folders:
        raise DatasetError(f"{path / 'rgb'}: has no folder of images such as 1x or 4x; copy it anew")
    first, *others = (folders[n] for n in sorted(folders))
    if others:
        names = first_names([folder.name for folder in others])
        notice(f"{path / 'rgb'}: the images in {first.name} are read; smaller ones are in {names}")
    return first


def _instants(file: Path, names: list[str]) -> dict[str, float]:
    """Return the time of each image in [0, 1]; nothing if all are of one instant, or the file is missing."""
    if not file.is_file():
        return {}
    document, instants = _object(file), {}
    for name in names:
        where, keys = f"{file} {printable(name)}", document.get(name)
        keys = keys if isinstance(keys, dict) else {}
        key = next((key for key in _TIMES if key in keys), None)
        if key is None:
            raise DatasetError(f"{where}: has no warp_id, so its instant is unknown; add it or remove the file")
        instants[name] = number_of(where, keys, key)
    first, last = min(instants.values()), max(instants.values())
    return {name: (number - first) / (last - first) for name, number in instants.items()} if last > first else {}


def _scene(file: Path) -> Scene:
    if not file.is_file():
        return Scene()
    document, where = _object(file), str(file)
    scale = number_of(where, document, "scale", 1.0)
    if not scale > 0:
        raise DatasetError(f"{file}: scale {scale:g} is not positive; correct it")
    centre = numbers(where, document, "center", (3,)) if document.get("center") is not None else None
    near, far = (number_of(where, document, key, math.nan) for key in ("near", "far"))
    return Scene(scale, centre, near, far)


def _view(file: Path, image: Path, scene: Scene, time: float | None, is_test: bool) -> CapturedView:
    where = str(file)
    if not file.is_file():
        raise DatasetError(
            f"{file}: the camera of {image.name} is missing; copy it, or remove the id from dataset.json"
        )
    keys = read_json(file, MAX_BYTES)
    if not isinstance(keys, dict):
        raise DatasetError(f"{file}: is no JSON object; copy it anew")
    if number_of(where, keys, "skew", 0.0) != 0:
        raise DatasetError(f"{where}: skew is not supported; undistort the images")
    focal, (cx, cy) = number_of(where, keys, "focal_length"), numbers(where, keys, "principal_point", (2,))
    k1, k2, k3 = numbers(where, keys, "radial_distortion", (3,)) if "radial_distortion" in keys else (0.0, 0.0, 0.0)
    tangential = next((key for key in ("tangential_distortion", "tangential") if key in keys), None)
    p1, p2 = (0.0, 0.0) if tangential is None else numbers(where, keys, tangential, (2,))
    size = size_of(where, keys, "image_size")
    if size is None:
        raise DatasetError(f"{where}: image_size is missing; copy it anew")
    orientation = rotation(where, keys, "orientation")
    position = numbers(where, keys, "position", (3,))
    position = (position - (0 if scene.centre is None else scene.centre)) * scene.scale
    intrinsics = (focal, focal * number_of(where, keys, "pixel_aspect_ratio", 1.0), float(cx), float(cy))
    distortion = (float(k1), float(k2), float(p1), float(p2), float(k3), 0.0, 0.0, 0.0)
    pose = opengl_pose(orientation, -orientation @ position)
    near, far = scene.near, scene.far
    return image_view(
        image, where, Lens(size, intrinsics, distortion), pose, time=time, is_test=is_test, near=near, far=far
    )
