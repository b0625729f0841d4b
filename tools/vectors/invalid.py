"""The invalid conformance vectors: by name, a file, the error that refuses it and a part of its message."""

import math
import struct
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial

import numpy as np

from kpc.encoder.coding.motion_codec import encode_motion
from kpc.encoder.coding.occupancy_codec import encode_occupancy
from kpc.encoder.coding.predictive import encode_with_weights
from kpc.encoder.coding.scene_writer import scene_chunks
from kpc.encoder.coding.transform import HEAD, TransformBlocks, encode_blocks
from kpc.format.coding.poses import HEAD as POSES_HEAD
from kpc.format.coding.poses import ROOT
from kpc.format.container.container import ENTRY, HEADER, Chunk, Codec, Reader
from kpc.format.container.scene_layout import CAMERA_STRUCT, DECODER_STRUCT, MOTION_STRUCT
from kpc.format.container.segments import DEPENDENT, SCALAR, TRELLIS, WEIGHT_COUNT
from kpc.format.scene.scene import ALL_PLANES
from kpc.tools.vectors.files import (
    Stored,
    assemble,
    claiming,
    coded,
    encode,
    patched,
    poses,
    raw,
    sealed,
    value_count,
    with_entry,
    with_field,
    with_index,
)
from kpc.tools.vectors.scenes import first_symbol, hybrid_decoder, make_scene, noise, smooth_motion, walked
from kpc.tools.vectors.zstd_frames import endless_weights, run_of_zeros

BROKEN = "FormatError"
Refused = tuple[bytes, str, str]  # a file, the name of the error, a part of its message
NAN = float("nan")


@cache
def invalid() -> dict[str, Refused]:
    """Return all vectors but those of groups; one process makes them once."""
    good = Good()
    small = Small()
    return (
        _drafts()
        | _container(good)
        | _segments(good)
        | _raw_planes(good)
        | _predictive(small)
        | _transform(small)
        | _occupancy(small)
        | _motion(good)
        | _weights(small)
        | _poses(small)
        | _head(good)
        | _mapping(good)
        | _raw_payloads(good)
        | _appearances(good)
    )


class Good:
    """A valid file of a moving scene, raw chunks only, and ways to damage it."""

    def __init__(self) -> None:
        self.scene = make_scene(dynamic=True, sizes=[(2, 5, 4, 3, 3)], cameras=1)
        self.chunks = scene_chunks(self.scene, segment_rows=2)
        self.values = value_count(self.scene)
        self.data = encode(self.scene, segment_rows=2)
        self.scne, self.deco, self.occu, self.came, self.xy = range(5)  # the order in which the writer lays chunks out
        self.xt = next(number for number, chunk in enumerate(self.chunks) if chunk.plane == ALL_PLANES.index("xt"))

    def of(self, chunks: list[Chunk]) -> bytes:
        """Return a file of these chunks."""
        return assemble([raw(chunk) for chunk in chunks], self.values)

    def changed(self, number: int, change: Callable[[bytes], bytes]) -> bytes:
        """Return the file with the content of one chunk changed."""
        chunks = list(self.chunks)
        chunks[number] = replace(chunks[number], raw=change(chunks[number].raw))
        return self.of(chunks)

    def set_at(self, number: int, offset: int, layout: str, *numbers: int | float) -> bytes:
        """Return the file with numbers in the content of one chunk changed."""
        return self.changed(number, lambda content: patched(content, offset, layout, *numbers))

    def with_chunks(self, kind: str, *contents: bytes) -> bytes:
        """Return the file with more chunks after SCNE."""
        return self.of([self.chunks[0], *(Chunk(kind, content) for content in contents), *self.chunks[1:]])

    def entry(self, number: int, field: str, value: int | bytes) -> bytes:
        """Return the file with a field of an index entry changed."""
        return sealed(with_entry(self.data, number, field, value))

    def without(self, number: int) -> bytes:
        return self.of(self.chunks[:number] + self.chunks[number + 1 :])


class Small:
    """A small still scene, one of whose chunks is to be under a context codec."""

    def __init__(self) -> None:
        self.scene = make_scene(dynamic=False, sizes=[(2, 2, 2, 2, 0)])
        self.chunks = scene_chunks(self.scene)
        self.values = value_count(self.scene)
        self.xy = next(number for number, chunk in enumerate(self.chunks) if chunk.kind == "PLNE")

    def plane(self, codec: Codec, body: bytes, raw_length: int = 8) -> bytes:
        """Return a file whose first plane is these bytes under a codec."""
        stored = [raw(chunk) for chunk in self.chunks]
        stored[self.xy] = Stored(self.chunks[self.xy], codec, body, raw_length)
        return assemble(stored, self.values)

    def other(self, kind: str, codec: Codec, body: bytes, raw_length: int) -> bytes:
        """Return a file whose chunk of a kind is these bytes under a codec."""
        stored = [Stored(c, codec, body, raw_length) if c.kind == kind else raw(c) for c in self.chunks]
        return assemble(stored, self.values)


def damaged_words(name: str, make: Callable[[bytes], bytes], body: bytes, state_at: int) -> dict[str, Refused]:
    """Return files, made of a body with state and words from `state_at` to its end, in which these are damaged."""
    last = len(body) - 1
    return {
        f"{name}-short": (make(body[: state_at + 3]), BROKEN, "cut off within its words"),
        f"{name}-half-word": (make(body[:-1]), BROKEN, "cut off within its words"),
        f"{name}-cut": (make(body[:-2]), BROKEN, "do not end where they should"),
        f"{name}-long": (make(body + bytes(2)), BROKEN, "do not end where they should"),
        f"{name}-state": (make(patched(body, state_at, "<I", 65535)), BROKEN, "first state is too small"),
        f"{name}-end": (make(patched(body, last, "<B", body[last] ^ 1)), BROKEN, "do not end where they should"),
    }


def _drafts() -> dict[str, Refused]:
    """Return the beginnings of files of the drafts: a header of 64 bytes, with 0 where header_length now is."""
    head = b"\x89KPC\r\n\x1a\n"
    drafts = {
        f"draft-{version}": (head + struct.pack("<HHIQ", version, 0, 64, 64) + bytes(64), BROKEN, "encode it again")
        for version in range(3)
    }
    return drafts | {"version-2": (head + struct.pack("<HHI", 2, 48, 1) + bytes(64), BROKEN, "format version 2")}


def _container(good: Good) -> dict[str, Refused]:
    """Return files with a damaged header or index."""
    data, count = good.data, len(good.chunks)
    offsets = [entry.offset for entry in Reader(data).index]
    flipped = patched(data, offsets[good.xy] + 9, "<B", data[offsets[good.xy] + 9] ^ 1)

    def header(field: str, value: int) -> bytes:
        return sealed(with_field(data, field, value))

    def table(offset: int, value: int) -> bytes:
        return with_index(data, lambda content: patched(content, offset, "<B", value))

    files = {
        "empty": (b"", "not a .kpc file"),
        "magic": (patched(data, 1, "4s", b"JPEG"), "not a .kpc file"),
        "header-length": (header("header_length", 64), "claims 64 bytes"),
        "header-crc": (with_field(data, "value_count", good.values + 1), "header is damaged"),
        "header-cut": (data[: HEADER.size - 1], "cut off within the header"),
        "no-chunks": (header("chunk_count", 0), "0 chunks"),
        "many-chunks": (with_index(data, count=1000), "1000 chunks"),
        "huge-value-count": (header("value_count", 1 << 50), "more than"),
        "huge-chunk-limit": (header("largest_raw", 0xFFFFFFFF), "more than"),
        "value-count": (header("value_count", good.values + 1), "the header claims"),
        "trailing-byte": (data + b"\0", "follow the end"),
        "chunk-cut": (data[:-1], "cut off"),
        "chunk-crc": (flipped, "is damaged"),
        "index-cut": (data[: HEADER.size + 1], "cut off"),
        "index-none": (header("index_length", 0), "0 bytes of index"),
        "index-huge": (with_index(data, frame=lambda frame: frame + bytes(50 * count)), "bytes of index"),
        "index-crc": (with_entry(data, 2, "group", 1), "index is damaged"),
        "index-garbage": (with_index(data, frame=lambda f: patched(f, 0, "<B", 0)), "index is no valid zstd frame"),
        "index-weights": (
            with_index(data, count=8, frame=lambda _: endless_weights(8 * ENTRY.size)),
            "index is no valid zstd frame",
        ),
        "index-long": (with_index(data, frame=lambda frame: frame + b"\0"), "index is no valid zstd frame"),
        "index-fewer": (with_index(data, count=count + 1), "claims another length"),
        "index-kind": (table(3 * count, 0), "four letters"),
        "index-end": (table(21 * count, 1), "the chunks end at"),
        "index-raw-length": (good.entry(1, "raw_length", 1 << 24), "more than the header's"),
        "unknown-critical": (good.entry(good.came, "kind", b"Came"), "critical kind Came"),
        "unknown-codec": (good.entry(1, "codec", 9), "codec 9"),
        "raw-length": (good.entry(good.deco, "raw_length", 1), "not the 1 it claims"),
    }
    for name, number, codec in (
        ("predictive-elsewhere", good.deco, Codec.PREDICTIVE),
        ("weights-elsewhere", good.xy, Codec.WEIGHTS),
        ("motion-elsewhere", good.occu, Codec.MOTION),
        ("occupancy-elsewhere", good.deco, Codec.OCCUPANCY),
        ("poses-elsewhere", good.scne, Codec.POSES),
        ("transform-elsewhere", good.came, Codec.TRANSFORM),
    ):
        files[name] = good.entry(number, "codec", codec), f"codec {int(codec)}"
    return {name: (content, BROKEN, message) for name, (content, message) in files.items()}


def _segments(good: Good) -> dict[str, Refused]:
    """Return files that do not list every plane and payload once."""
    files = {
        "group": (good.entry(good.xy, "group", 1), "group 1"),
        "position": (good.entry(good.deco, "scale", 1), "among the planes"),
        "no-decoder": (good.without(good.deco), "0 DECO chunks"),
        "no-segment": (good.without(len(good.chunks) - 1), "its segments hold 2 rows, not 3"),
        "two-occupancies": (good.of([*good.chunks, good.chunks[good.occu]]), "2 OCCU chunks"),
        "two-cameras": (good.of([*good.chunks, good.chunks[good.came]]), "2 came chunks"),
        "segment-twice": (good.of([*good.chunks, good.chunks[good.xt]]), "or two do"),
        "segment-start": (good.entry(good.xt, "row_start", 1), "no segment starts at row 0"),
        "segment-plane": (good.entry(good.xt, "plane", 6), "plane 6"),
    }
    return {name: (content, BROKEN, message) for name, (content, message) in files.items()}


def _raw_planes(good: Good) -> dict[str, Refused]:
    """Return files with damaged plane segments under RAW and ZSTD."""
    stored = [raw(chunk) for chunk in good.chunks]
    stored[good.xy] = Stored(good.chunks[good.xy], Codec.ZSTD, run_of_zeros(), 40)
    files = {
        "zstd-length": (assemble(stored, good.values), "claims another length"),
        "zstd-garbage": (good.entry(good.xy, "codec", Codec.ZSTD), "zstd frame"),
        "segment-map-mode": (good.set_at(good.xy, 0, "<B", 2), "unknown map mode"),
        "segment-map-bits": (good.set_at(good.xy, 3, "<B", 0xFF), "unused bits"),
        "segment-short": (good.changed(good.xy, lambda content: content[:-1]), "its map implies"),
        "segment-long": (good.changed(good.xt, lambda content: content + bytes(1)), "its map implies"),
    }
    return {name: (content, BROKEN, message) for name, (content, message) in files.items()}


def _predictive(small: Small) -> dict[str, Refused]:
    """Return files with damaged plane segments under PREDICTIVE."""
    symbols = np.array([[[0, 1], [100, -7]], [[-128, 127], [3, 3]]], np.int16)
    weights, whole = np.zeros((1, WEIGHT_COUNT), np.int8), np.ones((2, 2), bool)
    body = encode_with_weights(weights, symbols.astype(np.int8), whole, SCALAR)
    assert body is not None
    file = partial(small.plane, Codec.PREDICTIVE)

    def flags(value: int) -> bytes:
        return file(patched(body, 1, "<B", value))

    # A plane of nothing, in fewer bytes than its number of symbols allows; the writer would take a zstd frame.
    vast = make_scene(dynamic=False, sizes=[(256, 64, 64, 1, 0)])
    nothing = np.zeros((64, 64, 256), np.int8)
    empty = encode_with_weights(weights, nothing, np.zeros((64, 64), bool), TRELLIS)
    hollow = [
        coded(chunk, empty, Codec.PREDICTIVE) if (chunk.kind, chunk.plane) == ("PLNE", 0) else raw(chunk)
        for chunk in scene_chunks(vast)
    ]
    files = {
        "predictive-sets": (file(patched(body, 0, "<B", 3)), "number of sets"),
        "predictive-map-mode": (flags(3), "or flag"),
        "predictive-quantiser": (flags(12), "or flag"),
        "predictive-flags": (flags(16), "or flag"),
        "predictive-range": (file(walked(symbols + 200, whole, weights, SCALAR)), "leaves its 8 bits"),
        "dependent-range": (file(walked(0 * symbols + 200, whole, weights, DEPENDENT)), "leaves its 8 bits"),
        "predictive-count": (file(body, 7), "claims 7 symbols"),
        "predictive-bomb": (assemble(hollow, value_count(vast)), "more than 15 bytes can hold"),
    }
    return damaged_words("predictive", file, body, 2 + WEIGHT_COUNT) | {
        name: (content, BROKEN, message) for name, (content, message) in files.items()
    }


def _transform(small: Small) -> dict[str, Refused]:
    """Return files with damaged plane segments under TRANSFORM."""
    blocks = TransformBlocks(np.trunc(noise((2, 1, 1, 4, 4), 71) / 8).astype(np.int64), np.full((1, 1), 2), 40)
    body = encode_blocks(blocks, np.ones((2, 2), bool))
    file = partial(small.plane, Codec.TRANSFORM)
    files = {
        "transform-side": (file(patched(body, 0, "<B", 5)), "unknown side of blocks"),
        "transform-large": (file(patched(body, 0, "<B", 8)), "more than twice its 2 rows or columns"),
        "transform-map-mode": (file(patched(body, 1, "<B", 3)), "or flag"),
        "transform-flags": (file(patched(body, 1, "<B", 4)), "or flag"),
        "transform-step": (file(patched(body, 2, "<B", 0)), "a step of 0"),
        "transform-head": (file(body[:2]), "a step of 0"),
        "transform-count": (file(body, 7), "claims 7 symbols"),
    }
    return damaged_words("transform", file, body, HEAD) | {
        name: (content, BROKEN, message) for name, (content, message) in files.items()
    }


def _occupancy(small: Small) -> dict[str, Refused]:
    """Return files with damaged grids under OCCUPANCY."""
    cells = struct.pack("<4H", 1, 3, 3, 5) + encode_occupancy(noise((1, 3, 3, 5), 99) > 0)

    def file(body: bytes, raw_length: int = 8 + 6) -> bytes:
        return small.other("OCCU", Codec.OCCUPANCY, body, raw_length)

    vast = struct.pack("<4HI", 8, 50, 80, 100, 1 << 16)
    files = {
        "occupancy-none": (file(patched(cells, 4, "<H", 0)), "makes no sense"),
        "occupancy-more": (file(patched(cells, 0, "<H", 2), 8 + 12), "do not end where they should"),
        "occupancy-length": (file(cells, 15), "claims 15 bytes"),
        "occupancy-bomb": (file(vast, 8 + 400_000), "more than 12 bytes can hold"),
    }
    return damaged_words("occupancy", file, cells, 8) | {
        name: (content, BROKEN, message) for name, (content, message) in files.items()
    }


def _motion(good: Good) -> dict[str, Refused]:
    """Return files with damaged motion grids, raw and under MOTION."""
    grid = smooth_motion(3, 2, 2, 2)
    body = MOTION_STRUCT.pack(3, 2, 2, 2, grid.step) + encode_motion(grid.symbols)
    head = MOTION_STRUCT.pack(2, 2, 2, 2, grid.step)

    def file(body: bytes, raw_length: int = 12 + 6 * 24) -> bytes:
        chunks = [good.chunks[0], Chunk("MOVE", body), *good.chunks[1:]]
        return claiming(chunks, 1, good.values, raw_length, Codec.MOTION)

    def move(rows: int, nz: int, ny: int, nx: int, step: float) -> bytes:
        return MOTION_STRUCT.pack(rows, nz, ny, nx, step) + bytes(6 * 16)

    fine, displaced = 0.5**13, partial(good.with_chunks, "MOVE")
    still = make_scene(dynamic=False, sizes=[(1, 2, 2, 2, 0)])
    static = [raw(chunk) for chunk in [*scene_chunks(still), Chunk("MOVE", move(2, 2, 2, 2, fine))]]
    vast = struct.pack("<4HfI", 50, 60, 60, 20, grid.step, 1 << 16)
    files = {
        "motion-range": (file(head + first_symbol(40_000), 12 + 6 * 16), "leaves its 16 bits"),
        "motion-rows": (file(patched(body, 0, "<H", 1)), "makes no sense"),
        "motion-step": (file(patched(body, 8, "<f", NAN)), "outside its range"),
        "motion-length": (file(body, 12 + 6 * 24 + 1), "claims 157 bytes"),
        "motion-bomb": (file(vast, 12 + 6 * 50 * 60 * 60 * 20), "more than 16 bytes can hold"),
        "move-rows": (displaced(move(1, 2, 2, 2, fine)), "makes no sense"),
        "move-nodes": (displaced(move(2, 2, 257, 2, fine)), "makes no sense"),
        "move-step": (displaced(move(2, 2, 2, 2, 0.0)), "outside its range"),
        "move-nan": (displaced(move(2, 2, 2, 2, NAN)), "outside its range"),
        "move-far": (displaced(move(2, 2, 2, 2, 1.0)), "outside its range"),
        "move-short": (displaced(move(2, 2, 2, 2, fine)[:-1]), "ends after"),
        "move-long": (displaced(move(2, 2, 2, 2, fine) + bytes(1)), "1 bytes too long"),
        "move-twice": (displaced(*2 * [move(2, 2, 2, 2, fine)]), "2 MOVE chunks"),
        "move-static": (assemble(static, value_count(still)), "static scene"),
    }
    return damaged_words("motion", file, body, MOTION_STRUCT.size) | {
        name: (content, BROKEN, message) for name, (content, message) in files.items()
    }


def _weights(small: Small) -> dict[str, Refused]:
    """Return files with damaged decoders under WEIGHTS."""
    deco = next(chunk for chunk in small.chunks if chunk.kind == "DECO")
    assert deco.encode is not None
    body, exponents = deco.encode(), DECODER_STRUCT.size

    def file(body: bytes, raw_length: int = len(deco.raw)) -> bytes:
        return small.other("DECO", Codec.WEIGHTS, body, raw_length)

    files = {
        "weights-power": (file(patched(body, exponents, "<b", 16)), "not one of float16's"),
        "weights-range": (file(patched(body, exponents, "<b", 15)), "no number of float16"),
        "weights-none": (file(body[: exponents + 3]), "cut off within its words"),
        "weights-length": (file(body, len(deco.raw) + 2), "bytes of weights, not those"),
    }
    return damaged_words("weights", file, body, exponents + 5) | {
        name: (content, BROKEN, message) for name, (content, message) in files.items()
    }


def _poses(small: Small) -> dict[str, Refused]:
    """Return files with damaged cameras under POSES."""
    body = poses(-10, (0, 1, 2), [(0, 1, 2, 3), (1, 4, 5, 6)], [(7, 8, 9), (0, 0, 0)])
    origin = 2 * [(0, 0, 0)]

    def file(body: bytes, raw_length: int = 2 + 2 * CAMERA_STRUCT.size) -> bytes:
        chunks = [*small.chunks[:3], Chunk("came", body), *small.chunks[3:]]
        return claiming(chunks, 3, small.values, raw_length, Codec.POSES)

    files = {
        "poses-head": (file(body[: POSES_HEAD.size - 1]), "cut off within its head"),
        "poses-none": (file(patched(body, 0, "<H", 0)), "0 cameras"),
        "poses-many": (file(patched(body, 0, "<H", 4097)), "4097 cameras"),
        "poses-lenses": (file(patched(body, 2, "<H", 3)), "3 lenses of 2 cameras"),
        "poses-exponent": (file(patched(body, 4, "<b", 31)), "multiples of 2^31"),
        "poses-fine": (file(patched(body, 4, "<b", -127)), "multiples of 2^-127"),
        "poses-short": (file(body[:-1]), "are not those of 2 cameras"),
        "poses-long": (file(body + bytes(1)), "are not those of 2 cameras"),
        "poses-rotation": (file(poses(0, (0, 0, 0), 2 * [(0, -ROOT, ROOT, 1)], origin)), "is out of range"),
        "poses-position-bits": (file(patched(body, len(body) - 1, "<B", 64)), "is out of range"),
        "poses-far": (file(poses(30, (2, 0, 0), 2 * [(0, 0, 0, 0)], origin)), "absurdly far"),
        "poses-focal": (file(patched(body, POSES_HEAD.size + 4, "<f", 0.0)), "focal length"),
        "poses-length": (file(body, 2 + 68), "claims 70 bytes"),
    }
    return {name: (content, BROKEN, message) for name, (content, message) in files.items()}


def _head(good: Good) -> dict[str, Refused]:
    """Return files with a damaged SCNE chunk."""
    at = partial(good.set_at, good.scne)
    files = {
        "scene-box": (at(0, "<f", 1e9), "the box is empty"),
        "scene-box-large": (at(12, "<f", 1e30), "absurdly large"),
        "scene-box-infinite": (at(0, "<6f", *6 * [math.inf]), "not finite"),
        "scene-clip": (at(24, "<I", 0), "a clip of 0 frames"),
        "scene-fps": (at(28, "<d", NAN), "makes no sense"),
        "scene-step": (at(36, "<d", 1e-12), "a ray step"),
        "scene-background": (at(44, "<f", -1.0), "background"),
        "scene-scales": (at(56, "<B", 0), "0 scales"),
        "scene-static": (at(57, "<B", 0), "3 rows in time"),
        "scene-axis": (at(60, "<H", 65535), "65535"),
        "scene-plane-step": (at(68, "<f", 0.0), "plane xy: a step or an offset"),
        "scene-plane-nan": (at(68, "<f", NAN), "plane xy: a step or an offset"),
        "scene-plane-snan": (at(68, "<I", 0x7F800001), "plane xy: a step or an offset"),
        "scene-long": (good.changed(good.scne, lambda content: content + bytes(1)), "1 bytes too long"),
    }
    return {name: (content, BROKEN, message) for name, (content, message) in files.items()}


def _mapping(good: Good) -> dict[str, Refused]:
    """Return files with a damaged WARP chunk."""
    warped = partial(good.with_chunks, "WARP")

    def contraction(mapping: int, distance: float) -> bytes:
        return struct.pack("<Id", mapping, distance)

    def ndc(near: float = 0.5, skew: float = 0.0) -> bytes:
        return struct.pack("<I12ddd", 2, 1, 0, 0, 0.5, skew, 1, 0, -0.25, 0, 0, 1, 3, near, 2.0)

    files = {
        "warp-mapping": (warped(contraction(3, 3.5)), "mapping 3"),
        "warp-negative": (warped(contraction(1, -3.5)), "make no sense"),
        "warp-nan": (warped(contraction(1, NAN)), "make no sense"),
        "warp-far": (warped(contraction(1, 1e6)), "make no sense"),
        "warp-short": (warped(contraction(1, 3.5)[:-1]), "ends after"),
        "warp-long": (warped(contraction(1, 3.5) + bytes(1)), "1 bytes too long"),
        "warp-twice": (warped(*2 * [contraction(1, 3.5)]), "2 WARP chunks"),
        "ndc-short": (warped(ndc()[:-1]), "ends after"),
        "ndc-near": (warped(ndc(near=-1.0)), "make no sense"),
        "ndc-nan": (warped(ndc(near=NAN)), "make no sense"),
        "ndc-frame": (warped(ndc(skew=0.01)), "make no sense"),
        "ndc-vast": (warped(ndc(skew=1e200)), "make no sense"),
        "ndc-box": (warped(ndc(near=16.0)), "make no sense"),
    }
    return {name: (content, BROKEN, message) for name, (content, message) in files.items()}


def _raw_payloads(good: Good) -> dict[str, Refused]:
    """Return files with damaged decoders, occupancy and cameras under RAW."""
    mlps = scene_chunks(replace(good.scene, decoder=hybrid_decoder(2, 2, 2)))[good.deco].raw

    def decoded_by(*contents: bytes) -> bytes:
        """Return the file with hybrid decoders in place of its own."""
        others = good.chunks[good.occu :]
        return good.of([*good.chunks[: good.deco], *(Chunk("HYBR", content) for content in contents), *others])

    deco, occu, came = (partial(good.set_at, number) for number in (good.deco, good.occu, good.came))
    files = {
        "decoder-features": (deco(0, "<H", 3), "3 features"),
        "decoder-nan": (deco(8, "<H", 0x7E00), "NaN or infinite"),
        "decoder-short": (good.changed(good.deco, lambda content: content[:-1]), "ends after"),
        "hybrid-features": (decoded_by(patched(mlps, 0, "<H", 3)), "3 features"),
        "hybrid-width": (decoded_by(patched(mlps, 2, "<H", 0)), "0 and 2 hidden units"),
        "hybrid-hidden": (decoded_by(patched(mlps, 4, "<H", 257)), "2 and 257 hidden units"),
        "hybrid-bias": (decoded_by(patched(mlps, 6, "<f", NAN)), "density bias nan"),
        "hybrid-nan": (decoded_by(patched(mlps, 10, "<H", 0x7C00)), "NaN or infinite"),
        "hybrid-long": (decoded_by(mlps + bytes(2)), "2 bytes too long"),
        "hybrid-twice": (decoded_by(mlps, mlps), "2 HYBR chunks"),
        "two-decoders": (good.with_chunks("HYBR", mlps), "two decoders"),
        "occupancy-bits": (good.changed(good.occu, lambda content: content[:-1] + b"\xff"), "unused bits"),
        "occupancy-zero": (occu(0, "<H", 0), "makes no sense"),
        "camera-focal": (came(6, "<f", 0.0), "focal length"),
        "camera-far": (came(34, "<f", 1e30), "absurdly far"),
        "camera-axes": (came(22, "<f", 0.0), "not of length 1"),
        "camera-nan": (came(22, "<f", NAN), "NaN or infinity"),
    }
    return {name: (content, BROKEN, message) for name, (content, message) in files.items()}


def _appearances(good: Good) -> dict[str, Refused]:
    """Return files with a damaged appe chunk."""
    varied = partial(good.with_chunks, "appe")

    def appe(*names: bytes, count: int = 2, hidden: int = 3, codes: bytes = bytes(2 * 2 * 3)) -> bytes:
        head = struct.pack("<HH", count, hidden) + codes
        return head + b"".join(struct.pack("<B", len(name)) + name for name in names)

    files = {
        "appearances-none": (varied(struct.pack("<HH", 0, 3)), "0 appearances"),
        "appearances-many": (varied(appe(b"a", b"b", count=16385)), "16385 appearances"),
        "appearances-hidden": (varied(appe(b"a", b"b", hidden=4)), "4 numbers"),
        "appearances-nan": (varied(appe(b"a", b"b", codes=bytes(10) + b"\x00\x7e")), "NaN or infinite"),
        "appearances-short": (varied(appe(b"a")), "ends after"),
        "appearances-long": (varied(appe(b"a", b"b") + bytes(1)), "1 bytes too long"),
        "appearances-empty": (varied(appe(b"a", b"")), "is empty"),
        "appearances-same": (varied(appe(b"a", b"a")), "there twice"),
        "appearances-latin": (varied(appe(b"a", b"\xe9")), "not UTF-8"),
        "appearances-escape": (varied(appe(b"a", b"\x1b[2J")), "control character"),
        "appearances-control": (varied(appe(b"a", "\x9b".encode())), "control character"),
        "appearances-twice": (varied(*2 * [appe(b"a", b"b")]), "2 appe chunks"),
    }
    return {name: (content, BROKEN, message) for name, (content, message) in files.items()}
