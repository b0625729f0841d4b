"""kprender: render pictures and films of a scene without a window.

    kprender scene.kpc -o clip.mp4                            the clip, from the view that it opens with
    kprender scene.kpc --orbit 96 -o orbit.mp4                a path around the scene while the clip plays
    kprender scene.kpc --cameras cameras.json -o DIR          one picture for each frame that the file lists
    kprender scene.kpc --path path.json -o flight.mp4         a smooth path through the views that the file lists
    kprender scene.kpc --time 0.5 --size 960x720 -o still.png
    kprender scene.kpc --from 2 --to 4 --fps 60 -o slow.mov   two seconds of the clip as ProRes
    kprender scene.kpc --background transparent -o cut.webm   with alpha
    kprender scene.kpc --static-only --time 0 -o plate.png    without what moves
    kprender scene.kpc --dynamic-only --background transparent -o moves.mov
    kprender scene.kpc --with actor.kpc -o both.mp4           another scene in this one
    kprender scene.kpc --every-camera -o DIR                  what every camera sees, for kpenc to train on
    kprender scene.kpc --appearance dawn.jpg:dusk.jpg:0.3 -o clip.mp4

The player saves files for --cameras and --path.
"""

import argparse
import contextlib
import functools
import sys
import tempfile
import time as clock
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

import kpc
from kpc.format.common import cli
from kpc.format.common.errors import UsageError
from kpc.format.common.films import FilmFormat, write_film
from kpc.format.common.progress import progress
from kpc.format.common.text import NAMES_SHOWN, counted, escaped, notice
from kpc.format.container.groups import GroupedScene
from kpc.format.scene.scene import Scene
from kpc.player.cpu.reference import Part, Rendering
from kpc.tools.rendering import pictures, resuming, transforms
from kpc.tools.rendering.composition import played_clip
from kpc.tools.rendering.content import mean_picture, renderer_of
from kpc.tools.rendering.options import MAX_SIDE, parser
from kpc.tools.rendering.outputs import Output
from kpc.tools.rendering.shots import Shots, check_distance, rate_note, shots_of
from kpc.tools.rendering.sound import write_sound

# Contents that change colours and not depth, and their options.
CUT_BY_THE_MATTE = {"moving": "--dynamic-only", "matte": "--matte", "map": "--dynamic-map"}


def main(argv: list[str] | None = None) -> int:
    """Run the command and return its exit code."""
    return cli.run(_command, "kprender", argv)


def _command(argv: list[str]) -> None:
    options = parser().parse_args(argv)
    output = Output.of(options.output, options.format)
    film = _film_format(output, options)
    cli.check_writable(output.path, is_folder=output.is_folder)
    is_transparent = _resolve_background(output, options)
    loaded = kpc.load(options.scene)
    scene, _ = loaded.at(0.0)  # the first group of a long clip has the cameras and bounds of all
    others = _other_scenes(options)
    scenes = [scene, *(other.at(0.0)[0] for other in others)]
    clip = played_clip(loaded.clip, [other.clip for other in others])
    shots = shots_of(scene, clip, options, output.is_film)
    _check(shots, output, options, scenes)
    if (note := rate_note(clip, options)) is not None:
        _say(note)
    has_times = options.time is not None or any(shots.time(number) for number in shots.numbers)
    if options.cameras and clip.frame_count > 1 and not has_times:
        _say(f"{options.cameras}: all views are at the beginning of the clip; --time chooses another time")
    render, renderer = renderer_of(loaded, options, shots.times(), _say, others)
    _say(renderer)

    def picture(number: int) -> Rendering:
        # a matte is opacity, of which the mean is taken as it is
        has_opacity = is_transparent or options.content == "matte"
        return mean_picture(render, shots.instants(number), options.samples, has_opacity)

    started = clock.monotonic()
    if film is not None:
        with tempfile.TemporaryDirectory() as folder:
            sound = Path(folder) / "sound.wav"
            if reason := write_sound(sound, loaded, shots):
                _say(reason)
            what = _write_film(output, film, shots, picture, scenes, options, sound if sound.exists() else None)
    else:
        what = _write_pictures(output, shots, picture, scenes, options, is_transparent)
    print(escaped(f"{what}, in {clock.monotonic() - started:.1f} s"))


def _film_format(output: Output, options: argparse.Namespace) -> FilmFormat | None:
    """Return how to encode a film, None for pictures; refuse options that the output does not have."""
    if options.resume and not output.is_folder:
        what = "a film" if output.is_film else "a single picture"
        raise UsageError(
            f"--resume: {what} cannot be resumed; leave it out, or render pictures into a folder instead of "
            f"{options.output}"
        )
    if not output.is_film:
        asked = [name for name in ("codec", "crf", "bits") if getattr(options, name) is not None]
        if asked:
            raise UsageError(f"--{asked[0]} is for films; {options.output} is none")
        return None
    has_alpha = isinstance(options.background, str)
    try:
        return FilmFormat.of(output.suffix, options.codec, crf=options.crf, bits=options.bits, alpha=has_alpha)
    except UsageError as error:
        raise UsageError(f"-o {options.output}: {error}") from error


def _resolve_background(output: Output, options: argparse.Namespace) -> bool:
    """Set the background to black where it is transparent, and return whether it is.

    A matte is shown by opacity; it has no background.
    """
    is_drawing = (options.depth and output.is_film) or options.content in ("map", "matte")
    is_drawing |= options.part is not Part.FULL
    if options.content == "matte" and output.suffix == ".exr":
        raise UsageError(f"-o {options.output}: the matte is the channel A of --dynamic-only; or give .png")
    if is_drawing and options.background is not None:
        raise UsageError("--background: depth films, --dynamic-map, --matte and --diagnose have none; leave it out")
    if options.background is None and output.suffix == ".exr" and not is_drawing:
        options.background = "transparent"
    if not isinstance(options.background, str):
        return False
    if output.suffix in (".jpg", ".jpeg"):
        raise UsageError(f"-o {options.output}: JPEG has no alpha; give .png or .exr, or a background colour")
    options.background = np.zeros(3, np.float32)
    return True


def _check(shots: Shots, output: Output, options: argparse.Namespace, scenes: Sequence[Scene]) -> None:
    """Refuse several pictures for one file, pictures too large or scenes too far away to render, and films of two
    things at once."""
    if options.every_camera and not output.is_folder:
        raise UsageError(f"--every-camera: {output.path} is no folder; give a name without suffix or with / at its end")
    if options.depth and output.is_film and options.content in CUT_BY_THE_MATTE:
        raise UsageError(f"--depth: a film shows depth or {CUT_BY_THE_MATTE[options.content]}; leave one of them out")
    if options.depth and output.suffix == ".exr":
        raise UsageError("--depth: .exr pictures always hold the depth as channel Z; leave it out, or give .png")
    if not output.is_film and not output.is_folder and len(shots) != 1:
        raise UsageError(
            f"-o {output.path}: {len(shots)} pictures do not go into one file; give a folder, a film or --time"
        )
    for name, other in zip(options.others, scenes[1:], strict=True):
        for number in shots.numbers:
            check_distance(other, shots.camera(number), f"--with {name}: ")
    for number in shots.numbers if options.cameras or options.every_camera else shots.numbers[:1]:
        camera = shots.camera(number)
        if max(camera.width, camera.height) * options.samples > MAX_SIDE:
            raise UsageError(
                f"{camera.width}x{camera.height} with --samples {options.samples} is more than {MAX_SIDE} a side; "
                "choose a smaller --size or fewer samples"
            )


def _other_scenes(options: argparse.Namespace) -> list[Scene | GroupedScene]:
    """Return the scenes of --with; refuse them where what is shown is no scene."""
    if options.others and (options.content in ("map", "matte") or options.part is not Part.FULL):
        raise UsageError("--with: --matte, --dynamic-map and --diagnose show one scene; leave one of them out")
    return [kpc.load(name) for name in options.others]


def _write_film(
    output: Output,
    film: FilmFormat,
    shots: Shots,
    picture: Callable[[int], Rendering],
    scenes: Sequence[Scene],
    options: argparse.Namespace,
    sound: Path | None,
) -> str:
    """Render and encode a film; return what was written."""
    camera = shots.camera(shots.numbers[0])
    padded = film.padded(camera.width, camera.height)
    if padded != (camera.width, camera.height):
        _say(f"{output.path.name}: its codec needs even sides: the last row or column is repeated")
    if options.depth:
        cameras = [shots.camera(number) for number in shots.numbers]
        pixels = pictures.depth_pixels(scenes, cameras, film.bits)
    else:
        pixels = functools.partial(pictures.colour_pixels, is_transparent=film.has_alpha, bits=film.bits)
    frames = (pixels(picture(number)) for number in progress(shots.numbers, output.path.name, unit="frames"))
    write_film(output.path, frames, shots.fps, film, sound)
    size = f"{camera.width}x{camera.height}"
    size += "" if padded == (camera.width, camera.height) else f" (padded to {padded[0]}x{padded[1]})"
    heard = "" if sound is None else ", with sound"
    return f"{output.path}: {counted(len(shots), 'frame')} at {shots.fps:g} fps, {size}{heard}"


def _write_pictures(
    output: Output,
    shots: Shots,
    picture: Callable[[int], Rendering],
    scenes: Sequence[Scene],
    options: argparse.Namespace,
    is_transparent: bool,
) -> str:
    """Render and write pictures; return what was written."""
    unit = None
    if options.depth:
        unit = pictures.depth_unit(scenes, [shots.camera(number) for number in shots.numbers])
    names = [shots.name(number) for number in shots.numbers]
    paths, renamed = output.picture_paths(names, options.depth)
    if renamed:
        one, more = "gets another name, for its own is", "get other names, for theirs are"
        what = f"{one} taken or no plain file name" if len(renamed) == 1 else f"{more} taken or no plain file names"
        now = ", ".join(f"{name!r} becomes {new}" for name, new in renamed[:NAMES_SHOWN])
        now += ", ..." if len(renamed) > NAMES_SHOWN else ""
        _say(f"{options.cameras or '--every-camera'}: {counted(len(renamed), 'picture')} {what}: {now}")
    wanted = list(zip(shots.numbers, paths, strict=True))
    with contextlib.ExitStack() as alone:
        if output.is_folder:
            cli.make_folder(output.path)
            if options.every_camera:
                transforms.check_folder(output.path)
            alone.enter_context(resuming.rendering(output.path, options, is_transparent, paths))
            if options.every_camera:
                transforms.begin(output.path)
        if options.resume:
            wanted = [
                (number, path)
                for number, path in wanted
                if not pictures.is_complete(path, shots.camera(number), options.depth)
            ]
        for number, path in progress(wanted, "render", unit="pictures"):
            pictures.write_picture(path, picture(number), is_transparent, unit)
        if options.every_camera:
            transforms.write_transforms(output.path, shots, paths)
    there = f" ({len(shots) - len(wanted)} were there)" if len(wanted) < len(shots) else ""
    camera = shots.camera(shots.numbers[0])
    return f"{output.path}: {counted(len(shots), 'picture')}{there}, {camera.width}x{camera.height}"


def _say(text: str) -> None:
    notice(f"kprender: {text}")


if __name__ == "__main__":
    sys.exit(main())
