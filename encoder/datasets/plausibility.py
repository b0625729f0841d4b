"""Signs that a dataset is not what its owner thinks, from a cheap look at its pictures and cameras.

Each is reported in one line before training; none is an error, since each has a harmless explanation, too.
"""

from collections.abc import Iterator

import numpy as np

from kpc.encoder.datasets.capture import first_names
from kpc.encoder.datasets.dataset import Dataset
from kpc.format.common.text import agreeing, counted

# Pictures that are looked at, evenly spread over all of them, and rows of each.
PICTURES, ROWS = 256, 8

# Pictures of one colour are verified by reading all of their pixels; only so many of them.
VERIFIED = 8

# A picture is of one colour if no channel varies by more than this many of its 255 levels.
FLAT = 2

# Pictures are nearly black if no value exceeds this: those of a camera of 12 bits have at most 15 of 255 where its
# values are stored in 16 bits as they are.
DARK = 16

# Pictures of cameras far apart are alike if they differ by less than this share of what a shift by a pixel changes, and
# than this share of what pictures usually differ by. Cameras are far apart by this share of their mean distance from
# the middle.
ALIKE, ALIKE_OF_MEDIAN, FAR_APART = 0.5, 0.25, 0.5


def doubts(dataset: Dataset) -> Iterator[str]:
    """Yield a line for each sign that the result will mean less than it seems; none for good data.

    Reads at most PICTURES times ROWS rows and VERIFIED whole pictures, one at a time. Equal pictures are found by the
    checksums of the cache.
    """
    yield from _flat_pictures(dataset)
    yield from _dark_pictures(dataset)
    yield from _equal_pictures(dataset)
    yield from _alike_pictures(dataset)
    yield from _cameras(dataset)


def _flat_pictures(dataset: Dataset) -> Iterator[str]:
    """Doubt pictures of one colour, or without anything opaque."""
    looked_at = _spread(len(dataset.pictures))
    flat = [n for n in looked_at if _is_flat(dataset, n, ROWS)]
    if not flat or not all(_is_flat(dataset, n) for n in flat[:VERIFIED]):
        return
    is_empty = dataset.has_alpha and dataset.pixels.picture(flat[0])[..., 3].max() <= FLAT
    of_one = "shows nothing (it is transparent)" if is_empty else "is of one colour"
    of_more = "show nothing (they are transparent)" if is_empty else "are of one colour"
    names = first_names(list(dict.fromkeys(dataset.pictures.file[n] for n in flat)))
    of_all = agreeing(len(flat), "the only picture", "all pictures")
    share = of_all if len(flat) == len(looked_at) else f"{len(flat)} of {counted(len(looked_at), 'picture')}"
    meaning = agreeing(len(flat), of_one, of_more)
    yield f"{share} looked at {meaning}: {names}; check these files"


def _is_flat(dataset: Dataset, number: int, rows: int | None = None) -> bool:
    """Return whether a picture, or `rows` of its rows, is of one colour; what is fully transparent does not count."""
    pixels = _rows(dataset, number, rows)
    if dataset.has_alpha:
        if pixels[..., 3].max() <= FLAT:
            return True
        pixels = np.where(pixels[..., 3:] > 0, pixels, pixels[pixels[..., 3] > 0][0])
    return bool(np.ptp(pixels.reshape(-1, pixels.shape[2]), axis=0).max() <= FLAT)


def _rows(dataset: Dataset, number: int, rows: int | None) -> np.ndarray:
    """Return a picture, or `rows` of its rows, evenly spread: (rows, W, C) uint8."""
    height = int(dataset.pictures.height[number])
    if rows is None or rows >= height:
        return dataset.pixels.picture(number)
    tops = np.linspace(0, height - 1, rows).astype(int)
    return np.concatenate([dataset.pixels.picture(number, top, top + 1) for top in tops.tolist()])


def _dark_pictures(dataset: Dataset) -> Iterator[str]:
    """Doubt pictures that are all nearly black, but not of one colour."""
    looked_at = _spread(len(dataset.pictures))
    brightest = 0
    for n in looked_at:
        brightest = max(brightest, int(_rows(dataset, n, ROWS)[..., :3].max()))
        if brightest > DARK:
            return
    if not all(_is_flat(dataset, n, ROWS) for n in looked_at):
        yield (
            f"all pictures looked at are nearly black: no value exceeds {brightest} of 255; scale 16-bit files of a "
            "camera of 10 or 12 bits to the whole range"
        )


def _spread(count: int) -> list[int]:
    """Return at most PICTURES of so many numbers, evenly spread."""
    return sorted({int(n) for n in np.linspace(0, count - 1, min(count, PICTURES)).round()})


def _equal_pictures(dataset: Dataset) -> Iterator[str]:
    """Doubt test pictures that are training pictures, and cameras in different places that show the same."""
    pictures = dataset.pictures
    by_content: dict[tuple[int, int, int], list[int]] = {}
    for number, tile in enumerate(dataset.pixels.tiles):
        by_content.setdefault((tile.crc32c, tile.width, tile.height), []).append(number)
    equal = [numbers for numbers in by_content.values() if len(numbers) > 1]
    trained = [n for numbers in equal if not pictures.is_test[numbers].all() for n in numbers if pictures.is_test[n]]
    trained = [n for n in trained if not _is_flat(dataset, n, ROWS)]
    if trained:
        names = first_names(list(dict.fromkeys(pictures.file[n] for n in trained)))
        yield (
            f"{len(trained)} of {counted(int(pictures.is_test.sum()), 'test picture')} "
            f"{agreeing(len(trained), 'is', 'are')} also trained on: {names}; what is "
            "measured on them means nothing"
        )
    train = [[n for n in numbers if not pictures.is_test[n]] for numbers in equal]
    pairs: dict[tuple[int, int], int] = {}
    for numbers in train:
        cameras = sorted(set(pictures.camera[numbers].tolist()))
        if len(cameras) > 1 and not _is_flat(dataset, numbers[0], ROWS):
            pairs.setdefault((cameras[0], cameras[1]), numbers[0])
    if pairs:
        cameras_named = [" and ".join(dataset.camera_names[c] for c in pair) for pair in pairs]
        yield f"cameras in different places show the same picture: {first_names(cameras_named)}; check these files"


def _alike_pictures(dataset: Dataset) -> Iterator[str]:
    """Doubt cameras in different places that show about the same at the same time, such as one video encoded twice."""
    p = dataset.pictures
    of_camera: dict[int, int] = {}  # the picture of each camera that is nearest to the middle of the clip
    for n in np.argsort(np.abs(p.time - 0.5), kind="stable").tolist():
        of_camera.setdefault(int(p.camera[n]), n)
    cameras = sorted(of_camera)
    numbers = [of_camera[cameras[k]] for k in _spread(len(cameras))]
    centres = p.camera_to_world[numbers, :3, 3]
    far = FAR_APART * np.linalg.norm(centres - centres.mean(axis=0), axis=1).mean()
    keys = [(int(p.width[n]), int(p.height[n]), float(p.time[n])) for n in numbers]
    for key in set(keys):
        chosen = [k for k, other in enumerate(keys) if other == key]
        rows = np.stack([_rows(dataset, numbers[k], ROWS)[..., :3].astype(np.float32) for k in chosen])
        flat, shifts = rows.reshape(len(rows), -1), ((rows[:, :, 1:] - rows[:, :, :-1]) ** 2).sum(axis=(1, 2, 3))
        power = (flat**2).sum(axis=1)
        first, second = np.triu_indices(len(rows), 1)
        squares = np.maximum((power[:, None] + power - 2 * flat @ flat.T)[first, second], 0)
        ratios = np.sqrt(squares / np.maximum(shifts[first], 1e-9))
        if not len(ratios):
            continue
        distances = np.linalg.norm(centres[chosen][first] - centres[chosen][second], axis=1)
        is_alike = (ratios < min(ALIKE, ALIKE_OF_MEDIAN * float(np.median(ratios)))) & (distances > far)
        for i, j in zip(first[is_alike].tolist(), second[is_alike].tolist(), strict=True):
            pair = [numbers[chosen[k]] for k in (i, j)]
            if len({dataset.pixels.tiles[n].crc32c for n in pair}) == 2:
                names = " and ".join(first_names([dataset.camera_names[int(p.camera[n])]]) for n in pair)
                yield f"cameras far apart show nearly the same picture: {names}; check these files"
                return


def _cameras(dataset: Dataset) -> Iterator[str]:
    """Doubt cameras that coincide, look past their picture, or lack the depth range that others have."""
    p = dataset.pictures
    _, first, count = np.unique(
        np.stack([p.camera.astype(np.float64), p.time], axis=1), axis=0, return_index=True, return_counts=True
    )
    if (count > 1).any():
        names = first_names([p.file[n] for n in sorted(first[count > 1])])
        yield f"several pictures of the same time have the same pose: {names}; check the calibration"
    size = np.stack([p.width, p.height], axis=1)
    outside = ((p.intrinsics[:, 2:] < 0) | (p.intrinsics[:, 2:] > size)).any(axis=1)
    if outside.any():
        names = first_names(list(dict.fromkeys(p.file[n] for n in np.flatnonzero(outside))))
        yield f"the principal point lies outside of {counted(int(outside.sum()), 'picture')}: {names}; check cx and cy"
    known = np.isfinite(p.near) & np.isfinite(p.far)
    if (np.isfinite(p.near) | np.isfinite(p.far)).any() and not known.all():
        yield (
            f"near and far are known for {int(known.sum())} of {len(p)} pictures only, so the box does not follow from "
            "them; give them for all or none"
        )
