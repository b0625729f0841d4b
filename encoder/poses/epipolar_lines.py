"""Epipolar lines on pictures, by which people see whether cameras were placed rightly."""

import numpy as np

from kpc.encoder.datasets.rays import undistort
from kpc.encoder.evaluation.camera_page import Check
from kpc.encoder.poses.structure import PlacedView, Structure
from kpc.format.scene.camera_checks import distort

# Lines on each picture, and the depths between which each is drawn, as shares of that of the point.
LINES, NEAREST, FURTHEST, CORNERS = 4, 0.3, 4.0, 24


def looks(view: PlacedView, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the directions in the world of places in a picture, (N,) pixels each, as (N, 3) float64 of depth 1."""
    fl_x, fl_y, cx, cy = view.intrinsics
    x, y = (x - cx) / fl_x, (y - cy) / fl_y
    if any(view.distortion):
        x, y = undistort(x, y, _coefficients(view)[None])
    return np.stack([x, -y, -np.ones_like(x)], axis=1) @ view.camera_to_world[:3, :3].T


def seen_at(view: PlacedView, points: np.ndarray) -> np.ndarray:
    """Return where points (N, 3) in front of a camera lie in its picture, (N, 2) pixels; NaN for others."""
    pose = view.camera_to_world
    x, y, z = ((points - pose[:3, 3]) @ pose[:3, :3]).T
    depth = np.where(z < 0, -z, np.nan)
    u, v, _ = distort(x / depth, -y / depth, _coefficients(view).tolist())
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
        depth = float((structure.points[points[rows[k]]] - centre) @ -other.camera_to_world[:3, 2])
        line = seen_at(
            structure.views[number], centre + depth * np.geomspace(NEAREST, FURTHEST, CORNERS)[:, None] * ray
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
    return np.array([*view.distortion, 0.0, 0.0, 0.0, 0.0])
