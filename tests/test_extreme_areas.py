"""Scales of what moves at the extremes, against float64: areas that touch, nest, reach the ends of the box or hold
nothing, none to eight of them, and log densities that add up to the limit."""

from collections.abc import Sequence
from dataclasses import replace

import decoder  # the readable one, which computes in float64
import numpy as np
import pytest
import torch

import gl
from kpc.encoder.coding import scene_writer
from kpc.encoder.evaluation.evaluate import SceneRenderer
from kpc.encoder.field.field import Field
from kpc.encoder.field.fused import fused_features
from kpc.encoder.field.layout import layout_of_planes
from kpc.format.coding.quantise import quantise_scene
from kpc.format.container import scene_io
from kpc.format.scene.scene import LOG_DENSITY_LIMIT, SPACE_PLANES, TIME_PLANES, Scene
from kpc.player.cpu import reference
from kpc.player.gl.renderer import Renderer
from kpc.player.quality import LEVELS, Quality
from scenes import tiny_scene

CHANNELS, RESOLUTION, ROWS = 4, (12, 10, 8), 4
TIME = 0.3

Corner = tuple[float, float, float]
Area = tuple[Corner, Corner]

LEFT, RIGHT = ((0.0, 0.2, 0.2), (0.45, 0.8, 0.8)), ((0.45, 0.2, 0.2), (1.0, 0.8, 0.8))
MIDDLE, INNER = ((0.2, 0.2, 0.2), (0.8, 0.8, 0.8)), ((0.4, 0.4, 0.4), (0.6, 0.6, 0.6))
BEYOND, NOTHING = ((-0.5, -0.5, 0.3), (0.6, 1.5, 2.0)), ((2.0, 2.0, 2.0), (3.0, 3.0, 3.0))
AREAS: dict[str, Sequence[Area]] = {
    "none": (),
    "one": (MIDDLE,),
    "touching": (LEFT, RIGHT),
    "nested": (MIDDLE, INNER),
    "beyond the box": (BEYOND,),
    "around nothing": (NOTHING, MIDDLE),
    "eight": (LEFT, RIGHT, MIDDLE, INNER, BEYOND, MIDDLE, NOTHING, INNER),
}


def scene_of(areas: Sequence[Area]) -> Scene:
    """Return a scene of a scale that stands still, and one for each area that is 0 outside it."""
    scene = tiny_scene(scales=1, channels=CHANNELS * (1 + len(areas)), resolution=RESOLUTION, time=ROWS)
    return replace(scene, scales=(_scale(0, None), *(_scale(1 + k, area) for k, area in enumerate(areas))))


def _scale(seed: int, area: Area | None) -> dict[str, np.ndarray]:
    planes = tiny_scene(seed, scales=1, channels=CHANNELS, resolution=RESOLUTION, time=ROWS).scales[0]
    if area is None:
        return planes | {name: np.ones_like(planes[name][:2]) for name in TIME_PLANES}
    inside = []
    for count, low, high in zip(RESOLUTION, *area, strict=True):
        position = np.arange(count) / (count - 1)
        inside.append((position >= low) & (position <= high))
    along = dict(zip("xyz", inside, strict=True))
    held = {name: planes[name] * np.outer(along[name[1]], along[name[0]])[..., None] for name in SPACE_PLANES}
    return held | {name: 3 * planes[name] - 2 for name in TIME_PLANES}


def with_density_weight(scene: Scene, weight: float) -> Scene:
    """Return the scene with one density weight for all features."""
    weights = np.full_like(scene.decoder.density_weight, weight)
    return replace(scene, decoder=replace(scene.decoder, density_weight=weights, density_bias=0.0))


def coded(scene: Scene) -> tuple[Scene, dict]:
    """Return a scene as a file holds it, and as the readable decoder reads that file."""
    data = scene_writer.encode(quantise_scene(scene, [dict.fromkeys(scale, 0.01) for scale in scene.scales]))
    return scene_io.read(data).dequantise(), decoder.decode(data)


def rendered_in_float64(read: dict, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the colours (N, 3) and opacities (N,) of rays."""
    rays = zip(origins.tolist(), directions.tolist(), strict=True)
    found = [decoder.render_ray(read, origin, direction, TIME) for origin, direction in rays]
    return np.array([rgb for rgb, _, _ in found]), np.array([opacity for _, opacity, _ in found])


@pytest.mark.parametrize("density", [None, LOG_DENSITY_LIMIT, 1e4])
@pytest.mark.parametrize("name", AREAS)
def test_all_renderers_draw_what_float64_does(name: str, density: float | None) -> None:
    scene = scene_of(AREAS[name])
    scene, read = coded(scene if density is None else with_density_weight(scene, density))
    camera = scene.cameras[0].resized(8, 6)
    rgb, opacity = rendered_in_float64(read, *camera.rays())
    assert density is None or opacity.max() > 0.999
    in_numpy = reference.render_rays(scene, *camera.rays(), TIME)
    in_training = SceneRenderer(scene).render(*camera.rays(), np.full(len(rgb), TIME, np.float32))
    pictures = {"numpy": (in_numpy.rgb, in_numpy.opacity), "training": in_training[:2]}
    for who, quality in {"shaders": LEVELS["reference"], "processor": Quality(folded=True)}.items():
        found = Renderer(gl.context(), scene, quality, processor=who == "processor").render(camera, TIME)
        pictures[who] = found.rgb.reshape(-1, 3), found.opacity.ravel()
    for who, (found_rgb, found_opacity) in pictures.items():
        assert np.isfinite(found_rgb).all(), who
        off = np.maximum(np.abs(found_rgb - rgb).max(1), np.abs(found_opacity - opacity))
        # Where a density is at its limit, a sample more or less at a cell's face decides what a ray sees.
        assert np.mean(off < 1 / 255) > (0.99 if density is None else 0.95), (who, off.max())


@pytest.mark.parametrize("name", AREAS)
def test_features_and_their_gradients_are_those_of_float64(name: str) -> None:
    """Training holds texels of the areas alone."""
    scene = scene_of(AREAS[name])
    layout = layout_of_planes(scene.scales)
    tight, exact = Field.from_scene(scene, layout), Field.from_scene(scene, layout).double()
    whole, generator = Field.from_scene(scene).double(), torch.Generator().manual_seed(0)
    points, times = torch.rand(2000, 3, generator=generator), torch.rand(2000, generator=generator)
    found, wanted = fused_features(tight)(points, times), exact.features(points.double(), times.double())
    everywhere = whole.features(points.double(), times.double()).detach()
    scale = float(everywhere.abs().max())
    assert float((wanted.detach() - everywhere).abs().max()) < 1e-5 * scale  # outside the area there is nothing
    assert float((found.detach() - everywhere).abs().max()) < 1e-5 * scale
    weights = torch.randn(found.shape, generator=generator)
    (found * weights).sum().backward()
    (wanted * weights).sum().backward()
    assert tight.theta.grad is not None and exact.theta.grad is not None
    error = (tight.theta.grad - exact.theta.grad).abs().max()
    assert float(error) < 1e-5 * float(exact.theta.grad.abs().max())
