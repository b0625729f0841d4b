"""The panels over the scene: ImGui widgets that show a player's state and change it."""

import time as clock

import numpy as np

from kpc.format.scene.scene import HybridDecoder
from kpc.player.app.actions import DISPLAY_MODE_NAMES, PART_NAMES, Actions
from kpc.player.app.controls import SPEEDS
from kpc.player.app.desktop import imgui
from kpc.player.app.files_menu import files_button
from kpc.player.app.imgui_renderer import ImGuiRenderer
from kpc.player.app.input import KEY_BINDINGS
from kpc.player.app.leave_question import ask
from kpc.player.app.path_panel import PathPanel
from kpc.player.app.preferences import TARGET_FPS
from kpc.player.app.quality_controller import LEVEL_NAMES
from kpc.player.app.scene_view import SceneView
from kpc.player.app.state import PlayerState, Shown
from kpc.player.app.time_plane_panel import TimePlanePanel
from kpc.player.app.widgets import (
    ACCENT,
    CONTROL_EM,
    ERROR,
    MARGIN_EM,
    PANEL_EM,
    SPACING_EM,
    choice,
    em,
    label,
    message,
    panel,
    place_bar,
    place_next,
    tip,
    toggle,
    window_size,
)
from kpc.player.quality import LEVELS

# Messages of the stream stand right of the status panel if so much room is free there, else over it, em.
MIN_MESSAGE_EM = 12.0
# Width of what sets the volume, em.
SOUND_EM = 8.5
# Frame rates that the slider offers.
SLIDER_FPS = (5.0, 120.0)
# Characters of the device's name that are shown.
DEVICE_CHARACTERS = 32
# Characters of the name of the film that is written.
NAME_CHARACTERS = 20


class Panels:
    """All panels of a player."""

    def __init__(
        self, imgui_renderer: ImGuiRenderer, state: PlayerState, scene_view: SceneView, actions: Actions
    ) -> None:
        self.state, self.scene_view, self.actions = state, scene_view, actions
        self._time_planes, self._path = TimePlanePanel(imgui_renderer, state), PathPanel(state, actions)

    def build(self, asks: bool = False) -> None:
        """Build everything that this frame shows over the scene.

        Args:
            asks: whether to ask what becomes of an unsaved camera path.
        """
        state, visible = self.state, self.state.visible
        width, height = window_size()
        margin, spacing = em(MARGIN_EM), em(SPACING_EM)
        bottom = height - margin
        across = free = 0.0, width
        below = margin
        if visible.controls:
            bottom = self._transport(bottom)
            if visible.planes and state.scene.is_dynamic:
                bottom = self._time_planes.build(bottom - spacing)
            bottom = self._filming(bottom)
            right = self._status(bottom - margin - spacing)
            free = (right, width) if width - right > em(MIN_MESSAGE_EM) else across
            below = self._graphs(margin) if visible.graphs else margin
            if visible.path:
                below = self._path.build(below, bottom - spacing)
        else:
            bottom = self._filming(bottom)
        if visible.keys:
            self._keys()
        if asks:
            ask(self.actions)
        if clock.monotonic() < state.notice.until:
            message("notice", state.notice.text, free, bottom - margin, 1.0, ERROR if state.notice.is_error else None)
        # It lies above everything, so it waits until a menu is closed.
        if (text := state.stream.message) is not None and not imgui.is_popup_open("", imgui.PopupFlags.ANY_POPUP):
            message("stream", text, free, below, 0.0)

    def _status(self, bottom: float) -> float:
        """Statistics and settings on the left, above `bottom`; return the right edge."""
        state, stream = self.state, self.state.stream
        place_next(em(MARGIN_EM), em(MARGIN_EM), max_height=bottom - em(MARGIN_EM))
        with panel("status", scrolls=True):
            self._statistics()
            imgui.separator()
            self._quality()
            imgui.separator()
            state.display_mode = choice("show", state.display_mode, DISPLAY_MODE_NAMES)
            if state.scene.is_dynamic:
                state.part = choice("part", state.part, PART_NAMES)
            if state.scene.appearances:
                state.appearance.select(
                    choice("appearance", state.appearance.number, dict(enumerate(state.appearance.names)))
                )
            self._viewpoints()
            imgui.separator()
            files_button(self.actions)
            imgui.same_line()
            visible = state.visible
            visible.graphs = toggle("graphs", visible.graphs)
            if stream.scene.is_dynamic:
                imgui.same_line()
                visible.planes = toggle("planes", visible.planes)
            imgui.same_line()
            visible.path = toggle("path", visible.path)
            imgui.same_line()
            visible.keys = toggle("keys", visible.keys)
            return imgui.get_window_pos()[0] + imgui.get_window_width()

    def _statistics(self) -> None:
        """Frame rate, resolution, samples, memory, device, what has arrived."""
        statistics, view, stream = self.state.statistics, self.scene_view, self.state.stream
        if statistics.moves and statistics.frame_s:
            rate = 1 / statistics.frame_s
            imgui.text(f"{rate:.{1 if rate < 10 else 0}f} frames/s, each {1e3 * statistics.draw_s:.0f} ms")
        else:
            imgui.text("still picture" if self.scene_view.is_sharp else "refining the picture")
        tip("Frames that come each second, and the time that drawing one takes")
        imgui.text_disabled("{}x{} of {}x{} pixels".format(*view.raster, *view.canvas.size))
        imgui.text_disabled(f"{statistics.samples:.1f} samples per ray, {view.renderer.memory_bytes / 1e6:.0f} MB")
        imgui.text_disabled(view.device.split("(")[0].strip()[:DEVICE_CHARACTERS])
        imgui.text_disabled(f"drawn by {view.renderer.drawn_by}")
        # One line of these, since the panel is as high as a window of 480 rows permits.
        if not stream.is_settled:
            share = stream.loaded_fraction
            arrived = f"{share:.0%} loaded, {stream.bytes_per_s / 1e3:,.0f} KB/s"
            imgui.text_disabled("loading the next group" if share >= 1 else arrived)
        elif view.renderer.is_loading:
            imgui.text_disabled("compiling faster code")
        elif isinstance(self.state.scene.decoder, HybridDecoder):
            imgui.text_disabled("hybrid decoder (slower)")

    def _quality(self) -> None:
        """The quality level, and the frame rate to hold."""
        state, quality = self.state, self.state.quality
        label("quality")
        level = self.scene_view.level
        number = LEVEL_NAMES.index(level)
        changed, wanted = imgui.slider_int(
            "##quality", number, 0, len(LEVEL_NAMES) - 1, level, imgui.SliderFlags.NO_INPUT
        )
        if changed and wanted != number:
            quality.choose(LEVEL_NAMES[wanted])
        tip("From fastest to exact (key - and = or +)")
        label("adapt to")
        holds = quality.target_s is not None
        changed, holds = imgui.checkbox("##adapt", holds)
        tip("Lower and raise the quality so that so many frames come each second (U)")
        imgui.same_line()
        imgui.set_next_item_width((CONTROL_EM - 2) * imgui.get_font_size())
        flags = imgui.SliderFlags.NO_INPUT | imgui.SliderFlags.LOGARITHMIC
        moved, fps = imgui.slider_float("##fps", state.target_fps, *SLIDER_FPS, "%.0f fps", flags)
        if moved:
            state.target_fps = min(max(fps, TARGET_FPS[0]), TARGET_FPS[1])
        if changed or (moved and holds):
            quality.hold(state.target_fps if holds else None)
        if state.scene.is_dynamic and LEVELS[quality.level].folded:
            label("motion")
            _, state.exact = imgui.checkbox("exact", state.exact)
            tip("Draw what moves as exactly as what does not, which takes longer (F)")

    def _viewpoints(self) -> None:
        """The cameras of the scene, and the named viewpoints."""
        state = self.state
        cameras = ["-", *state.metadata.names_of(len(state.rig.cameras))]
        present = state.camera_number + 1 if state.shown is Shown.CAMERA else 0
        chosen = choice("camera", present, dict(enumerate(cameras)))
        if chosen not in (0, present):
            self.actions.to_camera(chosen - 1)
        present = state.preset_number + 1 if state.shown is Shown.PRESET else 0
        chosen = choice("viewpoint", present, dict(enumerate(["-", *state.presets])))
        if chosen not in (0, present):
            self.actions.to_preset(chosen - 1)

    def _transport(self, bottom: float) -> float:
        """Play, position, speed and loop along the lower edge, above `bottom`; return the upper edge."""
        playback, clip = self.state.playback, self.state.stream.clip
        if clip.duration_s == 0:
            return bottom
        place_bar(bottom)
        with panel("transport", fits_content=False):
            if imgui.button("pause" if playback.playing else "play", (em(4), 0)):
                self.state.follower.is_active = False
                playback.toggle()
            imgui.same_line()
            others = em(13.5 + (SOUND_EM if self.state.stream.has_sound else 0.0))
            imgui.set_next_item_width(max(imgui.get_content_region_avail()[0] - others, em(4)))
            text = f"{playback.time * clip.duration_s:.2f} / {clip.total_s:.2f} s"
            changed, time = imgui.slider_float("##time", playback.time, 0.0, 1.0, text, imgui.SliderFlags.NO_INPUT)
            if changed:
                self.state.scrub(time)
            imgui.same_line()
            imgui.set_next_item_width(em(5.5))
            changed, chosen = imgui.combo("##speed", playback.speed_number, [f"{speed:g}x" for speed in SPEEDS])
            if changed:
                playback.speed = SPEEDS[chosen]
            imgui.same_line()
            _, playback.loop = imgui.checkbox("loop", playback.loop)
            if self.state.stream.has_sound:
                self._volume()
            return bottom - imgui.get_window_height()

    def _volume(self) -> None:
        """The volume, and whether sound is on, beside the other controls of the clip."""
        state = self.state
        imgui.same_line()
        changed, is_on = imgui.checkbox("sound", not state.muted)
        if changed:
            state.muted = not is_on
        tip("Sound off or on (M)")
        imgui.same_line()
        imgui.set_next_item_width(em(SOUND_EM - 3))
        text = "sound off" if state.muted else f"{state.volume:.0%}".replace("%", "%%")
        changed, volume = imgui.slider_float("##volume", state.volume, 0.0, 1.0, text, imgui.SliderFlags.NO_INPUT)
        if changed:
            state.volume, state.muted = volume, False
        tip("Louder or quieter (Up, Down)")

    def _graphs(self, top: float) -> float:
        """Times between frames and of their pictures, on the right, below `top`; return the lower edge."""
        statistics = self.state.statistics
        size = statistics.history.shape[1]
        count = min(statistics.frames, size)
        place_next(window_size()[0] - em(MARGIN_EM), top, 1.0, 0.0)
        imgui.set_next_window_size((em(PANEL_EM), 0))
        with panel("graphs", fits_content=False):
            rows = (("frame", None), ("picture", self.state.quality.target_s))
            for (name, target_s), values in zip(rows, statistics.history, strict=True):
                shown = values[:count] if count else np.zeros(1, np.float32)
                median, slow = np.percentile(shown, (50, 95))
                imgui.text_disabled(f"{name} {median:.1f} ms (95 %: {slow:.1f})")
                highest = 1.25 * float(max(slow, 1.0, 1e3 * (target_s or 0.0)))
                corner, extent = (
                    imgui.get_cursor_screen_pos(),
                    (imgui.get_content_region_avail()[0], em(3.2)),
                )
                oldest = statistics.frames % size if count == size else 0
                imgui.plot_lines(f"##{name}", np.roll(shown, -oldest), None, 0.0, highest, extent)
                if target_s is not None:
                    y = corner[1] + extent[1] * (1 - 1e3 * target_s / highest)
                    ends = (corner[0], y), (corner[0] + extent[0], y)
                    imgui.get_window_draw_list().add_line(*ends, imgui.get_color_u32(ACCENT))
            return top + imgui.get_window_height() + em(SPACING_EM)

    def _filming(self, bottom: float) -> float:
        """How far the video is that is being written, and a button to end it, above `bottom`; return the upper edge."""
        filming = self.actions.filming
        recording = filming.recording
        if recording is None:
            return bottom
        name = shortened(recording.path.name)
        place_next(window_size()[0] / 2, bottom - em(SPACING_EM), 0.5, 1.0)
        with panel("film"):
            top = bottom - em(SPACING_EM) - imgui.get_window_height()
            if recording.is_ending:
                imgui.text_colored(ACCENT, f"finishing {name}")
                return top
            if filming.is_along_path:
                total = filming.path_frames
                text = f"frame {recording.taken} of {total}{_time_left(filming.left_s)}"
                text = f"{text:{23 + 2 * len(str(total))}}"  # of one width, so that the button stays where it is
            else:
                text = f"{recording.duration_s:.1f} s"
            imgui.align_text_to_frame_padding()
            imgui.text_colored(ACCENT, f"recording {name}: {text}")
            imgui.same_line()
            if imgui.button("stop"):
                filming.stop()
            tip("End the video here; what was recorded is kept (O)")
            if filming.is_along_path:
                imgui.progress_bar(recording.taken / filming.path_frames, (-1, em(0.4)), "")
            return top

    def _keys(self) -> None:
        """The list of keys, in the middle."""
        width, height = window_size()
        place_next(width / 2, height / 2, 0.5, 0.5, max_height=0.94 * height)
        imgui.set_next_window_bg_alpha(0.95)
        with panel("keys", scrolls=True, is_above=True):
            if imgui.begin_table("keys", 2, imgui.TableFlags.SIZING_FIXED_FIT):
                for binding in KEY_BINDINGS:
                    imgui.table_next_row()
                    imgui.table_next_column()
                    imgui.text(binding.keys_here())
                    imgui.table_next_column()
                    imgui.push_text_wrap_pos(0.94 * width - em(2))
                    imgui.text_disabled(binding.help)
                    imgui.pop_text_wrap_pos()
                imgui.end_table()


def shortened(name: str) -> str:
    """Return the name of a file with at most NAME_CHARACTERS, and its end, by which takes differ."""
    half = (NAME_CHARACTERS - 2) // 2
    return name if len(name) <= NAME_CHARACTERS else f"{name[:half]}..{name[-half:]}"


def _time_left(seconds: float | None) -> str:
    """Return how long something still takes, in words; nothing if that is not known yet."""
    if seconds is None:
        return ""
    return f", {seconds:.0f} s left" if seconds < 90 else f", {seconds / 60:.0f} min left"
