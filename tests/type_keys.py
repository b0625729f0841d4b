"""Type keys by their place on a keyboard, and print what the player takes them for: `type_keys.py 61 Shift+19 ...`.

The keys are typed by the X server's extension XTEST, as by a hand, given as key codes of evdev. The output is one JSON
object: the shortcuts of each argument, the list of keys as the window shows it, and the keys that fly.
"""

import ctypes
import json
import sys
import time

from kpc.player.app import input as player_input
from kpc.player.app.actions import Actions
from kpc.player.app.desktop import glfw
from kpc.player.app.keyboard import flying_keys
from kpc.player.app.window import Window

MODIFIERS = {"Shift": 50, "Ctrl": 37, "AltGr": 108, "Caps": 66}


class Hand:
    """Presses and releases keys of the display."""

    def __init__(self) -> None:
        x11, self.xtest = ctypes.CDLL("libX11.so.6"), ctypes.CDLL("libXtst.so.6")
        x11.XOpenDisplay.restype = ctypes.c_void_p
        self.display, self.flush = ctypes.c_void_p(x11.XOpenDisplay(None)), x11.XFlush
        self.xtest.XTestFakeMotionEvent(self.display, -1, 60, 60, 0)  # into the window, which then has the keyboard

    def move(self, *keys: int, down: bool) -> None:
        for key in keys:
            self.xtest.XTestFakeKeyEvent(self.display, key, down, 0)
        self.flush(self.display)

    def type(self, combination: str) -> None:
        *held, code = combination.split("+")
        keys = [*(MODIFIERS[name] for name in held), int(code)]
        self.move(*keys, down=True)
        self.move(*reversed(keys), down=False)
        if "Caps" in held:  # pressed again to switch it off
            self.move(MODIFIERS["Caps"], down=True)
            self.move(MODIFIERS["Caps"], down=False)


def main(combinations: list[str]) -> None:
    hand, window = Hand(), Window("keys", (320, 240))
    log: list[str] = []
    player_input._ACTIONS = {name: lambda _, name=name: log.append(name) for name in player_input._ACTIONS}
    found = []
    for combination in combinations:
        log.clear()
        hand.type(combination)
        pressed, until = 0, time.monotonic() + 0.5
        while time.monotonic() < until:
            glfw.wait_events_timeout(0.02)
            for key in window.take_keys():
                player_input.press(Actions, key)
                pressed += 1
                until = min(until, time.monotonic() + 0.05)
        assert pressed, f"the window got no event of {combination}"
        found.append(list(log))
    help_lines = {binding.help: binding.keys_here() for binding in player_input.KEY_BINDINGS}
    print(json.dumps({"shortcuts": found, "help": help_lines, "flying": flying_keys(player_input._ACTIONS)}))
    window.close()


if __name__ == "__main__":
    main(sys.argv[1:])
