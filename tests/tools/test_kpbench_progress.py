"""Measurements that take long say how far they are."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import gl
from kpc.encoder.coding.scene_writer import write
from kpc.format.coding.quantise import quantise_scene
from kpc.format.common import progress
from kpc.format.common.compiling import MONITOR
from kpc.player.quality import LEVELS
from kpc.tools.bench import codec_bench, entropy_ablation, harness, kpbench, player_bench, streaming_bench
from kpc.tools.bench.entropy_ablation import VARIANTS
from kpc.tools.bench.stability import sweeps
from scenes import tiny_scene


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    tiny = tiny_scene(scales=1, channels=4)
    write(quantise_scene(tiny, [dict.fromkeys(tiny.scales[0], 0.02)]), tmp_path / "tiny.kpc")
    return tmp_path / "tiny.kpc"


@pytest.fixture
def said(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[[], set[str]]:
    """Have each step reported in a line; return a function that returns what was reported to its end."""
    monkeypatch.setattr(progress, "FIRST_LINE_S", 0.0)
    monkeypatch.setattr(progress, "LINE_EVERY_S", 0.0)

    def lines() -> set[str]:
        found = re.findall(r"^([\w ]+): (\d+)/(\d+) (\w+)", capsys.readouterr().err, re.MULTILINE)
        return {f"{label}, {total} {unit}" for label, done, total, unit in found if done == total}

    return lines


def test_entropy(scene: Path, said: Callable[[], set[str]], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(MONITOR, "notice", MONITOR.notice)
    monkeypatch.setattr(entropy_ablation, "VARIANTS", dict(list(VARIANTS.items())[:2]))
    entropy_ablation.measure(scene)
    assert said() == {"entropy, 2 variants"}
    assert MONITOR.notice.endswith("which every run does anew"), "a changed coder is in no cache"


def test_codec(scene: Path, said: Callable[[], set[str]], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(codec_bench, "in_parallel", lambda jobs, *_: (None for _ in jobs))
    monkeypatch.setattr(codec_bench, "BASELINES", {})
    codec_bench.measure(scene, None, 1, False)
    assert said() == {f"codec, {len(codec_bench.RATES) + len(codec_bench.QUALITIES)} points"}


def test_decode(scene: Path, said: Callable[[], set[str]], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(harness, "isolated", lambda function, job: function(job))
    assert kpbench.main(["decode", str(scene), "--repeats", "3"]) == 0
    assert said() == {"decode, 3 repeats"}


def test_sweeps_are_reported_in_parts() -> None:
    done: list[float] = []

    def measure(value: float) -> dict[str, float]:
        done.append(bar.done)
        return {"numpy": 0.0}

    sweep = sweeps.Sweep("stage", "axis", (1.0, 2.0, 3.0, 4.0), measure, (1.0, 4.0), "kept")
    with progress.Progress("stability", 2, "sweeps") as bar:
        sweeps.run(sweep)
        bar.advance()
    assert done == [0.0, 0.25, 0.5, 0.75]


def test_player(scene: Path, said: Callable[[], set[str]]) -> None:
    gl.context()
    job: Any = player_bench.Play(scene, (16, 12), 5)
    player_bench.play_once(job)
    assert "timing, 2 turns" in said()
    player_bench.compare(job)
    assert said() == {"comparing, 2 paths"}


def test_stream(scene: Path, said: Callable[[], set[str]]) -> None:
    gl.context()
    job = streaming_bench.Loading(scene, (16, 12), LEVELS["fast"])
    streaming_bench.measure(job)
    assert said() == {"loading, 4 measurements"}
    streaming_bench.prefixes(job)
    assert {line.partition(",")[0] for line in said()} == {"prefixes"}
