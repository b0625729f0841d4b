"""The layout of nerfstudio and instant-ngp: one `transforms.json` with intrinsics, distortion, times and split.

Source: https://docs.nerf.studio/quickstart/data_conventions.html
"""

import os
from pathlib import Path
from typing import Any

from kpc.encoder.datasets.capture import HOLD_OUT_EVERY, Capture, find_image, holdout_flags, natural_key, report_missing
from kpc.encoder.datasets.layouts.transforms import frame_rate, frame_view, load_transforms
from kpc.format.common.errors import DatasetError


def recognise(path: Path) -> bool:
    """Return whether the folder has this layout."""
    return (path / "transforms.json").is_file()


def read(path: Path, holdout: str | None) -> Capture:
    """Read the folder. Test pictures are `test_filenames` (or `val_filenames`), else every eighth existing image.

    Raises:
        DatasetError, MediaError: the JSON or an image cannot be used.
    """
    file = path / "transforms.json"
    document = load_transforms(file)
    frames = sorted(enumerate(document["frames"]), key=lambda item: natural_key(item[1]["file_path"]))
    found = [(number, find_image(path, file, frame["file_path"])) for number, frame in frames]
    report_missing(file, [document["frames"][n]["file_path"] for n, image in found if image is None], len(found))
    existing = [(number, image) for number, image in found if image is not None]
    names = [os.path.normpath(document["frames"][n]["file_path"]) for n, _ in existing]
    train, test = _listed(file, document, "train_filenames"), _listed(file, document, "test_filenames")
    if test is None:
        test = _listed(file, document, "val_filenames")
    if train is None and test is None:
        default = [k % HOLD_OUT_EVERY == 0 for k in range(len(existing))]
    else:
        default = [name in test if test is not None else name not in (train or ()) for name in names]
    tests = holdout_flags(path, [str(image.relative_to(path)) for _, image in existing], holdout, default)
    views = tuple(
        frame_view(file, number, document, image, is_test)
        for (number, image), name, is_test in zip(existing, names, tests, strict=True)
        if is_test or train is None or name in train or holdout is not None
    )
    return Capture("nerfstudio", views, frame_rate(file, document))


def _listed(file: Path, document: dict[str, Any], key: str) -> frozenset[str] | None:
    """Return a list of file names in the document, normalised; None if the key is absent."""
    names = document.get(key)
    if names is None:
        return None
    if not (isinstance(names, list) and all(isinstance(name, str) for name in names)):
        raise DatasetError(f"{file}: {key} is not a list of names; export it anew")
    return frozenset(os.path.normpath(name) for name in names)
