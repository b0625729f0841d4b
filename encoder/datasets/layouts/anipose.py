"""The layout of Anipose: `calibration.toml` beside videos or in `calibration/`, which Pose2Sim writes as `Calib*.toml`.

Each table but `metadata` is a camera: `name`, `size`, `matrix`, `distortions`, `rotation` (a Rodrigues vector),
`translation` and `fisheye`. Names of videos end in the camera's, after a prefix such as `cam`: `walk-camA.mp4`.

Sources: `aniposelib/cameras.py` in https://github.com/lambdaloop/aniposelib, https://anipose.readthedocs.io
"""

from pathlib import Path
from typing import Any

from kpc.encoder.datasets.capture import Capture, natural_key, printable
from kpc.encoder.datasets.layouts.calibration import RigCamera, first_calibration
from kpc.encoder.datasets.layouts.caliscope import toml_camera
from kpc.encoder.datasets.layouts.documents import read_toml
from kpc.encoder.datasets.layouts.rig_media import read_rig
from kpc.format.common.errors import DatasetError

# The layout's name in messages.
NAME = "Anipose"

# A part of the names of calibrations, in any case, and the folders in which they lie.
PART, FOLDERS = "calib", (".", "calibration")


def recognise(path: Path) -> bool:
    """Return whether the folder has this layout."""
    return bool(_files(path))


def read(path: Path, holdout: str | None) -> Capture:
    """Read the folder; see `read_rig`.

    Raises:
        DatasetError, MediaError: the calibration or a file cannot be used.
    """
    file = first_calibration(path, _files(path))
    tables = {key: table for key, table in read_toml(file).items() if key != "metadata" and isinstance(table, dict)}
    if not tables:
        raise DatasetError(f"{file}: has no cameras; calibrate the rig first")
    cameras: list[RigCamera] = []
    for key, table in tables.items():
        where, name = f"{file} {printable(key)}", table.get("name", key)
        if not isinstance(name, str) or not name or name in [camera.name for camera in cameras]:
            raise DatasetError(f"{where}: has no name of its own; calibrate anew")
        _refuse_offset(where, table)
        cameras.append(toml_camera(name, where, table))
    return read_rig(path, NAME, file, cameras, ("videos", "videos-raw", "images", "."), holdout)


def _refuse_offset(where: str, table: dict[str, Any]) -> None:
    """Refuse a crop whose size is not that of the calibration."""
    if table.get("offset") not in (None, [0, 0], [0.0, 0.0]):
        raise DatasetError(f"{where}: offset of a crop is not supported; crop the calibration with the videos")


def _files(path: Path) -> list[Path]:
    found = [f for folder in FOLDERS for f in (path / folder).glob("*.toml") if f.is_file()]
    return sorted((f for f in found if PART in f.name.lower()), key=lambda f: natural_key(f.name))
