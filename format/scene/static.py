"""Which parts of a scene are static: cells in which the time planes hold the multiplicative identity.

A point reads one column of each time plane (`kpc.format.scene.scene`). A cell of the occupancy grid is static during
its time slot if every texel of "xt", "yt" and "zt" that is read from within the cell during that slot is exactly 1, at
every scale whose features are not 0 there, that is, whose space planes all hold a texel other than 0 that is read.
With a motion grid, all displacements that act on the cell must be 0 over the whole clip, too. (A displacement that is
constant but not 0 changes nothing either; it still counts as motion, since training never produces one.)
"""

import math
from collections.abc import Callable

import numpy as np

from kpc.format.scene.scene import TIME_PLANES, Scene


def static_cells(scene: Scene) -> np.ndarray:
    """Return (slots, Nz, Ny, Nx) bool: cells where all time planes are 1 and nothing is displaced."""
    return _cells_without(scene, lambda plane: np.any(plane != 1, axis=2))


def constant_cells(scene: Scene) -> np.ndarray:
    """Return (Nz, Ny, Nx) bool: cells whose content and occupancy are the same over the whole clip.

    Unlike in static cells, the time planes may differ from 1 as long as their rows are equal.
    """
    still = _cells_without(
        scene, lambda plane: np.broadcast_to(np.any(plane != plane[:1], axis=(0, 2)), plane.shape[:2])
    )
    return np.asarray(still.all(axis=0) & (scene.occupancy == scene.occupancy[:1]).all(axis=0))


def static_fraction(scene: Scene) -> float:
    """Return the fraction of occupied cells, over all slots, that are static; 1 if none is occupied."""
    return _fraction(static_cells(scene), scene.occupancy)


def constant_fraction(scene: Scene) -> float:
    """Return the fraction of cells occupied at any time that are constant; 1 if none is occupied."""
    return _fraction(constant_cells(scene), np.asarray(scene.occupancy.any(axis=0)))


def _fraction(cells: np.ndarray, occupied: np.ndarray) -> float:
    return float((cells & occupied).sum() / occupied.sum()) if occupied.any() else 1.0


def _cells_without(scene: Scene, differs: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Return (slots, Nz, Ny, Nx) bool: cells that read no texel of a time plane for which `differs` is true.

    Scales whose features are 0 in a cell are not asked.

    `differs` maps a plane (rows, columns, M) to (rows, columns) bool.
    """
    slots, nz, ny, nx = scene.occupancy.shape
    out = np.ones((slots, nz, ny, nx), bool)
    if not scene.is_dynamic:
        return out
    shapes = {"xt": (slots, 1, 1, nx), "yt": (slots, 1, ny, 1), "zt": (slots, nz, 1, 1)}
    for scale in scene.scales:
        moves = np.zeros_like(out)
        for name in TIME_PLANES:
            cells = math.prod(shapes[name]) // slots
            reading = cells_reading(cells_reading(differs(scale[name]), 0, slots), 1, cells)
            moves |= reading.reshape(shapes[name])
        for name, (rows, columns) in {"xy": (ny, nx), "xz": (nz, nx), "yz": (nz, ny)}.items():
            used = cells_reading(cells_reading(np.any(scale[name], axis=2), 0, rows), 1, columns)
            moves &= np.expand_dims(used, [axis in name for axis in "zyx"].index(False))
        out &= ~moves
    if scene.motion is not None:
        displaced = (scene.motion != 0).any(axis=(0, 4))
        for axis, count in enumerate((nz, ny, nx)):
            displaced = cells_reading(displaced, axis, count)
        out &= ~displaced
    return out


def cells_reading(texels: np.ndarray, axis: int, cells: int) -> np.ndarray:
    """Return which cells along an axis may read a texel that is set.

    Linear interpolation gives texel i of `size` corner-aligned ones the support [i-1, i+1] / (size-1); a cell [c, c+1]
    / cells reads it if the two closed intervals meet. `kpc.format.coding.quantise.needed_texels` is the inverse.

    Args:
        texels: bool, any shape.
        axis: the axis to resample.
        cells: number of cells along it.

    Returns:
        bool, as `texels` but with `cells` entries along `axis`.
    """
    texels = np.moveaxis(texels, axis, 0)
    out, intervals = np.zeros((cells, *texels.shape[1:]), bool), max(len(texels) - 1, 1)
    for i, is_set in enumerate(texels):
        first, last = -(-(i - 1) * cells // intervals) - 1, (i + 1) * cells // intervals
        out[max(first, 0) : last + 1] |= is_set
    return np.moveaxis(out, 0, axis)
