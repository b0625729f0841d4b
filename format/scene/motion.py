"""The motion grid: displacements that warp every instant of a clip to the canonical pose held by the planes.

Without motion, the planes have to store a moving surface once per pose. With a motion grid, a renderer samples them at

    u + D(u, t)

in place of u, the position in [0, 1]^3. D is interpolated linearly in x, y, z and t between the nodes of a coarse
corner-aligned grid over [0, 1]^4; D = 0 leaves the K-Planes field unchanged. Warping to a canonical space is the idea
of D-NeRF (arXiv:2011.13961), where D is a network. Here D is small enough that a player keeps it, for one instant, as
a small texture.
"""

from dataclasses import dataclass

import numpy as np

from kpc.format.common.errors import FormatError
from kpc.format.scene.grid import sample_linear, texel_and_fraction

# The finest quantisation step of displacements, in edges of the box: the error is at most 1/16 texel of a plane of 256
# texels. Held-out PSNR of the test scene "soldier" is the same to 0.001 dB down to 2^-13. Rate control may coarsen it.
FINEST_STEP = 2.0**-11

# The largest magnitude of a stored displacement, in edges of the box. Positions are clamped to [0, 1] after
# displacement, so anything above 1 acts as 1.
DISPLACEMENT_LIMIT = 1024.0


@dataclass(frozen=True)
class QuantisedMotion:
    """A quantised motion grid.

    Attributes:
        symbols: (T, Nz, Ny, Nx, 3) int16, every size but the last at least 2.
        step: quantisation step, float32 > 0, edges of the box.
    """

    symbols: np.ndarray
    step: float

    def dequantise(self) -> np.ndarray:
        """Return (T, Nz, Ny, Nx, 3) float32: symbol * step, rounded once."""
        return self.symbols.astype(np.float32) * np.float32(self.step)


def quantise_motion(offsets: np.ndarray) -> QuantisedMotion:
    """Round a motion grid to multiples of FINEST_STEP, or of the finest step that 16 bits allow.

    A grid of nothing but multiples of k FINEST_STEP gets that coarser step. A displacement of +DISPLACEMENT_LIMIT is
    stored one step smaller, since the symbol range is -32768 to 32767.

    Args:
        offsets: (T, Nz, Ny, Nx, 3) float, edges of the box.

    Raises:
        FormatError: an offset is NaN or exceeds DISPLACEMENT_LIMIT.
    """
    largest = float(np.abs(offsets).max())
    if not largest <= DISPLACEMENT_LIMIT:  # False for NaN, too
        raise FormatError(
            f"motion: holds NaN or a displacement of more than {DISPLACEMENT_LIMIT:g} edges of the box, which no file "
            "can store; train with a lower learning rate"
        )
    wide_enough = np.nextafter(np.float32(largest / 32767), np.float32(np.inf))
    step = np.float32(np.clip(wide_enough, FINEST_STEP, DISPLACEMENT_LIMIT / 32768))
    symbols = np.rint(offsets.astype(np.float64) / step).clip(-32768, 32767).astype(np.int16)
    # Only a step that is a power of two can be multiplied without new rounding. The gcd is 0 where nothing moves.
    multiple = int(np.gcd.reduce(symbols, axis=None)) or 1 if step == FINEST_STEP else 1
    return QuantisedMotion(symbols // np.int16(multiple), float(step) * multiple)


def displace(u: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """Return the positions in the planes of points u: u + D(u), clamped to [0, 1]^3.

    Args:
        u: (..., 3) float32 in [0, 1]^3.
        offsets: (Nz, Ny, Nx, 3) float32, the motion grid at one time (`kpc.format.scene.grid.sample_linear`).

    Returns:
        (..., 3) float32.
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
    """Return the cells of the planes' [0, 1]^3 in which points of occupied cells are sampled.

    The centres of occupied cells are displaced at every time row of the grid. The result covers their range plus one
    cell on every side: a point is missed only if D stretches its cell to more than twice its size.

    Args:
        occupancy: (slots, Nz, Ny, Nx) bool, the occupancy grid.
        offsets: (T, Mz, My, Mx, 3) float32, the motion grid over the whole clip.

    Returns:
        (slots, Nz, Ny, Nx) bool.
    """
    slots, shape = len(occupancy), np.array(occupancy.shape[1:], np.float32)
    times = np.linspace(0, 1, len(offsets))
    out = np.zeros_like(occupancy)
    for slot in range(slots):
        cells = np.argwhere(occupancy[slot])
        centres = ((cells + np.float32(0.5)) / shape)[:, ::-1]
        low, high = np.full(cells.shape, np.inf, np.float32), np.full(cells.shape, -np.inf, np.float32)
        start, end = slot / slots, (slot + 1) / slots
        for time in [start, *times[(times > start) & (times < end)], end]:
            reached = displace(centres, sample_linear(offsets, float(time)))[:, ::-1] * shape
            low, high = np.minimum(low, reached), np.maximum(high, reached)
        first, last = np.maximum(low - 1, 0).astype(np.int64), np.minimum(high + 1, shape - 1).astype(np.int64)
        _fill_boxes(out[slot], first, last)
    return out


def _fill_boxes(grid: np.ndarray, first: np.ndarray, last: np.ndarray) -> None:
    """Set all cells of the boxes from `first` to `last` (N, 3), both included, by one prefix sum per axis."""
    marks = np.zeros([n + 1 for n in grid.shape], np.int64)
    for corner in np.ndindex(2, 2, 2):
        at = np.where(corner, last + 1, first)
        np.add.at(marks, tuple(at.T), (-1) ** sum(corner))
    for axis in range(3):
        marks = marks.cumsum(axis)
    grid |= marks[:-1, :-1, :-1] > 0
