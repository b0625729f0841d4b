"""Puts GLSL files together: preamble, `#include`s, `#line`, and compiler messages that name the file they mean.

The files in `player/glsl` hold no `#version`, so that one set serves desktop OpenGL 3.3 and WebGL2. They are written in
the subset that both understand (GLSL ES 3.00).
"""

import re
from collections.abc import Mapping
from importlib import resources

import moderngl
import numpy as np

from kpc.format.errors import DisplayError

GL33 = "#version 330 core"
ES30 = """#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp sampler3D;
precision highp usampler3D;"""

LINES_A_FILE = 10000

_INCLUDE = re.compile(r'^\s*#include\s+"([\w./-]+)"\s*(?://.*)?$')
_WHERE = re.compile(r"(?:ERROR:\s*)?\b\d+[:(](\d+)\)?(?:\(\d+\))?\s*:\s*(?:error\b\s*:?)?\s*(.*)", re.IGNORECASE)


def compose(
    name: str, defines: Mapping[str, int] | None = None, preamble: str = GL33, written: Mapping[str, str] | None = None
) -> tuple[str, list[str]]:
    """The whole text of the shader `name`, and the names of the files in it.

    A `#line` gives line L of file F the number F * LINES_A_FILE + L. (The language has a second number for the file,
    but Mesa reports some complaints under the file before.)

    Each file is included once. `defines` become macros. `written` holds files that are made for one scene, by name; the
    others lie in `player/glsl`.

    Raises:
        ValueError: an included file does not exist.
    """
    files: list[str] = []
    macros = "".join(f"#define {key} {value}\n" for key, value in (defines or {}).items())
    return f"{preamble}\n{macros}" + _expand(name, files, written or {}), files


def _expand(name: str, files: list[str], written: Mapping[str, str]) -> str:
    number = len(files)
    files.append(name)
    base = number * LINES_A_FILE
    out = [f"#line {base + 1}"]
    for line_number, line in enumerate(_source(name, written).splitlines(), 1):
        include = _INCLUDE.match(line)
        if include is None:
            out.append(line)
        elif include[1] in files:
            out.append("")
        else:
            out += [_expand(include[1], files, written), f"#line {base + line_number + 1}"]
    return "\n".join(out) + "\n"


def _source(name: str, written: Mapping[str, str]) -> str:
    if name in written:
        return written[name]
    file = resources.files("kpc.player.glsl").joinpath(name)
    if not file.is_file():
        raise ValueError(f"shader file {name} does not exist")
    return file.read_text()


def build(
    ctx: moderngl.Context,
    fragment: str,
    defines: Mapping[str, int] | None = None,
    written: Mapping[str, str] | None = None,
) -> moderngl.Program:
    """Compile a fragment shader that is drawn over the whole viewport.

    Raises:
        DisplayError: the driver refuses it; the message names file, line and driver.
    """
    vertex_text, _ = compose("fullscreen.glsl", defines)
    text, files = compose(fragment, defines, written=written)
    try:
        return ctx.program(vertex_shader=vertex_text, fragment_shader=text)
    except moderngl.Error as error:
        message, driver = first_complaint(str(error), files), ctx.info["GL_RENDERER"]
        raise DisplayError(f"{message} (driver: {driver}); update it, or kprender --backend reference") from error


def constants(arrays: Mapping[str, np.ndarray]) -> str:
    """GLSL that declares each (N, 4) float32 array as `const vec4 name[N]`, (N,) ones as float or int, to the last bit."""
    lines = []
    for name, array in arrays.items():
        if array.ndim == 2:
            kind, values = "vec4", ["vec4(" + ", ".join(f"{x:.9e}" for x in row) + ")" for row in np.asarray(array, np.float32)]
        elif array.dtype.kind == "i":
            kind, values = "int", [str(n) for n in array]
        else:
            kind, values = "float", [f"{x:.9e}" for x in np.asarray(array, np.float32)]
        lines.append(f"const {kind} {name}[{len(array)}] = {kind}[{len(array)}]({', '.join(values)});")
    return "\n".join(lines) + "\n"


def first_complaint(log: str, files: list[str]) -> str:
    """The first message of a driver's log that names a place, as "shader file:line: message"."""
    for line in log.splitlines():
        where = _WHERE.search(line)
        if where is not None and int(where[1]) // LINES_A_FILE < len(files):
            file, number = divmod(int(where[1]), LINES_A_FILE)
            return f"shader {files[file]}:{number}: {where[2].strip()}"
    return f"shader {files[0]}: {' '.join(log.split())}"
