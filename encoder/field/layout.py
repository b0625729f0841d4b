"""Where the planes of a field lie in its vector of parameters, and how large they are."""

import functools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from kpc.encoder.field.config import TrainConfig
from kpc.encoder.field.occupancy_grid import grid_shape
from kpc.format.scene.areas import area_texels
from kpc.format.scene.scene import ALL_PLANES, SPACE_PLANES, TIME_PLANES, Clip

AXES = "xyzt"

# Texels of the scales of moving areas are smaller than those of the others by this factor at most: players hold them as
# if they covered the box.
MOST_FINER = 3.0

# Rows of a block in `Layout.line_blocks`, at most.
BLOCK_ROWS = 16

# Rows of a plane that lie so far apart in it follow each other in `Layout.plane_rows`.
DEALT = 64


@dataclass(frozen=True, eq=False)
class Layout:
    """Where each plane lies in `theta`.

    A scale may hold the texels of a part of the box only, its *area*: the others of its space planes are 0, those of
    its space-time planes 1, so that its features are 0 outside.

    Attributes:
        resolution: (S, 4) int64, texels along x, y, z and t; t is 0 in a scale without space-time planes.
        channels: M, the same for all scales.
        table: (S, 6) int64, first element of each plane in the order of ALL_PLANES; -1 for planes that do not exist.
        size: number of elements of theta.
        first: (S, 3) int64, the first texel that is held along x, y and z.
        held: (S, 4) int64, texels that are held along x, y, z and t.
    """

    resolution: np.ndarray
    channels: int
    table: np.ndarray
    size: int
    first: np.ndarray
    held: np.ndarray

    @staticmethod
    def of(resolution: np.ndarray, channels: int, spans: np.ndarray | None = None) -> "Layout":
        """Return the layout of planes that lie one after the other, scale by scale.

        Args:
            spans: (S, 3, 2), along x, y and z the first texel of each scale's area, and how many it has; None where
                all scales cover the box.
        """
        resolution = np.asarray(resolution, np.int64)
        first, held = np.zeros((len(resolution), 3), np.int64), resolution.copy()
        if spans is not None:
            first, held[:, :3] = np.asarray(spans, np.int64)[..., 0], np.asarray(spans, np.int64)[..., 1]
        table = np.full((len(resolution), 6), -1, np.int64)
        size = 0
        for s, axes in enumerate(held):
            for c, name in enumerate(ALL_PLANES if axes[3] else SPACE_PLANES):
                table[s, c] = size
                size += int(axes[AXES.index(name[0])] * axes[AXES.index(name[1])]) * channels
        return Layout(resolution, channels, table, size, first, held)

    @property
    def is_dynamic(self) -> bool:
        """Whether there are space-time planes."""
        return bool(self.resolution[:, 3].any())

    @property
    def is_uniform(self) -> bool:
        """Whether all scales cover the box, and have the same planes."""
        return bool((self.held == self.resolution).all() and len(set((self.resolution[:, 3] > 0).tolist())) == 1)

    @functools.cached_property
    def plane_rows(self) -> np.ndarray:
        """(R, 5) int64: for each row of a plane where the plane begins in theta, the number of the row, how many rows
        and columns the plane has, and 1 for a space-time plane.

        The rows of a plane are far apart, so that threads, which take rows that follow each other, have as much to do.
        """
        rows = [
            (start, row, count, columns, int(name in TIME_PLANES))
            for _, name, start, count, columns in self.planes()
            for row in range(count)
        ]
        return np.array([row for first in range(DEALT) for row in rows[first::DEALT]], np.int64)

    @functools.cached_property
    def line_blocks(self) -> np.ndarray:
        """(B, 6) int64: for blocks of rows of the `lined_planes` where the plane begins in theta, the block's first row
        and the one after its last, how many columns and rows the plane has, and the number of its first line.

        Lines are the rows of a plane and then its columns, plane by plane.
        """
        blocks, line = [], 0
        for start, rows, columns in self.lined_planes:
            for first in range(0, rows, BLOCK_ROWS):
                blocks.append([start, first, min(first + BLOCK_ROWS, rows), columns, rows, line])
            line += rows + columns
        return np.array(blocks, np.int64).reshape(-1, 6)

    @property
    def lined_planes(self) -> list[tuple[int, int, int]]:
        """(start, rows, columns) of each plane that `kpc.encoder.training.line_steps` concerns: those of the
        `still_scales`."""
        return [(start, rows, columns) for s, _, start, rows, columns in self.planes() if s in self.still_scales]

    @functools.cached_property
    def still_scales(self) -> tuple[int, ...]:
        """The scales without space-time planes, where others have some."""
        return tuple(np.flatnonzero(self.is_dynamic & (self.resolution[:, 3] == 0)).tolist())

    @property
    def lines(self) -> int:
        """The number of rows and columns of the `lined_planes`."""
        return sum(rows + columns for _, rows, columns in self.lined_planes)

    def rectangle(self, scale: int, name: str) -> tuple[slice, slice]:
        """Return which rows and columns of a plane of the whole box are held."""
        axes = [AXES.index(axis) for axis in reversed(name)]
        first = [int(self.first[scale, axis]) if axis < 3 else 0 for axis in axes]
        rows, columns = (slice(at, at + int(self.held[scale, axis])) for at, axis in zip(first, axes, strict=True))
        return rows, columns

    def has(self, scale: int, name: str) -> bool:
        """Return whether a scale has a plane."""
        return bool(self.table[scale, ALL_PLANES.index(name)] >= 0)

    @functools.cached_property
    def areas(self) -> np.ndarray:
        """(S, 2, 4) float32: of each scale along x, y and z where its area begins in [0, 1], and how often it would fit
        the box; at last 1 and 0 where that is a part of the box."""
        spaces = np.maximum(self.resolution[:, :3] - 1, 1)
        areas = np.zeros((len(spaces), 2, 4), np.float32)
        areas[:, 0, :3] = self.first / spaces
        areas[:, 1, :3] = spaces / np.maximum(self.held[:, :3] - 1, 1)
        areas[:, 0, 3] = (self.held != self.resolution).any(1)
        return areas

    @property
    def features(self) -> int:
        """F, the number of features of a sample."""
        return len(self.resolution) * self.channels

    def planes(self) -> Iterator[tuple[int, str, int, int, int]]:
        """Yield (scale, name, start, rows, columns) of every plane, as far as it is held."""
        for s, axes in enumerate(self.held):
            for c, name in enumerate(ALL_PLANES):
                if self.table[s, c] >= 0:
                    yield s, name, int(self.table[s, c]), int(axes[AXES.index(name[1])]), int(axes[AXES.index(name[0])])


def plan_layout(config: TrainConfig, aabb: np.ndarray, clip: Clip, is_dynamic: bool) -> Layout:
    """Return a layout with `config.resolutions` texels along the box's longest edge, and as many per length elsewhere.

    The number of time rows is the same at every scale (K-Planes, section 3.1). No axis has fewer than two texels.
    """
    edges = np.asarray(aabb[1] - aabb[0], np.float64)
    if is_dynamic and config.moving_area is not None:
        return _plan_moving_area(config, np.reshape(config.moving_area, (2, 3)), edges, clip)
    rows = time_rows(clip.frame_count, config.frames_per_row) if is_dynamic else 0
    resolution = [[max(2, round(n * e / edges.max())) for e in edges] + [rows] for n in config.resolutions]
    return Layout.of(np.array(resolution), config.channels)


def resolution_of(scale: Mapping[str, np.ndarray]) -> list[int]:
    """Return the texels of a scene's scale along x, y, z and t, 0 without space-time planes."""
    return [scale["xy"].shape[1], *scale["yz"].shape[1::-1], len(scale["xt"]) if "xt" in scale else 0]


def layout_of_planes(scales: Sequence[Mapping[str, np.ndarray]]) -> Layout:
    """Return a layout for planes of a scene that leaves out what its features do not depend on.

    Those are the texels beyond the area in which the features of a scale are other than 0 (`area_texels`), but for one
    on either side; and the space-time planes of scales where they are the identity, while those of others are not.

    Args:
        scales: the planes of each, (rows, columns, M), as many channels in all.
    """
    moves = [any((scale[name] != 1).any() for name in TIME_PLANES if name in scale) for scale in scales]
    resolution, spans = [], []
    for scale, is_moving in zip(scales, moves, strict=True):
        *axes, rows = resolution_of(scale)
        size = np.array(axes)
        resolution.append([*axes, rows if is_moving or not any(moves) else 0])
        texels = area_texels({name: np.any(scale[name], axis=2) for name in SPACE_PLANES})
        first, last = np.stack([0 * size, size - 1]) if texels is None else texels.T
        first, last = np.maximum(first - 1, 0), np.minimum(last + 1, size - 1)
        spans.append(np.stack([first, last - first + 1], axis=1))
    return Layout.of(np.array(resolution), scales[0]["xy"].shape[2], np.array(spans))


def _plan_moving_area(config: TrainConfig, area: np.ndarray, edges: np.ndarray, clip: Clip) -> Layout:
    """Return a layout of scales without space-time planes, each followed by one with them over the area (2, 3)."""
    rows = time_rows(clip.frame_count, max(1.0, config.frames_per_row / config.moving_rows))
    resolution, spans = [], []
    for n in config.resolutions:
        whole = [max(2, round(n * e / edges.max())) for e in edges]
        resolution.append([*whole, 0])
        spans.append([[0, count] for count in whole])
        texel = max(((area[1] - area[0]) * edges).max() / (config.moving_texels * n), edges.max() / (MOST_FINER * n))
        whole = [max(3, round(e / texel)) for e in edges]
        resolution.append([*whole, rows])
        low, high = (area * (np.array(whole) - 1)).round(6)
        first = np.maximum(np.floor(low) - 1, 0).astype(int)
        last = np.minimum(np.ceil(high) + 1, np.array(whole) - 1).astype(int)
        spans.append(np.stack([first, last - first + 1], axis=1).tolist())
    return Layout.of(np.array(resolution), config.channels, np.array(spans))


def time_rows(frame_count: int, frames_per_row: float) -> int:
    """Return the number of rows of the space-time planes."""
    return max(2, math.ceil(frame_count / frames_per_row))


def motion_grid_shape(config: TrainConfig, aabb: np.ndarray, layout: Layout) -> tuple[int, int, int, int] | None:
    """Return the nodes of the motion grid along t, z, y and x, or None where there is none.

    Along t there is one for each row of the space-time planes; cells are as nearly cubes as whole numbers allow.
    """
    if not config.motion_cells or not layout.is_dynamic:
        return None
    nz, ny, nx = grid_shape(aabb, config.motion_cells)
    return int(layout.resolution[:, 3].max()), nz + 1, ny + 1, nx + 1


def border_elements(layout: Layout) -> np.ndarray:
    """Return the elements of theta (n,) that stay 0: outermost texels of space planes where the box goes on beyond."""
    elements = np.arange(layout.size).reshape(-1, layout.channels)
    found = [np.zeros(0, np.int64)]
    for s, name, start, rows, columns in layout.planes():
        if name in TIME_PLANES:
            continue
        texels = elements[start // layout.channels :][: rows * columns].reshape(rows, columns, -1)
        for axis, lines in zip(map(AXES.index, name), (texels.swapaxes(0, 1), texels), strict=True):
            first, held = layout.first[s, axis], layout.held[s, axis]
            found += [lines[0].ravel()] * bool(first > 0)
            found += [lines[-1].ravel()] * bool(first + held < layout.resolution[s, axis])
    return np.unique(np.concatenate(found))
