"""kpjoin: several .kpc files become one clip.

kpjoin part0.kpc part1.kpc part2.kpc -o long.kpc      groups of one clip that were coded apart (`kpenc --group 10s --only N`)
kpjoin first.kpc second.kpc -o both.kpc               one clip after the other

Nothing is coded anew: each scene stays as it is, a group of the clip, and a group at a time is in memory.
"""

import argparse
import sys
from pathlib import Path

from kpc.format.common import cli
from kpc.format.common.errors import UsageError
from kpc.format.container import groups


def main(argv: list[str] | None = None) -> int:
    return cli.run(_command, "kpjoin", argv)


def _command(argv: list[str]) -> None:
    parser = argparse.ArgumentParser(
        prog="kpjoin",
        description="Several .kpc files become one clip. Groups of a clip know their frames and are put in order; other files "
        "follow one another as they are named.",
    )
    cli.add_version_option(parser)
    parser.add_argument("scenes", nargs="+", type=Path, metavar="SCENE", help=".kpc files")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="the .kpc file to write")
    options = parser.parse_args(argv)
    if len(options.scenes) < 2:
        raise UsageError(f"{options.scenes[0]}: one file is nothing to join; name two or more")
    if options.output.exists() and any(options.output.samefile(scene) for scene in options.scenes):
        raise UsageError(f"{options.output}: is to be joined itself; write elsewhere with -o")
    parts = groups.group_inputs(options.scenes)
    size = groups.write(parts, options.output)
    clip = groups.Timeline(tuple(part.span for part in parts), parts[0].fps).clip
    print(f"{options.output}: {size:,} bytes, {len(parts)} groups, {clip.frame_count} frames at {clip.fps:g} fps, "
          f"{clip.duration_s:.2f} s")  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
