"""A cache of decoded pictures, or of masks: one flat file on disk that later runs reuse."""

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

from kpc.format.common.cli import NO_ROOM, atomic_write
from kpc.format.common.errors import DatasetError

# Part of every fingerprint: caches of another version are rebuilt.
CACHE_VERSION = 4

# Caches up to this size are mapped into memory and may become resident entirely; larger ones are read pixel by pixel.
MAPPED_BYTES = 1 << 30

# Bytes of a cache that are verified against their CRCs on opening: all of a small one, an even sample of a large one.
VERIFIED_BYTES = 256 << 20

# Files of interrupted builds are deleted after this many seconds without a write: a live build writes more often.
ABANDONED_S = 600


@dataclass(frozen=True)
class Tile:
    """One picture in the cache.

    Attributes:
        offset: index of its first pixel.
        width, height: pixels.
        crc32c: checksum of its bytes.
    """

    offset: int
    width: int
    height: int
    crc32c: int


class PixelCache:
    """A flat file of uint8 pixels, picture after picture, row by row.

    Small files are mapped into memory; large ones are read with pread, so that they do not become resident
    (docs/design/datasets.md).

    Args:
        path: of the file.
        tiles: the pictures in it.
        stored_channels: bytes per pixel in the file.
        channels: how many of them are returned.
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
        """Return the cache of the given pictures in the same file; indices of pixels stay the same."""
        return PixelCache(self.path, tuple(self.tiles[n] for n in numbers), self._stored, self.channels)

    def read(self, indices: np.ndarray) -> np.ndarray:
        """Read pixels by their index in the cache, (N,) int64 to (N, channels) uint8.

        Raises:
            DatasetError: the file has been truncated.
        """
        if self._mapped is not None:
            return self._mapped[indices][:, : self.channels]
        fd, stored = self._fd, self._stored
        data = b"".join([os.pread(fd, stored, offset) for offset in (indices * stored).tolist()])
        if len(data) != len(indices) * stored:
            raise DatasetError(f"{self.path}: shorter than it was; delete it, and it will be rebuilt")
        return np.frombuffer(data, np.uint8).reshape(-1, stored)[:, : self.channels]

    def picture(self, number: int, top: int = 0, bottom: int | None = None) -> np.ndarray:
        """Read a picture, or its rows from `top` up to `bottom`, as (rows, width, channels) uint8."""
        return self._raw(number, top, bottom)[..., : self.channels]

    def _raw(self, number: int, top: int = 0, bottom: int | None = None) -> np.ndarray:
        tile = self.tiles[number]
        rows = (tile.height if bottom is None else bottom) - top
        size = rows * tile.width * self._stored
        data = os.pread(self._fd, size, (tile.offset + top * tile.width) * self._stored)
        if len(data) != size:
            raise DatasetError(f"{self.path}: shorter than it was; delete it, and it will be rebuilt")
        return np.frombuffer(data, np.uint8).reshape(rows, tile.width, self._stored)

    def is_intact(self) -> bool:
        """Return whether the file has the right length and the verified pictures match their CRCs."""
        stored = self._stored
        end = max((t.offset + t.width * t.height for t in self.tiles), default=0) * stored
        if os.fstat(self._fd).st_size != end:
            return False
        every = max(1, -(-end // VERIFIED_BYTES))
        return all(_crc(self._raw(n)) == self.tiles[n].crc32c for n in range(0, len(self.tiles), every))


def fingerprint_of(*what: Any) -> str:
    """Return a hash of what a cache is built from; the arguments must be serialisable as JSON."""
    return hashlib.sha256(json.dumps([CACHE_VERSION, *what]).encode()).hexdigest()


def open_cache(path: Path, fingerprint: str) -> PixelCache | None:
    """Open the cache at `path`; return None unless it has this fingerprint and is intact."""
    try:
        description = json.loads(path.with_suffix(".json").read_text())
        if description["fingerprint"] != fingerprint:
            return None
        tiles = tuple(Tile(**tile) for tile in description["tiles"])
        cache = PixelCache(path, tiles, int(description["stored_channels"]), int(description["channels"]))
        return cache if cache.is_intact() else None
    except (FileNotFoundError, ValueError, KeyError, TypeError, AttributeError, DatasetError):
        return None


def build_cache(
    path: Path, fingerprint: str, pictures: Iterable[np.ndarray], channels: int, size_bytes: int
) -> PixelCache:
    """Write pictures to `path`, and their description to a JSON file beside it.

    With 4 channels, pictures without alpha become opaque; if all turn out to be opaque, the cache returns 3 channels.

    Args:
        path: of the cache.
        fingerprint: of what it is built from.
        pictures: (height, width, C) uint8.
        channels: channels to store.
        size_bytes: an upper bound of its size, to refuse early if the disk has less space.

    Raises:
        DatasetError: the disk is full.
        MediaError: from `pictures`.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    _delete_abandoned(path)
    disk_full = (
        f"{path.parent}: the disk is full: decoded pictures need {size_bytes / 1e9:.1f} GB; free some space or give "
        "--downscale 2"
    )
    if shutil.disk_usage(path.parent).free < size_bytes:
        raise DatasetError(disk_full)
    tiles: list[Tile] = []
    offset, is_opaque = 0, channels == 4
    try:
        with atomic_write(path) as temporary, open(temporary, "wb", buffering=0) as file:
            for picture in pictures:
                pixels = _with_channels(picture, channels)
                is_opaque = is_opaque and bool((pixels[..., 3] == 255).all())
                _write_all(file.fileno(), pixels.data.cast("B"))
                height, width = pixels.shape[:2]
                tiles.append(Tile(offset, width, height, _crc(pixels)))
                offset += width * height
        shown = 3 if is_opaque else channels
        description = {
            "fingerprint": fingerprint,
            "stored_channels": channels,
            "channels": shown,
            "tiles": [asdict(tile) for tile in tiles],
        }
        with atomic_write(path.with_suffix(".json")) as temporary:
            temporary.write_text(json.dumps(description))
    except OSError as error:
        if error.errno in NO_ROOM:
            raise DatasetError(disk_full) from error
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


def _delete_abandoned(path: Path) -> None:
    """Delete what killed builds left behind."""
    for leftover in path.parent.glob(f".{path.stem}.*{path.suffix}"):
        if time.time() - leftover.stat().st_mtime > ABANDONED_S:
            leftover.unlink(missing_ok=True)
