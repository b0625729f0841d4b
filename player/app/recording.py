"""Videos of what the window shows, written while it goes on: a thread hands frames to ffmpeg, the window's never waits for it."""

import queue
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from kpc.format.common.errors import KpcError
from kpc.format.common.media import write_video

WAITING_BYTES = 1 << 27
"""Frames that ffmpeg has not taken yet may fill so much; at least MIN_WAITING of them may wait."""
MIN_WAITING = 2


class _Abandoned(Exception):
    """The video is not wanted any more."""


class Recording:
    """A video in the making, H.264 as of `kpc.format.common.media.write_video`; the file appears once it is whole.

    Attributes:
        path: where it goes; fps: frames a second; size: (width, height) of every frame.
        taken: frames so far.
    """

    def __init__(self, path: Path, fps: float, size: tuple[int, int]) -> None:
        self.path, self.fps, self.size, self.taken = path.absolute(), fps, size, 0
        frame_bytes = 3 * size[0] * size[1]
        self._waiting: queue.Queue[np.ndarray] = queue.Queue(max(WAITING_BYTES // frame_bytes, MIN_WAITING))
        self._ending = self._abandoned = False
        self._failure: str | None = None
        self._thread = threading.Thread(target=self._write, name="recording", daemon=True)
        self._thread.start()

    @property
    def duration_s(self) -> float:
        return self.taken / self.fps

    @property
    def is_ending(self) -> bool:
        """Whether it takes no more frames."""
        return self._ending

    @property
    def has_room(self) -> bool:
        """Whether the next frame would be taken."""
        return not (self._ending or self._waiting.full())

    @property
    def is_over(self) -> bool:
        """Whether the file is there, or will never be."""
        return not self._thread.is_alive()

    @property
    def failure(self) -> str | None:
        """Why there is no file, once that is known."""
        return self._failure

    def take(self, frame: np.ndarray) -> bool:
        """One more frame, uint8 (height, width, 3); False if there is no room for it now. It must not change afterwards."""
        if not self.has_room:
            return False
        self._waiting.put_nowait(frame)
        self.taken += 1
        return True

    def end(self) -> None:
        """No more frames will come. What waits is written, which takes its time: see `is_over`."""
        self._ending = True

    def close(self, patience_s: float) -> None:
        """End, wait so long at most, then give up: no file is left, neither half of one."""
        self.end()
        self._thread.join(patience_s)
        self._abandoned = True
        self._thread.join(1.0)

    def _write(self) -> None:
        try:
            write_video(self.path, self._frames(), self.fps)
        except _Abandoned:
            self._failure = f"{self.path}: given up before it was written"
        except KpcError as error:
            self._failure = str(error)
        except OSError as error:
            self._failure = f"{self.path}: {error.strerror or error}"

    def _frames(self) -> Iterator[np.ndarray]:
        while True:
            if self._abandoned:
                raise _Abandoned
            try:
                frame = self._waiting.get(timeout=0.05)
            except queue.Empty:
                if self._ending:
                    return
                continue
            yield frame


def frames_due(elapsed_s: float, fps: float, taken: int) -> int:
    """How many frames a recording lacks that began `elapsed_s` ago: frame n belongs to n / fps.

    A window that draws less often than `fps` records a picture more than once, one that draws more often leaves some out.
    """
    return max(int(elapsed_s * fps) + 1 - taken, 0)
