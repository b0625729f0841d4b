"""kpedit: change a .kpc file without training again.

    kpedit in.kpc -o out.kpc --title "A dancer" --author "A. Author" --licence CC-BY-4.0
    kpedit in.kpc -o out.kpc --view-limits auto        from where the scene holds, and the view that it opens with
    kpedit in.kpc -o out.kpc --view-limits azimuth=-30:30,distance=1:4
    kpedit in.kpc -o out.kpc --open-at view.json       a camera path or camera file; its first view opens the scene
    kpedit in.kpc -o out.kpc --provenance made.json    members of the provenance, for files that do not say
    kpedit in.kpc -o out.kpc --no-provenance           leave out how the file was made
    kpedit in.kpc -o out.kpc --from 1.5s --to 4s       a part of the clip
    kpedit in.kpc -o out.kpc --layer moving            what moves, or what stays
    kpedit in.kpc -o out.kpc --box -1,-1,0,1,1,2       what lies in a box
    kpedit in.kpc -o out.kpc --scale 0.01 --turn x:-90 --move 0,1,0
    kpedit in.kpc -o out.kpc --speed 0.5               half as fast; --fps 60 for more frames at the same speed

What does not change is copied byte for byte.
"""

import argparse
import json
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np

from kpc.format.common import cli
from kpc.format.common.errors import UsageError
from kpc.format.common.text import counted, escaped, first_names, notice
from kpc.format.common.version import VERSION
from kpc.format.container.clip_sound import has_sound
from kpc.format.container.groups import Groups, load
from kpc.format.container.metadata_chunk import META_LIMIT
from kpc.format.container.metadata_options import (
    ROUNDING,
    add_metadata_options,
    members_from,
    opening_beyond_limits,
    with_view_limits,
)
from kpc.format.container.rewriting import save, with_metadata
from kpc.format.scene.cameras import Camera, load_views
from kpc.format.scene.metadata import HISTORY_LIMIT, Metadata, camera_document
from kpc.format.scene.view_limits import find_view, view_members
from kpc.player.cpu import reference
from kpc.tools.editing.clips import Edits, edit
from kpc.tools.editing.cropping import holds_all
from kpc.tools.editing.layers import Layer
from kpc.tools.editing.placing import Placement, axis_turn
from kpc.tools.editing.timing import MAX_FPS, MIN_FPS


def main(argv: list[str] | None = None) -> int:
    """Run the command and return its exit code."""
    return cli.run(_command, "kpedit", argv)


def _command(argv: list[str]) -> None:
    options = _parser().parse_args(cli.join_values(argv, "--box", "--move", "--up"))
    cli.refuse_sources(options.output, options.scene)
    cli.check_writable(options.output)
    groups = Groups(options.scene)
    _drop_idle(options, groups)
    edits = _edits_from(options)
    if groups.clip.frame_count == 1 and (edits.speed is not None or edits.fps is not None):
        raise UsageError("--fps, --speed: the scene is static; it has no frames to show at another rate")
    if edits.speed is not None and has_sound(groups):
        notice("kpedit: the sound is left out, since it belongs to the speed of the source")
    size, kept_s = _write(options, groups, edits)
    if kept_s == (0.0, groups.clip.duration_s):
        notice("kpedit: --from, --to: widened to where the clip can be cut, it is kept as a whole")
        options.start = options.end = None
        size, kept_s = _write(options, groups, replace(edits, part_s=None))
    is_part = kept_s is not None or options.layer is not None or options.box is not None
    if is_part and size > options.scene.stat().st_size and _plane_bytes(Groups(options.output)) > _plane_bytes(groups):
        notice(
            "kpedit: larger than the source, since texels are predicted from less; kpenc makes it smaller, at a loss"
        )
    print(escaped(f"{options.output}: {size:,} bytes{_changed_time(options, kept_s)}"))


def _write(options: argparse.Namespace, groups: Groups, edits: Edits) -> tuple[int, tuple[float, float] | None]:
    """Write the edited file; return as `edit` does its size and which part is kept."""
    metadata = _edited_metadata(groups.metadata(), options, edits.placement)
    if edits.any:
        return edit(options.scene, options.output, edits, metadata)
    if metadata.document == groups.metadata().document:
        notice("kpedit: there is nothing to change; the output is a copy of the source")
        return save(options.scene.read_bytes(), options.output), None
    return save(with_metadata(options.scene, metadata), options.output), None


def _parser() -> argparse.ArgumentParser:
    parser = cli.Parser(prog="kpedit", description="Change a .kpc file without training again.")
    cli.add_version_option(parser)
    parser.add_argument("scene", type=cli.input_path, help="a .kpc file")
    parser.add_argument(
        "-o", "--output", type=cli.output_file(".kpc"), required=True, metavar="FILE", help="the .kpc file to write"
    )
    add_metadata_options(parser)
    parser.add_argument(
        "--open-at",
        type=cli.named_path,
        metavar="JSON",
        help="open with the first view of a saved camera path or camera file",
    )
    parser.add_argument("--up", type=_direction, metavar="X,Y,Z", help="which direction is up in the new file")
    parser.add_argument("--metres-per-unit", type=_length, metavar="M", help="length of a unit in the new file")
    transparent = parser.add_mutually_exclusive_group()
    for option, value, what in (("--transparent", True, "is"), ("--no-transparent", False, "is not")):
        text = f"the scene {what} meant to be laid over other pictures"
        transparent.add_argument(option, action="store_const", const=value, dest="transparent", help=text)
    provenance = parser.add_mutually_exclusive_group()
    provenance.add_argument(
        "--provenance",
        type=cli.named_path,
        metavar="JSON",
        help="a file with members of the provenance, for scenes that do not hold their own",
    )
    provenance.add_argument("--no-provenance", action="store_true", help="leave out how the file was made")
    _add_edits(parser)
    return parser


def _add_edits(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--from", dest="start", type=cli.time_s, metavar="1.5s", help="keep the clip from then on (default: its start)"
    )
    parser.add_argument("--to", dest="end", type=cli.time_s, metavar="4s", help="keep the clip until then")
    parser.add_argument(
        "--layer",
        choices=get_args(Layer),
        help="keep what moves, or what stays, by the cells in which it is at each time",
    )
    parser.add_argument(
        "--box",
        type=cli.box_corners,
        metavar="x0,y0,z0,x1,y1,z1",
        help="keep what lies in the cells that this box touches",
    )
    parser.add_argument(
        "--scale", type=_length, metavar="F", help="multiply all lengths, before the scene is turned and moved"
    )
    parser.add_argument(
        "--turn",
        type=_turn,
        action="append",
        metavar="AXIS:DEGREES",
        help="turn around an axis of the world, x, y or z, counter-clockwise seen from its tip; may be given again",
    )
    parser.add_argument("--move", type=_vector, metavar="X,Y,Z", help="move, after scaling and turning")
    parser.add_argument("--speed", type=_speed, metavar="F", help="play F times as fast: same frames, no sound")
    parser.add_argument(
        "--fps",
        type=cli.frame_rate(MIN_FPS, MAX_FPS),
        metavar="F",
        help="frames per second, at the same speed; the last frame, too, then lasts 1 / F s",
    )


def _plane_bytes(clip: Groups) -> int:
    """Return the bytes of the chunks that hold texels."""
    indices = [clip.open(number).index for number in range(len(clip))]
    return sum(entry.stored_length for index in indices for entry in index if entry.kind == "PLNE")


def _changed_time(options: argparse.Namespace, kept_s: tuple[float, float] | None) -> str:
    """Return, in words, which part of the clip was kept, and how long the result is; nothing if its time is as before.

    Args:
        options: of the command line.
        kept_s: from when to when the result is of the source, seconds; None for all of it.
    """
    if (kept_s, options.speed, options.fps) == (None, None, None):
        return ""
    result = Groups(options.output)
    is_widened = not Groups(options.scene).is_single
    part = "" if kept_s is None else f", {kept_s[0]:.3f} to {kept_s[1]:.3f} s of the clip"
    part += " (whole groups are kept)" if kept_s is not None and is_widened else ""
    frames = counted(result.clip.frame_count, "frame")
    return f"{part}, {frames} at {result.clip.fps:g} fps, {result.clip.total_s:.2f} s"


def _edits_from(options: argparse.Namespace) -> Edits:
    part_s = None
    if options.start is not None or options.end is not None:
        part_s = options.start or 0.0, math.inf if options.end is None else options.end
    placement = None
    if options.scale is not None or options.turn or options.move is not None:
        placement = Placement(_turn_of(options), options.scale or 1.0, np.array(options.move or (0.0, 0.0, 0.0)))
    box = None if options.box is None else np.reshape(options.box, (2, 3))
    return Edits(part_s, options.layer, box, placement, options.speed, options.fps)


def _turn_of(options: argparse.Namespace) -> np.ndarray:
    """Return the rotation of all --turn, one after the other, (3, 3)."""
    turn = np.eye(3)
    for axis, degrees in options.turn or ():
        turn = axis_turn(axis, degrees) @ turn
    return turn


def _drop_idle(options: argparse.Namespace, groups: Groups) -> None:
    """Set options that change nothing to None, so that they leave no figures out and no line in the history."""
    clip = groups.clip
    if options.start == 0:
        options.start = None
    if options.end is not None and clip.duration_s <= options.end <= clip.total_s + cli.TIME_SLACK_S:
        options.end = None
    if options.box is not None and holds_all(groups, np.reshape(options.box, (2, 3))):
        options.box = None
    if options.scale == 1:
        options.scale = None
    if np.allclose(_turn_of(options), np.eye(3), rtol=0, atol=1e-12):
        options.turn = None
    if options.move is not None and not any(options.move):
        options.move = None
    if options.speed == 1:
        options.speed = None
    if options.fps == clip.fps and clip.frame_count > 1 and options.speed is None:
        options.fps = None


def _history(options: argparse.Namespace) -> list[str]:
    """Return what is done with the scene, in words for the history of the file."""
    given = {"from": options.start, "to": options.end, "layer": options.layer, "box": options.box,
             "scale": options.scale, "turn": options.turn, "move": options.move, "speed": options.speed,
             "fps": options.fps}  # fmt: skip
    words = [f"{name} {_in_words(value)}" for name, value in given.items() if value is not None]
    return [f"edited by kpc {VERSION}: {', '.join(words)}"[:256]] if words else []


def _in_words(value: Any) -> str:
    """Return an option's value in the form of the command line."""
    if isinstance(value, list) and value and isinstance(value[0], tuple):  # turns
        return " ".join(f"{axis}:{degrees:g}" for axis, degrees in value)
    if isinstance(value, Sequence | np.ndarray) and not isinstance(value, str):
        return ",".join(f"{float(number):g}" for number in value)
    return f"{value:g}" if isinstance(value, float) else str(value)


def _edited_metadata(metadata: Metadata, options: argparse.Namespace, placement: Placement | None) -> Metadata:
    """Return the metadata as the options ask, before the scene is placed.

    `--up` and `--metres-per-unit` are meant for the scene where it is put, so they are taken back from there.
    """
    members = members_from(options)
    if options.up is not None:
        up = np.array(options.up, float)
        members["up"] = (up if placement is None else up @ placement.turn).tolist()
    if options.metres_per_unit is not None:
        members["metres_per_unit"] = options.metres_per_unit * (1.0 if placement is None else placement.factor)
    if options.transparent is not None:
        members["transparent"] = options.transparent or None
    is_upright = _has_direction(metadata.up, members.get("up"))
    if is_upright:
        members.pop("up", None)  # it stays as it was written
    metadata = _with_limits(metadata.with_members(**members), options, is_upright)
    if options.open_at is not None:
        view = load_views(options.open_at)[0]
        metadata = metadata.with_members(opening={"camera": camera_document(view.camera), "time": view.time})
    if options.open_at is not None or options.view_limits is not None:
        if (outside := opening_beyond_limits(metadata)) is not None:
            notice(f"kpedit: {outside}; --open-at sets another")
    if any(given is not None for given in (options.start, options.end, options.layer, options.box)):
        metadata = metadata.with_provenance(held_out=None, coding_loss_db=None)  # measured on the whole
    if options.provenance is not None:
        metadata = metadata.with_provenance(**_provenance_for(metadata, options))
    if step := _history(options):
        history = [*metadata.provenance.get("history", []), *step]
        metadata = metadata.with_provenance(history=history[-HISTORY_LIMIT:])
    if options.no_provenance:
        return metadata.with_members(provenance=None)
    return metadata


def _has_direction(up: np.ndarray | None, wanted: Sequence[float] | None) -> bool:
    """Return whether a unit vector `up` has the direction that is wanted; True where none is."""
    if up is None or wanted is None:
        return wanted is None
    return bool(np.linalg.norm(up - np.array(wanted) / np.linalg.norm(wanted)) < ROUNDING)


def _with_limits(metadata: Metadata, options: argparse.Namespace, is_upright: bool) -> Metadata:
    """Return metadata with the view limits that the options ask for.

    Limits are angles about `up`: where that changes, those of the file are found again, or left out.

    Args:
        metadata: with the new `up`.
        options: of the command line.
        is_upright: whether `up` is what it was.

    Raises:
        UsageError: limits are asked for, and none are found.
    """
    wanted = options.view_limits
    is_lost = not is_upright and "view_limits" in metadata.document
    if wanted == "none" or (wanted is None and not is_lost):
        return metadata if wanted is None else with_view_limits(metadata, wanted)
    if wanted is None:
        limits = _found_view(metadata, options.scene).get("view_limits")
        what = "none are found about the new one: they are left out" if limits is None else "they are found again"
        notice(f"kpedit: --up: the view limits were angles about the former up, and {what}")
        return metadata.with_members(view_limits=limits)
    if wanted == "auto" or is_lost or "view_limits" not in metadata.document:
        found = _found_view(metadata, options.scene)
        if "view_limits" not in found:
            raise UsageError(
                f"{options.scene}: no view limits are found: they need three cameras that look at one place and see "
                "what the first of them sees; give --view-limits none"
            )
        metadata = metadata.with_members(**found)
    return metadata if wanted == "auto" else with_view_limits(metadata, wanted)


def _found_view(metadata: Metadata, path: Path) -> Mapping[str, Any]:
    """Return an opening view, limits about the `up` of the metadata, and up where these have none, as members.

    They are found from what the cameras of the scene see; there are no limits where these do not look at one place.
    """
    scene, time = load(path).at(0.5)
    scene = replace(scene, metadata=metadata)

    def look(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        seen = reference.render_rays(scene, *camera.rays(), time)
        return seen.depth, seen.opacity

    found = view_members(scene, *find_view(scene, look))
    return {name: value for name, value in found.items() if name != "up" or "up" not in metadata.document}


def _provenance_for(metadata: Metadata, options: argparse.Namespace) -> dict[str, Any]:
    """Return the members that --provenance names, for a scene that holds no more than a history.

    Raises:
        UsageError: the scene holds its own, or it is no JSON object.
    """
    given = _json_object(options.provenance)
    own = [name for name in metadata.provenance if name != "history" or name in given]
    if own:
        raise UsageError(
            f"--provenance: {options.scene} holds its own ({first_names(own)}); leave the option out, or take away "
            "what the file holds by kpedit --no-provenance first"
        )
    return given


def _json_object(path: Path) -> dict[str, Any]:
    """Read a JSON object of at most META_LIMIT bytes; what it holds is checked when it is written."""
    with path.open("rb") as opened:
        content = opened.read(META_LIMIT + 1)
    try:
        document = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise UsageError(f'{path}: not JSON; write an object such as {{"preset": "fast"}}') from error
    if not isinstance(document, dict):
        raise UsageError(f'{path}: no JSON object; write one such as {{"preset": "fast"}}')
    return document


def _vector(text: str) -> tuple[float, float, float]:
    try:
        x, y, z = (cli.number_within(number, -1e9, 1e9) for number in text.split(","))
    except (ValueError, argparse.ArgumentTypeError):
        raise argparse.ArgumentTypeError(f"{text!r} is not three numbers from -1e9 to 1e9 such as 0,0,1") from None
    return x, y, z


def _turn(text: str) -> tuple[str, float]:
    axis, colon, degrees = text.partition(":")
    if axis not in ("x", "y", "z") or not colon:
        raise argparse.ArgumentTypeError(f"{text!r} is not a turn such as x:-90")
    return axis, cli.number_within(degrees, -360, 360)


def _speed(text: str) -> float:
    return cli.number_within(text, 0.001, 1000)


def _direction(text: str) -> tuple[float, ...]:
    numbers = _vector(text)
    if not np.linalg.norm(numbers) > 1e-6:
        raise argparse.ArgumentTypeError(f"{text!r} is not a direction such as 0,0,1")
    return numbers


def _length(text: str) -> float:
    return cli.number_within(text, 1e-9, 1e9)


if __name__ == "__main__":
    sys.exit(main())
