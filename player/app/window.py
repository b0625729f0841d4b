"""A window with an OpenGL context, and its events."""

import ctypes
from collections.abc import Callable
from typing import Any

import moderngl

from kpc.format.common.errors import ContextLostError, DisplayError
from kpc.format.common.text import escaped, valid_unicode
from kpc.player.app.desktop import glfw, imgui
from kpc.player.app.keyboard import KeyPress, key_name

# What error messages recommend where no window can be opened.
REMEDY = "render pictures or a video with kprender instead"
# OpenGL versions to ask for, in this order; macOS offers 4.1 when it is asked for 3.3.
OPENGL_VERSIONS = ((4, 3), (3, 3))


class Window:
    """A glfw window with an OpenGL 4.3 or 3.3 core context. Events are kept until they are asked for.

    Args:
        title: of the window.
        size: (width, height) in screen units; reduced to what the screen has room for.

    Attributes:
        handle: glfw's.
        ctx: the OpenGL context.
        io: where ImGui takes pointer events; None while there is no ImGui context.
        is_stirred: whether something has happened to the window; who has shown it resets it.

    Raises:
        DisplayError: there is no display, or no OpenGL 3.3.
    """

    def __init__(self, title: str, size: tuple[int, int]) -> None:
        self._last_error = "no reason given"
        glfw.set_error_callback(self._keep_error)
        if not glfw.init():
            raise DisplayError(f"cannot open a window ({self._last_error}); {REMEDY}")
        self.handle: Any = next(filter(None, (self._create(title, size, version) for version in OPENGL_VERSIONS)), None)
        if not self.handle:
            glfw.terminate()
            raise DisplayError(f"cannot open a window with OpenGL 3.3 ({self._last_error}); {REMEDY}")
        self._fit_screen()
        glfw.make_context_current(self.handle)
        glfw.swap_interval(1)
        self.ctx = self._make_context()
        self.ctx.gc_mode = (
            "context_gc"  # objects that are no longer referenced wait for `release_unused` in this thread
        )
        self._reset_status = reset_status_query()
        self.io: imgui.IO | None = None
        self.is_stirred = True
        self._keys: list[KeyPress] = []
        self._modifiers = 0
        self._dropped: list[str] = []
        glfw.set_key_callback(self.handle, self._key_event)
        glfw.set_char_callback(self.handle, lambda window, code: self.type_character(chr(code), self._modifiers))
        glfw.set_cursor_pos_callback(self.handle, lambda window, x, y: self.move_pointer(x, y))
        glfw.set_mouse_button_callback(
            self.handle, lambda window, button, action, mods: self.press_button(button, action == glfw.PRESS)
        )
        glfw.set_scroll_callback(self.handle, lambda window, x, y: self.scroll(x, y))
        glfw.set_drop_callback(self.handle, self._drop_event)  # type: ignore[arg-type]  # the stub means C's arguments
        for set_callback in (
            glfw.set_window_refresh_callback,
            glfw.set_window_close_callback,
            glfw.set_framebuffer_size_callback,
            glfw.set_window_content_scale_callback,
            glfw.set_window_iconify_callback,
        ):
            set_callback(self.handle, self._stir)

    # --- events, as the system sends them or as a test does

    def press_key(self, key: int, modifiers: int = 0, scancode: int = 0) -> None:
        """Keep a key for `take_keys`."""
        self._stir()
        self._keys.append(KeyPress(key, key_name(key, scancode), modifiers))
        self._modifiers = modifiers

    def type_character(self, character: str, modifiers: int = 0) -> None:
        """Keep a character for `take_keys`. glfw reports it after the key that types it."""
        self._stir()
        self._keys.append(KeyPress(None, character, modifiers))

    def move_pointer(self, x: float, y: float) -> None:
        """Move the pointer to a position in screen units."""
        self._stir()
        if self.io:
            self.io.add_mouse_pos_event(x, y)

    def press_button(self, button: int, is_down: bool) -> None:
        """Press or release a button of the mouse: 0 left, 1 right, 2 middle."""
        self._stir()
        if self.io and button < 3:
            self.io.add_mouse_button_event(button, is_down)

    def scroll(self, x: float, y: float) -> None:
        """Turn the wheel by so many notches."""
        self._stir()
        if self.io:
            self.io.add_mouse_wheel_event(x, y)

    def drop(self, paths: list[str]) -> None:
        """Keep files for `take_dropped_files`."""
        self._stir()
        self._dropped += paths

    def wake(self) -> None:
        """Have the window shown again; any thread may call it."""
        self._stir()
        glfw.post_empty_event()

    def take_keys(self) -> list[KeyPress]:
        """Return all keys pressed and characters typed since the last call."""
        keys, self._keys = self._keys, []
        return keys

    def take_dropped_files(self) -> list[str]:
        """Return all files dropped on the window since the last call."""
        dropped, self._dropped = self._dropped, []
        return dropped

    def is_held(self, *keys: int) -> bool:
        """Return whether any of these keys is down."""
        return any(glfw.get_key(self.handle, key) == glfw.PRESS for key in keys)

    # --- the window

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in screen units, those of the pointer."""
        width, height = glfw.get_window_size(self.handle)
        return width, height

    @property
    def pixels(self) -> tuple[int, int]:
        """(width, height) of the framebuffer."""
        width, height = glfw.get_framebuffer_size(self.handle)
        return width, height

    @property
    def text_scale(self) -> float:
        """The system's text size, in pixels per pixel of a screen of ordinary density."""
        return float(glfw.get_window_content_scale(self.handle)[0])

    @property
    def unscaled_size(self) -> tuple[int, int]:
        """The size to ask for to get a window of this size again.

        Where screen units are pixels, glfw multiplies the size that is asked for by `text_scale`.
        """
        (width, height), ratio = self.size, self.pixels[0] / max(self.size[0], 1)
        scale = max(self.text_scale / max(ratio, 1e-6), 1e-6)
        return round(width / scale), round(height / scale)

    @property
    def is_iconified(self) -> bool:
        """Whether the window is minimised."""
        return bool(glfw.get_window_attrib(self.handle, glfw.ICONIFIED))

    @property
    def should_close(self) -> bool:
        """Whether the user has closed the window."""
        return bool(glfw.window_should_close(self.handle))

    def keep_open(self) -> None:
        """Take back that the user has closed the window."""
        glfw.set_window_should_close(self.handle, False)

    def set_title(self, title: str) -> None:
        """Change the title."""
        glfw.set_window_title(self.handle, escaped(valid_unicode(title)))

    def check(self) -> None:
        """Raise a ContextLostError if the graphics card was reset, which loses everything on it."""
        if self._reset_status() != 0:
            raise ContextLostError("the graphics card was reset; restart kpplay, or update the graphics driver")

    def release_unused(self) -> None:
        """Release OpenGL objects that are no longer referenced.

        moderngl's own `gc` fails on objects that were released explicitly.
        """
        while self.ctx.objects:
            unused = self.ctx.objects.popleft()
            if not isinstance(unused, moderngl.InvalidObject):
                unused.release()

    def close(self) -> None:
        """Close the window; a second call does nothing."""
        if self.handle:
            glfw.destroy_window(self.handle)
            glfw.terminate()
        self.handle = None

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
        return glfw.create_window(*size, valid_unicode(title), None, None)

    def _fit_screen(self) -> None:
        """Reduce the window to the part of the screen that the desktop leaves free."""
        monitor = glfw.get_primary_monitor()
        if monitor:
            _, _, *room = glfw.get_monitor_workarea(monitor)
            width, height = (min(side, most) if most > 0 else side for side, most in zip(self.size, room, strict=True))
            if (width, height) != self.size:
                glfw.set_window_size(self.handle, width, height)

    def _make_context(self) -> moderngl.Context:
        failures = []
        # glfw uses GLX with an X server, and EGL with Wayland
        backends: tuple[dict[str, Any], ...] = ({}, {"backend": "egl"})
        for backend in backends:
            try:
                return moderngl.create_context(require=330, **backend)
            except Exception as error:  # glcontext raises bare Exception, ImportError or ValueError, whatever failed
                failures.append(str(error))
        glfw.terminate()
        reasons = "; ".join(failures)
        raise DisplayError(f"no OpenGL 3.3 in the window ({reasons}); update the graphics driver, or {REMEDY}")

    def _stir(self, *_: object) -> None:
        self.is_stirred = True

    def _keep_error(self, code: int, message: bytes | str) -> None:
        self._last_error = message.decode(errors="replace") if isinstance(message, bytes) else message

    def _drop_event(self, window: object, paths: list[str]) -> None:
        self.drop(paths)

    def _key_event(self, window: object, key: int, scancode: int, action: int, modifiers: int) -> None:
        if action in (glfw.PRESS, glfw.REPEAT):
            self.press_key(key, modifiers, scancode)


def reset_status_query() -> Callable[[], int]:
    """Return OpenGL's function for the reset status of the current context; one that returns 0 where there is none."""
    for name in ("glGetGraphicsResetStatus", "glGetGraphicsResetStatusARB"):
        address = glfw.get_proc_address(name)
        if address:
            status = ctypes.cast(address, ctypes.CFUNCTYPE(ctypes.c_uint))
            return lambda: int(status())
    return lambda: 0
