"""Which pixels move, and the quality of moving and still pixels apart."""

from pathlib import Path

import numpy as np
import pytest

import datasets as make
from kpc.encoder.datasets import load_dataset
from kpc.encoder.evaluation import moving as module
from kpc.encoder.evaluation.evaluate import SceneRenderer, evaluate
from kpc.encoder.evaluation.ground_truth import ground_truth
from kpc.encoder.evaluation.moving import MovingPixels, moving_pixels
from kpc.format.common.fidelity import psnr
from scenes import tiny_scene


def test_moving_pixels_differ_from_the_median_and_are_grown() -> None:
    median = np.full((20, 30, 3), 0.5, np.float32)
    picture = median.copy()
    picture[8, 10, 1] += 0.05
    picture[15, 25] += 0.03
    expected = np.zeros((20, 30), bool)
    expected[5:12, 7:14] = True
    np.testing.assert_array_equal(moving_pixels(picture, median), expected)


def test_moving_and_still_pixels_are_measured_apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The median of strips is that of whole pictures; PSNRs are means over pictures that have such pixels."""
    make.write_n3dv(tmp_path / "set", frames=5, width=40, height=30)
    dataset = load_dataset(tmp_path / "set", tmp_path / "cache", progress=False)
    monkeypatch.setattr(module, "ROWS_AT_ONCE", 7)
    scene, held_out = tiny_scene(), np.flatnonzero(dataset.pictures.is_test)
    truths = [ground_truth(dataset, n) for n in held_out]
    masks = [moving_pixels(truth, np.median(truths, axis=0)) for truth in truths]
    assert len(held_out) == 5 and any(mask.any() for mask in masks) and not all(mask.all() for mask in masks)
    moving, renderer = MovingPixels(dataset), SceneRenderer(scene)
    for number, mask in zip(held_out, masks, strict=True):
        np.testing.assert_array_equal(moving.mask(number), mask)
    pictures = [np.clip(renderer.picture(dataset, n), 0, 1) for n in held_out]
    quality = evaluate(scene, dataset, parts=True)
    assert quality is not None
    for found, chosen in ((quality.moving_psnr, masks), (quality.still_psnr, [~mask for mask in masks])):
        expected = [psnr(p[c], t[c]) for p, t, c in zip(pictures, truths, chosen, strict=True) if c.any()]
        assert found == pytest.approx(np.mean(expected))
    whole = evaluate(scene, dataset)
    assert whole is not None and whole.moving_psnr is None and whole.psnr == quality.psnr


def test_nothing_is_known_to_move_for_cameras_with_few_pictures(tmp_path: Path) -> None:
    make.write_n3dv(tmp_path / "set", frames=2)
    dataset = load_dataset(tmp_path / "set", tmp_path / "cache", progress=False)
    assert MovingPixels(dataset).mask(0) is None
    quality = evaluate(tiny_scene(), dataset, parts=True)
    assert quality is not None and quality.moving_psnr is None
