"""The spacing of time rows follows from how fast the pictures change, and from nothing else."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import datasets as make
from kpc.encoder.datasets import Dataset, load_dataset
from kpc.encoder.field.config import TrainConfig
from kpc.encoder.field.layout import time_rows
from kpc.encoder.training import temporal_resolution
from kpc.encoder.training.temporal_resolution import fit_frames_per_row, measure_time_resolution
from kpc.format.common.images import write_image

# The last frame is 48 after the first: a spacing r that divides 48 has 48 / r + 1 rows, which can match a clip exactly.
FRAMES = 49

# A function of frame numbers (n,) to colours in [0, 1].
Signal = Callable[[np.ndarray], np.ndarray]


def film(folder: Path, signal: Signal, noise: float = 0.0, moving: float = 0.5, masked: bool = False) -> Dataset:
    """Write two cameras whose pictures follow `signal` in their left part, which is ignored if `masked`."""
    rng = np.random.default_rng(2)
    (folder / "set/images").mkdir(parents=True)
    frames = []
    for k, camera in enumerate(make.ring(2)):
        base = rng.uniform(0.2, 0.3, (24, 32, 3))
        for t in range(FRAMES):
            pixels = base.copy()
            pixels[:, : int(32 * moving)] += 0.5 * signal(np.array([t]))
            pixels += noise * rng.normal(size=pixels.shape)
            name = f"images/{k}_{t:03d}.png"
            write_image(folder / "set" / name, np.rint(255 * pixels.clip(0, 1)).astype(np.uint8))
            if masked:
                make.write_mask(folder / f"set/masks/{k}_{t:03d}.png", np.arange(32) + np.zeros((24, 1)) >= 16)
            c = camera
            frames.append({"file_path": name, "transform_matrix": c.camera_to_world.tolist(), "time": t / (FRAMES - 1),
                           "w": 32, "h": 24, "fl_x": c.fl_x, "fl_y": c.fl_y, "cx": c.cx, "cy": c.cy})  # fmt: skip
    (folder / "set/transforms.json").write_text(make.json.dumps({"test_filenames": [], "frames": frames}))
    return load_dataset(folder / "set", folder / "cache", progress=False)


def wave(period: float) -> Signal:
    return lambda t: 0.5 + 0.5 * np.sin(2 * np.pi * t / period)


@pytest.fixture(scope="module")
def clips(tmp_path_factory: pytest.TempPathFactory) -> Callable[[float], Dataset]:
    found: dict[float, Dataset] = {}

    def of(period: float) -> Dataset:
        if period not in found:
            found[period] = film(tmp_path_factory.mktemp("clip"), wave(period))
        return found[period]

    return of


def by_definition(dataset: Dataset, spacing: int) -> float:
    """Return the error of linear interpolation on all changing pixels, by numpy's least squares for each."""
    rows, pictures = time_rows(dataset.clip.frame_count, spacing), dataset.pictures
    squares, values = 0.0, 0
    for camera in np.unique(pictures.camera):
        mine = np.flatnonzero(pictures.camera == camera)
        mine = mine[np.argsort(pictures.time[mine])]
        colours = np.stack([dataset.pixels.picture(int(p)) for p in mine]).astype(float) / 255
        position = pictures.time[mine].astype(float) * (rows - 1)
        matrix = np.stack([np.interp(position, np.arange(rows), np.eye(rows)[row]) for row in range(rows)], axis=1)
        signal = colours.reshape(len(mine), -1, 3)
        signal = signal[:, signal.var(0).mean(1) > temporal_resolution.CHANGING**2].reshape(len(mine), -1)
        missed = signal - matrix @ np.linalg.lstsq(matrix, signal, rcond=None)[0]
        squares, values = squares + float(np.square(missed).sum()), values + signal.size
    return math.sqrt(squares / values)


def test_interpolation_errors_equal_least_squares(clips: Callable[[float], Dataset]) -> None:
    for period in (8, 24):
        found = measure_time_resolution(clips(period), 0.05)
        assert found is not None and found.error <= 0.05 < found.next_error
        assert found.error == pytest.approx(by_definition(clips(period), found.frames_per_row), rel=1e-3, abs=1e-5)
        wider = temporal_resolution._spacings(FRAMES)[
            temporal_resolution._spacings(FRAMES).index(found.frames_per_row) + 1
        ]
        assert found.next_error == pytest.approx(by_definition(clips(period), wider), rel=1e-3)
        assert found.changing == pytest.approx(0.5) and found.noise < 1e-3


def test_slow_motion_needs_fewer_rows(clips: Callable[[float], Dataset]) -> None:
    chosen = []
    for period in (3, 12, 24, 96):
        found = measure_time_resolution(clips(period), 0.02)
        assert found is not None
        chosen.append(found.frames_per_row)
    assert chosen == sorted(chosen) and chosen[0] == 1 and len(set(chosen)) == 4 and chosen[-1] >= 12


def test_linear_change_needs_two_rows(tmp_path: Path) -> None:
    dataset = film(tmp_path, lambda t: t / (FRAMES - 1))
    found = measure_time_resolution(dataset, 0.02)
    assert found is not None and time_rows(FRAMES, found.frames_per_row) == 2 and math.isnan(found.next_error)


def test_noise_adds_no_rows_and_hides_no_motion(tmp_path: Path) -> None:
    """Noise of 0.04 is near the tolerance: by itself it would require more rows."""
    for name, period in (("slow", 48), ("fast", 6)):
        (tmp_path / name).mkdir()
        clean = measure_time_resolution(film(tmp_path / name / "clean", wave(period)), 0.04)
        noisy = measure_time_resolution(film(tmp_path / name / "noisy", wave(period), noise=0.04), 0.04)
        assert clean is not None and noisy is not None
        assert noisy.frames_per_row == clean.frames_per_row
        assert noisy.noise == pytest.approx(0.04, rel=0.15) and noisy.error == pytest.approx(clean.error, abs=0.008)


def test_a_scene_that_hardly_changes_has_two_rows(tmp_path: Path) -> None:
    dataset = film(tmp_path, lambda t: 0.02 * np.sin(t), noise=0.004)
    found = measure_time_resolution(dataset, 0.01)
    assert found is not None and found.changing == 0 and time_rows(FRAMES, found.frames_per_row) == 2


def test_masked_pixels_do_not_count(tmp_path: Path) -> None:
    dataset = film(tmp_path, wave(5), masked=True)
    found = measure_time_resolution(dataset, 0.02)
    assert found is not None and found.changing == 0


def test_smaller_samples_give_the_same_result(
    clips: Callable[[float], Dataset], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Few pixels, few lines and three short spans of a uniform clip suffice; no more values are read than stated."""
    whole = measure_time_resolution(clips(8), 0.05)
    for name, value in (("VALUES", 1600), ("LINES", 5), ("SPAN", 16), ("CAMERAS", 1)):
        monkeypatch.setattr(temporal_resolution, name, value)
    taken = list(temporal_resolution._spans(clips(8), temporal_resolution.group_by_camera(clips(8))))
    assert [colours.shape[:2] for _, colours in taken] == [(16, 100)] * 3
    assert taken[0][0][0] == 0 and taken[2][0][-1] == 1
    some = measure_time_resolution(clips(8), 0.05)
    assert some is not None and whole is not None
    assert some.frames_per_row == whole.frames_per_row and some.error == pytest.approx(whole.error, abs=0.01)


def test_the_config_takes_the_measured_spacing(clips: Callable[[float], Dataset], moving: Dataset) -> None:
    config = TrainConfig(time_tolerance=0.02)
    fitted, found = fit_frames_per_row(config, clips(24))
    assert found is not None and fitted == replace(config, frames_per_row=found.frames_per_row) != config
    assert fit_frames_per_row(config, clips(24)) == (fitted, found)  # a run that is resumed finds the same
    for other, dataset in (
        (config, moving),
        (replace(config, time_tolerance=0.0), clips(24)),
        (replace(config, motion_cells=4), clips(24)),
    ):
        assert fit_frames_per_row(other, dataset) == (other, None)


def test_cameras_that_show_little_of_the_clip_are_not_measured(clips: Callable[[float], Dataset]) -> None:
    """Anything may have happened between the frames that a camera shows."""
    pictures = clips(8).pictures
    seldom = replace(pictures, is_test=(pictures.camera == 1) & (np.arange(len(pictures)) % 3 > 0))
    assert (
        measure_time_resolution(clips(8), 0.05) is not None
        and measure_time_resolution(replace(clips(8), pictures=seldom), 0.05) is None
    )
