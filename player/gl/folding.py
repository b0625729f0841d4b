"""Folding: once a frame, the time rows are multiplied into the space planes, so that a march looks up half as many
texels.

The product is exact at the texels that are written. Between them the product of two interpolations becomes the
interpolation of a product, an error that falls with the square of the distance between texels; so planes and rows are
upsampled along the row first. Planes whose rows are those that were folded before are not folded again, such as all of
a scale for what stays.
"""

from collections.abc import Sequence

import moderngl
import numpy as np

from kpc.format.scene.scene import SPACE_PLANES, Scene
from kpc.player.atlas import FOLDING_AXIS, Layout
from kpc.player.gl.programs import Programs, draw, set_uniforms
from kpc.player.gl.targets import allocation
from kpc.player.gl.textures import PLANES_UNIT, ROWS_UNIT, SceneTextures, plane_texture, texture_bytes

# Texels of a folded plane to one of the scene's, along the folded row.
UPSAMPLING = 2
# The largest float16. Folded planes are float16 where it holds them: cards look it up at more than twice the rate of
# float32, and room is 74 dB and soldier 80 dB from their pictures in float32.
LARGEST_HALF = 65504.0
# The largest number of a channel of a plane from which on float16 holds it to 8 bits and more.
LEAST_HALF = 2.0**-16
LARGEST_SINGLE = float(np.finfo(np.float32).max)


def folded_layout(textures: SceneTextures) -> Layout:
    """Return the layout of folded planes: upsampled, unless that is more than the card takes."""
    finer = Layout.of(textures.scene, UPSAMPLING)
    return finer if max(finer.size) <= textures.ctx.info["GL_MAX_TEXTURE_SIZE"] else textures.layout


def folded_dtype(scene: Scene) -> str:
    """Return "f2", the type of folded planes, or "f4" where a product may be too large or a channel too small for it.

    Numbers on a plane's way to 0 are small, but where a channel is small everywhere its weights are large.
    """
    for scale in scene.scales:
        for name in SPACE_PLANES:
            row = np.abs(scale[f"{FOLDING_AXIS[name]}t"]).max(axis=(0, 1))
            product = np.abs(scale[name]).max(axis=(0, 1)) * np.maximum(row, 1)
            if product.max() > LARGEST_HALF or (product[product > 0] < LEAST_HALF).any():
                return "f4"
    return "f2"


class FoldedPlanes:
    """The planes of a dynamic scene at one time.

    Attributes:
        layout: of the folded planes.
    """

    def __init__(self, textures: SceneTextures, programs: Programs) -> None:
        self._textures, self._programs = textures, programs
        assert textures.time_rows is not None, "a static scene has nothing to fold"
        ctx, self.layout = textures.ctx, folded_layout(textures)
        with allocation(ctx, "the folded planes"):
            lines, width = self.layout.line_count, self.layout.upsampling * (textures.time_rows.width - 1) + 1
            self._upsampled = plane_texture(ctx, self.layout.size)
            self._rows = plane_texture(ctx, (width, lines))
            self._planes = plane_texture(ctx, self.layout.size, folded_dtype(textures.scene))
            self._upsampled.filter = self._rows.filter = moderngl.NEAREST, moderngl.NEAREST
            self._upsample_into, self._fold_into = ctx.framebuffer([self._upsampled]), ctx.framebuffer([self._planes])
        self._time: float | None = None
        self._folded_rows: np.ndarray | None = None  # as `TimeRows.at`
        self._is_upsampled, self._is_checked = False, True

    @property
    def memory_bytes(self) -> int:
        return sum(texture_bytes(texture) for texture in (self._upsampled, self._rows, self._planes))

    @property
    def dtype(self) -> str:
        return self._planes.dtype

    def planes_changed(self) -> None:
        self._time, self._folded_rows, self._is_upsampled, self._is_checked = None, None, False, False

    def time_planes_changed(self) -> None:
        self._time, self._is_checked = None, False

    def at(self, time: float) -> moderngl.Texture:
        """Return the planes at a time in [0, 1]."""
        if not self._is_checked:
            self._check_dtype()
        if not self._is_upsampled:
            self._textures.planes.use(PLANES_UNIT)
            self._draw_blocks("upsample_plane.glsl", self._upsample_into, range(len(self.layout.blocks)))
            self._is_upsampled = True
        if time != self._time:
            assert self._textures.time_rows is not None
            rows = self._textures.time_rows.at(time, self.layout.upsampling)
            self._rows.write(rows)
            self._upsampled.use(PLANES_UNIT)
            self._rows.use(ROWS_UNIT)
            stale, self._folded_rows = self._stale_blocks(rows), None
            self._draw_blocks("fold.glsl", self._fold_into, stale)
            self._time, self._folded_rows = time, rows
        return self._planes

    def _stale_blocks(self, rows: np.ndarray) -> list[int]:
        """Return the numbers of the blocks with which other rows are folded now."""
        before, lines = self._folded_rows, [self.layout.lines(block) for block in self.layout.blocks]
        if before is None:
            return list(range(len(lines)))
        return [number for number, used in enumerate(lines) if not np.array_equal(rows[used], before[used])]

    def _check_dtype(self) -> None:
        """Make folded planes of another type where what has changed in the scene needs it."""
        dtype, self._is_checked = folded_dtype(self._textures.scene), True
        if dtype == self.dtype:
            return
        for resource in (self._fold_into, self._planes):
            resource.release()
        ctx = self._textures.ctx
        with allocation(ctx, "the folded planes"):
            self._planes = plane_texture(ctx, self.layout.size, dtype)
            self._fold_into = ctx.framebuffer([self._planes])
        self._folded_rows = None

    def _draw_blocks(self, name: str, into: moderngl.Framebuffer, numbers: Sequence[int]) -> None:
        """Draw some planes by a shader that takes as uniforms where they lie and which rows go with them."""
        source = self._textures.layout
        program, vertices = self._programs.get(name, source)
        set_uniforms(
            program,
            upsampled=PLANES_UNIT,
            upsampled_texel=tuple(1 / side for side in into.size),
            folded_rows_texel=tuple(1 / side for side in self._rows.size),
            largest=LARGEST_HALF if self.dtype == "f2" else LARGEST_SINGLE,
        )
        for number in numbers:
            block, written = source.blocks[number], self.layout.blocks[number]
            lines = self.layout.lines(written)
            set_uniforms(
                program,
                source=source.texture_rectangle(block),
                source_width=block.width / source.size[0],
                origin=(written.x, written.y),
                width=written.width,
                per_texel=(1 / max(written.width - 1, 1), 1 / max(written.height - 1, 1)),
                along_rows=written.is_folded_along_rows,
                line=lines.start,
            )
            columns = (lines.stop - lines.start) * written.width
            draw(self._textures.ctx, into, vertices, (written.x, written.y, columns, written.height))

    def release(self) -> None:
        for resource in (self._upsample_into, self._fold_into, self._upsampled, self._rows, self._planes):
            resource.release()
