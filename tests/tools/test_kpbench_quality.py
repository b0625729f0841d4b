"""kpbench quality against what the encoder reports, and against measures computed by hand."""

import csv
import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import datasets as make
from kpc.encoder.cli.metadata import hash_dataset
from kpc.encoder.coding.scene_writer import encode
from kpc.encoder.datasets import load_dataset
from kpc.encoder.evaluation.evaluate import SceneRenderer, evaluate
from kpc.encoder.evaluation.ground_truth import ground_truth
from kpc.format.coding.quantise import quantise_scene
from kpc.format.container import groups, scene_io
from kpc.format.scene.metadata import Metadata
from kpc.format.scene.scene import Scene
from kpc.tools.bench import figures, harness, kpbench, quality, tables
from scenes import tiny_scene, with_appearances

pytestmark = pytest.mark.usefixtures("one_thread")


def coded(scene: Scene) -> bytes:
    return encode(quantise_scene(scene, [dict.fromkeys(scale, 0.01) for scale in scene.scales]))


def test_the_command_measures_what_the_encoder_reports(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Means are those of `evaluate`; flicker is the change of the error, over the pixels of each part."""
    make.write_n3dv(tmp_path / "set", frames=5, width=40, height=30)
    (tmp_path / "tiny.kpc").write_bytes(coded(tiny_scene()))
    monkeypatch.setattr(harness, "isolated", lambda work, job: work(job))
    out = tmp_path / "quality.json"
    command = ["quality", str(tmp_path / "tiny.kpc"), str(tmp_path / "set"), "--out", str(out)]
    assert kpbench.main(command) == 0
    (record,) = json.loads(out.read_text())
    assert record["settings"] == {"dataset": "set", "holdout": None, "downscale": 1, "test_views": None}
    scene = scene_io.read(tmp_path / "tiny.kpc").dequantise()
    dataset = load_dataset(tmp_path / "set", tmp_path / "cache", progress=False)
    reported, (means,), frames = evaluate(scene, dataset, parts=True), record["repeats"], record["frames"]
    assert reported is not None and means["pictures"] == reported.pictures == 5
    for name in ("psnr", "ssim", "moving_psnr", "still_psnr"):
        assert means[name] == pytest.approx(getattr(reported, name)), name
    held_out = np.flatnonzero(dataset.pictures.is_test)
    errors = [
        np.clip(SceneRenderer(scene).picture(dataset, n), 0, 1) - ground_truth(dataset, n) for n in held_out.tolist()
    ]
    changes = [np.sqrt(np.mean((b - a) ** 2)) for a, b in pairwise(errors)]
    assert [frame["flicker"] for frame in frames[1:]] == pytest.approx(changes) and frames[0]["flicker"] is None
    some_move = [frame for frame in frames[1:] if frame["moving_share"]]
    assert len(some_move) == 3  # the middle of the clip is its median
    for frame in some_move:
        share = frame["moving_share"]
        parts = share * frame["moving_flicker"] ** 2 + (1 - share) * frame["still_flicker"] ** 2
        assert frame["flicker"] ** 2 == pytest.approx(parts) and 0 < share < 1
        flip = share * frame["moving_flip"] + (1 - share) * frame["still_flip"]
        assert frame["flip"] == pytest.approx(flip, rel=1e-4)
    with out.with_suffix(".csv").open() as file:
        assert [float(row["psnr"]) for row in csv.DictReader(file)] == [frame["psnr"] for frame in frames]
    assert out.with_suffix(".svg").read_text().count("flicker, 8-bit levels") == 1
    printed = capsys.readouterr().err
    assert "cam00" in printed and max(map(len, printed.splitlines()[:-1])) <= 100
    assert "moving FLIP" in tables.markdown([record])


def test_a_scene_of_other_files_is_compared_with_a_warning(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make.write_n3dv(tmp_path / "set")
    own = hash_dataset(load_dataset(tmp_path / "set", tmp_path / "cache", progress=False))
    for sha256, downscale, warns in ((own, 1, False), ("0" * 64, 1, True), ("0" * 64, 2, False)):
        metadata = Metadata({"provenance": {"dataset_sha256": sha256}})
        (tmp_path / "a.kpc").write_bytes(coded(replace(tiny_scene(), metadata=metadata)))
        job = quality.Job(tmp_path / "a.kpc", tmp_path / "set", downscale=downscale)
        quality.dataset_of(job, tmp_path / "cache")
        assert ("a.kpc was made from other files than those of set" in capsys.readouterr().err) == warns


def test_the_table_fits_whatever_the_clip() -> None:
    largest = {"psnr": 99.99, "ssim": -0.123, "flip": 1.0, "flicker": 2.0}
    frame: dict[str, Any] = {f"{part}{name}": largest[name] for part in ("", "moving_", "still_") for name in largest}
    frame |= {"camera": "a camera of a long name", "moving_share": 1.0}
    frames = [frame | {"frame": number} for number in range(10_000)]
    lines = quality.frame_table(frames).splitlines()
    assert max(map(len, lines)) <= 100 and lines[-1] == f"({quality.ROWS} of 10000 frames)"


def test_a_clip_in_groups_is_measured_as_its_groups_are(tmp_path: Path) -> None:
    """Frames of one group have its measures; the frame that both share has a picture blended of both."""
    make.write_n3dv(tmp_path / "set", frames=21)
    scenes = [tiny_scene(seed) for seed in (1, 2)]
    parts = [groups.GroupInput.of(coded(scene), start) for scene, start in zip(scenes, (0, 10), strict=True)]
    groups.write(parts, tmp_path / "clip.kpc")
    found = quality.measure(quality.Job(tmp_path / "clip.kpc", tmp_path / "set"))
    frames = found["frames"]
    assert [frame["frame"] for frame in frames] == list(range(21)) and found["means"]["pictures"] == 21
    assert all(frame["flicker"] is not None for frame in frames[1:])
    dataset = load_dataset(tmp_path / "set", tmp_path / "cache", progress=False)
    for number, scene in enumerate(scenes):
        part = dataset.frame_range(10 * number, 10 * number + 10)
        alone = scene_io.read(coded(scene)).dequantise()
        for local in (1, 8):
            picture = int(np.flatnonzero(part.pictures.is_test & (np.rint(10 * part.pictures.time) == local))[0])
            error = np.clip(SceneRenderer(alone).picture(part, picture), 0, 1) - ground_truth(part, picture)
            expected = -10 * np.log10(np.mean(error**2))
            assert frames[10 * number + local]["psnr"] == pytest.approx(expected, abs=1e-3)


def test_photographs_are_measured_on_their_right_halves_at_any_time(tmp_path: Path) -> None:
    """A static scene with appearances: nothing moves or flickers, and means are those of `evaluate`."""
    make.write_llff(tmp_path / "set")
    scene = with_appearances(tiny_scene(dynamic=False))
    (tmp_path / "photos.kpc").write_bytes(coded(scene))
    found = quality.measure(quality.Job(tmp_path / "photos.kpc", tmp_path / "set"))
    dataset = load_dataset(tmp_path / "set", tmp_path / "cache", progress=False)
    reported = evaluate(scene_io.read(tmp_path / "photos.kpc").dequantise(), dataset)
    assert reported is not None and found["means"]["psnr"] == pytest.approx(reported.psnr)
    assert found["means"]["ssim"] == pytest.approx(reported.ssim)
    for name in ("moving_psnr", "still_flip", "flicker", "moving_share"):
        assert found["means"][name] is None, name
    record: dict[str, Any] = {"kind": "quality", "name": "photos", "frames": found["frames"]}
    axes = figures.fidelity([record]).axes[0]
    assert len(axes.lines) == 1 and len(axes.lines[0].get_xdata()) == reported.pictures


def test_what_cannot_be_measured_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    make.write_n3dv(tmp_path / "set", frames=2)
    (tmp_path / "a.kpc").write_bytes(coded(tiny_scene()))
    monkeypatch.setattr(harness, "isolated", lambda work, job: work(job))
    monkeypatch.setattr(quality, "flip_errors", lambda found: None)
    command = ["quality", str(tmp_path / "a.kpc"), str(tmp_path / "set")]
    assert kpbench.main(command) == 0
    output = capsys.readouterr()
    (record,) = json.loads(output.out)
    assert "needs flip-evaluator" in output.err and record["repeats"][0]["flip"] is None
    assert kpbench.main([*command, "--holdout", "none"]) == 1
    assert "holds out no picture" in capsys.readouterr().err
