"""Rate against distortion beside general-purpose codecs: the figures, the curves, and the whole command."""

import csv
import json
import math
import pickle
from collections.abc import Iterator
from pathlib import Path

import pytest

from datasets import write_n3dv
from kpc.encoder.coding import scene_writer
from kpc.format.coding.quantise import quantise_scene
from kpc.tools.bench import codec_bench, kpbench, plot, results, tables
from kpc.tools.bench.baselines import Float16, Planes, Uint8, Video
from kpc.tools.bench.codec_bench import headline
from kpc.tools.bench.rd_curves import Point, bd_rate, size_at
from scenes import tiny_scene


def points(scale: float, psnrs: tuple[float, ...] = (27.0, 28.0, 29.0, 29.7, 29.9)) -> list[Point]:
    """Return a curve whose sizes double with every decibel, times `scale`; the uncoded scene has 30 dB."""
    return [{"psnr": p, "loss_db": 30 - p, "size_bytes": scale * 1000 * 2 ** (p - 27)} for p in psnrs]


def test_delta_rate_of_scaled_curves() -> None:
    assert bd_rate(points(0.5), points(1.0)) == pytest.approx(-0.5, abs=1e-9)
    assert bd_rate(points(1.3), points(1.0)) == pytest.approx(0.3, abs=1e-9)
    other = points(1.0, (26.0, 27.5, 28.5, 29.2, 29.8, 29.95))
    assert bd_rate(points(0.6), other) == pytest.approx(-0.4, abs=1e-9)


def test_delta_rate_of_planes_ignores_other_bytes() -> None:
    ours, others = (
        [
            point | {"size_bytes": 1e4 + point["size_bytes"], "planes_bytes": point["size_bytes"]}
            for point in points(scale)
        ]
        for scale in (0.5, 1.0)
    )
    assert bd_rate(ours, others, "planes_bytes") == pytest.approx(-0.5, abs=1e-9)
    assert -0.2 < (bd_rate(ours, others) or 0) < 0


def test_delta_rate_covers_the_common_range_down_to_the_worst_loss() -> None:
    far = [{"psnr": p, "loss_db": 30 - p, "size_bytes": 10.0 * (p + 1)} for p in (1.0, 5.0, 10.0, 20.0)]
    assert bd_rate(points(0.5) + far, points(1.0) + far) == pytest.approx(-0.5, abs=0.02)
    assert bd_rate(points(1), [p | {"psnr": p["psnr"] - 20} for p in points(1)]) is None
    assert bd_rate(points(1)[:3], points(1)) is None and bd_rate([], points(1)) is None


def test_delta_rate_uses_the_pareto_front() -> None:
    worse = {"psnr": 27.5, "loss_db": 2.5, "size_bytes": 9e9}
    assert bd_rate([*points(0.5), worse], points(1.0)) == pytest.approx(-0.5, abs=1e-9)


def test_size_at_a_loss_and_headline() -> None:
    assert size_at(points(1.0), 0.15) == pytest.approx(1000 * 2**2.85)
    assert size_at(points(1.0), 9.0) is None and size_at([], 1.0) is None
    shown = headline(points(1.0))
    assert shown["loss_db"] == pytest.approx(0.1) and shown["size_at_default_loss"] == size_at(points(1.0), 0.15)
    assert headline([]) == {}


def test_sizes_at_equal_loss_beside_the_smallest_baseline() -> None:
    curves = {
        "kpc": points(0.6),
        "kpc, no fine-tuning": points(0.1),
        "PNG": points(2.0),
        "AV1": points(1.0),
        "HEVC": [],
    }
    records = [{"name": "scene", "coder": coder, "points": curve} for coder, curve in curves.items()]
    head, row = tables.loss_table(records)
    assert head == ["scene", "0.05 dB", "0.1 dB", "0.2 dB", "0.5 dB", "1 dB", "2 dB"]
    assert row == ["scene", "-", *(f"{0.6 * 2 ** (3 - loss):.0f} KB, 40% (AV1)" for loss in (0.1, 0.2, 0.5, 1.0, 2.0))]
    assert tables.loss_table(records[:1])[1][2:] == [
        f"{0.6 * 2 ** (3 - loss):.0f} KB" for loss in (0.1, 0.2, 0.5, 1.0, 2.0)
    ]


@pytest.fixture
def scene_file(tmp_path: Path) -> Path:
    scene = tiny_scene(3, channels=4)
    scene_writer.write(
        quantise_scene(scene, [dict.fromkeys(scale, 0.002) for scale in scene.scales]), tmp_path / "scene.kpc"
    )
    return tmp_path / "scene.kpc"


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch, quick_coding: None, rounded: None) -> None:
    """Run in this process with little to do; `test_separate_processes` covers the process pool."""

    def here(jobs: list[codec_bench.Job], views: object, processes: int) -> list[Point | None]:
        codec_bench._source.cache_clear()
        codec_bench._evaluate_on(views)  # type: ignore[arg-type]
        try:
            return [codec_bench.point(job) for job in jobs]
        finally:
            codec_bench._evaluate_on(None)

    monkeypatch.setattr(codec_bench, "in_parallel", here)
    monkeypatch.setattr("kpc.encoder.rdo.codec_model.TOLERANCE", 0.2)
    monkeypatch.setattr(codec_bench, "TUNE_STEPS", 0)
    monkeypatch.setattr(codec_bench, "RATES", (1e-3, 3.0, 4.0))
    monkeypatch.setattr(codec_bench, "QUALITIES", (60, 90))
    others = Float16("zstd -19"), Uint8(), Video("X", "libnothing", (1,), ())
    monkeypatch.setattr(codec_bench, "BASELINES", {baseline.name: baseline for baseline in others})
    monkeypatch.setattr(
        codec_bench, "FINE_TUNED", {"X, fine-tuned": "X", "Y, fine-tuned": "Y"}
    )  # X is missing here, Y is unknown


def test_the_command(few: None, scene_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "codec.json"
    assert kpbench.main(["codec", str(scene_file), "--ablate", "--out", str(out)]) == 0
    output = capsys.readouterr()
    records = results.load([out])
    assert [record["coder"] for record in records] == [
        "kpc",
        *codec_bench.ABLATIONS,
        "fp16 + zstd -19",
        "uint8 + zstd -19",
        "X",
        "X, fine-tuned",
    ]
    ours, *without, halves, _, missing, missing_too = records
    for one in (missing, missing_too):
        assert one["missing"] == "this ffmpeg has no libnothing" and one["points"] == [] and one["bd_rate"] is None
    assert len(halves["points"]) == 6 and halves["bd_rate"] is not None
    whole = scene_file.stat().st_size
    assert len(ours["points"]) == 4  # no file is as small as a thousandth of a bit per parameter
    for found in ours["points"]:
        assert found["size_bytes"] <= whole and sum(found["shares"].values()) == pytest.approx(1)
        assert found["bits_per_parameter"] == pytest.approx(
            8 * found["size_bytes"] / tiny_scene(3, channels=4).parameter_count
        )
    rates = [p["size_bytes"] for p in ours["points"][:2]]
    assert rates[0] <= 3 * tiny_scene(3, channels=4).parameter_count / 8 and rates[0] < rates[1]
    for found, quality in zip(ours["points"][2:], (60, 90), strict=True):
        assert found["setting"] == f"quality {quality}"
        # The file itself is hardly finer, and errors jump where so small a plane switches its coding mode.
        assert 0 <= found["agreement_db"] - (20 + quality / 3) < 1.5
    assert "| scene | 60 | 90 |" in tables.markdown(records)
    others = codec_bench.others_bytes(scene_file)
    assert min(p["size_bytes"] for p in halves["points"]) > others > 100
    assert all(found["size_bytes"] - found["planes_bytes"] == others for found in halves["points"])
    for found in ours["points"]:
        of_planes = found["shares"].get("PLNE", 0) + found["shares"]["index"]
        assert found["planes_bytes"] == pytest.approx(of_planes * found["size_bytes"])
    assert halves["bd_rate_planes"] < halves["bd_rate"] < 0
    assert all(record["settings"]["evaluated_on"] == "its own validation rays" for record in records)
    assert "KB at 0.15 dB loss" in output.err and "Coding, beside general-purpose codecs" in tables.markdown(records)
    with (tmp_path / "codec.csv").open() as table:
        rows = list(csv.DictReader(table))
    assert len(rows) == 4 + 7 * 2 + 6 + 5 and [len(one["points"]) for one in without] == [2] * 7
    assert {row["coder"] for row in rows} == {"kpc", *codec_bench.ABLATIONS, "fp16 + zstd -19", "uint8 + zstd -19"}
    assert float(rows[0]["size_bytes"]) == ours["points"][0]["size_bytes"]
    svg = (tmp_path / "codec.svg").read_text()
    assert "uint8 + zstd -19" in svg and "bits per parameter" in svg
    assert plot.main([str(out), "-o", str(tmp_path / "again.svg")]) == 0
    assert (tmp_path / "again.svg").read_text() == svg


def test_an_interrupted_benchmark_continues(
    few: None, scene_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out, real, asked = tmp_path / "codec.json", codec_bench.point, []

    def interrupted_at_the_third(job: codec_bench.Job) -> Point | None:
        asked.append(job.key)
        if len(asked) == 3:
            raise KeyboardInterrupt
        return real(job)

    def one_by_one(jobs: list[codec_bench.Job], views: object, processes: int) -> Iterator[Point | None]:
        return map(codec_bench.point, jobs)

    monkeypatch.setattr(codec_bench, "in_parallel", one_by_one)
    monkeypatch.setattr(codec_bench, "point", interrupted_at_the_third)
    monkeypatch.setattr(codec_bench, "RATES", (1e-3, 3.0))
    monkeypatch.setattr(codec_bench, "QUALITIES", (60, 70))
    assert kpbench.main(["codec", str(scene_file), "--out", str(out)]) != 0 and not out.exists()
    (log,) = tmp_path.glob("codec.*.points")
    with log.open("a") as lines:
        lines.write('["an incomplete line')
    assert kpbench.main(["codec", str(scene_file), "--out", str(out)]) == 0
    assert sorted(asked) == sorted([*set(asked), asked[2]])  # only the interrupted one twice
    assert not log.exists() and len(results.load([out])[0]["points"]) == 3
    # Points of another state of the code are ignored.
    log.write_text(json.dumps({"commit": "another"}) + "\n" + json.dumps([asked[0], None]) + "\n")
    assert codec_bench.PointLog(log, {"commit": "this"}).read() == {}


def test_fine_tuning_a_baseline_gains_accuracy_and_codes_every_plane_once(
    few: None, scene_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(codec_bench, "FINE_TUNED", {"levels, fine-tuned": Uint8().name})
    monkeypatch.setattr(codec_bench, "TUNE_STEPS", 40)
    monkeypatch.setattr("kpc.encoder.rdo.sequential_finetune.RAYS", 512)
    shapes: list[tuple[int, ...]] = []
    real = Uint8.encode

    def encode(self: Uint8, planes: Planes, setting: int) -> list[bytes]:
        shapes.extend(plane.shape for scale in planes for plane in scale.values())
        return real(self, planes, setting)

    monkeypatch.setattr(Uint8, "encode", encode)
    plain = codec_bench.point(codec_bench.Job(scene_file, Uint8().name, 4, 100))
    once, shapes[:] = sorted(shapes), ()
    tuned = codec_bench.point(codec_bench.Job(scene_file, "levels, fine-tuned", 4, 100))
    assert (
        sorted(shapes)
        == once
        == sorted(plane.shape for scale in tiny_scene(3, channels=4).scales for plane in scale.values())
    )
    assert plain is not None and tuned is not None and tuned["agreement_db"] > plain["agreement_db"] + 0.2
    assert (
        0.8 * plain["size_bytes"] < tuned["size_bytes"] < 1.3 * plain["size_bytes"]
        and tuned["search_s"] > tuned["encode_s"]
    )


def test_distortion_on_held_out_views(
    few: None, scene_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_n3dv(tmp_path / "set", cameras=3)
    monkeypatch.setattr(codec_bench, "VIEW_PIXELS", 256)
    monkeypatch.setattr(codec_bench, "RATES", (3.0,))
    monkeypatch.setattr(codec_bench, "QUALITIES", (60,))
    out = tmp_path / "codec.json"
    assert kpbench.main(["codec", str(scene_file), "--dataset", str(tmp_path / "set"), "--out", str(out)]) == 0
    records = results.load([out])
    assert records[0]["settings"]["evaluated_on"] == "held-out views of set"
    psnrs = {round(p["psnr"] + p["loss_db"], 6) for record in records for p in record["points"]}
    assert len(psnrs) == 1 and 3 < psnrs.pop() < 25  # one uncoded scene, unlike these pictures


def test_separate_processes(scene_file: Path) -> None:
    """By baselines, since quick settings do not reach other processes, where KPC's coder would take long."""
    jobs = [codec_bench.Job(scene_file, Float16("zstd -19").name, 10), codec_bench.Job(scene_file, Uint8().name, 4)]
    halves, levels = codec_bench.in_parallel(jobs, None, 2)
    assert halves is not None and levels is not None and halves["size_bytes"] > levels["size_bytes"] > 100
    assert levels["psnr"] < halves["psnr"] < math.inf
    ours = codec_bench.Job(scene_file, "kpc", "quality 5", codec_bench.Trade(quality=5.0))
    assert pickle.loads(pickle.dumps(ours)) == ours


def test_errors_are_one_line(few: None, scene_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "bad").write_bytes(b"nonsense")
    for words in (
        ["codec", str(tmp_path / "bad")],
        ["codec", str(tmp_path / "none.kpc")],
        ["codec", str(scene_file), "--dataset", str(tmp_path / "no")],
        ["codec", str(scene_file), "--dataset", ".", "--dataset", "."],
    ):
        assert kpbench.main(words) in (1, 2)
        output = capsys.readouterr()
        assert (
            output.out == "" and output.err.splitlines()[-1].startswith("kpbench: ") and "Traceback" not in output.err
        )


def test_records_are_json(
    few: None, scene_file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(codec_bench, "RATES", ())
    monkeypatch.setattr(codec_bench, "QUALITIES", (60,))
    monkeypatch.setattr(codec_bench, "TUNE_STEPS", 2)
    monkeypatch.setattr(Uint8, "settings", (8, 4))
    monkeypatch.setattr(codec_bench, "BASELINES", {Uint8().name: Uint8()})
    monkeypatch.setattr(codec_bench, "FINE_TUNED", {"levels, fine-tuned": Uint8().name})
    assert kpbench.main(["codec", str(scene_file)]) == 0
    assert json.loads(capsys.readouterr().out)[0]["kind"] == "codec"
