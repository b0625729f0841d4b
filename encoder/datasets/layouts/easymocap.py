"""The layout of EasyMocap and EasyVolcap: `intri.yml` and `extri.yml` beside `videos/` or `images/`.

ZJU-MoCap, DNA-Rendering, ENeRF-Outdoor and SelfCap are distributed so or converted to it. The documents are OpenCV's:
for each of the cameras that `names` lists, `K_NAME`, `dist_NAME` or `D_NAME`, `H_NAME` and `W_NAME`; `Rot_NAME` (a
matrix) or `R_NAME` (a Rodrigues vector), and `T_NAME`. Masks show the foreground.

Sources: `easymocap/mytools/camera_utils.py` in https://github.com/zju3dv/EasyMocap, and
`easyvolcap/utils/easy_utils.py` and `docs/misc/custom_dataset.md` in https://github.com/zju3dv/EasyVolcap
"""

from pathlib import Path
from typing import Any

import numpy as np

from kpc.encoder.datasets.capture import Capture, first_names, printable
from kpc.encoder.datasets.layouts.calibration import RigCamera, numbers, opencv_camera, rotation, size_of
from kpc.encoder.datasets.layouts.documents import read_yaml
from kpc.encoder.datasets.layouts.rig_media import read_rig
from kpc.format.common.errors import DatasetError
from kpc.format.common.text import notice

# The layout's name in messages.
NAME = "EasyMocap"

# Folders of calibrations: those that EasyVolcap has refined lie in `optimized`.
FOLDERS = (".", "optimized")

# Folders of masks, of which the names of some tell by which program they were made.
FOREGROUNDS = ("masks", "mask", "mask_cihp", "fmasks", "bgmtv2", "rvm")

_READ = ("K", "dist", "D", "H", "W", "R", "Rot", "T")

# How much the two rotations of a camera may differ.
_SAME_ROTATION = 1e-3


def recognise(path: Path) -> bool:
    """Return whether the folder has this layout."""
    return bool(_calibrations(path))


def read(path: Path, holdout: str | None) -> Capture:
    """Read the folder; see `read_rig`.

    Raises:
        DatasetError, MediaError: the calibration or a file cannot be used.
    """
    chosen, *others = _calibrations(path)
    if others:
        notice(f"{path}: {chosen / 'intri.yml'} is read; {others[0] / 'intri.yml'} is not")
    file = chosen / "intri.yml"
    return read_rig(path, NAME, file, _cameras(chosen), ("videos", "images", "."), holdout, FOREGROUNDS)


def _calibrations(path: Path) -> list[Path]:
    folders = [path / folder for folder in FOLDERS]
    return [f for f in folders if (f / "intri.yml").is_file() and (f / "extri.yml").is_file()]


def _cameras(folder: Path) -> list[RigCamera]:
    intri_file, extri_file = folder / "intri.yml", folder / "extri.yml"
    intri, extri = read_yaml(intri_file), read_yaml(extri_file)
    for file, document in ((intri_file, intri), (extri_file, extri)):
        if not isinstance(document, dict):
            raise DatasetError(f"{file}: holds no cameras; export it anew")
    names = intri.get("names") or [key[2:] for key in intri if key.startswith("K_")]
    if not (isinstance(names, list) and names and all(isinstance(name, str) and name for name in names)):
        raise DatasetError(f"{intri_file}: names no cameras; export it anew")
    if len(set(names)) < len(names):
        raise DatasetError(f"{intri_file}: names a camera twice; export it anew")
    _report_keys(folder, names, intri, extri)
    return [_camera(f"{folder} camera {printable(name)}", name, intri, extri) for name in names]


def _camera(where: str, name: str, intri: dict[str, Any], extri: dict[str, Any]) -> RigCamera:
    both = {key: (extri if key in ("R", "Rot", "T") else intri).get(f"{key}_{name}") for key in _READ}
    if both["Rot"] is not None and both["R"] is not None:
        apart = np.abs(rotation(where, both, "Rot") - rotation(where, both, "R")).max()
        if not apart <= _SAME_ROTATION:
            raise DatasetError(f"{where}: R and Rot are different rotations; export it anew")
    if intri.get(f"rdist_{name}") is not None and numbers(where, intri, f"rdist_{name}", range(1, 65)).any():
        raise DatasetError(f"{where}: rdist, a distortion of another kind, is not supported; undistort the images")
    keys = {
        "K": both["K"],
        "dist": both["dist"] if both["D"] is None else both["D"],
        "R": both["R"] if both["Rot"] is None else both["Rot"],
        "t": both["T"],
    }
    return opencv_camera(name, where, keys, size_of(where, both, "W", "H"))


def _report_keys(folder: Path, names: list[str], intri: dict[str, Any], extri: dict[str, Any]) -> None:
    """Name in one line what else the documents say: bounds, times and colours of cameras."""
    known = {"names", *(f"{key}_{name}" for key in (*_READ, "rdist") for name in names)}
    others = [key for key in (*intri, *extri) if key not in known]
    kinds = dict.fromkeys(
        next((key.removesuffix(f"_{n}") for n in names if key.endswith(f"_{n}")), key) for key in others
    )
    if kinds:
        notice(f"{folder}: keys of intri.yml and extri.yml without effect: {first_names(list(kinds))}")
