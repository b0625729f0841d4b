"""A file made of another: chunks are copied as they are stored, but for those that change."""

import os
from collections.abc import Mapping

from kpc.format.common.cli import atomic_write
from kpc.format.container.container import Chunk, Reader, StoredChunk, assemble, store
from kpc.format.container.metadata_chunk import pack_metadata
from kpc.format.container.sources import AnySource
from kpc.format.scene.metadata import Metadata

# The order in which a writer lays out the chunks before the planes (spec/kpc-format.md, "Order of chunks").
ORDER = ("SCNE", "WARP", "MOVE", "DECO", "HYBR", "OCCU", "came", "appe", "meta")


def with_metadata(source: AnySource, metadata: Metadata) -> bytes:
    """Return a file, a scene or a clip in groups, with other metadata; without any if there is nothing in them."""
    return with_chunks(Reader(source), {"meta": Chunk("meta", pack_metadata(metadata)) if metadata else None})


def with_chunks(reader: Reader, changed: Mapping[str, Chunk | None]) -> bytes:
    """Return a file in which some chunks before the planes are others, and the rest is copied byte for byte.

    Args:
        reader: of the file.
        changed: by kind, the chunk that replaces that of the file or is added to it; None to leave it out.
    """
    stored = [copied(reader, number) for number, entry in enumerate(reader.index) if entry.kind not in changed]
    for chunk in sorted((chunk for chunk in changed.values() if chunk is not None), key=lambda one: rank(one.kind)):
        later = (k for k, other in enumerate(stored) if rank(other.entry.kind) > rank(chunk.kind))
        stored.insert(next(later, len(stored)), store(chunk))
    return assemble(stored, reader.header.value_count)


def save(data: bytes, path: str | os.PathLike[str]) -> int:
    """Write the bytes of a file; return its size. On failure the file at `path` is unchanged."""
    with atomic_write(path) as aside:
        aside.write_bytes(data)
    return len(data)


def copied(reader: Reader, number: int) -> StoredChunk:
    """Return a chunk of a file as it is stored there, its CRC32C verified."""
    return StoredChunk(reader.index[number], reader.stored(number))


def rank(kind: str) -> int:
    """Return the place of a kind in the order of chunks."""
    return ORDER.index(kind) if kind in ORDER else len(ORDER)
