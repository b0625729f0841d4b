"""The picture of the scene: a canvas that is drawn fast while something changes, and refined when nothing does."""

import math
import time as clock
from dataclasses import replace

import moderngl
import numpy as np

from kpc.format.scene.cameras import Camera
from kpc.format.scene.scene import Scene
from kpc.player.app.controls import AppearanceSelection
from kpc.player.app.state import PlayerState
from kpc.player.cpu.reference import Part
from kpc.player.gl.programs import is_software
from kpc.player.gl.renderer import Renderer
from kpc.player.quality import LEVELS, Quality

# Statistics are measured this often, from a picture of this many pixels.
STATISTICS_EVERY_S = 0.5
STATISTICS_SIZE = (48, 36)
# Seconds without a change after which the picture is drawn at the quality of a still.
REFINE_AFTER_S = 0.25
# Seconds that one band of rows of a still may take, so that the controls keep responding.
BAND_S = 0.08


class SceneView:
    """The canvas that the scene is drawn on; the panels are drawn over it.

    Args:
        ctx: the OpenGL context.
        state: what to draw.
        size: (width, height) of the canvas, pixels.

    Attributes:
        device: the name of the graphics card or software renderer.
        canvas: holds the last picture of the scene.
        raster: (width, height) at which that was drawn before it was scaled to the canvas.
        is_sharp: whether it is drawn at the quality of a still.
        measuring_s: seconds spent on statistics so far.
        band_s: seconds that one band of rows of a still may take.
    """

    def __init__(self, ctx: moderngl.Context, state: PlayerState, size: tuple[int, int]) -> None:
        self.ctx, self.state = ctx, state
        self.device = str(ctx.info["GL_RENDERER"])
        if not state.stream.is_drawn:
            state.stream.draw_with(self.make_renderer)
        self.is_sharp, self.measuring_s, self.band_s = False, 0.0, BAND_S
        self._measured_at, self._changed_at = -STATISTICS_EVERY_S, clock.monotonic()
        self._refined_rows = 0
        self.resize(size)
        self._band = self.canvas

    @property
    def renderer(self) -> Renderer:
        """The renderer of the group that is shown."""
        return self.state.stream.renderer

    def make_renderer(self, scene: Scene) -> Renderer:
        """Return a renderer of a scene in this context."""
        return Renderer(self.ctx, scene, LEVELS[self.state.quality.level], in_background=True)

    def resize(self, size: tuple[int, int]) -> None:
        """Replace the canvas by an empty one of `size` pixels."""
        self._canvas_texture = self.ctx.texture(size, 4)
        self.canvas = self.ctx.framebuffer([self._canvas_texture])
        red, green, blue = map(float, self.state.scene.background)
        self.canvas.clear(red, green, blue)
        self.raster = size
        self.invalidate()

    def invalidate(self) -> None:
        """Have the next update draw, whether anything has changed or not."""
        self._drawn: tuple[object, ...] = ()

    def pixels(self) -> np.ndarray:
        """Return the canvas, (height, width, 3) uint8, top row first."""
        width, height = self.canvas.size
        data = self.canvas.read(components=3, alignment=1)
        return np.frombuffer(data, np.uint8).reshape(height, width, 3)[::-1]

    def update(self, now: float) -> bool:
        """Draw the scene if anything has changed, and refine the picture if nothing has for a while.

        Args:
            now: the time of `time.monotonic`.

        Returns:
            Whether a picture of a changing scene was drawn, whose time counts for the quality controller.
        """
        state, quality = self.state, self.state.quality
        appearance = state.appearance.number, state.appearance.progress
        version = state.stream.version_at(state.playback.time)
        wanted = (
            *(state.view, state.playback.time, state.part, state.display_mode),
            *(quality.chosen_level, state.exact, appearance, version),
        )
        if state.stream.complete_scales == 0:
            self.is_sharp = True  # there is nothing to refine
        elif wanted != self._drawn:
            self._drawn, self._changed_at, self.is_sharp, self._refined_rows = wanted, now, False, 0
            self.draw(quality.level, quality.resolution.scale)
            is_still_quality = self.renderer.quality == self._quality(quality.still_level, still=True)
            self.is_sharp = self.raster == self.canvas.size and is_still_quality
            return True
        elif not self.is_sharp and now - self._changed_at > REFINE_AFTER_S:
            self._refine()
        elif self.is_sharp:
            self._take_over()
        return False

    @property
    def level(self) -> str:
        """The quality level of the picture that is shown."""
        return self.state.quality.still_level if self.is_sharp else self.state.quality.level

    def draw_still(self) -> None:
        """Draw the whole scene at once at the quality of a still."""
        self.draw(self.state.quality.still_level, still=True)

    def draw(self, level: str, scale: float = 1.0, still: bool = False) -> None:
        """Draw the scene on the canvas.

        Args:
            level: name of the quality level.
            scale: side of the raster over that of the canvas, (0, 1].
            still: whether to draw as for a picture that does not change.
        """
        self.renderer.quality = self._quality(level, still)
        if clock.monotonic() - self._measured_at > STATISTICS_EVERY_S:
            self._measure()
        width, height = (max(1, round(side * scale)) for side in self.canvas.size)
        self.raster = (width, height)
        # Resizing the canvas's camera keeps the field of view, however the sides of the raster are rounded.
        self._show(self.canvas, self.state.view.camera(*self.canvas.size).resized(width, height))
        self._take_over()

    def _take_over(self) -> None:
        if self.renderer.take_over():
            self.state.quality.resolution.forget()

    def _refine(self) -> None:
        """Draw the next band of rows of a still, from the top, as many rows as take no longer than `band_s`."""
        self.renderer.quality = self._quality(self.state.quality.still_level, still=True)
        width, height = self.canvas.size
        if self._refined_rows == 0:
            whole_s = self.state.statistics.draw_s * width * height / (self.raster[0] * self.raster[1])
            bands = math.ceil(whole_s / self.band_s) if self.renderer.quality.resolution == 1.0 else 1
            rows = -(-height // bands)
            if self._band.size != (width, rows):
                self._band = self.ctx.simple_framebuffer((width, rows))
        rows = self._band.height
        top = min(self._refined_rows, height - rows)  # the last band may overlap the one before
        camera = self.state.view.camera(width, height)
        self._show(self._band, replace(camera, height=rows, cy=camera.cy - top))
        pixels = self._band.read(components=4, alignment=1)
        self._canvas_texture.write(pixels, viewport=(0, height - top - rows, width, rows), alignment=1)
        self._refined_rows = top + rows
        if self._refined_rows == height:
            self.is_sharp, self.raster = True, (width, height)
            self._measure()

    def _quality(self, level: str, still: bool) -> Quality:
        """Return the quality to draw at.

        For a still every pixel is marched, as a graphics card always does. While something changes, a processor sends
        one ray per pixel: a higher resolution shows more.
        """
        quality = LEVELS[level]
        if still or not is_software(self.ctx):
            quality = replace(quality, reprojection_tolerance=0.0, interpolation_tolerance=0.0)
        else:
            quality = replace(quality, rays_across=1)
        return replace(quality, folded=quality.folded and not self.state.exact)

    def _show(self, target: moderngl.Framebuffer, camera: Camera) -> None:
        """Draw the scene on a target; where two groups overlap, the blend of both."""
        state, started = self.state, clock.monotonic()
        parts = [(self.renderer, state.stream.time_in(state.playback.time), 1.0, state.appearance.code)]
        if (other := state.stream.blended_with(state.playback.time)) is not None:
            appearance = AppearanceSelection(other[0].scene, state.appearance.name)
            parts.append((*other, appearance.code))
        for renderer, time, opacity, code in parts:
            renderer.quality = self.renderer.quality
            renderer.show(
                target,
                camera,
                time,
                part=state.part,
                mode=state.display_mode,
                depths=state.statistics.depth_range,
                most_samples=state.statistics.max_samples,
                appearance=code,
                opacity=opacity,
            )
        self.ctx.finish()
        state.statistics.draw_s = clock.monotonic() - started

    def _measure(self) -> None:
        """Measure samples per ray and depths in a very small picture."""
        started, state = clock.monotonic(), self.state
        small = self.renderer.render(
            state.view.camera(*STATISTICS_SIZE),
            state.stream.time_in(state.playback.time),
            part=Part.STATIC if state.part is Part.STATIC else Part.FULL,
        )
        state.statistics.samples = float(small.samples.mean())
        state.statistics.max_samples = max(2.0 * float(np.percentile(small.samples, 95)), 8.0)
        depths = small.depth[small.opacity > 0.5]
        if depths.size:
            near, far = np.percentile(depths, (2, 98))
            state.statistics.depth_range = (0.9 * float(near), 1.1 * float(far))
        self._measured_at = clock.monotonic()
        self.measuring_s += self._measured_at - started
