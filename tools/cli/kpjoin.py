"""kpjoin: join .kpc files into one clip.

    kpjoin part0.kpc part1.kpc part2.kpc -o long.kpc    groups of one clip, encoded with `kpenc --group 10s --only N`
    kpjoin first.kpc second.kpc -o both.kpc             one clip after the other

Nothing is encoded again: each file becomes a group of the clip, and one group is in memory at a time.
"""

import argparse
import sys
from pathlib import Path

from kpc.format.common import cli
from kpc.format.common.errors import UsageError
from kpc.format.container import groups


def main(argv: list[str] | None = None) -> int:
    """Run the command and return its exit code."""
    return cli.run(_command, "kpjoin", argv)


def _command(argv: list[str]) -> None:
    parser = argparse.ArgumentParser(
        prog="kpjoin",
        description="Join .kpc files into one clip. Groups of a clip are put in the order of their frames; other files "
        "follow one another in the given order.",
    )
    cli.add_version_option(parser)
    parser.add_argument("scenes", nargs="+", type=Path, metavar="SCENE", help=".kpc files")
    parser.add_argument(
        "-o", "--output", type=cli.output_file(".kpc"), required=True, metavar="FILE", help="the .kpc file to write"
    )
    options = parser.parse_args(argv)
    if len(options.scenes) < 2:
        raise UsageError(f"{options.scenes[0]}: a single file cannot be joined; give two or more")
    if options.output.exists() and any(options.output.samefile(scene) for scene in options.scenes):
        raise UsageError(f"{options.output}: is one of the inputs; choose another output with -o")
    parts = groups.group_inputs(options.scenes)
    size = groups.write(parts, options.output)
    clip = groups.Timeline(tuple(part.span for part in parts), parts[0].fps).clip
    duration = f"{clip.frame_count} frames at {clip.fps:g} fps, {clip.duration_s:.2f} s"
    print(f"{options.output}: {size:,} bytes, {len(parts)} groups, {duration}")


if __name__ == "__main__":
    sys.exit(main())
