"""The mathematics of looking around and of playing: no window, no OpenGL."""

import math
from dataclasses import dataclass, replace

import numpy as np
from kpc.format.scene.cameras import Camera
from kpc.format.scene.scene import Clip, Scene
from kpc.player.viewpoints import Rig, fit_camera

STEEPEST = math.radians(1.0)
"""Orbiting stops this far from looking straight up or down."""
FADE_S = 0.4
"""From one appearance to the next."""
SPEEDS = (0.1, 0.25, 0.5, 1.0, 2.0, 4.0)


@dataclass(frozen=True, eq=False)
class View:
    """A camera that turns around a point.

    Attributes:
        lens: whose intrinsics to use; its pose is not looked at.
        focus: (3,) the point it looks at, world coordinates.
        distance: from the eye to it, world units.
        axes: (3, 3) columns right, up, backward in the world, orthonormal.
        up: (3,) unit vector; orbiting turns around it.
    """

    lens: Camera
    focus: np.ndarray
    distance: float
    axes: np.ndarray
    up: np.ndarray

    @staticmethod
    def of(rig: Rig, camera: Camera) -> "View":
        """Exactly what `camera` sees; turning around the point of its axis that lies nearest to the rig's focus."""
        axes, eye = camera.camera_to_world[:3, :3], camera.camera_to_world[:3, 3]
        away = float(np.linalg.norm(rig.focus - eye))
        distance = max(float((rig.focus - eye) @ -axes[:, 2]), 0.1 * away, 1e-3)
        return View(camera, eye - distance * axes[:, 2], distance, axes, rig.up)

    @property
    def eye(self) -> np.ndarray:
        return self.focus + self.distance * self.axes[:, 2]

    def camera(self, width: int, height: int) -> Camera:
        """The camera on a raster of this size."""
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = self.axes, self.eye
        return replace(fit_camera(self.lens, width, height), camera_to_world=pose)

    def orbit(self, sideways: float, upwards: float) -> "View":
        """Drag the scene by these angles, radians: the eye goes the other way around the focus."""
        turned = _rotation(self.up, -sideways) @ self.axes
        pitched = _rotation(turned[:, 0], upwards) @ turned
        old, new = (math.acos(np.clip(axes[:, 2] @ self.up, -1.0, 1.0)) for axes in (turned, pitched))
        steep = min(new, math.pi - new) < STEEPEST and min(new, math.pi - new) < min(old, math.pi - old)
        overturned = pitched[:, 1] @ self.up < 0.0 < turned[:, 1] @ self.up
        return replace(self, axes=_orthonormal(turned if steep or overturned else pitched))

    def pan(self, sideways: float, upwards: float) -> "View":
        """Drag the focus along the picture's plane, in heights of the picture, so that it stays under the pointer."""
        height = self.distance * self.lens.height / self.lens.fl_y
        return replace(self, focus=self.focus - height * (sideways * self.axes[:, 0] + upwards * self.axes[:, 1]))

    def zoom(self, notches: float) -> "View":
        """Come nearer by a tenth for each notch of the wheel."""
        return replace(self, distance=float(np.clip(self.distance * 0.9 ** np.clip(notches, -100, 100), 1e-4, 1e6)))

    def fly(self, right: float, up: float, forward: float) -> "View":
        """Move eye and focus along the camera's own axes, world units."""
        return replace(self, focus=self.focus + self.axes @ np.array([right, up, -forward]))


@dataclass
class Playback:
    """Where a clip is.

    Attributes:
        time: [0, 1] over the clip.
        speed: clip seconds to one real second.
        loop: begin again at the end, else stop there.
    """

    clip: Clip
    time: float = 0.0
    playing: bool = True
    speed: float = 1.0
    loop: bool = True

    def advance(self, seconds: float) -> None:
        """Let real time pass."""
        if not self.playing or self.clip.duration_s == 0.0:
            return
        time = self.time + seconds * self.speed / self.clip.duration_s
        if time > 1.0 and not self.loop:
            time, self.playing = 1.0, False
        self.time = time % 1.0 if time > 1.0 else time

    def after(self, seconds: float) -> "Playback":
        """Where it will be then."""
        later = replace(self)
        later.advance(seconds)
        return later

    @property
    def rate(self) -> float:
        """Of the clip in a real second; 0 while it does not play."""
        return self.speed / self.clip.duration_s if self.playing and self.clip.duration_s > 0 else 0.0

    def toggle(self) -> None:
        """Play or pause; at the end of a clip that does not loop, begin again."""
        self.playing = not self.playing
        if self.playing and not self.loop and self.time >= 1.0:
            self.time = 0.0

    def seek(self, time: float) -> None:
        self.time = min(max(time, 0.0), 1.0)

    def step(self, frames: int) -> None:
        """Pause, and go to a whole frame so many frames on."""
        self.playing = False
        last = self.clip.frame_count - 1
        if last > 0:
            self.seek((round(self.time * last) + frames) / last)

    def faster(self, steps: int) -> None:
        """Go so many steps along SPEEDS."""
        nearest = min(range(len(SPEEDS)), key=lambda i: abs(SPEEDS[i] - self.speed))
        self.speed = SPEEDS[min(max(nearest + steps, 0), len(SPEEDS) - 1)]


AVERAGE = "average"
"""The look without an appearance."""


class AppearanceSelection:
    """Which appearance of a scene is shown: the average first, then each of them; a change takes FADE_S.

    Attributes:
        scene: whose appearances they are.
        names: AVERAGE, then those of the scene's appearances.
        number: of the one shown, or on its way.
        progress: of that change, [0, 1].
    """

    def __init__(self, scene: Scene, selected: str = AVERAGE) -> None:
        """`selected`: the name to begin with; where the scene has it not, the average."""
        self.scene = scene
        self.names = (AVERAGE, *(appearance.name for appearance in scene.appearances))
        average = np.zeros(len(scene.decoder.b1), np.float32)
        self._codes = [average, *(appearance.code for appearance in scene.appearances)]
        self.number, self.progress = self.names.index(selected) if selected in self.names else 0, 1.0
        self._before = self._codes[self.number]

    @property
    def code(self) -> np.ndarray | None:
        """(H,) what to show now: (1 - s) before + s next, s = p^2 (3 - 2 p) of the progress p; None in a scene without any."""
        if len(self._codes) == 1:
            return None
        share = np.float32(self.progress * self.progress * (3 - 2 * self.progress))
        return (1 - share) * self._before + share * self._codes[self.number]

    def select(self, number: int) -> None:
        """Begin to change into another, from whatever is shown now."""
        shown = self.code
        if shown is not None and number != self.number:
            self._before, self.number, self.progress = shown, number, 0.0

    def next(self) -> None:
        """Begin to change into the next; after the last, the average."""
        self.select((self.number + 1) % len(self._codes))

    def advance(self, seconds: float) -> None:
        """Let real time pass."""
        self.progress = min(self.progress + seconds / FADE_S, 1.0)


def _rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    """Turn by `angle` around a unit vector, counter-clockwise seen from its tip (Rodrigues)."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross


def _orthonormal(axes: np.ndarray) -> np.ndarray:
    """The nearest rotation: many small turns must not add up to a skew."""
    u, _, vt = np.linalg.svd(axes)
    return u @ vt
