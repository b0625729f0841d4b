"""Which glfw library is used, and that only one module imports it."""

from pathlib import Path

import glfw
import pytest

from kpc.player.app.desktop import wayland_library
from test_floors import ROOT, imports

LIBRARY = Path(glfw.__file__).with_name("wayland") / "libglfw.so"


@pytest.mark.parametrize(
    ("environment", "is_wanted"),
    [
        ({}, False),
        ({"DISPLAY": ":0"}, False),
        ({"WAYLAND_DISPLAY": "wayland-0"}, True),
        ({"WAYLAND_DISPLAY": "wayland-0", "DISPLAY": ""}, True),
        ({"WAYLAND_DISPLAY": "wayland-0", "DISPLAY": ":0", "XDG_SESSION_TYPE": "wayland"}, False),
        ({"WAYLAND_DISPLAY": "wayland-0", "DISPLAY": ":0", "PYGLFW_LIBRARY_VARIANT": "Wayland"}, True),
        ({"WAYLAND_DISPLAY": "wayland-0", "PYGLFW_LIBRARY_VARIANT": "x11"}, False),
    ],
)
def test_wayland_is_used_without_an_x_server_or_on_request(environment: dict[str, str], is_wanted: bool) -> None:
    assert wayland_library("linux", environment) == (LIBRARY if is_wanted and LIBRARY.is_file() else None)
    assert wayland_library("darwin", environment) is None and wayland_library("win32", environment) is None


def test_only_one_module_imports_the_window_libraries() -> None:
    """If glfw is imported elsewhere first, it may be the wrong library."""
    for folder in ("player", "tools"):
        for file in sorted((ROOT / folder).rglob("*.py")):
            found = {module.split(".")[0] for module in imports(file)} & {"glfw", "slimgui"}
            assert not found or file.name == "desktop.py", f"{file.relative_to(ROOT)} imports {found}"
