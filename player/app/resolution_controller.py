"""Choose the resolution at which frames are drawn so that they come in time: no window, no OpenGL."""

import math
from dataclasses import dataclass, field

import numpy as np

GPU_FPS = 50.0
"""Pictures a second that a graphics card is to come up with where nothing else is asked for."""


@dataclass
class ResolutionController:
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
    def of(software: bool) -> "ResolutionController":
        """For a processor that stands in for a graphics card, or for one: the first picture comes soon, if coarsely."""
        return (
            ResolutionController(1 / 15, ResolutionController.STEP**-8)
            if software
            else ResolutionController(1 / GPU_FPS)
        )

    def record(self, seconds: float, budget_s: float | None = None) -> None:
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
