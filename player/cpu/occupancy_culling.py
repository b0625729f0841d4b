"""Which occupied cells are empty at one time.

A slot of the occupancy grid holds for a while, and all cells in which there is something meanwhile: where what is filmed moves, many
that are empty most of the time. Of `soldier`, eight slots for a hundred frames, 37 % are, and without them rays meet their surface
after 0.6 of the samples. A processor finds out for each picture, from densities at the corners of cells: that takes it 6 ms, and spares
it half of the 39 that marching 320 x 240 pixels took.
"""

import math
from dataclasses import dataclass

import numpy as np
from kpc.format.common.jit import compiled
from kpc.format.scene.grid import sample_linear
from kpc.format.scene.scene import LOG_DENSITY_LIMIT, SPACE_PLANES, Decoder, Scene
from kpc.format.scene.space import Contraction
from kpc.player.atlas import Layout, decoder_arrays
from kpc.player.cpu.threads import share_out

TEXELS_A_CELL = 2.0
"""Along an edge of a cell, of the finest scale: between corners farther apart there may be something that they do not see."""


@dataclass(frozen=True, eq=False)
class Corners:
    """Those of the occupied cells of a slot.

    Attributes:
        places: (M, 3) float32 in [0, 1]^3.
        number: (M,), which they are of a (Nz + 1, Ny + 1, Nx + 1) grid.
    """

    slot: int
    places: np.ndarray
    number: np.ndarray

    @staticmethod
    def of(slot: int, occupied: np.ndarray) -> "Corners":
        """Of a (Nz, Ny, Nx) bool grid."""
        at = np.zeros([side + 1 for side in occupied.shape], bool)
        for z, y, x in np.ndindex(2, 2, 2):
            at[z : z + len(occupied), y : y + occupied.shape[1], x : x + occupied.shape[2]] |= occupied
        places = np.argwhere(at)[:, ::-1] / np.array(occupied.shape[::-1])
        return Corners(slot, places.astype(np.float32), np.flatnonzero(at))


class OccupancyCulling:
    """The densities of a scene at the corners of its occupied cells, from its planes.

    Attributes:
        planes: (rows, columns, 4 layers) float32, of each of the layout's blocks.
    """

    def __init__(self, scene: Scene, layout: Layout) -> None:
        self._scene, self._layout = scene, layout
        self.planes: list[np.ndarray] = []
        self._folded: list[np.ndarray] = []
        self._log_density = np.zeros([side + 1 for side in scene.occupancy.shape[1:]], np.float32)
        weights = decoder_arrays(scene.decoder, scene, layout)["density_weight"]
        self._weights = [part.reshape(-1) for part in np.split(weights, layout.first_layers[1:])]
        self._corners: Corners | None = None

    @staticmethod
    def serves(scene: Scene) -> bool:
        """Not where it would not pay, one slot holding always, nor where corners tell too little of what is between them."""
        finest = scene.scales[-1]
        texels = np.array([*finest["xy"].shape[1::-1], finest["xz"].shape[0]]) - 1
        fine = bool((texels <= TEXELS_A_CELL * np.array(scene.occupancy.shape[:0:-1])).all())
        told = fine and isinstance(scene.decoder, Decoder) and not isinstance(scene.mapping, Contraction)
        return told and scene.is_dynamic and len(scene.occupancy) > 1

    @property
    def memory_bytes(self) -> int:
        return 2 * sum(plane.nbytes for plane in self.planes) + self._log_density.nbytes

    def keep(self, atlas: np.ndarray) -> None:
        """Take planes from an atlas, (height, width, 4), of the layout, from now on."""
        self.planes = [self._layout.plane(atlas, block) for block in self._layout.blocks]
        self._folded = [np.empty_like(plane) for plane in self.planes]

    def empty(self, slot: int, rows: np.ndarray, time: float, alpha: float) -> np.ndarray:
        """(Nz, Ny, Nx) bool: cells of a slot at whose corners a step of the scene has less than this alpha. `rows`: `Rows.at` the time."""
        occupied = self._scene.occupancy[slot]
        limit = math.log(-math.log1p(-alpha) * self._scene.extent / self._scene.step)
        if limit <= -LOG_DENSITY_LIMIT:  # no density is less
            return np.zeros_like(occupied)
        if self._corners is None or self._corners.slot != slot:
            self._corners = Corners.of(slot, occupied)
        corners = self._corners
        self._log_density.reshape(-1)[corners.number] = self.log_densities(corners.places, rows, time)
        # Of other corners it holds what once was there: no occupied cell has one.
        along_z = np.maximum(self._log_density[:-1], self._log_density[1:])
        along_y = np.maximum(along_z[:, :-1], along_z[:, 1:])
        empty: np.ndarray = np.maximum(along_y[..., :-1], along_y[..., 1:]) < limit
        return np.logical_and(empty, occupied, out=empty)

    def log_densities(self, places: np.ndarray, rows: np.ndarray, time: float) -> np.ndarray:
        """The log of the density at places (N, 3) in [0, 1]^3, float32: (N,)."""
        scene, layout = self._scene, self._layout
        places, out = places.copy(), np.full(len(places), scene.decoder.density_bias, np.float32)
        for block, plane, folded in zip(layout.blocks, self.planes, self._folded, strict=True):
            row = rows[layout.lines(block)].swapaxes(0, 1)[: plane.shape[0 if block.upright else 1]]
            row = row.reshape(len(row), -1)
            np.multiply(plane, row[:, None] if block.upright else row, out=folded)
        offsets = None if scene.motion is None else sample_linear(scene.motion, time)

        def add(part: slice) -> None:
            if offsets is not None:
                _displace(places[part], offsets)
            for scale, weights in enumerate(self._weights):
                _add_scale(
                    places[part],
                    *self._folded[len(SPACE_PLANES) * scale : len(SPACE_PLANES) * (scale + 1)],
                    weights,
                    out[part],
                )

        share_out(add, len(places))
        return out


@compiled()
def _displace(places, offsets):
    """`kpc.format.scene.motion.displace`, in place."""
    nz, ny, nx = offsets.shape[:3]
    one = np.float32(1)
    for n in range(len(places)):
        x, y, z = (
            places[n, 0] * np.float32(nx - 1),
            places[n, 1] * np.float32(ny - 1),
            places[n, 2] * np.float32(nz - 1),
        )
        i, j, k = min(int(x), max(nx - 2, 0)), min(int(y), max(ny - 2, 0)), min(int(z), max(nz - 2, 0))
        f, g, h = np.float32(x - i), np.float32(y - j), np.float32(z - k)
        for axis in range(3):
            offset = np.float32(0)
            for corner in range(8):
                right, up, back = corner & 1, corner >> 1 & 1, corner >> 2
                weight = (f if right else one - f) * (g if up else one - g) * (h if back else one - h)
                offset += weight * offsets[min(k + back, nz - 1), min(j + up, ny - 1), min(i + right, nx - 1), axis]
            places[n, axis] = min(max(places[n, axis] + offset, np.float32(0)), one)


@compiled(fastmath={"contract", "reassoc"})
def _add_scale(places, xy, xz, yz, weights, out):
    """Add to `out` what a scale, its planes (rows, columns, M), adds to log densities."""
    ny, nx, channels = xy.shape
    nz, one = xz.shape[0], np.float32(1)
    of_xy, of_xz, of_yz = xy.ravel(), xz.ravel(), yz.ravel()
    # Unsigned, so that no place counts from an array's end: that would keep the loop over channels from being one of vectors.
    along_x, along_y = np.uint64(channels if nx > 1 else 0), np.uint64(channels if ny > 1 else 0)
    up_y, up_z, up_z_of_y = (
        along_y * np.uint64(nx),
        np.uint64(channels * nx if nz > 1 else 0),
        np.uint64(channels * ny if nz > 1 else 0),
    )
    for n in range(len(places)):
        x, y, z = (
            places[n, 0] * np.float32(nx - 1),
            places[n, 1] * np.float32(ny - 1),
            places[n, 2] * np.float32(nz - 1),
        )
        i, j, k = min(int(x), max(nx - 2, 0)), min(int(y), max(ny - 2, 0)), min(int(z), max(nz - 2, 0))
        f, g, h = np.float32(x - i), np.float32(y - j), np.float32(z - k)
        a, b, c = (
            np.uint64(channels * (j * nx + i)),
            np.uint64(channels * (k * nx + i)),
            np.uint64(channels * (k * ny + j)),
        )
        a0, a1, a2, a3 = (one - f) * (one - g), f * (one - g), (one - f) * g, f * g
        b0, b1, b2, b3 = (one - f) * (one - h), f * (one - h), (one - f) * h, f * h
        c0, c1, c2, c3 = (one - g) * (one - h), g * (one - h), (one - g) * h, g * h
        log_density = np.float32(0)
        for m in range(np.uint64(channels)):
            in_xy = (
                a0 * of_xy[a + m]
                + a1 * of_xy[a + m + along_x]
                + a2 * of_xy[a + m + up_y]
                + a3 * of_xy[a + m + along_x + up_y]
            )
            in_xz = (
                b0 * of_xz[b + m]
                + b1 * of_xz[b + m + along_x]
                + b2 * of_xz[b + m + up_z]
                + b3 * of_xz[b + m + along_x + up_z]
            )
            in_yz = (
                c0 * of_yz[c + m]
                + c1 * of_yz[c + m + along_y]
                + c2 * of_yz[c + m + up_z_of_y]
                + c3 * of_yz[c + m + along_y + up_z_of_y]
            )
            log_density += in_xy * in_xz * in_yz * weights[m]
        out[n] += log_density
