"""The layouts of LLFF and Neural 3D Video: `poses_bounds.npy` beside `images/` or beside `cam*.mp4`.

Row n of `poses_bounds.npy` belongs to the n-th file (`row_order.py`). Its first 15 numbers are a 3x5 matrix by rows,
with the columns [down right backwards centre | (h w f)]; near and far depth follow.

Source: https://github.com/Fyusion/LLFF
"""

from pathlib import Path
from tokenize import TokenError

import numpy as np

from kpc.encoder.datasets.capture import (
    HOLD_OUT_EVERY,
    NEARLY_SQUARE,
    Capture,
    CapturedView,
    Lens,
    fit_intrinsics,
    fits,
    holdout_flags,
    image_view,
)
from kpc.encoder.datasets.layouts.row_order import in_row_order
from kpc.encoder.datasets.left_out import media_in
from kpc.encoder.datasets.video import VideoInfo, video_info
from kpc.format.common.errors import DatasetError
from kpc.format.common.media_files import is_image, is_video
from kpc.format.scene.camera_checks import NO_DISTORTION, check_depths, check_pose

POSES = "poses_bounds.npy"  # the file of poses and depth ranges


# The layout's name in messages; with videos it is that of Neural 3D Video.
NAME = "LLFF"


def recognise(path: Path) -> bool:
    """Return whether the folder has this layout."""
    return (path / POSES).is_file()


def read(path: Path, holdout: str | None) -> Capture:
    """Read the folder: its videos if there are any, else `images/`.

    Test pictures are those of the first video, or every eighth image.

    Raises:
        DatasetError: there are not as many poses as files, or a pose, focal length or depth range is invalid.
        MediaError: a file cannot be read.
    """
    found = media_in(path)
    videos = [file for file in found if is_video(file)]
    files = [file for file in videos if file.name.lower().startswith("cam")] or videos
    layout = "N3DV" if files else NAME
    if (path / "images").is_dir():
        images = media_in(path / "images")
        found = [*found, *images] if files else images
        files = files or [file for file in images if is_image(file)]
    if not files:
        raise DatasetError(
            f"{path}: has {POSES}, but neither cam*.mp4 nor, in images/, any image that is read, such as PNG or JPEG; "
            "copy the videos or images there, or convert them"
        )
    rows = _read_poses(path / POSES)
    kind = "videos" if layout == "N3DV" else "images"
    if len(rows) != len(files):
        raise DatasetError(
            f"{path / POSES}: {len(rows)} poses for {len(files)} {kind}; remove those that do not belong together"
        )
    poses = np.stack([_pose(f"{path / POSES} row {number}", row) for number, row in enumerate(rows)])
    files = in_row_order(path / POSES, files, poses[:, :3, 3], -poses[:, :3, 2])
    default = [k == 0 if layout == "N3DV" else k % HOLD_OUT_EVERY == 0 for k in range(len(files))]
    tests = holdout_flags(path, [str(f.relative_to(path)) for f in files], holdout, default)
    items = enumerate(zip(files, rows, poses, tests, strict=True))
    views = tuple(_view(f"{path / POSES} row {number}", *item) for number, item in items)
    return Capture(layout, views, None, tuple(found))


def _pose(where: str, row: np.ndarray) -> np.ndarray:
    """Return the pose of a row, (4, 4) float64 in the OpenGL convention."""
    down, right, backwards, centre = row[:15].reshape(3, 5).T[:4]
    return check_pose(where, np.stack([right, -down, backwards, centre], axis=1))


def _view(where: str, file: Path, row: np.ndarray, pose: np.ndarray, is_test: bool) -> CapturedView:
    (h, w, focal), (near, far) = row[[4, 9, 14]], row[15:]
    if np.isnan(row[15:]).any():
        raise DatasetError(f"{where}: near or far is NaN; calibrate anew")
    check_depths(where, near, far)
    intrinsics = (focal, focal, w / 2, h / 2)
    if not is_video(file):
        lens = Lens((w, h), intrinsics)
        return image_view(file, where, lens, pose, time=None, is_test=is_test, near=near, far=far)
    video = video_info(file)
    size = video.width, video.height
    if abs(video.pixel_aspect - 1) > NEARLY_SQUARE:
        intrinsics = _fit_stretched(where, file, video, intrinsics, (w, h))
    else:
        intrinsics = fit_intrinsics(where, file, intrinsics, (w, h), size)
    return CapturedView(file, video, None, is_test, *size, video.has_alpha, intrinsics, NO_DISTORTION, pose, near, far)


def _fit_stretched(
    where: str,
    file: Path,
    video: VideoInfo,
    intrinsics: tuple[float, float, float, float],
    declared: tuple[float, float],
) -> tuple[float, float, float, float]:
    """Return `fit_intrinsics` for a video whose pixels are not square; a single focal length is for square ones."""
    shown = round(video.width * video.pixel_aspect), video.height
    if not fits(declared, shown):
        raise DatasetError(
            f"{file}: its pixels are not square (width {video.pixel_aspect:.4g} of the height), and {where} gives one "
            f"focal length for {declared[0]:g}x{declared[1]:g}; scale it to {shown[0]}x{shown[1]} and calibrate"
        )
    fl_x, fl_y, cx, cy = fit_intrinsics(where, file, intrinsics, declared, shown)
    across = video.width / shown[0]
    return fl_x * across, fl_y, cx * across, cy


def _read_poses(file: Path) -> np.ndarray:
    try:
        rows = np.load(file, allow_pickle=False)
    except (ValueError, EOFError, SyntaxError, TokenError, OverflowError, MemoryError) as error:
        raise DatasetError(f"{file}: not a numpy array ({error}); copy it anew") from error
    if rows.ndim != 2 or rows.shape[1] != 17 or not np.issubdtype(rows.dtype, np.number) or np.iscomplexobj(rows):
        raise DatasetError(f"{file}: holds {rows.dtype} {rows.shape}, not N x 17 numbers; export it anew")
    return rows.astype(np.float64)
