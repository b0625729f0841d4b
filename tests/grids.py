"""Occupancy and motion grids that tests of several modules share."""

import numpy as np


def rolling(slots: int = 5, nz: int = 32, ny: int = 36, nx: int = 40) -> np.ndarray:
    """Return a (slots, nz, ny, nx) bool grid: cells where travelling waves are high, with noisy borders."""
    rng = np.random.default_rng(0)
    places = np.indices((slots, nz, ny, nx))
    height = sum(
        np.sin(np.tensordot(rng.normal(0, (0.1, 0.3, 0.3, 0.3)), places, 1) + 9 * rng.random()) for _ in range(6)
    )
    return height + rng.normal(0, 0.2, (nz, ny, nx)) > 1.5


def swaying(rows: int = 20, nz: int = 8, ny: int = 6, nx: int = 6) -> np.ndarray:
    """Return (rows, nz, ny, nx, 3) int16 displacements: travelling waves with a little noise."""
    rng = np.random.default_rng(0)
    places = np.indices((rows, nz, ny, nx))
    waves = [
        300 * np.sin(sum(np.tensordot(k, places, 1) for k in rng.normal(0, 0.3, (1, 4))) + 9 * rng.random())
        for _ in range(9)
    ]
    field = np.stack([sum(waves[c::3]) for c in range(3)], -1)
    return np.rint(field + rng.normal(0, 0.5, field.shape)).astype(np.int16)
