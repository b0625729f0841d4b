"""What moves, and how much: the field at a point now, against the same point at other times of the clip.

Time planes that differ from 1 say little about visible motion: fitted planes differ a little nearly everywhere, and one
that is constant but not 1 moves nothing. So the field itself is compared. A point at time t has

    q(t) = (alpha rgb, alpha)       alpha = 1 - exp(-sigma cell / extent), 0 where the occupancy grid is not set

`cell` being the mean edge of a cell of the occupancy grid, and it changes at t by the mean over INSTANTS t' of max
|q(t) - q(t')|.
"""

import numpy as np

from kpc.format.scene.rig import Rig
from kpc.format.scene.scene import Scene
from kpc.format.scene.space import Contraction, DeviceCoordinates
from kpc.player.cpu import reference
from kpc.player.cpu.reference import SceneAtTime

# Times that are compared with.
INSTANTS = (np.arange(8) + 0.5) / 8
# A change up to STILL counts as none: noise of fitting and rounding.
STILL = 0.1
# Cells that a share is computed from; of more, as many, evenly spread.
CELLS = 8192
CELLS_AT_ONCE = 1 << 20


def motionless_share(scene: Scene) -> float:
    """Return the share of the cells that are ever occupied whose middle never changes by more than STILL, as the
    opening camera sees it; 1 where none is occupied."""
    ever = scene.occupancy.any(axis=0)
    cells = _spread(ever.reshape(-1), CELLS)
    if not len(cells):
        return 1.0
    middles = (np.stack(np.unravel_index(cells, ever.shape)[::-1], axis=1) + 0.5) / ever.shape[::-1]
    pose = Rig.of(scene).cameras[0].camera_to_world.astype(np.float32)
    terms = _terms(scene, pose[None, :3, 3], -pose[None, :3, 2])
    looks = np.stack(
        [_appearances_at(scene, middles.astype(np.float32), terms, float(instant)) for instant in INSTANTS]
    )
    return float((np.max([_change(now, looks) for now in looks], axis=0) <= STILL).mean())


def _spread(cells: np.ndarray, most: int) -> np.ndarray:
    """Return indices of set cells among (N,) bool, at most so many, evenly spread; in blocks, since all of them may not
    fit in memory."""
    count = int(np.count_nonzero(cells))
    wanted = np.unique(np.linspace(0, count - 1, min(count, most)).astype(np.int64))
    found, before = [np.empty(0, np.int64)], 0
    for start in range(0, len(cells), CELLS_AT_ONCE):
        here = start + np.flatnonzero(cells[start : start + CELLS_AT_ONCE])
        low, high = np.searchsorted(wanted, (before, before + len(here)))
        found.append(here[wanted[low:high] - before])
        before += len(here)
    return np.concatenate(found)


def _change(now: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the mean over (K, N, 4) others of max |now - other|: (N,)."""
    return np.asarray(np.abs(others - now).max(axis=2).mean(axis=0))


def _appearances_at(scene: Scene, u: np.ndarray, terms: np.ndarray, time: float) -> np.ndarray:
    """Return q of points (N, 3) in [0, 1]^3 at a time, given the `_terms` of as many rays or of one: (N, 4)."""
    moment, decoder = SceneAtTime.of(scene, time), scene.decoder
    cells = np.array(moment.occupied.shape[::-1])
    x, y, z = np.clip((u * cells).astype(np.int32), 0, cells - 1).T
    edges = (scene.aabb[1] - scene.aabb[0]) * (2 if isinstance(scene.mapping, Contraction) else 1)
    f = reference.features(scene, moment, u)
    alpha = 1 - np.exp(-reference.density(decoder, f) * np.float32((edges / cells).mean() / scene.extent))
    alpha = np.where(moment.occupied[z, y, x], alpha, 0)[:, None]
    rgb = reference.colour(decoder, f, terms)
    return np.concatenate([alpha * rgb, alpha], axis=1)


def _terms(scene: Scene, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """`kpc.player.cpu.reference.ray_terms` of rays of the world, (N, 3) and (N, 3), with the average appearance."""
    if isinstance(scene.mapping, DeviceCoordinates):
        directions = scene.mapping.rays(origins, directions).directions
    return reference.ray_terms(scene.decoder, directions, reference.appearance_code(scene, None))
