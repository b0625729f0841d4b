"""Conversion between rotation matrices and unit quaternions (w, x, y, z)."""

import numpy as np

# Quaternions whose dot product is above this are interpolated linearly.
NEARLY_EQUAL = 0.9995


def quaternion_of(rotation: np.ndarray) -> np.ndarray:
    """Return the unit quaternions (w, x, y, z), w >= 0, of rotation matrices.

    The quaternion is the eigenvector with the largest eigenvalue of a symmetric matrix of the rotation's entries
    (Bar-Itzhack 2000). A matrix that is only nearly a rotation gives the nearest one.

    Args:
        rotation: (..., 3, 3) float.

    Returns:
        (..., 4) float64.
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
    """Return the (3, 3) rotation matrix of a quaternion (w, x, y, z) of any length but 0."""
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


def slerp(one: np.ndarray, two: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Interpolate unit quaternions along great circles, the shorter way (Shoemake 1985).

    Args:
        one, two: (N, 4) float, of any order of components.
        share: (N, 1) in [0, 1], of the way from one to two.

    Returns:
        (N, 4) unit quaternions.
    """
    cosine = (one * two).sum(1, keepdims=True)
    two, cosine = np.where(cosine < 0, -two, two), np.abs(cosine)
    angle = np.arccos(np.clip(cosine, -1, 1))
    sine = np.where(cosine < NEARLY_EQUAL, np.sin(angle), 1.0)
    along = np.where(cosine < NEARLY_EQUAL, np.sin((1 - share) * angle) / sine, 1 - share) * one
    along += np.where(cosine < NEARLY_EQUAL, np.sin(share * angle) / sine, share) * two
    return np.asarray(along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12))
