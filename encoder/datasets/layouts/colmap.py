"""The layout of COLMAP: a sparse model in `sparse/0/` (or `sparse/`, `sparse/1/`, ...) beside `images/`.

Source: https://colmap.github.io/format.html
"""

from pathlib import Path

from kpc.encoder.datasets.capture import (
    HOLD_OUT_EVERY,
    Capture,
    CapturedView,
    Lens,
    find_image,
    first_names,
    holdout_flags,
    image_view,
    natural_key,
    report_missing,
)
from kpc.encoder.datasets.layouts.colmap_model import ModelImage, count_images, read_cameras, read_images
from kpc.encoder.datasets.left_out import media_in
from kpc.format.common.errors import DatasetError
from kpc.format.common.text import notice

# The layout's name in messages.
NAME = "COLMAP"


def recognise(path: Path) -> bool:
    """Return whether the folder has this layout."""
    return bool(_models(path))


def read(path: Path, holdout: str | None) -> Capture:
    """Read the folder's largest model. Test pictures are every eighth existing image, in natural order of names.

    The model gives neither times nor depth ranges.

    Raises:
        DatasetError: the model is damaged or inconsistent, or a camera model is not understood.
        MediaError: an image cannot be read.
    """
    cameras_file, images_file = _largest(path)
    cameras, images = read_cameras(cameras_file), read_images(images_file)
    images.sort(key=lambda image: natural_key(image.name))
    folder = path / "images"
    found = [(image, find_image(folder, images_file, image.name)) for image in images]
    report_missing(images_file, folder, [image.name for image, file in found if file is None], len(found))
    existing = [(image, file) for image, file in found if file is not None]
    default = [k % HOLD_OUT_EVERY == 0 for k in range(len(existing))]
    tests = holdout_flags(path, [str(file.relative_to(path)) for _, file in existing], holdout, default)
    views = [_view(images_file, cameras, *item, is_test) for item, is_test in zip(existing, tests, strict=True)]
    return Capture(NAME, tuple(views), None, tuple(media_in(folder, recursive=True)))


def _models(path: Path) -> list[tuple[Path, Path]]:
    """Return the files of cameras and images of all models; binary before text, and `sparse/0` before others."""
    sparse = path / "sparse"
    if not sparse.is_dir():
        return []
    numbered = sorted((f for f in sparse.iterdir() if f.is_dir()), key=lambda f: natural_key(f.name))
    files = [(f / f"cameras{kind}", f / f"images{kind}") for f in (*numbered, sparse) for kind in (".bin", ".txt")]
    return [(cameras, images) for cameras, images in files if cameras.is_file() and images.is_file()]


def _largest(path: Path) -> tuple[Path, Path]:
    """Return the files of the model with the most images, the first of equals, and name the other models."""
    models = _models(path)
    if len(models) == 1:
        return models[0]
    counts = [count_images(images) for _, images in models]
    chosen = counts.index(max(counts))
    shown = [f"{images.relative_to(path).as_posix()} ({n})" for (_, images), n in zip(models, counts, strict=True)]
    largest = shown.pop(chosen)
    notice(f"{path}: of several models the largest is read, {largest}; left out: {first_names(shown)}")
    return models[chosen]


def _view(images_file: Path, cameras: dict[int, Lens], image: ModelImage, file: Path, is_test: bool) -> CapturedView:
    where = f"{images_file} image {image.number}"
    if image.camera not in cameras:
        raise DatasetError(f"{where}: its camera {image.camera} is missing from the model; export the model anew")
    return image_view(file, where, cameras[image.camera], image.camera_to_world, time=None, is_test=is_test)
