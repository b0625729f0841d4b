"""The world that found cameras are put into: z up, its origin where they look, and a size."""

from dataclasses import replace

import numpy as np

from kpc.encoder.poses.structure import Structure

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


def oriented(structure: Structure, scale: float) -> Structure:
    """Return the structure turned to z up, with its origin where the cameras look, `scale` times as large."""
    poses = np.stack([view.camera_to_world for view in structure.views.values()])
    up = up_direction(poses)
    forward = -poses[:, :3, 2].mean(0)
    y = forward - (forward @ up) * up
    if np.linalg.norm(y) < 1e-6:
        y = np.linalg.svd(up[None])[2][1]
    y /= np.linalg.norm(y)
    turn = np.stack([np.cross(y, up), y, up])  # rows: the new x, y and z axes
    origin = looked_at(poses)
    moved = {number: _moved(view.camera_to_world, turn, origin, scale) for number, view in structure.views.items()}
    return replace(
        structure,
        views={number: replace(view, camera_to_world=moved[number]) for number, view in structure.views.items()},
        points=scale * (structure.points - origin) @ turn.T,
    )


def _moved(pose: np.ndarray, turn: np.ndarray, origin: np.ndarray, scale: float) -> np.ndarray:
    moved = np.eye(4)
    moved[:3, :3] = turn @ pose[:3, :3]
    moved[:3, 3] = scale * turn @ (pose[:3, 3] - origin)
    return moved
