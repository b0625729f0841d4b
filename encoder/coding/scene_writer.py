"""Writing a scene to a file: its chunks, in the order in which a player wants them.

The coarsest picture of the first seconds comes first, then finer scales, then later seconds (spec/kpc-format.md,
"Order of chunks"). Sound of a time lies behind the coarsest planes of that time.
"""

import os
import struct
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from kpc.encoder.coding.motion_codec import encode_motion
from kpc.encoder.coding.occupancy_codec import encode_occupancy
from kpc.encoder.coding.raw_planes import encode_raw_segment
from kpc.encoder.coding.segments import choose_codec, segment_bounds
from kpc.encoder.coding.weights import encode_weights
from kpc.format.coding.poses import encode_poses
from kpc.format.coding.quantise import QuantisedScene, needed_texels, to_half
from kpc.format.common.errors import FormatError
from kpc.format.container.container import Chunk, Codec, pack
from kpc.format.container.metadata_chunk import pack_metadata
from kpc.format.container.rewriting import save
from kpc.format.container.scene_layout import (
    MOTION_STRUCT,
    OCCUPANCY_STRUCT,
    SceneHead,
    pack_appearances,
    pack_cameras,
    pack_decoder,
    pack_head,
    pack_mapping,
    pack_motion,
    pack_occupancy,
    parse_appearances,
    parse_cameras,
    parse_head,
    parse_mapping,
    parse_motion,
)
from kpc.format.container.segments import side_info_at
from kpc.format.container.sound_chunk import pack_sound
from kpc.format.scene.cameras import Camera
from kpc.format.scene.motion import QuantisedMotion
from kpc.format.scene.scene import ALL_PLANES, TIME_PLANES, AnyDecoder, Appearance, HybridDecoder, Scene
from kpc.format.scene.sound import SAMPLE_RATE


def write(scene: QuantisedScene, path: str | os.PathLike[str], *, segment_rows: int | None = None) -> int:
    """Write a scene; return the size in bytes. On failure the file at `path` is unchanged.

    Args:
        segment_rows: rows of a time plane in one segment, the unit in which a player fetches time; None:
            `rows_per_segment`. Planes whose symbols were chosen for other segments keep those.

    Raises:
        FormatError: the scene breaks a rule that every reader checks; the message says which.
    """
    return save(encode(scene, segment_rows=segment_rows), path)


def encode(scene: QuantisedScene, *, segment_rows: int | None = None, compress: bool = True) -> bytes:
    """Return the bytes of the file that `write` writes; without `compress` every chunk is stored raw."""
    chunks = scene_chunks(scene, segment_rows=segment_rows)
    return pack(chunks, sum(p.symbols.size for scale in scene.scales for p in scale.values()), compress=compress)


def scene_chunks(scene: QuantisedScene, *, segment_rows: int | None = None) -> list[Chunk]:
    """Return the chunks of a scene's file, in their order.

    Raises:
        FormatError: as `write`.
    """
    if segment_rows is not None and segment_rows < 1:
        raise FormatError(f"segment_rows {segment_rows} is not positive")
    try:
        chunks = _chunks_before_planes(scene)
    except (struct.error, OverflowError) as error:
        raise FormatError(f"scene: a number does not fit its field ({error})") from error
    return chunks + _plane_chunks(scene, segment_rows)


def _chunks_before_planes(scene: QuantisedScene) -> list[Chunk]:
    """Return the chunks before the planes, their content checked by the parsers that readers use."""
    head = pack_head(scene)
    parsed = parse_head(head)
    _check_planes(scene, parsed)
    chunks = [Chunk("SCNE", head)]
    if scene.mapping is not None:
        warp = pack_mapping(scene.mapping)
        parse_mapping(warp, parsed)
        chunks.append(Chunk("WARP", warp))
    if scene.motion is not None:
        chunks.append(_motion_chunk(scene.motion, parsed.is_dynamic))
    chunks += [_decoder_chunk(scene.decoder, parsed.feature_count), _occupancy_chunk(scene.occupancy)]
    return chunks + _chunks_about(scene)


def _chunks_about(scene: Scene | QuantisedScene) -> list[Chunk]:
    """Return the chunks of cameras, appearances and metadata."""
    chunks = [_cameras_chunk(scene.cameras)] if scene.cameras else []
    if scene.appearances:
        appe = pack_appearances(scene.appearances, len(scene.decoder.b1))
        parse_appearances(appe, len(scene.decoder.b1))
        chunks.append(Chunk("appe", appe))
    if scene.metadata:
        chunks.append(Chunk("meta", pack_metadata(scene.metadata)))
    return chunks


def fixed_bytes(scene: Scene | QuantisedScene, *, with_occupancy: bool) -> int:
    """Return the bytes that coding the planes more coarsely leaves as they are: a file is larger than that.

    They are those of cameras, appearances, metadata, sound, the header and an index of these.

    Args:
        scene: to be coded.
        with_occupancy: whether to count the occupancy grid, too, where it is kept as it is.
    """
    chunks = [_occupancy_chunk(scene.occupancy)] if with_occupancy else []
    sound = [] if scene.sound is None else pack_sound(scene.sound)
    rounded = tuple(Appearance(one.name, to_half(one.code, "appearances")) for one in scene.appearances)
    return len(pack(chunks + _chunks_about(replace(scene, appearances=rounded)) + sound, 0))


def _check_planes(scene: QuantisedScene, head: SceneHead) -> None:
    for number, (scale, heads) in enumerate(zip(scene.scales, head.scales, strict=True)):
        for name, plane in scale.items():
            where, expected = f"scale {number}, plane {name}", heads[name]
            shape = (expected.rows, expected.columns, expected.channels)
            if plane.symbols.shape != shape or plane.coded.shape != shape[:2] or plane.symbols.dtype != np.int8:
                raise FormatError(f"{where}: is {plane.symbols.dtype} {plane.symbols.shape}, not int8 {shape}")
            if not np.array_equal(plane.offset, expected.offset):
                raise FormatError(f"{where}: the offset of a time plane must be 1")
            if plane.symbols[~plane.coded].any():
                raise FormatError(f"{where}: an uncoded texel holds a symbol other than 0")


def _motion_chunk(motion: QuantisedMotion, dynamic: bool) -> Chunk:
    raw = pack_motion(motion)
    parse_motion(raw, dynamic)
    head = raw[: MOTION_STRUCT.size]
    return Chunk("MOVE", raw, codec=Codec.MOTION, encode=lambda: head + encode_motion(motion.symbols))


def _decoder_chunk(decoder: AnyDecoder, features: int) -> Chunk:
    head, weights = pack_decoder(decoder, features)
    raw = head + b"".join(np.asarray(w).astype("<f2").tobytes() for w in weights.values())
    kind, coded = "HYBR" if isinstance(decoder, HybridDecoder) else "DECO", encode_weights(list(weights.values()))
    if coded is None:
        return Chunk(kind, raw)
    return Chunk(kind, raw, codec=Codec.WEIGHTS, encode=lambda: head + coded)


def _occupancy_chunk(occupancy: np.ndarray) -> Chunk:
    raw = pack_occupancy(occupancy)
    head = raw[: OCCUPANCY_STRUCT.size]
    return Chunk("OCCU", raw, codec=Codec.OCCUPANCY, encode=lambda: head + encode_occupancy(occupancy))


def _cameras_chunk(cameras: tuple[Camera, ...]) -> Chunk:
    raw = pack_cameras(cameras)
    parse_cameras(raw)
    coded = encode_poses(cameras)
    return Chunk("came", raw) if coded is None else Chunk("came", raw, codec=Codec.POSES, encode=lambda: coded)


def _plane_chunks(scene: QuantisedScene, segment_rows: int | None) -> list[Chunk]:
    """Return the PLNE and soun chunks: first segments of all scales, coarse to fine, then later segments; each soun
    chunk behind those of the coarsest scale that begin before it.
    """
    segments = [
        (start / len(plane.symbols), number, ALL_PLANES.index(name), start, stop)
        for number, scale in enumerate(scene.scales)
        for name, plane in scale.items()
        for start, stop in segment_bounds(plane, name in TIME_PLANES, segment_rows)
    ]
    implied = [
        {name: needed_texels(scene.occupancy, name, *plane.coded.shape) for name, plane in scale.items()}
        for scale in scene.scales
    ]
    sound = [] if scene.sound is None else pack_sound(scene.sound)
    sound_begins = [_begin_of_sound(chunk, scene, segments) for chunk in sound]
    chunks = []
    for begin, number, plane_number, start, stop in sorted(segments):
        while sound and (begin, number) > (sound_begins[0], 0):
            chunks.append(sound.pop(0))
            del sound_begins[0]
        name = ALL_PLANES[plane_number]
        plane = scene.scales[number][name]
        symbols, coded = plane.symbols[start:stop], plane.coded[start:stop]
        side_info = side_info_at(plane.side_info, start)
        implied_here = None if plane.stores_map else implied[number][name][start:stop]
        codec, make = choose_codec(symbols, coded, side_info, implied_here)
        position = number, plane_number, start, stop - start
        chunks.append(Chunk("PLNE", encode_raw_segment(symbols, coded), *position, codec, make, symbols.size))
    return chunks + sound


def _begin_of_sound(chunk: Chunk, scene: QuantisedScene, segments: Sequence[tuple[float, int, int, int, int]]) -> float:
    """Return when the latest segments begin that do not begin after a soun chunk, as a share of the clip."""
    assert scene.sound is not None
    heard_s = (chunk.row_start - scene.sound.pre_skip) / SAMPLE_RATE
    share = heard_s / max(scene.clip.duration_s, 1 / SAMPLE_RATE)
    return max((begin for begin, *_ in segments if begin <= share), default=0.0)
