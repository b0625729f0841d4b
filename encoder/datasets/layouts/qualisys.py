"""The layout of Qualisys Track Manager: a calibration `*.qca.txt`, which is XML, beside videos with serial numbers.

A `camera` has `transform`: its centre x y z in millimetres and the rotation r11 to r33, whose rows are the camera's
axes right, up and backwards; `intrinsic`: focal lengths and centre in 1/64 of a pixel, counted from the edge of the
sensor (whose last is 64 times its size, less 1), and OpenCV's coefficients of distortion; and `fov_video`: the first
and last columns and rows of the sensor that are filmed.

Sources: `Pose2Sim/Utilities/calib_qca_to_toml.py` in https://github.com/perfanalytics/pose2sim, which reads them;
`CMarkupDeserializer.cpp` in https://github.com/qualisys/qualisys_cpp_sdk
"""

from collections.abc import Mapping
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from kpc.encoder.datasets.capture import Capture, first_names, natural_key, printable
from kpc.encoder.datasets.layouts.calibration import PIXEL_CENTRE, RigCamera, first_calibration, numbers, opencv_camera
from kpc.encoder.datasets.layouts.documents import read_xml
from kpc.encoder.datasets.layouts.rig_media import read_rig
from kpc.format.common.errors import DatasetError
from kpc.format.common.text import notice

# The layout's name in messages.
NAME = "Qualisys"

SUBPIXEL = 64  # parts of a pixel in which intrinsics are given
MILLIMETRE = 0.001  # the unit of translations

_DISTORTION = (
    *("radialDistortion1", "radialDistortion2", "tangentalDistortion1", "tangentalDistortion2", "radialDistortion3"),
)


def recognise(path: Path) -> bool:
    """Return whether the folder has this layout."""
    return bool(_files(path))


def read(path: Path, holdout: str | None) -> Capture:
    """Read the folder; see `read_rig`. Cameras that saw nothing in the calibration are left out.

    Raises:
        DatasetError, MediaError: the calibration or a file cannot be used.
    """
    file = first_calibration(path, _files(path))
    elements = list(read_xml(file).iter("camera"))
    if not elements:
        raise DatasetError(f"{file}: lists no cameras; export it from Qualisys Track Manager anew")
    cameras: list[RigCamera] = []
    turned = []
    for number, element in enumerate(elements):
        name = element.get("serial", "")
        where = f"{file} camera {printable(name or str(number))}"
        if element.get("calibrated", "true").lower() == "false":
            notice(f"{where}: is not calibrated and left out")
            continue
        if not name or name in [camera.name for camera in cameras]:
            raise DatasetError(f"{where}: has no serial number of its own; export the file anew")
        if element.get("viewrotation", "0") != "0":
            turned.append(name)
        cameras.append(_camera(name, where, element))
    if turned:
        names = first_names(turned)
        notice(f"{file}: videos are taken to be as the sensor filmed them, not turned for viewing: {names}")
    return read_rig(path, NAME, file, cameras, ("videos", "images", "."), holdout)


def _camera(name: str, where: str, element: Element) -> RigCamera:
    transform, intrinsic = (_attributes(where, element, tag) for tag in ("transform", "intrinsic"))
    rotation = np.array([_number(where, transform, f"r{i}{j}") for i in (1, 2, 3) for j in (1, 2, 3)]).reshape(3, 3)
    rotation = rotation * [[1], [-1], [-1]]  # to OpenCV's camera: y down, z forward
    centre = np.array([_number(where, transform, axis) for axis in "xyz"])
    left, top, right, bottom = _filmed(where, element, intrinsic)
    fx, fy = (_number(where, intrinsic, f"focalLength{axis}") / SUBPIXEL for axis in "UV")
    cx, cy = (_number(where, intrinsic, f"centerPoint{axis}") / SUBPIXEL - PIXEL_CENTRE for axis in "UV")
    keys = {
        "K": [[fx, 0, cx - left], [0, fy, cy - top], [0, 0, 1]],
        "dist": [_number(where, intrinsic, key) for key in _DISTORTION],
        "R": rotation.tolist(),
        "t": (-rotation @ centre).tolist(),
    }
    if abs(_number(where, intrinsic, "skew", 0.0)) > 0:
        raise DatasetError(f"{where}: skew is not supported; undistort the videos")
    return opencv_camera(name, where, keys, (right - left + 1, bottom - top + 1), unit_m=MILLIMETRE)


def _filmed(where: str, element: Element, intrinsic: Mapping[str, str]) -> tuple[float, float, float, float]:
    """Return the first and last columns and rows of the sensor that are filmed: left, top, right, bottom."""
    if element.find("fov_video") is None:
        last = (_number(where, intrinsic, f"sensorMax{axis}") for axis in "UV")
        right, bottom = ((value + 1) / SUBPIXEL - 1 for value in last)
        return 0.0, 0.0, right, bottom
    window = _attributes(where, element, "fov_video")
    left, top, right, bottom = (_number(where, window, side) for side in ("left", "top", "right", "bottom"))
    return left, top, right, bottom


def _attributes(where: str, element: Element, tag: str) -> dict[str, str]:
    found = element.find(tag)
    if found is None:
        raise DatasetError(f"{where}: has no {tag}; export the file anew")
    return dict(found.attrib)


def _number(where: str, attributes: Mapping[str, str], key: str, default: float | None = None) -> float:
    if default is not None and key not in attributes:
        return default
    return float(numbers(where, attributes, key, (1,))[0])


def _files(path: Path) -> list[Path]:
    found = [f for folder in (path, path / "calibration") if folder.is_dir() for f in folder.iterdir() if f.is_file()]
    return sorted((f for f in found if f.name.lower().endswith(".qca.txt")), key=lambda f: natural_key(f.name))
