"""`transforms.json` of what was found, in the layout of nerfstudio with clocks."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from kpc.encoder.datasets.layouts.nerfstudio import MADE_BY
from kpc.encoder.datasets.video import read_video
from kpc.encoder.poses.find import Found, depth_range
from kpc.encoder.poses.instants import frame_times
from kpc.encoder.poses.structure import PlacedView
from kpc.format.common import cli
from kpc.format.common.images import write_image
from kpc.format.common.progress import progress

# The folder beside the document that holds the frames of a moving camera.
IMAGES = "images"


def write_document(found: Found, root: Path, file: Path) -> None:
    """Write the document, and beside it the frames of a moving camera as images.

    Args:
        found: cameras and clocks.
        root: the folder that names are relative to, but for the frames of a moving camera.
        file: of the document.
    """
    document: dict[str, Any] = {"camera_model": "OPENCV", "made_by": MADE_BY, "kind": found.kind}
    if found.is_metric:
        document["unit"] = "metre"
    if found.kind == "moving camera":
        document |= _moving_camera(found, root, file.parent)
    else:
        document["frames"] = [
            frame for number in sorted(found.structure.views) for frame in _frames_of(found, number, root)
        ]
    with cli.atomic_write(file) as aside:
        Path(aside).write_text(json.dumps(document, indent=1) + "\n")


def _frames_of(found: Found, number: int, root: Path) -> list[dict[str, Any]]:
    """Return the frames of a camera that stands still: its video, or each of its images."""
    footage, clock = found.footage[number], found.clocks[number]
    camera = _camera(found, number)
    if footage.video is None:
        times = frame_times(footage) / max(len(footage.files) - 1, 1)
        return [
            {"file_path": _relative(image, root)} | ({"time": float(time)} if len(footage.files) > 1 else {}) | camera
            for image, time in zip(footage.files, times, strict=True)
        ]
    clocks = {"time_offset": clock.offset_s} if clock.offset_s else {}
    if clock.rate != 1:
        clocks["time_rate"] = clock.rate
    size = {"w": footage.video.width, "h": footage.video.height}
    return [{"file_path": _relative(footage.files[0], root)} | clocks | size | camera]


def _moving_camera(found: Found, root: Path, folder: Path) -> dict[str, Any]:
    """Return the frames of a moving camera: its images, or those of its video, which are written into a folder."""
    footage, views = found.footage[0], sorted(found.structure.views)
    times = frame_times(footage) - frame_times(footage)[0]
    files = {number: _relative(footage.files[number], root) for number in views} if footage.video is None else {}
    fps = {} if footage.video is None else {"fps": float(footage.video.fps)}
    if footage.video is not None:
        (folder / IMAGES).mkdir(parents=True, exist_ok=True)
        pictures = enumerate(read_video(footage.files[0], footage.video))
        for number, picture in progress(pictures, "writing frames", len(times), "frame"):
            if number in found.structure.views:
                files[number] = f"{IMAGES}/{found.view_names[number]}.png"
                write_image(folder / files[number], picture)
    last = max(float(times[-1]), 1e-9)
    frames = [{"file_path": files[n], "time": float(times[n]) / last} | _camera(found, n) for n in views]
    return fps | {"frames": frames}


def _relative(file: Path, root: Path) -> str:
    return file.relative_to(root).as_posix()


def _camera(found: Found, number: int) -> dict[str, Any]:
    view: PlacedView = found.structure.views[number]
    lens = dict(
        zip(("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2"), (*view.intrinsics, *view.distortion), strict=True)
    )
    # Photographs show a surrounding without bounds, which near and far would cut off at the points that were found.
    depths = None if found.kind == "photographs" else depth_range(found.structure, number, view)
    near_far = {} if depths is None else {"near": depths[0], "far": depths[1]}
    return {name: float(value) for name, value in (lens | near_far).items()} | {
        "transform_matrix": np.round(view.camera_to_world, 9).tolist()
    }
