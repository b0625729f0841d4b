"""Press every key, drag in every way, and check what the player does: `press_every_key.py scene.kpc`."""

import os
import sys
import time
from pathlib import Path

import numpy as np
from pytest import approx, raises

from kpc.encoder.datasets.video import read_video
from kpc.format.common.errors import DisplayError
from kpc.format.container.sources import open_source
from kpc.format.scene.metadata import ViewLimits
from kpc.player.app import imgui_renderer
from kpc.player.app import player as player_module
from kpc.player.app.camera_paths import CameraPath
from kpc.player.app.desktop import glfw, imgui
from kpc.player.app.input import KEY_BINDINGS
from kpc.player.app.player import MAX_RETRIES, Player
from kpc.player.app.preferences import Preferences
from kpc.player.app.quality_controller import LEVEL_NAMES
from kpc.player.app.recording import FILM_FPS
from kpc.player.app.window import Window
from kpc.player.cpu import loading
from kpc.player.quality import DEFAULT, neighbouring_level
from kpc.player.streaming.group_playback import GroupPlayback
from player_driver import drag, exact_picture, frames_until, press, replaced
from player_windows import (
    a_still_picture_takes_over,
    blended_groups,
    defaults_on_a_graphics_card,
    groups_of_a_clip,
    opening_asks_for_older_opengl,
    reset_of_the_graphics_card,
    settings_are_saved,
)

LEFT, RIGHT = 0, 1  # buttons of the mouse


def main(scene_file: str) -> None:
    opening_asks_for_older_opengl()
    window = Window("test", (320, 240))
    stream = GroupPlayback(open_source(scene_file))
    loading.load(stream.scene)
    player = Player(window, stream, Preferences(text_size=0.8))
    while not stream.is_settled:
        player.frame()

    keys_of_the_clip(player)
    keys_of_what_is_shown(player)
    keys_and_drags_of_the_camera(player)
    view_limits(player)
    keys_of_quality_and_panels(player)
    player.press("j")
    assert player.snapshot().notice_is_error and not player.snapshot().follows_path  # there is no path yet
    camera_path(player)
    videos(player)
    panels_reach_the_window_edges(player)
    files_cannot_be_written(player)
    every_pixel_is_used(player)
    field_of_view_does_not_depend_on_the_raster(player)
    stills_are_refined_in_bands(player)
    drawing_fails(player)
    dropped_files(player, Path(scene_file))
    resized_and_closed(player)
    groups_of_a_clip(window, scene_file)
    blended_groups(window, scene_file)
    a_still_picture_takes_over(window, scene_file)
    defaults_on_a_graphics_card(window, scene_file)
    stream.close()
    window.close()
    reset_of_the_graphics_card(scene_file)
    settings_are_saved(scene_file)


def keys_of_the_clip(player: Player) -> None:
    stream = player.state.stream
    player.frame()
    assert player.snapshot().playing
    player.state.playback.seek(0.2)
    before = player.snapshot().time
    with replaced(stream, can_show=lambda *position: False):
        player.frame(seconds=0.05)
        assert player.snapshot().time == before and player.snapshot().playing  # the clip waits for what has not arrived
    player.frame(seconds=0.05)
    assert player.snapshot().time == approx(before + 0.05 / player.state.playback.clip.duration_s)
    press(player, glfw.KEY_SPACE)
    assert not player.snapshot().playing
    press(player, "l", glfw.KEY_HOME, glfw.KEY_SPACE)
    player.frame(seconds=0.0)
    with replaced(player_module, MAX_ADVANCE_S=0.05):
        player.frame(seconds=60.0)  # something was compiled: the clip has waited for it
    assert player.snapshot().playing and 0 < player.snapshot().time < 0.5
    press(player, "l", glfw.KEY_SPACE, glfw.KEY_HOME, glfw.KEY_RIGHT)
    assert player.snapshot().time == approx(0.1)
    press(player, glfw.KEY_END)
    assert player.snapshot().time == 1.0
    press(player, glfw.KEY_DOWN, "m")
    assert player.state.volume == approx(0.9) and player.state.muted
    press(player, glfw.KEY_UP)
    assert player.state.volume == 1.0 and not player.state.muted
    press(player, "]", "l")
    assert player.snapshot().speed == 2.0 and not player.snapshot().loop


def keys_of_what_is_shown(player: Player) -> None:
    modes = {"2": "depth", "3": "samples", "4": "occupancy", "1": "colour"}
    for key, mode in modes.items():
        press(player, key)
        assert player.snapshot().display_mode == mode
    for part in ("static", "dynamic", "full"):
        press(player, "c")
        assert player.snapshot().part == part
    for folds in (False, True):
        press(player, "f")
        player.scene_view.draw("fine")
        assert player.snapshot().folds is folds

    average, appearance = exact_picture(player), player.state.appearance
    for name in ("dawn.jpg", "noon.jpg", "dusk.jpg"):
        press(player, "v")
        assert player.snapshot().appearance == name
    appearance.advance(1.0)
    assert np.abs(exact_picture(player) - average).max() > 10
    press(player, "v")
    appearance.advance(1.0)
    assert np.abs(exact_picture(player) - average).max() <= 1  # a value between two levels may be rounded to either


def keys_and_drags_of_the_camera(player: Player) -> None:
    before = player.snapshot().view
    assert player.snapshot().shown == "camera"
    for is_down in (True, False):  # the pointer has jumped here before the button was pressed
        player.window.move_pointer(200, 150 + 60 * is_down)
        player.window.press_button(LEFT, is_down)
        player.frame()
        player.frame()
        assert player.snapshot().view is before
    drag(player, LEFT, 30, 10)
    assert player.snapshot().shown is None
    turned = player.snapshot().view
    assert turned.focus == approx(before.focus) and not np.allclose(turned.axes, before.axes)
    drag(player, RIGHT, 30, 10)
    panned = player.snapshot().view
    assert np.allclose(panned.axes, turned.axes) and not np.allclose(panned.focus, turned.focus)
    player.window.scroll(0, 2)
    player.frame()
    assert player.snapshot().view.distance == approx(0.81 * before.distance)
    press(player, "n")
    assert player.snapshot().camera_number == 1 and player.snapshot().shown == "camera"
    press(player, "b")
    assert player.snapshot().preset_number == 0 and player.snapshot().shown == "preset"
    assert player.snapshot().view.eye != approx(before.eye)
    press(player, "r")
    assert player.snapshot().view.eye == approx(before.eye) and player.snapshot().shown == "camera"
    assert player.snapshot().camera_number == 0 and player.snapshot().preset_number == -1


def view_limits(player: Player) -> None:
    """A view comes back to the limits of the scene until X lets it go; cameras are shown wherever they are."""
    state = player.state
    press(player, "x")
    assert "does not say" in player.snapshot().notice
    press(player, "r")
    start = player.snapshot().view
    ahead, _ = state.rig.compass()
    state.limits = ViewLimits(
        start.focus, ahead, state.rig.up, (-3.2, 3.2), (-1.5, 1.5), (start.distance, start.distance), 10.0
    )
    player.window.scroll(0, 4)
    player.frame(seconds=0.0)
    assert player.snapshot().view.distance == approx(0.9**4 * start.distance)
    player.frame(seconds=5.0)
    assert player.snapshot().view.distance == approx(start.distance, rel=1e-3)
    press(player, "x")
    player.window.scroll(0, 4)
    player.frame(seconds=5.0)
    assert player.snapshot().view.distance == approx(0.9**4 * start.distance)
    press(player, "x")
    player.frame(seconds=5.0)
    assert player.snapshot().view.distance == approx(start.distance, rel=1e-3)
    press(player, "n")
    player.frame(seconds=5.0)
    assert player.snapshot().view.eye == approx(state.rig.cameras[1].camera_to_world[:3, 3])
    state.limits = None


def keys_of_quality_and_panels(player: Player) -> None:
    level = player.snapshot().level
    press(player, "-")
    assert player.snapshot().level == neighbouring_level(level, -1) and level == DEFAULT
    press(player, "=")
    assert player.snapshot().level == level
    press(player, "u")
    assert player.snapshot().target_s == approx(1 / FILM_FPS)
    press(player, "u", "t", "g")
    assert player.snapshot().target_s is None and player.snapshot().panels == {"controls", "planes", "graphs"}
    press(player, "g", glfw.KEY_TAB)
    assert player.snapshot().panels == {"planes"}
    press(player, "g")  # a panel that is asked for appears, and those beside it
    assert player.snapshot().panels == {"controls", "planes", "graphs"}
    with replaced(imgui, button=lambda label, *_: label == "open"):
        player.frame()
    player.frame()
    assert imgui.is_popup_open("", imgui.PopupFlags.ANY_POPUP)
    press(player, glfw.KEY_ESCAPE)
    assert not imgui.is_popup_open("", imgui.PopupFlags.ANY_POPUP) and not player.state.should_close
    player.state.quality.choose(level)  # the level that U chose depends on the machine
    text_size = player.state.text_size
    player.press(glfw.KEY_EQUAL, glfw.MOD_CONTROL)
    assert player.state.text_size > text_size


def camera_path(player: Player) -> None:
    """Add two keyframes, follow the path between them, and save it."""
    state = player.state
    state.playback.seek(0.2)
    press(player, "r", "k")
    first = player.snapshot().view.eye
    state.playback.seek(0.6)
    press(player, "n", "k", "k", glfw.KEY_BACKSPACE)
    second, path = player.snapshot().view.eye, state.follower.path
    assert [keyframe.time for keyframe in path.keyframes] == approx([0.2, 0.6])
    assert path.end_s == 2.0 and "path" in player.snapshot().panels
    state.follower.path = path.spaced(1, 0.2)

    player.press("j", seconds=0.0)
    assert player.snapshot().follows_path
    player.frame(seconds=0.06)
    between = player.snapshot()
    assert 0.2 < between.time < 0.6 and between.view.eye != approx(first) and between.view.eye != approx(second)
    player.frame(seconds=0.25)
    end = player.snapshot()
    assert not end.follows_path and end.view.eye == approx(second) and end.time == approx(0.6)

    player.press(glfw.KEY_S, glfw.MOD_CONTROL)
    notice = player.snapshot().notice
    assert not player.snapshot().notice_is_error and "path.json" in notice
    (file,) = Path().glob("*-path.json")
    assert CameraPath.load(file).end_s == approx(0.2) and str(file) in notice


def videos(player: Player) -> None:
    """Record the camera path, the window, and a window whose size changes."""
    second = player.snapshot().view.eye
    for modifiers in (glfw.MOD_SHIFT, 0):
        player.press("o", modifiers)
        recording = player.filming.recording
        assert recording is not None
        if not modifiers:
            time.sleep(0.2)
            player.frame()
            press(player, "o")
        frames_until(player, lambda: not player.snapshot().films)
        end = player.snapshot()
        assert str(recording.path) in end.notice and not end.notice_is_error, end.notice
        frames = list(read_video(recording.path))
        if modifiers:
            assert len(frames) == 7 and end.view.eye == approx(second)  # 0.2 s at 30 fps, with both ends
            assert np.abs(frames[0].astype(int) - frames[-1]).mean() > 2
        else:
            assert 3 <= len(frames) <= 20
        assert frames[0].shape == (*end.canvas[::-1], 3)

    press(player, "o")
    glfw.set_window_size(player.window.handle, 420, 330)
    time.sleep(0.05)
    frames_until(player, lambda: not player.snapshot().films)
    assert player.snapshot().canvas == (420, 330)


def panels_reach_the_window_edges(player: Player) -> None:
    """Panels of an enlarged window lie in its top left corner, and all along its lower edge."""
    player.frame()
    player.present_panels()
    ctx, (width, height) = player.window.ctx, player.snapshot().canvas
    data = ctx.screen.read(viewport=(0, 0, width, height), alignment=1)
    screen = np.frombuffer(data, np.uint8).reshape(height, width, 3)[::-1]
    # moderngl reads from an attachment that a window's own framebuffer does not have
    assert ctx.error in ("GL_NO_ERROR", "GL_INVALID_OPERATION")
    covered = np.any(screen != player.scene_view.pixels(), axis=2)
    top, left = covered.any(1).argmax(), covered.any(0).argmax()
    bottom, right = height - covered.any(1)[::-1].argmax(), width - covered.any(0)[::-1].argmax()
    assert top < 16 and left < 16 and bottom > height - 16 and right > width - 60, (top, left, bottom, right)


def files_cannot_be_written(player: Player) -> None:
    """An error is shown, and the player continues."""
    Path("nowhere").touch()
    with replaced(player.files, folder=Path("nowhere")):
        press(player, "p")
    assert player.snapshot().notice_is_error and "nowhere" in player.snapshot().notice, player.snapshot().notice


def every_pixel_is_used(player: Player) -> None:
    """Also where a screen unit has two pixels, and where the system asks for larger text instead."""
    window, io = player.window, player.imgui.io
    text_heights: list[float] = []
    paddings: list[float] = []
    build = player.panels.build

    def measuring(asks: bool) -> None:
        text_heights.append(imgui.get_font_size() * io.display_framebuffer_scale[0])
        paddings.append(imgui.get_style().window_padding[0] * io.display_framebuffer_scale[0])
        build(asks)

    for units, pixels, scale in (
        ((320, 240), (320, 240), 1.0),
        ((160, 120), (320, 240), 2.0),
        ((320, 240), (320, 240), 2.0),
    ):
        with replaced(Window, size=units, pixels=pixels, text_scale=scale):
            with replaced(player.panels, build=measuring), replaced(imgui_renderer, ROOM_EM=(1.0, 1.0)):
                player.frame()
            assert player.snapshot().canvas == pixels
            shown = (
                io.display_size[0] * io.display_framebuffer_scale[0],
                io.display_size[1] * io.display_framebuffer_scale[1],
            )
            assert shown == pixels
            before = player.snapshot().view
            window.move_pointer(0.9 * units[0], 0.3 * units[1])
            with replaced(player.state.visible, controls=False):
                player.frame()
                window.press_button(LEFT, True)
                player.frame()
                window.move_pointer(0.9 * units[0] + 0.1 * units[1], 0.3 * units[1])
                player.frame()
                window.press_button(LEFT, False)
                player.frame()
            turned = np.arccos(np.clip((np.trace(player.snapshot().view.axes.T @ before.axes) - 1) / 2, -1, 1))
            assert turned == approx(0.1 * np.pi, rel=1e-3)  # a tenth of the window's height, whatever its units
            assert window.unscaled_size == (units if pixels != units else tuple(n / scale for n in units))
    assert text_heights[1:] == approx([2 * text_heights[0]] * 2, rel=0.05)  # sizes of text are integers
    assert paddings == approx([paddings[0], 2 * paddings[0], 2 * paddings[0]], rel=0.1)  # whole units
    with replaced(player.state, text_size=3.0), replaced(player.panels, build=measuring):
        player.frame()
    assert text_heights[-1] * imgui_renderer.ROOM_EM[0] == approx(player.window.size[0], rel=0.05)  # room for it
    player.frame()


def field_of_view_does_not_depend_on_the_raster(player: Player) -> None:
    renderer, cameras = player.scene_view.renderer, []
    canvas = player.snapshot().canvas
    whole = player.snapshot().view.camera(*canvas)
    with replaced(renderer, show=lambda target, camera, *_, **__: cameras.append(camera)):
        for scale in (0.125, 0.297, 0.42, 0.841):
            player.scene_view.draw("fast", scale)
    assert len(cameras) == 4
    for camera in cameras:
        assert camera.fl_x / camera.width == approx(whole.fl_x / whole.width)
        assert camera.cx / camera.width == approx(whole.cx / whole.width)
        assert camera.fl_y / camera.height == approx(whole.fl_y / whole.height)
        assert camera.cy / camera.height == approx(whole.cy / whole.height)


def stills_are_refined_in_bands(player: Player) -> None:
    """Refining row by row gives the picture that drawing it at once gives."""
    state, scene_view = player.state, player.scene_view
    state.playback.playing = False
    level = state.quality.level
    with (
        replaced(state.visible, controls=False),
        replaced(scene_view, band_s=1e-6),
        replaced(state.quality, level=LEVEL_NAMES[0]),
    ):
        state.look_from(state.view.orbit(0.1, 0.0))
        state.quality.resolution.scale = 0.25
        player.frame()
        assert scene_view.level == LEVEL_NAMES[0] != level
        coarse = scene_view.pixels().astype(int)
        time.sleep(0.3)
        frames = 0
        while not player.snapshot().is_sharp:
            player.frame()
            frames += 1
        assert scene_view.level == level
        fine = scene_view.pixels().astype(int)
        scene_view.draw_still()
        whole = scene_view.pixels()
        assert frames == player.snapshot().canvas[1] and np.abs(fine - whole).max() <= 1 < np.abs(fine - coarse).max()


def drawing_fails(player: Player) -> None:
    """Errors of the graphics card are shown and the quality is lowered; repeated errors end the player."""
    renderer, state, level = player.scene_view.renderer, player.state, player.snapshot().level

    def refuse(*_: object, **__: object) -> None:
        raise DisplayError("no memory for a picture")

    with replaced(renderer, show=refuse):
        for _ in range(MAX_RETRIES):
            state.look_from(state.view.orbit(0.1, 0.0))
            player.frame()
            assert player.snapshot().notice_is_error and "no memory" in player.snapshot().notice
        assert LEVEL_NAMES.index(player.snapshot().level) < LEVEL_NAMES.index(level)
        state.look_from(state.view.orbit(0.1, 0.0))
        with raises(DisplayError, match="no memory"):
            player.frame()
        player.imgui.end()
    player.forget_failures()
    state.quality.choose(level)
    player.frame()


def dropped_files(player: Player, scene_file: Path) -> None:
    """Drop files that cannot be read, a camera path, and another scene."""
    (path,) = Path().glob("*-path.json")
    keyframes = player.snapshot().keyframes
    player.state.follower.replace(CameraPath())
    Path("text.kpc").write_text("no scene")
    for file, words in (
        ("text.kpc", "text.kpc"),
        ("none.kpc", "none.kpc"),
        ("none.json", "none.json"),
        ("text.kpc.JSON", "JSON"),
    ):
        player.window.drop([file])
        player.frame()
        shown = player.snapshot()
        assert shown.notice_is_error and words in shown.notice and player.successor is None, shown.notice
    player.window.drop([str(path)])
    player.frame()
    assert player.snapshot().keyframes == keyframes > 0 and not player.snapshot().notice_is_error
    press(player, "k")
    for file in (path, scene_file):  # neither replaces a path that is not saved
        player.window.drop([str(file)])
        player.frame()
        shown = player.snapshot()
        assert shown.asks and shown.keyframes == keyframes + 1
        assert "opening" not in shown.notice and "loaded" not in shown.notice
        press(player, glfw.KEY_ESCAPE)
        assert not player.snapshot().asks and player.successor is None and not player.state.should_close
    player.window.drop([str(path)])
    player.frame()
    player.state.follower.give_up()
    player.frame()
    assert player.snapshot().keyframes == keyframes and not player.snapshot().asks
    player.window.drop([str(scene_file)])
    player.run()
    assert player.successor is not None and not player.state.should_close
    with replaced(player.actions.playlist, position=1):
        player.actions.stay()
        assert player.actions.playlist.position == 0  # that of what is shown
    press(player, glfw.KEY_PAGE_DOWN)
    assert "one file" in player.snapshot().notice and player.successor is None
    player.actions.playlist.files.append("text.kpc")
    press(player, glfw.KEY_PAGE_UP)
    assert "text.kpc" in player.snapshot().notice and player.snapshot().notice_is_error


def resized_and_closed(player: Player) -> None:
    window = player.window
    press(player, "h", "p")
    glfw.set_window_size(window.handle, 200, 260)
    time.sleep(0.05)
    glfw.poll_events()
    player.frame()
    assert player.snapshot().canvas == window.pixels
    press(player, glfw.KEY_TAB, "k", glfw.KEY_ESCAPE)
    assert player.snapshot().asks  # what becomes of the keyframe
    press(player, glfw.KEY_PAGE_DOWN)
    assert "say first" in player.snapshot().notice
    press(player, glfw.KEY_ESCAPE)
    assert not player.snapshot().asks and not player.state.should_close
    glfw.set_window_should_close(window.handle, True)
    player.frame()
    assert player.snapshot().asks
    player.press(glfw.KEY_S, glfw.MOD_CONTROL)
    assert not player.snapshot().asks and player.state.should_close
    settings = player.preferences()
    assert settings == Preferences((200, 260), DEFAULT, None, False, True, True, player.state.text_size)
    player.run()
    press(player, "o")
    recording = player.filming.recording
    player.run(1)
    player.frame()
    report = player.close()  # a video that is being written is finished
    assert report is not None and report.startswith("saved ") and len(list(read_video(recording.path))) >= 1
    assert all(binding.help for binding in KEY_BINDINGS)


if __name__ == "__main__":
    assert os.environ.get("XDG_CONFIG_HOME"), "set XDG_CONFIG_HOME: the settings there are deleted"
    main(sys.argv[1])
