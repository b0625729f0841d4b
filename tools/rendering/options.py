"""The options of kprender."""

import argparse
import functools
import re

import numpy as np
from PIL import ImageColor

from kpc.format.common import cli
from kpc.format.common.films import CODECS
from kpc.player.cpu.reference import Part
from kpc.player.quality import LEVELS
from kpc.tools.rendering.outputs import FILM_SUFFIXES, PICTURE_FORMATS, PICTURE_SUFFIXES
from kpc.tools.rendering.shots import MAX_FPS, MAX_PICTURES, MIN_FPS, SHUTTER_INSTANTS

# The largest side of a picture, with all its samples.
MAX_SIDE = 16384
# The most samples along a side of a pixel.
MAX_SAMPLES = 16


def parser() -> argparse.ArgumentParser:
    """Return the parser of kprender's command line."""
    made = cli.Parser(prog="kprender", description="Render a .kpc scene to pictures or a film, without a window.")
    cli.add_version_option(made)
    made.add_argument("scene", type=cli.file_name, help="a .kpc file, or its http address")
    _add_cameras(made.add_argument_group("cameras"))
    add_times(made.add_argument_group("times"))
    _add_content(made.add_argument_group("content"))
    _add_output(made.add_argument_group("output"))
    quality = made.add_argument_group("quality")
    quality.add_argument(
        "--backend",
        choices=("gl", "reference"),
        default="gl",
        help="OpenGL, or numpy where there is none (default: %(default)s)",
    )
    quality.add_argument(
        "--quality",
        choices=tuple(LEVELS),
        default="reference",
        help="quality level of the gl backend, as in the player, from the fastest to the exact one "
        "(default: %(default)s)",
    )
    quality.add_argument(
        "--samples",
        type=functools.partial(cli.whole_number, low=1, high=MAX_SAMPLES),
        default=1,
        metavar="N",
        help="render N x N samples for each pixel, and take their mean in linear light (default: %(default)s)",
    )
    quality.add_argument(
        "--shutter",
        type=functools.partial(cli.number_within, low=0.0, high=1.0, name="a part of a frame's time"),
        default=0.0,
        metavar="S",
        help="keep the shutter open for this part of a frame's time (0.5: 180 degrees): the mean in linear light of "
        f"{SHUTTER_INSTANTS} instants around the frame's time; the clip moves meanwhile, and the camera of a --path "
        "(default: %(default)g)",
    )
    return made


def _add_cameras(group: argparse._ArgumentGroup) -> None:
    cameras = group.add_mutually_exclusive_group()
    cameras.add_argument(
        "--camera",
        type=cli.file_name,
        metavar="N|NAME|JSON",
        help="a fixed camera: one of the scene's by its name or else its number from 0 on, or the one that such a "
        "file as for --cameras lists (default: the view that the file opens with, or else 0)",
    )
    cameras.add_argument(
        "--cameras",
        type=cli.file_name,
        metavar="JSON",
        help="views to render: a file with w h fl_x fl_y cx cy frames[file time transform_matrix], or nerfstudio's "
        "transforms.json or camera_path.json",
    )
    cameras.add_argument(
        "--path",
        type=cli.file_name,
        metavar="JSON",
        help="a smooth path through the views of such a file; a frame's `at` is its time along the path in seconds "
        "(default: 2 s apart)",
    )
    cameras.add_argument(
        "--orbit",
        type=functools.partial(cli.whole_number, low=1, high=MAX_PICTURES),
        metavar="N",
        help="N views along a path around the scene while the clip plays once",
    )
    cameras.add_argument(
        "--every-camera",
        action="store_const",
        const=True,
        help="every frame by every camera of the scene: pictures in a folder, with a transforms.json, on which kpenc "
        "trains",
    )
    group.add_argument(
        "--size", type=size, metavar="WxH", help="size of the pictures; the vertical field of view stays the same"
    )


def add_times(group: argparse._ArgumentGroup, is_rendering: bool = True) -> None:
    """Add the options that choose frames, which `shots.shots_of` reads.

    Args:
        group: of the parser.
        is_rendering: whether the texts speak of --cameras and of films, too.
    """
    group.add_argument(
        "--time",
        type=functools.partial(cli.number_within, low=0.0, high=1.0, name="a number"),
        metavar="T",
        help="stop the clip at this time, in [0, 1] over the clip (default: "
        + ("those of --cameras, else the clip plays)" if is_rendering else "the clip plays)"),
    )
    group.add_argument(
        "--fps",
        type=cli.frame_rate(MIN_FPS, MAX_FPS),
        metavar="F",
        help="frames per second; the clip and the path keep their durations (default: the clip's rate)",
    )
    group.add_argument("--from", dest="start_s", type=cli.time_s, metavar="1.5s", help="begin at this time")
    group.add_argument("--to", dest="end_s", type=cli.time_s, metavar="4s", help="end before this time")
    group.add_argument(
        "--frames",
        type=_range,
        metavar="A-B",
        help="only the frames A to B, counted from 0 at --fps; not with --from or --to",
    )
    group.add_argument(
        "--step",
        type=functools.partial(cli.whole_number, low=1, high=MAX_PICTURES),
        default=1,
        metavar="N",
        help="only every Nth frame"
        + "; a film plays as fast, and lasts as long to one of its frames" * is_rendering
        + " (default: %(default)s)",
    )


def _add_content(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--depth",
        action="store_true",
        help="film: grey depth instead of colour; png, jpg: a 16-bit NAME_depth.png beside each picture; exr always "
        "contains depth as channel Z",
    )
    part = group.add_mutually_exclusive_group()
    for option, content, text in (
        ("--static-only", "plate", "the clean plate: what is seen when what moves is gone"),
        ("--dynamic-only", "moving", "what moves and its shadow, cut out, over black or --background"),
        ("--matte", "matte", "how much of each pixel moves, white on black"),
        ("--dynamic-map", "map", "how much of each pixel moves, in red over the picture in grey"),
    ):
        part.add_argument(option, action="store_const", const=content, dest="content", help=text)
    part.add_argument(
        "--diagnose",
        dest="part",
        type=_diagnosis,
        default=Part.FULL,
        metavar="static|dynamic",
        help="static: what the space planes alone show, time planes set to 1, which no one ever saw; dynamic: the "
        "absolute difference of the picture from that",
    )
    group.add_argument(
        "--with",
        dest="others",
        type=cli.file_name,
        action="append",
        default=[],
        metavar="SCENE",
        help="draw another scene, a file or its http address, into the pictures, too, where kpedit has placed it; what "
        "is nearer covers what is farther; all clips begin together, and the last frame of one that is shorter than "
        "the first stays; may be given several times",
    )
    group.add_argument(
        "--background",
        type=_colour,
        metavar="COLOUR",
        help="what is behind the scene: a colour (white, #00ff00), or transparent, for png, exr, and films with alpha "
        "(default: the scene's; exr: transparent)",
    )
    group.add_argument(
        "--appearance",
        metavar="NAME|A:B:0.3",
        help="appearance of the picture or camera NAME, or an interpolation from A to B (default: the average; kpinfo "
        "lists the names)",
    )


def _add_output(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "-o",
        "--output",
        type=cli.output_name,
        required=True,
        metavar="DIR|FILE",
        help="a folder for pictures (a name without suffix, or with / at its end), "
        f"a film ({' '.join(FILM_SUFFIXES)}), or a single picture ({' '.join(PICTURE_SUFFIXES)})",
    )
    group.add_argument(
        "--format",
        choices=PICTURE_FORMATS,
        help="format of pictures in a folder: 8-bit PNG or JPEG, or EXR with linear colour and depth (default: "
        f"{PICTURE_FORMATS[0]})",
    )
    group.add_argument(
        "--resume",
        action="store_true",
        help="skip pictures that are in the folder already and whole, of the same options; not for a single file",
    )
    group.add_argument(
        "--codec",
        choices=tuple(CODECS),
        help="codec of a film (default: h264 in .mp4 and .mkv, prores in .mov, vp9 in .webm)",
    )
    group.add_argument(
        "--crf", type=functools.partial(cli.whole_number, low=0, high=63), metavar="N",
        help="constant rate factor of a film: lower is better and larger (default: "
        + ", ".join(f"{name} {codec.crf[2]}" for name, codec in CODECS.items() if codec.crf)
        + ")",
    )  # fmt: skip
    group.add_argument("--bits", type=int, choices=(8, 10), help="bits per channel of a film (default: 8; prores: 10)")


def _range(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"([0-9]{1,6})(?:-([0-9]{1,6}))?", text)
    if match is None or int(match[2] or match[1]) < int(match[1]):
        raise argparse.ArgumentTypeError(f"{text!r} is not a range of frames like 10-20")
    return int(match[1]), int(match[2] or match[1])


def size(text: str) -> tuple[int, int]:
    """Parse a size of pictures such as "640x480"."""
    match = re.fullmatch(r"([0-9]{1,5})x([0-9]{1,5})", text)
    if match is None or not all(1 <= int(n) <= MAX_SIDE for n in match.groups()):
        raise argparse.ArgumentTypeError(f"{text!r} is not a size like 640x480, at most {MAX_SIDE} per side")
    return int(match[1]), int(match[2])


def _diagnosis(text: str) -> Part:
    if text not in (Part.STATIC.value, Part.DYNAMIC.value):
        raise argparse.ArgumentTypeError(f"{text!r} is neither {Part.STATIC.value} nor {Part.DYNAMIC.value}")
    return Part(text)


def _colour(text: str) -> np.ndarray | str:
    """Return a colour, (3,) float32 in [0, 1], or "transparent"."""
    if text == "transparent":
        return text
    refusal = argparse.ArgumentTypeError(f"{text!r} is no colour like white or #00ff00, nor transparent")
    try:
        colour = ImageColor.getrgb(text)
    except ValueError:
        raise refusal from None
    if len(colour) != 3:
        raise refusal
    return np.array(colour, np.float32) / 255
