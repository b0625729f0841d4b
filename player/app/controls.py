"""The mathematics of looking around and of playing: no window, no OpenGL."""

import math
from dataclasses import dataclass, field, replace

import numpy as np
from kpc.format.scene.cameras import Camera
from kpc.format.scene.scene import Clip, Scene
from kpc.player.orbit import Rig, fitted

STEEPEST = math.radians(1.0)
"""Orbiting stops this far from looking straight up or down."""
FADE_S = 0.4
"""From one appearance to the next."""
CARD_FPS = 50.0
"""Pictures a second that a graphics card is to come up with where nothing else is asked for."""
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
        return replace(fitted(self.lens, width, height), camera_to_world=pose)

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
    def pace(self) -> float:
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


class Wardrobe:
    """Which appearance of a scene is shown: the average first, then each of them; a change takes FADE_S.

    Attributes:
        scene: whose appearances they are.
        names: AVERAGE, then those of the scene's appearances.
        number: of the one shown, or on its way.
        progress: of that change, [0, 1].
    """

    def __init__(self, scene: Scene, worn: str = AVERAGE) -> None:
        """`worn`: the name to begin with; where the scene has it not, the average."""
        self.scene = scene
        self.names = (AVERAGE, *(appearance.name for appearance in scene.appearances))
        average = np.zeros(len(scene.decoder.b1), np.float32)
        self._codes = [average, *(appearance.code for appearance in scene.appearances)]
        self.number, self.progress = self.names.index(worn) if worn in self.names else 0, 1.0
        self._before = self._codes[self.number]

    @property
    def code(self) -> np.ndarray | None:
        """(H,) what to show now: (1 - s) before + s next, s = p^2 (3 - 2 p) of the progress p; None in a scene without any."""
        if len(self._codes) == 1:
            return None
        share = np.float32(self.progress * self.progress * (3 - 2 * self.progress))
        return (1 - share) * self._before + share * self._codes[self.number]

    def wear(self, number: int) -> None:
        """Begin to change into another, from whatever is shown now."""
        shown = self.code
        if shown is not None and number != self.number:
            self._before, self.number, self.progress = shown, number, 0.0

    def next(self) -> None:
        """Begin to change into the next; after the last, the average."""
        self.wear((self.number + 1) % len(self._codes))

    def advance(self, seconds: float) -> None:
        """Let real time pass."""
        self.progress = min(self.progress + seconds / FADE_S, 1.0)


@dataclass
class Pace:
    """How finely to draw so that pictures come in time: the side of the drawn raster over that of the window.

    A picture takes a + b scale^2 seconds. Both are fitted to a mean time of each raster tried, and, with less weight, to one of no
    pixels that takes no time: so a is 0 until several sizes say otherwise. When a raster takes longer than it did, all do. What is
    known of a raster is forgotten when it has not been drawn for OLD pictures; all is, when times are EXCEPTION times what was
    expected, or as many times less, for AGREED pictures on end.

    The first picture on a raster follows no other, as the next ones may, and textures are made for it; and the later a picture comes, the more
    the next has to draw. So the first NEW ones count only where one takes HOPELESS times the budget, or two on end LATE times. And no
    picture counts as longer than the one before it: what one alone has to do tells little of the next.

    Attributes:
        budget_s: seconds a picture may take.
        scale: in [LEAST, 1], a power of STEP: the card is asked for few different rasters, and keeps them.
    """

    STEP = 2**0.25
    LEAST = STEP**-12
    SLACK = 0.5
    """Steps that the raster may be too large before it shrinks. It grows after UP_AFTER pictures on end that left room for a finer one; after
    twice as many for each time that it shrank from there, up to MOST_PATIENCE."""
    UP_AFTER, MOST_PATIENCE = 3, 96
    MOST_AT_ONCE = 3
    """Steps down or up."""
    FRESH = 0.25
    """Share of the last picture in the mean time of its raster."""
    AT_NOTHING = 0.5
    """Weight of the raster of no pixels."""
    EXCEPTION = 4.0
    """A picture that takes so many times as long as the last counts as if it took no longer than that."""
    AGREED = 4
    NEW, LATE, HOPELESS = 4, 2.5, 8.0
    UNLIKE = 1.25
    """A raster takes at most so many times as long as the next known one and as it would in proportion to its pixels, or as much less: what differs
    more says that all rasters take another time by now."""
    OLD = 300

    budget_s: float
    scale: float = 1.0
    _times: dict[int, float] = field(default_factory=dict, repr=False)
    """By steps down from the whole raster."""
    _drawn: dict[int, int] = field(default_factory=dict, repr=False)
    """The number of the last picture on it."""
    _number: int = field(default=0, repr=False)
    _patience: dict[int, int] = field(default_factory=dict, repr=False)
    """Of a raster: how many pictures on a coarser one must leave room for it."""
    _spare: int = field(default=0, repr=False)
    """Pictures on end that left room for a finer raster."""
    _on: int | None = field(default=None, repr=False)
    """The raster of the last picture."""
    _since: int = field(default=0, repr=False)
    """Pictures on it, since another."""
    _last: float = field(default=0.0, repr=False)
    """The time of the last picture."""
    _odd: int = field(default=0, repr=False)
    """Pictures on end that took a time of another order."""

    @staticmethod
    def of(software: bool) -> "Pace":
        """For a processor that stands in for a graphics card, or for one: the first picture comes soon, if coarsely."""
        return Pace(1 / 15, Pace.STEP**-8) if software else Pace(1 / CARD_FPS)

    def saw(self, seconds: float, budget_s: float | None = None) -> None:
        """Take in how long a picture took at the present scale, and may take."""
        steps, budget = -round(math.log(self.scale, self.STEP)), budget_s or self.budget_s
        self._since = self._since + 1 if steps == self._on else 1
        self._on, before, self._last = steps, self._last, seconds
        if seconds < self.HOPELESS * budget:
            seconds = min(seconds, before if self._since > 1 else 0.0)
            if self._since <= self.NEW and seconds < self.LATE * budget:
                return
        self._take_in(steps, max(seconds, 1e-6))
        fixed, growing = self._fit()
        # where what no raster changes takes most of the time, a coarser one does more harm than good
        wanted = -math.log(max(budget - fixed, 0.5 * fixed) / growing, self.STEP) / 2
        self._spare = self._spare + 1 if wanted <= steps - 1 else 0
        if self._spare >= self._patience.get(steps - 1, self.UP_AFTER):
            finer = range(max(math.ceil(wanted), steps - self.MOST_AT_ONCE), steps)
            steps = next(step for step in finer if self._spare >= self._patience.get(step, self.UP_AFTER))
            self._spare = 0
        elif wanted > steps + self.SLACK:
            self._patience[steps] = min(2 * self._patience.get(steps, self.UP_AFTER), self.MOST_PATIENCE)
            steps = min(math.ceil(wanted), steps + self.MOST_AT_ONCE)
        self.scale = min(max(self.STEP**-steps, self.LEAST), 1.0)

    def forget(self) -> None:
        """What follows has nothing to do with what was."""
        self._times, self._drawn, self._patience, self._odd = {}, {}, {}, 0

    def _take_in(self, steps: int, seconds: float) -> None:
        if self._times:
            fixed, growing = self._fit()
            ratio = seconds / (fixed + growing * self.scale**2)
            self._odd = 0 if 1 / self.EXCEPTION < ratio < self.EXCEPTION else self._odd + 1
        if self._odd == self.AGREED:
            self.forget()
        self._number += 1
        self._drawn[steps] = self._number
        if steps not in self._times and self._times:
            near = min(self._times, key=lambda step: abs(step - steps))
            least, most = sorted((self._times[near], self._times[near] * self.STEP ** (2 * (near - steps))))
            likely = min(max(seconds, least / self.UNLIKE), most * self.UNLIKE)
            self._times = {step: time * seconds / likely for step, time in self._times.items()}
        before = self._times.setdefault(steps, seconds)
        changed = 1.0 + self.FRESH * (min(seconds / before, self.EXCEPTION) - 1.0)
        known = (step for step, number in self._drawn.items() if self._number - number < self.OLD)
        self._times = {step: changed * self._times[step] for step in known}
        self._drawn = {step: self._drawn[step] for step in self._times}

    def _fit(self) -> tuple[float, float]:
        """(a, b), neither negative, by least squares."""
        x = np.array([self.STEP ** (-2 * steps) for steps in self._times])
        y = np.array(list(self._times.values()))
        n, xx, xy = len(x) + self.AT_NOTHING, x @ x, x @ y
        growing = (n * xy - x.sum() * y.sum()) / (n * xx - x.sum() ** 2)
        fixed = (y.sum() - growing * x.sum()) / n
        return (0.0, xy / xx) if fixed < 0.0 else (fixed, max(growing, 1e-9))


def _rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    """Turn by `angle` around a unit vector, counter-clockwise seen from its tip (Rodrigues)."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross


def _orthonormal(axes: np.ndarray) -> np.ndarray:
    """The nearest rotation: many small turns must not add up to a skew."""
    u, _, vt = np.linalg.svd(axes)
    return u @ vt
