"""How many texels a pixel spans: from that follows how many rays a pixel needs, and how coarse a picture may be that
still meets every texel."""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from kpc.format.scene.cameras import Camera
from kpc.format.scene.scene import SPACE_PLANES, Scene
from kpc.format.scene.space import DeviceCoordinates
from kpc.player.cpu.reference import sample_positions, sample_range

# Points along a ray at which the texels between it and its neighbour are counted.
POINTS = 64


def texels_per_pixel(scene: Scene, camera: Camera) -> float:
    """Return how many texels of the finest scale a pixel spans: in the middle of the box; where space is mapped, the
    most anywhere along the ray in the middle of the picture."""
    if scene.mapping is None:
        distance = math.dist(scene.aabb.mean(0), camera.camera_to_world[:3, 3])
        return distance / min(camera.fl_x, camera.fl_y) / (scene.extent / texels_across(scene.scales[-1]))
    middle = replace(camera.resized(2, 2), fl_x=camera.fl_x, fl_y=camera.fl_y, cx=1.0, cy=1.0)
    origins, directions = middle.rays()
    if isinstance(scene.mapping, DeviceCoordinates):
        rays = scene.mapping.rays(origins, directions)
        origins, directions = rays.origins, rays.directions
    near, far = sample_range(scene, origins, directions)
    along = np.linspace(near.min(), far.max(), POINTS, dtype=np.float32)
    _, u, _ = sample_positions(scene, origins, directions, np.tile(along, (4, 1)))
    finest = scene.scales[-1]
    texels = np.array([finest["xy"].shape[1], finest["xy"].shape[0], finest["xz"].shape[0]]) - 1
    is_inside = ((u > 0) & (u < 1)).all(axis=(0, 2))
    spans = np.abs(np.diff(u, axis=0)[::2]) * texels  # between a pixel and the one to its right
    return float(spans[:, is_inside].max(initial=0.0))


def texels_across(scale: Mapping[str, np.ndarray]) -> int:
    """Return the texels along the longest edge of the box, from the centre of the first to that of the last, at least
    1."""
    return max(1, *(size - 1 for plane in SPACE_PLANES for size in scale[plane].shape[:2]))
