"""Puts GLSL files together: preamble, `#include`s, `#unroll`s, `#line`, and compiler messages that name the file they
mean.

The files in `player/gl/glsl` hold no `#version`, so that one set serves every `Language`. They are written in the
subset that desktop OpenGL 3.3 and WebGL2 both understand, GLSL ES 3.00. What a shader does is known only with its scene
(how many layers, which weights), so a browser composes them, too: `player/web/src/render/shader.ts` reads the same
files, and a test holds both composers to the same text.
"""

import contextlib
import re
from collections.abc import Iterator, Mapping
from enum import Enum
from importlib import resources

import moderngl
import numpy as np

from kpc.format.common.errors import DisplayError


class Language(Enum):
    """What a shader is composed for; the value is what the text begins with."""

    DESKTOP = "#version 330 core"
    DESKTOP_COMPUTE = "#version 430 core"
    WEB = """#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp sampler3D;
precision highp usampler3D;"""


LINES_A_FILE = 10000

_UNROLL = re.compile(r"^\s*#unroll\s+(\w+)\s+([\w#]+)\s*(?://.*)?$")
_END = re.compile(r"^\s*#end\s*(?://.*)?$")
_INCLUDE = re.compile(r'^\s*#include\s+"([\w./-]+)"\s*(?://.*)?$')
_WHERE = re.compile(r"(?:ERROR:\s*)?\b\d+[:(](\d+)\)?(?:\(\d+\))?\s*:\s*(?:error\b\s*:?)?\s*(.*)", re.IGNORECASE)


def compose(
    name: str,
    defines: Mapping[str, int] | None = None,
    language: Language = Language.DESKTOP,
    written: Mapping[str, str] | None = None,
) -> tuple[str, list[str]]:
    """The whole text of the shader `name`, and the names of the files in it.

    A `#line` gives line L of file F the number F * LINES_A_FILE + L. (The language has a second number for the file,
    but Mesa reports some complaints under the file before.)

    Each file is included once. The lines from `#unroll NAME COUNT` to `#end` are written COUNT times, a number or one
    of `defines`, with the word NAME, or ##NAME as part of a word, replaced by 0, 1, ...: compilers do not unroll long
    loops, and on a software driver an array at an index that is not a constant costs more than all else. `defines`
    become macros. `written` holds files that are made for one scene, by name; the others lie in `player/gl/glsl`.

    Raises:
        ValueError: an included file does not exist; a count is not known; an #end is missing.
    """
    files: list[str] = []
    macros = "".join(f"#define {key} {value}\n" for key, value in (defines or {}).items())
    return f"{language.value}\n{macros}" + _expand(name, files, written or {}, defines or {}), files


def _expand(name: str, files: list[str], written: Mapping[str, str], defines: Mapping[str, int]) -> str:
    number = len(files)
    files.append(name)
    base = number * LINES_A_FILE
    out = [f"#line {base + 1}"]
    lines = _unrolled(list(enumerate(_source(name, written).splitlines(), base + 1)), defines)
    expected = base + 1
    for line_number, line in lines:
        include = _INCLUDE.match(line)
        if line_number != expected:
            out.append(f"#line {line_number}")
        expected = line_number + 1
        if include is None:
            out.append(line)
        elif include[1] in files:
            out.append("")
        else:
            out.append(_expand(include[1], files, written, defines))
            expected = 0  # whatever comes next, its number has to be said
    return "\n".join(out) + "\n"


def _unrolled(lines: list[tuple[int, str]], defines: Mapping[str, int]) -> list[tuple[int, str]]:
    """Numbered lines with every #unroll written out, inner ones after outer ones."""
    out: list[tuple[int, str]] = []
    at = 0
    while at < len(lines):
        head = _UNROLL.match(lines[at][1])
        at += 1
        if head is None:
            out.append(lines[at - 1])
            continue
        start, depth = at, 1
        while depth:
            if at == len(lines):
                raise ValueError(f"#unroll {head[1]} has no #end")
            depth += bool(_UNROLL.match(lines[at][1])) - bool(_END.match(lines[at][1]))
            at += 1
        if not head[2].isdecimal() and head[2] not in defines:
            raise ValueError(f"#unroll {head[1]} {head[2]}: that count is not known")
        word = re.compile(rf"##{head[1]}\b|\b{head[1]}\b")
        for i in range(int(head[2]) if head[2].isdecimal() else defines[head[2]]):
            out += _unrolled([(number, word.sub(str(i), line)) for number, line in lines[start : at - 1]], defines)
    return out


def _source(name: str, written: Mapping[str, str]) -> str:
    if name in written:
        return written[name]
    file = resources.files("kpc.player.gl.glsl").joinpath(name)
    if not file.is_file():
        raise ValueError(f"shader file {name} does not exist")
    return file.read_text()


def build(
    ctx: moderngl.Context,
    fragment: str,
    defines: Mapping[str, int] | None = None,
    written: Mapping[str, str] | None = None,
    vertex: str = "fullscreen.glsl",
) -> moderngl.Program:
    """Compile a fragment shader that is drawn over the whole viewport, or where the shader `vertex` says.

    Raises:
        DisplayError: the driver refuses it; the message names file, line and driver.
    """
    vertex_text, _ = compose(vertex, defines)
    text, files = compose(fragment, defines, written=written)
    with _errors_with_file_names(ctx, files):
        return ctx.program(vertex_shader=vertex_text, fragment_shader=text)


def build_compute(
    ctx: moderngl.Context, name: str, defines: Mapping[str, int], written: Mapping[str, str] | None = None
) -> moderngl.ComputeShader:
    """Compile a compute shader. The context must be of GL 4.3.

    Raises:
        DisplayError: as `build`.
    """
    text, files = compose(name, defines, Language.DESKTOP_COMPUTE, written)
    with _errors_with_file_names(ctx, files):
        return ctx.compute_shader(text)


@contextlib.contextmanager
def _errors_with_file_names(ctx: moderngl.Context, files: list[str]) -> Iterator[None]:
    try:
        yield
    except moderngl.Error as error:
        message, driver = first_error(str(error), files), ctx.info["GL_RENDERER"]
        raise DisplayError(f"{message} (driver: {driver}); update it, or kprender --backend reference") from error


def constants(arrays: Mapping[str, np.ndarray]) -> str:
    """Return GLSL that declares each (N, 4) float32 array as `const vec4 name[N]`, (N,) ones as float or int, to the
    last bit."""
    lines = []
    for name, array in arrays.items():
        if array.ndim == 2:
            kind, values = (
                "vec4",
                ["vec4(" + ", ".join(f"{x:.9e}" for x in row) + ")" for row in np.asarray(array, np.float32)],
            )
        elif array.dtype.kind == "i":
            kind, values = "int", [str(n) for n in array]
        else:
            kind, values = "float", [f"{x:.9e}" for x in np.asarray(array, np.float32)]
        lines.append(f"const {kind} {name}[{len(array)}] = {kind}[{len(array)}]({', '.join(values)});")
    return "\n".join(lines) + "\n"


def first_error(log: str, files: list[str]) -> str:
    """Return the first message of a driver's log that names a line, as "shader file:line: message"."""
    for line in log.splitlines():
        where = _WHERE.search(line)
        if where is not None and int(where[1]) // LINES_A_FILE < len(files):
            file, number = divmod(int(where[1]), LINES_A_FILE)
            return f"shader {files[file]}:{number}: {where[2].strip()}"
    return f"shader {files[0]}: {' '.join(log.split())}"
