"""Where in space and time a scene is static: cells in which all that a renderer reads of the time planes is 1, the identity.

A point reads one column of each time plane (`kpc.format.scene.scene`), so a cell of the occupancy grid is static during its slot if no
texel differs that reads from within the cell and the slot may touch: of "xt", "yt" and "zt", at every scale. Three slabs at right
angles must all be still for one cell to be: a plane that wavers along one axis wavers through the whole box.

With a motion grid all displacements that act on the cell must be 0 over the whole clip, too. (One that is constant but not 0 moves
nothing either, yet counts: none is known to come out of training.)
"""

import math
from collections.abc import Callable

import numpy as np
from kpc.format.scene.scene import TIME_PLANES, Scene


def static_cells(scene: Scene) -> np.ndarray:
    """(slots, Nz, Ny, Nx) bool: where time planes are exactly 1, and nothing is displaced."""
    return _untouched(scene, lambda plane: np.any(plane != 1, axis=2))


def constant_cells(scene: Scene) -> np.ndarray:
    """(Nz, Ny, Nx) bool: where nothing changes over the clip, be it 1 or not, nor does whether the cell is occupied."""
    still = _untouched(scene, lambda plane: np.broadcast_to(np.any(plane != plane[:1], axis=(0, 2)), plane.shape[:2]))
    return np.asarray(still.all(axis=0) & (scene.occupancy == scene.occupancy[:1]).all(axis=0))


def static_fraction(scene: Scene) -> float:
    """Of the cells of all slots that are occupied, the share that is static; 1 where none is occupied."""
    return _share(static_cells(scene), scene.occupancy)


def constant_fraction(scene: Scene) -> float:
    """Of the cells that are ever occupied, the share that never changes; 1 where none is occupied."""
    return _share(constant_cells(scene), scene.occupancy.any(axis=0))


def _share(cells: np.ndarray, occupied: np.ndarray) -> float:
    return float((cells & occupied).sum() / occupied.sum()) if occupied.any() else 1.0


def _untouched(scene: Scene, differs: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """(slots, Nz, Ny, Nx) bool: cells whose reads of time planes meet no texel that differs; (rows, columns, M) -> (rows, columns)
    bool says which do."""
    slots, nz, ny, nx = scene.occupancy.shape
    out = np.ones((slots, nz, ny, nx), bool)
    if not scene.is_dynamic:
        return out
    shapes = {"xt": (slots, 1, 1, nx), "yt": (slots, 1, ny, 1), "zt": (slots, nz, 1, 1)}
    for scale in scene.scales:
        for name in TIME_PLANES:
            cells = math.prod(shapes[name]) // slots
            touched = cells_reading(cells_reading(differs(scale[name]), 0, slots), 1, cells)
            out &= ~touched.reshape(shapes[name])
    if scene.motion is not None:
        displaced = (scene.motion != 0).any(axis=(0, 4))
        for axis, count in enumerate((nz, ny, nx)):
            displaced = cells_reading(displaced, axis, count)
        out &= ~displaced
    return out


def cells_reading(texels: np.ndarray, axis: int, cells: int) -> np.ndarray:
    """Texels or nodes (bool) along an axis of corner-aligned positions -> the cells from which reads may touch one that is set:
    cell [c, c+1] / cells meets the closed support [i-1, i+1] / (size-1) of texel i. As `kpc.format.coding.quantise.needed_texels`, the
    other way round."""
    texels = np.moveaxis(texels, axis, 0)
    out, spaces = np.zeros((cells, *texels.shape[1:]), bool), max(len(texels) - 1, 1)
    for i, is_set in enumerate(texels):
        first, last = -(-(i - 1) * cells // spaces) - 1, (i + 1) * cells // spaces
        out[max(first, 0) : last + 1] |= is_set
    return np.moveaxis(out, 0, axis)
