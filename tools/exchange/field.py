"""The density of a scene at points and on grids, in blocks, with empty cells skipped."""

import numpy as np

from kpc.format.common.progress import in_parts
from kpc.format.scene.scene import Scene
from kpc.format.scene.space import Contraction, DeviceCoordinates, contract
from kpc.player.cpu.reference import SceneAtTime, density, features

# Points at which the field is evaluated at once.
BLOCK = 1 << 16
# Half the distance over which gradients are taken, in edges of the box.
GRADIENT_REACH = 1.0 / 512


def plane_coordinates(scene: Scene, points: np.ndarray) -> np.ndarray:
    """Return the coordinates in the planes of world points, both (N, 3)."""
    if isinstance(scene.mapping, Contraction):
        return contract(points, scene.aabb)[0]
    if isinstance(scene.mapping, DeviceCoordinates):
        points = scene.mapping.to_device(points)
    return np.asarray((points - scene.aabb[0]) / (scene.aabb[1] - scene.aabb[0]))


def box_points(scene: Scene, shares: np.ndarray) -> np.ndarray:
    """Return the world points at parts, (N, 3) in [0, 1], of the edges of the box."""
    points = scene.aabb[0] + shares * (scene.aabb[1] - scene.aabb[0]).astype(np.float64)
    return scene.mapping.to_world(points) if isinstance(scene.mapping, DeviceCoordinates) else np.asarray(points)


def densities(scene: Scene, moment: SceneAtTime, coordinates: np.ndarray) -> np.ndarray:
    """Return the density at coordinates in the planes, (N, 3): (N,) float32 per longest edge of the box.

    It is 0 outside the planes, and in empty cells of the occupancy grid.
    """
    found = np.zeros(len(coordinates), np.float32)
    cells = np.array(moment.occupied.shape[::-1])
    for start in range(0, len(coordinates), BLOCK):
        u = coordinates[start : start + BLOCK].astype(np.float32)
        inside = np.all((u >= 0) & (u <= 1), axis=1)
        x, y, z = np.clip((np.where(inside[:, None], u, 0) * cells).astype(np.int64), 0, cells - 1).T
        chosen = np.flatnonzero(inside & moment.occupied[z, y, x])
        if len(chosen):
            found[start + chosen] = density(scene.decoder, features(scene, moment, u[chosen]))
    return found


def density_grid(scene: Scene, moment: SceneAtTime, counts: tuple[int, int, int]) -> np.ndarray:
    """Return the density on a grid over the box, (Nx, Ny, Nz) float32, whose corners are those of the box.

    Args:
        scene: the scene.
        moment: it at a time.
        counts: Nx, Ny, Nz.
    """
    x, y, z = (np.linspace(0, 1, count) for count in counts)
    grid = np.empty(counts, np.float32)
    for number, share in enumerate(in_parts(x.tolist())):
        plane = np.stack(np.broadcast_arrays(share, *np.meshgrid(y, z, indexing="ij")), axis=-1).reshape(-1, 3)
        # with a contraction the box is the inner half of the planes
        inner = plane / 2 + 0.25 if isinstance(scene.mapping, Contraction) else plane
        grid[number] = densities(scene, moment, inner).reshape(counts[1:])
    return grid


def density_gradients(scene: Scene, time: float, points: np.ndarray) -> np.ndarray:
    """Return the gradient of the density at world points, both (N, 3), by central differences."""
    moment = SceneAtTime.of(scene, time)
    reach = GRADIENT_REACH * float((scene.bounds[1] - scene.bounds[0]).max())
    slopes = []
    for axis in in_parts(tuple(np.eye(3))):
        ahead, behind = (plane_coordinates(scene, points + sign * reach * axis) for sign in (1, -1))
        slopes.append((densities(scene, moment, ahead) - densities(scene, moment, behind)) / (2 * reach))
    return np.stack(slopes, axis=1).astype(np.float64)
