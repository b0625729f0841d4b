"""A rig calibrated with OpenCV: K, dist, R and t of each camera in YAML or JSON, under one of their usual names.

One document holds all cameras, by name or in a list, at its top or in `cameras`; or each camera has a document of its
own, which is called after it. They lie in the folder itself or in `calibration/`, `calib/` or `cameras/`. R and t lead
from the world to the camera: x_camera = R x_world + t.

Source: https://docs.opencv.org/4.x/d9/d0c/group__calib3d.html
"""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from kpc.encoder.datasets.capture import Capture, natural_key, printable
from kpc.encoder.datasets.layouts import panoptic
from kpc.encoder.datasets.layouts.calibration import RigCamera, opencv_camera, rotation, size_of
from kpc.encoder.datasets.layouts.documents import MAX_BYTES, read_json, read_yaml
from kpc.encoder.datasets.layouts.rig_media import read_rig
from kpc.format.common.errors import DatasetError
from kpc.format.common.text import open_text

# The layout's name in messages.
NAME = "OpenCV"

FOLDERS = (".", "calibration", "calib", "cameras")
SUFFIXES = (".json", ".yml", ".yaml")

# The most documents that are looked at.
_MOST_FILES = 1000

# Names of values, without regard to case and underscores.
NAMES = {
    "K": ("k", "cameramatrix", "intrinsicmatrix", "intrinsics", "intrinsic", "matrix", "mtx"),
    "dist": ("dist", "d", "distcoeffs", "distcoef", "distcoefs", "distortioncoefficients", "distortion", "distortions"),
    "R": ("r", "rot", "rotation", "rotationmatrix", "rvec"),
    "t": ("t", "translation", "translationvector", "tvec"),
    "size": ("imagesize", "size", "resolution", "imgsize"),
    "width": ("width", "imagewidth", "w"),
    "height": ("height", "imageheight", "h"),
    "fisheye": ("fisheye", "isfisheye"),
}

# Keys in quotes or before a colon: a document without those of K, R and t is not parsed.
_KEYS = re.compile(r"[\"']?(\w+)[\"']?\s*:")

# Documents of other layouts.
_OTHERS = re.compile(r"transforms.*\.json|(intri|extri)\.yml", re.IGNORECASE)

_SAME_ROTATION = 1e-4  # how much two forms of a rotation may differ


def recognise(path: Path) -> bool:
    """Return whether the folder has this layout."""
    return next(_files(path), None) is not None


def read(path: Path, holdout: str | None) -> Capture:
    """Read the folder; see `read_rig`.

    Raises:
        DatasetError, MediaError: a calibration or a file cannot be used.
    """
    files = list(_files(path))
    cameras: dict[str, RigCamera] = {}
    for file in files:
        for name, where, keys in _cameras(file):
            if name in cameras:
                raise DatasetError(f"{where}: camera {printable(name)} is also in {cameras[name].where}; remove one")
            cameras[name] = _camera(name, where, keys)
    return read_rig(path, NAME, files[0], list(cameras.values()), ("videos", "images", "."), holdout)


def _files(path: Path) -> Iterator[Path]:
    """Yield the documents that speak of K, R and t."""
    looked_at = 0
    for folder in FOLDERS:
        if not (path / folder).is_dir():
            continue
        for file in sorted((path / folder).iterdir(), key=lambda file: natural_key(file.name)):
            if file.suffix.lower() not in SUFFIXES or _OTHERS.fullmatch(file.name) or not file.is_file():
                continue
            looked_at += 1
            if looked_at > _MOST_FILES or file.stat().st_size > MAX_BYTES or panoptic.is_calibration(file):
                continue
            with open_text(file) as text:
                keys = {_plain(key) for key in _KEYS.findall(text.read())}
            if all(keys.intersection(NAMES[value]) for value in ("K", "R", "t")):
                yield file


def _cameras(file: Path) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Yield name, place for messages, and values of each camera of a document."""
    document = read_json(file, MAX_BYTES) if file.suffix.lower() == ".json" else read_yaml(file)
    if isinstance(document, dict) and not _is_camera(document) and "cameras" in document:
        document = document["cameras"]
    if isinstance(document, dict) and _is_camera(document):
        yield file.stem, str(file), document
        return
    items = (
        document.items() if isinstance(document, dict) else enumerate(document if isinstance(document, list) else ())
    )
    found = False
    for key, keys in items:
        if isinstance(keys, dict) and _is_camera(keys):
            name = next((keys[k] for k in ("name", "id", "camera") if k in keys), key)
            yield str(name), f"{file} camera {printable(str(name))}", keys
            found = True
        elif isinstance(document, list):
            raise DatasetError(f"{file} camera {key}: lacks K, R or t; calibrate it or remove it")
    if not found:
        raise DatasetError(f"{file}: no camera has all of K, R and t; calibrate the rig anew")


def _is_camera(keys: dict[str, Any]) -> bool:
    present = {_plain(key) for key in keys}
    return all(present.intersection(NAMES[value]) for value in ("K", "R", "t"))


def _camera(name: str, where: str, keys: dict[str, Any]) -> RigCamera:
    values: dict[str, list[Any]] = {
        value: [keys[key] for key in keys if _plain(key) in names and keys[key] is not None]
        for value, names in NAMES.items()
    }
    if len(values["R"]) > 1:  # often both a matrix and a Rodrigues vector
        forms = [rotation(where, {"R": form}, "R") for form in values["R"]]
        if not all(np.abs(form - forms[0]).max() <= _SAME_ROTATION for form in forms):
            raise DatasetError(f"{where}: has two rotations that differ; remove one")
        values["R"] = values["R"][:1]
    if twice := [value for value, some in values.items() if len(some) > 1]:
        raise DatasetError(f"{where}: has two values of {twice[0]} under different names; remove one")
    one = {value: some[0] for value, some in values.items() if some}
    size = size_of(where, one, "size") if "size" in one else size_of(where, one, "width", "height")
    fisheye = str(one.get("fisheye", "false")).lower()
    if fisheye not in ("0", "1", "false", "true"):
        raise DatasetError(f"{where}: fisheye is neither true nor false; correct it")
    return opencv_camera(name, where, one, size, is_fisheye=fisheye in ("1", "true"))


def _plain(key: str) -> str:
    return key.replace("_", "").lower()
