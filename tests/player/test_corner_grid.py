"""The corner grid: its values, and pictures drawn through it, against the reference."""

from dataclasses import replace

import numpy as np
import pytest

import gl
from kpc.format.scene.cameras import Camera
from kpc.format.scene.scene import SPACE_PLANES, TERMINATION, Scene
from kpc.player.cpu.corner_grid import CornerGrid
from kpc.player.cpu.field_kernels import COMPUTED
from kpc.player.cpu.reference import Part, SceneAtTime, features, render
from kpc.player.cpu.serving import MOST_CORNERS, grid_shape
from kpc.player.cpu.simd import LARGEST
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
    with_motion,
    with_moving_area,
    without_planes,
)

CAMERA = look_at((2.4, 1.0, 2.2), (0.1, 0.05, 0.05), 64, 48, 70.0)
FOLDED, WITH_GRID = Quality(folded=True), Quality(folded=True, grid_termination=TERMINATION)


def grid_of(scene: Scene, camera: Camera = CAMERA, time: float = 0.0) -> CornerGrid:
    """The grid after a picture."""
    renderer = Renderer(gl.context(), scene, WITH_GRID, processor=True)
    renderer.march(camera, time)
    return renderer._processor._sampler(CornerGrid)


SCENES = {
    "even": lambda: view_independent(tiny_scene(4, channels=16)),
    "unequal scales": unequal_scales,
    "one texel deep": one_texel_deep,
    "displaced": lambda: with_motion(view_independent(tiny_scene(4, channels=16))),
}


@pytest.mark.parametrize("make", SCENES.values(), ids=SCENES)
def test_corners_hold_the_field_at_their_positions(make) -> None:
    scene = make()
    shape = grid_shape(scene)
    at = np.argwhere(np.ones(shape, bool))[:, ::-1] / np.maximum(np.array(shape[::-1]) - 1, 1)
    still, decoder = replace(scene, motion=None), scene.decoder
    weights = np.concatenate([decoder.b2, decoder.density_weight[None]]).astype(np.float64)
    for time in (0.0, 0.37, 1.0):
        grid = grid_of(scene, time=time)
        wanted = features(still, SceneAtTime.of(still, time), at.astype(np.float32)) @ weights.T
        wanted[:, 3] += decoder.density_bias
        known = (grid._known & COMPUTED).any(0).reshape(-1)
        # Each of a plane's numbers is off by half a step at most, of 32767 to the largest.
        largest = np.prod([max(np.abs(scale[name]).max() for scale in scene.scales) for name in SPACE_PLANES])
        off = (
            3
            * largest
            * np.abs(weights).sum(1)
            * 0.5
            / 32767
            * max(np.abs(scale["xt"]).max() for scale in scene.scales) ** 3
        )
        assert np.all(np.abs(grid.values.reshape(-1, 4)[known] - wanted[known]) < off + 1e-4) and off.max() < 0.05
        assert known.mean() > 0.05


def test_values_that_overflow_are_clamped() -> None:
    scene = view_independent(tiny_scene(4, channels=16))
    for value in (3e38, -3e38, 1e-38):
        for name in SPACE_PLANES:
            scene.scales[1][name][:] = value
        grid = grid_of(scene, time=0.3)
        assert np.isfinite(grid.values).all() and np.abs(grid.values).max() <= LARGEST


@pytest.mark.parametrize("change", [{"step": 2.0}, {"termination": 1 / 16}, {"rays_across": 4}, {"resolution": 0.5}])
def test_quality_settings_have_the_same_effect_as_with_planes(change: dict[str, float]) -> None:
    scene = with_motion(
        linear_per_cell(view_independent(tiny_scene(4, scales=1, channels=32, resolution=(90, 80, 70))))
    )
    camera = look_at((4.8, 2.0, 4.4), (0.1, 0.05, 0.05), 61, 45, 60.0) if "rays_across" in change else CAMERA
    assert CornerGrid.serves(scene)
    renderers = [
        Renderer(gl.context(), scene, replace(quality, **change), processor=processor)
        for quality, processor in ((WITH_GRID, True), (FOLDED, False))
    ]
    if "termination" in change:
        renderers[0].quality = replace(WITH_GRID, grid_termination=change["termination"])
    assert renderers[0].rays_across(camera) > 1 or "rays_across" not in change
    got, wanted = (renderer.render(camera, 0.6) for renderer in renderers)
    np.testing.assert_allclose(got.rgb, wanted.rgb, atol=2e-3)
    assert np.mean(got.samples == wanted.samples) > 0.99 and wanted.samples.sum() > 100


@pytest.mark.parametrize("space", ["box", "displaced"])
def test_pictures_are_near_those_of_the_reference(space: str) -> None:
    """The scene has 24 texels and is smooth over six; exact and static pictures look up planes."""
    scene = VARIANTS[space](view_independent(tiny_scene(4, channels=16)))
    renderer = Renderer(gl.context(), scene, WITH_GRID, processor=True)
    assert renderer._processor._sampler_kind(renderer.quality, is_moving=True) is CornerGrid
    for time in (0.1, 0.5, 0.9):
        got, wanted = renderer.render(CAMERA, time), render(scene, CAMERA, time)
        assert -10 * np.log10(np.mean((got.rgb - wanted.rgb) ** 2)) > 40
        assert np.mean(np.abs(got.samples - wanted.samples) <= 1) > 0.95
    still = renderer.render(CAMERA, 0.9, part=Part.STATIC)
    np.testing.assert_array_equal(
        still.rgb, Renderer(gl.context(), scene, FOLDED, processor=True).render(CAMERA, 0.9, part=Part.STATIC).rgb
    )
    renderer.quality = LEVELS["reference"]
    assert renderer.drawn_by == "fragment shaders"
    exact = renderer.render(CAMERA, 0.9)
    np.testing.assert_array_equal(exact.rgb, Renderer(gl.context(), scene, LEVELS["reference"]).render(CAMERA, 0.9).rgb)


def test_its_memory_is_counted() -> None:
    grid = grid_of(view_independent(tiny_scene(4, channels=16)))
    taken = grid.values.nbytes + grid._known.nbytes + sum(plane.nbytes for plane in grid._planes)
    assert taken == CornerGrid.bytes_for(grid._scene) == grid.memory_bytes


@pytest.mark.parametrize("space", ["displaced", "moving area"])
def test_a_picture_does_not_depend_on_the_ones_before(space: str) -> None:
    scene = VARIANTS[space](view_independent(tiny_scene(4, channels=16)))
    renderer = Renderer(gl.context(), scene, LEVELS["balanced"], processor=True)
    for time in (0.1, 0.11, 0.7, 0.12):
        got = renderer.render(CAMERA, time)
    np.testing.assert_array_equal(
        got.rgb, Renderer(gl.context(), scene, LEVELS["balanced"], processor=True).render(CAMERA, 0.12).rgb
    )


def test_corners_at_which_nothing_moves_are_kept() -> None:
    renderer = Renderer(
        gl.context(), with_moving_area(view_independent(tiny_scene(4, channels=16))), WITH_GRID, processor=True
    )
    renderer.march(CAMERA, 0.5)
    grid = renderer._processor._sampler(CornerGrid)
    before = grid._known.any(0)
    grid.prepare(0.6, np.empty(0, np.float32))
    kept = grid._known.any(0)
    assert 0.1 * before.sum() < kept.sum() < before.sum()
    inside = tuple(slice(side // 3, 2 * side // 3) for side in before.shape)
    assert before[inside].any() and not kept[inside].any() and (kept[:, 0] == before[:, 0]).all()


def test_planes_that_arrive_later_are_drawn() -> None:
    scene = view_independent(tiny_scene(4, channels=16))
    early = without_planes(scene)
    renderer, whole = (
        Renderer(gl.context(), early, WITH_GRID, processor=True),
        Renderer(gl.context(), scene, WITH_GRID, processor=True),
    )
    renderer.render(CAMERA, 0.5)
    stream_planes(renderer, early, scene)
    np.testing.assert_array_equal(renderer.render(CAMERA, 0.5).rgb, whole.render(CAMERA, 0.5).rgb)


def test_scenes_that_it_does_not_serve_are_sampled_by_planes() -> None:
    assert CornerGrid.serves(view_independent(tiny_scene(channels=16)))
    fine = view_independent(tiny_scene(scales=1, channels=30, resolution=(200, 180, 120)))
    assert np.prod(grid_shape(fine)) > MOST_CORNERS
    mapped = [VARIANTS[space](view_independent(tiny_scene(channels=16))) for space in ("ndc", "contracted")]
    for scene in (
        *mapped,
        tiny_scene(channels=16),
        view_independent(tiny_scene(channels=16, dynamic=False)),
        view_independent(tiny_scene()),
        fine,
        VARIANTS["hybrid"](tiny_scene(channels=16)),
    ):
        assert not CornerGrid.serves(scene)
        got, wanted = (
            Renderer(gl.context(), scene, quality, processor=True).render(CAMERA, 0.5)
            for quality in (WITH_GRID, FOLDED)
        )
        np.testing.assert_array_equal(got.rgb, wanted.rgb)
