"""Pictures that are marched at a lower resolution first."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from kpc.player.cpu.coarse_to_fine import blocks_over, interpolation_errors, upsample
from kpc.player.cpu.field_sampler import FieldSampler
from kpc.player.cpu.picture import BLOCK, Picture
from kpc.player.footprint import texels_per_pixel
from kpc.player.quality import Quality
from processor import draw, processor_of, psnr
from scenes import VARIANTS, look_at, tiny_scene

CAMERA = look_at((2.4, 1.0, 2.2), (0.1, 0.05, 0.05), 64, 48, 70.0)


def rasters(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, int, int]]:
    """Width, height and marched blocks of each march from here on."""
    found, march = [], FieldSampler.march

    def noted(self, camera, free, blocks, *rest) -> None:
        found.append((camera.width, camera.height, len(blocks)))
        march(self, camera, free, blocks, *rest)

    monkeypatch.setattr(FieldSampler, "march", noted)
    return found


@pytest.mark.parametrize("size", [(128, 96), (127, 61), (16, 200), (1, 1), (4096, 1), (9, 8)])
def test_interpolated_pixels_are_off_by_no_more_than_allowed(
    size: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    camera = replace(CAMERA.resized(*size), fl_x=140.0, fl_y=140.0)
    pictures, marched, found = {}, {}, rasters(monkeypatch)
    tolerances = (0.0, 1e-6, 0.002, 0.01, 1.0)
    for tolerance in tolerances:
        found.clear()
        pictures[tolerance] = draw(
            processor_of(tiny_scene(4)), camera, 0.4, Quality(folded=True, interpolation_tolerance=tolerance)
        )
        marched[tolerance] = sum(blocks for *_, blocks in found)
        assert (len(found) > 1) == (tolerance > 0 and min(size) >= 2 * BLOCK)
    whole = pictures[0.0]
    if min(size) < 2 * BLOCK:
        assert all(np.array_equal(each, whole) for each in pictures.values())
        return
    off = {tolerance: np.sqrt(np.mean((each - whole)[..., :3] ** 2)) for tolerance, each in pictures.items()}
    # Cells end this scene abruptly: of edges so sharp bends tell less than half, and slivers are met by no coarser ray
    # at all.
    assert all(off[tolerance] < 4 * tolerance + 1.5e-3 for tolerance in tolerances)
    assert list(off.values()) == sorted(off.values())
    assert all(marched[more] <= marched[less] for less, more in pairwise(tolerances[1:]))
    assert size == (9, 8) or (off[1.0] > 4 * off[0.002] and marched[1e-6] > 2 * marched[1.0])
    assert np.abs(pictures[0.01] - whole)[..., 3].mean() < 0.01


@pytest.mark.parametrize("size", [(40, 28), (41, 27), (8, 9)])
def test_errors_are_estimated_from_second_differences(size: tuple[int, int]) -> None:
    few, blocks = (tuple(-(-side // n) for side in size) for n in (2, BLOCK))
    colours = np.random.default_rng(7).random((few[1], few[0], 4), np.float32)
    padded = np.pad(colours[..., :3].astype(float), ((1, 1), (1, 1), (0, 0)), "edge")
    here = padded[1:-1, 1:-1]
    bends = np.abs(padded[1:-1, :-2] + padded[1:-1, 2:] - 2 * here)
    bends += np.abs(padded[:-2, 1:-1] + padded[2:, 1:-1] - 2 * here)
    columns, rows = (
        np.minimum((2 * np.arange(2 * n) + 1) * fewer // side, fewer - 1)
        for n, fewer, side in zip(blocks, few, size, strict=True)
    )
    squares = np.mean((bends / 8) ** 2, axis=2)[rows[:, None], columns]
    wanted = squares.reshape(blocks[1], 2, blocks[0], 2).mean((1, 3))
    np.testing.assert_allclose(interpolation_errors(colours, size), wanted, rtol=1e-4)


def test_blocks_of_the_largest_errors_are_chosen() -> None:
    errors = np.random.default_rng(0).permutation(np.arange(100, dtype=np.float32)).reshape(10, 10)
    for allowed in (0.0, 0.3, 10.0, 49.5, 100.0):
        chosen = blocks_over(errors, allowed)
        left = errors[~chosen]
        assert left.sum() <= allowed * 100 and (not chosen.any() or left.max(initial=-1) < errors[chosen].min())
        assert not chosen.any() or left.sum() + errors[chosen].min() > allowed * 100


@pytest.mark.parametrize("sizes", [((20, 14), (40, 28)), ((21, 14), (41, 27)), ((1, 1), (3, 2))])
def test_pictures_are_upsampled_bilinearly(sizes: tuple[tuple[int, int], tuple[int, int]]) -> None:
    coarse, fine = map(Picture.empty, sizes)
    rng = np.random.default_rng(0)
    coarse.rgba[:], coarse.sums[:] = rng.random(coarse.rgba.shape), rng.random(coarse.sums.shape)
    upsample(coarse, fine)
    for few, many in zip(coarse, fine, strict=True):
        wanted = few.astype(float)
        for axis in (0, 1):
            at = np.clip(
                (np.arange(many.shape[axis]) + 0.5) / many.shape[axis] * few.shape[axis] - 0.5, 0, few.shape[axis] - 1
            )
            first = at.astype(int)
            share = (at - first).reshape((-1, 1, 1) if axis == 0 else (1, -1, 1))
            after = np.minimum(first + 1, few.shape[axis] - 1)
            wanted = (1 - share) * wanted.take(first, axis) + share * wanted.take(after, axis)
        np.testing.assert_allclose(many, wanted, atol=1e-5)


def test_each_texel_is_met_by_a_ray(monkeypatch: pytest.MonkeyPatch) -> None:
    """No coarser picture has less than a ray a texel."""
    scene, found = tiny_scene(4, resolution=(33, 17, 17)), rasters(monkeypatch)
    renderer, texel, middle = processor_of(scene), scene.extent / 32, scene.aabb.mean(0)
    for texels, coarser in ((0.51, 0), (0.49, 1), (0.26, 1), (0.24, 2)):
        camera = look_at(tuple(middle + np.array([0, 0, 100 * texels * texel])), tuple(middle), 64, 48, 70.0)
        found.clear()
        draw(renderer, replace(camera, fl_x=100.0, fl_y=100.0), 0.5, Quality(folded=True, interpolation_tolerance=2.0))
        assert len(found) == 1 + coarser


def test_in_contracted_space_texels_are_counted_along_a_ray(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, found = VARIANTS["contracted"](tiny_scene(4)), rasters(monkeypatch)
    camera = CAMERA.resized(128, 96)
    got = draw(processor_of(scene), camera, 0.5, Quality(folded=True, interpolation_tolerance=0.0005))
    assert len(found) > 1 and psnr(got, draw(processor_of(scene), camera, 0.5, Quality(folded=True))) > 50


@pytest.mark.parametrize("space", ["contracted", "ndc"])
def test_where_space_is_mapped_a_pixel_of_half_the_size_spans_half_the_texels(space: str) -> None:
    scene = VARIANTS[space](tiny_scene(4))
    once, twice = (texels_per_pixel(scene, CAMERA.resized(64 * k, 48 * k)) for k in (1, 2))
    assert 0.1 < once < 0.5 and twice == pytest.approx(once / 2, rel=0.01)  # tiny scenes have 8 to 12 texels across
