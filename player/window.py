"""The player's window: glfw for events, ImGui for controls, the renderer for the picture."""

import contextlib
import time as clock
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import glfw
import moderngl
import numpy as np
from imgui_bundle import imgui

from kpc.format.errors import DisplayError
from kpc.format.media import write_image
from kpc.format.scene import HybridDecoder
from kpc.player.controls import SPEEDS, Pace, Playback, View, Wardrobe
from kpc.player.orbit import Rig
from kpc.player.overlay import Overlay
from kpc.player.prefetch import Playhead
from kpc.player.quality import DEFAULT, LADDER
from kpc.player.reference import Part
from kpc.player.renderer import Look, Renderer, is_software
from kpc.player.stream import Stream

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
    ("V", "the next appearance, if it has several"),
    ("1 2 3 4", "colour, depth, samples, occupancy"),
    ("C", "all, what stays, what moves"),
    ("F", "exact or folded time planes"),
    ("P", "screenshot"),
    ("Tab", "hide or show all this"),
    ("H", "these keys"),
    ("Esc", "quit"),
)
LOOKS = {Look.COLOUR: "colour", Look.DEPTH: "depth", Look.SAMPLES: "samples", Look.OCCUPANCY: "occupancy"}
PARTS = {Part.FULL: "all", Part.STATIC: "static only", Part.DYNAMIC: "dynamic only"}
REMEDY = "render pictures or a video with kprender instead"

STATS_EVERY_S = 0.5
STATS_SIZE = (48, 36)
SHARPEN_AFTER_S = 0.25
CROSSING_S = 4.0
"""Flying takes this long to cross the box's longest edge."""


class Window:
    """A glfw window with an OpenGL 3.3 core context, and the events since the last look at them.

    Raises:
        DisplayError: no display, no OpenGL 3.3.
    """

    def __init__(self, title: str, size: tuple[int, int]) -> None:
        self._complaint = "no reason given"
        glfw.set_error_callback(self._complain)
        if not glfw.init():
            raise DisplayError(f"no window to be had ({self._complaint}); {REMEDY}")
        hints = {
            glfw.CONTEXT_VERSION_MAJOR: 3,
            glfw.CONTEXT_VERSION_MINOR: 3,
            glfw.OPENGL_PROFILE: glfw.OPENGL_CORE_PROFILE,
            glfw.OPENGL_FORWARD_COMPAT: True,
            glfw.SCALE_TO_MONITOR: True,
        }
        for hint, value in hints.items():
            glfw.window_hint(hint, value)
        self.handle = glfw.create_window(*size, title, None, None)
        if not self.handle:
            glfw.terminate()
            raise DisplayError(f"no window with OpenGL 3.3 to be had ({self._complaint}): {REMEDY}")
        glfw.make_context_current(self.handle)
        glfw.swap_interval(1)
        self.ctx = self._context()
        self.io: imgui.IO | None = None
        self.pressed: list[tuple[int, int]] = []
        glfw.set_key_callback(self.handle, self._key)
        glfw.set_cursor_pos_callback(self.handle, self._moved)
        glfw.set_mouse_button_callback(self.handle, self._clicked)
        glfw.set_scroll_callback(self.handle, self._scrolled)

    def _context(self) -> moderngl.Context:
        failures = []
        # glfw talks GLX to an X server and EGL to Wayland
        backends: tuple[dict[str, Any], ...] = ({}, {"backend": "egl"})
        for backend in backends:
            try:
                return moderngl.create_context(require=330, **backend)
            except Exception as error:  # glcontext raises bare Exception, ImportError or ValueError, whatever failed
                failures.append(str(error))
        glfw.terminate()
        raise DisplayError(
            f"no OpenGL 3.3 in the window ({'; '.join(failures)}); update the graphics driver, or {REMEDY}"
        )

    def _complain(self, code: int, message: bytes | str) -> None:
        self._complaint = message.decode(errors="replace") if isinstance(message, bytes) else message

    def _key(self, window: object, key: int, scancode: int, action: int, mods: int) -> None:
        if action in (glfw.PRESS, glfw.REPEAT):
            self.pressed.append((key, mods))

    def _moved(self, window: object, x: float, y: float) -> None:
        if self.io:
            self.io.add_mouse_pos_event(x, y)

    def _clicked(self, window: object, button: int, action: int, mods: int) -> None:
        if self.io and button < 3:
            self.io.add_mouse_button_event(button, action == glfw.PRESS)

    def _scrolled(self, window: object, x: float, y: float) -> None:
        if self.io:
            self.io.add_mouse_wheel_event(x, y)

    @property
    def size(self) -> tuple[int, int]:
        """In the system's screen units, those of the pointer."""
        width, height = glfw.get_window_size(self.handle)
        return width, height

    @property
    def pixels(self) -> tuple[int, int]:
        width, height = glfw.get_framebuffer_size(self.handle)
        return width, height

    def held(self, *keys: int) -> bool:
        return any(glfw.get_key(self.handle, key) == glfw.PRESS for key in keys)

    def close(self) -> None:
        glfw.destroy_window(self.handle)
        glfw.terminate()


class Player:
    """A scene in a window, from the first frame to the last, while it arrives."""

    def __init__(self, window: Window, stream: Stream) -> None:
        self.window, self.stream, self.scene = window, stream, stream.scene
        scene = self.scene
        stream.arrived = glfw.post_empty_event
        self.ctx = window.ctx
        self.device = self.ctx.info["GL_RENDERER"]
        software = is_software(self.ctx)
        self.renderer = Renderer(self.ctx, scene, LADDER[DEFAULT if software else "reference"])
        self.overlay = Overlay(self.ctx)
        window.io = self.overlay.io
        self.rig = Rig.of(scene)
        self.camera_number = 0
        self.view = View.of(self.rig, self.rig.cameras[0])
        self.playback = Playback(scene.clip, playing=scene.clip.duration_s > 0)
        self.wardrobe = Wardrobe(scene)
        self.pace = Pace.of(software)
        self.part, self.look = Part.FULL, Look.COLOUR
        self.show_hud, self.show_keys = True, False
        self.frame_s = self.draw_s = 0.0
        self.samples, self.most_samples, self.depths = 0.0, 16.0, (0.0, 1.0)
        self._notice, self._notice_until = "H: keys", clock.monotonic() + 4.0
        self._measured = -STATS_EVERY_S
        self._before = self._moved = clock.monotonic()
        self._resize(window.pixels)
        self._drawn: tuple[object, ...] = ()
        self._is_sharp = False

    def run(self, frames: int | None = None) -> None:
        """Until the window is closed, or for a number of frames once all of the scene is there that is to come."""
        shown = 0
        while not glfw.window_should_close(self.window.handle) and (frames is None or shown < frames):
            if (frames is None or not self.stream.is_settled) and self._is_sharp:
                glfw.wait_events_timeout(0.05)  # nothing moves: spend next to nothing
            else:
                glfw.poll_events()
            self.frame()
            shown += self.stream.is_settled

    def frame(self) -> None:
        """One turn: events, the scene, the controls over it."""
        now = clock.monotonic()
        seconds, self._before = now - self._before, now
        self.frame_s += 0.1 * (seconds - self.frame_s) if self.frame_s else seconds
        pixels = self.window.pixels
        if min(pixels) < 1 or glfw.get_window_attrib(self.window.handle, glfw.ICONIFIED):
            glfw.wait_events_timeout(0.1)
            return
        if pixels != self.canvas.size:
            self._resize(pixels)
        self._begin(seconds)
        self._point()
        self._fly(min(seconds, 0.1))
        for key, mods in self.window.pressed:
            self._type(key, mods)
        self.window.pressed.clear()
        self._advance(seconds)
        self.wardrobe.advance(seconds)
        self._draw(now)
        self._widgets()
        self._finish()
        glfw.swap_buffers(self.window.handle)
        self.renderer.check()

    def _advance(self, seconds: float) -> None:
        """Let the clip go on, unless what comes next is not there yet."""
        later = self.playback.after(seconds)
        self.stream.steer(Playhead(later.time, self.playback.pace, self.playback.loop))
        self.stream.upload(self.renderer)
        if self.stream.can_show(later.time, self.playback.pace):
            self.playback = later

    def screenshot(self, path: Path, with_controls: bool) -> None:
        """Save the picture at the window's full resolution."""
        self._begin(1 / 60)
        self._picture(1.0)
        self._widgets()
        self._finish()
        source = self.screen if with_controls else self.canvas
        width, height = self.canvas.size
        data = source.read(viewport=(0, 0, width, height), components=3, alignment=1)
        write_image(path, np.frombuffer(data, np.uint8).reshape(height, width, 3)[::-1])

    # --- the picture

    def _resize(self, pixels: tuple[int, int]) -> None:
        """The canvas holds the last picture of the scene, so that the controls can change over it."""
        self.ctx.screen.use()
        self.ctx.viewport = (0, 0, *pixels)
        self.screen = self.ctx.detect_framebuffer(0)
        self.canvas = self.ctx.framebuffer([self.ctx.texture(pixels, 4)])
        red, green, blue = map(float, self.scene.background)
        self.canvas.clear(red, green, blue)
        self.raster = pixels
        self._drawn = ()

    def _draw(self, now: float) -> None:
        """Draw the scene if anything has changed, finely once nothing does any more."""
        worn = (self.wardrobe.number, self.wardrobe.progress)
        wanted = (self.view, self.playback.time, self.part, self.look, self.renderer.quality, worn, self.stream.version)
        if self.stream.scales_here == 0:
            self._is_sharp = True  # as sharp as nothing can be
        elif wanted != self._drawn:
            self._drawn, self._moved, self._is_sharp = wanted, now, False
            self._picture(self.pace.scale)
            self.pace.saw(self.draw_s)
        elif not self._is_sharp and (self.pace.scale == 1.0 or now - self._moved > SHARPEN_AFTER_S):
            self._picture(1.0)
            self._is_sharp = True

    def _picture(self, scale: float) -> None:
        """Draw the scene on the canvas, at a share of its resolution."""
        if clock.monotonic() - self._measured > STATS_EVERY_S:
            self._measure()
        started = clock.monotonic()
        width, height = (max(1, round(side * scale)) for side in self.canvas.size)
        self.raster = (width, height)
        self.renderer.show(
            self.canvas,
            self.view.camera(width, height),
            self.playback.time,
            part=self.part,
            look=self.look,
            depths=self.depths,
            most_samples=self.most_samples,
            appearance=self.wardrobe.code,
        )
        self.ctx.finish()
        self.draw_s = clock.monotonic() - started

    def _measure(self) -> None:
        """Samples a ray, and how far things are, from a very small picture."""
        small = self.renderer.render(
            self.view.camera(*STATS_SIZE),
            self.playback.time,
            part=Part.STATIC if self.part is Part.STATIC else Part.FULL,
        )
        self.samples = float(small.samples.mean())
        self.most_samples = max(2.0 * float(np.percentile(small.samples, 95)), 8.0)
        seen = small.depth[small.opacity > 0.5]
        if seen.size:
            near, far = np.percentile(seen, (2, 98))
            self.depths = (0.9 * float(near), 1.1 * float(far))
        self._measured = clock.monotonic()

    def _finish(self) -> None:
        """The canvas, and the controls over it, on the screen."""
        self.ctx.copy_framebuffer(self.screen, self.canvas)
        self.overlay.draw(self.screen)

    # --- events

    def _point(self) -> None:
        """Drags and the wheel, where no control takes them."""
        io = self.overlay.io
        if io.want_capture_mouse:
            return
        width, height = self.window.size
        across, down = io.mouse_delta.x / max(height, 1), io.mouse_delta.y / max(height, 1)
        shift = self.window.held(glfw.KEY_LEFT_SHIFT, glfw.KEY_RIGHT_SHIFT)
        moving = shift or imgui.is_mouse_down(1) or imgui.is_mouse_down(2)
        if (across or down) and moving and any(imgui.is_mouse_down(button) for button in range(3)):
            self.view = self.view.pan(across, -down)
        elif (across or down) and imgui.is_mouse_down(0):
            self.view = self.view.orbit(np.pi * across, -np.pi * down)
        if io.mouse_wheel:
            self.view = self.view.zoom(io.mouse_wheel)

    def _fly(self, seconds: float) -> None:
        held = self.window.held
        right, up, forward = (
            held(plus) - held(minus)
            for plus, minus in ((glfw.KEY_D, glfw.KEY_A), (glfw.KEY_E, glfw.KEY_Q), (glfw.KEY_W, glfw.KEY_S))
        )
        if right or up or forward:
            hurry = 4 if held(glfw.KEY_LEFT_SHIFT, glfw.KEY_RIGHT_SHIFT) else 1
            way = hurry * seconds * self.scene.extent / CROSSING_S
            self.view = self.view.fly(way * right, way * up, way * forward)

    def _type(self, key: int, mods: int) -> None:
        playback = self.playback
        if key == glfw.KEY_SPACE:
            playback.toggle()
        elif key in (glfw.KEY_LEFT, glfw.KEY_RIGHT):
            playback.step(1 if key == glfw.KEY_RIGHT else -1)
        elif key in (glfw.KEY_HOME, glfw.KEY_END):
            playback.seek(0.0 if key == glfw.KEY_HOME else 1.0)
        elif key in (glfw.KEY_LEFT_BRACKET, glfw.KEY_RIGHT_BRACKET):
            playback.faster(1 if key == glfw.KEY_RIGHT_BRACKET else -1)
        elif key == glfw.KEY_L:
            playback.loop = not playback.loop
        elif key in (glfw.KEY_R, glfw.KEY_N):
            self.camera_number = (self.camera_number + 1) % len(self.rig.cameras) if key == glfw.KEY_N else 0
            self.view = View.of(self.rig, self.rig.cameras[self.camera_number])
        elif key == glfw.KEY_V:
            self.wardrobe.next()
        elif glfw.KEY_1 <= key < glfw.KEY_1 + len(LOOKS):
            self.look = list(LOOKS)[key - glfw.KEY_1]
        elif key == glfw.KEY_C and self.scene.is_dynamic:
            parts = list(PARTS)
            self.part = parts[(parts.index(self.part) + 1) % len(parts)]
        elif key == glfw.KEY_F and self.scene.is_dynamic:
            self._fold(not self.renderer.quality.folded)
        elif key == glfw.KEY_TAB:
            self.show_hud = not self.show_hud
        elif key == glfw.KEY_H:
            self.show_keys = not self.show_keys
        elif key == glfw.KEY_P:
            self._save_picture()
        elif key == glfw.KEY_ESCAPE:
            glfw.set_window_should_close(self.window.handle, True)

    def _save_picture(self) -> None:
        """Write the picture without controls into the working directory, under the first name that is free."""
        stem = Path(self.stream.source.name).stem
        path = next(p for p in (Path(f"{stem}-{n:03d}.png") for n in range(1, 1_000_000)) if not p.exists())
        self._picture(1.0)
        try:
            pixels = np.frombuffer(self.canvas.read(components=3, alignment=1), np.uint8)
            write_image(path, pixels.reshape(self.canvas.height, self.canvas.width, 3)[::-1])
            self._notice = f"saved {path}"
        except OSError as error:
            self._notice = f"{path}: {error.strerror or error}"
        self._notice_until = clock.monotonic() + 3.0

    # --- controls

    def _begin(self, seconds: float) -> None:
        scale = glfw.get_window_content_scale(self.window.handle)[0]
        self.overlay.begin(self.window.size, self.canvas.size, scale, seconds)

    def _widgets(self) -> None:
        """Build what is shown over the scene."""
        if self.show_hud:
            self._status()
            self._transport()
        if self.show_keys:
            self._key_list()
        width, height = self.window.size
        if clock.monotonic() < self._notice_until:
            _say("notice", self._notice, width, 0.82 * height, 0.5)
        if (message := self.stream.message) is not None:
            _say("stream", message, width, 0.8 * imgui.get_font_size(), 0.0)

    def _status(self) -> None:
        em = imgui.get_font_size()
        _place(0.8 * em, 0.8 * em)
        with _panel("status"):
            imgui.text(f"{1 / max(self.frame_s, 1e-6):.0f} fps   {1e3 * self.draw_s:.1f} ms")
            imgui.text_disabled("{}x{} of {}x{}".format(*self.raster, *self.canvas.size))
            imgui.text_disabled(f"{self.samples:.1f} samples a ray")
            imgui.text_disabled(f"{self.renderer.memory_bytes / 1e6:.0f} MB of textures")
            imgui.text_disabled(self.device.split("(")[0].strip())
            if isinstance(self.scene.decoder, HybridDecoder):
                imgui.text_disabled("hybrid decoder: plays slower")
            if not self.stream.is_settled:
                imgui.text_disabled(f"{self.stream.share_here:.0%} here, {self.stream.rate / 1e3:,.0f} KB/s")
            imgui.separator()
            for look, label in LOOKS.items():
                if imgui.radio_button(label, self.look is look):
                    self.look = look
            if self.scene.appearances:
                imgui.separator()
                imgui.text_disabled("appearance")
                imgui.set_next_item_width(12 * em)
                changed, chosen = imgui.combo("##appearance", self.wardrobe.number, list(self.wardrobe.names))
                if changed:
                    self.wardrobe.wear(chosen)
            if self.scene.is_dynamic:
                imgui.separator()
                for part, label in PARTS.items():
                    if imgui.radio_button(label, self.part is part):
                        self.part = part
                imgui.separator()
                changed, folded = imgui.checkbox("folded time planes", self.renderer.quality.folded)
                if changed:
                    self._fold(folded)
                imgui.set_item_tooltip("Multiplies time into the space planes once a frame: faster; some 43 dB from exact.")

    def _fold(self, folded: bool) -> None:
        self.renderer.quality = replace(self.renderer.quality, folded=folded)

    def _transport(self) -> None:
        """Play, pause, scrub, speed, loop."""
        playback, clip = self.playback, self.scene.clip
        if clip.duration_s == 0:
            return
        em = imgui.get_font_size()
        width, height = self.window.size
        _place(width / 2, height - 0.8 * em, 0.5, 1.0)
        imgui.set_next_window_size(imgui.ImVec2(min(width - 1.6 * em, 60 * em), 0))
        with _panel("transport", fitted=False):
            if imgui.button("pause" if playback.playing else "play", imgui.ImVec2(4 * em, 0)):
                playback.toggle()
            imgui.same_line()
            imgui.set_next_item_width(max(imgui.get_content_region_avail().x - 13.5 * em, 4 * em))
            label = f"{playback.time * clip.duration_s:.2f} / {clip.duration_s:.2f} s"
            changed, time = imgui.slider_float("##time", playback.time, 0.0, 1.0, label, imgui.SliderFlags_.no_input)
            if changed:
                playback.playing = False
                playback.seek(time)
            imgui.same_line()
            imgui.set_next_item_width(5.5 * em)
            names = [f"{speed:g}x" for speed in SPEEDS]
            nearest = min(range(len(SPEEDS)), key=lambda i: abs(SPEEDS[i] - playback.speed))
            changed, chosen = imgui.combo("##speed", nearest, names)
            if changed:
                playback.speed = SPEEDS[chosen]
            imgui.same_line()
            _, playback.loop = imgui.checkbox("loop", playback.loop)

    def _key_list(self) -> None:
        width, height = self.window.size
        _place(width / 2, height / 2, 0.5, 0.5)
        imgui.set_next_window_bg_alpha(0.95)
        with _panel("keys"):
            if imgui.begin_table("keys", 2, imgui.TableFlags_.sizing_fixed_fit):
                for key, meaning in KEYS:
                    imgui.table_next_row()
                    imgui.table_next_column()
                    imgui.text(key)
                    imgui.table_next_column()
                    imgui.text_disabled(meaning)
                imgui.end_table()

    def close(self) -> None:
        self.window.io = None
        self.overlay.close()


def _place(x: float, y: float, pivot_x: float = 0.0, pivot_y: float = 0.0) -> None:
    imgui.set_next_window_pos(imgui.ImVec2(x, y), imgui.Cond_.always, imgui.ImVec2(pivot_x, pivot_y))


def _say(name: str, text: str, width: float, y: float, pivot: float) -> None:
    """A message in the middle of the window's width, wrapped; `pivot` of its height lies at `y`."""
    _place(width / 2, y, 0.5, pivot)
    with _panel(name, imgui.WindowFlags_.no_inputs):
        imgui.push_text_wrap_pos(0.88 * width)
        imgui.text(text)
        imgui.pop_text_wrap_pos()


@contextlib.contextmanager
def _panel(name: str, flags: int = 0, fitted: bool = True) -> Iterator[None]:
    """A bare ImGui window that cannot be moved."""
    bare = imgui.WindowFlags_.no_decoration | imgui.WindowFlags_.no_move | imgui.WindowFlags_.no_nav
    imgui.begin(f"##{name}", None, bare | flags | (imgui.WindowFlags_.always_auto_resize if fitted else 0))
    try:
        yield
    finally:
        imgui.end()
