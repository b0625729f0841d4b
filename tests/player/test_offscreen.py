import moderngl
import pytest

import gl
from kpc.format.common.errors import DisplayError
from kpc.player.gl import offscreen


def test_a_context_says_who_renders() -> None:
    ctx = gl.context()
    assert ctx.version_code >= 330
    assert ctx.info["GL_RENDERER"] in offscreen.describe(ctx)


def test_without_opengl_the_remedy_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(**_: object) -> None:
        raise Exception("libEGL not loaded")

    monkeypatch.setattr(moderngl, "create_context", refuse)
    with pytest.raises(DisplayError, match=r"libEGL not loaded.*apt install libegl1.*--backend reference") as caught:
        offscreen.open_context()
    assert "\n" not in str(caught.value)
