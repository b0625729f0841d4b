"""Masks of still images: which pixels may be trained and tested on, kept as bits in a file beside the pixel cache.

For `images/x/name.jpg` the mask is `masks/x/name.jpg.png` (COLMAP's custom) or `masks/x/name.png`; 0 stands for ignored.
"""

import copy
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from kpc.encoder.datasets.capture import CapturedView, file_exists, first_names
from kpc.encoder.datasets.pixel_cache import PixelCache, build_cache, fingerprint_of, open_cache
from kpc.format.common.errors import DatasetError
from kpc.format.common.media import image_size, read_image
from kpc.format.common.progress import Progress

FOLDER = "masks"

BLOCK = 512
"""Pixels that are counted together: 8 bytes of memory each, and 64 bytes to read for every pixel drawn."""

_BITS = np.unpackbits(np.arange(256, dtype=np.uint8)[:, None], axis=1)  # of each byte, in the order of their pixels
_ONES = _BITS.sum(axis=1, dtype=np.int16)
_NTH = np.argsort(1 - _BITS.astype(np.int8), axis=1, kind="stable")  # (256, 8): where a byte's n-th one is


class Masks:
    """Which pixels are usable: a bit each, row by row, every picture filled up with zeros to whole blocks.

    `counts`: (P,) int64, usable pixels of each picture. `crc32c`: of each picture's bits.
    """

    def __init__(self, bits: PixelCache, sizes: Sequence[tuple[int, int]]) -> None:
        self._bits, self._sizes = bits, sizes
        in_block = [_ONES[bits.picture(n)[0]].sum(axis=1) for n in range(len(sizes))]
        self._before = np.concatenate([[0], np.cumsum(np.concatenate(in_block), dtype=np.int64)])  # of all pictures
        self._first_block = np.array([tile.offset for tile in bits.tiles], np.int64)
        self.counts = np.array([ones.sum() for ones in in_block], np.int64)
        self.crc32c = tuple(tile.crc32c for tile in bits.tiles)

    def subset(self, numbers: np.ndarray) -> "Masks":
        """Those of these pictures alone."""
        chosen = copy.copy(self)  # shares the counts of all blocks, whose numbers stay as they are
        chosen._bits, chosen._sizes = self._bits.subset(numbers), [self._sizes[n] for n in numbers]
        chosen._first_block, chosen.counts = self._first_block[numbers], self.counts[numbers]
        chosen.crc32c = tuple(self.crc32c[n] for n in numbers)
        return chosen

    def usable(self, picture: int) -> np.ndarray:
        """(height, width) bool."""
        width, height = self._sizes[picture]
        bits = np.unpackbits(self._bits.picture(picture), count=width * height)
        return bits.astype(bool).reshape(height, width)

    def is_usable(self, picture: np.ndarray, pixel: np.ndarray) -> np.ndarray:
        """Of pixels counted row by row, (N,) as their pictures: (N,) bool."""
        block, bit = np.divmod(pixel, BLOCK)
        data = self._bits.read(self._first_block[picture] + block)
        value = np.take_along_axis(data, bit[:, None] // 8, axis=1)[:, 0]
        return _BITS[value, bit % 8].astype(bool)

    def nth_usable(self, picture: np.ndarray, rank: np.ndarray) -> np.ndarray:
        """Pixels, counted row by row, that are usable number `rank` of their pictures: both (N,), as the result, int64.

        `rank` must be less than `counts[picture]`. Exact, whatever share is masked out.
        """
        first = self._first_block[picture]
        rank = self._before[first] + rank
        block = np.searchsorted(self._before, rank, side="right") - 1
        rank = rank - self._before[block]
        data = self._bits.read(block)
        after = np.cumsum(_ONES[data], axis=1)  # ones up to each byte, itself included
        byte = (after <= rank[:, None]).sum(axis=1)
        value = np.take_along_axis(data, byte[:, None], axis=1)[:, 0]
        rank = rank - np.take_along_axis(after, byte[:, None], axis=1)[:, 0] + _ONES[value]
        return (block - first) * BLOCK + byte * 8 + _NTH[value, rank]


def find_masks(root: Path, views: Sequence[CapturedView]) -> list[Path | None]:
    """The mask of each view, None for videos and where there is none.

    Raises:
        DatasetError: a mask has not the size of its image. MediaError: it cannot be read.
    """
    folder = root / FOLDER
    if not folder.is_dir():
        return [None] * len(views)
    masks = [None if view.video else _find(folder, view.file.relative_to(root)) for view in views]
    for view, mask in zip(views, masks):
        if mask is not None and (size := image_size(mask)[:2]) != (view.width, view.height):
            raise DatasetError(
                f"{mask}: is {size[0]}x{size[1]}, but {view.file.name} is {view.width}x{view.height}; "
                "make the mask anew in that size"
            )
    bare = [view.file.name for view, mask in zip(views, masks) if mask is None and not view.video]
    if bare:
        total = sum(not view.video for view in views)
        print(
            f"{folder}: {len(bare)} of {total} images have no mask and are used whole: {first_names(bare)}",
            file=sys.stderr,
        )
    return masks


def load_masks(
    root: Path, views: Sequence[CapturedView], masks: Sequence[Path | None], file: Path, downscale: int, progress: bool
) -> Masks | None:
    """Read the masks, or open what was read before; None where there are none.

    Args:
        file: where to keep them.
        downscale: a pixel is usable if all downscale^2 of its block are.

    Raises:
        DatasetError: the disk is full. MediaError: a mask cannot be read.
    """
    if not any(masks):
        return None
    sizes = [(view.width // downscale, view.height // downscale) for view in views]
    fingerprint = fingerprint_of([_source(root, mask) for mask in masks], sizes, downscale)
    bits = open_cache(file, fingerprint)
    if bits is None:
        size_bytes = sum(-(-width * height // BLOCK) for width, height in sizes) * BLOCK // 8
        with Progress(f"masks of {root.name}", len(views), "mask", shown=progress) as bar:

            def packed() -> Iterator[np.ndarray]:
                for mask, size in zip(masks, sizes):
                    yield _packed(mask, size, downscale)
                    bar.advance()

            bits = build_cache(file, fingerprint, packed(), BLOCK // 8, size_bytes)
    return Masks(bits, sizes)


def _find(folder: Path, image: Path) -> Path | None:
    inside = Path(*image.parts[1:]) if image.parts[0] == "images" else image
    for candidate in (folder / f"{inside}.png", (folder / inside).with_suffix(".png")):
        if file_exists(candidate):
            return candidate
    return None


def _source(root: Path, mask: Path | None) -> tuple[str, int, int] | None:
    if mask is None:
        return None
    about = mask.stat()
    return mask.relative_to(root).as_posix(), about.st_size, about.st_mtime_ns


def _packed(mask: Path | None, size: tuple[int, int], downscale: int) -> np.ndarray:
    """(1, blocks, BLOCK / 8) uint8."""
    width, height = size
    usable = np.ones((height, width), bool)
    if mask is not None:
        large = read_image(mask)[: height * downscale, : width * downscale, 0] != 0
        usable = large.reshape(height, downscale, width, downscale).all(axis=(1, 3))
    blocks = -(-width * height // BLOCK)
    return np.packbits(np.pad(usable.ravel(), (0, blocks * BLOCK - width * height))).reshape(1, blocks, BLOCK // 8)
