"""The quality dial, and the hand that moves it so that pictures come in time: no window, no OpenGL."""

import statistics
from collections import deque
from dataclasses import dataclass, field

from kpc.player.app.resolution_controller import GPU_FPS, ResolutionController
from kpc.player.quality import DEFAULT, LEVELS, neighbouring_level

LEVEL_NAMES = tuple(LEVELS)
TOO_SLOW, ROOM = 1.1, 0.85
"""Of the time a picture may take: down from above the one; up if the finer rung is expected to stay below the other."""
DOWN_AFTER, UP_AFTER = 3, 12
"""Pictures seen on a rung before it is left: slowness hurts at once, step_offsets can wait."""
GUESS = 1.5
"""How much longer the next rung takes, until it has been tried."""
UNSETTLED = 1
"""Pictures after a move that do not count: shaders are compiled, textures made."""
HOPELESS, FAR = 4.0, 2
"""Two pictures on end that take so many times as long as they may are enough, from the first on, and so many rungs are left at once."""
SKIPPED_ON_GPUS = frozenset({"fine"})
"""Rungs that a graphics card is not moved to: finding what is off costs it more than marching all, as the next finer one does. (An H100 at
1920x1080: room 5.8 ms on `fine`, 3.4 on `finer`; soldier 1.9 and 1.7.)"""


@dataclass
class QualityController:
    """Which rung of LADDER pictures are drawn on while something moves, and how finely below the lowest one.

    With `target_s` it moves by itself. It goes down when the median of the last DOWN_AFTER pictures is too slow, sooner where that is
    hopeless. It goes up when that of UP_AFTER leaves room for what the finer rung takes, which it learns whenever it moves: so it does
    not try again what it knows to be too slow, and does not flicker between two rungs. Below the fastest rung the raster gets coarser
    (`ResolutionController`).

    Attributes:
        chosen: the rung that was set by hand, and what a picture that stands still is drawn on at least.
        rung: what is drawn on while something moves.
        target_s: seconds a picture may take; None: the rung stays where it is.
        pace: the raster's share of the window, in as much as the rung is not enough.
        skipped: rungs that it does not move to by itself.
    """

    chosen_level: str
    resolution: ResolutionController
    target_s: float | None = None
    skipped: frozenset[str] = frozenset()
    level: str = field(init=False)
    _seen: deque[float] = field(init=False, default_factory=lambda: deque(maxlen=UP_AFTER))
    _skipped: int = field(init=False, default=0)
    _hopeless: int = field(init=False, default=0)
    """Pictures on end."""
    _growth: dict[str, float] = field(init=False, default_factory=dict)
    """By rung, how many times as long the next finer one takes."""
    _left: tuple[str, float] | None = field(init=False, default=None)
    """The rung before the last move, and the time it took there."""

    def __post_init__(self) -> None:
        self.level = self.chosen_level

    @property
    def still_level(self) -> str:
        """The rung for a picture that stands still."""
        return max(self.level, self.chosen_level, key=LEVEL_NAMES.index)

    def choose(self, rung: str) -> None:
        """Set it by hand, which ends its moving by itself."""
        self.chosen_level = self.level = rung
        self.target_s = None
        self.resolution.forget()
        self._restart()

    def hold(self, fps: float | None) -> None:
        """Move by itself from now on, for so many pictures a second; None: stay on the rung it is on.

        Where the raster is coarse, it begins from the fastest rung: no other is drawn on any but a whole raster then.
        """
        if fps is None:
            self.chosen_level = self.level
        elif self.resolution.scale < 1.0:
            self.level = LEVEL_NAMES[0]
        self.resolution.forget()
        self.target_s = None if fps is None else 1.0 / fps
        self._restart()

    def record(self, seconds: float) -> None:
        """Take in how long a picture took, on `rung` and at the present scale."""
        is_hopeless = self.target_s is not None and self.level != LEVEL_NAMES[0] and seconds > HOPELESS * self.target_s
        self._hopeless = self._hopeless + 1 if is_hopeless else 0
        if self._hopeless == 2:
            self._move(-FAR, seconds)
            return
        if self._skipped < UNSETTLED:
            self._skipped += 1
            return
        if self.target_s is None:
            self.resolution.record(seconds)
            return
        if self.resolution.scale < 1.0:  # on the fastest rung
            self.resolution.record(seconds, ROOM * self.target_s)
            return
        self._seen.append(seconds)
        if len(self._seen) < DOWN_AFTER:
            return
        lately = statistics.median(list(self._seen)[-DOWN_AFTER:])
        if len(self._seen) == DOWN_AFTER:
            self._learn(lately)
        if lately > TOO_SLOW * self.target_s:
            if self.level == LEVEL_NAMES[0]:
                self.resolution.record(lately, ROOM * self.target_s)
            else:
                self._move(-1, lately)
        elif len(self._seen) == UP_AFTER and self.level != LEVEL_NAMES[-1]:
            typical = statistics.median(self._seen)
            if typical * self._growth.get(self.level, GUESS) < ROOM * self.target_s:
                self._move(+1, typical)

    def _move(self, rungs: int, seconds: float) -> None:
        self._left = self.level, seconds
        self.level = neighbouring_level(self.level, rungs, self.skipped)
        self._restart()

    def _learn(self, seconds: float) -> None:
        """How the rung it is on compares with the one it came from, if that is the next."""
        if self._left is not None:
            (lower, fast), (upper, slow) = sorted(
                (self._left, (self.level, seconds)), key=lambda pair: LEVEL_NAMES.index(pair[0])
            )
            if upper == neighbouring_level(lower, 1, self.skipped):
                self._growth[lower] = max(slow / max(fast, 1e-6), 1.0)
            self._left = None

    def _restart(self) -> None:
        self._seen.clear()
        self._skipped = self._hopeless = 0


def quality_controller_for(software: bool, quality: str | None, target_fps: float | None) -> QualityController:
    """Where a device begins: a processor on the ladder's knee and coarsely, a graphics card on the reference.

    Cards differ a hundredfold, so one for which nothing is asked moves by itself from there: of a card too slow for the reference, a
    lower rung shows more than a coarser raster does.
    """
    if software:
        dial = QualityController(quality or DEFAULT, ResolutionController.of(software))
    else:
        dial = QualityController(quality or LEVEL_NAMES[-1], ResolutionController.of(software), skipped=SKIPPED_ON_GPUS)
        target_fps = target_fps or (GPU_FPS if quality is None else None)
    if target_fps is not None:
        dial.hold(target_fps)
    return dial
