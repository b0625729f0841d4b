"""Pixels are drawn in proportion to their change over time, and no other pixel is ever drawn."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import datasets as make
from kpc.encoder.datasets import Dataset, load_dataset
from kpc.encoder.training import importance
from kpc.encoder.training.importance import SMALLEST_TILE, TileWeights, has_static_cameras, max_temporal_difference
from kpc.format.common.images import write_image

FLOOR = 0.1


def load(folder: Path, **options: object) -> Dataset:
    return load_dataset(folder / "set", folder / "cache", progress=False, **options)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Return a clip of three cameras and six frames; 36 x 20 pixels are no multiple of a tile."""
    folder = tmp_path_factory.mktemp("rig")
    make.write_n3dv(folder / "set", frames=6, width=36, height=20)
    return load(folder)


def write_stills(folder: Path, sizes: list[tuple[int, int]], times: int = 4, masked: bool = False) -> None:
    """Write images of static cameras, each of one size, in the nerfstudio layout, with random pixels."""
    rng = np.random.default_rng(5)
    (folder / "images").mkdir(parents=True)
    frames = []
    for k, ((width, height), camera) in enumerate(zip(sizes, make.ring(len(sizes)), strict=True)):
        for t in range(times):
            name = f"images/{k}_{t}.png"
            write_image(folder / name, rng.integers(256, size=(height, width, 3), dtype=np.uint8))
            if masked:
                make.write_mask(folder / f"masks/{k}_{t}.png", rng.random((height, width)) < 0.4)
            lens = {"w": width, "h": height, "fl_x": 40, "fl_y": 40, "cx": width / 2, "cy": height / 2}
            pose = {"transform_matrix": camera.camera_to_world.tolist(), "time": t / (times - 1)}
            frames.append({"file_path": name, **pose, **lens})
    (folder / "transforms.json").write_text(make.json.dumps({"test_filenames": [], "frames": frames}))


def chances(
    dataset: Dataset, floor: float, window: int = importance.WINDOW, side: int = SMALLEST_TILE
) -> dict[int, np.ndarray]:
    """Return, by definition, the probability of each pixel of each training picture, (height, width)."""
    pictures, found = dataset.pictures, {}
    train = np.flatnonzero(~pictures.is_test)
    for number in train:
        same = train[pictures.camera[train] == pictures.camera[number]]
        same = same[np.argsort(pictures.time[same])]
        own = int(np.flatnonzero(same == number)[0])
        here = dataset.pixels.picture(int(number)).astype(int)
        change = np.zeros(here.shape[:2], int)
        for other in same[max(own - window, 0) : own + window + 1]:
            change = np.maximum(change, np.abs(dataset.pixels.picture(int(other)) - here).max(2))
        weight, usable = np.maximum(change, round(255 * floor)), dataset.usable(int(number))
        chance = np.zeros(here.shape[:2])
        for top, left in np.ndindex(-(-here.shape[0] // side), -(-here.shape[1] // side)):
            tile = np.s_[side * top : side * (top + 1), side * left : side * (left + 1)]
            if usable[tile].any():
                mean = int(weight[tile][usable[tile]].sum()) / int(usable[tile].sum())
                chance[tile] = max(np.floor(mean + 0.5), 1) * usable[tile]
        found[int(number)] = chance
    total = sum(chance.sum() for chance in found.values())
    return {number: chance / total for number, chance in found.items()}


def assert_drawn_as_stated(dataset: Dataset, expected: dict[int, np.ndarray], draws: int = 400_000) -> None:
    """Pearson's chi-square over all usable pixels is within five standard deviations of its mean."""
    weights = TileWeights(dataset, FLOOR)
    picture, row, column = weights.draw(np.random.default_rng(3), draws)
    assert len(picture) == len(row) == len(column) == draws
    square, pixels = 0.0, 0
    for number, chance in expected.items():
        mine = picture == number
        counts = np.zeros(chance.shape)
        np.add.at(counts, (row[mine], column[mine]), 1)  # fails for a pixel outside the picture
        assert not counts[chance == 0].any()
        wanted = draws * chance[chance > 0]
        square, pixels = square + float(((counts[chance > 0] - wanted) ** 2 / wanted).sum()), pixels + wanted.size
    assert row.min() >= 0 and column.min() >= 0 and set(np.unique(picture)) <= set(expected)
    assert abs(square - (pixels - 1)) < 5 * np.sqrt(2 * pixels), (square, pixels)


def test_draws_follow_the_weights(rig: Dataset) -> None:
    expected = chances(rig, FLOOR)
    assert len(expected) == 12 and max(c.max() for c in expected.values()) > 3 * min(c.min() for c in expected.values())
    assert_drawn_as_stated(rig, expected)


def test_uniform_draws_fail_the_test_of_weights(rig: Dataset) -> None:
    flat = {number: np.full(chance.shape, 1 / 12 / chance.size) for number, chance in chances(rig, FLOOR).items()}
    with pytest.raises(AssertionError):
        assert_drawn_as_stated(rig, flat)


@pytest.mark.parametrize("masked", [False, True])
def test_weights_respect_picture_sizes_and_masks(tmp_path: Path, masked: bool) -> None:
    write_stills(tmp_path / "set", [(33, 17), (16, 8), (7, 5)], masked=masked)
    dataset = load(tmp_path)
    assert has_static_cameras(dataset) and (dataset.masks is not None) == masked
    assert_drawn_as_stated(dataset, chances(dataset, FLOOR))


def test_window_and_memory_bounds_do_not_change_weights(rig: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the smallest of both, weights take many passes over bands of few rows and stay the same."""
    monkeypatch.setattr(importance, "WINDOW", 1)
    whole = TileWeights(rig, FLOOR)
    monkeypatch.setattr(importance, "BAND_BYTES", 1)
    read = []
    picture = rig.pixels.picture

    def recorded(number: int, top: int = 0, bottom: int | None = None) -> np.ndarray:
        read.append((top, bottom))
        return picture(number, top, bottom)

    monkeypatch.setattr(rig.pixels, "picture", recorded)
    banded = TileWeights(rig, FLOOR)
    np.testing.assert_array_equal(banded.weights, whole.weights)
    assert {(top, bottom) for top, bottom in read} == {(0, 8), (8, 16), (16, 20)}
    monkeypatch.setattr(rig.pixels, "picture", picture)
    monkeypatch.setattr(importance, "BAND_BYTES", 1 << 25)
    assert_drawn_as_stated(rig, chances(rig, FLOOR, window=1))


def test_a_tile_takes_one_byte(rig: Dataset) -> None:
    weights = TileWeights(rig, FLOOR)
    tiles = 12 * 5 * 3
    assert weights.weights.dtype == np.uint8 and tiles <= weights.weights.size < tiles + 64
    held = sum(value.nbytes for value in vars(weights).values() if isinstance(value, np.ndarray))
    assert held <= weights.weights.size * 9 / 8 + 12 * 3 * 8


def test_a_long_clip_takes_larger_tiles_instead_of_more_memory(rig: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importance, "MOST_TILES", 12 * 3 * 2)
    weights = TileWeights(rig, FLOOR)
    assert weights.tile == 16 and weights.ends[-1] == 12 * 3 * 2
    assert_drawn_as_stated(rig, chances(rig, FLOOR, side=16))
    monkeypatch.setattr(importance, "MOST_TILES", 1)  # not even one for each picture
    assert TileWeights(rig, FLOOR).ends[-1] == 12


@pytest.mark.parametrize("radius", [0, 1, 2, 25])
def test_max_temporal_difference_is_over_the_window(radius: int) -> None:
    pictures = np.random.default_rng(radius).integers(256, size=(9, 3, 4, 3), dtype=np.uint8)
    wide = pictures.astype(int)
    expected = [
        np.abs(wide[max(k - radius, 0) : k + radius + 1] - wide[k]).max(axis=(0, 3)) for k in range(len(pictures))
    ]  # fmt: skip
    np.testing.assert_array_equal(max_temporal_difference(pictures, radius), expected)


def test_transparent_colours_do_not_count_as_change(tmp_path: Path) -> None:
    write_stills(tmp_path / "set", [(16, 8), (16, 8)])
    for image in (tmp_path / "set/images").iterdir():
        pixels = np.random.default_rng(0).integers(256, size=(8, 16, 4), dtype=np.uint8)
        pixels[:, :8, :3] = 60 * int(image.stem[-1])
        pixels[:, :8, 3] = 0
        pixels[:, 8:, 3] = 255 * (int(image.stem[-1]) % 2)
        write_image(image, pixels)
    left, right = TileWeights(load(tmp_path), FLOOR).weights[:16].reshape(8, 2).T
    assert (left == round(255 * FLOOR)).all() and (right == 255).all()


def test_static_cameras_are_recognised(rig: Dataset, moving: Dataset, tmp_path: Path) -> None:
    assert has_static_cameras(rig) and not has_static_cameras(moving)
    assert not has_static_cameras(replace(rig, is_dynamic=False))
    write_stills(tmp_path / "set", [(16, 8), (16, 8)], times=3)
    dataset = load(tmp_path)
    assert has_static_cameras(dataset)
    shown_once = replace(dataset.pictures, is_test=np.array([False, True, True, False, False, False]))
    assert not has_static_cameras(replace(dataset, pictures=shown_once))
