"""The options of kpexport, and what it makes of which input."""

import argparse
import functools
from dataclasses import dataclass
from pathlib import Path

from kpc.format.common import cli
from kpc.format.common.errors import UsageError
from kpc.player.quality import LEVELS
from kpc.tools.exchange.geometry_files import SUFFIXES as GEOMETRY_SUFFIXES
from kpc.tools.rendering.options import add_times, size

GLTF_SUFFIXES, USD_SUFFIXES = (".gltf", ".glb"), (".usda", ".usd", ".usdc")
CAMERA_SUFFIXES = (".gltf", *USD_SUFFIXES)
# The default resolution of meshes and the largest one, of which the grid takes 1.5 GB in a cubic box.
RESOLUTION, MAX_RESOLUTION = 128, 512
DENSITY = 50.0
# The default spacing of points is the longest edge of the box over this.
SPACING_PARTS = 400
# Instants per second of a path, if nothing is said.
PATH_FPS = 24.0
# Options for scenes alone, and for cameras alone.
_OF_SCENES = ("time", "start_s", "end_s", "frames", "step", "mesh", "resolution", "density", "spacing", "normals",
              "format", "backend", "quality", "appearance")  # fmt: skip
_OF_CAMERAS = ("keyframes", "camera", "scene")
_OF_POINTS = ("spacing", "normals", "size", "backend", "quality", "appearance")
_OF_MESHES = ("resolution", "density")
# Options with a default of the parser: whether they are given is not seen by their values.
_WITH_DEFAULT = ("step", "backend", "quality")
_FLAGS = {"start_s": "--from", "end_s": "--to"}


@dataclass(frozen=True)
class Task:
    """What to do.

    Attributes:
        kind: "geometry" or "cameras" of a scene; "to" or "from" the camera files of other programs.
        is_folder: whether geometry goes into a folder, one file a frame.
        suffix: of each file written, in small letters.
    """

    kind: str
    is_folder: bool
    suffix: str


def parser() -> argparse.ArgumentParser:
    """Return the parser of kpexport's command line."""
    made = cli.Parser(
        prog="kpexport",
        description="Exchange points, meshes and cameras with Blender, Houdini, Unreal, Nuke and other programs: a "
        ".kpc scene becomes coloured points or a mesh (.ply, .glb); its cameras, a camera file or a path of the "
        "player (.json) become cameras (.gltf, .usda, .usd, .usdc); those of a .gltf, .glb or USD file become a .json.",
    )
    cli.add_version_option(made)
    made.add_argument("input", type=cli.file_name, help="a .kpc file or its http address, or a file of cameras")
    made.add_argument(
        "-o",
        "--output",
        type=cli.output_name,
        required=True,
        metavar="DIR|FILE",
        help="what to write; its suffix says which",
    )
    made.add_argument("--format", choices=("ply", "glb"), help="of the files in a folder (default: ply)")
    times = made.add_argument_group("times; of a path, --fps sets the instants per second (default: 24)")
    add_times(times, is_rendering=False)
    _add_geometry(made.add_argument_group("points and meshes"))
    cameras = made.add_argument_group("cameras")
    cameras.add_argument(
        "--scene",
        type=cli.file_name,
        metavar="KPC",
        help="place cameras as those of this scene, by its up and its unit of length",
    )
    cameras.add_argument(
        "--keyframes", action="store_true", help="write the keyframes of a path alone, not its smooth course"
    )
    cameras.add_argument("--camera", type=cli.file_name, metavar="NAME", help="read this camera alone")
    return made


def _add_geometry(group: argparse._ArgumentGroup) -> None:
    group.add_argument("--mesh", action="store_true", help="write a mesh instead of points")
    group.add_argument(
        "--resolution",
        type=functools.partial(cli.whole_number, low=8, high=MAX_RESOLUTION),
        metavar="N",
        help=f"mesh: points of the density grid along the longest edge of the box (default: {RESOLUTION})",
    )
    positive = functools.partial(cli.number_within, low=1e-6, high=1e9)
    group.add_argument(
        "--density",
        type=positive,
        metavar="D",
        help=f"mesh: density at its surface, per longest edge of the box (default: {DENSITY:g})",
    )
    group.add_argument(
        "--spacing",
        type=positive,
        metavar="L",
        help="points: merge those in cells of this edge, in units of the scene (default: the longest edge of the box "
        f"/ {SPACING_PARTS})",
    )
    group.add_argument("--normals", action="store_true", help="points: add normals, from the gradient of the density")
    group.add_argument(
        "--size", type=size, metavar="WxH",
        help="points: size of the pictures of each of the scene's cameras that they are taken from; cameras that are "
        "read: size of their pictures; the vertical field of view stays the same",
    )  # fmt: skip
    group.add_argument("--backend", choices=("gl", "reference"), default="gl", help="points: as for kprender")
    group.add_argument(
        "--quality", choices=tuple(LEVELS), default="reference", help="points: as for kprender (default: %(default)s)"
    )
    group.add_argument("--appearance", metavar="NAME|A:B:0.3", help="points: as for kprender")


def parse(argv: list[str]) -> tuple[argparse.Namespace, Task]:
    """Return the options of a command line, and what they ask for.

    Raises:
        UsageError: nothing of that kind can be written, or an option does not apply to it.
    """
    made = parser()
    options = made.parse_args(argv, argparse.Namespace(**dict.fromkeys(_WITH_DEFAULT)))
    task = _task_of(options)
    for name in _WITH_DEFAULT:
        if getattr(options, name) is None:
            setattr(options, name, made.get_default(name))
    return options, task


def _task_of(options: argparse.Namespace) -> Task:
    """Return what the names of input and output ask for; options that are not given are None or False.

    Raises:
        UsageError: nothing of that kind can be written, or an option does not apply to it.
    """
    source, suffix = Path(options.input).suffix.lower(), Path(options.output).suffix.lower()
    if source == ".json" or source in GLTF_SUFFIXES + USD_SUFFIXES:
        possible = CAMERA_SUFFIXES if source == ".json" else (".json",)
        if suffix not in possible or options.output.endswith("/"):
            raise UsageError(
                f"-o {options.output}: cameras of a {source} file are written to {', '.join(possible)}; "
                "give such a name"
            )
        _refuse(options, _OF_SCENES, "is for scenes")
        if source == ".json":
            _refuse(options, ("camera", "size"), "is for cameras that are read from other files")
        else:
            _refuse(options, ("keyframes", "fps"), "is for paths that are written")
        return Task("to" if source == ".json" else "from", False, suffix)
    if suffix in CAMERA_SUFFIXES and not options.output.endswith("/"):
        _refuse(options, (*_OF_SCENES, *_OF_CAMERAS, "fps", "size"), "is not for a scene's own cameras")
        return Task("cameras", False, suffix)
    _refuse(options, _OF_CAMERAS, "is for cameras")
    if options.mesh:
        _refuse(options, _OF_POINTS, "is for points")
    else:
        _refuse(options, _OF_MESHES, "is for --mesh")
    if (
        not suffix
        or options.output.endswith("/")
        or (Path(options.output).is_dir() and suffix not in GEOMETRY_SUFFIXES)
    ):
        return Task("geometry", True, f".{options.format or 'ply'}")
    if suffix not in GEOMETRY_SUFFIXES:
        if source not in ("", ".kpc"):
            cameras = ", ".join((".json", *GLTF_SUFFIXES, *USD_SUFFIXES))
            raise UsageError(
                f"{options.input}: is by its name neither a scene (.kpc) nor a file of cameras ({cameras}); give one"
            )
        raise UsageError(
            f"-o {options.output}: {suffix} is not written from a scene; give {' or '.join(GEOMETRY_SUFFIXES)}, "
            f"{' or '.join(CAMERA_SUFFIXES)} for its cameras, or a folder: a name without suffix or with / at its end"
        )
    if options.format is not None and suffix != f".{options.format}":
        raise UsageError(f"-o {options.output}: --format {options.format} contradicts {suffix}; leave --format out")
    return Task("geometry", False, suffix)


def check_path(options: argparse.Namespace, task: Task, is_path: bool) -> None:
    """Refuse options of paths that change nothing in what is written of a camera file.

    Args:
        options: of the command line.
        task: of kind "to".
        is_path: whether the file is a path.

    Raises:
        UsageError: there is one.
    """
    if not is_path:
        _refuse(options, ("keyframes",), f"is for paths, and {options.input} is none")
    if task.suffix in GLTF_SUFFIXES and (options.keyframes or not is_path):  # USD has a rate of its own
        _refuse(options, ("fps",), "is for the smooth course of a path")


def _refuse(options: argparse.Namespace, names: tuple[str, ...], reason: str) -> None:
    for name in names:
        value = getattr(options, name)
        if value is not None and value is not False:  # 0 is given
            raise UsageError(f"{_FLAGS.get(name, f'--{name}')} {reason}; leave it out")
