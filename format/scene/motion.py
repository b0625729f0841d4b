"""Motion: at which place in the planes a renderer looks for what is at a place at some time.

Planes that never move hold what turns and bends once for every pose. A motion grid leads each instant back to one frame that
all of the clip shares: the planes are read at

    u + D(u, t)

in place of u. D is linear in x, y, z and t between the nodes of a coarse, corner-aligned grid over [0, 1]^4, and D = 0 leaves
the K-Planes field as it is. (That a moving scene is best kept in one frame is D-NeRF's insight, arXiv:2011.13961; there D is a
network, here so few numbers that a player keeps D at one instant as a small texture.)
"""

from dataclasses import dataclass

import numpy as np
from kpc.format.common.errors import FormatError
from kpc.format.scene.grid import sample_linear, texel_and_fraction

FINEST_STEP = 2.0**-11
"""The finest that is stored, in box edges. Displacements then err by at most 1/16 texel of a plane of 256. Held-out PSNR of soldier is the
same to 0.001 dB down to 2^-13. (How coarse it may be for a file's sake: `kpc.encoder.rdo.rate_control.with_coarser_motion`.)"""

DISPLACEMENT_LIMIT = 1024.0
"""Magnitude of any displacement, in box edges. Places are clamped to [0, 1]: more than 1 has the effect of 1."""


@dataclass(frozen=True)
class QuantisedMotion:
    """A motion grid as integers.

    Attributes:
        symbols: (T, Nz, Ny, Nx, 3) int16, every size but the last at least 2.
        step: float32 > 0, box edges.
    """

    symbols: np.ndarray
    step: float

    def dequantise(self) -> np.ndarray:
        """(T, Nz, Ny, Nx, 3) float32: symbol * step, rounded once."""
        return self.symbols.astype(np.float32) * np.float32(self.step)


def quantise_motion(offsets: np.ndarray) -> QuantisedMotion:
    """Round a motion grid to multiples of STEP, or of what 16 bits allow; one that holds but multiples of k STEP is stored with that step. What
    is DISPLACEMENT_LIMIT, but for its sign, is stored as a step less.

    Raises:
        FormatError: an offset is NaN or beyond DISPLACEMENT_LIMIT.
    """
    largest = float(np.abs(offsets).max())
    if not largest <= DISPLACEMENT_LIMIT:  # False for NaN, too
        raise FormatError(
            f"motion: holds NaN or a displacement of more than {DISPLACEMENT_LIMIT:g} boxes, which no file can store; train with a "
            "lower learning rate"
        )
    wide_enough = np.nextafter(np.float32(largest / 32767), np.float32(np.inf))
    step = np.float32(np.clip(wide_enough, FINEST_STEP, DISPLACEMENT_LIMIT / 32768))
    symbols = np.rint(offsets.astype(np.float64) / step).clip(-32768, 32767).astype(np.int16)
    # Of a power of two, so that nothing is rounded anew; 0 where nothing moves.
    multiple = int(np.gcd.reduce(symbols, axis=None)) or 1 if step == FINEST_STEP else 1
    return QuantisedMotion(symbols // np.int16(multiple), float(step) * multiple)


def displace(u: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """Places (..., 3) in the planes of places u (..., 3) in [0, 1]^3: u + D(u), in [0, 1]^3.

    `offsets`: (Nz, Ny, Nx, 3), a motion grid cut at one time (`kpc.format.scene.grid.sample_linear`).
    """
    nz, ny, nx, _ = offsets.shape
    flat = offsets.reshape(-1, 3)
    (i, f), (j, g), (k, h) = (texel_and_fraction(u[..., axis], size) for axis, size in enumerate((nx, ny, nz)))
    out = u.copy()
    for corner in range(8):
        right, up, back = corner & 1, corner >> 1 & 1, corner >> 2
        weight = (f if right else 1 - f) * (g if up else 1 - g) * (h if back else 1 - h)
        out += weight[..., None] * flat[((k + back) * ny + j + up) * nx + i + right]
    return np.clip(out, 0, 1)


def reached_cells(occupancy: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """The cells of the planes' [0, 1]^3 in which points of occupied cells are looked up; shape and type as `occupancy`.

    `occupancy`: (slots, Nz, Ny, Nx) bool; `offsets`: (T, Mz, My, Mx, 3), whole. The middles of cells are followed through every
    row of time. About each a cell more counts on every side: D would have to stretch a cell to more than twice its size for a
    point of it to be missed.
    """
    slots, shape = len(occupancy), np.array(occupancy.shape[1:], np.float32)
    times = np.linspace(0, 1, len(offsets))
    out = np.zeros_like(occupancy)
    for slot in range(slots):
        cells = np.argwhere(occupancy[slot])
        middles = ((cells + np.float32(0.5)) / shape)[:, ::-1]
        low, high = np.full(cells.shape, np.inf, np.float32), np.full(cells.shape, -np.inf, np.float32)
        start, end = slot / slots, (slot + 1) / slots
        for time in [start, *times[(times > start) & (times < end)], end]:
            reached = displace(middles, sample_linear(offsets, float(time)))[:, ::-1] * shape
            low, high = np.minimum(low, reached), np.maximum(high, reached)
        first, last = np.maximum(low - 1, 0).astype(np.int64), np.minimum(high + 1, shape - 1).astype(np.int64)
        _fill(out[slot], first, last)
    return out


def _fill(grid: np.ndarray, first: np.ndarray, last: np.ndarray) -> None:
    """Set all boxes of cells from `first` to `last` (N, 3), both included: sums of differences, as many passes as axes."""
    marks = np.zeros([n + 1 for n in grid.shape], np.int64)
    for corner in np.ndindex(2, 2, 2):
        at = np.where(corner, last + 1, first)
        np.add.at(marks, tuple(at.T), (-1) ** sum(corner))
    for axis in range(3):
        marks = marks.cumsum(axis)
    grid |= marks[:-1, :-1, :-1] > 0
