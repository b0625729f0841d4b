"""The only place where glfw and imgui are imported, with the library that the desktop needs.

On Linux, glfw has one library for X11 and one for Wayland. PYGLFW_LIBRARY is set to that for Wayland where there is no
X server; PYGLFW_LIBRARY_VARIANT=wayland asks for it anywhere.
"""

import importlib.util
import os
import sys
from collections.abc import Mapping
from pathlib import Path


def wayland_library(platform: str, environment: Mapping[str, str]) -> Path | None:
    """Return the path of glfw's library for Wayland; None if it is not to be used, or missing.

    Args:
        platform: `sys.platform`.
        environment: variables of the environment.
    """
    is_only = "WAYLAND_DISPLAY" in environment and not environment.get("DISPLAY")
    wanted = environment.get("PYGLFW_LIBRARY_VARIANT", "wayland" if is_only else "x11").lower()
    package = importlib.util.find_spec("glfw") if platform == "linux" and wanted == "wayland" else None
    library = Path(package.origin).with_name("wayland") / "libglfw.so" if package and package.origin else None
    return library if library and library.is_file() else None


if library := wayland_library(sys.platform, os.environ):
    os.environ.setdefault("PYGLFW_LIBRARY", str(library))

import glfw  # noqa: E402
from slimgui import imgui  # noqa: E402

__all__ = ["glfw", "imgui"]
