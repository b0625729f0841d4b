"""Which occupied cells are empty at one time.

A slot of the occupancy grid holds for a while, and marks every cell in which there is something meanwhile; where the
subject moves, many of them are empty most of the time. The processor's renderer finds out for each picture from the
densities at the corners of cells, and rays skip
the cells that are empty. Figures: docs/design/drawing.md.
"""

import math
from dataclasses import dataclass

import numpy as np

from kpc.format.scene.scene import LOG_DENSITY_LIMIT, Decoder, Scene
from kpc.format.scene.space import Contraction
from kpc.player.cpu.plane_sampler import PlaneSampler
from kpc.player.cpu.threads import share_out

# Texels of the finest scale along an edge of a cell, at most: between corners farther apart there may be something that
# they do not show.
TEXELS_PER_CELL = 2.0


@dataclass(frozen=True, eq=False)
class CellCorners:
    """The corners of the occupied cells of a slot.

    Attributes:
        slot: number of the slot.
        positions: (M, 3) float32 in [0, 1]^3.
        indices: (M,), flat, in a (Nz + 1, Ny + 1, Nx + 1) grid.
    """

    slot: int
    positions: np.ndarray
    indices: np.ndarray

    @staticmethod
    def of(slot: int, occupied: np.ndarray) -> "CellCorners":
        """Find the corners of a (Nz, Ny, Nx) bool grid."""
        corners = np.zeros([side + 1 for side in occupied.shape], bool)
        for z, y, x in np.ndindex(2, 2, 2):
            corners[z : z + len(occupied), y : y + occupied.shape[1], x : x + occupied.shape[2]] |= occupied
        positions = np.argwhere(corners)[:, ::-1] / np.array(occupied.shape[::-1])
        return CellCorners(slot, positions.astype(np.float32), np.flatnonzero(corners))


class OccupancyCulling:
    """The densities of a scene at the corners of its occupied cells.

    Args:
        scene: the scene.
        sampler: its planes, which are asked for densities.
    """

    def __init__(self, scene: Scene, sampler: PlaneSampler) -> None:
        self._scene, self._sampler = scene, sampler
        self._log_density = np.zeros([side + 1 for side in scene.occupancy.shape[1:]], np.float32)
        self._corners: CellCorners | None = None

    @staticmethod
    def serves(scene: Scene) -> bool:
        """Return whether culling pays, several slots taking turns, and whether cells are small enough for their corners
        to tell."""
        finest = scene.scales[-1]
        texels = np.array([*finest["xy"].shape[1::-1], finest["xz"].shape[0]]) - 1
        is_fine = bool((texels <= TEXELS_PER_CELL * np.array(scene.occupancy.shape[:0:-1])).all())
        has_densities = isinstance(scene.decoder, Decoder) and not isinstance(scene.mapping, Contraction)
        return is_fine and has_densities and scene.is_dynamic and len(scene.occupancy) > 1

    @property
    def memory_bytes(self) -> int:
        return self._log_density.nbytes

    def empty(self, slot: int, alpha: float) -> np.ndarray:
        """Find the cells of a slot at all of whose corners a step of the scene has less than this alpha, at the time
        the sampler is prepared for.

        Returns:
            (Nz, Ny, Nx) bool.
        """
        occupied = self._scene.occupancy[slot]
        limit = math.log(-math.log1p(-alpha) * self._scene.extent / self._scene.step)
        if limit <= -LOG_DENSITY_LIMIT:  # no density is less
            return np.zeros_like(occupied)
        if self._corners is None or self._corners.slot != slot:
            self._corners = CellCorners.of(slot, occupied)
        positions, densities = self._corners.positions, np.empty(len(self._corners.positions), np.float32)
        share_out(lambda part: self._sampler.log_densities(positions[part], densities[part]), len(positions))
        # Other corners hold stale values, but no occupied cell has one of them.
        self._log_density.reshape(-1)[self._corners.indices] = densities
        along_z = np.maximum(self._log_density[:-1], self._log_density[1:])
        along_y = np.maximum(along_z[:, :-1], along_z[:, 1:])
        empty: np.ndarray = np.maximum(along_y[..., :-1], along_y[..., 1:]) < limit
        return np.logical_and(empty, occupied, out=empty)
