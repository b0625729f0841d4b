"""Where to look from: what the cameras a scene was filmed with have in common, and paths that stay near them."""

import math
from dataclasses import dataclass, replace

import numpy as np
from kpc.format.scene.cameras import Camera
from kpc.format.scene.scene import Scene

SURROUND_GAP = math.radians(160)
"""Cameras that leave no wider gap around their focus are a ring."""
INSIDE = 0.7
"""Share of a forward-facing rig's angles that a path uses: beyond its cameras nothing was seen."""
SMALL_SWAY = (math.radians(2), math.radians(1))
"""Least half angles of a path, sideways and upwards; that of a single camera."""


@dataclass(frozen=True)
class Rig:
    """The cameras of a scene, as a whole.

    Attributes:
        focus: (3,) the point they look at.
        up: (3,) unit vector.
        cameras: those of the scene, or one made up where it has none.
    """

    focus: np.ndarray
    up: np.ndarray
    cameras: tuple[Camera, ...]

    @staticmethod
    def of(scene: Scene) -> "Rig":
        cameras = scene.cameras or (_made_up(scene.bounds),)
        poses = np.stack([camera.camera_to_world for camera in cameras])
        return Rig(_focus(poses, scene.bounds), _up(poses), cameras)

    def angles(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Azimuth, elevation (radians) and distance of each camera, seen from the focus; the first has azimuth 0."""
        offsets = np.stack([camera.camera_to_world[:3, 3] for camera in self.cameras]) - self.focus
        distance = np.maximum(np.linalg.norm(offsets, axis=1), 1e-9)
        elevation = np.arcsin(np.clip(offsets @ self.up / distance, -1, 1))
        ahead, side = self.compass()
        azimuth = np.arctan2(offsets @ side, offsets @ ahead)
        return azimuth, elevation, distance

    def compass(self) -> tuple[np.ndarray, np.ndarray]:
        """Two level unit vectors: from the focus towards the first camera, and to the right as that camera sees it."""
        pose = self.cameras[0].camera_to_world
        for towards in (pose[:3, 3] - self.focus, pose[:3, 1], pose[:3, 0]):
            ahead = towards - (towards @ self.up) * self.up
            if np.linalg.norm(ahead) > 1e-6 * float(np.linalg.norm(towards)) + 1e-12:
                ahead = ahead / np.linalg.norm(ahead)
                break
        return ahead, np.cross(self.up, ahead)

    def camera(self, azimuth: float, elevation: float, distance: float) -> Camera:
        """The first camera, moved to a place given as by `angles` and turned to the focus."""
        ahead, side = self.compass()
        level = math.cos(azimuth) * ahead + math.sin(azimuth) * side
        eye = self.focus + distance * (math.cos(elevation) * level + math.sin(elevation) * self.up)
        return replace(self.cameras[0], camera_to_world=look_at(eye, self.focus, self.up))


def orbit(scene: Scene, count: int) -> list[Camera]:
    """`count` cameras along a closed path around what the scene's cameras look at.

    Cameras all around: a full circle at their mean height and distance, from the first one on. Cameras on one side: an
    ellipse that stays well inside their angles.
    """
    rig = Rig.of(scene)
    azimuth, elevation, distance = rig.angles()
    turns = 2 * math.pi * np.arange(count) / count
    if surround_focus(azimuth):
        return [rig.camera(turn, float(elevation.mean()), float(distance.mean())) for turn in turns]
    (middle_a, middle_e), sway_a, sway_e = _sways(azimuth, elevation)
    far = float(np.median(distance))
    return [rig.camera(middle_a + sway_a * math.sin(turn), middle_e + sway_e * math.cos(turn), far) for turn in turns]


def _sways(azimuth: np.ndarray, elevation: np.ndarray) -> tuple[tuple[float, float], float, float]:
    """Of a rig on one side: azimuth and elevation in the middle of its angles, and how far from there it is safe to go in each."""
    (middle_a, sway_a), (middle_e, sway_e) = (
        (float(angles.max() + angles.min()) / 2, max(INSIDE * float(angles.max() - angles.min()) / 2, least))
        for angles, least in zip((azimuth, elevation), SMALL_SWAY, strict=True)
    )
    return (middle_a, middle_e), sway_a, sway_e


def presets(scene: Scene) -> dict[str, Camera]:
    """Places to look from, by name, all towards what the scene's cameras look at.

    Cameras all around: its sides, and from above. Cameras on one side: the ends of the angles that were seen. Always: near, far.
    """
    rig = Rig.of(scene)
    azimuth, elevation, distance = rig.angles()
    far, level = float(np.median(distance)), float(elevation.mean())
    if surround_focus(azimuth):
        around = {
            "front": (0.0, level),
            "right": (0.5, level),
            "back": (1.0, level),
            "left": (-0.5, level),
            "above": (0.0, 1.4),
        }
        places = {name: (math.pi * turn, height, far) for name, (turn, height) in around.items()}
    else:
        middle, sway_a, sway_e = _sways(azimuth, elevation)
        ways = {"middle": (0, 0), "left": (-1, 0), "right": (1, 0), "above": (0, 1), "below": (0, -1)}
        places = {name: (middle[0] + x * sway_a, middle[1] + y * sway_e, far) for name, (x, y) in ways.items()}
    first = next(iter(places.values()))
    places |= {"near": (*first[:2], 0.6 * far), "far": (*first[:2], 1.6 * far)}
    return {name: rig.camera(*place) for name, place in places.items()}


def surround_focus(azimuth: np.ndarray) -> bool:
    """Whether directions, radians, leave no wide gap on the circle."""
    around = np.sort(azimuth)
    gaps = np.diff(np.append(around, around[0] + 2 * math.pi))
    return len(azimuth) > 2 and float(gaps.max()) < SURROUND_GAP


def look_at(eye: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """The (4, 4) camera-to-world pose at `eye` that looks at `target`, `up` upwards. The two points must differ."""
    backward = (eye - target) / np.linalg.norm(eye - target)
    right = np.cross(up, backward)
    if np.linalg.norm(right) < 1e-6:  # straight up or down: any right will do
        right = np.cross(np.eye(3)[np.argmin(np.abs(backward))], backward)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(backward, right), backward, eye], axis=1)
    return pose


def fit_camera(camera: Camera, width: int, height: int) -> Camera:
    """The same view on a raster of another shape: the vertical field of view stays, square pixels stay square."""
    scale = height / camera.height
    return Camera(
        width,
        height,
        camera.fl_x * scale,
        camera.fl_y * scale,
        width / 2 + (camera.cx - camera.width / 2) * scale,
        camera.cy * scale,
        camera.camera_to_world,
    )


def _made_up(aabb: np.ndarray) -> Camera:
    """A camera that sees the whole box from outside, z upwards."""
    centre, reach = aabb.mean(axis=0).astype(np.float64), float(np.linalg.norm(aabb[1] - aabb[0]))
    eye = centre + 1.2 * reach * np.array([0.0, -math.cos(0.35), math.sin(0.35)])
    return Camera(640, 480, 600.0, 600.0, 320.0, 240.0, look_at(eye, centre, np.array([0.0, 0.0, 1.0])))


def _focus(poses: np.ndarray, aabb: np.ndarray) -> np.ndarray:
    """The point of least squared distance to the optical axes; where they meet nowhere in front of the cameras, the
    point of the first one's axis nearest to the middle of the box."""
    eyes, forward = poses[:, :3, 3], -poses[:, :3, 2]
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    total = across.sum(axis=0)
    if np.linalg.cond(total) < 1e4:
        focus = np.linalg.solve(total, np.einsum("nij,nj->i", across, eyes))
        margin = 0.25 * (aabb[1] - aabb[0])
        if np.all(focus > aabb[0] - margin) and np.all(focus < aabb[1] + margin) and _in_front(focus, eyes, forward):
            return focus
    ahead = (aabb.mean(axis=0) - eyes[0]) @ forward[0]
    return eyes[0] + max(ahead, 0.1 * float(np.max(aabb[1] - aabb[0]))) * forward[0]


def _in_front(point: np.ndarray, eyes: np.ndarray, forward: np.ndarray) -> bool:
    return bool(np.mean(np.einsum("ni,ni->n", point - eyes, forward) > 0) > 0.9)


def _up(poses: np.ndarray) -> np.ndarray:
    """The direction to which all right axes are perpendicular, if they single one out; else the mean upward axis."""
    rights, mean = poses[:, :3, 0], poses[:, :3, 1].mean(axis=0)
    values, vectors = np.linalg.eigh(rights.T @ rights / len(rights))
    up = vectors[:, 0]
    if values[1] < 1e-3 or values[0] > 0.05 * values[1] or abs(up @ mean) < 0.5 * np.linalg.norm(mean):
        up = mean if np.linalg.norm(mean) > 1e-6 else poses[0, :3, 1]
    return up / np.linalg.norm(up) * (1.0 if up @ mean >= 0 else -1.0)
