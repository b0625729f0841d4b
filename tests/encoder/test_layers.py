"""Scales of their own for what moves: their area, their features, and how a file holds them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import datasets as make
from kpc.encoder.coding.scene_writer import write
from kpc.encoder.datasets import Dataset, load_dataset
from kpc.encoder.field.config import PRESETS, TrainConfig
from kpc.encoder.field.field import Field
from kpc.encoder.field.fused import fused_features
from kpc.encoder.field.layout import Layout, layout_of_planes, plan_layout
from kpc.encoder.training.moving_area import find_moving_area
from kpc.encoder.training.train import Trainer
from kpc.format.coding.quantise import quantise_plane, quantise_scene
from kpc.format.common.films import write_video
from kpc.format.container import scene_io
from kpc.format.scene.scene import SPACE_PLANES, TIME_PLANES, Clip, Scene
from scenes import tiny_scene
from training_runs import BOX, trained
from training_runs import CONFIG as RUN

AREA = (0.2, 0.1, 0.3, 0.6, 1.0, 0.75)
CONFIG = TrainConfig(resolutions=(12, 24), channels=8, moving_area=AREA)
EDGES = np.array([[0, 0, 0], [2, 1.6, 1.4]], np.float32)
CLIP = Clip(10, 10.0)


@pytest.fixture(scope="module")
def field() -> Field:
    generator = torch.Generator().manual_seed(0)
    field = Field(plan_layout(CONFIG, EDGES, CLIP, True), 16, generator)
    with torch.no_grad():
        field.theta += 0.3 * torch.rand(field.theta.shape, generator=generator)
    field.restore_fixed()
    return field


@pytest.fixture(scope="module")
def rolling(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Return what five cameras see of a ball of radius 0.26 that moves along x from -0.8 to 0.8."""
    folder = tmp_path_factory.mktemp("rolling")
    (folder / "set").mkdir()
    rig = make.ring(5, width=128, height=96)
    for k, camera in enumerate(rig):
        beside = [camera.camera_to_world.copy() for _ in range(7)]
        for pose, x in zip(beside, np.linspace(-0.8, 0.8, len(beside)), strict=True):
            pose[0, 3] -= x
        pictures = (make.picture(replace(camera, camera_to_world=pose), -0.8) for pose in beside)
        write_video(folder / "set" / f"cam{k:02d}.mp4", pictures, make.FPS, crf=1, pix_fmt="yuv444p")
    np.save(folder / "set" / "poses_bounds.npy", make.poses_bounds(rig))
    return load_dataset(folder / "set", folder / "cache", progress=False)


def as_scene(field: Field) -> Scene:
    return field.to_scene(EDGES, CLIP, np.ones((1, 4, 4, 4), bool), np.zeros(3), 0.05)


def test_a_resolution_makes_a_still_scale_and_a_moving_one(field: Field) -> None:
    layout = field.layout
    assert [bool(rows) for rows in layout.resolution[:, 3]] == [False, True, False, True]
    assert layout.is_dynamic and not layout.is_uniform and (layout.held <= layout.resolution).all()
    for s in (1, 3):
        spaces = layout.resolution[s, :3] - 1
        low, high = layout.first[s] / spaces, (layout.first[s] + layout.held[s, :3] - 1) / spaces
        assert (low <= np.maximum(AREA[:3], 0)).all() and (high >= np.array(AREA[3:]) - 1e-6).all()
    assert layout.size < Layout.of(np.maximum(layout.resolution, (0, 0, 0, 10)), 8).size


def test_kernels_and_pytorch_agree_with_the_whole_planes(field: Field) -> None:
    """Features and their gradient; a file's planes cover the box, and are 0 outside the area."""
    generator = torch.Generator().manual_seed(1)
    points, times = torch.rand(5000, 3, generator=generator), torch.rand(5000, generator=generator)
    whole = Field.from_scene(as_scene(field)).features(points, times)
    weights, gradients = torch.randn(whole.shape, generator=generator), []
    for features in (field.features, fused_features(field)):
        found = features(points, times)
        torch.testing.assert_close(found, whole, rtol=0, atol=2e-6)
        field.theta.grad = None
        (found * weights).sum().backward()
        assert field.theta.grad is not None
        gradients.append(field.theta.grad.clone())
    torch.testing.assert_close(*gradients, rtol=0, atol=1e-5 * float(gradients[0].abs().max()))


def test_a_layout_of_planes_leaves_out_what_does_not_count(field: Field) -> None:
    scene = as_scene(field)
    layout = layout_of_planes(scene.scales)
    assert (layout.resolution[:, 3] == field.layout.resolution[:, 3]).all() and layout.size <= field.layout.size
    tight, generator = Field.from_scene(scene, layout), torch.Generator().manual_seed(3)
    points, times = torch.rand(5000, 3, generator=generator), torch.rand(5000, generator=generator)
    torch.testing.assert_close(tight.features(points, times), field.features(points, times), rtol=0, atol=2e-6)
    for scale, planes in enumerate(as_scene(tight).scales):
        for name, plane in planes.items():
            np.testing.assert_array_equal(plane, scene.scales[scale][name])


def test_a_layout_of_planes_without_parts_holds_all_texels() -> None:
    for dynamic in (True, False):
        scene = tiny_scene(dynamic=dynamic)
        layout = layout_of_planes(scene.scales)
        assert layout.is_uniform and layout.size == Field.from_scene(scene).layout.size


def test_gradients_of_points_are_those_of_the_whole_planes(field: Field) -> None:
    generator = torch.Generator().manual_seed(2)
    points, times = torch.rand(500, 3, generator=generator), torch.rand(500, generator=generator)
    weights, gradients = torch.randn(500, field.layout.features, generator=generator), []
    for one in (field, Field.from_scene(as_scene(field))):
        at = points.clone().requires_grad_(), times.clone().requires_grad_()
        (fused_features(one)(*at) * weights).sum().backward()
        gradients.append(torch.cat([at[0].grad, at[1].grad[:, None]], dim=1))
    assert float((gradients[0] - gradients[1]).abs().quantile(0.99)) < 1e-4 * float(gradients[0].abs().max())


def test_a_preset_may_have_fewer_resolutions_of_more_channels_for_what_moves_apart() -> None:
    fast = PRESETS["fast"]
    layered = fast.with_moving_area(AREA)
    assert (layered.resolutions, layered.channels, layered.moving_area) == ((160,), 16, AREA)
    assert plan_layout(layered, EDGES, CLIP, True).features == plan_layout(fast, EDGES, CLIP, True).features * 2
    assert fast.with_moving_area(AREA) == layered.with_moving_area(AREA)  # of a run that is resumed, or a later group
    for other in (replace(fast, scale_dropout=0.1), CONFIG):
        assert other.with_moving_area(AREA) == replace(other, moving_area=AREA)


def test_a_file_stores_nothing_outside_the_area(field: Field, tmp_path: Path) -> None:
    scene = as_scene(field)
    steps = [dict.fromkeys(scale, 0.02) for scale in scene.scales]
    write(quantise_scene(scene, steps), tmp_path / "a.kpc")
    read = scene_io.read(tmp_path / "a.kpc")
    for s, (first, held) in enumerate(zip(field.layout.first, field.layout.held, strict=True)):
        plane, (top, left) = read.scales[s]["xy"], first[1::-1]
        inside = np.zeros(plane.coded.shape, bool)
        inside[top : top + held[1], left : left + held[0]] = True
        assert not plane.coded[~inside].any() and not plane.dequantise()[~inside].any()
        for name in TIME_PLANES:
            assert held[3] or not read.scales[s][name].coded.any()


def test_planes_without_empty_edges_are_quantised_as_before() -> None:
    values = tiny_scene().scales[0]["xy"].copy()
    values[1, 1] = 0
    plane = quantise_plane(values, 0.01, identity=False)
    assert plane.coded.all() and plane.offset.any()


def test_the_border_of_the_area_stays_empty_in_training(rolling: Dataset) -> None:
    run = trained(rolling, moving_area=(0.2, 0.2, 0.3, 0.8, 0.8, 0.7))
    assert len(run.field.border) and not run.field.theta.detach()[run.field.border].any()
    scene = run.scene()
    assert scene.is_dynamic and len(scene.scales) == 2 * len(run.config.resolutions)
    for scale in scene.scales[1::2]:
        assert all(not scale[name][0].any() and scale[name].any() for name in SPACE_PLANES)


def test_the_moving_area_holds_what_moves(rolling: Dataset) -> None:
    area, why = find_moving_area(rolling, 2 * BOX, None)
    assert area is not None and "%" in why
    low, high = np.reshape(area.box, (2, 3)) * 4 - 2
    assert low[0] < -1.06 < 1.06 < high[0] and low[1] < -0.26 < 0.26 < high[1] and low[2] < -0.26 < 0.26 < high[2]
    assert np.prod(high - low) < 0.2 * 4**3
    cells = area.cells((16, 16, 16))
    assert cells[8, 8, 4:12].all() and not cells[:3].any() and not cells[13:].any()
    early, late = (area.between(*part).cells((16, 16, 16)) for part in ((0.0, 0.4), (0.6, 1.0)))
    assert early[8, 8, 5] and not early[:, :, 11:].any()  # it moves along x
    assert late[8, 8, 10] and not late[:, :, :5].any()
    np.testing.assert_array_equal(area.between(0.0, 1.0).hulls, area.hulls)
    np.testing.assert_array_equal(area.between(0.6, 1.0).between(0.5, 1.0).hulls, area.between(0.8, 1.0).hulls)


def test_cells_where_something_moves_stay_occupied_for_a_part_of_the_run(rolling: Dataset) -> None:
    area, _ = find_moving_area(rolling, 2 * BOX, None)
    assert area is not None
    config = replace(RUN, moving_area=area.box, occupancy_start=1, occupancy_every=1, moving_kept=0.5, steps=20)
    run = Trainer(rolling, config, 2 * BOX, "cpu", moving=area)
    run.grid.threshold = 100.0  # nothing is dense enough
    kept = run.grid.kept
    assert kept is not None and kept.any()
    run.run_until(8)
    np.testing.assert_array_equal(run.grid.occupied & kept, kept)
    np.testing.assert_array_equal(run.grid.active.any(0) & kept, kept)
    run.run_until(12)
    assert run.grid.kept is None and (run.grid.occupied & kept).sum() < kept.sum()


@pytest.mark.parametrize("steps", [6, 14, 20])
def test_a_resumed_run_keeps_the_same_cells_occupied(rolling: Dataset, tmp_path: Path, steps: int) -> None:
    area, _ = find_moving_area(rolling, 2 * BOX, None)
    config = replace(RUN, moving_area=area.box, occupancy_start=1, occupancy_every=4, moving_kept=0.5, steps=20)
    first, second = (Trainer(rolling, config, 2 * BOX, "cpu", moving=area) for _ in range(2))
    first.grid.threshold = second.grid.threshold = 100.0  # nothing is dense enough
    first.run_until(steps)
    first.save(tmp_path / "checkpoint.kpck")
    second.resume(tmp_path / "checkpoint.kpck")
    for name in ("occupied", "active", "marched"):
        np.testing.assert_array_equal(getattr(second.grid, name), getattr(first.grid, name))


def test_no_area_is_found_where_cameras_move_or_all_of_space_does(moving: Dataset, rolling: Dataset) -> None:
    assert find_moving_area(moving, BOX, None) == (None, "cameras move, or show one picture each")
    area, why = find_moving_area(rolling, np.array([[-0.9, -0.3, -0.3], [0.9, 0.3, 0.3]], np.float32), None)
    assert area is None and "of the space" in why
