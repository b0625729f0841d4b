"""What a decoder must find in a valid vector: the entries of `manifest.json` (spec/kpc-format.md, "Conformance
vectors").
"""

import hashlib
import itertools
import json
from typing import Any

import numpy as np
import zstandard

from kpc.format.coding.quantise import QuantisedScene
from kpc.format.container.container import Codec, Reader
from kpc.format.container.scene_io import read
from kpc.format.scene.cameras import Camera
from kpc.format.scene.scene import HybridDecoder
from kpc.format.scene.space import Contraction, DeviceCoordinates
from kpc.player.cpu import reference

ZSTD_VERSION = ".".join(map(str, zstandard.ZSTD_VERSION))


def described(data: bytes, partial: bool) -> dict[str, Any]:
    """Return what a decoder must find in a file: numbers, and the SHA-256 of every array in the order that the spec
    gives.
    """
    scene = read(data, allow_partial=partial)
    codecs = {entry.codec for entry in Reader(data, allow_partial=partial).index}
    found: dict[str, Any] = {
        "partial": partial,
        "zstd": ZSTD_VERSION if Codec.ZSTD in codecs else None,
        "frame_count": scene.clip.frame_count,
        "fps": scene.clip.fps,
        "ray_step": scene.step,
    }
    if isinstance(scene.mapping, Contraction):
        found["uniform_distance"] = scene.mapping.uniform_distance
    elif isinstance(scene.mapping, DeviceCoordinates):
        mapping = scene.mapping
        found |= {"reference_pose": mapping.frame.tolist(), "near": mapping.near, "baseline": mapping.baseline}
    if scene.motion:
        values = scene.motion.dequantise().astype("<f4")
        found["motion"] = {"shape": list(scene.motion.symbols.shape), "sha256": _sha256(values)}
    if scene.metadata:
        found["metadata"] = scene.metadata.document
    if scene.sound is not None:
        sound = scene.sound
        packets = [np.frombuffer(packet, np.uint8) for packet in sound.packets]
        lengths = np.array([len(packet) for packet in sound.packets], "<u2")
        found["sound"] = {
            "channels": sound.channels,
            "pre_skip": sound.pre_skip,
            "sample_count": sound.sample_count,
            "packets": len(packets),
            "sha256": _sha256(lengths, *packets),
        }
    if scene.appearances:
        names = [np.frombuffer(one.name.encode(), np.uint8) for one in scene.appearances]
        codes = [one.code.astype("<f4") for one in scene.appearances]
        found["appearances"] = {
            "count": len(scene.appearances),
            "names_sha256": _sha256(*names),
            "sha256": _sha256(*codes),
        }
    return found | {
        "aabb": scene.aabb.tolist(),
        "background": scene.background.tolist(),
        "cameras": {"count": len(scene.cameras), "sha256": _sha256(*map(_camera, scene.cameras))},
        "occupancy": {"shape": list(scene.occupancy.shape), "sha256": _sha256(scene.occupancy.astype(np.uint8))},
        "decoder": _decoder(scene),
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


def _decoder(scene: QuantisedScene) -> dict[str, Any]:
    decoder = scene.decoder
    found: dict[str, Any] = {"features": sum(scale["xy"].symbols.shape[2] for scale in scene.scales)}
    if isinstance(decoder, HybridDecoder):
        found["width"] = len(decoder.v_bias)
    arrays = (np.asarray(w, "<f4") for w in vars(decoder).values())
    return found | {"hidden": len(decoder.b1), "sha256": _sha256(*arrays)}


def _rays(scene: QuantisedScene) -> list[dict[str, Any]]:
    """Return what four rays see: through the box's centre at the clip's start, across it, from inside it, and past it.

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
                scene.dequantise(), origin[None], direction[None], time, appearance=None if look is None else look.code
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


def manifest_json(manifest: dict[str, dict[str, Any]]) -> bytes:
    """Return `manifest.json`: a line for each vector."""
    sections = []
    for name, vectors in manifest.items():
        lines = [f"  {json.dumps(key)}: {json.dumps(value, separators=(',', ':'))}" for key, value in vectors.items()]
        sections.append(f" {json.dumps(name)}: {{\n" + ",\n".join(lines) + "\n }")
    return ("{\n" + ",\n".join(sections) + "\n}\n").encode()
