"""A dry run estimates what a run would take, and leaves nothing."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

import datasets as make
from kpc.encoder.cli import estimate as module
from kpc.encoder.cli import kpenc
from kpc.encoder.cli.work_folder import CHECKPOINT
from kpc.encoder.datasets import Dataset
from kpc.encoder.field.config import PRESETS
from kpc.encoder.training.train import Trainer
from training_runs import BOX, TINY

pytestmark = pytest.mark.usefixtures("one_thread")
CONFIG = replace(TINY, steps=400)


def test_training_is_extrapolated_from_the_watched_steps(moving: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    """The clock ticks once per step: 3 s in the first half of the watched steps, 1 s in the others."""
    run = Trainer(moving, CONFIG, BOX, "cpu", elapsed_s=5.0)
    watched = module.STEPS * CONFIG.occupancy_start
    inner = run.run

    def slow(*args: object, interrupted: Callable[[], bool]) -> None:
        def ticking() -> bool:
            run.elapsed_s = 5.0 + sum(3.0 if k < watched // 2 else 1.0 for k in range(run.step))
            return interrupted()

        inner(*args, interrupted=ticking)  # type: ignore[arg-type]

    monkeypatch.setattr(run, "run", slow)
    found = module.estimate(run, validation_rays=100, test_views=3, spent_s=2.0, time_budget_s=None)
    assert run.step == watched
    assert found.train_s == pytest.approx(5 + 3 * watched // 2 + 1.0 * (CONFIG.steps - watched // 2), abs=3)
    assert (found.test_pictures, found.held_out_pictures) == (3, 3) and found.test_s > 0
    assert found.rest_s > 2 and found.memory_bytes > 16 * run.field.theta.numel()


def test_fine_tuning_is_counted(moving: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    """From the time of coding once, and of a ray in training and in rendering."""
    for name, seconds in (("_time_coding", 2.0), ("_time_ray", 1e-4), ("_time_curvature", 1.0)):
        monkeypatch.setattr(module, name, lambda _, seconds=seconds: seconds)
    found = []
    for tune_steps in (0, 100):
        run = Trainer(moving, replace(CONFIG, steps=1250, tune_steps=tune_steps), BOX, "cpu")
        found.append(module.estimate(run, validation_rays=100, test_views=0, spent_s=0.0, time_budget_s=None).rest_s)
    scene = run.scene()
    steps = module.total_steps(scene, module.steps_per_group(1250, scene, 100))
    tuned = 2.0 + steps * module.RAYS * (1 / run.rays_per_second + 1e-4)
    assert 200 < steps <= 250
    assert found[1] - found[0] == pytest.approx(module.TUNED_CODINGS * tuned)


def test_steps_of_the_coarsest_scale_are_counted_separately(moving: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the same clock: 1 s per step for the coarsest scale alone, 4 s for all."""
    run = Trainer(moving, replace(CONFIG, coarse_until=0.3), BOX, "cpu")
    watched = module.STEPS * CONFIG.occupancy_start
    inner = run.run

    def slow(*args: object, interrupted: Callable[[], bool]) -> None:
        def ticking() -> bool:
            run.elapsed_s = sum(1.0 if k < watched else 4.0 for k in range(run.step))
            return interrupted()

        inner(*args, interrupted=ticking)  # type: ignore[arg-type]

    monkeypatch.setattr(run, "run", slow)
    found = module.estimate(run, validation_rays=100, test_views=0, spent_s=0.0, time_budget_s=None)
    assert run.step > watched and found.train_s == pytest.approx(0.3 * 400 * 1.0 + 0.7 * 400 * 4.0, rel=0.03)


def test_a_time_budget_is_the_training_time(moving: Dataset) -> None:
    run = Trainer(moving, CONFIG, BOX, "cpu")
    found = module.estimate(run, 100, None, 0.0, 600.0)
    assert found.train_s == 600.0 and found.test_pictures == found.held_out_pictures


def test_it_is_said_if_nothing_is_held_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(PRESETS, "draft", CONFIG)
    make.write_nerfstudio(tmp_path / "set", test_filenames=[])
    words = [str(tmp_path / "set"), "--preset", "draft", "--steps", "30", "--dry-run"]
    for options, count in (([], 1), (["--holdout", "none"], 0), (["--holdout", "0001"], 0)):
        assert kpenc.main([*words, *options]) == 0
        said = capsys.readouterr().err
        assert said.count("nothing is held out, so the quality will not be measured; --holdout NAME holds") == count


def test_a_dry_run_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(PRESETS, "draft", CONFIG)
    make.write_blender(tmp_path / "set")
    monkeypatch.chdir(tmp_path)
    words = ["set", "--preset", "draft", "--steps", "30", "--dry-run"]
    assert kpenc.main(words) == 0
    out, err = capsys.readouterr()
    assert "would take" in out and "3 of 3 held-out pictures" in out and "MB of memory" in out and "planes" in err
    assert {p.name for p in tmp_path.iterdir()} == {"set"}
    work = tmp_path / "set.kpc.work"
    work.mkdir()
    (work / CHECKPOINT).touch()  # of an interrupted run
    assert kpenc.main([*words, "--json", "--cache", "shared", "--downscale", "auto"]) == 0
    names = {"train_s", "test_s", "rest_s", "memory_bytes", "test_pictures", "held_out_pictures", "disk_bytes"}
    out, err = capsys.readouterr()
    found = json.loads(out)
    assert set(found) == names and "20 pixels across: --downscale 1 (auto: " in err
    assert [p.name for p in work.iterdir()] == [CHECKPOINT]
    (pixels,) = (tmp_path / "shared").glob("*.bin")
    assert found["disk_bytes"] == pixels.stat().st_size and str(pixels.relative_to(tmp_path)) in err
    assert kpenc.main([*words, "-o", "out.kpc", "--keep"]) == 0
    assert {p.suffix for p in (tmp_path / "out.kpc.work").iterdir()} == {".bin", ".json"}
    with pytest.raises(SystemExit, match="2"):
        kpenc.main([*words, "--resume"])
    with pytest.raises(SystemExit, match="2"):
        kpenc.main([*words, "--audio", "none", "--audio-bitrate", "64000"])
    with pytest.raises(SystemExit, match="2"):
        kpenc.main(words[:-1])  # only a dry run needs no -o
