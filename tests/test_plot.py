"""The plot shows what the records say, where its axes say it."""

import json
import math
from pathlib import Path
from xml.etree import ElementTree

import pytest

from kpc.format.errors import FormatError
from kpc.tools import plot, results

MACHINE = {"cpu": "Test CPU", "cores": 2, "memory_bytes": 8 << 30, "os": "Linux", "python": "3.11"}
SVG = "{http://www.w3.org/2000/svg}"


def record(name: str, seconds: float, psnrs: list[float | None], **changes: object) -> results.Record:
    runs = [
        dict(test_psnr=psnr, test_ssim=None if psnr is None else psnr / 40, size_bytes=1000 * seconds, train_s=seconds + k,
             encode_s=2 * seconds, steps=100)
        for k, psnr in enumerate(psnrs)
    ]  # fmt: skip
    made: results.Record = dict(kind="curve", name=name, commit="0" * 40, command="kpbench curve", renderer="cpu")
    return made | dict(machine=MACHINE, settings={"preset": "fast"}, repeats=runs) | changes


def test_dots_lie_where_the_axes_say() -> None:
    records = [record("a", 60, [20.0]), record("a", 600, [25.0]), record("b", 60, [22.5]), record("b", 600, [30.0])]
    root = ElementTree.fromstring(plot.svg(records))
    texts: dict[tuple[str | None, str | None], ElementTree.Element] = {}
    for text in root.iter(f"{SVG}text"):
        texts.setdefault((text.text, text.get("text-anchor")), text)  # PSNR's panel comes first
    xs = {minutes: float(texts[minutes, "middle"].get("x", "")) for minutes in ("1", "10")}
    ys = {psnr: float(texts[psnr, "end"].get("y", "")) - 4 for psnr in ("20", "30")}

    dots = [(float(dot.get("cx", "")), float(dot.get("cy", ""))) for dot in root.iter(f"{SVG}circle")]
    assert len(dots) == 3 * 4
    wanted = [("1", 20.0), ("10", 25.0), ("1", 22.5), ("10", 30.0)]
    for (x, y), (minutes, psnr) in zip(dots[:4], wanted):
        assert x == pytest.approx(xs[minutes], abs=0.11)
        assert y == pytest.approx(ys["20"] + (ys["30"] - ys["20"]) * (psnr - 20) / 10, abs=0.11)
    _, _, width, height = map(float, root.get("viewBox", "").split())
    assert all(0 < x < width and 0 < y < height for x, y in dots)
    corners = [line.get("points", "").split() for line in root.iter(f"{SVG}polyline")]
    assert corners[0] == [f"{x:.1f},{y:.1f}" for x, y in dots[:2]]
    assert ("a, fast", "start") in texts and ("b, fast", "start") in texts


def test_lines_go_through_medians_in_the_order_of_time() -> None:
    root = ElementTree.fromstring(plot.svg([record("a", 600, [30.0]), record("a", 60, [20.0, 28.0, 21.0])]))
    dots = [(dot.get("cx"), dot.get("cy")) for dot in root.iter(f"{SVG}circle")]
    (first, last) = next(root.iter(f"{SVG}polyline")).get("points", "").split()
    assert float(first.split(",")[0]) < float(last.split(",")[0])
    assert last == ",".join(dots[0]) and first.split(",") == [dots[2][0], dots[3][1]]  # 61 s, and 21.0 dB


def test_what_was_not_measured_is_left_out() -> None:
    text = plot.svg([record("a", 60, [None]), record("a", 120, [None])])
    assert "PSNR" not in text and "SSIM" not in text and "file, KB" in text
    text = plot.svg([record("a", 60, [None]), record("a", 120, [21.0])])
    assert text.count("<circle") == 1 + 1 + 2


def test_names_are_escaped() -> None:
    root = ElementTree.fromstring(plot.svg([record("<b>&", 60, [20.0])]))
    assert "<b>&, fast" in {text.text for text in root.iter(f"{SVG}text")}


@pytest.mark.parametrize(
    "values", [[0.93], [25.0, 25.0], [0.0, 0.0], [20.1, 33.7], [0.931, 0.967], [110.0, 4000.0], [-3.0, 2.0]]
)
def test_ticks_are_round_and_hold_all_values(values: list[float]) -> None:
    axis = plot.linear_axis(values)
    assert 2 <= len(axis.ticks) <= 8 and axis.ticks[0] == axis.low and axis.ticks[-1] == axis.high
    assert all(-1e-9 <= axis.at(value) <= 1 + 1e-9 for value in values)
    step = axis.ticks[1] - axis.ticks[0]
    assert any(math.isclose(step / 10 ** math.floor(math.log10(step) + 1e-9), n, rel_tol=1e-6) for n in (1, 2, 5))


def test_time_is_logarithmic() -> None:
    axis = plot.time_axis([60.0, 1200.0])
    assert [round(tick / 60, 9) for tick in axis.ticks] == [1, 2, 5, 10, 20]
    assert axis.at(120.0) - axis.at(60.0) == pytest.approx(axis.at(1200.0) - axis.at(600.0))
    assert 0 < axis.at(60.0) and axis.at(1200.0) < 1


def test_other_records_are_refused_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    without_time = record("a", 60, [20.0])
    del without_time["repeats"][0]["train_s"]
    for content in ("[]", "{}", json.dumps([record("a", 60, [20.0]) | {"repeats": []}]), json.dumps([without_time])):
        (tmp_path / "x.json").write_text(content)
        assert plot.main([str(tmp_path / "x.json"), "-o", str(tmp_path / "x.svg")]) == 1
        said = capsys.readouterr()
        assert said.out == "" and said.err.startswith("plot: ") and said.err.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["x.json"]
    with pytest.raises(FormatError):
        plot.svg([record("a", 60, [20.0], kind="encode")])
