import json
import operator
import os
import pickle
import shlex
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import gl
import kpc
from datasets import write_n3dv
from kpc.encoder.coding.scene_writer import write
from kpc.encoder.evaluation import profile
from kpc.encoder.evaluation.ablations import ABLATIONS, effective_ablations
from kpc.encoder.field.config import PRESETS
from kpc.format.coding.quantise import quantise_scene
from kpc.player.quality import DEFAULT, LEVELS
from kpc.tools.bench import harness, kpbench, machine_limits, plot, results, scaling, tables
from kpc.tools.bench.provenance import data_hash
from scenes import tiny_scene

SMALL = replace(
    PRESETS["draft"],
    resolutions=(8, 16),
    samples_across=32,
    cells_across=12,
    rays=256,
    samples=8192,
    warmup=5,
    occupancy_start=8,
    occupancy_every=4,
)


GROUPS = str(Path(__file__).parents[2] / "spec" / "vectors" / "valid" / "groups.kpc")


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch, one_thread: None, quick_coding: None, rounded: None) -> None:
    """Run in this process with little to do; jobs and results are pickled as for a separate process."""

    def isolated(work: Callable[[Any], Any], job: Any) -> Any:
        work, job = pickle.loads(pickle.dumps((work, job)))
        return pickle.loads(pickle.dumps(work(job)))

    monkeypatch.setattr(harness, "isolated", isolated)
    monkeypatch.setitem(PRESETS, "draft", SMALL)


def tiny_file(path: Path, dynamic: bool) -> Path:
    scene = tiny_scene(1, dynamic=dynamic)
    write(quantise_scene(scene, [dict.fromkeys(scale, 0.01) for scale in scene.scales]), path)
    return path


def test_encode_records_every_repeat(here: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_n3dv(tmp_path / "tiny", frames=2)
    command = [
        "encode",
        str(tmp_path / "tiny"),
        "--preset",
        "draft",
        "--steps",
        "3",
        "--repeats",
        "2",
        "--seed",
        "5",
        "--test-views",
        "1",
        "--box=-1,-1,-1,1,1,1",
        "--keep-scenes",
        str(tmp_path / "kept"),
        "--psnr",
        "3dB",
    ]
    assert kpbench.main(command) == 0
    output = capsys.readouterr()
    (record,) = json.loads(output.out)
    assert record["kind"] == "encode" and record["name"] == "tiny" and record["renderer"] == "cpu"
    assert record["command"] == shlex.join(["kpbench", *command]) and record["seed"] == 5
    assert record["data_sha256"] == data_hash(tmp_path / "tiny")
    assert record["settings"] == {
        "preset": "draft",
        "steps": 3,
        "time_budget_s": None,
        "downscale": 1,
        "test_views": 1,
        "space": "auto",
        "box": [-1, -1, -1, 1, 1, 1],
        "psnr_db": 3.0,
    }
    assert all(run["trade"] == "psnr_db" for run in record["repeats"]) and "--psnr 3" in tables.markdown([record])
    assert [run["seed"] for run in record["repeats"]] == [5, 6]
    for run in record["repeats"]:
        kept = tmp_path / "kept" / run["file"]
        assert run["size_bytes"] == kept.stat().st_size and kpc.load(kept).is_dynamic
        assert run["test_pictures"] == 1 and run["test_psnr"] > 3 and run["peak_memory_bytes"] > 1 << 26
    names = [f"tiny-draft-{seed}.{kind}" for seed in (5, 6) for kind in ("kpc", "kpck")]
    assert sorted(p.name for p in (tmp_path / "kept").iterdir()) == names
    assert "PSNR dB" in output.err and tables.markdown([record])


def test_step_compares_with_plain_pytorch_and_the_machine(
    here: None, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(profile, "STEPS", 1)
    monkeypatch.setattr(profile, "FUSED_STEPS", 5)
    monkeypatch.setattr(machine_limits, "MEMORY_BYTES", 1 << 24)
    write_n3dv(tmp_path / "tiny", frames=2)
    command = [
        "step",
        str(tmp_path / "tiny"),
        "--preset",
        "draft",
        "--box=-1,-1,-1,1,1,1",
        "--out",
        str(tmp_path / "step.json"),
    ]
    assert kpbench.main(command) == 0
    (record,) = results.load([tmp_path / "step.json"])
    (run,) = record["repeats"]
    assert run["rays_per_s"] > run["plain_rays_per_s"] > 0 and run["limits"]["gflops"] > 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["step.json", "tiny"]
    assert "rays/s" in capsys.readouterr().err and "speedup" in tables.markdown([record])


def test_scaling_changes_one_thing_at_a_time(
    here: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    base = scaling.BASE
    for size in scaling.sizes():
        changed = [name for name, value in vars(size.scene).items() if value != vars(base)[name]]
        assert len(changed) + (size.ablation != "baseline") <= 2
    axes: dict[str, list[float]] = {size.axis: [] for size in scaling.sizes()}
    for size in scaling.sizes():
        axes[size.axis].append(size.amount)
    assert len(axes) == 5 and all(amounts[0] < amounts[1] < amounts[2] for amounts in axes.values())
    tiny = replace(base, cameras=3, frames=3, width=40, height=32)
    some = [scaling.Size("frames", frames, replace(tiny, frames=frames)) for frames in (3, 6)]
    monkeypatch.setattr(scaling, "sizes", lambda: [*some, scaling.Size("cameras", 3, tiny)])
    out = tmp_path / "scaling.json"
    assert kpbench.main(["scaling", "--steps", "2", "--repeats", "2", "--out", str(out)]) == 0
    small, large, same = results.load([out])
    assert same["repeats"] == small["repeats"] != large["repeats"] and len(small["repeats"]) == 2
    assert [record["settings"]["amount"] for record in (small, large, same)] == [3, 6, 3]
    assert small["data_sha256"] == same["data_sha256"] != large["data_sha256"]
    assert all(run["read_s"] > 0 and run["rest_s"] > 0 and run["size_bytes"] > 0 for run in small["repeats"])
    assert "reading s" in capsys.readouterr().err


def test_curve_encodes_once_per_duration(here: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_n3dv(tmp_path / "tiny", frames=2)
    out = tmp_path / "curve.json"
    command = [
        "curve",
        str(tmp_path / "tiny"),
        "--preset",
        "draft",
        "--minutes",
        "0.002,0.02",
        "--box=-1,-1,-1,1,1,1",
        "--out",
        str(out),
        "--keep-scenes",
        str(tmp_path / "kept"),
    ]
    assert kpbench.main(command) == 0
    output = capsys.readouterr()
    records = results.load([out])
    assert [record["settings"]["time_budget_s"] for record in records] == pytest.approx([0.12, 1.2])
    for record in records:
        assert record["kind"] == "curve" and record["name"] == "tiny"
        (run,) = record["repeats"]
        assert run["train_s"] >= record["settings"]["time_budget_s"] and run["steps"] > 0
        assert run["test_psnr"] > 3 and -1 < run["test_ssim"] <= 1
        assert run["size_bytes"] == (tmp_path / "kept" / run["file"]).stat().st_size
    assert len(list((tmp_path / "kept").glob("*.kpc"))) == 2
    assert records[0]["repeats"][0]["steps"] < records[1]["repeats"][0]["steps"]
    assert output.out == "" and "training" in output.err and "against time" in tables.markdown(records)
    assert plot.main([str(out), "-o", str(tmp_path / "curve.svg")]) == 0
    assert "held-out PSNR, dB" in (tmp_path / "curve.svg").read_text()


def test_ablate_changes_one_thing_at_a_time(
    here: None, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    # After three steps no channel contributes anything yet: keep them all.
    monkeypatch.setitem(PRESETS, "draft", replace(SMALL, prune_share=0.0))
    for name in set(ABLATIONS) - {"baseline", "half the channels", "planes summed", "no motion grid"}:
        monkeypatch.delitem(ABLATIONS, name)
    write_n3dv(tmp_path / "tiny", frames=2)
    out = tmp_path / "ablate.json"
    command = [
        "ablate",
        str(tmp_path / "tiny"),
        "--preset",
        "draft",
        "--steps",
        "3",
        "--box=-1,-1,-1,1,1,1",
        "--out",
        str(out),
    ]
    assert kpbench.main(command) == 0
    records = results.load([out])  # this scene has no motion grid to leave out
    assert [record["settings"]["ablation"] for record in records] == [
        "baseline",
        "half the channels",
        "planes summed",
    ]
    whole, half, added = (record["repeats"][0] for record in records)
    assert added["test_psnr"] > 5 and "size_bytes" not in added  # the format cannot hold summed planes
    assert whole["parameters"] > 1.8 * half["parameters"] and whole["steps"] == half["steps"] == 3
    assert "variant" in capsys.readouterr().err and "half the channels" in tables.markdown(records)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["ablate.json", "tiny"]


def test_every_ablation_affects_some_config() -> None:
    plain = PRESETS["balanced"]
    lone, unequal = plain.for_single_object(), replace(plain, appearance="image")
    assert set(effective_ablations(plain)) | set(effective_ablations(lone)) | set(effective_ablations(unequal)) == set(
        ABLATIONS
    )
    assert "no appearances" in effective_ablations(unequal) and "no appearances" not in effective_ablations(plain)
    assert "no motion grid" in effective_ablations(lone) and "no motion grid" not in effective_ablations(plain)
    assert "view-independent colour" not in effective_ablations(lone) and effective_ablations(plain)[0] == "baseline"
    assert ABLATIONS["baseline"](plain) is plain


def test_jobs_run_in_a_process_of_their_own() -> None:
    assert harness.isolated(operator.call, os.getpid) not in (0, os.getpid())


def test_player_measures_every_quality(here: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    gl.context()
    moving, still = tiny_file(tmp_path / "moving.kpc", True), tiny_file(tmp_path / "still.kpc", False)
    out = tmp_path / "out.json"
    assert kpbench.main(["player", str(moving), str(still), "--size", "48x36", "--frames", "4", "--out", str(out)]) == 0
    output = capsys.readouterr()
    records = results.load([out])
    assert output.out == "" and "PSNR to reference dB" in output.err and f"{DEFAULT} (default)" in output.err
    assert [(r["name"], r["settings"]["quality"]) for r in records] == [
        (name, quality) for name in ("moving", "still") for quality in LEVELS
    ]
    for record in records:
        (run,) = record["repeats"]
        assert len(run["frame_ms"]) == 4 and min(run["frame_ms"]) <= run["frame_ms_median"] <= run["frame_ms_p95"]
        parts = run["load_ms"] + run["upload_ms"] + run["first_render_ms"]
        assert run["first_frame_ms"] == pytest.approx(parts) and run["cpu_ms_median"] > 0
        assert run["gpu_memory_bytes"] > 0 and record["accuracy"]["samples_per_ray"] > 0 and record["renderer"]
        if record["settings"]["quality"] == "reference":
            assert record["accuracy"]["psnr"] > 50 and record["accuracy"]["within_one_level"] > 0.999
            assert record["accuracy"]["psnr_moving"] > 50 and run["speedup_over_reference"] == 1
            assert record["accuracy"]["psnr_min"] == record["accuracy"]["psnr_min_moving"] == 100
            most, folding = record["accuracy"]["folding_max_error"], record["accuracy"]["folding_psnr"]
            assert (
                (most < 1e-5 and folding == 100)
                if record["name"] == "still"
                else 1 / 255 < most < 0.5 and 30 < folding < 90
            )
        else:
            assert "folding_psnr" not in record["accuracy"]
        if record["settings"]["quality"] == DEFAULT:
            assert min(record["accuracy"]["psnr_min"], record["accuracy"]["psnr_min_moving"]) > 35
    assert plot.main([str(out), "-o", str(tmp_path / "player.svg")]) == 0
    assert "milliseconds per frame" in (tmp_path / "player.svg").read_text()


def test_stream_measures_loading_and_seeking(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    gl.context()
    monkeypatch.setattr(harness, "isolated", lambda work, job: work(job))
    moving, still = tiny_file(tmp_path / "moving.kpc", True), tiny_file(tmp_path / "still.kpc", False)
    out = tmp_path / "out.json"
    assert kpbench.main(["stream", str(moving), str(still), "--size", "48x36", "--out", str(out)]) == 0
    first, second = results.load([out])
    assert "first picture ms" in capsys.readouterr().err and "| still | " in tables.markdown([second])
    for record in (first, second):
        (run,) = record["repeats"]
        for source in ("disk", "network"):
            stages = ("open", "first_picture", "full_detail", "complete")
            open_ms, first_ms, finest_ms, all_ms = (run[f"{source}_{stage}_ms"] for stage in stages)
            assert 0 < open_ms < first_ms < finest_ms <= all_ms
        assert 0 < run["network_first_picture_bytes"] <= run["size_bytes"]
        sizes, quality = ([prefix[key] for prefix in record["prefixes"]] for key in ("bytes", "psnr"))
        assert sizes == sorted(sizes) and sizes[-1] == run["size_bytes"] and quality[-1] > 80 > quality[0]
    assert first["repeats"][0]["seeks"] >= first["repeats"][0]["seeks_that_waited"] > 0
    assert "seek_ms" not in second["repeats"][0]


def test_records_before_a_failure_are_kept(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    gl.context()
    monkeypatch.setattr(harness, "isolated", lambda work, job: work(job))
    good, bad = tiny_file(tmp_path / "good.kpc", False), tmp_path / "bad.kpc"
    bad.write_bytes(good.read_bytes()[:-1] + b"x")
    assert kpbench.main(["player", str(good), str(bad), "--size", "8x6", "--frames", "1"]) == 1
    output = capsys.readouterr()
    assert [record["name"] for record in json.loads(output.out)] == ["good"] * len(LEVELS)
    assert output.err.splitlines()[-1].startswith(f"kpbench: {bad}: ")


@pytest.mark.parametrize("kind", ["codec", "entropy", "decode", "player", "stream", "window", "steady", "web"])
@pytest.mark.parametrize("wrong", ["none.kpc", "bad.kpc"])
def test_all_scenes_are_looked_at_before_the_first_is_measured(
    kind: str, wrong: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    good, bad = tiny_file(tmp_path / "good.kpc", False), tmp_path / wrong
    if wrong == "bad.kpc":
        bad.write_bytes(b"nonsense")
    assert kpbench.main([kind, str(good), str(bad)]) in (1, 2)
    output = capsys.readouterr()
    assert output.out == "" and output.err.startswith(f"kpbench: {bad}: ") and output.err.count("\n") == 1


@pytest.mark.parametrize("minutes", ["", "0", "-1", "nan", "inf", "1,,2", "soon"])
def test_invalid_minutes_are_refused(minutes: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        kpbench.main(["curve", ".", f"--minutes={minutes}"])
    assert "--minutes" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["x", "x.csv", "x.svg", "x.json/"])
def test_records_are_json(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as error:
        kpbench.main(["player", "x.kpc", "--out", name])
    assert error.value.code == 2 and f"{name!r} does not end in .json" in capsys.readouterr().err


@pytest.mark.parametrize(
    "command",
    [
        ["encode", "missing"],
        ["curve", "missing"],
        ["ablate", "missing"],
        ["player", "missing.kpc"],
        ["player", "x.kpc", "--out", "no/x.json"],
        ["player", GROUPS],
    ],
)
def test_errors_are_one_line(
    command: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert kpbench.main(command) in (1, 2)
    output = capsys.readouterr()
    assert output.out == "" and output.err.startswith("kpbench: ") and output.err.count("\n") == 1


@pytest.mark.parametrize("option", ["--box=1,1,1,0,0,0", "--box=nan,0,0,1,1,1", "--time-budget=soon", "--repeats=0"])
def test_invalid_options_are_refused(option: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        kpbench.main(["encode", ".", option])
    assert option.split("=")[0] in capsys.readouterr().err


def test_presets_are_those_of_kpenc(capsys: pytest.CaptureFixture[str]) -> None:
    for kind in ("encode", "curve"):
        with pytest.raises(SystemExit):
            kpbench.main([kind, "--help"])
        assert "{" + ",".join(PRESETS) + "}" in capsys.readouterr().out
