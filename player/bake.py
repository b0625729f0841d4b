"""Scenes of many channels whose colours are the same from all sides, drawn by a processor itself.

Where colours have no sides, a grid of what planes come to at the corners of the finest scale's texels holds all there is, the logits of the colour
and the log of the density, and a sample takes one look-up in it, in place of one in each plane for every four channels: of `soldier` 36. At
corners it is exact, and folding errs nowhere. In between it is of the first degree, where products of three planes are of the second: pictures of
soldier are 49 dB (`fast`, 80 texels high) and 53 (`balanced`, 128) from exact ones, where folded planes come to 62 and 67. The grid must have its
corners where texels do: one of four fifths as many along each axis comes to 37 dB.

`cast` bakes a corner when a sample first looks at it, and marches. Soldier, `balanced`, takes it 0.3 of the time that planes take at 320x240, and half at
640x480. A shader that looked up a grid which was baked before it, as far as samples of the time's slot might look, took twice as long.
"""

import math

import numpy as np

from kpc.format.cameras import Camera
from kpc.format.grid import linear, tap
from kpc.format.scene import SPACE_PLANES, TIME_PLANES, Decoder, Scene
from kpc.player.cast import cast
from kpc.player.cores import WORKERS, from_both_ends
from kpc.player.textures import Layout, filled
from kpc.player.vectors import LARGEST, WIDE

MOST_CORNERS = 1 << 22
"""Of a grid, 64 MB. With soldier's planes twice as fine, 3,900,000 corners, a picture of 320x240 takes 0.4 of the time that it takes by planes, one
of 640x480 0.3; three times as fine, half and a third."""
LEAST_LOOKED_UP = 24
"""Texels that a sample takes of planes, where a grid pays. The default scene, its colours made the same from all sides, takes 12, and what rests can
follow the picture before: baked, a picture of 320x240 took 1.15 of the time, one of 640x480 1.7, and both were 3 to 4 dB farther from exact ones."""
MOST_STEPS = 32767
"""Of a plane's channel, from 0: half the bytes of float32, which a processor's caches hold the more of, and 1e-4 off in a picture's colours."""
BLOCKS_AT_ONCE = 16
"""That a core takes, at least."""


class Baking:
    """The grid of a scene at a time, as far as samples have looked at it.

    Attributes:
        grid: (Nz, Ny, Nx, 4) float32, corner-aligned over [0, 1]^3: logits of red, green and blue, log density. Anything finite where no
            sample has looked.
    """

    def __init__(self, scene: Scene, layout: Layout) -> None:
        self._scene, self._layout = scene, layout
        self.grid = np.zeros((*corners_of(scene), 4), np.float32)
        self._known = np.zeros((WORKERS, *self.grid.shape[:3]), np.uint8)
        """Corners that hold what they are to, as far as each worker knows."""
        self._channels = [scale["xy"].shape[2] for scale in scene.scales]
        self._atlas = np.empty(0)
        self._planes: tuple[np.ndarray, ...] = ()
        self._time: float | None = None
        self._cut: dict[tuple[str, int, int], np.ndarray] = {}
        """Rows of time planes at corners, by plane, scale and number."""
        self._places = {axis: np.linspace(0, 1, count, dtype=np.float32) for axis, count in zip("zyx", self.grid.shape)}
        weights = np.concatenate([scene.decoder.b2, scene.decoder.density_weight[None]])
        self._weights = self._weights_in_steps = filled(weights.astype(np.float32), 1, WIDE)
        self._rows: tuple[np.ndarray, ...] = ()
        self._motion = np.zeros((0, 0, 0, 4) if scene.motion is None else (*scene.motion.shape[1:4], 4), np.float32)
        self._room, self._nothing = np.empty((6, 0), np.float32), np.empty(0, np.float32)
        """For as many pixels as a picture has had yet: what is seen and met; what is seen of rays that meet nothing."""

    @staticmethod
    def serves(scene: Scene) -> bool:
        """Where something moves in a box, colours have no sides, corners are not too many, and channels are many."""
        one_sided = isinstance(scene.decoder, Decoder) and not scene.decoder.w2.any()
        small = math.prod(corners_of(scene)) <= MOST_CORNERS
        looked_up = len(SPACE_PLANES) * sum(-(-scale["xy"].shape[2] // 4) for scale in scene.scales)
        return one_sided and scene.mapping is None and scene.is_dynamic and small and looked_up >= LEAST_LOOKED_UP

    @staticmethod
    def bytes_for(scene: Scene) -> int:
        """What grid and planes take."""
        nz, ny, nx = corners_of(scene)
        channels = sum(scale["xy"].shape[2] for scale in scene.scales)
        channels += -channels % WIDE
        return (16 + WORKERS) * nz * ny * nx + 2 * channels * (ny * nx + nz * nx + nz * ny)

    @property
    def memory_bytes(self) -> int:
        return self.bytes_for(self._scene)

    def keep(self, refined: np.ndarray) -> None:
        """Take planes from an atlas, (height, width, 4), of the layout, from now on, and as they are when next needed."""
        self._atlas, self._planes, self._time = refined, (), None

    def forget(self) -> None:
        """Rows of time planes are others now."""
        self._time, self._cut = None, {}

    def march(
        self, camera: Camera, time: float, free: np.ndarray, blocks: np.ndarray, side: int, step: float, termination: float
    ) -> tuple[np.ndarray, np.ndarray, tuple[int, int]]:
        """What march.glsl gives of some blocks of a picture, in the least rectangle that holds them; elsewhere what rays see that meet nothing.

        Args:
            time: in [0, 1].
            free: (Nz, Ny, Nx) uint8, `kpc.player.textures.distances` to what is occupied at the time.
            blocks: (N, 2) of row and column, rows from below, each of `side` x `side` pixels; at least one.
            step: world units.

        Returns: (h, w, 4) rgb and opacity, (h, w, 2) sum of weight t and samples, float32, row 0 at the bottom, valid until the next march; column
            and row of their first pixel.
        """
        self._go_to(time)
        scene, size = self._scene, (camera.width, camera.height)
        bottom, left = (int(first) for first in side * blocks.min(0))
        top, right = np.minimum(side * (blocks.max(0) + 1), size[::-1])
        seen, met = self._pictures(int(top) - bottom, int(right) - left)
        low, box = scene.aabb[0], scene.aabb[1] - scene.aabb[0]
        pose = camera.camera_to_world
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # a box without a volume, a camera at the end of the world: no ray meets a thing
            start = np.asarray((pose[:3, 3] - low) / box, np.float32)
        lens, axes, edges, background = (
            np.ascontiguousarray(array, np.float32)
            for array in ((camera.fl_x, camera.fl_y, camera.cx, camera.cy), pose[:3, :3], box, scene.background)
        )
        stride, tau, least, bias = map(np.float32, (step, step / scene.extent, termination, scene.decoder.density_bias))

        def work(worker: int, part: slice) -> None:
            cast(
                blocks[part], side, (left, bottom), size, lens, axes, start, edges, stride, tau, least, background,
                free.reshape(-1), free.shape[::-1], self._motion.reshape(-1, 4), self._motion.shape[2::-1],
                self._planes, self._rows, self._weights_in_steps, bias,
                self.grid.reshape(-1, 4), self._known[worker].reshape(-1), self.grid.shape[2::-1], seen, met,
            )  # fmt: skip

        from_both_ends(work, len(blocks), BLOCKS_AT_ONCE)
        return seen, met, (left, bottom)

    def _pictures(self, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
        """What `march` returns, as rays see it that meet nothing."""
        pixels = height * width
        if self._room.shape[1] < pixels:
            self._room = np.empty((6, pixels), np.float32)
            self._nothing = np.tile(np.append(self._scene.background, 0).astype(np.float32), pixels)
        seen, met = np.split(self._room.reshape(-1)[: 6 * pixels], [4 * pixels])
        seen[:], met[:] = self._nothing[: seen.size], 0.0
        return seen.reshape(height, width, 4), met.reshape(height, width, 2)

    def _go_to(self, time: float) -> None:
        if not self._planes:
            self._take_planes()
        if time != self._time:
            self._rows = self._rows_at(time)
            if self._scene.motion is not None:
                self._motion[..., :3] = linear(self._scene.motion, time)
            self._known[:] = 0
            self._time = time

    def _take_planes(self) -> None:
        """As whole numbers: each channel of each plane in steps of its own, by the product of which the weights are the larger."""
        planes: dict[str, list[np.ndarray]] = {name: [] for name in SPACE_PLANES}
        for block in self._layout.blocks:
            plane = self._layout.unrefined(self._atlas, block)[..., : self._channels[block.scale]]
            across = self._at_corners(plane.swapaxes(0, 1), block.plane[0])
            planes[block.plane].append(self._at_corners(across.swapaxes(0, 1), block.plane[1]))
        weights, taken = self._weights.astype(np.float64), []
        for parts in planes.values():
            plane = filled(np.concatenate(parts, axis=2), 2, WIDE)
            plane = plane.reshape(-1, plane.shape[2])
            step = np.abs(plane).max(0) / np.float32(MOST_STEPS)
            taken.append(np.rint(np.divide(plane, step, out=np.zeros_like(plane), where=step > 0)).astype(np.int16))
            weights = weights * step
        self._planes = tuple(taken)
        self._weights_in_steps = np.clip(weights, -LARGEST, LARGEST).astype(np.float32)

    def _rows_at(self, time: float) -> tuple[np.ndarray, ...]:
        """(N, M) of the rows of all scales at a time, at corners, along x, y and z. What is made of the rows before and after stays until there
        are others."""
        scales, kept, rows = self._scene.scales, self._cut, []
        self._cut = {}
        taps = {count: tap(np.float32(time), count) for count in {len(scale[TIME_PLANES[0]]) for scale in scales}}
        for name in TIME_PLANES:
            row = np.zeros((len(self._places[name[0]]), self._weights.shape[1]), np.float32)
            first = 0
            for number, (scale, channels) in enumerate(zip(scales, self._channels, strict=True)):
                plane = scale[name]  # of a scene that still arrives, no more of which may be there than single rows
                before, share = taps[len(plane)]
                for instant, weight in ((int(before), 1 - share), (min(int(before) + 1, len(plane) - 1), share)):
                    key = name, number, instant
                    self._cut[key] = kept[key] if key in kept else self._at_corners(np.asarray(plane[instant], np.float32), name[0])
                    row[:, first : first + channels] += weight * self._cut[key]
                first += channels
            rows.append(row)
        return tuple(rows)

    def _at_corners(self, row: np.ndarray, axis: str) -> np.ndarray:
        """A (size, ...) array that is corner-aligned along x, y or z, as fine as the grid is there."""
        places = self._places[axis]
        return row if len(row) == len(places) else linear(row, places)


def rehearse() -> None:
    """Have `cast` compiled, which takes five seconds, or loaded, before a picture waits for it: march no block of nothing."""
    whole, one, zero = (1, 1, 1), np.float32(1), np.zeros
    planes, rows = (zero((1, WIDE), np.int16),) * len(SPACE_PLANES), (zero((1, WIDE), np.float32),) * len(TIME_PLANES)
    three, four = zero(3, np.float32), zero((1, 4), np.float32)
    cast(
        zero((0, 2), np.int64), 1, (0, 0), (1, 1), four[0], zero((3, 3), np.float32), three, three, one, one, one, three,
        zero(1, np.uint8), whole, four, whole, planes, rows, zero((4, WIDE), np.float32), one,
        four, zero(1, np.uint8), whole, zero((1, 1, 4), np.float32), zero((1, 1, 2), np.float32),
    )  # fmt: skip


def corners_of(scene: Scene) -> tuple[int, int, int]:
    """(Nz, Ny, Nx) of the grid: those of the finest scale's texels."""
    return tuple(max(scale[plane].shape[axis] for scale in scene.scales) for plane, axis in (("xz", 0), ("xy", 0), ("xy", 1)))
