"""Rendering with OpenGL 3.3: a scene becomes textures once, then each picture is one pass of `glsl/march.glsl`."""

import math
import threading
import time as clock
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

import moderngl
import numpy as np
from kpc.format.common.errors import DisplayError
from kpc.format.scene.cameras import Camera
from kpc.format.scene.grid import sample_linear
from kpc.format.scene.scene import SPACE_PLANES, Scene
from kpc.format.scene.space import Contraction, DeviceCoordinates, SpaceMapping
from kpc.player.atlas import (
    LARGEST_FLOAT,
    Layout,
    TimeRows,
    block_arrays,
    decoder_arrays,
    decoder_shape,
    empty_distances,
    multiplied,
    pad_to_multiple,
    planes_shape,
)
from kpc.player.cpu.corner_grid import CornerGrid
from kpc.player.cpu.cpu_renderer import BLOCK, Marching, probes_of, rehearse
from kpc.player.cpu.occupancy_culling import OccupancyCulling
from kpc.player.cpu.plane_sampler import PlaneSampler
from kpc.player.cpu.reference import Part, Rendering, appearance_code, occupancy_slot, sample_positions, sample_range
from kpc.player.cpu.screen_mask import ScreenMask
from kpc.player.gl import shader
from kpc.player.gl.targets import EVERYWHERE, Bounds, Canvas, Target, first_channel, read, read_into, room_on, write
from kpc.player.quality import LEVELS, Quality

FOLDING_UPSAMPLING = 2
"""Texels of a folded plane to one of the scene's, along the folded row. The error of folding falls with its square."""
PLANES_UNIT, ROWS_UNIT, CELLS_UNIT, MOTION_UNIT = 0, 1, 2, 3
DOUBTS_UNIT = 4
SEEN_UNIT, MET_UNIT, WITHOUT_UNIT = 0, 1, 2
SEEN_PROBES_UNIT, MET_PROBES_UNIT = 2, 3
PICTURE, OTHER_PICTURE, PROBES, DOUBTS, COARSE = range(5)
"""The targets of a part and size: pictures take turns while the camera moves."""
COARSER = 2
"""Pixels a side to one of the picture that is marched before, as long as that has a ray for each texel: it then meets all there is."""
MOVED_TOLERANCE = 0.8
"""Of a quality's tolerance while the camera moves: what is interpolated errs in thin places, too thin for probes to meet them all.
Turning by a degree a frame, liam is then 42.2 dB from the reference instead of 40.8, in 7 % more time; room 44.2 and 42.6, 15 %."""
MOST_DOUBTED, ALONE_FOR = 0.6, 8
"""Where more than such a share of what a picture of its own took to march is in doubt, following costs a processor more than it saves: this
picture and so many after it then follow no other, before the next one does again."""
TARGETS_KEPT = 24
MOST_COVERED = 0.8
"""Share of a picture beyond which all of it is drawn."""
PIXELS_MARCHED = 1 << 22
"""Of a raster with several rays a pixel, at most: 100 MB."""
JUMP_S = 0.2
"""Of the clip between a picture and the next: what the one has in common with the other says nothing of those that come then. It still follows:
half of the clip later, pictures of room and liam take 0.3 of the time of those that follow none, and are as near to the reference."""
LATELY = 2
"""Pictures since one, that may be followed: itself the last, or but for a small one that statistics are taken from."""
PLACES_ALONG = 64
"""Of a ray, to look at how many texels a pixel spans."""
COMPUTE_VERSION = 430
TRIAL_AFTER, TRIALS = 8, 3
"""Marches until fragment and compute shaders are tried against each other, and pictures that each of them draws for that."""
LARGEST_HALF = 65504.0
"""What float16 can hold."""
BEARABLE_ALONE = 4.0
"""What a block may miss by, in squares, to what blocks may in the mean: most bend by much less than those that bend most."""
ALL, ONLY_PROBES, ONLY_DOUBTED, ONLY_COVERED = range(4)
"""Which pixels to march: PIXELS of march.glsl, to which blocks that cover something are as those in doubt."""
MORE_THAN_A_RASTER = 1 << 20
"""SQUARE of tiles.glsl, where probes lie side by side."""
GROUP = 8
"""Pixels a side that a work group of march.glsl draws."""
CONSTANTS = 8192
"""vec4s of decoder weights that a shader may hold, ten times what the largest preset needs; compilers choke on more."""
SOFTWARE = ("llvmpipe", "softpipe", "swrast", "swiftshader")


class DisplayMode(Enum):
    """What to put on the screen."""

    COLOUR = 0
    DEPTH = 2
    SAMPLES = 3
    OCCUPANCY = 4


@dataclass(frozen=True, eq=False)
class Shot:
    """A picture that others may follow: what it shows, how finely, which of all it is, the turn of its probes, which target holds it, the
    share of its pixels that was marched for the last that followed none, and how many after it are not to follow either."""

    camera: Camera
    time: float
    appearance: bytes
    quality: Quality
    count: int
    turn: int = 0
    number: int = PICTURE
    marched: float = 1.0
    alone: int = 0


@dataclass(frozen=True)
class Tiles:
    """How tiles.glsl lays out the raster of probes."""

    tile: int
    square: int

    def squares(self, blocks: tuple[int, int]) -> tuple[int, int]:
        """How many across and up, of (columns, rows) of blocks."""
        return -(-blocks[0] // self.square), -(-blocks[1] // self.square)

    def raster(self, blocks: tuple[int, int]) -> tuple[int, int]:
        """Its (width, height), of whole squares."""
        across, up = self.squares(blocks)
        return self.tile * (across - 1) + self.square, self.tile * (up - 1) + self.square


SPREAD = Tiles(64, 20)
"""Where a processor draws: a raster of probes that is almost as large as the picture. One of a texel a block takes two cores, of room at 320x240,
0.87 of the time that it takes one of them."""


@dataclass
class Folded:
    """What folding takes: the planes as fine as they are to be written, the rows likewise, and where their product goes."""

    refined: moderngl.Texture
    rows: moderngl.Texture
    planes: moderngl.Texture
    refine_into: moderngl.Framebuffer
    fold_into: moderngl.Framebuffer

    @staticmethod
    def of(ctx: moderngl.Context, layout: Layout, rows: tuple[int, int], in_half: bool) -> "Folded":
        """For rows that lie, unrefined, in a texture of (width, lines); the product in float16 where it is to be `in_half`, which graphics cards
        look up at twice the rate and more."""
        with room_on(ctx, "the folded planes"):
            finer = layout.refined * (rows[0] - 1) + 1, rows[1]
            refined, cut = _texture(ctx, layout.size), _texture(ctx, finer)
            planes = _texture(ctx, layout.size, "f2" if in_half else "f4")
            refined.filter = cut.filter = moderngl.NEAREST, moderngl.NEAREST
            return Folded(refined, cut, planes, ctx.framebuffer([refined]), ctx.framebuffer([planes]))

    @property
    def memory_bytes(self) -> int:
        return sum(_bytes_of(texture) for texture in (self.refined, self.rows, self.planes))

    def release(self) -> None:
        for thing in (self.refine_into, self.fold_into, self.refined, self.rows, self.planes):
            thing.release()


@dataclass
class FoldedInMemory:
    """What folding takes where a processor draws: it multiplies arrays in a third of the time that it takes to draw their product."""

    layout: Layout
    refined: np.ndarray
    planes: moderngl.Texture
    refine_into: moderngl.Framebuffer
    room: np.ndarray
    """For the product of any of the planes."""

    @staticmethod
    def of(ctx: moderngl.Context, layout: Layout) -> "FoldedInMemory":
        with room_on(ctx, "the folded planes"):
            planes = _texture(ctx, layout.size)
            refined = np.zeros((*layout.size[::-1], 4), np.float32)
            most = max(4 * layout.layers[block.scale] * block.width * block.height for block in layout.blocks)
            room = np.empty(most, np.float32)
            return FoldedInMemory(layout, refined, planes, ctx.framebuffer([planes]), room)

    def keep(self) -> None:
        """What was drawn into `refine_into` is the refined planes."""
        self.planes.read_into(self.refined)

    def fold(self, rows: np.ndarray) -> None:
        for block in self.layout.blocks:
            product = multiplied(self.refined, rows, self.layout, block, self.room)
            self.planes.write(product, viewport=(block.x, block.y, product.shape[1], block.height))

    @property
    def memory_bytes(self) -> int:
        return self.refined.nbytes + self.room.nbytes + _bytes_of(self.planes)

    def release(self) -> None:
        for thing in (self.refine_into, self.planes):
            thing.release()


def _texels_across(scale: Mapping[str, np.ndarray]) -> int:
    """Along the longest edge of the box, from the first one's middle to the last one's; 1 where one is all there is."""
    return max(1, *(size - 1 for plane in SPACE_PLANES for size in scale[plane].shape[:2]))


def texels_spanned(scene: Scene, camera: Camera) -> float:
    """Of the finest scale, by a pixel in the middle of a picture: the most anywhere along its ray, of a scene whose space is mapped."""
    middle = replace(camera.resized(2, 2), fl_x=camera.fl_x, fl_y=camera.fl_y, cx=1.0, cy=1.0)
    origins, directions = middle.rays()
    if isinstance(scene.mapping, DeviceCoordinates):
        path = scene.mapping.rays(origins, directions)
        origins, directions = path.origins, path.directions
    near, far = sample_range(scene, origins, directions)
    along = np.linspace(near.min(), far.max(), PLACES_ALONG, dtype=np.float32)
    _, u, _ = sample_positions(scene, origins, directions, np.tile(along, (4, 1)))
    finest = scene.scales[-1]
    texels = np.array([finest["xy"].shape[1], finest["xy"].shape[0], finest["xz"].shape[0]]) - 1
    seen = ((u > 0) & (u < 1)).all(axis=(0, 2))
    apart = np.abs(np.diff(u, axis=0)[::2]) * texels  # of a pixel and the one to its right
    return float(apart[:, seen].max(initial=0.0))


def _bounds(blocks: np.ndarray) -> tuple[int, int, int, int]:
    """(left, bottom, right, top) of the least rectangle that holds all that is set."""
    rows, columns = np.flatnonzero(blocks.any(1)), np.flatnonzero(blocks.any(0))
    if not len(rows):
        return 0, 0, 0, 0
    return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1


def _shares(blocks: tuple[int, int, int, int], count: tuple[int, int]) -> Bounds:
    """A rectangle of (columns, rows) of blocks, as a part of the picture."""
    left, bottom, right, top = blocks
    return left / count[0], bottom / count[1], right / count[0], top / count[1]


def _around(one: Bounds, other: Bounds) -> Bounds:
    """The least rectangle that holds both."""
    return min(one[0], other[0]), min(one[1], other[1]), max(one[2], other[2]), max(one[3], other[3])


def is_software(ctx: moderngl.Context) -> bool:
    """Whether a processor stands in for a graphics card."""
    return any(word in ctx.info["GL_RENDERER"].lower() for word in SOFTWARE)


def marches_itself(ctx: moderngl.Context) -> bool:
    """Whether a processor that stands in for a graphics card marches what it can itself."""
    return is_software(ctx)


def tries_compute(ctx: moderngl.Context) -> bool:
    """Whether there is a choice between fragment and compute shaders."""
    return ctx.version_code >= COMPUTE_VERSION and not is_software(ctx)


class Renderer:
    """A scene on the graphics card.

    Attributes:
        quality: how finely to draw; may be set at any time.
        compute: whether a compute shader marches, else a fragment shader. Unless told, graphics cards try both once, where they
            have both, and keep to the faster; a processor that stands in for one is never faster by compute shaders.
        casts: whether a processor that stands in for a graphics card marches what it can itself (`kpc.player.cpu.cpu_renderer`), unless `quality` asks for
            what is exact.

    Raises:
        DisplayError: the scene does not fit the card, or a shader does not compile.
    """

    def __init__(
        self,
        ctx: moderngl.Context,
        scene: Scene,
        quality: Quality = LEVELS["reference"],
        compute: bool | None = None,
        processor: bool | None = None,
    ) -> None:
        self.ctx = ctx
        self.scene = scene
        self.quality = quality
        self.compute = bool(compute)
        self._is_software = is_software(ctx)
        self._folds_in_memory = self._is_software
        self._folds_in_half = not self._is_software
        self.casts = marches_itself(ctx) if processor is None else processor
        self._served_by = [kind for kind in (CornerGrid, PlaneSampler) if kind.serves(scene)]
        self._thins = self._is_software and OccupancyCulling.serves(scene)
        marching = self._marching_kind(scene.is_dynamic)
        if marching is not None:  # until it is needed there is much else to do, decoding for one
            threading.Thread(target=rehearse, args=(marching, scene), name="rehearsing", daemon=True).start()
        self._marches_to_trial = TRIAL_AFTER if compute is None and tries_compute(ctx) else math.inf
        self.layout = Layout.of(scene)
        most = ctx.info["GL_MAX_TEXTURE_SIZE"]
        _refuse_too_large(scene, self.layout, ctx.info)
        finer = Layout.of(scene, FOLDING_UPSAMPLING)
        self.folded_layout = finer if max(finer.size) <= most else self.layout
        with room_on(ctx, "the scene"):
            self._planes = _texture(ctx, self.layout.size)
            self._folded: Folded | FoldedInMemory | None = None
            self._rows = TimeRows(scene, self.layout) if scene.is_dynamic else None
            lines, width = self.layout.row_count(), 1 if self._rows is None else self._rows.width
            self._row_texture = _texture(ctx, (width, lines))
            self._motion_texture: moderngl.Texture3D | None = None
            if scene.motion is not None:
                self._motion_texture = _volume(ctx, scene.motion.shape[3:0:-1])
            nz, ny, nx = scene.occupancy.shape[1:]
            self._cells = ctx.texture3d((nx, ny, nz), 1, alignment=1, dtype="u1")
            self._cells.filter = (moderngl.NEAREST, moderngl.NEAREST)
        self._middle, self._finest_texel = scene.aabb.mean(0), scene.extent / _texels_across(scene.scales[-1])
        self._distances: dict[int, np.ndarray] = {}
        self._covers: dict[int, ScreenMask] = {}
        self._view_covered: tuple[object, np.ndarray | None] | None = None
        weights = decoder_arrays(scene.decoder, scene, self.layout)
        if sum(map(len, weights.values())) > CONSTANTS:
            raise DisplayError(
                f"the decoder has {4 * sum(map(len, weights.values()))} weights, a shader takes "
                f"{4 * CONSTANTS}; kprender --backend reference"
            )
        self._decoder = shader.constants(weights)
        self._shots: dict[tuple[Part, tuple[int, int]], Shot] = {}
        """Of each part and size, the last picture if the next may follow it."""
        self._pictures = 0
        self._rows_time: float | None = None
        self._motion_time: float | None = None
        self._folded_time: float | None = None
        self._is_refined = False
        self._in_memory: dict[type[Marching | OccupancyCulling], Any] = {}
        """What works on planes in memory, and ..."""
        self._stale: set[type[Marching | OccupancyCulling]] = set()
        """... which of it has planes as they were."""
        self._cells_written: np.ndarray | None = None
        self._thinned: tuple[object, np.ndarray] | None = None
        """The last cells that were thinned, and of what."""
        for block in self.layout.blocks:
            self.put(block.scale, block.plane, self.layout.texels(scene.scales[block.scale][block.plane]))
        self._slot: int | None = None
        self._programs: dict[
            tuple[object, ...], tuple[moderngl.Program | moderngl.ComputeShader, moderngl.VertexArray]
        ] = {}
        self._targets: dict[tuple[Part, tuple[int, int], int], Target] = {}
        self._canvas: Canvas | None = None
        self.check()

    def check(self) -> None:
        """Raise a DisplayError if the card has reported an error since the last look."""
        error = self.ctx.error
        if error != "GL_NO_ERROR":
            full = error == "GL_OUT_OF_MEMORY"
            remedy = "close other programs or use a smaller size" if full else "update the graphics driver"
            raise DisplayError(f"OpenGL reports {error} on {self.ctx.info['GL_RENDERER']}; {remedy}")

    def release(self) -> None:
        """Give back all that the scene takes of the card."""
        self.ctx.detect_framebuffer(0).use()  # moderngl would bind again what it knows as bound, though it is gone
        things: list[
            Target
            | Canvas
            | Folded
            | FoldedInMemory
            | moderngl.Texture
            | moderngl.Texture3D
            | moderngl.Framebuffer
            | moderngl.Program
            | moderngl.VertexArray
        ]
        things = [self._planes, self._row_texture, self._cells, *self._targets.values()]
        things += [thing for pair in self._programs.values() for thing in reversed(pair)]
        things += [] if self._folded is None else [self._folded]
        things += [thing for thing in (self._canvas, self._motion_texture) if thing is not None]
        for thing in things:
            thing.release()
        self._targets.clear()
        self._programs.clear()
        self._in_memory.clear()
        self._canvas = None

    @property
    def _in_half(self) -> bool:
        return self.quality.folded and self._rows is not None and self._folds_in_half

    @property
    def plane_dtype(self) -> str:
        """The type of the planes that shaders look up: "f2" of those folded on a graphics card, else "f4"."""
        return "f2" if self._in_half else "f4"

    def _marching_kind(self, moving: bool) -> type[Marching] | None:
        """How a processor marches a picture itself, of what moves or what is static; None where shaders do."""
        if not self.casts or not self.quality.folded:
            return None
        kinds = [
            kind for kind in self._served_by if kind is not CornerGrid or moving and self.quality.grid_termination > 0
        ]
        return kinds[0] if kinds else None

    @property
    def drawn_by(self) -> str:
        """What marches a picture of what moves, for people to read."""
        by_itself = self._marching_kind(moving=self._rows is not None) is not None
        return "the processor itself" if by_itself else f"{'compute' if self.compute else 'fragment'} shaders"

    @property
    def texels_per_sample(self) -> float:
        """Look-ups in textures of planes and rows that a sample takes, each of four channels with its neighbours; 0 where there are no textures."""
        if self._marching_kind(moving=self._rows is not None) is not None:
            return 0.0
        layers, shared = self.layout.layers, 0
        planes = 3 if self.quality.folded or self._rows is None else 6
        return float(planes * sum(count / 2 if scale < shared else count for scale, count in enumerate(layers)))

    @property
    def memory_bytes(self) -> int:
        """Bytes of the textures and buffers that hold the scene and its pictures."""
        textures = [self._planes, self._row_texture]
        textures += [texture for target in self._targets.values() for texture in (target.seen, target.met)]
        textures += [self._canvas.shown] if self._canvas else []
        folded = self._folded.memory_bytes if self._folded else 0
        folded += sum(thing.memory_bytes for thing in self._in_memory.values())
        motion = 0 if self._motion_texture is None else 16 * int(np.prod(self._motion_texture.size))
        return sum(map(_bytes_of, textures)) + folded + int(self.scene.occupancy[0].size) + motion

    def put(self, scale: int, plane: str, texels: np.ndarray, first: int = 0) -> None:
        """Replace rows of a space plane from row `first` on: `Layout.texels` of them. Writes to textures that are there."""
        block = self.layout.block(scale, plane)
        self._planes.write(texels, viewport=(block.x, block.y + first, texels.shape[1], texels.shape[0]))
        self._folded_time = self._thinned = None
        self._is_refined = False
        self._stale = set(self._in_memory)
        self._shots.clear()

    def refresh(self) -> None:
        """Look at the scene's time planes anew: some of their rows have changed."""
        self._rows_time = self._motion_time = self._folded_time = self._thinned = None
        for marching in self._in_memory.values():
            if isinstance(marching, Marching):
                marching.forget()
        self._shots.clear()

    def render(
        self, camera: Camera, time: float, *, part: Part = Part.FULL, appearance: np.ndarray | None = None
    ) -> Rendering:
        """What `kpc.player.cpu.reference.render` gives, by OpenGL."""
        target = self.march(camera, time, part=Part.STATIC if part is Part.STATIC else Part.FULL, appearance=appearance)
        rgb, depth, opacity, samples = read(target)
        if part is Part.DYNAMIC:
            rgb = np.abs(rgb - read(self.march(camera, time, part=Part.STATIC, appearance=appearance))[0])
        self.check()
        return Rendering(rgb, depth, opacity, samples)

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
        """Draw what `camera` sees over the whole of `screen`, stretched to its size, `appearance` as in `reference.code_of`.

        Depth goes from bright to dark over `depths`, world units; samples up to `most_samples`. Of what `screen` shows, 1 - `opacity`
        remains.
        """
        if mode is DisplayMode.OCCUPANCY:
            target = self.march(camera, time, part=Part.STATIC, program="cells.glsl", small=True)
        else:
            shown = Part.STATIC if part is Part.STATIC else Part.FULL
            target = self.march(camera, time, part=shown, appearance=appearance, small=True)
        without, view = target, DisplayMode.COLOUR.value if mode is DisplayMode.OCCUPANCY else mode.value
        if part is Part.DYNAMIC and mode is DisplayMode.COLOUR:
            without, view = self.march(camera, time, part=Part.STATIC, appearance=appearance, small=True), 1
        bounds = target.drawn if view == DisplayMode.COLOUR.value and opacity == 1 else EVERYWHERE
        if bounds != EVERYWHERE:
            beyond = 3 / np.array(target.seen.size)  # pixels that its edge, its pixels and those in between reach
            bounds = (*(bounds[:2] - beyond), *(bounds[2:] + beyond))
        canvas = None if target.seen.size == screen.size else self._canvas_of(target.seen.size)
        into = canvas.framebuffer if canvas else screen
        present, vertices = self._program("present.glsl", self.layout, view=view)
        _set(
            present,
            seen=SEEN_UNIT,
            met=MET_UNIT,
            without=WITHOUT_UNIT,
            viewport=tuple(map(float, into.size)),
            depths=depths,
            most_samples=most_samples,
            share=1.0 if canvas else opacity,
        )
        target.seen.use(SEEN_UNIT)
        target.met.use(MET_UNIT)
        without.seen.use(WITHOUT_UNIT)
        self._show_on(into, vertices, bounds, over=not canvas and opacity < 1)
        if canvas:
            enlarge, vertices = self._program("enlarge.glsl", self.layout)
            _set(enlarge, shown_small=SEEN_UNIT, viewport=tuple(map(float, screen.size)), share=opacity)
            canvas.shown.use(SEEN_UNIT)
            self._show_on(screen, vertices, bounds, over=opacity < 1)

    def _show_on(
        self, screen: moderngl.Framebuffer, vertices: moderngl.VertexArray, bounds: Bounds, over: bool
    ) -> None:
        """Draw what touches `bounds`, and what rays see that meet nothing around it."""
        if bounds != EVERYWHERE:
            screen.scissor = None
            screen.clear(*self.scene.background, 1.0)
        self._draw(screen, vertices, over=over, within=bounds)

    def _canvas_of(self, size: tuple[int, int]) -> Canvas:
        """One of this size; the last one is kept."""
        if self._canvas is None or self._canvas.shown.size != size:
            if self._canvas is not None:
                self._canvas.release()
            self._canvas = Canvas.of(self.ctx, size)
        return self._canvas

    def march(
        self,
        camera: Camera,
        time: float,
        *,
        part: Part = Part.FULL,
        program: str = "march.glsl",
        appearance: np.ndarray | None = None,
        small: bool = False,
    ) -> Target:
        """Draw into a target of the camera's size, which stays valid until the next march of the same part and size.

        Where `quality` asks for a lower resolution or several rays a pixel, into a smaller or larger one first; `small`: a smaller one is left
        so.

        `part` is FULL or STATIC. `program` is march.glsl or another that takes a subset of its uniforms. `appearance` as in
        `reference.code_of`.
        """
        if not 0.0 <= time <= 1.0:
            raise ValueError(f"time {time} lies outside [0, 1]")
        moving = part is Part.FULL and self._rows is not None
        quality, size = self.quality, (camera.width, camera.height)
        across = self.rays_across(camera)
        if across > 1:
            camera = camera.resized(*(across * side for side in size))
        elif quality.resolution < 1:
            camera = camera.resized(*(max(1, round(side * quality.resolution)) for side in size))
        marching = self._marching_kind(moving) if program == "march.glsl" else None
        if marching is CornerGrid:
            target = self._march_baked(part, camera, time)
        else:
            target = self._march_planes(part, camera, time, program, appearance, marching)
        if target.seen.size == size or small and across == 1:
            return target
        return self._resampled(target, self._target(part, size), across)

    def _march_planes(
        self,
        part: Part,
        camera: Camera,
        time: float,
        program: str,
        appearance: np.ndarray | None,
        marching: type[Marching] | None,
    ) -> Target:
        """A picture for which samples look up planes; it may follow the one before."""
        quality, scene, moving = self.quality, self.scene, part is Part.FULL and self._rows is not None
        code, thin = appearance_code(scene, appearance), moving and quality.folded
        free = self._free_at(occupancy_slot(scene, time), time if thin else None)
        self._marches_to_trial -= 1
        if self._marches_to_trial == 0:
            self.compute = self.is_compute_faster(camera, time)
        if marching is None:
            draw = self._by_shaders(program, time, moving, free, code)
        else:
            draw = self._by_processor(self._kept(marching), time if moving else None, free, code, quality.termination)
        raster = (camera.width, camera.height)
        self._pictures += 1
        before = self._shots.pop((part, raster), None)
        before = before if before is not None and self._pictures - before.count <= LATELY else None
        if program == "march.glsl" and quality.reprojection_tolerance:
            return self._followed(draw, part, before, Shot(camera, time, code.tobytes(), quality, self._pictures))
        target = self._target(part, raster)
        if program == "march.glsl":
            self._draw_alone(draw, part, target, camera)
        else:
            draw(target, camera)
        return target

    def _by_shaders(
        self, program: str, time: float, moving: bool, free: np.ndarray, code: np.ndarray
    ) -> Callable[..., None]:
        """What draws all, probes, or doubted blocks of a picture into a target."""
        quality, scene = self.quality, self.scene
        folded, displaced = moving and quality.folded, moving and self._motion_texture is not None
        if displaced:
            self._displace(time)
        if moving and not folded:
            self._cut(time)
        planes = self._fold(time) if folded else self._planes
        if free is not self._cells_written:
            self._cells.write(free)
            self._cells_written = free
        layout = self.folded_layout if folded else self.layout
        drawn = layout.scales
        shared = 0
        code_vectors, stride = _vectors(code), scene.step * quality.step

        def draw(
            target: Target, camera: Camera, pixels: int = ALL, points: int = 0, doubts: Target | None = None, bearable: float = 0.0,
            covered: np.ndarray | None = None, **more: object,
        ) -> None:  # fmt: skip
            if covered is not None and doubts is not None:
                doubts.seen.write(np.repeat(covered[..., None], 4, axis=-1).astype(np.float32))
                pixels = ONLY_DOUBTED
            elif pixels == ALL:
                target.drawn = EVERYWHERE
            march, vertices = self._program(
                program, layout, rows=moving and not folded, displaced=displaced, drawn=drawn, shared=shared, pixels=pixels,
                compute=self.compute and program == "march.glsl",
            )  # fmt: skip
            _set(
                march,
                stride=stride,
                tau=stride / scene.extent,
                termination=quality.termination,
                appearance=code_vectors,
                doubts=DOUBTS_UNIT,
                bearable=bearable,
                size=(float(camera.width), float(camera.height)),
                **_lens_of(camera),
                **more,
            )
            planes.use(PLANES_UNIT)
            self._row_texture.use(ROWS_UNIT)
            if self._motion_texture is not None:
                self._motion_texture.use(MOTION_UNIT)
            self._cells.use(CELLS_UNIT)
            if doubts is not None:
                doubts.seen.use(DOUBTS_UNIT)
            if isinstance(march, moderngl.ComputeShader):
                target.seen.bind_to_image(SEEN_UNIT, read=False)
                target.met.bind_to_image(MET_UNIT, read=False)
                march.run(*(-(-side // GROUP) for side in target.seen.size))
                self.ctx.memory_barrier()
            else:
                self._draw(target.framebuffer, vertices, points=points)

        return draw

    def _by_processor(
        self, marching: Marching, time: float | None, free: np.ndarray, code: np.ndarray, termination: float
    ) -> Callable[..., None]:
        """As `_by_shaders`."""
        marching.go_to(time, code)

        def march(
            camera: Camera, blocks: np.ndarray, side: int, first: tuple[int, int], seen: np.ndarray, met: np.ndarray
        ) -> None:
            marching.march(
                camera, free, blocks, side, self.scene.step * self.quality.step, termination, first, seen, met
            )

        def draw(
            target: Target, camera: Camera, pixels: int = ALL, points: int = 0, doubts: Target | None = None, bearable: float = 0.0,
            covered: np.ndarray | None = None, turn: int = 0, bounds: Bounds = EVERYWHERE, **_: object,
        ) -> None:  # fmt: skip
            size, count = (camera.width, camera.height), (-(-camera.height // BLOCK), -(-camera.width // BLOCK))
            if pixels == ONLY_PROBES:
                left, bottom, right, top = map(int, bounds)
                at = probes_of(turn, left, bottom, right, top, size)
                rows, columns = at[..., 0], at[..., 1]
                seen, met = marching.room(size)
                march(camera, at.reshape(-1, 2), 1, (0, 0), seen, met)
                write(target, (left, bottom), seen[rows, columns], met[rows, columns])
                return
            blocks = covered
            if blocks is None:
                blocks = np.ones(count, bool) if doubts is None else first_channel(doubts).reshape(count) > bearable
            if not blocks.any():
                return
            left, bottom, right, top = (min(BLOCK * end, side) for end, side in zip(_bounds(blocks), 2 * size))
            seen, met = marching.room((right - left, top - bottom))
            if pixels == ONLY_DOUBTED:
                read_into(target, (left, bottom), seen, met)
            elif pixels == ALL:
                target.drawn = EVERYWHERE
            else:
                seen[:], met[:] = (*self.scene.background, 0.0), 0.0
            march(camera, np.argwhere(blocks), BLOCK, (left, bottom), seen, met)
            write(target, (left, bottom), seen, met)

        return draw

    def _march_baked(self, part: Part, camera: Camera, time: float) -> Target:
        """A picture that a processor marches itself, through a grid of what planes come to: all of what may see something."""
        target, free = (
            self._target(part, (camera.width, camera.height)),
            self._free_at(occupancy_slot(self.scene, time), None),
        )
        self._shots.pop((part, target.seen.size), None)
        draw = self._by_processor(
            self._kept(CornerGrid), time, free, np.empty(0, np.float32), self.quality.grid_termination
        )
        self._draw_all(draw, part, target, camera)
        return target

    def _kept(self, kind: type) -> Any:
        """What works on planes in memory, with planes as they are now."""
        if kind not in self._in_memory:
            self._in_memory[kind] = kind(self.scene, self.layout)
            self._stale.add(kind)
        if kind in self._stale:
            atlas = np.frombuffer(self._planes.read(), np.float32).reshape(*self.layout.size[::-1], 4)
            for stale in self._stale:
                self._in_memory[stale].keep(atlas)
            self._stale.clear()
        return self._in_memory[kind]

    def is_compute_faster(self, camera: Camera, time: float) -> bool:
        """Draw a picture by fragment and by compute shaders, a few times each, and compare the best of their times."""
        chosen, seconds = self.compute, {}
        for self.compute in (False, True):
            took = []
            for _ in range(1 + TRIALS):  # the first compiles
                self.ctx.finish()
                started = clock.perf_counter()
                self.march(camera, time)
                self.ctx.finish()
                took.append(clock.perf_counter() - started)
            seconds[self.compute] = min(took[1:])
        self.compute = chosen
        return seconds[True] < seconds[False]

    def _draw_all(self, draw: Callable[..., None], part: Part, target: Target, camera: Camera) -> tuple[float, Bounds]:
        """March all pixels that may see something; tell their share, and about where they are."""
        blocks = self._covered(camera)
        if blocks is None:
            draw(target, camera)
            return 1.0, EVERYWHERE
        self._empty(target)
        target.drawn = _shares(_bounds(blocks), blocks.shape[::-1])
        draw(
            target,
            camera,
            ONLY_COVERED,
            blocks.size,
            self._target(part, blocks.shape[::-1], DOUBTS),
            0.5,
            covered=blocks,
        )
        return float(blocks.mean()), target.drawn

    def _draw_alone(self, draw: Callable[..., None], part: Part, target: Target, camera: Camera) -> float:
        """A picture that follows no other. Tells the share of its pixels that were marched, where a processor draws."""
        spanned = self._texels_spanned(camera) if self.quality.interpolation_tolerance else math.inf
        return self._draw_coarse_to_fine(draw, part, target, camera, spanned, self.quality.interpolation_tolerance**2)[
            0
        ]

    def _draw_coarse_to_fine(
        self, draw: Callable[..., None], part: Part, target: Target, camera: Camera, spanned: float, bearable: float
    ) -> tuple[float, Bounds]:
        """March a coarser picture, itself drawn so, stretch it, and march pixel by pixel those blocks of it that would be off the most, until
        the mean of squares of what is left is `bearable`; all where the coarser one's pixels would span more than a texel, as this
        one's `spanned`. Tells as `_draw_all`."""
        size = camera.width, camera.height
        if min(size) < COARSER * BLOCK or COARSER * spanned > 1:
            return self._draw_all(draw, part, target, camera)
        fewer = camera.resized(*(-(-side // COARSER) for side in size))
        coarse, left_for_it = self._target(part, (fewer.width, fewer.height), COARSE), bearable / COARSER**2
        marched, bounds = self._draw_coarse_to_fine(draw, part, coarse, fewer, COARSER * spanned, left_for_it)
        doubts = self._target(part, (-(-size[0] // BLOCK), -(-size[1] // BLOCK)), DOUBTS)
        bent, vertices = self._program("bent.glsl", self.layout)
        _set(bent, seen_coarse=SEEN_UNIT, size=tuple(map(float, size)))
        coarse.seen.use(SEEN_UNIT)
        doubts.framebuffer.clear()
        self._draw(doubts.framebuffer, vertices, within=bounds)
        most, share = self._most_missed(doubts, bearable - left_for_it)
        self._stretch(coarse, target, bounds)
        self._draw_doubted(draw, target, camera, doubts, most)
        return marched / COARSER**2 + share, bounds

    def _most_missed(self, missed: Target, bearable: float) -> tuple[float, float]:
        """By how much a block may be off, that all which are off by no more may stay so; and the share of the others. A graphics card is
        not waited for: there the share counts as 0, and what is bearable counts for each block, not for their mean."""
        if not self._is_software:
            return BEARABLE_ALONE * bearable, 0.0
        errors = np.sort(first_channel(missed))
        kept = int(np.searchsorted(np.cumsum(errors, dtype=np.float64), bearable * len(errors), side="right"))
        return float(errors[kept - 1]) if kept else -1.0, 1.0 - kept / len(errors)

    def _share_of(self, doubts: Target) -> float:
        """Of blocks that are set; 0 where no processor draws: a graphics card would have to be waited for."""
        return float(first_channel(doubts).mean()) if self._is_software else 0.0

    def _draw_doubted(
        self, draw: Callable[..., None], target: Target, camera: Camera, doubts: Target, bearable: float = 0.5
    ) -> None:
        """March the blocks of a target whose doubt is more than `bearable`."""
        draw(target, camera, ONLY_DOUBTED, math.prod(doubts.seen.size), doubts, bearable=bearable)

    def _followed(self, draw: Callable[..., None], part: Part, before: Shot | None, shot: Shot) -> Target:
        """Draw what the picture before does not tell: its probes, and the blocks in which they are not as predicted."""
        camera, size = shot.camera, (shot.camera.width, shot.camera.height)
        if before is None or before.alone or not self._follows(shot, before):
            marched = self._draw_alone(draw, part, picture := self._target(part, size), camera)
            self._shots[part, size] = replace(shot, marched=marched, alone=max(before.alone - 1, 0) if before else 0)
            return picture
        shot = replace(shot, turn=before.turn + 1, number=before.number, marched=before.marched)
        picture = self._target(part, size, before.number)
        blocks = tuple(-(-side // BLOCK) for side in size)
        covered = self._covered(camera)
        within = (0, 0, *blocks) if covered is None else _bounds(covered)
        bounds = EVERYWHERE if covered is None else _shares(within, blocks)
        moved = _lens_of(camera) != _lens_of(before.camera)
        if moved:
            shot = replace(shot, number=PICTURE + OTHER_PICTURE - before.number)
            picture = self._predicted(picture, self._target(part, size, shot.number), before.camera, camera, bounds)
        picture.drawn = bounds = _around(picture.drawn, bounds)
        tiles = self._tiles
        raster = tiles.raster(blocks) if tiles else blocks
        probes, doubts = self._target(part, raster, PROBES), self._target(part, blocks, DOUBTS)
        common = {"turn": shot.turn, "raster": tuple(map(float, raster)),
                  "seen_probes": SEEN_PROBES_UNIT, "met_probes": MET_PROBES_UNIT}  # fmt: skip
        if covered is not None:
            self._empty(probes)
        squares = math.prod(tiles.squares(blocks)) if tiles else 0
        draw(probes, camera, ONLY_PROBES, squares, bounds=tuple(map(float, within)), **common)
        probes.seen.use(SEEN_PROBES_UNIT)
        probes.met.use(MET_PROBES_UNIT)
        picture.seen.use(SEEN_UNIT)
        doubt, vertices = self._program("doubt.glsl", self.layout, moved=moved)
        tolerance = shot.quality.reprojection_tolerance * (MOVED_TOLERANCE if moved else 1.0)
        _set(doubt, seen_predicted=SEEN_UNIT, tolerance=tolerance, size=tuple(map(float, size)), **common)
        doubts.framebuffer.clear()
        self._draw(doubts.framebuffer, vertices, within=bounds)
        if self._share_of(doubts) > MOST_DOUBTED * before.marched:
            marched = self._draw_alone(draw, part, picture, camera)
            self._shots[part, size] = replace(
                shot, marched=marched, alone=0 if self._since_s(shot, before) > JUMP_S else ALONE_FOR
            )
            return picture
        settle, vertices = self._program("settle.glsl", self.layout)
        _set(settle, size=tuple(map(float, size)), **common)
        self._draw(picture.framebuffer, vertices, points=math.prod(blocks), within=bounds)
        self._draw_doubted(draw, picture, camera, doubts)
        self._shots[part, size] = shot
        return picture

    @property
    def _tiles(self) -> Tiles | None:
        """How probes lie; None: side by side."""
        return SPREAD if self._is_software and not self.compute and self._marching_kind(moving=True) is None else None

    def _follows(self, shot: Shot, before: Shot) -> bool:
        """Whether a picture shows the same as the one before, at another time: while the clip stands still, pictures are whole."""
        return self._since_s(shot, before) > 0 and (shot.appearance, shot.quality) == (
            before.appearance,
            before.quality,
        )

    def _since_s(self, shot: Shot, before: Shot) -> float:
        return abs(shot.time - before.time) * self.scene.clip.duration_s

    def _predicted(self, old: Target, new: Target, before: Camera, now: Camera, bounds: Bounds = EVERYWHERE) -> Target:
        """A picture as it was before, seen from where the camera is now: as much as touches `bounds`."""
        predict, vertices = self._program("predict.glsl", self.layout)
        lens_before = {f"{name}_before": value for name, value in _lens_of(before).items()}
        size = tuple(map(float, new.seen.size))
        _set(predict, seen_before=SEEN_UNIT, met_before=MET_UNIT, size=size, **_lens_of(now), **lens_before)
        old.seen.use(SEEN_UNIT)
        old.met.use(MET_UNIT)
        self._confine(new, bounds)
        self._draw(new.framebuffer, vertices, within=bounds)
        return new

    def _resampled(self, marched: Target, target: Target, across: int) -> Target:
        """A picture of one size in another: the mean of `across` rays across a pixel, or stretched."""
        if across == 1:
            return self._stretch(marched, target, cubic=True)
        program, vertices = self._program("average.glsl", self.layout)
        _set(program, seen_fine=SEEN_UNIT, met_fine=MET_UNIT, across=across)
        marched.seen.use(SEEN_UNIT)
        marched.met.use(MET_UNIT)
        self._draw(target.framebuffer, vertices)
        target.drawn = EVERYWHERE
        return target

    def _stretch(self, marched: Target, target: Target, bounds: Bounds = EVERYWHERE, cubic: bool = False) -> Target:
        """A picture in a larger one: as much as touches `bounds`."""
        self._confine(target, bounds)
        program, vertices = self._program("upscale.glsl", self.layout, cubic=cubic)
        _set(program, seen_small=SEEN_UNIT, met_small=MET_UNIT, size=tuple(map(float, target.seen.size)))
        marched.seen.use(SEEN_UNIT)
        marched.met.use(MET_UNIT)
        self._draw(target.framebuffer, vertices, within=bounds)
        return target

    def _confine(self, target: Target, bounds: Bounds) -> None:
        """Leave what rays see that meet nothing wherever a target is not to be drawn, which is all but `bounds`."""
        if bounds not in (EVERYWHERE, target.drawn):
            self._empty(target)
        target.drawn = bounds

    def _empty(self, target: Target) -> None:
        """Draw what rays see that meet nothing, over what was drawn."""
        nothing, vertices = self._program("nothing.glsl", self.layout)
        self._draw(target.framebuffer, vertices, within=target.drawn)

    def _covered(self, camera: Camera) -> np.ndarray | None:
        """`Cover.blocks` of what is occupied now, where drawing only those is quicker: by a processor, and of less than MOST_COVERED."""
        if not self._is_software or self.scene.mapping is not None or self._slot is None:
            return None
        if self._slot not in self._covers:
            self._covers[self._slot] = ScreenMask.of(self.scene.occupancy[self._slot], self.scene.aabb)
        view = self._slot, camera.width, _lens_of(camera)
        if self._view_covered is None or self._view_covered[0] != view:
            blocks = self._covers[self._slot].blocks(camera, BLOCK)
            self._view_covered = view, None if blocks is None or blocks.mean() > MOST_COVERED else blocks
        return self._view_covered[1]

    def rays_across(self, camera: Camera) -> int:
        """As many as a pixel spans texels, as far as `quality` and PIXELS_MARCHED allow. One where space is mapped: there texels differ."""
        if self.scene.mapping is not None:
            return 1
        room = math.isqrt(max(1, PIXELS_MARCHED // (camera.width * camera.height)))
        return max(1, min(math.floor(self._texels_spanned(camera)), self.quality.rays_across, room))

    def _texels_spanned(self, camera: Camera) -> float:
        """By a pixel, of the finest scale: in the middle of the box; where space is mapped, the most along the ray in the picture's middle."""
        if self.scene.mapping is not None:
            return texels_spanned(self.scene, camera)
        away = math.dist(self._middle, camera.camera_to_world[:3, 3])
        return away / min(camera.fl_x, camera.fl_y) / self._finest_texel

    def _draw(
        self,
        framebuffer: moderngl.Framebuffer,
        vertices: moderngl.VertexArray,
        viewport: tuple[int, int, int, int] | None = None,
        over: bool = False,
        points: int = 0,
        within: Bounds = EVERYWHERE,
    ) -> None:
        """All over a viewport, or so many points; `over` what is there, by alpha; of pixels that touch `within`, and those next to them."""
        self.ctx.disable(moderngl.BLEND | moderngl.DEPTH_TEST | moderngl.CULL_FACE)
        if over:
            self.ctx.enable(moderngl.BLEND)
            self.ctx.blend_func = (
                moderngl.SRC_ALPHA,
                moderngl.ONE_MINUS_SRC_ALPHA,
                moderngl.ONE,
                moderngl.ONE_MINUS_SRC_ALPHA,
            )
        framebuffer.use()
        framebuffer.viewport = viewport or (0, 0, *framebuffer.size)
        left, bottom, right, top = (int(side * share) for side, share in zip(2 * framebuffer.size, within))
        framebuffer.scissor = (
            None if within == EVERYWHERE else (left - 1, bottom - 1, right - left + 3, top - bottom + 3)
        )
        self.ctx.enable(moderngl.PROGRAM_POINT_SIZE)
        vertices.render(moderngl.POINTS if points else moderngl.TRIANGLES, vertices=points or 3)
        framebuffer.scissor = None  # or what is cleared next would be no more than this

    def _target(self, part: Part, size: tuple[int, int], number: int = 0) -> Target:
        """A target of this size; the few last used are kept."""
        key = part, size, number
        target = self._targets.pop(key, None) or Target.of(self.ctx, size)
        self._targets[key] = target
        if len(self._targets) > TARGETS_KEPT:
            dropped = next(iter(self._targets))
            self._targets.pop(dropped).release()
            self._shots.pop(dropped[:2], None)
        return target

    def _program(
        self,
        name: str,
        layout: Layout,
        *,
        rows: bool = False,
        displaced: bool = False,
        drawn: int = 0,
        shared: int = 0,
        pixels: int = ALL,
        moved: bool = False,
        cubic: bool = False,
        view: int = 0,
        compute: bool = False,
    ) -> tuple[moderngl.Program | moderngl.ComputeShader, moderngl.VertexArray]:
        """Compiled when first needed, with everything set that does not change. `layout`: of the planes it reads."""
        tiles = self._tiles
        key = name, layout.refined, rows, displaced, drawn, shared, pixels, moved, cubic, view, compute, tiles
        if key in self._programs:
            return self._programs[key]
        scene = self.scene
        defines = {
            **planes_shape(layout),
            **decoder_shape(scene.decoder),
            "ROWS": int(rows),
            "DRAWN": drawn,
            "APPEARANCE": int(bool(scene.appearances)),
            "CONTRACTED": int(isinstance(scene.mapping, Contraction)),
            "NDC": int(isinstance(scene.mapping, DeviceCoordinates)),
            "MOTION": int(displaced),
            "SHARED": shared,
            "PIXELS": pixels,
            "MOVED": int(moved),
            "CUBIC": int(cubic),
            "VIEW": view,
            "COMPUTE": int(compute),
            "TILE": tiles.tile if tiles else MORE_THAN_A_RASTER,
            "SQUARE": tiles.square if tiles else MORE_THAN_A_RASTER,
        }
        written = {"decoder_weights": self._decoder, "plane_blocks": shader.constants(block_arrays(scene, layout))}
        where = (
            "places.glsl" if name == "settle.glsl" else "blocks.glsl" if pixels == ONLY_DOUBTED else "fullscreen.glsl"
        )
        if pixels == ONLY_PROBES and tiles:
            where = "squares.glsl"
        program: moderngl.Program | moderngl.ComputeShader
        if compute:
            program = shader.build_compute(self.ctx, name, defines, written)
        else:
            program = shader.build(self.ctx, name, defines, written, where)
        _set(
            program,
            seen_picture=SEEN_UNIT,
            met_picture=MET_UNIT,
            planes=PLANES_UNIT,
            rows=ROWS_UNIT,
            cells=CELLS_UNIT,
            motion=MOTION_UNIT,
            nodes=(1.0, 1.0, 1.0) if self._motion_texture is None else tuple(map(float, self._motion_texture.size)),
            rows_texel=(1 / self._row_texture.width, 1 / self._row_texture.height),
            cell_count=tuple(map(float, scene.occupancy.shape[:0:-1])),
            box_low=tuple(scene.aabb[0]),
            box_high=tuple(scene.aabb[1]),
            background=tuple(scene.background),
            even=scene.mapping.uniform_distance if isinstance(scene.mapping, Contraction) else 0.0,
            **_frame_of(scene.mapping),
        )
        # What draws a compute shader's picture on the screen has vertices of its own.
        vertices = self._program("present.glsl", layout)[1] if compute else self.ctx.vertex_array(program, [])
        entry = self._programs[key] = program, vertices
        return entry

    def _free_at(self, slot: int, time: float | None) -> np.ndarray:
        """How far around each cell all is empty: of a slot; at a `time`, 1 in those, too, that `quality` has rays pass by then."""
        self._slot = slot
        if time is None or not self.quality.culling_alpha or not self._thins or self._rows is None:
            return self._free(slot)
        key = slot, time, self.quality.culling_alpha
        if self._thinned is None or self._thinned[0] != key:
            empty = self._kept(OccupancyCulling).empty(slot, self._rows.at(time), time, self.quality.culling_alpha)
            self._thinned = key, self._free(slot) | empty  # 0 in what is occupied, 1 in what is so and empty
        return self._thinned[1]

    def _free(self, slot: int) -> np.ndarray:
        """How far around each cell of a slot all is empty."""
        if slot not in self._distances:
            self._distances[slot] = empty_distances(self.scene.occupancy[slot])
        return self._distances[slot]

    def _cut(self, time: float) -> None:
        if time != self._rows_time and self._rows is not None:
            self._row_texture.write(self._rows.at(time))
            self._rows_time = time

    def _displace(self, time: float) -> None:
        if time != self._motion_time and self._motion_texture is not None and self.scene.motion is not None:
            offsets = sample_linear(self.scene.motion, time)
            self._motion_texture.write(
                np.concatenate([offsets, offsets[..., :1]], axis=-1)
            )  # RGBA: RGB is seldom native
            self._motion_time = time

    def _refined(self) -> Folded | FoldedInMemory:
        """What folding takes, with planes as they are now."""
        if self._folded is None and self._folds_in_memory:
            self._folded = FoldedInMemory.of(self.ctx, self.folded_layout)
        elif self._folded is None:
            self._folded = Folded.of(self.ctx, self.folded_layout, self._row_texture.size, self._folds_in_half)
        if not self._is_refined:
            self._planes.use(PLANES_UNIT)
            self._draw_planes("refine.glsl", self._folded.refine_into)
            if isinstance(self._folded, FoldedInMemory):
                self._folded.keep()
            self._is_refined = True
        return self._folded

    def _fold(self, time: float) -> moderngl.Texture:
        if time == self._folded_time or self._rows is None:
            return self._refined().planes
        folded, rows = self._refined(), self._rows.at(time, self.folded_layout.refined)
        if isinstance(folded, FoldedInMemory):
            folded.fold(rows)
        else:
            folded.rows.write(rows)
            folded.refined.use(PLANES_UNIT)
            folded.rows.use(ROWS_UNIT)
            self._draw_planes(
                "fold.glsl", folded.fold_into, folded_rows_texel=tuple(1 / side for side in folded.rows.size)
            )
        self._folded_time = time
        return folded.planes

    def _draw_planes(self, name: str, into: moderngl.Framebuffer, **more: object) -> None:
        """Draw each plane as it lies in the folded layout, by a shader that is told where that is and which rows go with it."""
        program, vertices = self._program(name, self.layout)
        _set(
            program,
            refined=PLANES_UNIT,
            refined_texel=tuple(1 / side for side in into.size),
            largest=LARGEST_HALF if self._in_half else float(LARGEST_FLOAT),
            **more,
        )
        for source, block in zip(self.layout.blocks, self.folded_layout.blocks):
            lines = self.layout.lines(block)
            _set(
                program,
                source=self.layout.place(source),
                source_width=source.width / self.layout.size[0],
                origin=(block.x, block.y),
                width=block.width,
                at_texel=(1 / max(block.width - 1, 1), 1 / max(block.height - 1, 1)),
                upright=block.upright,
                line=lines.start,
            )
            self._draw(into, vertices, (block.x, block.y, (lines.stop - lines.start) * block.width, block.height))


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


def _texture(ctx: moderngl.Context, size: tuple[int, int], dtype: str = "f4") -> moderngl.Texture:
    """A texture, float32 unless told, of (width, height) vectors of four, filtered, clamped at its edges, all 0: filters may touch what lies
    between the blocks of an atlas, with a weight of 0, which does no harm to anything but NaN."""
    texture = ctx.texture(size, 4, dtype=dtype)
    texture.filter = (moderngl.LINEAR, moderngl.LINEAR)
    texture.repeat_x = texture.repeat_y = False
    whole = ctx.framebuffer([texture])
    whole.clear()
    whole.release()
    return texture


def _volume(ctx: moderngl.Context, size: tuple[int, int, int]) -> moderngl.Texture3D:
    """A texture of float32 vectors of four, filtered, clamped at its faces."""
    texture = ctx.texture3d(size, 4, dtype="f4")
    texture.filter = (moderngl.LINEAR, moderngl.LINEAR)
    texture.repeat_x = texture.repeat_y = texture.repeat_z = False
    return texture


def _bytes_of(texture: moderngl.Texture) -> int:
    return int(texture.dtype[1]) * texture.width * texture.height * texture.components


def _set(program: moderngl.Program | moderngl.ComputeShader, **values: object) -> None:
    """Set the uniforms that a program has; compilers drop those it does not use, and the unused ends of arrays."""
    for name, value in values.items():
        member = program.get(name, None)
        if isinstance(member, moderngl.Uniform):
            if isinstance(value, list):  # moderngl wants an array of one without the brackets
                value = value[: member.array_length] if member.array_length > 1 else value[0]
            member.value = value


def _vectors(code: np.ndarray) -> list[tuple[float, ...]]:
    """A code as a uniform array of vec4s, padded with 0."""
    return [tuple(map(float, vector)) for vector in pad_to_multiple(code, 0).reshape(-1, 4)]


def _lens_of(camera: Camera) -> dict[str, object]:
    """The uniforms of a camera."""
    return {
        "height": float(camera.height),
        "lens": (camera.fl_x, camera.fl_y, camera.cx, camera.cy),
        "axes": tuple(camera.camera_to_world[:3, :3].T.ravel()),
        "eye": tuple(camera.camera_to_world[:3, 3]),
    }


def _frame_of(mapping: SpaceMapping | None) -> dict[str, object]:
    """The uniforms of device coordinates."""
    if not isinstance(mapping, DeviceCoordinates):
        return {}
    return {"frame": tuple(mapping.frame.T.ravel()), "near": mapping.near, "baseline": mapping.baseline}
