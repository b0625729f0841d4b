"""What moves on corresponding epipolar lines of two cameras whose places are known.

A point that moves is seen by both cameras on lines that lie in one plane with their centres. So how much moves on each
such line, over time, is alike for both, and far more distinct than how much moves in the whole picture; it needs no
features, and cameras may see the thing from different sides. After Ben-Artzi, Halperin, Werman and Peleg, "Epipolar
geometry based on line similarity", ICPR 2016, whose lines only know whether anything moves on them.
"""

import numpy as np

from kpc.encoder.poses.epipolar_lines import looks
from kpc.encoder.poses.motion_sync import Signal, sampled
from kpc.encoder.poses.structure import PlacedView
from kpc.encoder.poses.survey import Survey

# Sheaves of epipolar lines, each with a motion of its own.
SHEAVES = 24
# They move by themselves, so that each frame counts three times: so counted, no sure offset of some hundreds that were
# measured was wrong.
FRAMES_AS_ONE = 1 / 3
# Cameras nearer to each other than this share of their distance from the rest have no epipolar lines.
LEAST_BASELINE = 1e-6


def directions(view: PlacedView, seen: Survey) -> np.ndarray:
    """Return where the squares of a camera's `changes` look in the world, (rows * columns, 3) float64."""
    y, x = (np.indices(seen.changes.shape[1:]).reshape(2, -1) + 0.5) * seen.square
    return looks(view, x, y)


def sheaves(one: PlacedView, two: PlacedView, rays: tuple[np.ndarray, np.ndarray]) -> list[np.ndarray] | None:
    """Return for each camera the sheaf of epipolar lines of each square, (N,) int; -1 for what only one camera sees.

    Args:
        one, two: the cameras.
        rays: their `directions`.
    """
    baseline = two.camera_to_world[:3, 3] - one.camera_to_world[:3, 3]
    length = float(np.linalg.norm(baseline))
    if length < LEAST_BASELINE:
        return None
    baseline = baseline / length
    forward = -(one.camera_to_world[:3, 2] + two.camera_to_world[:3, 2])
    forward = forward - (forward @ baseline) * baseline
    if np.linalg.norm(forward) < 0.05:  # they look at each other
        return None
    forward /= np.linalg.norm(forward)
    across = np.cross(baseline, forward)
    angles = [np.arctan2(ray @ across, ray @ forward) for ray in rays]
    ends = np.array([np.quantile(angle, (0.01, 0.99)) for angle in angles])
    low, high = ends[:, 0].max(), ends[:, 1].min()
    if high <= low:
        return None
    found = [np.floor((angle - low) / (high - low) * SHEAVES).astype(int) for angle in angles]
    return [np.where((0 <= sheaf) & (sheaf < SHEAVES), sheaf, -1) for sheaf in found]


def sheaf_signal(times: np.ndarray, seen: Survey, sheaf: np.ndarray, step_s: float) -> Signal | None:
    """Return how much moves on each sheaf of epipolar lines over time.

    What changes everywhere at once, such as the noise of coding, is taken out: things that move are small.

    Args:
        times: (N,) seconds of the frames.
        seen: of the camera.
        sheaf: (squares,) int, of `sheaves`.
        step_s: seconds.
    """
    changes = seen.changes.reshape(len(seen.changes), -1).astype(np.float32)
    changes = np.maximum(changes - np.median(changes, axis=1, keepdims=True), 0)
    used = sheaf >= 0
    sums = np.zeros((len(sheaf), SHEAVES), np.float32)
    sums[np.flatnonzero(used), sheaf[used]] = 1
    motion = changes @ (sums / np.maximum(sums.sum(0), 1))
    return sampled(times[: len(motion)], motion, step_s)
