"""Videos of the window as it is used, and of the camera path frame by frame."""

import time as clock

from kpc.format.common import interrupts
from kpc.player.app.controls import OrbitView
from kpc.player.app.output_files import OutputFiles
from kpc.player.app.recording import FILM_FPS, Recording, frames_due
from kpc.player.app.scene_view import SceneView
from kpc.player.app.state import PlayerState

# Seconds that a video may take to be finished after the window was closed.
FINISH_TIMEOUT_S = 60.0
# Frames of a camera path after which the time that is left is shown.
MIN_TIMED_FRAMES = 3
# Frames of the window without one of the camera path, which may take seconds: ImGui shows a new panel, with the button
# that ends the video, in its second frame.
FRAMES_BEFORE_PATH = 2


class Filming:
    """The video that a player writes.

    Attributes:
        recording: the video, until its file is finished; None while none is written.
    """

    def __init__(self, state: PlayerState, scene_view: SceneView, files: OutputFiles) -> None:
        self.state, self.scene_view, self.files = state, scene_view, files
        self.recording: Recording | None = None
        self._along_path, self._started_at, self._waits = False, 0.0, 0

    @property
    def is_along_path(self) -> bool:
        """Whether frames of the camera path are being recorded."""
        return self._along_path and self.recording is not None and not self.recording.is_ending

    @property
    def path_time(self) -> float:
        """The clip's time of the next frame of the camera path, [0, 1]."""
        assert self.recording is not None
        path = self.state.follower.path
        return path.at(path.start_s + self.recording.duration_s)[1]

    @property
    def path_frames(self) -> int:
        """The number of frames along the whole camera path."""
        path = self.state.follower.path
        return int((path.end_s - path.start_s + 1e-6) * FILM_FPS) + 1

    @property
    def left_s(self) -> float | None:
        """Seconds that recording the rest of the camera path takes at the rate so far; None before there is one."""
        taken = 0 if self.recording is None else self.recording.taken
        if taken < MIN_TIMED_FRAMES:
            return None
        return (clock.monotonic() - self._started_at) * (self.path_frames - taken) / taken

    def stop(self) -> None:
        """End the video that is being written; its file keeps what was recorded, and the camera stays where it is."""
        if self.recording is not None:
            self.state.follower.is_active = self.state.follower.is_active and not self._along_path
            self.recording.end()

    def start_or_stop(self, along_path: bool) -> None:
        """Begin a video, or end the one that is being written.

        Args:
            along_path: record the camera path frame by frame, however long a frame takes; else the window as it is
                used.
        """
        if self.recording is not None:
            self.stop()
            return
        follower = self.state.follower
        with self.state.reporting_errors(self.files.folder.absolute()):
            self.recording = Recording(self.files.next_path(".mp4"), FILM_FPS, self.scene_view.canvas.size)
            self._along_path, self._started_at = along_path, clock.monotonic()
            if along_path:
                self._waits = FRAMES_BEFORE_PATH
                follower.start(from_beginning=True)
                self.state.playback.playing = False

    def update(self, now: float) -> None:
        """Record the frames that are due, and report the end of a video.

        Args:
            now: the time of `time.monotonic`.
        """
        recording, follower = self.recording, self.state.follower
        if recording is None:
            return
        if recording.is_over:
            if not recording.is_ending:  # it has failed: the camera stays where it is
                self.stop()
            self.recording = None
            if recording.failure is None:
                self.state.notify(_saved(recording))
            else:
                self.state.notify_error(recording.failure)
        elif recording.is_ending:
            return
        elif recording.size != self.scene_view.canvas.size:
            self.state.notify("the window was resized: the video ends here")
            self.stop()
        elif self._along_path and self._waits:
            self._waits -= 1
        elif self._along_path:
            self._record_path(recording)
            follower.is_active = follower.is_active and not recording.is_ending
        else:
            due = frames_due(now - self._started_at, recording.fps, recording.taken)
            frame = self.scene_view.pixels() if due and recording.has_room else None
            for _ in range(due):
                if frame is None or not recording.take(frame):
                    break

    def close(self) -> str | None:
        """Finish the video that is being written; return what to report of it, None if there is none."""
        if self.recording is None:
            return None
        interrupts.heard()  # after Ctrl-C, too, the file takes the time that it needs
        self.recording.close(FINISH_TIMEOUT_S)
        return self.recording.failure or _saved(self.recording)

    def _record_path(self, recording: Recording) -> None:
        """Record the next frame of the camera path once the part of the scene that it shows has arrived."""
        state, follower = self.state, self.state.follower
        position_s = follower.path.start_s + recording.duration_s
        if not follower.is_active or position_s > follower.path.end_s + 1e-6:
            recording.end()
        elif recording.has_room and state.stream.is_settled:
            follower.position_s = position_s
            camera, state.playback.time = follower.path.at(position_s)
            state.view = OrbitView.of(state.rig, camera)
            self.scene_view.draw_still()
            recording.take(self.scene_view.pixels())


def _saved(recording: Recording) -> str:
    return f"saved {recording.path}, {recording.duration_s:.1f} s"
