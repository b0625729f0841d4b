import re

import numpy as np
import pytest

import gl
from kpc.format.common.errors import DisplayError
from kpc.player.atlas import Layout
from kpc.player.gl import shader
from kpc.player.gl.shader_constants import block_arrays, decoder_arrays, decoder_shape, planes_shape
from scenes import tiny_scene, with_hybrid_decoder


def test_includes_come_once_and_lines_keep_their_numbers() -> None:
    written = {
        "a": '#include "b"\nint a;\n#include "c"  // why\nint bad;\n',
        "b": "int b;\n",
        "c": '#include "b"\nint c;\n',
    }
    text, files = shader.compose("a", {"N": 3}, written=written)
    assert files == ["a", "b", "c"]
    assert text.count("int b;") == 1 and "#define N 3\n" in text and "#include" not in text
    assert text.index("#version") == 0
    where, number = {}, 0
    for line in text.splitlines():
        if found := re.match(r"#line (\d+)$", line):
            number = int(found[1])
        else:
            where[line] = files[number // shader.LINES_A_FILE], number % shader.LINES_A_FILE
            number += 1
    assert where["int b;"] == ("b", 1) and where["int a;"] == ("a", 2) and where["int c;"] == ("c", 2)
    assert where["int bad;"] == ("a", 4)


def test_loops_are_written_out() -> None:
    written = {
        "a": "#unroll i TWO\nint x_##i = i;\n"
        "#unroll j N_##i  // nested\nint y_##i##j = idle + j;\n#end\n#end\nint bad;\n"
    }
    text, _ = shader.compose("a", {"TWO": 2, "N_0": 1, "N_1": 2}, written=written)
    lines = text.splitlines()
    assert [line for line in lines if line.startswith("int")] == [
        "int x_0 = 0;", "int y_00 = idle + 0;",
        "int x_1 = 1;", "int y_10 = idle + 0;", "int y_11 = idle + 1;",
        "int bad;",
    ]  # fmt: skip
    assert (
        lines[lines.index("int bad;") - 1] == "#line 7" and lines[lines.index("int y_11 = idle + 1;") - 1] == "#line 4"
    )
    with pytest.raises(ValueError, match="#unroll i has no #end"):
        shader.compose("a", written={"a": "#unroll i 3\n"})
    with pytest.raises(ValueError, match="MANY: that count is not known"):
        shader.compose("a", written={"a": "#unroll i MANY\n#end\n"})


def test_a_missing_file_is_named() -> None:
    with pytest.raises(ValueError, match="nowhere"):
        shader.compose("a", written={"a": '#include "nowhere.glsl"'})


FRAGMENTS = ("march", "cells", "upsample_plane", "fold", "present", "upscale", "enlarge", "average")


@pytest.mark.parametrize("name", [*(f"{name}.glsl" for name in FRAGMENTS), "fullscreen.glsl"])
def test_shader_files_leave_the_version_to_the_composer(name: str) -> None:
    scene = tiny_scene(0)
    defines = {**planes_shape(scene, Layout.of(scene)), **decoder_shape(scene.decoder)}
    text, files = shader.compose(
        name, defines, written={"decoder_weights": "", "plane_blocks": ""}, language=shader.Language.WEB
    )
    assert text.startswith("#version 300 es\n") and text.count("#version") == 1
    assert len(set(files)) == len(files)


@pytest.mark.parametrize(
    "log",
    [
        "0:10012(5): error: `x' undeclared",  # Mesa
        '0(10012) : error C1503: undefined variable "x"',  # NVIDIA
        "ERROR: 0:10012: 'x' : undeclared identifier",  # Intel, Apple, ANGLE
    ],
)
def test_compiler_messages_name_the_file(log: str) -> None:
    assert re.match(
        r"shader march\.glsl:12: .*(undeclared|undefined)",
        shader.first_error(f"\nFragment\n{log}\n", ["a.glsl", "march.glsl"]),
    )


def test_a_broken_shader_is_one_error_with_its_place() -> None:
    written = {
        "main": '#include "part"\nout vec4 o;\nvoid main() { o = vec4(part()); }\n',
        "part": "\nfloat part() { return wrong; }\n",
    }
    with pytest.raises(DisplayError, match=r"shader part:2: .*wrong.*driver"):
        shader.build(gl.context(), "main", written=written)


def test_constants_are_exact() -> None:
    values = np.random.default_rng(0).normal(size=(3, 4)).astype(np.float32)
    text = shader.constants({"w": values})
    assert text.startswith("const vec4 w[3] = vec4[3](vec4(")
    numbers = re.findall(r"-?\d\.\d+e[+-]\d+", text)
    assert np.array_equal(np.array(numbers, np.float32).reshape(3, 4), values)


@pytest.mark.parametrize("space", ["box", "contracted", "ndc", "hybrid"])
@pytest.mark.parametrize("rows", [0, 1])
@pytest.mark.parametrize("motion", [0, 1])
@pytest.mark.parametrize("name", [f"{name}.glsl" for name in FRAGMENTS])
def test_shaders_keep_to_the_subset_that_browsers_take(name: str, motion: int, rows: int, space: str) -> None:
    ctx = gl.context()
    if "GL_ARB_ES3_compatibility" not in ctx.extensions:
        pytest.skip("this OpenGL compiles no GLSL ES 3.00")
    scene = tiny_scene(0, scales=3, channels=5)
    scene = with_hybrid_decoder(scene) if space == "hybrid" else scene
    layout = Layout.of(scene)
    weights = shader.constants(decoder_arrays(scene.decoder, scene, layout))
    blocks = shader.constants(block_arrays(scene, layout))
    defines = {
        "ROWS": rows,
        "MODE": rows + 2 * motion,
        "MOTION": motion,
        "APPEARANCE": rows,
        "COMPUTE": 0,
        "COUNTED": motion,
        "DEPTH_LIMIT": rows,
    }
    defines |= {"CONTRACTED": int(space == "contracted"), "NDC": int(space == "ndc")}
    defines |= {**planes_shape(scene, layout), **decoder_shape(scene.decoder)}
    fragment, _ = shader.compose(
        name, defines, shader.Language.WEB, {"decoder_weights": weights, "plane_blocks": blocks}
    )
    vertex, _ = shader.compose("fullscreen.glsl", defines, language=shader.Language.WEB)
    ctx.program(vertex_shader=vertex, fragment_shader=fragment).release()
