"""A scene's textures: the atlas of planes, time rows, displacements and distances to occupied cells."""

import math
from collections.abc import Mapping
from typing import Any

import moderngl
import numpy as np

from kpc.format.common.errors import DisplayError
from kpc.format.scene.grid import sample_linear
from kpc.format.scene.scene import SPACE_PLANES, Scene
from kpc.player.areas import FeatureAreas
from kpc.player.atlas import Layout, TimeRows, empty_distances
from kpc.player.cpu.reference import occupancy_slot
from kpc.player.gl.targets import allocation

# Texture units.
PLANES_UNIT, ROWS_UNIT, CELLS_UNIT, MOTION_UNIT = range(4)


class SceneTextures:
    """What shaders look up of a scene.

    Attributes:
        layout: of the planes' atlas.
        planes: the atlas.
        rows: the time rows at the last `set_time_rows`.
        time_rows: the scene's time planes; None for a static scene.
        areas: of its scales, as far as planes have been put.

    Raises:
        DisplayError: the scene does not fit the card.
    """

    def __init__(self, ctx: moderngl.Context, scene: Scene) -> None:
        self.ctx, self.scene, self.layout = ctx, scene, Layout.of(scene)
        _refuse_too_large(scene, self.layout, ctx.info)
        with allocation(ctx, "the scene"):
            self.planes = plane_texture(ctx, self.layout.size)
            self.areas = FeatureAreas(scene, self.layout)
            self.time_rows = TimeRows(scene, self.layout) if scene.is_dynamic else None
            width = 1 if self.time_rows is None else self.time_rows.width
            self.rows = plane_texture(ctx, (width, self.layout.line_count))
            self.motion = None if scene.motion is None else volume_texture(ctx, scene.motion.shape[3:0:-1])
            self.cells = ctx.texture3d(scene.occupancy.shape[:0:-1], 1, alignment=1, dtype="u1")
            self.cells.filter = (moderngl.NEAREST, moderngl.NEAREST)
        self._distances: dict[int, np.ndarray] = {}
        self._slot: int | None = None
        self._rows_time: float | None = None
        self._motion_time: float | None = None
        for block in self.layout.blocks:
            self.put(block.scale, block.plane, self.layout.texels(scene.scales[block.scale][block.plane]))

    def put(self, scale: int, plane: str, texels: np.ndarray, first: int = 0) -> None:
        """Replace rows of a space plane from row `first` on by `Layout.texels`."""
        block = self.layout.block(scale, plane)
        self.areas.put(scale, plane, texels, first)
        self.planes.write(texels, viewport=(block.x, block.y + first, texels.shape[1], texels.shape[0]))

    def time_planes_changed(self) -> None:
        """Read the scene's time planes and displacements anew when they are needed next."""
        self._rows_time = self._motion_time = None

    def read_atlas(self) -> np.ndarray:
        """Read the planes back: (height, width, 4) float32."""
        return np.frombuffer(self.planes.read(), np.float32).reshape(*self.layout.size[::-1], 4)

    def set_time_rows(self, time: float) -> None:
        if time != self._rows_time and self.time_rows is not None:
            self.rows.write(self.time_rows.at(time))
            self._rows_time = time

    def set_motion(self, time: float) -> None:
        if time != self._motion_time and self.motion is not None and self.scene.motion is not None:
            offsets = sample_linear(self.scene.motion, time)
            self.motion.write(np.concatenate([offsets, offsets[..., :1]], axis=-1))  # RGBA: few cards have RGB
            self._motion_time = time

    def set_occupancy(self, time: float) -> None:
        slot = occupancy_slot(self.scene, time)
        if slot not in self._distances:
            self._distances[slot] = empty_distances(self.scene.occupancy[slot])
        if slot != self._slot:
            self.cells.write(self._distances[slot])
            self._slot = slot

    def bind(self, planes: moderngl.Texture) -> None:
        """Bind all textures to their units, `planes` being the atlas or planes that rows are folded into."""
        planes.use(PLANES_UNIT)
        self.rows.use(ROWS_UNIT)
        self.cells.use(CELLS_UNIT)
        if self.motion is not None:
            self.motion.use(MOTION_UNIT)

    @property
    def memory_bytes(self) -> int:
        motion = 0 if self.motion is None else 16 * int(np.prod(self.motion.size))
        return texture_bytes(self.planes) + texture_bytes(self.rows) + int(self.scene.occupancy[0].size) + motion

    def release(self) -> None:
        for texture in (self.planes, self.rows, self.cells, self.motion):
            if texture is not None:
                texture.release()


def plane_texture(ctx: moderngl.Context, size: tuple[int, int], dtype: str = "f4") -> moderngl.Texture:
    """Make a texture of (width, height) vectors of four, filtered, clamped at its edges, all 0: filters may touch what
    lies between the blocks of an atlas, with a weight of 0, which harms nothing but NaN."""
    texture = ctx.texture(size, 4, dtype=dtype)
    texture.filter = (moderngl.LINEAR, moderngl.LINEAR)
    texture.repeat_x = texture.repeat_y = False
    whole = ctx.framebuffer([texture])
    whole.clear()
    whole.release()
    return texture


def volume_texture(ctx: moderngl.Context, size: tuple[int, int, int]) -> moderngl.Texture3D:
    """Make a texture of float32 vectors of four, filtered, clamped at its faces."""
    texture = ctx.texture3d(size, 4, dtype="f4")
    texture.filter = (moderngl.LINEAR, moderngl.LINEAR)
    texture.repeat_x = texture.repeat_y = texture.repeat_z = False
    return texture


def texture_bytes(texture: moderngl.Texture) -> int:
    return int(texture.dtype[1]) * texture.width * texture.height * texture.components


def _refuse_too_large(scene: Scene, layout: Layout, card: Mapping[str, Any]) -> None:
    """Raise a DisplayError that names what of the scene is larger than the card's textures may be."""
    flat, deep = card["GL_MAX_TEXTURE_SIZE"], card["GL_MAX_3D_TEXTURE_SIZE"]
    planes = {
        f"plane {name} of scale {number + 1}": (
            -(-scale[name].shape[2] // 4) * scale[name].shape[1],
            scale[name].shape[0],
        )
        for number, scale in enumerate(scene.scales)
        for name in scale
        if name in SPACE_PLANES
    }
    largest = max(planes, key=lambda name: math.prod(planes[name]))
    needs = {name: (size, flat) for name, size in planes.items()}
    needs[f"all planes, of which {largest} is the largest,"] = layout.size, flat
    needs["the occupancy grid"] = scene.occupancy.shape[:0:-1], deep
    if scene.motion is not None:
        needs["the motion grid"] = scene.motion.shape[3:0:-1], deep
    for what, (size, most) in needs.items():
        if max(size) > most:
            raise DisplayError(
                f"{what} needs a texture of {'x'.join(map(str, size))}, {card['GL_RENDERER']} takes {most} a side; "
                "kprender --backend reference"
            )
