"""The surfaces of a scene as coloured points: pixels of its cameras, moved to their depth and merged on a grid."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from kpc.format.scene.cameras import Camera
from kpc.format.scene.scene import Scene
from kpc.format.scene.space import Contraction
from kpc.player.cpu.reference import Rendering
from kpc.tools.exchange.field import density_gradients
from kpc.tools.rendering.content import straight_colours

# Pixels of less opacity show no surface.
LEAST_OPACITY = 0.5
# A depth may differ by this part from the median of its neighbours: others lie between two surfaces, on none of them.
LARGEST_JUMP = 0.02
# The longest edge of the box has at most this many cells of the grid.
MAX_CELLS = 1 << 16


@dataclass(frozen=True)
class Cloud:
    """Coloured points.

    Attributes:
        points: (N, 3) float64, world.
        colours: (N, 3) float64 in [0, 1], display values (sRGB).
        normals: (N, 3) float64 unit vectors, or None.
    """

    points: np.ndarray
    colours: np.ndarray
    normals: np.ndarray | None = None


def surface_points(pictures: Iterable[tuple[Camera, Rendering]], bounds: np.ndarray, spacing: float) -> Cloud:
    """Return the surface points that pictures show.

    A pixel of ray o + t d and depth t is the point o + t d. Points in one cell of a grid become their mean, so memory
    grows with the surface and not with the number of pictures.

    Args:
        pictures: cameras and what they see, over black.
        bounds: (2, 3), the corners of the box outside of which points are left out.
        spacing: the edge of a cell, world units.
    """
    keys, sums = np.zeros(0, np.int64), np.zeros((0, 7))
    cells = np.ceil((bounds[1] - bounds[0]) / spacing).astype(np.int64) + 1
    for camera, picture in pictures:
        points, colours = _seen(camera, picture, bounds)
        cell = np.floor((points - bounds[0]) / spacing).astype(np.int64)
        new_keys = (cell[:, 2] * cells[1] + cell[:, 1]) * cells[0] + cell[:, 0]
        rows = np.concatenate([points, colours, np.ones((len(points), 1))], axis=1)
        keys, where = np.unique(np.concatenate([keys, new_keys]), return_inverse=True)
        rows = np.concatenate([sums, rows])
        sums = np.stack([np.bincount(where, column, len(keys)) for column in rows.T], axis=1)
    return Cloud(sums[:, :3] / sums[:, 6:], sums[:, 3:6] / sums[:, 6:])


def normals_of(scene: Scene, time: float, points: np.ndarray) -> np.ndarray:
    """Return the outward normals at points, (N, 3): against the gradient of the density; +y where there is none."""
    gradients = density_gradients(scene, time, points)
    lengths = np.linalg.norm(gradients, axis=1, keepdims=True)
    return np.where(lengths > 0, -gradients / np.where(lengths > 0, lengths, 1), [0.0, 1.0, 0.0])


def is_clipped(scene: Scene) -> bool:
    """Return whether a scene goes on beyond its box, which exports do not hold."""
    return isinstance(scene.mapping, Contraction)


def _seen(camera: Camera, picture: Rendering, bounds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the surface points of a picture that lie in the box, and their colours, both (N, 3)."""
    depth = np.where((picture.opacity >= LEAST_OPACITY) & np.isfinite(picture.depth), picture.depth, np.nan)
    padded = np.pad(depth, 1, mode="edge")
    height, width = depth.shape
    around = np.stack([padded[y : y + height, x : x + width] for y in range(3) for x in range(3)])
    around = np.where(np.isnan(around), np.inf, around)  # beside nothing: a silhouette, whose own side decides
    known = np.isfinite(around).sum(0)
    middle = np.take_along_axis(np.sort(around, axis=0), np.maximum(known - 1, 0)[None] // 2, axis=0)[0]
    with np.errstate(invalid="ignore"):
        is_surface = np.abs(depth - middle) <= LARGEST_JUMP * middle
    origins, directions = camera.rays()
    chosen = np.flatnonzero(is_surface)
    points = origins[chosen] + depth.ravel()[chosen, None].astype(np.float64) * directions[chosen]
    inside = ((points >= bounds[0]) & (points <= bounds[1])).all(axis=1)
    return points[inside], straight_colours(picture).reshape(-1, 3)[chosen[inside]].astype(np.float64)
