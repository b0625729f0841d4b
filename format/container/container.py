"""The outer structure of a .kpc file: header, chunk index, chunks (spec/kpc-format.md, "Container").

    header (48 bytes) | index (a zstd frame) | chunk 0 | chunk 1 | ...        little-endian, no gaps

A CRC32C covers everything: the header has its own, that of the index is in the header, that of a chunk in its index
entry. This module does not know what a scene is: a chunk is a kind, a position in the scene, and bytes.
"""

import struct
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum

import google_crc32c
import numpy as np

from kpc.format.common.errors import FormatError
from kpc.format.container.sources import AnySource, RemoteSource, Source, open_source

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

MAGIC = b"\x89KPC\r\n\x1a\n"
VERSION = 1
HEADER = struct.Struct("<8sHHIIIQQII")  # see `Header`; the last field is the CRC32C of those before
ENTRY = struct.Struct("<4sHBBIIHIII")  # see `Entry`; the offset is not stored
VERSION_STRUCT = struct.Struct("<8sHH")  # magic, version, header_length: their positions never change

ZSTD_LEVEL = 19
# Frames of any window are read: what they take is bounded by the size of their content.
ZSTD_OPTIONS: dict[int, int] = {
    zstd.DecompressionParameter.window_log_max: zstd.DecompressionParameter.window_log_max.bounds()[1]
}
ZSTD_BLOCK = 1 << 17  # bytes of a block of a zstd frame, at most (RFC 8878)

# Bytes of file for each chunk, at least, so that a small file cannot claim many chunks.
MIN_CHUNK_BYTES = 8
# Bytes of index that a file may have: this and INDEX_BYTES_PER_CHUNK for each chunk.
INDEX_BYTES, INDEX_BYTES_PER_CHUNK = 64, 40
# Decoded bytes that a byte of file may stand for (zstd's own limit), so that a small file cannot claim a huge scene.
EXPANSION_LIMIT = 32768
CHUNK_LIMIT = 1 << 16  # chunks in a file


class Codec(IntEnum):
    """How the stored bytes of a chunk become its raw ones.

    `raw_length` is the number of symbols under PREDICTIVE and TRANSFORM, else the bytes that the content takes under
    RAW.
    """

    RAW = 0  # the content itself
    ZSTD = 1  # one zstd frame
    PREDICTIVE = 2  # plane segments: residuals of predictions, context-coded
    TRANSFORM = 3  # plane segments: levels of DCT blocks, context-coded
    MOTION = 4  # the motion grid, coarse to fine
    OCCUPANCY = 5  # the occupancy grid
    WEIGHTS = 6  # weights of a decoder
    POSES = 7  # cameras
    SHARED = 8  # plane segments in a group: nothing, since a shared plane beside the groups is meant


@dataclass(frozen=True)
class Header:
    """The first 48 bytes.

    Attributes:
        version: of the format.
        chunk_count, index_length, index_crc: number of chunks; size in bytes and CRC32C of the index.
        file_length: size of the whole file in bytes.
        value_count: numbers in all planes together, which a reader checks against its memory budget.
        largest_raw: the largest raw length of any chunk.
    """

    version: int
    chunk_count: int
    index_length: int
    index_crc: int
    file_length: int
    value_count: int
    largest_raw: int


@dataclass(frozen=True)
class Entry:
    """One chunk, as the index lists it.

    Attributes:
        kind: four letters; the first is a capital if no reader may ignore the chunk.
        group, scale, plane, row_start, row_count: position of a plane segment in the scene, or of a group in the
            clip, whose rows are frames (`kpc.format.container.groups`); 0 for other kinds.
        codec: a `Codec`, or a number that this reader does not know.
        stored_length, offset: size and position in the file, in bytes.
        raw_length: size once decoded, see `Codec`.
        crc: CRC32C of the stored bytes.
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
    """One chunk to be written.

    Attributes:
        kind, scale, plane, row_start, row_count: as of `Entry`.
        raw: the content under `Codec.RAW`.
        codec, encode: another codec that the content has, and the function that encodes with it, which may take a
            while.
        raw_length: the raw length under that codec; None: that of `raw`.
    """

    kind: str
    raw: bytes
    scale: int = 0
    plane: int = 0
    row_start: int = 0
    row_count: int = 0
    codec: Codec = Codec.RAW
    encode: Callable[[], bytes] | None = field(default=None, compare=False)
    raw_length: int | None = None


@dataclass(frozen=True)
class Beside:
    """A chunk that several groups of a clip share.

    Attributes:
        chunk: its number in the index of the clip.
        name: for messages.
        is_there: whether all its bytes are.
    """

    chunk: int
    name: str
    is_there: bool


@dataclass(frozen=True)
class StoredChunk:
    """One chunk as it lies in a file: its entry, whose offset is of no consequence, and its bytes."""

    entry: Entry
    body: bytes


def pack(chunks: Sequence[Chunk], value_count: int, *, compress: bool = True) -> bytes:
    """Return a file of these chunks in their order, each under the codec with which it is smallest.

    Zstandard is tried for plane segments only where their own codec cannot be used, and never for sound: it would
    double the time and never be smaller.

    Args:
        value_count: numbers in all planes together.
        compress: False stores every chunk raw, and the index without compression.

    Raises:
        FormatError: the result would break a limit that every reader checks.
    """
    _check_count(len(chunks))
    return assemble([store(chunk, compress=compress) for chunk in chunks], value_count, compress=compress)


def store(chunk: Chunk, *, compress: bool = True) -> StoredChunk:
    """Return a chunk as `pack` stores it."""
    body, codec, raw_length = min(_encodings(chunk, compress), key=lambda encoding: len(encoding[0]))
    position = 0, chunk.scale, chunk.plane, chunk.row_start, chunk.row_count
    return StoredChunk(Entry(chunk.kind, *position, codec, len(body), raw_length, google_crc32c.value(body)), body)


def assemble(stored: Sequence[StoredChunk], value_count: int, *, compress: bool = True) -> bytes:
    """Return a file of stored chunks in their order; arguments and errors as for `pack`."""
    _check_count(len(stored))
    entries = [one.entry for one in stored]
    data = b"".join([header_and_index(entries, value_count, compress=compress), *(one.body for one in stored)])
    if max(value_count, *(entry.raw_length for entry in entries)) > len(data) * EXPANSION_LIMIT:
        raise FormatError(
            f"the scene is too empty for its size: {value_count:,} values in {len(data):,} bytes; "
            "choose a lower resolution"
        )
    return data


def _check_count(count: int) -> None:
    if count > CHUNK_LIMIT:
        raise FormatError(
            f"{count} chunks are more than the {CHUNK_LIMIT} that a file may have; use fewer and longer segments"
        )


def _encodings(chunk: Chunk, compress: bool) -> list[tuple[bytes, Codec, int]]:
    """Return the stored bytes of a chunk under each codec that may be used, with the codec and the raw length."""
    found = [(chunk.raw, Codec.RAW, len(chunk.raw))]
    if compress and chunk.encode is not None:
        body, raw_length = chunk.encode(), len(chunk.raw) if chunk.raw_length is None else chunk.raw_length
        if raw_length <= len(body) * EXPANSION_LIMIT:
            found.append((body, chunk.codec, raw_length))
    if compress and chunk.kind != "soun" and (chunk.kind != "PLNE" or len(found) == 1):
        found += [(frame, Codec.ZSTD, len(chunk.raw)) for frame in _zstd_frames(chunk.raw)]
    return found


def _zstd_frames(raw: bytes) -> list[bytes]:
    """Return two zstd frames of the same bytes; in noise, short matches cost more than they save, hence one with long
    ones only.
    """
    parameter = zstd.CompressionParameter
    long_matches: dict[int, int] = {parameter.compression_level: ZSTD_LEVEL, parameter.min_match: 7}
    return [zstd.compress(raw, level=ZSTD_LEVEL), zstd.compress(raw, options=long_matches)]


def header_and_index(entries: Sequence[Entry], value_count: int, *, compress: bool = True) -> bytes:
    """Return the beginning of a file that holds the chunks of these entries, whose offsets are ignored.

    Args:
        compress: False makes the size of the index a function of the number of chunks alone, `stored_frame`.
    """
    table, stored = transposed_entries(entries), sum(entry.stored_length for entry in entries)
    index = stored_frame(table)
    if compress:
        compressed = zstd.compress(table, level=ZSTD_LEVEL)
        if len(compressed) + stored >= MIN_CHUNK_BYTES * len(entries):
            index = min(compressed, index, key=len)
    fields = HEADER.pack(
        MAGIC,
        VERSION,
        HEADER.size,
        len(entries),
        len(index),
        google_crc32c.value(index),
        HEADER.size + len(index) + stored,
        value_count,
        max((entry.raw_length for entry in entries), default=0),
        0,
    )[:-4]
    return b"".join([fields, struct.pack("<I", google_crc32c.value(fields)), index])


def transposed_entries(entries: Sequence[Entry]) -> bytes:
    """Return the content of the index: byte 0 of all entries, then byte 1 of all, and so on."""
    rows = b"".join(
        ENTRY.pack(
            e.kind.encode("ascii"),
            e.group,
            e.scale,
            e.plane,
            e.row_start,
            e.row_count,
            e.codec,
            e.stored_length,
            e.raw_length,
            e.crc,
        )
        for e in entries
    )
    return np.frombuffer(rows, np.uint8).reshape(-1, ENTRY.size).T.tobytes()


def stored_frame(content: bytes) -> bytes:
    """Return a zstd frame (RFC 8878) of stored blocks: its size depends on that of the content alone, and no library
    is needed.
    """
    starts = range(0, len(content), ZSTD_BLOCK) or range(1)
    blocks = [content[start : start + ZSTD_BLOCK] for start in starts]
    heads = [int(number == len(blocks) - 1) | len(block) << 3 for number, block in enumerate(blocks)]
    parts = [head.to_bytes(3, "little") + block for head, block in zip(heads, blocks, strict=True)]
    return b"\x28\xb5\x2f\xfd\xa0" + struct.pack("<I", len(content)) + b"".join(parts)


class Reader:
    """Random access to the chunks of a .kpc file.

    Opening reads the header and the index (two reads, at the very start of the file) and nothing else.

    Args:
        source: whatever `open_source` takes; or a `Reader`, whose header and index are taken over.
        allow_partial: accept a file whose end is missing; `available` says which chunks are there.

    Attributes:
        header, index: verified.
        name: of the file, for messages.
        beside: the chunks that are planes which groups of a clip share, by number; those of a group lie beside it
            (`kpc.format.container.shared_planes`).
        kept_bytes: bytes of memory that such planes take at most, for all readers of the file together.

    Raises:
        FormatError: not a .kpc file, a draft or another version, damaged, or claiming more than its size allows.
    """

    source: Source
    name: str
    header: Header
    index: tuple[Entry, ...]
    beside: Mapping[int, Beside]
    kept_bytes: int
    _reading: threading.Lock

    def __init__(self, source: "AnySource | Reader", *, allow_partial: bool = False):
        if isinstance(source, Reader):
            self._reading = source._reading
            self.source, self.name, self.header, self.index = source.source, source.name, source.header, source.index
            self.beside, self.kept_bytes = source.beside, source.kept_bytes
            return
        self._reading = threading.Lock()
        self.source = open_source(source)
        self.name, self.beside, self.kept_bytes = self.source.name, {}, 0
        self.header = self._read_header(allow_partial)
        self.index = self._read_index()

    def _read_header(self, allow_partial: bool) -> Header:
        head = self.source.read_at(0, HEADER.size)
        self._check_version(head)
        *fields, header_crc = HEADER.unpack(head)
        if google_crc32c.value(head[:-4]) != header_crc:
            raise FormatError(f"{self.name}: the header is damaged (its CRC32C differs); fetch the file again")
        _, version, header_length, *others = fields
        if header_length != HEADER.size:
            raise FormatError(f"{self.name}: the header claims {header_length} bytes, not {HEADER.size}")
        header = Header(version, *others)
        self._check_sizes(header, allow_partial)
        return header

    def _check_version(self, head: bytes) -> None:
        if head[: len(MAGIC)] != MAGIC[: len(head)] or not head:
            raise FormatError(f"{self.name}: not a .kpc file" + ", since it is empty" * (not head))
        if len(head) >= VERSION_STRUCT.size:
            _, version, header_length = VERSION_STRUCT.unpack_from(head)
            if header_length == 0:  # in drafts a reserved field
                raise FormatError(f"{self.name}: a draft of the format; encode it again")
            if version != VERSION:
                raise FormatError(f"{self.name}: format version {version}, this reader knows {VERSION}; update kpc")
        if len(head) < HEADER.size:
            raise FormatError(f"{self.name}: cut off within the header; fetch the file again")

    def _check_sizes(self, header: Header, allow_partial: bool) -> None:
        count, length, size = header.chunk_count, header.file_length, self.source.size
        if (
            not 0 < count <= CHUNK_LIMIT
            or not 0 < header.index_length <= INDEX_BYTES + INDEX_BYTES_PER_CHUNK * count
            or length < HEADER.size + max(header.index_length, MIN_CHUNK_BYTES * count)
        ):
            raise FormatError(
                f"{self.name}: the header claims {count} chunks and {header.index_length} bytes of index in a file of "
                f"{length} bytes"
            )
        if size > length:
            raise FormatError(f"{self.name}: {size - length} bytes follow the end of the file; fetch the file again")
        if size < length and not allow_partial:
            raise FormatError(f"{self._cut_off(header)}; fetch the file again")
        if max(header.value_count, header.largest_raw) > length * EXPANSION_LIMIT:
            raise FormatError(
                f"{self.name}: claims {header.value_count:,} values and chunks of {header.largest_raw:,} bytes, "
                f"more than {length:,} bytes can hold"
            )

    @property
    def cut_off(self) -> str | None:
        """How much of the file is there, for messages, if its end is missing; else None."""
        return self._cut_off(self.header) if self.source.size < self.header.file_length else None

    def _cut_off(self, header: Header) -> str:
        return f"{self.name}: cut off at {self.source.size:,} of {header.file_length:,} bytes"

    def _read_index(self) -> tuple[Entry, ...]:
        header = self.header
        if self.source.size < HEADER.size + header.index_length:
            raise FormatError(f"{self._cut_off(header)}, within the chunk index; fetch the file again")
        index = self.source.read_at(HEADER.size, header.index_length)
        if google_crc32c.value(index) != header.index_crc:
            raise FormatError(f"{self.name}: the chunk index is damaged (its CRC32C differs); fetch the file again")
        table = np.frombuffer(self._decompressed(index, header.chunk_count * ENTRY.size, "chunk index"), np.uint8)
        rows = table.reshape(ENTRY.size, -1).T.tobytes()
        entries, offset = [], HEADER.size + len(index)
        for number, fields in enumerate(ENTRY.iter_unpack(rows)):
            kind, group, scale, plane, row_start, row_count, codec, stored, raw, crc = fields
            if not (kind.isascii() and kind.isalpha()):
                raise FormatError(f"{self.name}: chunk {number} has a kind that is not four letters")
            name = kind.decode("ascii")
            entry = Entry(name, group, scale, plane, row_start, row_count, codec, stored, raw, crc, offset)
            if entry.raw_length > header.largest_raw:
                raise FormatError(
                    f"{self.name}: chunk {number} claims {entry.raw_length:,} bytes, more than the header's limit"
                )
            entries.append(entry)
            offset += entry.stored_length
        if offset != header.file_length:
            raise FormatError(f"{self.name}: the chunks end at byte {offset} of {header.file_length}")
        return tuple(entries)

    def available(self, number: int) -> bool:
        """Return whether all bytes of a chunk are there; False only in a partial file."""
        if number in self.beside:
            return self.beside[number].is_there
        entry = self.index[number]
        return entry.offset + entry.stored_length <= self.source.size

    def stored(self, number: int) -> bytes:
        """Return a chunk as it lies in the file, its CRC32C verified. Threads may call this at the same time; they
        read in turn.
        """
        entry = self.index[number]
        with self._reading:
            body = self.source.read_at(entry.offset, entry.stored_length)
        if len(body) != entry.stored_length:
            where = self.name if number in self.beside else self._cut_off(self.header)
            raise FormatError(f"{where}: {self._named(number)} is not there; fetch the file again")
        if google_crc32c.value(body) != entry.crc:
            is_remote = isinstance(self.source, RemoteSource)
            remedy = (
                "open it again, since it may have been replaced on the server" if is_remote else "fetch the file again"
            )
            raise FormatError(f"{self.name}: {self._named(number)} is damaged (its CRC32C differs); {remedy}")
        return body

    def _named(self, number: int) -> str:
        """Return what a chunk is called in messages."""
        named = f"chunk {number} ({self.index[number].kind})"
        return f"{named}, {self.beside[number].name}," if number in self.beside else named

    def chunk(self, number: int, limit: int | None = None) -> bytes:
        """Return the content of a chunk under RAW or ZSTD, verified and decoded.

        Args:
            limit: largest raw length in bytes that the caller accepts; checked before anything is allocated.
        """
        entry = self.index[number]
        if limit is not None and entry.raw_length > limit:
            raise FormatError(
                f"{self.name}: chunk {number} ({entry.kind}) claims {entry.raw_length:,} bytes where at "
                f"most {limit:,} make sense"
            )
        body = self.stored(number)
        if entry.codec == Codec.RAW:
            raw = body
        elif entry.codec == Codec.ZSTD:
            raw = self._decompressed(body, entry.raw_length, f"chunk {number} ({entry.kind})")
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

    def context_coded(self, number: int) -> bytes:
        """Return a chunk under one of the codecs from PREDICTIVE on as it is stored, if it may stand for as much as
        it claims.
        """
        entry = self.index[number]
        if entry.raw_length > entry.stored_length * EXPANSION_LIMIT:
            raise FormatError(
                f"{self.name}: chunk {number} ({entry.kind}) claims a length of {entry.raw_length:,}, more than "
                f"{entry.stored_length:,} bytes can hold"
            )
        return self.stored(number)

    def _decompressed(self, body: bytes, length: int, what: str) -> bytes:
        """Return the content of exactly one zstd frame, which must be `length` bytes."""
        try:
            frame = zstd.get_frame_info(body)
            if frame.decompressed_size != length or frame.dictionary_id:
                raise FormatError(f"{self.name}: {what}: its zstd frame claims another length")
            decoder = zstd.ZstdDecompressor(options=ZSTD_OPTIONS)
            content = decoder.decompress(body, max_length=length + 1)
        except zstd.ZstdError as error:
            raise FormatError(f"{self.name}: {what} is no valid zstd frame ({error})") from error
        if len(content) != length or not decoder.eof or decoder.unused_data:
            raise FormatError(f"{self.name}: {what} is no valid zstd frame (cut off, or followed by more)")
        return content
