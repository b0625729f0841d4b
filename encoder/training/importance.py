"""Which pixels are drawn more often than others: those that change, as far as cameras that stand still can tell.

Importance sampling by temporal difference, IST: DyNeRF (arXiv:2103.02597), K-Planes (arXiv:2301.10241, section 3.4). The loss
becomes the mean over what is drawn; nothing is weighed back, as in both papers: that would undo the purpose.
"""

from collections.abc import Iterator
from functools import reduce

import numpy as np
from kpc.encoder.datasets import Dataset

SMALLEST_TILE = 8
"""Pixels along the side of a tile; all in one have the same chance."""

MOST_TILES = 1 << 25
"""Tiles are made twice as wide until there are no more than this, a byte each: a long clip takes no more memory than that."""

WINDOW = 25
"""Pictures before and after that one is compared with (K-Planes: 25 frames either way)."""

BAND_BYTES = 1 << 21
"""Of pixels at a time while weights are computed, whatever the length of the clip: what a processor's cache holds."""

_BLOCK = 64
"""Tiles that are counted together: 8 bytes of memory each, and 64 bytes to read for every pixel drawn."""


class TileWeights:
    """A weight for each square tile of each training picture; draws usable pixels with a chance in proportion to it.

    The weight of a pixel is its largest difference in any channel, as a share of the full range, from the same pixel in the
    pictures of the same camera up to WINDOW before and after, but at least `floor`. Colours count as far as they are opaque.
    A tile has the mean over its usable pixels, in 8 bits and at least 1, so it is drawn as often as they would be one by one;
    0 without any.

    Memory: 1 byte a tile, and 8 a block of 64; so 0.018 bytes a pixel, and 36 MiB at most.
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
        """(P,) int64, tiles of all pictures up to each, itself included."""
        self.weights = np.zeros(-(-int(self.ends[-1]) // _BLOCK) * _BLOCK, np.uint8)
        """Row by row, picture by picture, filled up with 0 to whole blocks."""
        starts = self.ends - tiles
        for numbers in group_by_camera(dataset):
            for some, row, weights in _tile_weights(dataset, numbers, floor, self.tile):
                place = np.searchsorted(self.train, some)
                first = starts[place] + row // self.tile * self.across[place]
                self.weights[first[:, None] + np.arange(weights[0].size)] = weights.reshape(len(some), -1)
        self._block_ends = np.cumsum(self.weights.reshape(-1, _BLOCK).sum(1, dtype=np.int64))

    def draw(self, rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """`count` usable training pixels: numbers of their pictures, rows and columns, all (count,) int64.

        What falls on a pixel that is masked out or beyond the picture's edge is drawn again.
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
        """As `draw`, with pixels that are not there or not usable: (3, count) int64."""
        mass = rng.integers(self._block_ends[-1], size=count)
        block = np.searchsorted(self._block_ends, mass, side="right")
        up_to = np.cumsum(self.weights.reshape(-1, _BLOCK)[block], axis=1, dtype=np.int64)
        inside = mass - (self._block_ends[block] - up_to[:, -1])
        tile = block * _BLOCK + (up_to <= inside[:, None]).sum(1)
        place = np.searchsorted(self.ends, tile, side="right")
        down, along = np.divmod(tile - np.where(place > 0, self.ends[place - 1], 0), self.across[place])
        below, beside = np.divmod(rng.integers(self.tile * self.tile, size=count), self.tile)
        return np.stack([self.train[place], self.tile * down + below, self.tile * along + beside])

    def _tiles(self) -> np.ndarray:
        """How many of the present size each training picture has: (P,) int64."""
        width, height = self.dataset.pictures.width[self.train], self.dataset.pictures.height[self.train]
        return (-(-width // self.tile)).astype(np.int64) * -(-height // self.tile)

    def _usable(self, picture: np.ndarray, row: np.ndarray, column: np.ndarray) -> np.ndarray:
        pictures = self.dataset.pictures
        usable: np.ndarray = (row < pictures.height[picture]) & (column < pictures.width[picture])
        there = np.flatnonzero(usable)
        pixel = row[there] * pictures.width[picture[there]] + column[there]
        usable[there] = self.dataset.is_usable(picture[there], pixel)
        return usable


def has_static_cameras(dataset: Dataset) -> bool:
    """Whether every training camera of a moving scene has several pictures, so that one can be compared with another."""
    return dataset.is_dynamic and all(len(numbers) > 1 for numbers in group_by_camera(dataset))


def group_by_camera(dataset: Dataset) -> list[np.ndarray]:
    """The training pictures of one pose, lens and size in the order of their times, for each there is."""
    pictures = dataset.pictures
    train = np.flatnonzero(~pictures.is_test)
    train = train[np.argsort(pictures.time[train], kind="stable")]
    kinds = np.stack([pictures.camera[train], pictures.width[train], pictures.height[train]], axis=1)
    _, kind = np.unique(kinds, axis=0, return_inverse=True)
    return [train[kind == k] for k in range(int(kind.max()) + 1)]


def _tile_weights(
    dataset: Dataset, numbers: np.ndarray, floor: float, tile: int
) -> Iterator[tuple[np.ndarray, int, np.ndarray]]:
    """For (K,) pictures of one camera, part by part: some of them, a row of pixels, and the uint8 weights of their tiles from
    that row on, (pictures, rows of tiles, tiles across)."""
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
    """The largest |a - b| over channels and over the pictures b up to `radius` before and after each picture a.

    (K, H, W, C) uint8 to (K, H, W) uint8.
    """
    above = _running(np.maximum, pictures, radius) - pictures
    below = pictures - _running(np.minimum, pictures, radius)
    return reduce(
        np.maximum, np.moveaxis(np.maximum(above, below), 3, 0)
    )  # max(axis=3) takes four times as long in all


def _running(extreme: np.ufunc, values: np.ndarray, radius: int) -> np.ndarray:
    """Maximum or minimum over 2 radius + 1 neighbours along the first axis, fewer at its ends.

    Spans double in length until two of them, laid over one another, make the whole.
    """
    length = 2 * radius + 1
    ends = ((radius, radius),) + ((0, 0),) * (values.ndim - 1)
    spans, span = np.pad(values, ends, mode="edge"), 1  # an end lies within the window of all it is added to
    while 2 * span <= length:
        spans, span = extreme(spans[:-span], spans[span:]), 2 * span
    return extreme(spans[: len(values)], spans[length - span : length - span + len(values)])


def premultiply_alpha(picture: np.ndarray) -> np.ndarray:
    """Straight alpha multiplied in: what is transparent has no colour that could change."""
    if picture.shape[2] == 3:
        return picture
    alpha = picture[..., 3:].astype(np.uint16)
    return np.concatenate([((picture[..., :3] * alpha + 127) // 255).astype(np.uint8), picture[..., 3:]], axis=2)


def _tile_means(values: np.ndarray, usable: np.ndarray, tile: int) -> np.ndarray:
    """(K, H, W) uint8 to the rounded means over the usable pixels of each tile, at least 1; 0 where there are none."""
    count, height, width = values.shape
    tall, wide = -(-height // tile), -(-width // tile)
    sums = np.zeros((2, count, tall, wide), np.uint32)
    for total, kind in zip(sums, (values * usable, usable)):
        padded = np.pad(kind.view(np.uint8), ((0, 0), (0, tall * tile - height), (0, wide * tile - width)))
        for j, i in np.ndindex(tile, tile):
            total += padded[:, j::tile, i::tile]
    total, area = sums
    return np.maximum((total + area // 2) // np.maximum(area, 1), area > 0).astype(np.uint8)
