"""Where a scene lies in the files of other programs: y is up, and the unit is a metre, as glTF demands.

A scene's metadata may name its up and the length of its unit. Without them its coordinates are kept: y counts as up
and a unit as a metre. All that is exported is placed in the same way, so points, meshes and cameras of a scene fit
together.
"""

from dataclasses import dataclass, replace

import numpy as np

from kpc.format.scene.cameras import Camera
from kpc.format.scene.metadata import Metadata

# Directions whose sum is shorter than this count as opposite.
OPPOSITE = 1e-9


@dataclass(frozen=True, eq=False)
class Placement:
    """The similarity from a scene's coordinates to those of exported files: q = scale rotation p.

    Attributes:
        rotation: (3, 3) float64.
        scale: metres in a unit of the scene.
    """

    rotation: np.ndarray
    scale: float

    @staticmethod
    def of(metadata: Metadata | None) -> "Placement":
        """Return the placement of a scene with this metadata, or of cameras whose scene is not known."""
        up = None if metadata is None else metadata.up
        scale = 1.0 if metadata is None else float(metadata.document.get("metres_per_unit", 1.0))
        return Placement(np.eye(3) if up is None else rotation_to_y(up), scale)

    @property
    def inverse(self) -> "Placement":
        """The similarity back."""
        return Placement(self.rotation.T, 1.0 / self.scale)

    @property
    def is_identity(self) -> bool:
        """Whether nothing changes."""
        return self.scale == 1.0 and bool(np.allclose(self.rotation, np.eye(3), atol=1e-12))

    def points(self, points: np.ndarray) -> np.ndarray:
        """Place points, (N, 3)."""
        return np.asarray(points @ (self.scale * self.rotation.T))

    def camera(self, camera: Camera) -> Camera:
        """Place a camera, whose axes keep the length 1."""
        pose = np.eye(4)
        pose[:3, :3] = self.rotation @ camera.camera_to_world[:3, :3]
        pose[:3, 3] = self.points(camera.camera_to_world[None, :3, 3])[0]
        return replace(camera, camera_to_world=pose)


def rotation_to_y(up: np.ndarray) -> np.ndarray:
    """Return the smallest rotation, (3, 3), that turns a unit vector to +y; about x where it points to -y.

    With s = up + y it is the half turn about s after the half turn about up: (2 s s^T / s^2 - 1) (2 up up^T - 1).
    """
    y = np.array([0.0, 1.0, 0.0])
    middle = up + y
    length = float(middle @ middle)
    if length < OPPOSITE:
        return np.diag([1.0, -1.0, -1.0])
    return np.asarray((2 * np.outer(middle, middle) / length - np.eye(3)) @ (2 * np.outer(up, up) - np.eye(3)))
