"""The layers of a scene, what moves and what stays: its occupied cells are divided between them, so that the pictures
of both, laid over each other by depth, are those of the scene.

The opacity of a point is what a stretch as long as a cell would have at its density. Its *static opacity* is the
STILL_QUANTILE of its opacities over the clip, and that of a cell is the largest of its points. In a clip in groups,
neither is more than the largest static opacity that the cell and those around it have in any group of the same grid,
since surfaces lie a cell apart from one group to the next. Then:

1. A cell rises in a slot where its static opacity is at most STILL_LIMIT, and its opacity exceeds that by CELL_RISE:
   what was empty holds something. Surfaces whose density varies, by shadows or by noise, do not rise. Cells that rise
   at any time and touch each other are a group; groups of less than LEAST_SHARE of the cells of the largest are noise.
   The cells of the others move in the slots in which they rise.
2. Cells beside them move where the opacity of a point exceeds its static opacity: by FRINGE_RISE if that of the cell is
   at most STILL_LIMIT, which is the soft edge of what moves, else by POINT_RISE, where it touches what stays.
3. Groups of cells of a static opacity above SOLID that touch what moves and nothing else move at all times, such as the
   axis of a thing that turns in its place.

What never moves away stays, and so do shadows, which have no density.
"""

import math
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Literal

import numpy as np

from kpc.format.common.errors import UsageError
from kpc.format.common.progress import in_parts, progress
from kpc.format.scene.grid import dilate
from kpc.format.scene.scene import SPACE_PLANES, TIME_PLANES, Scene
from kpc.format.scene.space import Contraction
from kpc.player.areas import feature_area
from kpc.player.cpu.reference import SceneAtTime
from kpc.tools.exchange.field import densities

Layer = Literal["moving", "still"]
OpenScene = Callable[[], Scene]
# A grid of cells, and what part of space it divides: scenes of the same grid have the same cells.
Grid = tuple[tuple[int, ...], bytes, str]

STILL_QUANTILE, STILL_LIMIT = 0.2, 0.1
CELL_RISE, FRINGE_RISE, POINT_RISE = 0.5, 0.02, 0.3
LEAST_SHARE, SOLID = 0.05, 0.3
# Frames of a slot, and slots, that a layer has if the scene has no more; cells in all slots.
FRAMES_PER_SLOT, MOST_SLOTS, MOST_CELLS = 2, 32, 1 << 26
# Points along each axis of a cell at which its opacity is taken, and of how many cells and times at once.
POINTS, BLOCK = 2, 1 << 19


@dataclass(frozen=True)
class Packed:
    """An array, compressed, since those of all groups of a clip are kept at the same time."""

    shape: tuple[int, ...]
    dtype: np.dtype
    content: bytes

    @staticmethod
    def of(values: np.ndarray) -> "Packed":
        """Compress an array of bool or of numbers."""
        stored = np.packbits(values) if values.dtype == bool else values
        return Packed(values.shape, values.dtype, zlib.compress(stored.tobytes(), 1))

    def array(self) -> np.ndarray:
        """Return the array."""
        content, count = zlib.decompress(self.content), math.prod(self.shape)
        if self.dtype == bool:
            return np.unpackbits(np.frombuffer(content, np.uint8), count=count).view(bool).reshape(self.shape)
        return np.frombuffer(content, self.dtype).reshape(self.shape)


@dataclass(frozen=True)
class _Rises:
    """What rises in a scene.

    Attributes:
        grid: of the scene.
        occupied: (K, Nz, Ny, Nx) bool, the occupied cells in the slots of the layer.
        rising: (K, Nz, Ny, Nx) bool, cells that were empty and hold something.
        touching: (K, Nz, Ny, Nx) bool, cells in which a point rises.
    """

    grid: Grid
    occupied: Packed
    rising: Packed
    touching: Packed


def find_layer(layer: Layer, kept: Sequence[OpenScene], whole: Sequence[OpenScene]) -> list[Packed]:
    """Return the cells of a layer of some scenes, (K, Nz, Ny, Nx) bool, all of them occupied.

    Args:
        layer: which one.
        kept: the groups of a clip that are kept, or a part of it.
        whole: all groups of the clip; empty if `kept` is that, and of one group.

    Raises:
        UsageError: nothing moves, nothing stays, or there are too many cells.
    """
    static = _least_static_opacity(whole)
    found: list[_Rises] = []
    rising: dict[Grid, np.ndarray] = {}
    solid: dict[Grid, np.ndarray] = {}
    for open_scene in progress(kept, "finding what moves", unit="scenes"):
        scene = open_scene()
        grid = _grid_of(scene)
        elsewhere = static[grid].array() if grid in static else None
        rises, touches, stays = find_rises(scene, elsewhere)
        for known, seen in ((rising, np.logical_or.reduce(rises)), (solid, stays)):
            known[grid] = np.logical_or(known[grid], seen) if grid in known else seen
        occupied = np.repeat(scene.occupancy, len(rises) // len(scene.occupancy), axis=0)
        found.append(_Rises(grid, *map(Packed.of, (occupied, rises, touches))))
    if not any(cells.any() for cells in rising.values()):
        raise UsageError(f"--layer {layer}: nothing moves in what is kept")
    rising = without_noise(rising)
    hanging = {grid: hanging_cells(rising[grid], solid[grid]) for grid in rising}
    cells = [_cells_of(layer, rises, rising[rises.grid], hanging[rises.grid]) for rises in found]
    if not any(one.array().any() for one in cells):
        raise UsageError(f"--layer {layer}: nothing stays in what is kept")
    return cells


def _cells_of(layer: Layer, found: _Rises, risen: np.ndarray, hanging: np.ndarray) -> Packed:
    """Return the cells of a layer of a scene.

    Args:
        layer: which one.
        found: what rises in the scene.
        risen: (Nz, Ny, Nx) bool, the cells that rise at any time and are no noise.
        hanging: (Nz, Ny, Nx) bool, `hanging_cells`.
    """
    occupied, moving = found.occupied.array(), found.rising.array() & risen
    moving |= found.touching.array() & dilate(moving)
    moving |= hanging
    moving &= occupied
    return Packed.of(moving if layer == "moving" else occupied & ~moving)


def find_rises(scene: Scene, static_elsewhere: np.ndarray | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return what rises in a scene.

    Args:
        scene: the scene.
        static_elsewhere: (Nz, Ny, Nx), the largest that static opacities can be by the other groups of a clip.

    Returns:
        (K, Nz, Ny, Nx) bool where something rises, the same where a point does, and (Nz, Ny, Nx) bool what is solid and
        stays; K is a multiple of the slots of the scene.
    """
    slots, shape, per_slot = _slot_count(scene), scene.occupancy.shape[1:], _steps_per_slot(scene)
    rising, touching = (np.zeros((slots, *shape), bool) for _ in range(2))
    solid = np.zeros(shape, bool)
    for cells, opacity in _opacities(scene):
        at = tuple(cells.T)
        static = _static_opacity(opacity)
        if static_elsewhere is not None:
            static = np.minimum(static, static_elsewhere[at][:, None])
        of_cell = static.max(axis=1)
        rises = (of_cell <= STILL_LIMIT) & (opacity.max(axis=2) - of_cell > CELL_RISE)
        least_rise = np.where(of_cell <= STILL_LIMIT, FRINGE_RISE, POINT_RISE)
        touches = (opacity - static).max(axis=2) > least_rise
        for slot in range(slots):  # with its borders
            moments = slice(per_slot * slot, per_slot * (slot + 1) + 1) if len(opacity) > 1 else slice(None)
            rising[slot][at] = rises[moments].any(axis=0)
            touching[slot][at] = touches[moments].any(axis=0)
        solid[at] = of_cell > SOLID
    return rising, touching, solid


def without_noise(rising: Mapping[Grid, np.ndarray]) -> dict[Grid, np.ndarray]:
    """Return the cells, (Nz, Ny, Nx) bool by grid, without groups that are small beside the largest of any grid."""
    groups = {grid: connected(cells) for grid, cells in rising.items()}
    sizes = {grid: np.bincount(numbers.ravel()) for grid, numbers in groups.items()}
    least = LEAST_SHARE * max(size[1:].max(initial=0) for size in sizes.values())
    return {grid: (sizes[grid] >= least)[numbers] & (numbers > 0) for grid, numbers in groups.items()}


def hanging_cells(risen: np.ndarray, solid: np.ndarray) -> np.ndarray:
    """Return the solid cells that touch what moves and nothing else that stays; all are (Nz, Ny, Nx) bool.

    What is more than half as large as what moves holds it, rather than hangs on it.
    """
    held = connected(solid)
    sizes = np.bincount(held.ravel())
    touched = np.unique(held[dilate(risen) & solid])
    return np.isin(held, touched[2 * sizes[touched] < risen.sum()])


def connected(cells: np.ndarray) -> np.ndarray:
    """Return for each of (Nz, Ny, Nx) cells the number of the group that it is in, from 1 on, and 0 elsewhere.

    Cells of a group touch each other, if only by a corner. Each group takes the number of the neighbour of the largest
    number, until none changes, so that at each turn a group joins another one, or all its neighbours do.
    """
    found = np.zeros(cells.shape, np.int32)
    if not cells.any():
        return found
    around = tuple(slice(places.min(), places.max() + 1) for places in np.nonzero(cells))
    inside = cells[around]
    numbers = np.zeros(inside.shape, np.int32)
    labels = np.arange(1, np.count_nonzero(inside) + 1, dtype=np.int32)
    parents = np.arange(len(labels) + 1, dtype=np.int32)
    while True:
        numbers[inside] = labels
        np.maximum.at(parents, labels, dilate(numbers)[inside])
        while not np.array_equal(further := parents[parents], parents):
            parents = further
        if np.array_equal(joined := parents[labels], labels):
            break
        labels = joined
    found[around][inside] = np.unique(labels, return_inverse=True)[1] + 1
    return found


def _least_static_opacity(scenes: Sequence[OpenScene]) -> dict[Grid, Packed]:
    """Return by grid the least of all scenes of the largest static opacity around each cell, (Nz, Ny, Nx) float16."""
    least: dict[Grid, Packed] = {}
    for open_scene in progress(scenes, "finding what stays", unit="scenes"):
        scene = open_scene()
        grid = _grid_of(scene)
        static = np.zeros(grid[0], np.float16)
        for cells, opacity in _opacities(scene):
            static[tuple(cells.T)] = _static_opacity(opacity).max(axis=1)
        static = dilate(static)
        least[grid] = Packed.of(np.minimum(static, least[grid].array()) if grid in least else static)
    return least


def _static_opacity(opacity: np.ndarray) -> np.ndarray:
    """Return the static opacity of points, (N, POINTS^3), from that at some times, (count, N, POINTS^3)."""
    return np.asarray(np.quantile(opacity, STILL_QUANTILE, axis=0, method="lower"))


def _opacities(scene: Scene) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield the occupied cells in blocks, (N, 3) along z, y and x, and the opacity of their points at the steps of the
    slots, (count, N, POINTS^3) float32; the count is 1 for cells in which nothing changes."""
    occupied, changes = scene.occupancy.any(axis=0), _can_change(scene)
    blocks = []
    for chosen, count in ((changes, _slot_count(scene) * _steps_per_slot(scene) + 1), (~changes, 1)):
        cells, size = np.argwhere(occupied & chosen), max(BLOCK // count, 1)
        blocks += [(cells[start : start + size], count) for start in range(0, len(cells), size)]
    across = np.array(scene.occupancy.shape[:0:-1])
    edges = (scene.aabb[1] - scene.aabb[0]).astype(np.float64)
    reach = (edges / across).max() / edges.max()
    if isinstance(scene.mapping, Contraction):  # whose planes are twice as wide as the box
        reach *= 2
    within = (np.array(list(product(range(POINTS), repeat=3))) + 0.5) / POINTS
    for cells, count in in_parts(blocks):
        points = ((cells[:, None, ::-1] + within) / across).reshape(-1, 3)
        opacity = np.empty((count, len(cells), len(within)), np.float32)
        for number, time in enumerate(np.linspace(0, 1, count).tolist()):
            density = densities(scene, SceneAtTime.of(scene, time), points)
            opacity[number] = -np.expm1(-density * np.float32(reach)).reshape(len(cells), -1)
        yield cells, opacity


def _can_change(scene: Scene) -> np.ndarray:
    """Return the cells, (Nz, Ny, Nx) bool, that are not occupied in all slots alike, or in which a scale that changes
    over the clip has features; all where a motion grid displaces points."""
    shape = scene.occupancy.shape[1:]
    found = (scene.occupancy != scene.occupancy[0]).any(axis=0) | (scene.motion is not None)
    for scale in scene.scales if scene.is_dynamic else ():
        if all((scale[name] == 1).all() for name in TIME_PLANES):
            continue
        low, high = feature_area({name: (scale[name] != 0).any(axis=-1) for name in SPACE_PLANES})
        spans = []
        for count, since, until in zip(shape, low[::-1], high[::-1], strict=True):
            borders = np.arange(count + 1) / count
            spans.append((borders[1:] >= since) & (borders[:-1] <= until))
        found |= spans[0][:, None, None] & spans[1][:, None] & spans[2]
    return found


def _slot_count(scene: Scene) -> int:
    """Return how many slots a layer has: a multiple of those of the scene.

    Raises:
        UsageError: there are too many cells.
    """
    slots, cells = len(scene.occupancy), math.prod(scene.occupancy.shape[1:])
    if slots * cells > MOST_CELLS:
        raise UsageError(f"--layer: the occupancy grid has {slots * cells:,} cells in its slots, over {MOST_CELLS:,}")
    wanted = min(scene.clip.frame_count // FRAMES_PER_SLOT, MOST_SLOTS, MOST_CELLS // cells)
    return slots * max(wanted // slots, 1)


def _steps_per_slot(scene: Scene) -> int:
    """Return in how many steps of time a slot is looked at: of a frame, or of half a row if that is longer."""
    rows = max([len(scale[name]) for scale in scene.scales for name in TIME_PLANES if name in scale], default=1)
    rows = max(rows, 1 if scene.motion is None else len(scene.motion))
    steps = min(scene.clip.frame_count - 1, 2 * (rows - 1))
    return max(math.ceil(steps / _slot_count(scene)), 2)


def _grid_of(scene: Scene) -> Grid:
    return scene.occupancy.shape[1:], scene.aabb.tobytes(), str(scene.mapping)
