"""The first pass finds the object in a much too large box, and leaves the box alone where it cannot judge."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from kpc.encoder.cli.options import Options
from kpc.encoder.datasets import Dataset
from kpc.encoder.field.config import PRESETS, TrainConfig
from kpc.encoder.training.tight_bounds import MAX_STEPS, trim_box

CONFIG = TrainConfig(steps=1500, rays=256, samples=12288, warmup=5)
LARGE = np.array([[-3, -3, -3], [3, 3, 3]], np.float32)
pytestmark = pytest.mark.usefixtures("one_thread")


def test_a_large_box_is_trimmed_to_the_object(moving: Dataset) -> None:
    box, seconds = trim_box(moving, CONFIG, LARGE, lambda report: None)
    assert seconds > 0 and box.dtype == np.float32 and (box[0] < box[1]).all()
    assert (box[0] >= LARGE[0]).all() and (box[1] <= LARGE[1]).all()
    assert np.prod(box[1] - box[0]) < 0.5 * np.prod(LARGE[1] - LARGE[0])


def test_a_short_run_keeps_its_box(moving: Dataset) -> None:
    box, seconds = trim_box(moving, replace(CONFIG, steps=900), LARGE, lambda report: None)
    assert box is LARGE and seconds == 0
    box, _ = trim_box(moving, replace(CONFIG, steps=5), LARGE, lambda report: None, time_budget_s=1e-3)
    assert box is LARGE


def test_trimming_takes_a_bounded_part_of_the_time(moving: Dataset) -> None:
    steps: list[int] = []
    long = replace(CONFIG, steps=10 * MAX_STEPS)
    box, seconds = trim_box(moving, long, LARGE, lambda report: steps.append(report.step), time_budget_s=1e5)
    assert steps[-1] <= MAX_STEPS and seconds < 1e4
    assert np.array_equal(box, trim_box(moving, long, LARGE, lambda report: None)[0])


def test_a_single_object_in_monocular_video_gets_an_adapted_config(moving: Dataset, tmp_path: Path) -> None:
    options = Options(tmp_path, tmp_path / "out.kpc", preset="balanced", steps=7, seed=3)
    plain, lone = PRESETS["balanced"], options.config(moving)
    assert (lone.channels, lone.resolutions, lone.view_dependent, lone.steps, lone.seed) == (32, (32, 128), False, 7, 3)
    surrounded = options.config(replace(moving, has_alpha=False))
    assert surrounded == replace(plain, steps=7, seed=3)
    assert replace(options, progressive=True).config(moving).scale_dropout > lone.scale_dropout == 0
    twice = replace(moving.pictures, time=np.zeros(len(moving.pictures), np.float32))
    assert options.config(replace(moving, pictures=twice)).view_dependent
    assert (
        replace(options, steps=None).config(moving).steps == 3 * plain.steps
        and lone.motion_cells > plain.motion_cells == 0
    )
