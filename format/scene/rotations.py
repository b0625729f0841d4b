"""Rotations as unit quaternions (w, x, y, z), and as matrices."""

import numpy as np


def quaternion_of(rotation: np.ndarray) -> np.ndarray:
    """(..., 4): w x y z of (..., 3, 3) rotations, w >= 0; of a matrix that is nearly one, of the nearest (Bar-Itzhack 2000).

    It is the eigenvector of the largest eigenvalue of a symmetric matrix made of the rotation's entries.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = np.moveaxis(rotation, (-2, -1), (0, 1))
    symmetric = np.array([
        [xx + yy + zz, zy - yz, xz - zx, yx - xy],
        [zy - yz, xx - yy - zz, xy + yx, xz + zx],
        [xz - zx, xy + yx, yy - xx - zz, yz + zy],
        [yx - xy, xz + zx, yz + zy, zz - xx - yy],
    ])  # fmt: skip
    quaternion = np.linalg.eigh(np.moveaxis(symmetric, (0, 1), (-2, -1)))[1][..., -1]
    return np.where(quaternion[..., :1] >= 0, quaternion, -quaternion)


def rotation_of(quaternion: np.ndarray) -> np.ndarray:
    """The (3, 3) rotation of (w, x, y, z), of any length but 0."""
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip
