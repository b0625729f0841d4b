"""The player's renderer: chooses who draws a picture, and brings it to its size and to the screen.

quality.folded   device                drawn by
no               any                   exact shaders (`kpc.player.gl.shader_renderer`)
yes              graphics card         shaders through folded planes
yes              software driver       the processor's own code (`kpc.player.cpu.cpu_renderer`); what that does not
serve, a hybrid decoder or
                                       device coordinates, by shaders through folded planes
"""

import math
import time as clock
from typing import TYPE_CHECKING

import moderngl
import numpy as np

from kpc.format.common.errors import DisplayError
from kpc.format.scene.cameras import Camera
from kpc.format.scene.scene import Scene
from kpc.format.scene.space import Contraction
from kpc.player.atlas import Layout, TimeRows
from kpc.player.cpu import loading, serving
from kpc.player.cpu.reference import Part, Rendering, appearance_code
from kpc.player.footprint import texels_per_pixel
from kpc.player.gl.folding import UPSAMPLING, folded_dtype
from kpc.player.gl.presentation import DisplayMode, Presentation
from kpc.player.gl.programs import Programs, is_software
from kpc.player.gl.shader_renderer import ShaderRenderer
from kpc.player.gl.targets import Target
from kpc.player.gl.textures import SceneTextures
from kpc.player.quality import LEVELS, Quality

if TYPE_CHECKING:
    from kpc.player.cpu.cpu_renderer import ProcessorRenderer

# Pictures on the card that are kept for the next use of their size.
TARGETS_KEPT = 8
# Pixels of a raster with several rays a pixel, at most: 100 MB.
MOST_PIXELS = 1 << 22
# OpenGL version times 100 from which on there are compute shaders.
COMPUTE_VERSION = 430
# Pictures until fragment and compute shaders are tried against each other, and pictures that each of them then draws.
TRIAL_AFTER, TRIALS = 8, 3
# Samples on a ray that a software driver draws, at most.
MOST_SAMPLES = 32_000


def tries_compute(ctx: moderngl.Context) -> bool:
    """Return whether there is a choice between fragment and compute shaders; a processor is never faster by compute
    shaders."""
    return ctx.version_code >= COMPUTE_VERSION and not is_software(ctx)


def _refuse_endless(ctx: moderngl.Context, scene: Scene) -> None:
    """Raise a DisplayError for rays of more samples than loops of software drivers turn: llvmpipe leaves after 65,535
    turns, of which a sample takes two."""
    occupied = scene.occupancy.any(axis=0)
    if not is_software(ctx) or not occupied.any():
        return
    shares = [np.ptp(found) + 1 for found in np.nonzero(occupied)[::-1]] / np.array(occupied.shape[::-1])
    across = float(np.linalg.norm(shares * (scene.aabb[1] - scene.aabb[0])))
    if isinstance(scene.mapping, Contraction):
        across = scene.mapping.s_end
    if across / scene.step > MOST_SAMPLES:
        raise DisplayError(
            f"rays of {across / scene.step:,.0f} samples are more than {ctx.info['GL_RENDERER']} can draw "
            f"({MOST_SAMPLES:,}); kprender --backend reference"
        )


class Renderer:
    """A scene that is ready to be drawn.

    Args:
        ctx: the OpenGL context.
        scene: what to draw; time planes are read from it again after `refresh`.
        quality: how finely to draw.
        compute: whether compute shaders draw, else fragment shaders; None: graphics cards that have both try them once
            and keep the faster.
        processor: whether the processor's own code draws folded levels, if numba is there; None: where a software
            driver would.
        in_background: whether shaders draw until `take_over`, which loads the processor's code beside them.

    Attributes:
        quality: may be set at any time.
        compute: as above; False until they have been tried.

    Raises:
        DisplayError: the scene does not fit the card, or a shader does not compile.
    """

    def __init__(
        self,
        ctx: moderngl.Context,
        scene: Scene,
        quality: Quality = LEVELS["reference"],
        *,
        compute: bool | None = None,
        processor: bool | None = None,
        in_background: bool = False,
    ) -> None:
        self.ctx, self.scene, self.quality, self.compute = ctx, scene, quality, bool(compute)
        self._pictures_to_trial = TRIAL_AFTER if compute is None and tries_compute(ctx) else math.inf
        _refuse_endless(ctx, scene)
        self._textures = SceneTextures(ctx, scene)
        self.layout = self._textures.layout
        self._programs = Programs(self._textures)
        self._shaders = ShaderRenderer(self._textures, self._programs)
        self._presentation = Presentation(self._textures, self._programs)
        self._processor: ProcessorRenderer | None = None
        is_wanted = is_software(ctx) if processor is None else processor
        self._waits_for_processor = is_wanted and serving.is_installed() and serving.serves(scene)
        if self._waits_for_processor and (not in_background or loading.is_loaded(scene)):
            self._make_processor()
        self._targets: dict[tuple[Part, tuple[int, int]], Target] = {}
        self.check()

    def check(self) -> None:
        """Raise a DisplayError if the card has reported an error since the last call."""
        error = self.ctx.error
        if error != "GL_NO_ERROR":
            is_full = error == "GL_OUT_OF_MEMORY"
            remedy = "close other programs or use a smaller size" if is_full else "update the graphics driver"
            raise DisplayError(f"OpenGL reports {error} on {self.ctx.info['GL_RENDERER']}; {remedy}")

    def release(self) -> None:
        """Give back everything on the card."""
        self.ctx.detect_framebuffer(0).use()  # moderngl would bind again what it knows as bound, though it is gone
        for target in self._targets.values():
            target.release()
        self._targets.clear()
        for part in (self._presentation, self._shaders, self._programs, self._textures):
            part.release()
        self._processor = None

    # --- who draws, and what that takes

    @property
    def is_loading(self) -> bool:
        """Whether shaders draw because the processor's code is not loaded yet."""
        return self._waits_for_processor and self.quality.folded

    def take_over(self) -> bool:
        """Load the processor's code beside what draws, if that is to draw; return whether it does from here on."""
        is_ready = self.is_loading and loading.loading_for(self.scene).is_done
        if is_ready:
            self._make_processor()
        return is_ready

    def _make_processor(self) -> None:
        from kpc.player.cpu.cpu_renderer import ProcessorRenderer

        self._waits_for_processor = False
        self._processor = ProcessorRenderer(self.scene, self.layout, self._textures.read_atlas)

    def _drawing_processor(self) -> "ProcessorRenderer | None":
        """Return the processor's renderer if it draws at this quality."""
        return self._processor if self.quality.folded else None

    @property
    def drawn_by(self) -> str:
        """Who draws, for people to read."""
        if self._drawing_processor() is not None:
            return "the processor"
        return f"{'compute' if self.compute else 'fragment'} shaders"

    @property
    def texels_per_sample(self) -> float:
        """Texels of planes and rows that a sample looks up in textures; 0 where the processor draws."""
        if self._drawing_processor() is not None:
            return 0.0
        planes = 3 if self.quality.folded or not self.scene.is_dynamic else 6
        return float(planes * self.layout.features)

    @property
    def plane_dtype(self) -> str:
        """The type of the planes that shaders look up: "f4", or where they are folded `folding.folded_dtype`."""
        return folded_dtype(self.scene) if self.quality.folded and self.scene.is_dynamic else "f4"

    @property
    def memory_bytes(self) -> int:
        """Bytes of textures and arrays that hold the scene and its pictures."""
        parts = (self._textures, self._shaders, self._processor)
        return self.picture_bytes + sum(part.memory_bytes for part in parts if part is not None)

    @property
    def picture_bytes(self) -> int:
        """Bytes of `memory_bytes` that hold pictures."""
        in_memory = 0 if self._processor is None else self._processor.picture_bytes
        on_card = sum(target.memory_bytes for target in self._targets.values())
        return in_memory + on_card + self._presentation.memory_bytes

    @staticmethod
    def bytes_for(scene: Scene) -> int:
        """Return what a renderer of the scene takes at most, without pictures: `memory_bytes - picture_bytes`."""
        layout = Layout.of(scene)
        texels = layout.size[0] * layout.size[1]
        if scene.is_dynamic:
            finer = Layout.of(scene, UPSAMPLING)
            rows = TimeRows(scene, layout).width * layout.line_count
            texels += 2 * finer.size[0] * finer.size[1] + (1 + UPSAMPLING) * rows
        motion = 0 if scene.motion is None else 16 * int(np.prod(scene.motion.shape[1:4]))
        culling = 4 * int(np.prod([side + 1 for side in scene.occupancy.shape[1:]]))
        return 16 * texels + serving.bytes_for(scene) + scene.occupancy.nbytes + motion + culling

    # --- what changes in the scene

    def put(self, scale: int, plane: str, texels: np.ndarray, first: int = 0) -> None:
        """Replace rows of a space plane from row `first` on by `Layout.texels`. Nothing is allocated."""
        self._textures.put(scale, plane, texels, first)
        self._shaders.planes_changed()
        if self._processor is not None:
            self._processor.planes_changed()

    def refresh(self) -> None:
        """Read the scene's time planes anew: some of their rows have changed."""
        self._shaders.time_planes_changed()
        if self._processor is not None:
            self._processor.time_planes_changed()

    # --- pictures

    def render(
        self, camera: Camera, time: float, *, part: Part = Part.FULL, appearance: np.ndarray | None = None
    ) -> Rendering:
        """Return what `kpc.player.cpu.reference.render` does, as accurately as `quality` says."""
        shown = Part.STATIC if part is Part.STATIC else Part.FULL
        rendering = self.march(camera, time, part=shown, appearance=appearance).read()
        if part is Part.DYNAMIC:
            static = self.march(camera, time, part=Part.STATIC, appearance=appearance).read()
            rgb = np.abs(rendering.rgb - static.rgb)
            rendering = Rendering(rgb, rendering.depth, rendering.opacity, rendering.samples)
        self.check()
        return rendering

    def show(
        self,
        screen: moderngl.Framebuffer,
        camera: Camera,
        time: float,
        *,
        part: Part = Part.FULL,
        mode: DisplayMode = DisplayMode.COLOUR,
        depths: tuple[float, float] = (0.0, 1.0),
        most_samples: float = 64.0,
        appearance: np.ndarray | None = None,
        opacity: float = 1.0,
    ) -> None:
        """Draw what `camera` sees over the whole of `screen`, stretched to its size.

        Args:
            time: [0, 1] over the clip.
            part: what of the scene.
            mode: what of the picture.
            depths: DEPTH goes from bright to dark over these, world units.
            most_samples: SAMPLES goes up to this.
            appearance: as in `reference.appearance_code`.
            opacity: of the picture; 1 - opacity of what `screen` shows remains.
        """
        if mode is DisplayMode.OCCUPANCY:
            picture, static = self._draw_occupancy(camera, time), None
        else:
            shown, with_sums = Part.STATIC if part is Part.STATIC else Part.FULL, mode is not DisplayMode.COLOUR
            picture, static = (
                self.march(camera, time, part=shown, appearance=appearance, keep_small=True, with_sums=with_sums),
                None,
            )
            if part is Part.DYNAMIC and mode is DisplayMode.COLOUR:
                static = self.march(
                    camera, time, part=Part.STATIC, appearance=appearance, keep_small=True, with_sums=with_sums
                )
        self._presentation.show(screen, picture, static, mode, depths, most_samples, opacity)

    def march(
        self,
        camera: Camera,
        time: float,
        *,
        part: Part = Part.FULL,
        appearance: np.ndarray | None = None,
        keep_small: bool = False,
        with_sums: bool = True,
    ) -> Target:
        """Draw a picture of the camera's size on the card.

        Args:
            part: FULL or STATIC.
            keep_small: leave the picture smaller where the quality level has a lower resolution.
            with_sums: also bring `Target.sums` to the card, which only display modes besides COLOUR need.

        Returns:
            the picture, valid until the next one of the same part and size.

        Raises:
            ValueError: the time lies outside [0, 1], or the appearance does not fit the decoder.
        """
        if not 0.0 <= time <= 1.0:
            raise ValueError(f"time {time} lies outside [0, 1]")
        code = appearance_code(self.scene, appearance)
        size, rays_across = (camera.width, camera.height), self.rays_across(camera)
        raster = self._raster(camera, rays_across)
        self._pictures_to_trial -= 1
        if self._pictures_to_trial == 0:
            self.compute = self.is_compute_faster(raster, time)
        target = self._target(part, (raster.width, raster.height))
        processor = self._drawing_processor()
        if processor is not None:
            is_moving = part is Part.FULL and self.scene.is_dynamic
            picture = processor.draw(raster, time, self.quality, code, is_moving=is_moving)
            target.write(picture, processor.content, with_sums)
        else:
            self._shaders.draw(
                target, raster, time, self.quality, code, is_moving=part is Part.FULL, compute=self.compute
            )
            target.mark_drawn()
        if rays_across > 1:
            return self._presentation.average(target, self._target(part, size), rays_across)
        if target.rgba.size != size and not keep_small:
            return self._presentation.enlarge(target, self._target(part, size))
        return target

    def _draw_occupancy(self, camera: Camera, time: float) -> Target:
        target = self._target(Part.STATIC, (camera.width, camera.height))
        self._shaders.draw_occupancy(target, camera, time, self.quality)
        return target.mark_drawn()

    def is_compute_faster(self, camera: Camera, time: float) -> bool:
        """Draw a picture by fragment and by compute shaders, a few times each, and compare the best of their times."""
        target, code = self._target(Part.FULL, (camera.width, camera.height)), appearance_code(self.scene, None)
        seconds = {}
        for compute in (False, True):
            took = []
            for _ in range(1 + TRIALS):  # the first compiles
                self.ctx.finish()
                started = clock.perf_counter()
                self._shaders.draw(target, camera, time, self.quality, code, is_moving=True, compute=compute)
                target.mark_drawn()
                self.ctx.finish()
                took.append(clock.perf_counter() - started)
            seconds[compute] = min(took[1:])
        return seconds[True] < seconds[False]

    def rays_across(self, camera: Camera) -> int:
        """Return how many rays go across a pixel: as many as it spans texels, as far as `quality` and MOST_PIXELS
        allow.

        One where space is mapped: texels differ there.
        """
        if self.scene.mapping is not None or self.quality.rays_across == 1:
            return 1
        most = math.isqrt(max(1, MOST_PIXELS // (camera.width * camera.height)))
        return max(1, min(math.floor(texels_per_pixel(self.scene, camera)), self.quality.rays_across, most))

    def _raster(self, camera: Camera, rays_across: int) -> Camera:
        """Return the camera with the raster of rays that is marched."""
        size = camera.width, camera.height
        if rays_across > 1:
            return camera.resized(*(rays_across * side for side in size))
        if self.quality.resolution < 1:
            return camera.resized(*(max(1, round(side * self.quality.resolution)) for side in size))
        return camera

    def _target(self, part: Part, size: tuple[int, int]) -> Target:
        """Return a target of a size; the last used are kept."""
        key = part, size
        target = self._targets.pop(key, None) or Target.of(self.ctx, size)
        self._targets[key] = target
        if len(self._targets) > TARGETS_KEPT:
            self._targets.pop(next(iter(self._targets))).release()
        return target
