"""Options of commands that set metadata: --title and the like, and --view-limits."""

import argparse
import datetime
import math
import os
import re
from collections.abc import Mapping
from typing import Any

from kpc.format.common.errors import FormatError, UsageError
from kpc.format.container.metadata_chunk import pack_metadata
from kpc.format.container.scene_layout import BOX_LIMIT
from kpc.format.scene.metadata import Metadata

TEXTS = {
    "title": "of the scene",
    "description": "of the scene; \\n begins another line, and \\\\ is a backslash",
    "author": "of the recording",
    "licence": "under which it may be used, for example CC-BY-4.0",
    "date": "of the recording: 2026, 2026-11 or 2026-11-27",
}
# Members of `view_limits` that may be given: their least and largest value, and what to write.
LIMITS = {
    "azimuth": (-360.0, 360.0, "degrees from -360 to 360, at most a full turn"),
    "elevation": (-90.0, 90.0, "degrees from -90 to 90"),
    "distance": (math.ulp(0.0), float(BOX_LIMIT), f"lengths above 0, up to {BOX_LIMIT:.3g}"),
    "reach": (0.0, float(BOX_LIMIT), f"a length from 0 to {BOX_LIMIT:.3g}"),
}
# By this unit vectors of one direction, and numbers relative to their size, may differ: a file holds seven digits.
ROUNDING = 1e-5


def add_metadata_options(parser: argparse.ArgumentParser) -> None:
    """Add --title, --description, --author, --licence, --date and --view-limits; `members_from` reads them."""
    for name, what in TEXTS.items():
        parser.add_argument(f"--{name}", type=_text(name), metavar="DATE" if name == "date" else "TEXT", help=what)
    parser.add_argument(
        "--view-limits",
        type=view_limits,
        metavar="auto|none|NAME=LOW:HIGH,...",
        help="from where players let people look: found from the cameras and what they saw, not limited, or given: "
        "azimuth and elevation in degrees, distance and reach in world units, for example "
        "azimuth=-30:30,distance=1:4,reach=0.2; what is not given is found",
    )


def members_from(given: argparse.Namespace) -> dict[str, Any]:
    """Return the texts that are given, as members of the metadata; None for empty ones, which remove a member."""
    return {name: getattr(given, name) or None for name in TEXTS if getattr(given, name) is not None}


def view_limits(text: str) -> str | dict[str, Any]:
    """Parse --view-limits: "auto", "none", or members of `view_limits`.

    Raises:
        argparse.ArgumentTypeError: it is none of these.
    """
    if text in ("auto", "none"):
        return text
    found: dict[str, Any] = {}
    for part in text.split(","):
        name, _, value = part.partition("=")
        try:
            numbers = [float(number) for number in value.split(":")]
        except ValueError as error:
            raise argparse.ArgumentTypeError(f"{part!r} is not like azimuth=-30:30") from error
        if name not in LIMITS or name in found or len(numbers) != (1 if name == "reach" else 2):
            raise argparse.ArgumentTypeError(f"{part!r} is not like azimuth=-30:30 or reach=0.2, each at most once")
        if not all(map(math.isfinite, numbers)):
            raise argparse.ArgumentTypeError(f"{part!r}: write finite numbers, such as azimuth=-30:30")
        if numbers[0] > numbers[-1]:
            raise argparse.ArgumentTypeError(f"{part!r}: the least value is above the largest; swap them")
        least, most, what = LIMITS[name]
        is_beyond = numbers[0] < least or numbers[-1] > most
        if is_beyond or (name == "azimuth" and numbers[1] - numbers[0] > 360):
            raise argparse.ArgumentTypeError(f"{part!r}: write {what}")
        found[name] = numbers[0] if name == "reach" else numbers
    return found


def with_view_limits(metadata: Metadata, wanted: str | Mapping[str, Any]) -> Metadata:
    """Return the metadata with the view limits that --view-limits asks for, where they follow from those before.

    Raises:
        UsageError: they do not.
    """
    limits = metadata.document.get("view_limits")
    if wanted == "none":
        return metadata.with_members(view_limits=None)
    if limits is None or isinstance(wanted, str):
        raise UsageError("--view-limits: the file has none to change; find them with kpedit --view-limits auto")
    return metadata.with_members(view_limits={**limits, **wanted})


def opening_beyond_limits(metadata: Metadata) -> str | None:
    """Return in words where the opening view lies outside the view limits, so that players do not stay there; None if
    it lies within, or there are none.
    """
    limits, opening = metadata.view_limits, metadata.opening
    if limits is None or opening is None:
        return None
    position = limits.position(opening.camera.camera_to_world[:3, 3])
    bounds = {"azimuth": limits.azimuth, "elevation": limits.elevation, "distance": limits.distance}
    outside = [
        name
        for number, (name, (low, high)) in zip(position, bounds.items(), strict=True)
        if not low - ROUNDING * abs(low) <= number <= high + ROUNDING * abs(high)
    ]
    if not outside:
        return None
    return f"the opening view lies outside the limits of its {' and '.join(outside)}, and players move it within"


def _text(name: str) -> Any:
    def parse(text: str) -> str:
        # Arguments are decoded as the locale says, which may be no more than ASCII; terminals send UTF-8.
        text = os.fsencode(text).decode("utf-8", "replace")
        if name == "description":
            text = re.sub(r"\\[\\n]", lambda escape: "\n" if escape[0] == "\\n" else "\\", text)
        text = "" if text.isspace() else text
        if name == "date" and text:
            _check_date(text)
        try:
            pack_metadata(Metadata({name: text} if text else {}))
        except FormatError as error:
            reason = str(error).removeprefix("meta: ").removeprefix(f"meta.{name}: ")
            raise argparse.ArgumentTypeError(reason) from error
        return text

    parse.__name__ = name
    return parse


def _check_date(text: str) -> None:
    whole = text + "-01" * (2 - text.count("-"))
    try:
        is_date = datetime.date.fromisoformat(whole).isoformat() == whole
    except ValueError:
        is_date = False
    if not is_date:
        raise argparse.ArgumentTypeError(f"{text!r} is no date like 2026, 2026-11 or 2026-11-27")
