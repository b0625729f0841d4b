"""kpedit: change a .kpc file without training again.

    kpedit in.kpc -o out.kpc --title "A dancer" --author "A. Author" --licence CC-BY-4.0
    kpedit in.kpc -o out.kpc --view-limits auto        from where the scene holds, and the view that it opens with
    kpedit in.kpc -o out.kpc --view-limits azimuth=-30:30,distance=1:4
    kpedit in.kpc -o out.kpc --open-at view.json       a camera path or camera file; its first view opens the scene
    kpedit in.kpc -o out.kpc --provenance made.json    members of the provenance, for files that do not say
    kpedit in.kpc -o out.kpc --no-provenance           leave out how the file was made

What does not change is copied byte for byte.
"""

import argparse
import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from kpc.format.common import cli
from kpc.format.common.errors import UsageError
from kpc.format.container.groups import Groups, load
from kpc.format.container.metadata_chunk import META_LIMIT
from kpc.format.container.metadata_options import add_metadata_options, members_from, with_view_limits
from kpc.format.container.rewriting import with_metadata
from kpc.format.scene.cameras import Camera, load_views
from kpc.format.scene.metadata import Metadata, camera_document
from kpc.format.scene.view_limits import find_view, view_members
from kpc.player.cpu import reference


def main(argv: list[str] | None = None) -> int:
    """Run the command and return its exit code."""
    return cli.run(_command, "kpedit", argv)


def _command(argv: list[str]) -> None:
    options = _parser().parse_args(argv)
    if options.output.exists() and options.output.samefile(options.scene):
        raise UsageError(f"{options.output}: is the input, too; choose another output with -o")
    metadata = _edited_metadata(Groups(options.scene).metadata(), options)
    data = with_metadata(options.scene, metadata)
    with cli.atomic_write(options.output) as aside:
        aside.write_bytes(data)
    print(f"{options.output}: {len(data):,} bytes")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="kpedit", description="Change a .kpc file without training again.")
    cli.add_version_option(parser)
    parser.add_argument("scene", type=Path, help="a .kpc file")
    parser.add_argument(
        "-o", "--output", type=cli.output_file(".kpc"), required=True, metavar="FILE", help="the .kpc file to write"
    )
    add_metadata_options(parser)
    parser.add_argument(
        "--open-at", type=Path, metavar="JSON", help="open with the first view of a saved camera path or camera file"
    )
    parser.add_argument("--up", type=_direction, metavar="X,Y,Z", help="which direction is up in the world")
    parser.add_argument("--metres-per-unit", type=_length, metavar="M", help="length of a unit of the world")
    parser.add_argument(
        "--transparent",
        action=argparse.BooleanOptionalAction,
        default=None,
        help="the scene is, or is not, meant to be laid over other pictures",
    )
    parser.add_argument(
        "--provenance",
        type=Path,
        metavar="JSON",
        help="a file with members of the provenance, for scenes that do not hold their own",
    )
    parser.add_argument("--no-provenance", action="store_true", help="leave out how the file was made")
    return parser


def _edited_metadata(metadata: Metadata, options: argparse.Namespace) -> Metadata:
    """Return the metadata as the options ask."""
    members: dict[str, Any] = {name: text or None for name, text in members_from(options).items()}
    if options.up is not None:
        members["up"] = list(options.up)
    if options.metres_per_unit is not None:
        members["metres_per_unit"] = options.metres_per_unit
    if options.transparent is not None:
        members["transparent"] = options.transparent or None
    metadata = metadata.with_members(**members)
    if options.view_limits is not None:
        is_found = options.view_limits != "none" and (
            options.view_limits == "auto" or "view_limits" not in metadata.document
        )
        metadata = _with_found_view(metadata, options.scene) if is_found else metadata
        if options.view_limits != "auto":
            metadata = with_view_limits(metadata, options.view_limits)
    if options.open_at is not None:
        view = load_views(options.open_at)[0]
        metadata = metadata.with_members(opening={"camera": camera_document(view.camera), "time": view.time})
    if options.provenance is not None:
        metadata = metadata.with_provenance(**_json_object(options.provenance))
    if options.no_provenance:
        return metadata.with_members(provenance=None)
    return metadata


def _with_found_view(metadata: Metadata, path: Path) -> Metadata:
    """Return the metadata with an opening view, limits and up found from what the cameras of the scene see.

    Raises:
        UsageError: too few cameras are known, or they do not look at one place.
    """
    scene, time = load(path).at(0.5)

    def look(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        seen = reference.render_rays(scene, *camera.rays(), time)
        return seen.depth, seen.opacity

    found: Mapping[str, Any] = view_members(scene, *find_view(scene, look))
    if "view_limits" not in found:
        raise UsageError(
            f"{path}: no view limits are found: they need three cameras that look at one place and see what the first "
            "of them sees; give --view-limits none"
        )
    return metadata.with_members(**found)


def _json_object(path: Path) -> dict[str, Any]:
    """Read a JSON object of at most META_LIMIT bytes; what it holds is checked when it is written."""
    with path.open("rb") as opened:
        content = opened.read(META_LIMIT + 1)
    try:
        document = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise UsageError(f"{path}: not JSON; write an object such as {{'preset': 'fast'}}") from error
    if not isinstance(document, dict):
        raise UsageError(f"{path}: no JSON object; write one such as {{'preset': 'fast'}}")
    return document


def _direction(text: str) -> tuple[float, ...]:
    numbers = tuple(cli.number_within(number, -1e9, 1e9) for number in text.split(","))
    if len(numbers) != 3 or not np.linalg.norm(numbers) > 1e-6:
        raise argparse.ArgumentTypeError(f"{text!r} is not a direction such as 0,0,1")
    return numbers


def _length(text: str) -> float:
    return cli.number_within(text, 1e-9, 1e9)


if __name__ == "__main__":
    sys.exit(main())
