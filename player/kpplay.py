"""kpplay: fly through a scene in a window.

kpplay scene.kpc
kpplay scene.kpc --size 1280x720
kpplay scene.kpc --frames 30 --screenshot out.png      draw so many frames, save the window, leave
"""

import argparse
import re
import sys
from pathlib import Path

import kpc
from kpc.format import cli
from kpc.format.errors import UsageError
from kpc.player.orbit import Rig

HEIGHT = 720
SIZES = range(64, 16385)


def main(argv: list[str] | None = None) -> int:
    return cli.run(_command, "kpplay", argv)


def _command(argv: list[str]) -> None:
    parser = argparse.ArgumentParser(prog="kpplay", description="Fly through a .kpc scene. Press H for the keys.")
    parser.add_argument("scene", help="a .kpc file")
    parser.add_argument(
        "--size", type=_size, metavar="WxH", help=f"of the window (default: {HEIGHT} high, as wide as the camera)"
    )
    parser.add_argument("--frames", type=int, metavar="N", help="leave after N frames")
    parser.add_argument("--screenshot", metavar="PNG", help="save the window when leaving")
    options = parser.parse_args(argv)
    if options.frames is not None and options.frames < 1:
        raise UsageError(f"--frames {options.frames} is not positive")
    if options.screenshot is not None and Path(options.screenshot).suffix.lower() != ".png":
        raise UsageError(f"--screenshot {options.screenshot} is no .png")

    scene = kpc.load(options.scene)
    camera = Rig.of(scene).cameras[0]
    size = options.size or (min(max(round(HEIGHT * camera.width / camera.height), 480), 1600), HEIGHT)

    from kpc.player.window import Player, Window  # only now: a file that cannot be read is told without a display

    window = Window(f"{Path(options.scene).name} - kpplay", size)
    try:
        player = Player(window, scene, options.scene)
        try:
            player.run(options.frames)
            if options.screenshot is not None:
                player.screenshot(Path(options.screenshot), with_controls=True)
        finally:
            player.close()
    finally:
        window.close()


def _size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text)
    if match is None or not all(int(n) in SIZES for n in match.groups()):
        raise argparse.ArgumentTypeError(f"{text!r} is not a size like 1280x720, at least {SIZES[0]} a side")
    return int(match[1]), int(match[2])


if __name__ == "__main__":
    sys.exit(main())
