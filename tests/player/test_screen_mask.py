"""Blocks of a picture that can show anything."""

from dataclasses import replace

import numpy as np
import pytest

import gl
from kpc.format.scene.scene import Scene
from kpc.player.cpu import cpu_renderer
from kpc.player.cpu.reference import occupancy_slot, render
from kpc.player.cpu.screen_mask import MOST_CELLS, ScreenMask
from kpc.player.gl.presentation import DisplayMode
from kpc.player.gl.renderer import Renderer
from kpc.player.quality import LEVELS, Quality
from processor import draw, processor_of, psnr
from scenes import look_at, tiny_scene, with_motion

CAMERAS = {
    "near": look_at((2.4, 1.0, 2.2), (0.1, 0.05, 0.05), 61, 43, 60.0),
    "far": look_at((20.0, 9.0, -30.0), (0.1, 0.05, 0.05), 64, 48, 160.0),
    "beside": look_at((2.4, 1.0, 2.2), (2.0, 3.0, 0.05), 50, 50, 30.0),
    "away": look_at((2.4, 1.0, 2.2), (4.8, 2.0, 4.4), 32, 32, 30.0),
    "wide": look_at((1.4, 0.1, 1.9), (0.1, 1.4, 0.05), 90, 30, 14.0),
}


def sparse(scene: Scene, share: float, seed: int = 0) -> Scene:
    """A few cells of each slot, no two slots alike."""
    scene.occupancy[:] = np.random.default_rng(seed).random(scene.occupancy.shape) < share
    return scene


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("share", [0.003, 0.05, 1.0])
def test_no_ray_of_the_other_blocks_has_a_sample(camera: str, share: float) -> None:
    scene, view, side = sparse(tiny_scene(3), share), CAMERAS[camera], 4
    blocks = ScreenMask.of(scene.occupancy[occupancy_slot(scene, 0.4)], scene.aabb).blocks(view, side)
    assert blocks is not None and blocks.shape == (-(-view.height // side), -(-view.width // side))
    pixels = blocks.repeat(side, 0).repeat(side, 1)[: view.height, : view.width][::-1]
    assert not render(scene, view, 0.4).samples[~pixels].any()
    if camera == "away":
        assert not blocks.any()
    if camera == "far":
        assert blocks.any() and blocks.mean() < 0.5


def test_many_cells_are_covered_by_fewer_cubes() -> None:
    occupied = np.random.default_rng(1).random((70, 61, 83)) < 0.3
    aabb = np.array([[-1.0, -2.0, 0.0], [3.0, 1.0, 2.5]])
    cover = ScreenMask.of(occupied, aabb)
    assert len(cover.centres) <= MOST_CELLS
    cell = (aabb[1] - aabb[0]) / occupied.shape[::-1]
    z, y, x = np.nonzero(occupied)
    view = look_at((9.0, 7.0, 8.0), (1.0, -0.5, 1.0), 320, 240, 700.0)
    blocks = cover.blocks(view, 4)
    assert blocks is not None
    local = (aabb[0] + cell * (np.stack([x, y, z], -1) + 0.5) - view.camera_to_world[:3, 3]) @ view.camera_to_world[
        :3, :3
    ]
    column, row = (
        view.cx - view.fl_x * local[:, 0] / local[:, 2],
        view.height - view.cy - view.fl_y * local[:, 1] / local[:, 2],
    )
    seen = (column >= 0) & (column < 320) & (row >= 0) & (row < 240)
    assert seen.sum() > 1000 and blocks[row[seen].astype(int) // 4, column[seen].astype(int) // 4].all()


def test_nothing_occupied_covers_nothing() -> None:
    blocks = ScreenMask.of(np.zeros((5, 6, 7), bool), np.array([[0.0, 0, 0], [1, 1, 1]])).blocks(CAMERAS["near"], 4)
    assert blocks is not None and not blocks.any()


def test_a_camera_within_occupied_cells_has_no_mask() -> None:
    scene = tiny_scene(3)
    inside = look_at((0.1, 0.05, 0.05), (1.0, 0.0, 0.0), 32, 24, 30.0)
    assert (
        ScreenMask.of(np.ones((8, 8, 8), bool), scene.aabb).blocks(
            look_at(tuple(scene.aabb[0]), (0.0, 0.0, 0.0), 8, 8, 9.0), 4
        )
        is None
    )
    filled = np.zeros((8, 8, 8), bool)
    filled[3:5, 3:5, 3:5] = True
    assert ScreenMask.of(filled, scene.aabb).blocks(inside, 4) is None


@pytest.mark.parametrize("kind", ["plain", "displaced"])
@pytest.mark.parametrize("camera", ["near", "far", "beside", "away"])
def test_pictures_are_the_same_without_a_mask(monkeypatch: pytest.MonkeyPatch, kind: str, camera: str) -> None:
    make = {"plain": lambda s: s, "displaced": with_motion}[kind]
    scene, view = sparse(make(tiny_scene(3)), 0.02), CAMERAS[camera]
    for name in ("finer", "balanced"):
        pictures = []
        for most in (cpu_renderer.MOST_MASKED, -1.0):
            monkeypatch.setattr(cpu_renderer, "MOST_MASKED", most)
            renderer = processor_of(scene)
            pictures.append([draw(renderer, view, time, LEVELS[name]) for time in (0.3, 0.31, 0.32, 0.7, 0.7)])
        for one, other in zip(*pictures, strict=True):
            np.testing.assert_array_equal(one, other, name)


def test_earlier_pictures_leave_nothing_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = tiny_scene(4, resolution=(33, 17, 17))
    renderer, most = processor_of(scene), cpu_renderer.MOST_MASKED
    coarse, predicted = (
        Quality(folded=True, interpolation_tolerance=0.005),
        Quality(folded=True, reprojection_tolerance=0.02),
    )
    for number, away in enumerate(((2.0, 1.0), (-3.0, 4.0), (0.5, -9.0), (6.0, 2.0))):
        camera = look_at((away[0], away[1], 3.0), (0.1 * number - 0.2, 0.0, 0.0), 96, 64, 70.0)
        for quality in (coarse, predicted, coarse):
            for time in (0.3, 0.31):
                monkeypatch.setattr(cpu_renderer, "MOST_MASKED", most)
                got = draw(renderer, camera, time, quality)
                monkeypatch.setattr(cpu_renderer, "MOST_MASKED", -1.0)
                wanted = draw(processor_of(scene), camera, time, replace(quality, reprojection_tolerance=0.0))
                assert psnr(got, wanted) > (60 if quality is coarse else 40)


@pytest.mark.parametrize("size", [(96, 64), (201, 97)])
def test_a_screen_shows_nothing_of_earlier_pictures(monkeypatch: pytest.MonkeyPatch, size: tuple[int, int]) -> None:
    """Only the part with content is uploaded and drawn: after other cameras, and at once, the screen is the same."""
    scene, ctx, shown = tiny_scene(4, resolution=(33, 17, 17)), gl.context(), []
    cameras = [look_at((x, 1.0, 3.0), (0.3, 0.2, 0.0), 96, 64, 70.0) for x in (9.0, -2.0, 30.0, 4.0)]
    for mode in (DisplayMode.COLOUR, DisplayMode.DEPTH):
        for most, seen in ((cpu_renderer.MOST_MASKED, cameras), (-1.0, cameras[-1:])):
            monkeypatch.setattr(cpu_renderer, "MOST_MASKED", most)
            renderer, screen = Renderer(ctx, scene, LEVELS["balanced"], processor=True), ctx.simple_framebuffer(size, 4)
            for camera in seen:
                renderer.show(screen, camera, 0.3)
            renderer.show(screen, cameras[-1], 0.3, mode=mode, depths=(2.0, 6.0))
            shown.append(np.frombuffer(screen.read(), np.uint8).astype(int))
            monkeypatch.undo()
    for one, other in (shown[:2], shown[2:]):
        assert np.abs(one - other).max() <= 1 and len(np.unique(one)) > 50
