"""Tables of benchmark records: their columns by kind of record, as plain text or as Markdown.

A cell is the median over the repeats of a run.
"""

import statistics
import textwrap
from collections.abc import Callable, Iterable, Sequence

from kpc.tools.bench.records import Record, median

Cell = Callable[[Record], str]
Column = tuple[str, Cell]
Table = list[list[str]]

# Losses of PSNR on held-out views at which coders are compared.
LOSSES_DB = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0)

# The size of picture whose frame rate the summary shows.
SUMMARY_SIZE = "640x480"


def is_ours(coder: str) -> bool:
    """Return whether `coder` is KPC's own, complete or with something left out."""
    return coder.startswith("kpc")


# --- cells


def _number(key: str, text: str, unit: float = 1.0) -> Cell:
    """Show the median of `key` in multiples of `unit`, formatted by `text`."""

    def cell(record: Record) -> str:
        value = median(record, key)
        return "-" if value is None else text.format(value / unit)

    return cell


def _accuracy(key: str, text: str, unit: float = 1.0) -> Cell:
    return lambda record: text.format(record["accuracy"][key] / unit) if key in record["accuracy"] else "-"


def _ratio(key: str, other: str, text: str, unit: float = 1.0) -> Cell:
    def cell(record: Record) -> str:
        value, against = median(record, key), median(record, other)
        return "-" if value is None or not against else text.format(value / against / unit)

    return cell


def _nested(record: Record, group: str, key: str) -> float:
    """Return the median of `key` in the object `group` of each repeat."""
    return statistics.median(repeat[group][key] for repeat in record["repeats"])


def _part(name: str) -> Cell:
    """Show the milliseconds of one part of a training step."""
    return lambda record: f"{1e3 * _nested(record, 'parts_s', name):.1f}"


def _limit(name: str) -> Cell:
    return lambda record: f"{_nested(record, 'limits', name):.0f}"


def _against(key: str, limit: str) -> Cell:
    """Show what was reached and what the machine can reach."""
    return lambda record: f"{median(record, key):.0f} of {_nested(record, 'limits', limit):.0f}"


def _name(record: Record) -> str:
    return str(record["name"])


def _setting(key: str, text: str = "{}") -> Cell:
    return lambda record: text.format(record["settings"][key])


def _preset(record: Record) -> str:
    """Show the preset, and the target PSNR where one was given."""
    psnr = record["settings"].get("psnr_db")
    return str(record["settings"]["preset"]) + ("" if psnr is None else f", --psnr {psnr:g}")


def _quality(record: Record) -> str:
    settings = record["settings"]
    return str(settings["quality"]) + " (default)" * (settings["quality"] == settings["default_quality"])


def _prefixes(record: Record) -> str:
    """Show all prefixes but the last, which is the whole file."""
    size = record["prefixes"][-1]["bytes"]
    return ", ".join(f"{prefix['bytes'] / size:.0%}: {prefix['psnr']:.1f}" for prefix in record["prefixes"][:-1])


def _joins(record: Record) -> str:
    """Show each join of two groups, changes of the error in 8-bit levels."""
    return "; ".join(
        f"{join['psnr_before']:.1f}, {join['psnr_after']:.1f}; {255 * join['error_change']:.1f}"
        for join in record["joins"]
    )


def _typical_change(record: Record) -> str:
    joins = record["joins"]
    return f"{255 * joins[0]['median_error_change']:.1f}, {255 * joins[0]['p95_error_change']:.1f}" if joins else "-"


def _by_shader(record: Record) -> str:
    """Show the frame time by fragment and by compute shaders, where both were measured."""
    times = [median(record, f"{shader}_ms_median") for shader in ("fragment", "compute")]
    return "-" if None in times else ", ".join(f"{time:.1f}" for time in times)


def _savings(record: Record) -> str:
    """Show by how much KPC is smaller at equal PSNR, on average over the curve: the whole file, and the planes."""
    if record.get("missing"):
        return str(record["missing"])
    rates = [record["bd_rate"], record.get("bd_rate_planes")]
    return ", ".join(f"{-rate:.0%}" for rate in rates if rate is not None) or "-"


def _shares(record: Record) -> str:
    """Show the share of each kind of chunk, the largest first."""
    shares: dict[str, float] = record["repeats"][0].get("shares") or {}
    largest = sorted(shares.items(), key=lambda share: -share[1])
    return ", ".join(f"{kind} {share:.0%}" for kind, share in largest if share >= 0.01) or "-"


# --- columns

_ENCODED: list[Column] = [
    ("dataset", _name),
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
        ("total", _number("encode_s", "{:.0f} s")),
        ("rays/s", _number("rays_per_s", "{:,.0f}")),
        ("peak MB", _number("peak_memory_bytes", "{:.0f}", 1e6)),
    ],
    "curve": [
        *_ENCODED,
        ("training", _number("train_s", "{:.0f} s")),
        ("total", _number("encode_s", "{:.0f} s")),
        ("steps", _number("steps", "{:,.0f}")),
    ],
    "ablate": [
        _ENCODED[0],
        ("variant", _setting("ablation")),
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
        ("speedup", _ratio("rays_per_s", "plain_rays_per_s", "{:.0f}x")),
        ("ms per step", _number("step_s", "{:.1f}", 1e-3)),
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
        ("ms per step", _number("step_s", "{:.1f}", 1e-3)),
        ("GB per step", _number("bytes", "{:.1f}", 1e9)),
        ("lower bound", _number("least_bytes", "{:.1f}", 1e9)),
        ("GB/s", _ratio("bytes", "step_s", "{:.0f}", 1e9)),
        ("copying GB/s", _number("memory_gb_s", "{:.0f}")),
        ("ratio", _number("share_of_memory", "{:.0%}")),
        ("GPU memory GB", _number("gpu_memory_bytes", "{:.1f}", 1e9)),
    ],
    "player": [
        ("scene", _name),
        ("quality", _quality),
        ("size", _setting("size")),
        ("first frame ms", _number("first_frame_ms", "{:.0f}")),
        ("median ms", _number("frame_ms_median", "{:.1f}")),
        ("p95 ms", _number("frame_ms_p95", "{:.1f}")),
        ("CPU ms", _number("cpu_ms_median", "{:.1f}")),
        ("fps", _number("fps", "{:.1f}")),
        ("fragment, compute ms", _by_shader),
        ("G texels", _number("texels_per_frame", "{:.2f}", 1e9)),
        ("of peak texel rate", _number("share_of_texel_rate", "{:.0%}")),
        ("speedup", _number("speedup_over_reference", "{:.1f}x")),
        ("samples/ray", _accuracy("samples_per_ray", "{:.1f}")),
        ("textures MB", _number("gpu_memory_bytes", "{:.1f}", 1e6)),
        ("peak MB", _number("peak_memory_bytes", "{:.0f}", 1e6)),
        ("PSNR to reference dB", _accuracy("psnr", "{:.1f}")),
        ("worst frame", _accuracy("psnr_min", "{:.1f}")),
        ("moving camera", _accuracy("psnr_moving", "{:.1f}")),
        ("within 1/255", _accuracy("within_one_level", "{:.2%}")),
        ("folding only: worst frame dB", _accuracy("folding_psnr", "{:.1f}")),
        ("largest error of 255", _accuracy("folding_max_error", "{:.0f}", 1 / 255)),
    ],
    "stream": [
        ("scene", _name),
        ("file KB", _number("size_bytes", "{:.0f}", 1e3)),
        ("first picture from disk ms", _number("disk_first_picture_ms", "{:.0f}")),
        ("link", lambda r: f"{r['settings']['rate']}, {r['settings']['delay']}"),
        ("first picture ms", _number("network_first_picture_ms", "{:.0f}")),
        ("after KB", _number("network_first_picture_bytes", "{:.0f}", 1e3)),
        ("full detail ms", _number("network_full_detail_ms", "{:.0f}")),
        ("complete ms", _number("network_complete_ms", "{:.0f}")),
        ("seek ms", _number("seek_ms", "{:.0f}")),
        ("of which waiting", _number("seek_wait_ms", "{:.0f}")),
        ("share of the file: PSNR to the whole", _prefixes),
    ],
    "steady": [
        ("scene", _name),
        ("window", _setting("size")),
        ("frames", _setting("frames", "{:,}")),
        ("fps", _number("fps", "{:.0f}")),
        ("GPU objects created", _number("gpu_objects_created", "{:.0f}")),
        ("MB at start", _number("first_bytes", "{:.1f}", 1e6)),
        ("MB at end", _number("last_bytes", "{:.1f}", 1e6)),
        ("KB per 1,000 frames", _number("bytes_per_1000_frames", "{:.1f}", 1e3)),
    ],
    "window": [
        ("scene", _name),
        ("window", _setting("size")),
        ("degrees/s", _setting("turn", "{:g}")),
        ("fps", _number("fps", "{:.0f}")),
        ("p95 ms", _number("frame_ms_p95", "{:.0f}")),
        ("raster", lambda r: r["repeats"][0]["raster"]),
        ("raster changes/min", _number("raster_changes_per_minute", "{:.0f}")),
        ("PSNR to reference dB", _number("psnr", "{:.1f}")),
        ("worst frame", _number("psnr_min", "{:.1f}")),
    ],
    "web": [
        ("scene", _name),
        ("size", _setting("size")),
        ("quality", _setting("quality")),
        ("raster", lambda r: r["repeats"][0]["raster"]),
        ("samples/ray", _number("samples_per_ray", "{:.1f}")),
        ("cells/ray", _number("cells_per_ray", "{:.1f}")),
        ("texels/pixel", _number("texels_per_pixel", "{:.0f}")),
        ("M look-ups", _number("look_ups", "{:.1f}", 1e6)),
        ("MB", _number("bytes", "{:.0f}", 1e6)),
        ("PSNR to reference dB", _number("psnr", "{:.1f}")),
        ("when still", _number("psnr_still", "{:.1f}")),
        ("fps at 5 G/s", _number("phone_fps", "{:.0f}")),
        ("10 G/s", _number("integrated_fps", "{:.0f}")),
        ("100 G/s", _number("card_fps", "{:.0f}")),
        ("auto's choice on", lambda r: ", ".join(r["repeats"][0]["chosen_on"]) or "-"),
        ("software: CPU ms", _number("cpu_ms", "{:.0f}")),
        ("fps", _number("software_fps", "{:.1f}")),
    ],
    "webload": [
        ("scene", _name),
        ("player", _setting("player")),
        ("shows", _setting("shows")),
        ("scene KB", _number("scene_bytes", "{:.0f}", 1e3)),
        ("all KB", _number("bytes", "{:.0f}", 1e3)),
        ("first picture ms", _number("first_picture_ms", "{:.0f}")),
        ("longest task ms", _number("longest_task_ms", "{:.0f}")),
        ("of the processor", _number("longest_task_cpu_ms", "{:.0f}")),
        ("fps", _number("fps", "{:.1f}")),
        ("load of the machine", lambda r: f"{r['load_average']:.1f}"),
    ],
    "codec": [
        ("scene", _name),
        ("coder", lambda r: r["coder"]),
        ("KB at 0.15 dB loss", _number("size_at_default_loss", "{:.0f}", 1e3)),
        ("kpc is smaller by, its planes by", _savings),
        ("nearest setting: KB", _number("size_bytes", "{:.0f}", 1e3)),
        ("bits/param", _number("bits_per_parameter", "{:.2f}")),
        ("PSNR loss dB", _number("loss_db", "{:.2f}")),
        ("encode s", _number("encode_s", "{:.1f}")),
        ("decode s", _number("decode_s", "{:.2f}")),
        ("chunks", _shares),
    ],
    "groups": [
        ("dataset", _name),
        ("preset", _setting("preset")),
        ("group length", _setting("group_s", "{:g} s")),
        ("groups", _number("groups", "{:.0f}")),
        ("file KB", _number("size_bytes", "{:.0f}", 1e3)),
        ("PSNR dB", _number("test_psnr", "{:.2f}")),
        ("encoded in s", _number("encode_s", "{:.0f}")),
        ("peak MB, one group", _number("first_group_peak_memory_bytes", "{:.0f}", 1e6)),
        ("peak MB, all", _number("peak_memory_bytes", "{:.0f}", 1e6)),
        ("joins: PSNR before, after; error change", _joins),
        ("other frames: median, 95th percentile", _typical_change),
    ],
    "entropy": [
        ("scene", _name),
        ("variant", _setting("variant")),
        ("planes KB", _number("plane_bytes", "{:.1f}", 1e3)),
        ("decoding ms", _number("decode_ms", "{:.0f}")),
        ("file KB", _number("file_bytes", "{:.1f}", 1e3)),
        ("reading ms", _number("read_ms", "{:.0f}")),
    ],
    "decode": [
        ("scene", _name),
        ("segments", _number("segments", "{:.0f}")),
        ("symbols", _number("symbols", "{:.0f}")),
        ("one thread ms", _number("decode_ms", "{:.1f}")),
        ("two threads ms", _number("two_threads_ms", "{:.1f}")),
        ("slowest segment ms", _number("slowest_segment_ms", "{:.1f}")),
    ],
}

# Columns of the table that kpbench prints, which is to fit a terminal; all others are in its JSON.
PRINTED: dict[str, tuple[str, ...]] = {
    "encode": ("dataset", "preset", "PSNR dB", "file KB", "training", "total"),
    "curve": ("dataset", "preset", "PSNR dB", "file KB", "training", "total"),
    "ablate": ("dataset", "variant", "PSNR dB", "SSIM", "file KB", "training"),
    "step": ("dataset", "preset", "rays/s", "speedup", "ms per step", "peak MB"),
    "gpu": ("dataset", "preset", "rays/s", "ms per step", "ratio", "GPU memory GB"),
    "player": ("scene", "quality", "size", "median ms", "fps", "PSNR to reference dB"),
    "stream": ("scene", "file KB", "link", "first picture ms", "complete ms", "seek ms"),
    "steady": ("scene", "window", "frames", "fps", "MB at start", "MB at end"),
    "window": ("scene", "window", "fps", "p95 ms", "raster", "PSNR to reference dB"),
    "web": ("scene", "size", "quality", "raster", "M look-ups", "PSNR to reference dB"),
    "webload": ("scene", "player", "all KB", "first picture ms", "longest task ms", "fps"),
    "codec": ("scene", "coder", "KB at 0.15 dB loss", "PSNR loss dB", "encode s", "decode s"),
    "groups": ("dataset", "groups", "file KB", "PSNR dB", "encoded in s", "peak MB, all"),
    "entropy": ("scene", "variant", "planes KB", "decoding ms", "file KB", "reading ms"),
    "decode": ("scene", "segments", "symbols", "one thread ms", "two threads ms", "slowest segment ms"),
}
PRINTED_NAME = 22  # characters of a cell that are printed; names of datasets may be longer

TITLES = {
    "encode": "Encoding",
    "curve": "Encoding, quality against time",
    "ablate": "Encoding, ablations",
    "step": "A training step",
    "gpu": "A training step",
    "player": "Playing",
    "stream": "Playing while loading",
    "groups": "A clip in groups",
    "window": "Playing in a window with quality control",
    "steady": "Long playback with all panels open",
    "web": "Drawing in a browser",
    "webload": "Loading in a browser",
    "codec": "Coding, beside general-purpose codecs",
    "entropy": "Entropy coding of planes, ablations, on one core",
    "decode": "Decoding by the decoder core",
}


# --- tables


def cells(kind: str, records: Iterable[Record]) -> Table:
    """Return heading and rows of the table of one kind of record."""
    columns = COLUMNS[kind]
    return [[name for name, _ in columns]] + [[cell(record) for _, cell in columns] for record in records]


def printed(kind: str, records: Sequence[Record]) -> str:
    """Return the table of one kind of record with the columns PRINTED, as text for a terminal of 100 characters."""
    table = list(zip(*cells(kind, records), strict=True))
    return aligned(list(zip(*(column for column in table if column[0] in PRINTED[kind]), strict=True)))


def aligned(table: Sequence[Sequence[str]]) -> str:
    """Return a table as text for a terminal; cells longer than PRINTED_NAME are cut."""
    table = [[text if len(text) <= PRINTED_NAME else f"{text[: PRINTED_NAME - 1]}…" for text in row] for row in table]
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    return "\n".join(
        "  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip() for row in table
    )


def markdown(records: Sequence[Record]) -> str:
    """Return the tables of all records, one for each kind and machine, each with where its numbers come from."""
    return "\n\n".join(tables(kind, records) for kind in TITLES if any(record["kind"] == kind for record in records))


def tables(kind: str, records: Iterable[Record]) -> str:
    """Return the tables of one kind of record in Markdown, one for each machine."""
    parts, of_kind = [], [record for record in records if record["kind"] == kind]
    for machine in dict.fromkeys(map(machine_name, of_kind)):
        rows = [record for record in of_kind if machine_name(record) == machine]
        parts += [f"**{TITLES[kind]}** on {machine}:", _as_markdown(cells(kind, rows))]
        if kind == "codec":
            parts.append("Size at equal loss, and how much smaller it is than the smallest general-purpose codec:")
            parts.append(_as_markdown(loss_table(rows)))
            parts.append("Size and PSNR loss by `--quality`:")
            parts.append(_as_markdown(_quality_table(rows)))
        runs = sorted({len(record["repeats"]) for record in rows})
        commits = ", ".join(dict.fromkeys(_short(record["commit"]) for record in rows))
        commands = "; ".join(dict.fromkeys(f"`{record['command']}`" for record in rows))
        source = f"Commit {commits}; median of {' or '.join(map(str, runs))} run{'s' * (runs != [1])}; {commands}."
        parts.append(textwrap.fill(source, 120, break_long_words=False, break_on_hyphens=False))
    return "\n\n".join(parts)


def glance(records: Sequence[Record]) -> str:
    """Return a summary in Markdown, a row a scene: its encoding, and how fast a software renderer plays it.

    A scene played from the file NAME-PRESET.kpc belongs to the encoding of dataset NAME by that preset.
    """
    encoded = {
        f"{record['name']}-{record['settings']['preset']}": record
        for record in records
        if record["kind"] == "encode" and record["settings"].get("psnr_db") is None
    }
    played = {record["name"]: record for record in records if _is_summary_playback(record)}
    minutes, fps, psnr = _number("encode_s", "{:.0f}", 60.0), _number("fps", "{:.0f}"), _accuracy("psnr", "{:.0f}")
    rows = []
    for name in played:
        if name in encoded:
            encoding, playback = encoded[name], played[name]
            row = [cell(encoding) for _, cell in _ENCODED]
            row += [minutes(encoding), str(encoding["machine"]["cores"]), fps(playback), psnr(playback)]
            rows.append(row)
    head = [name for name, _ in _ENCODED]
    head += ["encoded in minutes", "on cores", f"fps at {SUMMARY_SIZE}", "PSNR to reference dB"]
    return _as_markdown([head, *rows])


def _is_summary_playback(record: Record) -> bool:
    if record["kind"] != "player" or record["settings"]["size"] != SUMMARY_SIZE:
        return False
    return record["settings"]["quality"] == record["settings"]["default_quality"] and "llvmpipe" in record["renderer"]


def _quality_table(records: Iterable[Record]) -> Table:
    """Return size and loss of KPC's coder at each `--quality`."""
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


def loss_table(records: Sequence[Record]) -> Table:
    """Return KPC's size at each of LOSSES_DB, and how much smaller it is than the smallest of the other coders."""
    from kpc.tools.bench.rd_curves import size_at  # needs SciPy, which no other table does

    rows = []
    for name in dict.fromkeys(record["name"] for record in records):
        points = {record["coder"]: record["points"] for record in records if record["name"] == name}
        row = [name]
        for loss in LOSSES_DB:
            ours = size_at(points.get("kpc", []), loss)
            sizes = {coder: size for coder in points if not is_ours(coder) and (size := size_at(points[coder], loss))}
            best = min(sizes, key=lambda coder: sizes[coder], default=None)
            saved = f", {1 - ours / sizes[best]:.0%} ({best})" if ours is not None and best else ""
            row.append("-" if ours is None else f"{ours / 1e3:.0f} KB{saved}")
        rows.append(row)
    return [["scene", *(f"{loss:g} dB" for loss in LOSSES_DB)], *rows]


def _as_markdown(table: Table) -> str:
    head, *rows = table
    return "\n".join(f"| {' | '.join(line)} |" for line in [head, ["---"] * len(head), *rows])


def machine_name(record: Record) -> str:
    """Return the processor of a record, and the graphics card or software renderer where one was used."""
    machine = record["machine"]
    processor = f"{machine['cpu']}, {machine['cores']} cores, {machine['memory_bytes'] / 2**30:.0f} GiB"
    return processor if record["renderer"] == "cpu" else f"{record['renderer']} ({processor})"


def _short(commit: str) -> str:
    digits, plus, dirty = commit.partition("+")
    return digits[:9] + plus + dirty
