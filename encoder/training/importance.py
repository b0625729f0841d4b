"""Importance sampling by temporal difference: pixels that change are drawn more often, with static cameras.

IST of DyNeRF (arXiv:2103.02597); K-Planes (arXiv:2301.10241, section 3.4). The loss becomes the mean over the drawn
pixels; as in both papers it is not reweighted, which would undo the purpose.
"""

from collections.abc import Iterator
from functools import reduce

import numpy as np

from kpc.encoder.datasets import Dataset

# Pixels along the side of a tile; all pixels of a tile have the same probability.
SMALLEST_TILE = 8

# Tiles, of a byte each, are doubled in width until there are no more than this, which bounds the memory of long clips.
MOST_TILES = 1 << 25

# Pictures before and after that a picture is compared with (K-Planes: 25).
WINDOW = 25

# Bytes of pixels that are processed at a time while weights are computed: about what the cache holds.
BAND_BYTES = 1 << 21

# Tiles with a common running sum: 8 bytes of memory per block, and 64 bytes to read for every pixel drawn. Sums of the
# tiles of a block are of 16 bits.
_BLOCK = 64


class TileWeights:
    """A weight for each square tile of each training picture; draws usable pixels with probability proportional to it.

    The weight of a pixel is its largest absolute difference in any channel, as a share of the full range, from the same
    pixel in pictures of the same camera up to WINDOW before and after, but at least `floor`. Colours are premultiplied
    by alpha. A tile has the mean over its usable pixels, in 8 bits and at least 1; or 0 without usable pixels.

    It takes a byte per tile and 8 per block of 64 tiles: 0.018 bytes per pixel, and 36 MiB at most.

    Attributes:
        train: (P,) int64, the training pictures.
        tile: pixels along the side of a tile.
        across: (P,) int64, tiles along a row of each picture.
        ends: (P,) int64, tiles of all pictures up to and including each.
        weights: uint8, row by row, picture by picture, zero-padded to whole blocks.
    """

    def __init__(self, dataset: Dataset, floor: float) -> None:
        """Read all training pictures of a dataset for which `has_static_cameras`, a band at a time."""
        self.dataset = dataset
        pictures = dataset.pictures
        self.train = np.flatnonzero(~pictures.is_test)
        self.tile = SMALLEST_TILE
        while (tiles := self._tiles()).sum() > MOST_TILES and self.tile < max(
            pictures.width.max(), pictures.height.max()
        ):
            self.tile *= 2
        self.across = -(-pictures.width[self.train] // self.tile)
        self.ends = np.cumsum(tiles)
        self.weights = np.zeros(-(-int(self.ends[-1]) // _BLOCK) * _BLOCK, np.uint8)
        starts = self.ends - tiles
        for numbers in group_by_camera(dataset):
            for some, row, weights in _tile_weights(dataset, numbers, floor, self.tile):
                picture = np.searchsorted(self.train, some)
                first = starts[picture] + row // self.tile * self.across[picture]
                self.weights[first[:, None] + np.arange(weights[0].size)] = weights.reshape(len(some), -1)
        self._block_ends = np.cumsum(self.weights.reshape(-1, _BLOCK).sum(1, dtype=np.int64))

    def draw(self, rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Draw `count` usable training pixels.

        Pixels that are masked out or beyond the picture's edge are drawn again.

        Returns:
            Numbers of the pictures, rows and columns, (count,) int64 each.
        """
        found: list[np.ndarray] = []
        missing = count
        while missing:
            drawn = self._draw_any(rng, missing)
            found.append(drawn[:, self._usable(*drawn)])
            missing -= found[-1].shape[1]
        picture, row, column = np.concatenate(found, axis=1)
        return picture, row, column

    def _draw_any(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Draw as `draw` does, including pixels that do not exist or are not usable: (3, count) int64."""
        mass = rng.integers(self._block_ends[-1], size=count)
        block = np.searchsorted(self._block_ends, mass, side="right")
        running = np.cumsum(self.weights.reshape(-1, _BLOCK)[block], axis=1, dtype=np.uint16)
        inside = (mass - self._block_ends[block] + running[:, -1]).astype(np.uint16)
        tile = block * _BLOCK + np.count_nonzero(running <= inside[:, None], axis=1)
        picture = np.searchsorted(self.ends, tile, side="right")
        tile_row, tile_column = np.divmod(tile - np.where(picture > 0, self.ends[picture - 1], 0), self.across[picture])
        row, column = np.divmod(rng.integers(self.tile * self.tile, size=count), self.tile)
        return np.stack([self.train[picture], self.tile * tile_row + row, self.tile * tile_column + column])

    def _tiles(self) -> np.ndarray:
        """Return how many tiles of the current size each training picture has, (P,) int64."""
        width, height = self.dataset.pictures.width[self.train], self.dataset.pictures.height[self.train]
        return (-(-width // self.tile)).astype(np.int64) * -(-height // self.tile)

    def _usable(self, picture: np.ndarray, row: np.ndarray, column: np.ndarray) -> np.ndarray:
        """Return whether pixels exist and are usable, (count,) bool."""
        pictures = self.dataset.pictures
        usable: np.ndarray = (row < pictures.height[picture]) & (column < pictures.width[picture])
        there = np.flatnonzero(usable)
        pixel = row[there] * pictures.width[picture[there]] + column[there]
        usable[there] = self.dataset.is_usable(picture[there], pixel)
        return usable


def has_static_cameras(dataset: Dataset) -> bool:
    """Return whether every training camera of a moving scene has several pictures, which can then be compared."""
    return dataset.is_dynamic and all(len(numbers) > 1 for numbers in group_by_camera(dataset))


def group_by_camera(dataset: Dataset) -> list[np.ndarray]:
    """Return the training pictures of each camera and picture size, in the order of their times."""
    pictures = dataset.pictures
    train = np.flatnonzero(~pictures.is_test)
    train = train[np.argsort(pictures.time[train], kind="stable")]
    kinds = np.stack([pictures.camera[train], pictures.width[train], pictures.height[train]], axis=1)
    _, kind = np.unique(kinds, axis=0, return_inverse=True)
    return [train[kind == k] for k in range(int(kind.max()) + 1)]


def _tile_weights(
    dataset: Dataset, numbers: np.ndarray, floor: float, tile: int
) -> Iterator[tuple[np.ndarray, int, np.ndarray]]:
    """Compute the tile weights of the pictures `numbers` (K,) of one camera, part by part.

    Yields:
        Some of the pictures, the first row of pixels, and their weights from that row on, (pictures, tile rows, tile
        columns) uint8.
    """
    pictures, pixels = dataset.pictures, dataset.pixels
    width, height = int(pictures.width[numbers[0]]), int(pictures.height[numbers[0]])
    rows = max(1, BAND_BYTES // (4 * WINDOW * tile * width * pixels.channels)) * tile
    for start in range(0, len(numbers), 2 * WINDOW):
        some = numbers[start : start + 2 * WINDOW]
        first = max(start - WINDOW, 0)
        near = numbers[first : start + 3 * WINDOW]
        for row in range(0, height, rows):
            band = np.stack([premultiply_alpha(pixels.picture(int(p), row, min(row + rows, height))) for p in near])
            changes = max_temporal_difference(band, WINDOW)[start - first :][: len(some)]
            usable = np.stack([dataset.usable(int(p))[row : row + rows] for p in some])
            yield some, row, _tile_means(np.maximum(changes, np.uint8(round(255 * floor))), usable, tile)


def max_temporal_difference(pictures: np.ndarray, radius: int) -> np.ndarray:
    """Return the largest |a - b| over channels and over the pictures b up to `radius` before and after each picture a.

    Args:
        pictures: (K, H, W, C) uint8.

    Returns:
        (K, H, W) uint8.
    """
    above = _running(np.maximum, pictures, radius) - pictures
    below = pictures - _running(np.minimum, pictures, radius)
    return reduce(np.maximum, np.moveaxis(np.maximum(above, below), 3, 0))  # max(axis=3) takes four times as long


def _running(extreme: np.ufunc, values: np.ndarray, radius: int) -> np.ndarray:
    """Return the maximum or minimum over 2 radius + 1 neighbours along the first axis, fewer at its ends.

    Windows double in length until two of them, overlapping, cover the whole.
    """
    length = 2 * radius + 1
    ends = ((radius, radius),) + ((0, 0),) * (values.ndim - 1)
    spans, span = (
        np.pad(values, ends, mode="edge"),
        1,
    )  # an end lies within the window of all pictures that it is added to
    while 2 * span <= length:
        spans, span = extreme(spans[:-span], spans[span:]), 2 * span
    return extreme(spans[: len(values)], spans[length - span : length - span + len(values)])


def premultiply_alpha(picture: np.ndarray) -> np.ndarray:
    """Return a picture (H, W, 3 or 4) uint8 with premultiplied alpha: colours that are transparent do not count."""
    if picture.shape[2] == 3:
        return picture
    alpha = picture[..., 3:].astype(np.uint16)
    return np.concatenate([((picture[..., :3] * alpha + 127) // 255).astype(np.uint8), picture[..., 3:]], axis=2)


def _tile_means(values: np.ndarray, usable: np.ndarray, tile: int) -> np.ndarray:
    """Return the rounded means of (K, H, W) uint8 over the usable pixels of each tile: at least 1, or 0 without any."""
    count, height, width = values.shape
    tall, wide = -(-height // tile), -(-width // tile)
    sums = np.zeros((2, count, tall, wide), np.uint32)
    for total, kind in zip(sums, (values * usable, usable), strict=True):
        padded = np.pad(kind.view(np.uint8), ((0, 0), (0, tall * tile - height), (0, wide * tile - width)))
        for j, i in np.ndindex(tile, tile):
            total += padded[:, j::tile, i::tile]
    total, area = sums
    return np.maximum((total + area // 2) // np.maximum(area, 1), area > 0).astype(np.uint8)
