"""The settings of a picture, and the ladder of them."""

import gl
import numpy as np
import pytest
from scenes import SPACES, look_at, tiny_scene

from kpc.player import renderer as module
from kpc.player.quality import DEFAULT, LADDER, Quality, climbed
from kpc.player.reference import render
from kpc.player.renderer import COMPUTE_VERSION, TRIAL_AFTER, Renderer

CAMERA = look_at((2.4, 1.0, 2.2), (0.1, 0.05, 0.05), 64, 48, 70.0)


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10 * np.log10(max(np.mean((a - b) ** 2), 1e-12)))


def test_the_ladder_ends_at_what_the_format_says() -> None:
    names = list(LADDER)
    assert LADDER[names[-1]] == Quality() and DEFAULT in names
    assert [climbed(names[0], n) for n in range(-1, len(names) + 1)] == [names[0], *names, names[-1]]


@pytest.mark.parametrize("fault", [{"step": 0.5}, {"step": np.nan}, {"termination": 0.0}, {"termination": 1.0}, {"resolution": 0.0},
                                   {"resolution": 1.5}, {"scales": 0}])  # fmt: skip
def test_settings_that_draw_nothing_are_refused(fault: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(fault))):
        Quality(**fault)  # type: ignore[arg-type]


@pytest.mark.parametrize("space", SPACES)
def test_every_rung_draws_the_scene_and_the_last_exactly(space: str) -> None:
    scene = SPACES[space](tiny_scene(4))
    renderer, wanted = Renderer(gl.context(), scene), render(scene, CAMERA, 0.62)
    for name, quality in LADDER.items():
        renderer.quality = quality
        got = renderer.render(CAMERA, 0.62)
        assert got.rgb.shape == wanted.rgb.shape
        assert psnr(got.rgb, wanted.rgb) > (60 if name == "reference" else 20), name


@pytest.mark.parametrize("space", SPACES)
def test_compute_shaders_draw_the_same(space: str) -> None:
    ctx, scene = gl.context(), SPACES[space](tiny_scene(4))
    if ctx.version_code < COMPUTE_VERSION:
        pytest.skip("this OpenGL has no compute shaders")
    camera = CAMERA.resized(61, 43)  # no whole number of work groups
    renderer, pictures = Renderer(ctx, scene), {}
    for renderer.compute in (False, True):
        for name in ("reference", "balanced", "fine"):
            renderer.quality = LADDER[name]
            pictures[name, renderer.compute] = renderer.render(camera, 0.3)
    renderer.check()
    for name in ("reference", "balanced", "fine"):
        one, other = pictures[name, False], pictures[name, True]
        assert np.mean(np.abs(one.rgb - other.rgb).max(axis=2) < 1 / 255) > 0.999 and psnr(one.rgb, other.rgb) > 55, name
        assert np.mean(one.samples == other.samples) > 0.99


def test_a_card_tries_both_kinds_of_shaders_once_and_keeps_to_the_faster(monkeypatch: pytest.MonkeyPatch) -> None:
    ctx = gl.context()
    if ctx.version_code < COMPUTE_VERSION:
        pytest.skip("this OpenGL has no compute shaders")
    monkeypatch.setattr(module, "is_software", lambda ctx: False)
    asked = []
    monkeypatch.setattr(Renderer, "is_compute_faster", lambda self, camera, time: asked.append(time) or True)
    renderer = Renderer(ctx, tiny_scene(4))
    for n in range(TRIAL_AFTER + 3):
        assert renderer.compute == (n >= TRIAL_AFTER)
        renderer.march(CAMERA, n / 100)
    assert asked == [(TRIAL_AFTER - 1) / 100]
    monkeypatch.undo()
    assert renderer.is_compute_faster(CAMERA, 0.5) in (True, False) and renderer.compute
    assert not Renderer(ctx, tiny_scene(4)).compute
