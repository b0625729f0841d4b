"""Random points and times by a generator that needs no state, so that threads draw the same ones in any order."""

import numpy as np
from numba import prange

from kpc.jit import compiled, inlined


@compiled(parallel=True)
def random_points(cells, shape, start, end, seed):
    """Return a random point u of each cell in [0, 1]^3, (N, 3) float32, and a random time for it, (N,) float32.

    Args:
        start, end: between which the times lie.
        cells: (N,) int64, numbers of cells in a flat grid. shape: Nz, Ny and Nx of the grid. seed: uint64.
    """
    N, (Nz, Ny, Nx), span = cells.size, shape, np.float32(end - start)
    points, times = np.empty((N, 3), np.float32), np.empty(N, np.float32)
    for i in prange(N):
        z, y, x = cells[i] // (Ny * Nx), cells[i] // Nx % Ny, cells[i] % Nx
        one, other = _random_bits(seed, 2 * i), _random_bits(seed, 2 * i + 1)
        points[i, 0] = (np.float32(x) + _upper(one)) / np.float32(Nx)
        points[i, 1] = (np.float32(y) + _lower(one)) / np.float32(Ny)
        points[i, 2] = (np.float32(z) + _upper(other)) / np.float32(Nz)
        times[i] = np.float32(start) + span * _lower(other)
    return points, times


@inlined
def _random_bits(seed, number):
    """Return the 64 bits at a place in the sequence of SplitMix64 (Steele et al., OOPSLA 2014, figure 16)."""
    z = seed + np.uint64(number + 1) * np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@inlined
def _upper(bits):
    """Return a number in [0, 1) made of the upper 24 bits."""
    return np.float32(bits >> np.uint64(40)) * np.float32(2.0**-24)


@inlined
def _lower(bits):
    """Return a number in [0, 1) made of 24 of the other bits."""
    return np.float32((bits >> np.uint64(16)) & np.uint64(0xFFFFFF)) * np.float32(2.0**-24)
