"""Tables of benchmark records, and the documents that hold them.

python -m kpc.tools.bench.results docs/bench/*.json                                        print the tables as Markdown
python -m kpc.tools.bench.results docs/bench/*.json --into README.md docs/benchmarks.md      rewrite those between the documents' markers

Tables in documents come from here, never from a keyboard. A cell is the median over the repeats of a run.
"""

import argparse
import json
import re
import statistics
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from kpc.format.common import cli
from kpc.format.common.errors import FormatError

LOSSES_DB = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0)
"""Of PSNR on held-out views, at which coders are compared."""

Record = dict[str, Any]
Column = tuple[str, Callable[[Record], str]]

MARKED = re.compile(r"(<!-- (\w+): begin\b[^\n]*-->)(.*?)(<!-- \2: end -->)", re.DOTALL)
"""In a document: a name, and what stands between its markers."""
MARKER = re.compile(r"<!-- \w+: (?:begin|end)\b")
GLANCED_AT = "640x480"


def median(record: Record, key: str) -> float | None:
    """Over the repeats that have `key`; None where none has."""
    values = [repeat[key] for repeat in record["repeats"] if repeat.get(key) is not None]
    return statistics.median(values) if values else None


def _number(key: str, text: str, unit: float = 1.0) -> Callable[[Record], str]:
    """The median of `key` in multiples of `unit`, as `text` formats it."""

    def cell(record: Record) -> str:
        value = median(record, key)
        return "-" if value is None else text.format(value / unit)

    return cell


def _accuracy(key: str, text: str, unit: float = 1.0) -> Callable[[Record], str]:
    return lambda record: text.format(record["accuracy"][key] / unit) if key in record["accuracy"] else "-"


def _ratio(key: str, other: str, text: str, unit: float = 1.0) -> Callable[[Record], str]:
    def cell(record: Record) -> str:
        value, against = median(record, key), median(record, other)
        return "-" if value is None or not against else text.format(value / against / unit)

    return cell


def _of(record: Record, group: str, key: str) -> float:
    return statistics.median(repeat[group][key] for repeat in record["repeats"])


def _part(name: str) -> Callable[[Record], str]:
    """Milliseconds of a step."""
    return lambda record: f"{1e3 * _of(record, 'parts_s', name):.1f}"


def _limit(name: str) -> Callable[[Record], str]:
    return lambda record: f"{_of(record, 'limits', name):.0f}"


def _against(key: str, limit: str) -> Callable[[Record], str]:
    """What was reached, and what the machine can reach."""
    return lambda record: f"{median(record, key):.0f} of {_of(record, 'limits', limit):.0f}"


def _prefixes(record: Record) -> str:
    """All but the last, which is the whole."""
    size = record["prefixes"][-1]["bytes"]
    return ", ".join(f"{prefix['bytes'] / size:.0%}: {prefix['psnr']:.1f}" for prefix in record["prefixes"][:-1])


def _at_joins(record: Record) -> str:
    """Of each join; changes are in 8-bit levels."""
    return "; ".join(
        f"{join['before']:.1f}, {join['after']:.1f}; {255 * join['change']:.1f}" for join in record["joins"]
    )


def _usual_change(record: Record) -> str:
    joins = record["joins"]
    return f"{255 * joins[0]['usual_change']:.1f}, {255 * joins[0]['high_change']:.1f}" if joins else "-"


def _ways(record: Record) -> str:
    """Of a frame by each kind of shader, where there is a choice."""
    times = [median(record, f"{way}_ms_median") for way in ("fragment", "compute")]
    return "-" if None in times else ", ".join(f"{time:.1f}" for time in times)


def _smaller(record: Record) -> str:
    """By how much ours is smaller at equal PSNR, on average over the curve; and what codes its planes."""
    if record.get("missing"):
        return str(record["missing"])
    rates = [record["bd_rate"], record.get("bd_rate_planes")]
    return ", ".join(f"{-rate:.0%}" for rate in rates if rate is not None) or "-"


def _shares(record: Record) -> str:
    """Of our bytes, by kind of chunk, the largest first."""
    shares: dict[str, float] = record["repeats"][0].get("shares") or {}
    largest = sorted(shares.items(), key=lambda share: -share[1])
    return ", ".join(f"{kind} {share:.0%}" for kind, share in largest if share >= 0.01) or "-"


def is_ours(coder: str) -> bool:
    """Whether it is our coder, whole or with something left out."""
    return coder.startswith("kpc")


def _quality_table(records: Iterable[Record]) -> list[list[str]]:
    """What each quality gives: of our coder alone, bytes and loss."""
    rows = []
    for record in records:
        if record["coder"] == "kpc":
            labelled = ((str(point["setting"]), point) for point in record["points"])
            points = {
                label.removeprefix("quality "): point for label, point in labelled if label.startswith("quality ")
            }
            rows.append((record["name"], points))
    qualities = sorted({quality for _, points in rows for quality in points}, key=float)

    def cell(point: Record | None) -> str:
        return "-" if point is None else f"{point['size_bytes'] / 1e3:.0f} KB, {point['loss_db']:.2f} dB"

    return [["scene", *qualities]] + [
        [name, *(cell(points.get(quality)) for quality in qualities)] for name, points in rows
    ]


def _loss_table(records: Sequence[Record]) -> list[list[str]]:
    """Our bytes at each of LOSSES_DB, and how much less that is than the smallest of what is at hand."""
    from kpc.tools.bench.rd_curves import size_at  # SciPy: not needed for any other table

    rows = []
    for name in dict.fromkeys(record["name"] for record in records):
        points = {record["coder"]: record["points"] for record in records if record["name"] == name}
        row = [name]
        for loss in LOSSES_DB:
            ours = size_at(points.get("kpc", []), loss)
            sizes = {coder: size for coder in points if not is_ours(coder) and (size := size_at(points[coder], loss))}
            best = min(sizes, key=lambda coder: sizes[coder], default=None)
            row.append(
                "-"
                if ours is None
                else f"{ours / 1e3:.0f} KB" + (f", {1 - ours / sizes[best]:.0%} ({best})" if best else "")
            )
        rows.append(row)
    return [["scene", *(f"{loss:g} dB" for loss in LOSSES_DB)], *rows]


def _preset(record: Record) -> str:
    """And what the file was to have, if that was said."""
    psnr = record["settings"].get("psnr_db")
    return str(record["settings"]["preset"]) + ("" if psnr is None else f", --psnr {psnr:g}")


_ENCODED: list[Column] = [
    ("dataset", lambda r: r["name"]),
    ("preset", _preset),
    ("PSNR dB", _number("test_psnr", "{:.2f}")),
    ("SSIM", _number("test_ssim", "{:.3f}")),
    ("file KB", _number("size_bytes", "{:.0f}", 1e3)),
]

COLUMNS: dict[str, list[Column]] = {
    "encode": [
        *_ENCODED,
        ("bits/param", _number("bits_per_parameter", "{:.2f}")),
        ("identity", _number("identity_share", "{:.0%}")),
        ("coding loss dB", _number("coding_loss_db", "{:.2f}")),
        ("training", _number("train_s", "{:.0f} s")),
        ("all", _number("encode_s", "{:.0f} s")),
        ("rays/s", _number("rays_per_s", "{:,.0f}")),
        ("peak MB", _number("peak_memory_bytes", "{:.0f}", 1e6)),
    ],
    "curve": [
        *_ENCODED,
        ("training", _number("train_s", "{:.0f} s")),
        ("all", _number("encode_s", "{:.0f} s")),
        ("steps", _number("steps", "{:,.0f}")),
    ],
    "ablate": [
        _ENCODED[0],
        ("changed", lambda r: r["settings"]["ablation"]),
        *_ENCODED[2:],
        ("identity", _number("identity_share", "{:.0%}")),
        ("training", _number("train_s", "{:.0f} s")),
    ],
    "step": [
        *_ENCODED[:2],
        ("M param", _number("parameters", "{:.2f}", 1e6)),
        ("samples/ray", _number("samples_per_ray", "{:.1f}")),
        ("rays/s", _number("rays_per_s", "{:,.0f}")),
        ("plain PyTorch", _number("plain_rays_per_s", "{:,.0f}")),
        ("faster", _ratio("rays_per_s", "plain_rays_per_s", "{:.0f}x")),
        ("ms a step", _number("step_s", "{:.1f}", 1e-3)),
        *((name, _part(name)) for name in ("kernel", "adam", "priors", "decoder", "rays", "occupancy")),
        ("kernel GFLOP/s", _against("kernel_gflops", "gflops")),
        ("kernel GB/s", _against("kernel_gb_s", "cache_gb_s")),
        ("memory GB/s", _limit("memory_gb_s")),
        ("peak MB", _number("peak_memory_bytes", "{:.0f}", 1e6)),
    ],
    "gpu": [
        *_ENCODED[:2],
        ("M param", _number("parameters", "{:.2f}", 1e6)),
        ("samples/ray", _number("samples_per_ray", "{:.1f}")),
        ("rays/s", _number("rays_per_s", "{:,.0f}")),
        ("ms a step", _number("step_s", "{:.1f}", 1e-3)),
        ("GB a step", _number("bytes", "{:.1f}", 1e9)),
        ("at least", _number("least_bytes", "{:.1f}", 1e9)),
        ("GB/s", _ratio("bytes", "step_s", "{:.0f}", 1e9)),
        ("a copy's", _number("memory_gb_s", "{:.0f}")),
        ("share", _number("share_of_memory", "{:.0%}")),
        ("GPU memory GB", _number("gpu_memory_bytes", "{:.1f}", 1e9)),
    ],
    "player": [
        ("scene", lambda r: r["name"]),
        (
            "quality",
            lambda r: r["settings"]["quality"] + " (default)" * (r["settings"]["quality"] == r["settings"]["default"]),
        ),
        ("size", lambda r: r["settings"]["size"]),
        ("first frame ms", _number("first_frame_ms", "{:.0f}")),
        ("median ms", _number("frame_ms_median", "{:.1f}")),
        ("p95 ms", _number("frame_ms_p95", "{:.1f}")),
        ("processors ms", _number("cpu_ms_median", "{:.1f}")),
        ("fps", _number("fps", "{:.1f}")),
        ("fragment, compute ms", _ways),
        ("G texels", _number("texels_a_frame", "{:.2f}", 1e9)),
        ("of the card's rate", _number("share_of_texel_rate", "{:.0%}")),
        ("of reference", _number("times_reference", "{:.1f}x")),
        ("samples/ray", _accuracy("samples_per_ray", "{:.1f}")),
        ("textures MB", _number("gpu_memory_bytes", "{:.1f}", 1e6)),
        ("peak MB", _number("peak_memory_bytes", "{:.0f}", 1e6)),
        ("PSNR to reference dB", _accuracy("psnr", "{:.1f}")),
        ("worst frame", _accuracy("psnr_least", "{:.1f}")),
        ("turning", _accuracy("psnr_turning", "{:.1f}")),
        ("within 1/255", _accuracy("within_one_level", "{:.2%}")),
        ("folding alone: worst frame dB", _accuracy("folding_psnr", "{:.1f}")),
        ("largest error, of 255", _accuracy("folding_most", "{:.0f}", 1 / 255)),
    ],
    "stream": [
        ("scene", lambda r: r["name"]),
        ("file KB", _number("size_bytes", "{:.0f}", 1e3)),
        ("first picture from disk ms", _number("disk_first_picture_ms", "{:.0f}")),
        ("line", lambda r: f"{r['settings']['rate']}, {r['settings']['delay']}"),
        ("first picture ms", _number("line_first_picture_ms", "{:.0f}")),
        ("after KB", _number("line_first_picture_bytes", "{:.0f}", 1e3)),
        ("finest ms", _number("line_finest_picture_ms", "{:.0f}")),
        ("all ms", _number("line_all_ms", "{:.0f}")),
        ("jump ms", _number("jump_ms", "{:.0f}")),
        ("of which waiting", _number("jump_wait_ms", "{:.0f}")),
        ("share of the file: dB to the whole", _prefixes),
    ],
    "steady": [
        ("scene", lambda r: r["name"]),
        ("window", lambda r: r["settings"]["size"]),
        ("frames", lambda r: f"{r['settings']['frames']:,}"),
        ("fps", _number("fps", "{:.0f}")),
        ("made on the card", _number("made_on_card", "{:.0f}")),
        ("MB at first", _number("first_bytes", "{:.1f}", 1e6)),
        ("MB at last", _number("last_bytes", "{:.1f}", 1e6)),
        ("KB more in 1,000 frames", _number("bytes_per_1000_frames", "{:.1f}", 1e3)),
    ],
    "window": [
        ("scene", lambda r: r["name"]),
        ("window", lambda r: r["settings"]["size"]),
        ("degrees a second", lambda r: f"{r['settings']['turn']:g}"),
        ("fps", _number("fps", "{:.0f}")),
        ("95% ms", _number("frame_ms_p95", "{:.0f}")),
        ("raster", lambda r: r["repeats"][0]["raster"]),
        ("changes a minute", _number("rasters_a_minute", "{:.0f}")),
        ("dB to the exact path", _number("psnr", "{:.1f}")),
        ("at least", _number("psnr_least", "{:.1f}")),
    ],
    "codec": [
        ("scene", lambda r: r["name"]),
        ("coder", lambda r: r["coder"]),
        ("KB at 0.15 dB loss", _number("size_at_default_loss", "{:.0f}", 1e3)),
        ("kpc is smaller by, its planes by", _smaller),
        ("near it: KB", _number("size_bytes", "{:.0f}", 1e3)),
        ("bits/param", _number("bits_per_parameter", "{:.2f}")),
        ("PSNR loss dB", _number("loss_db", "{:.2f}")),
        ("encode s", _number("encode_s", "{:.1f}")),
        ("decode s", _number("decode_s", "{:.2f}")),
        ("chunks", _shares),
    ],
    "groups": [
        ("dataset", lambda r: r["name"]),
        ("preset", lambda r: r["settings"]["preset"]),
        ("groups of", lambda r: f"{r['settings']['group_s']:g} s"),
        ("groups", _number("groups", "{:.0f}")),
        ("file KB", _number("size_bytes", "{:.0f}", 1e3)),
        ("PSNR dB", _number("test_psnr", "{:.2f}")),
        ("encoded in s", _number("encode_s", "{:.0f}")),
        ("peak MB, one group", _number("peak_of_one_bytes", "{:.0f}", 1e6)),
        ("peak MB, all", _number("peak_memory_bytes", "{:.0f}", 1e6)),
        ("at joins: dB before, after; change", _at_joins),
        ("usual change, 95th percentile", _usual_change),
    ],
    "entropy": [
        ("scene", lambda r: r["name"]),
        ("without", lambda r: r["settings"]["left_out"]),
        ("planes KB", _number("plane_bytes", "{:.1f}", 1e3)),
        ("decoded ms", _number("decode_ms", "{:.0f}")),
        ("whole file KB", _number("file_bytes", "{:.1f}", 1e3)),
        ("read ms", _number("read_ms", "{:.0f}")),
    ],
}

TITLES = {
    "encode": "Encoding",
    "curve": "Encoding, quality against time",
    "ablate": "Encoding, one thing changed",
    "step": "A step of training",
    "gpu": "A step of training",
    "player": "Playing",
    "stream": "Playing while it arrives",
    "groups": "A clip in groups",
    "window": "Playing in a window that is left to itself",
    "steady": "Playing for long, all controls shown",
    "codec": "Coding, beside what is at hand",
    "entropy": "Entropy coding of planes, one idea left out; one core",
}


def cells(kind: str, records: Iterable[Record]) -> list[list[str]]:
    """Heading and rows of the table of one kind of record."""
    columns = COLUMNS[kind]
    return [[name for name, _ in columns]] + [[cell(record) for _, cell in columns] for record in records]


def aligned(table: Sequence[Sequence[str]]) -> str:
    """A table for a terminal."""
    widths = [max(map(len, column)) for column in zip(*table)]
    return "\n".join("  ".join(text.ljust(width) for text, width in zip(row, widths)).rstrip() for row in table)


def markdown(records: Sequence[Record]) -> str:
    """Tables of all records, one for each kind and machine, and below each where its numbers come from."""
    return "\n\n".join(tables(kind, records) for kind in TITLES if any(record["kind"] == kind for record in records))


def tables(kind: str, records: Iterable[Record]) -> str:
    """Those of one kind."""
    parts, ours = [], [record for record in records if record["kind"] == kind]
    for place in dict.fromkeys(map(_place, ours)):
        here = [record for record in ours if _place(record) == place]
        head, *rows = cells(kind, here)
        runs = sorted({len(record["repeats"]) for record in here})
        commits = ", ".join(dict.fromkeys(_short(record["commit"]) for record in here))
        parts += [f"**{TITLES[kind]}** on {place}:", _lines(head, rows)]
        if kind == "codec":
            parts.append("At equal loss: size, and how much smaller that is than the smallest of what is at hand:")
            head, *rows = _loss_table(here)
            parts.append(_lines(head, rows))
            parts.append("By `--quality`, size and PSNR loss:")
            head, *rows = _quality_table(here)
            parts.append(_lines(head, rows))
        parts.append(
            f"Commit {commits}; median of {' or '.join(map(str, runs))} run{'s' * (runs != [1])}; "
            + "; ".join(dict.fromkeys(f"`{record['command']}`" for record in here))
            + "."
        )
    return "\n\n".join(parts)


def glance(records: Sequence[Record]) -> str:
    """A line a scene: what its file is, of the encoding that the player's file is named after, and how fast a processor plays it."""
    encoded = {
        f"{record['name']}-{record['settings']['preset']}": record
        for record in records
        if record["kind"] == "encode" and record["settings"].get("psnr_db") is None
    }
    played = {
        record["name"]: record
        for record in records
        if record["kind"] == "player" and record["settings"]["size"] == GLANCED_AT
        and record["settings"]["quality"] == record["settings"]["default"] and "llvmpipe" in record["renderer"]
    }  # fmt: skip
    rows = [
        [*(cell(encoded[name]) for _, cell in _ENCODED), _number("encode_s", "{:.0f}", 60.0)(encoded[name]),
         str(encoded[name]["machine"]["cores"]), *(cell(played[name]) for cell in (_number("fps", "{:.0f}"), _accuracy("psnr", "{:.0f}")))]
        for name in played if name in encoded
    ]  # fmt: skip
    head = [
        *(name for name, _ in _ENCODED),
        "encoded in minutes",
        "on cores",
        f"fps at {GLANCED_AT}",
        "dB to exact ones",
    ]
    return _lines(head, rows)


def is_brief(record: Record) -> bool:
    """Whether documents show it: of the qualities of playing, only the default and the reference."""
    return record["kind"] != "player" or record["settings"]["quality"] in (record["settings"]["default"], "reference")


def _lines(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    return "\n".join(f"| {' | '.join(line)} |" for line in [head, ["---"] * len(head), *rows])


def _place(record: Record) -> str:
    machine = record["machine"]
    processor = f"{machine['cpu']}, {machine['cores']} cores, {machine['memory_bytes'] / 2**30:.0f} GiB"
    return processor if record["renderer"] == "cpu" else f"{record['renderer']} ({processor})"


def _short(commit: str) -> str:
    digits, plus, dirty = commit.partition("+")
    return digits[:9] + plus + dirty


def load(paths: Iterable[Path]) -> list[Record]:
    """The records of files that kpbench wrote, in order.

    Raises:
        FormatError: a file holds something else.
    """
    records: list[Record] = []
    for path in paths:
        try:
            found = json.loads(path.read_text())
            if not isinstance(found, list):
                raise ValueError("not a list")
            for record in found:
                cells(record["kind"], [record])
                _place(record), record["commit"], record["command"]
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise FormatError(f"{path}: not records of kpbench ({error!r}); write it with kpbench --out") from error
        records += found
    return records


def names_in(document: Path) -> set[str]:
    """What a document has markers for.

    Raises:
        FormatError: they are not pairs, or name something else.
    """
    text, known = document.read_text(), {*TITLES, "glance"}
    names = [name for _, name, _, _ in MARKED.findall(text)]
    if (
        not names
        or len(MARKER.findall(text)) != 2 * len(names)
        or len({*names}) < len(names)
        or not known.issuperset(names)
    ):
        raise FormatError(
            f"{document}: needs lines such as <!-- encode: begin --> and <!-- encode: end -->, a pair a name of {sorted(known)}"
        )
    return {*names}


def written(text: str, records: Sequence[Record]) -> str:
    """A document with the tables of each kind of record, and what is seen at a glance, between the markers of that name."""
    shown = [record for record in records if is_brief(record)]

    def filled(found: re.Match[str]) -> str:
        name = found[2]
        return f"{found[1]}\n\n{glance(shown) if name == 'glance' else tables(name, shown)}\n\n{found[4]}"

    return MARKED.sub(filled, text)


def main(argv: list[str] | None = None) -> int:
    return cli.run(_command, "results", argv)


def _command(argv: list[str]) -> None:
    parser = argparse.ArgumentParser("results", description="Tables of benchmark records, as Markdown.")
    parser.add_argument("records", type=Path, nargs="+", help="files that kpbench --out wrote")
    parser.add_argument(
        "--into",
        type=Path,
        nargs="+",
        default=[],
        help="rewrite those between these files' markers instead of printing",
    )
    options = parser.parse_args(argv)
    records = load(options.records)
    if not options.into:
        print(markdown(records))
        return
    missing = {record["kind"] for record in records}.difference(*map(names_in, options.into))
    if missing:
        raise FormatError(f"{', '.join(map(str, options.into))}: no place for tables of {', '.join(sorted(missing))}")
    for document in options.into:
        text = written(document.read_text(), records)
        with cli.atomic_write(document) as aside:
            aside.write_text(text)
        print(document)


if __name__ == "__main__":
    sys.exit(main())
