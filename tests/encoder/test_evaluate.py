"""PSNR and SSIM against simple implementations; pictures of a scene against the player's reference."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import datasets as make
from kpc.encoder.datasets import Dataset, load_dataset
from kpc.encoder.evaluation.evaluate import SceneRenderer, evaluate, spread_evenly, ssim, training_psnr
from kpc.encoder.evaluation.ground_truth import ground_truth
from kpc.encoder.evaluation.testing_time import FEWEST_PICTURES, affordable_pictures, picture_seconds
from kpc.format.common.fidelity import psnr
from kpc.format.scene.scene import Scene
from kpc.player.cpu import reference
from scenes import tiny_scene


def plain_ssim(a: np.ndarray, b: np.ndarray) -> float:
    """Wang et al. 2004, window by window."""
    size = min(11, *a.shape[:2])
    x = np.arange(size) - (size - 1) / 2
    window = np.exp(-(x[:, None] ** 2 + x[None] ** 2) / (2 * 1.5**2))
    window /= window.sum()
    values = []
    for c in range(3):
        for j in range(a.shape[0] - size + 1):
            for i in range(a.shape[1] - size + 1):
                p, q = (im[j : j + size, i : i + size, c].astype(np.float64) for im in (a, b))
                mp, mq = (window * p).sum(), (window * q).sum()
                vp, vq, cov = (
                    (window * (p - mp) ** 2).sum(),
                    (window * (q - mq) ** 2).sum(),
                    (window * (p - mp) * (q - mq)).sum(),
                )
                values.append((2 * mp * mq + 1e-4) * (2 * cov + 9e-4) / ((mp**2 + mq**2 + 1e-4) * (vp + vq + 9e-4)))
    return float(np.mean(values))


def noise(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random(shape, np.float32)


@pytest.mark.parametrize("shape", [(14, 16, 3), (11, 11, 3), (5, 20, 3), (1, 1, 3)])
def test_ssim_matches_the_simple_implementation(shape: tuple[int, int, int]) -> None:
    a = noise(*shape)
    for b in (noise(*shape, seed=1), np.clip(a + 0.1 * noise(*shape, seed=2), 0, 1), 1 - a):
        assert ssim(a, b) == pytest.approx(plain_ssim(a, b), abs=1e-9)
        assert ssim(a, b) == pytest.approx(ssim(b, a), abs=1e-12)
    assert ssim(a, a) == pytest.approx(1.0, abs=1e-12)


def test_psnr() -> None:
    a = noise(8, 9, 3)
    b = noise(8, 9, 3, seed=1)
    assert psnr(a, b) == pytest.approx(
        -10 * math.log10(sum((float(x) - float(y)) ** 2 for x, y in zip(a.flat, b.flat, strict=True)) / a.size),
        abs=1e-4,
    )
    assert psnr(a, a) == 100
    assert psnr(np.zeros((4, 4, 3), np.float32), np.full((4, 4, 3), 0.1, np.float32)) == pytest.approx(20, abs=1e-5)


@pytest.fixture(scope="module")
def blender(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("evaluate")
    make.write_blender(folder / "set")
    return load_dataset(folder / "set", folder / "cache", progress=False)


def dim_scene() -> Scene:
    """Return a scene where every step absorbs at least a tenth, so that the kernel skips no sample."""
    scene = tiny_scene()
    weight = np.abs(scene.decoder.density_weight) / 16
    return replace(scene, decoder=replace(scene.decoder, density_weight=weight), background=np.ones(3, np.float32))


def test_a_picture_matches_the_reference_renderer(blender: Dataset) -> None:
    scene = dim_scene()
    for number in (0, 6):
        ours = SceneRenderer(scene).picture(blender, number)
        theirs = reference.render(scene, blender.camera(number), float(blender.pictures.time[number])).rgb
        assert ours.shape == (20, 20, 3)
        assert np.mean(np.abs(ours - theirs).max(-1) > 1e-4) <= 0.005  # a ray that grazes a cell's face


def test_ground_truth_is_composited_on_white(blender: Dataset) -> None:
    picture, raw = ground_truth(blender, 5), blender.pixels.picture(5) / 255.0
    assert raw.shape[2] == 4
    np.testing.assert_allclose(picture, raw[..., :3] * raw[..., 3:] + 1 - raw[..., 3:], atol=1e-6)
    assert (picture[raw[..., 3] == 0] == 1).all()


def test_ground_truth_without_alpha(tmp_path: Path) -> None:
    make.write_n3dv(tmp_path / "set", frames=1)
    dataset = load_dataset(tmp_path / "set", tmp_path / "cache", progress=False)
    np.testing.assert_array_equal(
        ground_truth(dataset, 1), dataset.pixels.picture(1).astype(np.float32) / np.float32(255)
    )
    assert (
        evaluate(tiny_scene(), load_dataset(tmp_path / "set", tmp_path / "cache", holdout="none", progress=False))
        is None
    )


def test_the_psnr_of_pictures_that_were_trained_on(blender: Dataset) -> None:
    scene = tiny_scene()
    swapped = replace(blender, pictures=replace(blender.pictures, is_test=~blender.pictures.is_test))
    quality = evaluate(scene, swapped)
    assert quality is not None
    assert training_psnr(scene, blender, 100) == pytest.approx(quality.psnr, abs=1e-9)
    assert training_psnr(scene, blender, 2) == pytest.approx(evaluate(scene, swapped, most=2).psnr, abs=1e-9)


def test_evaluate_is_the_mean_over_held_out_pictures(blender: Dataset) -> None:
    scene, held_out = dim_scene(), np.flatnonzero(blender.pictures.is_test)
    assert len(held_out) == 3
    pairs = [(np.clip(SceneRenderer(scene).picture(blender, n), 0, 1), ground_truth(blender, n)) for n in held_out]
    quality = evaluate(scene, blender)
    assert quality is not None and quality.pictures == 3
    assert quality.psnr == pytest.approx(np.mean([psnr(*p) for p in pairs]))
    assert quality.ssim == pytest.approx(np.mean([ssim(*p) for p in pairs]))
    two = evaluate(scene, blender, most=2)
    assert two is not None and two.pictures == 2
    assert two.psnr == pytest.approx(np.mean([psnr(*pairs[0]), psnr(*pairs[2])]))


def test_pictures_are_spread_over_cameras_and_time(blender: Dataset) -> None:
    """3 cameras of 20 frames, in any order: 8 of 60 pictures, at distinct and evenly spaced times for each camera."""
    camera, time = np.divmod(np.random.default_rng(0).permutation(60), 20)
    pictures = replace(blender.pictures, camera=camera, time=time.astype(np.float32))
    chosen = spread_evenly(pictures, np.arange(60), 8)
    assert len(set(chosen.tolist())) == 8 and sorted(np.bincount(camera[chosen])) == [2, 3, 3]
    for k in range(3):
        times = np.sort(time[chosen[camera[chosen] == k]])
        assert (np.abs(np.diff(times) - 20 / len(times)) < 1).all()
    one_each = spread_evenly(pictures, np.arange(60), 3)
    assert sorted(camera[one_each]) == [0, 1, 2] and sorted(time[one_each]) == [3, 10, 16]
    subset = np.arange(7, 50)
    np.testing.assert_array_equal(spread_evenly(pictures, subset, 43), subset)
    for count in range(1, 43):
        chosen = spread_evenly(pictures, subset, count)
        assert len(set(chosen.tolist())) == count and np.isin(chosen, subset).all()


def test_testing_takes_a_tenth_of_the_training_time(blender: Dataset) -> None:
    assert affordable_pictures(train_s=2515, picture_s=56) == 4
    assert affordable_pictures(train_s=10000, picture_s=10) == 100
    assert affordable_pictures(train_s=1, picture_s=10) == affordable_pictures(1, 1e9) == FEWEST_PICTURES
    without = replace(blender, pictures=replace(blender.pictures, is_test=np.zeros(len(blender.pictures), bool)))
    renderer = SceneRenderer(dim_scene())
    assert picture_seconds(renderer, blender) > 0 == picture_seconds(renderer, without)
