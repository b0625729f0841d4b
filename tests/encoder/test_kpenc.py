"""The whole command: a folder becomes a file; every error is one line and leaves other files alone."""

import builtins
import errno
import json
import math
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import datasets as make
import quick_coding
from kpc.encoder.cli import kpenc
from kpc.encoder.cli.work_folder import CHECKPOINT
from kpc.encoder.datasets import pixel_cache
from kpc.encoder.evaluation.preview import Preview
from kpc.encoder.field.config import PRESETS
from kpc.encoder.training import train
from kpc.encoder.training.train import Trainer
from kpc.format.common import cli
from kpc.format.container import scene_io
from kpc.format.scene.scene import HybridDecoder
from kpc.format.scene.space import DeviceCoordinates
from training_runs import TINY

pytestmark = pytest.mark.usefixtures("one_thread", "quick_coding", "rounded", "tiny", "heeded_signals")


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(PRESETS, "draft", TINY)


@pytest.fixture(scope="module")
def sets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sets")
    make.write_n3dv(folder / "n3dv", cameras=4)
    make.write_blender(folder / "blender")
    make.write_nerfstudio(folder / "nerfstudio")
    make.write_varying_exposure(folder / "unequal")
    make.write_colmap(folder / "colmap", model="OPENCV", lens=(0.06, -0.08, -0.001, 0.0002))
    for k in range(10):
        make.write_mask(folder / f"colmap/masks/{k:04d}.png.png", np.arange(32) + np.zeros((24, 1)) > k)
    return folder


Kpenc = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Kpenc:
    """Run the command on a dataset, to out.kpc unless another output is given: exit code, stdout, stderr."""

    def call(source: Path, *options: str, output: Path = tmp_path / "out.kpc") -> tuple[int, str, str]:
        capsys.readouterr()
        code = kpenc.main([str(source), "-o", str(output), "--preset", "draft", *options])
        return code, *capsys.readouterr()

    return call


def fails(
    run: Kpenc,
    tmp_path: Path,
    source: Path,
    *words: str,
    options: tuple[str, ...] = (),
    output: Path | None = None,
    code: int = 1,
    lines: int = 1,
) -> None:
    """Check for one line of error with all these words, the exit code, no files left, and an unchanged output file."""
    output = output or tmp_path / "out.kpc"
    there = output.is_dir() or output.exists()
    if not there and output.parent.is_dir():
        output.write_bytes(b"an earlier scene")
    found, out, err = run(source, *options, output=output)
    assert found == code and out == "", (found, out, err)
    assert err.startswith("kpenc: ") or lines > 1
    said = err.splitlines()
    assert len(said) == lines and said[-1].startswith("kpenc: "), err
    assert all(word in said[-1] for word in words), (words, err)
    assert "Traceback" not in err
    if output.is_file():
        assert output.read_bytes() == b"an earlier scene"
        beside = {p.name for p in output.parent.iterdir() if p.name.startswith((".", output.name))}
        assert beside <= {output.name, output.name + ".work"}


# --- it works


@pytest.mark.usefixtures("searched")
@pytest.mark.parametrize(
    "name, layout, dynamic, steps",
    [
        ("n3dv", "N3DV", True, 24),
        ("blender", "Blender", True, 72),
        ("nerfstudio", "nerfstudio", False, 24),
        ("colmap", "COLMAP", False, 24),
    ],
)
def test_a_folder_becomes_a_file(
    run: Kpenc, sets: Path, tmp_path: Path, name: str, layout: str, dynamic: bool, steps: int
) -> None:
    code, out, err = run(sets / name, "--json")
    assert code == 0
    result, output = json.loads(out), tmp_path / "out.kpc"
    assert [result[key] for key in ("layout", "dynamic", "steps", "file")] == [layout, dynamic, steps, str(output)]
    assert result["size_bytes"] == output.stat().st_size
    assert 5 < result["test_psnr"] < 60 and -1 < result["test_ssim"] <= 1 and result["test_pictures"] > 0
    assert (result["identity_share"] is not None) == dynamic
    assert result["bits_per_parameter"] == pytest.approx(8 * result["size_bytes"] / result["parameters"])
    scene = scene_io.read(output).dequantise()
    assert scene.is_dynamic == dynamic and scene.cameras and scene.parameter_count == result["parameters"]
    np.testing.assert_array_equal(scene.aabb, np.float32(result["box"]))
    provenance = scene.metadata.provenance
    assert (provenance["layout"], provenance["preset"]) == (layout, "draft") and len(provenance["dataset_sha256"]) == 64
    assert provenance["held_out"]["pictures"] == result["test_pictures"]
    assert provenance["held_out"]["psnr_db"] == pytest.approx(result["test_psnr"], rel=1e-6)
    assert ("moving_psnr_db" in provenance["held_out"]) == (name == "n3dv")  # others have a picture or two a camera
    assert len(scene.metadata.camera_names) == len(scene.cameras)
    assert layout in err and "box" in err and ("dynamic, " if dynamic else "static") in err
    assert {p.name for p in tmp_path.iterdir()} == {"out.kpc"}


@pytest.mark.parametrize("name", ["n3dv", "blender"])
def test_the_hybrid_decoder(run: Kpenc, searched: None, sets: Path, tmp_path: Path, name: str) -> None:
    code, out, err = run(sets / name, "--json", "--decoder", "hybrid")
    assert code == 0 and "hybrid decoder" in err
    decoder = scene_io.read(tmp_path / "out.kpc").decoder
    assert isinstance(decoder, HybridDecoder) and decoder.w2.any()
    assert decoder.w1.any() == (name == "n3dv")  # a lone object has the same colour from everywhere
    assert 5 < json.loads(out)["test_psnr"] < 60


def test_the_result_is_printed(run: Kpenc, sets: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    previewed: list[int] = []
    monkeypatch.setattr(train, "REPORT_S", 0.0)
    monkeypatch.setattr(Preview, "write", lambda self, trainer, step: previewed.append(step))
    code, out, err = run(sets / "blender", "--preview")
    assert previewed[0] < previewed[-1] == 72
    assert code == 0 and "displaced by a motion grid of 11x11x11 nodes" in err
    assert "colour: view-independent, as trained\nchannels kept: " in err
    assert "time: 2 rows, one for every 4 of 5 frames (the preset's" in err
    assert all(
        words in out
        for words in (
            "out.kpc: held-out PSNR ",
            " dB, SSIM ",
            "over 3 of 3 pictures",
            " bytes, ",
            "bits per parameter",
            "exactly at identity: ",
            "encoded in ",
            "(72 steps) and coding ",
        )
    )


@pytest.mark.parametrize(
    "tolerance, rows, why", [(1.0, 2, "1 allowed"), (1e-4, 4, "0.0001 allowed"), (0.0, 3, "the preset's")]
)
def test_time_rows_are_as_far_apart_as_motion_allows(
    run: Kpenc, sets: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, tolerance: float, rows: int, why: str
) -> None:
    """There are four frames; a resumed run finds the same number of rows."""
    each = {2: "every 2", 3: "every 1.5", 4: "each"}[rows]
    config = replace(TINY, time_tolerance=tolerance, frames_per_row=1.5)
    monkeypatch.setitem(PRESETS, "draft", config)
    for options in (("--keep",), ("--resume",)):
        code, _, err = run(sets / "n3dv", "--steps", "2", "--layers", "one", *options)
        (said,) = [line for line in err.splitlines() if line.startswith("time: ")]
        assert code == 0 and f"time: {rows} rows, one for {each} of 4 frames" in said and why in said
        assert len(scene_io.read(tmp_path / "out.kpc").scales[0]["xt"].symbols) == rows
    assert "resumed at step 2" in err


def test_options(run: Kpenc, sets: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code, out, err = run(
        sets / "n3dv",
        "--json",
        "--holdout",
        "none",
        "--steps",
        "9",
        "--downscale",
        "2",
        "--seed",
        "3",
        "--box",
        "-1,-1,-0.5,1,1,0.5",
        "--device",
        "cpu",
        "--work",
        str(tmp_path / "w"),
        "--keep",
    )
    result = json.loads(out)
    assert code == 0 and result["test_psnr"] is None and result["test_pictures"] == 0
    assert (result["steps"], result["seed"], result["device"]) == (9, 3, "cpu")
    assert result["box"] == [[-1, -1, -0.5], [1, 1, 0.5]]
    assert "16x12" in err and "0 of them held out" in err
    assert (tmp_path / "w" / CHECKPOINT).is_file() and any((tmp_path / "w").glob("pixels-*.bin"))
    code, out, _ = run(sets / "n3dv", "--holdout", "cam02", "--test-views", "2", "--steps", "1")
    assert code == 0 and "over 2 of 4 pictures" in out
    monkeypatch.setattr("kpc.encoder.evaluation.testing_time.FEWEST_PICTURES", 3)
    monkeypatch.setattr("kpc.encoder.cli.encode_scene.picture_seconds", lambda *_: math.inf)
    code, out, err = run(sets / "n3dv", "--holdout", "cam02", "--steps", "1")
    assert code == 0 and "testing 3 of 4 held-out pictures" in err and "over 3 of 4 pictures" in out
    code, out, err = run(sets / "n3dv", "--holdout", "none", "--steps", "1")
    assert code == 0 and "no view held out" in out and "nothing is held out" not in err


def test_masks_and_the_error_for_a_damaged_model(run: Kpenc, sets: Path, tmp_path: Path) -> None:
    code, _, err = run(sets / "colmap", "--steps", "2", "--keep")
    assert code == 0 and "distortion, masks (17.2% ignored)" in err
    assert len(list((tmp_path / "out.kpc.work").glob("pixels-*-masks.bin"))) == 1
    code, _, err = run(sets / "colmap", "--steps", "4", "--resume")
    assert code == 0 and "resumed at step 2" in err
    assert {p.name for p in tmp_path.iterdir()} == {"out.kpc"}
    (tmp_path / "out.kpc").unlink()
    folder = copied(sets, tmp_path, "colmap")
    make.write_mask(folder / "masks/0003.png.png", np.ones((9, 9), bool))
    fails(run, tmp_path, folder, "0003.png.png", "is 9x9, but 0003.png is 32x24")
    for k in range(10):
        make.write_mask(folder / f"masks/{k:04d}.png.png", np.zeros((24, 32), bool))
    fails(run, tmp_path, folder, "every pixel to train on")
    (folder / "sparse/0/images.bin").write_bytes((folder / "sparse/0/images.bin").read_bytes()[:-9])
    fails(run, tmp_path, folder, "images.bin", "it ends early")


@pytest.mark.usefixtures("searched")
@pytest.mark.parametrize("share", [1.0, 0.0])
def test_pruning_is_logged_and_reduces_the_file(
    run: Kpenc, sets: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, share: float
) -> None:
    """After 24 steps hardly anything gains a decibel; the loss that is reported counts all that coding costs."""
    monkeypatch.setitem(PRESETS, "draft", replace(TINY, prune_share=share))
    code, out, err = run(sets / "n3dv", "--layers", "one", "--max-loss", "1dB", "--holdout", "none", "--json")
    scene = scene_io.read(tmp_path / "out.kpc")
    counts = [scale["xy"].symbols.shape[2] for scale in scene.scales]
    assert code == 0 and json.loads(out)["coding_loss_db"] <= 1
    assert (
        ("colour: view-independent, as view dependence would gain only" in err)
        == (share > 0)
        == (scene.decoder.w1.shape == (1, 9))
    )
    assert sum(counts) < 16 if share else counts == [8, 8]
    assert all(f"{count} of 8" in err for count in counts) == (share > 0)


def test_a_time_budget(run: Kpenc, sets: Path, tmp_path: Path) -> None:
    code, out, _ = run(sets / "blender", "--json", "--time-budget", "0.5s")
    result = json.loads(out)
    assert code == 0 and 0.5 <= result["train_s"] < 10
    assert scene_io.read(tmp_path / "out.kpc").metadata.provenance["options"]["steps"] == result["steps"]


def test_a_seed_gives_the_same_bytes(run: Kpenc, searched: None, sets: Path, tmp_path: Path) -> None:
    written = []
    for seed in ("4", "4", "5"):
        assert run(sets / "nerfstudio", "--seed", seed, "--steps", "10", "--test-views", "all")[0] == 0
        written.append((tmp_path / "out.kpc").read_bytes())
    assert written[0] == written[1] != written[2]


def test_the_work_folder_keeps_foreign_files(run: Kpenc, sets: Path, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("years of work")
    assert run(sets / "blender", "--work", str(tmp_path / "mine"), "--steps", "2")[0] == 0
    assert [p.name for p in (tmp_path / "mine").iterdir()] == ["thesis.txt"]


def test_durations() -> None:
    assert [cli.duration_s(t) for t in ("90", "90s", "10m", "1.5h")] == [90, 90, 600, 5400]


# --- interruption


def test_an_interrupted_run_resumes_to_the_same_file(
    run: Kpenc, sets: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert run(sets / "blender", "--test-views", "all")[0] == 0
    output = tmp_path / "out.kpc"
    whole = output.read_bytes()
    output.write_bytes(b"an earlier scene")
    with monkeypatch.context() as patched:
        _signal_at_step(patched, 13, signal.SIGINT)
        code, out, err = run(sets / "blender", "--test-views", "all")
    assert code == 130 and out == "" and err.endswith("kpenc: interrupted\n")
    assert "--resume" in err and "Traceback" not in err
    assert output.read_bytes() == b"an earlier scene"
    assert {p.name for p in tmp_path.iterdir()} == {"out.kpc", "out.kpc.work"}
    code, _, err = run(sets / "blender", "--test-views", "all", "--resume")
    assert code == 0 and "resumed at step 13" in err
    assert output.read_bytes() == whole
    assert {p.name for p in tmp_path.iterdir()} == {"out.kpc"}


def test_termination_is_like_ctrl_c(run: Kpenc, sets: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)
    _signal_at_step(monkeypatch, 5, signal.SIGTERM)
    code, _, err = run(sets / "blender")
    assert code == 130 and "stopped at step 5" in err
    assert not (tmp_path / "out.kpc").exists()
    assert (signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)) == before


@pytest.mark.parametrize("answer, code", [("y\n", 0), ("\n", 130)])
def test_on_a_terminal_ctrl_c_offers_the_partial_scene(
    run: Kpenc, sets: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, answer: str, code: int
) -> None:
    monkeypatch.setattr(sys.stdin, "isatty", lambda: True, raising=False)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    monkeypatch.setattr(sys.stdin, "readline", lambda: answer, raising=False)
    _signal_at_step(monkeypatch, 13, signal.SIGINT)
    found, _, err = run(sets / "blender")
    assert found == code and "write the scene as trained so far?" in err
    assert (tmp_path / "out.kpc").exists() == (code == 0)
    if code == 0:
        assert scene_io.read(tmp_path / "out.kpc").metadata.provenance["options"]["steps"] == 13
    assert "resumed at step 13" in run(sets / "blender", "--resume")[2]


def test_interrupted_while_writing(run: Kpenc, sets: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cli.os, "replace", _failing_for(tmp_path / "out.kpc", KeyboardInterrupt()))
    (tmp_path / "out.kpc").write_bytes(b"an earlier scene")
    code, _, err = run(sets / "blender", "--steps", "2")
    assert code == 130 and err.endswith("checkpoint.kpck is kept, go on with --resume\nkpenc: interrupted\n")
    assert {p.name for p in tmp_path.iterdir()} == {"out.kpc", "out.kpc.work"}
    assert (tmp_path / "out.kpc").read_bytes() == b"an earlier scene"
    monkeypatch.setattr(cli.os, "replace", os.rename)
    assert run(sets / "blender", "--steps", "2", "--resume")[0] == 0


def test_resume_without_a_checkpoint_starts_afresh(run: Kpenc, sets: Path, tmp_path: Path) -> None:
    code, _, err = run(sets / "blender", "--steps", "2", "--resume")
    assert code == 0 and err.startswith(f"{tmp_path / 'out.kpc.work'}: there is nothing to resume; starting afresh\n")


def test_resume_with_other_settings(run: Kpenc, sets: Path, tmp_path: Path) -> None:
    assert run(sets / "n3dv", "--steps", "2", "--keep", "--box", "-1,-1,-1,1,1,1")[0] == 0
    kept = (tmp_path / "out.kpc").read_bytes()
    changed = ("--seed", "7", "--decoder", "hybrid"), "(--decoder was explicit, is hybrid; --seed was 0, is 7)"
    shorter = ("--steps", "1"), "already (--steps 2 before, --steps 1 now), so that nothing is left"
    for options, words in (changed, shorter, (("--holdout", "none"), "other pictures")):
        code, _, err = run(sets / "n3dv", "--steps", "3", "--resume", "--box", "-1,-1,-1,1,1,1", *options)
        assert code == 1 and words in err.splitlines()[-1] and CHECKPOINT in err
    (tmp_path / "out.kpc.work" / CHECKPOINT).write_bytes(b"damaged")
    code, _, err = run(sets / "n3dv", "--steps", "3", "--resume")
    assert code == 1 and "delete it" in err and (tmp_path / "out.kpc").read_bytes() == kept


def test_a_killed_process_resumes(sets: Path, tmp_path: Path, run: Kpenc) -> None:
    """SIGKILL after the first checkpoint, as when memory runs out or power fails."""
    output = tmp_path / "out.kpc"
    process = _subprocess(
        [str(sets / "blender"), "-o", str(output), "--preset", "draft", "--steps", "1000000"],
        "import functools; from kpc.encoder.training.train import Trainer\n"
        "Trainer.run = functools.partialmethod(Trainer.run, checkpoint_every_s=0.2)",
    )
    checkpoint = tmp_path / "out.kpc.work" / CHECKPOINT
    deadline = time.monotonic() + 180
    while not checkpoint.exists() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.05)
    process.kill()
    assert process.wait() == -signal.SIGKILL and checkpoint.exists(), process.stderr.read()
    process.stderr.close()
    assert not output.exists()
    state = torch.load(checkpoint, weights_only=True)
    code, out, err = run(sets / "blender", "--resume", "--json", "--steps", f"{(steps := state['step'] + 3)}")
    assert code == 0 and f"--steps 1000000 before, --steps {steps} now" in err and {*tmp_path.iterdir()} == {output}
    assert (made := json.loads(out))["steps"] == steps and made["encode_s"] > made["train_s"] + made["coding_s"]


# --- bad input


def copied(sets: Path, tmp_path: Path, name: str = "n3dv") -> Path:
    return Path(shutil.copytree(sets / name, tmp_path / "set"))


def test_no_dataset(run: Kpenc, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    fails(run, tmp_path, tmp_path / "empty", str(tmp_path / "empty"), "empty directory; give a folder")
    fails(run, tmp_path, tmp_path / "none", str(tmp_path / "none"), "no such directory; give a folder")
    assert not (tmp_path / "out.kpc.work").exists()
    (tmp_path / "empty" / "notes.txt").write_text("")
    fails(run, tmp_path, tmp_path / "empty", "no dataset layout recognised", "poses_bounds.npy")


def test_a_missing_video(run: Kpenc, sets: Path, tmp_path: Path) -> None:
    folder = copied(sets, tmp_path)
    (folder / "cam02.mp4").unlink()
    fails(run, tmp_path, folder, "poses_bounds.npy", "3", "4")


def test_an_unreadable_video(run: Kpenc, sets: Path, tmp_path: Path) -> None:
    folder = copied(sets, tmp_path)
    (folder / "cam02.mp4").write_bytes(b"no video at all")
    fails(run, tmp_path, folder, "cam02.mp4")
    assert not (tmp_path / "out.kpc.work").exists()
    (folder / "cam02.mp4").write_bytes(b"")
    fails(run, tmp_path, folder, "cam02.mp4")


def test_different_frame_counts_are_logged(run: Kpenc, sets: Path, tmp_path: Path) -> None:
    folder, other = copied(sets, tmp_path), tmp_path / "short"
    make.write_n3dv(other, cameras=4, frames=3)
    shutil.copy(other / "cam02.mp4", folder / "cam02.mp4")
    code, _, err = run(folder, "--steps", "2")
    assert code == 0 and "cam02.mp4" in err and "3 (cam02.mp4) to 4 frames" in err and (tmp_path / "out.kpc").exists()


@pytest.mark.parametrize("column, value, words", [(3, np.nan, "NaN"), (14, 0.0, "focal length"), (15, -1.0, "near")])
def test_impossible_poses(run: Kpenc, sets: Path, tmp_path: Path, column: int, value: float, words: str) -> None:
    folder = copied(sets, tmp_path)
    poses = np.load(folder / "poses_bounds.npy")
    poses[1, column] = value
    np.save(folder / "poses_bounds.npy", poses)
    fails(run, tmp_path, folder, "poses_bounds.npy", words)


def test_zero_focal_length_and_nan_poses_in_json(run: Kpenc, sets: Path, tmp_path: Path) -> None:
    folder = copied(sets, tmp_path, "nerfstudio")
    make.edit_json(folder / "transforms.json", lambda d: d.update(fl_x=0.0))
    fails(run, tmp_path, folder, "transforms.json", "focal length")
    make.edit_json(folder / "transforms.json", lambda d: d.update(fl_x=30.0))
    make.edit_json(
        folder / "transforms.json", lambda d: d["frames"][2]["transform_matrix"][0].__setitem__(3, float("nan"))
    )
    fails(run, tmp_path, folder, "transforms.json", "NaN")


def test_a_single_camera_that_stands_still(run: Kpenc, tmp_path: Path) -> None:
    make.write_n3dv(tmp_path / "one", cameras=1)
    fails(
        run,
        tmp_path,
        tmp_path / "one",
        str(tmp_path / "one"),
        "single camera",
        "add cameras",
        options=("--holdout", "none"),
    )
    fails(run, tmp_path, tmp_path / "one", str(tmp_path / "one"), "--holdout none")


def test_an_unknown_holdout(run: Kpenc, sets: Path, tmp_path: Path) -> None:
    fails(run, tmp_path, sets / "n3dv", "cam77", "cam00", options=("--holdout", "cam77"))


def test_cameras_without_a_common_point(run: Kpenc, sets: Path, tmp_path: Path) -> None:
    folder = copied(sets, tmp_path, "nerfstudio")

    def parallel(document: dict[str, list[dict[str, list[list[float]]]]]) -> None:
        for k, frame in enumerate(document["frames"]):
            frame["transform_matrix"] = [[1, 0, 0, 0.1 * k], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]

    make.edit_json(folder / "transforms.json", parallel)
    fails(run, tmp_path, folder, str(folder), "--box", options=("--space", "box"))
    assert run(folder, "--steps", "2")[0] == 0  # contracted, the box is about the cameras


@pytest.mark.parametrize("space, found", [("auto", "contracted"), ("box", "box"), ("contracted", "contracted")])
def test_space_is_chosen_logged_and_overridden(run: Kpenc, sets: Path, tmp_path: Path, space: str, found: str) -> None:
    code, out, err = run(sets / "colmap", "--json", "--space", space)
    assert code == 0
    result, scene = json.loads(out), scene_io.read(tmp_path / "out.kpc")
    assert result["space"] == found and (scene.mapping is not None) == (found == "contracted")
    assert ("all around it" in err) == (found == "contracted")
    assert ("space: contracted beyond" if found == "contracted" else "space: a box") in err
    assert ("nothing bounds what the cameras see" if space == "auto" else "as given") in err


@pytest.mark.parametrize("name, why", [("n3dv", "near and far are known"), ("blender", "have alpha")])
def test_bounded_scenes_get_a_box(run: Kpenc, sets: Path, name: str, why: str) -> None:
    code, out, err = run(sets / name, "--json", "--steps", "2")
    assert code == 0 and json.loads(out)["space"] == "box" and why in err


@pytest.mark.parametrize(
    "asked, names", [("auto", "image"), ("image", "image"), ("camera", "camera"), ("none", "none")]
)
def test_appearances_are_chosen_logged_and_overridden(
    run: Kpenc, sets: Path, tmp_path: Path, asked: str, names: str
) -> None:
    code, out, err = run(sets / "unequal", "--appearance", asked, "--steps", "60", "--test-views", "1")
    assert code == 0 and ("28 of 28 pictures have a lens" if asked == "auto" else "as given") in err
    assert ("appearance: none" if names == "none" else f"appearance: an embedding for each {names} (") in err
    assert ("right halves, each in an appearance fitted to its left half" in out) == (names != "none")
    scene = scene_io.read(tmp_path / "out.kpc")
    found = [appearance.name for appearance in scene.appearances]
    endings = {"image": ".png", "camera": "", "none": ""}
    assert found == ([] if names == "none" else [f"{k:04d}{endings[names]}" for k in range(32) if k % 8])
    assert names == "none" or np.abs([appearance.code for appearance in scene.appearances]).max() > 0.01


def test_appearances_in_results_and_estimates(run: Kpenc, sets: Path) -> None:
    code, out, _ = run(sets / "unequal", "--json", "--test-views", "1")
    result = json.loads(out)
    assert code == 0 and (result["appearance"], result["appearances"], result["test_pictures"]) == ("image", 28, 1)
    assert 5 < result["test_psnr"] < 60
    code, out, err = run(sets / "unequal", "--dry-run", "--json")
    assert code == 0 and "appearance: an embedding for each image" in err and json.loads(out)["rest_s"] > 0
    code, out, err = run(sets / "n3dv", "--json", "--steps", "2")
    assert code == 0 and json.loads(out)["appearance"] == "none" and "appearance: none (a clip, filmed as one" in err
    code, out, err = run(sets / "n3dv", "--json", "--steps", "2", "--holdout", "none", "--appearance", "camera")
    assert code == 0 and (json.loads(out)["appearances"], json.loads(out)["test_psnr"]) == (4, None)


def test_a_single_object_gets_view_dependence_with_appearances(run: Kpenc, sets: Path, tmp_path: Path) -> None:
    for options, directed in (((), False), (("--appearance", "image"), True)):
        assert run(sets / "blender", "--test-views", "1", *options)[0] == 0
        scene = scene_io.read(tmp_path / "out.kpc")
        assert bool(scene.decoder.w2.any()) == bool(scene.appearances) == directed


def test_an_interrupted_run_with_appearances_resumes_to_the_same_file_but_not_with_others(
    run: Kpenc, sets: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert run(sets / "unequal", "--test-views", "1")[0] == 0
    whole = (tmp_path / "out.kpc").read_bytes()
    with monkeypatch.context() as patch:
        _signal_at_step(patch, 13, signal.SIGINT)
        assert run(sets / "unequal", "--test-views", "1")[0] == 130
    code, _, err = run(sets / "unequal", "--test-views", "1", "--resume", "--appearance", "none")
    assert code == 1 and "other settings" in err
    code, _, err = run(sets / "unequal", "--test-views", "1", "--resume")
    assert code == 0 and "resumed at step 13" in err and (tmp_path / "out.kpc").read_bytes() == whole


def test_device_coordinates_for_cameras_that_face_one_way(run: Kpenc, sets: Path, tmp_path: Path) -> None:
    code, out, err = run(sets / "n3dv", "--json", "--space", "ndc")
    scene = scene_io.read(tmp_path / "out.kpc")
    assert code == 0 and json.loads(out)["space"] == "ndc" and isinstance(scene.mapping, DeviceCoordinates)
    assert "space: device coordinates of a rig that faces one way (as given)" in err and "baseline" in err
    assert scene.aabb[1, 2] < scene.mapping.baseline / scene.mapping.near
    # The sphere at the origin is within, and what is seen of it lies about there.
    assert (scene.dequantise().bounds[0] < 0).all() and (scene.dequantise().bounds[1] > 0).all()


def test_rigs_that_have_no_device_coordinates(run: Kpenc, sets: Path, tmp_path: Path) -> None:
    fails(run, tmp_path, sets / "nerfstudio", "near and far", "--space contracted", options=("--space", "ndc"))
    code, _, err = run(sets / "n3dv", "--space", "ndc", "--box", "-1,-1,-1,1,1,1")
    assert code == 2 and "--box" in err


def test_a_given_box_of_contracted_space_is_not_changed(run: Kpenc, sets: Path, tmp_path: Path) -> None:
    code, out, _ = run(sets / "n3dv", "--json", "--space", "contracted", "--box", "-1,-1,-1,1,1,0.5")
    scene = scene_io.read(tmp_path / "out.kpc")
    assert code == 0 and json.loads(out)["box"] == scene.aabb.tolist() == [[-1, -1, -1], [1, 1, 0.5]]
    assert scene.mapping is not None and scene.mapping.uniform_distance > 3  # the cameras' distance


def test_a_box_outside_all_views(run: Kpenc, sets: Path, tmp_path: Path) -> None:
    fails(run, tmp_path, sets / "n3dv", "outside every camera's view", "--box", options=("--box", "90,90,90,91,91,91"))
    fails(run, tmp_path, sets / "n3dv", "too large or too thin", "--box", options=("--box", "0,0,0,1,1,1e12"))
    fails(run, tmp_path, sets / "n3dv", "too large or too thin", "--box", options=("--box", "1e8,0,0,100000001,1,1"))
    tiny = ("--space", "contracted", "--box", "0,0,0,1e-4,1e-4,1e-4")
    fails(run, tmp_path, sets / "n3dv", "too small for cameras", "--box", options=tiny)


def test_no_permission(run: Kpenc, sets: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Root may do anything, so that the system's refusal is simulated."""
    real_open = builtins.open

    def refusing(name: object, *a: object, **k: object) -> object:
        if str(name).endswith("poses_bounds.npy"):
            raise PermissionError(errno.EACCES, "Permission denied", str(name))
        return real_open(name, *a, **k)  # type: ignore[call-overload]

    with monkeypatch.context() as patch:
        patch.setattr(builtins, "open", refusing)
        fails(run, tmp_path, sets / "n3dv", "poses_bounds.npy", "ermission")
    with monkeypatch.context() as patch:
        patch.setattr(os, "access", lambda path, _: Path(path).is_file())
        fails(run, tmp_path, sets / "n3dv", str(tmp_path), "no permission", "-o")


def test_outputs_that_cannot_be_written(run: Kpenc, sets: Path, tmp_path: Path) -> None:
    fails(run, tmp_path, sets / "n3dv", str(tmp_path / "no"), "make it first", output=tmp_path / "no" / "x.kpc", code=2)
    (tmp_path / "folder").mkdir()
    fails(run, tmp_path, sets / "n3dv", str(tmp_path / "folder"), "is a folder", output=tmp_path / "folder", code=2)
    for name in ("scene", "scene.mp4", "scene.kpck"):
        fails(
            run, tmp_path, sets / "n3dv", str(tmp_path / name), "end the name in .kpc", output=tmp_path / name, code=2
        )
    (tmp_path / "plain").write_text("")
    fails(run, tmp_path, sets / "n3dv", str(tmp_path / "plain"), "--work", options=("--work", str(tmp_path / "plain")))


@pytest.mark.parametrize(
    "options",
    [
        ("--steps", "0"),
        ("--steps", "x"),
        ("--time-budget", "soon"),
        ("--time-budget", "-3"),
        ("--time-budget", "nan"),
        ("--seed", "-1"),
        ("--seed", str(1 << 70)),
        ("--downscale", "0"),
        ("--box", "1,2,3"),
        ("--box", "0,0,0,1,1,nan"),
        ("--box", "1,0,0,0,1,1"),
        ("--preset", "huge"),
        ("--device", "tpu"),
        ("--appearance", "video"),
        ("--nonsense",),
    ],
)
def test_invalid_options_are_refused(
    run: Kpenc, sets: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], options: tuple[str, ...]
) -> None:
    with pytest.raises(SystemExit) as stopped:
        run(sets / "n3dv", *options)
    assert stopped.value.code == 2
    assert options[0] in capsys.readouterr().err
    assert not any(tmp_path.iterdir())


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_no_cuda(run: Kpenc, sets: Path, tmp_path: Path) -> None:
    fails(run, tmp_path, sets / "n3dv", "--device cuda", "use --device cpu", options=("--device", "cuda"), code=2)


# --- full disks


def test_disk_full_while_decoding(run: Kpenc, sets: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(pixel_cache.os, "write", full)
    fails(run, tmp_path, sets / "n3dv", "out.kpc.work", "the disk is full", "--downscale")
    assert not (tmp_path / "out.kpc.work").exists()


def test_disk_full_at_a_checkpoint(run: Kpenc, sets: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One line is logged and the run goes on, since the much smaller scene may still fit."""

    def full(_: object, path: Path) -> None:
        Path(path).write_bytes(b"half")
        raise RuntimeError("[enforce fail at inline_container.cc:672] . unexpected pos 704 vs 598")

    monkeypatch.setattr(torch, "save", full)
    code, _, err = run(sets / "n3dv", "--steps", "2")
    said = [line for line in err.splitlines() if CHECKPOINT in line]
    assert code == 0 and len(said) == 1 and "free space" in said[0] and "Traceback" not in err
    assert {p.name for p in tmp_path.iterdir()} == {"out.kpc"}


def test_disk_full_as_an_interrupted_run_saves(
    run: Kpenc, sets: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_: object, path: Path) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    monkeypatch.setattr(torch, "save", full)
    _signal_at_step(monkeypatch, 3, signal.SIGINT)
    code, _, err = run(sets / "n3dv")
    last = err.splitlines()[-1]
    assert code == 1 and CHECKPOINT in last and "No space left" in last and "free space" in last


def test_disk_full_as_the_file_is_written(
    run: Kpenc, sets: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        cli.os, "replace", _failing_for(tmp_path / "out.kpc", OSError(errno.ENOSPC, "No space left on device"))
    )
    (tmp_path / "out.kpc").write_bytes(b"an earlier scene")
    code, out, err = run(sets / "n3dv", "--steps", "2")
    last = err.splitlines()[-1]
    assert code == 1 and out == "" and "Traceback" not in err
    assert last.startswith(f"kpenc: {tmp_path / 'out.kpc'}: No space left on device; make room") and "--resume" in last
    assert (tmp_path / "out.kpc").read_bytes() == b"an earlier scene"
    assert {p.name for p in tmp_path.iterdir()} == {"out.kpc", "out.kpc.work"}
    monkeypatch.setattr(cli.os, "replace", os.rename)
    code, _, err = run(
        sets / "n3dv", "--steps", "2", "--resume", "--work", str(tmp_path / "out.kpc.work"), output=tmp_path / "b.kpc"
    )
    assert code == 0 and "resumed at step 2" in err


# --- a bare server


def test_no_opengl_and_no_window(sets: Path, tmp_path: Path) -> None:
    """Nor TorchDynamo, which takes a second and more to import."""
    names = "moderngl", "glfw", "slimgui", "OpenGL", "kpc.player", "torch._dynamo"
    words = [str(sets / "blender"), "-o", str(tmp_path / "out.kpc"), "--preset", "draft", "--steps", "3"]
    process = _subprocess(words, f"for name in {names}: sys.modules[name] = None")
    out, err = process.communicate(timeout=120)
    assert process.returncode == 0, err
    assert "held-out PSNR" in out and (tmp_path / "out.kpc").exists()


def test_another_thread_may_encode(run: Kpenc, sets: Path) -> None:
    """Only the main thread may handle signals; elsewhere kpenc does without."""
    found: list[int] = []
    thread = threading.Thread(target=lambda: found.append(run(sets / "nerfstudio", "--steps", "1")[0]))
    thread.start()
    thread.join()
    assert found == [0]


def _signal_at_step(monkeypatch: pytest.MonkeyPatch, step: int, number: int) -> None:
    """Send this process a signal from within a step of training: it must take effect between steps."""
    draw = Trainer.__init__

    def init(self: Trainer, *args: object, **named: object) -> None:
        draw(self, *args, **named)  # type: ignore[arg-type]
        whole = self.optimiser.step

        def stepping(count: int, *rest: object) -> tuple[float, float]:
            if count == step - 1:
                os.kill(os.getpid(), number)
            return whole(count, *rest)  # type: ignore[arg-type]

        self.optimiser.step = stepping  # type: ignore[method-assign]

    monkeypatch.setattr(Trainer, "__init__", init)


def _failing_for(target: Path, error: BaseException) -> Callable[[Path, Path], None]:
    def replace(source: Path, destination: Path) -> None:
        if Path(destination) == target:
            raise error
        os.rename(source, destination)

    return replace


def _subprocess(argv: list[str], preparation: str) -> subprocess.Popen[str]:
    script = (
        f"import sys\n{preparation}\n"
        f"sys.path.append({str(Path(quick_coding.__file__).parent)!r})\nimport quick_coding\n"
        "from kpc.encoder.cli import kpenc\nfrom kpc.encoder.field.config import PRESETS, TrainConfig\n"
        f"PRESETS['draft'] = {TINY!r}\nquick_coding.apply()\nsys.exit(kpenc.main({argv!r}))"
    )
    return subprocess.Popen(
        [sys.executable, "-c", script],
        stdout=subprocess.PIPE if "moderngl" in preparation else subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "NUMBA_NUM_THREADS": "1"},
    )


def test_rate_distortion_targets(run: Kpenc, sets: Path, tmp_path: Path) -> None:
    """The kept checkpoint is coded anew, without a step of training."""
    _, out, _ = run(sets / "n3dv", "--keep", "--json")
    usual = json.loads(out)["size_bytes"]
    sizes, target = [], int(0.95 * usual)
    for trade in ("--max-loss=0.01dB", "--max-loss=2", f"--target-size={target}"):
        code, out, err = run(sets / "n3dv", "--keep", "--resume", "--json", trade)
        assert code == 0 and "resumed at step 24" in err
        sizes.append(json.loads(out)["size_bytes"])
    assert sizes[0] > usual > sizes[1] and sizes[2] <= target
    last = (tmp_path / "out.kpc").read_bytes()
    for size, reason in ("0.5KB", "what no quantisation step shrinks"), ("1KB", "is the smallest size of this model"):
        code, out, err = run(sets / "n3dv", "--resume", "--keep", "--target-size", size)
        assert code == 1 and out == "" and reason in err.splitlines()[-1]
        assert ("occupied: " in err) == (size == "1KB")  # what is too small for cameras is refused before training
    assert (tmp_path / "out.kpc").read_bytes() == last
    assert run(sets / "n3dv", "--resume")[0] == 0 and {p.name for p in tmp_path.iterdir()} == {"out.kpc"}


@pytest.mark.parametrize(
    "words, named",
    [
        (("--max-loss", "much"), "0.1dB"),
        (("--max-loss=-1dB",), "0.1dB"),
        (("--target-size", "nanMB"), "2MB"),
        (("--target-size", "K"), "2MB"),
        (("--target-size", "2MB", "--max-loss", "1dB"), "not allowed"),
    ],
)
def test_invalid_targets_are_refused(
    words: tuple[str, ...], named: str, sets: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        kpenc.main([str(sets / "n3dv"), "-o", str(tmp_path / "out.kpc"), *words])
    assert named in capsys.readouterr().err
