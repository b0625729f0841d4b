"""Feeds the player every key and drag it knows, and looks at what they do: `press_every_key.py scene.kpc`."""

import sys
import time

import glfw
import numpy as np
from pytest import approx

from kpc.format.container import open_source
from kpc.player.reference import Part
from kpc.player.renderer import Look
from kpc.player.stream import Stream
from kpc.player.window import Player, Window


def main(scene_file: str) -> None:
    window = Window("test", (320, 240))
    stream = Stream(open_source(scene_file))
    player = Player(window, stream)
    while not stream.is_settled:
        player.frame()

    def press(*keys: int) -> None:
        for key in keys:
            window._key(None, key, 0, glfw.PRESS, 0)
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
        player._picture(1.0)
        return np.frombuffer(player.canvas.read(components=3, alignment=1), np.uint8).astype(int)

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
        (glfw.KEY_2, glfw.KEY_3, glfw.KEY_4, glfw.KEY_1), (Look.DEPTH, Look.SAMPLES, Look.OCCUPANCY, Look.COLOUR)
    ):
        press(key)
        assert player.look is look
    for part in (Part.STATIC, Part.DYNAMIC, Part.FULL):
        press(glfw.KEY_C)
        assert player.part is part
    folded = player.renderer.quality.folded
    press(glfw.KEY_F)
    assert player.renderer.quality.folded is not folded

    average = canvas()
    for number, name in enumerate(("dawn.jpg", "noon.jpg", "dusk.jpg"), 1):
        press(glfw.KEY_V)
        assert player.wardrobe.number == number and player.wardrobe.names[number] == name
    player.wardrobe.advance(1.0)
    assert np.abs(canvas() - average).max() > 10
    press(glfw.KEY_V)
    player.wardrobe.advance(1.0)
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

    press(glfw.KEY_H, glfw.KEY_P)
    glfw.set_window_size(window.handle, 200, 260)
    time.sleep(0.05)
    glfw.poll_events()
    player.frame()
    assert player.canvas.size == window.pixels
    press(glfw.KEY_TAB, glfw.KEY_ESCAPE)
    assert glfw.window_should_close(window.handle)
    player.run()
    player.close()
    stream.close()
    window.close()


if __name__ == "__main__":
    main(sys.argv[1])
