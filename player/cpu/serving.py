"""Which scenes the processor's renderer serves, and the memory that it takes: asked before its kernels are loaded."""

import importlib.util
import math
from collections.abc import Mapping
from functools import cache

import numpy as np

from kpc.format.scene.scene import SPACE_PLANES, Decoder, Scene
from kpc.format.scene.space import DeviceCoordinates
from kpc.player.cpu.threads import WORKERS

# Channels of a grid node, processed at once.
CHANNELS = 4
# Features that are stored together: as many floats as the widest processors multiply at once.
WIDE = 16
# Features that are processed at once: in halves of WIDE samples take 0.8 of the time, since all operands fit the
# registers.
NARROW = 8
# Rays side by side. With 256 a picture takes 1.05 of the time, with 128 1.1; what they hold fits the two nearest
# caches.
LANES = 512
# Corners of the largest corner grid, 64 MB; up to here it saves half of the time and more.
MOST_CORNERS = 1 << 22
# Texels that a sample takes of planes from which on the grid pays; below it, reprojection from picture to picture saves
# more.
LEAST_TEXELS = 24


@cache
def is_installed() -> bool:
    """Return whether there is numba, which the extras `cpu` and `encoder` bring."""
    try:
        return all(importlib.util.find_spec(name) is not None for name in ("numba", "llvmlite"))
    except ModuleNotFoundError:
        return False


def serves(scene: Scene) -> bool:
    """Return whether the scene has an explicit decoder and no device coordinates."""
    return isinstance(scene.decoder, Decoder) and not isinstance(scene.mapping, DeviceCoordinates)


def serves_grid(scene: Scene) -> bool:
    """Return whether something moves in a box, colour is view-independent, corners are not too many, and channels are
    many."""
    is_view_independent = isinstance(scene.decoder, Decoder) and not scene.decoder.w2.any()
    is_small = math.prod(grid_shape(scene)) <= MOST_CORNERS
    texels = len(SPACE_PLANES) * sum(-(-scale["xy"].shape[2] // 4) for scale in scene.scales)
    return is_view_independent and scene.mapping is None and scene.is_dynamic and is_small and texels >= LEAST_TEXELS


def grid_shape(scene: Scene) -> tuple[int, int, int]:
    """Return (Nz, Ny, Nx) of the corner grid: the number of texels of the finest scale along each axis."""
    nz, ny, nx = (
        max(scale[plane].shape[axis] for scale in scene.scales) for plane, axis in (("xz", 0), ("xy", 0), ("xy", 1))
    )
    return nz, ny, nx


def group_width(scene: Scene) -> int:
    """Return how many channels of a plane are stored together."""
    return NARROW if all(scale["xy"].shape[2] <= NARROW for scale in scene.scales) else WIDE


def texels_along(scale: Mapping[str, np.ndarray]) -> tuple[int, int, int]:
    """Return the number of texels along x, y, z, at least two: a single one is stored twice."""
    nx, ny, nz = (max(2, scale[plane].shape[axis]) for plane, axis in (("xy", 1), ("xy", 0), ("xz", 0)))
    return nx, ny, nz


def grid_bytes(scene: Scene) -> int:
    """Return what the corner grid takes."""
    nz, ny, nx = grid_shape(scene)
    channels = sum(scale["xy"].shape[2] for scale in scene.scales)
    channels += -channels % WIDE
    return (16 + WORKERS) * nz * ny * nx + 2 * channels * (ny * nx + nz * nx + nz * ny)


def plane_bytes(scene: Scene) -> int:
    """Return what the planes take."""
    taken = 0
    for scale in scene.scales:
        nx, ny, nz = texels_along(scale)
        channels = scale["xy"].shape[2]
        channels += -channels % group_width(scene)
        planes, rows = 2 * (nx * ny + nx * nz + ny * nz), 4 * (nx + ny + nz)
        taken += channels * (planes + rows + 4 * CHANNELS * WORKERS * LANES)
    return taken


def bytes_for(scene: Scene) -> int:
    """Return what the processor's renderer takes at most, without pictures; 0 where it does not serve."""
    if not is_installed() or not serves(scene):
        return 0
    return plane_bytes(scene) + (grid_bytes(scene) if serves_grid(scene) else 0)
