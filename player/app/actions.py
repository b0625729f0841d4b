"""What keys and panels can make a player do."""

from collections.abc import Sequence
from pathlib import Path

from kpc.format.common.images import write_image
from kpc.format.common.text import counted
from kpc.format.container.http_address import is_url
from kpc.format.container.sources import open_source
from kpc.player.app.camera_paths import CameraPath
from kpc.player.app.controls import OrbitView
from kpc.player.app.filming import Filming
from kpc.player.app.open_dialog import OpenDialog
from kpc.player.app.output_files import OutputFiles
from kpc.player.app.playlist import Playlist
from kpc.player.app.preferences import TEXT_SIZES
from kpc.player.app.quality_controller import LEVEL_NAMES
from kpc.player.app.scene_view import SceneView
from kpc.player.app.state import Notice, PlayerState, Shown
from kpc.player.app.widgets import close_lists
from kpc.player.cpu.reference import Part
from kpc.player.gl.presentation import DisplayMode
from kpc.player.quality import neighbouring_level
from kpc.player.streaming.group_playback import GroupPlayback

# Display modes and parts of the scene, as the panels name them; the keys 1, 2 ... and C follow this order.
DISPLAY_MODE_NAMES = {
    DisplayMode.COLOUR: "colour",
    DisplayMode.DEPTH: "depth",
    DisplayMode.SAMPLES: "samples",
    DisplayMode.OCCUPANCY: "occupancy",
}
PART_NAMES = {Part.FULL: "everything", Part.STATIC: "static", Part.DYNAMIC: "dynamic"}
# Factor between two sizes of the text.
TEXT_STEP = 1.1
# Difference between two volumes.
VOLUME_STEP = 0.1
UNANSWERED = "the camera path is not saved; say first what becomes of it"
NO_PATH = "there is no camera path yet; press K to add a keyframe"


class Actions:
    """The commands of a player.

    Attributes:
        playlist: the files to go through.
        successor: the scene that was opened last, which is to follow the one that is shown; successor_file: its file.
    """

    def __init__(
        self, state: PlayerState, scene_view: SceneView, filming: Filming, files: OutputFiles, playlist: Playlist
    ) -> None:
        self.state, self.scene_view, self.filming, self.files = state, scene_view, filming, files
        self.playlist, self._shown_at = playlist, playlist.position
        self.successor: GroupPlayback | None = None
        self.successor_file = ""
        self.dialog = OpenDialog()
        self._to_open: str | None = None
        self._path_to_load: tuple[CameraPath, str] | None = None  # and its file

    # --- the clip

    def play_or_pause(self) -> None:
        """Play or pause the clip; if the camera follows the path, stop that."""
        if self.state.follower.is_active:
            self.state.follower.is_active = False
        else:
            self.state.playback.toggle()

    def step(self, frames: int) -> None:
        """Pause and go `frames` frames forward."""
        self.state.playback.step(frames)
        self.state.follower.is_active = False

    def seek(self, time: float) -> None:
        """Go to a time in [0, 1] without pausing."""
        self.state.playback.seek(time)
        self.state.follower.is_active = False

    def change_speed(self, steps: int) -> None:
        """Choose the next faster speed, or with -1 the next slower one."""
        self.state.playback.change_speed(steps)

    def toggle_loop(self) -> None:
        """Switch looping on or off."""
        self.state.playback.loop = not self.state.playback.loop

    def change_volume(self, steps: int) -> None:
        """Make the sound louder, or with -1 quieter."""
        state = self.state
        state.volume, state.muted = min(max(state.volume + VOLUME_STEP * steps, 0.0), 1.0), False
        state.notify(f"volume {state.volume:.0%}")

    def toggle_mute(self) -> None:
        """Switch the sound off or on."""
        self.state.muted = not self.state.muted
        self.state.notify("sound off" if self.state.muted else f"volume {self.state.volume:.0%}")

    # --- the camera

    def to_camera(self, number: int) -> None:
        """Go to a camera of the scene, counted from 0."""
        self.state.look_from(OrbitView.of(self.state.rig, self.state.rig.cameras[number]))
        self.state.camera_number, self.state.shown = number, Shown.CAMERA

    def to_opening(self) -> None:
        """Go to the view that the clip opens with."""
        self.state.look_from_opening()

    def toggle_limits(self) -> None:
        """Leave the limits from where the scene holds, or keep them."""
        state = self.state
        if state.limits is None:
            state.notify("this file does not say from where it holds")
            return
        state.keeps_limits = not state.keeps_limits
        state.is_moved = True
        state.notify("the view keeps to where the scene holds" if state.keeps_limits else "the view is free")

    def next_camera(self) -> None:
        """Go to the next camera of the scene."""
        self.to_camera((self.state.camera_number + 1) % len(self.state.rig.cameras))

    def to_preset(self, number: int) -> None:
        """Go to a named viewpoint, counted from 0."""
        name, camera = list(self.state.presets.items())[number]
        self.state.look_from(OrbitView.of(self.state.rig, camera))
        self.state.preset_number, self.state.shown = number, Shown.PRESET
        self.state.notify(f"viewpoint: {name}")

    def next_preset(self) -> None:
        """Go to the next named viewpoint."""
        self.to_preset((self.state.preset_number + 1) % len(self.state.presets))

    # --- what is shown, and how

    def next_appearance(self) -> None:
        """Blend into the next appearance."""
        self.state.appearance.next()

    def show_mode(self, number: int) -> None:
        """Choose a display mode, in the order of DISPLAY_MODE_NAMES."""
        self.state.display_mode = list(DISPLAY_MODE_NAMES)[number]

    def next_part(self) -> None:
        """Show the next part of a dynamic scene."""
        if self.state.scene.is_dynamic:
            parts = list(PART_NAMES)
            self.state.part = parts[(parts.index(self.state.part) + 1) % len(parts)]

    def toggle_exact(self) -> None:
        """Sample the time planes of a dynamic scene, or fold them into the space planes."""
        if self.state.scene.is_dynamic:
            self.state.exact = not self.state.exact

    def change_quality(self, levels: int) -> None:
        """Choose the quality level that is `levels` higher, and keep it."""
        quality = self.state.quality
        quality.choose(neighbouring_level(quality.level, levels))
        position = LEVEL_NAMES.index(quality.level) + 1
        self.state.notify(f"quality: {quality.level}, level {position} of {len(LEVEL_NAMES)}")

    def toggle_target_rate(self) -> None:
        """Hold the target frame rate by changing the quality, or keep the quality of still pictures."""
        quality = self.state.quality
        quality.hold(self.state.target_fps if quality.target_s is None else None)

    def change_text_size(self, steps: int) -> None:
        """Enlarge the text of the panels, or with -1 reduce it."""
        size = self.state.text_size * TEXT_STEP**steps
        self.state.text_size = min(max(size, TEXT_SIZES[0]), TEXT_SIZES[1])

    def toggle_panel(self, name: str) -> None:
        """Show or hide a panel, a field of VisiblePanels; one that Tab has hidden with the controls is shown again."""
        visible = self.state.visible
        if name == "planes" and not self.state.scene.is_dynamic:
            self.state.notify("nothing moves in this scene, so it has no time planes")
        elif visible.controls or name in ("controls", "keys"):
            setattr(visible, name, not getattr(visible, name))
        else:
            visible.controls = True
            setattr(visible, name, True)

    # --- the camera path

    def add_keyframe(self) -> None:
        """Add the present camera and time to the camera path."""
        state, follower = self.state, self.state.follower
        camera = state.view.camera(*self.scene_view.canvas.size)
        follower.append(camera, state.playback.time, state.playback.playing)
        state.visible.path = True
        state.notify(f"keyframe {len(follower.path.keyframes)} at {follower.path.end_s:.1f} s")

    def remove_last_keyframe(self) -> None:
        """Remove the last keyframe, if there is one."""
        if not self.state.follower.is_empty:
            self.state.follower.remove(len(self.state.follower.path.keyframes) - 1)

    def follow_or_stop(self) -> None:
        """Let the camera follow the path from where it left it, or stop."""
        follower = self.state.follower
        if follower.is_empty:
            self.state.notify_error(NO_PATH)
        elif follower.is_active:
            follower.is_active = False
        else:
            follower.start()
            self.state.playback.playing = False

    def to_path_position(self, seconds: float) -> None:
        """Go to a position on the camera path, and pause there."""
        camera, time = self.state.follower.path.at(seconds)
        self.state.look_from(OrbitView.of(self.state.rig, camera))
        self.state.scrub(time)
        self.state.follower.position_s = seconds

    # --- files

    def start_or_stop_filming(self, along_path: bool) -> None:
        """Begin a video of the window or of the camera path, or end the one that is being written."""
        if self.filming.recording is None and along_path and self.state.follower.is_empty:
            self.state.notify_error(NO_PATH)
        else:
            self.filming.start_or_stop(along_path)

    def save_picture(self) -> None:
        """Save the picture without panels at the quality of a still."""
        self.scene_view.draw_still()
        with self.state.reporting_errors(self.files.folder.absolute()):
            path = self.files.next_path(".png")
            write_image(path, self.scene_view.pixels())
            self.state.notify(f"saved {path}")

    def save_path(self) -> None:
        """Save the camera path."""
        if self.state.follower.is_empty:
            self.state.notify_error(NO_PATH)
            return
        with self.state.reporting_errors(self.files.folder.absolute()):
            path = self.files.next_path("-path.json")
            self.state.follower.save(path)
            self.state.notify(f"saved {path}; kprender --path makes a video of it")

    def choose_file(self) -> None:
        """Show the system's dialog to choose a file."""
        with self.state.reporting_errors("the dialog"):
            self.dialog.show(str(Path.cwd()))

    def next_file(self, count: int) -> None:
        """Open the file that is `count` files further in the playlist."""
        if len(self.playlist.files) < 2:
            self.state.notify("there is one file only; Ctrl+O opens another")
        elif self.asks:
            self.state.notify(UNANSWERED)
        else:
            self.open(self.playlist.step(count))

    def open(self, file: str) -> None:
        """Load a camera path (.json) unless another is unsaved, or have `open_waiting` open another scene."""
        state = self.state
        if self.asks:
            state.notify(UNANSWERED)
            return
        if not file.lower().endswith(".json"):
            self._to_open = file
            state.notify(f"opening {Path(file).name if not is_url(file) else 'the address'}")
            return
        with state.reporting_errors(file):
            self._path_to_load = CameraPath.load(file), file
            self.load_waiting_path()

    def drop(self, files: Sequence[str]) -> None:
        """Open what was dropped on the window: camera paths, and the first of the scenes; others follow it."""
        scenes = [file for file in files if not file.lower().endswith(".json")]
        for file in files:
            if file not in scenes:
                self.open(file)
        if not scenes:
            return
        if self.asks or (len(scenes) == 1 and not Path(scenes[0]).is_dir()):
            self.open(scenes[0])
            return
        with self.state.reporting_errors(scenes[0]):
            first, *others = self.playlist.add(scenes)
            self.open(first)
            if others:
                self.state.notify(f"opening {Path(first).name}; {len(others)} more in the playlist")

    def load_waiting_path(self) -> None:
        """Take over the camera path that was opened last, once the one that is there is saved or given up."""
        if self._path_to_load is None or self.asks:
            return
        (path, file), self._path_to_load, state = self._path_to_load, None, self.state
        state.follower.replace(path)
        state.visible.path = True
        state.notify(f"loaded {counted(len(path.keyframes), 'keyframe')} from {file}; press J to follow them")

    @property
    def asks(self) -> bool:
        """Whether to ask what becomes of an unsaved camera path, since the player is to end or show something else."""
        is_leaving = self.state.should_close or self.successor is not None or self._path_to_load is not None
        return is_leaving and self.state.follower.is_unsaved

    @property
    def is_opening(self) -> bool:
        """Whether a scene waits for `open_waiting`."""
        return self._to_open is not None

    def open_waiting(self) -> None:
        """Open the scene that waits for it, which becomes the successor."""
        file, self._to_open, state = self._to_open, None, self.state
        if file is None:
            return
        with state.reporting_errors(file):
            if self.successor is not None:
                self.successor.close()
            stream = GroupPlayback(open_source(file, limit=state.stream.memory), memory=state.stream.memory)
            try:
                stream.draw_with(self.scene_view.make_renderer)
                self.successor, self.successor_file = stream, file
                if self.asks:
                    state.notice = Notice()  # it is not opened yet
            except BaseException:
                stream.close()
                raise

    def quit(self) -> None:
        """Close an open list, or else end the player; if it asks about an unsaved camera path, stay."""
        if close_lists():
            return
        if self.asks:
            self.stay()
        else:
            self.state.should_close = True

    def stay(self) -> None:
        """Go on with the scene that is shown, whatever was to follow."""
        self.state.should_close = False
        self.playlist.position, self._path_to_load = self._shown_at, None
        if self.successor is not None:
            self.successor.close()
            self.successor = None
