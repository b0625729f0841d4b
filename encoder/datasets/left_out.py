"""Which images and videos of a dataset's folder are not used, so that it can be said."""

from collections.abc import Iterable, Sequence
from pathlib import Path

from kpc.encoder.datasets.capture import Capture, first_names
from kpc.format.common.media_files import is_hidden, is_image, is_video
from kpc.format.common.text import agreeing, counted, notice


def media_in(folder: Path, *, recursive: bool = False) -> list[Path]:
    """Return the images and videos in a folder; hidden and system files and folders do not count."""
    found = folder.rglob("*") if recursive else folder.iterdir()
    return [
        file
        for file in found
        if (is_image(file) or is_video(file))
        and not any(map(is_hidden, file.relative_to(folder).parts))
        and file.is_file()
    ]


def left_out_clause(names: Sequence[str]) -> str:
    """Return the end of a sentence about files that belong to no camera, with the first of their names."""
    verb = agreeing(len(names), "belongs to no camera and is", "belong to no camera and are")
    return f"{verb} left out: {first_names(names)}"


def count_left_out(root: Path, capture: Capture, masks: Iterable[Path]) -> int:
    """Return how many files a layout found but does not use, and name those for which it has not given a reason.

    Args:
        root: the dataset's folder.
        capture: what the layout read.
        masks: the masks of its images, which count as used.
    """
    used = {view.file for view in capture.views}
    left_out = {*capture.found, *capture.left_out} - used - set(masks)
    unnamed = sorted(file.relative_to(root).as_posix() for file in left_out - set(capture.left_out))
    if unnamed:
        notice(f"{root}: {len(unnamed)} of {counted(len(used | left_out), 'file')} found {left_out_clause(unnamed)}")
    return len(left_out)
