"""Keys, pointer and dropped files. The table of keys is data: the list on the screen and README.md are made from it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from kpc.player.app.actions import Actions
from kpc.player.app.desktop import glfw, imgui
from kpc.player.app.state import PlayerState
from kpc.player.app.window import Window

# Seconds in which the flying camera crosses the longest edge of the scene's bounding box, and how much faster it is
# with Shift.
CROSSING_S, SHIFT_FACTOR = 4.0, 4.0
# The camera flies no farther than in so many seconds at once, however long a frame took.
MAX_FLY_S = 0.1

NONE, SHIFT, CTRL = 0, glfw.MOD_SHIFT, glfw.MOD_CONTROL


@dataclass(frozen=True)
class KeyBinding:
    """A line of the list of keys.

    Attributes:
        keys: as the user reads them.
        help: what they do.
        actions: by (glfw key, modifier) what to call; empty for what `Input` handles while it is held.
    """

    keys: str
    help: str
    actions: Mapping[tuple[int, int], Callable[[Actions], None]] = field(default_factory=dict)


KEY_BINDINGS = (
    KeyBinding("Drag", "orbit around the scene"),
    KeyBinding("Right drag, Shift+drag", "pan"),
    KeyBinding("Wheel", "zoom"),
    KeyBinding("W A S D, Q E", "fly; four times as fast with Shift"),
    KeyBinding("Space", "play or pause", {(glfw.KEY_SPACE, NONE): Actions.play_or_pause}),
    KeyBinding(
        "Left, Right",
        "one frame back or forward",
        {(glfw.KEY_LEFT, NONE): lambda do: do.step(-1), (glfw.KEY_RIGHT, NONE): lambda do: do.step(1)},
    ),
    KeyBinding(
        "Home, End",
        "go to the start or the end",
        {(glfw.KEY_HOME, NONE): lambda do: do.seek(0.0), (glfw.KEY_END, NONE): lambda do: do.seek(1.0)},
    ),
    KeyBinding(
        "[  ]",
        "play slower or faster",
        {
            (glfw.KEY_LEFT_BRACKET, NONE): lambda do: do.change_speed(-1),
            (glfw.KEY_RIGHT_BRACKET, NONE): lambda do: do.change_speed(1),
        },
    ),
    KeyBinding("L", "loop on or off", {(glfw.KEY_L, NONE): Actions.toggle_loop}),
    KeyBinding("R", "back to the first camera", {(glfw.KEY_R, NONE): lambda do: do.to_camera(0)}),
    KeyBinding("N", "next camera of the scene", {(glfw.KEY_N, NONE): Actions.next_camera}),
    KeyBinding("B", "next viewpoint", {(glfw.KEY_B, NONE): Actions.next_preset}),
    KeyBinding("V", "next appearance, if the scene has several", {(glfw.KEY_V, NONE): Actions.next_appearance}),
    KeyBinding(
        "1 2 3 4",
        "show colour, depth, samples per ray, occupancy",
        {
            (glfw.KEY_1, NONE): lambda do: do.show_mode(0),
            (glfw.KEY_2, NONE): lambda do: do.show_mode(1),
            (glfw.KEY_3, NONE): lambda do: do.show_mode(2),
            (glfw.KEY_4, NONE): lambda do: do.show_mode(3),
        },
    ),
    KeyBinding("C", "show everything, the static part, the dynamic part", {(glfw.KEY_C, NONE): Actions.next_part}),
    KeyBinding(
        "-  =",
        "lower or higher quality",
        {
            (glfw.KEY_MINUS, NONE): lambda do: do.change_quality(-1),
            (glfw.KEY_EQUAL, NONE): lambda do: do.change_quality(1),
        },
    ),
    KeyBinding("U", "hold the frame rate or the quality", {(glfw.KEY_U, NONE): Actions.toggle_target_rate}),
    KeyBinding("F", "exact or fast drawing of what moves", {(glfw.KEY_F, NONE): Actions.toggle_exact}),
    KeyBinding("K", "add a keyframe to the camera path", {(glfw.KEY_K, NONE): Actions.add_keyframe}),
    KeyBinding("Backspace", "remove the last keyframe", {(glfw.KEY_BACKSPACE, NONE): Actions.remove_last_keyframe}),
    KeyBinding("J", "follow the camera path, or stop", {(glfw.KEY_J, NONE): Actions.follow_or_stop}),
    KeyBinding("Ctrl+S", "save the camera path", {(glfw.KEY_S, CTRL): Actions.save_path}),
    KeyBinding("P", "save a screenshot", {(glfw.KEY_P, NONE): Actions.save_picture}),
    KeyBinding(
        "O",
        "record the window, or stop",
        {(glfw.KEY_O, NONE): lambda do: do.start_or_stop_filming(along_path=False)},
    ),
    KeyBinding(
        "Shift+O",
        "record the camera path, or stop",
        {(glfw.KEY_O, SHIFT): lambda do: do.start_or_stop_filming(along_path=True)},
    ),
    KeyBinding("T", "show the time planes", {(glfw.KEY_T, NONE): lambda do: do.toggle_panel("planes")}),
    KeyBinding("G", "show the frame times", {(glfw.KEY_G, NONE): lambda do: do.toggle_panel("graphs")}),
    KeyBinding(
        "Ctrl+-, Ctrl+=",
        "smaller or larger text",
        {
            (glfw.KEY_MINUS, CTRL): lambda do: do.change_text_size(-1),
            (glfw.KEY_EQUAL, CTRL): lambda do: do.change_text_size(1),
        },
    ),
    KeyBinding("Tab", "show or hide the controls", {(glfw.KEY_TAB, NONE): lambda do: do.toggle_panel("controls")}),
    KeyBinding("H", "show this list", {(glfw.KEY_H, NONE): lambda do: do.toggle_panel("keys")}),
    KeyBinding("Esc", "quit", {(glfw.KEY_ESCAPE, NONE): Actions.quit}),
)
_ACTIONS = {shortcut: action for binding in KEY_BINDINGS for shortcut, action in binding.actions.items()}


def press(actions: Actions, key: int, modifiers: int = NONE) -> None:
    """Do what a key is bound to. With Ctrl only shortcuts with Ctrl count; Shift is ignored where it changes nothing.

    Args:
        actions: what can be done.
        key, modifiers: as in a glfw key event.
    """
    wanted = (CTRL,) if modifiers & CTRL else (SHIFT, NONE) if modifiers & SHIFT else (NONE,)
    for modifier in wanted:
        if (action := _ACTIONS.get((key, modifier))) is not None:
            action(actions)
            return


class Input:
    """Turns the events of a window into changes of a player's state."""

    def __init__(self, window: Window, state: PlayerState, actions: Actions) -> None:
        self.window, self.state, self.actions = window, state, actions

    def update(self, seconds: float) -> None:
        """Handle all events since the last call, within an ImGui frame.

        Args:
            seconds: since the last call.
        """
        self._move_pointer()
        self._fly(min(seconds, MAX_FLY_S))
        for key, modifiers in self.window.take_keys():
            press(self.actions, key, modifiers)
        for file in self.window.take_dropped_files():
            self.actions.open(file)

    def _move_pointer(self) -> None:
        """Orbit, pan and zoom where no panel takes the pointer.

        Dragging over the height of the window orbits by half a turn.
        """
        io, state = imgui.get_io(), self.state
        if io.want_capture_mouse:
            return
        height = max(self.window.size[1], 1)
        right, down = io.mouse_delta.x / height, io.mouse_delta.y / height
        shift = self.window.is_held(glfw.KEY_LEFT_SHIFT, glfw.KEY_RIGHT_SHIFT)
        pans = shift or imgui.is_mouse_down(1) or imgui.is_mouse_down(2)
        if (right or down) and pans and any(imgui.is_mouse_down(button) for button in range(3)):
            state.look_from(state.view.pan(right, -down))
        elif (right or down) and imgui.is_mouse_down(0):
            state.look_from(state.view.orbit(np.pi * right, -np.pi * down))
        if io.mouse_wheel:
            state.look_from(state.view.zoom(io.mouse_wheel))

    def _fly(self, seconds: float) -> None:
        """Move the camera while W, A, S, D, Q or E are held."""
        is_held = self.window.is_held
        if is_held(glfw.KEY_LEFT_CONTROL, glfw.KEY_RIGHT_CONTROL):
            return  # Ctrl+S saves
        right, up, forward = (
            is_held(plus) - is_held(minus)
            for plus, minus in ((glfw.KEY_D, glfw.KEY_A), (glfw.KEY_E, glfw.KEY_Q), (glfw.KEY_W, glfw.KEY_S))
        )
        if right or up or forward:
            factor = SHIFT_FACTOR if is_held(glfw.KEY_LEFT_SHIFT, glfw.KEY_RIGHT_SHIFT) else 1.0
            distance = factor * seconds * self.state.scene.extent / CROSSING_S
            self.state.look_from(self.state.view.fly(distance * right, distance * up, distance * forward))
