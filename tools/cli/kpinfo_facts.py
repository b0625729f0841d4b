"""What kpinfo says about a .kpc file, as plain data that becomes JSON: docs/kpinfo.schema.json describes it.

Shares are in [0, 1], times in seconds, sizes in bytes. What is not known is None.
"""

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

from kpc.format.coding.quantise import QuantisedPlane, QuantisedScene
from kpc.format.common import cli
from kpc.format.common.errors import BudgetError, FormatError, KpcError, UsageError
from kpc.format.common.progress import in_parts, progress
from kpc.format.common.text import agreeing, counted
from kpc.format.container.clip_sound import SoundSpan, sound_spans
from kpc.format.container.container import Beside, Codec, Entry, Reader
from kpc.format.container.groups import Groups
from kpc.format.container.http_address import public_name
from kpc.format.container.scene_io import SceneReader, read
from kpc.format.container.scene_layout import GROUP_KIND
from kpc.format.container.shared_planes import SharedPlanes
from kpc.format.container.slices import sliced
from kpc.format.container.sources import open_source
from kpc.format.scene.motion import QuantisedMotion
from kpc.format.scene.scene import ALL_PLANES, SPACE_PLANES, Appearance, Clip, HybridDecoder, common_names
from kpc.format.scene.sound import SAMPLE_RATE
from kpc.format.scene.space import FAR, Contraction, SpaceMapping
from kpc.format.scene.static import constant_fraction, static_fraction
from kpc.player.cpu.motion_map import motionless_share

# The version of the structure of the JSON; it grows whenever a key is renamed, removed or changes its meaning.
SCHEMA = 1

CODEC_NAMES = {codec.value: codec.name for codec in Codec}

# Number of damaged chunks that an error names.
DAMAGED_SHOWN = 10


def examine(file: str, *, memory: int, group: int | None, verify: bool, details: bool) -> dict[str, Any]:
    """Return what there is to say about a file. If it cannot be read, `error` says why.

    Args:
        file: a path or an http address.
        memory: bytes that one group may take.
        group: number of the group of which the scene is described; None: that of a file without groups.
        verify: whether to check all checksums and decode everything, or the one group.
        details: whether to describe the scene.

    Raises:
        UsageError: there is no such group.
    """
    info: dict[str, Any] = {
        "file": _shown(file),
        "error": None,
        "verified": False,
        "damaged_chunks": [],
        "version": None,
        "size_bytes": None,
        "expected_bytes": None,
        "clip": None,
        "cameras": None,
        "appearances": None,
        "metadata": None,
        "groups": [],
        "shared_planes": [],
    }
    with _noting(info):
        source = open_source(file, limit=memory)
        info |= {"file": source.name, "size_bytes": source.size}
        reader = Reader(source, allow_partial=True)
        info |= {"version": reader.header.version, "expected_bytes": reader.header.file_length}
        count = sum(entry.kind == GROUP_KIND for entry in reader.index) or 1
        if group is not None and not 0 <= group < count:
            raise UsageError(
                f"{reader.name}: there is no group {group}: it has {counted(count, 'group')}, numbered from 0"
            )
        if verify:
            with _noting(info):
                _verify(reader, group, memory, info)
        groups = Groups(source, memory_budget=memory, allow_partial=True, reads_metadata=False, needs_first=False)
        _describe_file(groups, group, info)
        if info["error"] is None and (details or not verify) and (group is not None or groups.is_single):
            scene_reader = groups.open(group or 0)
            # Without details, too: it finds damage.
            scene = read(scene_reader, memory_budget=memory, allow_partial=True)
            info["groups"][group or 0]["scene"] = describe(scene_reader, scene) if details else None
    info["verified"] = verify and info["error"] is None
    return info


@contextmanager
def _noting(info: dict[str, Any]) -> Iterator[None]:
    """Keep what goes wrong as the error of a file, unless it has one, and go on."""
    try:
        yield
    except UsageError:
        raise
    except (KpcError, OSError) as error:
        message = cli.message_of(error)
        if message is None:
            raise
        if info["error"] is None:
            info["error"] = f"{message}; give more with --memory" if isinstance(error, BudgetError) else message


def _describe_file(groups: Groups, only: int | None, info: dict[str, Any]) -> None:
    """Set what can be read without decoding planes; what is wrong with other groups than `only`, if that is not None,
    is no error.
    """

    def noted(number: int) -> dict[str, Any]:
        return info if only in (None, number) else dict(info)

    info["clip"], users, looks = _clip(groups.clip), Counter[int](), list[tuple[Appearance, ...]]()
    info["groups"] = [_group(groups, span, noted(span.group), users, looks) for span in sound_spans(groups.timeline)]
    info["appearances"] = common_names(looks)
    info["shared_planes"] = [_shared_plane(groups.reader, number, users[number]) for number in groups.reader.beside]
    info["clip"]["is_dynamic"] = any(one["is_dynamic"] for one in info["groups"])
    with _noting(noted(0)):
        info["cameras"] = len(groups.cameras())
    with _noting(noted(0)):
        info["metadata"] = dict(groups.metadata().document)


def totals(files: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return sums over the files that could be read, as far as they are known."""
    known = [info for info in files if info["clip"] is not None]
    clips = [info["clip"] for info in known]
    return {
        "files": len(files),
        "failed": sum(info["error"] is not None for info in files),
        "size_bytes": sum(info["size_bytes"] for info in known),
        "frame_count": sum(clip["frame_count"] for clip in clips),
        "duration_s": sum(clip["duration_s"] for clip in clips),
        "groups": sum(len(info["groups"]) for info in files),
    }


def _shown(file: str) -> str:
    """Return a path as it is, and an address without what is secret."""
    return public_name(file) if "://" in file else file


def _clip(clip: Clip) -> dict[str, Any]:
    return {"frame_count": clip.frame_count, "fps": clip.fps, "duration_s": clip.total_s}


def _group(
    groups: Groups, heard: SoundSpan, info: dict[str, Any], users: Counter[int], looks: list[tuple[Appearance, ...]]
) -> dict[str, Any]:
    """Return what header, index and SCNE of a group say, as far as they can be read; the first error goes to `info`.

    The group of a file without groups is the whole file.

    Args:
        users: how many groups use each shared plane; this one is counted.
        looks: the appearances of each group; those of this one are appended.
    """
    number, clip = heard.group, groups.clip
    span = groups.timeline.spans[number]
    since, until = (time * clip.duration_s for time in groups.timeline.display_span(number))
    if number == len(groups) - 1:
        until = clip.total_s  # The last frame is shown as long as the others.
    head, sound = None, None
    if groups.available(number):
        with _noting(info):
            reader = groups.open(number)
            head = reader.head
            users.update(plane.chunk for plane in reader.beside.values())
            sound = _sound(reader, heard)
            looks.append(reader.appearances())
    is_complete = head is not None and (not groups.is_single or groups.reader.source.size >= groups.size_bytes[0])
    return {
        "number": number,
        "frames": [span.start, span.last],
        "shown_s": [round(since, 6), round(until, 6)],
        "stored_bytes": groups.size_bytes[number],
        "is_complete": is_complete,
        "value_count": head.value_count if head else None,
        "scale_count": len(head.scales) if head else None,
        "is_dynamic": head.is_dynamic if head else None,
        "sound": sound,
        "scene": None,
    }


def _sound(reader: SceneReader, heard: SoundSpan) -> dict[str, Any] | None:
    """Return what the index and the first soun chunk say; None without one, or where it is missing."""
    numbers = reader.sound_numbers
    if not numbers or not reader.available(numbers[0]):
        return None
    first, size = reader.sound_segment(numbers[0]), sum(reader.index[number].stored_length for number in numbers)
    duration_s = first.sample_count / SAMPLE_RATE
    heard_samples = min(first.sample_count, heard.stop - heard.start) - (heard.first - heard.start)
    heard_s = max(heard_samples, 0) / SAMPLE_RATE
    return {"channels": first.channels, "duration_s": duration_s, "heard_s": heard_s, "stored_bytes": size}


def _verify(file: Reader, group: int | None, memory: int, info: dict[str, Any]) -> None:
    """Check the CRC32C of every chunk and decode all chunks of known kinds; set `damaged_chunks`.

    Args:
        file: the whole file, of which nothing but header and index need be right.
        group: the only group to check; None for all.
        memory: bytes that one group may take.
        info: of the file.

    Raises:
        FormatError: chunks are damaged, or the end of the file is missing.
    """
    errors, found = [], info["damaged_chunks"]
    if info["size_bytes"] < info["expected_bytes"]:
        raise _cut_off(file, info)
    file.source.will_read(0, file.source.size)
    chunks = [number for number, entry in enumerate(file.index) if entry.kind == GROUP_KIND]
    is_single = not chunks
    shared = None if is_single else SharedPlanes(file, len(chunks), memory)
    beside = [number for number, entry in enumerate(file.index) if entry.kind != GROUP_KIND]
    damaged = [] if is_single else _differing(file, beside)
    if group is not None:
        chunks = [number for number in chunks if file.index[number].group == group]
    for chunk in progress([None] if is_single else chunks, "checking", unit="groups"):
        place = None if chunk is None else file.index[chunk].group
        for number, kind, error in (
            _damaged_chunks(file, memory)
            if chunk is None
            else _damaged_in(file, chunk, memory, shared, {number for number, *_ in damaged})
        ):
            errors.append(error)
            found.append({"group": None if kind == GROUP_KIND else place, "chunk": number, "kind": kind})
    for number, kind, error in damaged:
        errors.append(error)
        found.append({"group": None, "chunk": number, "kind": kind})
    if len(errors) > 1:
        raise FormatError(f"{file.name}: {len(found)} chunks are damaged: {_listed(found)}; fetch the file again")
    if errors:
        raise errors[0]


def _cut_off(file: Reader, info: dict[str, Any]) -> FormatError:
    """Return what to say of a file whose end is missing; set `damaged_chunks` to those of what is there."""
    whole = [number for number in range(len(file.index)) if file.available(number)]
    damaged = [{"group": None, "chunk": number, "kind": kind} for number, kind, _ in _differing(file, whole)]
    info["damaged_chunks"] = damaged
    chunks, are = agreeing(len(damaged), "chunk", "chunks"), agreeing(len(damaged), "is", "are")
    damage = f"; of what is there, {chunks} {_listed(damaged)} {are} damaged" if damaged else ""
    return FormatError(
        f"{file.name}: cut off at {info['size_bytes']:,} of {info['expected_bytes']:,} bytes{damage}; "
        "fetch the file again"
    )


def _listed(damaged: Sequence[Mapping[str, Any]]) -> str:
    """Return the first of some chunks in words."""
    named = [
        f"{one['chunk']} ({one['kind']})" + (f" of group {one['group']}" if one["group"] is not None else "")
        for one in damaged
    ]
    return ", ".join(named[:DAMAGED_SHOWN]) + ", ..." * (len(named) > DAMAGED_SHOWN)


def _damaged_in(
    file: Reader, chunk: int, memory: int, shared: SharedPlanes | None, skipped: Collection[int]
) -> list[tuple[int, str, FormatError]]:
    """Return as `_damaged_chunks` does what is damaged in a GRUP chunk, or that chunk if it is damaged elsewhere.

    Args:
        shared: the planes that the groups of the file share.
        skipped: the chunks of those that are known to be damaged.
    """
    entry = file.index[chunk]
    try:
        name = f"{file.name}, group {entry.group}"
        reader = Reader(sliced(file.source, entry.offset, entry.stored_length, name, shared))
        if shared is not None:
            shared.resolve(reader, entry.group)
        damaged = _damaged_chunks(reader, memory, skipped)
    except FormatError:
        if found := _differing(file, [chunk]):
            return found
        raise
    return damaged or _differing(file, [chunk])


def _differing(file: Reader | SceneReader, numbers: Sequence[int] | None = None) -> list[tuple[int, str, FormatError]]:
    """Return number, kind and error of each chunk, of all or of these, whose CRC32C differs."""
    damaged = []
    for number in range(len(file.index)) if numbers is None else numbers:
        try:
            file.stored(number)
        except FormatError as error:
            damaged.append((number, file.index[number].kind, error))
    return damaged


def _damaged_chunks(file: Reader, memory: int, skipped: Collection[int] = ()) -> list[tuple[int, str, FormatError]]:
    """Return the number, kind and error of each damaged chunk of a scene, but for shared planes in these chunks of its
    clip.

    Raises:
        FormatError: no chunk is damaged, but what they hold is not valid.
    """
    try:
        reader = SceneReader(file, memory_budget=memory)
    except FormatError:
        if damaged := _differing(file):  # SCNE, without which no plane is decoded
            return damaged
        raise
    damaged = []
    for number, entry in in_parts(list(enumerate(reader.index))):
        if number in reader.beside and reader.beside[number].chunk in skipped:
            continue
        try:
            reader.segment(number) if entry.kind == "PLNE" else reader.stored(number)
        except FormatError as error:
            damaged.append((number, entry.kind, error))
    if any(kind == "OCCU" for _, kind, _ in damaged):  # without it no plane decodes, however whole
        damaged = [one for one in damaged if one[1] != "PLNE" or _differing(reader, [one[0]])]
    if not damaged:
        reader.mapping(), reader.motion(), reader.decoder(), reader.occupancy()
        reader.cameras(), reader.appearances(), reader.metadata(), reader.sound()
    return damaged


def describe(reader: SceneReader, scene: QuantisedScene) -> dict[str, Any]:
    """Return what there is to say about a decoded scene. Shares that chunks which are missing would change are None.

    Planes that a group shares count as if they lay in it.
    """
    size = reader.header.file_length + sum(reader.index[number].stored_length for number in reader.beside)
    missing = [not reader.available(number) for number in range(len(reader.index))]
    is_whole = not any(missing)
    partial = {
        (entry.scale, ALL_PLANES[entry.plane])
        for entry, gone in zip(reader.index, missing, strict=True)
        if gone and entry.kind == "PLNE"
    }
    return {
        "missing_chunks": sum(missing),
        "aabb": scene.aabb.tolist(),
        "step": scene.step,
        "space": _describe_space(scene.mapping),
        "motion": _describe_motion(scene.motion),
        "background": scene.background.tolist(),
        "scales": [
            _describe_scale(scale, {name for number, name in partial if number == s})
            for s, scale in enumerate(scene.scales)
        ],
        "decoder": {
            "kind": "hybrid" if isinstance(scene.decoder, HybridDecoder) else "explicit",
            "hidden": len(scene.decoder.b1),
            "features": sum(scale["xy"].symbols.shape[2] for scale in scene.scales),
        },
        "occupancy": {
            "slots": scene.occupancy.shape[0],
            "cells_zyx": list(scene.occupancy.shape[1:]),
            "share": float(scene.occupancy.mean()),
        },
        "cameras": len(scene.cameras),
        "camera_box": _camera_box(scene),
        "camera_sizes": [[camera.width, camera.height] for camera in scene.cameras],
        "appearances": [appearance.name for appearance in scene.appearances],
        "parameter_count": scene.parameter_count,
        "bits_per_parameter": 8 * size / scene.parameter_count,
        "identity_share": scene.identity_share if is_whole else None,
        "static": _describe_static(scene) if is_whole else None,
        "uncoded_share": _uncoded_share([scale[name] for scale in scene.scales for name in SPACE_PLANES])
        if is_whole
        else None,
        "overhead_bytes": size - sum(entry.stored_length for entry in reader.index),
        "chunks": [
            _describe_chunk(entry, missing[number], size, reader.beside.get(number))
            for number, entry in enumerate(reader.index)
        ],
    }


def _describe_motion(motion: QuantisedMotion | None) -> dict[str, Any] | None:
    if motion is None:
        return None
    rows, *nodes_zyx, _ = motion.symbols.shape
    return {
        "rows": rows,
        "nodes_zyx": nodes_zyx,
        "max_displacement": float(np.abs(motion.dequantise()).max()),
    }


def _describe_static(scene: QuantisedScene) -> dict[str, float]:
    """Return the shares of occupied space where time planes are 1, where nothing changes, and where little changes."""
    decoded = scene.dequantise()
    return {
        "identity_share": static_fraction(decoded),
        "constant_share": constant_fraction(decoded),
        "motionless_share": motionless_share(decoded),
    }


def _describe_space(mapping: SpaceMapping | None) -> dict[str, Any]:
    if isinstance(mapping, Contraction):
        return {
            "mapping": "contracted",
            "uniform_distance": mapping.uniform_distance,
            "far": FAR * mapping.uniform_distance,
        }
    if mapping is not None:
        return {"mapping": "ndc", "frame": mapping.frame.tolist(), "near": mapping.near, "baseline": mapping.baseline}
    return {"mapping": "box"}


def _describe_scale(scale: Mapping[str, QuantisedPlane], partial: set[str]) -> dict[str, Any]:
    return {
        "channels": scale["xy"].symbols.shape[2],
        "planes": {
            name: {
                "rows": plane.symbols.shape[0],
                "columns": plane.symbols.shape[1],
                "coded_share": None if name in partial else float(plane.coded.mean()),
                "mean_step": float(plane.step.mean()),
            }
            for name, plane in scale.items()
        },
    }


def _shared_plane(reader: Reader, number: int, group_count: int) -> dict[str, Any]:
    """Return what the index of a clip says of a shared plane."""
    entry = reader.index[number]
    return {
        "chunk": number,
        "scale": entry.scale,
        "plane": ALL_PLANES[entry.plane],
        "first_group": entry.group,
        "group_count": group_count,
        "codec": CODEC_NAMES[entry.codec],
        "stored_bytes": entry.stored_length,
        "missing": not reader.available(number),
    }


def _describe_chunk(entry: Entry, missing: bool, size: int, shared: Beside | None) -> dict[str, Any]:
    is_plane = entry.kind == "PLNE"
    return {
        "kind": entry.kind,
        "critical": entry.is_critical,
        "scale": entry.scale if is_plane else None,
        "plane": ALL_PLANES[entry.plane] if is_plane else None,
        "rows": [entry.row_start, entry.row_start + entry.row_count - 1] if is_plane else None,
        "codec": CODEC_NAMES.get(entry.codec, str(entry.codec)),
        "offset": entry.offset if shared is None else None,
        "stored_bytes": entry.stored_length,
        "raw_bytes": entry.raw_length,
        "share": None if missing else entry.stored_length / size,
        "missing": missing,
        "shared_chunk": None if shared is None else shared.chunk,
    }


def _camera_box(scene: QuantisedScene) -> list[list[float]] | None:
    if not scene.cameras:
        return None
    positions = np.array([camera.camera_to_world[:3, 3] for camera in scene.cameras])
    return [positions.min(0).tolist(), positions.max(0).tolist()]


def _uncoded_share(planes: Sequence[QuantisedPlane]) -> float:
    return 1.0 - sum(int(p.coded.sum()) for p in planes) / sum(p.coded.size for p in planes)
