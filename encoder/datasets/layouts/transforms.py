"""Reading of `transforms*.json`, common to the layouts of Blender and nerfstudio.

The document describes a camera and lists frames, which may override it. `transforms_keys.py` has all its keys.
"""

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from kpc.encoder.datasets.capture import (
    CapturedView,
    Film,
    Lens,
    MaskFile,
    file_exists,
    find_image,
    image_view,
    printable,
    report_missing,
    video_view,
)
from kpc.encoder.datasets.layouts.documents import read_json
from kpc.encoder.datasets.layouts.transforms_keys import check_keys
from kpc.encoder.datasets.masks import DYNAMIC_MASK
from kpc.format.common.errors import DatasetError
from kpc.format.common.images import image_info
from kpc.format.common.media_files import is_video
from kpc.format.common.text import notice
from kpc.format.scene.camera_checks import DISTORTION_KEYS, Distortion, check_depths, number_of, pose_of
from kpc.format.scene.camera_models import FISHEYE_MODELS, understood_model

# Keys of the clock of a video: its offset in seconds, and its rate.
CLOCK = ("time_offset", "time_rate")

# Focal lengths that differ by less than this share are the same.
SAME_FOCAL = 0.02

# Frame rates that are believed, frames per second: from a picture in a quarter of an hour to a high-speed camera.
LEAST_FPS, GREATEST_FPS = 1e-3, 1e3

# A clip has so many frames for each picture at most: some may not have been placed.
FRAMES_PER_PICTURE = 100

# Clocks that are believed: the largest offset in seconds, and how much faster one may run.
LONGEST_OFFSET_S, GREATEST_RATE = 1e5, 2.0

# Keys that say the same in other words: a frame that has one of them overrides all of the document.
_SAME = (("fl_x", "camera_angle_x", "x_fov"), ("fl_y", "camera_angle_y", "y_fov"))

# The order of nerfstudio's list `distortion_params`.
_DISTORTION_PARAMS = ("k1", "k2", "k3", "k4", "p1", "p2")


def load_transforms(file: Path) -> dict[str, Any]:
    """Read the document and check its keys, and that it lists frames with `file_path` and `transform_matrix`.

    Raises:
        DatasetError: it is not JSON, lacks those, or a key is refused.
    """
    document = read_json(file)
    frames = document.get("frames") if isinstance(document, dict) else None
    if not isinstance(frames, list) or not frames:
        raise DatasetError(f"{file}: lists no frames; export it anew")
    for number, frame in enumerate(frames):
        if not (isinstance(frame, dict) and isinstance(frame.get("file_path"), str) and "transform_matrix" in frame):
            raise DatasetError(f"{file}: frame {number} lacks file_path or transform_matrix; export it anew")
    check_keys(file, document)
    return document


def find_images(root: Path, file: Path, document: dict[str, Any]) -> dict[int, Path]:
    """Return the existing images by the numbers of their frames, and name the missing ones in one line.

    Raises:
        DatasetError: none of the images exists, one leads out of the folder, or two frames have the same.
    """
    names = [frame["file_path"] for frame in document["frames"]]
    found = {number: image for number, name in enumerate(names) if (image := find_image(root, file, name))}
    report_missing(file, root, [name for number, name in enumerate(names) if number not in found], len(names))
    frame_of: dict[Path, int] = {}
    for number, image in found.items():
        if frame_of.setdefault(image, number) != number:
            both = f"frames {frame_of[image]} and {number}"
            raise DatasetError(f"{file}: {both} have the same image, {printable(names[number])}; remove one")
    return found


def frame_view(
    root: Path, file: Path, number: int, document: dict[str, Any], image: Path, is_test: bool
) -> CapturedView:
    """Return the view of a frame, whose keys override those of the document.

    Args:
        root: the dataset's folder.
        file: the document's path, for messages.
        number: of the frame.
        document: from `load_transforms`.
        image: the frame's image.
        is_test: whether it is held out.

    Raises:
        DatasetError: a number is missing or malformed, or the camera model is not understood.
    """
    where = f"{file} frame {number}"
    keys = _merged(document, document["frames"][number])
    if is_video(image):
        return _video_view(where, keys, image, is_test)
    if ("w" in keys) != ("h" in keys):
        raise DatasetError(f"{where}: has only one of w and h; add the other or export anew")
    _check_rays(where, keys, image)
    declared = (number_of(where, keys, "w"), number_of(where, keys, "h")) if "w" in keys else None
    if declared is None:
        info = image_info(image)
        width, height = float(info.width), float(info.height)
    else:
        width, height = declared
    fl_x, fl_y = _focals(where, keys, width, height)
    centre = number_of(where, keys, "cx", width / 2), number_of(where, keys, "cy", height / 2)
    view = image_view(
        image,
        where,
        Lens(declared, (fl_x, fl_y, *centre), *_distortion(where, keys)),
        pose_of(where, keys),
        time=number_of(where, keys, "time") if keys.get("time") is not None else None,
        is_test=is_test,
        near=number_of(where, keys, "near", math.nan),
        far=number_of(where, keys, "far", math.nan),
    )
    return replace(view, mask=_mask(root, file, where, keys, image), camera=_camera_name(where, keys))


def _video_view(where: str, keys: dict[str, Any], video: Path, is_test: bool) -> CapturedView:
    """Return the view of a video of a camera that stands still, with the clock that `kpposes` gives it."""
    if not ("w" in keys and "h" in keys):
        raise DatasetError(f"{where}: the frame of a video needs w and h; add them, or run kpposes")
    width, height = number_of(where, keys, "w"), number_of(where, keys, "h")
    centre = number_of(where, keys, "cx", width / 2), number_of(where, keys, "cy", height / 2)
    lens = Lens((width, height), (*_focals(where, keys, width, height), *centre), *_distortion(where, keys))
    view = video_view(video, where, lens, pose_of(where, keys), is_test)
    near, far = number_of(where, keys, "near", math.nan), number_of(where, keys, "far", math.nan)
    check_depths(where, near, far)
    return replace(view, near=near, far=far, clock=_clock(where, keys), camera=_camera_name(where, keys))


def _camera_name(where: str, keys: dict[str, Any]) -> str | None:
    """Return the name that the document gives to a camera; None where it gives none."""
    name = keys.get("camera_name")
    if name is None or isinstance(name, str | int):
        return None if name is None else str(name)
    raise DatasetError(f"{where}: camera_name is no text; correct it")


def _clock(where: str, keys: dict[str, Any]) -> tuple[float, float]:
    offset, rate = (number_of(where, keys, name, usual) for name, usual in zip(CLOCK, (0.0, 1.0), strict=True))
    check_clock(where, CLOCK, offset, rate)
    return offset, rate


def check_clock(where: str, names: tuple[str, str], offset_s: float, rate: float) -> None:
    """Refuse an offset or a rate that no clock has.

    Args:
        where: they stand, for messages.
        names: of both there.
        offset_s: in seconds.
        rate: seconds of the clip for one of the camera.

    Raises:
        DatasetError: one of them is out of range, or NaN.
    """
    longest, least = LONGEST_OFFSET_S, 1 / GREATEST_RATE
    if not abs(offset_s) <= longest:
        raise DatasetError(
            f"{where}: {names[0]} {offset_s:g} is not from -{longest:g} to {longest:g} seconds; correct it"
        )
    if not least <= rate <= GREATEST_RATE:
        raise DatasetError(f"{where}: {names[1]} {rate:g} is not from {least:g} to {GREATEST_RATE:g}; correct it")


def report_contradictions(file: Path, document: dict[str, Any], image: Path) -> None:
    """Say in one line if a document's angle of view gives another focal length than fl_x or fl_y, which is then used.

    Args:
        file: the document's path, for messages.
        document: from `load_transforms`.
        image: one of its images; its size counts if the document has none.
    """
    info = image_info(image)
    for axis, side, size in (("x", "w", info.width), ("y", "h", info.height)):
        focal = number_of(str(file), document, f"fl_{axis}", math.nan)
        for key, other in _focals_of_angles(str(file), document, axis, number_of(str(file), document, side, size)):
            if abs(other - focal) > SAME_FOCAL * focal:
                notice(f"{file}: fl_{axis} is {focal:g}, but {other:g} by {key}; fl_{axis} is used")


def frame_rate(file: Path, document: dict[str, Any]) -> float | None:
    """Return the frame rate from the key `fps`, an extension of KPC; None if it is absent."""
    if document.get("fps") is None:
        return None
    fps = number_of(str(file), document, "fps")
    if not LEAST_FPS <= fps <= GREATEST_FPS:
        raise DatasetError(f"{file}: fps {fps:g} is not from {LEAST_FPS:g} to {GREATEST_FPS:g}; correct it")
    return fps


def clip_frames(file: Path, document: dict[str, Any]) -> int | None:
    """Return the frames of the clip from the key `frame_count`, an extension of KPC; None if it is absent."""
    if document.get("frame_count") is None:
        return None
    count, most = number_of(str(file), document, "frame_count"), FRAMES_PER_PICTURE * len(document["frames"])
    if not (1 <= count <= most and count == round(count)):
        raise DatasetError(f"{file}: frame_count {count:g} is no whole number from 1 to {most}; correct it")
    return round(count)


def films_of(root: Path, file: Path, document: dict[str, Any]) -> dict[str, Film]:
    """Return the videos that are there from which images were taken, from the key `videos`, an extension of KPC.

    Args:
        root: the folder of the videos.
        file: the document's path, for messages.
        document: from `load_transforms`.

    Raises:
        DatasetError: an entry names no file of the folder, or has a clock that none has.
    """
    entries, films = document.get("videos") or [], {}
    if not (isinstance(entries, list) and all(isinstance(entry, dict) for entry in entries)):
        raise DatasetError(f"{file}: videos is not a list of objects; run kpposes anew")
    for number, entry in enumerate(entries):
        where, name = f"{file} video {number}", entry.get("file_path")
        if not isinstance(name, str):
            raise DatasetError(f"{where}: lacks file_path; run kpposes anew")
        video = find_image(root, file, name)
        if video is not None and is_video(video):
            films[video.relative_to(root).as_posix()] = Film(video, _clock(where, entry))
    return films


def _merged(document: dict[str, Any], frame: dict[str, Any]) -> dict[str, Any]:
    """Return the keys that hold for a frame: its own, and those of the document that it does not override."""
    overridden = {"frames", *(key for same in _SAME if any(k in frame for k in same) for key in same)}
    if "distortion_params" in frame:
        overridden.update(DISTORTION_KEYS)
    elif any(k in frame for k in DISTORTION_KEYS):
        overridden.add("distortion_params")
    return {**{key: value for key, value in document.items() if key not in overridden}, **frame}


def _focals(where: str, keys: dict[str, Any], width: float, height: float) -> tuple[float, float]:
    """Return fl_x and fl_y in pixels; an axis without one takes that of the other."""
    fl_x, fl_y = _focal(where, keys, "x", width), _focal(where, keys, "y", height)
    fl_x = fl_y if fl_x is None else fl_x
    if fl_x is None:
        raise DatasetError(f"{where}: fl_x is missing, and so is camera_angle_x; add it or export anew")
    return fl_x, fl_x if fl_y is None else fl_y


def _focal(where: str, keys: dict[str, Any], axis: str, size: float) -> float | None:
    """Return fl_x or fl_y in pixels, from that key or an angle of view; None without them."""
    if f"fl_{axis}" in keys:
        return number_of(where, keys, f"fl_{axis}")
    return next((focal for _, focal in _focals_of_angles(where, keys, axis, size)), None)


def _focals_of_angles(where: str, keys: dict[str, Any], axis: str, size: float) -> Iterator[tuple[str, float]]:
    """Yield the keys that give an angle of view, and the focal length in pixels: size / 2 / tan(angle / 2).

    As in instant-ngp, `camera_angle_*` is in radians and `*_fov` in degrees.
    """
    for key, unit in ((f"camera_angle_{axis}", 1.0), (f"{axis}_fov", math.pi / 180)):
        if keys.get(key) is not None:
            angle = number_of(where, keys, key) * unit
            if not 1e-9 < angle < math.pi:
                raise DatasetError(f"{where}: {key} {angle / unit:g} is no angle of view; correct the calibration")
            yield key, size / 2 / math.tan(angle / 2)


def _distortion(where: str, keys: dict[str, Any]) -> tuple[Distortion, bool]:
    """Return the coefficients of a camera whose model is understood, and whether it is a fisheye model.

    nerfstudio's k4 of a camera that is no fisheye belongs to r^8, that of OpenCV's rational model to the denominator.
    """
    named = [keys[key] for key in ("camera_model", "camera_type") if keys.get(key) is not None]
    models = [understood_model(where, printable(str(name))) for name in named]
    is_fisheye = any(model in FISHEYE_MODELS for model in models)
    if keys.get("is_fisheye") and not is_fisheye:
        if any(model != "OPENCV" for model in models):
            raise DatasetError(f"{where}: is_fisheye contradicts camera model {models[0]}; correct it")
        is_fisheye = True
    if "distortion_params" in keys:
        values = keys["distortion_params"]
        if not (isinstance(values, list) and len(values) == len(_DISTORTION_PARAMS)):
            raise DatasetError(f"{where}: distortion_params is not {len(_DISTORTION_PARAMS)} numbers; export it anew")
        keys = dict(zip(_DISTORTION_PARAMS, values, strict=True))
    distortion = {name: number_of(where, keys, name, 0.0) for name in DISTORTION_KEYS}
    unused = ("p1", "p2", "k5", "k6") if is_fisheye else () if "FULL_OPENCV" in models else ("k4", "k5", "k6")
    if wrong := [name for name in unused if distortion[name]]:
        model = "a fisheye" if is_fisheye else "no FULL_OPENCV"
        raise DatasetError(
            f"{where}: {' '.join(wrong)} of a camera model that is {model} is not supported; correct camera_model or "
            "undistort the images"
        )
    return tuple(distortion.values()), is_fisheye


def _check_rays(where: str, keys: dict[str, Any], image: Path) -> None:
    """Refuse an image beside which instant-ngp finds a file of its rays, which then replace the camera."""
    rays = image.with_name(f"rays_{image.stem}.dat")
    if keys.get("enable_ray_loading", True) and file_exists(rays):
        raise DatasetError(f"{where}: {rays} replaces the camera, which is not supported; undistort the images")


def _mask(root: Path, file: Path, where: str, keys: dict[str, Any], image: Path) -> MaskFile | None:
    """Return the mask that `mask_path` names, or instant-ngp's `dynamic_mask_NAME.png` beside the image."""
    name = keys.get("mask_path") or None
    dynamic = image.with_name(f"{DYNAMIC_MASK}{image.stem}.png")
    if name is None:
        return MaskFile(dynamic, marks_ignored=True) if file_exists(dynamic) else None
    mask = find_image(root, file, name) if isinstance(name, str) else None
    if mask is None:
        raise DatasetError(f"{where}: mask_path {printable(str(name))} is no image in {root}; copy it there")
    if file_exists(dynamic):
        raise DatasetError(f"{where}: has two masks, {mask} and {dynamic}; remove one")
    return MaskFile(mask)
