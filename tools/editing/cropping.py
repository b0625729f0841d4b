"""A part of a scene: other cells of its occupancy grid are emptied, and what nothing reads is left out."""

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from kpc.format.coding.quantise import QuantisedScene, looked_up_cells, needed_texels
from kpc.format.container.groups import Groups
from kpc.format.container.partial import PartialScene
from kpc.format.scene.scene import ALL_PLANES, Scene
from kpc.format.scene.space import Contraction, DeviceCoordinates, uncontract
from kpc.tools.editing.unread import SharedTexels, without_unread


def cropped(scene: QuantisedScene, box: np.ndarray) -> QuantisedScene:
    """Return the part of a scene in the cells that a box, (2, 3) its corners in world units, touches."""
    return with_cells(scene, scene.occupancy & touched_cells(scene.dequantise(), box))


def with_cells(scene: QuantisedScene, cells: np.ndarray, shared: SharedTexels | None = None) -> QuantisedScene:
    """Return the part of a scene in some of its cells, (K, Nz, Ny, Nx) bool; pictures of these stay as they are.

    Args:
        scene: of any mapping.
        cells: its new occupancy grid, in any number of slots.
        shared: of a group, what `shared_texels` says.
    """
    return without_unread(replace(scene, occupancy=cells), scene.occupancy, shared)


def holds_all(clip: Groups, box: np.ndarray) -> bool:
    """Return whether a box touches all that any group holds, so that nothing is cropped."""
    scenes = (PartialScene(clip.open(number)).scene for number in range(len(clip)))
    return not any((scene.occupancy & ~touched_cells(scene, box)).any() for scene in scenes)


def shared_texels(
    clip: Groups, numbers: Sequence[int], cells: Iterable[np.ndarray | None]
) -> list[SharedTexels | None]:
    """Return for each of some groups what any of them reads of the planes that it shares; None where all is kept.

    Args:
        clip: the groups.
        numbers: of those that are kept.
        cells: of each of these the new occupancy grid, as `with_cells`; None of all where that stays.
    """
    found: dict[tuple[int, ...], np.ndarray] = {}  # by chunk and shape
    places: list[dict[tuple[int, str], tuple[int, ...]]] = []
    for number, occupancy in zip(numbers, cells, strict=True):
        reader = clip.open(number)
        places.append({})
        if occupancy is None or not reader.beside:
            continue
        inside = looked_up_cells(replace(PartialScene(reader).scene, occupancy=occupancy))
        for chunk, plane in reader.beside.items():
            entry = reader.index[chunk]
            name = ALL_PLANES[entry.plane]
            head = reader.head.scales[entry.scale][name]
            key = plane.chunk, head.rows, head.columns
            texels = needed_texels(inside, name, head.rows, head.columns)
            found[key] = found[key] | texels if key in found else texels
            places[-1][entry.scale, name] = key
    return [{place: found[key] for place, key in keys.items()} or None for keys in places]


def touched_cells(scene: Scene, box: np.ndarray) -> np.ndarray:
    """Return (Nz, Ny, Nx) bool: the cells that may have a point in a box, (2, 3) its corners in world units.

    The corners of cells are mapped into the world; a cell is kept if the box around its corners touches `box`.
    """
    cells = scene.occupancy.shape[1:]
    aabb = scene.aabb.astype(np.float64)
    axes = [np.linspace(0.0, 1.0, count + 1) for count in cells]
    z, y, x = np.meshgrid(*axes, indexing="ij")
    u = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    if isinstance(scene.mapping, Contraction):
        points = uncontract(np.clip(u, 1e-6, 1 - 1e-6), aabb)
    else:
        points = aabb[0] + u * (aabb[1] - aabb[0])
        if isinstance(scene.mapping, DeviceCoordinates):
            points = scene.mapping.to_world(points)
    grid = points.reshape(*(count + 1 for count in cells), 3)
    corners = itertools.product((0, 1), repeat=3)
    shifts = [tuple(slice(k, k + n) for k, n in zip(corner, cells, strict=True)) for corner in corners]
    low, high = (bound([grid[shift] for shift in shifts], axis=0) for bound in (np.min, np.max))
    return np.asarray((low <= box[1]).all(-1) & (high >= box[0]).all(-1))
