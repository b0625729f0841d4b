"""Drive a player as a user does: press keys, drag, wait for frames. Tests of the window import this."""

import contextlib
import time
from collections.abc import Callable, Iterator

import numpy as np

from kpc.player.app.desktop import glfw
from kpc.player.app.player import Player

PATIENCE_S = 20.0


def press(player: Player, *keys: int | str) -> None:
    for key in keys:
        player.press(key)


def drag(player: Player, button: int, x: float, y: float) -> None:
    """Drag by so many units, outside the panels."""
    window = player.window
    window.move_pointer(285, 60)
    player.frame()
    window.press_button(button, True)
    player.frame()
    window.move_pointer(285 + x, 60 + y)
    player.frame()
    window.press_button(button, False)
    player.frame()


def exact_picture(player: Player) -> np.ndarray:
    """What the player shows, drawn without approximations, (height, width, 3) integers."""
    player.scene_view.draw("reference", still=True)
    return player.scene_view.pixels().astype(int)


def frames_until(player: Player, condition: Callable[[], object]) -> None:
    """Show frames until a condition holds."""
    until = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < until
        glfw.poll_events()
        player.frame()


@contextlib.contextmanager
def replaced(owner: object, **values: object) -> Iterator[None]:
    """Replace attributes for a while."""
    before = {name: getattr(owner, name) for name in values}
    for name, value in values.items():
        setattr(owner, name, value)
    try:
        yield
    finally:
        for name, value in before.items():
            setattr(owner, name, value)
