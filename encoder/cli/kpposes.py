"""kpposes: find the cameras of a folder of videos, and bring the videos in step.

    kpposes videos/ -o transforms.json                   cameras and clocks, in the layout of nerfstudio
    kpposes videos/ --distance cam00,cam05=1.2           in metres: these two cameras are 1.2 m apart
    kpposes videos/ --sync motion --require-all          by what moves, and no camera may be missing

`kpenc videos/` does this by itself where a folder has no poses.
"""

import argparse
import json
import sys
from pathlib import Path

from kpc.encoder.datasets.layouts.nerfstudio import MADE_BY
from kpc.encoder.datasets.layouts.nerfstudio import NAME as NERFSTUDIO
from kpc.encoder.datasets.loading import layouts_of
from kpc.encoder.evaluation.camera_page import check_page
from kpc.encoder.poses.document import write_document
from kpc.encoder.poses.facts import camera_table, lens_text
from kpc.encoder.poses.find import Found, find_poses
from kpc.encoder.poses.page import NAME, write_page
from kpc.encoder.poses.wishes import add_pose_options, wishes_from
from kpc.format.common import cli
from kpc.format.common.errors import UsageError
from kpc.format.common.text import escaped, notice


def main(argv: list[str] | None = None) -> int:
    """Run the command and return its exit code."""
    return cli.run(_command, "kpposes", argv)


def _command(argv: list[str]) -> None:
    options = _parser().parse_args(argv)
    if not options.folder.is_dir():
        problem = "is a file, not a folder" if options.folder.exists() else "no such folder"
        raise UsageError(
            f"{options.folder}: {problem}; give a folder of videos, of folders of frames, or of photographs"
        )
    file = options.output or options.folder / "transforms.json"
    cli.check_writable(file)
    _refuse_other_document(file)
    page = file.with_name(NAME if file.name == "transforms.json" else f"{file.stem}.{NAME}")
    check_page(page)
    found = find_poses(options.folder, wishes_from(options))
    write_document(found, options.folder, file)
    _say_if_not_read(found, options.folder, file)
    write_page(found, f"Cameras of {options.folder.resolve().name}", page)
    print(report(found))
    print(escaped(f"{page}: where the cameras stand, and what they see"))
    print(escaped(f"{file}: {len(found.structure.views)} of {len(found.view_names)} placed"))


def _parser() -> argparse.ArgumentParser:
    parser = cli.Parser(
        prog="kpposes", description="Find the cameras of a folder of videos, and bring the videos in step."
    )
    cli.add_version_option(parser)
    parser.add_argument(
        "folder",
        type=cli.named_path,
        metavar="videos",
        help="a folder of videos, of folders of frames, or of photographs",
    )
    parser.add_argument(
        "-o",
        "--output",
        type=cli.output_file(".json"),
        metavar="JSON",
        help="default: transforms.json in the folder; only a document of kpposes is replaced",
    )
    add_pose_options(parser)
    return parser


def _refuse_other_document(file: Path) -> None:
    """Refuse to replace a document of someone else, cameras or clocks that were given; name one that is replaced."""
    if not file.exists():
        return
    try:
        document = json.loads(file.read_text(encoding="utf-8"))
    except ValueError:
        document = None
    if not isinstance(document, dict) or document.get("made_by") != MADE_BY:
        raise UsageError(f"{file}: is not a document of kpposes and stays; move it, or choose another name with -o")
    notice(f"replaces {file}, with any edits in it, once the cameras are found")


def _say_if_not_read(found: Found, folder: Path, file: Path) -> None:
    """Say where kpenc reads the document, or that it reads other poses of the folder."""
    layouts = layouts_of(folder) if file.resolve() == folder.resolve() / "transforms.json" else []
    read = (file.parent if found.writes_frames else folder) / "transforms.json"
    if file.resolve() != read.resolve():
        notice(f"{file}: kpenc reads these cameras once the file is {read}")
    if layouts and layouts[0].NAME != NERFSTUDIO:
        notice(
            f"{file}: warning: kpenc reads the folder in the layout of {layouts[0].NAME}, and not this file; to use "
            "these cameras, move the poses of that layout out of the folder"
        )


def report(found: Found) -> str:
    """Return a table of the cameras, with clock, points and error, or a line about their pictures, as text."""
    if found.kind in ("moving camera", "photographs"):
        views = list(found.structure.views.values())
        points = sorted(view.points for view in views)[len(views) // 2]
        lenses = {lens_text(view): view.is_fisheye for view in views}
        fisheyes = sum(lenses.values())
        kinds = f", {fisheyes} of them fisheye" if fisheyes else ""
        focal = f"focal length {next(iter(lenses))}" if len(lenses) == 1 else f"{len(lenses)} lenses{kinds}"
        return f"{len(views)} pictures, error {found.structure.error:.2f} px, {points} points in each, {focal}"
    rows = [(escaped(name), *facts) for name, *facts in camera_table(found)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
    )


if __name__ == "__main__":
    sys.exit(main())
