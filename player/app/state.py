"""What a player shows and how: the state that input, panels and drawing share. No window, no OpenGL calls."""

import contextlib
import time as clock
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum, auto

import numpy as np

from kpc.format.common.cli import print_error
from kpc.format.common.errors import KpcError
from kpc.format.common.text import escaped
from kpc.format.scene.rig import Rig
from kpc.format.scene.scene import Scene
from kpc.player.app.controls import AppearanceSelection, OrbitView, Playback
from kpc.player.app.path_follower import PathFollower
from kpc.player.app.preferences import Preferences
from kpc.player.app.quality_controller import QualityController
from kpc.player.app.recording import FILM_FPS
from kpc.player.app.view_keeper import kept
from kpc.player.cpu.reference import Part
from kpc.player.gl.presentation import DisplayMode
from kpc.player.streaming.group_playback import GroupPlayback
from kpc.player.viewpoints import presets

# Seconds for which a message and an error message stay on the screen.
NOTICE_S, ERROR_NOTICE_S = 4.0, 12.0
# Frames whose times the graphs show.
HISTORY_FRAMES = 240


@dataclass
class Notice:
    """A message on the screen.

    Attributes:
        text: the message.
        until: the time of `time.monotonic` at which it disappears.
        is_error: whether it reports an error.
    """

    text: str = ""
    until: float = 0.0
    is_error: bool = False


class Shown(Enum):
    """What a view is called by."""

    CAMERA = auto()
    PRESET = auto()


@dataclass
class VisiblePanels:
    """Which panels are shown. `controls` hides all others but `keys`."""

    controls: bool = True
    graphs: bool = False
    planes: bool = False
    path: bool = False
    keys: bool = False


class FrameStatistics:
    """Times of the last frames, and statistics of the picture.

    Attributes:
        history: (2, HISTORY_FRAMES) float32, milliseconds between frames and milliseconds that pictures took; frame n
            is in column n % HISTORY_FRAMES.
        frames: frames so far.
        frame_s: seconds between two frames while something moves, smoothed.
        moves: whether the last frame showed something else than that before it.
        draw_s: seconds that the last picture took.
        samples: samples per ray, on average.
        max_samples: samples per ray at the upper end of the colour scale.
        depth_range: nearest and farthest depth of the colour scale, world units.
    """

    def __init__(self) -> None:
        self.history = np.zeros((2, HISTORY_FRAMES), np.float32)
        self.frames = 0
        self.frame_s = self.draw_s = 0.0
        self.moves = False
        self.samples, self.max_samples, self.depth_range = 0.0, 16.0, (0.0, 1.0)

    def record_frame(self, seconds: float, moves: bool) -> None:
        """Append a frame to the history.

        Args:
            seconds: since the frame before.
            moves: whether it shows something else than that.
        """
        if moves and self.moves:
            self.frame_s += 0.1 * (seconds - self.frame_s) if self.frame_s else seconds
        self.moves = moves
        self.history[:, self.frames % HISTORY_FRAMES] = 1e3 * seconds, 1e3 * self.draw_s
        self.frames += 1


class PlayerState:
    """State of a player.

    Args:
        stream: the clip that plays.
        preferences: the settings to begin with.
        quality: chooses quality level and resolution.

    Attributes:
        metadata: of the clip.
        opening: the camera to begin with.
        rig: the cameras of the scene; presets: named viewpoints.
        camera_number: the camera that was chosen last, from 0; preset_number: likewise, or -1.
        shown: whether the view is still that of this camera or of this preset; None if it is neither.
        view: the camera that the picture is drawn from.
        limits: from where the scene holds; None if its file does not say.
        keeps_limits: whether the user's movements are kept within them.
        is_moved: whether the user has moved the view since it was chosen by name or number.
        playback: the position in the clip.
        appearance: the appearance embedding that is shown.
        part: the part of the scene that is shown.
        display_mode: what of each ray is shown.
        exact: whether time planes are sampled beside the space planes even where the quality level folds them.
        target_fps: the frame rate to hold when the quality controller is switched on.
        follower: the camera path.
        visible: the panels that are shown.
        text_size: of the panels; 1 is the system's text size.
        volume: of sound, 0 to 1; muted: whether it is off.
        should_close: whether the player is to end.
    """

    def __init__(self, stream: GroupPlayback, preferences: Preferences, quality: QualityController) -> None:
        self.stream, self.quality = stream, quality
        self.target_fps = preferences.target_fps or (1 / quality.target_s if quality.target_s else FILM_FPS)
        self.rig, self.presets = Rig.of(self.scene), presets(self.scene)
        self.camera_number, self.preset_number = 0, -1
        self.view: OrbitView  # `look_from_opening` sets it
        self.shown: Shown | None = None
        self.metadata, self.follower = stream.metadata, PathFollower()
        self.limits, self.keeps_limits, self.is_moved = self.metadata.view_limits, True, False
        opening = self.metadata.opening
        self.opening = self.rig.cameras[0] if opening is None else opening.camera
        self.look_from_opening()
        has_duration = stream.clip.duration_s > 0
        self.playback = Playback(stream.clip, playing=has_duration)
        self.playback.seek(0.0 if opening is None else opening.time)
        self.appearance = AppearanceSelection(self.scene)
        self.part, self.display_mode, self.exact = Part.FULL, DisplayMode.COLOUR, False
        self.visible = VisiblePanels(preferences.controls, preferences.graphs, preferences.planes)
        self.text_size = preferences.text_size
        self.volume, self.muted = preferences.volume, preferences.muted
        self.statistics, self.notice = FrameStatistics(), Notice()
        self.should_close = False

    @property
    def scene(self) -> Scene:
        """The scene that is shown; for a clip in groups, the group."""
        return self.stream.scene

    def resume(self, before: "PlayerState") -> None:
        """Continue where another player of the same scene stopped."""
        self.view, self.playback = before.view, before.playback
        self.part, self.display_mode = before.part, before.display_mode
        self.quality, self.target_fps, self.exact = before.quality, before.target_fps, before.exact
        self.keeps_limits = before.keeps_limits
        self.follower = before.follower
        self.follower.is_active = False
        self.appearance.select(before.appearance.number)
        self.volume, self.muted = before.volume, before.muted
        self.visible.controls, self.visible.path = before.visible.controls, before.visible.path

    def preferences(self, window_size: tuple[int, int]) -> Preferences:
        """Return the settings to remember."""
        holds_rate = self.quality.target_s is not None
        return Preferences(
            size=window_size,
            quality=self.quality.chosen_level,
            target_fps=self.target_fps if holds_rate else None,
            controls=self.visible.controls,
            graphs=self.visible.graphs,
            planes=self.visible.planes,
            text_size=self.text_size,
            volume=self.volume,
            muted=self.muted,
        )

    def play_like(self, before: Playback) -> None:
        """Keep the speed of another clip, and whether it loops."""
        self.playback.speed, self.playback.loop = before.speed, before.loop

    def look_from(self, view: OrbitView) -> None:
        """Move the camera at once, and stop following the camera path."""
        self.view, self.follower.is_active, self.is_moved, self.shown = view, False, False, None

    def look_from_opening(self) -> None:
        """Move the camera to the view that the clip opens with; nothing else counts as chosen any more."""
        self.look_from(OrbitView.of(self.rig, self.opening))
        self.camera_number, self.preset_number = 0, -1
        self.shown = Shown.CAMERA if self.opening is self.rig.cameras[0] else None

    def move_to(self, view: OrbitView) -> None:
        """Move the camera as the user does, by hand; `keep_limits` may move it back."""
        self.look_from(view)
        self.is_moved = True

    def keep_limits(self, seconds: float) -> None:
        """Move a view that the user has moved out of the limits towards them."""
        if self.limits is not None and self.keeps_limits and self.is_moved and not self.follower.is_active:
            self.view = kept(self.view, self.limits, seconds)

    def scrub(self, time: float) -> None:
        """Pause the clip at a time in [0, 1], and stop following the camera path."""
        self.playback.playing = self.follower.is_active = False
        self.playback.seek(time)

    def follow_scene(self) -> None:
        """Keep the appearance that is selected when another group of the clip is shown."""
        if self.appearance.scene is not self.scene:
            self.appearance = AppearanceSelection(self.scene, self.appearance.name)

    def notify(self, text: str) -> None:
        """Show a message."""
        self.notice = Notice(escaped(text), clock.monotonic() + NOTICE_S)

    def notify_error(self, text: str) -> None:
        """Show an error message, for longer."""
        self.notice = Notice(escaped(text), clock.monotonic() + ERROR_NOTICE_S, is_error=True)

    @contextlib.contextmanager
    def reporting_errors(self, subject: object) -> Iterator[None]:
        """Show errors of the block as a message, and on the terminal.

        Args:
            subject: what precedes errors of the operating system, say a file name.
        """
        try:
            yield
        except (KpcError, OSError) as error:
            text = f"{subject}: {error.strerror or error}" if isinstance(error, OSError) else str(error)
            self.notify_error(text)
            print_error("kpplay", text)
