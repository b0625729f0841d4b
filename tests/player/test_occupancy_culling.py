"""Cells that are empty at one time, against the reference."""

from dataclasses import replace

import gl
import numpy as np
import pytest
from kpc.format.scene.scene import Scene
from kpc.player.atlas import Layout, TimeRows
from kpc.player.cpu.occupancy_culling import OccupancyCulling
from kpc.player.cpu.reference import Part, SceneAtTime, features, occupancy_slot, render
from kpc.player.gl import renderer as module
from kpc.player.gl.renderer import Renderer
from kpc.player.quality import LEVELS, Quality
from scenes import VARIANTS, look_at, stream_planes, tiny_scene, with_motion, without_planes

CAMERA = look_at((2.4, 1.0, 2.2), (0.1, 0.05, 0.05), 64, 48, 70.0)
FOLDED = Quality(folded=True)


def moving(channels: int = 8, resolution: tuple[int, int, int] = (24, 20, 16)) -> Scene:
    """A scene much of which is empty some of the time."""
    scene = tiny_scene(4, channels=channels, resolution=resolution)
    return replace(
        scene, decoder=replace(scene.decoder, density_weight=3 * scene.decoder.density_weight, density_bias=-13.0)
    )


def thinning_of(scene: Scene) -> OccupancyCulling:
    renderer = Renderer(gl.context(), scene, FOLDED)
    return renderer._kept(OccupancyCulling)


@pytest.fixture(autouse=True, params=[False, True], ids=["shaders", "processor"])
def who_marches(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "marches_itself", lambda ctx: request.param and module.is_software(ctx))


def densities_of_folded(scene: Scene, places: np.ndarray, time: float) -> np.ndarray:
    """The reference's, of a scene whose rows at a time are multiplied into its planes, texel by texel."""
    moment = SceneAtTime.of(scene, time)
    scales = tuple(
        {"xy": scale["xy"] * rows["x"], "xz": scale["xz"] * rows["z"][:, None], "yz": scale["yz"] * rows["y"]}
        for scale, rows in zip(scene.scales, moment.rows, strict=True)
    )
    folded = replace(moment, rows=tuple({} for _ in scales))
    return (
        features(replace(scene, scales=scales), folded, places) @ scene.decoder.density_weight
        + scene.decoder.density_bias
    )


@pytest.mark.parametrize(
    "scene", [moving(), moving(5, (9, 20, 1)), with_motion(moving())], ids=["even", "odd", "displaced"]
)
def test_densities_are_those_of_folded_planes(scene: Scene) -> None:
    rng, thinning = np.random.default_rng(3), thinning_of(scene)
    rows = TimeRows(scene, Layout.of(scene))
    for time in (0.0, 0.37, 1.0):
        places = np.concatenate(
            [rng.random((1 << 16, 3), np.float32), np.eye(3, dtype=np.float32), np.ones((1, 3), np.float32)]
        )
        got, wanted = thinning.log_densities(places, rows.at(time), time), densities_of_folded(scene, places, time)
        np.testing.assert_allclose(got, wanted, rtol=1e-4, atol=1e-4 * np.abs(wanted).max())


def test_a_cell_is_empty_whose_corners_are() -> None:
    scene = moving()
    thinning, rows = thinning_of(scene), TimeRows(scene, Layout.of(scene))
    for time in (0.1, 0.2, 0.9):
        slot = occupancy_slot(scene, time)
        occupied = scene.occupancy[slot]
        corners = np.argwhere(np.ones([side + 1 for side in occupied.shape], bool))[:, ::-1] / np.array(
            occupied.shape[::-1]
        )
        sigma = np.exp(np.float64(densities_of_folded(scene, corners.astype(np.float32), time)))
        alpha = (1 - np.exp(-sigma * scene.step / scene.extent)).reshape([side + 1 for side in occupied.shape])
        most = np.max([alpha[z : z + 8, y : y + 10, x : x + 12] for z, y, x in np.ndindex(2, 2, 2)], axis=0)
        for limit in (1e-6, 0.004, 0.03, 0.5, 0.9):
            empty = thinning.empty(slot, rows.at(time), time, limit)
            clear = np.abs(most / limit - 1) > 0.01
            assert np.array_equal(empty[clear], (occupied & (most < limit))[clear]) and clear.mean() > 0.9
            assert empty.any() or limit < 0.03


def test_nothing_is_empty_where_no_density_is_less() -> None:
    scene = moving()
    scene = replace(scene, decoder=replace(scene.decoder, density_bias=-100.0))
    empty = thinning_of(scene).empty(0, TimeRows(scene, Layout.of(scene)).at(0.0), 0.0, 1e-12)
    assert not empty.any()


@pytest.mark.parametrize("space", ["box", "displaced", "ndc"])
def test_rays_pass_by_what_is_empty_and_pictures_stay(space: str) -> None:
    scene = VARIANTS[space](moving())
    whole, thin = (
        Renderer(gl.context(), scene, FOLDED),
        Renderer(gl.context(), scene, replace(FOLDED, culling_alpha=1 / 100)),
    )
    for time in (0.1, 0.5, 0.9):
        wanted, got = whole.render(CAMERA, time), thin.render(CAMERA, time)
        assert got.samples.sum() < 0.9 * wanted.samples.sum()
        assert -10 * np.log10(np.mean((got.rgb - wanted.rgb) ** 2)) > 40
    # What is exact, or static, sees all of the slot again.
    np.testing.assert_array_equal(
        thin.render(CAMERA, 0.9, part=Part.STATIC).samples, whole.render(CAMERA, 0.9, part=Part.STATIC).samples
    )
    thin.render(CAMERA, 0.9)
    thin.quality = LEVELS["reference"]
    assert np.mean(thin.render(CAMERA, 0.9).samples == render(scene, CAMERA, 0.9).samples) > 0.99


def test_planes_that_arrive_later_count() -> None:
    scene = moving()
    early = without_planes(scene)
    quality = replace(FOLDED, culling_alpha=1 / 100)
    renderer, whole = Renderer(gl.context(), early, quality), Renderer(gl.context(), scene, quality)
    renderer.render(CAMERA, 0.5)
    stream_planes(renderer, early, scene)
    got, wanted = renderer.render(CAMERA, 0.5), whole.render(CAMERA, 0.5)
    np.testing.assert_array_equal(got.samples, wanted.samples)
    np.testing.assert_array_equal(got.rgb, wanted.rgb)


def test_scenes_that_it_would_not_serve_keep_their_cells() -> None:
    assert OccupancyCulling.serves(moving())
    one_slot = replace(moving(), occupancy=moving().occupancy[:1])
    fine = moving(resolution=(40, 20, 16))  # more than two texels a cell
    for scene in (one_slot, fine, VARIANTS["hybrid"](moving()), VARIANTS["contracted"](moving())):
        assert not OccupancyCulling.serves(scene)
        Renderer(gl.context(), scene, replace(FOLDED, culling_alpha=1 / 100)).render(CAMERA, 0.5)
