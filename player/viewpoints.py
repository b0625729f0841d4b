"""Viewpoints of a scene: named ones, and paths that stay near the cameras."""

import math

import numpy as np

from kpc.format.scene.cameras import Camera
from kpc.format.scene.rig import Rig, surround_focus
from kpc.format.scene.scene import Scene
from kpc.format.scene.view_limits import OPENING_ASPECT

# The fraction of the angles between cameras on one side that viewpoints use: what lies beyond was not filmed.
USED_FRACTION = 0.7
# Least amplitudes of a path in azimuth and elevation, radians; those for a single camera.
MIN_AMPLITUDES = (math.radians(2), math.radians(1))
# The elevation of the viewpoint "above", radians, and distances of "near" and "far" over the cameras' median distance.
ABOVE, NEAR, FAR = 1.4, 0.6, 1.6


def orbit(scene: Scene, count: int) -> list[Camera]:
    """Return cameras along a closed path around the focus.

    If the scene's cameras surround the focus, the path is a full circle at their mean elevation and distance that
    starts at the first camera; otherwise an ellipse within their angles.

    Args:
        scene: the scene.
        count: number of cameras.
    """
    rig = Rig.of(scene)
    azimuth, elevation, distance = rig.angles()
    phases = 2 * math.pi * np.arange(count) / count
    if surround_focus(azimuth):
        return [rig.camera(phase, float(elevation.mean()), float(distance.mean())) for phase in phases]
    (middle_a, middle_e), amplitude_a, amplitude_e = _centre_and_amplitudes(azimuth, elevation)
    far = float(np.median(distance))
    return [
        rig.camera(middle_a + amplitude_a * math.sin(phase), middle_e + amplitude_e * math.cos(phase), far)
        for phase in phases
    ]


def _centre_and_amplitudes(azimuth: np.ndarray, elevation: np.ndarray) -> tuple[tuple[float, float], float, float]:
    """Return the central azimuth and elevation of cameras on one side, and amplitudes that stay within them."""
    (middle_a, amplitude_a), (middle_e, amplitude_e) = (
        (float(angles.max() + angles.min()) / 2, max(USED_FRACTION * float(angles.max() - angles.min()) / 2, least))
        for angles, least in zip((azimuth, elevation), MIN_AMPLITUDES, strict=True)
    )
    return (middle_a, middle_e), amplitude_a, amplitude_e


def presets(scene: Scene) -> dict[str, Camera]:
    """Return viewpoints by name; all look at the focus.

    If the scene's cameras surround the focus, they are its sides and the view from above; otherwise the centre and the
    ends of the cameras' angles. "near" and "far" are always there.
    """
    rig = Rig.of(scene)
    azimuth, elevation, distances = rig.angles()
    distance, level = float(np.median(distances)), float(elevation.mean())
    if surround_focus(azimuth):
        half_turns = {"front": 0.0, "right": 0.5, "back": 1.0, "left": -0.5}
        positions = {name: (math.pi * turn, level, distance) for name, turn in half_turns.items()}
        positions["above"] = (0.0, ABOVE, distance)
    else:
        middle, amplitude_a, amplitude_e = _centre_and_amplitudes(azimuth, elevation)
        directions = {"middle": (0, 0), "left": (-1, 0), "right": (1, 0), "above": (0, 1), "below": (0, -1)}
        positions = {
            name: (middle[0] + x * amplitude_a, middle[1] + y * amplitude_e, distance)
            for name, (x, y) in directions.items()
        }
    first = next(iter(positions.values()))
    positions |= {"near": (*first[:2], NEAR * distance), "far": (*first[:2], FAR * distance)}
    return {name: rig.camera(*position) for name, position in positions.items()}


def fit_camera(camera: Camera, width: int, height: int) -> Camera:
    """Return a camera for a raster of another size; vertical field of view and shape of pixels stay the same."""
    return _scaled(camera, width, height, height / camera.height)


def fit_window(camera: Camera, width: int, height: int) -> Camera:
    """Return a camera for a window, whose sides show no more than a picture of OPENING_ASPECT or the camera's own does.

    A window that is wider shows less above and below; in others the vertical field of view stays the same.
    """
    widest = max(camera.width, OPENING_ASPECT * camera.height)
    return _scaled(camera, width, height, max(height / camera.height, width / widest))


def _scaled(camera: Camera, width: int, height: int, scale: float) -> Camera:
    return Camera(
        width,
        height,
        camera.fl_x * scale,
        camera.fl_y * scale,
        width / 2 + (camera.cx - camera.width / 2) * scale,
        height / 2 + (camera.cy - camera.height / 2) * scale,
        camera.camera_to_world,
    )
