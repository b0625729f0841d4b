"""OpenGL without a window."""

from typing import Any

import moderngl

from kpc.format.common.errors import DisplayError

REMEDY = "apt install libegl1 libgl1-mesa-dri (Debian, Ubuntu), or kprender --backend reference"


def open_context() -> moderngl.Context:
    """Open an OpenGL context that draws to textures: 4.3 for compute shaders where there is that, else 3.3; through EGL
    if possible, else what the system offers. (Some drivers give more than they are asked for, NVIDIA's gives exactly
    that.)

    Raises:
        DisplayError: there is none; the message says how to get one.
    """
    complaints = []
    backends: tuple[dict[str, Any], ...] = ({"backend": "egl"}, {})
    for backend in backends:
        for version in (430, 330):
            try:
                return moderngl.create_context(require=version, standalone=True, **backend)
            except Exception as error:  # glcontext raises bare Exception, ImportError or ValueError, whatever failed
                complaint = str(error)
        complaints.append(complaint)
    raise DisplayError(f"no OpenGL 3.3 to be had ({'; '.join(complaints)}): {REMEDY}")


def describe(ctx: moderngl.Context) -> str:
    """Return the renderer and its version, in one line."""
    return f"{ctx.info['GL_RENDERER']}, OpenGL {ctx.info['GL_VERSION']}"
