"""The layout of NeRF-synthetic and D-NeRF: `transforms_{train,val,test}.json` and images with straight alpha.

Sources: https://github.com/bmild/nerf, https://github.com/albertpumarola/D-NeRF
"""

from dataclasses import replace
from pathlib import Path

from kpc.encoder.datasets.capture import Capture, find_image, holdout_flags, report_missing
from kpc.encoder.datasets.layouts.transforms import frame_rate, frame_view, load_transforms


def recognise(path: Path) -> bool:
    """Return whether the folder has this layout."""
    return (path / "transforms_train.json").is_file()


def read(path: Path, holdout: str | None) -> Capture:
    """Read the folder. Test pictures are the test split, or val without one; holdout "none" trains on all splits.

    Raises:
        DatasetError, MediaError: a split or an image cannot be used.
    """
    splits = [s for s in ("train", "test", "val") if (path / f"transforms_{s}.json").is_file()]
    if "test" in splits and "val" in splits and holdout is None:
        splits.remove("val")
    views, fps = [], None
    for split in splits:
        file = path / f"transforms_{split}.json"
        document = load_transforms(file)
        names = [frame["file_path"] for frame in document["frames"]]
        images = [find_image(path, file, name) for name in names]
        report_missing(file, [name for name, image in zip(names, images, strict=True) if image is None], len(names))
        views += [frame_view(file, n, document, image, split != "train") for n, image in enumerate(images) if image]
        fps = fps or frame_rate(file, document)
    tests = holdout_flags(path, [str(v.file.relative_to(path)) for v in views], holdout, [v.is_test for v in views])
    return Capture("Blender", tuple(replace(v, is_test=t) for v, t in zip(views, tests, strict=True)), fps)
