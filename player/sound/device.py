"""The sound device of this machine, through the package miniaudio (extra `sound`).

miniaudio opens what the system has (ALSA, PulseAudio, Core Audio, WASAPI) from wheels without further libraries;
sounddevice, its like, needs PortAudio to be installed on Linux.
"""

import sys
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from kpc.format.common import extras
from kpc.format.common.errors import MediaError
from kpc.format.scene.sound import SAMPLE_RATE

BUFFER_MS = 60  # of the device: what is pulled is heard so much later, about
MISSING = f"the clip has sound; {extras.install('sound')} plays it"
NO_DEVICE = "there is no sound device; the clip plays without sound"

Pull = Callable[[int], np.ndarray]  # returns so many frames, (n, 2) float32


class Device(Protocol):
    """What plays samples."""

    @property
    def latency_s(self) -> float:
        """Seconds from when a frame is pulled until it is heard."""

    def close(self) -> None:
        """Stop, and never pull again."""


class SystemDevice:
    """The system's default device.

    Args:
        pull: called by a thread of the device.

    Raises:
        MediaError: there is none, or miniaudio is not installed.
    """

    latency_s = BUFFER_MS / 1e3

    def __init__(self, pull: Pull) -> None:
        try:
            import miniaudio  # late: a viewer may lack it
        except (ImportError, OSError) as error:
            raise MediaError(MISSING) from error
        try:
            self._device: Any = miniaudio.PlaybackDevice(
                miniaudio.SampleFormat.FLOAT32, 2, SAMPLE_RATE, BUFFER_MS, backends=_backends(), app_name="kpplay"
            )
        except miniaudio.MiniaudioError as error:
            raise MediaError(NO_DEVICE) from error
        if self._device.backend == "Null":  # what miniaudio falls back to
            self._device.close()
            raise MediaError(NO_DEVICE)
        frames = _frames(pull)
        next(frames)
        self._device.start(frames)

    def close(self) -> None:
        """Stop, and never pull again."""
        self._device.close()


def _backends() -> list[Any] | None:
    """Return what to try; None for all there is. Without sound cards, ALSA would write many lines to standard error."""
    from miniaudio import Backend

    is_bare = sys.platform == "linux" and not Path("/dev/snd").exists()
    return [Backend.PULSEAUDIO, Backend.JACK] if is_bare else None


def _frames(pull: Pull) -> Generator[bytes, int, None]:
    """Yield as many frames as the device asks for."""
    count = yield b""
    while True:
        count = yield pull(count).tobytes()
