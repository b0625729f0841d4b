"""Appearances in training: which pictures have one, that only colours depend on it, and what held-out pictures gain."""

import copy
import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import datasets as make
from gradients import random_rays, translucent_scene
from kpc.encoder.cli import encode_scene
from kpc.encoder.coding.scene_writer import encode
from kpc.encoder.datasets import Dataset, load_dataset
from kpc.encoder.evaluation.evaluate import SceneRenderer, evaluate, ssim
from kpc.encoder.evaluation.ground_truth import ground_truth
from kpc.encoder.evaluation.validation_rays import ValidationRays
from kpc.encoder.field import appearances
from kpc.encoder.field.appearances import assign_appearances, choose_appearance, fit_code
from kpc.encoder.field.config import TrainConfig
from kpc.encoder.field.field import Field
from kpc.encoder.field.priors import appearance_priors
from kpc.encoder.field.render import render_reference
from kpc.encoder.training.fused_optimiser import FusedOptimiser
from kpc.encoder.training.torch_optimiser import TorchOptimiser
from kpc.encoder.training.train import Trainer
from kpc.format.coding.quantise import quantise_scene
from kpc.format.common.errors import UsageError
from kpc.format.common.fidelity import psnr
from kpc.format.container.scene_io import read
from kpc.player.cpu import reference
from scenes import tiny_scene, with_appearances, with_hybrid_decoder

pytestmark = pytest.mark.usefixtures("one_thread")
CONFIG = TrainConfig(
    resolutions=(12, 32),
    samples_across=48,
    cells_across=16,
    steps=200,
    rays=512,
    samples=24576,
    warmup=10,
    occupancy_start=32,
    occupancy_every=8,
)
BOX = np.array([[-1, -1, -1], [1, 1, 1]], np.float32)


@pytest.fixture(scope="module")
def unequal(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("unequal")
    make.write_varying_exposure(folder / "set")
    return load_dataset(folder / "set", folder / "cache", progress=False)


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("rig")
    make.write_n3dv(folder / "set", frames=3)
    return load_dataset(folder / "set", folder / "cache", progress=False)


def trained(dataset: Dataset, **changes: object) -> Trainer:
    run = Trainer(dataset, replace(CONFIG, **changes), BOX, "cpu")  # type: ignore[arg-type]
    run.run(lambda report: None)
    return run


@pytest.fixture(scope="module")
def with_codes(unequal: Dataset) -> Trainer:
    return trained(unequal, appearance="image")


# --- who has one


def test_only_photo_collections_get_appearances(unequal: Dataset, rig: Dataset, tmp_path: Path) -> None:
    assert choose_appearance(unequal) == ("image", "photographs: 28 of 28 pictures have a lens or size of their own")
    assert choose_appearance(rig) == ("none", "a clip, filmed as one")
    make.write_varying_exposure(tmp_path / "set", images=9, own_lens=False)
    one_lens = load_dataset(tmp_path / "set", tmp_path / "cache", progress=False)
    assert choose_appearance(one_lens) == ("none", "0 of 7 pictures have a lens or size of their own")
    pictures = one_lens.pictures
    for own, kind in ((3, "none"), (4, "image")):  # more than half of seven; the others share one size
        width = pictures.width.copy()
        width[np.flatnonzero(~pictures.is_test)[:own]] = 33 + np.arange(own)
        assert choose_appearance(replace(one_lens, pictures=replace(pictures, width=width)))[0] == kind


def test_each_image_or_each_camera_has_an_appearance(rig: Dataset, unequal: Dataset) -> None:
    held_out = rig.pictures.is_test
    assert held_out.sum() == 3 and rig.camera_names == ("cam00", "cam01", "cam02")
    numbers, names = assign_appearances(rig, "camera")
    assert names == ("cam01", "cam02") and numbers.tolist() == [-1] * 3 + [0] * 3 + [1] * 3
    numbers, names = assign_appearances(rig, "image")
    assert names == tuple(f"cam0{c}.mp4#{f}" for c in (1, 2) for f in range(3)) and numbers.tolist() == [-1] * 3 + list(
        range(6)
    )
    numbers, names = assign_appearances(rig, "none")
    assert names == () and (numbers == -1).all()
    numbers, names = assign_appearances(unequal, "image")
    assert names[:2] == ("0001.png", "0002.png") and numbers[:3].tolist() == [-1, 0, 1]


def test_names_that_clash_or_that_no_file_can_hold_are_replaced(unequal: Dataset) -> None:
    files = ("a/1.jpg", "b/1.jpg", "c/x\ny.jpg", "d/" + "z" * 300, "e/\ud800.jpg", "#4")
    some = replace(unequal.pictures, file=files + unequal.pictures.file[6:], is_test=np.arange(32) >= 6)
    dataset = replace(unequal, pictures=some)
    assert assign_appearances(dataset, "image")[1] == ("a/1.jpg", "b/1.jpg", "#2", "#3", "#4", "#5")
    assert assign_appearances(dataset, "camera")[1] == tuple(f"000{k}" for k in range(6))
    stems = replace(dataset, camera_names=("1",) * 32)
    assert assign_appearances(stems, "camera")[1][:3] == ("a/1.jpg", "b/1.jpg", "#2")


def test_more_appearances_than_a_file_holds_are_refused(unequal: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(appearances, "APPEARANCE_LIMIT", 27)
    with pytest.raises(UsageError, match="28 appearances, a file holds 27; give --appearance camera"):
        assign_appearances(unequal, "image")
    with pytest.raises(UsageError, match="--appearance none"):
        assign_appearances(unequal, "camera")
    assert choose_appearance(unequal)[0] == "none"


@pytest.mark.parametrize("object_rays", [0.0, 0.5])
def test_rays_carry_the_appearance_of_their_picture(unequal: Dataset, object_rays: float) -> None:
    run = Trainer(unequal, replace(CONFIG, appearance="image"), BOX, "cpu")
    batch, _ = run.sampler.draw(np.random.default_rng(0), 1000, None, object_rays)
    eyes = unequal.pictures.camera_to_world[~unequal.pictures.is_test, :3, 3].astype(np.float32)
    assert batch.appearances is not None and len(torch.unique(batch.appearances)) == 28
    np.testing.assert_allclose(batch.origins.numpy(), eyes[batch.appearances.numpy()], atol=1e-6)

    assert Trainer(unequal, CONFIG, BOX, "cpu").sampler.draw(np.random.default_rng(0), 10)[0].appearances is None


# --- gradients


@pytest.mark.parametrize("kind", ["fused", "plain", "hybrid"])
def test_gradients_equal_those_of_autograd_in_double_precision(kind: str) -> None:
    scene = with_appearances(with_hybrid_decoder(translucent_scene()) if kind == "hybrid" else translucent_scene())
    rays = replace(random_rays(scene, 160), appearances=torch.from_numpy(np.random.default_rng(3).integers(0, 3, 160)))
    targets = torch.from_numpy(np.random.default_rng(1).random((160, 3), np.float32))
    config = replace(CONFIG, appearance="image", appearance_decay=0.05, regularise_every=1000, full_weight=0.0)
    field = Field.from_scene(scene)
    optimiser = (FusedOptimiser if kind == "fused" else TorchOptimiser)(field, config, scene.occupancy.shape[1:])
    twin = copy.deepcopy(field).double()
    optimiser.step(1, 0.0, 0.0, rays, targets, scene.aabb, scene.occupancy, scene.step, scene.extent)  # at a rate of 0

    floats = type(rays)(
        *(value.double() for name, value in vars(rays).items() if name != "appearances"), rays.appearances
    )
    rgb, distortion, *_ = render_reference(
        twin, floats, torch.from_numpy(scene.aabb).double(), torch.from_numpy(scene.occupancy), scene.step
    )
    prior = appearance_priors(twin, config)["appearance_decay"]
    ((rgb - targets.double()).square().mean() + config.distortion * distortion + prior).backward()
    assert twin.codes is not None and twin.codes.grad.abs().max() > 1e-4
    for name in ("codes", "w1", "b1", "w2", "b2"):
        ours, theirs = getattr(field, name).grad.double(), getattr(twin, name).grad
        assert float((ours - theirs).abs().max()) < 2e-3 * float(theirs.abs().max()), (
            name
        )  # samples below 1e-4 have no colour


def test_the_prior_is_the_mean_square_and_pulls_each_code_to_0() -> None:
    config = replace(CONFIG, appearance_decay=0.5)
    field = Field.from_scene(with_appearances(tiny_scene())).double()
    assert field.codes is not None
    value = appearance_priors(field, config)["appearance_decay"]
    value.backward()
    codes = field.codes.detach()
    assert value.item() == pytest.approx(0.5 * float((codes**2).sum()) / 48)
    torch.testing.assert_close(field.codes.grad, 2 * 0.5 * codes / 48)
    step, n = 1e-6, (1, 2)
    moved = codes.clone()
    moved[n] += step
    slope = (0.5 * float(moved.square().mean()) - value.item()) / step
    assert float(field.codes.grad[n]) == pytest.approx(slope, abs=1e-6)
    assert appearance_priors(Field.from_scene(tiny_scene()), config) == {}


# --- what appearances change


def test_codes_start_at_0_and_affect_only_colour(unequal: Dataset, with_codes: Trainer) -> None:
    fresh = Trainer(unequal, replace(CONFIG, appearance="image"), BOX, "cpu")
    assert fresh.field.codes is not None and fresh.field.codes.shape == (28, 16) and not fresh.field.codes.any()
    scene = with_codes.scene()
    renderer, picture = SceneRenderer(scene), 1
    origins, directions = unequal.camera(picture).rays()
    times = np.zeros(len(origins), np.float32)
    looks = [renderer.render(origins, directions, times, renderer.codes(np.full(len(origins), k))) for k in (0, 5)]
    looks.append(renderer.render(origins, directions, times))
    assert all(np.abs(one[0] - other[0]).max() > 0.05 for one, other in itertools.pairwise(looks))
    for one, other in itertools.pairwise(looks):
        np.testing.assert_array_equal(one[1], other[1])
        np.testing.assert_array_equal(one[2], other[2])


def test_the_average_appearance_is_the_mean_of_the_codes(with_codes: Trainer) -> None:
    field, scene = with_codes.field, with_codes.scene()
    assert field.codes is not None and field.codes.mean(0).abs().max().item() > 1e-2
    codes = np.stack([appearance.code for appearance in scene.appearances])
    assert np.abs(codes.mean(0)).max() < 1e-6 < 0.05 < codes.std()
    shift = scene.decoder.b1 - field.b1.detach().numpy()
    np.testing.assert_allclose(shift, field.codes.detach().numpy().mean(0), atol=1e-6)
    directions = torch.nn.functional.normalize(torch.randn(28, 3, generator=torch.Generator().manual_seed(0)))
    for k, raw in enumerate(field.codes):  # every picture with its own code looks as it did
        ours = reference.hidden_layer(scene.decoder, directions.numpy(), scene.appearances[k].code)
        np.testing.assert_allclose(ours, field.hidden(directions, raw).detach().numpy(), atol=1e-5)


def test_codes_survive_a_file(with_codes: Trainer) -> None:
    scene = with_codes.scene()
    decoded = read(encode(quantise_scene(scene, [dict.fromkeys(scale, 0.02) for scale in scene.scales]))).dequantise()
    assert [a.name for a in decoded.appearances] == [a.name for a in scene.appearances] == [*with_codes.names]
    back = Field.from_scene(decoded)
    assert back.codes is not None
    np.testing.assert_allclose(
        back.codes.detach().numpy(), np.stack([a.code for a in scene.appearances]), atol=2e-7, rtol=2.0**-11
    )
    camera = with_codes.dataset.camera(1)
    ours = SceneRenderer(decoded).picture(with_codes.dataset, 1, 0, decoded.appearances[0].code)
    theirs = reference.render(decoded, camera, 0.0, appearance=decoded.appearances[0].code).rgb
    # The kernel leaves out the colour of samples whose weight is below 1e-4.
    assert np.mean(np.abs(ours - theirs).max(-1) > 2e-3) < 0.01


# --- held-out pictures


def test_appearances_improve_held_out_right_halves(unequal: Dataset, with_codes: Trainer) -> None:
    """Measured: 18.5 dB without, 24.8 dB with; and 18.9 and 24.7 dB with another seed."""
    without, quality = (
        SceneRenderer(encode_scene.to_scene(trained(unequal))),
        evaluate(encode_scene.to_scene(with_codes), unequal),
    )
    numbers = np.flatnonzero(unequal.pictures.is_test)
    plain = np.mean(
        [psnr(np.clip(without.picture(unequal, n, 16), 0, 1), ground_truth(unequal, n)[:, 16:]) for n in numbers]
    )
    assert quality is not None and quality.pictures == 4 and quality.psnr > plain + 4, (quality, plain)


def test_the_code_is_fitted_on_the_left_half_and_the_right_half_is_scored(
    unequal: Dataset, with_codes: Trainer
) -> None:
    scene = with_codes.scene()
    renderer, number = SceneRenderer(scene), 8
    code = renderer.fit_left_half(unequal, number)
    assert code.shape == (16,) and np.abs(code).max() > 0.05

    class RightHalvesBlack:
        def picture(self, *rows: int | None) -> np.ndarray:
            out = unequal.pixels.picture(*rows).copy()
            out[:, 16:] = 0
            return out

    np.testing.assert_array_equal(renderer.fit_left_half(replace(unequal, pixels=RightHalvesBlack()), number), code)
    alone = replace(unequal, pictures=replace(unequal.pictures, is_test=np.arange(32) == number))
    quality = evaluate(scene, alone)
    half, truth = np.clip(renderer.picture(unequal, number, 16, code), 0, 1), ground_truth(unequal, number)[:, 16:]
    assert half.shape == (32, 16, 3) and quality is not None
    assert quality.psnr == pytest.approx(psnr(half, truth)) and quality.ssim == pytest.approx(ssim(half, truth))
    np.testing.assert_array_equal(
        renderer.picture(unequal, number, 0, code)[:, 16:], renderer.picture(unequal, number, 16, code)
    )


def test_masks_apply_to_both_halves(tmp_path: Path, with_codes: Trainer) -> None:
    """A picture whose right half is masked is not scored; one whose left half is shows the average appearance."""
    make.write_varying_exposure(tmp_path / "set")
    for k, usable in ((0, np.arange(32) < 16), (8, np.arange(32) >= 16)):
        make.write_mask(tmp_path / f"set/masks/{k:04d}.png", np.broadcast_to(usable, (32, 32)))
    masked = load_dataset(tmp_path / "set", tmp_path / "cache", progress=False)
    scene = with_codes.scene()
    quality = evaluate(scene, masked)
    assert quality is not None and quality.pictures == 3
    assert not SceneRenderer(scene).fit_left_half(masked, 8).any()


@pytest.mark.parametrize(("contracted", "decoder"), [(False, "explicit"), (True, "explicit"), (False, "hybrid")])
def test_a_fitted_code_reproduces_its_target(contracted: bool, decoder: str) -> None:
    scene = translucent_scene(contracted=contracted)
    scene = with_appearances(with_hybrid_decoder(scene) if decoder == "hybrid" else scene)
    wanted = scene.appearance("dusk.jpg") / 2
    backgrounds = torch.from_numpy(np.tile(scene.background, (300, 1)))
    rays = replace(random_rays(scene, 300), jitters=torch.full((300,), 0.5), backgrounds=backgrounds)
    renderer = SceneRenderer(scene)
    arrays = [a.numpy() for a in (rays.origins, rays.directions, rays.times)]
    targets = renderer.rgb(*arrays, np.tile(wanted, (300, 1)))
    code = fit_code(scene, renderer.field, rays, torch.from_numpy(targets))
    np.testing.assert_array_equal(code, fit_code(scene, renderer.field, rays, torch.from_numpy(targets)))
    shown = renderer.rgb(*arrays, np.tile(code, (300, 1)))
    assert psnr(shown, targets) > psnr(renderer.rgb(*arrays), targets) + 12
    assert not fit_code(scene, renderer.field, rays.map(lambda a: a[:0]), torch.zeros(0, 3)).any()


def test_coding_loss_is_measured_with_the_codes_of_the_rays(with_codes: Trainer) -> None:
    scene = encode_scene.to_scene(with_codes)
    measure = ValidationRays.from_training_views(with_codes.sampler, with_codes.background).measure(scene)
    turned = tuple(
        replace(a, code=b.code)
        for a, b in zip(scene.appearances, scene.appearances[1:] + scene.appearances[:1], strict=True)
    )
    judged = measure(replace(scene, appearances=turned))
    assert measure(scene).psnr > 25 > judged.psnr + 3 and measure(scene).mse == 0 < judged.mse
