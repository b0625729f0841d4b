"""kpplay: fly through a scene in a window.

kpplay scene.kpc
kpplay https://host/scene.kpc                          plays while it arrives
kpplay scene.kpc --size 1280x720
kpplay scene.kpc --quality fast                        from fastest to reference; --target-fps 30 chooses by itself
kpplay scene.kpc --path path.json --folder films       a camera path to follow; where films and screenshots go
kpplay scene.kpc --frames 30 --screenshot out.png      draw so many frames, save the window, leave
"""

import argparse
import errno
import os
import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from kpc.format.common import cli
from kpc.format.common.errors import ContextLostError, UsageError
from kpc.format.container.container import DEFAULT_BUDGET, open_source
from kpc.player.app import preferences
from kpc.player.app.camera_paths import CameraPath
from kpc.player.app.preferences import TARGET_FPS, WINDOW_SIDES, Preferences
from kpc.player.app.resolution_controller import GPU_FPS
from kpc.player.quality import LEVELS
from kpc.player.viewpoints import Rig

if TYPE_CHECKING:
    from kpc.player.streaming.group_playback import GroupPlayback

HEIGHT = 720
MOST_RESETS = 3
"""Of the graphics card, before it is given up."""


def main(argv: list[str] | None = None) -> int:
    return cli.run(_command, "kpplay", argv)


def _command(argv: list[str]) -> None:
    options = _parser().parse_args(argv)
    if options.frames is not None and options.frames < 1:
        raise UsageError(f"--frames {options.frames} is not positive")
    if options.screenshot is not None and Path(options.screenshot).suffix.lower() != ".png":
        raise UsageError(f"--screenshot {options.screenshot} is no .png")
    if not Path(options.folder).is_dir():
        raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), options.folder)
    path = None if options.path is None else CameraPath.load(options.path)

    from kpc.player.streaming.group_playback import (
        GroupPlayback,
    )  # only now: what is wrong with the options is told without OpenGL's libraries

    lasting = (
        preferences.preferences_path() if options.frames is None else None
    )  # counted frames are a test, which leaves no trace
    stream = GroupPlayback(open_source(options.scene, limit=options.memory), memory=options.memory)
    wanted = _over(preferences.load(lasting) if lasting else Preferences(), options)
    last = _play(stream, wanted, options, path)
    if lasting is not None:
        try:
            preferences.save(last, lasting)
        except OSError as error:
            print(f"kpplay: settings are not remembered: {lasting}: {error.strerror or error}", file=sys.stderr)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="kpplay", description="Fly through a .kpc scene. Press H for the keys.")
    cli.add_version_option(parser)
    parser.add_argument("scene", help="a .kpc file, or its http address")
    parser.add_argument(
        "--size",
        type=_size,
        metavar="WxH",
        help=f"of the window (default: as it was; {HEIGHT} high, as wide as the camera)",
    )
    parser.add_argument(
        "--memory",
        type=cli.byte_count,
        default=DEFAULT_BUDGET,
        metavar="500MB",
        help="for the scene, on the processor's side and on the graphics card's together (default: %(default)s bytes)",
    )
    parser.add_argument(
        "--quality", choices=list(LEVELS), help="how finely to draw (default: as it was; else what the device is up to)"
    )
    parser.add_argument(
        "--target-fps",
        type=cli.frame_rate(*TARGET_FPS),
        metavar="F",
        help="hold so many frames a second by moving the quality "
        f"(default: as it was; else a graphics card holds {GPU_FPS:.0f})",
    )
    parser.add_argument("--path", metavar="JSON", help="a camera path, as saved before, for J to follow")
    parser.add_argument(
        "--folder",
        default=".",
        metavar="DIR",
        help="for screenshots, videos and camera paths (default: the working directory)",
    )
    parser.add_argument(
        "--frames", type=int, metavar="N", help="leave after N frames, and neither take nor leave settings"
    )
    parser.add_argument("--screenshot", metavar="PNG", help="save the window when leaving")
    return parser


def _over(remembered: Preferences, options: argparse.Namespace) -> Preferences:
    """What is asked for goes before what is remembered; a quality that is asked for is not moved by itself."""
    target_fps = options.target_fps or (None if options.quality else remembered.target_fps)
    return replace(
        remembered,
        size=options.size or remembered.size,
        quality=options.quality or remembered.quality,
        target_fps=target_fps,
    )


def _play(
    stream: "GroupPlayback", wanted: Preferences, options: argparse.Namespace, path: CameraPath | None
) -> Preferences:
    """From the first scene to the last that is dragged in, and over a graphics card that is reset; what to remember."""
    from kpc.player.app.window import Player, Window  # only now: a scene that cannot be read is told without a display
    from kpc.player.streaming.group_playback import GroupPlayback

    window = Window("kpplay", wanted.size or _opening_size(stream))
    before, resets = None, 0
    try:
        while True:
            window.name(f"{Path(stream.source.name).name} - kpplay")
            player = Player(window, stream, wanted, before=before, folder=Path(options.folder))
            player.path, path = path or player.path, None
            before = None
            try:
                player.run(options.frames)
                if options.screenshot is not None and player.successor is None:
                    player.screenshot(Path(options.screenshot))
            except ContextLostError:
                resets, before = resets + 1, player
                if resets > MOST_RESETS:
                    raise
            finally:
                wanted = player.preferences()
                if (told := player.close()) is not None:
                    print(f"kpplay: {told}", file=sys.stderr)
            if before is not None:
                window.close()
                stream.close()
                window = Window("kpplay", wanted.size or _opening_size(stream))
                stream = GroupPlayback(open_source(stream.source.name, limit=options.memory), memory=options.memory)
            elif player.successor is not None:
                stream.close()
                stream = player.successor
            else:
                return wanted
    finally:
        stream.close()  # before the window goes that it wakes
        window.close()


def _opening_size(stream: "GroupPlayback") -> tuple[int, int]:
    camera = Rig.of(stream.scene).cameras[0]
    return min(max(round(HEIGHT * camera.width / camera.height), 480), 1600), HEIGHT


def _size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text)
    if match is None or not all(int(n) in WINDOW_SIDES for n in match.groups()):
        raise argparse.ArgumentTypeError(f"{text!r} is not a size like 1280x720, at least {WINDOW_SIDES[0]} a side")
    return int(match[1]), int(match[2])


if __name__ == "__main__":
    sys.exit(main())
