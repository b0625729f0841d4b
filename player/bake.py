"""A scene of few texels at one time as one grid: what its planes come to at the corners of the finest scale's texels.

Where colours are the same from all sides, such a grid holds all there is, the logits of the colour and the log of the density, and a sample takes
one look-up in it, in place of one in each plane for every four channels: of `soldier` 36. At corners it is exact, and folding errs nowhere. In
between it is of the first degree, where products of three planes are of the second: pictures of soldier are 45 dB (`fast`, 80 texels high) and
50 (`balanced`, 128) from exact ones, where folded planes come to 62 and 67. The grid must have its corners where texels do: one of four fifths as
many along each axis comes to 37 dB.

A processor looks that up while it draws, and bakes as many of 490,000 corners as are looked at, three fifths, in 3.5 ms: soldier, `balanced`, takes
it 0.6 of the time that it takes by planes.
"""

import math

import numpy as np

from kpc.format.grid import linear, tap
from kpc.format.rans import compiled, inlined
from kpc.format.scene import SPACE_PLANES, TIME_PLANES, Decoder, Scene
from kpc.player.cores import share_out
from kpc.player.textures import Layout, filled
from kpc.player.thin import Corners, displace

MOST_CORNERS = 1 << 20
"""Of a grid, 16 MB."""
LEAST_LOOKED_UP = 24
"""Texels that a sample takes of planes, where a grid pays. The default scene, its colours made the same from all sides, takes 12, and has
2,600,000 corners: baked, a picture of 320x240 took 1.2 of the time, one of 640x480 0.8, and both were 3 to 4 dB farther from exact ones."""
VECTOR = 16
"""Channels come in multiples of so many: as many floats as the widest processors multiply at once."""
SPANS_KEPT = 64
"""Tables of what is looked at, of slots and rows of the motion grid: more than a clip has that plays as a loop of some seconds."""
SPAN = np.dtype(np.int16)
"""Of numbers of rows and corners, which axes have no more than AXIS_LIMIT of."""
LARGEST = np.float32(1e30)
"""What values are cut off at: a density is clamped far before, a colour is 0 or 1."""


class Baking:
    """The grid of a scene, baked anew for each picture, as far as samples look at it.

    Attributes:
        grid: (Nz, Ny, Nx, 4) float32, corner-aligned over [0, 1]^3: logits of red, green and blue, log density. Anything finite where no
            sample looks.
    """

    def __init__(self, scene: Scene, layout: Layout) -> None:
        self._scene, self._layout = scene, layout
        self.grid = np.zeros((*corners_of(scene), 4), np.float32)
        self._channels = [scale["xy"].shape[2] for scale in scene.scales]
        self._atlas = np.empty(0)
        self._planes: dict[str, np.ndarray] = {}
        self._spans: dict[tuple[int, int], np.ndarray] = {}
        self._corners: tuple[Corners, np.ndarray] | None = None
        """Of the last slot, and which of them each cell has, (N, 8)."""
        weights = np.concatenate([scene.decoder.b2, scene.decoder.density_weight[None]])
        self._weights = filled(weights.astype(np.float32), 1, VECTOR)

    @staticmethod
    def serves(scene: Scene) -> bool:
        """Where something moves, colours have no sides, corners are few, and channels many."""
        one_sided = isinstance(scene.decoder, Decoder) and not scene.decoder.w2.any()
        small = math.prod(corners_of(scene)) <= MOST_CORNERS
        looked_up = len(SPACE_PLANES) * sum(-(-scale["xy"].shape[2] // 4) for scale in scene.scales)
        return one_sided and scene.is_dynamic and small and looked_up >= LEAST_LOOKED_UP

    @staticmethod
    def bytes_for(scene: Scene) -> int:
        """What grid and texture, planes and tables take, at most."""
        nz, ny, nx = corners_of(scene)
        channels = sum(scale["xy"].shape[2] for scale in scene.scales)
        channels += -channels % VECTOR
        return 2 * 16 * nz * ny * nx + 4 * channels * (ny * nx + nz * nx + nz * ny) + SPANS_KEPT * 4 * SPAN.itemsize * nz * ny

    @property
    def memory_bytes(self) -> int:
        return self.bytes_for(self._scene)

    def keep(self, refined: np.ndarray) -> None:
        """Take planes from an atlas, (height, width, 4), of the layout, from now on, and as they are when next needed."""
        self._atlas, self._planes = refined, {}

    def bake(self, slot: int, time: float) -> None:
        """Fill the grid as far as samples in occupied cells of a slot look at it, as of a time in it."""
        if not self._planes:
            self._planes = self._planes_at_corners()
        spans = self._spans_at(slot, time)
        along_x, along_y, along_z = (self._rows(name, time) for name in TIME_PLANES)
        bias = np.float32(self._scene.decoder.density_bias)
        xz, yz = self._planes["xz"], self._planes["yz"]
        with np.errstate(over="ignore", invalid="ignore"):  # bounded below
            xy = self._planes["xy"] * along_x

        def fill(part: slice) -> None:
            _fill(spans[part], xy, xz, yz, along_y, along_z, self._weights, bias, self.grid)

        share_out(fill, len(spans))

    def _planes_at_corners(self) -> dict[str, np.ndarray]:
        planes: dict[str, list[np.ndarray]] = {name: [] for name in SPACE_PLANES}
        for block in self._layout.blocks:
            plane = self._layout.unrefined(self._atlas, block)[..., : self._channels[block.scale]]
            planes[block.plane].append(self._at_corners(self._at_corners(plane, 0, block.plane[1]), 1, block.plane[0]))
        return {name: np.ascontiguousarray(filled(np.concatenate(parts, axis=2), 2, VECTOR)) for name, parts in planes.items()}

    def _rows(self, name: str, time: float) -> np.ndarray:
        """(N, M) of the rows of all scales at a time, at corners. Of a scene that still arrives no more of a time plane is there."""
        rows = [self._at_corners(linear(scale[name], time), 0, name[0]) for scale in self._scene.scales]
        return np.concatenate([*rows, np.zeros((len(rows[0]), self._weights.shape[1] - sum(self._channels)), np.float32)], axis=1)

    def _spans_at(self, slot: int, time: float) -> np.ndarray:
        """Of the corners that are looked at in a slot, between the rows of the motion grid that a time lies between."""
        row = 0 if self._scene.motion is None else int(tap(np.asarray(time, np.float32), len(self._scene.motion))[0])
        spans = self._spans.pop((slot, row), None)
        if spans is None:
            spans = _spans(self._reached(slot, row))
        self._spans[slot, row] = spans
        if len(self._spans) > SPANS_KEPT:
            del self._spans[next(iter(self._spans))]
        return spans

    def _reached(self, slot: int, row: int) -> np.ndarray:
        """(Nz, Ny, Nx) bool: corners of the grid that samples in occupied cells of a slot look at, between a row of the motion grid and the
        next. There places move evenly in time, and between its nodes in space, where cells are cut: so the corners of the parts bound what
        they reach."""
        motion = self._scene.motion
        reached = np.zeros(self.grid.shape[:3], bool)
        if self._corners is None or self._corners[0].slot != slot:
            self._corners = self._cut_corners(slot)
        corners, of_cells = self._corners
        texels = np.array(reached.shape[::-1], np.float32) - 1

        def places_at(row: int) -> np.ndarray:
            places = corners.places.copy()
            if motion is not None:
                share_out(lambda part: displace(places[part], motion[row]), len(places))
            return np.multiply(places, texels, out=places)

        one = places_at(row)
        other = one if motion is None or row + 1 == len(motion) else places_at(row + 1)
        share_out(lambda part: _reach(of_cells[part], one, other, reached), len(of_cells))
        return reached

    def _cut_corners(self, slot: int) -> tuple[Corners, np.ndarray]:
        """Of the occupied cells of a slot, cut where nodes of the motion grid lie; and which of them each cell has, (N, 8)."""
        occupied, motion = self._scene.occupancy[slot], self._scene.motion
        lines = []
        for axis, side in enumerate(occupied.shape):
            faces = np.arange(side + 1) / side
            lines.append(faces if motion is None else np.union1d(faces, np.linspace(0, 1, motion.shape[1 + axis])))
            cell = np.searchsorted(faces, (lines[-1][1:] + lines[-1][:-1]) / 2) - 1
            occupied = occupied.take(cell, axis)
        corners, (nz, ny, nx) = Corners.of(slot, occupied, lines[::-1]), occupied.shape
        which = np.zeros((nz + 1, ny + 1, nx + 1), np.int32)
        which.reshape(-1)[corners.number] = np.arange(len(corners.number))
        around = [which[z : z + nz, y : y + ny, x : x + nx][occupied] for z, y, x in np.ndindex(2, 2, 2)]
        return corners, np.stack(around, axis=1)

    def _at_corners(self, array: np.ndarray, axis: int, along: str) -> np.ndarray:
        """An array that is corner-aligned along one of its axes, there as fine as the grid is along x, y or z."""
        count = self.grid.shape["zyx".index(along)]
        if array.shape[axis] == count:
            return array
        at = np.linspace(0, 1, count, dtype=np.float32) if count > 1 else np.zeros(1, np.float32)
        return np.moveaxis(linear(np.moveaxis(array, axis, 0), at), 0, axis)


def corners_of(scene: Scene) -> tuple[int, int, int]:
    """(Nz, Ny, Nx) of the grid: those of the finest scale's texels."""
    return tuple(max(scale[plane].shape[axis] for scale in scene.scales) for plane, axis in (("xz", 0), ("xy", 0), ("xy", 1)))


@inlined
def _bounded(value):
    """Finite, whatever it was."""
    return min(max(value, -LARGEST), LARGEST) if value == value else np.float32(0)


def _spans(reached: np.ndarray) -> np.ndarray:
    """(N, 4) of z, y, the first x and the one behind the last, of each row along x in which anything is set."""
    z, y = np.nonzero(reached.any(2))
    rows = reached[z, y]
    return np.stack([z, y, rows.argmax(1), rows.shape[1] - rows[:, ::-1].argmax(1)], axis=1).astype(SPAN)


@compiled()
def _reach(cells, one, other, reached):
    """Set what cells look at whose eight corners, (N, 8), are at these places, (M, 3) in texels, or at the others, or in between."""
    low, high = np.empty(3, np.int64), np.empty(3, np.int64)
    for n in range(len(cells)):
        for axis in range(3):
            least, most = one[cells[n, 0], axis], one[cells[n, 0], axis]
            for corner in cells[n]:
                least = min(least, one[corner, axis], other[corner, axis])
                most = max(most, one[corner, axis], other[corner, axis])
            low[axis], high[axis] = int(least), int(most) + 2
        reached[low[2] : high[2], low[1] : high[1], low[0] : high[0]] = True


@compiled(fastmath={"contract", "reassoc"})
def _fill(spans, xy, xz, yz, along_y, along_z, weights, bias, grid):
    """The corners of some spans. Planes (rows, columns, M), `xy` times its row; the others' rows apart, (N, M); `weights` (4, M)."""
    ny, nx, channels = xy.shape
    of_xy, of_xz, here = xy.ravel(), xz.ravel(), np.empty(4 * channels, np.float32)
    # Unsigned, so that no place counts from an array's end: that would keep the loop over channels from being one of vectors.
    count = np.uint64(channels)
    green_at, blue_at, density_at = count, np.uint64(2) * count, np.uint64(3) * count
    for n in range(len(spans)):
        z, y, first, end = spans[n]
        for of in range(4):
            for m in range(channels):
                here[of * channels + m] = yz[z, y, m] * along_y[y, m] * along_z[z, m] * weights[of, m]
        for x in range(first, end):
            at_xy, at_xz = np.uint64(channels * (y * nx + x)), np.uint64(channels * (z * nx + x))
            red, green, blue, log_density = np.float32(0), np.float32(0), np.float32(0), np.float32(0)
            for m in range(count):
                feature = of_xy[at_xy + m] * of_xz[at_xz + m]
                red += feature * here[m]
                green += feature * here[green_at + m]
                blue += feature * here[blue_at + m]
                log_density += feature * here[density_at + m]
            corner = grid[z, y, x]
            corner[0], corner[1], corner[2], corner[3] = _bounded(red), _bounded(green), _bounded(blue), _bounded(log_density + bias)
