"""Rays are drawn from usable pixels of training pictures, and more often around opaque parts."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from kpc.encoder.datasets import Dataset
from kpc.encoder.field.render import Rays
from kpc.encoder.training.sampler import RaySampler


@pytest.mark.parametrize("object_rays", [0.0, 0.5])
def test_drawn_rays_are_those_of_training_pixels(moving: Dataset, object_rays: float) -> None:
    sampler = RaySampler(moving)
    batch, targets = sampler.draw(np.random.default_rng(0), 2000, np.ones(3, np.float32), object_rays)
    assert (batch.backgrounds == 1).all() and 0 <= float(batch.jitters.min()) and float(batch.jitters.max()) < 1
    torch.testing.assert_close(batch.directions.norm(dim=1), torch.ones(2000), atol=1e-6, rtol=0)
    shown = set()
    for number in np.flatnonzero(~moving.pictures.is_test):
        pixels = moving.pixels.picture(int(number)).astype(np.float32) / 255
        on_white = (pixels[..., :3] * pixels[..., 3:] + 1 - pixels[..., 3:]).reshape(-1, 3)
        origins, directions = moving.camera(int(number)).rays()
        mine = np.flatnonzero(np.abs(batch.origins.numpy() - origins[0]).max(1) < 1e-6)
        distance = np.linalg.norm(batch.directions.numpy()[mine, None] - directions[None], axis=2)
        pixel = distance.argmin(1)
        assert distance.min(1).max() < 1e-6
        np.testing.assert_allclose(targets.numpy()[mine], on_white[pixel], atol=1e-6)
        assert (batch.times.numpy()[mine] == moving.pictures.time[number]).all()
        shown.update(mine.tolist())
    assert len(shown) == 2000


def test_frames_contain_opaque_pixels(moving: Dataset) -> None:
    sampler = RaySampler(moving)
    train = np.flatnonzero(~moving.pictures.is_test)
    assert sampler.frames is not None and len(sampler.frames) == len(train)
    for number, (left, right, top, bottom) in zip(train, sampler.frames, strict=True):
        alpha = moving.pixels.picture(int(number))[..., 3]
        outside = alpha.copy()
        outside[top:bottom, left:right] = 0
        assert alpha.any() and not outside.any()
        assert (bottom - top) * (right - left) < alpha.size
    whole, _ = sampler.draw(np.random.default_rng(0), 4000, np.ones(3, np.float32))
    half, _ = sampler.draw(np.random.default_rng(0), 4000, np.ones(3, np.float32), 0.5)
    assert len(half.times) == 4000
    # Half of them, and of the others as many as of all before.
    share = float(sampler.frame_ends[-1] / sampler.ends[-1])
    assert within_frames(moving, sampler, whole) == pytest.approx(share, abs=0.04)
    assert within_frames(moving, sampler, half) == pytest.approx(0.5 + 0.5 * share, abs=0.04)


def within_frames(dataset: Dataset, sampler: RaySampler, batch: Rays) -> float:
    """Share of the rays that pass through `sampler.frames`."""
    count = 0
    assert sampler.frames is not None
    for number, (left, right, top, bottom) in zip(sampler.train, sampler.frames, strict=True):
        camera = dataset.camera(int(number))
        local = batch.directions.numpy() @ camera.camera_to_world[:3, :3]
        i = camera.cx - camera.fl_x * local[:, 0] / local[:, 2]
        j = camera.cy + camera.fl_y * local[:, 1] / local[:, 2]
        mine = np.abs(batch.origins.numpy() - camera.camera_to_world[:3, 3]).max(1) < 1e-5
        count += int((mine & (i > left) & (i < right) & (j > top) & (j < bottom)).sum())
    return count / len(batch.times)


def test_transparent_pictures_have_no_frame(moving: Dataset) -> None:
    class Clear:
        def picture(self, number: int) -> np.ndarray:
            return 0 * moving.pixels.picture(number)

        read = moving.pixels.read

    sampler = RaySampler(replace(moving, pixels=Clear()))  # type: ignore[arg-type]
    batch, _ = sampler.draw(np.random.default_rng(0), 100, None, 0.5)
    assert len(batch.times) == 100


def test_random_backgrounds_show_through(moving: Dataset) -> None:
    batch, targets = RaySampler(moving).draw(np.random.default_rng(0), 500)
    assert len(torch.unique(batch.backgrounds)) > 1000
    assert bool((targets == batch.backgrounds).all(1).any())  # alpha is 0 somewhere
