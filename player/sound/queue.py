"""Decoded samples on their way to the device, and the clock that follows from what the device has taken."""

import threading
import time as clock
from collections import deque
from collections.abc import Callable

import numpy as np

from kpc.format.scene.sound import SAMPLE_RATE


class SampleQueue:
    """Blocks of samples with their positions in the clip. Used by three threads.

    Args:
        now: the time in seconds.

    Attributes:
        volume: factor of what is pulled.
        holds: whether the device gets silence and the position stays.
    """

    def __init__(self, now: Callable[[], float] = clock.monotonic) -> None:
        self.volume, self.holds = 1.0, True
        self._now, self._lock = now, threading.Lock()
        self._blocks: deque[tuple[int, np.ndarray]] = deque()
        self._used = 0  # frames of the first block that were pulled
        self._last: tuple[int, int, float] | None = None  # position, number and time of the frames pulled last

    def clear(self) -> None:
        """Drop everything."""
        with self._lock:
            self._blocks.clear()
            self._used, self._last = 0, None

    def put(self, position: int, samples: np.ndarray) -> None:
        """Append a block, (n, 2) float32, whose first frame is sample `position` of the clip."""
        with self._lock:
            self._blocks.append((position, samples))

    @property
    def waiting(self) -> int:
        """Frames that wait to be pulled."""
        with self._lock:
            return sum(len(samples) for _, samples in self._blocks) - self._used

    def pull(self, count: int) -> np.ndarray:
        """Return (count, 2) float32 for the device; silence where nothing waits."""
        found, filled = np.zeros((count, 2), np.float32), 0
        with self._lock:
            first: int | None = None
            while not self.holds and filled < count and self._blocks:
                position, samples = self._blocks[0]
                taken = samples[self._used : self._used + count - filled]
                found[filled : filled + len(taken)] = taken
                first = position + self._used if first is None else first
                filled, self._used = filled + len(taken), self._used + len(taken)
                if self._used == len(samples):
                    self._blocks.popleft()
                    self._used = 0
            if first is not None:
                self._last = first, filled, self._now()
        found *= self.volume
        return found

    def heard(self, latency_s: float) -> float | None:
        """Return the sample of the clip that is heard now; None if none was pulled since `clear`, or if it holds.

        Between two pulls it advances with the time, at most to the end of what was pulled.
        """
        with self._lock:
            if self._last is None or self.holds:
                return None
            position, count, at = self._last
            return position + min((self._now() - at) * SAMPLE_RATE, count) - latency_s * SAMPLE_RATE
