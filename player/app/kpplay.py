"""kpplay: play a scene in a window.

kpplay scene.kpc
kpplay https://host/scene.kpc                          plays while it arrives
kpplay one.kpc two.kpc, kpplay folder                  several; Page Up and Page Down go through them
kpplay scene.kpc --size 1280x720
kpplay scene.kpc --quality fast                        a quality level, from fastest to reference
kpplay scene.kpc --target-fps 30                       changes the quality to hold a frame rate
kpplay scene.kpc --path path.json --folder videos      a camera path to follow; where videos and screenshots go
kpplay scene.kpc --frames 30 --screenshot out.png      show 30 frames, save the window, and exit
kpplay --web scene.kpc                                 plays in the browser of this machine
"""

import argparse
import os
import re
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from kpc.format.common import cli
from kpc.format.common.errors import ContextLostError, KpcError, UsageError
from kpc.format.common.memory import DEFAULT_BUDGET
from kpc.format.common.text import notice
from kpc.format.container.sources import RemoteSource, open_source
from kpc.format.scene.rig import Rig
from kpc.player.app import preferences
from kpc.player.app.camera_paths import CameraPath
from kpc.player.app.controls import Playback
from kpc.player.app.playlist import Playlist, menu_names
from kpc.player.app.preferences import MIN_WINDOW, TARGET_FPS, WINDOW_SIDES, Preferences
from kpc.player.app.resolution_controller import GPU_FPS
from kpc.player.quality import LEVELS

if TYPE_CHECKING:
    from kpc.player.streaming.group_playback import GroupPlayback

# Height of the window on a first run, and bounds of its width, which follows from the scene's first camera.
DEFAULT_HEIGHT, MIN_WIDTH, MAX_WIDTH = 720, 480, 1600
# Resets of the graphics card after which kpplay gives up.
MAX_RESETS = 3
# Options that a page in a browser does not have.
WINDOW_OPTIONS = ("size", "quality", "target_fps", "path", "folder", "frames", "screenshot")


def main(argv: list[str] | None = None) -> int:
    """Run the command; return its exit status."""
    return cli.run(_command, "kpplay", argv)


def _command(argv: list[str]) -> None:
    options = _parser().parse_args(argv)
    if options.web:
        _play_in_browser(options)
        return
    options.memory = DEFAULT_BUDGET if options.memory is None else options.memory
    if options.screenshot is not None:
        cli.check_writable(options.screenshot, option="--screenshot")
    if options.folder is not None:
        cli.check_writable(Path(options.folder), is_folder=True, option="--folder")
        cli.make_folder(Path(options.folder))
    path = None if options.path is None else CameraPath.load(options.path)

    # Imported here so that errors in the options are reported without OpenGL's libraries.
    from kpc.player.streaming.group_playback import GroupPlayback

    # A run of a fixed number of frames is a test: it neither reads nor writes settings.
    file = preferences.preferences_path() if options.frames is None else None
    if file is not None and options.size is not None:
        options.size = _usable_size(options.size)
    settings = _merged(preferences.load(file) if file else Preferences(), options)
    playlist = Playlist.named(options.scenes, settings.recent)
    stream = GroupPlayback(open_source(playlist.files[0], limit=options.memory), memory=options.memory)
    failures: list[str] = []

    def save(settings: Preferences) -> None:
        if file is not None:
            preferences.save(settings, file)

    last_settings = _play(stream, settings, options, path, playlist, failures, save)
    try:
        save(last_settings)
    except OSError as error:
        notice(f"kpplay: settings were not saved: {file}: {error.strerror or error}")
    if failures:
        raise KpcError(f"loading stopped: {'; '.join(failures)}")


def _play_in_browser(options: argparse.Namespace) -> None:
    given = [name for name in WINDOW_OPTIONS if getattr(options, name) is not None]
    if given:
        raise UsageError(f"--{given[0].replace('_', '-')}: is for the window; the page has its own, leave out --web")
    from kpc.player.sharing.web_view import play_in_browser

    play_in_browser(Playlist.named(options.scenes).files, options.memory)


def _parser() -> argparse.ArgumentParser:
    parser = cli.Parser(prog="kpplay", description="Play a .kpc scene in a window. Press H there for the list of keys.")
    cli.add_version_option(parser)
    parser.add_argument(
        "scenes",
        type=cli.file_name,
        nargs="+",
        metavar="scene",
        help="a .kpc file, its http address, or a folder of .kpc files; of several, the first one is shown first",
    )
    parser.add_argument(
        "--size",
        type=_size,
        metavar="WxH",
        help="size of the window, at least {}x{}, or any with --frames (default: as last time; at first {} high, "
        "shaped as the pictures)".format(*MIN_WINDOW, DEFAULT_HEIGHT),
    )
    parser.add_argument(
        "--memory",
        type=cli.byte_count,
        metavar="500MB",
        help="limit for the scene, in main memory and on the graphics card together (default: "
        f"{DEFAULT_BUDGET / 1e9:.3g}GB; with --web, what the player in pages has)",
    )
    quality = parser.add_mutually_exclusive_group()
    quality.add_argument(
        "--quality",
        choices=list(LEVELS),
        help="quality level, which then stays (default: as last time; at first chosen for the device)",
    )
    quality.add_argument(
        "--target-fps",
        type=cli.frame_rate(*TARGET_FPS),
        metavar="F",
        help="hold this frame rate by changing the quality "
        f"(default: as last time; at first {GPU_FPS:.0f} on a graphics card)",
    )
    parser.add_argument(
        "--path", type=cli.file_name, metavar="JSON", help="a saved camera path, which the key J follows"
    )
    parser.add_argument(
        "--folder",
        type=cli.output_name,
        metavar="DIR",
        help="for screenshots, videos and camera paths; it is made (default: the working directory)",
    )
    parser.add_argument(
        "--frames",
        type=partial(cli.whole_number, low=1),
        metavar="N",
        help="exit after N frames; settings are neither read nor saved",
    )
    parser.add_argument("--web", action="store_true", help="play in the browser of this machine, without a window")
    parser.add_argument("--screenshot", type=cli.output_file(".png"), metavar="PNG", help="save the window at the end")
    return parser


def _merged(saved: Preferences, options: argparse.Namespace) -> Preferences:
    """Return settings in which options replace saved ones. A quality that is asked for is not changed automatically."""
    target_fps = options.target_fps or (None if options.quality else saved.target_fps)
    return replace(
        saved,
        size=options.size or saved.size,
        quality=options.quality or saved.quality,
        target_fps=target_fps,
    )


def _play(
    stream: "GroupPlayback",
    settings: Preferences,
    options: argparse.Namespace,
    path: CameraPath | None,
    playlist: Playlist,
    failures: list[str],
    save: Callable[[Preferences], None],
) -> Preferences:
    """Play the scene and others that are opened in the window; return the settings to save.

    Recent files are saved when they are opened, since a player may be killed. Why the loading of a scene stopped is
    added to `failures`.
    """
    # Imported here so that a scene that cannot be read is reported without a display.
    from kpc.player.app.player import Player
    from kpc.player.app.window import Window
    from kpc.player.streaming.group_playback import GroupPlayback

    window = Window("kpplay", settings.size or _default_size(stream))
    interrupted, resets, file = None, 0, playlist.files[0]
    before: Playback | None = None
    try:
        while True:
            name, is_remote = stream.source.name, isinstance(stream.source, RemoteSource)
            playlist.opened(file, name if is_remote else os.path.abspath(name))
            with suppress(OSError):  # which is reported at the end
                save(replace(settings, recent=playlist.recent))
            window.set_title(_title(stream.metadata.title, playlist))
            player = Player(
                window, stream, settings, resume_from=interrupted, folder=Path(options.folder or "."), playlist=playlist
            )
            if before is not None:
                player.state.play_like(before)
            if stream.notice is not None and interrupted is None:
                notice(f"kpplay: {stream.notice}")
                player.state.notify_error(stream.notice)  # for long enough to outlast a slow first picture
            if path is not None:
                player.state.follower.replace(path)
            path = interrupted = None
            try:
                player.run(options.frames)
                if options.screenshot is not None and player.successor is None:
                    player.screenshot(options.screenshot)
            except ContextLostError:
                resets, interrupted = resets + 1, player
                if resets > MAX_RESETS:
                    raise
            finally:
                if stream.failure is not None and stream.failure not in failures:
                    failures.append(stream.failure)
                settings = player.preferences()
                if (report := player.close()) is not None:
                    notice(f"kpplay: {report}")
            if interrupted is not None:
                window.close()
                stream.close()
                window = Window("kpplay", settings.size or _default_size(stream))
                # A remote source alone knows its address; the name lacks what is secret.
                source = stream.source
                source = source.clone() if isinstance(source, RemoteSource) else open_source(source.name)
                stream = GroupPlayback(source, memory=options.memory)
            elif player.successor is not None:
                stream.close()
                stream, file, before = player.successor, player.actions.successor_file, player.state.playback
            else:
                return settings
    finally:
        stream.close()  # before the window, which its threads wake
        window.close()


def _title(title: str, playlist: Playlist) -> str:
    """Return the title of the window: that of the scene, which several may have, and the name of its file."""
    file = menu_names(playlist.files)[playlist.position]
    return f"{title} ({file}) - kpplay" if title else f"{file} - kpplay"


def _default_size(stream: "GroupPlayback") -> tuple[int, int]:
    camera = Rig.of(stream.scene).cameras[0]
    return min(max(round(DEFAULT_HEIGHT * camera.width / camera.height), MIN_WIDTH), MAX_WIDTH), DEFAULT_HEIGHT


def _usable_size(size: tuple[int, int]) -> tuple[int, int]:
    """Return a size in which nothing is cut off; say so if it is another."""
    width, height = map(max, size, MIN_WINDOW)
    if (width, height) != size:
        given, least = ("{}x{}".format(*one) for one in (size, MIN_WINDOW))
        notice(f"kpplay: --size {given}: a window is at least {least}, so this one is {width}x{height}")
    return width, height


def _size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text)
    if match is None or not all(int(n) in WINDOW_SIDES for n in match.groups()):
        raise argparse.ArgumentTypeError(f"{text!r} is not a size like 1280x720, at least {WINDOW_SIDES[0]} a side")
    return int(match[1]), int(match[2])


if __name__ == "__main__":
    sys.exit(main())
