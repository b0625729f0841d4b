"""Writes the conformance vectors that lie beside the spec: `python -m kpc.tools.vectors.specvectors spec/vectors`.

    valid/NAME.kpc     decodes to what valid/NAME.json says, bit by bit
    invalid/NAME.kpc   is refused; invalid/NAME.json names the kind of error and a part of its message

Every file is computed from integers, so that it comes out the same everywhere; only files that hold zstd frames depend
on the version of that library, and only in how they are packed (valid/NAME.json says which version packed them).
"""

import hashlib
import itertools
import json
import math
import struct
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import google_crc32c
import numpy as np
import zstandard
from kpc.format.coding.motion_codec import encode_motion
from kpc.format.coding.motion_raster import LORENZO, NEIGHBOURS
from kpc.format.coding.motion_raster import encode_with as encode_nodes_with
from kpc.format.coding.occupancy_codec import encode_occupancy
from kpc.format.coding.poses import BITS, LENS, NOTHING, ROOT, WORD
from kpc.format.coding.poses import HEAD as POSES_HEAD
from kpc.format.coding.predictive import (
    DEPENDENT,
    LATTICE_BIT,
    MAX_DECISIONS,
    SCALAR,
    TRELLIS,
    WEIGHT_COUNT,
    PredictionWeights,
    code_symbols,
    encode_with_weights,
    follows_trellis,
    trellis_transition,
)
from kpc.format.coding.quantise import QuantisedPlane, QuantisedScene, needed_texels
from kpc.format.coding.rans import encode_trace
from kpc.format.coding.transform import HEAD, OFFSET_COUNT, TransformBlocks, coded_blocks, encode_blocks, largest_side
from kpc.format.common import cli
from kpc.format.common.errors import UsageError
from kpc.format.container import container
from kpc.format.container.container import (
    CODEC_MIDPOINTS,
    CODEC_SYMBOLS,
    CODEC_THIRD,
    CODEC_ZSTD,
    ENTRY,
    HEADER,
    PLAIN_VERSION,
    VERSION,
    Chunk,
    Reader,
)
from kpc.format.container.scene_io import (
    APPEARANCE_LIMIT,
    AXIS_LIMIT,
    BOX_LIMIT,
    CAMERA_LIMIT,
    CAMERA_STRUCT,
    CHANNEL_LIMIT,
    DECODER_STRUCT,
    FRAME_LIMIT,
    HIDDEN_LIMIT,
    MOTION_LIMIT,
    MOTION_STRUCT,
    NAME_LIMIT,
    SAMPLE_LIMIT,
    SCALE_LIMIT,
    read,
    scene_chunks,
)
from kpc.format.container.segments import codec_of
from kpc.format.scene.cameras import Camera
from kpc.format.scene.motion import QuantisedMotion
from kpc.format.scene.scene import ALL_PLANES, SPACE_PLANES, TIME_PLANES, Appearance, Clip, Decoder, HybridDecoder
from kpc.format.scene.space import Contraction, DeviceCoordinates
from kpc.player.cpu import reference
from kpc.tools.vectors import groupvectors
from kpc.tools.vectors.groupvectors import of_the_draft

ZSTD_VERSION = ".".join(map(str, zstandard.ZSTD_VERSION))

pack = partial(container.pack, version=PLAIN_VERSION)
"""All vectors but those of `in_columns` are of the version that was first."""


def main(argv: list[str] | None = None) -> int:
    return cli.run(_command, "specvectors", argv)


def _command(argv: list[str]) -> None:
    if len(argv) != 1 or argv[0].startswith("-"):
        raise UsageError("give the folder to write, as in: python -m kpc.tools.vectors.specvectors spec/vectors")
    for path, data in vectors().items():
        target = Path(argv[0]) / path
        target.parent.mkdir(parents=True, exist_ok=True)
        with cli.atomic_write(target) as aside:
            aside.write_bytes(data)


def vectors() -> dict[str, bytes]:
    """All files of the vector set: path -> content."""
    files = {}
    scenes = _valid()
    for name, (data, is_partial) in scenes.items():
        files[f"valid/{name}.kpc"] = data
        files[f"valid/{name}.json"] = _json(described(data, is_partial))
    whole = {name: data for name, (data, is_partial) in scenes.items() if not is_partial}
    for name, (data, is_partial) in groupvectors.valid(whole).items():
        files[f"valid/{name}.kpc"] = data
        files[f"valid/{name}.json"] = _json(
            groupvectors.described(data, is_partial, {data: name for name, data in whole.items()})
        )
    for name, (data, error, message) in (_invalid() | groupvectors.invalid(whole)).items():
        files[f"invalid/{name}.kpc"] = data
        files[f"invalid/{name}.json"] = _json({"error": error, "message": message})
    return files


def described(data: bytes, partial: bool) -> dict[str, Any]:
    """What a decoder must find in a file: SHA-256 of every array, in the order that the spec's last section gives."""
    scene = read(data, allow_partial=partial)
    decoder = scene.decoder
    return {
        "partial": partial,
        "zstd": ZSTD_VERSION
        if any(entry.codec == CODEC_ZSTD for entry in Reader(data, allow_partial=partial).index)
        else None,
        "frame_count": scene.clip.frame_count,
        "fps": scene.clip.fps,
        "step": scene.step,
        **({"even": scene.mapping.uniform_distance} if isinstance(scene.mapping, Contraction) else {}),
        **(
            {"frame": scene.mapping.frame.tolist(), "near": scene.mapping.near, "baseline": scene.mapping.baseline}
            if isinstance(scene.mapping, DeviceCoordinates)
            else {}
        ),
        **(
            {
                "motion": {
                    "shape": list(scene.motion.symbols.shape),
                    "sha256": _sha256(scene.motion.dequantise().astype("<f4")),
                }
            }
            if scene.motion
            else {}
        ),
        **(
            {
                "appearances": {
                    "count": len(scene.appearances),
                    "names_sha256": _sha256(
                        *(np.frombuffer(look.name.encode(), np.uint8) for look in scene.appearances)
                    ),
                    "sha256": _sha256(*(look.code.astype("<f4") for look in scene.appearances)),
                }
            }
            if scene.appearances
            else {}
        ),
        "aabb": scene.aabb.tolist(),
        "background": scene.background.tolist(),
        "cameras": {"count": len(scene.cameras), "sha256": _sha256(*map(_camera, scene.cameras))},
        "occupancy": {"shape": list(scene.occupancy.shape), "sha256": _sha256(scene.occupancy.astype(np.uint8))},
        "decoder": {
            "features": sum(scale["xy"].symbols.shape[2] for scale in scene.scales),
            **({"width": len(decoder.v_bias)} if isinstance(decoder, HybridDecoder) else {}),
            "hidden": len(decoder.b1),
            "sha256": _sha256(*(np.asarray(w, "<f4") for w in vars(decoder).values())),
        },
        "planes": [
            {
                "scale": number,
                "plane": name,
                "shape": list(plane.symbols.shape),
                "symbols_sha256": _sha256(plane.symbols),
                "coded_sha256": _sha256(plane.coded.astype(np.uint8)),
                "values_sha256": _sha256(plane.dequantise().astype("<f4")),
            }
            for number, scale in enumerate(scene.scales)
            for name, plane in scale.items()
        ],
        "rays": _rays(scene),
    }


def resealed(data: bytes) -> bytes:
    """The same file with all its checksums made right again, so that what else is wrong with it shows."""
    out = bytearray(data)
    count = struct.unpack_from("<I", out, 28)[0]
    for start in range(HEADER.size, HEADER.size + ENTRY.size * count, ENTRY.size):
        stored, offset = struct.unpack_from("<I", out, start + 20)[0], struct.unpack_from("<Q", out, start + 32)[0]
        struct.pack_into("<I", out, start + 28, google_crc32c.value(bytes(out[offset : offset + stored])))
    struct.pack_into("<I", out, 56, google_crc32c.value(bytes(out[HEADER.size : HEADER.size + ENTRY.size * count])))
    struct.pack_into("<I", out, 60, google_crc32c.value(bytes(out[:60])))
    return bytes(out)


def patched(data: bytes, offset: int, layout: str, *values: int | float | bytes) -> bytes:
    """A copy with `values` at a byte offset; checksums stay as they were."""
    out = bytearray(data)
    struct.pack_into(layout, out, offset, *values)
    return bytes(out)


def encode(scene: QuantisedScene, *, segment_rows: int = 16, compress: bool = True) -> bytes:
    """A file without context-coded symbols: as kpc.format.container.scene_io.encode made it before there were any."""
    chunks = [replace(chunk, coded={}) for chunk in scene_chunks(scene, segment_rows=segment_rows)]
    return pack(chunks, _value_count(scene), compress=compress)


def context_coded(
    scene: QuantisedScene,
    sets: int = 1,
    *,
    segment_rows: int = 16,
    weights: np.ndarray | None = None,
    flat: bool = False,
    implied: bool = False,
) -> bytes:
    """A file all of whose planes are context-coded, also where raw ones would be smaller, with so many sets of weights.

    The weights, if none are given, are no good ones but such as need no floating-point fit, and the largest and the smallest among
    them. `flat`: symbols near to the scene's that are around predictions where it is flat. `implied`: maps follow from occupancy.
    """
    if weights is None:
        weights = (_noise((sets, WEIGHT_COUNT), 61) / 4).astype(np.int8)
        weights[0, 0], weights[-1, -1] = -128, 127
    if flat:
        scene = around(scene, PredictionWeights(weights), segment_rows)
    chunks = []
    for chunk in scene_chunks(scene, segment_rows=segment_rows):
        if chunk.kind == "PLNE":
            plane = scene.scales[chunk.scale][ALL_PLANES[chunk.plane]]
            rows = slice(chunk.row_start, chunk.row_start + chunk.row_count)
            symbols, coded = plane.symbols[rows], plane.coded[rows]
            lattice = DEPENDENT if flat else TRELLIS if follows_trellis(symbols, coded) else SCALAR
            body = encode_with_weights(weights, symbols, coded, lattice, _needed(scene, chunk) if implied else None)
            chunks.append(_forced(chunk, body, codec_of(body)))
        else:
            chunks.append(replace(chunk, coded={}))
    return pack(chunks, _value_count(scene))


def around(scene: QuantisedScene, side_info: PredictionWeights, segment_rows: int) -> QuantisedScene:
    """The scene with near symbols, none at the ends of 8 bits, that follow a side_info in each segment."""

    def moved(plane: QuantisedPlane, rows: int) -> QuantisedPlane:
        segments = [
            np.clip(plane.symbols[start : start + rows], -126, 126) for start in range(0, len(plane.symbols), rows)
        ]
        for number, symbols in enumerate(segments):
            walked(symbols, plane.coded[rows * number : rows * (number + 1)], side_info.weights, DEPENDENT)
        return replace(plane, symbols=np.concatenate(segments), side_info=side_info)

    return replace(
        scene,
        scales=tuple(
            {
                name: moved(plane, segment_rows if name in TIME_PLANES else len(plane.symbols))
                for name, plane in scale.items()
            }
            for scale in scene.scales
        ),
    )


def in_blocks(
    scene: QuantisedScene,
    side: int,
    quantiser: int,
    spread: float,
    *,
    segment_rows: int = 16,
    codec: int = CODEC_SYMBOLS,
    implied: bool = False,
) -> bytes:
    """A file all of whose planes are told in blocks of a side, or of smaller ones where a segment is small, with levels from noise, those of
    means as large as may be, quick ones small; levels grow and fall with `spread`. `implied`: maps follow from occupancy."""

    def body(chunk: Chunk) -> bytes:
        plane = scene.scales[chunk.scale][ALL_PLANES[chunk.plane]]
        coded = plane.coded[chunk.row_start : chunk.row_start + chunk.row_count]
        N = min(side, largest_side(*coded.shape))
        grid, seed = coded_blocks(coded, N).shape, 100 + 10 * chunk.plane + chunk.scale
        levels = _noise((plane.symbols.shape[2], *grid, N, N), seed) / 128 * spread
        levels *= np.float32(1) / (1 + np.add.outer(np.arange(N), np.arange(N), dtype=np.float32)) ** 2
        step_offsets = np.abs(_noise(grid, seed + 1)).astype(np.int64) % OFFSET_COUNT
        return encode_blocks(
            TransformBlocks(np.trunc(levels).astype(np.int64), step_offsets, quantiser),
            coded,
            _needed(scene, chunk) if implied else None,
            borders=codec == CODEC_THIRD,
        )

    chunks = [
        _forced(chunk, body(chunk), codec) if chunk.kind == "PLNE" else replace(chunk, coded={})
        for chunk in scene_chunks(scene, segment_rows=segment_rows)
    ]
    return pack(chunks, _value_count(scene))


on_from_borders = partial(in_blocks, codec=CODEC_THIRD)


def seen_through(scene: QuantisedScene, occupancy: np.ndarray) -> QuantisedScene:
    """The scene so occupied, of whose planes those texels are coded that this needs."""

    def cut(name: str, plane: QuantisedPlane) -> QuantisedPlane:
        coded = needed_texels(occupancy, name, *plane.coded.shape)
        return replace(plane, symbols=plane.symbols * coded[..., None], coded=coded)

    scales = tuple({name: cut(name, plane) for name, plane in scale.items()} for scale in scene.scales)
    return replace(scene, occupancy=occupancy, scales=scales)


def seen_through_slits(scene: QuantisedScene) -> QuantisedScene:
    """The same with few cells occupied."""
    return seen_through(scene, _noise((2 if scene.is_dynamic else 1, 5, 7, 6), 96) > 110)


def _needed(scene: QuantisedScene, chunk: Chunk) -> np.ndarray:
    """Those texels of a segment."""
    name = ALL_PLANES[chunk.plane]
    return needed_texels(scene.occupancy, name, *scene.scales[chunk.scale][name].coded.shape)[
        chunk.row_start : chunk.row_start + chunk.row_count
    ]


def walked(symbols: np.ndarray, coded: np.ndarray, weights: np.ndarray, lattice: int) -> bytes:
    """A segment that tells (H, W, M) symbols up to the first that leaves its 8 bits, each moved so that it follows the lattice."""
    trace = np.empty(symbols.size * MAX_DECISIONS, np.int16)
    _, at, _ = code_symbols(symbols, np.ascontiguousarray(coded), lattice, weights, 0, 0, None, trace, None)
    return bytes([len(weights), lattice << LATTICE_BIT]) + weights.tobytes() + encode_trace(trace[:at])


def coded_grids(scene: QuantisedScene) -> bytes:
    """A file whose planes are as they ever were, but whose grids are context-coded with codec 2, also where raw ones would be smaller."""
    chunks = []
    for chunk in scene_chunks(scene):
        body = chunk.coded[CODEC_SYMBOLS]() if chunk.kind == "OCCU" else None
        if chunk.kind == "MOVE":  # weights that need no floating-point fit, and the largest and the smallest among them
            weights = LORENZO - _noise((NEIGHBOURS,), 67).astype(np.int16)
            weights[-2:] = -32768, 32767
            body = chunk.parts[0][: MOTION_STRUCT.size] + encode_nodes_with(weights, scene.motion.symbols)
        chunks.append(_forced(chunk, body) if body else replace(chunk, coded={}))
    return pack(chunks, _value_count(scene))


def halved(scene: QuantisedScene) -> bytes:
    """A file whose motion grid is told by midpoints, also where a raw one would be smaller, and all else as it ever was."""
    chunks = [
        _forced(chunk, chunk.coded[CODEC_MIDPOINTS](), CODEC_MIDPOINTS)
        if chunk.kind == "MOVE"
        else replace(chunk, coded={})
        for chunk in scene_chunks(scene)
    ]
    return pack(chunks, _value_count(scene))


def coded_weights(scene: QuantisedScene) -> bytes:
    """A file whose decoder's weights are context-coded, also where raw ones would be smaller, and all else as it ever was."""
    chunks = [
        _forced(chunk, chunk.coded[CODEC_SYMBOLS]()) if chunk.kind in ("DECO", "HYBR") else replace(chunk, coded={})
        for chunk in scene_chunks(scene)
    ]
    return pack(chunks, _value_count(scene))


def posed(scene: QuantisedScene, body: bytes) -> bytes:
    """A file of raw chunks with these cameras, as `told_poses` tells them."""
    chunks = [replace(chunk, parts=[body]) if chunk.kind == "came" else chunk for chunk in scene_chunks(scene)]
    came = next(number for number, chunk in enumerate(chunks) if chunk.kind == "came")
    return claiming(chunks, came, _value_count(scene), 2 + struct.unpack_from("<H", body)[0] * CAMERA_STRUCT.size)


def told_poses(
    exponent: int, corner: tuple[int, ...], turns: list[tuple[int, ...]], places: list[tuple[int, ...]], lenses: int = 1
) -> bytes:
    """The `came` chunk of such cameras under codec 2. `turns`: which number of a quaternion is left out, and the others."""

    def word(numbers: tuple[int, ...], above: int = 0) -> bytes:
        return sum(number << BITS * k for k, number in enumerate((*numbers, above))).to_bytes(WORD, "little")

    told = (
        word(tuple(number + NOTHING for number in others), largest) + word(place)
        for (largest, *others), place in zip(turns, places, strict=True)
    )
    kinds = (LENS.pack(64 + k, 48, 80.0, 80.5 + k, 32.0, 24.0) for k in range(lenses))
    return POSES_HEAD.pack(len(turns), lenses, exponent, *corner) + b"".join(kinds) + b"".join(told)


def all_zstd(scene: QuantisedScene) -> bytes:
    """A file all of whose chunks are zstd frames, also where raw ones would be smaller."""
    chunks = scene_chunks(scene)
    raws = [b"".join(chunk.parts) for chunk in chunks]
    bodies = [zstandard.ZstdCompressor(level=19).compress(raw) for raw in raws]
    data = pack(
        [replace(chunk, parts=[body], coded={}) for chunk, body in zip(chunks, bodies, strict=True)],
        _value_count(scene),
        compress=False,
    )
    for number, raw in enumerate(raws):
        entry = HEADER.size + ENTRY.size * number
        data = patched(patched(data, entry + 16, "<H", CODEC_ZSTD), entry + 24, "<I", len(raw))
    return resealed(patched(data, 48, "<I", max(map(len, raws))))


def _forced(chunk: Chunk, body: bytes, codec: int = CODEC_SYMBOLS) -> Chunk:
    """The chunk with a context-coded body, which the writer takes because the raw one is no longer smaller."""
    return replace(chunk, parts=[body, b"\0"], coded={codec: lambda: body})


def in_columns(
    data: bytes,
    change: Callable[[bytes], bytes] = bytes,
    count: int | None = None,
    *,
    frame: Callable[[bytes], bytes] = bytes,
) -> bytes:
    """A file of version 1 as one of version 2, its index in a frame of a raw block, which no library has to make.

    The index may be changed before it comes into the frame, the frame itself, and the number of chunks in the header; checksums are right.
    """
    reader = Reader(data)
    columns = change(container.in_columns(data[HEADER.size : HEADER.size + reader.header.index_length]))
    index = frame(
        b"\x28\xb5\x2f\xfd\xa0"
        + struct.pack("<I", len(columns))
        + struct.pack("<I", 1 | len(columns) << 3)[:3]
        + columns
    )
    body = data[HEADER.size + reader.header.index_length :]
    head = patched(
        data[: HEADER.size], 24, "<IIQ", len(index), count or len(reader.index), HEADER.size + len(index) + len(body)
    )
    head = patched(patched(head, 8, "<H", VERSION), 56, "<I", google_crc32c.value(index))
    return patched(head, 60, "<I", google_crc32c.value(head[:60])) + index + body


def claiming(chunks: list[Chunk], number: int, value_count: int, length: int, codec: int = CODEC_SYMBOLS) -> bytes:
    """A file of raw chunks, of which one claims to be context-coded and to stand for so many bytes."""
    data = pack(chunks, value_count, compress=False)
    data = patched(data, 48, "<I", max(length, Reader(data).header.largest_raw))
    entry = HEADER.size + ENTRY.size * number
    return resealed(patched(patched(data, entry + 16, "<H", codec), entry + 24, "<I", length))


def _on_trellis(scene: QuantisedScene) -> QuantisedScene:
    """The scene with the last bit of its symbols such that they follow the trellis."""

    def moved(plane: QuantisedPlane) -> QuantisedPlane:
        symbols = plane.symbols.copy()
        for y, c in np.ndindex(len(symbols), symbols.shape[2]):
            place = 0
            for x in np.flatnonzero(plane.coded[y]):
                symbols[y, x, c] = symbols[y, x, c] & ~1 | place & 1
                place = trellis_transition(place, int(symbols[y, x, c]))
        return replace(plane, symbols=symbols)

    return replace(scene, scales=tuple({name: moved(plane) for name, plane in scale.items()} for scale in scene.scales))


def _value_count(scene: QuantisedScene) -> int:
    return sum(plane.symbols.size for scale in scene.scales for plane in scale.values())


def _motion_grids(
    name: str, coded: Callable[[QuantisedScene], bytes], dense: QuantisedScene, moved: QuantisedScene
) -> dict[str, tuple[bytes, bool]]:
    """Files whose motion grid is so coded: of a scene that is to move, and of one that does."""
    extremes = QuantisedMotion(np.where(_noise((3, 2, 4, 3, 3), 43) < 0, -32768, 32767).astype(np.int16), 0.5**13)
    return {
        name: (coded(replace(dense, motion=_swaying(6, 4, 3, 5))), False),
        f"{name}-noise": (coded(moved), False),
        f"{name}-prefix": (coded(moved)[: Reader(coded(moved)).index[5].offset], True),
        f"{name}-extremes": (coded(replace(dense, motion=extremes)), False),
        f"{name}-smallest": (coded(replace(dense, motion=_motion(2, 2, 2, 2))), False),
    }


def _valid() -> dict[str, tuple[bytes, bool]]:
    dynamic = _scene(dynamic=True, sizes=[(2, 5, 4, 3, 3), (4, 9, 8, 7, 6)], cameras=2)
    packed = encode(dynamic, segment_rows=4)
    minimal = minimal_scene()
    dense = replace(_scene(dynamic=True, sizes=[(2, 9, 8, 7, 3)], cameras=1), occupancy=_noise((2, 3, 3, 5), 98) > -64)
    contracted, moved = replace(dense, mapping=Contraction(3.5)), replace(dense, motion=_motion(4, 3, 2, 5))
    frame = np.array([[0.96, 0, 0.28, 0.5], [0, 1, 0, -0.25], [-0.28, 0, 0.96, 3]])
    faced = replace(
        dense,
        mapping=DeviceCoordinates(frame, 1.5, 2.0),
        aabb=np.array([[-0.5, -0.5, 0.125], [0.5, 0.5, 1.25]], np.float32),
    )
    hybrid = replace(dense, decoder=_hybrid(2, 5, 3))
    varied = replace(dense, appearances=_appearances("north.mp4", "süd.mp4", "東/0003.jpg"))
    y, x = np.indices((6, 9))
    rolling = np.stack(
        [np.stack([(x - s - 4) ** 2 + (y - 2) ** 2 + (z - 3) ** 2 < 8 for z in range(5)]) for s in range(3)]
    )
    note = Chunk("note", [b"readers skip what they need not know"])
    chunks = scene_chunks(minimal)
    index = Reader(packed).index
    coarse_ends = next(entry.offset for entry in index if entry.scale == 1)
    columns = in_columns(context_coded(dynamic, 8, segment_rows=4))
    plain = _scene(dynamic=False, sizes=[(1, 2, 2, 2, 0)], cameras=1)
    some = _noise((5, 6), 83).astype(int) * 500
    poses = told_poses(
        -17,
        (-131072, 3, 99999),
        [(k % 4, *some[k, :3].tolist()) for k in range(5)],
        [tuple((some[k, 3:] + NOTHING).tolist()) for k in range(5)],
    )
    turns = [
        (largest, *others)
        for largest in range(4)
        for others in ((-ROOT, -ROOT, 0), (ROOT, 0, ROOT - 1), (0, 0, -NOTHING), (0, 0, 0))
    ]
    return {
        "minimal": (encode(minimal, compress=False), False),
        "static": (encode(_scene(dynamic=False, sizes=[(3, 17, 13, 11, 0)])), False),
        "dynamic": (packed, False),
        "dynamic-raw": (encode(dynamic, segment_rows=4, compress=False), False),
        "dynamic-prefix": (packed[:coarse_ends], True),
        "one-texel": (encode(_scene(dynamic=True, sizes=[(1, 1, 1, 1, 1)]), compress=False), False),
        "wrap": (encode(_scene(dynamic=False, sizes=[(8, 12, 10, 6, 0)], amplitude=400), compress=False), False),
        "contracted": (encode(contracted), False),
        "contracted-prefix": (encode(contracted)[: Reader(encode(contracted)).index[4].offset], True),
        "moved": (encode(moved), False),
        "moved-prefix": (encode(moved)[: Reader(encode(moved)).index[4].offset], True),
        "moved-contracted": (encode(replace(contracted, motion=_motion(2, 2, 2, 2, 32.0)), compress=False), False),
        "device-coordinates": (encode(faced), False),
        "hybrid": (encode(hybrid), False),
        "hybrid-moved": (encode(replace(hybrid, motion=moved.motion, decoder=_hybrid(2, 1, 1)), compress=False), False),
        "appearances": (encode(varied), False),
        "appearances-prefix": (encode(varied)[: Reader(encode(varied)).index[4].offset], True),
        "symbols": (context_coded(dynamic, 8, segment_rows=4), False),
        "symbols-prefix": (context_coded(dynamic, 2)[: Reader(context_coded(dynamic, 2)).index[9].offset], True),
        "symbols-extremes": (
            context_coded(_painted(lambda shape, seed: np.where(_noise(shape, seed) < 0, -128, 127)), 4),
            False,
        ),
        "symbols-noise": (context_coded(_painted(_noise), 2), False),
        "symbols-contexts": (_in_all_contexts(), False),
        "symbols-constant": (
            context_coded(_painted(lambda shape, seed: np.full(shape, (127, -128, 1)[seed % 3]))),
            False,
        ),
        "symbols-empty": (context_coded(_painted(lambda shape, seed: np.zeros(shape), coded=False)), False),
        "trellis": (context_coded(_on_trellis(dynamic), 8, segment_rows=4), False),
        "trellis-extremes": (
            context_coded(_on_trellis(_painted(lambda shape, seed: np.where(_noise(shape, seed) < 0, -128, 127))), 4),
            False,
        ),
        "around": (context_coded(dynamic, 8, segment_rows=4, flat=True), False),
        "around-extremes": (
            context_coded(_painted(lambda shape, seed: np.where(_noise(shape, seed) < 0, -128, 127)), 4, flat=True),
            False,
        ),
        "around-flat": (context_coded(_painted(lambda shape, seed: _noise(shape, seed) // 50), 2, flat=True), False),
        "blocks": (in_blocks(dynamic, 16, 12, 60, segment_rows=4), False),
        "blocks-prefix": (in_blocks(dynamic, 8, 64, 8)[: Reader(in_blocks(dynamic, 8, 64, 8)).index[9].offset], True),
        "blocks-extremes": (in_blocks(_scene(dynamic=True, sizes=[(2, 9, 6, 5, 4)]), 4, 255, 8196), False),
        "blocks-fine": (in_blocks(_scene(dynamic=False, sizes=[(2, 20, 17, 9, 0)]), 16, 1, 8196), False),
        "blocks-empty": (in_blocks(_painted(lambda shape, seed: np.zeros(shape), coded=False), 8, 64, 0), False),
        "blocks-one-texel": (in_blocks(_scene(dynamic=True, sizes=[(3, 1, 1, 1, 1)]), 4, 64, 20), False),
        "borders": (on_from_borders(dynamic, 16, 12, 60, segment_rows=4), False),
        "implied": (
            context_coded(
                seen_through_slits(_scene(dynamic=True, sizes=[(2, 11, 8, 9, 6), (3, 20, 13, 17, 6)])),
                2,
                segment_rows=4,
                implied=True,
            ),
            False,
        ),
        "implied-borders": (
            on_from_borders(
                seen_through_slits(_scene(dynamic=True, sizes=[(2, 29, 21, 16, 5)])), 8, 20, 100, implied=True
            ),
            False,
        ),
        "borders-eight": (on_from_borders(_scene(dynamic=True, sizes=[(2, 20, 17, 9, 4)]), 8, 20, 100), False),
        "borders-sparse": (
            on_from_borders(seen_through_slits(_scene(dynamic=False, sizes=[(3, 41, 38, 35, 0)])), 4, 24, 24),
            False,
        ),
        "blocks-sparse": (
            in_blocks(seen_through_slits(_scene(dynamic=False, sizes=[(3, 41, 38, 35, 0)])), 4, 24, 24),
            False,
        ),
        "borders-prefix": (
            on_from_borders(dynamic, 8, 64, 8)[: Reader(on_from_borders(dynamic, 8, 64, 8)).index[9].offset],
            True,
        ),
        "borders-extremes": (on_from_borders(_scene(dynamic=True, sizes=[(2, 9, 6, 5, 4)]), 4, 255, 8196), False),
        "borders-large": (on_from_borders(_scene(dynamic=False, sizes=[(2, 33, 20, 17, 0)]), 16, 255, 8196), False),
        "borders-fine": (on_from_borders(_scene(dynamic=False, sizes=[(2, 20, 17, 9, 0)]), 16, 1, 8196), False),
        "borders-empty": (on_from_borders(_painted(lambda shape, seed: np.zeros(shape), coded=False), 8, 64, 0), False),
        "borders-one-texel": (on_from_borders(_scene(dynamic=True, sizes=[(3, 1, 1, 1, 1)]), 4, 64, 20), False),
        "symbols-one-texel": (context_coded(_scene(dynamic=True, sizes=[(3, 1, 1, 1, 1)])), False),
        "cells": (coded_grids(replace(dense, occupancy=rolling)), False),
        "cells-noise": (coded_grids(dense), False),
        "cells-prefix": (coded_grids(dense)[: Reader(coded_grids(dense)).index[4].offset], True),
        "cells-thin": (coded_grids(replace(minimal, occupancy=_noise((1, 1, 1, 70), 97) > 0)), False),
        "cells-one": (coded_grids(minimal), False),
        "cells-long-times": (coded_grids(replace(dense, occupancy=_noise((40, 1, 2, 1), 96) > 0)), False),
        **_motion_grids("nodes", coded_grids, dense, moved),
        **_motion_grids("midpoints", halved, dense, moved),
        "midpoints-uneven": (halved(replace(dense, motion=_swaying(12, 2, 8, 7))), False),
        "unknown-ancillary": (pack([*chunks[:3], note, *chunks[3:]], 12, compress=False), False),
        "version-0": (of_the_draft(encode(_scene(dynamic=True, sizes=[(1, 1, 1, 1, 1)]), compress=False)), False),
        "version-0-symbols": (of_the_draft(context_coded(dynamic, 8, segment_rows=4)), False),
        "weights": (coded_weights(dense), False),
        "weights-hybrid": (coded_weights(hybrid), False),
        "weights-prefix": (coded_weights(dense)[: Reader(coded_weights(dense)).index[4].offset], True),
        "poses": (posed(plain, poses), False),
        "poses-prefix": (posed(plain, poses)[: Reader(posed(plain, poses)).index[4].offset], True),
        "poses-lenses": (
            posed(
                plain,
                told_poses(-24, (-5, 1 << 24, -7), 3 * [(0, 3, 4, 5)], [(1, 0, 2), (0, 9, 0), (4, 4, 0)], lenses=3),
            ),
            False,
        ),
        "poses-extremes": (
            posed(plain, told_poses(30, (-1, 0, -1), turns, [(k & 1, k >> 1 & 1, 0) for k in range(len(turns))])),
            False,
        ),
        "poses-small": (
            posed(plain, told_poses(-126, (-(1 << 31), 0, (1 << 31) - 1), [(3, 0, 0, 0)], [((1 << BITS) - 1, 1, 0)])),
            False,
        ),
        "weights-extremes": (coded_weights(replace(dense, decoder=_extreme(dense.decoder))), False),
        "columns": (columns, False),
        "columns-prefix": (columns[: Reader(columns).index[9].offset], True),
        "zstd": (all_zstd(replace(varied, mapping=contracted.mapping, motion=moved.motion)), False),
        "zstd-hybrid": (all_zstd(hybrid), False),
        "time-empty": (encode(_at_rest(dynamic), segment_rows=4, compress=False), False),
        "time-empty-symbols": (context_coded(_at_rest(dynamic)), False),
        **{name: (data, False) for name, data in _limits().items()},
    }


def _limits() -> dict[str, bytes]:
    """Files at the limits of the spec's section 12, each as small as may be; none at that of chunks, which takes half a megabyte."""
    plain = _scene(dynamic=False, sizes=[(1, 2, 2, 2, 0)], cameras=1)
    moving = _scene(dynamic=True, sizes=[(1, 2, 2, 2, 2)])
    deep = _scene(dynamic=False, sizes=SCALE_LIMIT * [(1, 2, 1, 1, 0)])
    many = _scene(dynamic=False, sizes=[(CHANNEL_LIMIT, 2, 1, 1, 0)])
    axes = _scene(dynamic=True, sizes=[(1, AXIS_LIMIT, 1, 2, 1), (1, 2, AXIS_LIMIT, 1, 2), (1, 1, 2, AXIS_LIMIT, 1)])
    rows = _scene(dynamic=True, sizes=[(1, 1, 2, 1, AXIS_LIMIT)])
    pose = np.diag([1.0, 1, 1, 1])
    names = [chr(0x4E00 + k) for k in range(APPEARANCE_LIMIT)]
    steps = np.float32(
        [16, 8, 0.5**20, 0.5**149, 0.5**126]
    )  # the last two: the least number above 0, the least that is normal
    wide = {
        name: QuantisedPlane(
            np.tile(np.int8([[[-128], [127], [1]]]), (1, 1, 5)),
            steps,
            np.float32([0, -1024, 1, 0, 0.5**126]),
            np.ones((1, 3), bool),
        )
        for name in SPACE_PLANES[:2]
    }
    wide["yz"] = replace(wide["xy"], symbols=wide["xy"].symbols[:, :1], coded=np.ones((1, 1), bool))
    decoder = _scene(dynamic=False, sizes=[(5, 1, 1, 1, 0)]).decoder
    far = replace(
        plain,
        aabb=np.float32([[-BOX_LIMIT] * 3, [BOX_LIMIT] * 3]),
        clip=Clip(FRAME_LIMIT, 5e-324),
        scales=(wide,),
        decoder=decoder,
        step=2.0**32 / SAMPLE_LIMIT,
        occupancy=np.zeros((1, 1, 1, 1), bool),
        background=np.float32([0, 1, 1]),
        cameras=(
            Camera(
                65535,
                65535,
                BOX_LIMIT,
                BOX_LIMIT,
                -BOX_LIMIT,
                BOX_LIMIT,
                pose + np.pad([[BOX_LIMIT]], ((0, 3), (3, 0))),
            ),
        ),
        appearances=_appearances("n" * NAME_LIMIT, "é" * (NAME_LIMIT // 2)),
    )
    near = replace(
        plain,
        aabb=np.float32([[0, 0, 0], [1 / BOX_LIMIT] * 3]),
        step=2.0**-33,
        clip=Clip(1, 1.7e308),
        occupancy=far.occupancy,
        mapping=Contraction(1 / BOX_LIMIT),
    )
    periodic = _noise((97,), 71) / np.float32(64)

    def repeated(shapes: dict[str, tuple[int, ...]]) -> dict[str, np.ndarray]:
        return {name: np.resize(periodic, shape) for name, shape in shapes.items()}

    return {
        "limits-scales": encode(
            replace(deep, decoder=replace(deep.decoder, density_weight=np.zeros(SCALE_LIMIT, np.float32)))
        ),
        "limits-channels": encode(many),
        "limits-axes": encode(
            _smooth(replace(axes, occupancy=np.ones((1, 1, 1, AXIS_LIMIT), bool))), segment_rows=AXIS_LIMIT
        ),
        "limits-rows": encode(
            _smooth(replace(rows, occupancy=np.ones((AXIS_LIMIT, 1, 1, 1), bool))), segment_rows=AXIS_LIMIT
        ),
        "limits-motion": encode(
            replace(
                moving,
                motion=QuantisedMotion(np.resize(np.int16([-32768, 32767, 0]), (AXIS_LIMIT, 2, 2, 2, 3)), 1 / 32),
            )
        ),
        "limits-nodes": coded_grids(replace(moving, motion=_swaying(2, 2, 2, MOTION_LIMIT))),
        "limits-hidden": encode(
            replace(plain, decoder=Decoder(density_bias=0.5, **repeated(Decoder.shapes(1, HIDDEN_LIMIT))))
        ),
        "limits-hybrid": encode(
            replace(
                plain,
                decoder=HybridDecoder(
                    density_bias=0.5, **repeated(HybridDecoder.shapes(1, HIDDEN_LIMIT, HIDDEN_LIMIT))
                ),
            )
        ),
        "limits-cameras": encode(
            replace(
                plain, cameras=tuple(Camera(64 + k % 7, 48, 80.0, 80.5, 32.0, 24.0, pose) for k in range(CAMERA_LIMIT))
            )
        ),
        "limits-appearances": encode(
            replace(plain, appearances=tuple(Appearance(name, np.zeros(3, np.float32)) for name in names))
        ),
        "limits-large": encode(far),
        "limits-small": encode(near),
    }


def _at_rest(scene: QuantisedScene) -> QuantisedScene:
    """The scene with time planes none of whose texels is coded."""
    return replace(
        scene,
        scales=tuple(
            {
                name: replace(plane, symbols=0 * plane.symbols, coded=plane.coded & False)
                if name in TIME_PLANES
                else plane
                for name, plane in scale.items()
            }
            for scale in scene.scales
        ),
    )


def _smooth(scene: QuantisedScene) -> QuantisedScene:
    """The scene with planes that take few bytes however large they are: they rise and fall slowly, from end to end of 8 bits."""

    def slow(plane: QuantisedPlane) -> QuantisedPlane:
        index = np.arange(plane.symbols.size).reshape(plane.symbols.shape) // 32 % 512
        return replace(plane, symbols=(np.minimum(index, 511 - index) - 128).astype(np.int8), coded=plane.coded | True)

    return replace(scene, scales=tuple({name: slow(plane) for name, plane in scale.items()} for scale in scene.scales))


def _invalid() -> dict[str, tuple[bytes, str, str]]:
    scene = _scene(dynamic=True, sizes=[(2, 5, 4, 3, 3)], cameras=1)
    good = encode(scene, segment_rows=2, compress=False)
    chunks = scene_chunks(scene, segment_rows=2)
    values = Reader(good).header.value_count
    entry = [HEADER.size + ENTRY.size * number for number in range(len(chunks))]
    body = [e.offset for e in Reader(good).index]
    scne, deco, occu, came, xy = range(5)  # the order in which the writer lays chunks out
    xt = next(number for number, chunk in enumerate(chunks) if chunk.plane == ALL_PLANES.index("xt"))

    def repacked(number: int, change: Callable[[bytes], bytes]) -> bytes:
        """The file with the raw bytes of one chunk changed, everything around it in order."""
        raw = b"".join(chunks[number].parts)
        old = chunks[number]
        new = Chunk(old.kind, [change(raw)], old.scale, old.plane, old.row_start, old.row_count)
        return pack([*chunks[:number], new, *chunks[number + 1 :]], values, compress=False)

    def set_at(offset: int, layout: str, *numbers: int | float) -> Callable[[bytes], bytes]:
        return lambda raw: patched(raw, offset, layout, *numbers)

    def with_chunks(kind: str, *parts: bytes) -> bytes:
        """The file with more chunks, of a kind that follows SCNE."""
        return pack([chunks[scne], *(Chunk(kind, [part]) for part in parts), *chunks[deco:]], values, compress=False)

    def warped(*parts: bytes) -> bytes:
        return with_chunks("WARP", *parts)

    still = _scene(dynamic=False, sizes=[(1, 2, 2, 2, 0)])
    still_values = Reader(encode(still)).header.value_count

    def ndc(near: float = 0.5, skew: float = 0.0) -> bytes:
        return struct.pack("<I12ddd", 2, 1, 0, 0, 0.5, skew, 1, 0, -0.25, 0, 0, 1, 3, near, 2.0)

    def displaced(*parts: bytes) -> bytes:
        return with_chunks("MOVE", *parts)

    def move(rows: int, nz: int, ny: int, nx: int, step: float) -> bytes:
        return struct.pack("<4Hf", rows, nz, ny, nx, step) + bytes(6 * 16)

    mlps = b"".join(scene_chunks(replace(scene, decoder=_hybrid(2, 2, 2)))[deco].parts)

    def decoded_by(*parts: bytes) -> bytes:
        """The file with hybrid decoders in place of its own."""
        return pack(
            [*chunks[:deco], *(Chunk("HYBR", [part]) for part in parts), *chunks[occu:]], values, compress=False
        )

    def varied(*parts: bytes) -> bytes:
        return with_chunks("appe", *parts)

    def appe(*names: bytes, count: int = 2, hidden: int = 3, codes: bytes = bytes(2 * 2 * 3)) -> bytes:
        return (
            struct.pack("<HH", count, hidden) + codes + b"".join(struct.pack("<B", len(name)) + name for name in names)
        )

    def without(number: int) -> bytes:
        return pack(chunks[:number] + chunks[number + 1 :], values, compress=False)

    run = 1 << 17  # RFC 8878: a frame of one segment that claims 1 MiB, then eight blocks of 128 KiB of zeros each
    bomb = (
        b"\x28\xb5\x2f\xfd\xa0"
        + struct.pack("<I", 8 * run)
        + b"".join(struct.pack("<I", (block == 7) | 1 << 1 | run << 3)[:3] + b"\0" for block in range(8))
    )
    bomb_file = pack([*chunks[:xy], Chunk("PLNE", [bomb], 0, 0, 0, 4), *chunks[xy + 1 :]], values, compress=False)
    nan = float("nan")
    broken = "FormatError"

    symbols = np.array([[[0, 1], [100, -7]], [[-128, 127], [3, 3]]], np.int16)
    weights = np.zeros((1, WEIGHT_COUNT), np.int8)
    whole = np.ones((2, 2), bool)
    coarse = encode_with_weights(weights, symbols.astype(np.int8), whole, SCALAR)
    small = _scene(dynamic=False, sizes=[(2, 2, 2, 2, 0)])
    small_chunks = scene_chunks(small)
    small_xy = next(number for number, chunk in enumerate(small_chunks) if chunk.kind == "PLNE")

    def context(body: bytes, codec: int = CODEC_SYMBOLS) -> bytes:
        """A file whose first plane is so coded."""
        told = [*small_chunks[:small_xy], _forced(small_chunks[small_xy], body, codec), *small_chunks[small_xy + 1 :]]
        return pack(
            [chunk if number == small_xy else replace(chunk, coded={}) for number, chunk in enumerate(told)], 24
        )

    told = context(coarse)
    four = TransformBlocks(np.trunc(_noise((2, 1, 1, 4, 4), 71) / 8).astype(np.int64), np.full((1, 1), 2), 40)
    in_four, from_borders = (encode_blocks(four, whole, borders=borders) for borders in (False, True))
    third = partial(context, codec=CODEC_THIRD)
    small_entry = HEADER.size + ENTRY.size * small_xy
    state_at = 2 + WEIGHT_COUNT
    small_occu = next(number for number, chunk in enumerate(small_chunks) if chunk.kind == "OCCU")
    cells = struct.pack("<4H", 1, 3, 3, 5) + encode_occupancy(_noise((1, 3, 3, 5), 99) > 0)

    def occupied(body: bytes, length: int = 8 + 6) -> bytes:
        """A file whose occupancy is so coded, and claims to stand for so many bytes."""
        stored = [Chunk("OCCU", [body]) if chunk.kind == "OCCU" else chunk for chunk in small_chunks]
        return claiming(stored, small_occu, 24, length)

    grid = _swaying(3, 2, 2, 2)
    nodes = struct.pack("<4Hf", 3, 2, 2, 2, grid.step) + encode_nodes_with(LORENZO, grid.symbols)
    nodes_at = 12 + 2 * NEIGHBOURS
    leaving = np.zeros((2, 2, 2, 2, 3), np.int32)
    leaving[0, 0, 0, 0, 0] = 40_000

    def moving(body: bytes, length: int = 12 + 6 * 24, codec: int = CODEC_SYMBOLS) -> bytes:
        """A file with a motion grid that is so coded, and claims to stand for so many bytes."""
        return claiming([chunks[scne], Chunk("MOVE", [body]), *chunks[deco:]], 1, values, length, codec)

    halves = nodes[:12] + encode_motion(grid.symbols)
    moving_halves = partial(moving, codec=CODEC_MIDPOINTS)

    small_deco = next(number for number, chunk in enumerate(small_chunks) if chunk.kind == "DECO")
    small_weights = small_chunks[small_deco].coded[CODEC_SYMBOLS]()
    powers_at = DECODER_STRUCT.size
    small_raw = len(small_chunks[small_deco].parts[0])

    def weighing(body: bytes, length: int = small_raw) -> bytes:
        """A file whose decoder is so coded, and claims to stand for so many bytes."""
        stored = [Chunk("DECO", [body]) if number == small_deco else chunk for number, chunk in enumerate(small_chunks)]
        return claiming(stored, small_deco, 24, length)

    told_turn = told_poses(-10, (0, 1, 2), [(0, 1, 2, 3), (1, 4, 5, 6)], [(7, 8, 9), (0, 0, 0)])

    def turned(body: bytes, length: int = 2 + 2 * CAMERA_STRUCT.size) -> bytes:
        """A file with such cameras, which claim to stand for so many bytes."""
        return claiming([*small_chunks[:3], Chunk("came", [body]), *small_chunks[3:]], 3, 24, length)

    def damaged_words(
        name: str, made: Callable[[bytes], bytes], body: bytes, state_at: int
    ) -> dict[str, tuple[bytes, str, str]]:
        """Files, `made` of a body with state and words from `state_at` to its end, in which these are damaged."""
        last = len(body) - 1
        return {
            f"{name}-short": (made(body[: state_at + 3]), broken, "cut off within its words"),
            f"{name}-half-word": (made(body[:-1]), broken, "cut off within its words"),
            f"{name}-cut": (made(body[:-2]), broken, "do not end where they should"),
            f"{name}-long": (made(body + bytes(2)), broken, "do not end where they should"),
            f"{name}-state": (made(patched(body, state_at, "<I", 65535)), broken, "first state is too small"),
            f"{name}-end": (made(patched(body, last, "<B", body[last] ^ 1)), broken, "do not end where they should"),
        }

    # A plane of nothing, told in fewer bytes than its number of symbols allows; the writer itself would take the zstd frame.
    vast = _scene(dynamic=False, sizes=[(256, 64, 64, 1, 0)])
    vast = replace(
        vast,
        scales=(
            {
                name: replace(plane, symbols=0 * plane.symbols, coded=plane.coded & False)
                for name, plane in vast.scales[0].items()
            },
        ),
    )
    nothing = encode_with_weights(weights, vast.scales[0]["xy"].symbols, vast.scales[0]["xy"].coded, TRELLIS)
    hollow = [
        replace(chunk, coded={}, parts=[nothing] if number == small_xy else chunk.parts)
        for number, chunk in enumerate(scene_chunks(vast))
    ]
    bomb_symbols = patched(pack(hollow, _value_count(vast)), small_entry + 16, "<H", 2)
    for place in (48, small_entry + 24):
        bomb_symbols = patched(bomb_symbols, place, "<I", 64 * 64 * 256)
    return {
        "empty": (b"", broken, "not a .kpc file"),
        "magic": (patched(good, 1, "4s", b"JPEG"), broken, "not a .kpc file"),
        "version": (resealed(patched(good, 8, "<H", 2)), broken, "bytes of index"),  # its index is that of version 1
        "version-3": (resealed(patched(good, 8, "<H", 3)), broken, "format version 3"),
        "columns-garbage": (
            in_columns(good, frame=lambda frame: patched(frame, 0, "<B", 0)),
            broken,
            "chunk index is no valid zstd frame",
        ),
        "columns-long": (
            in_columns(good, frame=lambda frame: frame + b"\0"),
            broken,
            "chunk index is no valid zstd frame",
        ),
        "columns-fewer": (in_columns(good, count=len(chunks) + 1), broken, "claims another length"),
        "columns-many": (in_columns(good, count=1000), broken, "1000 chunks in a file of"),
        "columns-reserved": (
            in_columns(good, lambda told: patched(told, 18 * len(chunks), "<B", 1)),
            broken,
            "reserved",
        ),
        "columns-kind": (in_columns(good, lambda told: patched(told, 0, "<B", 0)), broken, "four letters"),
        "columns-end": (
            in_columns(good, lambda told: patched(told, 21 * len(chunks), "<B", 1)),
            broken,
            "the chunks end at",
        ),
        "columns-raw-length": (
            in_columns(good, lambda told: patched(told, 26 * len(chunks), "<B", 255)),
            broken,
            "more than the header's",
        ),
        "header-crc": (patched(good, 40, "<Q", values + 1), broken, "header is damaged"),
        "header-flags": (resealed(patched(good, 10, "<H", 1)), broken, "reserved"),
        "header-reserved": (resealed(patched(good, 52, "<I", 1)), broken, "reserved"),
        "header-cut": (good[:63], broken, "cut off within the header"),
        "index-cut": (good[: HEADER.size + 1], broken, "cut off"),
        "chunk-cut": (good[:-1], broken, "cut off"),
        "trailing-byte": (good + b"\0", broken, "follow the end"),
        "no-chunks": (resealed(patched(good, 24, "<II", 0, 0)), broken, "0 chunks"),
        "huge-value-count": (resealed(patched(good, 40, "<Q", 1 << 50)), broken, "more than"),
        "huge-chunk-limit": (resealed(patched(good, 48, "<I", 0xFFFFFFFF)), broken, "more than"),
        "value-count": (resealed(patched(good, 40, "<Q", values + 1)), broken, "the header claims"),
        "index-crc": (patched(good, entry[2] + 4, "<H", 1), broken, "index is damaged"),
        "index-reserved": (resealed(patched(good, entry[2] + 18, "<H", 1)), broken, "reserved"),
        "index-kind": (resealed(patched(good, entry[3], "4s", b"c\0me")), broken, "four letters"),
        "index-gap": (resealed(patched(good, entry[1] + 32, "<Q", body[1] + 1)), broken, "starts at byte"),
        "index-raw-length": (resealed(patched(good, entry[1] + 24, "<I", 1 << 24)), broken, "more than the header's"),
        "unknown-critical": (resealed(patched(good, entry[3], "4s", b"Came")), broken, "critical kind Came"),
        "unknown-codec": (resealed(patched(good, entry[1] + 16, "<H", 9)), broken, "codec 9"),
        "group": (resealed(patched(good, entry[xy] + 4, "<H", 1)), broken, "group 1"),
        "place": (resealed(patched(good, entry[deco] + 6, "<B", 1)), broken, "among the planes"),
        "chunk-crc": (patched(good, body[xy] + 9, "<B", good[body[xy] + 9] ^ 1), broken, "is damaged"),
        "raw-length": (resealed(patched(good, entry[deco] + 24, "<I", 1)), broken, "not the 1 it claims"),
        "zstd-length": (
            resealed(patched(patched(bomb_file, entry[xy] + 16, "<H", 1), entry[xy] + 24, "<I", 40)),
            broken,
            "claims another length",
        ),
        "zstd-garbage": (resealed(patched(good, entry[xy] + 16, "<H", 1)), broken, "zstd frame"),
        "symbols-sets": (context(patched(coarse, 0, "<B", 3)), broken, "number of sets"),
        "symbols-flags": (context(patched(coarse, 1, "<B", 6)), broken, "unknown side of blocks"),
        "symbols-flags-more": (context(patched(coarse, 1, "<B", 8)), broken, "or flag"),
        "blocks-side": (context(patched(in_four, 0, "<B", 5)), broken, "unknown side of blocks"),
        "blocks-large": (context(patched(in_four, 0, "<B", 8)), broken, "more than twice its 2 rows or columns"),
        "blocks-quantiser": (context(patched(in_four, 2, "<B", 0)), broken, "a quantiser of 0"),
        "blocks-head": (context(in_four[:2]), broken, "a quantiser of 0"),
        **damaged_words("blocks", context, in_four, HEAD),
        "blocks-codec": (third(in_four), broken, "codec 3 has no such"),
        "borders-codec": (context(from_borders), broken, "codec 2 has no such"),
        "borders-flags": (third(patched(from_borders, 1, "<B", from_borders[1] | 32)), broken, "or flag"),
        "implied-codec": (context(patched(from_borders, 1, "<B", 7 | 16)), broken, "or flag"),
        "implied-map": (third(patched(from_borders, 1, "<B", 15 | 16)), broken, "or flag"),
        "borders-side": (third(patched(from_borders, 0, "<B", 0)), broken, "unknown side of blocks"),
        "borders-large": (third(patched(from_borders, 0, "<B", 16)), broken, "more than twice its 2 rows or columns"),
        "borders-quantiser": (third(patched(from_borders, 2, "<B", 0)), broken, "a quantiser of 0"),
        "borders-head": (third(from_borders[:2]), broken, "a quantiser of 0"),
        **damaged_words("borders", third, from_borders, HEAD),
        **damaged_words("symbols", context, coarse, state_at),
        "symbols-bomb": (resealed(bomb_symbols), broken, "more than 15 bytes can hold"),
        "symbols-range": (context(walked(symbols + 200, whole, weights, SCALAR)), broken, "leaves its 8 bits"),
        "around-range": (context(walked(0 * symbols + 200, whole, weights, DEPENDENT)), broken, "leaves its 8 bits"),
        "symbols-count": (resealed(patched(told, small_entry + 24, "<I", 7)), broken, "claims 7 symbols"),
        "symbols-elsewhere": (
            resealed(patched(good, entry[deco] + 16, "<H", 2)),
            broken,
            "weights",
        ),  # DECO had no codec 2 once
        "symbols-in-head": (resealed(patched(good, entry[scne] + 16, "<H", 2)), broken, "codec 2"),
        **damaged_words("cells", occupied, cells, 8),
        "cells-none": (occupied(patched(cells, 4, "<H", 0)), broken, "makes no sense"),
        "cells-more": (occupied(patched(cells, 0, "<H", 2), 8 + 12), broken, "do not end where they should"),
        "cells-length": (occupied(cells, 15), broken, "claims 15 bytes"),
        "cells-bomb": (
            occupied(struct.pack("<4HI", 8, 50, 80, 100, 1 << 16), 8 + 400_000),
            broken,
            "more than 12 bytes can hold",
        ),
        "nodes-weights": (moving(nodes[: nodes_at - 1]), broken, "cut off within its weights"),
        **damaged_words("nodes", moving, nodes, nodes_at),
        "nodes-range": (
            moving(struct.pack("<4Hf", 2, 2, 2, 2, grid.step) + encode_nodes_with(LORENZO, leaving), 12 + 6 * 16),
            broken,
            "leaves its 16 bits",
        ),
        "nodes-rows": (moving(patched(nodes, 0, "<H", 1)), broken, "makes no sense"),
        "nodes-step": (moving(patched(nodes, 8, "<f", nan)), broken, "outside its range"),
        "nodes-length": (moving(nodes, 12 + 6 * 24 + 1), broken, "claims 157 bytes"),
        "nodes-bomb": (
            moving(struct.pack("<4Hf15hI", 50, 60, 60, 20, grid.step, *15 * [0], 1 << 16), 12 + 6 * 50 * 60 * 60 * 20),
            broken,
            "more than 46 bytes can hold",
        ),
        **damaged_words("midpoints", moving_halves, halves, 12),
        "midpoints-range": (
            moving_halves(struct.pack("<4Hf", 2, 2, 2, 2, grid.step) + encode_motion(leaving), 12 + 6 * 16),
            broken,
            "leaves its 16 bits",
        ),
        "midpoints-rows": (moving_halves(patched(halves, 0, "<H", 1)), broken, "makes no sense"),
        "midpoints-length": (moving_halves(halves, 12 + 6 * 24 + 1), broken, "claims 157 bytes"),
        "midpoints-bomb": (
            moving_halves(struct.pack("<4HfI", 50, 60, 60, 20, grid.step, 1 << 16), 12 + 6 * 50 * 60 * 60 * 20),
            broken,
            "more than 16 bytes can hold",
        ),
        **damaged_words("weights", weighing, small_weights, powers_at + 5),
        "weights-power": (weighing(patched(small_weights, powers_at, "<b", 16)), broken, "not one of float16's"),
        "weights-range": (weighing(patched(small_weights, powers_at, "<b", 15)), broken, "no number of float16"),
        "weights-none": (weighing(small_weights[: powers_at + 3]), broken, "cut off within its words"),
        "weights-length": (weighing(small_weights, small_raw + 2), broken, "bytes of weights, not those"),
        "poses-head": (turned(told_turn[: POSES_HEAD.size - 1]), broken, "cut off within its head"),
        "poses-none": (turned(patched(told_turn, 0, "<H", 0)), broken, "0 cameras"),
        "poses-many": (turned(patched(told_turn, 0, "<H", 4097)), broken, "4097 cameras"),
        "poses-lenses": (turned(patched(told_turn, 2, "<H", 3)), broken, "3 lenses of 2 cameras"),
        "poses-exponent": (turned(patched(told_turn, 4, "<b", 31)), broken, "multiples of 2^31"),
        "poses-fine": (turned(patched(told_turn, 4, "<b", -127)), broken, "multiples of 2^-127"),
        "poses-short": (turned(told_turn[:-1]), broken, "are not those of 2 cameras"),
        "poses-long": (turned(told_turn + bytes(1)), broken, "are not those of 2 cameras"),
        "poses-turn": (
            turned(told_poses(0, (0, 0, 0), 2 * [(0, -ROOT, ROOT, 1)], 2 * [(0, 0, 0)])),
            broken,
            "a turn or a place is none",
        ),
        "poses-place-bits": (
            turned(patched(told_turn, len(told_turn) - 1, "<B", 64)),
            broken,
            "a turn or a place is none",
        ),
        "poses-far": (turned(told_poses(30, (2, 0, 0), 2 * [(0, 0, 0, 0)], 2 * [(0, 0, 0)])), broken, "absurdly far"),
        "poses-focal": (turned(patched(told_turn, POSES_HEAD.size + 4, "<f", 0.0)), broken, "focal length"),
        "poses-length": (turned(told_turn, 2 + 68), broken, "claims 70 bytes"),
        "midpoints-elsewhere": (resealed(patched(told, small_entry + 16, "<H", CODEC_MIDPOINTS)), broken, "codec 3"),
        "no-decoder": (without(deco), broken, "0 DECO chunks"),
        "no-segment": (without(len(chunks) - 1), broken, "its segments hold 2 rows, not 3"),
        "two-occupancies": (pack([*chunks, chunks[occu]], values, compress=False), broken, "2 OCCU chunks"),
        "two-cameras": (pack([*chunks, chunks[came]], values, compress=False), broken, "2 came chunks"),
        "segment-twice": (pack([*chunks, chunks[xt]], values, compress=False), broken, "or two do"),
        "segment-start": (resealed(patched(good, entry[xt] + 8, "<I", 1)), broken, "no segment starts at row 0"),
        "segment-plane": (resealed(patched(good, entry[xt] + 7, "<B", 6)), broken, "plane 6"),
        "segment-map-flag": (repacked(xy, set_at(0, "<B", 2)), broken, "unknown map flag"),
        "segment-map-bits": (repacked(xy, set_at(3, "<B", 0xFF)), broken, "unused bits"),
        "segment-filter": (repacked(xy, set_at(4, "<B", 4)), broken, "unknown filter 4"),
        "segment-short": (repacked(xy, lambda raw: raw[:-1]), broken, "its map implies"),
        "segment-long": (repacked(xt, lambda raw: raw + bytes(1)), broken, "its map implies"),
        "scene-box": (repacked(scne, set_at(0, "<f", 1e9)), broken, "the box is empty"),
        "scene-box-large": (repacked(scne, set_at(12, "<f", 1e30)), broken, "absurdly large"),
        "scene-box-infinite": (repacked(scne, set_at(0, "<6f", *6 * [math.inf])), broken, "not finite"),
        "scene-clip": (repacked(scne, set_at(24, "<I", 0)), broken, "a clip of 0 frames"),
        "scene-fps": (repacked(scne, set_at(28, "<d", nan)), broken, "makes no sense"),
        "scene-step": (repacked(scne, set_at(36, "<d", 1e-12)), broken, "a ray step"),
        "scene-background": (repacked(scne, set_at(44, "<f", -1.0)), broken, "background"),
        "scene-scales": (repacked(scne, set_at(56, "<B", 0)), broken, "0 scales"),
        "scene-static": (repacked(scne, set_at(57, "<B", 0)), broken, "3 rows in time"),
        "scene-axis": (repacked(scne, set_at(60, "<H", 65535)), broken, "65535"),
        "scene-plane-step": (repacked(scne, set_at(68, "<f", 0.0)), broken, "plane xy: a step or an offset"),
        "scene-plane-nan": (repacked(scne, set_at(68, "<f", nan)), broken, "plane xy: a step or an offset"),
        "scene-plane-snan": (repacked(scne, set_at(68, "<I", 0x7F800001)), broken, "plane xy: a step or an offset"),
        "scene-long": (repacked(scne, lambda raw: raw + bytes(1)), broken, "1 bytes too long"),
        "warp-mapping": (warped(struct.pack("<Id", 3, 3.5)), broken, "mapping 3"),
        "warp-negative": (warped(struct.pack("<Id", 1, -3.5)), broken, "make no sense"),
        "warp-nan": (warped(struct.pack("<Id", 1, nan)), broken, "make no sense"),
        "warp-far": (warped(struct.pack("<Id", 1, 1e6)), broken, "make no sense"),
        "warp-short": (warped(struct.pack("<Id", 1, 3.5)[:-1]), broken, "ends after"),
        "warp-long": (warped(struct.pack("<Id", 1, 3.5) + bytes(1)), broken, "1 bytes too long"),
        "ndc-short": (warped(ndc()[:-1]), broken, "ends after"),
        "ndc-near": (warped(ndc(near=-1.0)), broken, "make no sense"),
        "ndc-nan": (warped(ndc(near=nan)), broken, "make no sense"),
        "ndc-frame": (warped(ndc(skew=0.01)), broken, "make no sense"),
        "ndc-vast": (warped(ndc(skew=1e200)), broken, "make no sense"),
        "ndc-box": (warped(ndc(near=16.0)), broken, "make no sense"),
        "warp-twice": (warped(*2 * [struct.pack("<Id", 1, 3.5)]), broken, "2 WARP chunks"),
        "move-rows": (displaced(move(1, 2, 2, 2, 0.5**13)), broken, "makes no sense"),
        "move-nodes": (displaced(move(2, 2, 257, 2, 0.5**13)), broken, "makes no sense"),
        "move-step": (displaced(move(2, 2, 2, 2, 0.0)), broken, "outside its range"),
        "move-nan": (displaced(move(2, 2, 2, 2, nan)), broken, "outside its range"),
        "move-far": (displaced(move(2, 2, 2, 2, 1.0)), broken, "outside its range"),
        "move-short": (displaced(move(2, 2, 2, 2, 0.5**13)[:-1]), broken, "ends after"),
        "move-long": (displaced(move(2, 2, 2, 2, 0.5**13) + bytes(1)), broken, "1 bytes too long"),
        "move-twice": (displaced(*2 * [move(2, 2, 2, 2, 0.5**13)]), broken, "2 MOVE chunks"),
        "move-static": (
            pack([*scene_chunks(still), Chunk("MOVE", [move(2, 2, 2, 2, 0.5**13)])], still_values, compress=False),
            broken,
            "static scene",
        ),
        "decoder-features": (repacked(deco, set_at(0, "<H", 3)), broken, "3 features"),
        "decoder-nan": (repacked(deco, set_at(8, "<H", 0x7E00)), broken, "NaN or infinite"),
        "hybrid-features": (decoded_by(patched(mlps, 0, "<H", 3)), broken, "3 features"),
        "hybrid-width": (decoded_by(patched(mlps, 2, "<H", 0)), broken, "0 and 2 hidden units"),
        "hybrid-hidden": (decoded_by(patched(mlps, 4, "<H", 257)), broken, "2 and 257 hidden units"),
        "hybrid-bias": (decoded_by(patched(mlps, 6, "<f", nan)), broken, "density bias nan"),
        "hybrid-nan": (decoded_by(patched(mlps, 10, "<H", 0x7C00)), broken, "NaN or infinite"),
        "hybrid-long": (decoded_by(mlps + bytes(2)), broken, "2 bytes too long"),
        "hybrid-twice": (decoded_by(mlps, mlps), broken, "2 HYBR chunks"),
        "two-decoders": (with_chunks("HYBR", mlps), broken, "two decoders"),
        "decoder-short": (repacked(deco, lambda raw: raw[:-1]), broken, "ends after"),
        "occupancy-bits": (repacked(occu, lambda raw: raw[:-1] + b"\xff"), broken, "unused bits"),
        "occupancy-zero": (repacked(occu, set_at(0, "<H", 0)), broken, "makes no sense"),
        "camera-focal": (repacked(came, set_at(6, "<f", 0.0)), broken, "focal length"),
        "camera-far": (repacked(came, set_at(34, "<f", 1e30)), broken, "absurdly far"),
        "camera-axes": (repacked(came, set_at(22, "<f", 0.0)), broken, "not of length 1"),
        "camera-nan": (repacked(came, set_at(22, "<f", nan)), broken, "NaN or infinity"),
        "appearances-none": (varied(struct.pack("<HH", 0, 3)), broken, "0 appearances"),
        "appearances-many": (varied(appe(b"a", b"b", count=16385)), broken, "16385 appearances"),
        "appearances-hidden": (varied(appe(b"a", b"b", hidden=4)), broken, "4 numbers"),
        "appearances-nan": (varied(appe(b"a", b"b", codes=bytes(10) + b"\x00\x7e")), broken, "NaN or infinite"),
        "appearances-short": (varied(appe(b"a")), broken, "ends after"),
        "appearances-long": (varied(appe(b"a", b"b") + bytes(1)), broken, "1 bytes too long"),
        "appearances-empty": (varied(appe(b"a", b"")), broken, "is empty"),
        "appearances-same": (varied(appe(b"a", b"a")), broken, "there twice"),
        "appearances-latin": (varied(appe(b"a", b"\xe9")), broken, "not UTF-8"),
        "appearances-escape": (varied(appe(b"a", b"\x1b[2J")), broken, "control character"),
        "appearances-control": (varied(appe(b"a", "\x9b".encode())), broken, "control character"),
        "appearances-twice": (varied(*2 * [appe(b"a", b"b")]), broken, "2 appe chunks"),
    }


def minimal_scene() -> QuantisedScene:
    """The smallest scene worth a look: one channel, two texels an axis, a fog that is denser towards +x."""
    planes = {
        name: QuantisedPlane(
            np.array([[[0], [4]], [[0], [4]]], np.int8),
            np.array([0.25], np.float32),
            np.array([1.0], np.float32),
            np.ones((2, 2), bool),
        )
        for name in SPACE_PLANES
    }
    decoder = Decoder(
        np.array([1.0], np.float32),
        0.0,
        np.zeros((1, 9), np.float32),
        np.zeros(1, np.float32),
        np.zeros((3, 1, 1), np.float32),
        np.array([[1.0], [0.5], [0.0]], np.float32),
    )
    return QuantisedScene(
        np.array([[0, 0, 0], [1, 1, 1]], np.float32),
        Clip(1, 1.0),
        (planes,),
        decoder,
        np.ones((1, 1, 1, 1), bool),
        np.zeros(3, np.float32),
        0.125,
    )


def _scene(
    dynamic: bool, sizes: list[tuple[int, int, int, int, int]], amplitude: int = 60, cameras: int = 0
) -> QuantisedScene:
    """A scene made of integers alone. `sizes`: channels, Nx, Ny, Nz, T of each scale."""
    scales = []
    for number, (channels, nx, ny, nz, nt) in enumerate(sizes):
        size = {"x": nx, "y": ny, "z": nz, "t": nt}
        scales.append(
            {
                name: _plane(
                    size[name[1]],
                    size[name[0]],
                    channels,
                    amplitude,
                    ALL_PLANES.index(name) + 7 * number,
                    name in TIME_PLANES,
                )
                for name in (ALL_PLANES if dynamic else SPACE_PLANES)
            }
        )
    features, hidden = sum(size[0] for size in sizes), 3
    weights = {
        name: _noise(shape, 17 + k) / np.float32(64)
        for k, (name, shape) in enumerate(Decoder.shapes(features, hidden).items())
    }
    occupancy = _noise((2 if dynamic else 1, 3, 3, 5), 99) > 0
    pose = np.array([[1, 0, 0, 0.5], [0, 1, 0, -0.25], [0, 0, 1, 3], [0, 0, 0, 1]], np.float64)
    return QuantisedScene(
        np.array([[-1, -0.75, -0.5], [1, 0.75, 0.5]], np.float32),
        Clip(12, 24.0) if dynamic else Clip(1, 24.0),
        tuple(scales),
        Decoder(density_bias=0.5, **weights),
        occupancy,
        np.array([0.25, 0.5, 1], np.float32),
        0.0625,
        tuple(Camera(64 + k, 48, 80.0, 80.5, 32.0, 24.0, pose) for k in range(cameras)),
    )


def _painted(
    paint: Callable[[tuple[int, int, int], int], np.ndarray], coded: bool = True, size: tuple[int, int, int] = (9, 6, 5)
) -> QuantisedScene:
    """A static scene of `paint(shape, number)` on every plane, all of whose texels are coded, or none."""
    scene = _scene(dynamic=False, sizes=[(3, *size, 0)])
    planes = {
        name: replace(
            plane, symbols=paint(plane.symbols.shape, number).astype(np.int8), coded=np.full(plane.coded.shape, coded)
        )
        for number, (name, plane) in enumerate(scene.scales[0].items())
    }
    return replace(scene, scales=(planes,))


def _in_all_contexts() -> bytes:
    """Planes full of ends of the range under weights that fail them, and one that hardly changes: with the other vectors, found by trial
    to have symbols in every context that there can be."""
    weights = _noise((2, WEIGHT_COUNT), 3025).astype(np.int8)
    weights[0, 8] = 24

    def paint(shape: tuple[int, int, int], number: int) -> np.ndarray:
        noise = _noise(shape, 3026 + number)
        return noise > 120 if number == 2 else np.where(noise < 0, -128, np.where(noise > 90, 122, 127))

    return context_coded(_painted(paint, size=(9, 9, 9)), weights=weights)


def _hybrid(features: int, width: int, hidden: int) -> HybridDecoder:
    shapes = HybridDecoder.shapes(features, width, hidden)
    return HybridDecoder(
        density_bias=0.5,
        **{name: _noise(shape, 17 + k) / np.float32(64) for k, (name, shape) in enumerate(shapes.items())},
    )


def _extreme(decoder: Decoder) -> Decoder:
    """With the largest and the smallest numbers that codec 2 has, and an array of zeros."""
    return replace(
        decoder,
        density_weight=np.float32([-65504, 65504, 32][: len(decoder.density_weight)]),
        w1=0 * decoder.w1,
        b1=np.float32([1, -2, 2048]) * np.float32(0.5**24),
        w2=_noise(decoder.w2.shape, 83) * np.float32(16),
        b2=_noise(decoder.b2.shape, 84) * np.float32(0.5**20),
    )


def _motion(rows: int, nz: int, ny: int, nx: int, step: float = 8.0) -> QuantisedMotion:
    """Displacements that jump from row to row, the largest and the smallest symbol among them; `step` in 1 / 8192."""
    symbols = _noise((rows, nz, ny, nx, 3), 41).astype(np.int16)
    symbols[0, 0, 0, 0], symbols[1, 0, 0, 0] = (32767, -32768, 0), (-32768, 32767, 1)
    return QuantisedMotion(symbols, step / 8192)


def _swaying(rows: int, nz: int, ny: int, nx: int) -> QuantisedMotion:
    """Displacements that grow with place and time, a little rough: what a prediction from neighbours hits nearly."""
    t, z, y, x, c = np.indices((rows, nz, ny, nx, 3))
    symbols = (c + 1) * (3 * x * x - 5 * y * t + 2 * z * t * t) + 40 * t * (c - 1) + _noise(t.shape, 47) // 64
    return QuantisedMotion(symbols.astype(np.int16), 0.5**11)


def _appearances(*names: str) -> tuple[Appearance, ...]:
    """For a scene of `_scene`'s three hidden units."""
    codes = _noise((len(names), 3), 53) / np.float32(32)
    return tuple(Appearance(name, code) for name, code in zip(names, codes, strict=True))


def _plane(rows: int, columns: int, channels: int, amplitude: int, seed: int, is_time: bool) -> QuantisedPlane:
    """Ramps of several slopes, some flat, plus noise; a quarter of the texels uncoded. Wraps where it leaves 8 bits."""
    y, x, m = np.meshgrid(np.arange(rows), np.arange(columns), np.arange(channels), indexing="ij")
    ramp = amplitude * ((m % 3) * x // columns + (m % 2) * y * y // (rows * rows))
    noise = _noise((rows, columns, channels), seed) % np.array([1, 2, 5, 256])[m % 4]
    symbols = (ramp + noise).astype(np.int64).astype(np.int8)  # the low 8 bits
    coded = (x[..., 0] * 3 + y[..., 0] * 5 + seed) % 16 >= 4
    symbols[~coded] = 0
    steps = ((1 + np.arange(channels)) / 128).astype(np.float32)
    offsets = np.ones(channels) if is_time else (seed + np.arange(channels)) / 8 - 1
    return QuantisedPlane(symbols, steps, offsets.astype(np.float32), symbols.any(2) if is_time else coded)


def _noise(shape: tuple[int, ...], seed: int) -> np.ndarray:
    """Integers in [-128, 127] from a multiplicative hash of their position, as float32."""
    index = np.arange(int(np.prod(shape)), dtype=np.uint32) + np.uint32(seed * 7919)
    mixed = (index * np.uint32(2654435761)) ^ (index * np.uint32(2654435761) >> np.uint32(15))
    mixed = mixed * np.uint32(2246822519)
    return ((mixed >> np.uint32(13)) & np.uint32(255)).astype(np.float32).reshape(shape) - np.float32(128)


def _rays(scene: QuantisedScene) -> list[dict[str, Any]]:
    """What four rays see: through the box's centre at the clip's start, across it, from inside it, and past it.

    In contracted space some of it lies outside. The last ray shows the average of the appearances, if there are any.
    """
    bounds = scene.dequantise().bounds.astype(np.float32)
    centre, size = bounds.mean(0), bounds[1] - bounds[0]
    starts = np.array([[0.0, 0.1, 1.5], [-1.5, -0.75, 1.25], [0.1, -0.2, 0.05], [2.0, 2.0, 2.0]], np.float32)
    towards = np.array([[0.05, 0.0, -1.0], [1.5, 0.75, -1.25], [0.75, 0.5, 0.25], [1.0, 0.0, 0.0]], np.float32)
    origins = (centre + starts * size).astype(np.float32)
    directions = towards * size
    directions = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)
    rays, appearances = [], itertools.islice(itertools.chain(scene.appearances, itertools.repeat(None)), 4)
    for origin, direction, time, look in zip(origins, directions, (0.0, 0.375, 0.8125, 1.0), appearances, strict=True):
        with np.errstate(over="ignore"):  # a vector may saturate colours
            seen = reference.render_rays(
                scene.dequantise(), origin[None], direction[None], time, appearance=look and look.code
            )
        depth = float(seen.depth[0])
        rays.append(
            {
                "origin": origin.tolist(),
                "direction": direction.tolist(),
                "time": time,
                "rgb": [round(float(c), 6) for c in seen.rgb[0]],
                "opacity": round(float(seen.opacity[0]), 6),
                "depth": round(depth, 6) if np.isfinite(depth) else None,
                **({"appearance": look and look.name} if scene.appearances else {}),
            }
        )
    return rays


def _camera(c: Camera) -> np.ndarray:
    return np.array([c.width, c.height, c.fl_x, c.fl_y, c.cx, c.cy, *np.ravel(c.camera_to_world[:3])], "<f8")


def _sha256(*arrays: np.ndarray) -> str:
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _json(document: dict[str, Any]) -> bytes:
    """A line for each member, and for each element of one that is a list of objects."""

    def lines(value: Any) -> str:
        if isinstance(value, list) and value and isinstance(value[0], dict):
            return "[\n  " + ",\n  ".join(json.dumps(element, separators=(",", ":")) for element in value) + "]"
        return json.dumps(value)

    return ("{" + ",\n ".join(f"{json.dumps(key)}: {lines(value)}" for key, value in document.items()) + "}\n").encode()


if __name__ == "__main__":
    sys.exit(main())
