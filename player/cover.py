"""Which blocks of a picture can show anything, and how far away: those into which an occupied cell may project. Rays of the others meet nothing.

A ray that meets nothing costs a graphics card little, but a processor that draws as much as a step of the march: there neighbouring
pixels run as one, and what one of them need not do is done all the same.
"""

from dataclasses import dataclass

import numpy as np

from kpc.format.cameras import Camera
from kpc.format.rans import compiled

MOST_CELLS = 8192
"""Of a grid with more that are not amid others, eight count as one, and so on."""

NEARER, FARTHER = 1 - 1e-5, 1 + 1e-5
"""For rounding."""


@dataclass(frozen=True, eq=False)
class Cover:
    """Cubes around all that is occupied.

    Attributes:
        centres: (N, 3) float64, world units.
        reach: by how much a point of one may be off its centre along any direction.
    """

    centres: np.ndarray
    reach: float

    @staticmethod
    def of(occupied: np.ndarray, aabb: np.ndarray) -> "Cover":
        """Of a (Nz, Ny, Nx) bool grid over a box. What has occupied cells all around is left out: who sees it sees them."""
        cell = (aabb[1] - aabb[0]).astype(np.float64) / occupied.shape[::-1]
        while len(shell := _shell(occupied)) > MOST_CELLS:
            occupied, cell = _halved(occupied), 2 * cell
        return Cover(aabb[0] + cell * (shell + 0.5), float(np.linalg.norm(cell) / 2))

    def ranges(self, camera: Camera, side: int) -> np.ndarray | None:
        """(rows, columns, 2) float32: how far away, along rays, what occupied cells hold is at least and at most, of blocks of `side` x `side`
        pixels, rows from below, the first of which begins with the lowest pixels. Of blocks that none projects into, 0 at most. None where
        the camera is so near to something that it may be all."""
        out = np.zeros((-(-camera.height // side), -(-camera.width // side), 2), np.float32)
        out[..., 0] = np.inf
        pose = camera.camera_to_world.astype(np.float64)
        lens = camera.fl_x / side, camera.fl_y / side, camera.cx / side, (camera.height - camera.cy) / side
        return out if _project(self.centres, self.reach, pose, lens, out) else None


@compiled()
def _shell(occupied):
    """(N, 3) of x, y, z: cells of a grid that are set and have not such at all six sides."""
    nz, ny, nx = occupied.shape
    out = np.empty((np.count_nonzero(occupied), 3), np.int64)
    count = 0
    for z in range(nz):
        for y in range(ny):
            for x in range(nx):
                if occupied[z, y, x]:
                    amid = 0 < x < nx - 1 and 0 < y < ny - 1 and 0 < z < nz - 1
                    if amid:
                        amid = occupied[z, y, x - 1] and occupied[z, y, x + 1] and occupied[z, y - 1, x] and occupied[z, y + 1, x]
                        amid = amid and occupied[z - 1, y, x] and occupied[z + 1, y, x]
                    if not amid:
                        out[count, 0], out[count, 1], out[count, 2] = x, y, z
                        count += 1
    return out[:count]


@compiled()
def _project(centres, reach, pose, lens, out):
    """`Cover.ranges`, into `out`; `lens` in blocks. Whether it can be told."""
    rows, columns = out.shape[:2]
    fl_x, fl_y, cx, cy = lens
    for n in range(len(centres)):
        away, offset = np.zeros(3), centres[n] - pose[:3, 3]
        for axis in range(3):
            for of in range(3):
                away[axis] += offset[of] * pose[of, axis]
        x, y, ahead = away[0], away[1], -away[2]
        if ahead <= -reach:
            continue
        nearest, farthest = ahead - reach, ahead + reach
        if not nearest > 0.1 * reach:
            return False
        left = int(max(np.floor(cx + fl_x * min((x - reach) / nearest, (x - reach) / farthest)), 0.0))
        right = int(min(np.floor(cx + fl_x * max((x + reach) / nearest, (x + reach) / farthest)) + 1.0, float(columns)))
        bottom = int(max(np.floor(cy + fl_y * min((y - reach) / nearest, (y - reach) / farthest)), 0.0))
        top = int(min(np.floor(cy + fl_y * max((y + reach) / nearest, (y + reach) / farthest)) + 1.0, float(rows)))
        distance = np.sqrt(x * x + y * y + ahead * ahead)
        near, far = np.float32((distance - reach) * NEARER), np.float32((distance + reach) * FARTHER)
        for row in range(bottom, top):
            for column in range(left, right):
                out[row, column, 0] = min(out[row, column, 0], near)
                out[row, column, 1] = max(out[row, column, 1], far)
    return True


def _halved(occupied: np.ndarray) -> np.ndarray:
    """At half the resolution: cells of which any of eight is occupied."""
    even = np.pad(occupied, [(0, n % 2) for n in occupied.shape])
    nz, ny, nx = (n // 2 for n in even.shape)
    return even.reshape(nz, 2, ny, 2, nx, 2).any((1, 3, 5))
