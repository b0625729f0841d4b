"""Camera movement, playback of the clip, and selection of an appearance. No window, no OpenGL."""

import math
from dataclasses import dataclass, replace

import numpy as np

from kpc.format.scene.cameras import Camera
from kpc.format.scene.rig import Rig
from kpc.format.scene.scene import Clip, Scene
from kpc.player.viewpoints import fit_window

# Orbiting stops at this angle from looking straight up or down, radians.
MIN_POLAR_ANGLE = math.radians(1.0)
# Seconds that the blend from one appearance to the next takes.
BLEND_S = 0.4
# Playback speeds to choose from, clip seconds per second.
SPEEDS = (0.1, 0.25, 0.5, 1.0, 2.0, 4.0)
# Distance over that before, for each notch of the wheel, and bounds of the distance, world units.
ZOOM_FACTOR, MIN_DISTANCE, MAX_DISTANCE = 0.9, 1e-4, 1e6
# The name of what is shown without an appearance embedding.
AVERAGE = "average"


@dataclass(frozen=True, eq=False)
class OrbitView:
    """A camera that orbits around a point.

    Attributes:
        lens: the camera whose intrinsics to use; its pose is ignored.
        focus: (3,) the point it orbits around, world coordinates.
        distance: from the eye to the focus, world units.
        axes: (3, 3) columns right, up, backward in world coordinates, orthonormal.
        up: (3,) unit vector, the axis of horizontal orbits.
    """

    lens: Camera
    focus: np.ndarray
    distance: float
    axes: np.ndarray
    up: np.ndarray

    @staticmethod
    def of(rig: Rig, camera: Camera) -> "OrbitView":
        """Return the view of a camera, orbiting around the point of its axis that is nearest to the rig's focus."""
        axes, eye = camera.camera_to_world[:3, :3], camera.camera_to_world[:3, 3]
        away = float(np.linalg.norm(rig.focus - eye))
        distance = max(float((rig.focus - eye) @ -axes[:, 2]), 0.1 * away, 1e-3)
        return OrbitView(camera, eye - distance * axes[:, 2], distance, axes, rig.up)

    @property
    def eye(self) -> np.ndarray:
        """(3,) the camera's position, world coordinates."""
        return self.focus + self.distance * self.axes[:, 2]

    def camera(self, width: int, height: int) -> Camera:
        """Return the camera for a window of this size."""
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = self.axes, self.eye
        return replace(fit_window(self.lens, width, height), camera_to_world=pose)

    def orbit(self, right: float, up: float) -> "OrbitView":
        """Drag the scene by two angles in radians; the eye moves the other way around the focus."""
        turned = _rotation(self.up, -right) @ self.axes
        pitched = _rotation(turned[:, 0], up) @ turned
        old, new = (math.acos(np.clip(axes[:, 2] @ self.up, -1.0, 1.0)) for axes in (turned, pitched))
        polar, polar_before = min(new, math.pi - new), min(old, math.pi - old)
        is_too_steep = polar < MIN_POLAR_ANGLE and polar < polar_before
        is_upside_down = pitched[:, 1] @ self.up < 0.0 < turned[:, 1] @ self.up
        return replace(self, axes=_orthonormal(turned if is_too_steep or is_upside_down else pitched))

    def pan(self, right: float, up: float) -> "OrbitView":
        """Drag the focus parallel to the image plane, in heights of the picture, so that it stays under the pointer."""
        height = self.distance * self.lens.height / self.lens.fl_y
        return replace(self, focus=self.focus - height * (right * self.axes[:, 0] + up * self.axes[:, 1]))

    def zoom(self, notches: float) -> "OrbitView":
        """Move closer by a tenth of the distance for each notch of the wheel."""
        distance = self.distance * ZOOM_FACTOR ** np.clip(notches, -100, 100)
        return replace(self, distance=float(np.clip(distance, MIN_DISTANCE, MAX_DISTANCE)))

    def fly(self, right: float, up: float, forward: float) -> "OrbitView":
        """Move eye and focus along the camera's axes, world units."""
        return replace(self, focus=self.focus + self.axes @ np.array([right, up, -forward]))


@dataclass
class Playback:
    """The position in a clip.

    Attributes:
        clip: number and rate of its frames.
        time: in [0, 1] over the clip.
        playing: whether time advances.
        speed: clip seconds per second.
        loop: whether to begin again at the end, else to stop there.
    """

    clip: Clip
    time: float = 0.0
    playing: bool = True
    speed: float = 1.0
    loop: bool = True

    def advance(self, seconds: float) -> None:
        """Advance by some real time."""
        if not self.playing or self.clip.duration_s == 0.0:
            return
        time = self.time + seconds * self.speed / self.clip.duration_s
        if time > 1.0 and not self.loop:
            time, self.playing = 1.0, False
        self.time = time % 1.0 if time > 1.0 else time

    def after(self, seconds: float) -> "Playback":
        """Return the position after some real time."""
        later = replace(self)
        later.advance(seconds)
        return later

    @property
    def rate(self) -> float:
        """The fraction of the clip that is played per second; 0 while paused."""
        return self.speed / self.clip.duration_s if self.playing and self.clip.duration_s > 0 else 0.0

    def toggle(self) -> None:
        """Play or pause; at the end of a clip that does not loop, begin again."""
        self.playing = not self.playing
        if self.playing and not self.loop and self.time >= 1.0:
            self.time = 0.0

    def seek(self, time: float) -> None:
        """Go to a time, clamped to [0, 1]."""
        self.time = min(max(time, 0.0), 1.0)

    def step(self, frames: int) -> None:
        """Pause, round to a whole frame, and go `frames` frames forward."""
        self.playing = False
        last = self.clip.frame_count - 1
        if last > 0:
            self.seek((round(self.time * last) + frames) / last)

    @property
    def speed_number(self) -> int:
        """The position in SPEEDS of the speed nearest to the present one."""
        return min(range(len(SPEEDS)), key=lambda number: abs(SPEEDS[number] - self.speed))

    def change_speed(self, steps: int) -> None:
        """Go `steps` speeds up in SPEEDS."""
        self.speed = SPEEDS[min(max(self.speed_number + steps, 0), len(SPEEDS) - 1)]


class AppearanceSelection:
    """The appearance embedding that is shown: the average or that of a picture; a change is blended over BLEND_S.

    Args:
        scene: the scene.
        selected: the name to begin with; the average if the scene has no such appearance.

    Attributes:
        names: AVERAGE, then those of the scene's appearances.
        number: position in `names` of the one that is shown or being blended in.
        progress: of the blend, [0, 1].
    """

    def __init__(self, scene: Scene, selected: str = AVERAGE) -> None:
        self.scene = scene
        self.names = (AVERAGE, *(appearance.name for appearance in scene.appearances))
        average = np.zeros(len(scene.decoder.b1), np.float32)
        self._codes = [average, *(appearance.code for appearance in scene.appearances)]
        self.number, self.progress = self.names.index(selected) if selected in self.names else 0, 1.0
        self._before = self._codes[self.number]

    @property
    def name(self) -> str:
        """The name of the appearance that is shown or being blended in."""
        return self.names[self.number]

    @property
    def code(self) -> np.ndarray | None:
        """(H,) float32, the embedding to show; None if the scene has none.

        It is (1 - s) before + s next, with s = p^2 (3 - 2 p) for progress p.
        """
        if len(self._codes) == 1:
            return None
        share = np.float32(self.progress * self.progress * (3 - 2 * self.progress))
        return (1 - share) * self._before + share * self._codes[self.number]

    def select(self, number: int) -> None:
        """Begin to blend from what is shown to another appearance."""
        shown = self.code
        if shown is not None and number != self.number:
            self._before, self.number, self.progress = shown, number, 0.0

    def next(self) -> None:
        """Begin to blend to the next appearance; after the last, to the average."""
        self.select((self.number + 1) % len(self._codes))

    def advance(self, seconds: float) -> None:
        """Advance the blend."""
        self.progress = min(self.progress + seconds / BLEND_S, 1.0)


def _rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    """Return the rotation by `angle` around a unit vector, counter-clockwise seen from its tip (Rodrigues' formula)."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross


def _orthonormal(axes: np.ndarray) -> np.ndarray:
    """Return the nearest rotation, so that many small rotations do not add up to a skew."""
    u, _, vt = np.linalg.svd(axes)
    return u @ vt
