"""A scene in a window: the main loop, and what happens in a frame."""

import time as clock
from dataclasses import dataclass, replace
from pathlib import Path

from kpc.format.common.errors import ContextLostError, DisplayError
from kpc.format.common.images import write_image
from kpc.player.app.actions import Actions
from kpc.player.app.controls import OrbitView
from kpc.player.app.desktop import glfw
from kpc.player.app.filming import Filming
from kpc.player.app.imgui_renderer import ImGuiRenderer
from kpc.player.app.input import Input
from kpc.player.app.output_files import OutputFiles
from kpc.player.app.panels import Panels
from kpc.player.app.playlist import Playlist
from kpc.player.app.preferences import Preferences
from kpc.player.app.quality_controller import quality_controller_for
from kpc.player.app.scene_view import SceneView
from kpc.player.app.state import PlayerState
from kpc.player.app.widgets import message
from kpc.player.app.window import Window
from kpc.player.gl.programs import is_software
from kpc.player.quality import neighbouring_level
from kpc.player.sound.clip_samples import ClipSamples
from kpc.player.sound.playback import SoundPlayback
from kpc.player.streaming.group_playback import GroupPlayback
from kpc.player.streaming.prefetch import Playhead

# Times that drawing may fail, say for want of memory, each followed by a lower quality, before the player gives up.
MAX_RETRIES = 3
# Seconds to wait for events while nothing changes, and while the window is minimised.
IDLE_S, ICONIFIED_S = 0.05, 0.1
# Seconds to wait for events once nothing has happened for AWAKE_S.
SLEEP_S, AWAKE_S = 1.0, 0.6
# Seconds that the clip advances at most in a frame, so that one that compiles for a minute does not skip to its end.
MAX_ADVANCE_S = 1.0

# What a window shows until its first picture, and the colour around it.
OPENING = "Preparing {}"
BACKGROUND = 0.06, 0.07, 0.09


@dataclass(frozen=True)
class Snapshot:
    """What a player shows at the moment, for tests.

    Attributes:
        time: of the clip, [0, 1].
        playing, speed, loop: of the clip.
        view: the camera.
        camera_number, preset_number: that were chosen last; shown: which of them the view still is, in lower case.
        appearance: its name.
        part, display_mode: names, in lower case.
        folds: whether the picture was drawn with folded time planes.
        level: name of the quality level; target_s: seconds that a frame may take, if the level follows from that.
        keyframes: of the camera path; follows_path: whether the camera follows it.
        films: whether a video is being written.
        asks: whether the window asks what becomes of an unsaved camera path.
        panels: names of the panels that are switched on.
        notice, notice_is_error: the last message.
        canvas, raster: (width, height) of the canvas, and of the picture before it was scaled to it.
        is_sharp: whether the picture has the quality of a still.
    """

    time: float
    playing: bool
    speed: float
    loop: bool
    view: OrbitView
    camera_number: int
    preset_number: int
    shown: str | None
    appearance: str
    part: str
    display_mode: str
    folds: bool
    level: str
    target_s: float | None
    keyframes: int
    follows_path: bool
    films: bool
    asks: bool
    panels: frozenset[str]
    notice: str
    notice_is_error: bool
    canvas: tuple[int, int]
    raster: tuple[int, int]
    is_sharp: bool


class Player:
    """A scene in a window, from the first frame to the last, also while it arrives.

    Args:
        window: where to show it.
        stream: the clip.
        preferences: the settings to begin with.
        resume_from: a player of the same scene whose context was lost; this one continues where that one stopped.
        folder: for screenshots, videos and camera paths.
        playlist: the files to go through; None for this one alone.

    Attributes:
        state: what is shown, and how.
        scene_view: the picture of the scene.
        actions: what keys and panels do.
        filming: the video that is written.
        sound: what is heard of the clip.
    """

    def __init__(
        self,
        window: Window,
        stream: GroupPlayback,
        preferences: Preferences = Preferences(),  # noqa: B008  # it is immutable
        *,
        resume_from: "Player | None" = None,
        folder: Path = Path(),
        playlist: Playlist | None = None,
    ) -> None:
        self.window = window
        stream.arrived = window.wake
        self.imgui = ImGuiRenderer(window.ctx)
        window.io = self.imgui.io
        self._announce(stream.source.name)
        quality = quality_controller_for(is_software(window.ctx), preferences.quality, preferences.target_fps)
        self.state = PlayerState(stream, preferences, quality)
        if resume_from is not None:
            self.state.resume(resume_from.state)
        self.scene_view = SceneView(window.ctx, self.state, window.pixels)
        self.files = OutputFiles(folder, stream.source.name)
        self.filming = Filming(self.state, self.scene_view, self.files)
        self.sound = SoundPlayback(ClipSamples(stream.groups), stream.clip.duration_s)
        self.actions = Actions(
            self.state, self.scene_view, self.filming, self.files, playlist or Playlist([stream.source.name])
        )
        self.input = Input(window, self.state, self.actions)
        self.panels = Panels(self.imgui, self.state, self.scene_view, self.actions)
        self._is_still = False  # whether the last frame showed the same scene as that before it
        self._retries, self._last_frame_at, self._stirred_at = 0, clock.monotonic(), clock.monotonic()
        if resume_from is None:
            self.state.notify("Press H for the list of keys")
        else:
            self.state.notify_error("the graphics card was reset; the scene has been loaded again")

    @property
    def successor(self) -> GroupPlayback | None:
        """The scene that is to follow this one."""
        return self.actions.successor

    def preferences(self) -> Preferences:
        """Return the settings to remember."""
        return replace(self.state.preferences(self.window.unscaled_size), recent=self.actions.playlist.recent)

    def run(self, frames: int | None = None) -> None:
        """Show frames until the window is closed or another scene is opened.

        Args:
            frames: end after so many, counted once all of the scene has arrived that is to arrive.
        """
        shown, stream = 0, self.state.stream
        while not self._is_over and (frames is None or shown < frames):
            may_wait = frames is None or not stream.is_settled
            if may_wait and self._is_still:
                self._wait()
            else:
                glfw.poll_events()
                self.frame()
            shown += stream.is_settled

    def _wait(self) -> None:
        """Wait for events; show a frame if there are any, or were a moment ago, a message disappears, or code loads.

        ImGui reacts to an event over several frames, say with a tooltip.
        """
        state, now = self.state, clock.monotonic()
        until_gone = state.notice.until - now
        if now - self._stirred_at < AWAKE_S or not state.stream.is_settled or self.actions.dialog.is_open:
            glfw.wait_events_timeout(IDLE_S)
            self.frame()
            return
        glfw.wait_events_timeout(min(until_gone, SLEEP_S) if until_gone > 0 else SLEEP_S)
        if self.window.is_stirred or 0 < until_gone < SLEEP_S or self.scene_view.renderer.is_loading:
            self.frame()

    def frame(self, seconds: float | None = None) -> None:
        """Handle events, advance the clip, draw the scene and the panels over it, and show them.

        Args:
            seconds: to advance by; None: the time since the last frame.
        """
        now = clock.monotonic()
        if seconds is None:
            seconds = now - self._last_frame_at
        self._last_frame_at = now
        if self.window.is_stirred:
            self.window.is_stirred, self._stirred_at = False, now
        pixels = self.window.pixels
        if min(pixels) < 1 or self.window.is_iconified:
            glfw.wait_events_timeout(ICONIFIED_S)
            return
        self.window.check()
        measuring_s, is_timed = self.scene_view.measuring_s, False
        if pixels != self.scene_view.canvas.size:
            self.scene_view.resize(pixels)
        self._begin_panels(seconds)
        self.input.update(seconds)
        try:
            self.state.keep_limits(seconds)
            self._advance(seconds)
            self.state.appearance.advance(seconds)
            if self.filming.is_along_path:
                self.scene_view.is_sharp = False  # `filming` draws each frame
            else:
                is_timed = self.scene_view.update(now)
            self.scene_view.renderer.check()
        except ContextLostError:
            raise
        except DisplayError as error:
            self._retry_after(error)
        self.filming.update(now)
        self._is_still = self.scene_view.is_sharp and not is_timed and self.filming.recording is None
        self.state.statistics.record_frame(seconds, moves=is_timed or self.filming.is_along_path)
        self._close_or_ask()
        self.panels.build(asks=self.actions.asks)
        self._present()
        if is_timed:  # the frame without waiting for the screen, and without measuring statistics
            self.state.quality.record(clock.monotonic() - now - (self.scene_view.measuring_s - measuring_s))
        glfw.swap_buffers(self.window.handle)
        self.window.release_unused()
        if self.actions.is_opening:
            self.present_panels()  # it may take a while, and ImGui shows a new message in its second frame
            glfw.swap_buffers(self.window.handle)
            self.actions.open_waiting()

    def screenshot(self, path: Path) -> None:
        """Save the window with its panels at full resolution as a PNG file."""
        self._begin_panels(1 / 60)
        self.scene_view.draw_still()
        self.panels.build(asks=self.actions.asks)
        self.imgui.draw(self.scene_view.canvas)
        write_image(path, self.scene_view.pixels())
        self.scene_view.invalidate()

    def close(self) -> str | None:
        """End the sound, finish the video that is being written and release the panels; return what to report of the
        video.
        """
        self.sound.close()
        report = self.filming.close()
        self.window.io = None
        self.imgui.close()
        return report

    # --- for tests

    def press(self, key: int | str, modifiers: int = 0, seconds: float | None = None) -> None:
        """Press a key or type a character, and show a frame; see `Window.press_key` and `frame`."""
        if isinstance(key, str):
            self.window.type_character(key, modifiers)
        else:
            self.window.press_key(key, modifiers)
        self.frame(seconds)

    def present_panels(self) -> None:
        """Build the panels and show them over the canvas, without drawing the scene or swapping buffers."""
        self._begin_panels(0.0)
        self.panels.build(asks=self.actions.asks)
        self._present()

    def forget_failures(self) -> None:
        """Allow MAX_RETRIES failures again."""
        self._retries = 0

    def snapshot(self) -> Snapshot:
        """Return what the player shows."""
        state, playback, follower = self.state, self.state.playback, self.state.follower
        return Snapshot(
            time=playback.time,
            playing=playback.playing,
            speed=playback.speed,
            loop=playback.loop,
            view=state.view,
            camera_number=state.camera_number,
            preset_number=state.preset_number,
            shown=None if state.shown is None else state.shown.name.lower(),
            appearance=state.appearance.name,
            part=state.part.name.lower(),
            display_mode=state.display_mode.name.lower(),
            folds=self.scene_view.renderer.quality.folded,
            level=state.quality.level,
            target_s=state.quality.target_s,
            keyframes=len(follower.path.keyframes),
            follows_path=follower.is_active,
            films=self.filming.recording is not None,
            asks=self.actions.asks,
            panels=frozenset(name for name, is_shown in vars(state.visible).items() if is_shown),
            notice=state.notice.text,
            notice_is_error=state.notice.is_error,
            canvas=self.scene_view.canvas.size,
            raster=self.scene_view.raster,
            is_sharp=self.scene_view.is_sharp,
        )

    # --- parts of a frame

    @property
    def _is_over(self) -> bool:
        return (self.state.should_close or self.successor is not None) and not self.actions.asks

    def _close_or_ask(self) -> None:
        """Take over that the user has closed the window; doing so again while it asks closes it."""
        if self.window.should_close:
            self.window.keep_open()
            if self.actions.asks:
                self.state.follower.give_up()
            self.state.should_close = True

    def _advance(self, seconds: float) -> None:
        """Advance the clip, or the camera along its path, unless what would be shown has not arrived yet."""
        state, follower = self.state, self.state.follower
        seconds = min(seconds, MAX_ADVANCE_S)
        clip_s, plays = state.stream.clip.duration_s, self._plays_sound
        clip_seconds = self.sound.advance(seconds, state.playback.time * clip_s) if plays else seconds
        playback, position_s, view = state.playback.after(clip_seconds), follower.position_s, state.view
        follows = follower.is_active
        if self.filming.is_along_path:
            playback = replace(playback, time=self.filming.path_time)
        elif follower.is_active:
            position_s, follows = follower.after(seconds, state.playback.loop)
            camera, time = follower.path.at(position_s)
            playback, view = replace(playback, time=time), OrbitView.of(state.rig, camera)
        state.stream.set_playhead(Playhead(playback.time, state.playback.rate, state.playback.loop))
        state.stream.upload()
        state.follow_scene()
        is_shown = state.stream.can_show(playback.time, state.playback.rate)
        if is_shown:
            state.shown = state.shown if view is state.view else None
            state.playback, state.view = playback, view
            follower.position_s, follower.is_active = position_s, follows
        plays = plays and is_shown and state.playback.playing
        self.sound.follow(state.playback.time * clip_s, plays=plays, loops=state.playback.loop)
        self.sound.set_volume(0.0 if state.muted else state.volume)
        if self.sound.notice is not None:
            state.notify(self.sound.notice)
            self.sound.notice = None

    @property
    def _plays_sound(self) -> bool:
        """Whether the clip runs as its sound does: at its own speed, on no camera path."""
        state = self.state
        is_natural = state.playback.playing and state.playback.speed == 1.0
        is_on_path = state.follower.is_active or self.filming.is_along_path
        return state.stream.has_sound and is_natural and not is_on_path

    def _announce(self, name: str) -> None:
        """Show at once that the scene is being prepared: compiling what draws it may take a minute the first time."""
        ctx, pixels, text = self.window.ctx, self.window.pixels, OPENING.format(Path(name).name)
        if min(pixels) < 1:
            return
        ctx.screen.use()
        ctx.clear(*BACKGROUND, viewport=(0, 0, *pixels))
        for is_last in (False, True):  # ImGui shows a window that fits its content from the second frame on
            self.imgui.begin(self.window.size, pixels, self.window.text_scale, 0.0)
            width, height = self.window.size
            message("opening", text, (0.0, width), height / 2, 0.5)
            if is_last:
                self.imgui.draw(ctx.screen)
            else:
                self.imgui.end()
        glfw.swap_buffers(self.window.handle)
        glfw.poll_events()

    def _retry_after(self, error: DisplayError) -> None:
        """Report that drawing failed and lower the quality; give up after MAX_RETRIES."""
        self._retries += 1
        if self._retries > MAX_RETRIES:
            raise error
        self.state.notify_error(str(error))
        self.state.quality.choose(neighbouring_level(self.state.quality.level, -1))

    def _begin_panels(self, seconds: float) -> None:
        text_scale = self.state.text_size * self.window.text_scale
        self.imgui.begin(self.window.size, self.scene_view.canvas.size, text_scale, seconds)

    def _present(self) -> None:
        """Copy the canvas to the screen and draw the panels over it."""
        ctx = self.window.ctx
        ctx.copy_framebuffer(ctx.screen, self.scene_view.canvas)
        self.imgui.draw(ctx.screen)
