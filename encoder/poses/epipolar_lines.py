"""Epipolar lines on pictures, by which people see whether cameras were placed rightly."""

import numpy as np

from kpc.encoder.datasets.rays import local_directions
from kpc.encoder.evaluation.camera_page import Check
from kpc.encoder.poses.structure import PlacedView, Structure
from kpc.format.scene.camera_checks import distort

# Lines on each picture, and the depths between which each is drawn, as shares of that of the point.
LINES, NEAREST, FURTHEST, CORNERS = 4, 0.3, 4.0, 24


def looks(view: PlacedView, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the directions in the world of places in a picture, (N,) pixels each, as (N, 3) float64.

    They have depth 1, or length 1 where the lens is a fisheye.
    """
    fl_x, fl_y, cx, cy = view.intrinsics
    coefficients, is_fisheye = np.tile(_coefficients(view), (len(x), 1)), np.full(len(x), view.is_fisheye)
    right, down, ahead = local_directions((x - cx) / fl_x, (y - cy) / fl_y, coefficients, is_fisheye)
    return np.stack(np.broadcast_arrays(right, -down, -ahead), axis=1) @ view.camera_to_world[:3, :3].T


def seen_at(view: PlacedView, points: np.ndarray) -> np.ndarray:
    """Return where points (N, 3) before a camera lie in its picture, (N, 2) pixels; NaN for others.

    Before a fisheye lens is what lies no further from its axis than the corners of the picture.
    """
    pose = view.camera_to_world
    x, y, z = ((points - pose[:3, 3]) @ pose[:3, :3]).T
    if view.is_fisheye:
        across = np.hypot(x, y)
        angle = np.arctan2(across, -z)
        corner = looks(view, np.zeros(1), np.zeros(1))[0] @ -pose[:3, 2]
        scale = np.where(angle <= np.arccos(corner), angle, np.nan) / np.maximum(across, 1e-12)
    else:
        scale = 1 / np.where(z < 0, -z, np.nan)
    u, v, _ = distort(x * scale, -y * scale, _coefficients(view).tolist(), view.is_fisheye)
    fl_x, fl_y, cx, cy = view.intrinsics
    return np.stack([fl_x * u + cx, fl_y * v + cy], axis=1)


def checks(structure: Structure, number: int) -> tuple[Check, ...]:
    """Return for a placed view some points, and their epipolar lines from the view that shares most points with it."""
    points, views = structure.observations[:, :2].astype(int).T
    own = {int(points[k]): structure.observations[k, 2:] for k in np.flatnonzero(views == number)}
    shared = np.array([point in own for point in points], bool) & (views != number)
    others = np.bincount(views[shared]) if shared.any() else np.zeros(1, int)
    if others.max() < LINES:
        return ()
    other = structure.views[int(others.argmax())]
    rows = np.flatnonzero(shared & (views == others.argmax()))
    places = np.array([own[int(point)] for point in points[rows]])
    found = []
    for k in _far_apart(places):
        x, y = structure.observations[rows[k], 2:]
        ray = looks(other, np.array([x]), np.array([y]))[0]
        centre = other.camera_to_world[:3, 3]
        along = float((structure.points[points[rows[k]]] - centre) @ ray / (ray @ ray))
        line = seen_at(
            structure.views[number], centre + along * np.geomspace(NEAREST, FURTHEST, CORNERS)[:, None] * ray
        )
        found.append(Check((float(places[k, 0]), float(places[k, 1])), line[np.isfinite(line).all(1)]))
    return tuple(found)


def _far_apart(places: np.ndarray) -> list[int]:
    """Return numbers of LINES places (N, 2) that lie far from each other, beginning at the one furthest to the left."""
    chosen = [int(places[:, 0].argmin())]
    distance = np.linalg.norm(places - places[chosen[0]], axis=1)
    while len(chosen) < min(LINES, len(places)):
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(places - places[chosen[-1]], axis=1))
    return chosen


def _coefficients(view: PlacedView) -> np.ndarray:
    """Return OpenCV's eight coefficients k1 k2 p1 p2 k3 k4 k5 k6."""
    first, last = view.distortion[:2], view.distortion[2:]
    return np.array([*first, 0.0, 0.0, *last, 0.0, 0.0] if view.is_fisheye else [*first, *last, 0.0, 0.0, 0.0, 0.0])
