"""Building blocks of the panels: ImGui windows, messages, labelled controls. One em is the height of the text."""

import contextlib
from collections.abc import Iterator, Sequence
from typing import TypeAlias, TypeVar

from kpc.format.common.text import valid_unicode
from kpc.player.app.desktop import imgui

# Red, green, blue and alpha; those of what is active, and of errors.
Colour: TypeAlias = tuple[float, float, float, float]
ACCENT: Colour = (0.95, 0.62, 0.25, 1.0)
ERROR: Colour = (1.0, 0.45, 0.38, 1.0)
# Widths of the labels before controls, of the controls, and of the panels on the right, em.
LABEL_EM, CONTROL_EM, PANEL_EM = 6.5, 11.1, 19.0
# Distances of the panels from the window's edges and from each other, em.
MARGIN_EM, SPACING_EM = 0.8, 0.4
# Width of the panels along the lower edge, at most, em.
MAX_BAR_EM = 60.0
# Room that the panels need: the text grows no further than a window has it, em.
ROOM_EM = 41.5, 24.0
# Width of a text about a widget, at most, em.
TIP_EM = 24.0
# Width of a message over the room it has.
MESSAGE_SHARE = 0.88

# Name of a panel that is there whenever a list is open: focusing it closes what is above it.
LOWEST = "status"

Value = TypeVar("Value")


def em(count: float = 1.0) -> float:
    """Return `count` heights of the text, in screen units."""
    return count * imgui.get_font_size()


def window_size() -> tuple[float, float]:
    """Return (width, height) of the player's window, screen units."""
    width, height = imgui.get_io().display_size
    return width, height


@contextlib.contextmanager
def panel(
    name: str,
    flags: imgui.WindowFlags = imgui.WindowFlags.NONE,
    fits_content: bool = True,
    scrolls: bool = False,
    is_above: bool = False,
) -> Iterator[None]:
    """Build a window without decoration that cannot be moved.

    Args:
        name: of the window.
        flags: further flags.
        fits_content: whether its size is that of its content.
        scrolls: whether it may be smaller than its content.
        is_above: whether it comes to the front when it appears or is used; others stay where they are.
    """
    bare = imgui.WindowFlags.NO_DECORATION | imgui.WindowFlags.NO_MOVE | imgui.WindowFlags.NO_NAV
    if scrolls:
        bare &= ~imgui.WindowFlags.NO_SCROLLBAR
    if fits_content:
        bare |= imgui.WindowFlags.ALWAYS_AUTO_RESIZE
    if not is_above:
        bare |= imgui.WindowFlags.NO_BRING_TO_FRONT_ON_FOCUS
    imgui.begin(f"##{name}", False, bare | flags)
    try:
        yield
    finally:
        imgui.end()


def place_next(
    x: float,
    y: float,
    pivot_x: float = 0.0,
    pivot_y: float = 0.0,
    max_height: float | None = None,
    min_width: float = 0.0,
) -> None:
    """Place the next window: the point at (pivot_x, pivot_y) of its size lies at (x, y)."""
    imgui.set_next_window_pos((x, y), imgui.Cond.ALWAYS, (pivot_x, pivot_y))
    if max_height is not None:
        imgui.set_next_window_size_constraints((min_width, 0), (1e5, max(max_height, 1.0)))


def place_bar(bottom: float) -> None:
    """Place the next window along the lower edge, above `bottom`."""
    width = window_size()[0]
    place_next(width / 2, bottom, 0.5, 1.0)
    imgui.set_next_window_size((min(width - em(2 * MARGIN_EM), em(MAX_BAR_EM)), 0))


def message(
    name: str,
    text: str,
    across: tuple[float, float],
    y: float,
    pivot_y: float,
    colour: Colour | None = None,
) -> None:
    """Show a wrapped text.

    Args:
        name: of its window.
        text: to show.
        across: left and right end of the room it is centred in, screen units.
        y, pivot_y: see `place_next`.
        colour: of the text; None for the usual one.
    """
    place_next(sum(across) / 2, y, 0.5, pivot_y)
    imgui.set_next_window_bg_alpha(0.92)
    with panel(name, imgui.WindowFlags.NO_INPUTS, is_above=True):
        imgui.push_text_wrap_pos(MESSAGE_SHARE * (across[1] - across[0]))
        if colour is not None:
            imgui.push_style_color(imgui.Col.TEXT, colour)
        imgui.text(valid_unicode(text))
        if colour is not None:
            imgui.pop_style_color()
        imgui.pop_text_wrap_pos()


def label(text: str) -> None:
    """Begin a line of a label and a control."""
    imgui.align_text_to_frame_padding()
    imgui.text_disabled(text)
    imgui.same_line(em(LABEL_EM))
    imgui.set_next_item_width(em(CONTROL_EM))


def choice(name: str, present: Value, names: dict[Value, str]) -> Value:
    """Build a labelled list to choose from; return the value that is chosen."""
    label(name)
    values: Sequence[Value] = list(names)
    changed, chosen = imgui.combo(f"##{name}", values.index(present), list(names.values()))
    return values[chosen] if changed else present


def tip(text: str) -> None:
    """Show a text while the pointer rests on the widget before."""
    if imgui.begin_item_tooltip():
        imgui.push_text_wrap_pos(em(TIP_EM))
        imgui.text(text)
        imgui.pop_text_wrap_pos()
        imgui.end_tooltip()


def close_lists() -> bool:
    """Close all lists and menus that are open; return whether there were any."""
    are_open = imgui.is_popup_open("", imgui.PopupFlags.ANY_POPUP)
    if are_open:
        imgui.set_window_focus(f"##{LOWEST}")
    return are_open


def toggle(name: str, is_on: bool) -> bool:
    """Build a button that stays down; return whether it is down."""
    if is_on:
        imgui.push_style_color(imgui.Col.BUTTON, (*ACCENT[:3], 0.55))
    pressed = imgui.button(name)
    if is_on:
        imgui.pop_style_color()
    return is_on != pressed
