"""kpinfo: show what is inside a .kpc file.

    kpinfo scene.kpc             clip, scene box, planes and chunks
    kpinfo https://host/scene.kpc
    kpinfo long.kpc --group 2    one group of a clip in groups; without --group, a list of its groups
    kpinfo scene.kpc --json      the same as a JSON object
    kpinfo scene.kpc --verify    also check all checksums and decode everything; the exit code is 1 if anything is wrong

Without --verify, a file whose end is missing is described as far as it goes.
"""

import argparse
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from kpc.format.coding.quantise import QuantisedPlane, QuantisedScene
from kpc.format.common import cli
from kpc.format.common.errors import FormatError, UsageError
from kpc.format.common.memory import DEFAULT_BUDGET
from kpc.format.container.container import Codec, Entry
from kpc.format.container.groups import Groups
from kpc.format.container.scene_io import SceneReader, read
from kpc.format.container.sources import open_source
from kpc.format.scene.motion import QuantisedMotion
from kpc.format.scene.scene import ALL_PLANES, SPACE_PLANES, HybridDecoder
from kpc.format.scene.space import FAR, Contraction, SpaceMapping
from kpc.format.scene.static import constant_fraction, static_fraction
from kpc.player.cpu.motion_map import STILL, motionless_share

# Number of appearances that the page names; --json has all of them.
NAMES_SHOWN = 8

CODEC_NAMES = {codec.value: codec.name for codec in Codec}


def main(argv: list[str] | None = None) -> int:
    """Run the command and return its exit code."""
    return cli.run(_command, "kpinfo", argv)


def _command(argv: list[str]) -> None:
    options = _parser().parse_args(argv)
    if options.memory_budget < 1:
        raise UsageError(f"--memory-budget {options.memory_budget} is not positive")

    source = open_source(options.scene, limit=options.memory_budget)
    groups = Groups(source, memory_budget=options.memory_budget, allow_partial=not options.verify)
    source.will_read(0, source.size)
    if options.group is not None and not 0 <= options.group < len(groups):
        raise UsageError(f"--group {options.group}: the file has {len(groups)} groups, numbered from 0")
    if options.verify:
        for number in range(len(groups)) if options.group is None else [options.group]:
            verify(groups.open(number))
    if options.group is None and not groups.is_single:
        overview = describe_groups(groups) | {"verified": options.verify}
        cli.print_json(overview) if options.json else print(_groups_page(overview))
        return
    reader = groups.open(options.group or 0)
    info = describe(reader, read(reader, memory_budget=options.memory_budget, allow_partial=True))
    info["verified"] = options.verify
    cli.print_json(info) if options.json else print(_page(info))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="kpinfo", description="Show what is inside a .kpc file.")
    cli.add_version_option(parser)
    parser.add_argument("scene", help="a .kpc file, or its http address")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--group", type=int, metavar="N", help="describe group N of a clip in groups, counted from 0")
    parser.add_argument("--verify", action="store_true", help="check every CRC32C and decode everything")
    parser.add_argument(
        "--memory-budget",
        type=int,
        default=DEFAULT_BUDGET,
        metavar="BYTES",
        help="largest memory that the scene may take (default: %(default)s)",
    )
    return parser


def verify(reader: SceneReader) -> None:
    """Check the CRC32C of every chunk and decode all chunks of known kinds.

    Raises:
        FormatError: chunks are damaged; the message names all of them.
    """
    damaged = []
    for number, entry in enumerate(reader.index):
        try:
            reader.segment(number) if entry.kind == "PLNE" else reader.stored(number)
        except FormatError as error:
            damaged.append((number, entry.kind, error))
    if len(damaged) > 1:
        listed = ", ".join(f"{number} ({kind})" for number, kind, _ in damaged)
        raise FormatError(
            f"{reader.name}: {len(damaged)} of {len(reader.index)} chunks are damaged: {listed}; fetch the file again"
        )
    if damaged:
        raise damaged[0][2]
    reader.mapping(), reader.motion(), reader.decoder(), reader.occupancy(), reader.cameras(), reader.appearances()


def describe_groups(groups: Groups) -> dict[str, Any]:
    """Return what kpinfo prints about a clip in groups, as plain data."""
    clip, sizes, described = groups.clip, groups.size_bytes, []
    for number, (span, size) in enumerate(zip(groups.timeline.spans, sizes, strict=True)):
        head = groups.open(number).head if groups.available(number) else None
        shown = [round(time * clip.duration_s, 6) for time in groups.timeline.display_span(number)]
        described.append(
            {
                "frames": [span.start, span.last],
                "shown_s": shown,
                "size_bytes": size,
                "missing": head is None,
                "values": head.value_count if head else None,
                "scales": len(head.scales) if head else None,
                "is_dynamic": head.is_dynamic if head else None,
            }
        )
    return {
        "file": groups.name,
        "version": groups.reader.header.version,
        "size_bytes": groups.reader.header.file_length,
        "clip": {"frame_count": clip.frame_count, "fps": clip.fps, "duration_s": clip.duration_s},
        "cameras": len(groups.cameras()),
        "groups": described,
    }


def _groups_page(info: dict[str, Any]) -> str:
    clip = info["clip"]
    lines = [
        f"{info['file']}: {info['size_bytes']:,} bytes, format version {info['version']}"
        + (", verified" if info["verified"] else ""),
        f"  clip        {clip['frame_count']} frames at {clip['fps']:g} fps, {clip['duration_s']:.2f} s, in "
        f"{len(info['groups'])} groups",
        f"  cameras     {info['cameras']}",
        "",
        "  group       frames          shown, s       stored   scales       values",
    ]
    for number, group in enumerate(info["groups"]):
        (first, last), (since, until) = group["frames"], group["shown_s"]
        model = "missing" if group["missing"] else f"{group['scales']:>7}  {group['values']:>11,}"
        lines.append(
            f"  {number:>5}  {first:>6}-{last:<6}  {since:>8.2f}-{until:<8.2f}  {group['size_bytes']:>9,}  {model}"
        )
    return "\n".join(lines)


def describe(reader: SceneReader, scene: QuantisedScene) -> dict[str, Any]:
    """Return everything kpinfo prints, as plain data. Shares are in [0, 1]; times are in seconds."""
    size = reader.header.file_length
    missing = [not reader.available(number) for number in range(len(reader.index))]
    return {
        "file": reader.name,
        "version": reader.header.version,
        "size_bytes": size,
        "missing_chunks": sum(missing),
        "clip": {
            "frame_count": scene.clip.frame_count,
            "fps": scene.clip.fps,
            "duration_s": scene.clip.duration_s,
            "is_dynamic": scene.is_dynamic,
        },
        "aabb": scene.aabb.tolist(),
        "step": scene.step,
        "space": _describe_space(scene.mapping),
        "motion": _describe_motion(scene.motion),
        "background": scene.background.tolist(),
        "scales": [_describe_scale(scale) for scale in scene.scales],
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
        "appearances": [appearance.name for appearance in scene.appearances],
        "parameter_count": scene.parameter_count,
        "bits_per_parameter": 8 * size / scene.parameter_count,
        "identity_share": scene.identity_share,
        "static": _describe_static(scene),
        "uncoded_share": _uncoded_share([scale[name] for scale in scene.scales for name in SPACE_PLANES]),
        "overhead_bytes": size - sum(entry.stored_length for entry in reader.index),
        "chunks": [_describe_chunk(entry, gone, size) for entry, gone in zip(reader.index, missing, strict=True)],
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


def _describe_scale(scale: Mapping[str, QuantisedPlane]) -> dict[str, Any]:
    return {
        "channels": scale["xy"].symbols.shape[2],
        "planes": {
            name: {
                "rows": plane.symbols.shape[0],
                "columns": plane.symbols.shape[1],
                "coded_share": float(plane.coded.mean()),
                "mean_step": float(plane.step.mean()),
            }
            for name, plane in scale.items()
        },
    }


def _describe_chunk(entry: Entry, missing: bool, size: int) -> dict[str, Any]:
    is_plane = entry.kind == "PLNE"
    return {
        "kind": entry.kind,
        "critical": entry.is_critical,
        "scale": entry.scale if is_plane else None,
        "plane": ALL_PLANES[entry.plane] if is_plane else None,
        "rows": [entry.row_start, entry.row_start + entry.row_count] if is_plane else None,
        "codec": CODEC_NAMES.get(entry.codec, str(entry.codec)),
        "offset": entry.offset,
        "stored_bytes": entry.stored_length,
        "raw_bytes": entry.raw_length,
        "share": entry.stored_length / size,
        "missing": missing,
    }


def _camera_box(scene: QuantisedScene) -> list[list[float]] | None:
    if not scene.cameras:
        return None
    positions = np.array([camera.camera_to_world[:3, 3] for camera in scene.cameras])
    return [positions.min(0).tolist(), positions.max(0).tolist()]


def _uncoded_share(planes: Sequence[QuantisedPlane]) -> float:
    return 1.0 - sum(int(p.coded.sum()) for p in planes) / sum(p.coded.size for p in planes)


def _page(info: dict[str, Any]) -> str:
    clip, occupancy = info["clip"], info["occupancy"]
    kind = "dynamic" if clip["is_dynamic"] else "static"
    verified = ", verified" if info["verified"] else ""
    cameras = f"  cameras     {info['cameras']}"
    if info["cameras"]:
        cameras += f" within {_corner(info['camera_box'][0])} to {_corner(info['camera_box'][1])}"
    cells = "x".join(map(str, reversed(occupancy["cells_zyx"])))
    lines = [
        f"{info['file']}: {info['size_bytes']:,} bytes, format version {info['version']}{verified}",
        f"  clip        {clip['frame_count']} frames at {clip['fps']:g} fps, {clip['duration_s']:.2f} s, {kind}",
        f"  box         {_corner(info['aabb'][0])} to {_corner(info['aabb'][1])}, ray step {info['step']:.4g}",
        *_space_line(info["space"]),
        *_motion_line(info["motion"]),
        cameras,
        *_appearances_line(info["appearances"]),
        f"  occupancy   {occupancy['slots']} x {cells} cells, {occupancy['share']:.1%} occupied",
        "  decoder     {kind}, {features} features, {hidden} hidden units".format(**info["decoder"]),
    ]
    for number, scale in enumerate(info["scales"]):
        planes = ", ".join(f"{name} {p['columns']}x{p['rows']}" for name, p in scale["planes"].items())
        lines.append(f"  scale {number}     {scale['channels']} channels; {planes}")
    static = info["static"]
    lines += [
        f"  model       {info['parameter_count']:,} parameters, {info['bits_per_parameter']:.3f} bits each",
        f"  identity    {info['identity_share']:.1%} of the time-plane texels are exactly 1",
        f"  static      {static['identity_share']:.1%} of the occupied space-time has time planes of 1;",
        f"              {static['constant_share']:.1%} of the occupied space never changes,",
        f"              about {static['motionless_share']:.0%} by less than {STILL:g} of white and of full opacity",
        f"  not coded   {info['uncoded_share']:.1%} of the space-plane texels are not stored",
    ]
    if info["missing_chunks"]:
        lines.append(
            f"  cut off     {info['missing_chunks']} of {len(info['chunks'])} chunks are missing and count as "
            "not stored"
        )
    return "\n".join([*lines, "", *_chunk_lines(info)])


def _chunk_lines(info: dict[str, Any]) -> list[str]:
    lines = ["  chunk  kind  scale  plane  rows        codec           stored         raw   share"]
    for number, chunk in enumerate(info["chunks"]):
        plane = f"{'-':>5}  {'-':<5}  {'-':<10}"
        if chunk["plane"] is not None:
            plane = f"{chunk['scale']:>5}  {chunk['plane']:<5}  {chunk['rows'][0]:>4}-{chunk['rows'][1]:<5}"
        lines.append(
            f"  {number:>5}  {chunk['kind']}  {plane}  {chunk['codec']:<10}  {chunk['stored_bytes']:>10,}  "
            f"{chunk['raw_bytes']:>10,}  {chunk['share']:>6.1%}" + ("  missing" if chunk["missing"] else "")
        )
    overhead = info["overhead_bytes"]
    return [*lines, f"  header and index {overhead:>42,} {'':>12} {overhead / info['size_bytes']:>6.1%}"]


def _space_line(space: Mapping[str, Any]) -> list[str]:
    """Return the line on the mapping of space; none for a box."""
    if space["mapping"] == "box":
        return []
    if space["mapping"] == "ndc":
        parameters = f"near {space['near']:.4g}, baseline {space['baseline']:.4g}"
        return [f"  space       normalised device coordinates, as is the box; {parameters}"]
    parameters = f"uniform steps up to {space['uniform_distance']:.4g}, rays end at {space['far']:.4g}"
    return [f"  space       contracted beyond the box; {parameters}"]


def _motion_line(motion: Mapping[str, Any] | None) -> list[str]:
    if motion is None:
        return []
    nodes = "x".join(map(str, reversed(motion["nodes_zyx"])))
    largest = f"displacements up to {motion['max_displacement']:.3f} of the box"
    return [f"  motion      {motion['rows']} x {nodes} nodes, {largest}"]


def _appearances_line(names: Sequence[str]) -> list[str]:
    """Return the line on appearances, with the first few names; none without any."""
    if not names:
        return []
    return [f"  appearances {len(names)}: {', '.join(names[:NAMES_SHOWN])}" + ", ..." * (len(names) > NAMES_SHOWN)]


def _corner(point: Sequence[float]) -> str:
    return f"({', '.join(f'{x:.4g}' for x in point)})"


if __name__ == "__main__":
    sys.exit(main())
