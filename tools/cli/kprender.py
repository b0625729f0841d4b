"""kprender: render pictures and videos of a scene without a window.

    kprender scene.kpc -o clip.mp4                            the clip, from the scene's first camera
    kprender scene.kpc --orbit 96 -o orbit.mp4                a path around the scene while the clip plays
    kprender scene.kpc --cameras cameras.json -o DIR          one picture for each frame that the file lists
    kprender scene.kpc --path path.json -o flight.mp4         a smooth path through the views that the file lists
    kprender scene.kpc --time 0.5 --size 960x720 -o still.png
    kprender scene.kpc --dynamic-map -o moves.mp4             moving content in colour, static content in grey
    kprender scene.kpc --appearance dawn.jpg:dusk.jpg:0.3 -o clip.mp4

The player saves files for --cameras and --path.
"""

import argparse
import errno
import itertools
import os
import re
import sys
import time as clock
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenEXR

import kpc
from kpc.format.common import cli
from kpc.format.common.errors import UsageError
from kpc.format.common.images import write_image
from kpc.format.common.media import write_video
from kpc.format.common.progress import progress
from kpc.format.container.groups import GroupedScene
from kpc.format.scene.cameras import Camera, View, load_views
from kpc.format.scene.scene import Clip, Scene
from kpc.format.scene.space import Contraction
from kpc.player.app.camera_paths import CameraPath
from kpc.player.cpu import reference
from kpc.player.cpu.motion_map import motion_colours
from kpc.player.cpu.reference import Part, Rendering
from kpc.player.quality import LEVELS
from kpc.player.viewpoints import Rig, fit_camera, orbit
from kpc.tools.cli.depth_images import NO_SURFACE, write_depth
from kpc.tools.rendering.outputs import FILM_SUFFIXES, PICTURE_FORMATS, PICTURE_SUFFIXES, Output

Render = Callable[[Camera, float], Rendering]

# Limits of --fps, of a side of a picture, and of the number of pictures.
MIN_FPS, MAX_FPS = 0.001, 240.0
MAX_SIDE = 16384
MAX_PICTURES = 100_000

# Depth PNGs of contracted scenes reach this many times `Contraction.uniform_distance`: 16 bits could not resolve near
# depths if they reached as far as the rays.
CONTRACTED_DEPTH_RANGE = 16.0


def main(argv: list[str] | None = None) -> int:
    """Run the command and return its exit code."""
    return cli.run(_command, "kprender", argv)


def _command(argv: list[str]) -> None:
    options = _parser().parse_args(argv)
    output = Output.of(options.output, options.format)
    out = output.path
    if not output.is_folder and not out.absolute().parent.is_dir():
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(out.absolute().parent))
    loaded = kpc.load(options.scene)
    scene, _ = loaded.at(0.0)  # the first group of a long clip has the cameras and bounds of all
    views = _views(scene, loaded.clip, options, output)
    if not output.is_film and not output.is_folder and len(views) != 1:
        raise UsageError(f"-o {out}: {len(views)} pictures do not go into one file; give a folder, an .mp4 or --time")
    render, renderer = _backend(loaded, options)
    _say(renderer)

    started = clock.monotonic()
    if output.is_film:
        pixels = _depth_pixels(scene, views) if options.depth else _colour_pixels
        fps = _fps(loaded.clip, options)
        renderings = (render(view.camera, view.time) for view in progress(views, out.name, unit="frame"))
        write_video(out, (pixels(rendering) for rendering in renderings), fps)
        what = f"{out}: {len(views)} frames at {fps:g} fps"
    else:
        depth_unit = _max_depth(scene, views) / (NO_SURFACE - 1) if options.depth else None
        paths, renamed = output.picture_paths(views)
        if renamed:
            _say(f"{options.cameras}: {renamed} pictures get other names, for theirs are taken or no plain file names")
        if output.is_folder:
            out.mkdir(parents=True, exist_ok=True)
        for view, path in zip(progress(views, "render", unit="picture"), paths, strict=True):
            _write(path, render(view.camera, view.time), depth_unit)
        what = f"{out}: {len(views)} picture{'s' * (len(views) != 1)}"
    elapsed = clock.monotonic() - started
    print(f"{what}, {views[0].camera.width}x{views[0].camera.height}, in {elapsed:.1f} s")


def _say(text: str) -> None:
    print(f"kprender: {text}", file=sys.stderr)


# --- options


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="kprender", description="Render a .kpc scene to pictures or a video, without a window."
    )
    cli.add_version_option(parser)
    parser.add_argument("scene", help="a .kpc file, or its http address")
    _add_views(parser)
    _add_content(parser)
    parser.add_argument(
        "-o",
        "--output",
        required=True,
        metavar="DIR|FILE",
        help="a folder for pictures (a name without suffix, or with / at its end), "
        f"a film ({' '.join(FILM_SUFFIXES)}), or a single picture ({' '.join(PICTURE_SUFFIXES)})",
    )
    parser.add_argument(
        "--format",
        choices=PICTURE_FORMATS,
        help="format of pictures in a folder: 8-bit PNG or JPEG, or EXR with linear colour and depth (default: "
        f"{PICTURE_FORMATS[0]})",
    )
    parser.add_argument(
        "--fps",
        type=cli.frame_rate(MIN_FPS, MAX_FPS),
        metavar="F",
        help="frame rate of an mp4, and of --path (default: the clip's)",
    )
    parser.add_argument(
        "--backend",
        choices=("gl", "reference"),
        default="gl",
        help="OpenGL, or numpy where there is none (default: %(default)s)",
    )
    parser.add_argument(
        "--quality",
        choices=tuple(LEVELS),
        default="reference",
        help="quality level of the gl backend, as in the player, from the fastest to the exact one "
        "(default: %(default)s)",
    )
    return parser


def _add_views(parser: argparse.ArgumentParser) -> None:
    """Add the options that choose cameras and times."""
    views = parser.add_mutually_exclusive_group()
    views.add_argument(
        "--cameras",
        metavar="JSON",
        help="views to render: a file with w h fl_x fl_y cx cy frames[file time transform_matrix]",
    )
    views.add_argument(
        "--path",
        metavar="JSON",
        help="a smooth path through the views of such a file; a frame's `at` is its time along the path in seconds "
        "(default: 2 s apart)",
    )
    views.add_argument("--orbit", type=_count, metavar="N", help="N views along a path around the scene")
    parser.add_argument(
        "--time",
        type=_unit_interval,
        metavar="T",
        help="time of all pictures, in [0, 1] over the clip (default: those of --cameras, else evenly over the clip)",
    )
    parser.add_argument(
        "--size", type=_size, metavar="WxH", help="size of the pictures; the vertical field of view stays the same"
    )


def _add_content(parser: argparse.ArgumentParser) -> None:
    """Add the options that choose what the pictures show."""
    parser.add_argument(
        "--depth",
        action="store_true",
        help="mp4: grey depth instead of colour; png: a 16-bit NAME_depth.png beside each picture; exr always contains "
        "depth as channel Z",
    )
    part = parser.add_mutually_exclusive_group()
    part.add_argument(
        "--static-only",
        action="store_const",
        dest="part",
        const=Part.STATIC,
        help="the static part: time planes set to 1",
    )
    part.add_argument(
        "--dynamic-only",
        action="store_const",
        dest="part",
        const=Part.DYNAMIC,
        help="the absolute difference between the full picture and the static part",
    )
    part.add_argument(
        "--dynamic-map",
        action="store_true",
        help="colour for content that differs from that at other times, grey for the rest",
    )
    parser.add_argument(
        "--appearance",
        metavar="NAME|A:B:0.3",
        help="appearance of the picture or camera NAME, or an interpolation from A to B (default: the average; kpinfo "
        "lists the names)",
    )
    parser.set_defaults(part=Part.FULL)


def _count(text: str) -> int:
    if not text.isdecimal() or not 1 <= int(text) <= MAX_PICTURES:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of pictures from 1 to {MAX_PICTURES}")
    return int(text)


def _unit_interval(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0.0 <= value <= 1.0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number in [0, 1]")
    return value


def _size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text)
    if match is None or not all(1 <= int(n) <= MAX_SIDE for n in match.groups()):
        raise argparse.ArgumentTypeError(f"{text!r} is not a size like 640x480, at most {MAX_SIDE} per side")
    return int(match[1]), int(match[2])


def _appearance(scene: Scene, text: str | None) -> np.ndarray | None:
    """Return the embedding that --appearance asks for; None, the average, without the option.

    The text is NAME, or ONE:OTHER:SHARE for a linear interpolation; names themselves may contain colons.

    Raises:
        UsageError: the scene has no appearance of that name, or the share lies outside [0, 1].
    """
    if text is None:
        return None
    names = {appearance.name for appearance in scene.appearances}
    pair, _, share = text.rpartition(":")
    if text in names or ":" not in pair:
        return scene.appearance(text)
    try:
        weight = _unit_interval(share)
    except argparse.ArgumentTypeError as error:
        raise UsageError(
            f"--appearance {text}: {share!r} is not a share in [0, 1]; give NAME or NAME:NAME:SHARE"
        ) from error
    colons = [k for k, letter in enumerate(pair) if letter == ":"]
    split = next((k for k in colons if names.issuperset({pair[:k], pair[k + 1 :]})), colons[0])
    return scene.interpolate_appearance(pair[:split], pair[split + 1 :], weight)


def _fps(clip: Clip, options: argparse.Namespace) -> float:
    return float(options.fps or min(max(clip.fps, 1.0), MAX_FPS))


# --- views


def _views(scene: Scene, clip: Clip, options: argparse.Namespace, output: Output) -> list[View]:
    """Return the views to render: a camera, a time and a name each."""
    if options.cameras is not None:
        views = load_views(options.cameras)
        if options.time is None and clip.frame_count > 1 and not any(view.time for view in views):
            _say(f"{options.cameras}: all views are at the beginning of the clip; --time chooses another time")
    elif options.path is not None:
        views = _path_views(clip, options)
    else:
        first = Rig.of(scene).cameras[0]
        still = [first] * (1 if options.time is not None else clip.frame_count)
        cameras = orbit(scene, options.orbit) if options.orbit else still
        times = np.linspace(0.0, 1.0, len(cameras))
        views = [
            View(camera, float(time), f"{number:04d}")
            for number, (camera, time) in enumerate(zip(cameras, times, strict=True))
        ]
    if options.time is not None:
        views = [replace(view, time=options.time) for view in views]
    if options.size is not None:
        views = [replace(view, camera=fit_camera(view.camera, *options.size)) for view in views]
    elif options.cameras is not None and output.is_film:
        size = views[0].camera.width, views[0].camera.height
        views = [replace(view, camera=fit_camera(view.camera, *size)) for view in views]
    return views


def _path_views(clip: Clip, options: argparse.Namespace) -> list[View]:
    path, fps = CameraPath.load(options.path), _fps(clip, options)
    duration_s = path.end_s - path.start_s
    if duration_s * fps >= MAX_PICTURES:
        raise UsageError(
            f"--path {options.path}: {duration_s:g} s at {fps:g} fps are more than {MAX_PICTURES} pictures"
        )
    return path.views(fps)


# --- rendering


def _backend(loaded: Scene | GroupedScene, options: argparse.Namespace) -> tuple[Render, str]:
    """Return a function that renders a picture, and the name of the renderer."""
    _appearance(loaded.at(0.0)[0], options.appearance)  # reports an unknown name at once
    if options.backend == "reference":
        return _reference_backend(loaded, options), "reference renderer (numpy)"
    from kpc.player.gl import offscreen  # here, since the reference backend works without moderngl
    from kpc.player.gl.renderer import Renderer

    ctx = offscreen.open_context()
    renderers: list[Renderer] = []

    def render(camera: Camera, time: float) -> Rendering:
        parts = loaded.blend_at(time)
        for unused in [one for one in renderers if all(one.scene is not scene for scene, *_ in parts)]:
            unused.release()
            renderers.remove(unused)
        pictures = []
        for scene, local_time, share in parts:
            renderer = next((one for one in renderers if one.scene is scene), None)
            if renderer is None:
                renderers.append(renderer := Renderer(ctx, scene, LEVELS[options.quality]))
            appearance = _appearance(scene, options.appearance)
            picture = renderer.render(camera, local_time, part=options.part, appearance=appearance)
            pictures.append((_displayed(scene, camera, local_time, picture, options), share))
        return reference.blend(pictures)

    return render, offscreen.describe(ctx)


def _reference_backend(loaded: Scene | GroupedScene, options: argparse.Namespace) -> Render:
    def render(camera: Camera, time: float) -> Rendering:
        pictures = []
        for scene, local_time, share in loaded.blend_at(time):
            appearance = _appearance(scene, options.appearance)
            picture = reference.render(scene, camera, local_time, part=options.part, appearance=appearance)
            pictures.append((_displayed(scene, camera, local_time, picture, options), share))
        return reference.blend(pictures)

    return render


def _displayed(scene: Scene, camera: Camera, time: float, picture: Rendering, options: argparse.Namespace) -> Rendering:
    return motion_colours(scene, camera, time, picture) if options.dynamic_map else picture


# --- files


def _write(path: Path, rendering: Rendering, depth_unit: float | None) -> None:
    if path.suffix.lower() == ".exr":
        _write_exr(path, rendering)
        return
    write_image(path, _colour_pixels(rendering))
    if depth_unit is not None:
        write_depth(path.with_name(f"{path.stem}_depth.png"), rendering.depth, depth_unit)


def _write_exr(path: Path, rendering: Rendering) -> None:
    """Write R, G, B in linear light, and Z in world units along the ray, infinite where there is no surface."""
    rgb = np.clip(rendering.rgb, 0, 1).astype(np.float64)
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4).astype(np.float32)  # inverse sRGB
    channels = {"RGB": linear, "Z": np.ascontiguousarray(rendering.depth, np.float32)}
    with (
        cli.atomic_write(path) as aside,
        OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, channels) as exr,
    ):
        exr.write(str(aside))


def _colour_pixels(rendering: Rendering) -> np.ndarray:
    return np.rint(np.clip(rendering.rgb, 0, 1) * 255).astype(np.uint8)


def _max_depth(scene: Scene, views: list[View]) -> float:
    """Return a depth that no surface exceeds: the greatest distance from a camera to a corner of the scene's bounds.

    In contracted space it is a limit to which depth is clipped.
    """
    if isinstance(scene.mapping, Contraction):
        return CONTRACTED_DEPTH_RANGE * scene.mapping.uniform_distance
    corners = np.array(list(itertools.product(*scene.bounds.T)))
    eyes = np.unique([view.camera.camera_to_world[:3, 3] for view in views], axis=0)
    return float(np.linalg.norm(eyes[:, None] - corners, axis=2).max())


def _depth_pixels(scene: Scene, views: list[View]) -> Callable[[Rendering], np.ndarray]:
    """Return a function that shows depth in grey: near is white, far and empty are black.

    Grey is linear in depth, or in contracted space in the ray's parameter, along which samples are evenly spaced.
    """
    mapping, max_depth = scene.mapping, _max_depth(scene, views)

    def pixels(rendering: Rendering) -> np.ndarray:
        if isinstance(mapping, Contraction):
            brightness = 1 - mapping.parameter(rendering.depth) / (2 * mapping.uniform_distance)
        else:
            relative = np.minimum(rendering.depth / max_depth, 1)
            brightness = np.where(np.isfinite(rendering.depth), 1 - relative, 0)
        return np.repeat(np.rint(brightness * 255).astype(np.uint8)[..., None], 3, axis=2)

    return pixels


if __name__ == "__main__":
    sys.exit(main())
