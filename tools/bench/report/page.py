"""kpbench report: what the records of benchmarks say of the trades, on one page that needs no network.

    kpbench report docs/bench/*.json -o report.html

What is absent, the page says, with the command that makes it; a record that it cannot show, it names.
"""

import base64
import binascii
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from kpc.format.common import cli
from kpc.format.common.errors import KpcError
from kpc.format.common.text import counted, notice
from kpc.tools import pages
from kpc.tools.bench import records as record_files
from kpc.tools.bench.columns import COLUMNS, TITLES
from kpc.tools.bench.records import Record
from kpc.tools.bench.report.trades import COMMANDS, SECTIONS, AnyChart
from kpc.tools.bench.tables import cells, machine_name, short_commit

# What the page may take, and what of it pictures may.
MOST_BYTES, MOST_PICTURE_BYTES = 5_000_000, 3_000_000
# Characters that no page may hold: controls but tab and line feed, halves of surrogate pairs, and non-characters.
UNFIT = re.compile("[\x00-\x08\x0b-\x1f\x7f\ud800-\udfff\ufffe\uffff]")
PICTURES = "pictures"  # the kind of record that holds pictures
SHOWN = ("picture", "truth", "error")  # those of each view


@dataclass(frozen=True)
class Found:
    """A record, and where it comes from.

    Attributes:
        file: its name.
        record: as it was read.
        fault: why the page cannot show it; empty where it can.
    """

    file: str
    record: Record
    fault: str = ""


def main(argv: Sequence[str]) -> None:
    """Write the page.

    Raises:
        FormatError: a file holds no list of records.
        KpcError: the page would be too large.
    """
    parser = cli.Parser("kpbench report", description="Draw benchmark records on one page that needs no network.")
    parser.add_argument(
        "records", type=cli.input_path, nargs="+", metavar="JSON", help="files that kpbench --out wrote"
    )
    parser.add_argument(
        "-o", "--output", type=cli.output_file(".html"), required=True, metavar="HTML", help="the page to write"
    )
    options = parser.parse_args(argv)
    cli.check_writable(options.output)
    files = {path.resolve(): path for path in reversed(options.records)}  # each once
    found = [one for path in reversed(files.values()) for one in read(path)]
    text = as_page(found)
    if (size := len(text.encode())) > MOST_BYTES:
        raise KpcError(f"the page would take {size / 1e6:.1f} MB, more than {MOST_BYTES / 1e6:g}; give fewer records")
    with cli.atomic_write(options.output) as aside:
        aside.write_text(text, encoding="utf-8")
    left_out = sum(bool(one.fault) for one in found)
    note = f" ({left_out} cannot be drawn; the end of the page lists them, and why)" if left_out else ""
    print(f"{options.output}: {counted(len(found), 'record')}{note}, {size / 1e6:.1f} MB")


def read(path: Path) -> list[Found]:
    """Read the records of a file, of whatever kind.

    Raises:
        FormatError: it holds no list of objects.
    """
    records = record_files.read(path)
    if not records:
        notice(f"kpbench: {path}: holds no records")
    return [Found(path.name, record, fault_of(record)) for record in map(_fit, records)]


def fault_of(record: Record) -> str:
    """Return why a record cannot be shown; empty where it can."""
    kind = record.get("kind")
    if not isinstance(kind, str) or kind not in COLUMNS:
        return "a kind that this page does not know"
    try:
        cells(kind, [record])
        origin = machine_name(record), short_commit(record["commit"]), str(record["command"])
        if not all(map(str, origin)):
            raise ValueError("no origin")
        for section in SECTIONS:
            if kind in section.kinds:
                section.draw([record])
        if kind == PICTURES:
            views_of(record)
    except (ValueError, KeyError, TypeError, AttributeError, IndexError, ArithmeticError) as error:
        return f"not as kpbench writes it: {error!r}"
    return ""


def as_page(found: Sequence[Found]) -> str:
    """Return the page about some records."""
    records = [one.record for one in found if not one.fault]
    kinds = {record["kind"] for record in records}
    numbers = iter(range(1_000_000))
    sections = []
    for section in SECTIONS:
        drawn = section.draw([record for record in records if record["kind"] in section.kinds])
        charts = [_chart(chart, next(numbers)) for chart in drawn if _has_points(chart)]
        sections.append(_described(section.key, section.title, section.text, section.kinds, kinds) | {"charts": charts})
    pictures = _described(
        PICTURES,
        "Pictures beside truth",
        "Held-out views as KPC renders them and as they were filmed: move the slider. Below, "
        "where the two differ, the brighter the more: orange where pixels move, blue where they are still.",
        (PICTURES,),
        kinds,
    )
    views, left_out = _views(records)
    commits = list(dict.fromkeys(short_commit(record["commit"]) for record in records))
    return pages.render(
        "bench.html",
        script="bench.js",
        sections=sections,
        pictures=pictures | {"views": views, "left_out": left_out},
        tables=[_table(kind, [r for r in records if r["kind"] == kind]) for kind in TITLES if kind in kinds],
        others=[
            [str(one.record.get("kind"))[:200], str(one.record.get("name"))[:200], one.file, one.fault[:500]]
            for one in found
            if one.fault
        ],
        count=len(records),
        commits=commits,
        is_dirty=any(commit.endswith("dirty") for commit in commits),
        machines=list(dict.fromkeys(map(machine_name, records))),
    )


def _described(key: str, title: str, text: str, wanted: Iterable[str], kinds: set[str]) -> dict[str, Any]:
    """Return what the page says of a section, and which kinds of its records are absent, each with its command."""
    absent = [(kind, COMMANDS[kind]) for kind in wanted if kind not in kinds]
    return {"key": key, "title": title, "text": text, "absent": absent}


def _has_points(chart: AnyChart) -> bool:
    return len(chart.table) > 1


def _chart(chart: AnyChart, number: int) -> dict[str, Any]:
    return {"title": chart.title, "svg": chart.svg(number), "table": chart.table}


def _table(kind: str, records: Sequence[Record]) -> dict[str, Any]:
    head, *rows = cells(kind, records)
    return {
        "kind": kind,
        "title": TITLES[kind],
        "head": [*head, "machine", "runs", "commit"],
        "rows": [
            [*row, machine_name(record), str(len(record["repeats"])), short_commit(record["commit"])]
            for row, record in zip(rows, records, strict=True)
        ],
        "commands": list(dict.fromkeys(str(record["command"]) for record in records)),
    }


# --- pictures


def views_of(record: Record) -> list[dict[str, Any]]:
    """Return the views of a record of pictures.

    Raises:
        ValueError: a picture is no WebP in base64.
    """
    views = []
    for view in record["views"]:
        for key in SHOWN:
            try:
                data = base64.b64decode(view[key], validate=True)
            except binascii.Error as error:
                raise ValueError(f"{key} is not base64") from error
            if data[:4] != b"RIFF" or data[8:12] != b"WEBP":
                raise ValueError(f"{key} is no WebP")
        psnrs = {
            part: view[name] for part, name in (("all", "psnr"), ("moving", "moving_psnr"), ("still", "still_psnr"))
        }
        said = ", ".join(f"{part} {value:.1f} dB" for part, value in psnrs.items() if value is not None)
        views.append(
            {key: view[key] for key in SHOWN}
            | {"said": said, "width": int(view["width"]), "height": int(view["height"])}
            | {"title": f"{record['name']}: {view['camera']}, frame {view['frame']}, {view['choice']}"}
        )
    return views


def _views(records: Iterable[Record]) -> tuple[list[dict[str, Any]], int]:
    """Return the views that fit MOST_PICTURE_BYTES, and how many do not."""
    views = [view for record in records if record["kind"] == PICTURES for view in views_of(record)]
    room, kept = MOST_PICTURE_BYTES, []
    for view in views:
        room -= sum(len(view[key]) for key in SHOWN)
        if room >= 0:
            kept.append(view)
    return kept, len(views) - len(kept)


# --- whatever records hold


def _fit(value: Any) -> Any:
    """Return a value of JSON with characters and numbers that a page can hold."""
    if isinstance(value, str):
        return UNFIT.sub("\ufffd", value)
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, list):
        return [_fit(item) for item in value]
    if isinstance(value, dict):
        return {_fit(key): _fit(item) for key, item in value.items()}
    return value
