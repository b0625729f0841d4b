"""Drawing by shaders: march.glsl, exact or through folded planes, as a fragment or a compute shader."""

import moderngl
import numpy as np

from kpc.format.scene.cameras import Camera
from kpc.player.atlas import pad_to_multiple
from kpc.player.gl.folding import FoldedPlanes
from kpc.player.gl.programs import RGBA_UNIT, SUMS_UNIT, Programs, draw, set_uniforms
from kpc.player.gl.targets import Target
from kpc.player.gl.textures import SceneTextures
from kpc.player.quality import Quality

# Pixels a side that a work group of march.glsl draws.
GROUP = 8


class ShaderRenderer:
    """Draws a scene by shaders."""

    def __init__(self, textures: SceneTextures, programs: Programs) -> None:
        self._textures, self._programs = textures, programs
        self._folded: FoldedPlanes | None = None

    @property
    def memory_bytes(self) -> int:
        return 0 if self._folded is None else self._folded.memory_bytes

    def planes_changed(self) -> None:
        if self._folded is not None:
            self._folded.planes_changed()

    def time_planes_changed(self) -> None:
        self._textures.time_planes_changed()
        if self._folded is not None:
            self._folded.time_planes_changed()

    def draw(
        self,
        target: Target,
        camera: Camera,
        time: float,
        quality: Quality,
        code: np.ndarray,
        *,
        is_moving: bool,
        compute: bool,
    ) -> None:
        """March all pixels of a target.

        Args:
            camera: of the target's size.
            time: [0, 1] over the clip.
            code: of an appearance, `reference.appearance_code`.
            is_moving: draw the whole scene, else its static part.
            compute: by a compute shader, else a fragment shader.
        """
        textures = self._textures
        is_moving = is_moving and textures.time_rows is not None
        is_folded, is_displaced = is_moving and quality.folded, is_moving and textures.motion is not None
        textures.set_occupancy(time)
        if is_displaced:
            textures.set_motion(time)
        planes, layout = textures.planes, textures.layout
        if is_folded:
            if self._folded is None:
                self._folded = FoldedPlanes(textures, self._programs)
            planes, layout = self._folded.at(time), self._folded.layout
        elif is_moving:
            textures.set_time_rows(time)
        has_rows = is_moving and not is_folded
        march, vertices = self._programs.get(
            "march.glsl", layout, compute, ROWS=int(has_rows), MOTION=int(is_displaced)
        )
        stride = textures.scene.step * quality.step
        set_uniforms(
            march,
            stride=stride,
            tau=stride / textures.scene.extent,
            termination=quality.termination,
            areas=[tuple(map(float, corner)) for corner in textures.areas.bounds.reshape(-1, 3)],
            appearance=[tuple(map(float, vector)) for vector in pad_to_multiple(code, 0).reshape(-1, 4)],
            **camera_uniforms(camera),
        )
        textures.bind(planes)
        if isinstance(march, moderngl.ComputeShader):
            target.rgba.bind_to_image(RGBA_UNIT, read=False)
            target.sums.bind_to_image(SUMS_UNIT, read=False)
            march.run(*(-(-side // GROUP) for side in target.rgba.size))
            textures.ctx.memory_barrier()
        else:
            draw(textures.ctx, target.framebuffer, vertices)

    def draw_occupancy(self, target: Target, camera: Camera, time: float, quality: Quality) -> None:
        """Draw the occupied cells at a time."""
        textures = self._textures
        textures.set_occupancy(time)
        cells, vertices = self._programs.get("cells.glsl", textures.layout)
        set_uniforms(cells, stride=textures.scene.step * quality.step, **camera_uniforms(camera))
        textures.bind(textures.planes)
        draw(textures.ctx, target.framebuffer, vertices)

    def release(self) -> None:
        if self._folded is not None:
            self._folded.release()


def camera_uniforms(camera: Camera) -> dict[str, object]:
    return {
        "height": float(camera.height),
        "lens": (camera.fl_x, camera.fl_y, camera.cx, camera.cy),
        "axes": tuple(camera.camera_to_world[:3, :3].T.ravel()),
        "eye": tuple(camera.camera_to_world[:3, 3]),
    }
