"""The layout of nerfstudio and instant-ngp: one `transforms.json` with intrinsics, distortion, times and split.

Source: https://docs.nerf.studio/quickstart/data_conventions.html
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from kpc.encoder.datasets.capture import Capture, CapturedView, first_names, holdout_flags, natural_key
from kpc.encoder.datasets.layouts.splits import split_of
from kpc.encoder.datasets.layouts.transforms import (
    CLOCK,
    clip_frames,
    films_of,
    find_images,
    frame_rate,
    frame_view,
    load_transforms,
    report_contradictions,
)
from kpc.encoder.datasets.left_out import media_in
from kpc.format.common.errors import DatasetError
from kpc.format.common.media_files import is_video
from kpc.format.common.text import notice
from kpc.format.scene.camera_checks import number_of

# The layout's name in messages.
NAME = "nerfstudio"

# What a document of `kpposes` says it was made by.
MADE_BY = "kpposes"


def recognise(path: Path) -> bool:
    """Return whether the folder has this layout."""
    return (path / "transforms.json").is_file()


def read(path: Path, holdout: str | None, transforms: Path | None = None, footage: Path | None = None) -> Capture:
    """Read the folder. Test pictures are what the document lists, else every eighth existing image (`split_of`).

    With `holdout`, the document's lists are ignored, and all other pictures are trained on. A document of `kpposes`
    names the videos of cameras that stand still; all are trained on.

    Args:
        path: the folder.
        holdout: as for `holdout_flags`.
        transforms: the document, if it lies elsewhere.
        footage: the folder of the videos from which the images were taken, if it is another.

    Raises:
        DatasetError, MediaError: the JSON, an image or a video cannot be used.
    """
    file = transforms or path / "transforms.json"
    document = load_transforms(file)
    found = find_images(path, file, document)
    missing = [frame["file_path"] for number, frame in enumerate(document["frames"]) if number not in found]
    existing = sorted(found.items(), key=lambda item: natural_key(item[1].relative_to(path).as_posix()))
    images = [image for _, image in existing]
    films = [image for image in images if is_video(image)]
    if films and len(films) < len(images):
        raise DatasetError(
            f"{file}: lists videos ({first_names([film.name for film in films])}) beside images; give one"
        )
    if films:
        holdout = holdout or "none"
    else:
        report_contradictions(file, document, images[0])
    split = split_of(path, file, document, images, missing) if holdout is None else ["train"] * len(images)
    default = [part == "test" for part in split]
    tests = holdout_flags(path, [str(image.relative_to(path)) for image in images], holdout, default)
    views = tuple(
        frame_view(path, file, number, document, image, is_test)
        for (number, image), part, is_test in zip(existing, split, tests, strict=True)
        if part is not None
    )
    left_out = tuple(image for image, part in zip(images, split, strict=True) if part is None)
    in_folders = tuple(media for folder in sorted({image.parent for image in images}) for media in media_in(folder))
    is_ours = document.get("made_by") == MADE_BY
    clocked = [image.name for number, image in found.items() if document["frames"][number].keys() & CLOCK]
    if clocked and not films:
        notice(
            f"{file}: warning: {' and '.join(CLOCK)} of {first_names(clocked)} have no effect: they are for "
            "videos, while images have a time of their own"
        )
    views = _named_by_folder(path, views) if is_ours else views
    fps, frame_count = frame_rate(file, document), clip_frames(file, document)
    sources = films_of(footage or path, file, document)
    start_s = number_of(str(file), document, "start_s") if sources else None
    if is_ours:
        _warn_of_changes(file, document, found, footage or path)
    return Capture(NAME, views, fps, in_folders, left_out, is_ours, frame_count, sources, start_s)


def _warn_of_changes(file: Path, document: dict[str, Any], found: Mapping[int, Path], footage: Path) -> None:
    """Say which files have another size than when `kpposes` found their cameras.

    Args:
        file: the document, for messages.
        document: from `load_transforms`.
        found: files by the numbers of their frames.
        footage: the folder of the videos that the document lists.
    """
    entries = [(document["frames"][number], image) for number, image in found.items()]
    entries += [(video, footage / video["file_path"]) for video in document.get("videos") or ()]
    changed = [
        media.name
        for entry, media in entries
        if isinstance(entry.get("bytes"), int) and media.is_file() and media.stat().st_size != entry["bytes"]
    ]
    if changed:
        notice(
            f"{file}: warning: {first_names(changed)} changed since kpposes found the cameras, which may be wrong now; "
            "run it again"
        )


def _named_by_folder(path: Path, views: tuple[CapturedView, ...]) -> tuple[CapturedView, ...]:
    """Name the pictures of several cameras by their folders, too, where the files alone do not: "cam00/000012"."""
    if len({view.file.stem for view in views}) == len(views):
        return views
    names = [view.file.relative_to(path).with_suffix("").as_posix() for view in views]
    if len({name.partition("/")[0] for name in names}) == 1:  # the folder into which `kpposes` wrote all frames
        names = [name.partition("/")[2] for name in names]
    return tuple(replace(view, camera=view.camera or name) for view, name in zip(views, names, strict=True))
