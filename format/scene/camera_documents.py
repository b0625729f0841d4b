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


def rewritten(document: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return a document in the form of `cameras.json`; one that has this form already is returned unchanged.

    Raises:
        DatasetError: the cameras of a `camera_path` are not perspective ones, or a value is out of range.
        KeyError, TypeError, ValueError: a key is missing or malformed.
    """
    if "camera_path" in document and "frames" not in document:
        return _of_camera_path(document)
    frames = [{"file": frame["file_path"], **frame} if "file_path" in frame else frame for frame in document["frames"]]
    return {**document, "frames": frames}


def _of_camera_path(document: Mapping[str, Any]) -> Mapping[str, Any]:
    """Rewrite a `camera_path.json`.

    Its poses are those of a film: frame k is at k / fps where `seconds` times `fps` is their number, else they spread
    over `seconds`. A pose may have a `render_time` in [0, 1]; else the times spread over the clip.
    """
    kind = document.get("camera_type", "perspective")
    if kind != "perspective":
        raise DatasetError(f"camera_type {str(kind)[:40]!r} is no pinhole camera; export a perspective path")
    poses = document["camera_path"]
    width, height, count = int(document["render_width"]), int(document["render_height"]), len(poses)
    last = max(count - 1, 1)
    gap_s = None
    if document.get("seconds") is not None:
        seconds = float(document["seconds"])
        is_film = document.get("fps") is not None and round(seconds * float(document["fps"])) == count
        gap_s = seconds / (count if is_film else last)
    frames = []
    for number, pose in enumerate(poses):
        fov = float(pose["fov"])
        if not 0 < fov < 180:
            raise DatasetError(f"pose {number}: fov of {fov:g} degrees lies outside (0, 180)")
        numbers = pose["camera_to_world"]
        rows = numbers if len(numbers) == 4 else [numbers[4 * row : 4 * row + 4] for row in range(len(numbers) // 4)]
        frames.append(
            {
                "fl_x": height / 2 / math.tan(math.radians(fov) / 2),
                "transform_matrix": rows,
                "time": pose.get("render_time", number / last),
                "at": None if gap_s is None else number * gap_s,
            }
        )
    return {"w": width, "h": height, "frames": frames}
