"""Playing the sound of a clip in step with its pictures: the clock of the clip follows the device.

A thread decodes ahead of the playhead; a thread of the device pulls what is decoded. In each frame the window's thread
asks `advance` by how much the clip is to go on, and passes its position to `follow`: a sound that is elsewhere, after a
seek or a pause, begins anew there.
"""

import math
import threading
import time as clock
from collections.abc import Callable
from typing import Protocol

import numpy as np

from kpc.format.common.errors import KpcError, MediaError
from kpc.format.scene.sound import SAMPLE_RATE
from kpc.player.sound.device import Device, Pull, SystemDevice
from kpc.player.sound.queue import SampleQueue

# Seconds in which the clip follows a difference from the sound, but for 1 / e of it.
FOLLOW_S = 0.5
# A sound that is farther than this from the clip begins anew at the clip's time, seconds.
APART_S = 0.2
# Seconds that are decoded at once, and how many wait for the device.
BLOCK_S, AHEAD_S = 1.0, 3.0


class Samples(Protocol):
    """Where samples come from (`kpc.player.sound.clip_samples.ClipSamples`).

    Attributes:
        notice: why some that were asked for are silent, for the user; None if there is no reason.
    """

    notice: str | None

    def read(self, first: int, count: int) -> np.ndarray:
        """Return (count, 2) float32 from sample `first` on."""

    def close(self) -> None:
        """Let a read in progress fail."""


class SoundPlayback:
    """The sound of a clip that is being played.

    Args:
        samples: of the clip.
        duration_s: from the first frame to the last, after which a clip that loops begins again.
        open_device: opens the device, when the first sound is to be heard.
        now: the time in seconds.
        starts_thread: False if the caller decodes, with `fill`.

    Attributes:
        notice: why nothing is heard, for the user; None if all is well. The caller may take it.
    """

    def __init__(
        self,
        samples: Samples,
        duration_s: float,
        *,
        open_device: Callable[[Pull], Device] = SystemDevice,
        now: Callable[[], float] = clock.monotonic,
        starts_thread: bool = True,
    ) -> None:
        self.notice: str | None = None
        self._samples, self._length = samples, round(duration_s * SAMPLE_RATE)
        self._open_device, self._starts_thread = open_device, starts_thread
        self._queue = SampleQueue(now)
        self._device: Device | None = None
        self._noticed: str | None = None  # what was said of the samples, once
        self._is_over = False  # there is no device, the sound cannot be decoded, or `close` was called
        self._change = threading.Condition()
        self._next = 0  # the sample of the clip that is decoded next
        self._start = 0  # a number that grows whenever the sound begins anew
        self._loops = True
        self._thread: threading.Thread | None = None

    def set_volume(self, volume: float) -> None:
        """Set the volume, 0 for silence and 1 for the sound unchanged."""
        self._queue.volume = volume * volume  # about as loudness is heard

    def advance(self, seconds: float, time_s: float) -> float:
        """Return by how much the clip is to advance, so that it follows what is heard.

        Args:
            seconds: since the last frame.
            time_s: where the clip was then, seconds.
        """
        heard_s = self._heard_s()
        if heard_s is None:
            return seconds
        error_s = self._apart(heard_s, time_s + seconds)
        if abs(error_s) > APART_S:
            return seconds
        return max(seconds + error_s * (1 - math.exp(-seconds / FOLLOW_S)), 0.0)

    def follow(self, time_s: float, *, plays: bool, loops: bool) -> None:
        """Take over where the clip is, seconds, whether it plays at its own speed, and whether it loops."""
        self._loops = loops
        if self._is_over:
            return
        if not plays:
            self._queue.holds = True
            return
        if self._device is None and not self._open():
            return
        heard_s = self._heard_s()
        is_resumed = self._queue.holds
        self._queue.holds = False
        if is_resumed or (heard_s is not None and abs(self._apart(heard_s, time_s)) > APART_S):
            self._begin(time_s)

    def fill(self) -> bool:
        """Decode a block if there is room for it; return whether there was."""
        with self._change:
            start, first = self._start, self._next
            if self._queue.waiting >= AHEAD_S * SAMPLE_RATE or (first >= self._length and not self._loops):
                return False
            first = first % self._length if self._loops else first
            count = min(round(BLOCK_S * SAMPLE_RATE), self._length - first)
        samples = self._samples.read(first, count)
        if self._samples.notice != self._noticed:
            self.notice = self._noticed = self._samples.notice
        with self._change:
            if start == self._start:  # else it began anew meanwhile
                self._queue.put(first, samples)
                self._next = first + count
        return True

    def close(self) -> None:
        """End the threads."""
        with self._change:
            self._is_over = True
            self._change.notify_all()
        if self._device is not None:
            self._device.close()
            self._device = None
        self._samples.close()
        if self._thread is not None:
            self._thread.join(timeout=0.5)

    def _open(self) -> bool:
        try:
            self._device = self._open_device(self._queue.pull)
        except MediaError as error:
            self._fail(error)
            return False
        if self._starts_thread:
            self._thread = threading.Thread(target=self._run, name="sound", daemon=True)
            self._thread.start()
        return True

    def _begin(self, time_s: float) -> None:
        with self._change:
            self._queue.clear()
            self._next, self._start = round(time_s * SAMPLE_RATE), self._start + 1
            self._change.notify_all()

    def _heard_s(self) -> float | None:
        heard = None if self._device is None else self._queue.heard(self._device.latency_s)
        return None if heard is None else heard / SAMPLE_RATE

    def _apart(self, heard_s: float, time_s: float) -> float:
        """Return how far the sound is ahead of the clip; across the end of a clip that loops, the shorter way."""
        length_s = self._length / SAMPLE_RATE
        apart = heard_s - time_s
        return (apart + length_s / 2) % length_s - length_s / 2 if self._loops else apart

    def _fail(self, error: Exception) -> None:
        self.notice, self._is_over = str(error), True

    def _run(self) -> None:
        try:
            while not self._is_over:
                if not self.fill():
                    with self._change:
                        if not self._is_over:
                            self._change.wait(timeout=BLOCK_S / 4)
        except (KpcError, OSError) as error:
            if not self._is_over:
                self._fail(error)
            self._queue.holds = True
