"""Masks of images: which pixels may be used for training and testing. They are cached as bits beside the pixel cache.

The mask of `images/x/name.jpg` is `masks/x/name.jpg.png` (as in COLMAP) or `masks/x/name.png`, or has the suffix of
another image format; black (0) means ignored, as does transparent.
"""

import copy
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from kpc.encoder.datasets.capture import CapturedView, MaskFile, first_names, with_image_suffix
from kpc.encoder.datasets.pixel_cache import PixelCache, build_cache, fingerprint_of, open_cache
from kpc.format.common.errors import DatasetError
from kpc.format.common.images import image_info, read_mask
from kpc.format.common.progress import Progress
from kpc.format.common.text import agreeing, counted, notice

# The folder of masks within a dataset, and how names of instant-ngp's masks begin, which lie beside the images.
FOLDER, DYNAMIC_MASK = "masks", "dynamic_mask_"

# Pixels per block of the rank index: a block takes 8 bytes of memory, and drawing a pixel reads 64 bytes.
BLOCK = 512

# For every byte: its bits in pixel order (256, 8), their sum (256,), and the position of its n-th set bit (256, 8).
_BITS = np.unpackbits(np.arange(256, dtype=np.uint8)[:, None], axis=1)
_ONES = _BITS.sum(axis=1, dtype=np.int16)
_NTH = np.argsort(1 - _BITS.astype(np.int8), axis=1, kind="stable")


class Masks:
    """The usable pixels of all pictures: one bit per pixel, row by row, each picture padded with zeros to whole blocks.

    Attributes:
        counts: (P,) int64, number of usable pixels of each picture.
        crc32c: checksum of each picture's bits.
    """

    def __init__(self, bits: PixelCache, sizes: Sequence[tuple[int, int]]) -> None:
        self._bits, self._sizes = bits, sizes
        in_block = [_ONES[bits.picture(n)[0]].sum(axis=1) for n in range(len(sizes))]
        self._before = np.concatenate(
            [[0], np.cumsum(np.concatenate(in_block), dtype=np.int64)]
        )  # usable pixels before each block
        self._first_block = np.array([tile.offset for tile in bits.tiles], np.int64)
        self.counts = np.array([ones.sum() for ones in in_block], np.int64)
        self.crc32c = tuple(tile.crc32c for tile in bits.tiles)

    def subset(self, numbers: np.ndarray) -> "Masks":
        """Return the masks of the given pictures."""
        chosen = copy.copy(self)  # shares the counts of blocks, whose numbers stay the same
        chosen._bits, chosen._sizes = self._bits.subset(numbers), [self._sizes[n] for n in numbers]
        chosen._first_block, chosen.counts = self._first_block[numbers], self.counts[numbers]
        chosen.crc32c = tuple(self.crc32c[n] for n in numbers)
        return chosen

    def usable(self, picture: int) -> np.ndarray:
        """Return the usable pixels of a picture, (height, width) bool."""
        width, height = self._sizes[picture]
        bits = np.unpackbits(self._bits.picture(picture), count=width * height)
        return bits.astype(bool).reshape(height, width)

    def is_usable(self, picture: np.ndarray, pixel: np.ndarray) -> np.ndarray:
        """Return whether pixels, counted row by row, of the given pictures are usable; (N,) int64 to (N,) bool."""
        block, bit = np.divmod(pixel, BLOCK)
        data = self._bits.read(self._first_block[picture] + block)
        value = np.take_along_axis(data, bit[:, None] // 8, axis=1)[:, 0]
        return _BITS[value, bit % 8].astype(bool)

    def nth_usable(self, picture: np.ndarray, rank: np.ndarray) -> np.ndarray:
        """Return the pixel, counted row by row, that is usable pixel number `rank` of its picture.

        Args:
            picture: (N,) int64.
            rank: (N,) int64, less than `counts[picture]`.

        Returns:
            (N,) int64.
        """
        first = self._first_block[picture]
        rank = self._before[first] + rank
        block = np.searchsorted(self._before, rank, side="right") - 1
        rank = rank - self._before[block]
        data = self._bits.read(block)
        after = np.cumsum(_ONES[data], axis=1)  # set bits up to each byte, inclusive
        byte = (after <= rank[:, None]).sum(axis=1)
        value = np.take_along_axis(data, byte[:, None], axis=1)[:, 0]
        rank = rank - np.take_along_axis(after, byte[:, None], axis=1)[:, 0] + _ONES[value]
        return (block - first) * BLOCK + byte * 8 + _NTH[value, rank]


def find_masks(root: Path, views: Sequence[CapturedView]) -> list[MaskFile | None]:
    """Find the mask of each view; None for videos and for images without one.

    Raises:
        DatasetError: a mask differs in size from its image, or an image has two masks.
        MediaError: a mask cannot be read.
    """
    folder = root / FOLDER
    masks = [None if view.video or view.foreground else _find(root, folder, view) for view in views]
    for view, mask in zip(views, masks, strict=True):
        if mask is not None:
            info, size = image_info(mask.path), (view.width, view.height)
            if size not in ((info.width, info.height), info.displayed_size):
                raise DatasetError(
                    f"{mask.path}: is {info.width}x{info.height}, but {view.file.name} is {view.width}x{view.height}; "
                    "make the mask anew at that size"
                )
    unmasked = [view.file.name for view, mask in zip(views, masks, strict=True) if mask is None and not view.video]
    if any(view.foreground for view in views):
        return masks  # their folder has been read as alpha
    if unmasked and (any(masks) or folder.is_dir()):
        total = sum(not view.video for view in views)
        notice(
            f"{folder if folder.is_dir() else root}: {len(unmasked)} of {counted(total, 'image')} "
            f"{agreeing(len(unmasked), 'has no mask and is', 'have no mask and are')} used entirely: "
            f"{first_names(unmasked)}"
        )
    return masks


def load_masks(
    root: Path,
    views: Sequence[CapturedView],
    masks: Sequence[MaskFile | None],
    file: Path,
    downscale: int,
    progress: bool,
) -> Masks | None:
    """Read the masks, or open their cache; return None if there are none.

    Args:
        root: the dataset's folder.
        views: of the dataset.
        masks: the mask of each view, from `find_masks`.
        file: the cache file.
        downscale: a downscaled pixel is usable if all downscale^2 pixels of its block are.
        progress: whether to report progress on stderr.

    Raises:
        DatasetError: the disk is full.
        MediaError: a mask cannot be read.
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
                for mask, view in zip(masks, views, strict=True):
                    yield _packed(mask, view, downscale)
                    bar.advance()

            bits = build_cache(file, fingerprint, packed(), BLOCK // 8, size_bytes)
    return Masks(bits, sizes)


def _find(root: Path, folder: Path, view: CapturedView) -> MaskFile | None:
    """Return the mask of an image: the one that the dataset's own files name, or the one in the folder of masks."""
    image = view.file.relative_to(root)
    inside = Path(*image.parts[1:]) if image.parts[0] == "images" else image
    beside = with_image_suffix(folder / inside) or with_image_suffix((folder / inside).with_suffix(""))
    if view.mask is None:
        return None if beside is None else MaskFile(beside)
    if beside is not None and not beside.samefile(view.mask.path):
        raise DatasetError(f"{view.file}: has two masks, {beside} and {view.mask.path}; remove one")
    return view.mask


def _source(root: Path, mask: MaskFile | None) -> tuple[str, int, int, bool] | None:
    """Return what identifies the content of a mask: name, size, time of modification, and which values it ignores."""
    if mask is None:
        return None
    stat = mask.path.stat()
    return mask.path.relative_to(root).as_posix(), stat.st_size, stat.st_mtime_ns, mask.marks_ignored


def _packed(mask: MaskFile | None, view: CapturedView, downscale: int) -> np.ndarray:
    """Return the bits of one mask, (1, blocks, BLOCK / 8) uint8; all set if there is no mask."""
    width, height = view.width // downscale, view.height // downscale
    usable: np.ndarray = np.ones((height, width), bool)
    if mask is not None:
        info = image_info(mask.path)
        marked = read_mask(mask.path, upright=(info.width, info.height) != (view.width, view.height))
        large = (marked != mask.marks_ignored)[: height * downscale, : width * downscale]
        usable = large.reshape(height, downscale, width, downscale).all(axis=(1, 3))
    blocks = -(-width * height // BLOCK)
    return np.packbits(np.pad(usable.ravel(), (0, blocks * BLOCK - width * height))).reshape(1, blocks, BLOCK // 8)
