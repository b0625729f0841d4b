"""What is shown over the scene: ImGui widgets for the state of a `kpc.player.app.window.Player`, and what they change in it."""

import contextlib
import time as clock
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, TypeVar

import moderngl
import numpy as np
from kpc.format.common.errors import DatasetError
from kpc.format.scene.scene import HybridDecoder, Scene
from kpc.player.app.controls import SPEEDS
from kpc.player.app.desktop import imgui
from kpc.player.app.preferences import TARGET_FPS
from kpc.player.app.quality_controller import LEVEL_NAMES
from kpc.player.app.time_plane_pictures import moving_part, time_plane_picture, time_planes
from kpc.player.cpu.reference import Part
from kpc.player.gl.renderer import DisplayMode
from kpc.player.quality import LEVELS

if TYPE_CHECKING:
    from kpc.player.app.window import Player

KEYS = (
    ("drag", "turn around the scene"),
    ("right drag, Shift drag", "move sideways"),
    ("wheel", "come nearer, go away"),
    ("W A S D, Q E", "fly; with Shift faster"),
    ("Space", "play, pause"),
    ("Left, Right", "one frame back, on"),
    ("Home, End", "to the start, to the end"),
    ("[  ]", "slower, faster"),
    ("L", "loop"),
    ("R", "back to the opening camera"),
    ("N", "the next camera of the scene"),
    ("B", "the next place to look from"),
    ("V", "the next appearance, if it has several"),
    ("1 2 3 4", "colour, depth, samples, occupancy"),
    ("C", "all, what stays, what moves"),
    ("-  =", "faster, finer pictures"),
    ("U", "hold the frame rate, or the quality"),
    ("F", "exact or folded time planes"),
    ("K", "a keyframe of the camera path, here and now"),
    ("Backspace", "take the last keyframe away"),
    ("J", "follow the camera path, stop"),
    ("Ctrl S", "save the camera path"),
    ("P", "screenshot"),
    ("O", "film the window, stop"),
    ("Shift O", "film the camera path, stop"),
    ("T", "time planes: what moves is a wave"),
    ("G", "graphs"),
    ("Ctrl -, Ctrl =", "smaller, larger text"),
    ("Tab", "hide or show all this"),
    ("H", "these keys"),
    ("Esc", "quit"),
)
DISPLAY_MODE_NAMES = {
    DisplayMode.COLOUR: "colour",
    DisplayMode.DEPTH: "depth",
    DisplayMode.SAMPLES: "samples",
    DisplayMode.OCCUPANCY: "occupancy",
}
PART_NAMES = {Part.FULL: "all", Part.STATIC: "static only", Part.DYNAMIC: "dynamic only"}

LABEL_EM = 5.2
"""Width of the labels before controls, in heights of the text."""
CONTROL_EM = 9.5
PANEL_EM = 19.0
"""Width of the panels on the right."""
ROWS_SHOWN = 8
"""Keyframes that are seen without scrolling."""
LEAST_TOLD_EM = 12.0
"""What is told of the stream stands beside the panel on the left where so much is free there, else over it."""
REFRESH_S = 0.5
"""Pictures of time planes follow what arrives no sooner."""
ACCENT, ERROR = imgui.ImVec4(0.95, 0.62, 0.25, 1.0), imgui.ImVec4(1.0, 0.45, 0.38, 1.0)


Value = TypeVar("Value")


def show(player: "Player") -> None:
    """Build all that is to be shown in this frame."""
    width, height = player.window.size
    em = imgui.get_font_size()
    bottom = height - 0.8 * em
    across = free = 0.0, float(width)
    if player.show_hud:
        bottom = _transport(player, bottom)
        if player.show_planes and player.scene.is_dynamic:
            bottom = _time_planes(player, bottom - 0.4 * em)
        right = _status(player, bottom - 1.2 * em)
        free = (right, float(width)) if width - right > LEAST_TOLD_EM * em else across
        top = _graphs(player, 0.8 * em) if player.show_graphs else 0.8 * em
        if player.show_path:
            _camera_path(player, top, bottom - 0.4 * em)
    if player.film is not None:
        _filming(player)
    if player.show_keys:
        _key_list(player)
    if clock.monotonic() < player.notice_until:
        _say("notice", player.notice, across, bottom - 0.8 * em, 1.0, ERROR if player.notice_is_error else None)
    if (message := player.stream.message) is not None:
        _say("stream", message, free, 0.8 * em, 0.0)


def _status(player: "Player", bottom: float) -> float:
    """On the left: how fast, what of the scene, how finely, from where. Where it ends."""
    em, stream = imgui.get_font_size(), player.stream
    _place(0.8 * em, 0.8 * em, most_height=bottom - 0.8 * em)
    with _panel("status", scrolls=True):
        imgui.text(f"{1 / max(player.frame_s, 1e-6):.0f} fps   {1e3 * player.draw_s:.1f} ms")
        imgui.text_disabled("{}x{} of {}x{}".format(*player.raster, *player.canvas.size))
        imgui.text_disabled(f"{player.samples:.1f} samples a ray, {player.renderer.memory_bytes / 1e6:.0f} MB")
        imgui.text_disabled(player.device.split("(")[0].strip()[:32])
        imgui.text_disabled(f"by {player.renderer.drawn_by}")
        if isinstance(player.scene.decoder, HybridDecoder):
            imgui.text_disabled("hybrid decoder: plays slower")
        if not stream.is_settled:
            imgui.text_disabled(f"{stream.loaded_fraction:.0%} here, {stream.rate / 1e3:,.0f} KB/s")
        imgui.separator()
        _quality(player)
        imgui.separator()
        player.look = _choice("view", player.look, DISPLAY_MODE_NAMES)
        if player.scene.is_dynamic:
            player.part = _choice("part", player.part, PART_NAMES)
        if player.scene.appearances:
            selected = _choice("colours", player.appearance.number, dict(enumerate(player.appearance.names)))
            if selected != player.appearance.number:
                player.appearance.select(selected)
        _places(player)
        imgui.separator()
        player.show_graphs = _toggle("graphs", player.show_graphs)
        if player.scene.is_dynamic:
            imgui.same_line()
            player.show_planes = _toggle("time", player.show_planes)
        imgui.same_line()
        player.show_path = _toggle("path", player.show_path)
        imgui.same_line()
        player.show_keys = _toggle("keys", player.show_keys)
        return imgui.get_window_pos().x + imgui.get_window_width()


def _quality(player: "Player") -> None:
    """The dial, and whether it moves by itself."""
    dial = player.quality
    _label("quality")
    number = LEVEL_NAMES.index(dial.level)
    changed, wanted = imgui.slider_int(
        "##quality", number, 0, len(LEVEL_NAMES) - 1, dial.level, imgui.SliderFlags_.no_input
    )
    if changed and wanted != number:
        dial.choose(LEVEL_NAMES[wanted])
    imgui.set_item_tooltip("From fastest to what the format says. - and = move it.")
    _label("hold")
    held = dial.target_s is not None
    changed, held = imgui.checkbox("##hold", held)
    imgui.set_item_tooltip("Moves the quality by itself, so that so many pictures come in a second.")
    imgui.same_line()
    imgui.set_next_item_width((CONTROL_EM - 2) * imgui.get_font_size())
    moved, fps = imgui.slider_float(
        "##fps", player.target_fps, 5.0, 120.0, "%.0f fps", imgui.SliderFlags_.no_input | imgui.SliderFlags_.logarithmic
    )
    if moved:
        player.target_fps = min(max(fps, TARGET_FPS[0]), TARGET_FPS[1])
    if changed or (moved and held):
        dial.hold(player.target_fps if held else None)
    if player.scene.is_dynamic and LEVELS[dial.level].folded:
        _label("exact")
        _, player.exact = imgui.checkbox("##exact", player.exact)
        imgui.set_item_tooltip("Samples time planes beside the space planes, and does not multiply them in: slower.")


def _places(player: "Player") -> None:
    """Cameras of the scene, and places around it."""
    cameras = [f"camera {number + 1}" for number in range(len(player.rig.cameras))]
    chosen = _choice("camera", player.camera_number, dict(enumerate(cameras)))
    if chosen != player.camera_number:
        player.to_camera(chosen)
    names = ["-", *player.presets]
    chosen = _choice("place", player.preset_number + 1, dict(enumerate(names)))
    if chosen not in (0, player.preset_number + 1):
        player.to_preset(chosen - 1)


def _transport(player: "Player", bottom: float) -> float:
    """Play, pause, scrub, speed, loop, up from `bottom`; its upper edge."""
    playback, clip = player.playback, player.stream.clip
    if clip.duration_s == 0:
        return bottom
    em = imgui.get_font_size()
    width = player.window.size[0]
    _place(width / 2, bottom, 0.5, 1.0)
    imgui.set_next_window_size(imgui.ImVec2(_band(width), 0))
    with _panel("transport", fitted=False):
        if imgui.button("pause" if playback.playing else "play", imgui.ImVec2(4 * em, 0)):
            player.riding = False
            playback.toggle()
        imgui.same_line()
        imgui.set_next_item_width(max(imgui.get_content_region_avail().x - 13.5 * em, 4 * em))
        label = f"{playback.time * clip.duration_s:.2f} / {clip.duration_s:.2f} s"
        changed, time = imgui.slider_float("##time", playback.time, 0.0, 1.0, label, imgui.SliderFlags_.no_input)
        if changed:
            player.scrub(time)
        imgui.same_line()
        imgui.set_next_item_width(5.5 * em)
        nearest = min(range(len(SPEEDS)), key=lambda i: abs(SPEEDS[i] - playback.speed))
        changed, chosen = imgui.combo("##speed", nearest, [f"{speed:g}x" for speed in SPEEDS])
        if changed:
            playback.speed = SPEEDS[chosen]
        imgui.same_line()
        _, playback.loop = imgui.checkbox("loop", playback.loop)
        return bottom - imgui.get_window_height()


class PlaneView:
    """The time plane that is shown, as a texture that follows what arrives.

    Attributes:
        number: of those that `time_planes` lists.
        low, high: between which shares of its height something moves, from the upper edge.
    """

    def __init__(self, scene: Scene) -> None:
        self.number = len(scene.scales) - 1
        self.low, self.high = 0.0, 1.0
        self._texture: moderngl.Texture | None = None
        self._shown: tuple[int, int] | None = None
        self._made = 0.0

    def texture(self, player: "Player") -> moderngl.Texture:
        """Made anew where another plane is wanted, or more of it has come."""
        wanted = self.number, player.stream.version
        stale = wanted != self._shown and clock.monotonic() - self._made > REFRESH_S
        if self._texture is None or stale or (self._shown or (-1,))[0] != self.number:
            picture = time_plane_picture(player.scene, *time_planes(player.scene)[self.number])
            size = picture.shape[1], picture.shape[0]
            if self._texture is None or self._texture.size != size:
                if self._texture is not None:
                    player.imgui.forget(self._texture)
                self._texture = player.imgui.adopt(player.ctx.texture(size, 3, alignment=1))
            self._texture.write(picture.tobytes(), alignment=1)
            self.low, self.high = moving_part(picture)
            self._shown, self._made = wanted, clock.monotonic()
        return self._texture


def _time_planes(player: "Player", bottom: float) -> float:
    """A time plane over the whole clip, or the group that shows, the playhead in it; a click goes there. Up from `bottom`; its upper edge."""
    em, width, view = imgui.get_font_size(), player.window.size[0], player.planes
    _place(width / 2, bottom, 0.5, 1.0)
    imgui.set_next_window_size(imgui.ImVec2(_band(width), 0))
    with _panel("time planes", fitted=False):
        listed = time_planes(player.scene)
        view.number = min(view.number, len(listed) - 1)  # groups of a clip need not have equally many
        imgui.set_next_item_width(9 * em)
        names = [f"{plane}, scale {scale + 1}" for plane, scale in listed]
        changed, number = imgui.combo("##plane", view.number, names)
        if changed:
            view.number = number
        imgui.same_line()
        texture, axis = view.texture(player), listed[view.number][0][0]
        where = f"{axis} upwards, {1 - view.high:.0%} to {1 - view.low:.0%}"
        imgui.text_disabled(f"time to the right, {where}; grey stands still")
        size = imgui.ImVec2(imgui.get_content_region_avail().x, min(7 * em, 0.25 * player.window.size[1]))
        corner = imgui.get_cursor_screen_pos()
        imgui.image(imgui.ImTextureRef(texture.glo), size, imgui.ImVec2(0.0, view.low), imgui.ImVec2(1.0, view.high))
        imgui.set_cursor_screen_pos(corner)
        imgui.invisible_button("##seek", size)
        if imgui.is_item_active():
            player.scrub(player.stream.time_of((imgui.get_mouse_pos().x - corner.x) / max(size.x, 1.0)))
        at = corner.x + player.stream.time_in(player.playback.time) * size.x
        imgui.get_window_draw_list().add_line(
            imgui.ImVec2(at, corner.y),
            imgui.ImVec2(at, corner.y + size.y),
            imgui.get_color_u32(ACCENT),
            max(0.12 * em, 1.0),
        )
        return bottom - imgui.get_window_height()


def _graphs(player: "Player", top: float) -> float:
    """On the right: milliseconds of the last frames, and of their pictures. Down from `top`; its lower edge."""
    em, width = imgui.get_font_size(), player.window.size[0]
    count = min(player.frames, player.history.shape[1])
    _place(width - 0.8 * em, top, 1.0, 0.0)
    imgui.set_next_window_size(imgui.ImVec2(PANEL_EM * em, 0))
    with _panel("graphs", fitted=False):
        for (label, target_s), values in zip((("frame", None), ("picture", player.quality.target_s)), player.history):
            seen = values[:count] if count else np.zeros(1, np.float32)
            median, slow = np.percentile(seen, (50, 95))
            imgui.text_disabled(f"{label} {median:.1f} ms, 95% {slow:.1f}")
            most = 1.25 * float(max(slow, 1.0, 1e3 * (target_s or 0.0)))
            corner, size = imgui.get_cursor_screen_pos(), imgui.ImVec2(imgui.get_content_region_avail().x, 3.2 * em)
            offset = player.frames % len(values) if count == len(values) else 0
            imgui.plot_lines(f"##{label}", values if count == len(values) else seen, offset, None, 0.0, most, size)
            if target_s is not None:
                y = corner.y + size.y * (1 - 1e3 * target_s / most)
                ends = imgui.ImVec2(corner.x, y), imgui.ImVec2(corner.x + size.x, y)
                imgui.get_window_draw_list().add_line(*ends, imgui.get_color_u32(ACCENT))
        return top + imgui.get_window_height() + 0.4 * em


def _camera_path(player: "Player", top: float, bottom: float) -> None:
    """On the right, below `top`: the keyframes, and what can be done with them."""
    em, width, path = imgui.get_font_size(), player.window.size[0], player.path
    _place(width - 0.8 * em, top, 1.0, 0.0, most_height=bottom - top, least_width=PANEL_EM * em)
    with _panel("path", scrolls=True):
        if imgui.button("keyframe"):
            player.add_keyframe()
        imgui.set_item_tooltip("Here and now: K.")
        imgui.same_line()
        imgui.begin_disabled(not path.keyframes)
        if imgui.button("stop" if player.riding and not player.is_filming_path else "follow"):
            player.follow()
        imgui.same_line()
        if imgui.button("film it"):
            player.start_or_stop_filming(along_path=True)
        imgui.same_line()
        if imgui.button("save"):
            player.save_path()
        imgui.end_disabled()
        if not path.keyframes:
            imgui.text_disabled(
                "No keyframes yet. Fly somewhere,\npress K, and again elsewhere;\nor drag a saved path in."
            )
            return
        imgui.set_next_item_width(-1)
        ride_s = min(max(player.ride_s, path.start_s), path.end_s)
        changed, ride_s = imgui.slider_float(
            "##ride", ride_s, path.start_s, max(path.end_s, path.start_s + 1e-3), "%.1f s", imgui.SliderFlags_.no_input
        )
        if changed:
            player.ride_to(ride_s)
        row = imgui.get_frame_height_with_spacing()
        if imgui.begin_child("##keyframes", imgui.ImVec2(0, row * min(len(path.keyframes), ROWS_SHOWN))):
            for number in range(len(path.keyframes)):
                imgui.push_id(number)
                _keyframe(player, number)
                imgui.pop_id()
        imgui.end_child()


def _keyframe(player: "Player", number: int) -> None:
    """A line of the list: go there, seconds since the one before, the clip's time, away with it."""
    em, path = imgui.get_font_size(), player.path
    if number >= len(path.keyframes):
        return  # one before it has just gone
    shot = path.keyframes[number]
    if imgui.button(f"{number + 1}", imgui.ImVec2(2 * em, 0)):
        player.ride_to(float(shot.at_s or 0.0))
    imgui.set_item_tooltip("Go there.")
    imgui.same_line()
    imgui.set_next_item_width(5 * em)
    if number:
        gap_s = float(shot.at_s or 0.0) - float(path.keyframes[number - 1].at_s or 0.0)
        changed, gap_s = imgui.drag_float("##gap", gap_s, 0.05, 0.1, 60.0, "+%.1f s", imgui.SliderFlags_.no_input)
        if changed:
            with contextlib.suppress(DatasetError):  # longer than a path may be
                player.path = path.spaced(number, max(gap_s, 0.1))
        imgui.set_item_tooltip("Seconds since the one before. Drag to change.")
    else:
        imgui.dummy(imgui.ImVec2(5 * em, 0))
    imgui.same_line()
    imgui.text_disabled(f"t {shot.time:.2f}")
    imgui.same_line()
    if imgui.button("x", imgui.ImVec2(1.8 * em, 0)):
        player.remove_keyframe(number)
    imgui.set_item_tooltip("Remove it.")


def _filming(player: "Player") -> None:
    """That a video is being written, where, and how far it is."""
    film, width = player.film, player.window.size[0]
    if film is None:
        return
    name = film.path if len(str(film.path)) < 60 else f".../{film.path.name}"
    what = "finishing" if film.is_ending else "filming the path" if player.is_filming_path else "filming"
    share = f" of {player.path.end_s - player.path.start_s:.1f}" if player.is_filming_path else ""
    _say(
        "film",
        f"{what}: {film.duration_s:.1f}{share} s, {name}",
        (0.0, float(width)),
        0.06 * player.window.size[1],
        0.0,
        ACCENT,
    )


def _key_list(player: "Player") -> None:
    width, height = player.window.size
    _place(width / 2, height / 2, 0.5, 0.5, most_height=0.94 * height)
    imgui.set_next_window_bg_alpha(0.95)
    with _panel("keys", scrolls=True):
        if imgui.begin_table("keys", 2, imgui.TableFlags_.sizing_fixed_fit):
            for key, meaning in KEYS:
                imgui.table_next_row()
                imgui.table_next_column()
                imgui.text(key)
                imgui.table_next_column()
                imgui.text_disabled(meaning)
            imgui.end_table()


# --- parts of panels


def _band(width: float) -> float:
    """Width of what lies along the lower edge."""
    em = imgui.get_font_size()
    return min(width - 1.6 * em, 60 * em)


def _label(text: str) -> None:
    """A label, and the place for what it belongs to."""
    em = imgui.get_font_size()
    imgui.align_text_to_frame_padding()
    imgui.text_disabled(text)
    imgui.same_line(LABEL_EM * em)
    imgui.set_next_item_width(CONTROL_EM * em)


def _choice(label: str, present: Value, names: dict[Value, str]) -> Value:
    """One of several by name."""
    _label(label)
    values: Sequence[Value] = list(names)
    changed, chosen = imgui.combo(f"##{label}", values.index(present), list(names.values()))
    return values[chosen] if changed else present


def _toggle(label: str, on: bool) -> bool:
    """A button that stays down."""
    if on:
        imgui.push_style_color(imgui.Col_.button, imgui.ImVec4(ACCENT.x, ACCENT.y, ACCENT.z, 0.55))
    pressed = imgui.button(label)
    if on:
        imgui.pop_style_color()
    return on != pressed


def _place(
    x: float,
    y: float,
    pivot_x: float = 0.0,
    pivot_y: float = 0.0,
    most_height: float | None = None,
    least_width: float = 0.0,
) -> None:
    imgui.set_next_window_pos(imgui.ImVec2(x, y), imgui.Cond_.always, imgui.ImVec2(pivot_x, pivot_y))
    if most_height is not None:
        imgui.set_next_window_size_constraints(imgui.ImVec2(least_width, 0), imgui.ImVec2(1e5, max(most_height, 1.0)))


def _say(
    name: str, text: str, across: tuple[float, float], y: float, pivot: float, colour: imgui.ImVec4 | None = None
) -> None:
    """A message in the middle of what is between two places across the window, wrapped; `pivot` of its height lies at `y`."""
    _place(sum(across) / 2, y, 0.5, pivot)
    with _panel(name, imgui.WindowFlags_.no_inputs):
        imgui.push_text_wrap_pos(0.88 * (across[1] - across[0]))
        if colour is not None:
            imgui.push_style_color(imgui.Col_.text, colour)
        imgui.text(text)
        if colour is not None:
            imgui.pop_style_color()
        imgui.pop_text_wrap_pos()


@contextlib.contextmanager
def _panel(name: str, flags: int = 0, fitted: bool = True, scrolls: bool = False) -> Iterator[None]:
    """A bare ImGui window that cannot be moved."""
    bare = imgui.WindowFlags_.no_decoration | imgui.WindowFlags_.no_move | imgui.WindowFlags_.no_nav
    if scrolls:
        bare &= ~imgui.WindowFlags_.no_scrollbar
    imgui.begin(f"##{name}", None, bare | flags | (imgui.WindowFlags_.always_auto_resize if fitted else 0))
    try:
        yield
    finally:
        imgui.end()
