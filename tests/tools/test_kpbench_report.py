"""The page of kpbench report."""

import base64
import io
import json
import math
import re
import subprocess
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from kpc.encoder.cli.options import Options
from kpc.tools.bench import kpbench, web_page
from kpc.tools.bench.columns import COLUMNS, TITLES
from kpc.tools.bench.encoding_commands import DEFAULT_PRESET
from kpc.tools.bench.records import Record
from kpc.tools.bench.report import page, trades
from kpc.tools.bench.report.charts import Bar, Bars, Chart, Point, Series
from kpc.tools.bench.report.exponents import exponent

BENCH = Path(__file__).parents[2] / "docs" / "bench"
MACHINE = {"cpu": "Test CPU", "cores": 2, "memory_bytes": 8 << 30, "os": "Linux", "python": "3.11"}


class Elements(HTMLParser):
    """Collects the elements of a page with their attributes, and its text."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        self.text += data


def record(kind: str, name: str = "room", **changes: Any) -> Record:
    made: Record = {"kind": kind, "name": name, "commit": "0123456789abcdef", "command": f"kpbench {kind} {name}"}
    made |= {"machine": MACHINE, "renderer": "cpu", "settings": {"preset": "fast"}, "repeats": [{}]}
    return made | changes


def encoded(psnrs: list[float], **settings: Any) -> Record:
    repeats = [{"train_s": 60.0, "encode_s": 90.0, "test_psnr": psnr} for psnr in psnrs]
    return record("encode", settings={"preset": "balanced"} | settings, repeats=repeats)


def written(folder: Path, records: list[Any]) -> str:
    (folder / "some.json").write_text(json.dumps(records))
    assert kpbench.main(["report", str(folder / "some.json"), "-o", str(folder / "page.html")]) == 0
    return (folder / "page.html").read_text()


@pytest.fixture(scope="module")
def committed(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The page about the records in docs/bench."""
    path = tmp_path_factory.mktemp("report") / "page.html"
    assert kpbench.main(["report", *map(str, sorted(BENCH.glob("*.json"))), "-o", str(path)]) == 0
    return path.read_text()


def test_the_page_is_one_small_file(committed: str) -> None:
    assert len(committed.encode()) < page.MOST_BYTES
    assert "://" not in committed and "@import" not in committed
    for tag, attributes in Elements(committed).elements:
        assert tag not in ("link", "iframe", "object", "embed", "base")
        for name in ("src", "href"):
            assert (attributes.get(name) or "#").startswith(("#", "data:image/")), (tag, attributes)
    assert "default-src 'none'" in committed


def test_all_committed_records_are_shown(committed: str) -> None:
    kinds = {r["kind"] for path in BENCH.glob("*.json") for r in json.loads(path.read_text())}
    assert kinds and 'id="others"' not in committed
    for kind in kinds:
        assert f"{TITLES[kind]} ({kind}, " in committed
    ids = [attributes["id"] for _, attributes in Elements(committed).elements if "id" in attributes]
    assert len(ids) == len({*ids})


def test_every_kind_has_a_command_that_exists(capsys: pytest.CaptureFixture[str]) -> None:
    assert COLUMNS.keys() <= trades.COMMANDS.keys()
    for command in trades.COMMANDS.values():
        with pytest.raises(SystemExit):
            kpbench.main([command.split()[1], "--help"])
        shown = capsys.readouterr().out
        assert {*re.findall(r"--[a-z-]+", command)} <= {*re.findall(r"--[a-z-]+", shown)}, command


def test_absent_kinds_are_named_with_their_commands(tmp_path: Path) -> None:
    text = Elements(written(tmp_path, [encoded([30.0])])).text
    assert "No record of curve. kpbench curve DATASET" in text and "No record of encode" not in text
    for section in trades.SECTIONS:
        for kind in {*section.kinds} - {"encode"}:
            assert f"No record of {kind}. {trades.COMMANDS[kind]} makes one." in text


def test_what_cannot_be_shown_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    broken = encoded([30.0]) | {"machine": None, "name": "broken"}
    text = Elements(written(tmp_path, [record("novel", "thing"), broken, {}, encoded([30.0])])).text
    assert "a kind that this page does not know" in text and "novel" in text and "thing" in text
    assert "broken" in text and "not as kpbench writes it: TypeError" in text
    assert "4 records (3 cannot be drawn; the end of the page lists them, and why), " in capsys.readouterr().out


def test_a_file_counts_once_and_an_empty_one_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    some, empty, page = (tmp_path / name for name in ("some.json", "empty.json", "page.html"))
    some.write_text(json.dumps([encoded([30.0])]))
    empty.write_text("[]")
    twice = [str(some), str(tmp_path / "." / ".." / tmp_path.name / "some.json")]
    assert kpbench.main(["report", *twice, str(empty), "-o", str(page)]) == 0
    said = capsys.readouterr()
    assert f"{page}: 1 record, " in said.out and said.err == f"kpbench: {empty}: holds no records\n"


@pytest.mark.parametrize("content", ["{}", "[1]", "no JSON", "[" * 100_000])
def test_files_without_records_are_refused_in_one_line(
    tmp_path: Path, content: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "some.json").write_text(content)
    assert kpbench.main(["report", str(tmp_path / "some.json"), "-o", str(tmp_path / "page.html")]) == 1
    assert re.fullmatch(r"kpbench: .*some.json: not (a list of )?records[^\n]+\n", capsys.readouterr().err)
    assert not (tmp_path / "page.html").exists()


HOSTILE = "<script>alert(1)</script>\" onload='x' $\\frac$ _x ]]> & \x00 \ud800 \ufffe </svg></style>"


def test_hostile_strings_are_text(tmp_path: Path) -> None:
    curve = record("curve", HOSTILE, settings={"preset": HOSTILE}, repeats=encoded([30.0])["repeats"], command=HOSTILE)
    bars = [
        record("ablate", HOSTILE, settings={"ablation": name}, repeats=[{"test_psnr": 30.0, "size_bytes": 5}])
        for name in ("baseline", HOSTILE, "_" + HOSTILE)
    ]
    unknown = record(HOSTILE, HOSTILE)
    made = Elements(written(tmp_path, [curve, *bars, unknown, encoded([math.nan])]))
    shown = HOSTILE.replace("\x00", "\ufffd").replace("\ud800", "\ufffd").replace("\ufffe", "\ufffd")
    assert [tag for tag, _ in made.elements if tag == "script"] == ["script"]
    assert not any(name.startswith("on") for _, attributes in made.elements for name in attributes)
    labels = [attributes["aria-label"] for tag, attributes in made.elements if tag == "svg"]
    assert [label for label in labels if label and not label.startswith(shown)] == [] and len(labels) == 3
    assert labels[0] == f"{shown}: held-out PSNR, dB against training, minutes"
    assert made.text.count(shown) > 5 and "not as kpbench" not in made.text


def test_the_default_is_ringed_and_repeats_have_a_range(tmp_path: Path) -> None:
    assert DEFAULT_PRESET == Options.preset
    chart = trades.training([encoded([29.0, 31.0, 30.0]), encoded([20.0], steps=9), encoded([21.0], psnr_db=21.0)])[0]
    assert isinstance(chart, Chart)
    (series,) = chart.series
    assert series.points == [
        Point(1.0, 30.0, "balanced", 29.0, 31.0, is_default=True),
        Point(1.0, 20.0, "balanced"),
    ]
    drawn = chart.svg(7)
    assert drawn.count("the default</title>") == 1 and "balanced: training, minutes 1, held-out PSNR, dB 30" in drawn
    assert not re.search(r"#01[0-9a-f]{4}", drawn) and "var(--s0)" in drawn and 'id="c7-' in drawn


def test_gains_are_relative_to_the_unchanged_run() -> None:
    runs = [("baseline", 30.0, 100), ("none", 29.5, 80), ("twice", 30.25, 150)]
    records = [
        record("ablate", settings={"ablation": name}, repeats=[{"test_psnr": psnr, "size_bytes": size}])
        for name, psnr, size in runs
    ]
    psnr, size = trades.coding_parts(records)
    assert isinstance(psnr, Bars) and isinstance(size, Bars)
    assert psnr.bars == [Bar("none", -0.5, "-0.50 dB"), Bar("twice", 0.25, "+0.25 dB")]
    assert [bar.text for bar in size.bars] == ["-20 %", "+50 %"] and not size.is_more_better
    drawn = psnr.svg(0)
    assert drawn.index("var(--s1)") < drawn.index("var(--s0)")  # the loss comes first


def test_a_part_that_saves_half_doubles_the_size_without_it() -> None:
    coder = record("codec", coder="kpc, no trellis", points=[], bd_rate=-0.5)
    (chart,) = trades.coding_parts([coder])
    assert isinstance(chart, Bars) and chart.bars == [Bar("no trellis", 100.0, "+100 %")]


def test_levels_that_equal_the_reference_are_bounded_and_the_reference_is_none() -> None:
    def level(quality: str, psnr: float) -> Record:
        settings = {"quality": quality, "default_quality": "balanced", "size": "8x8"}
        return record("player", settings=settings, accuracy={"psnr": psnr}, repeats=[{"frame_ms_median": 5.0}])

    chart = trades.levels([level("balanced", 45.0), level("finer", 98.0), level("reference", 100.0)])[0]
    assert isinstance(chart, Chart)
    assert chart.series[0].points == [
        Point(5.0, 45.0, "balanced", is_default=True),
        Point(5.0, trades.MOST_DB, "finer, 98.0 dB"),
    ]


def test_exponents_are_those_of_power_laws() -> None:
    assert exponent([1, 2, 4], [3.0, 6.0, 12.0]) == pytest.approx(1)
    assert exponent([1, 10], [5.0, 0.5]) == pytest.approx(-1)
    assert exponent([2, 2], [1.0, 2.0]) is None and exponent([0, 1], [1.0, 1.0]) is None


def test_costs_are_drawn_by_axis_with_their_exponents() -> None:
    runs = [
        record(
            "scaling",
            settings={"axis": "cameras", "amount": amount, "preset": "draft"},
            repeats=[{"read_s": amount**2, "train_s": 3.0, "rest_s": amount, "peak_memory_bytes": 1e6 * amount}],
        )
        for amount in (4, 2, 8)
    ]
    seconds, memory = trades.costs(runs)
    assert isinstance(seconds, Chart) and isinstance(memory, Chart)
    names = [series.name for series in seconds.series]
    assert names == ["reading, exponent 2.00", "training, exponent 0.00", "coding and testing, exponent 1.00"]
    assert [point.x for point in seconds.series[0].points] == [2, 4, 8]
    assert memory.series[0].points[0] == Point(2, 2.0, "2")


def test_sweeps_show_each_implementation_with_its_bound_and_what_is_admitted() -> None:
    points = [
        {"value": value, "errors": {"numpy": value / 1e6, "glsl": error}}
        for value, error in ((0, 1), (1, 0), (9, None), (99, 0.5))
    ]
    settings = {"axis": "edge", "error": "picture", "bound": 1 / 255, "admitted": [0, 50]}
    (chart,) = [
        c for c in trades.precision([record("stability", "box", settings=settings, points=points)]) if c.table[1:]
    ]
    assert isinstance(chart, Chart) and chart.title == "box: edge" and list(chart.marks) == [50]
    assert [(one.name, [point.x for point in one.points]) for one in chart.series] == [
        ("numpy", [1, 9, 99]),
        ("glsl", [99]),
    ]
    assert chart.limits == (1 / 255,) and "numpy, 9" in chart.svg(0)


def test_points_below_the_axes_are_not_drawn() -> None:
    chart = Chart("t", "x", "y", [Series("s", [Point(1, 1, "low"), Point(2, 9, "high")])], lowest_y=5)
    drawn = chart.svg(0)
    assert "s, high" in drawn and "s, low" not in drawn and len(chart.table) == 3


def view(kind: str = "WEBP") -> dict[str, Any]:
    written = io.BytesIO()
    Image.new("RGB", (8, 6)).save(written, kind)
    image = base64.b64encode(written.getvalue()).decode()
    found = {"camera": "cam00", "frame": 3, "choice": "the worst", "width": 8, "height": 6}
    return found | {"psnr": 30.0, "moving_psnr": 25.0, "still_psnr": None} | dict.fromkeys(page.SHOWN, image)


def pictures(views: list[dict[str, Any]]) -> Record:
    return record("pictures", settings={"dataset": "room"}, views=views, repeats=[{"psnr": 30.0}])


def test_pictures_beside_truth(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = Elements(written(tmp_path, [pictures([view(), view()]), pictures([view("PNG")])]))
    images = [attributes for tag, attributes in made.elements if tag == "img"]
    assert [image["alt"] for image in images[:2]] == ["as filmed", "as rendered"] and len(images) == 6
    assert all(str(image["src"]).startswith("data:image/webp;base64,") for image in images)
    assert "room: cam00, frame 3, the worst" in made.text and "all 30.0 dB, moving 25.0 dB" in made.text
    assert "picture is no WebP" in made.text
    monkeypatch.setattr(page, "MOST_PICTURE_BYTES", 3 * len(view()["truth"]))
    made = Elements(written(tmp_path, [pictures([view(), view()])]))
    assert "1 views are left out" in made.text and sum(tag == "img" for tag, _ in made.elements) == 3


def test_a_browser_shows_the_page_and_runs_its_script(tmp_path: Path) -> None:
    """The policy of the page permits its own script and nothing else, so what the script changed shows that it ran."""
    if (browser := web_page.browser()) is None:
        pytest.skip("needs Chromium")
    text = written(tmp_path, [pictures([view()])])
    foreign = "<script>document.title = 'foreign'</script>"
    (tmp_path / "page.html").write_text(text.replace("</body>", f"{foreign}</body>"))
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--no-first-run"]
    flags += ["--disable-component-update", "--disable-sync", f"--user-data-dir={tmp_path / 'profile'}"]
    command = [browser, *flags, "--dump-dom", (tmp_path / "page.html").as_uri()]
    shown = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True).stdout
    assert "clip-path: inset(0px 50% 0px 0px)" in shown and "<title>KPC: what each trade costs</title>" in shown
