"""What the user may say about footage without poses, and the options that say it."""

import argparse
import math
from dataclasses import dataclass, fields
from pathlib import Path

from kpc.format.common.text import option_name

RIGS = ("auto", "still", "moving")
LENSES = ("auto", "pinhole", "fisheye")
SYNC_MODES = ("auto", "audio", "motion", "none")


@dataclass(frozen=True)
class Wishes:
    """What the user says about footage without poses.

    Attributes:
        rig: one of RIGS: whether cameras move.
        sync: one of SYNC_MODES: how videos are brought in step; or a file of offsets (`given_clocks`).
        distance: names of two cameras, or of two pictures of moving ones, and how far apart they are in metres; None
            if unknown.
        require_all: whether to refuse if a camera cannot be placed.
        lens: one of LENSES: of what kind all lenses are.
    """

    rig: str = "auto"
    sync: str | Path = "auto"
    distance: tuple[str, str, float] | None = None
    require_all: bool = False
    lens: str = "auto"

    def changed(self) -> dict[str, str]:
        """Return what differs from the defaults and may change the cameras, as text by the names of options."""
        distance = None if self.distance is None else "{},{}={:g}".format(*self.distance)
        given = {"rig": self.rig, "sync": str(self.sync), "distance": distance, "lens": self.lens}
        return {name: value for name, value in given.items() if value not in ("auto", None)}

    def options_given(self) -> list[str]:
        """Return the options that say something else than the defaults."""
        return [option_name(one.name) for one in fields(self) if getattr(self, one.name) != one.default]


def add_pose_options(parser: argparse.ArgumentParser) -> None:
    """Add the options from which `wishes_from` makes wishes."""
    group = parser.add_argument_group("footage without poses")
    group.add_argument(
        "--rig",
        choices=RIGS,
        default=Wishes.rig,
        help="whether cameras move; moving: images are the frames of one camera (default: %(default)s)",
    )
    group.add_argument(
        "--sync",
        type=_sync,
        metavar="{" + ",".join(SYNC_MODES) + ",JSON}",
        default=Wishes.sync,
        help="how videos are brought in step, or a file of their offsets (default: %(default)s)",
    )
    group.add_argument(
        "--distance",
        type=_distance,
        metavar="A,B=METRES",
        help="how far two cameras, or pictures of moving ones (left/000012), are apart; without it, the largest "
        "distance between cameras is 1",
    )
    group.add_argument(
        "--lens", choices=LENSES, default=Wishes.lens, help="of what kind all lenses are (default: %(default)s)"
    )
    group.add_argument("--require-all", action="store_true", help="fail if a camera or picture cannot be placed")


def wishes_from(given: argparse.Namespace) -> Wishes:
    """Return what parsed options say."""
    return Wishes(given.rig, given.sync, given.distance, given.require_all, given.lens)


def _sync(text: str) -> str | Path:
    if text in SYNC_MODES:
        return text
    if not text.lower().endswith(".json"):
        raise argparse.ArgumentTypeError(f"{text!r} is none of {', '.join(SYNC_MODES)}, and no .json file")
    return Path(text)


def _distance(text: str) -> tuple[str, str, float]:
    names, _, metres = text.rpartition("=")
    one, _, two = names.partition(",")
    try:
        value = float(metres)
    except ValueError:
        value = math.nan
    if not (one and two and one != two and 0 < value < math.inf):
        raise argparse.ArgumentTypeError(f"{text!r} is not two cameras and a distance, such as cam00,cam05=1.2")
    return one, two, value
