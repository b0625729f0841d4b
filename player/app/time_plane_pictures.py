"""Pictures of time planes: what moves makes waves along the time axis, what is static is grey."""

import numpy as np

from kpc.format.scene.scene import TIME_PLANES, Scene

# Instants in a picture; longer planes are subsampled evenly.
MAX_INSTANTS = 1024
# The 8-bit level of what is static.
STATIC_LEVEL = 128
# Lines at the edges with less motion than this fraction of the maximum are cropped, but for a margin of a fraction of
# the rest's height.
MIN_MOTION, MARGIN = 0.25, 0.25
# The percentile of deviations that is shown at the ends of the range.
RANGE_PERCENTILE = 99.0


def time_plane_picture(scene: Scene, plane: str, scale: int) -> np.ndarray:
    """Return a picture of a time plane, time to the right and its other axis upwards.

    At each texel, the deviations from the mean over time are projected on the three principal components of all
    deviations, which become red, green and blue. Texels that do not change are STATIC_LEVEL.

    Args:
        scene: a dynamic scene.
        plane: "xt", "yt" or "zt".
        scale: of the plane, from 0.

    Returns:
        (N, T, 3) uint8.

    Raises:
        KeyError: the scene has no such plane.
    """
    values = scene.scales[scale][plane]
    rows = np.unique(np.linspace(0, len(values) - 1, min(len(values), MAX_INSTANTS)).round().astype(int))
    values = np.stack([values[row] for row in rows])
    deviations = np.where(np.ptp(values, axis=0) > 0, values - values.mean(axis=0, dtype=np.float64), 0.0)
    flat = deviations.reshape(-1, deviations.shape[2])
    _, vectors = np.linalg.eigh(flat.T @ flat)
    components = vectors[:, ::-1][:, :3]
    components = components * np.where(
        components[np.abs(components).argmax(0), np.arange(components.shape[1])] < 0, -1.0, 1.0
    )
    projected = np.zeros((*deviations.shape[:2], 3))
    projected[..., : components.shape[1]] = deviations @ components
    extent = (
        np.percentile(np.abs(projected[np.abs(deviations).max(axis=2) > 0]), RANGE_PERCENTILE, axis=0)
        if deviations.any()
        else np.ones(3)
    )
    shown = 0.5 + 0.5 * np.clip(projected / np.maximum(extent, 1e-6), -1.0, 1.0)
    return np.ascontiguousarray(np.rint(255 * shown).astype(np.uint8).swapaxes(0, 1)[::-1])


def moving_part(picture: np.ndarray) -> tuple[float, float]:
    """Return the fractions of a picture's height between which most motion lies; (0, 1) if nothing moves.

    Args:
        picture: (N, T, 3) uint8, of `time_plane_picture`.
    """
    motion = np.abs(picture.astype(float) - STATIC_LEVEL).mean(axis=(1, 2))
    if motion.max() == 0:
        return 0.0, 1.0
    moves = motion > MIN_MOTION * motion.max()
    first, last = np.flatnonzero(moves)[[0, -1]]
    margin = MARGIN * (last + 1 - first)
    return max(float(first - margin), 0.0) / len(moves), min(float(last + 1 + margin), len(moves)) / len(moves)


def time_planes(scene: Scene) -> list[tuple[str, int]]:
    """Return (plane, scale) of all time planes of a scene, scales from coarse to fine; none for a static scene."""
    return [(plane, scale) for plane in TIME_PLANES for scale in range(len(scene.scales))] if scene.is_dynamic else []
