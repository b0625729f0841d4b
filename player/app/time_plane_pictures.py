"""Time planes as pictures: what moves shows as waves along the time axis, what stands still as even grey."""

import numpy as np
from kpc.format.scene.scene import TIME_PLANES, Scene

MOST_ROWS = 1024
"""Instants in a picture; of more, as many, evenly spread."""
STILL = 128
"""The level of what stands still."""
QUIET, MARGIN = 0.25, 0.25
"""Lines with less motion than this share of the liveliest are left out at the edges, but for a margin of the others' height."""
SPREAD = 99.0
"""This percentile of deviations comes out at the ends of the range."""


def time_plane_picture(scene: Scene, plane: str, scale: int) -> np.ndarray:
    """uint8 (N, T, 3): a time plane of a dynamic scene, "xt", "yt" or "zt", time to the right, its other axis upwards.

    Each place's deviations from its mean over time are projected on the three directions among the channels in which they are
    greatest (principal components), which become red, green, blue. Columns that stay the same, at 1 or elsewhere, are STILL.

    Raises:
        KeyError: the scene has no such plane.
    """
    values = scene.scales[scale][plane]
    rows = np.unique(np.linspace(0, len(values) - 1, min(len(values), MOST_ROWS)).round().astype(int))
    values = np.stack([values[row] for row in rows])
    deviations = np.where(np.ptp(values, axis=0) > 0, values - values.mean(axis=0, dtype=np.float64), 0.0)
    flat = deviations.reshape(-1, deviations.shape[2])
    _, vectors = np.linalg.eigh(flat.T @ flat)
    main = vectors[:, ::-1][:, :3]
    main = main * np.where(main[np.abs(main).argmax(0), np.arange(main.shape[1])] < 0, -1.0, 1.0)
    seen = np.zeros((*deviations.shape[:2], 3))
    seen[..., : main.shape[1]] = deviations @ main
    most = (
        np.percentile(np.abs(seen[np.abs(deviations).max(axis=2) > 0]), SPREAD, axis=0)
        if deviations.any()
        else np.ones(3)
    )
    shown = 0.5 + 0.5 * np.clip(seen / np.maximum(most, 1e-6), -1.0, 1.0)
    return np.ascontiguousarray(np.rint(255 * shown).astype(np.uint8).swapaxes(0, 1)[::-1])


def moving_part(picture: np.ndarray) -> tuple[float, float]:
    """Between which shares of a picture's height the most of what moves lies, with a margin; all of it where nothing does."""
    motion = np.abs(picture.astype(float) - STILL).mean(axis=(1, 2))
    if motion.max() == 0:
        return 0.0, 1.0
    moves = motion > QUIET * motion.max()
    first, last = np.flatnonzero(moves)[[0, -1]]
    margin = MARGIN * (last + 1 - first)
    return max(float(first - margin), 0.0) / len(moves), min(float(last + 1 + margin), len(moves)) / len(moves)


def time_planes(scene: Scene) -> list[tuple[str, int]]:
    """The planes there are pictures of: (plane, scale), scales from coarse to fine."""
    return [(plane, scale) for plane in TIME_PLANES for scale in range(len(scene.scales))] if scene.is_dynamic else []
