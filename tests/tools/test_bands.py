"""Large pictures are drawn in bands: the same pixels, and each band is reported as a part of the picture."""

import numpy as np

from kpc.format.common.progress import Progress
from kpc.format.scene.cameras import Camera
from kpc.player.cpu import reference
from kpc.player.cpu.reference import Rendering
from kpc.tools.rendering import bands
from scenes import look_at, tiny_scene


def test_bands_give_the_same_picture_and_are_reported() -> None:
    scene, heights, reported = tiny_scene(), [], []
    camera = look_at((0.5, 0.4, 2.5), (0.0, 0.0, 0.0), 30, 20, 25.0)

    def draw(band: Camera) -> Rendering:
        heights.append(band.height)
        reported.append(pictures.done)
        return reference.render(scene, band, 0.5)

    whole = reference.render(scene, camera, 0.5)
    with Progress("draw", 1, "pictures", shown=False) as pictures:
        banded = bands.in_bands(draw, camera, 100)
    assert heights == [3] * 6 + [2]
    np.testing.assert_allclose(reported, np.arange(7) / 7)
    for field in ("rgb", "depth", "opacity", "samples"):
        np.testing.assert_allclose(getattr(banded, field), getattr(whole, field), atol=1e-5)
    assert whole.opacity.max() > 0.1


def test_a_small_picture_is_drawn_at_once() -> None:
    cameras: list[Camera] = []

    def draw(camera: Camera) -> Rendering:
        cameras.append(camera)
        return reference.render(tiny_scene(), camera, 0.0)

    camera = look_at((0.5, 0.4, 2.5), (0.0, 0.0, 0.0), 8, 6, 7.0)
    bands.in_bands(draw, camera, 48)
    assert cameras == [camera]
