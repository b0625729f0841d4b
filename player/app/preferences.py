"""Settings of the player that are kept from one run to the next, in a small JSON file.

The file may contain anything: at most MAX_BYTES of it are read, and invalid values are ignored.
"""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import platformdirs

from kpc.format.common.cli import atomic_write
from kpc.player.app.playlist import MAX_RECENT
from kpc.player.quality import LEVELS

# Bytes of the file that are read.
MAX_BYTES = 1 << 16
# Width and height of a window, screen units.
WINDOW_SIDES = range(64, 16385)
# The smallest (width, height) of a window in which nothing is cut off, screen units.
MIN_WINDOW = 640, 480
# Lowest and highest frame rate to hold.
TARGET_FPS = (1.0, 240.0)
# Smallest and largest text, relative to the system's text size.
TEXT_SIZES = (0.5, 3.0)


@dataclass(frozen=True)
class Preferences:
    """Settings; the defaults are those of a first run.

    Attributes:
        size: (width, height) of the window, screen units, at least MIN_WINDOW when it is loaded; None: derived from the
            scene's first camera.
        quality: name of a quality level; None: the device's default.
        target_fps: frame rate to hold by changing the quality; None: the quality stays.
        controls, graphs, planes: whether these panels are shown.
        text_size: of the panels, 1 for the system's text size.
        recent: paths and addresses of the files that were opened lately, the latest first.
        volume: of sound, 0 to 1; muted: whether it is off.
    """

    size: tuple[int, int] | None = None
    quality: str | None = None
    target_fps: float | None = None
    controls: bool = True
    graphs: bool = False
    planes: bool = False
    text_size: float = 1.0
    recent: tuple[str, ...] = ()
    volume: float = 1.0
    muted: bool = False


def _is_between(low: float, high: float) -> Callable[[Any], bool]:
    return lambda value: isinstance(value, float | int) and not isinstance(value, bool) and low <= value <= high


def _is_bool(value: Any) -> bool:
    return isinstance(value, bool)


def _is_size(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(isinstance(n, int) and n in WINDOW_SIDES for n in value)


def _is_recent(value: Any) -> bool:
    return isinstance(value, list) and len(value) <= MAX_RECENT and all(isinstance(n, str) and n for n in value)


_IS_VALID: dict[str, Callable[[Any], bool]] = {
    "size": _is_size,
    "quality": lambda value: isinstance(value, str) and value in LEVELS,
    "target_fps": _is_between(*TARGET_FPS),
    "controls": _is_bool,
    "graphs": _is_bool,
    "planes": _is_bool,
    "text_size": _is_between(*TEXT_SIZES),
    "volume": _is_between(0.0, 1.0),
    "muted": _is_bool,
    "recent": _is_recent,
}


def preferences_path() -> Path:
    """Return the path of the file, in $XDG_CONFIG_HOME or ~/.config, ~/Library/Application Support, or %APPDATA%."""
    return platformdirs.user_config_path(roaming=True) / "kpc" / "player.json"


def load(path: Path) -> Preferences:
    """Read a file; defaults replace invalid values, and everything if the file cannot be read."""
    try:
        if not path.is_file():  # reading a pipe might never return
            return Preferences()
        with path.open("rb") as file:
            found = json.loads(file.read(MAX_BYTES))
    except (OSError, ValueError, RecursionError):
        return Preferences()
    if not isinstance(found, dict):
        return Preferences()
    valid = {name: found[name] for name, is_valid in _IS_VALID.items() if name in found and is_valid(found[name])}
    if "size" in valid:
        valid["size"] = tuple(map(max, valid["size"], MIN_WINDOW))
    if "recent" in valid:
        valid["recent"] = tuple(valid["recent"])
    return Preferences(**valid)


def save(preferences: Preferences, path: Path) -> None:
    """Write a file, and make its folder.

    Raises:
        OSError: the file cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    values = {name: value for name, value in asdict(preferences).items() if value is not None}
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(values, indent=1))
