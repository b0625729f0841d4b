"""Plots of benchmark records."""

import json
from pathlib import Path

import pytest

from kpc.format.common.errors import FormatError
from kpc.tools.bench import figures, plot
from kpc.tools.bench.records import Record

MACHINE = {"cpu": "Test CPU", "cores": 2, "memory_bytes": 8 << 30, "os": "Linux", "python": "3.11"}


def record(name: str, seconds: float, psnrs: list[float | None], **changes: object) -> Record:
    runs = [
        {
            "test_psnr": psnr,
            "test_ssim": None if psnr is None else psnr / 40,
            "size_bytes": 1000 * seconds,
            "train_s": seconds + k,
            "encode_s": 2 * seconds,
            "steps": 100,
        }
        for k, psnr in enumerate(psnrs)
    ]
    made: Record = {"kind": "curve", "name": name, "commit": "0" * 40, "command": "kpbench curve", "renderer": "cpu"}
    return made | {"machine": MACHINE, "settings": {"preset": "fast"}, "repeats": runs} | changes


def test_a_line_per_dataset_through_medians_and_a_dot_per_repeat() -> None:
    records = [record("a", 600, [30.0]), record("b", 60, [22.5]), record("a", 60, [20.0, 28.0, 21.0])]
    figure = figures.curves(records)
    assert [axes.get_title() for axes in figure.axes] == ["held-out PSNR, dB", "held-out SSIM", "file, KB"]
    psnr, _, size = figure.axes
    line, dots, other, _ = psnr.lines
    assert (line.get_label(), other.get_label()) == ("a, fast", "b, fast")
    assert line.get_color() == dots.get_color() != other.get_color()
    assert line.get_xydata().tolist() == [[61 / 60, 21.0], [10.0, 30.0]]
    assert sorted(map(tuple, dots.get_xydata().tolist())) == [
        (1.0, 20.0),
        (61 / 60, 28.0),
        (62 / 60, 21.0),
        (10.0, 30.0),
    ]
    assert size.lines[2].get_xydata().tolist() == [[1.0, 60.0]]
    assert psnr.get_xscale() == "log"


def test_values_that_were_not_measured_are_left_out() -> None:
    figure = figures.curves([record("a", 60, [None]), record("a", 120, [None])])
    assert [axes.get_title() for axes in figure.axes] == ["file, KB"]
    figure = figures.curves([record("a", 60, [None]), record("a", 120, [21.0])])
    assert [len(axes.lines[0].get_xydata()) for axes in figure.axes] == [1, 1, 2]


def test_the_svg_is_reproducible_and_keeps_its_text(tmp_path: Path) -> None:
    (tmp_path / "x.json").write_text(json.dumps([record("<b>&", 60, [20.0]), record("<b>&", 1200, [20.5])]))
    for name in ("one.svg", "two.svg"):
        assert plot.main([str(tmp_path / "x.json"), "-o", str(tmp_path / name)]) == 0
    text = (tmp_path / "one.svg").read_text()
    assert text == (tmp_path / "two.svg").read_text()
    assert "held-out PSNR, dB" in text and "&lt;b&gt;&amp;, fast" in text and ">20</text>" in text


@pytest.mark.parametrize("suffix, magic", [("png", b"\x89PNG"), ("PDF", b"%PDF")])
def test_other_formats_by_suffix(tmp_path: Path, suffix: str, magic: bytes) -> None:
    (tmp_path / "x.json").write_text(json.dumps([record("a", 60, [20.0])]))
    assert plot.main([str(tmp_path / "x.json"), "-o", str(tmp_path / f"x.{suffix}")]) == 0
    assert (tmp_path / f"x.{suffix}").read_bytes().startswith(magic)


def test_an_unknown_suffix_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "x.json").write_text(json.dumps([record("a", 60, [20.0])]))
    assert plot.main([str(tmp_path / "x.json"), "-o", str(tmp_path / "x.gif")]) == 2
    assert "x.gif: plots are .svg, .png, .pdf" in capsys.readouterr().err


def test_other_records_are_refused_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    without_time = record("a", 60, [20.0])
    del without_time["repeats"][0]["train_s"]
    for content in ("[]", "{}", json.dumps([record("a", 60, [20.0]) | {"repeats": []}]), json.dumps([without_time])):
        (tmp_path / "x.json").write_text(content)
        assert plot.main([str(tmp_path / "x.json"), "-o", str(tmp_path / "x.svg")]) == 1
        output = capsys.readouterr()
        assert output.out == "" and output.err.startswith("plot: ") and output.err.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["x.json"]
    with pytest.raises(FormatError):
        figures.curves([record("a", 60, [20.0], kind="encode")])
