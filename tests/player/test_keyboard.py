"""Shortcuts on keyboards of other countries, typed on an X server."""

import ctypes.util
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from kpc.player.app.desktop import glfw
from kpc.player.app.keyboard import FLYING_KEYS, US_CHARACTERS, KeyPress, flying_keys, nearest_at_hand
from x_server import x_server

SCRIPT = Path(__file__).parent.parent / "type_keys.py"
QUALITY, SPEED, FLYING = "lower or higher quality", "play slower or faster", "fly; four times as fast with Shift"


@pytest.fixture(scope="module")
def display() -> Iterator[str]:
    """A display of its own, since the layout of its keyboard changes."""
    if shutil.which("setxkbmap") is None or ctypes.util.find_library("Xtst") is None:
        pytest.skip("no setxkbmap or no libXtst (Debian: apt install x11-xkb-utils libxtst6)")
    with x_server() as name:
        yield name


# Key codes are those of evdev: 10 to 21 from 1 to =, 24 to 35 from Q to ], 38 to 47 from A to ;, 52 to 61 from Z to /.
@pytest.mark.parametrize(
    ("layout", "typed", "help_lines"),
    [
        (
            "us",
            {
                "20": "-", "21": "=", "Shift+21": "+", "34": "[", "35": "]", "59": ",", "46": "l", "10": "1",
                "32": "o", "Shift+32": "Shift+o", "Caps+32": "o", "Shift+46": "l", "Ctrl+39": "Ctrl+s",
                "Ctrl+20": "Ctrl+-", "65": "Space", "61": None, "Ctrl+32": "Ctrl+o", "25": None,
            },
            {QUALITY: "-  =", SPEED: "[  ]", FLYING: "W A S D, Q E"},
        ),
        (
            "de",
            {
                "61": "-", "35": "+", "Shift+19": "=", "AltGr+17": "[", "AltGr+18": "]", "59": ",", "60": ".",
                "20": None, "34": None, "10": "1", "Ctrl+61": "Ctrl+-", "Ctrl+35": "Ctrl++", "113": "Left",
            },
            {QUALITY: "-  +", SPEED: ",  .", FLYING: "W A S D, Q E"},
        ),
        (
            "fr",
            {
                "15": "-", "21": "=", "Shift+21": "+", "AltGr+14": "[", "AltGr+20": "]", "58": ",", "Shift+59": ".",
                "10": "1", "Shift+10": "1", "13": "4", "46": "l", "61": None, "Ctrl+15": "Ctrl+-",
            },
            {QUALITY: "-  =", SPEED: ",  .", FLYING: "Z Q S D, A E"},
        ),
        ("ru", {"46": "l", "34": "[", "Shift+32": "Shift+o", "Ctrl+39": "Ctrl+s", "20": "-"}, {FLYING: "W A S D, Q E"}),
        ("us -variant dvorak", {"39": "o", "25": ",", "20": "[", "48": "-"}, {FLYING: "W A S D, Q E"}),
    ],
)  # fmt: skip
def test_shortcuts_go_by_letter(
    display: str, layout: str, typed: dict[str, str | None], help_lines: dict[str, str]
) -> None:
    env = {k: v for k, v in os.environ.items() if not k.startswith(("WAYLAND", "PYGLFW"))} | {"DISPLAY": display}
    subprocess.run(["setxkbmap", "-layout", *layout.split()], env=env, check=True, timeout=20)
    done = subprocess.run(
        [sys.executable, SCRIPT, *typed], env=env, capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert dict(zip(typed, found["shortcuts"], strict=True)) == {k: [v] if v else [] for k, v in typed.items()}
    assert {line: found["help"][line] for line in help_lines} == help_lines
    assert (found["flying"] == list(FLYING_KEYS)) == ("dvorak" not in layout)


def test_flying_goes_by_letter_where_its_place_has_a_shortcut() -> None:
    colemak = US_CHARACTERS | {glfw.KEY_S: "r", glfw.KEY_D: "s", glfw.KEY_E: "f", glfw.KEY_K: "e", glfw.KEY_G: "d"}
    assert flying_keys({"r", "l"}, US_CHARACTERS.get) == FLYING_KEYS
    left, right, down, up, backward, forward = flying_keys({"r", "l"}, colemak.get)
    assert (left, right, backward) == (glfw.KEY_A, glfw.KEY_G, glfw.KEY_D)
    assert (down, up, forward) == (glfw.KEY_Q, glfw.KEY_K, glfw.KEY_W)


def test_keys_without_a_character_and_with_a_dead_one() -> None:
    assert KeyPress(glfw.KEY_F1, None).shortcuts() == () == KeyPress(glfw.KEY_L, None).shortcuts()
    assert KeyPress(None, " ").shortcuts() == () and KeyPress(None, "").shortcuts() == ()
    assert KeyPress(glfw.KEY_SPACE, None, glfw.MOD_SHIFT).shortcuts() == ("Shift+Space", "Space")
    assert nearest_at_hand(("[  ]", ",  ."), lambda key: None) == "[  ]"
