"""The processor's pictures, through the corner grid or by planes, against the reference."""

from dataclasses import replace

import numpy as np
import pytest
from numba import njit

import gl
from kpc.format.scene.cameras import Camera
from kpc.format.scene.scene import SPACE_PLANES, TERMINATION, Scene
from kpc.player.cpu.corner_grid import CornerGrid
from kpc.player.cpu.field_sampler import quantised_planes
from kpc.player.cpu.lanes import FAST, clamped
from kpc.player.cpu.plane_sampler import PlaneSampler
from kpc.player.cpu.reference import Part, render
from kpc.player.gl.renderer import Renderer
from kpc.player.quality import LEVELS, Quality
from scenes import (
    VARIANTS,
    linear_per_cell,
    look_at,
    one_texel_deep,
    stream_planes,
    tiny_scene,
    unequal_scales,
    view_independent,
    with_appearances,
    with_motion,
    without_planes,
)

CAMERA = look_at((2.4, 1.0, 2.2), (0.1, 0.05, 0.05), 64, 48, 70.0)
FOLDED, WITH_GRID = Quality(folded=True), Quality(folded=True, grid_termination=TERMINATION)
QUALITY = {PlaneSampler: FOLDED, CornerGrid: WITH_GRID}


def renderer_of(scene: Scene, kind: type = PlaneSampler, quality: Quality | None = None) -> Renderer:
    renderer = Renderer(gl.context(), scene, quality or QUALITY[kind], processor=True)
    assert renderer._processor._sampler_kind(renderer.quality, scene.is_dynamic) is kind
    assert renderer.drawn_by == "the processor"
    return renderer


@njit(**FAST)
def clamped_all(places, most):
    out = np.empty_like(places)
    for i in range(len(places)):
        out[i] = clamped(places[i], most)
    return out


VIEWS = {
    "from outside": CAMERA,
    "within": look_at((0.5, 0.3, 0.2), (-0.4, -0.2, -0.1), 48, 36, 40.0),
    "amid what is opaque": look_at((0.1, 0.05, 0.05), (1.0, 0.4, 0.3), 33, 21, 30.0),
    "from far away": look_at((240.0, 100.0, 220.0), (0.1, 0.05, 0.05), 47, 39, 7000.0),
    "along an axis": look_at((0.1, 0.05, 4.0), (0.1, 0.05, 0.0), 40, 30, 60.0),
    "of one pixel": look_at((2.4, 1.0, 2.2), (0.1, 0.05, 0.05), 1, 1, 1.0),
    "a long line": look_at((2.4, 1.0, 2.2), (0.1, 0.05, 0.05), 4096, 1, 4000.0),
    "beside it": look_at((2.4, 1.0, 2.2), (9.0, 9.0, 2.0), 40, 30, 60.0),
}


@pytest.mark.parametrize("view", VIEWS.values(), ids=VIEWS)
@pytest.mark.parametrize(
    "kind, where",
    [(kind, where) for kind in (PlaneSampler, CornerGrid) for where in ("box", "displaced", "opaque", "fog")]
    + [(PlaneSampler, "contracted")],
)
def test_pictures_are_those_of_the_reference(kind: type, where: str, view: Camera) -> None:
    """Through a grid, where that holds all there is. Fog, which takes the most samples, is drawn at one time."""
    scene = tiny_scene(4, scales=1, channels=32)
    scene = linear_per_cell(view_independent(scene)) if kind is CornerGrid else scene
    if where in ("displaced", "contracted"):
        scene = VARIANTS[where](scene)
    elif where == "opaque":
        scene = replace(scene, decoder=replace(scene.decoder, density_bias=60.0))
    elif where == "fog":
        weight = 0.02 * scene.decoder.density_weight
        scene = replace(scene, step=0.004, decoder=replace(scene.decoder, density_bias=0.0, density_weight=weight))
    renderer = renderer_of(scene, kind)
    for time in (0.6,) if where == "fog" else (0.0, 0.6, 1.0):
        got, wanted = renderer.render(view, time), render(scene, view, time)
        off = np.abs(got.rgb - wanted.rgb).max(axis=2)
        assert np.mean(off <= 1 / 255) > 0.998 and np.mean(np.abs(got.opacity - wanted.opacity) <= 1 / 255) > 0.998
        apart = np.abs(got.samples - wanted.samples)  # one more or less where a sample lies on a cell's face
        assert np.mean(apart <= 1) > 0.99 and np.mean(apart == 0) > 0.95
        both = (got.opacity > 0.1) & (wanted.opacity > 0.1)
        assert np.mean(np.abs(got.depth[both] - wanted.depth[both]) < 2 * scene.step) > 0.99 if both.any() else True
    if view.width > 1 and where != "contracted":  # there something is everywhere
        assert (wanted.opacity.max() > 0.1) == (view is not VIEWS["beside it"])


SCENES = {
    "two scales": lambda: tiny_scene(4, channels=16),
    "five channels": lambda: tiny_scene(4, channels=5, scales=3),
    "unequal scales": unequal_scales,
    "one texel along z": one_texel_deep,
    "one-sided": lambda: view_independent(tiny_scene(4)),
    "static": lambda: tiny_scene(4, dynamic=False),
    "appearances": lambda: with_appearances(tiny_scene(4)),
    "contracted": lambda: VARIANTS["contracted"](tiny_scene(4)),
    "contracted and static": lambda: VARIANTS["contracted"](tiny_scene(4, dynamic=False)),
}


@pytest.mark.parametrize("make", SCENES.values(), ids=SCENES)
def test_planes_of_all_sizes_are_looked_up(make) -> None:
    scene = make()
    renderer = renderer_of(scene)
    code = scene.appearances[1].code if scene.appearances else None
    for time in (0.0, 0.37, 1.0):
        for part in (Part.FULL, Part.STATIC):
            got, wanted = (
                renderer.render(CAMERA, time, part=part, appearance=code),
                render(scene, CAMERA, time, part=part, appearance=code),
            )
            assert np.mean(np.abs(got.rgb - wanted.rgb).max(axis=2) <= 1 / 255) > 0.998
            assert np.mean(got.samples == wanted.samples) > 0.95 and wanted.samples.sum() > 500
    if code is not None:
        assert np.abs(renderer.render(CAMERA, 1.0).rgb - got.rgb).max() > 0.05


def test_nan_is_no_index_into_an_array() -> None:
    places = np.array([np.nan, -np.inf, -1.0, 0.0, 2.5, 7.0, np.inf] * 5, np.float32)  # more than vectors hold
    np.testing.assert_array_equal(clamped_all(places, np.float32(5)), np.float32([0, 0, 0, 0, 2.5, 5, 5] * 5))


@pytest.mark.parametrize("value", [3e38, -3e38, 1e-38])
def test_planes_that_overflow_do_not_crash(value: float) -> None:
    scene = tiny_scene(4)
    for name in SPACE_PLANES:
        scene.scales[1][name][:] = value
    assert np.isfinite(renderer_of(scene).render(CAMERA, 0.3).rgb).all()


@pytest.mark.parametrize("kind", [PlaneSampler, CornerGrid])
@pytest.mark.parametrize("edges", [(0.0, 1.0, 1.0), (1.0, 1.0, 1e-6)])
def test_boxes_without_a_volume_show_the_background(edges: tuple[float, float, float], kind: type) -> None:
    scene = with_motion(tiny_scene(4, channels=16))
    scene = replace(
        view_independent(scene) if kind is CornerGrid else scene, aabb=np.array([[0, 0, 0], edges], np.float32)
    )
    for camera in (CAMERA, look_at((0.0, 0.0, 0.0), (1.0, 0.4, 0.3), 33, 21, 30.0)):
        got = renderer_of(scene, kind).render(camera, 1.0)
        assert np.isfinite(got.rgb).all() and np.abs(got.rgb - scene.background).max() < 0.02


def test_quantised_planes_are_off_by_half_a_step() -> None:
    plane = np.random.default_rng(0).normal(size=(7, 9, 5)).astype(np.float32) * np.float32([1e-30, 1, 0, 1e30, 5])
    whole, step = quantised_planes(plane)
    assert whole.dtype == np.int16 and step[2] == 0 and not whole[..., 2].any()
    assert (np.abs(whole * step - plane) <= 0.51 * step).all() and (
        np.abs(whole).max((0, 1)) == [32767, 32767, 0, 32767, 32767]
    ).all()


@pytest.mark.parametrize("variant", ["ndc", "hybrid"])
def test_scenes_that_it_does_not_serve_are_drawn_by_shaders(variant: str) -> None:
    scene = VARIANTS[variant](tiny_scene(4))
    renderer = Renderer(gl.context(), scene, FOLDED, processor=True)
    assert not PlaneSampler.serves(scene) and renderer.drawn_by.endswith("shaders")
    error = renderer.render(CAMERA, 0.5).rgb - render(scene, CAMERA, 0.5).rgb
    assert -10 * np.log10(np.mean(error**2)) > 60


def test_the_exact_level_is_drawn_by_shaders() -> None:
    renderer = Renderer(gl.context(), tiny_scene(4), LEVELS["reference"], processor=True)
    assert renderer.drawn_by == "fragment shaders"
    renderer.render(CAMERA, 0.5)
    assert renderer._processor.memory_bytes == 0


def test_planes_that_arrive_later_are_drawn() -> None:
    scene = with_motion(tiny_scene(4))
    early = without_planes(scene)
    renderer, whole = renderer_of(early), renderer_of(scene)
    renderer.render(CAMERA, 0.5)
    stream_planes(renderer, early, scene)
    np.testing.assert_array_equal(renderer.render(CAMERA, 0.5).rgb, whole.render(CAMERA, 0.5).rgb)


def test_its_memory_is_counted() -> None:
    for make in SCENES.values():
        renderer = renderer_of(scene := make())
        before = renderer.memory_bytes
        renderer.render(CAMERA, 0.5)
        sampler = renderer._processor._sampler(PlaneSampler)
        taken = sampler._planes.nbytes + sampler._rows.nbytes + sampler._ray_weights.nbytes
        bound = PlaneSampler.bytes_for(scene)
        assert taken == bound or (not scene.decoder.w2.any() and taken < bound)
        assert renderer.memory_bytes >= before + bound
        assert renderer.memory_bytes - renderer.picture_bytes <= Renderer.bytes_for(scene)
