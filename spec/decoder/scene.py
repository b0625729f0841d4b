"""Sections 4.3, 7 and 10: a scene from the chunks of a file."""

import hashlib
import struct

from .common import PLANES, ByteReader, require
from .container import scene_contents
from .metadata import decode_metadata
from .payloads import (
    decode_appearances,
    decode_cameras,
    decode_explicit_decoder,
    decode_hybrid_decoder,
    decode_motion,
    decode_occupancy,
)
from .planes import decode_segment, dequantise
from .scene_chunks import decode_scne, decode_warp
from .sound import decode_sound

SINGLE_KINDS = "SCNE", "WARP", "MOVE", "DECO", "HYBR", "OCCU", "came", "appe", "meta"


def decode(data, is_prefix=False, shared=None):
    """Return the scene as a dict of numbers, lists and dicts; shared: see scene_contents."""
    chunks, value_count = scene_contents(data, is_prefix, shared)
    single, segments, sound = {}, [], []
    for chunk, content in chunks:
        kind = chunk.kind.decode()
        if kind == "PLNE":
            segments.append((chunk.scale, chunk.plane, chunk.row_start, chunk.row_count, content))
        elif kind == "soun":
            sound.append((chunk, content))
        else:
            require(kind not in single, f"there are two {kind} chunks")
            single[kind] = content
    require(("DECO" in single) != ("HYBR" in single), "there must be either DECO or HYBR")
    for kind in ("SCNE", "DECO", "HYBR", "OCCU", "WARP", "MOVE"):
        is_required = kind in ("SCNE", "OCCU") or kind in single
        require(not is_required or single.get(kind) is not None, f"there is no {kind} chunk")

    scene = decode_scne(ByteReader(single["SCNE"].data))
    planes = [plane for scale in scene["scales"] for plane in scale.values()]
    require(sum(p["rows"] * p["columns"] * p["channels"] for p in planes) == value_count, "invalid value count")
    feature_count = sum(scale["xy"]["channels"] for scale in scene["scales"])
    scene |= {"value_count": value_count, "mapping": 0, "motion": None}
    scene |= {"cameras": [], "appearances": {}, "metadata": {}}
    if "WARP" in single:
        scene |= decode_warp(ByteReader(single["WARP"].data), scene)
    if "MOVE" in single:
        require("xt" in scene["scales"][0], "a static scene has no motion")
        scene["motion"] = decode_motion(single["MOVE"])
    if "DECO" in single:
        scene |= decode_explicit_decoder(single["DECO"], feature_count)
    else:
        scene |= decode_hybrid_decoder(single["HYBR"], feature_count)
    scene |= decode_occupancy(single["OCCU"])
    if single.get("came") is not None:
        scene["cameras"] = decode_cameras(single["came"])
    if single.get("appe") is not None:
        scene["appearances"] = decode_appearances(ByteReader(single["appe"].data), scene["hidden"])
    if single.get("meta") is not None:
        scene["metadata"] = decode_metadata(single["meta"].data)
    scene["sound"] = decode_sound(sound)
    decode_planes(scene, segments)
    return scene


def decode_planes(scene, segments):
    scales = scene["scales"]
    for plane in (plane for scale in scales for plane in scale.values()):
        texels = plane["rows"] * plane["columns"]
        plane |= {"coded": [0] * texels, "symbols": [0] * (texels * plane["channels"])}
        plane |= {"next_row": 0, "segment_count": 0, "is_held": False}
    for scale, number, row_start, row_count, content in sorted(segments, key=lambda segment: segment[:3]):
        require(scale < len(scales) and number < 6 and PLANES[number] in scales[scale], "a segment is of no plane")
        name = PLANES[number]
        plane = scales[scale][name]
        require(row_count > 0 and row_start == plane["next_row"], "segments overlap or leave rows out")
        require(row_start + row_count <= plane["rows"], "a segment exceeds its plane")
        plane["next_row"] += row_count
        plane["segment_count"] += 1
        if content is not None:
            plane["is_held"] = True
            coded, symbols = decode_segment(scene, name, plane, row_start, row_count, content)
            W, M = plane["columns"], plane["channels"]
            for (y, x), bit in coded.items():
                plane["coded"][(row_start + y) * W + x] = bit
            for (y, x, c), symbol in symbols.items():
                plane["symbols"][((row_start + y) * W + x) * M + c] = symbol
    for scale in scales:
        for name, plane in scale.items():
            require(plane["next_row"] == plane["rows"], "segments leave rows out")
            require("t" in name or plane["segment_count"] == 1, "a space plane has several segments")
            if "t" not in name and not plane["is_held"]:  # section 10: a space plane that is missing is 0
                plane["offset"] = [0.0] * plane["channels"]
            plane["values"] = dequantise(plane)


def hashes(scene):  # section 14
    """Return {(scale, plane): SHA-256 of (symbols, coded, values)}."""
    return {
        (number, name): tuple(
            hashlib.sha256(data).hexdigest()
            for data in (
                struct.pack(f"{len(plane['symbols'])}b", *plane["symbols"]),
                bytes(plane["coded"]),
                struct.pack(f"<{len(plane['values'])}f", *plane["values"]),
            )
        )
        for number, scale in enumerate(scene["scales"])
        for name, plane in scale.items()
    }
