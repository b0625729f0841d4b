"""A cache of compressed pictures for rigs of still cameras, whose pixels are read at random without decoding pictures.

A folder holds parts, each the pictures of one camera or of a few: a file of backgrounds, coded blocks
(`packed_blocks`) and their positions, and a JSON file with sizes and checksums, written when the part is finished. An
interrupted build therefore goes on with the parts that are missing.
"""

import copy
import json
import os
import shutil
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import google_crc32c
import numpy as np

from kpc.encoder.datasets.packed_blocks import (
    SIDE,
    block_bytes,
    blocks_across,
    expand,
    find_background,
    pack,
    residual_of_blocks,
    residual_of_pixels,
)
from kpc.encoder.datasets.pixel_cache import (
    VERIFIED_BYTES,
    OpenFile,
    PixelCache,
    Tile,
    crc_of,
    disk_full,
    fingerprint_of,
    require_room,
    with_channels,
    write_all,
)
from kpc.format.common.cli import NO_ROOM, atomic_write
from kpc.format.common.errors import DatasetError
from kpc.format.common.text import byte_text

# Pictures that share a background: as many as take so much memory while it is found, within these limits.
GROUP_BYTES = 192 << 20
FEWEST, MOST = 8, 64

# Memory that all groups of pictures may take while a cache is built, but for one group, which is always built.
BUILD_BYTES = 768 << 20

# The share of the size of decoded pictures that must be free before they are packed.
EXPECTED_SHARE = 0.25


@dataclass(frozen=True)
class Run:
    """Pictures of one size that a camera took without moving.

    Attributes:
        numbers: of the pictures in the cache.
        decode: returns an iterator over these pictures, (height, width, C) uint8 each.
    """

    numbers: tuple[int, ...]
    decode: Callable[[], Iterator[np.ndarray]]


@dataclass(frozen=True)
class Part:
    """What is built at a time: some runs, and a fingerprint of what they are decoded from."""

    fingerprint: str
    runs: tuple[Run, ...]

    @property
    def numbers(self) -> tuple[int, ...]:
        """The numbers of its pictures in the cache, in the order of the part."""
        return tuple(number for run in self.runs for number in run.numbers)


@dataclass(frozen=True)
class _Record:
    """A run of bytes in the file of a part."""

    start: int
    size: int
    crc32c: int


@dataclass(frozen=True)
class _Picture:
    """A picture in a part: its size, the CRC32C of its pixels, the number of its background, and its coded blocks."""

    width: int
    height: int
    crc32c: int
    background: int
    blocks: _Record


class _OpenPart:
    """The finished file of a part.

    Attributes:
        file: opened.
        is_opaque: whether there is a fourth channel that is 255 everywhere.
        starts: uint32, where each block begins from the first one of its picture on, and where the last ends.
    """

    def __init__(self, path: Path, description: dict[str, Any]) -> None:
        self.file = OpenFile(path)
        self.is_opaque = bool(description["is_opaque"])
        self.backgrounds = [_Record(*record) for record in description["backgrounds"]]
        self.pictures = [
            _Picture(width, height, crc32c, background, _Record(*blocks))
            for width, height, crc32c, background, *blocks in description["pictures"]
        ]
        index = _Record(*description["index"])
        self.is_whole = self.file.size == index.start + index.size and self._verify([index])
        self.starts = np.frombuffer(self.file.read(index.start, index.size), np.uint32) if self.is_whole else None

    def is_intact(self, verified_bytes: int) -> bool:
        """Return whether the file is whole and its index and an even sample of the rest match their checksums."""
        records = [*self.backgrounds, *(picture.blocks for picture in self.pictures)]
        every = max(1, -(-sum(record.size for record in records) // max(verified_bytes, 1)))
        return self.is_whole and self._verify(records[::every])

    def _verify(self, records: Sequence[_Record]) -> bool:
        return all(google_crc32c.value(self.file.read(r.start, r.size)) == r.crc32c for r in records)


class PackedCache(PixelCache):
    """Pictures as backgrounds and compressed blocks of what differs from them.

    Only the positions of blocks are held in memory: 4 bytes for 256 pixels.

    Args:
        path: of the folder.
        numbers: the numbers of the pictures of each part.
        parts: opened.
        stored_channels: channels in the files.
    """

    def __init__(
        self, path: Path, numbers: Sequence[tuple[int, ...]], parts: Sequence[_OpenPart], stored_channels: int
    ) -> None:
        self.path, self._stored = path, stored_channels
        self.channels = 3 if stored_channels == 4 and all(part.is_opaque for part in parts) else stored_channels
        self._files = [part.file for part in parts]
        self._starts = np.concatenate([part.starts for part in parts if part.starts is not None])
        count = sum(map(len, numbers))
        rows = np.zeros((count, 5), np.int64)  # width, height, CRC32C, start of the background, start of the blocks
        self._part = np.zeros(count, np.int64)
        self._first = np.zeros(count, np.int64)  # in `_starts`
        first = 0
        for number, (part, chosen) in enumerate(zip(parts, numbers, strict=True)):
            for picture, n in zip(part.pictures, chosen, strict=True):
                begin = part.backgrounds[picture.background].start
                rows[n] = picture.width, picture.height, picture.crc32c, begin, picture.blocks.start
                self._part[n], self._first[n] = number, first
                first += blocks_across(picture.width) * blocks_across(picture.height) + 1
        self._width, height, crcs, self._background, self._blocks = rows.T
        self._offset = np.cumsum(self._width * height) - self._width * height
        self.tiles = tuple(Tile(*map(int, tile)) for tile in zip(self._offset, self._width, height, crcs, strict=True))
        self._numbers = np.arange(count)

    def subset(self, numbers: np.ndarray) -> Self:
        chosen = copy.copy(self)
        chosen.tiles = tuple(self.tiles[n] for n in numbers)
        chosen._numbers = self._numbers[numbers]
        return chosen

    def read(self, indices: np.ndarray) -> np.ndarray:
        picture = np.searchsorted(self._offset, indices, side="right") - 1
        part, inside = self._part[picture], indices - self._offset[picture]
        row, column = np.divmod(inside, self._width[picture])
        found = self._read_many(part, self._background[picture] + inside * self._stored, self._stored)
        pixels = np.frombuffer(b"".join(found), np.uint8).reshape(-1, self._stored)
        block = self._first[picture] + row // SIDE * -(-self._width[picture] // SIDE) + column // SIDE
        differs = np.flatnonzero(self._starts[block + 1] > self._starts[block])
        if len(differs):
            distinct, one, which = np.unique(block[differs], return_index=True, return_inverse=True)
            start, one = self._starts[distinct].astype(np.int64), differs[one]
            sizes = self._starts[distinct + 1] - start
            coded = self._read_many(part[one], self._blocks[picture[one]] + start, sizes)
            position = (row[differs] % SIDE) * SIDE + column[differs] % SIDE
            pixels = pixels.copy()
            pixels[differs] += residual_of_pixels(self._expand(coded)[which], position)
        return pixels[:, : self.channels]

    def picture(self, number: int, top: int = 0, bottom: int | None = None) -> np.ndarray:
        n, tile = self._numbers[number], self.tiles[number]
        bottom = tile.height if bottom is None else bottom
        across, file = blocks_across(tile.width), self._files[self._part[n]]
        begin, end = top // SIDE, blocks_across(bottom)  # in rows of blocks
        starts = self._starts[self._first[n] + begin * across : self._first[n] + end * across + 1].tolist()
        data = file.read(int(self._blocks[n]) + starts[0], starts[-1] - starts[0])
        ends = [start - starts[0] for start in starts]
        differs = [k for k in range(len(ends) - 1) if ends[k + 1] > ends[k]]
        residual = np.zeros(((end - begin) * across, SIDE, SIDE, self._stored), np.uint8)
        if differs:
            residual[differs] = residual_of_blocks(self._expand([data[ends[k] : ends[k + 1]] for k in differs]))
        rows = residual.reshape(end - begin, across, SIDE, SIDE, -1).swapaxes(1, 2)
        rows = rows.reshape((end - begin) * SIDE, across * SIDE, -1)[top - begin * SIDE :][: bottom - top, : tile.width]
        stride = tile.width * self._stored
        background = file.read(int(self._background[n]) + top * stride, (bottom - top) * stride)
        return (rows + np.frombuffer(background, np.uint8).reshape(rows.shape))[..., : self.channels]

    @property
    def disk_bytes(self) -> int:
        return sum(file.size for file in self._files)

    def describe(self) -> str:
        raw = int(self._offset[-1] + self.tiles[-1].width * self.tiles[-1].height) * self._stored
        return f"{byte_text(raw)}, compressed to {byte_text(self.disk_bytes)}, in {self.path}"

    def _read_many(self, part: np.ndarray, starts: np.ndarray, sizes: np.ndarray | int) -> list[bytes]:
        """Read runs of bytes from the files of the given parts, (N,) each."""
        fds = np.array([file.fd for file in self._files])[part]
        sizes = np.broadcast_to(sizes, starts.shape)
        numbers = zip(fds.tolist(), sizes.tolist(), starts.tolist(), strict=True)
        found = [os.pread(fd, size, start) for fd, size, start in numbers]
        if sum(map(len, found)) != sizes.sum():
            raise self._files[int(part[0])].damaged()
        return found

    def _expand(self, coded: Sequence[bytes]) -> np.ndarray:
        try:
            return expand(coded, self._stored)
        except ValueError as error:
            raise DatasetError(f"{self.path}: is damaged; delete it, and it will be rebuilt") from error


def open_packed(folder: Path, parts: Sequence[Part], channels: int) -> PackedCache | None:
    """Open the cache in a folder; return None unless all parts are there and intact."""
    found = [_open_part(folder, number, part, len(parts)) for number, part in enumerate(parts)]
    whole = [part for part in found if part is not None]
    return PackedCache(folder, [part.numbers for part in parts], whole, channels) if len(whole) == len(parts) else None


def build_packed(
    folder: Path, parts: Sequence[Part], channels: int, raw_bytes: int, advance: Callable[[int], None]
) -> PackedCache:
    """Build the parts that a folder lacks, several at a time, and delete what else is in it.

    Args:
        folder: of the cache; made if it does not exist.
        parts: all of it.
        channels: channels to store; pictures without alpha become opaque.
        raw_bytes: of all pictures, not compressed.
        advance: called with a number of pictures that are done; not by several threads at a time.

    Raises:
        DatasetError: the disk is full.
        MediaError: from decoding.
    """
    folder.mkdir(parents=True, exist_ok=True)
    kept = {path for number in range(len(parts)) for path in _paths(folder, number)}
    for other in set(folder.iterdir()) - kept:
        shutil.rmtree(other) if other.is_dir() else other.unlink()
    missing = [n for n, part in enumerate(parts) if _open_part(folder, n, part, len(parts)) is None]
    total = sum(len(part.numbers) for part in parts)
    left = sum(len(parts[n].numbers) for n in missing)
    advance(total - left)
    require_room(folder, int(EXPECTED_SHARE * raw_bytes * left / total))
    lock, stop = threading.Lock(), threading.Event()

    def done() -> None:
        if stop.is_set():
            raise _Stopped
        with lock:
            advance(1)

    workers = min(os.cpu_count() or 1, max(1, BUILD_BYTES // _group_bytes(raw_bytes // total)))
    try:
        with ThreadPoolExecutor(workers) as pool:  # decoding and compression release the GIL
            jobs = [pool.submit(_build_part, *_paths(folder, n), parts[n], channels, done) for n in missing]
            try:
                for job in as_completed(jobs):
                    job.result()
            except BaseException:
                stop.set()
                raise
    except OSError as error:
        if error.errno in NO_ROOM:
            raise disk_full(folder, raw_bytes) from error
        raise
    cache = open_packed(folder, parts, channels)
    if cache is None:
        raise DatasetError(f"{folder}: what was written there cannot be read back; name another folder with --cache")
    return cache


class _Stopped(Exception):
    """Another part has failed, or the user has stopped the build."""


def _paths(folder: Path, number: int) -> tuple[Path, Path]:
    """Return the paths of a part's file and of its description."""
    return folder / f"{number:04d}.bin", folder / f"{number:04d}.json"


def _group_size(picture_bytes: int) -> int:
    return min(max(GROUP_BYTES // max(picture_bytes, 1), FEWEST), MOST)


def _group_bytes(picture_bytes: int) -> int:
    return max(picture_bytes, 1) * _group_size(picture_bytes)


def _open_part(folder: Path, number: int, part: Part, parts: int) -> _OpenPart | None:
    """Open a part; return None unless it is finished, of this fingerprint, and intact."""
    path, json_path = _paths(folder, number)
    try:
        description = json.loads(json_path.read_text())
        crc32c = description.pop("crc32c")
        if description["fingerprint"] != part.fingerprint or crc32c != _crc_of_description(description):
            return None
        found = _OpenPart(path, description)
        is_intact = len(found.pictures) == len(part.numbers) and found.is_intact(VERIFIED_BYTES // parts)
        return found if is_intact else None
    except (FileNotFoundError, ValueError, KeyError, TypeError, AttributeError, DatasetError):
        return None


def _crc_of_description(description: dict[str, Any]) -> int:
    return int(google_crc32c.value(json.dumps(description, sort_keys=True).encode()))


def _build_part(path: Path, json_path: Path, part: Part, channels: int, done: Callable[[], None]) -> None:
    """Decode and write a part, and then its description; `done` is called after each picture."""
    backgrounds: list[_Record] = []
    pictures: list[tuple[int, ...]] = []
    index: list[np.ndarray] = []
    is_opaque = channels == 4
    with atomic_write(path) as temporary, open(temporary, "wb", buffering=0) as file:

        def write(data: bytes | memoryview) -> _Record:
            start = file.tell()
            write_all(file.fileno(), memoryview(data))
            return _Record(start, len(data), int(google_crc32c.value(bytes(data))))

        for run in part.runs:
            for group in _groups(run, channels):
                background = find_background(group)
                backgrounds.append(write(background.tobytes()))
                for picture in group:
                    is_opaque = is_opaque and bool((picture[..., 3] == 255).all())
                    height, width = picture.shape[:2]
                    coded, ends = pack(picture, background)
                    blocks = write(coded)
                    index += [np.zeros(1, np.uint32), ends]
                    about = (width, height, crc_of(picture), len(backgrounds) - 1)
                    pictures.append((*about, blocks.start, blocks.size, blocks.crc32c))
                    done()
        where = write(np.concatenate(index).tobytes())
    description = {
        "fingerprint": part.fingerprint,
        "is_opaque": is_opaque,
        "backgrounds": [(record.start, record.size, record.crc32c) for record in backgrounds],
        "pictures": pictures,
        "index": (where.start, where.size, where.crc32c),
    }
    with atomic_write(json_path) as temporary:
        temporary.write_text(json.dumps(description | {"crc32c": _crc_of_description(description)}))


def _groups(run: Run, channels: int) -> Iterator[np.ndarray]:
    """Decode a run and yield its pictures in groups of about equal length, (K, H, W, C) uint8.

    The next group overwrites the last: one array is used for all, since memory of many would not return to the system.
    """
    count, number, ends = len(run.numbers), 0, [0]
    group = np.empty(0, np.uint8)
    for decoded in run.decode():
        picture = with_channels(decoded, channels)
        if number == 0:
            groups = -(-count // _group_size(picture.nbytes))
            ends = [k * count // groups for k in range(groups + 1)]
            group = np.empty((-(-count // groups), *picture.shape), np.uint8)
        group[number - ends[0]] = picture
        number += 1
        if number == ends[1]:
            yield group[: number - ends.pop(0)]


def part_fingerprint(*what: Any) -> str:
    """Return the fingerprint of a part that is decoded from `what`, which must be serialisable as JSON."""
    return fingerprint_of("packed", block_bytes(1), *what)
