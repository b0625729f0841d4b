"""Cells that are empty at one time, against the reference."""

from dataclasses import replace

import numpy as np
import pytest

import gl
from kpc.format.scene.scene import Scene
from kpc.player.atlas import Layout
from kpc.player.cpu.occupancy_culling import OccupancyCulling
from kpc.player.cpu.plane_sampler import PlaneSampler
from kpc.player.cpu.reference import Part, SceneAtTime, features, occupancy_slot, render
from kpc.player.gl.renderer import Renderer
from kpc.player.quality import LEVELS, Quality
from processor import atlas_of
from scenes import VARIANTS, look_at, stream_planes, tiny_scene, with_motion, without_planes

CAMERA = look_at((2.4, 1.0, 2.2), (0.1, 0.05, 0.05), 64, 48, 70.0)
FOLDED = Quality(folded=True)


def moving(channels: int = 8, resolution: tuple[int, int, int] = (24, 20, 16)) -> Scene:
    """A scene much of which is empty some of the time."""
    scene = tiny_scene(4, channels=channels, resolution=resolution)
    return replace(
        scene, decoder=replace(scene.decoder, density_weight=3 * scene.decoder.density_weight, density_bias=-13.0)
    )


def culling_at(scene: Scene, time: float) -> tuple[OccupancyCulling, PlaneSampler]:
    sampler = PlaneSampler(scene, Layout.of(scene))
    sampler.set_planes(atlas_of(scene))
    sampler.prepare(time, np.zeros(16, np.float32))
    return OccupancyCulling(scene, sampler), sampler


def log_densities(scene: Scene, positions: np.ndarray, time: float) -> np.ndarray:
    """The reference's."""
    f = features(scene, SceneAtTime.of(scene, time), positions)
    return f @ scene.decoder.density_weight + scene.decoder.density_bias


@pytest.mark.parametrize(
    "scene", [moving(), moving(5, (9, 20, 1)), with_motion(moving())], ids=["even", "odd", "displaced"]
)
def test_densities_are_those_of_the_reference(scene: Scene) -> None:
    rng = np.random.default_rng(3)
    corners = np.concatenate([np.eye(3, dtype=np.float32), np.ones((1, 3), np.float32)])
    positions = np.concatenate([rng.random((1 << 14, 3), np.float32), corners])
    for time in (0.0, 0.37, 1.0):
        _, sampler = culling_at(scene, time)
        got, wanted = np.empty(len(positions), np.float32), log_densities(scene, positions, time)
        sampler.log_densities(positions, got)
        # Each of three factors is off by half of 1 / 32767 of its plane's largest number.
        np.testing.assert_allclose(got, wanted, atol=2e-4 * np.abs(wanted).max())


def test_a_cell_is_empty_whose_corners_are() -> None:
    scene = moving()
    for time in (0.1, 0.2, 0.9):
        slot, (culling, _) = occupancy_slot(scene, time), culling_at(scene, time)
        occupied = scene.occupancy[slot]
        corners = np.argwhere(np.ones([side + 1 for side in occupied.shape], bool))[:, ::-1] / np.array(
            occupied.shape[::-1]
        )
        sigma = np.exp(np.float64(log_densities(scene, corners.astype(np.float32), time)))
        alpha = (1 - np.exp(-sigma * scene.step / scene.extent)).reshape([side + 1 for side in occupied.shape])
        most = np.max([alpha[z : z + 8, y : y + 10, x : x + 12] for z, y, x in np.ndindex(2, 2, 2)], axis=0)
        for limit in (1e-6, 0.004, 0.03, 0.5, 0.9):
            empty = culling.empty(slot, limit)
            clear = np.abs(most / limit - 1) > 0.01
            assert np.array_equal(empty[clear], (occupied & (most < limit))[clear]) and clear.mean() > 0.9
            assert empty.any() or limit < 0.03


def test_nothing_is_culled_below_the_least_density() -> None:
    scene = moving()
    scene = replace(scene, decoder=replace(scene.decoder, density_bias=-100.0))
    assert not culling_at(scene, 0.0)[0].empty(0, 1e-12).any()


@pytest.mark.parametrize("variant", ["box", "displaced"])
def test_rays_skip_what_is_empty_and_pictures_stay(variant: str) -> None:
    scene = VARIANTS[variant](moving())
    whole, culled = FOLDED, replace(FOLDED, culling_alpha=1 / 100)
    renderer = Renderer(gl.context(), scene, processor=True)
    for time in (0.1, 0.5, 0.9):
        renderer.quality = whole
        wanted = renderer.render(CAMERA, time)
        renderer.quality = culled
        got = renderer.render(CAMERA, time)
        assert got.samples.sum() < 0.9 * wanted.samples.sum()
        assert -10 * np.log10(np.mean((got.rgb - wanted.rgb) ** 2)) > 40
    # The static part and the exact level see the whole slot again.
    statics = []
    for renderer.quality in (whole, culled):
        statics.append(renderer.render(CAMERA, 0.9, part=Part.STATIC).samples)
    np.testing.assert_array_equal(*statics)
    renderer.render(CAMERA, 0.9)
    renderer.quality = LEVELS["reference"]
    assert np.mean(renderer.render(CAMERA, 0.9).samples == render(scene, CAMERA, 0.9).samples) > 0.99


def test_planes_that_arrive_later_are_drawn() -> None:
    scene = moving()
    early = without_planes(scene)
    quality = replace(FOLDED, culling_alpha=1 / 100)
    renderer, whole = (
        Renderer(gl.context(), early, quality, processor=True),
        Renderer(gl.context(), scene, quality, processor=True),
    )
    renderer.render(CAMERA, 0.5)
    stream_planes(renderer, early, scene)
    got, wanted = renderer.render(CAMERA, 0.5), whole.render(CAMERA, 0.5)
    np.testing.assert_array_equal(got.samples, wanted.samples)
    np.testing.assert_array_equal(got.rgb, wanted.rgb)


def test_scenes_that_it_does_not_serve_keep_their_cells() -> None:
    assert OccupancyCulling.serves(moving())
    one_slot = replace(moving(), occupancy=moving().occupancy[:1])
    fine = moving(resolution=(40, 20, 16))  # more than two texels a cell
    for scene in (one_slot, fine, VARIANTS["hybrid"](moving()), VARIANTS["contracted"](moving())):
        assert not OccupancyCulling.serves(scene)
        Renderer(gl.context(), scene, replace(FOLDED, culling_alpha=1 / 100)).render(CAMERA, 0.5)
