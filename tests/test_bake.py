"""What planes come to at the corners of their texels, and pictures that a processor marches itself, against the reference."""

from dataclasses import replace

import gl
import numpy as np
import pytest
from numba import njit
from scenes import SPACES, bring, displaced, look_at, tiny_scene, without_planes

from kpc.format.cameras import Camera
from kpc.format.scene import SPACE_PLANES, TERMINATION, Scene
from kpc.player.bake import MOST_CORNERS, Baking, corners_of, rehearse
from kpc.player.cast import BAKED as CORNER_BAKED
from kpc.player.cast import _FAST, _within, cast
from kpc.player.quality import LADDER, Quality
from kpc.player.reference import Moment, Part, features, render
from kpc.player.renderer import Renderer
from kpc.player.textures import Layout
from kpc.player.vectors import LARGEST

CAMERA = look_at((2.4, 1.0, 2.2), (0.1, 0.05, 0.05), 64, 48, 70.0)
FOLDED, BAKED = Quality(folded=True), Quality(folded=True, baked=TERMINATION)


@njit(**_FAST)
def clamped(places, most):
    out = np.empty_like(places)
    for i in range(len(places)):
        out[i] = _within(places[i], most)
    return out


def one_sided(scene: Scene) -> Scene:
    """Its colours the same from all sides."""
    return replace(scene, decoder=replace(scene.decoder, w2=0 * scene.decoder.w2))


def uneven() -> Scene:
    """Scales of other channels, rows of time and sizes; the first is the finer one along y."""
    coarse, fine = tiny_scene(1, channels=13, resolution=(12, 44, 10), time=4), tiny_scene(2, channels=19, resolution=(23, 20, 15), time=7)
    scales = coarse.scales[-1], fine.scales[-1]
    rng, features = np.random.default_rng(3), 32
    decoder = replace(fine.decoder, density_weight=rng.normal(0, 0.8, features).astype(np.float32),
                      w2=np.zeros((3, features, 16), np.float32), b2=rng.normal(0, 0.4, (3, features)).astype(np.float32))  # fmt: skip
    return replace(fine, scales=scales, decoder=decoder)


def flat() -> Scene:
    """Of one texel along z."""
    scene = tiny_scene(5, scales=1, channels=30, resolution=(9, 20, 2))
    planes = {name: plane[:1] if name in ("xz", "yz") else plane[:, :1] if name == "zt" else plane for name, plane in scene.scales[0].items()}
    return one_sided(replace(scene, scales=(planes,)))


def of_first_degree(scene: Scene) -> Scene:
    """Of one scale, in which one plane varies, and rows of time planes are the same all along their axes: so that a grid holds all there is."""
    for name in ("xz", "yz"):
        scene.scales[0][name][:] = 1.0
    for name in ("xt", "yt", "zt"):
        scene.scales[0][name][:] = scene.scales[0][name][:, :1]
    return scene


def baking_of(scene: Scene, camera: Camera = CAMERA, time: float = 0.0, refined: int = 2) -> Baking:
    """As it is after a picture."""
    renderer = Renderer(gl.context(), scene, BAKED)
    if not renderer.bakes:
        pytest.skip("a graphics card, which bakes nothing")
    renderer.folded_layout = Layout.of(scene, refined)
    renderer.march(camera, time)
    return renderer._folded.baking


SCENES = {"even": lambda: one_sided(tiny_scene(4, channels=16)), "uneven": uneven, "flat": flat, "displaced": lambda: displaced(one_sided(tiny_scene(4, channels=16)))}


@pytest.mark.parametrize("refined", [1, 2])
@pytest.mark.parametrize("make", SCENES.values(), ids=SCENES)
def test_corners_hold_what_a_sample_there_finds(make, refined: int) -> None:
    scene = make()
    shape = corners_of(scene)
    at = np.argwhere(np.ones(shape, bool))[:, ::-1] / np.maximum(np.array(shape[::-1]) - 1, 1)
    still, decoder = replace(scene, motion=None), scene.decoder
    weights = np.concatenate([decoder.b2, decoder.density_weight[None]]).astype(np.float64)
    for time in (0.0, 0.37, 1.0):
        baking = baking_of(scene, time=time, refined=refined)
        wanted = features(still, Moment.of(still, time), at.astype(np.float32)) @ weights.T
        wanted[:, 3] += decoder.density_bias
        known = (baking._known & CORNER_BAKED).any(0).reshape(-1)
        # Each of a plane's numbers is off by half a step at most, of 32767 to the largest.
        largest = np.prod([max(np.abs(scale[name]).max() for scale in scene.scales) for name in SPACE_PLANES])
        off = 3 * largest * np.abs(weights).sum(1) * 0.5 / 32767 * max(np.abs(scale["xt"]).max() for scale in scene.scales) ** 3
        assert np.all(np.abs(baking.grid.reshape(-1, 4)[known] - wanted[known]) < off + 1e-4) and off.max() < 0.05
        assert known.mean() > 0.05


def test_what_overflows_is_finite() -> None:
    scene = one_sided(tiny_scene(4, channels=16))
    for value in (3e38, -3e38, 1e-38):
        for name in SPACE_PLANES:
            scene.scales[1][name][:] = value
        baking = baking_of(scene, time=0.3)
        assert np.isfinite(baking.grid).all() and np.abs(baking.grid).max() <= LARGEST


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
@pytest.mark.parametrize("where", ["box", "displaced", "opaque", "fog"])
def test_where_a_grid_holds_all_there_is_pictures_are_those_of_the_reference(where: str, view: Camera) -> None:
    scene = of_first_degree(one_sided(tiny_scene(4, scales=1, channels=32)))
    if where == "displaced":
        scene = displaced(scene)
    elif where == "opaque":
        scene = replace(scene, decoder=replace(scene.decoder, density_bias=60.0))
    elif where == "fog":
        weight = 0.02 * scene.decoder.density_weight
        scene = replace(scene, step=0.002, decoder=replace(scene.decoder, density_bias=0.0, density_weight=weight))
    renderer = Renderer(gl.context(), scene, BAKED)
    for time in (0.0, 0.6, 1.0):
        got, wanted = renderer.render(view, time), render(scene, view, time)
        off = np.abs(got.rgb - wanted.rgb).max(axis=2)
        assert np.mean(off <= 1 / 255) > 0.998 and np.mean(np.abs(got.opacity - wanted.opacity) <= 1 / 255) > 0.998
        apart = np.abs(got.samples - wanted.samples)  # one more or less where a sample lies on a cell's face
        assert np.mean(apart <= 1) > 0.99 and np.mean(apart == 0) > 0.95
        both = (got.opacity > 0.1) & (wanted.opacity > 0.1)
        assert np.mean(np.abs(got.depth[both] - wanted.depth[both]) < 2 * scene.step) > 0.99 if both.any() else True
    if view.width > 1:
        assert (wanted.opacity.max() > 0.1) == (view is not VIEWS["beside it"])


@pytest.mark.parametrize("edges", [(0.0, 1.0, 1.0), (1.0, 1.0, 1e-6)])
def test_boxes_without_a_volume_show_the_background(edges: tuple[float, float, float]) -> None:
    scene = replace(displaced(one_sided(tiny_scene(4, channels=16))), aabb=np.array([[0, 0, 0], edges], np.float32))
    for camera in (CAMERA, look_at((0.0, 0.0, 0.0), (1.0, 0.4, 0.3), 33, 21, 30.0)):
        got = Renderer(gl.context(), scene, BAKED).render(camera, 1.0)
        assert np.isfinite(got.rgb).all() and np.abs(got.rgb - scene.background).max() < 0.02


def test_what_is_no_number_is_no_place_in_an_array() -> None:
    places = np.array([np.nan, -np.inf, -1.0, 0.0, 2.5, 7.0, np.inf] * 5, np.float32)  # more than vectors hold
    np.testing.assert_array_equal(clamped(places, np.float32(5)), np.float32([0, 0, 0, 0, 2.5, 5, 5] * 5))


@pytest.mark.parametrize("change", [{"step": 2.0}, {"termination": 1 / 16}, {"across": 4}, {"resolution": 0.5}])
def test_qualities_mean_what_they_mean_for_planes(change: dict[str, float]) -> None:
    scene = displaced(of_first_degree(one_sided(tiny_scene(4, scales=1, channels=32, resolution=(90, 80, 70)))))
    camera = look_at((4.8, 2.0, 4.4), (0.1, 0.05, 0.05), 61, 45, 60.0) if "across" in change else CAMERA
    assert Baking.serves(scene)
    renderers = [Renderer(gl.context(), scene, replace(quality, **change)) for quality in (BAKED, FOLDED)]
    if "termination" in change:
        renderers[0].quality = replace(BAKED, baked=change["termination"])
    assert renderers[0].rays_across(camera) > 1 or "across" not in change
    got, wanted = (renderer.render(camera, 0.6) for renderer in renderers)
    np.testing.assert_allclose(got.rgb, wanted.rgb, atol=2e-3)
    assert np.mean(got.samples == wanted.samples) > 0.99 and wanted.samples.sum() > 100


@pytest.mark.parametrize("space", ["box", "displaced"])
def test_pictures_are_near_those_of_the_reference(space: str) -> None:
    """Of a scene of 24 texels, smooth over six; nearer than to those of another time. What is exact, or static, looks up planes."""
    scene = SPACES[space](one_sided(tiny_scene(4, channels=16)))
    renderer = Renderer(gl.context(), scene, BAKED)
    assert renderer.bakes == renderer._is_software
    assert renderer.marched_by == ("the processor itself" if renderer.bakes else "fragment shaders")
    for time in (0.1, 0.5, 0.9):
        got, wanted = renderer.render(CAMERA, time), render(scene, CAMERA, time)
        assert -10 * np.log10(np.mean((got.rgb - wanted.rgb) ** 2)) > 40
        assert np.mean(np.abs(got.samples - wanted.samples) <= 1) > 0.95
    still = renderer.render(CAMERA, 0.9, part=Part.STATIC)
    np.testing.assert_array_equal(still.rgb, Renderer(gl.context(), scene, FOLDED).render(CAMERA, 0.9, part=Part.STATIC).rgb)
    renderer.quality = LADDER["reference"]
    assert renderer.marched_by == "fragment shaders"
    exact = renderer.render(CAMERA, 0.9)
    np.testing.assert_array_equal(exact.rgb, Renderer(gl.context(), scene, LADDER["reference"]).render(CAMERA, 0.9).rgb)


def test_what_it_takes_is_counted() -> None:
    baking = baking_of(one_sided(tiny_scene(4, channels=16)))
    taken = baking.grid.nbytes + baking._known.nbytes + sum(plane.nbytes for plane in baking._planes)
    assert taken == baking.memory_bytes


def test_a_picture_hangs_on_none_before_it() -> None:
    scene = displaced(one_sided(tiny_scene(4, channels=16)))
    renderer = Renderer(gl.context(), scene, LADDER["balanced"])
    for time in (0.1, 0.11, 0.7, 0.12):
        got = renderer.render(CAMERA, time)
    if not renderer.bakes:
        pytest.skip("a graphics card, which bakes nothing")
    np.testing.assert_array_equal(got.rgb, Renderer(gl.context(), scene, LADDER["balanced"]).render(CAMERA, 0.12).rgb)


def test_planes_that_arrive_later_count() -> None:
    scene = one_sided(tiny_scene(4, channels=16))
    early = without_planes(scene)
    renderer, whole = Renderer(gl.context(), early, BAKED), Renderer(gl.context(), scene, BAKED)
    renderer.render(CAMERA, 0.5)
    bring(renderer, early, scene)
    np.testing.assert_array_equal(renderer.render(CAMERA, 0.5).rgb, whole.render(CAMERA, 0.5).rgb)


def test_scenes_that_it_would_not_serve_are_looked_up_in_planes() -> None:
    assert Baking.serves(one_sided(tiny_scene(channels=16)))
    fine = one_sided(tiny_scene(scales=1, channels=30, resolution=(200, 180, 120)))
    assert np.prod(corners_of(fine)) > MOST_CORNERS
    mapped = [SPACES[space](one_sided(tiny_scene(channels=16))) for space in ("ndc", "contracted")]
    for scene in (*mapped, tiny_scene(channels=16), one_sided(tiny_scene(channels=16, dynamic=False)), one_sided(tiny_scene()), fine, SPACES["hybrid"](tiny_scene(channels=16))):
        assert not Baking.serves(scene)
        got, wanted = (Renderer(gl.context(), scene, quality).render(CAMERA, 0.5) for quality in (BAKED, FOLDED))
        np.testing.assert_array_equal(got.rgb, wanted.rgb)


def test_what_is_rehearsed_is_what_pictures_need() -> None:
    """Whether or not anything is displaced."""
    rehearse()
    before = list(cast.signatures)
    for make in SCENES.values():
        baking_of(make(), time=0.3)
    assert cast.signatures == before and len(before) == 1
