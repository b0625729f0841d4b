"""Checks of whole windows: how they open, clips in groups, defaults, resets of the graphics card, saved settings."""

import contextlib
import io
import os
import shutil
import threading
from collections.abc import Callable

import numpy as np
from pytest import approx, raises

from kpc.format.common.errors import DisplayError
from kpc.format.common.images import read_image
from kpc.format.container import groups
from kpc.format.container.sources import open_source
from kpc.format.scene.scene import Scene
from kpc.player.app import kpplay
from kpc.player.app import player as player_module
from kpc.player.app import window as window_module
from kpc.player.app.desktop import glfw
from kpc.player.app.player import Player
from kpc.player.app.preferences import Preferences, load, preferences_path
from kpc.player.app.quality_controller import LEVEL_NAMES
from kpc.player.app.recording import FILM_FPS
from kpc.player.app.window import Window
from kpc.player.cpu import loading
from kpc.player.quality import DEFAULT, neighbouring_level
from kpc.player.streaming.group_playback import GroupPlayback
from player_driver import frames_until, press, replaced


def opening_asks_for_older_opengl() -> None:
    """Where there is no OpenGL 4.3, as on macOS, 3.3 is asked for; where there is neither, an error says so."""
    create = glfw.create_window
    attempts: list[object] = []

    def failing(times: int) -> Callable[..., object]:
        def attempt(*arguments: object) -> object:
            attempts.append(arguments)
            return create(*arguments) if len(attempts) > times else None

        return attempt

    with replaced(glfw, create_window=failing(1)):
        window = Window("test", (64, 64))
    assert len(attempts) == 2 and window.ctx.version_code >= 330
    window.close()
    window.close()
    attempts.clear()
    with replaced(glfw, create_window=failing(2)), raises(DisplayError, match="kprender"):
        Window("test", (64, 64))


def groups_of_a_clip(window: Window, scene_file: str) -> None:
    """Each group of a clip is shown at its time, with the quality and the appearance that were chosen."""
    groups.write(groups.group_inputs([scene_file, scene_file]), "twice.kpc")
    stream = GroupPlayback(open_source("twice.kpc"))
    player = Player(window, stream, Preferences())
    press(player, glfw.KEY_SPACE)
    player.state.appearance.select(2)
    press(player, "-")
    level, times = player.snapshot().level, []
    for key, number in ((glfw.KEY_END, 1), (glfw.KEY_LEFT, 1), (glfw.KEY_HOME, 0)):
        player.press(key)
        frames_until(player, lambda n=number: stream.number == n and stream.is_settled and player.snapshot().is_sharp)
        assert player.state.scene is player.state.appearance.scene is stream.scene
        assert player.snapshot().appearance == "noon.jpg" and player.snapshot().level == level
        times.append((player.snapshot().time, stream.time_in(player.snapshot().time)))
    assert np.allclose(times, [(1.0, 1.0), (20 / 21, 0.9), (0.0, 0.0)], atol=1e-6)
    press(player, glfw.KEY_SPACE)  # from here the clip plays into the second group
    frames_until(player, lambda: player.snapshot().time >= 0.6)
    assert stream.number == 1
    player.close()
    stream.close()


def blended_groups(window: Window, scene_file: str) -> None:
    """Within the frames that two groups share the picture is a blend of both, also once it is refined."""
    groups.write([groups.GroupInput.of(scene_file, 0), groups.GroupInput.of(scene_file, 6)], "mixed.kpc")
    stream = GroupPlayback(open_source("mixed.kpc"))
    player = Player(window, stream, Preferences())
    player.state.scrub(0.5)
    frames_until(player, lambda: stream.is_settled and stream.blended_with(0.5) and player.snapshot().is_sharp)
    other, time_in_group, share = stream.blended_with(0.5)
    camera = player.snapshot().view.camera(*player.snapshot().canvas)
    first = stream.renderer.render(camera, stream.time_in(0.5)).rgb.clip(0, 1)
    second = other.render(camera, time_in_group).rgb.clip(0, 1)
    assert share == 0.5 and np.abs(first - second).max() > 0.1
    assert np.abs(player.scene_view.pixels() / 255 - (first + second) / 2).max() < 2 / 255
    player.close()
    stream.close()


def a_still_picture_takes_over(window: Window, scene_file: str) -> None:
    """While nothing changes, too, the panels say that code is being compiled only as long as it is."""
    may_end = threading.Event()

    def run(self: loading.Loading, scene: Scene) -> None:
        may_end.wait()
        self.is_done = True

    with replaced(loading, _begun={}), replaced(loading.Loading, run=run):
        stream = GroupPlayback(open_source(scene_file))
        player = Player(window, stream, Preferences())
        press(player, glfw.KEY_SPACE)
        frames_until(player, lambda: stream.is_settled and player.snapshot().is_sharp)
        assert player.scene_view.renderer.is_loading
        may_end.set()
        frames_until(player, lambda: not player.scene_view.renderer.is_loading)
        player.close()
        stream.close()


def defaults_on_a_graphics_card(window: Window, scene_file: str) -> None:
    """A graphics card begins with the reference and holds a frame rate, unless a quality is asked for."""
    with replaced(player_module, is_software=lambda ctx: False):
        for settings, level, fps in (
            (Preferences(), LEVEL_NAMES[-1], 50.0),
            (Preferences(quality="fine"), "fine", None),
        ):
            stream = GroupPlayback(open_source(scene_file))
            player = Player(window, stream, settings)
            assert player.preferences().quality == player.snapshot().level == level
            assert player.preferences().target_fps == approx(fps) if fps else player.snapshot().target_s is None
            assert player.state.target_fps == approx(fps or FILM_FPS)
            player.state.target_fps = 42.0
            resumed = Player(window, stream, settings, resume_from=player)
            assert resumed.state.target_fps == 42.0
            resumed.close()
            player.close()
            stream.close()


def reset_of_the_graphics_card(scene_file: str) -> None:
    """After a reset another window continues; after many the player ends."""
    windows: list[object] = []

    def resets_of_first(count: int) -> Callable[[], Callable[[], int]]:
        """The first `count` windows report a reset in their second frame."""

        def query() -> Callable[[], int]:
            frame = iter(range(1_000_000))
            windows.append(object())
            return lambda: 0x8255 if len(windows) <= count and next(frame) == 1 else 0

        return query

    with replaced(window_module, reset_status_query=resets_of_first(1)):
        assert kpplay.main([scene_file, "--size", "300x200", "--frames", "4", "--screenshot", "reset.png"]) == 0
    assert len(windows) == 2 and read_image("reset.png").shape == (200, 300, 3)
    windows.clear()
    with replaced(window_module, reset_status_query=resets_of_first(99)), replaced(kpplay, MAX_RESETS=1):
        assert kpplay.main([scene_file, "--size", "300x200", "--frames", "4"]) == 1 and len(windows) == 2


def settings_are_saved(scene_file: str) -> None:
    """Settings of one run hold in the next unless an option replaces them; an error in saving them is reported."""
    settings: list[Preferences] = []
    recent: list[tuple[str, ...]] = []

    def run(player: Player, frames: int | None = None) -> None:
        player.frame()
        settings.append(player.preferences())
        recent.append(load(preferences_path()).recent)
        press(player, "-", "g")

    with replaced(Player, run=run):
        with contextlib.redirect_stderr(io.StringIO()) as said:
            assert kpplay.main([scene_file, "--size", "300x200"]) == 0
        assert said.getvalue() == "kpplay: --size 300x200: a window is at least 640x480, so this one is 640x480\n"
        assert kpplay.main([scene_file, "--target-fps", "25"]) == 0
        assert kpplay.main([scene_file, "--quality", "fine"]) == 0
        shutil.rmtree(preferences_path().parent)
        preferences_path().parent.write_text("not a folder")
        assert kpplay.main([scene_file]) == 0
    assert recent == [(os.path.abspath(scene_file),)] * 3 + [()]
    assert [one.size for one in settings[:3]] == [(640, 480)] * 3
    assert [one.graphs for one in settings] == [False, True, False, False]
    assert [one.quality for one in settings] == [DEFAULT, neighbouring_level(DEFAULT, -1), "fine", DEFAULT]
    assert [one.target_fps for one in settings] == [None, 25.0, None, None]
