"""Predicting a picture from the one before: reprojection, and the sample pixels that show where the prediction fails.

A picture is divided into blocks of BLOCK x BLOCK pixels. One *sample pixel* of each block is marched for every picture,
all sixteen by turns; a block whose sample pixel differs from the prediction by more than a tolerance is mismatched, and
marched whole.
"""

from typing import NamedTuple

import numpy as np

from kpc.format.scene.cameras import Camera
from kpc.jit import compiled
from kpc.player.cpu.interpolation import interpolate_pixel
from kpc.player.cpu.lanes import FAST, F, I, kernel_part
from kpc.player.cpu.picture import BLOCK, Picture
from kpc.player.cpu.threads import share_out

# Between the opacities of a block's corners, from which on it counts as an edge against the background.
EDGE = 0.1
# Distance of what no ray met, in distances of the eye from where it was before.
NOWHERE = F(1e6)
# Pixels across and up to the neighbours whose distances are looked at.
AROUND = 2

HALF, BEHIND = F(0.5), F(1e-6)


class Pinhole(NamedTuple):
    """A camera for the kernels, float32."""

    lens: np.ndarray  # (4,) fl_x, fl_y, cx, cy, pixels
    axes: np.ndarray  # (3, 3) right, up and backward in the world, as columns
    eye: np.ndarray  # (3,) in the world

    @staticmethod
    def of(camera: Camera) -> "Pinhole":
        """Return a camera with cy counted from below, as the rows of a Picture."""
        lens = camera.fl_x, camera.fl_y, camera.cx, camera.height - camera.cy
        pose = camera.camera_to_world
        return Pinhole(*(np.ascontiguousarray(array, np.float32) for array in (lens, pose[:3, :3], pose[:3, 3])))


def sample_pixels(turn: int, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return the row and column, (rows, columns) int64 each, of the sample pixel of every block of a picture of (width,
    height).

    Sixteen turns visit every pixel; those that come next to each other are far apart, and neighbouring blocks are out
    of step, so that an edge does not slip through between them.
    """
    width, height = size
    rows, columns = np.mgrid[: -(-height // BLOCK), : -(-width // BLOCK)]
    k = turn + 3 * columns + 5 * rows & 15
    x, y = 2 * ((k ^ k >> 1) & 1) + ((k >> 2 ^ k >> 3) & 1), 2 * (k & 1) + (k >> 2 & 1)
    return np.minimum(BLOCK * rows + y, height - 1), np.minimum(BLOCK * columns + x, width - 1)


def mismatched_blocks(sampled: np.ndarray, predicted: np.ndarray, tolerance: float) -> np.ndarray:
    """Find the blocks whose sample pixel is off its prediction by more than a tolerance, or a neighbour's by twice as
    much.

    Args:
        sampled, predicted: (rows, columns, 4) float32, rgba of the sample pixels.

    Returns:
        (rows, columns) bool.
    """
    off = np.abs(sampled - predicted).max(axis=2)
    around = np.pad(off, 1, mode="edge")
    around = np.maximum(np.maximum(around[:-2], around[1:-1]), around[2:])
    around = np.maximum(np.maximum(around[:, :-2], around[:, 1:-1]), around[:, 2:])
    return np.asarray(np.maximum(off, np.float32(0.5) * around) > tolerance)


def edge_blocks(opacity: np.ndarray) -> np.ndarray:
    """Find the blocks at an edge against the background: it is never predicted to the pixel, and sample pixels meet it
    too seldom.

    Args:
        opacity: (H, W) float32.

    Returns:
        (rows, columns) bool: blocks over whose 3 x 3 corners and middles, each the mean of four pixels, opacity varies
        by more than EDGE.
    """
    rows, columns = (-(-side // BLOCK) for side in opacity.shape)
    ends = [(1, 1 + BLOCK * count - side) for count, side in zip((rows, columns), opacity.shape, strict=True)]
    whole = np.pad(opacity, ends, mode="edge")
    means = 0.25 * (whole[0::2, 0::2] + whole[1::2, 0::2] + whole[0::2, 1::2] + whole[1::2, 1::2])
    least, most = means, means
    for axis in (0, 1):
        first, middle, last = (
            tuple(slice(n, means.shape[axis] - 2 + n, 2) if a == axis else slice(None) for a in (0, 1))
            for n in range(3)
        )
        least = np.minimum(np.minimum(least[first], least[middle]), least[last])
        most = np.maximum(np.maximum(most[first], most[middle]), most[last])
    return np.asarray(most - least > EDGE)


def predict(old: Picture, before: Camera, new: Picture, now: Camera) -> None:
    """Write a picture as another camera saw it before to `new`, as the camera sees it now.

    Each pixel takes its colour from where the point that it shows was seen. How far away that point is comes from the
    old picture, too: first the nearest around the same pixel, since what is in front may have moved over it, then what
        is found where that leads; if nothing is in front
    there, that is what lies behind.
    """
    distances = np.empty(old.rgba.shape[:2], np.float32)
    cameras = Pinhole.of(before), Pinhole.of(now)
    share_out(lambda part: _distances(part.start, part.stop, *cameras, old, distances), len(distances))
    share_out(lambda part: _gather(part.start, part.stop, *cameras, old, distances, new), len(distances))


@kernel_part
def _direction(camera, x, y):
    """Return the unit direction through a point of the raster, rows from below."""
    lens, axes = camera.lens, camera.axes
    right, up = (x - lens[2]) / lens[0], (y - lens[3]) / lens[1]
    dx = axes[0, 0] * right + axes[0, 1] * up - axes[0, 2]
    dy = axes[1, 0] * right + axes[1, 1] * up - axes[1, 2]
    dz = axes[2, 0] * right + axes[2, 1] * up - axes[2, 2]
    length = np.sqrt(dx * dx + dy * dy + dz * dz)
    return dx / length, dy / length, dz / length


@kernel_part
def _pixel(x, count):
    """Return the pixel that holds x, the nearest one where x is outside or NaN."""
    x = x if x > F(0) else F(0)
    return I(x if x < F(count - 1) else F(count - 1))


@kernel_part
def _project(camera, distance, dx, dy, dz, before):
    """Return where on its raster the camera `before` sees the point at a distance from `camera`'s eye; far outside if
    behind it."""
    axes, lens = before.axes, before.lens
    px = camera.eye[0] + distance * dx - before.eye[0]
    py = camera.eye[1] + distance * dy - before.eye[1]
    pz = camera.eye[2] + distance * dz - before.eye[2]
    right = axes[0, 0] * px + axes[1, 0] * py + axes[2, 0] * pz
    up = axes[0, 1] * px + axes[1, 1] * py + axes[2, 1] * pz
    ahead = -(axes[0, 2] * px + axes[1, 2] * py + axes[2, 2] * pz)
    if not ahead > BEHIND:
        return F(-1e9), F(-1e9)
    return lens[2] + lens[0] * right / ahead, lens[3] + lens[1] * up / ahead


@compiled(**FAST)
def _distances(first, last, before, now, old, distances):
    """For rows of the old picture, compute how far what each pixel shows is from the eye of now."""
    for row in range(first, last):
        for column in range(distances.shape[1]):
            opacity = old.rgba[row, column, 3]
            dx, dy, dz = _direction(before, F(column) + HALF, F(row) + HALF)
            t = old.sums[row, column, 0] / max(opacity, F(1e-30))
            x = before.eye[0] + t * dx - now.eye[0]
            y = before.eye[1] + t * dy - now.eye[1]
            z = before.eye[2] + t * dz - now.eye[2]
            distances[row, column] = np.sqrt(x * x + y * y + z * z) if opacity > F(0) else NOWHERE


@compiled(**FAST)
def _gather(first, last, before, now, old, distances, new):
    """Fill rows of the new picture."""
    height, width = distances.shape
    for row in range(first, last):
        below, above = max(row - AROUND, 0), min(row + AROUND, height - 1)
        for column in range(width):
            left, right = max(column - AROUND, 0), min(column + AROUND, width - 1)
            nearest = min(
                min(distances[below, left], distances[below, right]),
                min(distances[above, left], distances[above, right]),
            )
            nearest = min(nearest, distances[row, column])
            dx, dy, dz = _direction(now, F(column) + HALF, F(row) + HALF)
            x, y = _project(now, nearest, dx, dy, dz, before)
            distance = distances[_pixel(y, height), _pixel(x, width)]
            x, y = _project(now, distance, dx, dy, dz, before)
            i, j = _pixel(y, height), _pixel(x, width)
            distance = distances[i, j]
            interpolate_pixel(old.rgba, x, y, new.rgba[row, column])
            opacity = new.rgba[row, column, 3]
            new.sums[row, column, 0] = distance * opacity if opacity > F(0) else F(0)
            new.sums[row, column, 1] = old.sums[i, j, 1]
