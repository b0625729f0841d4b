"""Keeping a view within the limits from where a scene holds. No window, no OpenGL."""

import math

import numpy as np

from kpc.format.scene.metadata import ViewLimits
from kpc.format.scene.rig import look_at
from kpc.player.app.controls import OrbitView

# Seconds in which a view outside the limits comes back by all but 1/e of the way.
RETURN_S = 0.15
# A view that is as near as this to the limits is put on them: angles in radians, lengths over the largest distance.
NEARLY = 1e-4


def kept(view: OrbitView, limits: ViewLimits, seconds: float) -> OrbitView:
    """Return a view that has moved towards the limits for some time; the same view if it lies within them.

    The eye moves along the sphere around the limits' focus and to or from it, the point that is looked at straight
    towards that focus; what lies within its limits does not move.

    Args:
        view: where the user has moved it.
        limits: those of the scene.
        seconds: since the last call.
    """
    share = 1.0 - math.exp(-seconds / RETURN_S)
    offset = view.focus - limits.focus
    away = float(np.linalg.norm(offset))
    target_beyond = max(away - limits.reach, 0.0)
    position = np.array(limits.position(view.eye))
    excess = position - _nearest(position, limits)
    scale = np.array([1.0, 1.0, limits.distance[1]])
    if target_beyond <= NEARLY * limits.distance[1] and (np.abs(excess) <= NEARLY * scale).all():
        return view
    is_small = (np.abs(excess) <= 2 * NEARLY * scale).all() and target_beyond <= 2 * NEARLY * limits.distance[1]
    share = 1.0 if is_small else share
    focus = view.focus if away == 0 else view.focus - share * target_beyond * offset / away
    eye = _eye(position - share * excess, limits)
    axes = look_at(eye, focus, limits.up)[:3, :3]
    return OrbitView(view.lens, focus, float(np.linalg.norm(eye - focus)), axes, view.up)


def _nearest(position: np.ndarray, limits: ViewLimits) -> np.ndarray:
    low, high = zip(limits.azimuth, limits.elevation, limits.distance, strict=True)
    return np.clip(position, low, high)


def _eye(position: np.ndarray, limits: ViewLimits) -> np.ndarray:
    azimuth, elevation, distance = position
    level = math.cos(azimuth) * limits.forward + math.sin(azimuth) * np.cross(limits.up, limits.forward)
    return np.asarray(limits.focus + distance * (math.cos(elevation) * level + math.sin(elevation) * limits.up))
