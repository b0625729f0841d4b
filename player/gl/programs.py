"""Shader programs of a scene, compiled when they are first needed, and drawing with them."""

from typing import Any

import moderngl

from kpc.format.common.errors import DisplayError
from kpc.format.scene.scene import Scene
from kpc.format.scene.space import Contraction, DeviceCoordinates, SpaceMapping
from kpc.player.atlas import Layout
from kpc.player.gl import shader
from kpc.player.gl.shader_constants import block_arrays, decoder_arrays, decoder_shape, planes_shape
from kpc.player.gl.textures import CELLS_UNIT, MOTION_UNIT, PLANES_UNIT, ROWS_UNIT, SceneTextures

# Units of the images and textures of a picture.
RGBA_UNIT, SUMS_UNIT, STATIC_UNIT = range(3)
# vec4s of decoder weights that a shader may hold, ten times what the largest preset needs; compilers choke on more.
MOST_CONSTANTS = 8192

# Renderers that are a processor which stands in for a graphics card.
SOFTWARE = ("llvmpipe", "softpipe", "swrast", "swiftshader")

AnyProgram = moderngl.Program | moderngl.ComputeShader


def is_software(ctx: moderngl.Context) -> bool:
    """Return whether a processor stands in for a graphics card."""
    return any(word in ctx.info["GL_RENDERER"].lower() for word in SOFTWARE)


class Programs:
    """The programs of a scene.

    Raises:
        DisplayError: the decoder has too many weights for a shader.
    """

    def __init__(self, textures: SceneTextures) -> None:
        self.ctx, self._textures = textures.ctx, textures
        weights = decoder_arrays(textures.scene.decoder, textures.scene, textures.layout)
        count = sum(map(len, weights.values()))
        if count > MOST_CONSTANTS:
            raise DisplayError(
                f"the decoder has {4 * count} weights, a shader takes {4 * MOST_CONSTANTS}; "
                "kprender --backend reference"
            )
        self._decoder = shader.constants(weights)
        self._programs: dict[tuple[object, ...], tuple[AnyProgram, moderngl.VertexArray | None]] = {}

    def get(
        self, name: str, layout: Layout, compute: bool = False, **defines: int
    ) -> tuple[AnyProgram, moderngl.VertexArray | None]:
        """Return a program, compiled if necessary and with all uniforms set that never change, and what draws it over a
        whole viewport.

        Args:
            name: of the shader file.
            layout: of the planes that it reads.
            compute: whether it is to be a compute shader, which has no vertices.
            defines: macros, besides those that describe the scene.

        Raises:
            DisplayError: the driver refuses it.
        """
        key = name, layout.upsampling, compute, *sorted(defines.items())
        if key in self._programs:
            return self._programs[key]
        scene = self._textures.scene
        macros = {**scene_defines(scene, layout), "COMPUTE": int(compute), "COUNTED": 0, "DEPTH_LIMIT": 0, **defines}
        if is_software(self.ctx):  # llvmpipe executes both sides of a branch
            macros |= {f"PART_{scale}": 0 for scale in range(layout.scales)}
        written = {"decoder_weights": self._decoder, "plane_blocks": shader.constants(block_arrays(scene, layout))}
        program: AnyProgram
        vertices = None
        if compute:
            program = shader.build_compute(self.ctx, name, macros, written)
        else:
            program = shader.build(self.ctx, name, macros, written)
            vertices = self.ctx.vertex_array(program, [])
        motion, rows = self._textures.motion, self._textures.rows
        set_uniforms(
            program,
            rgba_picture=RGBA_UNIT,
            sums_picture=SUMS_UNIT,
            planes=PLANES_UNIT,
            rows=ROWS_UNIT,
            cells=CELLS_UNIT,
            motion=MOTION_UNIT,
            nodes=(1.0, 1.0, 1.0) if motion is None else tuple(map(float, motion.size)),
            rows_texel=(1 / rows.width, 1 / rows.height),
            cell_count=tuple(map(float, scene.occupancy.shape[:0:-1])),
            box_low=tuple(scene.aabb[0]),
            box_high=tuple(scene.aabb[1]),
            background=tuple(scene.background),
            uniform_distance=scene.mapping.uniform_distance if isinstance(scene.mapping, Contraction) else 0.0,
            **_device_uniforms(scene.mapping),
        )
        entry = self._programs[key] = program, vertices
        return entry

    def names(self) -> set[tuple[object, ...]]:
        """Return the keys of all programs that are compiled."""
        return set(self._programs)

    def release(self) -> None:
        for program, vertices in self._programs.values():
            if vertices is not None:
                vertices.release()
            program.release()
        self._programs.clear()


def scene_defines(scene: Scene, layout: Layout) -> dict[str, int]:
    """Return the macros that describe a scene whose planes lie in a layout."""
    return {
        **planes_shape(scene, layout),
        **decoder_shape(scene.decoder),
        "APPEARANCE": int(bool(scene.appearances)),
        "CONTRACTED": int(isinstance(scene.mapping, Contraction)),
        "NDC": int(isinstance(scene.mapping, DeviceCoordinates)),
    }


def draw(
    ctx: moderngl.Context,
    framebuffer: moderngl.Framebuffer,
    vertices: moderngl.VertexArray | None,
    viewport: tuple[int, int, int, int] | None = None,
    blend: bool = False,
    scissor: tuple[int, int, int, int] | None = None,
) -> None:
    """Draw over all of a framebuffer, or a viewport of it within a scissor; `blend` with what is there, by alpha."""
    assert vertices is not None, "compute shaders are run, not drawn"
    ctx.disable(moderngl.BLEND | moderngl.DEPTH_TEST | moderngl.CULL_FACE)
    if blend:
        ctx.enable(moderngl.BLEND)
        factors = moderngl.SRC_ALPHA, moderngl.ONE_MINUS_SRC_ALPHA, moderngl.ONE, moderngl.ONE_MINUS_SRC_ALPHA
        ctx.blend_func = factors  # type: ignore[assignment]
    framebuffer.use()
    framebuffer.viewport = viewport or (0, 0, *framebuffer.size)
    framebuffer.scissor = scissor  # type: ignore[assignment]
    vertices.render(moderngl.TRIANGLES, vertices=3)
    framebuffer.scissor = None  # type: ignore[assignment]  # or it would bound the next clear


def set_uniforms(program: AnyProgram, **values: Any) -> None:
    """Set the uniforms that a program has; compilers drop unused ones, and the unused ends of arrays."""
    for name, value in values.items():
        member = program.get(name, None)
        if isinstance(member, moderngl.Uniform):
            if isinstance(value, list):  # moderngl wants an array of one without the brackets
                value = value[: member.array_length] if member.array_length > 1 else value[0]
            member.value = value


def _device_uniforms(mapping: SpaceMapping | None) -> dict[str, object]:
    if not isinstance(mapping, DeviceCoordinates):
        return {}
    return {"frame": tuple(mapping.frame.T.ravel()), "near": mapping.near, "baseline": mapping.baseline}
