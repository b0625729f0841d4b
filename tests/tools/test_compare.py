"""kpbench compare: better and worse beyond the noise of the repeats."""

import json
from pathlib import Path
from typing import Any

import pytest

from kpc.tools.bench.compare import changes
from kpc.tools.bench.kpbench import main


def record(*repeats: dict[str, Any], name: str = "room", **settings: Any) -> dict[str, Any]:
    return {"kind": "encode", "name": name, "settings": settings, "repeats": list(repeats)}


@pytest.mark.parametrize(
    "before, after, is_better",
    [
        ([{"test_psnr": 30.0}], [{"test_psnr": 30.1}], True),
        ([{"test_psnr": 30.0}], [{"test_psnr": 29.9}], False),
        ([{"size_bytes": 1000}], [{"size_bytes": 1001}], False),
        ([{"frame_ms_median": 10.0}], [{"frame_ms_median": 8.9}], True),
        ([{"frame_ms_median": 10.0}], [{"frame_ms_median": 10.9}], None),  # within the noise of a single run
        ([{"fps": 30.0}], [{"fps": 20.0}], False),
        ([{"train_s": 10.0}, {"train_s": 12.0}], [{"train_s": 11.9}, {"train_s": 20.0}], None),  # ranges overlap
        ([{"train_s": 10.0}, {"train_s": 12.0}], [{"train_s": 12.1}, {"train_s": 13.0}], False),
        ([{"seed": 1, "steps": 3, "layout": "N3DV"}], [{"seed": 2, "steps": 9, "layout": "LLFF"}], None),
        ([{"test_psnr": None}], [{"test_psnr": 30.0}], None),
    ],
)
def test_a_figure_is_better_or_worse_beyond_noise(before: list, after: list, is_better: bool | None) -> None:
    found = changes(record(*before), record(*after))
    assert [change.is_better for change in found] == ([] if is_better is None else [is_better])


def test_records_of_equal_settings_are_compared(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = [tmp_path / "old.json", tmp_path / "new.json"]
    files[0].write_text(json.dumps([record({"size_bytes": 9}, preset="fast"), record({"size_bytes": 5}, name="liam")]))
    files[1].write_text(
        json.dumps([record({"size_bytes": 8}, preset="fast"), record({"size_bytes": 5}, preset="best")])
    )
    assert main(["compare", *map(str, files)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith('better encode room {"preset": "fast"}: size_bytes 9 -> 8 (-11.1%)')
    assert [line.split(":")[0] for line in lines[1:3]] == [f"only in {files[0]}", f"only in {files[1]}"]
    assert lines[3] == "1 record compared: 1 better, 0 worse"
    assert main(["compare", *map(str, reversed(files))]) == 1
    assert "1 figure is worse" in capsys.readouterr().err


def test_what_holds_no_records_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    wrong = {"{}": "not a list of records", "[{}]": "not records of kpbench (record 1 has no 'settings')"}
    for text, said in wrong.items():
        (tmp_path / "x.json").write_text(text)
        assert main(["compare", str(tmp_path / "x.json"), str(tmp_path / "x.json")]) == 1
        assert f"x.json: {said}; write it with kpbench --out" in capsys.readouterr().err


def test_records_of_nothing_in_common_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("room", "liam"):
        (tmp_path / f"{name}.json").write_text(json.dumps([record({"size_bytes": 9}, name=name)]))
    assert main(["compare", str(tmp_path / "room.json"), str(tmp_path / "liam.json")]) == 2
    assert "have no record of the same measurement" in capsys.readouterr().err
