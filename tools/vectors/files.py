"""Files of the conformance vectors: chunks under a given codec, put together whether they make sense or not.

The index of all vectors is a zstd frame of stored blocks, which no library has to make; so its bytes have known
positions.
"""

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import google_crc32c
import numpy as np
import zstandard

from kpc.encoder.coding.predictive import encode_with_weights, follows_trellis
from kpc.encoder.coding.scene_writer import scene_chunks
from kpc.encoder.coding.transform import OFFSET_COUNT, TransformBlocks, coded_blocks, encode_blocks, largest_side
from kpc.format.coding.poses import BITS, LENS, NOTHING, WORD
from kpc.format.coding.poses import HEAD as POSES_HEAD
from kpc.format.coding.quantise import QuantisedScene, needed_texels
from kpc.format.container.container import HEADER, Chunk, Codec, Entry, Reader, header_and_index, stored_frame
from kpc.format.container.segments import DEPENDENT, SCALAR, TRELLIS, WEIGHT_COUNT
from kpc.format.scene.scene import ALL_PLANES
from kpc.tools.vectors.scenes import dependent, noise

FRAME_HEAD = 12  # bytes of a zstd frame of one stored block before its content
# Position of each field of an entry in its 30 bytes, and its layout.
ENTRY_FIELDS = {
    "kind": (0, "4s"),
    "group": (4, "<H"),
    "scale": (6, "<B"),
    "plane": (7, "<B"),
    "row_start": (8, "<I"),
    "row_count": (12, "<I"),
    "codec": (16, "<H"),
    "stored_length": (18, "<I"),
    "raw_length": (22, "<I"),
    "crc": (26, "<I"),
}
# Position of each field of the header after version and header_length, and its layout.
HEADER_FIELDS = {
    "version": (8, "<H"),
    "header_length": (10, "<H"),
    "chunk_count": (12, "<I"),
    "index_length": (16, "<I"),
    "index_crc": (20, "<I"),
    "file_length": (24, "<Q"),
    "value_count": (32, "<Q"),
    "largest_raw": (40, "<I"),
    "header_crc": (44, "<I"),
}


@dataclass(frozen=True)
class Stored:
    """A chunk as it lies in a file."""

    chunk: Chunk
    codec: int
    body: bytes
    raw_length: int


def raw(chunk: Chunk) -> Stored:
    """Return a chunk under RAW."""
    return Stored(chunk, Codec.RAW, chunk.raw, len(chunk.raw))


def zstd(chunk: Chunk) -> Stored:
    """Return a chunk under ZSTD."""
    return Stored(chunk, Codec.ZSTD, zstandard.ZstdCompressor(level=19).compress(chunk.raw), len(chunk.raw))


def smallest(chunk: Chunk) -> Stored:
    """Return a chunk under RAW or ZSTD."""
    return min(raw(chunk), zstd(chunk), key=lambda stored: len(stored.body))


def coded(chunk: Chunk, body: bytes | None = None, codec: int | None = None) -> Stored:
    """Return a chunk under the codec of its kind, or with other stored bytes under another."""
    if body is None:
        assert chunk.encode is not None
        body = chunk.encode()
    raw_length = len(chunk.raw) if chunk.raw_length is None else chunk.raw_length
    return Stored(chunk, chunk.codec if codec is None else codec, body, raw_length)


def assemble(stored: Sequence[Stored], value_count: int) -> bytes:
    """Return a file of these chunks in their order."""
    entries = []
    for one in stored:
        chunk = one.chunk
        position = 0, chunk.scale, chunk.plane, chunk.row_start, chunk.row_count
        crc = google_crc32c.value(one.body)
        entries.append(Entry(chunk.kind, *position, one.codec, len(one.body), one.raw_length, crc))
    return header_and_index(entries, value_count, compress=False) + b"".join(one.body for one in stored)


def value_count(scene: QuantisedScene) -> int:
    """Return the numbers in all planes."""
    return sum(plane.symbols.size for scale in scene.scales for plane in scale.values())


def encode(scene: QuantisedScene, *, segment_rows: int = 16, store: Callable[[Chunk], Stored] = raw) -> bytes:
    """Return a file of a scene without context-coded chunks."""
    return assemble([store(chunk) for chunk in scene_chunks(scene, segment_rows=segment_rows)], value_count(scene))


def encode_kinds(scene: QuantisedScene, *kinds: str) -> bytes:
    """Return a file of a scene whose chunks of some kinds are under the codec of their kind, all others raw."""
    stored = [coded(chunk) if chunk.kind in kinds else raw(chunk) for chunk in scene_chunks(scene)]
    return assemble(stored, value_count(scene))


def predictive(
    scene: QuantisedScene,
    sets: int = 1,
    *,
    segment_rows: int = 16,
    weights: np.ndarray | None = None,
    is_dependent: bool = False,
    implied: bool = False,
) -> bytes:
    """Return a file all of whose planes are under PREDICTIVE.

    Args:
        sets: number of sets of weights.
        weights: (sets, WEIGHT_COUNT) int8; None: weights that need no floating-point fit, the largest and the
            smallest among them.
        is_dependent: move the symbols so that they are DEPENDENT.
        implied: leave maps to the occupancy, where it implies them.
    """
    if weights is None:
        weights = (noise((sets, WEIGHT_COUNT), 61) / 4).astype(np.int8)
        weights[0, 0], weights[-1, -1] = -128, 127
    if is_dependent:
        scene = dependent(scene, weights, segment_rows)
    stored = []
    for chunk in scene_chunks(scene, segment_rows=segment_rows):
        if chunk.kind == "PLNE":
            plane = scene.scales[chunk.scale][ALL_PLANES[chunk.plane]]
            rows = slice(chunk.row_start, chunk.row_start + chunk.row_count)
            symbols, texels = plane.symbols[rows], plane.coded[rows]
            quantiser = DEPENDENT if is_dependent else TRELLIS if follows_trellis(symbols, texels) else SCALAR
            needed = _needed(scene, chunk) if implied else None
            stored.append(
                coded(chunk, encode_with_weights(weights, symbols, texels, quantiser, needed), Codec.PREDICTIVE)
            )
        else:
            stored.append(raw(chunk))
    return assemble(stored, value_count(scene))


def transform(
    scene: QuantisedScene,
    side: int,
    step: int,
    spread: float,
    *,
    segment_rows: int = 16,
    implied: bool = False,
) -> bytes:
    """Return a file all of whose planes are under TRANSFORM, with levels from noise in place of the scene's symbols.

    Args:
        side: of blocks; smaller where a segment is too small for it.
        spread: magnitude of levels; means are the largest, high frequencies small.
        implied: leave maps to the occupancy, where it implies them.
    """

    def body(chunk: Chunk) -> bytes:
        plane = scene.scales[chunk.scale][ALL_PLANES[chunk.plane]]
        texels = plane.coded[chunk.row_start : chunk.row_start + chunk.row_count]
        N = min(side, largest_side(*texels.shape))
        grid, seed = coded_blocks(texels, N).shape, 100 + 10 * chunk.plane + chunk.scale
        levels = noise((plane.symbols.shape[2], *grid, N, N), seed) / 128 * spread
        levels *= np.float32(1) / (1 + np.add.outer(np.arange(N), np.arange(N), dtype=np.float32)) ** 2
        offsets = np.abs(noise(grid, seed + 1)).astype(np.int64) % OFFSET_COUNT
        blocks = TransformBlocks(np.trunc(levels).astype(np.int64), offsets, step)
        return encode_blocks(blocks, texels, _needed(scene, chunk) if implied else None)

    chunks = scene_chunks(scene, segment_rows=segment_rows)
    stored = [coded(c, body(c), Codec.TRANSFORM) if c.kind == "PLNE" else raw(c) for c in chunks]
    return assemble(stored, value_count(scene))


def _needed(scene: QuantisedScene, chunk: Chunk) -> np.ndarray:
    """Return the map of a segment that the occupancy implies."""
    name = ALL_PLANES[chunk.plane]
    needed = needed_texels(scene.occupancy, name, *scene.scales[chunk.scale][name].coded.shape)
    return needed[chunk.row_start : chunk.row_start + chunk.row_count]


def with_poses(scene: QuantisedScene, body: bytes) -> bytes:
    """Return a file of raw chunks whose cameras are these bytes under POSES, as of `poses`."""
    (count,) = struct.unpack_from("<H", body)
    stored = [
        Stored(chunk, Codec.POSES, body, 2 + 68 * count) if chunk.kind == "came" else raw(chunk)
        for chunk in scene_chunks(scene)
    ]
    return assemble(stored, value_count(scene))


def poses(
    exponent: int,
    corner: tuple[int, ...],
    rotations: Sequence[tuple[int, ...]],
    positions: Sequence[tuple[int, ...]],
    lenses: int = 1,
) -> bytes:
    """Return the `came` chunk of such cameras under POSES.

    Args:
        rotations: of each camera, which number of the quaternion is left out, and the others.
    """

    def word(numbers: Sequence[int], above: int = 0) -> bytes:
        return sum(number << BITS * k for k, number in enumerate((*numbers, above))).to_bytes(WORD, "little")

    words = (
        word([number + NOTHING for number in others], largest) + word(position)
        for (largest, *others), position in zip(rotations, positions, strict=True)
    )
    heads = (LENS.pack(64 + k, 48, 80.0, 80.5 + k, 32.0, 24.0) for k in range(lenses))
    return POSES_HEAD.pack(len(rotations), lenses, exponent, *corner) + b"".join(heads) + b"".join(words)


# --- damage


def patched(data: bytes, offset: int, layout: str, *values: int | float | bytes) -> bytes:
    """Return a copy with `values` at a byte offset; checksums stay as they were."""
    out = bytearray(data)
    struct.pack_into(layout, out, offset, *values)
    return bytes(out)


def with_field(data: bytes, name: str, value: int) -> bytes:
    """Return a file with a field of the header changed; checksums stay as they were."""
    offset, layout = HEADER_FIELDS[name]
    return patched(data, offset, layout, value)


def with_entry(data: bytes, number: int, name: str, value: int | bytes) -> bytes:
    """Return a file with a field of an index entry changed; checksums stay as they were."""
    out, (offset, layout) = bytearray(data), ENTRY_FIELDS[name]
    (count,) = struct.unpack_from("<I", data, HEADER_FIELDS["chunk_count"][0])
    for k, byte in enumerate(struct.pack(layout, value)):
        out[HEADER.size + FRAME_HEAD + (offset + k) * count + number] = byte
    return bytes(out)


def sealed(data: bytes) -> bytes:
    """Return the file with the CRC32C of index and header made right, so that what else is wrong shows."""
    length = struct.unpack_from("<I", data, HEADER_FIELDS["index_length"][0])[0]
    data = with_field(data, "index_crc", google_crc32c.value(data[HEADER.size : HEADER.size + length]))
    return with_field(data, "header_crc", google_crc32c.value(data[: HEADER.size - 4]))


def resealed(data: bytes) -> bytes:
    """Return the file with all of its checksums made right, those of chunks, too."""
    for number, entry in enumerate(Reader(data, allow_partial=True).index):
        body = data[entry.offset : entry.offset + entry.stored_length]
        data = with_entry(data, number, "crc", google_crc32c.value(body))
    return sealed(data)


def with_index(
    data: bytes,
    change: Callable[[bytes], bytes] = bytes,
    count: int | None = None,
    *,
    frame: Callable[[bytes], bytes] = bytes,
) -> bytes:
    """Return the file with its index changed before it comes into the frame, or the frame itself, or the number of
    chunks.

    Checksums and lengths are right.
    """
    header = Reader(data, allow_partial=True).header
    start, stop = HEADER.size + FRAME_HEAD, HEADER.size + header.index_length
    index = frame(stored_frame(change(data[start:stop])))
    head = with_field(data[: HEADER.size], "index_length", len(index))
    head = with_field(head, "chunk_count", header.chunk_count if count is None else count)
    head = with_field(head, "file_length", header.file_length - header.index_length + len(index))
    return sealed(head + index + data[stop:])


def claiming(chunks: Sequence[Chunk], number: int, values: int, length: int, codec: int) -> bytes:
    """Return a file of raw chunks, of which one claims another codec and raw length."""
    stored = [raw(chunk) for chunk in chunks]
    stored[number] = replace(stored[number], codec=codec, raw_length=length)
    return assemble(stored, values)
