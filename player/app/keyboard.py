"""What the keys of this keyboard are called, and which shortcut a press stands for.

Shortcuts that people read as a character (-, =, [, L) are taken by the character that was typed, wherever the layout
has it. Space, arrows and other named keys are taken by position, and so are the keys that fly the camera, whose shape
is what matters.
"""

import unicodedata
from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass

from kpc.player.app.desktop import glfw

# Names of keys without a character.
KEY_NAMES = {
    glfw.KEY_SPACE: "Space",
    glfw.KEY_LEFT: "Left",
    glfw.KEY_RIGHT: "Right",
    glfw.KEY_UP: "Up",
    glfw.KEY_DOWN: "Down",
    glfw.KEY_HOME: "Home",
    glfw.KEY_END: "End",
    glfw.KEY_PAGE_UP: "PageUp",
    glfw.KEY_PAGE_DOWN: "PageDown",
    glfw.KEY_BACKSPACE: "Backspace",
    glfw.KEY_TAB: "Tab",
    glfw.KEY_ESCAPE: "Esc",
}
# Characters of the other keys on a US keyboard; glfw numbers keys by them.
US_CHARACTERS = {
    key: chr(key).lower() for key in (*range(39, 97), 161) if chr(key).isascii() and chr(key) not in ":<>?@"
}
DIGITS = range(glfw.KEY_1, glfw.KEY_9 + 1)
# The keys that fly, by their position on a US keyboard: left, right, down, up, backward, forward.
FLYING_KEYS = (glfw.KEY_A, glfw.KEY_D, glfw.KEY_Q, glfw.KEY_E, glfw.KEY_S, glfw.KEY_W)


@dataclass(frozen=True)
class KeyPress:
    """A key that was pressed, or a character that was typed. A key with a character causes one of each.

    Attributes:
        key: of glfw, by position; None for a typed character.
        character: that was typed; of a key the one that the layout shows on it, without modifiers, None if it has none.
        modifiers: as in a glfw key event.
    """

    key: int | None
    character: str | None
    modifiers: int = 0

    def shortcuts(self) -> tuple[str, ...]:
        """Return the names of the shortcuts that it may stand for, as in `input.KEY_BINDINGS`; the first one that is
        bound is meant.

        A key counts if it has no character, or with Ctrl, which types none. It counts by its position on a US keyboard
        if its layout has other letters than Latin ones. The digit row counts by position without Shift, for French
        keyboards show digits but type them with Shift.
        """
        has_ctrl, has_shift = bool(self.modifiers & glfw.MOD_CONTROL), bool(self.modifiers & glfw.MOD_SHIFT)
        if self.key is None:
            name = self.character if self.character and not self.character.isspace() else None
        elif (name := KEY_NAMES.get(self.key)) is None:
            by_position = _is_foreign(self.character) or (self.key in DIGITS and not (has_ctrl or has_shift))
            name = US_CHARACTERS.get(self.key) if by_position else self.character if has_ctrl else None
        if name is None:
            return ()
        name = name.lower() if len(name) == 1 else name
        if has_ctrl and self.key is not None:
            return (f"Ctrl+{name}",)
        return (f"Shift+{name}", name) if has_shift else (name,)


def key_name(key: int, scancode: int = 0) -> str | None:
    """Return the character that the layout shows on a key, in small letters; None if it shows none."""
    name = glfw.get_key_name(key, scancode)
    return name.lower() if name else None


def label(key: int) -> str:
    """Return a character key's label: that of its layout, or of a US keyboard where it has no Latin letters."""
    name = key_name(key)
    return (US_CHARACTERS[key] if name is None or _is_foreign(name) else name).upper()


def flying_keys(bound: Container[str], name_of: Callable[[int], str | None] = key_name) -> tuple[int, ...]:
    """Return the keys that fly, in the order of FLYING_KEYS.

    They are taken by position. Where the layout has a letter there that is a shortcut (Dvorak, Colemak), all six are
    taken by letter, else flying would also start what the letters stand for.

    Args:
        bound: all shortcuts.
        name_of: see `key_name`.
    """
    if not any((name_of(key) or "") in bound for key in FLYING_KEYS):
        return FLYING_KEYS
    by_name = {name_of(key): key for key in US_CHARACTERS}
    return tuple(by_name.get(US_CHARACTERS[key], key) for key in FLYING_KEYS)


def nearest_at_hand(variants: Sequence[str], name_of: Callable[[int], str | None] = key_name) -> str:
    """Return the names of keys, such as "[  ]" or ",  .", of which most need neither Shift nor AltGr; the first of
    several."""
    at_hand = {name_of(key) for key in US_CHARACTERS}
    return max(variants, key=lambda keys: sum(name.removeprefix("Ctrl+").lower() in at_hand for name in keys.split()))


def _is_foreign(character: str | None) -> bool:
    """Return whether a character is a letter of another script than Latin."""
    return (
        character is not None
        and any(map(str.isalpha, character))
        and not unicodedata.name(character[0], "").startswith("LATIN")
    )
