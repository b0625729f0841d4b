"""Which file belongs to which row of a table of poses that names none.

LLFF writes the rows in the plain order of names, and whoever reads them sorts names alike: cam1, cam10, cam2. Tables
made by hand may be in natural order: cam1, cam2, cam10. Where the two differ, the pictures decide
(docs/design/datasets.md).
"""

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from kpc.encoder.datasets.capture import natural_key, printable
from kpc.encoder.datasets.video import read_video
from kpc.format.common.images import read_image
from kpc.format.common.media_files import is_video
from kpc.format.common.text import notice

# Orders of names in which rows may have been written, by what they sort: the first is LLFF's own.
ORDERS: dict[str, Callable[[str], Any]] = {
    "plain order of names": os.fsencode,
    "natural order of names": natural_key,
    "order of names without regard to case": lambda name: natural_key(name.casefold()),
}

# At most so many files are compared, evenly spread, as pictures of this size.
COMPARED_FILES = 64
THUMBNAIL = (16, 12)

# Each picture is compared with those of this many nearest cameras.
NEIGHBOURS = 2

# Another order is taken if neighbours then differ by less than this share of what they differ by in plain order.
CLEARLY_LESS = 0.95


def in_row_order(table: Path, files: Sequence[Path], centres: np.ndarray, directions: np.ndarray) -> list[Path]:
    """Return the files in the order of the rows, and say in one line if it had to be decided.

    Args:
        table: the file of poses, for messages.
        files: images or videos, as many as there are rows.
        centres: (N, 3) position of the camera in each row.
        directions: (N, 3) its viewing direction, a unit vector.

    Raises:
        MediaError: a file cannot be read.
    """
    orders: dict[str, list[Path]] = {}
    for name, key in ORDERS.items():
        order = sorted(files, key=lambda file: (key(file.name), os.fsencode(file.name)))
        if order not in orders.values():
            orders[name] = order
    plain = next(iter(orders.values()))
    if len(orders) == 1:
        return plain
    chosen = [plain[n] for n in np.linspace(0, len(plain) - 1, min(len(plain), COMPARED_FILES)).astype(int)]
    pictures = np.stack([_thumbnail(file) for file in chosen])
    cost = {}
    for name, order in orders.items():
        row_of = {file: n for n, file in enumerate(order)}
        rows = [row_of[file] for file in chosen]
        cost[name] = neighbour_difference(centres[rows], directions[rows], pictures)
    default = next(iter(orders))
    ranked = sorted(orders, key=lambda name: cost[name])
    why = ranked[0] if cost[ranked[0]] < CLEARLY_LESS * cost[default] else default
    order, other = orders[why], orders[next(name for name in (default, *ranked) if name != why)]
    row = next(n for n, (file, another) in enumerate(zip(order, other, strict=True)) if file != another)
    reason = "" if why == default else ", by which neighbouring cameras see more alike"
    notice(
        f"{table}: rows belong to files in the {why}{reason}: row {row} to {printable(order[row].name)}, not to "
        f"{printable(other[row].name)}; if not, rename the files so that their order is that of the rows"
    )
    return order


def neighbour_difference(centres: np.ndarray, directions: np.ndarray, pictures: np.ndarray) -> float:
    """Return the mean difference between each picture and those of its nearest cameras.

    The distance of two cameras is that of their centres plus that of their directions, each in units of its mean
    distance from the mean.

    Args:
        centres, directions: (N, 3).
        pictures: (N, ...) float.
    """
    flat = pictures.reshape(len(pictures), -1)
    spread = np.linalg.norm(centres - centres.mean(axis=0), axis=1).mean()
    turn = np.linalg.norm(directions - directions.mean(axis=0), axis=1).mean()
    total = 0.0
    for n in range(len(flat)):
        distance = np.linalg.norm(centres - centres[n], axis=1) / max(spread, 1e-9)
        distance += np.linalg.norm(directions - directions[n], axis=1) / max(turn, 1e-9)
        distance[n] = np.inf
        nearest = np.argsort(distance, kind="stable")[:NEIGHBOURS]
        total += float(np.sqrt(((flat[nearest] - flat[n]) ** 2).mean(axis=1)).mean())
    return total / len(flat)


def _thumbnail(file: Path) -> np.ndarray:
    """Return an image, or the first frame of a video, on white and reduced to THUMBNAIL, (12, 16, 3) float64."""
    picture = next(read_video(file, stop=1)) if is_video(file) else read_image(file)
    image = Image.fromarray(picture)
    if image.mode == "RGBA":
        image = Image.alpha_composite(Image.new("RGBA", image.size, "white"), image)
    return np.asarray(image.convert("RGB").resize(THUMBNAIL, Image.Resampling.BOX), np.float64)
