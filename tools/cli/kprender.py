"""kprender: pictures and videos of a scene, without a window.

kprender scene.kpc -o clip.mp4                            the clip, from the scene's first camera
kprender scene.kpc --orbit 96 -o orbit.mp4                a path around it while the clip plays
kprender scene.kpc --cameras cameras.json -o DIR          one picture for each frame the file lists
kprender scene.kpc --path path.json -o flight.mp4         smoothly through the views it lists, as saved in the player
kprender scene.kpc --time 0.5 --size 960x720 -o still.png
kprender scene.kpc --dynamic-map -o moves.mp4             what moves in colour, what stands still in grey
kprender scene.kpc --appearance dawn.jpg:dusk.jpg:0.3 -o clip.mp4
"""

import argparse
import errno
import itertools
import os
import re
import sys
import time as clock
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenEXR
from kpc.format.common import cli
from kpc.format.common.errors import UsageError
from kpc.format.common.media import write_image, write_video
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
from PIL import Image, PngImagePlugin

import kpc

Render = Callable[[Camera, float], Rendering]

FILES = (".mp4", ".png", ".exr")
SLOWEST, FASTEST = 0.001, 240.0
LARGEST = 16384
MOST = 100_000
"""Pictures at one go."""
NOTHING = 65535
"""In a depth PNG: no surface."""
FARTHEST_EVEN = 16.0
"""Depth PNGs of contracted scenes reach so many times `even`; levels are too few to tell near things apart out to infinity."""


def main(argv: list[str] | None = None) -> int:
    return cli.run(_command, "kprender", argv)


def _command(argv: list[str]) -> None:
    options = _parser().parse_args(argv)
    out = Path(options.output)
    if out.suffix.lower() in FILES and not out.absolute().parent.is_dir():
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(out.absolute().parent))
    loaded = kpc.load(options.scene)
    scene, _ = loaded.at(0.0)  # of a clip in groups the first says how large it all is
    shots = _shots(scene, loaded.clip, options)
    if out.suffix.lower() in (".png", ".exr") and len(shots) != 1:
        raise UsageError(f"-o {out}: {len(shots)} pictures do not go into one; give a directory, an .mp4 or --time")
    render, where = _backend(loaded, options)
    print(f"kprender: {where}", file=sys.stderr)

    started = clock.monotonic()
    if out.suffix.lower() == ".mp4":
        pixels = _depth_pixels(scene, shots) if options.depth else _colour_pixels
        fps = _fps(loaded.clip, options)
        renderings = (render(shot.camera, shot.time) for shot in progress(shots, out.name, unit="frame"))
        write_video(out, (pixels(rendering) for rendering in renderings), fps)
        what = f"{out}: {len(shots)} frames at {fps:g} fps"
    else:
        for shot, path in zip(progress(shots, "render", unit="picture"), _paths(out, shots, options.format)):
            _write(path, render(shot.camera, shot.time), _depth_unit(scene, shots) if options.depth else None)
        what = f"{out}: {len(shots)} picture{'s' * (len(shots) != 1)}"
    elapsed = clock.monotonic() - started
    print(f"{what}, {shots[0].camera.width}x{shots[0].camera.height}, in {elapsed:.1f} s")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="kprender", description="Render a .kpc scene to pictures or a video, without a window."
    )
    cli.add_version_option(parser)
    parser.add_argument("scene", help="a .kpc file, or its http address")
    parser.add_argument(
        "-o",
        "--output",
        required=True,
        metavar="DIR|FILE",
        help="a directory for pictures, or an .mp4; for a single picture also a .png or .exr",
    )
    views = parser.add_mutually_exclusive_group()
    views.add_argument(
        "--cameras", metavar="JSON", help="cameras and times: w h fl_x fl_y cx cy frames[file time transform_matrix]"
    )
    views.add_argument(
        "--path",
        metavar="JSON",
        help="a smooth way through such cameras, that passes each `at` so many seconds (else 2 s apart)",
    )
    views.add_argument("--orbit", type=_count, metavar="N", help="N pictures along a path around the scene")
    parser.add_argument(
        "--time",
        type=_moment,
        metavar="T",
        help="in [0, 1] over the clip, for every picture "
        "(default: the times in --cameras, else from the clip's start to its end)",
    )
    parser.add_argument("--size", type=_size, metavar="WxH", help="of the pictures; the vertical field of view stays")
    parser.add_argument(
        "--depth",
        action="store_true",
        help="mp4: depth in grey instead of colour; png: a 16-bit "
        "NAME_depth.png beside each picture; exr: always holds depth, as Z",
    )
    part = parser.add_mutually_exclusive_group()
    part.add_argument(
        "--static-only",
        action="store_const",
        dest="part",
        const=Part.STATIC,
        help="what never moves: time planes set to 1",
    )
    part.add_argument(
        "--dynamic-only", action="store_const", dest="part", const=Part.DYNAMIC, help="|all of it - what never moves|"
    )
    part.add_argument(
        "--dynamic-map",
        action="store_true",
        help="what differs from what is there at other times in colour, the rest in grey",
    )
    parser.add_argument(
        "--appearance",
        metavar="NAME|A:B:0.3",
        help="show colours as the picture or camera NAME did, or so far from A's to B's (default: the average; "
        "kpinfo lists the names)",
    )
    parser.add_argument(
        "--format",
        choices=("png", "exr"),
        default="png",
        help="of pictures in a directory: 8-bit, or linear float colour and depth (default: %(default)s)",
    )
    parser.add_argument(
        "--fps",
        type=cli.frame_rate(SLOWEST, FASTEST),
        metavar="F",
        help="of an mp4, and of --path (default: the clip's)",
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
        help="gl: a rung of the player's ladder, from fastest to what the format says exactly (default: %(default)s)",
    )
    parser.set_defaults(part=Part.FULL)
    return parser


def _appearance(scene: Scene, text: str | None) -> np.ndarray | None:
    """The code that --appearance asks for: NAME, or ONE:OTHER:SHARE, which lies so far from one to the other; names may hold
    colons themselves. None, the average, where it asks for nothing.

    Raises:
        UsageError: the scene has no appearance of such a name, or the share lies outside [0, 1].
    """
    if text is None:
        return None
    names = {appearance.name for appearance in scene.appearances}
    pair, _, share = text.rpartition(":")
    if text in names or ":" not in pair:
        return scene.appearance(text)
    try:
        so_far = _moment(share)
    except argparse.ArgumentTypeError as error:
        raise UsageError(
            f"--appearance {text}: {share!r} is not a share in [0, 1]; give NAME or NAME:NAME:SHARE"
        ) from error
    cuts = [k for k, letter in enumerate(pair) if letter == ":"]
    cut = next((k for k in cuts if names.issuperset({pair[:k], pair[k + 1 :]})), cuts[0])
    return scene.interpolate_appearance(pair[:cut], pair[cut + 1 :], so_far)


def _count(text: str) -> int:
    if not text.isdecimal() or not 1 <= int(text) <= MOST:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of pictures from 1 to {MOST}")
    return int(text)


def _moment(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0.0 <= value <= 1.0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a time in [0, 1]")
    return value


def _size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text)
    if match is None or not all(1 <= int(n) <= LARGEST for n in match.groups()):
        raise argparse.ArgumentTypeError(f"{text!r} is not a size like 640x480, at most {LARGEST} a side")
    return int(match[1]), int(match[2])


def _fps(clip: Clip, options: argparse.Namespace) -> float:
    return float(options.fps or min(max(clip.fps, 1.0), FASTEST))


def _path_shots(clip: Clip, options: argparse.Namespace) -> list[View]:
    path, fps = CameraPath.load(options.path), _fps(clip, options)
    if (path.end_s - path.start_s) * fps >= MOST:
        raise UsageError(
            f"--path {options.path}: {path.end_s - path.start_s:g} s at {fps:g} fps are more than {MOST} pictures"
        )
    return path.views(fps)


def _shots(scene: Scene, clip: Clip, options: argparse.Namespace) -> list[View]:
    """What to take: a camera, a time and a name each."""
    if options.cameras is not None:
        shots = load_views(options.cameras)
    elif options.path is not None:
        shots = _path_shots(clip, options)
    else:
        views = (
            orbit(scene, options.orbit)
            if options.orbit
            else [Rig.of(scene).cameras[0]] * (1 if options.time is not None else clip.frame_count)
        )
        times = np.linspace(0.0, 1.0, len(views))
        shots = [View(camera, float(time), f"{number:04d}") for number, (camera, time) in enumerate(zip(views, times))]
    if options.time is not None:
        shots = [replace(shot, time=options.time) for shot in shots]
    if options.size is not None:
        shots = [replace(shot, camera=fit_camera(shot.camera, *options.size)) for shot in shots]
    elif options.cameras is not None and Path(options.output).suffix.lower() == ".mp4":
        first = shots[0].camera
        shots = [replace(shot, camera=fit_camera(shot.camera, first.width, first.height)) for shot in shots]
    return shots


def _backend(loaded: Scene | GroupedScene, options: argparse.Namespace) -> tuple[Render, str]:
    """How to render, and its name. OpenGL is looked for only where it is wanted."""
    _appearance(loaded.at(0.0)[0], options.appearance)
    shown = motion_colours if options.dynamic_map else _as_it_is
    if options.backend == "reference":

        def by_reference(camera: Camera, time: float) -> Rendering:
            return reference.blend(
                [
                    (
                        shown(
                            scene,
                            camera,
                            time,
                            reference.render(
                                scene,
                                camera,
                                time,
                                part=options.part,
                                appearance=_appearance(scene, options.appearance),
                            ),
                        ),
                        share,
                    )
                    for scene, time, share in loaded.blend_at(time)
                ]
            )

        return by_reference, "reference renderer (numpy)"
    from kpc.player.gl import offscreen
    from kpc.player.gl.renderer import Renderer

    ctx = offscreen.open_context()
    renderers: list[Renderer] = []

    def by_graphics(camera: Camera, time: float) -> Rendering:
        parts = loaded.blend_at(time)
        for gone in [one for one in renderers if all(one.scene is not scene for scene, *_ in parts)]:
            gone.release()
            renderers.remove(gone)
        pictures = []
        for scene, time, share in parts:
            renderer = next((one for one in renderers if one.scene is scene), None)
            if renderer is None:
                renderers.append(renderer := Renderer(ctx, scene, LEVELS[options.quality]))
            look = _appearance(scene, options.appearance)
            picture = renderer.render(camera, time, part=options.part, appearance=look)
            pictures.append((shown(scene, camera, time, picture), share))
        return reference.blend(pictures)

    return by_graphics, offscreen.describe(ctx)


def _as_it_is(scene: Scene, camera: Camera, time: float, rendering: Rendering) -> Rendering:
    return rendering


def _paths(out: Path, shots: list[View], suffix: str) -> Iterator[Path]:
    """Where each picture goes.

    A camera file may come from anywhere: of its names only the last part is used, and none twice.
    """
    if out.suffix.lower() in (".png", ".exr"):
        yield out
        return
    out.mkdir(parents=True, exist_ok=True)
    used: set[str] = set()
    for number, shot in enumerate(shots):
        stem = re.sub(r"[^\w.+-]", "_", re.split(r"[/\\]", shot.file)[-1].rsplit(".", 1)[0])[:120].lstrip(".")
        if not stem or stem in used:
            stem = f"{number:04d}" if not stem else f"{stem}_{number:04d}"
        used.add(stem)
        yield out / f"{stem}.{suffix}"


def _write(path: Path, rendering: Rendering, depth_unit: float | None) -> None:
    if path.suffix.lower() == ".exr":
        _write_exr(path, rendering)
        return
    write_image(path, _colour_pixels(rendering))
    if depth_unit is not None:
        levels = np.rint(np.minimum(rendering.depth / depth_unit, NOTHING - 1))
        levels[~np.isfinite(rendering.depth)] = NOTHING
        note = PngImagePlugin.PngInfo()
        note.add_text("depth_unit", repr(depth_unit))
        with cli.atomic_write(path.with_name(f"{path.stem}_depth.png")) as aside:
            Image.fromarray(levels.astype(np.uint16)).save(aside, pnginfo=note)


def _write_exr(path: Path, rendering: Rendering) -> None:
    """R, G, B in linear light (the inverse sRGB curve), Z in world units along the ray, inf where nothing is."""
    rgb = np.clip(rendering.rgb, 0, 1).astype(np.float64)
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4).astype(np.float32)
    channels = {"RGB": linear, "Z": np.ascontiguousarray(rendering.depth, np.float32)}
    with (
        cli.atomic_write(path) as aside,
        OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, channels) as exr,
    ):
        exr.write(str(aside))


def _colour_pixels(rendering: Rendering) -> np.ndarray:
    return np.rint(np.clip(rendering.rgb, 0, 1) * 255).astype(np.uint8)


def _farthest(scene: Scene, shots: list[View]) -> float:
    """The greatest distance from a camera to a corner of the scene's bounds: no depth exceeds it. In contracted space, where
    all that is farther counts as that far."""
    if isinstance(scene.mapping, Contraction):
        return FARTHEST_EVEN * scene.mapping.uniform_distance
    corners = np.array(list(itertools.product(*scene.bounds.T)))
    eyes = np.unique([shot.camera.camera_to_world[:3, 3] for shot in shots], axis=0)
    return float(np.linalg.norm(eyes[:, None] - corners, axis=2).max())


def _depth_unit(scene: Scene, shots: list[View]) -> float:
    """World units to one level of a depth PNG."""
    return _farthest(scene, shots) / (NOTHING - 1)


def _depth_pixels(scene: Scene, shots: list[View]) -> Callable[[Rendering], np.ndarray]:
    """Near is white, far is black, and so is nothing; in contracted space evenly by how far along the samples it is."""
    mapping, farthest = scene.mapping, _farthest(scene, shots)

    def pixels(rendering: Rendering) -> np.ndarray:
        if not isinstance(mapping, Contraction):
            near = np.where(np.isfinite(rendering.depth), 1 - np.minimum(rendering.depth / farthest, 1), 0)
        else:
            near = 1 - mapping.parameter(rendering.depth) / (2 * mapping.uniform_distance)
        return np.repeat(np.rint(near * 255).astype(np.uint8)[..., None], 3, axis=2)

    return pixels


if __name__ == "__main__":
    sys.exit(main())
