"""Frames of a clip that are trained alone, by kpbench ceiling."""

import json
from pathlib import Path

import pytest

import datasets as make
from kpc.tools.bench import harness, kpbench
from kpc.tools.bench.ceiling import frames_between

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(autouse=True)
def here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Measure in this process."""
    monkeypatch.setattr(harness, "isolated", lambda work, job: work(job))


def test_frames_part_the_clip_evenly() -> None:
    assert frames_between(5, 1) == [2] and frames_between(31, 3) == [8, 15, 22]
    assert frames_between(2, 3) == [0, 1] and frames_between(3, 9) == [0, 1, 2]


def test_frames_are_trained_alone_and_measured_where_the_clip_moves(tmp_path: Path) -> None:
    make.write_n3dv(tmp_path / "set", frames=5, width=40, height=30)
    out = tmp_path / "ceiling.json"
    words = ["ceiling", str(tmp_path / "set"), "--preset", "draft", "--steps", "2", "--frames", "2", "--seed", "3"]
    assert kpbench.main([*words, "--keep-scenes", str(tmp_path / "kept"), "--out", str(out)]) == 0
    (record,) = json.loads(out.read_text())
    assert record["kind"] == "ceiling" and record["seed"] == 3 and record["settings"]["frames"] == 2
    assert [frame["frame"] for frame in record["frames"]] == [1, 3]
    assert all(frame["moving_psnr"] < 60 and 0 < frame["moving_share"] < 1 for frame in record["frames"])
    assert all(frame["flicker"] is None for frame in record["frames"]) and record["repeats"][0]["pictures"] == 2
    assert sorted(path.name for path in (tmp_path / "kept").iterdir()) == ["set-frame-0001.kpc", "set-frame-0003.kpc"]


def test_a_scene_without_several_views_of_an_instant_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make.write_blender(tmp_path / "alone")
    assert kpbench.main(["ceiling", str(tmp_path / "alone")]) == 1
    assert "a frame alone needs several" in capsys.readouterr().err
