"""Cameras to and from glTF: perspective cameras, and animations of the nodes that hold them.

A camera of glTF has a vertical field of view and an aspect ratio, which do not change, and its principal point is the
centre. The member `extras.kpc` of its node holds what glTF lacks: `size`, `centre`, and for each instant the clip's
`time`. Axes are those of KPC: x right, y up, looking along -z.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from kpc.format.scene.camera_checks import check_lens, check_pose, number_of
from kpc.format.scene.cameras import Camera, View
from kpc.format.scene.rotations import quaternion_of, rotation_of, slerp
from kpc.tools.exchange.camera_tracks import (
    MAX_VIEWS,
    SAMPLED_FPS,
    Track,
    fitted,
    sampled_note,
    size_for,
    times_at,
    with_instants_between,
)
from kpc.tools.exchange.gltf import GltfReader, GltfWriter

NEAR = 0.01
# The deepest chain of parents that a node may have.
MAX_DEPTH = 64
PATHS = {"translation": "VEC3", "rotation": "VEC4", "scale": "VEC3"}


def write_gltf_cameras(path: Path, tracks: Sequence[Track]) -> list[str]:
    """Write cameras, placed (`kpc.tools.exchange.placement`), and return what glTF cannot say of them."""
    nodes, cameras, lost = [], [], set[str]()
    for number, track in enumerate(tracks):
        camera = track.views[0].camera
        if any(abs(v.camera.fl_y / camera.fl_y - 1) + abs(v.camera.fl_x / camera.fl_x - 1) > 1e-9 for v in track.views):
            lost.add("the focal length changes along the path; glTF keeps the first one; USD has them all")
        centred = (camera.width / 2, camera.height / 2)
        if any(math.dist((v.camera.cx, v.camera.cy), centred) > 1e-6 * camera.width for v in track.views):
            lost.add("principal points lie off the centre, which other programs ignore in glTF; USD has them")
        yfov = 2 * math.atan(camera.height / 2 / camera.fl_y)
        aspect = camera.width / camera.fl_x / (camera.height / camera.fl_y)
        cameras.append(
            {
                "name": track.name,
                "type": "perspective",
                "perspective": {"yfov": yfov, "aspectRatio": aspect, "znear": NEAR},
            }
        )
        extras = {
            "size": [camera.width, camera.height],
            "centre": [camera.cx, camera.cy],
            "time": [view.time for view in track.views],
        }
        nodes.append({"name": track.name, "camera": number, **_node_pose(camera), "extras": {"kpc": extras}})
    writer = GltfWriter(nodes, cameras=cameras)
    for number, track in enumerate(tracks):
        if track.is_moving:
            _animate(writer, number, track)
    writer.write(path)
    return sorted(lost)


def read_gltf_cameras(path: Path, size: tuple[int, int] | None) -> tuple[list[Track], list[str]]:
    """Read the perspective cameras of a .gltf or .glb file, and return what of them was guessed, too.

    Args:
        path: of the file.
        size: of the pictures; None for what the file says (`camera_tracks.size_for`).

    Raises:
        DatasetError: the file is malformed, or a camera cannot be rendered.
    """
    reader = GltfReader(path)
    nodes = reader.objects("nodes")
    parents = _parents(reader, nodes)
    channels = _channels(reader)
    tracks: list[Track] = []
    guessed = set[str]()
    for number, node in enumerate(nodes):
        if "camera" not in node:
            continue
        camera = reader.entry("cameras", node["camera"])
        if camera.get("type") != "perspective":
            guessed.add("orthographic cameras are left out")
            continue
        if len(tracks) == MAX_VIEWS:
            raise reader.error(f"more than {MAX_VIEWS} cameras")
        chain = [number]
        while (parent := parents.get(chain[-1])) is not None:
            chain.append(parent)
            if len(chain) > MAX_DEPTH:
                raise reader.error(f"node {number} has more than {MAX_DEPTH} parents, or is its own")
        tracks.append(_track(reader, camera, [(n, nodes[n]) for n in chain], channels, size, guessed))
    return tracks, sorted(guessed)


def _node_pose(camera: Camera) -> dict[str, Any]:
    w, x, y, z = quaternion_of(camera.camera_to_world[:3, :3]).tolist()
    return {"translation": camera.camera_to_world[:3, 3].tolist(), "rotation": [x, y, z, w]}


def _animate(writer: GltfWriter, node: int, track: Track) -> None:
    """Add an animation of a node through all instants of a track."""
    poses = np.stack([view.camera.camera_to_world for view in track.views])
    turns = quaternion_of(poses[:, :3, :3])
    for before, after in itertools.pairwise(turns):
        after *= 1.0 if before @ after >= 0 else -1.0  # q and -q are the same rotation: take the nearer one
    times = writer.add(np.array([view.at_s for view in track.views], np.float32))
    outputs = {"translation": poses[:, :3, 3], "rotation": turns[:, [1, 2, 3, 0]]}
    samplers = [
        {"input": times, "interpolation": "LINEAR", "output": writer.add(values.astype(np.float32))}
        for values in outputs.values()
    ]
    channels = [{"sampler": n, "target": {"node": node, "path": name}} for n, name in enumerate(outputs)]
    writer.document.setdefault("animations", []).append(
        {"name": track.name, "samplers": samplers, "channels": channels}
    )


# The animated values of a node: name -> (instants (N,), values (N, K), whether they jump).
_Channels = dict[tuple[int, str], tuple[np.ndarray, np.ndarray, bool]]


def _channels(reader: GltfReader) -> _Channels:
    """Return the animated values of all nodes."""
    found: _Channels = {}
    for animation in reader.objects("animations"):
        samplers, channels = animation.get("samplers"), animation.get("channels")
        if not isinstance(samplers, list) or not isinstance(channels, list):
            raise reader.error("an animation lacks samplers or channels")
        for channel in channels:
            target = channel.get("target") if isinstance(channel, Mapping) else None
            if not isinstance(target, Mapping) or target.get("path") not in PATHS:
                continue  # weights of shapes, and what extensions animate
            at = channel.get("sampler")
            if not isinstance(at, int) or not 0 <= at < len(samplers) or not isinstance(samplers[at], Mapping):
                raise reader.error("an animation has no such sampler")
            node: Any = target.get("node")
            name, sampler = str(target["path"]), samplers[at]
            reader.entry("nodes", node)
            how = sampler.get("interpolation", "LINEAR")
            if how not in ("LINEAR", "STEP"):
                raise reader.error(f"an animation is {str(how)[:40]}; sample it at every frame")
            instants, values = (
                reader.floats(sampler.get("input"), "SCALAR"),
                reader.floats(sampler.get("output"), PATHS[name]),
            )
            if len(instants) != len(values) or len(instants) > MAX_VIEWS or not (np.diff(instants) > 0).all():
                raise reader.error(f"the instants of an animation do not fit its values, or exceed {MAX_VIEWS}")
            if (node, name) in found:
                raise reader.error("several animations move one node; export the active one alone")
            found[int(node), name] = instants, values, how == "STEP"
    return found


def _track(
    reader: GltfReader,
    camera: Mapping[str, Any],
    chain: Sequence[tuple[int, Mapping[str, Any]]],
    channels: _Channels,
    size: tuple[int, int] | None,
    guessed: set[str],
) -> Track:
    """Return the track of a camera whose node and its parents are `chain`."""
    node = chain[0][1]
    name = str(node.get("name", camera.get("name", f"camera{chain[0][0]}")))[:200]
    where = f"{reader.where}, camera {name[:40]!r}"
    lens = camera.get("perspective")
    if not isinstance(lens, Mapping):
        raise reader.error(f"camera {name[:40]!r} has no perspective")
    extras = node.get("extras")
    stored = extras.get("kpc") if isinstance(extras, Mapping) else None
    stored = stored if isinstance(stored, Mapping) else {}
    yfov = number_of(where, lens, "yfov")
    if not 1e-6 < yfov < math.pi:
        raise reader.error(f"camera {name[:40]!r} has a field of view of {yfov:g} radians")
    aspect = number_of(where, lens, "aspectRatio", 16 / 9)
    width, height, aspect = size_for(where, aspect, stored.get("size"), size)
    fl_y = height / 2 / math.tan(yfov / 2)
    fl_x = width / (aspect * height / fl_y) if aspect > 0 else 0.0
    cx, cy = _centre(stored, width, height)
    check_lens(where, (width, height), (fl_x, fl_y, cx, cy))

    def poses(instants: np.ndarray) -> np.ndarray:
        found = np.broadcast_to(np.eye(4), (len(instants), 4, 4))
        for number, one in chain:
            found = _matrices(reader, number, one, channels, instants) @ found
        axes = np.linalg.norm(found[:, :3, :3], axis=1, keepdims=True)  # a parent may scale
        rigid = found.copy()
        rigid[:, :3, :3] /= np.where(axes > 0, axes, 1.0)
        for pose in rigid:
            check_pose(where, pose)
        return rigid

    animated = [channels[n, path][0] for n, _ in chain for path in PATHS if (n, path) in channels]
    keys = np.unique(np.concatenate(animated)) if animated else np.zeros(1)
    if len(keys) > MAX_VIEWS:
        raise reader.error(f"camera {name[:40]!r} has more than {MAX_VIEWS} instants")
    stored_times: Any = stored.get("time")
    known = stored_times if _are_times(stored_times, len(keys)) else None
    if known is None:
        guessed.add("there are no times of the clip: it plays once along the path" if animated else "all times are 0")
    instants = with_instants_between(where, keys, poses, 1 / SAMPLED_FPS)
    if len(instants) > len(keys):
        guessed.add(sampled_note(SAMPLED_FPS))
    views = []
    for k, (pose, time) in enumerate(zip(poses(instants), times_at(instants, keys, known), strict=True)):
        made = Camera(width, height, fl_x, fl_y, cx, cy, pose)
        file, at_s = (f"{k:04d}.png", float(instants[k])) if animated else (f"{name}.png", None)
        views.append(View(fitted(made, size), float(time), file, at_s))
    return Track(name, tuple(views))


def _centre(stored: Mapping[str, Any], width: int, height: int) -> tuple[float, float]:
    """Return the principal point that a file stores, scaled to the size; the centre if it stores none."""
    try:
        (cx, cy), (w, h) = stored["centre"], stored["size"]
        centre = float(cx) * width / float(w), float(cy) * height / float(h)
    except (KeyError, TypeError, ValueError, ZeroDivisionError, OverflowError):
        return width / 2, height / 2
    return centre


def _are_times(times: Any, count: int) -> bool:
    return (
        isinstance(times, list)
        and len(times) == count
        and all(isinstance(time, (int, float)) and not isinstance(time, bool) and 0 <= time <= 1 for time in times)
    )


def _parents(reader: GltfReader, nodes: Sequence[Mapping[str, Any]]) -> dict[int, int]:
    parents: dict[int, int] = {}
    for number, node in enumerate(nodes):
        children = node.get("children", [])
        for child in children if isinstance(children, list) else []:
            reader.entry("nodes", child)
            parents[child] = number
    return parents


def _matrices(
    reader: GltfReader, number: int, node: Mapping[str, Any], channels: _Channels, instants: np.ndarray
) -> np.ndarray:
    """Return the local matrices of a node at instants: (N, 4, 4)."""
    where = f"{reader.where} node {number}"
    if "matrix" in node:
        return np.broadcast_to(np.reshape(_numbers(where, node, "matrix", [0.0] * 16), (4, 4)).T, (len(instants), 4, 4))
    values = {}
    for path, default in (("translation", [0.0] * 3), ("rotation", [0.0, 0.0, 0.0, 1.0]), ("scale", [1.0] * 3)):
        still = np.array(_numbers(where, node, path, default))
        channel = channels.get((number, path))
        values[path] = np.tile(still, (len(instants), 1)) if channel is None else _sampled(channel, path, instants)
    turns = values["rotation"]
    if not (np.isfinite(turns).all() and (np.abs(np.linalg.norm(turns, axis=1) - 1) < 1e-2).all()):
        raise reader.error(f"node {number} has a rotation that is no unit quaternion")
    matrices = np.tile(np.eye(4), (len(instants), 1, 1))
    matrices[:, :3, :3] = [rotation_of(turn[[3, 0, 1, 2]]) for turn in turns]
    matrices[:, :3, :3] *= values["scale"][:, None, :]
    matrices[:, :3, 3] = values["translation"]
    return matrices


def _numbers(where: str, node: Mapping[str, Any], key: str, default: list[float]) -> list[float]:
    listed = node.get(key, default)
    keys = {f"{key}[{n}]": number for n, number in enumerate(listed if isinstance(listed, list) else [])}
    return [number_of(where, keys, f"{key}[{n}]") for n in range(len(default))]


def _sampled(channel: tuple[np.ndarray, np.ndarray, bool], path: str, instants: np.ndarray) -> np.ndarray:
    """Return animated values at instants, (N, K): rotations along great circles, others linearly."""
    times, values, jumps = channel
    before = np.clip(np.searchsorted(times, instants, side="right") - 1, 0, len(times) - 1)
    after = np.minimum(before + 1, len(times) - 1)
    gap = np.where(after > before, times[after] - times[before], 1.0)
    share = np.zeros(len(instants)) if jumps else np.clip((instants - times[before]) / gap, 0, 1)
    a, b, share = values[before], values[after], share[:, None]
    if path != "rotation":
        return np.asarray((1 - share) * a + share * b)
    return slerp(a, b, share)
