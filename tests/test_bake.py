"""What planes come to at the corners of their texels, against the reference."""

from dataclasses import replace

import gl
import numpy as np
import pytest
from scenes import SPACES, bring, displaced, look_at, tiny_scene, without_planes

from kpc.format.grid import linear, tap
from kpc.format.motion import moved
from kpc.format.scene import SPACE_PLANES, Scene
from kpc.player.bake import LARGEST, MOST_CORNERS, SPANS_KEPT, Baking, corners_of
from kpc.player.quality import LADDER, Quality
from kpc.player.reference import Moment, Part, features, render, slot_at
from kpc.player.renderer import Renderer
from kpc.player.textures import Layout

CAMERA = look_at((2.4, 1.0, 2.2), (0.1, 0.05, 0.05), 64, 48, 70.0)
FOLDED, BAKED = Quality(folded=True), Quality(folded=True, baked=True)


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


def row_of(scene: Scene, time: float) -> int:
    """Of the motion grid, the one before a time."""
    return 0 if scene.motion is None else int(tap(np.float32(time), len(scene.motion))[0])


def baking_of(scene: Scene, refined: int = 2) -> Baking:
    renderer = Renderer(gl.context(), scene, BAKED)
    renderer.folded_layout = Layout.of(scene, refined)
    renderer.march(CAMERA, 0.0)
    return renderer._folded.baking


SCENES = {"even": lambda: one_sided(tiny_scene(4, channels=16)), "uneven": uneven, "flat": flat, "displaced": lambda: displaced(one_sided(tiny_scene(4, channels=16)))}


@pytest.mark.parametrize("refined", [1, 2])
@pytest.mark.parametrize("make", SCENES.values(), ids=SCENES)
def test_corners_hold_what_a_sample_there_finds(make, refined: int) -> None:
    scene = make()
    baking = baking_of(scene, refined)
    shape = corners_of(scene)
    at = np.argwhere(np.ones(shape, bool))[:, ::-1] / np.maximum(np.array(shape[::-1]) - 1, 1)
    still, decoder = replace(scene, motion=None), scene.decoder
    weights = np.concatenate([decoder.b2, decoder.density_weight[None]]).astype(np.float64)
    for time in (0.0, 0.37, 1.0):
        baking.bake(slot_at(scene, time), time)
        wanted = features(still, Moment.of(still, time), at.astype(np.float32)) @ weights.T
        wanted[:, 3] += decoder.density_bias
        reached = baking._reached(slot_at(scene, time), row_of(scene, time)).reshape(-1)
        np.testing.assert_allclose(baking.grid.reshape(-1, 4)[reached], wanted[reached], rtol=1e-4, atol=1e-4)
        assert reached.mean() > 0.2


@pytest.mark.parametrize("most", [0.0, 0.05, 0.6])
def test_no_corner_that_is_looked_at_is_missed(most: float) -> None:
    """Nodes of the motion grid lie amid cells, too, and places beyond those of a cell's corners there."""
    scene, rng = one_sided(tiny_scene(4, channels=16, resolution=(93, 79, 81))), np.random.default_rng(1)
    scene = replace(scene, motion=rng.uniform(-most, most, (6, 6, 4, 6, 3)).astype(np.float32))
    scene.occupancy[:] = rng.random(scene.occupancy.shape) < 0.01
    baking, texels = baking_of(scene), np.array(corners_of(scene)[::-1]) - 1
    for time in (0.0, 0.13, 0.34, 0.66, 0.67, 0.99, 1.0):
        slot = slot_at(scene, time)
        cells = np.argwhere(scene.occupancy[slot])[:, ::-1]
        u = ((cells[rng.integers(0, len(cells), 20_000)] + rng.random((20_000, 3))) / scene.occupancy.shape[:0:-1]).astype(np.float32)
        position = moved(u, linear(scene.motion, time)) * texels
        first = np.minimum(position.astype(int), texels - 1)
        reached = baking._reached(slot, row_of(scene, time))
        for offset in np.ndindex(2, 2, 2):
            counts = (np.abs(position - first - offset) < 1 - 1e-3).all(1)
            x, y, z = (first + offset)[counts].T
            assert reached[z, y, x].all()
        assert reached.mean() < 0.9


def test_what_overflows_is_finite() -> None:
    scene = one_sided(tiny_scene(4, channels=16))
    for value in (3e38, -3e38, 1e-38):
        for name in SPACE_PLANES:
            scene.scales[1][name][:] = value
        baking = baking_of(scene)
        baking.bake(0, 0.3)
        assert np.isfinite(baking.grid).all() and np.abs(baking.grid).max() <= LARGEST


def test_where_products_are_of_the_first_degree_pictures_are_those_of_folded_planes() -> None:
    """One plane that varies, of one scale: in between corners as the planes themselves."""
    scene = one_sided(tiny_scene(4, scales=1, channels=32))
    for name in ("xz", "yz"):
        scene.scales[0][name][:] = 1.0
    for name in ("yt", "zt"):
        scene.scales[0][name][:] = scene.scales[0][name][:, :1]  # the same all along their axes
    scene.scales[0]["xt"][:] = scene.scales[0]["xt"][:, :1]
    for scene in (scene, displaced(scene)):
        for time in (0.1, 0.6):
            got, wanted = (Renderer(gl.context(), scene, quality).render(CAMERA, time) for quality in (BAKED, FOLDED))
            np.testing.assert_allclose(got.rgb, wanted.rgb, atol=2e-4)
            assert np.mean(got.samples == wanted.samples) > 0.999 and wanted.samples.sum() > 1000


@pytest.mark.parametrize("space", ["box", "displaced", "ndc", "contracted"])
def test_pictures_are_near_those_of_the_reference(space: str) -> None:
    """Of a scene of 24 texels, smooth over six; nearer than to those of another time. What is exact, or static, looks up planes."""
    scene = SPACES[space](one_sided(tiny_scene(4, channels=16)))
    renderer = Renderer(gl.context(), scene, BAKED)
    assert renderer.bakes == renderer._is_software
    for time in (0.1, 0.5, 0.9):
        got, wanted = renderer.render(CAMERA, time), render(scene, CAMERA, time)
        assert -10 * np.log10(np.mean((got.rgb - wanted.rgb) ** 2)) > 40
        assert np.mean(np.abs(got.samples - wanted.samples) <= 1) > 0.95
    still = renderer.render(CAMERA, 0.9, part=Part.STATIC)
    np.testing.assert_array_equal(still.rgb, Renderer(gl.context(), scene, FOLDED).render(CAMERA, 0.9, part=Part.STATIC).rgb)
    renderer.quality = LADDER["reference"]
    exact = renderer.render(CAMERA, 0.9)
    np.testing.assert_array_equal(exact.rgb, Renderer(gl.context(), scene, LADDER["reference"]).render(CAMERA, 0.9).rgb)


def test_what_it_takes_is_bounded_however_long_the_clip() -> None:
    scene, rows = one_sided(tiny_scene(4, channels=16)), SPANS_KEPT + 30
    scene = replace(scene, motion=np.random.default_rng(0).uniform(-0.1, 0.1, (rows, 3, 2, 4, 3)).astype(np.float32))
    baking = baking_of(scene)
    for time in np.linspace(0, 1, 2 * rows):
        baking.bake(slot_at(scene, time), float(time))
    tables = sum(spans.nbytes for spans in baking._spans.values())
    planes = sum(plane.nbytes for plane in baking._planes.values())
    assert len(baking._spans) == SPANS_KEPT and 2 * baking.grid.nbytes + planes + tables <= baking.memory_bytes < 4 * (2 * baking.grid.nbytes + planes)


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
    fine = one_sided(tiny_scene(scales=1, channels=30, resolution=(128, 128, 80)))
    assert np.prod(corners_of(fine)) > MOST_CORNERS
    for scene in (tiny_scene(channels=16), one_sided(tiny_scene(channels=16, dynamic=False)), one_sided(tiny_scene()), fine, SPACES["hybrid"](tiny_scene(channels=16))):
        assert not Baking.serves(scene)
        got, wanted = (Renderer(gl.context(), scene, quality).render(CAMERA, 0.5) for quality in (BAKED, FOLDED))
        np.testing.assert_array_equal(got.rgb, wanted.rgb)
