"""The state of the rays that the processor's ray marcher (`kpc.player.cpu.raymarch`) has under way, and helpers for its
kernels.

All kernels work on float32 in structures of arrays: one column for each ray or sample, so that most loops become vector
instructions.
"""

from typing import Any, NamedTuple

import numpy as np

from kpc.jit import compiled
from kpc.player.cpu.serving import LANES, WIDE

# Corners of a texel or grid cell in three dimensions.
CORNERS = 8

# Rows of `Lanes.rays`; the first KEPT belong to the ray, as in march.glsl with FAR in t; the others to the sample it is
# at in this round.
RATE_X, RATE_Y, RATE_Z, NEAR, FAR, STEP, TRANS, RED, GREEN, BLUE, DEPTH, SAMPLES, T, X, Y, Z, DENSITY_SCALE = range(17)
KEPT = SAMPLES + 1
# Rows of `Lanes.samples`: position in [0, 1]^3, share of the way to the next grid node, density factor of the step, and
# four values.
POSITION_X, POSITION_Y, POSITION_Z, FRACTION_X, FRACTION_Y, FRACTION_Z, STEP_SCALE, VALUES = range(8)
LOGIT_RED, LOGIT_GREEN, LOGIT_BLUE, LOG_DENSITY = range(VALUES, VALUES + 4)

F, I, U = np.float32, np.int32, np.uint64  # noqa: E741, the kernels' names of their types
ZERO, ONE = F(0), F(1)

# Unsigned indices do not count from an array's end, which lets loops become vector instructions.
FAST: dict[str, Any] = {"fastmath": {"contract", "reassoc", "nsz", "arcp"}, "error_model": "numpy"}
# For parts of a kernel that make no array: compiled into their callers.
kernel_part = compiled(forceinline=True, _nrt=False, **FAST)


class Lanes(NamedTuple):
    """Rays under way and the samples that some of them take in this round."""

    rays: np.ndarray  # (17, LANES) float32
    samples: np.ndarray  # (11, LANES) float32
    pixel: np.ndarray  # (LANES,) int32, row * width + column
    cell: np.ndarray  # (LANES,) int32, index in a grid
    free: np.ndarray  # (LANES,) int32, distance to the nearest occupied cell in cells, or raymarch.DONE
    ray_of: np.ndarray  # (LANES,) int32, the ray of each sample
    weights_of: np.ndarray  # (LANES,) int32, the row of direction-dependent weights of each ray
    texels: np.ndarray  # (6, LANES) int32, texels of xy, xz, yz and of the rows along x, y, z before each sample
    missing: np.ndarray  # (CORNERS * LANES + 1,) int32, corners to be computed


@compiled(**FAST)
def new_lanes():
    """Make lanes without rays."""
    return Lanes(
        np.zeros((DENSITY_SCALE + 1, LANES), np.float32),
        np.zeros((LOG_DENSITY + 1, LANES), np.float32),
        np.empty(LANES, np.int32),
        np.empty(LANES, np.int32),
        np.zeros(LANES, np.int32),
        np.zeros(LANES, np.int32),
        np.zeros(LANES, np.int32),
        np.zeros((6, LANES), np.int32),
        np.empty(CORNERS * LANES + 1, np.int32),
    )


class Grid(NamedTuple):
    """Vectors of four at nodes that are aligned with the corners of [0, 1]^3."""

    nodes: np.ndarray  # (Nz * Ny * Nx, 4) float32; no nodes: there is no grid
    size: tuple[int, int, int]  # Nx, Ny, Nz


@kernel_part
def whole_vectors(count):
    """Round up to a multiple of WIDE: a remainder would be processed one by one. Lanes beyond `count` hold stale
    values."""
    return (U(count) + U(WIDE - 1)) // U(WIDE) * U(WIDE)


@kernel_part
def clamped(x, most):
    """Clamp to [0, most]; 0 for NaN, which must not become an index into an array."""
    x = x if x > ZERO else ZERO
    return x if x < most else most


@kernel_part
def node_strides(size):
    """Distance from a node to the next along x, y, z; 0 where there is none."""
    nx, ny, nz = size
    return U(1 if nx > 1 else 0), U(nx if ny > 1 else 0), U(nx * ny if nz > 1 else 0)


@kernel_part
def find_nodes(found, size, lanes):
    """For each sample, find the grid node before it (`cell`) and its share of the way to the next."""
    samples, cell = lanes.samples, lanes.cell
    nx, ny, nz = size
    for j in range(whole_vectors(found)):
        x, y, z = (
            clamped(samples[POSITION_X, j], ONE),
            clamped(samples[POSITION_Y, j], ONE),
            clamped(samples[POSITION_Z, j], ONE),
        )
        samples[POSITION_X, j], samples[POSITION_Y, j], samples[POSITION_Z, j] = x, y, z
        x, y, z = x * F(nx - 1), y * F(ny - 1), z * F(nz - 1)
        column, row, layer = min(I(x), I(max(nx - 2, 0))), min(I(y), I(max(ny - 2, 0))), min(I(z), I(max(nz - 2, 0)))
        samples[FRACTION_X, j], samples[FRACTION_Y, j], samples[FRACTION_Z, j] = x - F(column), y - F(row), z - F(layer)
        cell[j] = (layer * I(ny) + row) * I(nx) + column
