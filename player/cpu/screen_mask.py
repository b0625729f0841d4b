"""Which blocks of a picture can show anything: those that an occupied cell may project to. Rays of the others meet
nothing.

A ray that meets nothing costs a graphics card little, but the processor as much as a step of the march.
"""

from dataclasses import dataclass

import numpy as np

from kpc.format.scene.cameras import Camera
from kpc.format.scene.grid import dilate

# Occupied cells up to which each is projected; of more, eight count as one, and so on.
MOST_CELLS = 8192


@dataclass(frozen=True, eq=False)
class ScreenMask:
    """Cubes around everything that is occupied.

    Attributes:
        centres: (N, 3) float64, world units.
        reach: how far a point of a cube may be from its centre along any direction, world units.
    """

    centres: np.ndarray
    reach: float

    @staticmethod
    def of(occupied: np.ndarray, aabb: np.ndarray) -> "ScreenMask":
        """Make the mask of a (Nz, Ny, Nx) bool grid over a box. Cells with occupied cells all around are left out: they
        are hidden by those."""
        cell = (aabb[1] - aabb[0]).astype(np.float64) / occupied.shape[::-1]
        while np.count_nonzero(occupied) > MOST_CELLS:
            occupied, cell = _halved(occupied), 2 * cell
        around = np.pad(occupied, 1)
        shell = occupied & dilate(~around)[1:-1, 1:-1, 1:-1]
        z, y, x = np.nonzero(shell)
        return ScreenMask(aabb[0] + cell * (np.stack([x, y, z], axis=-1) + 0.5), float(np.linalg.norm(cell) / 2))

    def blocks(self, camera: Camera, side: int) -> np.ndarray | None:
        """Find the blocks of `side` x `side` pixels that a cube may project to.

        Returns:
            (rows, columns) bool, rows from below; None where the camera is so near to a cube that it may fill the
            picture.
        """
        x, y, z = ((self.centres - camera.camera_to_world[:3, 3]) @ camera.camera_to_world[:3, :3]).T
        ahead = -z > -self.reach
        x, y, nearest, farthest = x[ahead], y[ahead], -z[ahead] - self.reach, -z[ahead] + self.reach
        if not (nearest > 0.1 * self.reach).all():
            return None
        columns, rows = -(-camera.width // side), -(-camera.height // side)
        edges = []
        for offset, focal, centre, count in (
            (x, camera.fl_x, camera.cx, columns),
            (y, camera.fl_y, camera.height - camera.cy, rows),
        ):
            low, high = offset - self.reach, offset + self.reach
            first = np.floor((centre + focal * np.minimum(low / nearest, low / farthest)) / side)
            last = np.floor((centre + focal * np.maximum(high / nearest, high / farthest)) / side)
            edges += [np.clip(first, 0, count).astype(int), np.clip(last + 1, 0, count).astype(int)]
        left, right, bottom, top = edges
        # Each rectangle adds or takes away one at its corners, so that sums along rows and columns count rectangles.
        corners = np.zeros((rows + 1, columns + 1), int)
        for row, column, sign in ((bottom, left, 1), (bottom, right, -1), (top, left, -1), (top, right, 1)):
            np.add.at(corners, (row, column), sign)
        return np.asarray(corners.cumsum(0).cumsum(1)[:-1, :-1] > 0)


def _halved(occupied: np.ndarray) -> np.ndarray:
    """Return the grid at half the resolution: cells of which any of eight is occupied."""
    even = np.pad(occupied, [(0, n % 2) for n in occupied.shape])
    nz, ny, nx = (n // 2 for n in even.shape)
    return np.asarray(even.reshape(nz, 2, ny, 2, nx, 2).any((1, 3, 5)))
