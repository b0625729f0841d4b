"""The question what becomes of an unsaved camera path before the player ends, or shows another scene or path."""

from kpc.player.app.actions import Actions
from kpc.player.app.desktop import imgui
from kpc.player.app.widgets import panel, place_next, window_size


def ask(actions: Actions) -> None:
    """Build the question, in the middle of the window."""
    width, height = window_size()
    place_next(width / 2, height / 2, 0.5, 0.5)
    imgui.set_next_window_bg_alpha(0.95)
    imgui.set_next_window_focus()
    with panel("leave", is_above=True):
        imgui.text("The camera path is not saved.")
        if imgui.button("save it"):
            actions.save_path()
        imgui.same_line()
        if imgui.button("leave without saving"):
            actions.state.follower.give_up()
        imgui.same_line()
        if imgui.button("stay"):
            actions.stay()
