"""The layout of NeRF-synthetic and D-NeRF: `transforms_{train,val,test}.json` and images with straight alpha.

Sources: https://github.com/bmild/nerf, https://github.com/albertpumarola/D-NeRF
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

from kpc.encoder.datasets.capture import Capture, CapturedView, find_image, holdout_flags
from kpc.encoder.datasets.layouts.transforms import (
    find_images,
    frame_rate,
    frame_view,
    load_transforms,
    report_contradictions,
)
from kpc.encoder.datasets.left_out import media_in
from kpc.format.common.text import agreeing, counted, notice

# The layout's name in messages.
NAME = "Blender"


def recognise(path: Path) -> bool:
    """Return whether the folder has this layout."""
    return (path / "transforms_train.json").is_file()


def read(path: Path, holdout: str | None) -> Capture:
    """Read the folder. Test pictures are the test split, or val without one; holdout "none" trains on all splits.

    Raises:
        DatasetError, MediaError: a split or an image cannot be used.
    """
    splits = [s for s in ("train", "test", "val") if (path / f"transforms_{s}.json").is_file()]
    views: list[CapturedView] = []
    left_out: tuple[Path, ...] = ()
    fps = None
    for split in splits:
        file = path / f"transforms_{split}.json"
        document = load_transforms(file)
        if split == "val" and "test" in splits and holdout is None:
            left_out = _existing(path, file, document)
            left = f"{counted(len(left_out), 'picture')} {agreeing(len(left_out), 'is', 'are')} left out"
            notice(f"{file}: {left}, since the test split is held out")
            continue
        images = find_images(path, file, document)
        report_contradictions(file, document, next(iter(images.values())))
        views += [frame_view(path, file, n, document, image, split != "train") for n, image in images.items()]
        fps = fps or frame_rate(file, document)
    folders = sorted({file.parent for file in (*left_out, *(view.file for view in views))})
    found = tuple(media for folder in folders for media in media_in(folder))
    tests = holdout_flags(path, [str(v.file.relative_to(path)) for v in views], holdout, [v.is_test for v in views])
    used = tuple(replace(view, is_test=is_test) for view, is_test in zip(views, tests, strict=True))
    return Capture(NAME, used, fps, found, left_out)


def _existing(root: Path, file: Path, document: dict[str, Any]) -> tuple[Path, ...]:
    """Return the existing images of a split that is left out."""
    images = (find_image(root, file, frame["file_path"]) for frame in document["frames"])
    return tuple(image for image in images if image is not None)
