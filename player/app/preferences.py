"""What the player remembers from one run to the next, in a small JSON file in the platform's folder for settings.

The file may have been changed by anybody: it is read no further than LARGEST, and every value that is not as it should be counts
as not there.
"""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from kpc.format.common.cli import atomic_write
from kpc.player.app.controls import SPEEDS
from kpc.player.quality import LEVELS

LARGEST = 1 << 16
WINDOW_SIDES = range(64, 16385)
TARGET_FPS = (1.0, 240.0)
TEXT_SIZES = (0.5, 3.0)


@dataclass(frozen=True)
class Preferences:
    """The defaults are those of a first run.

    Attributes:
        size: of the window, screen units; None: as the scene's first camera asks for.
        quality: a rung of LADDER; None: as the device asks for.
        target_fps: hold so many frames a second by moving along the ladder; None: stay.
        speed: one of SPEEDS; loop: begin again at the clip's end.
        controls, graphs, planes: whether these are shown.
        text_size: of the controls, 1 as the system asks for.
    """

    size: tuple[int, int] | None = None
    quality: str | None = None
    target_fps: float | None = None
    speed: float = 1.0
    loop: bool = True
    controls: bool = True
    graphs: bool = False
    planes: bool = False
    text_size: float = 1.0


def _is_between(low: float, high: float) -> Callable[[Any], bool]:
    return lambda value: isinstance(value, float | int) and not isinstance(value, bool) and low <= value <= high


def _is_flag(value: Any) -> bool:
    return isinstance(value, bool)


def _is_size(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(isinstance(n, int) and n in WINDOW_SIDES for n in value)


_IS_RIGHT: dict[str, Callable[[Any], bool]] = {
    "size": _is_size,
    "quality": lambda value: isinstance(value, str) and value in LEVELS,
    "target_fps": _is_between(*TARGET_FPS),
    "speed": lambda value: _is_between(SPEEDS[0], SPEEDS[-1])(value) and value in SPEEDS,
    "loop": _is_flag,
    "controls": _is_flag,
    "graphs": _is_flag,
    "planes": _is_flag,
    "text_size": _is_between(*TEXT_SIZES),
}


def preferences_path() -> Path:
    """The file: under $XDG_CONFIG_HOME or ~/.config, ~/Library/Application Support, or %APPDATA%."""
    from kpc.player.app.desktop import hello_imgui

    return (
        Path(hello_imgui.ini_folder_location(hello_imgui.IniFolderType.app_user_config_folder)) / "kpc" / "player.json"
    )


def load(path: Path) -> Preferences:
    """What the file says, as far as that is valid; the defaults where it is not, or where there is no file to read."""
    try:
        if not path.is_file():  # a pipe would make us wait for ever
            return Preferences()
        with path.open("rb") as file:
            said = json.loads(file.read(LARGEST))
    except (OSError, ValueError, RecursionError):
        return Preferences()
    if not isinstance(said, dict):
        return Preferences()
    right = {name: said[name] for name, is_right in _IS_RIGHT.items() if name in said and is_right(said[name])}
    if "size" in right:
        right["size"] = tuple(right["size"])
    return Preferences(**right)


def save(preferences: Preferences, path: Path) -> None:
    """Write the file, and the folder it lies in.

    Raises:
        OSError: the folder cannot be written to.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as aside:
        aside.write_text(
            json.dumps({name: value for name, value in asdict(preferences).items() if value is not None}, indent=1)
        )
