"""Tables of benchmark records, as plain text or as Markdown; `kpc.tools.bench.columns` has their columns."""

import textwrap
from collections.abc import Iterable, Sequence

from kpc.tools.bench.columns import COLUMNS, ENCODED, PRINTED, TITLES, accuracy, number
from kpc.tools.bench.records import Record

Table = list[list[str]]

# Losses of PSNR on held-out views at which coders are compared.
LOSSES_DB = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0)

# The size of picture whose frame rate the summary shows.
SUMMARY_SIZE = "640x480"
# Characters of a cell that are printed; names of datasets may be longer.
PRINTED_NAME = 22


def is_ours(coder: str) -> bool:
    """Return whether `coder` is KPC's own, complete or with something left out."""
    return coder.startswith("kpc")


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
        commits = ", ".join(dict.fromkeys(short_commit(record["commit"]) for record in rows))
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
    minutes, fps, psnr = number("encode_s", "{:.0f}", 60.0), number("fps", "{:.0f}"), accuracy("psnr", "{:.0f}")
    rows = []
    for name in played:
        if name in encoded:
            encoding, playback = encoded[name], played[name]
            row = [cell(encoding) for _, cell in ENCODED]
            row += [minutes(encoding), str(encoding["machine"]["cores"]), fps(playback), psnr(playback)]
            rows.append(row)
    head = [name for name, _ in ENCODED]
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


def short_commit(commit: str) -> str:
    digits, plus, dirty = commit.partition("+")
    return digits[:9] + plus + dirty
