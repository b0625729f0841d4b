"""Masked pixels are neither trained nor tested on; without masks nothing changes."""

import errno
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

import datasets as make
from datasets import fails, load
from kpc.encoder.datasets import Dataset, pixel_cache
from kpc.encoder.datasets.masks import BLOCK
from kpc.encoder.evaluation.evaluate import SceneRenderer, evaluate, ssim
from kpc.encoder.evaluation.ground_truth import ground_truth
from kpc.encoder.training.sampler import RaySampler
from kpc.format.common.fidelity import psnr
from kpc.format.common.images import write_image
from scenes import tiny_scene

SIZE = (24, 32)


def random_mask(seed: int, share: float = 0.5) -> np.ndarray:
    """Return a mask with a random `share` of usable pixels."""
    return np.random.default_rng(seed).random(SIZE) < share


def masked(folder: Path, masks: dict[int, np.ndarray], images: int = 10) -> Path:
    """Write a nerfstudio dataset with masks for some images; pixel (j, i) of image k has the colour (k, j, i)."""
    make.write_nerfstudio(folder, images=images)
    row, column = np.indices(SIZE)
    for k in range(images):
        write_image(folder / f"images/{k:04d}.png", np.stack([np.full(SIZE, k), row, column], axis=2).astype(np.uint8))
    for k, usable in masks.items():
        make.write_mask(folder / f"masks/{k:04d}.png", usable)
    return folder


def drawn(dataset: Dataset, count: int, seed: int = 0) -> np.ndarray:
    """Return picture, row and column of pixels that a sampler drew from a `masked` dataset, (count, 3)."""
    _, targets = RaySampler(dataset).draw(np.random.default_rng(seed), count)
    return np.rint(targets.numpy() * 255).astype(int)


def test_masks_are_found_in_every_layout_of_images(tmp_path: Path) -> None:
    usable = random_mask(0)
    for write, name in (
        (make.write_llff, "view3"),
        (make.write_nerfstudio, "0003"),
        (make.write_colmap, "0003"),
    ):
        folder = tmp_path / write.__name__
        write(folder)
        for mask in (f"{name}.png", f"{name}.png.png"):
            make.write_mask(folder / "masks" / mask, usable)
            dataset = load(folder)
            assert dataset.masks is not None and "masks" in dataset.describe()
            np.testing.assert_array_equal(dataset.usable(3), usable)
            assert dataset.usable(4).shape == SIZE and dataset.usable(4).all()
            (folder / "masks" / mask).unlink()
    make.write_blender(tmp_path / "blender")
    make.write_mask(tmp_path / "blender/masks/train/r_002.png", usable[:20, :20])
    np.testing.assert_array_equal(load(tmp_path / "blender").usable(2), usable[:20, :20])


def test_masks_are_in_the_same_subfolders_as_their_images(tmp_path: Path) -> None:
    """Camera folders repeat names; a mask with the image's full name takes precedence."""
    folder = tmp_path / "set"
    make.write_nerfstudio(folder, images=3)
    for k, camera in enumerate("abc"):
        (folder / "images" / camera).mkdir()
        (folder / f"images/{k:04d}.png").rename(folder / f"images/{camera}/view.png")
    make.edit_json(
        folder / "transforms.json",
        lambda d: [f.update(file_path=f"images/{c}/view.png") for f, c in zip(d["frames"], "abc", strict=True)],
    )
    make.write_mask(folder / "masks/b/view.png", random_mask(1))
    make.write_mask(folder / "masks/c/view.png", random_mask(2))
    make.write_mask(folder / "masks/c/view.png.png", random_mask(3))
    dataset = load(folder)
    assert dataset.usable(0).all()
    np.testing.assert_array_equal(dataset.usable(1), random_mask(1))
    np.testing.assert_array_equal(dataset.usable(2), random_mask(3))


def test_without_masks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make.write_nerfstudio(tmp_path / "set")
    dataset = load(tmp_path / "set")
    assert dataset.masks is None and "mask" not in dataset.describe() and dataset.usable(0).all()
    assert capsys.readouterr().err == ""
    assert not list((tmp_path / "cache").glob("*masks*"))
    (tmp_path / "set" / "masks").mkdir()
    assert load(tmp_path / "set").masks is None
    (line,) = capsys.readouterr().err.splitlines()
    assert "masks: 10 of 10 images have no mask and are used entirely: 0000.png" in line


def test_videos_have_no_masks(tmp_path: Path) -> None:
    make.write_n3dv(tmp_path / "set")
    make.write_mask(tmp_path / "set/masks/cam01.png", random_mask(0))
    assert load(tmp_path / "set").masks is None


def test_images_without_a_mask_are_listed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = masked(tmp_path / "set", {k: random_mask(k) for k in range(8)})
    description = load(folder).describe()
    (line,) = capsys.readouterr().err.splitlines()
    assert "2 of 10 images have no mask and are used entirely: 0008.png, 0009.png" in line
    share = sum((~random_mask(k)).sum() for k in range(8)) / (10 * 24 * 32)
    assert f"masks ({share:.1%} ignored)" in description


def test_only_black_and_transparent_is_ignored(tmp_path: Path) -> None:
    """Any other grey level is usable, and so is any other colour."""
    folder = masked(tmp_path / "set", {})
    (folder / "masks").mkdir()
    grey = np.arange(24 * 32, dtype=np.uint8).reshape(SIZE)
    write_image(folder / "masks/0001.png", grey)
    blue = np.stack([0 * grey, 0 * grey, grey, np.where(grey == 7, 0, 255).astype(np.uint8)], axis=2)
    write_image(folder / "masks/0002.png", blue[..., :3])
    write_image(folder / "masks/0003.png", blue)
    Image.fromarray(grey.astype(np.uint16)).save(folder / "masks/0004.png.TIF")
    dataset = load(folder)
    for k in (1, 2, 4):
        np.testing.assert_array_equal(dataset.usable(k), grey != 0)
    np.testing.assert_array_equal(dataset.usable(3), (grey != 0) & (grey != 7))


def test_a_mask_of_another_size_is_refused(tmp_path: Path) -> None:
    folder = masked(tmp_path / "set", {4: random_mask(0)[:12, :16]})
    fails(folder, "masks/0004.png", "is 16x12, but 0004.png is 32x24")
    assert not (tmp_path / "cache").exists()


def test_a_damaged_mask_is_refused(tmp_path: Path) -> None:
    folder = masked(tmp_path / "set", {4: random_mask(0)})
    mask = folder / "masks/0004.png"
    mask.write_bytes(mask.read_bytes()[:-60])
    fails(folder, "masks/0004.png")
    mask.write_bytes(b"text")
    fails(folder, "masks/0004.png")


@pytest.mark.parametrize("factor", [2, 3, 5])
def test_a_downscaled_pixel_is_ignored_if_any_pixel_of_its_block_is(tmp_path: Path, factor: int) -> None:
    usable = random_mask(0, 0.93)
    dataset = load(masked(tmp_path / "set", {2: usable}), downscale=factor)
    small = dataset.usable(2)
    assert small.shape == dataset.pixels.picture(2).shape[:2] and dataset.usable(3).all()
    for j, i in np.ndindex(*small.shape):
        assert small[j, i] == usable[j * factor : (j + 1) * factor, i * factor : (i + 1) * factor].all()
    assert 0 < small.sum() < small.size


def test_usable_pixels_are_drawn_uniformly_and_ignored_ones_never(tmp_path: Path) -> None:
    masks = {k: random_mask(k, share) for k, share in enumerate((0.5, 0.9, 0.001, 0.5, 0.02, 0.5, 1.0, 0.3))}
    masks[3][:] = False  # ignored entirely
    masks[5][:] = False
    masks[5][-1, -1] = True
    dataset = load(masked(tmp_path / "set", masks, images=9))
    usable = np.stack([dataset.usable(k) for k in range(9)])
    np.testing.assert_array_equal(usable[:8], np.stack(list(masks.values())))
    usable[dataset.pictures.is_test] = False
    hits = np.zeros_like(usable, int)
    count = 200 * int(usable.sum())
    np.add.at(hits, tuple(drawn(dataset, count).T), 1)
    assert not hits[~usable].any()
    # Poisson with mean 200: a deviation of 6.5 sigma occurs once in 10^10 pixels.
    assert np.abs(hits[usable] - 200).max() < 6.5 * np.sqrt(200)


def test_a_single_usable_pixel(tmp_path: Path) -> None:
    masks = {k: np.zeros(SIZE, bool) for k in range(10)}
    masks[6][17, 5] = True
    dataset = load(masked(tmp_path / "set", masks))
    assert (drawn(dataset, 5000) == [6, 17, 5]).all()


def test_masks_that_leave_nothing_to_train_on_are_refused(tmp_path: Path) -> None:
    masks = {k: np.full(SIZE, k % 8 == 0) for k in range(10)}  # 0 and 8 are held out
    folder = masked(tmp_path / "set", masks)
    fails(folder, "masks", "every pixel to train on", "invert")
    assert load(folder, holdout="0003").usable(0).all()
    checkered = np.indices(SIZE).sum(0) % 2 == 0
    fails(masked(tmp_path / "fine", dict.fromkeys(range(10), checkered)), "every pixel to train on", downscale=2)


def test_without_masks_the_draw_is_unchanged(tmp_path: Path) -> None:
    """The draw is a plain uniform one; masks that ignore nothing do not change it."""
    folder = masked(tmp_path / "set", {})
    unmasked = load(folder)
    p = unmasked.pictures
    train = np.flatnonzero(~p.is_test)
    rng = np.random.default_rng(3)
    pixel = rng.integers(len(train) * 24 * 32, size=1000)
    expected = np.stack([train[pixel // 768], pixel % 768 // 32, pixel % 32], axis=1)
    np.testing.assert_array_equal(drawn(unmasked, 1000, seed=3), expected)
    for k in range(10):
        make.write_mask(folder / f"masks/{k:04d}.png", np.ones(SIZE, bool))
    masked_nowhere = load(folder)
    assert masked_nowhere.masks is not None
    (rays, targets), (same_rays, same_targets) = (
        RaySampler(d, appearances=np.arange(10)).draw(np.random.default_rng(5), 500) for d in (unmasked, masked_nowhere)
    )
    for a, b in zip((*vars(rays).values(), targets), (*vars(same_rays).values(), same_targets), strict=True):
        np.testing.assert_array_equal(a.numpy(), b.numpy())


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_nth_usable_equals_the_definition(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    rng = np.random.default_rng(seed)
    folder = tmp_path_factory.mktemp("ranks")
    make.write_nerfstudio(folder / "set", images=3)
    size = tuple(int(n) for n in rng.integers(1, 90, 2))
    make.edit_json(folder / "set/transforms.json", lambda d: d.update(w=size[1], h=size[0]))
    masks = []
    for k in range(3):
        write_image(folder / f"set/images/{k:04d}.png", np.zeros((*size, 3), np.uint8))
        block = np.repeat(rng.random((size[0] * size[1]) // 100 + 1) < rng.random(), 100)[: size[0] * size[1]]
        masks.append((block & (rng.random(size[0] * size[1]) < rng.choice([0.1, 0.7, 1.0]))).reshape(size))
        make.write_mask(folder / f"set/masks/{k:04d}.png", masks[-1])
    masks[1][:] = masks[1] | (not masks[1].any())
    make.write_mask(folder / "set/masks/0001.png", masks[1])
    dataset = load(folder / "set", holdout="none")
    np.testing.assert_array_equal(dataset.usable_counts, [mask.sum() for mask in masks])
    picture = np.repeat(np.arange(3), dataset.usable_counts)
    rank = np.concatenate([np.arange(n) for n in dataset.usable_counts])
    order = rng.permutation(len(rank))
    expected = np.concatenate([np.flatnonzero(mask) for mask in masks])
    np.testing.assert_array_equal(dataset.nth_usable(picture[order], rank[order]), expected[order])


def mask_file(tmp_path: Path) -> Path:
    (file,) = (tmp_path / "cache").glob("pixels-*-masks.bin")
    return file


def test_masks_are_read_once(tmp_path: Path) -> None:
    folder = masked(tmp_path / "set", {2: random_mask(2)})
    load(folder)
    file = mask_file(tmp_path)
    assert file.stat().st_size == 10 * -(-24 * 32 // BLOCK) * BLOCK // 8
    before = file.stat().st_mtime_ns
    pictures = (tmp_path / "cache" / file.name.replace("-masks", "")).stat().st_mtime_ns
    np.testing.assert_array_equal(load(folder, holdout="none").usable(2), random_mask(2))
    assert file.stat().st_mtime_ns == before
    make.write_mask(folder / "masks/0002.png", random_mask(9))
    make.write_mask(folder / "masks/0003.png", random_mask(3))
    changed = load(folder)
    np.testing.assert_array_equal(changed.usable(2), random_mask(9))
    np.testing.assert_array_equal(changed.usable(3), random_mask(3))
    assert (tmp_path / "cache" / file.name.replace("-masks", "")).stat().st_mtime_ns == pictures
    for mask in (folder / "masks").iterdir():
        mask.unlink()
    assert load(folder).masks is None


def test_a_damaged_cache_is_rebuilt(tmp_path: Path) -> None:
    folder = masked(tmp_path / "set", {2: random_mask(2)})
    load(folder)
    file = mask_file(tmp_path)
    good = file.read_bytes()
    for damaged in (good[:-1], good + b"\0", bytes([good[0] ^ 1]) + good[1:], b""):
        file.write_bytes(damaged)
        np.testing.assert_array_equal(load(folder).usable(2), random_mask(2))
        assert file.read_bytes() == good


@pytest.mark.parametrize("mapped_bytes", [1 << 30, 0])
def test_drawing_with_and_without_a_memory_mapping(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mapped_bytes: int
) -> None:
    monkeypatch.setattr(pixel_cache, "MAPPED_BYTES", mapped_bytes)
    dataset = load(masked(tmp_path / "set", {k: random_mask(k, 0.1) for k in range(10)}))
    pixels = drawn(dataset, 3000)
    assert all(random_mask(k, 0.1)[j, i] for k, j, i in pixels)


def test_disk_full(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = masked(tmp_path / "set", {2: random_mask(2)}, images=3)
    real, written = os.write, []

    def write(fd: int, data: memoryview) -> int:
        if len(written) == 4:  # three pictures and one mask
            raise OSError(errno.ENOSPC, "No space left on device")
        written.append(fd)
        return real(fd, data)

    monkeypatch.setattr(pixel_cache.os, "write", write)
    fails(folder, "disk is full")
    assert not list((tmp_path / "cache").glob("*masks*"))


def held_out_quality(tmp_path: Path, name: str, masks: dict[int, np.ndarray]) -> tuple[Dataset, object]:
    dataset = load(masked(tmp_path / name, masks))
    return dataset, evaluate(tiny_scene(), dataset)


def test_evaluation_ignores_masked_pixels(tmp_path: Path) -> None:
    usable = random_mask(0, 0.7)
    dataset, quality = held_out_quality(tmp_path, "set", {0: usable})
    assert quality.pictures == 2
    renderer, scores = SceneRenderer(tiny_scene()), []
    for number, mask in ((0, usable), (8, np.ones(SIZE, bool))):
        a, b = np.clip(renderer.picture(dataset, number), 0, 1), ground_truth(dataset, number)
        error = sum(float(np.square(a[j, i] - b[j, i]).sum()) for j, i in zip(*np.nonzero(mask), strict=True)) / (
            3 * mask.sum()
        )
        windows = [
            ssim(a[j : j + 11, i : i + 11], b[j : j + 11, i : i + 11])
            for j, i in np.ndindex(24 - 10, 32 - 10)
            if mask[j + 5, i + 5]
        ]
        scores.append((-10 * np.log10(error), np.mean(windows)))
    assert quality.psnr == pytest.approx(np.mean([s[0] for s in scores]), abs=1e-4)
    assert quality.ssim == pytest.approx(np.mean([s[1] for s in scores]), abs=1e-9)


def test_masks_that_ignore_nothing_change_no_score(tmp_path: Path) -> None:
    dataset = load(masked(tmp_path / "set", {0: np.ones(SIZE, bool), 8: np.ones(SIZE, bool)}))
    with_masks, without = evaluate(tiny_scene(), dataset), evaluate(tiny_scene(), replace(dataset, masks=None))
    assert with_masks.psnr == pytest.approx(without.psnr) and with_masks.ssim == pytest.approx(without.ssim)


def test_pictures_without_a_whole_ssim_window_are_left_out(tmp_path: Path) -> None:
    border = np.ones(SIZE, bool)
    border[5:-5, 5:-5] = False
    _, quality = held_out_quality(tmp_path, "one", {0: border})
    assert quality.pictures == 1 and np.isfinite([quality.psnr, quality.ssim]).all()
    _, quality = held_out_quality(tmp_path, "none", {0: border, 8: np.zeros(SIZE, bool)})
    assert quality is None


@pytest.mark.parametrize("shape", [(5, 20), (1, 1), (10, 12)])
def test_ssim_of_masked_pictures_smaller_than_a_window(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(0)
    a, b = rng.random((2, *shape, 3), np.float32)
    assert ssim(a, b, np.ones(shape, bool)) == pytest.approx(ssim(a, b))
    assert psnr(a[np.ones(shape, bool)], b[np.ones(shape, bool)]) == pytest.approx(psnr(a, b), abs=1e-4)
