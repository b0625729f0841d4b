"""What cameras say of the world: what is up, where they look, and how far apart they are."""

import numpy as np

# The cameras' horizontal axes give the vertical one if they spread by as much as this, as a ratio of singular values.
SPREAD = 0.08


def up_direction(poses: np.ndarray) -> np.ndarray:
    """Return what is up for most cameras, a unit vector.

    Cameras are seldom rolled: up is perpendicular to their x axes if these differ enough, else the mean of their y
    axes.

    Args:
        poses: (N, 4, 4) camera to world, OpenGL convention.
    """
    across, up = poses[:, :3, 0], poses[:, :3, 1].mean(0)
    _, values, axes = np.linalg.svd(across)
    if len(poses) > 2 and values[1] > SPREAD * values[0]:
        normal = axes[2] * np.sign(axes[2] @ up or 1.0)
        if normal @ up > 0.5 * np.linalg.norm(up):
            return normal
    return up / max(float(np.linalg.norm(up)), 1e-12)


def looked_at(poses: np.ndarray) -> np.ndarray:
    """Return the point nearest to all optical axes, by least squares; the mean centre where they are parallel."""
    forward = -poses[:, :3, 2]
    away = np.eye(3) - forward[:, :, None] * forward[:, None, :]  # (N, 3, 3) projections off the axes
    total = away.sum(0)
    if np.linalg.cond(total) > 1e6:
        return poses[:, :3, 3].mean(0)
    return np.linalg.solve(total, (away @ poses[:, :3, 3, None]).sum(0))[:, 0]


def extent(poses: np.ndarray) -> float:
    """Return the largest distance between two cameras."""
    centres = poses[:, :3, 3]
    return float(np.linalg.norm(centres[:, None] - centres, axis=2).max())
