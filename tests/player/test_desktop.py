"""Which glfw library is used, and that only one module imports it."""

import ast
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
    """If glfw is imported before imgui-bundle, it may be the wrong library, or imgui-bundle may fail to load."""
    for folder in ("player", "tools"):
        for file in sorted((ROOT / folder).rglob("*.py")):
            found = {module.split(".")[0] for module in imports(file)} & {"glfw", "imgui_bundle"}
            assert not found or file.name == "desktop.py", f"{file.relative_to(ROOT)} imports {found}"
    lines = [
        node
        for node in ast.walk(ast.parse((ROOT / "player/app/desktop.py").read_text()))
        if isinstance(node, ast.Import | ast.ImportFrom)
    ]
    order = {(node.module if isinstance(node, ast.ImportFrom) else node.names[0].name): node.lineno for node in lines}
    assert order["imgui_bundle"] < order["glfw"]
