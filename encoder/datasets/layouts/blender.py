"""The layout of NeRF-synthetic and D-NeRF: `transforms_{train,val,test}.json` and images with straight alpha.

Sources: https://github.com/bmild/nerf, https://github.com/albertpumarola/D-NeRF
"""

import sys
from dataclasses import replace
from pathlib import Path

from kpc.encoder.datasets.capture import Capture, CapturedView, find_image, holdout_flags, report_missing
from kpc.encoder.datasets.layouts.transforms import frame_rate, frame_view, load_transforms
from kpc.encoder.datasets.left_out import media_in

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
    found: list[Path] = []
    left_out: tuple[Path, ...] = ()
    fps = None
    for split in splits:
        file = path / f"transforms_{split}.json"
        document = load_transforms(file)
        names = [frame["file_path"] for frame in document["frames"]]
        images = [find_image(path, file, name) for name in names]
        existing = {image for image in images if image}
        found += (media for folder in sorted({image.parent for image in existing}) for media in media_in(folder))
        if split == "val" and "test" in splits and holdout is None:
            left_out = tuple(existing)
            print(
                f"{file}: its {len(left_out)} pictures are left out, since the test split is held out", file=sys.stderr
            )
            continue
        report_missing(
            file, path, [name for name, image in zip(names, images, strict=True) if image is None], len(names)
        )
        views += [frame_view(path, file, n, document, im, split != "train") for n, im in enumerate(images) if im]
        fps = fps or frame_rate(file, document)
    tests = holdout_flags(path, [str(v.file.relative_to(path)) for v in views], holdout, [v.is_test for v in views])
    used = tuple(replace(view, is_test=is_test) for view, is_test in zip(views, tests, strict=True))
    return Capture(NAME, used, fps, tuple(found), left_out)
