"""Read the dataset of an encode; of footage without poses, find the cameras and clocks first."""

import sys
from pathlib import Path

from kpc.encoder.cli.options import Options
from kpc.encoder.cli.work_folder import POSES
from kpc.encoder.datasets import Dataset, load_dataset
from kpc.encoder.datasets.loading import has_layout
from kpc.format.common.media_files import is_hidden, is_image, is_video


def read_dataset(options: Options) -> Dataset:
    """Decode the dataset that the options name.

    Cameras that were found are kept in the work folder, and not looked for again.

    Raises:
        DatasetError, MediaError: the dataset cannot be used, or its cameras cannot be found.
    """
    root, transforms = options.source, None
    if not has_layout(root) and _has_footage(root):
        file = options.work_dir / POSES / "transforms.json"
        if not file.exists():
            _find_poses(options, file)
        else:
            print(f"cameras: those found before, {file}", file=sys.stderr)
        is_own = (file.parent / "images").is_dir()  # the frames of a moving camera lie beside the document
        root, transforms = (file.parent, None) if is_own else (root, file)
    return load_dataset(
        root, options.work_dir, holdout=options.holdout, downscale=options.downscale, transforms=transforms
    )


def _has_footage(root: Path) -> bool:
    """Return whether a folder, or one of its folders, holds a video or an image."""
    if not root.is_dir():
        return False
    folders = [root, *(folder for folder in root.iterdir() if folder.is_dir() and not is_hidden(folder))]
    return any(is_video(file) or is_image(file) for folder in folders for file in folder.iterdir())


def _find_poses(options: Options, file: Path) -> None:
    from kpc.encoder.cli.kpposes import report  # needs packages that other encodes do not
    from kpc.encoder.poses.document import write_document
    from kpc.encoder.poses.find import find_poses

    print(f"{options.source}: has no poses; finding the cameras", file=sys.stderr)
    found = find_poses(options.source, options.wishes)
    file.parent.mkdir(parents=True, exist_ok=True)
    write_document(found, options.source, file)
    print(report(found), file=sys.stderr)
