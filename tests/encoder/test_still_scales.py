"""Planes that the groups of a clip share: trained and coded with the first, and the same in all others."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from kpc.encoder.cli.grouped import STILL_SHARE, options_of_group, split_into_spans, take_over
from kpc.encoder.cli.options import Options
from kpc.encoder.datasets import Dataset
from kpc.encoder.evaluation.validation_rays import ValidationRays
from kpc.encoder.rdo.codec_model import CodedModel, Model, code
from kpc.encoder.rdo.prune import prune
from kpc.encoder.rdo.rate_control import Trade
from kpc.encoder.rdo.sharing import Sharing
from kpc.format.coding.quantise import quantise_plane
from kpc.format.container.container import Reader
from kpc.format.scene.scene import ALL_PLANES, SPACE_PLANES, TIME_PLANES, Clip, Scene
from scenes import tiny_scene, with_moving_area
from training_runs import CONFIG, trainer

STILL = (0, 1)
KEYS = [(s, name) for s in STILL for name in SPACE_PLANES]


@pytest.fixture(scope="module")
def scene() -> Scene:
    """Two scales in which nothing moves, and one for what does."""
    return with_moving_area(tiny_scene(scales=3))


@pytest.fixture(scope="module")
def sharing(scene: Scene) -> Sharing:
    return Sharing.of_scales(STILL, np.zeros(scene.occupancy.shape[1:], bool))


def coded(scene: Scene, sharing: Sharing, tune_steps: int = 0) -> CodedModel:
    model = Model(scene, ValidationRays.from_cameras(scene), sharing=sharing)
    return code(model, Trade(max_loss_db=0.5), 0.1, tune_steps)


def bodies(data: bytes) -> dict[tuple[int, str], bytes]:
    """Return the stored bytes of the planes that are shared, by scale and name."""
    reader = Reader(data)
    places = {
        (entry.scale, ALL_PLANES[entry.plane]): number
        for number, entry in enumerate(reader.index)
        if entry.kind == "PLNE"
    }
    return {key: bytes(reader.stored(places[key])) for key in KEYS}


def another(scene: Scene, first: CodedModel) -> Scene:
    """Return the scene of a later group: other things move, elsewhere, over what the first group has settled."""
    decoded = first.scene.dequantise()
    still = [decoded.scales[s] for s in STILL]
    moving = {
        name: plane[::-1].copy() if name in TIME_PLANES else plane * np.float32(0.9)
        for name, plane in decoded.scales[2].items()
    }
    occupancy = scene.occupancy.copy()
    occupancy[:, : occupancy.shape[1] // 3] = False
    return replace(decoded, scales=(*still, moving), occupancy=occupancy)


@pytest.mark.parametrize("tune_steps", [0, 3])
def test_later_groups_hold_the_still_planes_of_the_first_byte_for_byte(
    scene: Scene, sharing: Sharing, tune_steps: int
) -> None:
    first = coded(scene, sharing, tune_steps)
    assert all(first.scene.scales[s][name].stores_map for s, name in KEYS)
    later = another(scene, first)
    found = coded(later, sharing.after(first.scene), tune_steps)
    assert bodies(found.data) == bodies(first.data) and found.loss_db <= 0.5
    assert not np.array_equal(found.scene.scales[2]["xt"].symbols, first.scene.scales[2]["xt"].symbols)


def test_shared_planes_hold_where_other_groups_need_them(scene: Scene, sharing: Sharing) -> None:
    occupancy = scene.occupancy.copy()
    occupancy[:, :, :, : occupancy.shape[3] // 2] = False
    part = replace(scene, occupancy=occupancy)
    narrow = coded(part, sharing).scene
    wide = coded(part, replace(sharing, cells=scene.occupancy.any(0)[None])).scene
    for s, name in KEYS:
        assert (narrow.scales[s][name].coded <= wide.scales[s][name].coded).all()
    assert wide.scales[0]["xy"].coded.sum() > narrow.scales[0]["xy"].coded.sum()
    assert wide.scales[2]["xy"].coded.sum() == narrow.scales[2]["xy"].coded.sum()
    reach = replace(sharing, cells=scene.occupancy.any(0)[None]).after(wide).reach
    np.testing.assert_array_equal(reach, scene.occupancy.any(0) | wide.occupancy.any(0))


def test_pruning_spares_shared_scales_and_a_channel_of_each_other(scene: Scene) -> None:
    rays = ValidationRays.from_cameras(scene).rays
    pruned = prune(scene, rays, lambda candidate: 30.0, 1.0, STILL)  # whatever goes costs nothing
    assert [len(kept) for kept in pruned.kept] == [scene.scales[0]["xy"].shape[2]] * 2 + [1]
    everything = prune(scene, rays, lambda candidate: 30.0, 1.0)
    assert sum(map(len, everything.kept)) == 1


def test_settled_planes_do_not_train(moving: Dataset) -> None:
    run = trainer(moving, moving_area=(0.2, 0.2, 0.3, 0.8, 0.8, 0.7))
    assert run.field.layout.still_scales == (0, 2)
    values = {name: quantise_plane(plane + 0.1, 0.01, identity=False) for name, plane in run.scene().scales[2].items()}
    settled = {(2, name): values[name] for name in SPACE_PLANES}
    cells = np.zeros(run.grid.visible.shape, bool)
    cells[2:9] = True
    take_over(settled, run.field)
    run.grid.restrict(cells)
    run.run_until(CONFIG.occupancy_start + 2)
    for (s, name), plane in settled.items():
        np.testing.assert_array_equal(run.field.plane(s, name).detach().numpy(), plane.dequantise())
    assert not run.grid.occupied[~cells].any() and run.grid.occupied.any()
    assert not torch.equal(run.field.plane(1, "xt"), torch.ones_like(run.field.plane(1, "xt")))


def test_the_first_group_gets_the_bytes_of_what_stands_still() -> None:
    spans = split_into_spans(Clip(100, 10.0), 2.5)
    options = Options(Path("a"), Path("b"), trade=Trade(target_bytes=100_000))
    plain = sum(options_of_group(options, number, spans).trade.target_bytes or 0 for number in range(4))
    shares = [options_of_group(options, number, spans, STILL_SHARE).trade.target_bytes or 0 for number in range(4)]
    assert sum(shares) == pytest.approx(plain, abs=4)
    assert shares[0] / shares[3] == pytest.approx(1 / (1 - STILL_SHARE), rel=1e-3)
    assert options_of_group(options, 3, spans, STILL_SHARE, 500).trade.target_bytes == shares[3] + 500
