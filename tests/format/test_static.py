"""Static and constant cells, their fractions, and the motion map."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from kpc.encoder.coding.scene_writer import write
from kpc.format.coding.quantise import needed_texels, quantise_scene
from kpc.format.scene.scene import SPACE_PLANES, TIME_PLANES, Scene
from kpc.format.scene.static import cells_reading, constant_cells, constant_fraction, static_cells, static_fraction
from kpc.player.cpu import motion_map, reference
from kpc.player.cpu.motion_map import motionless_share
from kpc.player.cpu.reference import SceneAtTime
from kpc.tools.cli import kpinfo
from scenes import VARIANTS, tiny_scene, with_moving_area


def still(scene: Scene) -> Scene:
    """Return the scene with time planes of 1 and the occupancy of its first slot throughout."""
    scales = tuple(
        {name: np.ones_like(p) if name in TIME_PLANES else p for name, p in scale.items()} for scale in scene.scales
    )
    return replace(scene, scales=scales, occupancy=np.repeat(scene.occupancy[:1], len(scene.occupancy), axis=0))


def with_changed_texels(scene: Scene, plane: str, rows: slice, columns: slice, factor: float = 0.5) -> Scene:
    """Return the scene with some texels of its finest time plane `plane` multiplied by `factor`."""
    values = scene.scales[-1][plane].copy()
    values[rows, columns] *= factor
    return replace(scene, scales=(*scene.scales[:-1], {**scene.scales[-1], plane: values}))


def box_of_cells(time: int = 9) -> Scene:
    """Return a scene with nine texels per axis and 8 x 8 x 8 cells in four slots, all occupied."""
    return replace(still(tiny_scene(resolution=(9, 9, 9), time=time)), occupancy=np.ones((4, 8, 8, 8), bool))


@pytest.mark.parametrize("plane, axis", [("xt", 2), ("yt", 1), ("zt", 0)])
def test_a_changed_texel_makes_the_cells_that_read_it_dynamic(plane: str, axis: int) -> None:
    # The texel is at time 1/2 and read from 3/8 to 5/8.
    scene = with_changed_texels(box_of_cells(), plane, slice(4, 5), slice(6, 7))
    moving = np.zeros((4, 8, 8, 8), bool)
    # Along the axis it is read from 5/8 to 7/8, both included: cells 4 and 7 meet that range at their edges.
    np.moveaxis(moving, axis + 1, 1)[1:3, 4:8] = True
    assert np.array_equal(static_cells(scene), ~moving)
    assert static_fraction(scene) == 0.75 and constant_fraction(scene) == 0.5
    assert np.array_equal(constant_cells(scene), ~moving.any(axis=0))


def test_kpinfo_prints_the_fractions(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = with_changed_texels(box_of_cells(), "xt", slice(4, 5), slice(6, 7))
    write(quantise_scene(scene, [dict.fromkeys(scale, 0.02) for scale in scene.scales]), tmp_path / "scene.kpc")
    assert kpinfo.main([str(tmp_path / "scene.kpc"), "--json"]) == 0
    shares = json.loads(capsys.readouterr().out)["files"][0]["groups"][0]["scene"]["static"]
    assert shares["identity_share"] == 0.75 and shares["constant_share"] == 0.5 <= shares["motionless_share"] <= 1
    assert kpinfo.main([str(tmp_path / "scene.kpc")]) == 0
    page = capsys.readouterr().out
    assert "75.0% of the occupied space-time has time planes of 1" in page
    assert "50.0% of the occupied space never changes" in page


def test_planes_constant_in_time_but_not_one_are_constant_and_not_static() -> None:
    scene = with_changed_texels(box_of_cells(), "yt", slice(None), slice(None))
    assert static_fraction(scene) == 0 and constant_fraction(scene) == 1


def test_fractions_count_occupied_cells_and_changing_occupancy_is_not_constant() -> None:
    scene = with_changed_texels(box_of_cells(), "xt", slice(None), slice(6, 7))
    occupancy = np.zeros((4, 8, 8, 8), bool)
    occupancy[:, 0, 0, :4] = True
    assert (
        static_fraction(replace(scene, occupancy=occupancy))
        == 1
        == constant_fraction(replace(scene, occupancy=occupancy))
    )
    occupancy[2, 0, 0, 0] = False
    assert constant_fraction(replace(scene, occupancy=occupancy)) == 0.75
    assert static_fraction(replace(scene, occupancy=np.zeros_like(occupancy))) == 1


def test_scenes_without_time_planes_are_static() -> None:
    scene = tiny_scene(dynamic=False)
    assert static_cells(scene).shape == scene.occupancy.shape
    assert static_fraction(scene) == constant_fraction(scene) == motionless_share(scene) == 1


def test_features_in_static_cells_are_those_of_the_static_scene() -> None:
    """At random positions and times within the cells."""
    scene, rng = tiny_scene(), np.random.default_rng(1)
    motion = np.zeros((3, 2, 2, 4, 3), np.float32)
    motion[:, :, :, 3] = rng.uniform(-0.2, 0.2, (3, 2, 2, 3))  # displaces everything beyond 2/3 along x
    scene = replace(scene, motion=motion)
    cells = np.argwhere(static_cells(scene))
    slots, *shape = scene.occupancy.shape
    assert 0.01 < len(cells) / scene.occupancy.size < 0.9
    for slot in range(slots):
        inside = cells[cells[:, 0] == slot][:, 1:]
        u = ((inside + rng.uniform(size=inside.shape)) / shape)[:, ::-1].astype(np.float32)
        for time in (slot + rng.uniform(size=4)) / slots:
            full, static = SceneAtTime.of(scene, time), SceneAtTime.of(scene, time, with_motion=False)
            assert np.array_equal(reference.features(scene, full, u), reference.features(scene, static, u))


def test_cells_beyond_a_moving_area_are_static() -> None:
    scene = with_moving_area(tiny_scene())
    ones = ({name: np.ones_like(scale[name]) for name in SPACE_PLANES} for scale in scene.scales)
    whole = replace(scene, scales=tuple({**scale, **planes} for scale, planes in zip(scene.scales, ones, strict=True)))
    cells = static_cells(scene)
    assert (cells >= static_cells(whole)).all() and cells.mean() > 1.2 * static_cells(whole).mean()
    at, rng = np.argwhere(cells.all(axis=0)), np.random.default_rng(1)
    u = ((at + rng.uniform(size=at.shape)) / cells.shape[1:])[:, ::-1].astype(np.float32)
    one, other = (reference.features(scene, SceneAtTime.of(scene, time), u) for time in (0.3, 0.6))
    assert np.array_equal(one, other) and one.any()


def test_cells_reading_is_the_inverse_of_needed_texels() -> None:
    """`needed_texels` returns the texels that a cell reads, `cells_reading` the cells that read a texel."""
    for texels, cells in [(1, 5), (2, 3), (5, 8), (8, 5), (9, 8), (17, 17), (30, 4)]:
        for cell in range(cells):
            occupancy = np.zeros((1, 1, 1, cells), bool)
            occupancy[..., cell] = True
            needed = needed_texels(occupancy, "xt", 1, texels)[0]
            assert [
                bool(cells_reading(texel, 0, cells)[cell]) for texel in np.eye(texels, dtype=bool)
            ] == needed.tolist()


def test_displaced_cells_are_not_static() -> None:
    scene = box_of_cells()
    motion = np.zeros((3, 3, 3, 5, 3), np.float32)
    motion[1, 0, 0, 0] = 0.01  # the corner node, whose support reaches 1/4 along x and 1/2 along y and z
    moving = np.zeros((8, 8, 8), bool)
    moving[:5, :5, :3] = True
    assert np.array_equal(constant_cells(replace(scene, motion=motion)), ~moving)
    assert np.array_equal(static_cells(replace(scene, motion=motion)), np.repeat(~moving[None], 4, axis=0))


@pytest.mark.parametrize("space", VARIANTS)
def test_a_scene_that_does_not_move_is_motionless(space: str) -> None:
    scene = VARIANTS[space](tiny_scene())
    still_scene = replace(still(scene), motion=None if scene.motion is None else np.zeros_like(scene.motion))
    assert motionless_share(still_scene) == 1 > motionless_share(scene)


def test_the_motionless_share_samples_cells_evenly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(motion_map, "CELLS_AT_ONCE", 7)
    cells = np.random.default_rng(0).uniform(size=100) < 0.4
    indices = np.flatnonzero(cells)
    assert np.array_equal(motion_map._spread(cells, 1000), indices)
    spread = motion_map._spread(cells, 10)
    assert len(spread) == 10 and spread[0] == indices[0] and spread[-1] == indices[-1] and cells[spread].all()
    assert len(motion_map._spread(np.zeros(20, bool), 10)) == 0
