"""The camera path of a player: keyframes that are added while it runs, and the camera that follows it. No window."""

import time as clock
from pathlib import Path

from kpc.format.scene.cameras import Camera
from kpc.player.app.camera_paths import GAP_S, CameraPath

# Bounds of the time between two keyframes that are set while the clip plays: it is the time that passed in between.
MIN_GAP_S, MAX_GAP_S = 0.1, 60.0


class PathFollower:
    """A camera path and the position on it.

    Attributes:
        path: the keyframes.
        position_s: seconds, from `path.start_s` to `path.end_s` while the camera follows the path.
        is_active: whether the camera follows the path.
    """

    def __init__(self) -> None:
        self.path, self.position_s, self.is_active = CameraPath(), 0.0, False
        self._kept = self.path  # the path that is in a file, or that the user has given up
        self._last_keyframe_at: float | None = None  # time.monotonic(); None unless the clip played then

    @property
    def is_empty(self) -> bool:
        """Whether there are no keyframes."""
        return not self.path.keyframes

    @property
    def is_unsaved(self) -> bool:
        """Whether there are keyframes that would be lost."""
        return not self.is_empty and self.path is not self._kept

    def replace(self, path: CameraPath) -> None:
        """Take over another path, from a file, and go to its beginning."""
        self.path, self._kept, self.position_s = path, path, 0.0

    def save(self, file: Path) -> None:
        """Write the path to a file."""
        self.path.save(file)
        self._kept = self.path

    def give_up(self) -> None:
        """Do without a file of the path as it is."""
        self._kept = self.path

    def start(self, from_beginning: bool = False) -> None:
        """Follow the path, from where the camera left it unless that was its end."""
        self.is_active = True
        if from_beginning or not self.path.start_s <= self.position_s < self.path.end_s:
            self.position_s = self.path.start_s

    def after(self, seconds: float, loop: bool) -> tuple[float, bool]:
        """Return the position after some time, and whether the camera still follows the path then."""
        position_s = self.position_s + seconds
        if position_s <= self.path.end_s:
            return position_s, True
        return (self.path.start_s, True) if loop else (self.path.end_s, False)

    def append(self, camera: Camera, time: float, playing: bool) -> None:
        """Add a keyframe at the end. While the clip plays, as long after the last one as has passed since.

        Args:
            camera: what to see.
            time: in the clip, [0, 1].
            playing: whether the clip plays.
        """
        now, gap_s = clock.monotonic(), GAP_S
        if self._last_keyframe_at is not None and playing:
            gap_s = min(max(now - self._last_keyframe_at, MIN_GAP_S), MAX_GAP_S)
        self._last_keyframe_at = now if playing else None
        self.path = self.path.with_keyframe(camera, time, gap_s)

    def remove(self, number: int) -> None:
        """Remove a keyframe, counted from 0."""
        self.path, self._last_keyframe_at = self.path.without(number), None
        self.is_active = self.is_active and not self.is_empty
