"""Camera files of other programs, rewritten as the document that `kpc.format.scene.cameras.load_views` reads.

* nerfstudio's `transforms.json`: its frames name their image `file_path`.
* nerfstudio's `camera_path.json`, which its viewer exports: a list `camera_path` of poses, 16 numbers each row by row,
  with the vertical field of view `fov` in degrees; `render_width`, `render_height`, `seconds` and `fps` for all.

Poses are taken as they are. nerfstudio moves and scales a scene before it trains; a path that its viewer exports fits
only scenes with the same coordinates.
"""

import math
from collections.abc import Mapping
from typing import Any

from kpc.format.common.errors import DatasetError
from kpc.format.scene.camera_checks import number_of


def rewritten(where: str, document: Any) -> Mapping[str, Any]:
    """Return a document in the form of `cameras.json`; its frames are objects, but what they hold is not checked.

    Args:
        where: the file, which begins messages.
        document: what the file holds.

    Raises:
        DatasetError: the document has no list of frames, the cameras of a `camera_path` are not perspective ones, or
            a value is missing or malformed.
    """
    key = "frames" if not isinstance(document, dict) or "frames" in document else "camera_path"
    frames = document.get(key) if isinstance(document, dict) else None
    if not (isinstance(frames, list) and all(isinstance(frame, dict) for frame in frames)):
        raise DatasetError(f"{where}: not an object with a list of frames; correct the file")
    if key == "camera_path":
        return _of_camera_path(where, document)
    named = [{"file": frame["file_path"], **frame} if "file_path" in frame else frame for frame in frames]
    return {**document, "frames": named}


def _of_camera_path(where: str, document: Mapping[str, Any]) -> Mapping[str, Any]:
    """Rewrite a `camera_path.json`.

    Its poses are those of a film: frame k is at k / fps where `seconds` times `fps` is their number, else they spread
    over `seconds`. A pose may have a `render_time` in [0, 1]; else the times spread over the clip.
    """
    kind = document.get("camera_type", "perspective")
    if kind != "perspective":
        raise DatasetError(f"{where}: camera_type {str(kind)[:40]!r} is no pinhole camera; export a perspective path")
    poses = document["camera_path"]
    height, count = number_of(where, document, "render_height"), len(poses)
    last = max(count - 1, 1)
    gap_s = None
    if document.get("seconds") is not None:
        seconds = number_of(where, document, "seconds")
        rate = None if document.get("fps") is None else number_of(where, document, "fps")
        is_film = rate is not None and round(seconds * rate) == count
        gap_s = seconds / (count if is_film else last)
    frames = []
    for number, pose in enumerate(poses):
        fov = number_of(f"{where} pose {number}", pose, "fov")
        if not 1e-6 < fov < 180:
            raise DatasetError(f"{where} pose {number}: fov of {fov:g} degrees lies outside (0, 180); correct it")
        rows = pose.get("camera_to_world")
        if isinstance(rows, list) and len(rows) in (12, 16):
            rows = [rows[4 * row : 4 * row + 4] for row in range(len(rows) // 4)]
        frames.append(
            {
                "fl_x": height / 2 / math.tan(math.radians(fov) / 2),
                "transform_matrix": rows,
                "time": pose.get("render_time", number / last),
                "at": None if gap_s is None else number * gap_s,
            }
        )
    return {"w": document.get("render_width"), "h": height, "frames": frames}
