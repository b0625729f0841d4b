"""Choose the quality level so that frames come in time. No window, no OpenGL."""

import statistics
from collections import deque
from dataclasses import dataclass, field

from kpc.player.app.resolution_controller import GPU_FPS, ResolutionController
from kpc.player.quality import DEFAULT, LEVELS, neighbouring_level

# Names of the quality levels, from the fastest to the exact one.
LEVEL_NAMES = tuple(LEVELS)
# Fractions of the target time: the level is lowered above the first, and raised if the next is expected below the
# second.
TOO_SLOW, IN_TIME = 1.1, 0.85
# Frames on a level before it is lowered or raised. Slow frames disturb at once; a finer picture can wait.
DOWN_AFTER, UP_AFTER = 3, 12
# Assumed factor between the frame times of neighbouring levels, until both have been tried.
ASSUMED_FACTOR = 1.5
# Frames after a change that do not count, because shaders are compiled and textures made.
SETTLING_FRAMES = 1
# Two consecutive frames that take this many times the target time lower the quality by several levels at once.
MUCH_TOO_SLOW, LEVELS_AT_ONCE = 4.0, 2


@dataclass
class QualityController:
    """Chooses the quality level of frames while something changes, and their resolution below the fastest level.

    With a target time it works automatically. The level is lowered if the median time of the last DOWN_AFTER frames is
    too long, and raised if the median of UP_AFTER frames leaves enough time for the next level. The factor between the
    times of two levels is measured whenever the level changes, so a level that is known to be too slow is not tried
    again and the controller does not oscillate. If the fastest level is still too slow, the resolution is lowered.

    Attributes:
        chosen_level: the level the user chose; still pictures have at least this one.
        resolution: chooses the resolution where the level does not suffice.
        target_s: seconds that a frame may take; None: the level does not change automatically.
        level: the level of frames while something changes.
    """

    chosen_level: str
    resolution: ResolutionController
    target_s: float | None = None
    level: str = field(init=False)
    _times: deque[float] = field(init=False, default_factory=lambda: deque(maxlen=UP_AFTER))  # of frames on this level
    _settling: int = field(init=False, default=0)  # frames since the last change, up to SETTLING_FRAMES
    _much_too_slow: int = field(init=False, default=0)  # consecutive frames
    _factors: dict[str, float] = field(
        init=False, default_factory=dict
    )  # time of the next finer level over that of a level
    _previous: tuple[str, float] | None = field(init=False, default=None)  # level before the last change, and its time

    def __post_init__(self) -> None:
        self.level = self.chosen_level

    @property
    def still_level(self) -> str:
        """The level of still pictures."""
        return max(self.level, self.chosen_level, key=LEVEL_NAMES.index)

    def choose(self, level: str) -> None:
        """Set the level, and do not change it automatically any more."""
        self.chosen_level = self.level = level
        self.target_s = None
        self.resolution.forget()
        self._restart()

    def hold(self, fps: float | None) -> None:
        """Change the level automatically to hold a frame rate; with None, keep that of still pictures, so that these do
        not change.

        If the resolution is reduced, begin with the fastest level: finer levels are only used at full resolution.
        """
        if fps is None:
            self.chosen_level = self.level = self.still_level
        elif self.resolution.scale < 1.0:
            self.level = LEVEL_NAMES[0]
        self.resolution.forget()
        self.target_s = None if fps is None else 1.0 / fps
        self._restart()

    def record(self, seconds: float) -> None:
        """Record the time of a frame at the present level and resolution, and choose those of the next one."""
        fastest, finest = LEVEL_NAMES[0], LEVEL_NAMES[-1]
        is_much_too_slow = (
            self.target_s is not None and seconds > MUCH_TOO_SLOW * self.target_s and self.level != fastest
        )
        self._much_too_slow = self._much_too_slow + 1 if is_much_too_slow else 0
        if self._much_too_slow == 2:
            self._change(-LEVELS_AT_ONCE, seconds)
            return
        if self._settling < SETTLING_FRAMES:
            self._settling += 1
            return
        if self.target_s is None:
            self.resolution.record(seconds)
            return
        if self.resolution.scale < 1.0:  # at the fastest level
            self.resolution.record(seconds, IN_TIME * self.target_s)
            return
        self._times.append(seconds)
        if len(self._times) < DOWN_AFTER:
            return
        recent = statistics.median(list(self._times)[-DOWN_AFTER:])
        if len(self._times) == DOWN_AFTER:
            self._measure_factor(recent)
        if recent > TOO_SLOW * self.target_s:
            if self.level == fastest:
                self.resolution.record(recent, IN_TIME * self.target_s)
            else:
                self._change(-1, recent)
        elif len(self._times) == UP_AFTER and self.level != finest:
            typical = statistics.median(self._times)
            if typical * self._factors.get(self.level, ASSUMED_FACTOR) < IN_TIME * self.target_s:
                self._change(+1, typical)

    def _change(self, levels: int, seconds: float) -> None:
        self._previous = self.level, seconds
        self.level = neighbouring_level(self.level, levels)
        self._restart()

    def _measure_factor(self, seconds: float) -> None:
        """Measure the factor between this level and the previous one, if they are neighbours."""
        if self._previous is not None:
            both = sorted((self._previous, (self.level, seconds)), key=lambda pair: LEVEL_NAMES.index(pair[0]))
            (lower, lower_s), (upper, upper_s) = both
            if upper == neighbouring_level(lower, 1):
                self._factors[lower] = max(upper_s / max(lower_s, 1e-6), 1.0)
            self._previous = None

    def _restart(self) -> None:
        self._times.clear()
        self._settling = self._much_too_slow = 0


def quality_controller_for(software: bool, quality: str | None, target_fps: float | None) -> QualityController:
    """Return the controller with which a device begins.

    A processor begins with the default level at a low resolution. A graphics card begins with the reference and, since
    cards differ a hundredfold in speed, holds GPU_FPS: a lower level looks better than a lower resolution.

    Args:
        software: whether a processor draws in place of a graphics card.
        quality: the level to keep; None: the device's.
        target_fps: the frame rate to hold; None: the device's.
    """
    if software:
        controller = QualityController(quality or DEFAULT, ResolutionController.of(software))
    else:
        controller = QualityController(quality or LEVEL_NAMES[-1], ResolutionController.of(software))
        target_fps = target_fps or (GPU_FPS if quality is None else None)
    if target_fps is not None:
        controller.hold(target_fps)
    return controller
