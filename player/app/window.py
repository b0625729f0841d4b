"""The player's window: glfw for events, ImGui for controls (`kpc.player.app.panels`), the renderer for the picture."""

import contextlib
import ctypes
import math
import re
import time as clock
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import moderngl
import numpy as np
from kpc.format.common.errors import ContextLostError, DisplayError, KpcError
from kpc.format.common.media import write_image
from kpc.format.container.container import open_source
from kpc.format.scene.cameras import Camera
from kpc.format.scene.scene import Scene
from kpc.player.app import panels
from kpc.player.app.camera_paths import GAP_S, CameraPath
from kpc.player.app.controls import AppearanceSelection, Playback, View
from kpc.player.app.desktop import glfw, imgui
from kpc.player.app.imgui_renderer import ImGuiRenderer
from kpc.player.app.panels import DISPLAY_MODE_NAMES, PART_NAMES
from kpc.player.app.preferences import TEXT_SIZES, Preferences
from kpc.player.app.quality_controller import LEVEL_NAMES, quality_controller_for
from kpc.player.app.recording import Recording, frames_due
from kpc.player.cpu.reference import Part
from kpc.player.gl.renderer import DisplayMode, Renderer, is_software
from kpc.player.quality import LEVELS, neighbouring_level
from kpc.player.streaming.group_playback import GroupPlayback
from kpc.player.streaming.prefetch import Playhead
from kpc.player.viewpoints import Rig, presets

REMEDY = "render pictures or a video with kprender instead"

OPENGL = ((4, 3), (3, 3))
"""Versions to ask for, in this order; macOS gives 4.1 for the second."""
STATS_EVERY_S = 0.5
STATS_SIZE = (48, 36)
SHARPEN_AFTER_S = 0.25
BAND_S = 0.08
"""How long a part of a sharp picture may take."""
CROSSING_S = 4.0
"""Flying takes this long to cross the box's longest edge."""
TOLD_S, COMPLAINED_S = 4.0, 12.0
"""How long a message is shown, and an error."""
FILM_FPS = 30.0
LONGEST_GAP_S = 60.0
HISTORY = 240
MOST_MISHAPS = 3
FINISHING_S = 60.0
"""How long a video may take to be finished after the window was closed."""


class Window:
    """A glfw window with an OpenGL 4.3 or 3.3 core context, and the events since the last look at them.

    Attributes:
        pressed: keys and their modifiers; dropped: files dragged in.

    Raises:
        DisplayError: no display, no OpenGL 3.3.
    """

    def __init__(self, title: str, size: tuple[int, int]) -> None:
        self._complaint = "no reason given"
        glfw.set_error_callback(self._complain)
        if not glfw.init():
            raise DisplayError(f"no window to be had ({self._complaint}); {REMEDY}")
        self.handle: Any = next(filter(None, (self._create(title, size, version) for version in OPENGL)), None)
        if not self.handle:
            glfw.terminate()
            raise DisplayError(f"no window with OpenGL 3.3 to be had ({self._complaint}): {REMEDY}")
        glfw.make_context_current(self.handle)
        glfw.swap_interval(1)
        self.ctx = self._context()
        self.ctx.gc_mode = "context_gc"  # what nobody refers to any more waits for `sweep`, in the window's thread
        self._reset_status = _reset_status()
        self.io: imgui.IO | None = None
        self.pressed: list[tuple[int, int]] = []
        self.dropped: list[str] = []
        glfw.set_key_callback(self.handle, self._key)
        glfw.set_cursor_pos_callback(self.handle, self._moved)
        glfw.set_mouse_button_callback(self.handle, self._clicked)
        glfw.set_scroll_callback(self.handle, self._scrolled)
        glfw.set_drop_callback(self.handle, self._drop)  # type: ignore[arg-type]  # the stub means C's arguments

    def _create(self, title: str, size: tuple[int, int], version: tuple[int, int]) -> Any:
        hints = {
            glfw.CONTEXT_VERSION_MAJOR: version[0],
            glfw.CONTEXT_VERSION_MINOR: version[1],
            glfw.OPENGL_PROFILE: glfw.OPENGL_CORE_PROFILE,
            glfw.OPENGL_FORWARD_COMPAT: True,
            glfw.CONTEXT_ROBUSTNESS: glfw.LOSE_CONTEXT_ON_RESET,
            glfw.SCALE_TO_MONITOR: True,
        }
        for hint, value in hints.items():
            glfw.window_hint(hint, value)
        return glfw.create_window(*size, title, None, None)

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

    def _drop(self, window: object, paths: list[str]) -> None:
        self.dropped += paths

    @property
    def size(self) -> tuple[int, int]:
        """In the system's screen units, those of the pointer."""
        width, height = glfw.get_window_size(self.handle)
        return width, height

    @property
    def pixels(self) -> tuple[int, int]:
        width, height = glfw.get_framebuffer_size(self.handle)
        return width, height

    @property
    def text_scale(self) -> float:
        """How large the system draws its text, pixels to one of a plain screen."""
        return float(glfw.get_window_content_scale(self.handle)[0])

    @property
    def plain_size(self) -> tuple[int, int]:
        """What to ask for to get a window of this size again: glfw multiplies by the text's scale where units are pixels."""
        (width, height), ratio = self.size, self.pixels[0] / max(self.size[0], 1)
        scale = max(self.text_scale / max(ratio, 1e-6), 1e-6)
        return round(width / scale), round(height / scale)

    def held(self, *keys: int) -> bool:
        return any(glfw.get_key(self.handle, key) == glfw.PRESS for key in keys)

    def check(self) -> None:
        """Raise a ContextLostError if the graphics card has been reset, and all that it held is gone."""
        if self._reset_status() != 0:
            raise ContextLostError("the graphics card was reset; start kpplay anew, or update the graphics driver")

    def sweep(self) -> None:
        """Release what nobody refers to any more. (moderngl's own `gc` stumbles over what was released by hand.)"""
        while self.ctx.objects:
            thing = self.ctx.objects.popleft()
            if not isinstance(thing, moderngl.InvalidObject):
                thing.release()

    def name(self, title: str) -> None:
        glfw.set_window_title(self.handle, title)

    def close(self) -> None:
        if self.handle:
            glfw.destroy_window(self.handle)
            glfw.terminate()
        self.handle = None


def _reset_status() -> Callable[[], int]:
    """OpenGL's own function of the context that is current, where it has one."""
    for name in ("glGetGraphicsResetStatus", "glGetGraphicsResetStatusARB"):
        address = glfw.get_proc_address(name)
        if address:
            status = ctypes.cast(address, ctypes.CFUNCTYPE(ctypes.c_uint))
            return lambda: int(status())
    return lambda: 0


class Player:
    """A scene in a window, from the first frame to the last, while it arrives.

    Args:
        before: a player of the same scene that cannot go on; this one does, where it was.
        folder: where screenshots, videos and camera paths go.
    """

    def __init__(
        self,
        window: Window,
        stream: GroupPlayback,
        preferences: Preferences = Preferences(),
        *,
        before: "Player | None" = None,
        folder: Path = Path(),
    ) -> None:
        self.window, self.stream, self.folder = window, stream, folder
        scene = self.scene
        stream.arrived = glfw.post_empty_event
        self.ctx = window.ctx
        self.device = self.ctx.info["GL_RENDERER"]
        self.quality = quality_controller_for(is_software(self.ctx), preferences.quality, preferences.target_fps)
        self.target_fps = preferences.target_fps or (1 / self.quality.target_s if self.quality.target_s else FILM_FPS)
        if not stream.is_drawn:
            stream.draw_with(self._make_renderer)
        self.imgui = ImGuiRenderer(self.ctx)
        window.io = self.imgui.io
        self.rig, self.presets = Rig.of(scene), presets(scene)
        self.camera_number, self.preset_number = 0, -1
        self.view = View.of(self.rig, self.rig.cameras[0])
        self.playback = Playback(
            stream.clip, playing=stream.clip.duration_s > 0, speed=preferences.speed, loop=preferences.loop
        )
        self.appearance = AppearanceSelection(scene)
        self.part, self.look, self.exact = Part.FULL, DisplayMode.COLOUR, False
        self.path, self.ride_s, self.riding = CameraPath(), 0.0, False
        self._keyed_at: float | None = None
        self.film: Recording | None = None
        self._filming_path, self._filming_since = False, 0.0
        self.show_hud, self.show_keys, self.show_path = preferences.controls, False, False
        self.show_graphs, self.show_planes, self.text_size = (
            preferences.graphs,
            preferences.planes,
            preferences.text_size,
        )
        self.history = np.zeros((2, HISTORY), np.float32)
        """Milliseconds from one frame to the next, and that a picture took; the column of the next is `frames % HISTORY`."""
        self.frames = 0
        self.frame_s = self.draw_s = 0.0
        self.samples, self.most_samples, self.depths = 0.0, 16.0, (0.0, 1.0)
        self.planes = panels.PlaneView(scene)
        self.successor: GroupPlayback | None = None
        self._mishaps = 0
        self.say("H: keys")
        self._measured = -STATS_EVERY_S
        self._before = self._moved = clock.monotonic()
        if before is not None:
            self._go_on_from(before)
        self._resize(window.pixels)
        self._drawn: tuple[object, ...] = ()
        self._is_sharp, self._sharp_rows = False, 0
        self._is_paced, self._aside_s = False, 0.0
        self._band = self.canvas

    @property
    def scene(self) -> Scene:
        """What shows: of a clip in groups, the group."""
        return self.stream.scene

    @property
    def renderer(self) -> Renderer:
        return self.stream.renderer

    def _make_renderer(self, scene: Scene) -> Renderer:
        return Renderer(self.ctx, scene, LEVELS[self.quality.level])

    def _go_on_from(self, before: "Player") -> None:
        self.view, self.playback, self.path, self.part, self.look = (
            before.view, before.playback, before.path, before.part, before.look
        )  # fmt: skip
        self.quality, self.target_fps, self.exact = before.quality, before.target_fps, before.exact
        self.appearance.select(before.appearance.number)
        self.show_hud, self.show_path = before.show_hud, before.show_path
        self.complain("the graphics card was reset; the scene is there again")

    def preferences(self) -> Preferences:
        """What to remember of it."""
        holds = self.quality.target_s is not None
        return Preferences(
            self.window.plain_size, self.quality.chosen_level, self.target_fps if holds else None, self.playback.speed, self.playback.loop,
            self.show_hud, self.show_graphs, self.show_planes, self.text_size,
        )  # fmt: skip

    def run(self, frames: int | None = None) -> None:
        """Until the window is closed, another scene is opened, or for a number of frames once all of the scene is there that is
        to come."""
        shown = 0
        while (
            not glfw.window_should_close(self.window.handle)
            and (frames is None or shown < frames)
            and self.successor is None
        ):
            if (frames is None or not self.stream.is_settled) and self._is_sharp and self.film is None:
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
        self.window.check()
        self._is_paced, self._aside_s = False, 0.0
        if pixels != self.canvas.size:
            self._resize(pixels)
        self._begin(seconds)
        self._point()
        self._fly(min(seconds, 0.1))
        for key, mods in self.window.pressed:
            self.type(key, mods)
        self.window.pressed.clear()
        for file in self.window.dropped:
            self.open(file)
        self.window.dropped.clear()
        try:
            self._advance(seconds)
            self.appearance.advance(seconds)
            self._draw(now)
            self.renderer.check()
        except ContextLostError:
            raise
        except DisplayError as error:
            self._coarser_after(error)
        self._keep_filming(now)
        self.history[:, self.frames % HISTORY] = 1e3 * seconds, 1e3 * self.draw_s
        self.frames += 1
        panels.show(self)
        self._finish()
        if self._is_paced:  # all but waiting for the screen counts, and but for looking at statistics
            self.quality.record(clock.monotonic() - now - self._aside_s)
        glfw.swap_buffers(self.window.handle)
        self.window.sweep()

    def _coarser_after(self, error: DisplayError) -> None:
        """The card has no room, say: tell it, and go on with less, but not for ever."""
        self._mishaps += 1
        if self._mishaps > MOST_MISHAPS:
            raise error
        self.complain(str(error))
        self.quality.choose(neighbouring_level(self.quality.level, -1))

    def _advance(self, seconds: float) -> None:
        """Let the clip, or the camera path, go on, unless what comes next is not there yet."""
        later, ride_s, view = self.playback.after(seconds), self.ride_s, self.view
        if self.is_filming_path and self.film is not None:
            later = replace(later, time=self.path.at(self.path.start_s + self.film.duration_s)[1])
        elif self.riding:
            ride_s += seconds
            if ride_s > self.path.end_s:
                ride_s, self.riding = (self.path.start_s, True) if self.playback.loop else (self.path.end_s, False)
            camera, time = self.path.at(ride_s)
            later, view = replace(later, time=time), View.of(self.rig, camera)
        self.stream.set_playhead(Playhead(later.time, self.playback.rate, self.playback.loop))
        self.stream.upload()
        if self.appearance.scene is not self.scene:
            self.appearance = AppearanceSelection(self.scene, self.appearance.names[self.appearance.number])
        if self.stream.can_show(later.time, self.playback.rate):
            self.playback, self.ride_s, self.view = later, ride_s, view

    # --- files

    def say(self, text: str) -> None:
        """Show a message for a while."""
        self.notice, self.notice_until, self.notice_is_error = text, clock.monotonic() + TOLD_S, False

    def complain(self, text: str) -> None:
        """Show what went wrong for longer."""
        self.notice, self.notice_until, self.notice_is_error = text, clock.monotonic() + COMPLAINED_S, True

    @property
    def stem(self) -> str:
        """What files of this scene begin with: part of its name or address, of characters that every system takes."""
        return re.sub(r"[^\w.+-]", "_", Path(self.stream.source.name).stem)[:80] or "scene"

    def free_name(self, suffix: str) -> Path:
        """The first that is free of scene-001.png, scene-002.png and so on."""
        names = (self.folder / f"{self.stem}-{n:03d}{suffix}" for n in range(1, 1_000_000))
        return next(path for path in names if not path.exists()).absolute()

    @contextlib.contextmanager
    def _told(self, what: object) -> Iterator[None]:
        """What goes wrong with `what` is shown, and the player goes on."""
        try:
            yield
        except KpcError as error:
            self.complain(str(error))
        except OSError as error:
            self.complain(f"{what}: {error.strerror or error}")

    def open(self, file: str) -> None:
        """A camera path, or another scene, which follows this one."""
        with self._told(file):
            if file.lower().endswith(".json"):
                self.path, self.ride_s, self.show_path = CameraPath.load(file), 0.0, True
                self.say(f"{len(self.path.keyframes)} keyframes from {file}; J follows them")
                return
            stream = GroupPlayback(open_source(file, limit=self.stream.memory), memory=self.stream.memory)
            try:
                stream.draw_with(self._make_renderer)
                self.successor = stream
            except BaseException:
                stream.close()
                raise

    def screenshot(self, path: Path) -> None:
        """Save the window, controls and all, at its full resolution."""
        self._begin(1 / 60)
        self._still()
        panels.show(self)
        self.imgui.draw(self.canvas)
        write_image(path, self._pixels())
        self._drawn = ()

    def _save_picture(self) -> None:
        """Write the picture without controls, under the first name that is free."""
        self._still()
        with self._told(self.folder.absolute()):
            path = self.free_name(".png")
            write_image(path, self._pixels())
            self.say(f"saved {path}")

    def save_path(self) -> None:
        """Write the camera path, under the first name that is free."""
        if not self.path.keyframes:
            self.complain("there is no camera path yet; K makes a keyframe")
            return
        with self._told(self.folder.absolute()):
            path = self.free_name("-path.json")
            self.path.save(path)
            self.say(f"saved {path}; kprender --path makes a video of it")

    # --- the camera path, and films

    def scrub(self, time: float) -> None:
        """Pause the clip there."""
        self.playback.playing = self.riding = False
        self.playback.seek(time)

    def ride_to(self, seconds: float) -> None:
        """See what the camera path passes then."""
        camera, time = self.path.at(seconds)
        self.look_from(View.of(self.rig, camera))
        self.scrub(time)
        self.ride_s = seconds

    def look_from(self, view: View) -> None:
        """Go there at once; where a path was followed, that ends."""
        self.view, self.riding = view, False

    def add_keyframe(self) -> None:
        """Here and now. While the clip plays, as long after the one before as it took."""
        now, gap_s = clock.monotonic(), GAP_S
        if self._keyed_at is not None and self.playback.playing:
            gap_s = min(max(now - self._keyed_at, 0.1), LONGEST_GAP_S)
        self._keyed_at = now if self.playback.playing else None
        self.path = self.path.with_keyframe(self.view.camera(*self.canvas.size), self.playback.time, gap_s)
        self.show_path = True
        self.say(f"keyframe {len(self.path.keyframes)}, at {self.path.end_s:.1f} s")

    def remove_keyframe(self, number: int) -> None:
        self.path, self._keyed_at = self.path.without(number), None
        self.riding = self.riding and bool(self.path.keyframes)

    def follow(self) -> None:
        """Follow the camera path from where it was left, or stop."""
        if not self.path.keyframes:
            self.complain("there is no camera path yet; K makes a keyframe")
        elif self.riding:
            self.riding = False
        else:
            self.riding, self.playback.playing = True, False
            if not self.path.start_s <= self.ride_s < self.path.end_s:
                self.ride_s = self.path.start_s

    def start_or_stop_filming(self, along_path: bool) -> None:
        """Begin a video of what the window shows, or of the camera path frame by frame, however long that takes; or end it."""
        if self.film is not None:
            self.film.end()
            return
        if along_path and not self.path.keyframes:
            self.complain("there is no camera path yet; K makes a keyframe")
            return
        with self._told(self.folder.absolute()):
            self.film = Recording(self.free_name(".mp4"), FILM_FPS, self.canvas.size)
            self._filming_path, self._filming_since = along_path, clock.monotonic()
            if along_path:
                self.riding, self.playback.playing, self.ride_s = True, False, self.path.start_s

    @property
    def is_filming_path(self) -> bool:
        return self._filming_path and self.film is not None and not self.film.is_ending

    def _keep_filming(self, now: float) -> None:
        """Hand on what is due of a film, and tell how it ended."""
        film = self.film
        if film is None:
            return
        if film.is_over:
            self.film = None
            if film.failure is None:
                self.say(f"saved {film.path}, {film.duration_s:.1f} s")
            else:
                self.complain(film.failure)
        elif film.is_ending:
            return
        elif film.size != self.canvas.size:
            self.say("the window has another size now: the film ends")
            film.end()
        elif self._filming_path:
            self._film_path(film)
            self.riding = self.riding and not film.is_ending
        else:
            due = frames_due(now - self._filming_since, film.fps, film.taken)
            frame = self._pixels() if due and film.has_room else None
            for _ in range(due):
                if frame is None or not film.take(frame):
                    break

    def _film_path(self, film: Recording) -> None:
        """One more frame, once all is there that it shows."""
        if not self.riding or self.path.start_s + film.duration_s > self.path.end_s + 1e-6:
            film.end()
        elif film.has_room and self.stream.is_settled:
            self.ride_s = self.path.start_s + film.duration_s
            camera, self.playback.time = self.path.at(self.ride_s)
            self.view = View.of(self.rig, camera)
            self._still()
            film.take(self._pixels())

    # --- the picture

    def _resize(self, pixels: tuple[int, int]) -> None:
        """The canvas holds the last picture of the scene, so that the controls can change over it."""
        self._canvas_texture = self.ctx.texture(pixels, 4)
        self.canvas = self.ctx.framebuffer([self._canvas_texture])
        red, green, blue = map(float, self.scene.background)
        self.canvas.clear(red, green, blue)
        self.raster = pixels
        self._drawn = ()

    def _pixels(self) -> np.ndarray:
        """What the canvas holds, uint8 (height, width, 3), top row first."""
        width, height = self.canvas.size
        data = self.canvas.read(components=3, alignment=1)
        return np.frombuffer(data, np.uint8).reshape(height, width, 3)[::-1]

    def _draw(self, now: float) -> None:
        """Draw the scene if anything has changed, finely once nothing does any more."""
        selected = (self.appearance.number, self.appearance.progress)
        dial = self.quality
        wanted = (
            self.view,
            self.playback.time,
            self.part,
            self.look,
            dial.chosen_level,
            self.exact,
            selected,
            self.stream.version_at(self.playback.time),
        )
        if self.stream.complete_scales == 0:
            self._is_sharp = True  # as sharp as nothing can be
        elif self.is_filming_path:
            self._is_sharp = False  # `_film_path` draws
        elif wanted != self._drawn:
            self._drawn, self._moved, self._is_sharp, self._sharp_rows = wanted, now, False, 0
            self._picture(dial.resolution.scale, dial.level)
            self._is_paced = True
            drawn, resting = self.renderer.quality, LEVELS[dial.still_level]
            is_whole = (
                self.raster == self.canvas.size
                and not (drawn.reprojection_tolerance or drawn.interpolation_tolerance)
                and drawn.rays_across == resting.rays_across
            )
            self._is_sharp = is_whole and dial.level == dial.still_level
        elif not self._is_sharp and now - self._moved > SHARPEN_AFTER_S:
            self._sharpen()

    def _still(self) -> None:
        """Draw the scene on the canvas as finely as a picture that stands still, at once."""
        self._picture(1.0, self.quality.still_level, still=True)

    def _picture(self, scale: float, rung: str, still: bool = False) -> None:
        """Draw the scene on the canvas, at a share of its resolution."""
        self._set_quality(rung, still)
        if clock.monotonic() - self._measured > STATS_EVERY_S:
            self._measure()
        width, height = (max(1, round(side * scale)) for side in self.canvas.size)
        self.raster = (width, height)
        self._show(
            self.canvas, self.view.camera(*self.canvas.size).resized(width, height)
        )  # the same view, however sides are rounded

    def _sharpen(self) -> None:
        """Draw the next rows of the picture as finely as it is to be, from above, so many as do not keep the controls waiting."""
        self._set_quality(self.quality.still_level, still=True)
        width, height = self.canvas.size
        if self._sharp_rows == 0:
            whole_s = self.draw_s * width * height / (self.raster[0] * self.raster[1])
            bands = math.ceil(whole_s / BAND_S) if self.renderer.quality.resolution == 1.0 else 1
            rows = -(-height // bands)
            if self._band.size != (width, rows):
                self._band = self.ctx.simple_framebuffer((width, rows))
        rows = self._band.height
        top = min(self._sharp_rows, height - rows)  # the last may overlap the one before
        camera = self.view.camera(width, height)
        self._show(self._band, replace(camera, height=rows, cy=camera.cy - top))
        pixels = self._band.read(components=4, alignment=1)
        self._canvas_texture.write(pixels, viewport=(0, height - top - rows, width, rows), alignment=1)
        self._sharp_rows = top + rows
        if self._sharp_rows == height:
            self._is_sharp, self.raster = True, (width, height)

    def _set_quality(self, rung: str, still: bool) -> None:
        """That of a rung, but for what is set by hand; a picture that stands still is marched pixel by pixel. A processor sends several
        rays through a pixel of that alone: before, more pixels tell more."""
        quality = LEVELS[rung]
        if still:
            quality = replace(quality, reprojection_tolerance=0.0, interpolation_tolerance=0.0)
        elif is_software(self.ctx):
            quality = replace(quality, rays_across=1)
        self.renderer.quality = replace(quality, folded=quality.folded and not self.exact)

    def _show(self, target: moderngl.Framebuffer, camera: Camera) -> None:
        started = clock.monotonic()
        parts = [(self.renderer, self.stream.time_in(self.playback.time), 1.0, self.appearance.code)]
        if (beside := self.stream.beside(self.playback.time)) is not None:
            selected = self.appearance.names[self.appearance.number]
            parts.append((*beside, AppearanceSelection(beside[0].scene, selected).code))
        for renderer, time, share, code in parts:
            renderer.quality = self.renderer.quality
            renderer.show(
                target,
                camera,
                time,
                part=self.part,
                mode=self.look,
                depths=self.depths,
                most_samples=self.most_samples,
                appearance=code,
                opacity=share,
            )
        self.ctx.finish()
        self.draw_s = clock.monotonic() - started

    def _measure(self) -> None:
        """Samples a ray, and how far things are, from a very small picture."""
        started = clock.monotonic()
        small = self.renderer.render(
            self.view.camera(*STATS_SIZE),
            self.stream.time_in(self.playback.time),
            part=Part.STATIC if self.part is Part.STATIC else Part.FULL,
        )
        self.samples = float(small.samples.mean())
        self.most_samples = max(2.0 * float(np.percentile(small.samples, 95)), 8.0)
        seen = small.depth[small.opacity > 0.5]
        if seen.size:
            near, far = np.percentile(seen, (2, 98))
            self.depths = (0.9 * float(near), 1.1 * float(far))
        self._measured = clock.monotonic()
        self._aside_s += self._measured - started

    def _begin(self, seconds: float) -> None:
        self.imgui.begin(self.window.size, self.canvas.size, self.text_size * self.window.text_scale, seconds)

    def _finish(self) -> None:
        """The canvas, and the controls over it, on the screen."""
        self.ctx.copy_framebuffer(self.ctx.screen, self.canvas)
        self.imgui.draw(self.ctx.screen)

    # --- events

    def _point(self) -> None:
        """Drags and the wheel, where no control takes them."""
        io = self.imgui.io
        if io.want_capture_mouse:
            return
        width, height = self.window.size
        across, down = io.mouse_delta.x / max(height, 1), io.mouse_delta.y / max(height, 1)
        shift = self.window.held(glfw.KEY_LEFT_SHIFT, glfw.KEY_RIGHT_SHIFT)
        moving = shift or imgui.is_mouse_down(1) or imgui.is_mouse_down(2)
        if (across or down) and moving and any(imgui.is_mouse_down(button) for button in range(3)):
            self.look_from(self.view.pan(across, -down))
        elif (across or down) and imgui.is_mouse_down(0):
            self.look_from(self.view.orbit(np.pi * across, -np.pi * down))
        if io.mouse_wheel:
            self.look_from(self.view.zoom(io.mouse_wheel))

    def _fly(self, seconds: float) -> None:
        held = self.window.held
        if held(glfw.KEY_LEFT_CONTROL, glfw.KEY_RIGHT_CONTROL):
            return  # Ctrl S saves
        right, up, forward = (
            held(plus) - held(minus)
            for plus, minus in ((glfw.KEY_D, glfw.KEY_A), (glfw.KEY_E, glfw.KEY_Q), (glfw.KEY_W, glfw.KEY_S))
        )
        if right or up or forward:
            hurry = 4 if held(glfw.KEY_LEFT_SHIFT, glfw.KEY_RIGHT_SHIFT) else 1
            way = hurry * seconds * self.scene.extent / CROSSING_S
            self.look_from(self.view.fly(way * right, way * up, way * forward))

    def type(self, key: int, mods: int) -> None:
        """What a key does."""
        playback, ctrl, shift = self.playback, bool(mods & glfw.MOD_CONTROL), bool(mods & glfw.MOD_SHIFT)
        if ctrl:
            if key == glfw.KEY_S:
                self.save_path()
            elif key in (glfw.KEY_MINUS, glfw.KEY_EQUAL):
                factor = 1.1 if key == glfw.KEY_EQUAL else 1 / 1.1
                self.text_size = min(max(self.text_size * factor, TEXT_SIZES[0]), TEXT_SIZES[1])
        elif key == glfw.KEY_SPACE:
            if self.riding:
                self.riding = False
            else:
                playback.toggle()
        elif key in (glfw.KEY_LEFT, glfw.KEY_RIGHT):
            playback.step(1 if key == glfw.KEY_RIGHT else -1)
            self.riding = False
        elif key in (glfw.KEY_HOME, glfw.KEY_END):
            playback.seek(0.0 if key == glfw.KEY_HOME else 1.0)
            self.riding = False
        elif key in (glfw.KEY_LEFT_BRACKET, glfw.KEY_RIGHT_BRACKET):
            playback.faster(1 if key == glfw.KEY_RIGHT_BRACKET else -1)
        elif key == glfw.KEY_L:
            playback.loop = not playback.loop
        elif key in (glfw.KEY_R, glfw.KEY_N):
            self.to_camera((self.camera_number + 1) % len(self.rig.cameras) if key == glfw.KEY_N else 0)
        elif key == glfw.KEY_B:
            self.to_preset((self.preset_number + 1) % len(self.presets))
        elif key == glfw.KEY_V:
            self.appearance.next()
        elif glfw.KEY_1 <= key < glfw.KEY_1 + len(DISPLAY_MODE_NAMES):
            self.look = list(DISPLAY_MODE_NAMES)[key - glfw.KEY_1]
        elif key == glfw.KEY_C and self.scene.is_dynamic:
            parts = list(PART_NAMES)
            self.part = parts[(parts.index(self.part) + 1) % len(parts)]
        elif key in (glfw.KEY_MINUS, glfw.KEY_EQUAL):
            self.quality.choose(neighbouring_level(self.quality.level, 1 if key == glfw.KEY_EQUAL else -1))
            self.say(
                f"quality: {self.quality.level}, {LEVEL_NAMES.index(self.quality.level) + 1} of {len(LEVEL_NAMES)}"
            )
        elif key == glfw.KEY_U:
            self.quality.hold(self.target_fps if self.quality.target_s is None else None)
        elif key == glfw.KEY_F and self.scene.is_dynamic:
            self.exact = not self.exact
        elif key == glfw.KEY_K:
            self.add_keyframe()
        elif key == glfw.KEY_BACKSPACE and self.path.keyframes:
            self.remove_keyframe(len(self.path.keyframes) - 1)
        elif key == glfw.KEY_J:
            self.follow()
        elif key == glfw.KEY_O:
            self.start_or_stop_filming(along_path=shift)
        elif key == glfw.KEY_T and self.scene.is_dynamic:
            self.show_planes = not self.show_planes
        elif key == glfw.KEY_G:
            self.show_graphs = not self.show_graphs
        elif key == glfw.KEY_TAB:
            self.show_hud = not self.show_hud
        elif key == glfw.KEY_H:
            self.show_keys = not self.show_keys
        elif key == glfw.KEY_P:
            self._save_picture()
        elif key == glfw.KEY_ESCAPE:
            glfw.set_window_should_close(self.window.handle, True)

    def to_camera(self, number: int) -> None:
        """Jump to a camera of the scene."""
        self.camera_number = number
        self.look_from(View.of(self.rig, self.rig.cameras[number]))

    def to_preset(self, number: int) -> None:
        """Jump to one of the places to look from."""
        self.preset_number = number
        name, camera = list(self.presets.items())[number]
        self.look_from(View.of(self.rig, camera))
        self.say(name)

    def close(self) -> str | None:
        """Finish a film that is being written, let go of all; what is to be said of the film."""
        told = None
        if self.film is not None:
            self.film.close(FINISHING_S)
            told = self.film.failure or f"saved {self.film.path}, {self.film.duration_s:.1f} s"
        self.window.io = None
        self.imgui.close()
        return told
