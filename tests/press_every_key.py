"""Feeds the player every key and drag it knows, and looks at what they do: `press_every_key.py scene.kpc`."""

import shutil
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from kpc.format.common.errors import DisplayError
from kpc.format.common.media import read_image, read_video
from kpc.format.container import groups
from kpc.format.container.container import open_source
from kpc.player.app import kpplay, panels
from kpc.player.app import window as window_module
from kpc.player.app.camera_paths import CameraPath
from kpc.player.app.desktop import glfw, imgui
from kpc.player.app.preferences import Preferences, preferences_path
from kpc.player.app.quality_controller import LEVEL_NAMES
from kpc.player.app.window import Player, Window
from kpc.player.cpu.reference import Part
from kpc.player.gl.renderer import DisplayMode
from kpc.player.quality import DEFAULT, neighbouring_level
from kpc.player.streaming.group_playback import GroupPlayback
from pytest import approx, raises


def main(scene_file: str) -> None:
    ask_for_less()
    window = Window("test", (320, 240))
    stream = GroupPlayback(open_source(scene_file))
    player = Player(window, stream, Preferences(text_size=0.9, speed=1.0))
    while not stream.is_settled:
        player.frame()

    def press(*keys: int, mods: int = 0) -> None:
        for key in keys:
            window._key(None, key, 0, glfw.PRESS, mods)
            player.frame()

    def drag(button: int, x: float, y: float) -> None:
        window._moved(None, 250, 60)
        player.frame()
        window._clicked(None, button, glfw.PRESS, 0)
        player.frame()
        window._moved(None, 250 + x, 60 + y)
        player.frame()
        window._clicked(None, button, glfw.RELEASE, 0)
        player.frame()

    def canvas() -> np.ndarray:
        player._picture(1.0, "reference", still=True)
        return player._pixels().astype(int)

    player.frame()
    assert player.playback.playing
    can_show, stream.can_show = stream.can_show, lambda *where: False  # type: ignore[method-assign]
    before = player.playback.time
    time.sleep(0.05)
    player.frame()
    assert player.playback.time == before and player.playback.playing  # what is not there is waited for
    stream.can_show = can_show  # type: ignore[method-assign]
    time.sleep(0.05)
    player.frame()
    assert player.playback.time != before
    press(glfw.KEY_SPACE)
    assert not player.playback.playing
    press(glfw.KEY_HOME, glfw.KEY_RIGHT)
    assert player.playback.time == approx(0.1)
    press(glfw.KEY_END)
    assert player.playback.time == 1.0
    press(glfw.KEY_RIGHT_BRACKET, glfw.KEY_L)
    assert player.playback.speed == 2.0 and not player.playback.loop
    for key, look in zip(
        (glfw.KEY_2, glfw.KEY_3, glfw.KEY_4, glfw.KEY_1),
        (DisplayMode.DEPTH, DisplayMode.SAMPLES, DisplayMode.OCCUPANCY, DisplayMode.COLOUR),
    ):
        press(key)
        assert player.look is look
    for part in (Part.STATIC, Part.DYNAMIC, Part.FULL):
        press(glfw.KEY_C)
        assert player.part is part
    for folded in (False, True):
        press(glfw.KEY_F)
        player._picture(1.0, "fine")
        assert player.renderer.quality.folded is folded

    average = canvas()
    for number, name in enumerate(("dawn.jpg", "noon.jpg", "dusk.jpg"), 1):
        press(glfw.KEY_V)
        assert player.appearance.number == number and player.appearance.names[number] == name
    player.appearance.advance(1.0)
    assert np.abs(canvas() - average).max() > 10
    press(glfw.KEY_V)
    player.appearance.advance(1.0)
    assert np.abs(canvas() - average).max() <= 1  # where a value lies between two levels, it may round to either

    before = player.view
    drag(0, 30, 10)
    assert player.view.focus == approx(before.focus) and not np.allclose(player.view.axes, before.axes)
    turned = player.view
    drag(1, 30, 10)
    assert np.allclose(player.view.axes, turned.axes) and not np.allclose(player.view.focus, turned.focus)
    window._scrolled(None, 0, 2)
    player.frame()
    assert player.view.distance == approx(0.81 * before.distance)
    press(glfw.KEY_N)
    assert player.camera_number == 1
    press(glfw.KEY_R)
    assert player.view.eye == approx(before.eye)

    press(glfw.KEY_B)
    assert player.preset_number == 0 and player.view.eye != approx(before.eye)

    rung = player.quality.level
    press(glfw.KEY_MINUS)
    assert player.quality.level == neighbouring_level(rung, -1) and rung == DEFAULT
    press(glfw.KEY_EQUAL)
    assert player.quality.level == rung
    press(glfw.KEY_U)
    assert player.quality.target_s == approx(1 / 30)
    press(glfw.KEY_U, glfw.KEY_T, glfw.KEY_G)
    assert player.quality.target_s is None and player.show_planes and player.show_graphs
    player.quality.choose(rung)  # where it stood is the machine's business
    before_size = player.text_size
    press(glfw.KEY_EQUAL, mods=glfw.MOD_CONTROL)
    assert player.text_size > before_size

    press(glfw.KEY_J)
    assert player.notice_is_error and not player.riding  # there is no path yet
    follow_a_path(player, press)
    see_every_pixel_once(window, player)
    see_the_same_however_coarsely(player)
    come_to_rest(player)
    run_out_of_room(player)
    drop_files(window, player, Path(scene_file))

    press(glfw.KEY_H, glfw.KEY_P)
    glfw.set_window_size(window.handle, 200, 260)
    time.sleep(0.05)
    glfw.poll_events()
    player.frame()
    assert player.canvas.size == window.pixels
    press(glfw.KEY_TAB, glfw.KEY_ESCAPE)
    assert glfw.window_should_close(window.handle)
    kept = player.preferences()
    assert kept == Preferences((200, 260), DEFAULT, None, 2.0, False, False, True, True, player.text_size)
    player.run()
    press(glfw.KEY_O)
    player.run(1)
    told = player.close()  # a film that is being written is finished
    assert told is not None and told.startswith("saved ") and len(list(read_video(player.film.path))) >= 1
    go_through_groups(window, scene_file)
    stand_where_groups_are_mixed(window, scene_file)
    begin_on_a_card(window, scene_file)
    stream.close()
    window.close()
    lose_the_card(scene_file)
    remember(scene_file)


def ask_for_less() -> None:
    """Where there is no OpenGL 4.3, as on macOS, 3.3 is asked for; where there is neither, that is told."""
    create = glfw.create_window
    asked: list[object] = []

    def none_above(most: int) -> Callable[..., object]:
        def attempt(*arguments: object) -> object:
            asked.append(arguments)
            return create(*arguments) if len(asked) > most else None

        return attempt

    glfw.create_window = none_above(1)
    window = Window("test", (64, 64))
    assert len(asked) == 2 and window.ctx.version_code >= 330
    window.close()
    window.close()
    asked.clear()
    glfw.create_window = none_above(2)
    with raises(DisplayError, match="kprender"):
        Window("test", (64, 64))
    glfw.create_window = create


def follow_a_path(player: Player, press: Callable[..., None]) -> None:
    """Two keyframes, the way between them, a film of it, and its file."""
    player.playback.seek(0.2)
    press(glfw.KEY_R, glfw.KEY_K)
    first = player.view.eye
    player.playback.seek(0.6)
    press(glfw.KEY_N, glfw.KEY_K, glfw.KEY_K, glfw.KEY_BACKSPACE)
    second = player.view.eye
    assert (
        [shot.time for shot in player.path.keyframes] == approx([0.2, 0.6])
        and player.path.end_s == 2.0
        and player.show_path
    )
    player.path = player.path.spaced(1, 0.2)

    press(glfw.KEY_J)
    assert player.riding
    time.sleep(0.06)
    player.frame()
    assert 0.2 < player.playback.time < 0.6 and player.view.eye != approx(first) and player.view.eye != approx(second)
    time.sleep(0.25)
    player.frame()
    assert not player.riding and player.view.eye == approx(second) and player.playback.time == approx(0.6)

    press(glfw.KEY_S, mods=glfw.MOD_CONTROL)
    assert not player.notice_is_error and "path.json" in player.notice
    (file,) = Path().glob("*-path.json")
    assert CameraPath.load(file).end_s == approx(0.2) and str(file) in player.notice

    for shift in (glfw.MOD_SHIFT, 0):
        press(glfw.KEY_O, mods=shift)
        film = player.film
        assert film is not None
        if not shift:
            time.sleep(0.2)
            player.frame()
            press(glfw.KEY_O)
        until = time.monotonic() + 20
        while player.film is not None and time.monotonic() < until:
            player.frame()
        assert str(film.path) in player.notice and not player.notice_is_error, player.notice
        frames = list(read_video(film.path))
        if shift:
            assert len(frames) == 7 and player.view.eye == approx(second)  # 0.2 s at 30 a second, both ends
            assert np.abs(frames[0].astype(int) - frames[-1]).mean() > 2
        else:
            assert 3 <= len(frames) <= 20
        assert frames[0].shape == (*player.canvas.size[::-1], 3)

    press(glfw.KEY_O)
    glfw.set_window_size(player.window.handle, 420, 330)
    time.sleep(0.05)
    until = time.monotonic() + 20
    while player.film is not None and time.monotonic() < until:
        glfw.poll_events()
        player.frame()
    assert player.film is None and player.canvas.size == (420, 330)
    reach_into_corners(player)
    Path("nowhere").touch()
    player.folder = Path("nowhere")  # no folder: what goes wrong is told, and nothing ends
    press(glfw.KEY_P)
    assert player.notice_is_error and "nowhere" in player.notice, player.notice
    player.folder = Path()


def reach_into_corners(player: Player) -> None:
    """As the controls do of a window that is larger than it was: in its top left, and all along its bottom."""
    player.frame()
    player._begin(0.0)
    panels.show(player)
    player._finish()
    width, height = player.canvas.size
    screen = np.frombuffer(player.ctx.screen.read(viewport=(0, 0, width, height), alignment=1), np.uint8).reshape(
        height, width, 3
    )[::-1]
    assert player.ctx.error in (
        "GL_NO_ERROR",
        "GL_INVALID_OPERATION",
    )  # moderngl reads from an attachment that no window's own has
    over = np.any(screen != player._pixels(), axis=2)
    top, left = over.any(1).argmax(), over.any(0).argmax()
    bottom, right = height - over.any(1)[::-1].argmax(), width - over.any(0)[::-1].argmax()
    assert top < 16 and left < 16 and bottom > height - 16 and right > width - 60, (top, left, bottom, right)


def see_the_same_however_coarsely(player: Player) -> None:
    show, whole, seen = player._show, player.view.camera(*player.canvas.size), []
    player._show = lambda target, camera: seen.append(camera)  # type: ignore[method-assign]
    for scale in (0.125, 0.297, 0.42, 0.841):
        player._picture(scale, "fast")
    player._show = show  # type: ignore[method-assign]
    for camera in seen:
        assert len(seen) == 4 and (camera.fl_x / camera.width, camera.cx / camera.width) == approx(
            (whole.fl_x / whole.width, whole.cx / whole.width)
        )
        assert (camera.fl_y / camera.height, camera.cy / camera.height) == approx(
            (whole.fl_y / whole.height, whole.cy / whole.height)
        )


def see_every_pixel_once(window: Window, player: Player) -> None:
    """Where the system counts two or three pixels to its unit, and where it wants larger text instead."""
    size, pixels, scale = Window.size, Window.pixels, Window.text_scale
    heights: list[float] = []
    show = panels.show

    def measure(player: Player) -> None:
        heights.append(imgui.get_font_size() * player.imgui.io.display_framebuffer_scale.x)
        show(player)

    for units, count, text in (
        ((320, 240), (320, 240), 1.0),
        ((160, 120), (320, 240), 2.0),
        ((320, 240), (320, 240), 2.0),
    ):
        Window.size, Window.pixels, Window.text_scale = units, count, text  # type: ignore[assignment, method-assign]
        panels.show = measure
        player.frame()
        panels.show = show
        assert player.canvas.size == count
        io = player.imgui.io
        assert (
            io.display_size.x * io.display_framebuffer_scale.x,
            io.display_size.y * io.display_framebuffer_scale.y,
        ) == count
        before = player.view
        window._moved(None, 0.9 * units[0], 0.3 * units[1])
        player.show_hud = False
        player.frame()
        window._clicked(None, 0, glfw.PRESS, 0)
        player.frame()
        window._moved(None, 0.9 * units[0] + 0.1 * units[1], 0.3 * units[1])
        player.frame()
        window._clicked(None, 0, glfw.RELEASE, 0)
        player.frame()
        player.show_hud = True
        turned = np.arccos(np.clip((np.trace(player.view.axes.T @ before.axes) - 1) / 2, -1, 1))
        assert turned == approx(0.1 * np.pi, rel=1e-3)  # of the window's height, whatever its units
        assert window.plain_size == (units if count != units else tuple(n / text for n in units))
    assert heights[1:] == approx([2 * heights[0]] * 2, rel=0.05)  # sizes of text are whole
    Window.size, Window.pixels, Window.text_scale = size, pixels, scale  # type: ignore[method-assign]
    player.frame()


def come_to_rest(player: Player) -> None:
    """What stands still is drawn anew, row by row, as finely as at once."""
    player.playback.playing = False
    player.show_hud = False
    band_s, window_module.BAND_S = window_module.BAND_S, 1e-6
    player.look_from(player.view.orbit(0.1, 0.0))
    player.quality.resolution.scale = 0.25
    player.frame()
    coarse = player._pixels().astype(int)
    time.sleep(0.3)
    turns = 0
    while not player._is_sharp:
        player.frame()
        turns += 1
    fine = player._pixels().astype(int)
    player._still()
    assert turns == player.canvas.height and np.abs(fine - player._pixels()).max() <= 1 < np.abs(fine - coarse).max()
    window_module.BAND_S, player.show_hud = band_s, True


def run_out_of_room(player: Player) -> None:
    """What the card refuses is told, and drawn more coarsely; what it refuses again and again ends the player."""
    show, rung = player.renderer.show, player.quality.level

    def refuse(*_: object, **__: object) -> None:
        raise DisplayError("no room for a picture")

    player.renderer.show = refuse  # type: ignore[method-assign]
    for _ in range(window_module.MOST_MISHAPS):
        player.look_from(player.view.orbit(0.1, 0.0))
        player.frame()
        assert player.notice_is_error and "no room" in player.notice
    assert LEVEL_NAMES.index(player.quality.level) < LEVEL_NAMES.index(rung)
    player.look_from(player.view.orbit(0.1, 0.0))
    with raises(DisplayError, match="no room"):
        player.frame()
    imgui.end_frame()
    player.renderer.show, player._mishaps = show, 0  # type: ignore[method-assign]
    player.quality.choose(rung)
    player.frame()


def drop_files(window: Window, player: Player, scene_file: Path) -> None:
    """A camera path, things that are none, and another scene."""
    (path,) = Path().glob("*-path.json")
    keyframes = player.path.keyframes
    player.path = CameraPath()
    Path("text.kpc").write_text("no scene")
    for file, words in (
        ("text.kpc", "text.kpc"),
        ("none.kpc", "none.kpc"),
        ("none.json", "none.json"),
        ("text.kpc.JSON", "JSON"),
    ):
        window._drop(None, [file])
        player.frame()
        assert player.notice_is_error and words in player.notice and player.successor is None, player.notice
    window._drop(None, [str(path)])
    player.frame()
    assert len(player.path.keyframes) == len(keyframes) and not player.notice_is_error
    window._drop(None, [str(scene_file)])
    player.run()
    assert player.successor is not None and not glfw.window_should_close(window.handle)
    player.successor.close()
    player.successor = None


def go_through_groups(window: Window, scene_file: str) -> None:
    """The scene twice as one clip: each half shows in its time, in the quality and the appearance that were chosen."""
    groups.write(groups.group_inputs([scene_file, scene_file]), "twice.kpc")
    reel = GroupPlayback(open_source("twice.kpc"))
    player = Player(window, reel, Preferences())
    player.type(glfw.KEY_SPACE, 0)
    player.appearance.select(2)
    player.type(glfw.KEY_MINUS, 0)
    chosen, times = player.quality.level, []
    for key, number in ((glfw.KEY_END, 1), (glfw.KEY_LEFT, 1), (glfw.KEY_HOME, 0)):
        player.type(key, 0)
        until = time.monotonic() + 20
        while not (reel.number == number and reel.is_settled and player._is_sharp):
            assert time.monotonic() < until
            player.frame()
        assert player.scene is reel.scene and player.appearance.scene is reel.scene and player.appearance.number == 2
        assert player.quality.level == chosen
        times.append((player.playback.time, reel.time_in(player.playback.time)))
    assert np.allclose(times, [(1.0, 1.0), (20 / 21, 0.9), (0.0, 0.0)], atol=1e-6)
    player.type(glfw.KEY_SPACE, 0)  # from here it plays over the join
    until = time.monotonic() + 20
    while player.playback.time < 0.6:
        assert time.monotonic() < until
        player.frame()
    assert reel.number == 1
    player.close()
    reel.close()


def stand_where_groups_are_mixed(window: Window, scene_file: str) -> None:
    """Amid the frames that two groups share the picture is made of both, also once it is sharp."""
    groups.write([groups.GroupInput.of(scene_file, 0), groups.GroupInput.of(scene_file, 6)], "mixed.kpc")
    reel = GroupPlayback(open_source("mixed.kpc"))
    player = Player(window, reel, Preferences())
    player.scrub(0.5)
    until = time.monotonic() + 20
    while not (reel.is_settled and reel.beside(0.5) and player._is_sharp):
        assert time.monotonic() < until
        player.frame()
    other, time_in_it, share = reel.beside(0.5)
    camera = player.view.camera(*player.canvas.size)
    alone, beside = (
        renderer.render(camera, at).rgb.clip(0, 1)
        for renderer, at in ((reel.renderer, reel.time_in(0.5)), (other, time_in_it))
    )
    assert share == 0.5 and np.abs(alone - beside).max() > 0.1
    assert np.abs(player._pixels() / 255 - (alone + beside) / 2).max() < 2 / 255
    player.close()
    reel.close()


def lose_the_card(scene_file: str) -> None:
    """Once, after a frame: another window goes on where that one was. Again and again: it is given up."""
    made: list[object] = []
    real = window_module._reset_status

    def reset_by(turns: int) -> Callable[[], Callable[[], int]]:
        def look_up() -> Callable[[], int]:
            turn = iter(range(1_000_000))
            made.append(window_module.Window)
            return lambda: 0x8255 if len(made) <= turns and next(turn) == 1 else 0

        return look_up

    window_module._reset_status = reset_by(1)
    assert kpplay.main([scene_file, "--size", "300x200", "--frames", "4", "--screenshot", "reset.png"]) == 0
    assert len(made) == 2 and read_image("reset.png").shape == (200, 300, 3)
    made.clear()
    window_module._reset_status, kpplay.MOST_RESETS = reset_by(99), 1
    assert kpplay.main([scene_file, "--size", "300x200", "--frames", "4"]) == 1 and len(made) == kpplay.MOST_RESETS + 1
    window_module._reset_status = real


def begin_on_a_card(window: Window, scene_file: str) -> None:
    """A graphics card holds a rate from the reference on, as long as nothing else is asked for; the control shows it, and it is remembered."""
    real, window_module.is_software = window_module.is_software, lambda ctx: False
    for asked, quality, fps in ((Preferences(), LEVEL_NAMES[-1], 50.0), (Preferences(quality="fine"), "fine", None)):
        reel = GroupPlayback(open_source(scene_file))
        player = Player(window, reel, asked)
        assert player.preferences().quality == player.quality.level == quality
        assert player.preferences().target_fps == approx(fps) if fps else player.quality.target_s is None
        assert player.target_fps == approx(fps or window_module.FILM_FPS)
        player.target_fps = 42.0
        assert Player(window, reel, asked, before=player).target_fps == 42.0
        player.close()
        reel.close()
    window_module.is_software = real


def remember(scene_file: str) -> None:
    """What was set in one run is there in the next, unless it is told otherwise; also where nothing can be written."""
    run, seen = Player.run, []

    def changed(player: Player, frames: int | None = None) -> None:
        player.frame()
        seen.append(player.preferences())
        player.type(glfw.KEY_MINUS, 0)
        player.type(glfw.KEY_G, 0)

    Player.run = changed  # type: ignore[method-assign]
    assert kpplay.main([scene_file, "--size", "300x200"]) == 0
    assert kpplay.main([scene_file, "--target-fps", "25"]) == 0
    assert kpplay.main([scene_file, "--quality", "fine"]) == 0
    shutil.rmtree(preferences_path().parent)
    preferences_path().parent.write_text("no folder")
    assert kpplay.main([scene_file]) == 0
    Player.run = run  # type: ignore[method-assign]
    assert [one.size for one in seen[:3]] == 3 * [(300, 200)] and [one.graphs for one in seen] == [
        False,
        True,
        False,
        False,
    ]
    assert [one.quality for one in seen] == [DEFAULT, neighbouring_level(DEFAULT, -1), "fine", DEFAULT]
    assert [one.target_fps for one in seen] == [None, 25.0, None, None]


if __name__ == "__main__":
    main(sys.argv[1])
