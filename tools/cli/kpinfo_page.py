"""What kpinfo says about .kpc files, as text of 80 columns."""

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

from kpc.format.common.text import counted, first_names, one_line
from kpc.format.container.http_address import printable
from kpc.format.scene.metadata import Metadata
from kpc.format.scene.scene import TIME_PLANES
from kpc.player.cpu.motion_map import STILL
from kpc.tools.cli.kpinfo_metadata import metadata_rows

WIDTH = 80


def page(info: Mapping[str, Any]) -> str:
    """Return the page about one file: its scene where that is described, else its groups."""
    described = next((group for group in info["groups"] if group["scene"] is not None), None)
    first = f"{_sizes(info)}, format version {info['version']}" + ", verified" * info["verified"]
    name = one_line(info["file"])
    lines = [f"{name}:", f"  {first}"] if len(name) + len(first) > WIDTH - 2 else [f"{name}: {first}"]
    sizes = described["scene"]["camera_sizes"] if described else []
    for label, text in metadata_rows(Metadata(info["metadata"] or {}), sizes):
        lines += _item(label, printable(text))
    if described is None:
        lines += _item("clip", _clip(info)) + _sound(info["groups"])
        lines += _item("cameras", "not known" if info["cameras"] is None else str(info["cameras"]))
        lines += _appearances_line(info["appearances"])
        return "\n".join([*lines, *_groups(info), *_shared_planes(info["shared_planes"])])
    if len(info["groups"]) > 1:
        since, until = described["shown_s"]
        frames = "frames {}-{}".format(*described["frames"])
        lines += _item("clip", _clip(info))
        lines += _item(f"group {described['number']}", f"{frames}, shown from {since:.2f} to {until:.2f} s")
    else:
        lines += _item("clip", _clip(info))
    lines += _sound([described])
    scene = described["scene"]
    whole = info["expected_bytes"] if len(info["groups"]) == 1 else described["stored_bytes"]
    whole += sum(chunk["stored_bytes"] for chunk in scene["chunks"] if chunk["shared_chunk"] is not None)
    return "\n".join([*lines, *_scene_lines(scene), "", *_chunk_lines(scene, whole)])


def table(files: Sequence[Mapping[str, Any]], totals: Mapping[str, Any]) -> str:
    """Return a table of several files with their totals."""
    lines = [f"{'bytes':>15}  {'frames':>7}  {'fps':>6}  {'duration':>11}  {'groups':>6}  file"]
    for info in files:
        size, clip = info["size_bytes"], info["clip"]
        columns = [f"{'-' if size is None else f'{size:,}':>15}"]
        columns += (
            ["      -       -            -       -"]
            if clip is None
            else [_columns(clip, f"{clip['fps']:g}", len(info["groups"]))]
        )
        is_cut = clip is not None and size < info["expected_bytes"]
        state = "  (not read)" if clip is None else "  (damaged)" if info["error"] else ""
        state = f"  (cut off from {info['expected_bytes']:,})" if is_cut else state
        lines.append("  ".join([*columns, one_line(info["file"]) + state]))
    verified = ", all verified" if all(info["verified"] for info in files) else ""
    failed = f", {totals['failed']} failed" if totals["failed"] else ""
    columns = [f"{totals['size_bytes']:>15,}", _columns(totals, "", totals["groups"])]
    return "\n".join([*lines, "  ".join([*columns, f"{counted(totals['files'], 'file')}{verified}{failed}"])])


def _columns(clip: Mapping[str, Any], fps: str, groups: int) -> str:
    return f"{clip['frame_count']:>7,}  {fps:>6}  {clip['duration_s']:>9,.2f} s  {groups:>6,}"


def _item(label: str, text: str) -> list[str]:
    """Return a line that begins with a label, wrapped if it is long."""
    indent = " " * 14
    return textwrap.wrap(
        text,
        WIDTH,
        initial_indent=f"  {label:<11} ",
        subsequent_indent=indent,
        break_long_words=False,
        break_on_hyphens=False,
    )


def _sizes(info: Mapping[str, Any]) -> str:
    size, expected = info["size_bytes"], info["expected_bytes"]
    return f"{size:,} bytes" if size == expected else f"cut off at {size:,} of {expected:,} bytes"


def _clip(info: Mapping[str, Any]) -> str:
    clip, groups = info["clip"], len(info["groups"])
    parts = [counted(clip["frame_count"], "frame")]
    if clip["frame_count"] > 1:
        parts = [f"{parts[0]} at {clip['fps']:g} fps", f"{clip['duration_s']:.2f} s"]
    parts.append(f"in {counted(groups, 'group')}" if groups > 1 else "dynamic" if clip["is_dynamic"] else "static")
    return ", ".join(parts)


def _sound(groups: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return a line about the sound of some groups; none if they are silent."""
    sounds = [group["sound"] for group in groups if group["sound"] is not None]
    if not sounds:
        return []
    # Groups share frames, of whose sound that of one is heard.
    length = "heard_s" if len(groups) > 1 else "duration_s"
    size, duration_s = (sum(sound[name] for sound in sounds) for name in ("stored_bytes", length))
    kind = "mono" if all(sound["channels"] == 1 for sound in sounds) else "stereo"
    some = f", in {len(sounds)} of {len(groups)} groups" if len(sounds) < len(groups) else ""
    text = f"Opus, {kind}, {duration_s:.2f} s{some}, {size:,} bytes, {size / max(duration_s, 1e-3):,.0f} a second"
    return _item("sound", text)


def _groups(info: Mapping[str, Any]) -> list[str]:
    lines = ["", "  group       frames          shown, s       stored   scales       values"]
    unread = "missing" if info["size_bytes"] < info["expected_bytes"] else "damaged"
    for group in info["groups"]:
        (first, last), (since, until) = group["frames"], group["shown_s"]
        model = f"{group['scale_count']:>7}  {group['value_count']:>11,}" if group["is_complete"] else unread
        lines.append(
            f"  {group['number']:>5}  {first:>6}-{last:<6}  {since:>8.2f}-{until:<8.2f}  "
            f"{group['stored_bytes']:>9,}  {model}"
        )
    return lines


def _shared_planes(planes: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return a table of the planes that groups share; nothing without any."""
    lines = ["", "  chunk  shared plane  codec          stored  in groups"] if planes else []
    for plane in planes:
        users = f"{plane['group_count']}, from {plane['first_group']} on" if plane["group_count"] else "none"
        lines.append(
            f"  {plane['chunk']:>5}  {'scale ' + str(plane['scale']):<9} {plane['plane']}  {plane['codec']:<10} "
            f"{plane['stored_bytes']:>10,}  {'missing' if plane['missing'] else users}"
        )
    return lines


def _scene_lines(scene: Mapping[str, Any]) -> list[str]:
    occupancy, decoder = scene["occupancy"], scene["decoder"]
    cameras = str(scene["cameras"])
    if scene["cameras"]:
        cameras += f" within {_corner(scene['camera_box'][0])} to {_corner(scene['camera_box'][1])}"
    cells = "x".join(map(str, reversed(occupancy["cells_zyx"])))
    units = counted(decoder["hidden"], "hidden unit")
    corners = f"{_corner(scene['aabb'][0])} to {_corner(scene['aabb'][1])}"
    lines = [
        *_item("box", corners),
        *_item("ray step", f"{scene['step']:.4g}"),
        *_space_line(scene["space"]),
        *_motion_line(scene["motion"]),
        *_item("cameras", cameras),
        *_appearances_line(scene["appearances"]),
        *_item("occupancy", f"{occupancy['slots']} x {cells} cells, {occupancy['share']:.1%} occupied"),
        *_item("decoder", f"{decoder['kind']}, {counted(decoder['features'], 'feature')}, {units}"),
    ]
    for number, scale in enumerate(scene["scales"]):
        sizes = {name: f"{name} {plane['columns']}x{plane['rows']}" for name, plane in scale["planes"].items()}
        space = ", ".join(size for name, size in sizes.items() if name not in TIME_PLANES)
        time = ", ".join(size for name, size in sizes.items() if name in TIME_PLANES)
        lines += _item(f"scale {number}", f"{counted(scale['channels'], 'channel')}; {space}" + ";" * bool(time))
        lines += _item("", time) if time else []
    bits = f"{scene['bits_per_parameter']:.3f} bits each"
    lines += _item("model", f"{counted(scene['parameter_count'], 'parameter')}, {bits}")
    return lines + _share_lines(scene)


def _share_lines(scene: Mapping[str, Any]) -> list[str]:
    """Return the lines on shares of the whole scene, or the one that says why there are none."""
    if scene["missing_chunks"]:
        gone = f"{scene['missing_chunks']} of {counted(len(scene['chunks']), 'chunk')}"
        return _item("missing", f"{gone}; what is coded and what moves is not known")
    static = scene["static"]
    return [
        *_item("identity", f"{scene['identity_share']:.1%} of the time-plane texels are exactly 1"),
        *_item("static", f"{static['identity_share']:.1%} of the occupied space-time has time planes of 1;"),
        *_item("", f"{static['constant_share']:.1%} of the occupied space never changes,"),
        *_item("", f"about {static['motionless_share']:.0%} by less than {STILL:g} of white and of full opacity"),
        *_item("not coded", f"{scene['uncoded_share']:.1%} of the space-plane texels are not stored"),
    ]


def _chunk_lines(scene: Mapping[str, Any], size: int) -> list[str]:
    lines = ["  chunk  kind  scale plane       rows  codec          stored         raw   share"]
    for number, chunk in enumerate(scene["chunks"]):
        plane = f"{'-':>5} {'-':<5}  {'-':>9}"
        if chunk["plane"] is not None:
            rows = "{}-{}".format(*chunk["rows"])
            plane = f"{chunk['scale']:>5} {chunk['plane']:<5}  {rows:>9}"
        share = "missing" if chunk["missing"] else f"{chunk['share']:.1%}"
        codec = chunk["codec"] if chunk["shared_chunk"] is None else "SHARED"
        lines.append(
            f"  {number:>5}  {chunk['kind']}  {plane}  {codec:<10} "
            f"{chunk['stored_bytes']:>10,}  {chunk['raw_bytes']:>10,} {share:>7}"
        )
    overhead = scene["overhead_bytes"]
    return [*lines, f"  {'header and index':<42} {overhead:>10,} {overhead / size:>18.1%}"]


def _space_line(space: Mapping[str, Any]) -> list[str]:
    """Return the line on the mapping of space; none for a box."""
    if space["mapping"] == "box":
        return []
    if space["mapping"] == "ndc":
        parameters = f"near {space['near']:.4g}, baseline {space['baseline']:.4g}"
        return _item("space", f"normalised device coordinates, as is the box; {parameters}")
    parameters = f"uniform steps up to {space['uniform_distance']:.4g}, rays end at {space['far']:.4g}"
    return _item("space", f"contracted beyond the box; {parameters}")


def _motion_line(motion: Mapping[str, Any] | None) -> list[str]:
    if motion is None:
        return []
    nodes = "x".join(map(str, reversed(motion["nodes_zyx"])))
    largest = f"displacements up to {motion['max_displacement']:.3f} of the box"
    return _item("motion", f"{motion['rows']} x {nodes} nodes, {largest}")


def _appearances_line(names: Sequence[str]) -> list[str]:
    """Return the line on appearances, with the first few names; none without any."""
    if not names:
        return []
    return _item("appearances", f"{len(names)}: {first_names(names, '--json')}")


def _corner(point: Sequence[float]) -> str:
    return f"({', '.join(f'{x:.4g}' for x in point)})"
