"""The first pass finds the object in a much too large box, and leaves the box alone where it cannot judge."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from kpc.encoder.cli.options import Options
from kpc.encoder.datasets import Dataset
from kpc.encoder.field.config import PRESETS, TrainConfig
from kpc.encoder.training import tight_bounds, train
from kpc.encoder.training.tight_bounds import MAX_STEPS, PASSES, nearest_to_box, trim_box
from kpc.encoder.training.train import Report

CONFIG = TrainConfig(steps=1500, rays=256, samples=12288, warmup=5)
LARGE = np.array([[-3, -3, -3], [3, 3, 3]], np.float32)
pytestmark = pytest.mark.usefixtures("one_thread")


def test_a_large_box_is_trimmed_to_the_object(moving: Dataset) -> None:
    box, seconds = trim_box(moving, CONFIG, LARGE, lambda report: None)
    assert seconds > 0 and box.dtype == np.float32 and (box[0] < box[1]).all()
    assert (box[0] >= LARGE[0]).all() and (box[1] <= LARGE[1]).all()
    assert np.prod(box[1] - box[0]) < 0.5 * np.prod(LARGE[1] - LARGE[0])


def test_the_points_of_lines_that_are_nearest_to_a_box() -> None:
    rng = np.random.default_rng(0)
    box = np.array([[-1.0, -0.5, -0.2], [1.0, 0.5, 0.3]])
    origins, directions = rng.uniform(-3, 3, (300, 3)), rng.normal(size=(300, 3))
    nearest = nearest_to_box(box, origins, directions)
    distances = np.linalg.norm(nearest - np.clip(nearest, *box), axis=1)
    t = np.linspace(-8, 8, 20001)[:, None]
    least = []
    for origin, direction in zip(origins, directions, strict=True):
        points = origin + t * direction / np.linalg.norm(direction)
        least.append(np.linalg.norm(points - np.clip(points, *box), axis=1).min())
    np.testing.assert_allclose(distances, least, atol=1e-3)
    assert 10 < (distances < 1e-9).sum() < 200
    across = np.cross(nearest - origins, directions)
    np.testing.assert_allclose(across, 0, atol=1e-9)  # they lie on the lines


def test_a_short_run_keeps_its_box(moving: Dataset) -> None:
    box, seconds = trim_box(moving, replace(CONFIG, steps=900), LARGE, lambda report: None)
    assert box is LARGE and seconds == 0
    box, _ = trim_box(moving, replace(CONFIG, steps=5), LARGE, lambda report: None, time_budget_s=1e-3)
    assert box is LARGE


def test_trimming_takes_a_bounded_part_of_the_time(moving: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(train, "REPORT_S", 0.0)  # else a fast machine is done before the first report
    steps: list[int] = []
    long = replace(CONFIG, steps=10 * MAX_STEPS)
    box, seconds = trim_box(moving, long, LARGE, lambda report: steps.append(report.step), time_budget_s=1e5)
    assert steps[-1] <= MAX_STEPS and seconds < 1e4
    assert np.array_equal(box, trim_box(moving, long, LARGE, lambda report: None)[0])


@pytest.fixture
def passes(monkeypatch: pytest.MonkeyPatch) -> list[float | None]:
    """The time budgets of passes that each take 2 s and halve a box, down to an edge of 3."""
    budgets: list[float | None] = []

    def halve(dataset, config, aabb, report, time_budget_s, mapping):
        budgets.append(time_budget_s)
        report(Report(config.steps, 1.0, 20.0, 1.0, 1.0, 1.0, 2.0))
        return (aabb / max(1.0, min(2.0, (aabb[1] - aabb[0]).max() / 3))).astype(np.float32), 2.0

    monkeypatch.setattr(tight_bounds, "_trim_once", halve)
    return budgets


@pytest.mark.parametrize("edges, count, left", [(3, 1, 3), (3.1, 1, 3), (6, 2, 3), (12, 3, 3), (100, PASSES, 12.5)])
def test_passes_go_on_while_the_box_shrinks_much(moving, passes, edges, count, left) -> None:
    fractions: list[float] = []
    found = replace(moving, poses_found=True)
    box, seconds = trim_box(found, CONFIG, LARGE * (edges / 6), lambda report: fractions.append(report.fraction))
    assert (box[1] - box[0]).max() == pytest.approx(left)
    assert seconds == 2 * count and passes == [None] * count
    assert fractions == pytest.approx([(done + 1) / PASSES for done in range(count)])


@pytest.mark.parametrize("budget_s, budgets", [(15, [1.5]), (39, [3.9]), (40, [4.0, 2.0]), (100, [10.0, 8.0, 6.0])])
def test_passes_stay_within_the_time(moving, passes, budget_s, budgets) -> None:
    trim_box(replace(moving, poses_found=True), CONFIG, LARGE * 20, lambda report: None, time_budget_s=budget_s)
    assert passes == pytest.approx(budgets)


def test_there_is_one_pass_where_poses_were_given(moving, passes) -> None:
    assert trim_box(moving, CONFIG, LARGE * 20, lambda report: None)[1] == 2
    assert passes == [None]


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
