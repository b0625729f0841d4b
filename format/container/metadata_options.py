"""Options of commands that set metadata: --title and the like, and --view-limits."""

import argparse
import datetime
import math
import os
from collections.abc import Mapping
from typing import Any

from kpc.format.common.errors import FormatError, UsageError
from kpc.format.container.metadata_chunk import pack_metadata
from kpc.format.scene.metadata import Metadata

TEXTS = {
    "title": "of the scene",
    "description": "of the scene; lines may be separated by \\n",
    "author": "of the recording",
    "licence": "under which it may be used, for example CC-BY-4.0",
    "date": "of the recording: 2026, 2026-11 or 2026-11-27",
}
LIMITS = ("azimuth", "elevation", "distance", "reach")


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
    """Return the texts that are given, as members of the metadata."""
    return {name: getattr(given, name) for name in TEXTS if getattr(given, name) is not None}


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
        found[name] = numbers[0] if name == "reach" else numbers
    placeholder = {"focus": [0, 0, 0], "forward": [1, 0, 0], "azimuth": [0, 0], "elevation": [0, 0]}
    limits = {**placeholder, "distance": [1, 1], "reach": 0, **found}
    try:
        pack_metadata(Metadata({"up": [0, 0, 1], "view_limits": limits}))
    except FormatError as error:
        raise argparse.ArgumentTypeError(str(error).removeprefix("meta: ")) from error
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


def _text(name: str) -> Any:
    def parse(text: str) -> str:
        # Arguments are decoded as the locale says, which may be no more than ASCII; terminals send UTF-8.
        text = os.fsencode(text).decode("utf-8", "replace")
        text = text.replace("\\n", "\n") if name == "description" else text
        if name == "date" and text:
            _check_date(text)
        try:
            pack_metadata(Metadata({name: text} if text else {}))
        except FormatError as error:
            raise argparse.ArgumentTypeError(str(error).removeprefix("meta: ")) from error
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
