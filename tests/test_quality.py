"""The settings of a picture, and the ladder of them."""

import gl
import numpy as np
import pytest
from scenes import SPACES, look_at, tiny_scene

from kpc.player.quality import DEFAULT, LADDER, Quality, climbed
from kpc.player.reference import render
from kpc.player.renderer import Renderer

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
