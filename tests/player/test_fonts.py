"""Characters that ImGui's own font lacks."""

import numpy as np
import pytest

import gl
from kpc.player.app import fonts
from kpc.player.app.desktop import imgui
from kpc.player.app.imgui_renderer import ImGuiRenderer


def drawn(text: str) -> np.ndarray:
    """Return the picture of a text."""
    ctx = gl.context()
    target = ctx.simple_framebuffer((200, 60))
    target.clear()
    renderer = ImGuiRenderer(ctx)
    for _ in range(2):  # a new window is shown in its second frame
        renderer.begin((200, 60), (200, 60), 1.0, 0.1)
        imgui.begin("##text", False, imgui.WindowFlags.NO_DECORATION)
        imgui.text(text)
        imgui.end()
        renderer.draw(target)
    renderer.close()
    return np.frombuffer(target.read(), np.uint8)


@pytest.mark.skipif(fonts.system_font() is None, reason="this system has none of the fonts that are looked for")
def test_names_show_dashes_and_letters_of_many_scripts() -> None:
    unknown = drawn("\ue000" * 4)
    for text in ("\u2013" * 4, "\u0142" * 4, "\u044f" * 4, "\u03a9" * 4):
        assert not np.array_equal(drawn(text), unknown), text
    assert np.array_equal(drawn("\ue000" * 4), unknown)


def test_without_such_a_font_the_player_has_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fonts, "NAMES", ("nowhere.ttf",))
    assert fonts.system_font() is None and drawn("a").any()
