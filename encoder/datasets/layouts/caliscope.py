"""The layout of Caliscope: a workspace with `camera_array.toml`, and videos in `recordings/NAME/`.

`[cameras.N]` has `size`, `matrix`, `distortions`, `rotation` (a Rodrigues vector, once a matrix), `translation`,
`fisheye` and `ignore`; what has no pose yet lacks some. Videos are called `cam_N.mp4`, by older versions `port_N.mp4`.

Source: `src/caliscope/cameras/camera_array.py` and docs/ in https://github.com/mprib/caliscope
"""

from pathlib import Path
from typing import Any

from kpc.encoder.datasets.capture import Capture, first_names, natural_key, printable
from kpc.encoder.datasets.layouts.calibration import RigCamera, opencv_camera, size_of
from kpc.encoder.datasets.layouts.documents import read_toml
from kpc.encoder.datasets.layouts.rig_media import read_rig
from kpc.encoder.datasets.left_out import media_in
from kpc.format.common.errors import DatasetError
from kpc.format.common.text import notice

# The layout's name in messages.
NAME = "Caliscope"

FILE, RECORDINGS = "camera_array.toml", "recordings"

# Files with the times of a recording's frames.
_TIMES = ("timestamps.csv", "frame_timestamps.csv", "frame_time_history.csv")

_NEEDED = ("matrix", "rotation", "translation")


def recognise(path: Path) -> bool:
    """Return whether the folder has this layout."""
    return (path / FILE).is_file()


def read(path: Path, holdout: str | None) -> Capture:
    """Read the folder; see `read_rig`.

    Raises:
        DatasetError, MediaError: the calibration or a file cannot be used.
    """
    file = path / FILE
    tables = read_toml(file).get("cameras")
    if not (isinstance(tables, dict) and tables and all(isinstance(keys, dict) for keys in tables.values())):
        raise DatasetError(f"{file}: has no cameras; calibrate the rig first")
    posed = {n: keys for n, keys in tables.items() if not keys.get("ignore") and all(k in keys for k in _NEEDED)}
    if not posed:
        raise DatasetError(f"{file}: no camera has a pose; calibrate the rig first")
    if left := [name for name in tables if name not in posed]:
        notice(f"{file}: cameras without a pose, or to be ignored, are left out: {first_names(left)}")
    folder = _recording(path)
    if times := next((name for name in _TIMES if (path / folder / name).is_file()), None):
        notice(f"{path / folder / times}: not read; videos are aligned by their own time stamps")
    cameras = [toml_camera(name, f"{file} camera {printable(name)}", keys) for name, keys in posed.items()]
    return read_rig(path, NAME, file, cameras, (folder, "videos", "images", "."), holdout)


def toml_camera(name: str, where: str, keys: dict[str, Any]) -> RigCamera:
    """Return the camera of a table, which is the same in Anipose's files."""
    is_fisheye = keys.get("fisheye", False)
    if not isinstance(is_fisheye, bool):
        raise DatasetError(f"{where}: fisheye is neither true nor false; correct it")
    own = {
        "K": keys.get("matrix"),
        "dist": keys.get("distortions"),
        "R": keys.get("rotation"),
        "t": keys.get("translation"),
    }
    return opencv_camera(name, where, own, size_of(where, keys, "size"), is_fisheye=is_fisheye)


def _recording(path: Path) -> str:
    """Return the folder of the only recording, relative to the workspace.

    Raises:
        DatasetError: there are several.
    """
    folders = (
        sorted((path / RECORDINGS).iterdir(), key=lambda f: natural_key(f.name)) if (path / RECORDINGS).is_dir() else []
    )
    takes = [folder.name for folder in folders if folder.is_dir() and media_in(folder)]
    if len(takes) > 1:
        raise DatasetError(
            f"{path}: has {len(takes)} recordings ({first_names(takes)}); copy {FILE} into the folder of one, and give "
            "that"
        )
    return f"{RECORDINGS}/{takes[0]}" if takes else RECORDINGS
