"""The cameras of a scene as a rig: the point they look at, which way is up, and spherical coordinates around it."""

import math
from dataclasses import dataclass, replace

import numpy as np

from kpc.format.scene.cameras import Camera
from kpc.format.scene.scene import Scene

# Cameras surround their focus if they leave no wider gap between their azimuths, radians.
MAX_SURROUND_GAP = math.radians(160)


@dataclass(frozen=True)
class Rig:
    """The cameras of a scene.

    Attributes:
        focus: (3,) the point they look at, world coordinates.
        up: (3,) unit vector.
        cameras: those of the scene; a default camera if it has none.
    """

    focus: np.ndarray
    up: np.ndarray
    cameras: tuple[Camera, ...]

    @staticmethod
    def of(scene: Scene) -> "Rig":
        """Return the rig of a scene; up is that of its metadata, if they have one."""
        cameras = scene.cameras or (_default_camera(scene.bounds),)
        poses = np.stack([camera.camera_to_world for camera in cameras])
        up = scene.metadata.up
        return Rig(_focus(poses, scene.bounds), _up(poses) if up is None else up, cameras)

    def angles(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the cameras' positions in spherical coordinates around the focus.

        Returns:
            Azimuths and elevations in radians, and distances, each (N,). The azimuth of the first camera is 0.
        """
        offsets = np.stack([camera.camera_to_world[:3, 3] for camera in self.cameras]) - self.focus
        distance = np.maximum(np.linalg.norm(offsets, axis=1), 1e-9)
        elevation = np.arcsin(np.clip(offsets @ self.up / distance, -1, 1))
        ahead, side = self.compass()
        azimuth = np.arctan2(offsets @ side, offsets @ ahead)
        return azimuth, elevation, distance

    def compass(self) -> tuple[np.ndarray, np.ndarray]:
        """Return two horizontal unit vectors: from the focus to the first camera, and to the right of that camera."""
        pose = self.cameras[0].camera_to_world
        for towards in (pose[:3, 3] - self.focus, pose[:3, 1], pose[:3, 0]):
            ahead = towards - (towards @ self.up) * self.up
            if np.linalg.norm(ahead) > 1e-6 * float(np.linalg.norm(towards)) + 1e-12:
                ahead = ahead / np.linalg.norm(ahead)
                break
        return ahead, np.cross(self.up, ahead)

    def camera(self, azimuth: float, elevation: float, distance: float) -> Camera:
        """Return the first camera at other spherical coordinates (see `angles`), turned to the focus."""
        ahead, side = self.compass()
        level = math.cos(azimuth) * ahead + math.sin(azimuth) * side
        eye = self.focus + distance * (math.cos(elevation) * level + math.sin(elevation) * self.up)
        return replace(self.cameras[0], camera_to_world=look_at(eye, self.focus, self.up))


def surround_focus(azimuth: np.ndarray) -> bool:
    """Return whether cameras at these azimuths, (N,) radians, surround their focus."""
    around = np.sort(azimuth)
    gaps = np.diff(np.append(around, around[0] + 2 * math.pi))
    return len(azimuth) > 2 and float(gaps.max()) < MAX_SURROUND_GAP


def look_at(eye: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return the (4, 4) camera-to-world matrix of a camera.

    Args:
        eye: (3,) its position.
        target: (3,) the point it looks at; it must differ from `eye`.
        up: (3,) unit vector that points up in the picture.
    """
    backward = (eye - target) / np.linalg.norm(eye - target)
    right = np.cross(up, backward)
    if np.linalg.norm(right) < 1e-6:  # looking along `up`, any right axis will do
        right = np.cross(np.eye(3)[np.argmin(np.abs(backward))], backward)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(backward, right), backward, eye], axis=1)
    return pose


def _default_camera(aabb: np.ndarray) -> Camera:
    """Return a camera outside a bounding box, (2, 3), that sees all of it, with z up."""
    centre, reach = aabb.mean(axis=0).astype(np.float64), float(np.linalg.norm(aabb[1] - aabb[0]))
    eye = centre + 1.2 * reach * np.array([0.0, -math.cos(0.35), math.sin(0.35)])
    return Camera(640, 480, 600.0, 600.0, 320.0, 240.0, look_at(eye, centre, np.array([0.0, 0.0, 1.0])))


def _focus(poses: np.ndarray, aabb: np.ndarray) -> np.ndarray:
    """Return the point with the least sum of squared distances to the optical axes.

    If that is not a point in front of the cameras within the bounding box (with a margin), return the point of the
    first axis that is nearest to the centre of the box.

    Args:
        poses: (N, 4, 4) camera-to-world matrices.
        aabb: (2, 3) bounding box.
    """
    eyes, forward = poses[:, :3, 3], -poses[:, :3, 2]
    projections = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    total = projections.sum(axis=0)
    if np.linalg.cond(total) < 1e4:
        focus = np.linalg.solve(total, np.einsum("nij,nj->i", projections, eyes))
        margin = 0.25 * (aabb[1] - aabb[0])
        if np.all(focus > aabb[0] - margin) and np.all(focus < aabb[1] + margin) and _in_front(focus, eyes, forward):
            return focus
    ahead = (aabb.mean(axis=0) - eyes[0]) @ forward[0]
    return eyes[0] + max(ahead, 0.1 * float(np.max(aabb[1] - aabb[0]))) * forward[0]


def _in_front(point: np.ndarray, eyes: np.ndarray, forward: np.ndarray) -> bool:
    """Return whether a point is in front of nearly all cameras; eyes and forward: (N, 3)."""
    return bool(np.mean(np.einsum("ni,ni->n", point - eyes, forward) > 0) > 0.9)


def _up(poses: np.ndarray) -> np.ndarray:
    """Return the direction perpendicular to all right axes if they determine one, else the mean of the up axes."""
    rights, mean = poses[:, :3, 0], poses[:, :3, 1].mean(axis=0)
    values, vectors = np.linalg.eigh(rights.T @ rights / len(rights))
    up = vectors[:, 0]
    if values[1] < 1e-3 or values[0] > 0.05 * values[1] or abs(up @ mean) < 0.5 * np.linalg.norm(mean):
        up = mean if np.linalg.norm(mean) > 1e-6 else poses[0, :3, 1]
    return up / np.linalg.norm(up) * (1.0 if up @ mean >= 0 else -1.0)
