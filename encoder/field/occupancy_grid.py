"""The occupancy grid: which cells of the box hold anything, so that rays take samples nowhere else."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from kpc.format.scene.grid import SPACE_TIME_AXES, dilate

MERGE_TOLERANCE = 0.1
"""Cells that a renderer may march more, as a share, for a grid that is told less often."""

DensityAt = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""(N, 3) float32 points in [0, 1]^3 and (N,) float32 times -> (N,) log densities."""


def grid_shape(aabb: np.ndarray, cells_across: int) -> tuple[int, int, int]:
    """(Nz, Ny, Nx): `cells_across` along the longest edge, cubes as nearly as whole numbers allow."""
    edges = np.asarray(aabb[1] - aabb[0], np.float64)
    nx, ny, nz = (max(1, round(cells_across * e / edges.max())) for e in edges)
    return nz, ny, nx


def merge_slots(occupancy: np.ndarray, more: float = MERGE_TOLERANCE) -> np.ndarray:
    """(slots, Nz, Ny, Nx) bool in as few slots of equal length as leave no more than this share more cells occupied on average: each
    holds all that those that it stands for hold.

    Where little moves, slots differ by the chance of where density was looked at: one in place of eight makes the grid of the default
    scene 2.9 KB in place of 7.7, of 53 to 83 KB in all, with 5 % more cells, and held-out views are 0.04 dB better; that of liam 3.7 KB
    in place of 6.8, with 0.4 % more.
    """
    slots, *cells = occupancy.shape
    merged = (
        occupancy.reshape(count, slots // count, *cells).any(1) for count in range(1, slots + 1) if slots % count == 0
    )
    return next(grid for grid in merged if grid.mean() <= (1 + more) * occupancy.mean())


class OccupancyGrid:
    """Where density is (Instant-NGP, arXiv:2201.05989, appendix E), cut down to where it has been seen to matter.

    A cell is occupied while its density could absorb something and it, or a neighbour, has lately given a ray some of its
    colour. The second condition empties what lies hidden behind surfaces, where the planes' products are arbitrary.

    Attributes:
        log_density: (Nz, Ny, Nx) float32, decaying maximum of the samples taken in a cell.
        peak: (Nz, Ny, Nx) float32, decaying maximum of the weights that training rays have found in a cell.
        occupied: (Nz, Ny, Nx) bool; cells that too few cameras see are never occupied.
        active: (slots, Nz, Ny, Nx) bool, of the occupied cells those in which rays take samples while each slot of the clip
            lasts: one slot until `split`.
    """

    DENSITY_DECAY = 0.05
    """Subtracted from the log density at each update."""
    LOOKS = 3
    """Points and times at which an update looks at a cell. With the slow decay they keep what fills a cell for a
    fifteenth of the clip from being forgotten between two sights of it: a fast ball lost pieces with one look and 0.1."""
    PEAK_DECAY = 0.85
    """Factor on the peak at each update."""
    PEAK_LEAST = 2e-3
    """A cell whose peak is below gives less than half an 8-bit level to any ray."""

    def __init__(self, seen: np.ndarray, threshold: float) -> None:
        """`threshold`: log density, per longest edge of the box, below which a cell counts as empty."""
        self.visible = seen
        self.threshold = threshold
        self.log_density = np.full(seen.shape, -np.inf, np.float32)
        self.peak = np.ones(seen.shape, np.float32)
        self.occupied = seen.copy()
        self.active = self.occupied[None]
        self._dense = np.ones((1, *seen.shape), bool)
        self._known = False

    def update(self, density_at: DensityAt, peaks: np.ndarray, rng: np.random.Generator) -> None:
        """Take in the peaks since the last update, look at the density anew, and decide what is occupied.

        Looked at: at first all that is seen, then what is occupied and a random sixteenth of the rest, at LOOKS random
        points and times a cell.
        """
        np.maximum(self.peak * np.float32(self.PEAK_DECAY), peaks, out=self.peak)
        matters = dilate(self.peak > self.PEAK_LEAST) & self.visible
        chosen = matters
        if self._known:
            chosen = matters & (self.occupied | (rng.random(self.visible.shape, dtype=np.float32) < 1 / 16))
        self._known = True
        self.log_density -= self.DENSITY_DECAY
        cells = np.argwhere(chosen)
        for _ in range(self.LOOKS):
            self.log_density[chosen] = np.maximum(
                self.log_density[chosen], self._look(density_at, cells, rng, 0.0, 1.0)
            )
        self.occupied = matters & (self.log_density > self._least())
        self.active = self._dense & self.occupied

    def split(self, density_at: DensityAt, slots: int, rng: np.random.Generator) -> None:
        """From now on march, in each of `slots` equal parts of the clip, only where density is or was close by.

        What moves fills at each instant a small part of the cells that it ever fills. Close by is a cell's own slot or one
        beside it, the cell or a neighbour: what is learnt can go on moving until the next split.
        """
        self._dense = dilate(self.sample_slots(density_at, rng, slots, self.LOOKS), SPACE_TIME_AXES)
        self.active = self._dense & self.occupied

    def state(self) -> dict[str, Any]:
        return {
            "log_density": torch.from_numpy(self.log_density),
            "peak": torch.from_numpy(self.peak),
            "occupied": torch.from_numpy(self.occupied),
            "dense": torch.from_numpy(self._dense),
            "known": self._known,
        }

    def load(self, state: dict[str, Any]) -> None:
        names = ("log_density", "peak", "occupied", "dense")
        self.log_density, self.peak, self.occupied, self._dense = (state[name].cpu().numpy() for name in names)
        self.active = self._dense & self.occupied
        self._known = bool(state["known"])

    def _least(self) -> float:
        """The log density that fills a cell. While all is thin it is the average: an empty grid could never be filled again."""
        known = self.log_density[self.visible]
        return min(self.threshold, math.log(max(float(np.exp(known.astype(np.float64)).mean()), 1e-30)))

    def _look(
        self, density_at: DensityAt, cells: np.ndarray, rng: np.random.Generator, start: float, end: float
    ) -> np.ndarray:
        """Log density at a random point of each cell and a random time in [start, end]."""
        points = (cells + rng.random(cells.shape, dtype=np.float32)) / np.array(self.visible.shape, np.float32)
        times = start + (end - start) * rng.random(len(cells), dtype=np.float32)
        return density_at(np.ascontiguousarray(points[:, ::-1], np.float32), times.astype(np.float32))

    def sample_slots(
        self, density_at: DensityAt, rng: np.random.Generator, slots: int, samples: int = 16
    ) -> np.ndarray:
        """The grid to store: (slots, Nz, Ny, Nx) bool, what is occupied while each slot of the clip lasts.

        Each cell that is occupied is looked at `samples` times in every slot.
        """
        cells, least = np.argwhere(self.occupied), self._least()
        out = np.zeros((slots, *self.visible.shape), bool)
        for slot in range(slots):
            best = np.full(len(cells), -np.inf, np.float32)
            for _ in range(samples):
                best = np.maximum(best, self._look(density_at, cells, rng, slot / slots, (slot + 1) / slots))
            out[slot][self.occupied] = best > least
        return out
