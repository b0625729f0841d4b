"""Keys, pointer and dropped files. The list on the screen and docs/playing.md are made from the table of keys."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from kpc.player.app.actions import Actions
from kpc.player.app.desktop import glfw, imgui
from kpc.player.app.keyboard import KeyPress, flying_keys, label, nearest_at_hand
from kpc.player.app.state import PlayerState
from kpc.player.app.window import Window

# Seconds in which the flying camera crosses the longest edge of the scene's bounding box, and how much faster it is
# with Shift.
CROSSING_S, SHIFT_FACTOR = 4.0, 4.0
# Buttons of the mouse that move the camera.
BUTTONS = imgui.MouseButton.LEFT, imgui.MouseButton.RIGHT, imgui.MouseButton.MIDDLE
# The camera flies no farther than in so many seconds at once, however long a frame took.
MAX_FLY_S = 0.1


@dataclass(frozen=True)
class KeyBinding:
    """A line of the list of keys.

    Attributes:
        keys: as the user reads them on a US keyboard.
        help: what they do.
        actions: by shortcut what to call; empty for what `Input` handles while it is held. A shortcut is a character or
            a name of `keyboard.KEY_NAMES`, with "Ctrl+" or "Shift+" before it.
        elsewhere: other keys for the same, which some keyboards have without Shift and AltGr where they lack `keys`.
    """

    keys: str
    help: str
    actions: Mapping[str, Callable[[Actions], None]] = field(default_factory=dict)
    elsewhere: tuple[str, ...] = ()

    def keys_here(self) -> str:
        """Return the keys as the user reads them on this keyboard."""
        if self.keys == FLYING:
            left, right, down, up, backward, forward = (label(key) for key in flying_keys(_ACTIONS))
            return f"{forward} {left} {backward} {right}, {down} {up}"
        return nearest_at_hand((self.keys, *self.elsewhere))


def _slower(do: Actions) -> None:
    do.change_speed(-1)


def _faster(do: Actions) -> None:
    do.change_speed(1)


def _quieter(do: Actions) -> None:
    do.change_volume(-1)


def _coarser(do: Actions) -> None:
    do.change_quality(-1)


def _finer(do: Actions) -> None:
    do.change_quality(1)


def _smaller_text(do: Actions) -> None:
    do.change_text_size(-1)


def _larger_text(do: Actions) -> None:
    do.change_text_size(1)


FLYING = "W A S D, Q E"
KEY_BINDINGS = (
    KeyBinding("Drag", "orbit around the scene"),
    KeyBinding("Right drag, Shift+drag", "pan"),
    KeyBinding("Wheel", "zoom"),
    KeyBinding(FLYING, "fly; four times as fast with Shift"),
    KeyBinding("Space", "play or pause", {"Space": Actions.play_or_pause}),
    KeyBinding(
        "Left, Right", "one frame back or forward", {"Left": lambda do: do.step(-1), "Right": lambda do: do.step(1)}
    ),
    KeyBinding(
        "Home, End", "go to the start or the end", {"Home": lambda do: do.seek(0.0), "End": lambda do: do.seek(1.0)}
    ),
    KeyBinding(
        "[  ]",
        "play slower or faster",
        {"[": _slower, "]": _faster, ",": _slower, ".": _faster},
        elsewhere=(",  .",),
    ),
    KeyBinding("L", "loop on or off", {"l": Actions.toggle_loop}),
    KeyBinding("Up, Down", "louder or quieter", {"Up": lambda do: do.change_volume(1), "Down": _quieter}),
    KeyBinding("M", "sound off or on", {"m": Actions.toggle_mute}),
    KeyBinding("R", "back to the view that the file opens with", {"r": Actions.to_opening}),
    KeyBinding("N", "next camera of the scene", {"n": Actions.next_camera}),
    KeyBinding("B", "next viewpoint", {"b": Actions.next_preset}),
    KeyBinding("X", "leave or keep the limits from where the scene holds", {"x": Actions.toggle_limits}),
    KeyBinding("V", "next appearance, if the scene has several", {"v": Actions.next_appearance}),
    KeyBinding(
        "1 2 3 4",
        "show colour, depth, samples per ray, occupancy",
        {
            "1": lambda do: do.show_mode(0),
            "2": lambda do: do.show_mode(1),
            "3": lambda do: do.show_mode(2),
            "4": lambda do: do.show_mode(3),
        },
    ),
    KeyBinding("C", "show everything, the static part, the dynamic part", {"c": Actions.next_part}),
    KeyBinding("-  =", "lower or higher quality", {"-": _coarser, "=": _finer, "+": _finer}, elsewhere=("-  +",)),
    KeyBinding("U", "keep the frame rate, or keep the quality", {"u": Actions.toggle_target_rate}),
    KeyBinding("F", "draw what moves exactly and slower, or faster", {"f": Actions.toggle_exact}),
    KeyBinding("K", "add a keyframe to the camera path", {"k": Actions.add_keyframe}),
    KeyBinding("Backspace", "remove the last keyframe", {"Backspace": Actions.remove_last_keyframe}),
    KeyBinding("J", "follow the camera path, or stop", {"j": Actions.follow_or_stop}),
    KeyBinding("Ctrl+S", "save the camera path", {"Ctrl+s": Actions.save_path}),
    KeyBinding("Ctrl+O", "open a scene or a camera path", {"Ctrl+o": Actions.choose_file}),
    KeyBinding(
        "PageUp, PageDown",
        "previous or next file of the playlist",
        {"PageUp": lambda do: do.next_file(-1), "PageDown": lambda do: do.next_file(1)},
    ),
    KeyBinding("P", "save a screenshot", {"p": Actions.save_picture}),
    KeyBinding("O", "record the window, or stop", {"o": lambda do: do.start_or_stop_filming(along_path=False)}),
    KeyBinding(
        "Shift+O", "record the camera path, or stop", {"Shift+o": lambda do: do.start_or_stop_filming(along_path=True)}
    ),
    KeyBinding("T", "show the time planes", {"t": lambda do: do.toggle_panel("planes")}),
    KeyBinding("G", "show the frame times", {"g": lambda do: do.toggle_panel("graphs")}),
    KeyBinding(
        "Ctrl+-  Ctrl+=",
        "smaller or larger text",
        {"Ctrl+-": _smaller_text, "Ctrl+=": _larger_text, "Ctrl++": _larger_text},
        elsewhere=("Ctrl+-  Ctrl++",),
    ),
    KeyBinding("Tab", "show or hide the controls", {"Tab": lambda do: do.toggle_panel("controls")}),
    KeyBinding("H", "show this list", {"h": lambda do: do.toggle_panel("keys")}),
    KeyBinding("Esc", "close an open list, or quit", {"Esc": Actions.quit}),
)
_ACTIONS = {shortcut: action for binding in KEY_BINDINGS for shortcut, action in binding.actions.items()}


def press(actions: Actions, pressed: KeyPress) -> None:
    """Do what a key or a character is bound to. With Ctrl only shortcuts with Ctrl count; Shift is ignored where it
    changes nothing. Without Ctrl, a key whose character is bound acts through that character, which follows it."""
    if pressed.key is not None and pressed.character in _ACTIONS and not pressed.modifiers & glfw.MOD_CONTROL:
        return
    for shortcut in pressed.shortcuts():
        if (action := _ACTIONS.get(shortcut)) is not None:
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
        for pressed in self.window.take_keys():
            press(self.actions, pressed)
        self.actions.drop(self.window.take_dropped_files())
        if (chosen := self.actions.dialog.take_chosen()) is not None:
            self.actions.open(chosen)
        self.actions.load_waiting_path()

    def _move_pointer(self) -> None:
        """Orbit, pan and zoom where no panel takes the pointer.

        Dragging over the height of the window orbits by half a turn.
        """
        io, state = imgui.get_io(), self.state
        if io.want_capture_mouse:
            return
        height = max(self.window.size[1], 1)
        right, down = (side / height for side in io.mouse_delta)
        shift = self.window.is_held(glfw.KEY_LEFT_SHIFT, glfw.KEY_RIGHT_SHIFT)
        # In the frame of the press, the motion is that before it.
        held = [imgui.is_mouse_down(button) and not imgui.is_mouse_clicked(button) for button in BUTTONS]
        if (right or down) and (held[1] or held[2] or (shift and held[0])):
            state.move_to(state.view.pan(right, -down))
        elif (right or down) and held[0]:
            state.move_to(state.view.orbit(np.pi * right, -np.pi * down))
        if io.mouse_wheel:
            state.move_to(state.view.zoom(io.mouse_wheel))

    def _fly(self, seconds: float) -> None:
        """Move the camera while one of `keyboard.flying_keys` is held."""
        is_held = self.window.is_held
        if is_held(glfw.KEY_LEFT_CONTROL, glfw.KEY_RIGHT_CONTROL):
            return  # Ctrl+S saves
        held = [is_held(key) for key in flying_keys(_ACTIONS)]
        right, up, forward = (plus - minus for minus, plus in zip(held[::2], held[1::2], strict=True))
        if right or up or forward:
            factor = SHIFT_FACTOR if is_held(glfw.KEY_LEFT_SHIFT, glfw.KEY_RIGHT_SHIFT) else 1.0
            distance = factor * seconds * self.state.scene.extent / CROSSING_S
            self.state.move_to(self.state.view.fly(distance * right, distance * up, distance * forward))
