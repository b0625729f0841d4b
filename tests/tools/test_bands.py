"""Large pictures are drawn in bands: the same pixels, and a bar where it takes long."""

import numpy as np
import pytest

from kpc.format.scene.cameras import Camera
from kpc.player.cpu import reference
from kpc.player.cpu.reference import Rendering
from kpc.tools.rendering import bands
from scenes import look_at, tiny_scene


def test_bands_give_the_same_picture(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(bands, "BAND_PIXELS", 100)
    monkeypatch.setattr(bands, "SLOW_S", 0.0)
    scene, heights = tiny_scene(), []
    camera = look_at((0.5, 0.4, 2.5), (0.0, 0.0, 0.0), 30, 20, 25.0)

    def draw(band: Camera) -> Rendering:
        heights.append(band.height)
        return reference.render(scene, band, 0.5)

    whole, banded = reference.render(scene, camera, 0.5), bands.in_bands(draw, camera)
    assert heights == [3] * 6 + [2]
    for field in ("rgb", "depth", "opacity", "samples"):
        np.testing.assert_allclose(getattr(banded, field), getattr(whole, field), atol=1e-5)
    assert whole.opacity.max() > 0.1


def test_a_small_picture_is_drawn_at_once() -> None:
    cameras: list[Camera] = []

    def draw(camera: Camera) -> Rendering:
        cameras.append(camera)
        return reference.render(tiny_scene(), camera, 0.0)

    camera = look_at((0.5, 0.4, 2.5), (0.0, 0.0, 0.0), 8, 6, 7.0)
    bands.in_bands(draw, camera)
    assert cameras == [camera]
