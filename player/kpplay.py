"""kpplay: fly through a scene in a window.

kpplay scene.kpc
kpplay https://host/scene.kpc                          plays while it arrives
kpplay scene.kpc --size 1280x720
kpplay scene.kpc --frames 30 --screenshot out.png      draw so many frames, save the window, leave
"""

import argparse
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from kpc.format import cli
from kpc.format.container import DEFAULT_BUDGET, open_source
from kpc.format.errors import UsageError
from kpc.player.orbit import Rig

if TYPE_CHECKING:
    from kpc.player.stream import Stream

HEIGHT = 720
SIZES = range(64, 16385)


def main(argv: list[str] | None = None) -> int:
    return cli.run(_command, "kpplay", argv)


def _command(argv: list[str]) -> None:
    parser = argparse.ArgumentParser(prog="kpplay", description="Fly through a .kpc scene. Press H for the keys.")
    parser.add_argument("scene", help="a .kpc file, or its http address")
    parser.add_argument(
        "--size", type=_size, metavar="WxH", help=f"of the window (default: {HEIGHT} high, as wide as the camera)"
    )
    parser.add_argument(
        "--memory",
        type=cli.byte_count,
        default=DEFAULT_BUDGET,
        metavar="500MB",
        help="for the scene, on the processor's side and on the graphics card's together (default: %(default)s bytes)",
    )
    parser.add_argument("--frames", type=int, metavar="N", help="leave after N frames")
    parser.add_argument("--screenshot", metavar="PNG", help="save the window when leaving")
    options = parser.parse_args(argv)
    if options.frames is not None and options.frames < 1:
        raise UsageError(f"--frames {options.frames} is not positive")
    if options.screenshot is not None and Path(options.screenshot).suffix.lower() != ".png":
        raise UsageError(f"--screenshot {options.screenshot} is no .png")

    from kpc.player.stream import Stream  # only now: what is wrong with the options is told without OpenGL's libraries

    stream = Stream(open_source(options.scene, limit=options.memory), memory=options.memory)
    try:
        camera = Rig.of(stream.scene).cameras[0]
        size = options.size or (min(max(round(HEIGHT * camera.width / camera.height), 480), 1600), HEIGHT)
        _play(stream, size, options.frames, options.screenshot)
    finally:
        stream.close()


def _play(stream: "Stream", size: tuple[int, int], frames: int | None, screenshot: str | None) -> None:
    from kpc.player.window import Player, Window  # only now: a scene that cannot be read is told without a display

    window = Window(f"{Path(stream.source.name).name} - kpplay", size)
    try:
        player = Player(window, stream)
        try:
            player.run(frames)
            if screenshot is not None:
                player.screenshot(Path(screenshot), with_controls=True)
        finally:
            player.close()
    finally:
        stream.close()  # before the window goes that it wakes
        window.close()


def _size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text)
    if match is None or not all(int(n) in SIZES for n in match.groups()):
        raise argparse.ArgumentTypeError(f"{text!r} is not a size like 1280x720, at least {SIZES[0]} a side")
    return int(match[1]), int(match[2])


if __name__ == "__main__":
    sys.exit(main())
