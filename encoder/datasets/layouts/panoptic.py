"""The layout of the CMU Panoptic Studio: `calibration_SEQUENCE.json` beside `hdVideos/` or `hdImgs/`.

`cameras` lists `name`, `type` (hd, vga, kinect-color), `resolution`, `K`, `distCoef`, `R` and `t`, in centimetres. The
cameras of one type are read: those of high definition if there are any.

Source: README.md and `python/panutils.py` in https://github.com/CMU-Perceptual-Computing-Lab/panoptic-toolbox
"""

from pathlib import Path

from kpc.encoder.datasets.capture import Capture, first_names, natural_key, printable
from kpc.encoder.datasets.layouts.calibration import RigCamera, first_calibration, opencv_camera, size_of
from kpc.encoder.datasets.layouts.documents import MAX_BYTES, read_json
from kpc.encoder.datasets.layouts.rig_media import read_rig
from kpc.format.common.errors import DatasetError
from kpc.format.common.text import notice, open_text

# The layout's name in messages.
NAME = "Panoptic Studio"

# The types of cameras, the preferred first, and where their videos and images lie.
FOLDERS = {
    "hd": ("hdVideos", "hdImgs"),
    "vga": ("vgaVideos", "vgaImgs"),
    "kinect-color": ("kinectVideos", "kinectImgs"),
}

# The unit of translations.
CENTIMETRE = 0.01


def recognise(path: Path) -> bool:
    """Return whether the folder has this layout."""
    return bool(_files(path))


def read(path: Path, holdout: str | None) -> Capture:
    """Read the folder; see `read_rig`.

    Raises:
        DatasetError, MediaError: the calibration or a file cannot be used.
    """
    file = first_calibration(path, _files(path))
    document = read_json(file, MAX_BYTES)
    listed = document.get("cameras") if isinstance(document, dict) else None
    if not (isinstance(listed, list) and listed and all(isinstance(keys, dict) for keys in listed)):
        raise DatasetError(f"{file}: lists no cameras; copy it anew")
    types = list(dict.fromkeys(str(keys.get("type", "hd")) for keys in listed))
    kind = next((kind for kind in FOLDERS if kind in types), types[0])
    if len(types) > 1:
        rest = first_names([other for other in types if other != kind])
        notice(f"{file}: the cameras of type {printable(kind)} are read, not those of type {rest}")
    cameras: list[RigCamera] = []
    for number, keys in enumerate(listed):
        where, name = f"{file} camera {number}", keys.get("name")
        if str(keys.get("type", "hd")) != kind:
            continue
        if not (isinstance(name, str) and name) or name in [camera.name for camera in cameras]:
            raise DatasetError(f"{where}: has no name of its own; copy the file anew")
        own = {"K": keys.get("K"), "dist": keys.get("distCoef"), "R": keys.get("R"), "t": keys.get("t")}
        cameras.append(opencv_camera(name, where, own, size_of(where, keys, "resolution"), unit_m=CENTIMETRE))
    folders = (*FOLDERS.get(kind, ()), "videos", "images", ".")
    return read_rig(path, NAME, file, cameras, folders, holdout)


def is_calibration(file: Path) -> bool:
    """Return whether a document is one of the studio's: it lists cameras with `distCoef`."""
    if not (file.match("calibration_*.json") and file.is_file() and file.stat().st_size <= MAX_BYTES):
        return False
    with open_text(file) as text:
        content = text.read()
    return '"distCoef"' in content and '"cameras"' in content


def _files(path: Path) -> list[Path]:
    return sorted(filter(is_calibration, path.glob("calibration_*.json")), key=lambda f: natural_key(f.name))
