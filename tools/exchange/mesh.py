"""The surface of a scene as a coloured mesh: an isosurface of its density by marching cubes (scikit-image)."""

from dataclasses import dataclass

import numpy as np

from kpc.format.common.errors import UsageError
from kpc.format.common.progress import in_parts, part
from kpc.format.scene.rig import Rig
from kpc.format.scene.scene import LOG_DENSITY_LIMIT, Scene
from kpc.player.cpu.reference import RAYS_AT_ONCE, Rendering, SceneAtTime, render_rays
from kpc.tools.exchange.field import box_points, density_grid

# Rays that give a vertex its colour begin this many cells before it.
AHEAD_CELLS = 2.0


@dataclass(frozen=True)
class Mesh:
    """A coloured mesh.

    Attributes:
        points: (N, 3) float64 vertices, world.
        triangles: (M, 3) int64 vertices of triangles, counter-clockwise from outside.
        normals: (N, 3) float64 outward unit vectors.
        colours: (N, 3) float64 in [0, 1], display values (sRGB).
    """

    points: np.ndarray
    triangles: np.ndarray
    normals: np.ndarray
    colours: np.ndarray


def surface_mesh(scene: Scene, time: float, resolution: int, level: float) -> Mesh:
    """Return the isosurface of the density in the box of a scene at a time in [0, 1].

    A vertex is coloured as the one of the scene's cameras sees it that faces it most, by a ray that begins just before
    it, so that nothing in front of it counts.

    Args:
        scene: the scene.
        time: in [0, 1] over it.
        resolution: points of the grid along the longest edge of the box.
        level: density of the surface, per longest edge of the box.

    Raises:
        UsageError: the density does not cross the level.
    """
    from skimage.measure import marching_cubes

    edges = (scene.aabb[1] - scene.aabb[0]).astype(np.float64)
    counts = np.maximum(np.round(edges / edges.max() * (resolution - 1)).astype(int) + 1, 2)
    nx, ny, nz = counts.tolist()
    with part(1 / 2):
        grid = density_grid(scene, SceneAtTime.of(scene, time), (nx, ny, nz))
    if not level < grid.max():
        raise UsageError(
            f"--density {level:g}: no surface; the density goes up to {grid.max():.3g} per longest edge of the box"
        )
    # The logarithm varies more evenly from point to point, and what lies outside the box is empty, so the mesh closes.
    np.log(np.maximum(grid, np.float32(np.exp(-LOG_DENSITY_LIMIT)), out=grid), out=grid)
    grid = np.pad(grid, 1, constant_values=-LOG_DENSITY_LIMIT)
    vertices, triangles, _, _ = marching_cubes(grid, np.log(level), allow_degenerate=False)
    points = box_points(scene, np.clip((vertices - 1) / (counts - 1), 0, 1))
    triangles = _outward(points, triangles.astype(np.int64))
    normals = _vertex_normals(points, triangles)
    spacing = float((scene.bounds[1] - scene.bounds[0]).max()) / (resolution - 1)
    with part(1 / 2):
        colours = _colours(scene, time, points, normals, AHEAD_CELLS * spacing)
    return Mesh(points, triangles, normals, colours)


def _outward(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return the triangles in the order that is counter-clockwise from outside.

    All of them have one sense, and the volume that they enclose is positive if it is that one.
    """
    a, b, c = (points[triangles[:, corner]] - points.mean(0) for corner in range(3))
    return triangles if (a * np.cross(b, c)).sum() >= 0 else triangles[:, ::-1]


def _vertex_normals(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return the mean normals of the triangles at each vertex, weighted by area: (N, 3) unit vectors."""
    a, b, c = (points[triangles[:, corner]] for corner in range(3))
    faces = np.cross(b - a, c - a)
    sums = np.stack(
        [np.bincount(triangles.ravel(), np.repeat(faces[:, axis], 3), len(points)) for axis in range(3)], axis=1
    )
    lengths = np.linalg.norm(sums, axis=1, keepdims=True)
    return np.where(lengths > 0, sums / np.where(lengths > 0, lengths, 1), [0.0, 1.0, 0.0])


def _colours(scene: Scene, time: float, points: np.ndarray, normals: np.ndarray, ahead: float) -> np.ndarray:
    eyes = np.stack([camera.camera_to_world[:3, 3] for camera in Rig.of(scene).cameras])
    directions, facing = -normals, np.full(len(points), -2.0)
    for eye in eyes:
        towards = points - eye
        towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)
        cosine = -(towards * normals).sum(1)
        directions = np.where((cosine > facing)[:, None], towards, directions)
        facing = np.maximum(facing, cosine)
    origins = (points - ahead * directions).astype(np.float32)
    colours = []
    for start in in_parts(range(0, len(points), RAYS_AT_ONCE)):
        some = slice(start, start + RAYS_AT_ONCE)
        colours.append(_straight(scene, render_rays(scene, origins[some], directions[some].astype(np.float32), time)))
    return np.concatenate(colours)


def _straight(scene: Scene, seen: Rendering) -> np.ndarray:
    """Return the colours of rays without the background behind them."""
    covering = seen.rgb - (1 - seen.opacity)[:, None] * scene.background
    opacity = seen.opacity[:, None]
    straight = np.divide(covering, opacity, out=np.zeros_like(covering), where=opacity > 1e-6)
    return np.clip(straight, 0, 1).astype(np.float64)
