"""Videos that are written while the window continues: a thread passes frames to ffmpeg, so the window never waits."""

import queue
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from kpc.format.common.errors import KpcError
from kpc.format.common.films import write_video

# Frames per second of all videos.
FILM_FPS = 30.0
# Bytes of frames that may wait for ffmpeg, and how many frames may wait however large they are.
QUEUE_BYTES, MIN_QUEUE_FRAMES = 1 << 27, 2


class _AbandonedError(Exception):
    """The video is given up."""


class Recording:
    """A video that is being written; see `kpc.format.common.films.write_video`. The file appears when it is complete.

    Attributes:
        path: of the file, absolute.
        fps: frames per second.
        size: (width, height) of every frame.
        taken: number of frames so far.
    """

    def __init__(self, path: Path, fps: float, size: tuple[int, int]) -> None:
        self.path, self.fps, self.size, self.taken = path.absolute(), fps, size, 0
        frame_bytes = 3 * size[0] * size[1]
        self._queue: queue.Queue[np.ndarray] = queue.Queue(max(QUEUE_BYTES // frame_bytes, MIN_QUEUE_FRAMES))
        self._ending = self._abandoned = False
        self._failure: str | None = None
        self._thread = threading.Thread(target=self._write, name="recording", daemon=True)
        self._thread.start()

    @property
    def duration_s(self) -> float:
        """Seconds that the frames so far last."""
        return self.taken / self.fps

    @property
    def is_ending(self) -> bool:
        """Whether it takes no more frames."""
        return self._ending

    @property
    def has_room(self) -> bool:
        """Whether the next frame would be taken."""
        return not (self._ending or self._queue.full())

    @property
    def is_over(self) -> bool:
        """Whether the file is complete, or writing it has failed."""
        return not self._thread.is_alive()

    @property
    def failure(self) -> str | None:
        """Why writing the file has failed; None if it has not."""
        return self._failure

    def take(self, frame: np.ndarray) -> bool:
        """Append a frame.

        Args:
            frame: (height, width, 3) uint8; it must not change afterwards.

        Returns:
            False if the queue is full and the frame was not taken.
        """
        if not self.has_room:
            return False
        self._queue.put_nowait(frame)
        self.taken += 1
        return True

    def end(self) -> None:
        """Accept no more frames. Those in the queue are still written; see `is_over`."""
        self._ending = True

    def close(self, timeout_s: float) -> None:
        """End, and wait at most `timeout_s` seconds for the file; then give it up and leave no file."""
        self.end()
        self._thread.join(timeout_s)
        self._abandoned = True
        self._thread.join(1.0)

    def _write(self) -> None:
        try:
            write_video(self.path, self._frames(), self.fps)
        except _AbandonedError:
            self._failure = f"{self.path}: the video was given up before it was complete"
        except KpcError as error:
            self._failure = str(error)
        except OSError as error:
            self._failure = f"{self.path}: {error.strerror or error}"

    def _frames(self) -> Iterator[np.ndarray]:
        while True:
            if self._abandoned:
                raise _AbandonedError
            try:
                frame = self._queue.get(timeout=0.05)
            except queue.Empty:
                if self._ending:
                    return
                continue
            yield frame


def frames_due(elapsed_s: float, fps: float, taken: int) -> int:
    """Return how many frames a recording lacks whose frame n belongs to the time n / fps.

    A window that draws less often than `fps` records frames more than once; one that draws more often leaves some out.

    Args:
        elapsed_s: seconds since the recording began.
        fps: frames per second.
        taken: frames so far.
    """
    return max(int(elapsed_s * fps) + 1 - taken, 0)
