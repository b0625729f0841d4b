"""kpjoin: join .kpc files into one clip.

    kpjoin part0.kpc part1.kpc part2.kpc -o long.kpc    groups of one clip, encoded with `kpenc --group 10s --only N`
    kpjoin first.kpc second.kpc -o both.kpc             one clip after the other
    kpjoin slow.kpc fast.kpc -o both.kpc --fps 30       clips of different frame rates

Nothing is encoded again: each file becomes a group of the clip, and one group is in memory at a time.
"""

import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from kpc.format.common import cli
from kpc.format.common.errors import UsageError
from kpc.format.common.text import counted, escaped, notice
from kpc.format.container import groups
from kpc.format.scene.metadata import camera_document, differences
from kpc.tools.editing.clips import Edits, edit
from kpc.tools.editing.timing import MAX_FPS, MIN_FPS


def main(argv: list[str] | None = None) -> int:
    """Run the command and return its exit code."""
    return cli.run(_command, "kpjoin", argv)


def _command(argv: list[str]) -> None:
    parser = cli.Parser(
        prog="kpjoin",
        description="Join .kpc files into one clip. Parts of one clip are put in the order of their frames; other "
        "files follow one another in the given order.",
    )
    cli.add_version_option(parser)
    parser.add_argument("scenes", nargs="+", type=cli.input_path, metavar="SCENE", help=".kpc files")
    parser.add_argument(
        "-o", "--output", type=cli.output_file(".kpc"), required=True, metavar="FILE", help="the .kpc file to write"
    )
    parser.add_argument(
        "--fps",
        type=cli.frame_rate(MIN_FPS, MAX_FPS),
        metavar="F",
        help="frames per second of the clip; files of other rates are as long as before from the first frame to the "
        "last, to half a frame, which then lasts 1 / F s",
    )
    options = parser.parse_args(argv)
    if len(options.scenes) < 2:
        what = "is a folder" if options.scenes[0].is_dir() else "a single file cannot be joined"
        raise UsageError(f"{options.scenes[0]}: {what}; give two or more files")
    cli.refuse_sources(options.output, *options.scenes)
    cli.check_writable(options.output)
    with tempfile.TemporaryDirectory(dir=options.output.parent) as folder:
        _check_belonging(options.scenes)
        parts = groups.group_inputs(options.scenes)
        groups.check_parts(parts)
        if options.fps is not None:
            parts = groups.group_inputs(_at_rate(options.scenes, options.fps, Path(folder)))
        size = groups.write(parts, options.output)
    clip = groups.Timeline(tuple(part.span for part in parts), parts[0].fps).clip
    duration = f"{counted(clip.frame_count, 'frame')} at {clip.fps:g} fps, {clip.total_s:.2f} s"
    if differing := differences([part.metadata for part in parts]):
        notice(f"kpjoin: the files differ, so the clip has no {', '.join(differing)}")
    if _cameras_differ(options.scenes):
        notice("kpjoin: the files have different cameras; those of the first stand for the clip")
    print(escaped(f"{options.output}: {size:,} bytes, {len(parts)} groups, {duration}"))


def _check_belonging(scenes: Sequence[Path]) -> None:
    """Check that files can be parts of one clip, if one of them begins later than with frame 0, as only a part does.

    Raises:
        UsageError: another one is a clip of its own, begins with frame 0 as another does, or is of another dataset.
    """
    opened = [groups.Groups(scene) for scene in scenes]
    later = next((one for one in opened if one.timeline.spans[0].start), None)
    if later is None:
        return
    part = f"{later.name} a part of a clip, from frame {later.timeline.spans[0].start} on"
    first: groups.Groups | None = None
    for one in opened:
        if one.is_single:
            raise UsageError(f"{one.name}: is a clip of its own, and {part}; join the parts of that clip by themselves")
        if one.timeline.spans[0].start == 0:
            if first is not None:
                if one.name == first.name:
                    raise UsageError(f"{one.name}: is given twice; give it once")
                both = f"begins with frame 0, as {first.name} does"
                raise UsageError(f"{one.name}: {both}, and {part}; give one first part only")
            first = one
        datasets = [found.metadata().provenance.get("dataset_sha256") for found in (one, later)]
        if None not in datasets and datasets[0] != datasets[1]:
            raise UsageError(f"{one.name}: is of another dataset than {later.name}, so they are no parts of one clip")


def _cameras_differ(scenes: Sequence[Path]) -> bool:
    first, *others = ([camera_document(camera) for camera in groups.Groups(scene).cameras()] for scene in scenes)
    return any(one != first for one in others)


def _at_rate(scenes: Sequence[Path], fps: float, folder: Path) -> list[Path]:
    """Return files of one frame rate; those that have another are written to `folder`."""
    found = []
    for number, scene in enumerate(scenes):
        opened = groups.Groups(scene)
        if opened.clip.fps != fps:
            edit(scene, folder / f"{number}-{scene.name}", Edits(fps=fps), opened.metadata())
            scene = folder / f"{number}-{scene.name}"
        found.append(scene)
    return found


if __name__ == "__main__":
    sys.exit(main())
