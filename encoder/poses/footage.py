"""What a folder without poses holds: a video for each camera, folders of frames, or photographs."""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from kpc.encoder.datasets.capture import natural_key
from kpc.encoder.datasets.left_out import media_in
from kpc.encoder.datasets.masks import DYNAMIC_MASK
from kpc.encoder.datasets.masks import FOLDER as MASKS
from kpc.encoder.datasets.video import VideoInfo, video_info
from kpc.format.common.errors import DatasetError
from kpc.format.common.images import image_info
from kpc.format.common.media_files import is_hidden, is_image, is_video

# Folders of frames have at least as many images; fewer are photographs.
LEAST_FRAMES = 5
# How the names of folders end into which `kpposes` writes frames; a number follows where there are several.
FRAMES = ".images"
# Names of folders that hold masks, in small letters; only those in `masks` are used.
MASK_FOLDERS = (MASKS, "mask")


@dataclass(frozen=True)
class Footage:
    """What one camera filmed.

    Attributes:
        name: of the camera: its video's name without suffix, or its folder's.
        files: a video, or images in the order of time.
        video: properties of the video; None for images.
    """

    name: str
    files: tuple[Path, ...]
    video: VideoInfo | None


def find_footage(root: Path) -> tuple[Footage, ...]:
    """Return what each camera filmed, in the order of names; one entry for each photograph of a collection.

    Raises:
        DatasetError: the folder holds nothing of these kinds, or several.
        MediaError: a video cannot be read.
    """
    videos, folders = videos_by_name(root), _frame_folders(root)
    images = _images_in(root)
    if videos:
        return tuple(Footage(name, (file,), video_info(file)) for name, file in videos.items())
    if folders:
        return tuple(Footage(name, files, None) for name, files in folders.items())
    images = images or _of_only_folder(root)
    if len(images) < 3:
        raise DatasetError(
            f"{root}: holds no videos, folders of frames, or three photographs; give a video for each camera"
        )
    return tuple(Footage(file.stem, (file,), None) for file in sorted(images, key=lambda file: natural_key(file.name)))


def left_out(root: Path, footage: Iterable[Footage]) -> list[str]:
    """Return the names of images and videos in a folder, or in its folders, that belong to no camera.

    Masks do not count, nor do frames that `kpposes` wrote beside a document that is still there.
    """
    used = {file for one in footage for file in one.files}
    folders = [folder for folder in _folders(root) if folder.name != MASKS and not _has_document(folder)]
    found = [file for folder in (root, *folders) for file in media_in(folder)]
    return sorted(
        (
            file.relative_to(root).as_posix()
            for file in found
            if file not in used and not file.name.startswith(DYNAMIC_MASK)
        ),
        key=natural_key,
    )


def _has_document(folder: Path) -> bool:
    """Return whether `kpposes` wrote the frames in a folder, to go by its name and that of a document beside it."""
    name = re.fullmatch(rf"(.+){re.escape(FRAMES)}(-\d+)?", folder.name)
    return name is not None and folder.with_name(f"{name[1]}.json").is_file()


def frame_size(footage: Footage) -> tuple[int, int]:
    """Return the width and height of a camera's pictures as they are shown, pixels."""
    if footage.video is not None:
        return footage.video.width, footage.video.height
    return image_info(footage.files[0]).displayed_size


def videos_by_name(root: Path) -> dict[str, Path]:
    """Return the videos of a folder, or else those of its folders, which then name the cameras.

    Raises:
        DatasetError: two have one name.
    """
    found = [file for file in media_in(root) if is_video(file)]
    if not found:
        found = [file for folder in _footage_folders(root) for file in media_in(folder) if is_video(file)]
    parents = [file.parent for file in found]
    by_folder = bool(found) and found[0].parent != root and len(set(parents)) == len(parents)
    files = {(file.parent.name if by_folder else file.stem): file for file in found}
    if len(files) < len(found):
        twice = next(file for file in found if file not in files.values())
        raise DatasetError(f"{root}: two videos are named {twice.stem}; give each camera a name of its own")
    return {name: files[name] for name in sorted(files, key=natural_key)}


def _frame_folders(root: Path) -> dict[str, tuple[Path, ...]]:
    found = {}
    for folder in _footage_folders(root):
        images = _images_in(folder)
        if len(images) >= LEAST_FRAMES:
            found[folder.name] = tuple(sorted(images, key=lambda file: natural_key(file.name)))
    return {name: found[name] for name in sorted(found, key=natural_key)} if len(found) > 1 else {}


def _of_only_folder(root: Path) -> list[Path]:
    folders = [images for folder in _footage_folders(root) if (images := _images_in(folder))]
    return folders[0] if len(folders) == 1 else []


def _images_in(folder: Path) -> list[Path]:
    """Return the images in a folder but for masks."""
    return [file for file in media_in(folder) if is_image(file) and not file.name.startswith(DYNAMIC_MASK)]


def _footage_folders(root: Path) -> list[Path]:
    """Return the folders in a folder that may hold footage: not those of masks."""
    return [folder for folder in _folders(root) if folder.name.lower() not in MASK_FOLDERS]


def _folders(root: Path) -> list[Path]:
    return sorted(folder for folder in root.iterdir() if folder.is_dir() and not is_hidden(folder))
