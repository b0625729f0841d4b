"""`transforms.json` of what was found, in the layout of nerfstudio with clocks."""

import itertools
import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np

from kpc.encoder.datasets.layouts.nerfstudio import MADE_BY
from kpc.encoder.datasets.video import read_video
from kpc.encoder.poses.clocks import Clock
from kpc.encoder.poses.find import Found, depth_range
from kpc.encoder.poses.footage import FRAMES, Footage, frame_size
from kpc.encoder.poses.instants import frame_times
from kpc.encoder.poses.structure import PlacedView
from kpc.encoder.poses.takes import Take
from kpc.format.common import cli
from kpc.format.common.images import write_image
from kpc.format.common.progress import progress
from kpc.format.common.text import notice


def write_document(found: Found, root: Path, file: Path) -> None:
    """Write the document, and the frames of videos of moving cameras as images into a new folder beside it.

    That is NAME.images, or NAME.images-2 and so on where there is one, which another document may name; it is removed
    if not all can be written.

    Args:
        found: cameras and clocks.
        root: the folder that names are relative to, but for the frames of the videos of moving cameras.
        file: of the document.
    """
    # Other readers look at the document's model alone.
    model = "OPENCV_FISHEYE" if all(view.is_fisheye for view in found.structure.views.values()) else "OPENCV"
    document: dict[str, Any] = {"camera_model": model, "made_by": MADE_BY, "kind": found.kind}
    if found.is_metric:
        document["unit"] = "metre"
    with _new_folder(file.with_suffix(FRAMES)) if found.writes_frames else nullcontext(root) as images:
        if found.take is not None:
            document |= _moving_cameras(found, found.take, root, images)
        else:
            document["frames"] = [
                frame for number in sorted(found.structure.views) for frame in _frames_of(found, number, root)
            ]
        with cli.atomic_write(file) as aside:
            Path(aside).write_text(json.dumps(document, indent=1) + "\n")


@contextmanager
def _new_folder(path: Path) -> Iterator[Path]:
    """Make a folder of a name, or of that name and a number if there is one already; remove it on failure."""
    folder = path
    for number in itertools.count(2):
        try:
            folder.mkdir()
            break
        except FileExistsError:
            folder = path.with_name(f"{path.name}-{number}")
    if folder != path:
        notice(f"{path}: stays, since another document may name its images; new ones are written into {folder.name}")
    try:
        yield folder
    except BaseException:
        shutil.rmtree(folder)
        raise


def _frames_of(found: Found, number: int, root: Path) -> list[dict[str, Any]]:
    """Return the frames of a camera that stands still: its video, or each of its images."""
    footage, clock = found.footage[number], found.clocks[number]
    camera = _camera(found, number, frame_size(footage))
    if footage.video is None:
        times = frame_times(footage) / max(len(footage.files) - 1, 1)
        return [
            _file(image, root) | ({"time": float(time)} if len(footage.files) > 1 else {}) | camera
            for image, time in zip(footage.files, times, strict=True)
        ]
    return [_file(footage.files[0], root) | _clock(clock) | camera]


def _clock(clock: Clock) -> dict[str, float]:
    offset = {"time_offset": clock.offset_s} if clock.offset_s else {}
    return offset | ({"time_rate": clock.rate} if clock.rate != 1 else {})


def _moving_cameras(found: Found, take: Take, root: Path, images: Path) -> dict[str, Any]:
    """Return the clip and the frames of moving cameras: images, or those of videos, which are written into a folder."""
    document: dict[str, Any] = {"frame_count": take.frame_count, "frames": []}
    if take.fps is not None and take.start_s is not None:
        document |= {"fps": take.fps, "start_s": take.start_s}
        document["videos"] = [
            _file(one.files[0], root) | _clock(clock) for one, clock in zip(found.footage, found.clocks, strict=True)
        ]
    for footage, track in zip(found.footage, take.tracks, strict=True):
        placed = {frame for frame in track.frames if track.view_of(frame) in found.structure.views}
        if footage.video is None:
            files = {frame: _file(footage.files[frame], root) for frame in placed}
        else:
            names = dict(zip(track.frames, track.frame_names, strict=True))
            files = {frame: {"file_path": f"{images.name}/{names[frame]}.png"} for frame in placed}
            _write_frames(footage, track.frames, {frame: images / f"{names[frame]}.png" for frame in placed})
        size = frame_size(footage)
        cameras = {view: _camera(found, view, size) for view in track.views if view in found.structure.views}
        document["frames"] += [
            files[frame] | {"time": float(time)} | cameras[track.view_of(frame)]
            for frame, time in zip(track.frames, track.times, strict=True)
            if frame in placed
        ]
    return document


def _write_frames(footage: Footage, frames: range, files: dict[int, Path]) -> None:
    """Write some of the frames of a video into files, by their numbers; those have none that are not wanted."""
    assert footage.video is not None
    if not files:
        return
    next(iter(files.values())).parent.mkdir(parents=True, exist_ok=True)
    pictures = zip(frames, read_video(footage.files[0], footage.video, frames.start, frames.stop), strict=True)
    for frame, picture in progress(pictures, f"writing frames of {footage.name}", len(frames), "frame"):
        if frame in files:
            write_image(files[frame], picture)


def _file(file: Path, root: Path) -> dict[str, Any]:
    """Return the name of a file and its size, by which it is noticed if it is replaced."""
    return {"file_path": file.relative_to(root).as_posix(), "bytes": file.stat().st_size}


def _camera(found: Found, number: int, size: tuple[int, int]) -> dict[str, Any]:
    view: PlacedView = found.structure.views[number]
    last = ("k3", "k4") if view.is_fisheye else ("p1", "p2")
    names = ("fl_x", "fl_y", "cx", "cy", "k1", "k2", *last)
    lens = dict(zip(names, (*view.intrinsics, *view.distortion), strict=True))
    # Photographs show a surrounding without bounds, which near and far would cut off at the points that were found.
    depths = None if found.kind == "photographs" else depth_range(found.structure, number, view)
    near_far = {} if depths is None else {"near": depths[0], "far": depths[1]}
    model = {"camera_model": "OPENCV_FISHEYE"} if view.is_fisheye else {}
    numbers = dict(zip("wh", size, strict=True)) | {name: float(value) for name, value in (lens | near_far).items()}
    return model | numbers | {"transform_matrix": np.round(view.camera_to_world, 9).tolist()}
