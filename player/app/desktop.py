"""What windows are made with, from here alone: glfw and imgui, brought in in the order, and by the library, that this desktop needs.

On Linux glfw brings a library for X11 and one for Wayland, and imgui-bundle one of its own for X11, which glfw takes where it comes second. Where it
comes first, its library stands in for imgui-bundle's, which finds in that for Wayland nothing of X11 and does not load. So it comes second, and is
told beforehand to take the one for Wayland where there is no X server. PYGLFW_LIBRARY_VARIANT=wayland asks for that anywhere.
"""

import importlib.util
import os
import sys
from collections.abc import Mapping
from pathlib import Path


def wayland_library(platform: str, environment: Mapping[str, str]) -> Path | None:
    """That of glfw, where it is to be taken and there is one."""
    alone = "WAYLAND_DISPLAY" in environment and not environment.get("DISPLAY")
    wanted = environment.get("PYGLFW_LIBRARY_VARIANT", "wayland" if alone else "x11").lower()
    package = importlib.util.find_spec("glfw") if platform == "linux" and wanted == "wayland" else None
    library = Path(package.origin).with_name("wayland") / "libglfw.so" if package and package.origin else None
    return library if library and library.is_file() else None


if library := wayland_library(sys.platform, os.environ):
    os.environ.setdefault("PYGLFW_LIBRARY", str(library))

import glfw  # noqa: E402, I001
from imgui_bundle import hello_imgui, imgui  # noqa: E402

__all__ = ["glfw", "hello_imgui", "imgui"]
