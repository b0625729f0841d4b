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
from typing import Any

import numpy as np
from kpc.format.scene.grid import sample_linear, texel_and_fraction
from kpc.format.scene.scene import SPACE_PLANES, TIME_PLANES, Decoder, Scene
from kpc.player.atlas import Layout, pad_to_multiple
from kpc.player.cpu.cpu_renderer import Marching, in_steps
from kpc.player.cpu.simd import LARGEST, WIDE
from kpc.player.cpu.threads import WORKERS

MOST_CORNERS = 1 << 22
"""Of a grid, 64 MB. With soldier's planes twice as fine, 3,900,000 corners, a picture of 320x240 takes 0.4 of the time that it takes by planes, one
of 640x480 0.3; three times as fine, half and a third."""
LEAST_LOOKED_UP = 24
"""Texels that a sample takes of planes, where a grid pays. The default scene, its colours made the same from all sides, takes 12, and what rests can
follow the picture before: baked, a picture of 320x240 took 1.15 of the time, one of 640x480 1.7, and both were 3 to 4 dB farther from exact ones."""


class CornerGrid(Marching):
    """The grid of a scene at a time, as far as samples have looked at it.

    Attributes:
        grid: (Nz, Ny, Nx, 4) float32, corner-aligned over [0, 1]^3: logits of red, green and blue, log density. Anything finite where no
            sample has looked.
    """

    def __init__(self, scene: Scene, layout: Layout) -> None:
        super().__init__(scene)
        self._layout = layout
        self.grid = np.zeros((*corners_of(scene), 4), np.float32)
        self._known = np.zeros((WORKERS, *self.grid.shape[:3]), np.uint8)
        """Corners that hold what they are to, as far as each worker knows."""
        self._channels = [scale["xy"].shape[2] for scale in scene.scales]
        self._planes: tuple[np.ndarray, ...] = ()
        self._cut: dict[tuple[str, int, int], np.ndarray] = {}
        """Rows of time planes at corners, by plane, scale and number."""
        self._places = {axis: np.linspace(0, 1, count, dtype=np.float32) for axis, count in zip("zyx", self.grid.shape)}
        weights = np.concatenate([scene.decoder.b2, scene.decoder.density_weight[None]])
        self._weights = self._weights_in_steps = pad_to_multiple(weights.astype(np.float32), 1, WIDE)
        self._rows: tuple[np.ndarray, ...] = ()

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

    def keep(self, atlas: np.ndarray) -> None:
        """As whole numbers: each channel of each plane in steps of its own, by the product of which the weights are the larger."""
        planes: dict[str, list[np.ndarray]] = {name: [] for name in SPACE_PLANES}
        for block in self._layout.blocks:
            plane = self._layout.plane(atlas, block)[..., : self._channels[block.scale]]
            across = self._at_corners(plane.swapaxes(0, 1), block.plane[0])
            planes[block.plane].append(self._at_corners(across.swapaxes(0, 1), block.plane[1]))
        weights, taken = self._weights.astype(np.float64), []
        for parts in planes.values():
            plane = pad_to_multiple(np.concatenate(parts, axis=2), 2, WIDE)
            whole, step = in_steps(plane.reshape(-1, plane.shape[2]))
            taken.append(whole)
            weights = weights * step
        self._planes = tuple(taken)
        self._weights_in_steps = np.clip(weights, -LARGEST, LARGEST).astype(np.float32)
        self.forget()

    def forget(self) -> None:
        super().forget()
        self._cut = {}

    def _prepare(self, time: float | None) -> None:
        assert time is not None
        self._rows = self._rows_at(time)
        self._known[:] = 0

    def _looked_at(self, worker: int) -> tuple[Any, Any]:
        bias, corners = np.float32(self._scene.decoder.density_bias), self.grid.shape[2::-1]
        return (
            self._planes,
            self._rows,
            self._weights_in_steps,
            bias,
            self.grid.reshape(-1, 4),
            self._known[worker].reshape(-1),
            corners,
        ), None

    @staticmethod
    def rehearsed(scene: Scene) -> tuple[Any, Any]:
        planes, rows = (
            (np.zeros((1, WIDE), np.int16),) * len(SPACE_PLANES),
            (np.zeros((1, WIDE), np.float32),) * len(TIME_PLANES),
        )
        weights, grid, known = np.zeros((4, WIDE), np.float32), np.zeros((1, 4), np.float32), np.zeros(1, np.uint8)
        return (planes, rows, weights, np.float32(0), grid, known, (1, 1, 1)), None

    def _rows_at(self, time: float) -> tuple[np.ndarray, ...]:
        """(N, M) of the rows of all scales at a time, at corners, along x, y and z. What is made of the rows before and after stays until there
        are others."""
        scales, kept, rows = self._scene.scales, self._cut, []
        self._cut = {}
        taps = {
            count: texel_and_fraction(np.float32(time), count)
            for count in {len(scale[TIME_PLANES[0]]) for scale in scales}
        }
        for name in TIME_PLANES:
            row = np.zeros((len(self._places[name[0]]), self._weights.shape[1]), np.float32)
            first = 0
            for number, (scale, channels) in enumerate(zip(scales, self._channels, strict=True)):
                plane = scale[name]  # of a scene that still arrives, no more of which may be there than single rows
                before, share = taps[len(plane)]
                for instant, weight in ((int(before), 1 - share), (min(int(before) + 1, len(plane) - 1), share)):
                    key = name, number, instant
                    self._cut[key] = (
                        kept[key] if key in kept else self._at_corners(np.asarray(plane[instant], np.float32), name[0])
                    )
                    row[:, first : first + channels] += weight * self._cut[key]
                first += channels
            rows.append(row)
        return tuple(rows)

    def _at_corners(self, row: np.ndarray, axis: str) -> np.ndarray:
        """A (size, ...) array that is corner-aligned along x, y or z, as fine as the grid is there."""
        places = self._places[axis]
        return row if len(row) == len(places) else sample_linear(row, places)


def corners_of(scene: Scene) -> tuple[int, int, int]:
    """(Nz, Ny, Nx) of the grid: those of the finest scale's texels."""
    return tuple(
        max(scale[plane].shape[axis] for scale in scene.scales) for plane, axis in (("xz", 0), ("xy", 0), ("xy", 1))
    )
