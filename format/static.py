"""Where in space and time a scene is static: cells in which all that a renderer reads of the time planes is 1, the identity.

A point reads one column of each time plane (`kpc.format.scene`), so a cell of the occupancy grid is static during its slot if no
texel differs that reads from within the cell and the slot may touch: of "xt", "yt" and "zt", at every scale. Three slabs at right
angles must all be still for one cell to be: a plane that wavers along one axis wavers through the whole box.

With a motion grid the displacement must not change over the clip, either; what is read lies where it leads.
"""

from collections.abc import Callable

import numpy as np

from kpc.format.grid import linear
from kpc.format.motion import moved
from kpc.format.quantise import touches
from kpc.format.scene import TIME_PLANES, Scene


def static_cells(scene: Scene) -> np.ndarray:
    """(slots, Nz, Ny, Nx) bool: where time planes are exactly 1, and places displaced by the same all over the clip if at all."""
    return _untouched(scene, lambda plane: np.any(plane != 1, axis=2))


def unchanging_cells(scene: Scene) -> np.ndarray:
    """(Nz, Ny, Nx) bool: where nothing changes over the clip, be it 1 or not, nor does whether the cell is occupied."""
    still = _untouched(scene, lambda plane: np.broadcast_to(np.any(plane != plane[:1], axis=(0, 2)), plane.shape[:2]))
    return np.asarray(still.all(axis=0) & (scene.occupancy == scene.occupancy[:1]).all(axis=0))


def static_share(scene: Scene) -> float:
    """Of the cells of all slots that are occupied, the share that is static; 1 where none is occupied."""
    return _share(static_cells(scene), scene.occupancy)


def unchanging_share(scene: Scene) -> float:
    """Of the cells that are ever occupied, the share that never changes; 1 where none is occupied."""
    return _share(unchanging_cells(scene), scene.occupancy.any(axis=0))


def _share(cells: np.ndarray, occupied: np.ndarray) -> float:
    return float((cells & occupied).sum() / occupied.sum()) if occupied.any() else 1.0


def _untouched(scene: Scene, differs: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """(slots, Nz, Ny, Nx) bool: cells whose reads of time planes meet no texel that differs; (rows, columns, M) -> (rows, columns)
    bool says which do."""
    slots, *shape = scene.occupancy.shape
    out = np.ones((slots, *shape), bool)
    if not scene.is_dynamic:
        return out
    if scene.motion is not None:
        out &= ~_led_astray(scene.motion, shape)
    for axis, (first, last) in enumerate(_cells_read(scene)):
        name, cells = TIME_PLANES[2 - axis], shape[axis]
        touched = np.zeros((slots, cells), bool)
        for scale in scene.scales:
            texels = differs(scale[name]).astype(np.float32)
            touched |= touches(len(texels), slots).T @ texels @ touches(texels.shape[1], cells) > 0
        until = np.pad(touched.cumsum(axis=1, dtype=np.int32), ((0, 0), (1, 0)))  # cells touched before each
        for slot in range(slots):
            out[slot] &= until[slot, last + 1] == until[slot, first]
    return out


def _cells_read(scene: Scene) -> list[tuple[np.ndarray, np.ndarray]]:
    """Along z, y and x, the first and the last cell of the planes' [0, 1]^3 in which points of each cell are looked up; of shapes
    that go with (Nz, Ny, Nx). Displaced ones are followed as in `kpc.format.motion.places_reached`, at the first instant."""
    shape = scene.occupancy.shape[1:]
    if scene.motion is None:
        return [(index, index) for index in np.ogrid[tuple(slice(size) for size in shape)]]
    middles = np.stack(np.indices(shape)[::-1], axis=-1).astype(np.float32) + np.float32(0.5)
    reached = moved(middles / np.array(shape[::-1], np.float32), linear(scene.motion, 0.0))[..., ::-1] * np.array(shape, np.float32)
    return [(np.maximum(along - 1, 0).astype(np.int64), np.minimum(along + 1, size - 1).astype(np.int64))
            for along, size in zip(np.moveaxis(reached, -1, 0), shape)]


def _led_astray(motion: np.ndarray, shape: list[int]) -> np.ndarray:
    """(Nz, Ny, Nx) bool: cells whose displacement changes over the clip: they touch a node of which it does."""
    reach = (motion != motion[:1]).any(axis=(0, 4)).astype(np.float32)
    for nodes, cells in zip(motion.shape[1:4], shape):
        reach = np.tensordot(reach, touches(nodes, cells), axes=(0, 0))  # z, y, x -> y, x, cells along z, and so on
    return reach > 0
