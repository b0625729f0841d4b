"""What every dataset layout is read into: a list of views, each an image or the video of a static camera."""

import errno
import math
import os
import re
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from kpc.encoder.datasets.video import VideoInfo, video_info
from kpc.format.common.errors import DatasetError
from kpc.format.common.images import image_info
from kpc.format.common.media_files import IMAGE_SUFFIXES, is_video
from kpc.format.common.text import agreeing, counted, notice
from kpc.format.scene.camera_checks import NO_DISTORTION, Distortion, check_depths, check_lens, check_pose

# Where neither the dataset nor the user names test images, every eighth is one, as in LLFF (arXiv:1905.00889).
HOLD_OUT_EVERY = 8

# Pixels of a video whose aspect differs from 1 by no more are taken as square.
NEARLY_SQUARE = 5e-3


@dataclass(frozen=True)
class MaskFile:
    """An image that says which pixels of another are ignored: those that are 0, or those that are not.

    Attributes:
        path: of the image.
        marks_ignored: whether other values than 0 are ignored, as in the `dynamic_mask_*.png` of instant-ngp.
    """

    path: Path
    marks_ignored: bool = False


@dataclass(frozen=True)
class Lens:
    """The lens of a camera as a calibration has it, not checked.

    Attributes:
        size: width and height of the pictures for which it holds; None if those are the pictures as stored.
        intrinsics: fl_x fl_y cx cy in pixels of that size, the centre of the first pixel at 0.5.
        distortion: the coefficients DISTORTION_KEYS of OpenCV's lens models.
        is_fisheye: whether they are those of its fisheye model.
    """

    size: tuple[float, float] | None
    intrinsics: tuple[float, float, float, float]
    distortion: Distortion = NO_DISTORTION
    is_fisheye: bool = False


@dataclass(frozen=True)
class CapturedView:
    """One file of a dataset, with the camera that captured it.

    Attributes:
        file: an image, or a video if `video` is given.
        video: properties of the video.
        time: as given by the dataset, in any unit; None for videos and where it gives none.
        is_test: whether it is held out from training.
        width, height, has_alpha: of the picture, before downscaling.
        intrinsics: fl_x fl_y cx cy in pixels of that size.
        distortion: the coefficients DISTORTION_KEYS of OpenCV's lens models.
        camera_to_world: (4, 4) float64, OpenGL convention.
        near, far: depth range along the optical axis, NaN if unknown.
        orientation: of an image, EXIF's number from 1 (as stored) to 8.
        upright: whether that orientation is applied.
        mask: the mask that the dataset's own files name; None if they name none.
        is_fisheye: whether `distortion` is that of OpenCV's fisheye model.
        foreground: a mask that is the image's alpha: what is 0 there is transparent.
        camera: the camera's name, where it is not that of the file.
        clock: of a video, seconds to be added to its times after they are multiplied by the second number.
    """

    file: Path
    video: VideoInfo | None
    time: float | None
    is_test: bool
    width: int
    height: int
    has_alpha: bool
    intrinsics: tuple[float, float, float, float]
    distortion: Distortion
    camera_to_world: np.ndarray
    near: float = math.nan
    far: float = math.nan
    orientation: int = 1
    upright: bool = False
    mask: MaskFile | None = None
    is_fisheye: bool = False
    foreground: Path | None = None
    camera: str | None = None
    clock: tuple[float, float] = (0.0, 1.0)


@dataclass(frozen=True)
class Film:
    """A video whose sound may be that of the clip.

    Attributes:
        file: the video.
        clock: seconds to be added to its times after they are multiplied by the second number.
    """

    file: Path
    clock: tuple[float, float] = (0.0, 1.0)


@dataclass(frozen=True)
class Capture:
    """A dataset before its pixels are read.

    Attributes:
        layout: name of the layout.
        views: all files that are used.
        fps: frames per second; None if the dataset does not give it.
        found: all images, or videos, in the folders that the layout reads.
        left_out: those of them that are not used for a reason that the layout has reported.
        poses_found: whether `kpposes` found the poses.
        frame_count: of the clip of images with times; None if it follows from these.
        films: by their names, videos from which images were taken.
        start_s: when the clip of these begins by the common clock; None if it is unknown.
    """

    layout: str
    views: tuple[CapturedView, ...]
    fps: float | None
    found: tuple[Path, ...]
    left_out: tuple[Path, ...] = ()
    poses_found: bool = False
    frame_count: int | None = None
    films: Mapping[str, Film] = field(default_factory=dict)
    start_s: float | None = None


def image_view(
    file: Path,
    where: str,
    lens: Lens,
    camera_to_world: np.ndarray,
    *,
    time: float | None,
    is_test: bool,
    near: float = math.nan,
    far: float = math.nan,
) -> CapturedView:
    """Return the view of an image.

    An EXIF orientation is applied only if the image then has the aspect ratio of the calibration, and not as stored.

    Args:
        file: the image.
        where: the calibration's file and entry, for messages.
        lens, camera_to_world, time, is_test, near, far: as in `CapturedView`, but none of them checked.
    """
    info = image_info(file)
    width, height = info.width, info.height
    upright = lens.size is not None and fits(lens.size, info.displayed_size) and not fits(lens.size, (width, height))
    if upright:
        width, height = info.displayed_size
    intrinsics = fit_intrinsics(where, file, lens.intrinsics, lens.size or (width, height), (width, height))
    check_lens(where, (width, height), intrinsics, lens.distortion, lens.is_fisheye)
    check_depths(where, near, far)
    return CapturedView(
        file,
        None,
        time,
        is_test,
        width,
        height,
        info.has_alpha,
        intrinsics,
        lens.distortion,
        check_pose(where, camera_to_world),
        near,
        far,
        info.orientation,
        upright,
        is_fisheye=lens.is_fisheye,
    )


def video_view(file: Path, where: str, lens: Lens, camera_to_world: np.ndarray, is_test: bool) -> CapturedView:
    """Return the view of the video of a camera that stands still.

    Args:
        file: the video.
        where: the calibration's file and entry, for messages.
        lens, camera_to_world: not checked.
        is_test: whether it is held out.

    Raises:
        DatasetError: the calibration is not that of a camera, or for pictures of another shape.
    """
    video = video_info(file)
    size = video.width, video.height
    if abs(video.pixel_aspect - 1) > NEARLY_SQUARE and lens.size != size:
        raise DatasetError(
            f"{file}: its pixels are not square (width {video.pixel_aspect:.4g} of the height), and {where} is not for "
            f"{size[0]}x{size[1]}; scale it to {round(size[0] * video.pixel_aspect)}x{size[1]}"
        )
    intrinsics = fit_intrinsics(where, file, lens.intrinsics, lens.size or size, size)
    check_lens(where, size, intrinsics, lens.distortion, lens.is_fisheye)
    pose = check_pose(where, camera_to_world)
    return CapturedView(
        file,
        video,
        None,
        is_test,
        *size,
        video.has_alpha,
        intrinsics,
        lens.distortion,
        pose,
        is_fisheye=lens.is_fisheye,
    )


def opengl_pose(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Return the (4, 4) camera-to-world pose in the OpenGL convention of OpenCV's x_camera = R x_world + t.

    OpenCV's camera looks along z and has y down, OpenGL's looks along -z and has y up.
    """
    pose = np.eye(4)
    pose[:3, :3] = rotation.T * [1, -1, -1]
    # A translation that overflows is refused later, with other poses that are not finite.
    with np.errstate(over="ignore", invalid="ignore"):
        pose[:3, 3] = -rotation.T @ translation
    return pose


def fit_intrinsics(
    where: str,
    file: Path,
    intrinsics: tuple[float, float, float, float],
    declared: tuple[float, float],
    actual: tuple[int, int],
) -> tuple[float, float, float, float]:
    """Scale fl_x fl_y cx cy from the declared to the actual image size, each axis independently.

    Args:
        where: the calibration's file and entry, for messages.
        file: the image or video.
        intrinsics: fl_x fl_y cx cy in pixels of the declared size.
        declared, actual: width and height.

    Raises:
        DatasetError: the intrinsics are not those of a camera, or the aspect ratios differ by more than a pixel of
            rounding: then the image was cropped or padded, and it is unknown where.
    """
    check_lens(where, declared, intrinsics)
    fl_x, fl_y, cx, cy = intrinsics
    sx, sy = actual[0] / declared[0], actual[1] / declared[1]
    if not fits(declared, actual):
        remedy = "turn it back" if fits(declared, actual[::-1]) else "undo the crop or correct the size there"
        raise DatasetError(
            f"{file}: is {actual[0]}x{actual[1]}, but {where} is for {declared[0]:g}x{declared[1]:g}, another aspect "
            f"ratio; {remedy}"
        )
    return fl_x * sx, fl_y * sy, cx * sx, cy * sy


def fits(declared: tuple[float, float], actual: tuple[int, int]) -> bool:
    """Return whether two sizes have the same aspect ratio, but for a pixel of rounding on each axis."""
    crossed = declared[0] * actual[1] - actual[0] * declared[1]
    return declared[1] > 0 and abs(crossed) <= declared[0] + declared[1]


def natural_key(name: str) -> list[tuple[int, str]]:
    """Return a sort key that puts cam2 before cam10.

    Numbers are compared by length, then by digits, so that they may be of any length.
    """
    parts = re.split(r"(\d+)", name)
    numbers = [part.lstrip("0") for part in parts[1::2]]
    return [(len(numbers[k // 2]), numbers[k // 2]) if k % 2 else (-1, part) for k, part in enumerate(parts)]


def holdout_flags(path: Path, names: Sequence[str], holdout: str | None, default: Iterable[bool]) -> list[bool]:
    """Return for each file whether it is held out for testing.

    Args:
        path: the dataset's folder, for messages.
        names: of the files, relative to it.
        holdout: a file's name with or without suffix, or that of a folder, with or without the folders above it;
            "none", or None for the layout's default.
        default: the layout's default for each file.

    Raises:
        DatasetError: no file or folder has the name `holdout`.
    """
    if holdout is None:
        return list(default)
    if holdout == "none":
        return [False] * len(names)

    def is_meant(path: Path) -> bool:
        return f"/{path.as_posix()}".endswith(f"/{holdout}")

    paths = list(map(Path, names))
    chosen = [is_meant(path) or is_meant(path.with_suffix("")) for path in paths]
    if not any(chosen):
        chosen = [any(map(is_meant, path.parents)) for path in paths]
    if not any(chosen):
        folders = list(dict.fromkeys(one.parent.name for one in paths if one.parent.name))
        known = folders if len(folders) > 1 else [one.stem for one in paths]
        raise DatasetError(
            f"{path}: no file or folder is named {holdout!r}; give --holdout one of {first_names(known)}"
        )
    return chosen


def find_image(root: Path, file: Path, name: str) -> Path | None:
    """Find an image or video by a name relative to `root`; an image also without its suffix.

    Args:
        root: the folder of images.
        file: the file that lists the name, for messages.
        name: as listed; an absolute path inside `root` counts as relative to it, and a backslash as a slash.

    Returns:
        The image's path, or None if it does not exist.

    Raises:
        DatasetError: the name leads out of `root`. (Symbolic links inside it may: whoever put them there meant it.)
    """
    try:
        # Documents hold UTF-8; what Python takes a name for depends on the system's encoding.
        stored = os.fsdecode(name.encode("utf-8", "surrogateescape"))
    except UnicodeEncodeError:
        return None
    relative = os.path.normpath(stored.replace("\\", "/"))
    for folder in (os.path.abspath(root), os.path.realpath(root)):
        relative = relative.removeprefix(folder + os.sep)
    if os.path.isabs(relative) or relative.split(os.sep)[0] in (os.curdir, os.pardir) or "\0" in relative:
        raise DatasetError(f"{file}: {name!r} leads out of {root} or is no file name; make it relative to that folder")
    unreadable = None
    # Macs decompose accented letters (NFD), other systems do not.
    for form in dict.fromkeys(
        (relative, unicodedata.normalize("NFC", relative), unicodedata.normalize("NFD", relative))
    ):
        bare, suffix = root / form, Path(form).suffix
        is_image = suffix.lower() in IMAGE_SUFFIXES
        if (is_image or is_video(bare)) and file_exists(bare):
            return bare
        found = (_in_any_case(bare.with_suffix(""), suffix) if is_image else None) or with_image_suffix(bare)
        if found is not None:
            return found
        if file_exists(bare):
            unreadable = suffix
    if unreadable is not None:
        kind = f"of the suffix {printable(unreadable)}" if unreadable else "without a suffix"
        raise DatasetError(
            f"{file}: {printable(name)} exists, but images {kind} are not read; convert it to PNG, TIFF or JPEG"
        )
    return None


def with_image_suffix(bare: Path) -> Path | None:
    """Return the image whose name is `bare` and a suffix in any case; None if there is none."""
    return next(filter(None, (_in_any_case(bare, suffix) for suffix in IMAGE_SUFFIXES)), None)


def _in_any_case(bare: Path, suffix: str) -> Path | None:
    candidates = (bare.with_name(bare.name + case) for case in (suffix.lower(), suffix.upper(), suffix.title()))
    return next(filter(file_exists, candidates), None)


def file_exists(path: Path) -> bool:
    """Return whether a file exists; unlike `Path.is_file`, return False for a name that is too long to exist."""
    try:
        return path.is_file()
    except OSError as error:
        if error.errno == errno.ENAMETOOLONG:
            return False
        raise


def report_missing(file: Path, folder: Path, missing: list[str], total: int) -> None:
    """Print one line about all frames whose image does not exist.

    Args:
        file: the file that lists the images.
        folder: the folder to which their names are relative.
        missing: names of those that do not exist.
        total: how many are listed.

    Raises:
        DatasetError: none of the images exists.
    """
    if len(missing) == total:
        which = f"{printable(missing[0])} ..." if total > 1 else printable(missing[0])
        them = agreeing(total, "it", "them")
        files = counted(total, "video" if is_video(missing[0]) else "image")
        raise DatasetError(f"{file}: none of its {files} exists ({which}); copy {them} to {folder}")
    if missing:
        words = agreeing(len(missing), "has no image and is", "have no image and are")
        share = f"{len(missing)} of {counted(total, 'frame')}"
        notice(f"{file}: {share} {words} skipped: {first_names(missing)}")


def report_orientations(root: Path, views: Iterable[CapturedView]) -> None:
    """Print one line about images that are turned by their EXIF orientation, and one about those that are not."""
    turned = [view.file.name for view in views if view.orientation != 1 and view.upright]
    stored = [view.file.name for view in views if view.orientation != 1 and not view.upright]
    if turned:
        notice(
            f"{root}: {counted(len(turned), 'image')} "
            f"{agreeing(len(turned), 'is turned by its', 'are turned by their')} EXIF orientation, since the "
            f"calibration is for that size: {first_names(turned)}"
        )
    if stored:
        words = agreeing(len(stored), "has an EXIF orientation, but is", "have an EXIF orientation, but are")
        notice(
            f"{root}: {counted(len(stored), 'image')} {words} used as stored, since the calibration does not ask for "
            f"another size; if it is for turned images, turn the files: {first_names(stored)}"
        )


def first_names(names: Sequence[str]) -> str:
    """Return the first few names, for a message."""
    return ", ".join(map(printable, names[:6])) + (" ..." if len(names) > 6 else "")


def printable(text: str) -> str:
    """Return text from a file in printable form, on one line and of limited length, for a message."""
    return (text if text.isprintable() else repr(text))[:160]
