"""The outer shape of a .kpc file: header, chunk index, chunks (spec/kpc-format.md, sections 3 and 4).

    header (64 bytes) | index (chunk_count entries of 40 bytes) | chunk 0 | chunk 1 | ...        little-endian, no gaps

Files of version 1 hold the index as it is, those of version 2 as a zstd frame of its columns.
Everything is covered by a CRC32C: the header by its own, the index by one in the header, a chunk by one in its entry.
This module knows nothing of scenes: a chunk is a kind, a place in the scene, and bytes.
"""

import io
import os
import struct
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, Protocol, runtime_checkable

import google_crc32c
import numpy as np
import zstandard
from kpc.format.common.errors import FormatError

MAGIC = b"\x89KPC\r\n\x1a\n"
PLAIN_VERSION, VERSION = 1, 2
READABLE_VERSIONS = (0, PLAIN_VERSION, VERSION)
"""Files of the draft, version 0, are as those of version 1 but for the number."""
HEADER = struct.Struct("<8sHHIQIIQQIIII")
ENTRY = struct.Struct("<4sHBBIIHHIIIQ")
TOLD = ENTRY.size - 8
"""Bytes of an entry that version 2 tells: all but the offset, which follows from the lengths before it."""

CODEC_RAW, CODEC_ZSTD, CODEC_SYMBOLS, CODEC_MIDPOINTS = range(4)
CODEC_THIRD = CODEC_MIDPOINTS
"""Of planes, which have no midpoints."""
ZSTD_LEVEL = 19

LEAST_CHUNK = 8
"""Bytes that a file of version 2 has for each of its chunks, at least; in one of version 1 each takes ENTRY.size. So few bytes cannot claim
many chunks."""
EXPANSION_LIMIT = 32768
"""Decoded bytes a byte of file may stand for (zstd's own limit): a small file cannot claim a huge scene."""
CHUNK_LIMIT = 1 << 16
"""Chunks a file may hold."""
DEFAULT_BUDGET = 2 << 30
"""Bytes a reader allows a decoded scene unless told otherwise."""


@runtime_checkable
class Source(Protocol):
    """Where a file's bytes come from: a disk, memory, or HTTP range requests."""

    name: str
    size: int

    def read_at(self, offset: int, length: int) -> bytes:
        """`length` bytes from `offset`, fewer only at the end."""

    def will_read(self, offset: int, length: int) -> None:
        """The next reads lie within these bytes, in order; a source to which each costs a journey may fetch them in one."""


@runtime_checkable
class RemoteSource(Source, Protocol):
    """A source behind a network (`kpc.format.container.http.HttpSource`, which takes a while to import)."""

    attempts: float
    report: Callable[[str | None], None]

    @property
    def received_bytes(self) -> int:
        """Bytes that came so far."""

    @property
    def has_ranges(self) -> bool:
        """False if the server sends whole files only."""

    def clone(self) -> "RemoteSource":
        """The same file, for another thread to read at the same time."""

    def interrupt(self) -> None:
        """Something else is wanted sooner: what another thread is reading fails with InterruptedRead, as soon as may be. What came
        of it is kept for when it is read again."""

    def discard(self) -> None:
        """Read anew what is asked for next: it came damaged."""

    def close(self) -> None:
        """Let go of the connection; what is being read fails."""


@dataclass(frozen=True)
class Header:
    """The first 64 bytes.

    Attributes:
        version: of the format.
        index_length, chunk_count: of the index that follows.
        file_length: size of the whole file, bytes.
        value_count: numbers in all planes together, the limit a reader checks against its memory budget.
        largest_raw: the largest raw length of any chunk, bytes.
        index_crc: CRC32C of the index.
    """

    version: int
    index_length: int
    chunk_count: int
    file_length: int
    value_count: int
    largest_raw: int
    index_crc: int


@dataclass(frozen=True)
class Entry:
    """One chunk, as the index lists it.

    Attributes:
        kind: four letters; the first is a capital if no reader may ignore the chunk.
        group, scale, plane, row_start, row_count: the place in the scene of a plane segment, or in the clip of a group, whose rows
            are frames (`kpc.format.container.groups`); 0 for other kinds.
        codec: how the stored bytes become the raw ones.
        stored_length, offset: where it lies in the file. raw_length: bytes once decoded. crc: of the stored bytes.
    """

    kind: str
    group: int
    scale: int
    plane: int
    row_start: int
    row_count: int
    codec: int
    stored_length: int
    raw_length: int
    crc: int
    offset: int = 0

    @property
    def is_critical(self) -> bool:
        return self.kind[0].isupper()


@dataclass(frozen=True)
class Chunk:
    """One chunk to be written: its place and its raw bytes, cut where their statistics change.

    Some have other forms besides, context-coded: `coded` makes them, by codec, which takes a while; they stand for `symbol_count` symbols
    or bytes.
    """

    kind: str
    parts: Sequence[bytes]
    scale: int = 0
    plane: int = 0
    row_start: int = 0
    row_count: int = 0
    coded: Mapping[int, Callable[[], bytes]] = field(default_factory=dict)
    symbol_count: int = 0


def pack(chunks: Sequence[Chunk], value_count: int, *, compress: bool = True, version: int = VERSION) -> bytes:
    """Lay chunks out in the given order; each is stored in what is smallest: raw, context-coded if it can be, or as a zstd
    frame (of planes only if they cannot).

    Args:
        value_count: numbers in all planes together.
        compress: False stores every chunk raw, and the index as it is.
        version: the newest that may be written; 1 has no other index than that.

    Raises:
        FormatError: the result would break a limit that every reader checks.
    """
    if len(chunks) > CHUNK_LIMIT:
        raise FormatError(
            f"{len(chunks)} chunks are more than the {CHUNK_LIMIT} that a file may have; use fewer and longer segments"
        )
    entries, bodies = [], []
    for chunk in chunks:
        raw = b"".join(chunk.parts)
        forms = [(raw, CODEC_RAW, len(raw))]
        for codec, make in chunk.coded.items() if compress else ():
            body = make()
            if chunk.symbol_count <= len(body) * EXPANSION_LIMIT:
                forms.append((body, codec, chunk.symbol_count))
        if compress and (
            chunk.kind != "PLNE" or len(forms) == 1
        ):  # zstd would double the time, and never beats symbols of planes
            forms += [(frame, CODEC_ZSTD, len(raw)) for frame in _zstd_frames(chunk.parts)]
        body, codec, length = min(forms, key=lambda form: len(form[0]))
        entries.append(
            Entry(
                chunk.kind,
                0,
                chunk.scale,
                chunk.plane,
                chunk.row_start,
                chunk.row_count,
                codec,
                len(body),
                length,
                google_crc32c.value(body),
            )
        )
        bodies.append(body)
    data = b"".join([header_and_index(entries, value_count, version if compress else PLAIN_VERSION), *bodies])
    if max(value_count, *(entry.raw_length for entry in entries)) > len(data) * EXPANSION_LIMIT:
        raise FormatError(
            f"the scene is too empty for its size: {value_count:,} values in {len(data):,} bytes; "
            "choose a lower resolution"
        )
    return data


def header_and_index(entries: Sequence[Entry], value_count: int, version: int = PLAIN_VERSION) -> bytes:
    """How a file begins that holds the chunks of these entries, which need not know their offsets; as one of version 1 if a later one
    would not be smaller."""
    index, stored = _plain_index(entries), sum(entry.stored_length for entry in entries)
    if version == VERSION:
        told = zstandard.ZstdCompressor(level=ZSTD_LEVEL).compress(in_columns(index))
        if len(told) < len(index) and len(told) + stored >= LEAST_CHUNK * len(entries):
            index = told
        else:
            version = PLAIN_VERSION
    file_length = HEADER.size + len(index) + stored
    header = HEADER.pack(
        MAGIC,
        version,
        0,
        HEADER.size,
        HEADER.size,
        len(index),
        len(entries),
        file_length,
        value_count,
        max((entry.raw_length for entry in entries), default=0),
        0,
        google_crc32c.value(index),
        0,
    )
    return b"".join([header[:-4], struct.pack("<I", google_crc32c.value(header[:-4])), index])


def _plain_index(entries: Sequence[Entry]) -> bytes:
    """As files of version 1 hold it."""
    offset, parts = HEADER.size + ENTRY.size * len(entries), []
    for e in entries:
        parts.append(
            ENTRY.pack(
                e.kind.encode("ascii"),
                e.group,
                e.scale,
                e.plane,
                e.row_start,
                e.row_count,
                e.codec,
                0,
                e.stored_length,
                e.raw_length,
                e.crc,
                offset,
            )
        )
        offset += e.stored_length
    return b"".join(parts)


def in_columns(index: bytes) -> bytes:
    """What the frame of those of version 2 holds: byte 0 of all entries of a plain index, then byte 1 of all, ..., but for offsets."""
    return np.frombuffer(index, np.uint8).reshape(-1, ENTRY.size)[:, :TOLD].T.tobytes()


def _zstd_frames(parts: Sequence[bytes]) -> list[bytes]:
    """The same bytes as zstd frames of several kinds; which is smallest depends on the data.

    Noise tempts the parser into short matches that cost more than they save, hence the longer minimum; a block boundary
    after each part gives it a Huffman table of its own.
    """
    raw = b"".join(parts)
    long_matches = zstandard.ZstdCompressionParameters.from_level(ZSTD_LEVEL, source_size=len(raw), min_match=7)
    stream = zstandard.ZstdCompressor(compression_params=long_matches).compressobj(size=len(raw))
    blocks = [stream.compress(part) + stream.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK) for part in parts]
    return [
        zstandard.ZstdCompressor(level=ZSTD_LEVEL).compress(raw),
        zstandard.ZstdCompressor(compression_params=long_matches).compress(raw),
        b"".join([*blocks, stream.flush()]),
    ]


class Reader:
    """Random access to the chunks of a .kpc file.

    Opening reads the header and the index (two reads, at the very start of the file) and nothing else.

    Args:
        source: a path, an http or https URL, the bytes themselves, a binary file object that can seek, or a `Source`; or a `Reader`
            of it, whose header and index are taken over.
        allow_partial: accept a file whose end is missing; `available` tells which chunks are there.

    Attributes:
        header, index: what the file says of itself, verified.
        name: of the file, for messages.

    Raises:
        FormatError: not a .kpc file, of another version, damaged, or with limits its size does not bear out.
    """

    def __init__(self, source: "AnySource | Reader", *, allow_partial: bool = False):
        self._reading = threading.Lock()
        if isinstance(source, Reader):
            self.source, self.name, self.header, self.index = source.source, source.name, source.header, source.index
            return
        self.source = open_source(source)
        self.name = self.source.name
        self.header = self._read_header(allow_partial)
        self.index = self._read_index()

    def _read_header(self, allow_partial: bool) -> Header:
        head = self.source.read_at(0, HEADER.size)
        if head[: len(MAGIC)] != MAGIC[: len(head)] or not head:
            raise FormatError(f"{self.name}: not a .kpc file")
        if len(head) < HEADER.size:
            raise FormatError(f"{self.name}: cut off within the header; fetch the file again")
        (
            _,
            version,
            flags,
            header_length,
            index_offset,
            index_length,
            chunk_count,
            file_length,
            value_count,
            largest_raw,
            reserved,
            index_crc,
            header_crc,
        ) = HEADER.unpack(head)
        if version not in READABLE_VERSIONS:
            raise FormatError(f"{self.name}: format version {version}, this reader knows up to {VERSION}; update kpc")
        if google_crc32c.value(head[:-4]) != header_crc:
            raise FormatError(f"{self.name}: the header is damaged (its CRC32C differs); fetch the file again")
        if flags or reserved or header_length != HEADER.size or index_offset != HEADER.size:
            raise FormatError(f"{self.name}: the header uses reserved fields; update kpc")
        plain = chunk_count * ENTRY.size
        if not 0 < chunk_count <= CHUNK_LIMIT or not (
            index_length < plain if version == VERSION else index_length == plain
        ):
            raise FormatError(f"{self.name}: the header claims {chunk_count} chunks in {index_length} bytes of index")
        if file_length < HEADER.size + LEAST_CHUNK * chunk_count:
            raise FormatError(f"{self.name}: the header claims {chunk_count} chunks in a file of {file_length} bytes")
        if file_length < HEADER.size + index_length:
            raise FormatError(f"{self.name}: the header claims a file of {file_length} bytes, less than its index")
        if self.source.size > file_length:
            raise FormatError(f"{self.name}: {self.source.size - file_length} bytes follow the end of the file")
        if self.source.size < file_length and not allow_partial:
            raise FormatError(
                f"{self.name}: cut off at {self.source.size} of {file_length} bytes; fetch the file again"
            )
        if max(value_count, largest_raw) > file_length * EXPANSION_LIMIT:
            raise FormatError(
                f"{self.name}: claims {value_count:,} values and chunks of {largest_raw:,} bytes, "
                f"more than {file_length:,} bytes can hold"
            )
        return Header(version, index_length, chunk_count, file_length, value_count, largest_raw, index_crc)

    def _read_index(self) -> tuple[Entry, ...]:
        if self.source.size < HEADER.size + self.header.index_length:
            raise FormatError(f"{self.name}: cut off within the chunk index; fetch the file again")
        index = self.source.read_at(HEADER.size, self.header.index_length)
        if google_crc32c.value(index) != self.header.index_crc:
            raise FormatError(f"{self.name}: the chunk index is damaged (its CRC32C differs); fetch the file again")
        entries, expected, has_offsets = [], HEADER.size + len(index), self.header.version != VERSION
        for number, fields in enumerate(ENTRY.iter_unpack(index if has_offsets else self._out_of_columns(index))):
            kind, group, scale, plane, row_start, row_count, codec, reserved, stored, raw, crc, offset = fields
            if not (kind.isascii() and kind.isalpha()):
                raise FormatError(f"{self.name}: chunk {number} has a kind that is not four letters")
            if reserved:
                raise FormatError(f"{self.name}: chunk {number} uses reserved fields; update kpc")
            if has_offsets and offset != expected:
                raise FormatError(f"{self.name}: chunk {number} starts at byte {offset}, not at {expected}")
            if raw > self.header.largest_raw:
                raise FormatError(f"{self.name}: chunk {number} claims {raw:,} bytes, more than the header's limit")
            entries.append(
                Entry(
                    kind.decode("ascii"), group, scale, plane, row_start, row_count, codec, stored, raw, crc, expected
                )
            )
            expected += stored
        if expected != self.header.file_length:
            raise FormatError(f"{self.name}: the chunks end at byte {expected} of {self.header.file_length}")
        return tuple(entries)

    def _out_of_columns(self, index: bytes) -> bytes:
        """The plain index of a frame of its columns, `in_columns`; with offsets of 0."""
        columns = self._unframed(index, self.header.chunk_count * TOLD, "chunk index")
        rows = np.zeros((self.header.chunk_count, ENTRY.size), np.uint8)
        rows[:, :TOLD] = np.frombuffer(columns, np.uint8).reshape(TOLD, -1).T
        return rows.tobytes()

    def available(self, number: int) -> bool:
        """Whether all bytes of a chunk are there; False only in a partial file."""
        entry = self.index[number]
        return entry.offset + entry.stored_length <= self.source.size

    def stored(self, number: int) -> bytes:
        """A chunk as it lies in the file, its CRC32C verified. Several threads may ask; the source is read by one at a time."""
        entry = self.index[number]
        with self._reading:
            body = self.source.read_at(entry.offset, entry.stored_length)
        if len(body) != entry.stored_length:
            raise FormatError(f"{self.name}: chunk {number} ({entry.kind}) is not there; fetch the file again")
        if google_crc32c.value(body) != entry.crc:
            raise FormatError(
                f"{self.name}: chunk {number} ({entry.kind}) is damaged (its CRC32C differs); fetch the file again"
            )
        return body

    def chunk(self, number: int, limit: int | None = None) -> bytes:
        """The raw bytes of a chunk, verified and decoded.

        Args:
            limit: largest raw length the caller is ready for, bytes; checked before anything is allocated.
        """
        entry = self.index[number]
        if limit is not None and entry.raw_length > limit:
            raise FormatError(
                f"{self.name}: chunk {number} ({entry.kind}) claims {entry.raw_length:,} bytes where at "
                f"most {limit:,} make sense"
            )
        body = self.stored(number)
        if entry.codec == CODEC_RAW:
            raw = body
        elif entry.codec == CODEC_ZSTD:
            raw = self._unframed(body, entry.raw_length, f"chunk {number} ({entry.kind})")
        else:
            raise FormatError(
                f"{self.name}: chunk {number} ({entry.kind}) uses codec {entry.codec}, "
                "unknown to this reader; update kpc"
            )
        if len(raw) != entry.raw_length:
            raise FormatError(
                f"{self.name}: chunk {number} ({entry.kind}) holds {len(raw)} bytes, "
                f"not the {entry.raw_length} it claims"
            )
        return raw

    def _unframed(self, body: bytes, length: int, what: str) -> bytes:
        """The content of the zstd frame that the bytes are, of so many bytes."""
        try:
            frame = zstandard.get_frame_parameters(body)
            if frame.content_size != length or frame.dict_id:
                raise FormatError(f"{self.name}: {what}: its zstd frame claims another length")
            return zstandard.ZstdDecompressor().decompress(body, max_output_size=length, allow_extra_data=False)
        except zstandard.ZstdError as error:
            raise FormatError(f"{self.name}: {what} is no valid zstd frame ({error})") from error


class _BytesSource:
    def __init__(self, data: bytes, name: str = "<bytes>"):
        self.data, self.name, self.size = memoryview(data), name, len(data)

    def read_at(self, offset: int, length: int) -> bytes:
        return bytes(self.data[offset : offset + length])

    def will_read(self, offset: int, length: int) -> None:
        """All bytes are at hand."""


class _FileSource:
    """A seekable file object; opened anew for each read when only its path is known."""

    def __init__(self, path: Path | None, file: BinaryIO | None = None):
        self.path, self.file = path, file
        self.name = str(path if path is not None else getattr(file, "name", "<file>"))
        if file is not None:
            self.size = file.seek(0, io.SEEK_END)
        else:
            with open(self.name, "rb") as opened:  # so that an unreadable file is named here, not later
                self.size = opened.seek(0, io.SEEK_END)

    def read_at(self, offset: int, length: int) -> bytes:
        if self.file is not None:
            self.file.seek(offset)
            return self.file.read(length)
        with open(self.name, "rb") as opened:
            opened.seek(offset)
            return opened.read(length)

    def will_read(self, offset: int, length: int) -> None:
        """The operating system reads ahead."""


AnySource = str | os.PathLike[str] | bytes | BinaryIO | Source
"""What `open_source` takes."""


def open_source(source: AnySource, *, limit: int = DEFAULT_BUDGET) -> Source:
    """The bytes behind a path, a URL (`kpc.format.container.http`), or what else a `Reader` takes.

    Args:
        limit: bytes of memory that a file may take whose server sends it as a whole only.
    """
    if isinstance(source, str) and "://" in source:
        from kpc.format.container.http import (
            HttpSource,
            is_url,
        )  # only now: what it takes to speak to servers is slow to load

        if is_url(source):
            return HttpSource(source, limit=limit)
    if isinstance(source, (str, os.PathLike)):
        return _FileSource(Path(source))
    if isinstance(source, (bytes, bytearray, memoryview)):
        return _BytesSource(bytes(source))
    if isinstance(source, Source):
        return source
    return _FileSource(None, source)
