"""OpenGL for tests: one context for all of them, a skip where there is none."""

import functools

import moderngl
import numpy as np
import pytest

from kpc.format.common.errors import DisplayError
from kpc.player.gl import shader
from kpc.player.gl.offscreen import open_context
from kpc.player.gl.textures import volume_texture


@functools.cache
def _context() -> moderngl.Context | str:
    try:
        return open_context()
    except DisplayError as error:
        return str(error)


def context() -> moderngl.Context:
    found = _context()
    if isinstance(found, str):
        pytest.skip(found)
    found.__enter__()  # what a test before rendered within a command may have made another one current
    return found


def evaluate(
    glsl: str, expression: str, *inputs: np.ndarray, grid: np.ndarray | None = None, **defines: int
) -> np.ndarray:
    """Evaluate a GLSL expression at N points.

    Args:
        glsl: what comes before main, `#include`s for the most part.
        expression: of type vec4.
        inputs: (N, 4) each, N a multiple of 256, called a, b, c, d in the expression.
        grid: (Nz, Ny, Nx, 4), a filtered sampler3D of that name.

    Returns:
        (N, 4) float32.
    """
    ctx, names = context(), "abcd"[: len(inputs)]
    size = (256, len(inputs[0]) // 256)
    fetch = "".join(f"vec4 {n} = texelFetch(from_{n}, ivec2(gl_FragCoord.xy), 0); " for n in names)
    text = (
        "".join(f"uniform sampler2D from_{n};\n" for n in names)
        + "uniform sampler3D grid;\n" * (grid is not None)
        + glsl
    )
    program = shader.build(ctx, "main", {"CONTRACTED": 0, "NDC": 0, "COUNTED": 0, **defines},
                           {"main": f"{text}\nout vec4 o;\nvoid main() {{ {fetch} o = {expression}; }}\n"})  # fmt: skip
    textures = [ctx.texture(size, 4, np.ascontiguousarray(array, np.float32), dtype="f4") for array in inputs]
    for unit, (name, texture) in enumerate(zip(names, textures, strict=True)):
        texture.use(unit)
        program[f"from_{name}"] = unit
    if grid is not None:
        volume = volume_texture(ctx, grid.shape[2::-1])
        volume.write(np.ascontiguousarray(grid, np.float32))
        volume.use(len(inputs))
        program["grid"] = len(inputs)
    target = ctx.framebuffer([ctx.texture(size, 4, dtype="f4")])
    target.use()
    ctx.vertex_array(program, []).render(moderngl.TRIANGLES, vertices=3)
    return np.frombuffer(target.read(components=4, dtype="f4"), np.float32).reshape(-1, 4)
