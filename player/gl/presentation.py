"""Bringing pictures to their size and to the screen."""

import math
from enum import Enum

import moderngl

from kpc.player.gl.programs import RGBA_UNIT, STATIC_UNIT, SUMS_UNIT, Programs, draw, set_uniforms
from kpc.player.gl.targets import Canvas, Target
from kpc.player.gl.textures import SceneTextures


class DisplayMode(Enum):
    """What of a picture to put on the screen; the value is MODE of present.glsl."""

    COLOUR = 0
    DEPTH = 2
    SAMPLES = 3
    OCCUPANCY = 4


# MODE of present.glsl: |whole scene - static part|.
DIFFERENCE = 1


class Presentation:
    """Resamples pictures of a scene, and shows them."""

    def __init__(self, textures: SceneTextures, programs: Programs) -> None:
        self._ctx, self._layout, self._programs = textures.ctx, textures.layout, programs
        self._background = tuple(map(float, textures.scene.background))
        self._canvas: Canvas | None = None

    @property
    def memory_bytes(self) -> int:
        return 0 if self._canvas is None else 4 * self._canvas.shown.width * self._canvas.shown.height

    def average(self, marched: Target, target: Target, rays_across: int) -> Target:
        """Write the mean of `rays_across` x `rays_across` rays to each pixel of a target."""
        program, vertices = self._programs.get("average.glsl", self._layout)
        set_uniforms(program, rgba_rays=RGBA_UNIT, sums_rays=SUMS_UNIT, rays_across=rays_across)
        marched.rgba.use(RGBA_UNIT)
        marched.sums.use(SUMS_UNIT)
        draw(self._ctx, target.framebuffer, vertices)
        return target.mark_drawn()

    def enlarge(self, marched: Target, target: Target) -> Target:
        """Interpolate a picture to a larger target: colours by a cubic, the rest bilinearly."""
        program, vertices = self._programs.get("upscale.glsl", self._layout)
        set_uniforms(program, rgba_small=RGBA_UNIT, sums_small=SUMS_UNIT, size=tuple(map(float, target.rgba.size)))
        marched.rgba.use(RGBA_UNIT)
        marched.sums.use(SUMS_UNIT)
        draw(self._ctx, target.framebuffer, vertices)
        return target.mark_drawn()

    def show(
        self, screen: moderngl.Framebuffer, picture: Target, static: Target | None, mode: DisplayMode,
        depths: tuple[float, float], most_samples: float, opacity: float,
    ) -> None:  # fmt: skip
        """Draw a picture over a screen, stretched to its size.

        Args:
            static: the static part of the same picture, to be subtracted from its colours; None: nothing is.
            mode: what to show; OCCUPANCY as COLOUR.
            depths: shown from bright to dark, world units.
            most_samples: number of samples that is shown white.
            opacity: of the picture over what the screen shows, in (0, 1].
        """
        shown = DisplayMode.COLOUR.value if mode is DisplayMode.OCCUPANCY else mode.value
        shown = DIFFERENCE if static is not None and mode is DisplayMode.COLOUR else shown
        canvas = None if picture.rgba.size == screen.size else self._canvas_of(picture.rgba.size)
        into = canvas.framebuffer if canvas else screen
        present, vertices = self._programs.get("present.glsl", self._layout, MODE=shown)
        set_uniforms(
            present,
            rgba=RGBA_UNIT,
            sums=SUMS_UNIT,
            static_rgba=STATIC_UNIT,
            viewport=tuple(map(float, into.size)),
            depths=depths,
            most_samples=most_samples,
            opacity=1.0 if canvas else opacity,
        )
        picture.rgba.use(RGBA_UNIT)
        picture.sums.use(SUMS_UNIT)
        (static or picture).rgba.use(STATIC_UNIT)
        is_partial = shown == DisplayMode.COLOUR.value and opacity == 1 and not picture.is_full
        self._draw(into, vertices, picture, is_partial, blend=not canvas and opacity < 1)
        if canvas:
            enlarge, vertices = self._programs.get("enlarge.glsl", self._layout)
            set_uniforms(enlarge, shown_small=RGBA_UNIT, viewport=tuple(map(float, screen.size)), opacity=opacity)
            canvas.shown.use(RGBA_UNIT)
            self._draw(screen, vertices, picture, is_partial, blend=opacity < 1)

    def _draw(
        self,
        screen: moderngl.Framebuffer,
        vertices: moderngl.VertexArray | None,
        picture: Target,
        is_partial: bool,
        blend: bool,
    ) -> None:
        """Draw over a screen; if `is_partial`, only where the picture has content, and the background elsewhere."""
        scissor = None
        if is_partial:
            screen.scissor = None  # type: ignore[assignment]
            red, green, blue = self._background
            screen.clear(red, green, blue, 1.0)
            across, up = (side / of for side, of in zip(screen.size, picture.rgba.size, strict=True))
            left, bottom, right, top = picture.content
            # Interpolation reaches two pixels of the picture.
            left, bottom = math.floor((left - 2) * across), math.floor((bottom - 2) * up)
            right, top = math.ceil((right + 2) * across), math.ceil((top + 2) * up)
            scissor = left, bottom, right - left, top - bottom
        draw(self._ctx, screen, vertices, blend=blend, scissor=scissor)

    def _canvas_of(self, size: tuple[int, int]) -> Canvas:
        """Return a canvas of a size; the last one is kept."""
        if self._canvas is None or self._canvas.shown.size != size:
            self.release()
            self._canvas = Canvas.of(self._ctx, size)
        return self._canvas

    def release(self) -> None:
        if self._canvas is not None:
            self._canvas.release()
            self._canvas = None
