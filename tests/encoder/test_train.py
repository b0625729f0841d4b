"""Training learns, is reproducible and resumable bit by bit, and reports failures in one line."""

import errno
import itertools
from dataclasses import replace
from pathlib import Path

import numba
import numpy as np
import pytest
import torch

import datasets as make
from kpc.encoder.cli.encode_scene import to_scene
from kpc.encoder.datasets import Dataset, load_dataset
from kpc.encoder.evaluation.evaluate import evaluate
from kpc.encoder.field.bounds import find_box, fit_contraction
from kpc.encoder.training.sampler import RaySampler
from kpc.encoder.training.train import Report, Trainer
from kpc.format.common.errors import TrainingError
from kpc.format.common.fidelity import psnr
from kpc.format.common.images import read_image, write_image
from kpc.format.scene.scene import SPACE_PLANES
from kpc.format.scene.space import Contraction
from training_runs import BOX, CONFIG, ignore, torch_twin, trained, trainer

pytestmark = pytest.mark.usefixtures("one_thread")
PROPOSALS = {"proposals": True, "proposal_resolutions": (8, 12), "proposal_samples": (24, 12, 8)}


@pytest.fixture(scope="module")
def still(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("still")
    make.write_llff(folder / "set", images=5)
    return load_dataset(folder / "set", folder / "cache", progress=False)


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Return a clip of static cameras."""
    folder = tmp_path_factory.mktemp("rig")
    make.write_n3dv(folder / "set", frames=6)
    return load_dataset(folder / "set", folder / "cache", progress=False)


@pytest.fixture(scope="module")
def surrounded(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("surrounded")
    make.write_unbounded(folder / "set")
    return load_dataset(folder / "set", folder / "cache", progress=False)


def assert_same(one: Trainer, two: Trainer) -> None:
    assert one.step == two.step
    for (name, a), b in zip(one.field.named_parameters(), two.field.parameters(), strict=True):
        assert torch.equal(a, b), name
    np.testing.assert_array_equal(one.grid.active, two.grid.active)
    np.testing.assert_array_equal(one.grid.log_density, two.grid.log_density)
    assert one.rng.bit_generator.state == two.rng.bit_generator.state


@pytest.mark.parametrize("hybrid", [False, True])
def test_training_learns_a_moving_scene(moving: Dataset, hybrid: bool) -> None:
    before = evaluate(to_scene(trainer(moving, hybrid=hybrid)), moving)
    run = trained(moving, steps=200, hybrid=hybrid)
    after = evaluate(to_scene(run), moving)
    assert before is not None and after is not None
    assert after.psnr > before.psnr + 8, (before, after)
    assert run.field.layout.is_dynamic and run.grid.occupied.mean() < 0.6
    assert 0 < run.rays_per_second and run.elapsed_s > 0


def test_training_learns_a_static_scene_with_three_planes(still: Dataset) -> None:
    before = evaluate(to_scene(trainer(still)), still)
    run = trained(still, steps=100)
    after = evaluate(to_scene(run), still)
    assert before is not None and after is not None and after.psnr > before.psnr + 2, (before, after)
    scene = to_scene(run)
    assert not scene.is_dynamic and len(scene.occupancy) == 1 and set(scene.scales[0]) == {"xy", "xz", "yz"}


@pytest.mark.parametrize("hybrid", [False, True])
def test_a_seed_repeats_bitwise(moving: Dataset, hybrid: bool) -> None:
    numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)
    one, two, other = (trained(moving, steps=20, hybrid=hybrid, seed=seed) for seed in (0, 0, 1))
    assert_same(one, two)
    assert not torch.equal(one.field.theta, other.field.theta)


# before the occupancy grid forms, between two updates of it, and after it has been split
@pytest.mark.parametrize(("stop_at", "other"), [(5, {}), (21, {}), (68, {}), (68, {"hybrid": True}), (68, PROPOSALS)])
def test_a_resumed_run_is_bitwise_equal_to_an_uninterrupted_one(
    moving: Dataset, tmp_path: Path, stop_at: int, other: dict[str, object]
) -> None:
    changes = other | {
        "steps": 80,
        "channel_dropout": 0.25,
        "occupancy_split_every": 64,
        "motion_cells": 3,
        "appearance": "image",
    }
    whole = trained(moving, **changes)
    assert whole.field.codes is not None and whole.field.codes.any(1).all()
    assert len(whole.grid.active) == whole.slots > 1
    first = trainer(moving, **changes)
    with pytest.raises(KeyboardInterrupt):
        first.run(ignore, interrupted=lambda: first.step == stop_at)
    first.save(tmp_path / "checkpoint.kpck")
    second = trainer(moving, **changes)
    second.resume(tmp_path / "checkpoint.kpck")
    assert_same(first, second)
    second.run(ignore)
    assert_same(whole, second)


# Before temporal weights apply, at the last step without, at the first with them, and later.
@pytest.mark.parametrize("stop_at", [5, 20, 21, 30])
def test_resuming_across_the_change_of_weights_is_bitwise(rig: Dataset, tmp_path: Path, stop_at: int) -> None:
    changes = {"steps": 40, "temporal_start": 0.5}
    whole = trained(rig, **changes)
    first, second = trainer(rig, **changes), trainer(rig, **changes)
    with pytest.raises(KeyboardInterrupt):
        first.run(ignore, interrupted=lambda: first.step == stop_at)
    first.save(tmp_path / "checkpoint.kpck")
    second.resume(tmp_path / "checkpoint.kpck")
    second.run(ignore)
    assert_same(whole, second)


def test_rays_follow_temporal_weights_from_the_configured_share_on(
    rig: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, seen = trainer(rig, steps=40, temporal_start=0.6), []
    draw = RaySampler.draw_pixels

    def recorded(sampler: RaySampler, *args: object) -> object:
        seen.append((run.step, args[-1]))
        return draw(sampler, *args)  # type: ignore[arg-type]

    monkeypatch.setattr(RaySampler, "draw_pixels", recorded)
    run.run(ignore)
    assert [step for step, weights in seen if weights is not None] == list(range(24, 40))
    assert len({id(weights) for _, weights in seen}) == 2  # computed once


def test_moving_cameras_train_without_temporal_weights(moving: Dataset) -> None:
    assert_same(trained(moving, steps=12, temporal_start=0.0), trained(moving, steps=12, temporal_start=1.0))


def test_a_contracted_run_repeats_and_resumes_bitwise_but_not_with_another_mapping(
    surrounded: Dataset, tmp_path: Path
) -> None:
    mapping = Contraction(5.0)
    whole, first, second = trained(surrounded, mapping), trainer(surrounded, mapping), trainer(surrounded, mapping)
    assert_same(whole, trained(surrounded, mapping))
    with pytest.raises(KeyboardInterrupt):
        first.run(ignore, interrupted=lambda: first.step == 30)
    first.save(tmp_path / "checkpoint.kpck")
    second.resume(tmp_path / "checkpoint.kpck")
    second.run(ignore)
    assert_same(whole, second)
    for other in (None, Contraction(6.0)):
        with pytest.raises(TrainingError, match="other settings"):
            trainer(surrounded, other).resume(tmp_path / "checkpoint.kpck")


def test_contraction_models_a_background_that_a_box_cannot(surrounded: Dataset) -> None:
    """A ball before a sky at infinity, filmed from all around: a box's walls are near and shift against the sky."""
    changes = {"steps": 250, "resolutions": (16, 48), "cells_across": 24}
    config, inner, large = replace(CONFIG, **changes), 1.5 * BOX, find_box(surrounded.pictures, False)  # type: ignore[arg-type]
    contracted = Trainer(surrounded, config, inner, "cpu", mapping=fit_contraction(surrounded.pictures, inner))
    boxed = Trainer(surrounded, config, large, "cpu")
    psnrs = []
    for run in (contracted, boxed):
        run.run(ignore)
        quality = evaluate(to_scene(run), surrounded)
        assert quality is not None
        psnrs.append(quality.psnr)
    assert psnrs[0] > psnrs[1] + 3, psnrs
    assert psnrs[0] > 18, psnrs


def test_checkpoints_are_written_on_the_way_and_at_the_end(moving: Dataset, tmp_path: Path) -> None:
    file = tmp_path / "checkpoint.kpck"
    run = trainer(moving, steps=3)
    found = []

    def look() -> bool:
        found.append(file.exists())
        return False

    run.run(ignore, file, checkpoint_every_s=0.0, interrupted=look)
    assert found == [False, True, True]
    again = trainer(moving, steps=3)
    again.resume(file)
    assert again.step == 3
    again.run(ignore, file)  # nothing is left to do
    assert_same(run, again)
    assert list(tmp_path.iterdir()) == [file]


def test_masked_pixels_have_no_influence_and_other_masks_are_another_run(tmp_path: Path) -> None:
    folder = tmp_path / "set"
    make.write_llff(folder, images=5)
    masks = np.random.default_rng(0).random((5, 24, 32)) < 0.6
    for k, usable in enumerate(masks):
        make.write_mask(folder / f"masks/view{k}.png", usable)

    def load() -> Dataset:
        return load_dataset(folder, tmp_path / "cache", progress=False)

    before = trained(load(), steps=20)
    for k, usable in enumerate(masks):
        image = folder / f"images/view{k}.png"
        write_image(image, np.where(usable[..., None], read_image(image), np.uint8(255 * (k % 2))))
    changed = load()
    assert changed.pixels.tiles != before.dataset.pixels.tiles
    assert_same(before, trained(changed, steps=20))

    first = trainer(changed, steps=20)
    with pytest.raises(KeyboardInterrupt):
        first.run(ignore, interrupted=lambda: first.step == 11)
    first.save(tmp_path / "c.kpck")
    second = trainer(load(), steps=20)
    second.resume(tmp_path / "c.kpck")
    second.run(ignore)
    assert_same(before, second)
    make.write_mask(folder / "masks/view3.png", ~masks[3])
    for dataset in (load(), replace(changed, masks=None)):
        with pytest.raises(TrainingError, match="other pictures"):
            trainer(dataset, steps=20).resume(tmp_path / "c.kpck")


def test_a_checkpoint_can_be_trained_for_more_steps(moving: Dataset, tmp_path: Path) -> None:
    trained(moving, steps=3).save(tmp_path / "c.kpck")
    longer = trainer(moving, steps=5)
    longer.resume(tmp_path / "c.kpck")
    longer.run(ignore)
    assert longer.step == 5


@pytest.mark.parametrize("damage", ["empty", "noise", "cut", "flipped", "pickle", "foreign"])
def test_a_damaged_checkpoint_is_reported_in_one_line(moving: Dataset, tmp_path: Path, damage: str) -> None:
    file = tmp_path / "c.kpck"
    run = trainer(moving)
    run.save(file)
    data = bytearray(file.read_bytes())
    if damage == "flipped":
        data[data.index(b"data.pkl") + 60] ^= 0xFF
    made = {
        "empty": b"",
        "noise": bytes(range(256)) * 8,
        "cut": data[: len(data) // 2],
        "flipped": data,
        "pickle": b"cos\nsystem\n(S'id'\ntR.",
    }
    if damage == "foreign":
        torch.save({"weights": torch.zeros(3)}, file)
    else:
        file.write_bytes(made[damage])
    with pytest.raises(TrainingError) as caught:
        trainer(moving).resume(file)
    message = str(caught.value)
    assert str(file) in message and "delete it" in message and "\n" not in message


def test_a_checkpoint_of_another_run_is_refused(moving: Dataset, still: Dataset, tmp_path: Path) -> None:
    file = tmp_path / "c.kpck"
    trained(moving, steps=2).save(file)
    for other in (trainer(moving, seed=1), trainer(moving, learning_rate=0.5), Trainer(moving, CONFIG, 2 * BOX, "cpu")):
        with pytest.raises(TrainingError, match="other settings"):
            other.resume(file)
    holding_out_more = replace(moving, pictures=replace(moving.pictures, is_test=np.arange(8) > 3))
    for dataset in (still, holding_out_more):
        with pytest.raises(TrainingError, match="other pictures"):
            trainer(dataset).resume(file)


@pytest.mark.parametrize(
    "error",
    [OSError(errno.ENOSPC, "No space left on device"), RuntimeError("PytorchStreamWriter failed writing file\nmore")],
)
def test_a_full_disk_keeps_the_earlier_checkpoint_and_the_run_going(
    moving: Dataset,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    error: Exception,
) -> None:
    file = tmp_path / "c.kpck"
    run = trainer(moving, steps=2)
    run.save(file)
    kept = file.read_bytes()

    def full(state: object, path: Path) -> None:
        Path(path).write_bytes(b"half")
        raise error

    monkeypatch.setattr(torch, "save", full)
    with pytest.raises(TrainingError, match="free space") as caught:
        run.save(file)
    assert str(file) in str(caught.value) and "\n" not in str(caught.value)
    run.run(ignore, file)
    assert run.step == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and str(file) in said and "goes on" in said
    assert list(tmp_path.iterdir()) == [file] and file.read_bytes() == kept


def test_a_really_full_disk() -> None:
    """/dev/full refuses every write; `save` must handle what torch raises then."""
    if not Path("/dev/full").exists():
        pytest.skip("needs /dev/full")
    with pytest.raises((OSError, RuntimeError)):
        torch.save({"a": torch.zeros(1 << 16)}, "/dev/full")


def test_a_loss_that_is_not_finite_stops_the_run(moving: Dataset, tmp_path: Path) -> None:
    run = trainer(moving)
    run.field.theta.data[:] = float("nan")
    with pytest.raises(TrainingError, match=r"step 0.*not finite.*--seed"):
        run.run(ignore, tmp_path / "c.kpck")
    assert not any(tmp_path.iterdir())


def test_an_error_names_what_is_not_finite(moving: Dataset) -> None:
    run = trainer(moving)
    run.field.plane(1, "xt").data[0] = float("inf")
    with pytest.raises(TrainingError) as caught:
        run.run(ignore)
    message = str(caught.value)
    assert all(term in message for term in ("colour", "time_smoothness", "sparse_transients", "xt at scale 1"))
    assert "space_variation" not in message and "xy" not in message and "\n" not in message


def test_pytorch_does_not_compete_with_the_kernels_for_the_cores(moving: Dataset) -> None:
    torch.set_num_threads(2)
    trained(moving, steps=1)
    assert torch.get_num_threads() == 1


def test_a_time_budget_ends_the_run(moving: Dataset) -> None:
    run = trainer(moving, steps=10**9)
    run.run(ignore, time_budget_s=0.3)
    assert run.elapsed_s >= 0.3 and 0 < run.step < 10**9


def test_reports_come_twice_a_second(moving: Dataset) -> None:
    reports: list[Report] = []
    run = trainer(moving)
    run.run(reports.append, time_budget_s=1.3)
    assert reports and all(0 < a.step < b.step for a, b in itertools.pairwise(reports))
    last = reports[-1]
    assert 0.5 < last.fraction < 1.5 and 0 < last.psnr < 60 and last.rays_per_second > 0 and 0 <= last.occupied <= 1


def test_scale_dropout_improves_the_coarse_scale_alone(moving: Dataset) -> None:
    """With the finer scale set to 0, pictures are closer to the truth if training dropped it at times."""

    def coarse(scale_dropout: float) -> float:
        run = trainer(moving, steps=150, scale_dropout=scale_dropout)
        run.run(lambda report: None)
        scene = to_scene(run)
        finer = {
            name: np.zeros_like(plane) if name in SPACE_PLANES else plane for name, plane in scene.scales[1].items()
        }
        quality = evaluate(replace(scene, scales=(scene.scales[0], finer)), moving, most=4)
        assert quality is not None
        return quality.psnr

    assert coarse(0.2) > coarse(0.0) + 1


def test_training_runs_and_resumes_with_the_torch_optimiser(moving: Dataset, tmp_path: Path) -> None:
    """As on CUDA, which the machine that tests may not have."""

    def make_plain() -> Trainer:
        run = trainer(moving, steps=24)
        run.optimiser = torch_twin(run)
        run.field = run.optimiser.field
        return run

    whole, first, second = make_plain(), make_plain(), make_plain()
    whole.run(ignore)
    with pytest.raises(KeyboardInterrupt):
        first.run(ignore, interrupted=lambda: first.step == 20)
    first.save(tmp_path / "c.kpck")
    second.resume(tmp_path / "c.kpck")
    second.run(ignore)
    assert second.step == 24 and second.grid.occupied.any()
    # PyTorch adds with atomics in no fixed order here and there; the runs agree as nearly as two runs do.
    assert psnr(second.field.theta.detach().numpy(), whole.field.theta.detach().numpy()) > 40


def test_a_view_independent_hybrid_decoder_ignores_the_direction(moving: Dataset) -> None:
    field = trained(moving, view_dependent=False, hybrid=True, steps=20).field
    directions = torch.nn.functional.normalize(torch.randn(8, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    assert field.b1.any() and torch.equal(field.ray_terms(directions), field.b1.expand(8, -1))


def test_a_view_independent_decoder_keeps_zero_direction_weights(moving: Dataset) -> None:
    run = trained(moving, view_dependent=False)
    assert not run.field.w2.any() and run.field.b2.any() and trained(moving).field.w2.any()
