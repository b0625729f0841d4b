"""The split of nerfstudio's `transforms.json`: the lists `train_filenames`, `val_filenames` and `test_filenames`."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from kpc.encoder.datasets.capture import HOLD_OUT_EVERY, find_image, first_names
from kpc.format.common.errors import DatasetError
from kpc.format.common.text import agreeing, counted, notice

# What becomes of a picture; None if it is left out.
Part = Literal["train", "test"] | None


def split_of(
    root: Path, file: Path, document: dict[str, Any], images: Sequence[Path], missing: Sequence[str]
) -> list[Part]:
    """Return for each image whether it is trained on, held out for testing, or left out.

    Held out is what `test_filenames` lists, or `val_filenames` if that is absent or empty, or else what
    `train_filenames` does not list. Without any list it is every eighth image; with empty lists alone, none. Trained
    on is what `train_filenames` lists, or all the rest, except pictures of `val_filenames`. Names without a frame,
    pictures in two lists and pictures that are left out are reported in a line each.

    Args:
        root: the dataset's folder.
        file: the document's path, for messages.
        document: from `load_transforms`.
        images: of the frames.
        missing: names of frames whose image does not exist.

    Raises:
        DatasetError: a list is not one of names, or none of its names has a frame.
    """
    known = {*images, *(_resolved(root, file, name) for name in missing)}
    train, val, test = (_listed(root, file, document, f"{part}_filenames", known) for part in ("train", "val", "test"))
    if not (train or val or test):
        has_empty_lists = any(document.get(f"{part}_filenames") is not None for part in ("train", "val", "test"))
        return ["test" if k % HOLD_OUT_EVERY == 0 and not has_empty_lists else "train" for k in range(len(images))]
    held_out = test or val or (set(images) - train)
    if both := [image for image in images if image in held_out and image in train]:
        _report(file, root, both, "in two of its lists and held out, not trained on")
    parts: list[Part] = []
    for image in images:
        trained_on = image in train if train else image not in val
        parts.append("test" if image in held_out else "train" if trained_on else None)
    if left_out := [image for image, part in zip(images, parts, strict=True) if part is None]:
        lists = f"not in train_filenames nor {'test' if test else 'val'}_filenames"
        _report(file, root, left_out, f"{lists if train else 'in val_filenames beside test_filenames'} and left out")
    return parts


def _listed(root: Path, file: Path, document: dict[str, Any], key: str, known: set[Path]) -> set[Path]:
    """Return the files that a list of the document names; empty if it is absent."""
    names = document.get(key)
    names = [] if names is None else names
    if not (isinstance(names, list) and all(isinstance(name, str) for name in names)):
        raise DatasetError(f"{file}: {key} is not a list of names; export it anew")
    listed = {name: _resolved(root, file, name) for name in names}
    unmatched = [name for name, path in listed.items() if path not in known]
    if names and len(unmatched) == len(listed):
        raise DatasetError(f"{file}: {key} names no frame ({first_names(unmatched)}); correct it or remove it")
    if unmatched:
        have = agreeing(len(unmatched), "has", "have")
        notice(f"{file}: {counted(len(unmatched), 'name')} in {key} {have} no frame: {first_names(unmatched)}")
    return set(listed.values())


def _resolved(root: Path, file: Path, name: str) -> Path:
    """Return the image that a name means, or the path that it would have if it does not exist."""
    return find_image(root, file, name) or root / os.path.normpath(name.replace("\\", "/"))


def _report(file: Path, root: Path, images: Sequence[Path], what: str) -> None:
    names = first_names([image.relative_to(root).as_posix() for image in images])
    notice(f"{file}: {counted(len(images), 'picture')} {agreeing(len(images), 'is', 'are')} {what}: {names}")
