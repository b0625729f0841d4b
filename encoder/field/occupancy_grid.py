"""The occupancy grid: the cells that are not empty. Rays take samples nowhere else."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from kpc.encoder.field.random_points import random_points
from kpc.format.scene.grid import SPACE_TIME_AXES, dilate

# Share of cells by which merging time slots may raise the mean occupancy.
MERGE_TOLERANCE = 0.1

# What `OccupancyGrid.marched` holds of cells in which rays take every STRIDE-th sample only, for as many steps.
STRIDED, STRIDE = 2, 4

# A function of (N, 3) float32 points in [0, 1]^3 and (N,) float32 times that returns (N,) log densities.
DensityAt = Callable[[np.ndarray, np.ndarray], np.ndarray]


def grid_shape(aabb: np.ndarray, cells_across: int) -> tuple[int, int, int]:
    """Return (Nz, Ny, Nx): `cells_across` along the longest edge, cells as nearly cubes as whole numbers allow."""
    edges = np.asarray(aabb[1] - aabb[0], np.float64)
    nx, ny, nz = (max(1, round(cells_across * e / edges.max())) for e in edges)
    return nz, ny, nx


def merge_slots(occupancy: np.ndarray, more: float = MERGE_TOLERANCE) -> np.ndarray:
    """Return a grid (slots, Nz, Ny, Nx) bool in the fewest equal slots that raise the mean occupancy by at most `more`.

    A merged slot is the union of those that it replaces. Where little moves, slots differ by the randomness of sampling
    alone (measured: docs/design/training.md).
    """
    slots, *cells = occupancy.shape
    counts = (count for count in range(1, slots + 1) if slots % count == 0)
    merged = (np.asarray(occupancy.reshape(count, slots // count, *cells).any(1)) for count in counts)
    return next(grid for grid in merged if grid.mean() <= (1 + more) * occupancy.mean())


class OccupancyGrid:
    """Where density is (Instant-NGP, arXiv:2201.05989, appendix E), reduced to where it contributes to rays.

    A cell is occupied while its density could absorb something, and it or a neighbour has recently contributed to the
    colour of a ray. The second condition empties what is hidden behind surfaces, where products of planes are
    arbitrary.

    Attributes:
        visible: (Nz, Ny, Nx) bool, cells that enough cameras see; no others are ever occupied.
        threshold: log density per longest box edge below which a cell is empty.
        log_density: (Nz, Ny, Nx) float32, decaying maximum of the samples in a cell.
        peak: (Nz, Ny, Nx) float32, decaying maximum of the weights of training rays in a cell.
        occupied: (Nz, Ny, Nx) bool.
        kept: (Nz, Ny, Nx) bool, cells that are occupied in any case; None for none.
        marched: (slots, Nz, Ny, Nx) uint8, 1 where rays of training take samples in each time slot, STRIDED where
            nothing but `kept` says that a cell is occupied; one slot until `split`.
    """

    # Subtracted from the log density at each update.
    DENSITY_DECAY = 0.05

    # Points and times at which an update samples a cell. With the slow decay they keep a cell that is filled for a
    # fifteenth of the clip from being emptied in between.
    SAMPLES = 3

    # Factor on the peak at each update.
    PEAK_DECAY = 0.85

    # A cell with a lower peak contributes less than half an 8-bit level to any ray.
    MIN_PEAK = 2e-3

    def __init__(self, visible: np.ndarray, threshold: float) -> None:
        """Create a grid in which all of `visible` (Nz, Ny, Nx) bool is occupied."""
        self.visible = visible
        self.threshold = threshold
        self.log_density = np.full(visible.shape, -np.inf, np.float32)
        self.peak = np.ones(visible.shape, np.float32)
        self._found = visible.copy()  # what is occupied without `kept`
        self.kept: np.ndarray | None = None
        self._dense = np.ones((1, *visible.shape), bool)
        self._is_sampled = False
        self._activate_all()

    @property
    def active(self) -> np.ndarray:
        """The occupied cells where rays take samples in each time slot, (slots, Nz, Ny, Nx) bool."""
        return self.marched > 0

    def restrict(self, cells: np.ndarray) -> None:
        """Let no cells be occupied but these, (Nz, Ny, Nx) bool."""
        self.visible = self.visible & cells
        self._found &= cells
        if self.kept is not None:
            self.kept = self.kept & cells
        self._activate()

    def update(self, density_at: DensityAt, peaks: np.ndarray, rng: np.random.Generator) -> None:
        """Update the occupied cells.

        The density is sampled at SAMPLES random points and times per cell: at first in all visible cells, then in
        occupied cells and a random sixteenth of the others.

        Args:
            peaks: (Nz, Ny, Nx), the largest weights since the last update.
        """
        np.maximum(self.peak * np.float32(self.PEAK_DECAY), peaks, out=self.peak)
        matters = dilate(self.peak > self.MIN_PEAK) & self.visible
        chosen = matters
        if self._is_sampled:
            chosen = matters & (self.occupied | (rng.random(self.visible.shape, dtype=np.float32) < 1 / 16))
        self._is_sampled = True
        self.log_density -= self.DENSITY_DECAY
        cells, known = np.flatnonzero(chosen), self.log_density.reshape(-1)
        known[cells] = np.maximum(known[cells], self._sample(density_at, cells, rng, self.SAMPLES, 0.0, 1.0))
        self._found = matters & (self.log_density > self._density_threshold())
        self._activate()

    def split(self, density_at: DensityAt, slots: int, rng: np.random.Generator) -> None:
        """Restrict active cells, in each of `slots` equal parts of the clip, to where density is close by.

        What moves fills at each instant a small part of the cells that it ever fills. Close by means in the same or a
        neighbouring slot and cell, so that displacements can go on changing until the next split; with so many
        neighbours one sample of each is enough.
        """
        self._dense = dilate(self.sample_slots(density_at, rng, slots, 1), SPACE_TIME_AXES)
        self._activate_all()

    def _activate_all(self) -> None:
        """Set `occupied` and `marched` of all cells."""
        # Of each cell what `marched` was set by: 1 if it was occupied, and STRIDED more if it was kept.
        self._codes = np.zeros(self.visible.size, np.uint8)
        self.marched = np.zeros(self._dense.shape, np.uint8)
        self._activate()

    def _activate(self) -> None:
        """Set `occupied`, and `marched` of the cells for which it changes: those that are occupied and hold density,
        and `kept`."""
        codes = self._found.astype(np.uint8).reshape(-1)
        if self.kept is not None:
            codes += np.uint8(STRIDED) * self.kept.reshape(-1)
        self.occupied = (codes > 0).reshape(self.visible.shape)
        cells = np.flatnonzero(codes != self._codes)
        self._codes, changed = codes, codes[cells]
        slots = len(self._dense)
        holds = self._dense.reshape(slots, -1)[:, cells] & (changed & 1).astype(bool)
        self.marched.reshape(slots, -1)[:, cells] = np.where(holds, np.uint8(1), changed & np.uint8(STRIDED))

    def state(self) -> dict[str, Any]:
        """Return what a checkpoint holds of this grid."""
        return {
            "log_density": torch.from_numpy(self.log_density),
            "peak": torch.from_numpy(self.peak),
            "occupied": torch.from_numpy(self._found),
            "dense": torch.from_numpy(self._dense),
            "known": self._is_sampled,
            "keeps": self.kept is not None,
        }

    def load(self, state: dict[str, Any]) -> None:
        """Take over what `state` returned; `kept` is given up if it was when the checkpoint was written."""
        if not state.get("keeps", False):
            self.kept = None
        names = ("log_density", "peak", "occupied", "dense")
        self.log_density, self.peak, self._found, self._dense = (state[name].cpu().numpy() for name in names)
        self._activate_all()
        self._is_sampled = bool(state["known"])

    def _density_threshold(self) -> float:
        """Return the threshold of log density, at most the mean: an empty grid could never fill again."""
        known = self.log_density[self.visible]
        if len(known) and known.max() - math.log(len(known)) > self.threshold:  # so is the mean
            return self.threshold
        return min(self.threshold, math.log(max(float(np.exp(known.astype(np.float64)).mean()), 1e-30)))

    def _sample(
        self, density_at: DensityAt, cells: np.ndarray, rng: np.random.Generator, samples: int, start: float, end: float
    ) -> np.ndarray:
        """Return the largest of some log densities, each at a random point of a cell and a random time in [start, end].

        Args:
            cells: (n,) int64, numbers of cells in a flat grid. samples: of each cell.
        """
        best = np.full(len(cells), -np.inf, np.float32)
        for _ in range(samples):
            seed = rng.integers(1 << 64, dtype=np.uint64)
            np.maximum(best, density_at(*random_points(cells, self.visible.shape, start, end, seed)), out=best)
        return best

    def sample_slots(
        self, density_at: DensityAt, rng: np.random.Generator, slots: int, samples: int = 16
    ) -> np.ndarray:
        """Return the grid to store, (slots, Nz, Ny, Nx) bool: the cells that are occupied in each part of the clip.

        Each occupied cell is sampled `samples` times in each slot.
        """
        cells, least = np.flatnonzero(self.occupied), self._density_threshold()
        out = np.zeros((slots, self.visible.size), bool)
        for slot in range(slots):
            found = self._sample(density_at, cells, rng, samples, slot / slots, (slot + 1) / slots)
            out[slot, cells] = found > least
        return out.reshape(slots, *self.visible.shape)
