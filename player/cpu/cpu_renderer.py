"""The processor's renderer: draws pictures in memory where a software OpenGL driver would stand in for a graphics card.

A picture follows the one before if it can (`kpc.player.cpu.reprojection`); else it is drawn coarse to fine
(`kpc.player.cpu.coarse_to_fine`); where the level asks for neither, all its pixels are marched. Pixels that no occupied
cell projects to are left out (`kpc.player.cpu.screen_mask`).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from kpc.format.scene.cameras import Camera
from kpc.format.scene.scene import Scene
from kpc.player.atlas import Layout, empty_distances
from kpc.player.cpu.coarse_to_fine import FACTOR, blocks_over, interpolation_errors, upsample
from kpc.player.cpu.corner_grid import CornerGrid
from kpc.player.cpu.field_sampler import FieldSampler
from kpc.player.cpu.occupancy_culling import OccupancyCulling
from kpc.player.cpu.picture import BLOCK, Picture, Rectangle, union
from kpc.player.cpu.plane_sampler import PlaneSampler
from kpc.player.cpu.reference import occupancy_slot
from kpc.player.cpu.reprojection import edge_blocks, mismatched_blocks, predict, sample_pixels
from kpc.player.cpu.screen_mask import ScreenMask
from kpc.player.footprint import texels_per_pixel
from kpc.player.quality import Quality

# Factor of the tolerance while the camera moves: interpolation errs in places too thin for sample pixels to meet.
# Turning by a degree a frame, liam is then 42.2 dB from the reference instead of 40.8, in 7 % more time.
MOVED_TOLERANCE = 0.8
# Where more than this share of the pixels that a picture without prediction took is mismatched, prediction costs more
# than it saves ...
MOST_MISMATCHED = 0.6
# ... and so many pictures after it are drawn without, before it is tried again; but not after a jump of the clip by
# more than JUMP_S.
UNPREDICTED_PICTURES = 8
JUMP_S = 0.2
# Pictures since the last, at most, that it may be predicted from: one in between may be a small one for statistics.
LATEST = 2
# Share of a picture from which on the screen mask saves nothing.
MOST_MASKED = 0.8
# Pictures in memory: two of each size and part, and those of the coarser sizes.
PICTURES_KEPT = 16

# The roles of pictures in memory: FULL and OTHER take turns while the camera moves.
FULL, OTHER, COARSE, SAMPLED = range(4)


@dataclass(frozen=True, eq=False)
class Drawn:
    """The last picture of a part and size, which the next may be predicted from.

    Attributes:
        number: of the picture among all.
        role: FULL or OTHER, which of the two pictures in memory it is.
        turn: of its sample pixels.
        marched: share of the pixels that the last picture without prediction took.
        unpredicted: how many pictures from here on are to be drawn without prediction.
        content: of the picture; outside it shows the background.
    """

    camera: Camera
    time: float
    code: bytes
    quality: Quality
    number: int
    role: int = FULL
    turn: int = 0
    marched: float = 1.0
    unpredicted: int = 0
    content: Rectangle = (0, 0, 0, 0)


@dataclass(frozen=True, eq=False)
class Frame:
    """What is to be drawn.

    Attributes:
        march: marches blocks of a side into a picture of a camera.
        is_moving: whether the whole scene is drawn, else its static part.
        slot: of the occupancy grid.
    """

    march: Callable[[Camera, np.ndarray, int, Picture], None]
    is_moving: bool
    slot: int
    interpolation_tolerance: float


class ProcessorRenderer:
    """Draws a scene on the processor.

    Args:
        scene: the scene; time planes are read from it.
        layout: of the atlas.
        read_atlas: returns the space planes, a (height, width, 4) float32 atlas, when they are needed.

    Attributes:
        content: of the last picture; outside this rectangle it shows the background.
    """

    def __init__(self, scene: Scene, layout: Layout, read_atlas: Callable[[], np.ndarray]) -> None:
        self.scene = scene
        self._layout, self._read_atlas = layout, read_atlas
        self._samplers: dict[type[FieldSampler], FieldSampler] = {}
        self._stale: set[type[FieldSampler]] = set()
        self._culling: OccupancyCulling | None = None
        self._distances: dict[int, np.ndarray] = {}
        # The last distances with culling, and the slot, time and alpha that they are for.
        self._culled: tuple[tuple[int, float, float], np.ndarray] | None = None
        self._masks: dict[int, ScreenMask] = {}
        # The last blocks of a screen mask, and the view that they are for.
        self._masked: tuple[object, np.ndarray | None] | None = None
        self._pictures: dict[tuple[bool, tuple[int, int], int], Picture] = {}
        # By the id of a picture's rgba, the rectangle outside which it is the background; unknown: nowhere.
        self._contents: dict[int, Rectangle] = {}
        self._drawn: dict[tuple[bool, tuple[int, int]], Drawn] = {}
        self._count = 0
        self.content: Rectangle = (0, 0, 0, 0)

    @property
    def memory_bytes(self) -> int:
        """Bytes of its arrays without pictures."""
        culling = 0 if self._culling is None else self._culling.memory_bytes
        return culling + sum(sampler.memory_bytes for sampler in self._samplers.values())

    @property
    def picture_bytes(self) -> int:
        return sum(array.nbytes for picture in self._pictures.values() for array in picture)

    def planes_changed(self) -> None:
        """Read the space planes anew before the next picture."""
        self._stale = set(self._samplers)
        self._culled = None
        self._drawn.clear()

    def time_planes_changed(self) -> None:
        """Read the time planes anew before the next picture."""
        for sampler in self._samplers.values():
            sampler.time_planes_changed()
        self._culled = None
        self._drawn.clear()

    def draw(self, camera: Camera, time: float, quality: Quality, code: np.ndarray, *, is_moving: bool) -> Picture:
        """Draw a picture; it stays valid until the next of the same size and part.

        Args:
            time: [0, 1] over the clip.
            code: of an appearance, `reference.appearance_code`.
            is_moving: draw the whole scene, else its static part.
        """
        kind = self._sampler_kind(quality, is_moving)
        sampler = self._sampler(kind)
        sampler.prepare(time if is_moving else None, code)
        slot, stride = occupancy_slot(self.scene, time), self.scene.step * quality.step
        self._count += 1
        key = is_moving, (camera.width, camera.height)
        last = self._drawn.pop(key, None)
        if kind is CornerGrid:
            free, termination = self._free(slot), quality.grid_termination
        else:
            free, termination = (
                self._free(slot, time if is_moving else None, quality.culling_alpha),
                quality.termination,
            )

        def march(view: Camera, blocks: np.ndarray, side: int, picture: Picture) -> None:
            sampler.march(view, free, blocks, side, stride, termination, picture)

        frame = Frame(march, is_moving, slot, 0.0 if kind is CornerGrid else quality.interpolation_tolerance)
        self.content = self._content(slot, camera)
        if kind is CornerGrid or not quality.reprojection_tolerance:
            picture = self._picture(*key, FULL)
            self._draw_unpredicted(frame, camera, picture)
            return picture
        drawn = Drawn(camera, time, code.tobytes(), quality, self._count, content=self.content)
        return self._draw_predicted(frame, drawn, last)

    # --- whole pictures

    def _draw_unpredicted(self, frame: Frame, camera: Camera, picture: Picture) -> float:
        """Draw a picture that is not predicted; return the share of its pixels that were marched."""
        tolerance = frame.interpolation_tolerance
        if not tolerance:
            return self._march_masked(frame, camera, picture)
        return self._draw_coarse_to_fine(frame, camera, picture, texels_per_pixel(self.scene, camera), tolerance**2)

    def _march_masked(self, frame: Frame, camera: Camera, picture: Picture) -> float:
        """March all pixels that an occupied cell may project to; return their share."""
        blocks = self._masked_blocks(frame.slot, camera)
        if blocks is None:
            blocks = np.ones((-(-camera.height // BLOCK), -(-camera.width // BLOCK)), bool)
            self._contents.pop(id(picture.rgba), None)
        else:
            self._clear(picture, self._content(frame.slot, camera))
        frame.march(camera, np.argwhere(blocks), BLOCK, picture)
        return float(blocks.mean())

    def _draw_coarse_to_fine(
        self, frame: Frame, camera: Camera, picture: Picture, texels: float, allowed: float
    ) -> float:
        """Draw a coarser picture, itself coarse to fine, interpolate it, and march the blocks that are off the most,
        until the mean squared error left is `allowed`. March all where the coarser picture's pixels would span more
        than a texel, as this one's span `texels`.
        """
        size = camera.width, camera.height
        if min(size) < FACTOR * BLOCK or FACTOR * texels > 1:
            return self._march_masked(frame, camera, picture)
        coarser = camera.resized(*(-(-side // FACTOR) for side in size))
        coarse, allowed_there = (
            self._picture(frame.is_moving, (coarser.width, coarser.height), COARSE),
            allowed / FACTOR**2,
        )
        marched = self._draw_coarse_to_fine(frame, coarser, coarse, FACTOR * texels, allowed_there)
        blocks = blocks_over(interpolation_errors(coarse.rgba, size), allowed - allowed_there)
        upsample(coarse, picture)
        self._contents.pop(id(picture.rgba), None)
        frame.march(camera, np.argwhere(blocks), BLOCK, picture)
        return marched / FACTOR**2 + float(blocks.mean())

    # --- pictures that follow the one before

    def _draw_predicted(self, frame: Frame, drawn: Drawn, last: Drawn | None) -> Picture:
        """Draw a picture by what is mismatched in its prediction, if there is one."""
        camera, size = drawn.camera, (drawn.camera.width, drawn.camera.height)
        key = frame.is_moving, size
        if last is None or last.unpredicted or not self._is_predictable(drawn, last):
            picture = self._picture(*key, FULL)
            marched = self._draw_unpredicted(frame, camera, picture)
            unpredicted = max(last.unpredicted - 1, 0) if last else 0
            self._drawn[key] = replace(drawn, marched=marched, unpredicted=unpredicted)
            return picture
        has_moved = not _is_same_view(camera, last.camera)
        role = FULL + OTHER - last.role if has_moved else last.role
        drawn = replace(drawn, turn=last.turn + 1, role=role, marched=last.marched)
        picture = self._picture(*key, role)
        if has_moved:
            predict(self._picture(*key, last.role), last.camera, picture, camera)
            self._contents.pop(id(picture.rgba), None)
        is_shown = self._masked_blocks(frame.slot, camera)
        rows, columns = sample_pixels(drawn.turn, size)
        if is_shown is None:
            is_shown = np.ones(rows.shape, bool)
        sampled = self._sampled(frame, camera, rows, columns, is_shown)
        tolerance = drawn.quality.reprojection_tolerance * (MOVED_TOLERANCE if has_moved else 1.0)
        mismatched = mismatched_blocks(sampled.rgba, picture.rgba[rows, columns], tolerance)
        if has_moved:
            mismatched |= edge_blocks(picture.rgba[..., 3])
        if mismatched.mean() > MOST_MISMATCHED * last.marched:
            marched = self._draw_unpredicted(frame, camera, picture)
            unpredicted = 0 if self._seconds_between(drawn, last) > JUMP_S else UNPREDICTED_PICTURES
            self._drawn[key] = replace(drawn, marched=marched, unpredicted=unpredicted)
            return picture
        self.content = (0, 0, *size) if has_moved else union(last.content, drawn.content)
        drawn = replace(drawn, content=self.content)
        if id(picture.rgba) in self._contents:
            self._contents[id(picture.rgba)] = union(self._contents[id(picture.rgba)], self.content)
        picture.rgba[rows, columns], picture.sums[rows, columns] = sampled
        self._clear_blocks(picture, np.argwhere(mismatched & ~is_shown))
        frame.march(camera, np.argwhere(mismatched & is_shown), BLOCK, picture)
        self._drawn[key] = drawn
        return picture

    def _sampled(
        self, frame: Frame, camera: Camera, rows: np.ndarray, columns: np.ndarray, is_shown: np.ndarray
    ) -> Picture:
        """March the sample pixels of the blocks that can show something: a picture of one pixel a block."""
        picture = self._picture(True, (camera.width, camera.height), SAMPLED)
        pixels = np.stack([rows, columns], axis=-1)
        frame.march(camera, pixels[is_shown], 1, picture)
        sampled = Picture(picture.rgba[rows, columns], picture.sums[rows, columns])
        sampled.rgba[~is_shown], sampled.sums[~is_shown] = (*self.scene.background, 0.0), 0.0
        return sampled

    def _is_predictable(self, drawn: Drawn, last: Drawn) -> bool:
        """Return whether a picture shows the same as the last at another time: while the clip stands still, pictures
        are whole."""
        is_recent = drawn.number - last.number <= LATEST
        return (
            is_recent
            and self._seconds_between(drawn, last) > 0
            and (drawn.code, drawn.quality) == (last.code, last.quality)
        )

    def _seconds_between(self, drawn: Drawn, last: Drawn) -> float:
        return abs(drawn.time - last.time) * self.scene.clip.duration_s

    # --- what pictures need

    def _sampler_kind(self, quality: Quality, is_moving: bool) -> type[FieldSampler]:
        has_grid = is_moving and quality.grid_termination > 0 and CornerGrid.serves(self.scene)
        return CornerGrid if has_grid else PlaneSampler

    def _sampler(self, kind: type[FieldSampler]) -> FieldSampler:
        """Return a sampler with the present planes."""
        if kind not in self._samplers:
            self._samplers[kind] = kind(self.scene, self._layout)
            self._stale.add(kind)
        if kind in self._stale:
            atlas = self._read_atlas()
            for stale in self._stale:
                self._samplers[stale].set_planes(atlas)
            self._stale.clear()
        return self._samplers[kind]

    def _free(self, slot: int, time: float | None = None, culling_alpha: float = 0.0) -> np.ndarray:
        """Return the distances to occupied cells of a slot; at a `time`, 1 in those that culling finds to be empty."""
        if slot not in self._distances:
            self._distances[slot] = empty_distances(self.scene.occupancy[slot])
        free = self._distances[slot]
        if time is None or not culling_alpha or not OccupancyCulling.serves(self.scene):
            return free
        key = slot, time, culling_alpha
        if self._culled is None or self._culled[0] != key:
            if self._culling is None:
                sampler = self._sampler(PlaneSampler)
                assert isinstance(sampler, PlaneSampler)
                self._culling = OccupancyCulling(self.scene, sampler)
            self._culled = key, free | self._culling.empty(slot, culling_alpha)
        return self._culled[1]

    def _masked_blocks(self, slot: int, camera: Camera) -> np.ndarray | None:
        """Return which blocks an occupied cell of a slot may project to, (rows, columns) bool; None where they are
        most."""
        if self.scene.mapping is not None:
            return None
        if slot not in self._masks:
            self._masks[slot] = ScreenMask.of(self.scene.occupancy[slot], self.scene.aabb)
        key = (
            slot,
            camera.width,
            camera.height,
            camera.fl_x,
            camera.fl_y,
            camera.cx,
            camera.cy,
            camera.camera_to_world.tobytes(),
        )
        if self._masked is None or self._masked[0] != key:
            blocks = self._masks[slot].blocks(camera, BLOCK)
            self._masked = key, None if blocks is None or blocks.mean() > MOST_MASKED else blocks
        return self._masked[1]

    def _content(self, slot: int, camera: Camera) -> Rectangle:
        """Return the rectangle outside which a picture shows the background: that of its mask, and as far as
        interpolation reaches."""
        blocks = self._masked_blocks(slot, camera)
        if blocks is None:
            return 0, 0, camera.width, camera.height
        if not blocks.any():
            return 0, 0, 0, 0
        rows, columns = np.flatnonzero(blocks.any(1)), np.flatnonzero(blocks.any(0))
        left, bottom = (max(BLOCK * (int(first) - 1), 0) for first in (columns[0], rows[0]))
        right, top = min(BLOCK * (int(columns[-1]) + 2), camera.width), min(BLOCK * (int(rows[-1]) + 2), camera.height)
        return left, bottom, right, top

    def _picture(self, is_moving: bool, size: tuple[int, int], role: int) -> Picture:
        """Return a picture in memory; the last used are kept."""
        key = is_moving, size, role
        picture = self._pictures.pop(key, None)
        self._pictures[key] = picture = Picture.empty(size) if picture is None else picture
        if len(self._pictures) > PICTURES_KEPT:
            dropped = next(iter(self._pictures))
            self._contents.pop(id(self._pictures.pop(dropped).rgba), None)
            self._drawn.pop(dropped[:2], None)
        return picture

    def _clear(self, picture: Picture, content: Rectangle) -> None:
        """Fill a picture with the background, where it is not, to be drawn within `content` then."""
        height, width = picture.rgba.shape[:2]
        left, bottom, right, top = union(self._contents.get(id(picture.rgba), (0, 0, width, height)), content)
        picture.rgba[bottom:top, left:right] = (*self.scene.background, 0.0)
        picture.sums[bottom:top, left:right] = 0.0
        self._contents[id(picture.rgba)] = content

    def _clear_blocks(self, picture: Picture, blocks: np.ndarray) -> None:
        for row, column in BLOCK * blocks:
            picture.rgba[row : row + BLOCK, column : column + BLOCK] = (*self.scene.background, 0.0)
            picture.sums[row : row + BLOCK, column : column + BLOCK] = 0.0


def _is_same_view(one: Camera, other: Camera) -> bool:
    lens_and_size = ("width", "height", "fl_x", "fl_y", "cx", "cy")
    is_same_lens = all(getattr(one, name) == getattr(other, name) for name in lens_and_size)
    return is_same_lens and np.array_equal(one.camera_to_world, other.camera_to_world)
