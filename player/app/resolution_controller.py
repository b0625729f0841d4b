"""Choose the resolution of frames so that they come in time. No window, no OpenGL."""

import math
from dataclasses import dataclass, field

import numpy as np

# Frames per second that a graphics card is to reach, and a processor, unless another rate is asked for.
GPU_FPS, PROCESSOR_FPS = 50.0, 15.0
# Factor between the sides of neighbouring resolutions; the card is asked for few different sizes, and keeps their
# textures.
STEP = 2**0.25
# The smallest scale, and the one at which a processor begins so that the first picture appears soon.
MIN_SCALE, PROCESSOR_SCALE = STEP**-12, STEP**-8
# Steps by which the resolution may be too high before it is lowered.
SLACK_STEPS = 0.5
# The resolution is raised after so many consecutive frames that leave time for it; after twice as many for each time
# that it was lowered from there, up to MAX_PATIENCE.
UP_AFTER, MAX_PATIENCE = 3, 96
# Steps that it may be raised or lowered at once.
MAX_STEPS = 3
# Weight of the newest frame in the mean time of its resolution.
NEW_WEIGHT = 0.25
# Weight of the fictitious frame of no pixels that takes no time; see `_fit`.
ORIGIN_WEIGHT = 0.5
# A frame that takes this many times the mean counts as if it took no longer than that. After AGREED_FRAMES consecutive
# frames that differ from the expected time by this factor, all measurements are discarded.
OUTLIER_FACTOR, AGREED_FRAMES = 4.0, 4
# The first SETTLING_FRAMES at a resolution count only if they take LATE_FACTOR times the budget, or the first alone
# HOPELESS_FACTOR times.
SETTLING_FRAMES, LATE_FACTOR, HOPELESS_FACTOR = 4, 2.5, 8.0
# How far the time of a new resolution may differ from what the nearest known one suggests before all times are
# rescaled.
PLAUSIBLE_FACTOR = 1.25
# Frames after which the time of a resolution that was not used again is discarded.
MAX_AGE_FRAMES = 300


@dataclass
class ResolutionController:
    """Chooses the scale of the raster, its side over that of the window.

    A frame takes a + b scale^2 seconds. Both are fitted to the mean times of the resolutions that were used, and, with
    less weight, to no time for no pixels, so that a is 0 until several resolutions show otherwise. If the time of one
    resolution changes, the times of all are changed by the same factor.

    The first frame at a resolution is drawn without reprojection and makes textures, and a late frame leaves more for
    the next one to draw; hence SETTLING_FRAMES. For the same reason no frame counts as longer than the one before it.

    Attributes:
        budget_s: seconds that a frame may take.
        scale: in [MIN_SCALE, 1], a power of STEP.
    """

    budget_s: float
    scale: float = 1.0
    # Resolutions are given as steps down from scale 1.
    _times: dict[int, float] = field(default_factory=dict, repr=False)  # mean time of each resolution
    _used: dict[int, int] = field(default_factory=dict, repr=False)  # number of the last frame at each resolution
    _number: int = field(default=0, repr=False)  # of the last frame
    _patience: dict[int, int] = field(default_factory=dict, repr=False)  # frames that must leave time for a resolution
    _in_time: int = field(default=0, repr=False)  # consecutive frames that left time for a higher resolution
    _last_steps: int | None = field(default=None, repr=False)  # the resolution of the last frame
    _since_change: int = field(default=0, repr=False)  # frames at that resolution
    _last_s: float = field(default=0.0, repr=False)  # time of the last frame
    _outliers: int = field(default=0, repr=False)  # consecutive frames with unexpected times

    @staticmethod
    def of(software: bool) -> "ResolutionController":
        """Return the controller of a graphics card, or of a processor that draws in its place."""
        return (
            ResolutionController(1 / PROCESSOR_FPS, PROCESSOR_SCALE) if software else ResolutionController(1 / GPU_FPS)
        )

    def record(self, seconds: float, budget_s: float | None = None) -> None:
        """Record the time of a frame that was drawn at the present scale, and choose that of the next.

        Args:
            seconds: that the frame took.
            budget_s: seconds that a frame may take; None: `self.budget_s`.
        """
        steps, budget = -round(math.log(self.scale, STEP)), budget_s or self.budget_s
        self._since_change = self._since_change + 1 if steps == self._last_steps else 1
        self._last_steps, before, self._last_s = steps, self._last_s, seconds
        if seconds < HOPELESS_FACTOR * budget:
            seconds = min(seconds, before if self._since_change > 1 else 0.0)
            if self._since_change <= SETTLING_FRAMES and seconds < LATE_FACTOR * budget:
                return
        self._update_times(steps, max(seconds, 1e-6))
        fixed_s, pixels_s = self._fit()
        # If most of the time does not depend on the resolution, lowering it does more harm than good.
        wanted = -math.log(max(budget - fixed_s, 0.5 * fixed_s) / pixels_s, STEP) / 2
        self._in_time = self._in_time + 1 if wanted <= steps - 1 else 0
        if self._in_time >= self._patience.get(steps - 1, UP_AFTER):
            higher = range(max(math.ceil(wanted), steps - MAX_STEPS), steps)
            steps = next(step for step in higher if self._in_time >= self._patience.get(step, UP_AFTER))
            self._in_time = 0
        elif wanted > steps + SLACK_STEPS:
            self._patience[steps] = min(2 * self._patience.get(steps, UP_AFTER), MAX_PATIENCE)
            steps = min(math.ceil(wanted), steps + MAX_STEPS)
        self.scale = min(max(STEP**-steps, MIN_SCALE), 1.0)

    def forget(self) -> None:
        """Discard all measurements."""
        self._times, self._used, self._patience, self._outliers = {}, {}, {}, 0

    def _update_times(self, steps: int, seconds: float) -> None:
        """Update the mean time of a resolution, and scale those of the others by the same factor."""
        if self._times:
            fixed_s, pixels_s = self._fit()
            ratio = seconds / (fixed_s + pixels_s * self.scale**2)
            self._outliers = 0 if 1 / OUTLIER_FACTOR < ratio < OUTLIER_FACTOR else self._outliers + 1
        if self._outliers == AGREED_FRAMES:
            self.forget()
        self._number += 1
        self._used[steps] = self._number
        if steps not in self._times and self._times:
            nearest = min(self._times, key=lambda step: abs(step - steps))
            proportional = self._times[nearest] * STEP ** (2 * (nearest - steps))
            lowest, highest = sorted((self._times[nearest], proportional))
            plausible = min(max(seconds, lowest / PLAUSIBLE_FACTOR), highest * PLAUSIBLE_FACTOR)
            self._times = {step: time * seconds / plausible for step, time in self._times.items()}
        before = self._times.setdefault(steps, seconds)
        factor = 1.0 + NEW_WEIGHT * (min(seconds / before, OUTLIER_FACTOR) - 1.0)
        recent = (step for step, number in self._used.items() if self._number - number < MAX_AGE_FRAMES)
        self._times = {step: factor * self._times[step] for step in recent}
        self._used = {step: self._used[step] for step in self._times}

    def _fit(self) -> tuple[float, float]:
        """Fit time = a + b scale^2 to all times and, with ORIGIN_WEIGHT, to (0, 0) by least squares; return a and b."""
        x = np.array([STEP ** (-2 * steps) for steps in self._times])
        y = np.array(list(self._times.values()))
        n, xx, xy = len(x) + ORIGIN_WEIGHT, x @ x, x @ y
        slope = (n * xy - x.sum() * y.sum()) / (n * xx - x.sum() ** 2)
        intercept = (y.sum() - slope * x.sum()) / n
        return (0.0, xy / xx) if intercept < 0.0 else (intercept, max(slope, 1e-9))
