"""All pictures of a dataset, or their masks, decoded once into one flat file that outlasts the run."""

import errno
import hashlib
import json
import mmap
import os
import shutil
import time
import weakref
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import google_crc32c
import numpy as np
from kpc.format.common.cli import atomic_write
from kpc.format.common.errors import DatasetError

CACHE_VERSION = 2

MAPPED_BYTES = 1 << 30
"""Up to this size the cache is mapped into memory, and may all become resident; a larger one is read pixel by pixel."""

VERIFIED_BYTES = 256 << 20
"""How much of a cache is held against its CRCs as it is opened: all of a small one, an even sample of a large one."""


@dataclass(frozen=True)
class Tile:
    """One picture in the cache: `offset` is its first pixel."""

    offset: int
    width: int
    height: int
    crc32c: int


class PixelCache:
    """A flat file of uint8 pixels, `stored_channels` bytes each, picture after picture, row by row.

    A mapping that is read at random drags whole pages in, up to 2 MB for three bytes (kernels with large folios), and
    all of them count as resident. A file larger than `MAPPED_BYTES` is therefore read with pread, which keeps nothing:
    about 1 us a pixel, where the mapping takes 0.1.
    """

    def __init__(self, path: Path, tiles: tuple[Tile, ...], stored_channels: int, channels: int) -> None:
        self.path, self.tiles, self.channels = path, tiles, channels
        self._stored = stored_channels
        self._fd = os.open(path, os.O_RDONLY)
        weakref.finalize(self, os.close, self._fd)
        size = os.fstat(self._fd).st_size
        self._mapped: np.ndarray | None = None
        if 0 < size <= MAPPED_BYTES and size % stored_channels == 0:
            mapping = mmap.mmap(self._fd, size, access=mmap.ACCESS_READ)
            self._mapped = np.frombuffer(mapping, np.uint8).reshape(-1, stored_channels)

    def subset(self, numbers: np.ndarray) -> "PixelCache":
        """These pictures alone, of the same file; indices of pixels stay as they are."""
        return PixelCache(self.path, tuple(self.tiles[n] for n in numbers), self._stored, self.channels)

    def read(self, indices: np.ndarray) -> np.ndarray:
        """Pixels by their index in the cache: (N,) int64 to (N, channels) uint8."""
        if self._mapped is not None:
            return self._mapped[indices][:, : self.channels]
        fd, stored = self._fd, self._stored
        data = b"".join([os.pread(fd, stored, offset) for offset in (indices * stored).tolist()])
        if len(data) != len(indices) * stored:
            raise DatasetError(f"{self.path}: shorter than it was; delete it to have it rebuilt")
        return np.frombuffer(data, np.uint8).reshape(-1, stored)[:, : self.channels]

    def picture(self, number: int, top: int = 0, bottom: int | None = None) -> np.ndarray:
        """A picture, or its rows from `top` up to `bottom`: (rows, width, channels) uint8."""
        return self._raw(number, top, bottom)[..., : self.channels]

    def _raw(self, number: int, top: int = 0, bottom: int | None = None) -> np.ndarray:
        tile = self.tiles[number]
        rows = (tile.height if bottom is None else bottom) - top
        size = rows * tile.width * self._stored
        data = os.pread(self._fd, size, (tile.offset + top * tile.width) * self._stored)
        if len(data) != size:
            raise DatasetError(f"{self.path}: shorter than it was; delete it to have it rebuilt")
        return np.frombuffer(data, np.uint8).reshape(rows, tile.width, self._stored)

    def is_intact(self) -> bool:
        """Whether the file has its length and the pictures checked have their CRCs."""
        stored = self._stored
        end = max((t.offset + t.width * t.height for t in self.tiles), default=0) * stored
        if os.fstat(self._fd).st_size != end:
            return False
        every = max(1, -(-end // VERIFIED_BYTES))
        return all(_crc(self._raw(n)) == self.tiles[n].crc32c for n in range(0, len(self.tiles), every))


def fingerprint_of(*what: Any) -> str:
    """Of what a cache is built from, as far as JSON can hold it, and of how it is built."""
    return hashlib.sha256(json.dumps([CACHE_VERSION, *what]).encode()).hexdigest()


def open_cache(path: Path, fingerprint: str) -> PixelCache | None:
    """The cache at `path`, if it was built from what `fingerprint` stands for and is whole."""
    try:
        about = json.loads(path.with_suffix(".json").read_text())
        if about["fingerprint"] != fingerprint:
            return None
        tiles = tuple(Tile(**tile) for tile in about["tiles"])
        cache = PixelCache(path, tiles, int(about["stored_channels"]), int(about["channels"]))
        return cache if cache.is_intact() else None
    except (FileNotFoundError, ValueError, KeyError, TypeError, AttributeError, DatasetError):
        return None


def build_cache(
    path: Path, fingerprint: str, pictures: Iterable[np.ndarray], channels: int, size_bytes: int
) -> PixelCache:
    """Write uint8 (height, width, any number of channels) to `path`, and what is in it to a JSON beside it.

    Pictures without alpha get an opaque one where `channels` is 4; if all prove opaque, the cache gives 3 channels.

    Args:
        size_bytes: an upper bound of what it will take, to refuse early.

    Raises:
        DatasetError: the disk is full.
        MediaError: from `pictures`.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    _sweep(path)
    too_small = f"{path.parent}: the disk is full: decoded pictures need {size_bytes / 1e9:.1f} GB; give --downscale 2"
    if shutil.disk_usage(path.parent).free < size_bytes:
        raise DatasetError(too_small)
    tiles: list[Tile] = []
    offset, is_opaque = 0, channels == 4
    try:
        with atomic_write(path) as aside, open(aside, "wb", buffering=0) as file:
            for picture in pictures:
                pixels = _with_channels(picture, channels)
                is_opaque = is_opaque and bool((pixels[..., 3] == 255).all())
                _write_all(file.fileno(), pixels.data.cast("B"))
                height, width = pixels.shape[:2]
                tiles.append(Tile(offset, width, height, _crc(pixels)))
                offset += width * height
        shown = 3 if is_opaque else channels
        about = {
            "fingerprint": fingerprint,
            "stored_channels": channels,
            "channels": shown,
            "tiles": [asdict(tile) for tile in tiles],
        }
        with atomic_write(path.with_suffix(".json")) as aside:
            aside.write_text(json.dumps(about))
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise DatasetError(too_small) from error
        raise
    return PixelCache(path, tuple(tiles), channels, shown)


def _with_channels(picture: np.ndarray, channels: int) -> np.ndarray:
    if picture.shape[2] < channels:
        picture = np.concatenate([picture, np.full((*picture.shape[:2], 1), 255, np.uint8)], axis=2)
    return np.ascontiguousarray(picture)


def _write_all(fd: int, data: memoryview) -> None:
    while len(data):
        data = data[os.write(fd, data) :]


def _crc(pixels: np.ndarray) -> int:
    return int(google_crc32c.value(pixels.tobytes()))


def _sweep(path: Path) -> None:
    """Delete what builds that were killed left behind; a build that lives wrote within the last minutes."""
    for leftover in path.parent.glob(f".{path.stem}.*{path.suffix}"):
        if time.time() - leftover.stat().st_mtime > 600:
            leftover.unlink(missing_ok=True)
