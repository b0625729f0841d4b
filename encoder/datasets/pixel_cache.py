"""Caches of decoded pictures, or of masks, on disk, which later runs reuse; and the one that is a flat file.

The other is `packed_cache.PackedCache`.
"""

import copy
import hashlib
import json
import mmap
import os
import shutil
import time
import weakref
from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Self

import google_crc32c
import numpy as np

from kpc.format.common.cli import NO_ROOM, atomic_write
from kpc.format.common.errors import DatasetError
from kpc.format.common.text import byte_text

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


class OpenFile:
    """A file that is open for reading as long as anyone refers to this.

    Whoever reads on sees the content that was opened, even after another process has replaced the file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.fd = os.open(path, os.O_RDONLY)
        weakref.finalize(self, os.close, self.fd)

    @property
    def size(self) -> int:
        return os.fstat(self.fd).st_size

    def read(self, start: int, size: int) -> bytes:
        """Read bytes from `start` on.

        Raises:
            DatasetError: the file has been truncated.
        """
        data = os.pread(self.fd, size, start)
        if len(data) != size:
            raise self.damaged()
        return data

    def damaged(self) -> DatasetError:
        """Return the error to raise where its content is not what was written."""
        return DatasetError(f"{self.path}: shorter than it was, or damaged; delete it, and it will be rebuilt")


class PixelCache(ABC):
    """Decoded pictures on disk, with random access to their pixels.

    A pixel's index counts all pixels of all pictures, picture after picture, row by row.

    Attributes:
        path: of the file or folder.
        tiles: the pictures in it.
        channels: of the pixels as they are returned.
    """

    path: Path
    tiles: tuple[Tile, ...]
    channels: int

    @abstractmethod
    def subset(self, numbers: np.ndarray) -> Self:
        """Return the cache of the given pictures; indices of pixels stay the same."""

    @abstractmethod
    def read(self, indices: np.ndarray) -> np.ndarray:
        """Read pixels by their index, (N,) int64 to (N, channels) uint8.

        Raises:
            DatasetError: the cache was damaged after it had been opened.
        """

    @abstractmethod
    def picture(self, number: int, top: int = 0, bottom: int | None = None) -> np.ndarray:
        """Read a picture, or its rows from `top` up to `bottom`, as (rows, width, channels) uint8. Raises as `read`."""

    @property
    @abstractmethod
    def disk_bytes(self) -> int:
        """The bytes that it takes on disk."""

    @abstractmethod
    def describe(self) -> str:
        """Describe how the pictures are stored, and how large they are, in one line."""


class FlatCache(PixelCache):
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
        self._file = OpenFile(path)
        size = self._file.size
        self._mapped: np.ndarray | None = None
        if 0 < size <= MAPPED_BYTES and size % stored_channels == 0:
            mapping = mmap.mmap(self._file.fd, size, access=mmap.ACCESS_READ)
            self._mapped = np.frombuffer(mapping, np.uint8).reshape(-1, stored_channels)

    def subset(self, numbers: np.ndarray) -> Self:
        chosen = copy.copy(self)
        chosen.tiles = tuple(self.tiles[n] for n in numbers)
        return chosen

    def read(self, indices: np.ndarray) -> np.ndarray:
        if self._mapped is not None:
            return self._mapped[indices][:, : self.channels]
        return read_items(self._file, indices * self._stored, self._stored)[:, : self.channels]

    def picture(self, number: int, top: int = 0, bottom: int | None = None) -> np.ndarray:
        return self._raw(number, top, bottom)[..., : self.channels]

    @property
    def disk_bytes(self) -> int:
        return self._file.size

    def describe(self) -> str:
        return f"{byte_text(self.disk_bytes)}, not compressed, in {self.path}"

    def is_intact(self) -> bool:
        """Return whether the file has the right length and the verified pictures match their CRCs."""
        stored = self._stored
        end = max((t.offset + t.width * t.height for t in self.tiles), default=0) * stored
        if self._file.size != end:
            return False
        every = max(1, -(-end // VERIFIED_BYTES))
        return all(crc_of(self._raw(n)) == self.tiles[n].crc32c for n in range(0, len(self.tiles), every))

    def _raw(self, number: int, top: int = 0, bottom: int | None = None) -> np.ndarray:
        tile = self.tiles[number]
        rows = (tile.height if bottom is None else bottom) - top
        data = self._file.read((tile.offset + top * tile.width) * self._stored, rows * tile.width * self._stored)
        return np.frombuffer(data, np.uint8).reshape(rows, tile.width, self._stored)


def read_items(file: OpenFile, starts: np.ndarray, size: int) -> np.ndarray:
    """Read items of `size` bytes at the given positions of a file, (N,) int64 to (N, size) uint8.

    Raises:
        DatasetError: the file has been truncated.
    """
    fd = file.fd
    data = b"".join([os.pread(fd, size, start) for start in starts.tolist()])
    if len(data) != len(starts) * size:
        raise file.damaged()
    return np.frombuffer(data, np.uint8).reshape(-1, size)


def fingerprint_of(*what: Any) -> str:
    """Return a hash of what a cache is built from; the arguments must be serialisable as JSON."""
    return hashlib.sha256(json.dumps([CACHE_VERSION, *what]).encode()).hexdigest()


def open_cache(path: Path, fingerprint: str) -> FlatCache | None:
    """Open the cache at `path`; return None unless it has this fingerprint and is intact."""
    try:
        description = json.loads(path.with_suffix(".json").read_text())
        if description["fingerprint"] != fingerprint:
            return None
        tiles = tuple(Tile(**tile) for tile in description["tiles"])
        cache = FlatCache(path, tiles, int(description["stored_channels"]), int(description["channels"]))
        return cache if cache.is_intact() else None
    except (FileNotFoundError, ValueError, KeyError, TypeError, AttributeError, DatasetError):
        return None


def build_cache(
    path: Path, fingerprint: str, pictures: Iterable[np.ndarray], channels: int, size_bytes: int
) -> FlatCache:
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
    delete_abandoned(path)
    require_room(path.parent, size_bytes)
    tiles: list[Tile] = []
    offset, is_opaque = 0, channels == 4
    try:
        with atomic_write(path) as temporary, open(temporary, "wb", buffering=0) as file:
            for picture in pictures:
                pixels = with_channels(picture, channels)
                is_opaque = is_opaque and bool((pixels[..., 3] == 255).all())
                write_all(file.fileno(), pixels.data.cast("B"))
                height, width = pixels.shape[:2]
                tiles.append(Tile(offset, width, height, crc_of(pixels)))
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
            raise disk_full(path.parent, size_bytes) from error
        raise
    return FlatCache(path, tuple(tiles), channels, shown)


def require_room(folder: Path, size_bytes: int) -> None:
    """Refuse to write more than fits.

    Raises:
        DatasetError: the disk of `folder` has less space than `size_bytes`.
    """
    if shutil.disk_usage(folder).free < size_bytes:
        raise disk_full(folder, size_bytes)


def disk_full(folder: Path, size_bytes: int) -> DatasetError:
    return DatasetError(
        f"{folder}: the disk is full: decoded pictures need {byte_text(size_bytes)}; free some space, name a folder "
        "on another disk with --cache, or give --downscale 2"
    )


def with_channels(picture: np.ndarray, channels: int) -> np.ndarray:
    """Return a picture of so many channels, contiguous; alpha that it lacks is opaque."""
    if picture.shape[2] < channels:
        picture = np.concatenate([picture, np.full((*picture.shape[:2], 1), 255, np.uint8)], axis=2)
    return np.ascontiguousarray(picture)


def write_all(fd: int, data: memoryview) -> None:
    """Write all of `data`; a single call of the system may write less."""
    while len(data):
        data = data[os.write(fd, data) :]


def crc_of(pixels: np.ndarray) -> int:
    """Return the CRC32C of an array's bytes."""
    return int(google_crc32c.value(pixels.tobytes()))


def delete_abandoned(path: Path) -> None:
    """Delete what killed builds of the file left behind."""
    for leftover in path.parent.glob(f".{path.stem}.*{path.suffix}"):
        if time.time() - leftover.stat().st_mtime > ABANDONED_S:
            leftover.unlink(missing_ok=True)
