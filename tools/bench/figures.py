"""Figures of benchmark records, by matplotlib."""

from collections.abc import Sequence
from pathlib import Path

from matplotlib import rcParams
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from kpc.format.common import cli
from kpc.format.common.errors import FormatError, UsageError
from kpc.tools.bench.records import Record, median
from kpc.tools.bench.tables import is_ours

# Panels of the training plot: the key of a repeat, the title, and the unit of the axis.
PANELS = (("test_psnr", "held-out PSNR, dB", 1.0), ("test_ssim", "held-out SSIM", 1.0), ("size_bytes", "file, KB", 1e3))

# Panels of the plot of quality: the key of a frame, the title, and what the axis multiplies it by.
MEASURES = (
    ("psnr", "PSNR, dB", 1.0),
    ("ssim", "SSIM", 1.0),
    ("flip", "FLIP error", 1.0),
    ("flicker", "flicker, 8-bit levels", 255.0),
)
PART_COLOURS = {"": "0.3", "moving_": "C1", "still_": "C0"}

SUFFIXES = (".svg", ".png", ".pdf")

PANEL_INCHES = (3.6, 3.2)
RATE_PANEL_INCHES = (4.6, 4.0)

# Line styles of KPC's own coder, complete and with parts left out; all of them have one colour.
DASHES = ("-", "--", ":", "-.", (0, (1, 3)))

# The rate-distortion plot shows losses down to this; `kpc.tools.bench.rd_curves` compares down to 3 dB.
DEEPEST_DB = 3.5

rcParams["svg.fonttype"] = "none"  # keep text as text
rcParams["svg.hashsalt"] = "kpc"  # the same records give the same file


def curves(records: Sequence[Record]) -> Figure:
    """Draw quality and size against training time from records of `kpbench curve`.

    There is a panel for each of PSNR, SSIM and file size for which some run has a value, and in it for each dataset
    and preset a line through the medians of the repeats, with a dot for each repeat.

    Raises:
        FormatError: there is nothing to draw.
    """
    lines: dict[str, list[Record]] = {}
    for record in records:
        if record["kind"] == "curve":
            lines.setdefault(f"{record['name']}, {record['settings']['preset']}", []).append(record)
    panels = [panel for panel in PANELS if any(_dots(line, panel[0]) for line in lines.values())]
    if not panels:
        raise FormatError("no records of kpbench curve to draw; write some with kpbench curve --out")
    width, height = PANEL_INCHES
    figure = Figure(figsize=(width * len(panels), height), layout="constrained")
    all_axes = figure.subplots(1, len(panels), squeeze=False)[0]
    for axes, (key, title, unit) in zip(all_axes, panels, strict=True):
        for number, (name, line) in enumerate(lines.items()):
            dots = [(seconds / 60, value / unit) for seconds, value in _dots(line, key)]
            measured = [record for record in line if _dots([record], key)]
            medians = sorted((median(record, "train_s") or 0.0, median(record, key) or 0.0) for record in measured)
            axes.plot([s / 60 for s, _ in medians], [v / unit for _, v in medians], color=f"C{number}", label=name)
            if dots:
                axes.plot(*zip(*dots, strict=True), "o", markersize=4, color=f"C{number}")
        axes.set(xlabel="training, minutes", title=title)
        _logarithmic(axes)
    axes.legend()
    return figure


def rate_distortion(records: Sequence[Record]) -> Figure:
    """Draw PSNR against bits per parameter from records of `kpbench codec`: a panel per scene, a line per coder.

    Raises:
        FormatError: there is nothing to draw.
    """
    scenes: dict[str, list[Record]] = {}
    for record in records:
        if record["kind"] == "codec" and record["points"]:
            scenes.setdefault(record["name"], []).append(record)
    if not scenes:
        raise FormatError("no records of kpbench codec to draw; write some with kpbench codec --out")
    names = list(dict.fromkeys(record["coder"] for coders in scenes.values() for record in coders))
    ours = [name for name in names if is_ours(name)]
    styles = {name: {"color": "C0", "linestyle": DASHES[number % len(DASHES)]} for number, name in enumerate(ours)}
    styles |= {name: {"color": f"C{1 + number}"} for number, name in enumerate(n for n in names if n not in ours)}
    lines = {}
    width, height = RATE_PANEL_INCHES
    figure = Figure(figsize=(width * len(scenes), height), layout="constrained")
    all_axes = figure.subplots(1, len(scenes), squeeze=False)[0]
    for axes, (name, coders) in zip(all_axes, scenes.items(), strict=True):
        for record in coders:
            points = sorted(record["points"], key=lambda point: float(point["size_bytes"]))
            is_complete = record["coder"] == "kpc"
            (lines[record["coder"]],) = axes.plot(
                [p["bits_per_parameter"] for p in points],
                [p["psnr"] for p in points],
                marker="o",
                markersize=3,
                linewidth=2.2 if is_complete else 1,
                zorder=3 if is_complete else 2,
                **styles[record["coder"]],
            )
        best = max(p["psnr"] for record in coders for p in record["points"])
        axes.set(xlabel="bits per parameter", ylabel="PSNR, dB", title=name, ylim=(best - DEEPEST_DB, best + 0.1))
        _logarithmic(axes)
    axes.legend([lines[name] for name in names], names, fontsize=8)
    return figure


def per_frame(records: Sequence[Record]) -> Figure:
    """Draw the held-out PSNR of each frame, and how much its error differs from that of the frame before.

    The records are those of `kpbench groups`; groups join at the vertical lines.

    Raises:
        FormatError: there is nothing to draw.
    """
    clips = [record for record in records if record["kind"] == "groups" and record["frames"]]
    if not clips:
        raise FormatError("no records of kpbench groups to draw; write some with kpbench groups --out")
    width, height = RATE_PANEL_INCHES
    figure = Figure(figsize=(2 * width * len(clips), 1.5 * height), layout="constrained")
    columns = figure.subplots(2, len(clips), squeeze=False, sharex="col").T
    titles = ("held-out PSNR, dB", "change of the error between frames, 8-bit levels")
    for column, record in zip(columns, clips, strict=True):
        for camera in sorted({frame["camera"] for frame in record["frames"]}):
            frames = [frame for frame in record["frames"] if frame["camera"] == camera]
            column[0].plot([f["frame"] for f in frames], [f["psnr"] for f in frames], label=camera)
            changed = [f for f in frames if f["error_change"] is not None]
            column[1].plot([f["frame"] for f in changed], [255 * f["error_change"] for f in changed])
        for axes, title in zip(column, titles, strict=True):
            for join in record["joins"]:
                axes.axvline(join["frame"] - 0.5, color="0.6", linestyle="--", linewidth=1)
            axes.set(title=f"{record['name']}: {title}")
            axes.grid(color="0.87")
        column[0].legend()
        column[1].set(xlabel="frame", ylim=(0, None))
    return figure


def fidelity(records: Sequence[Record]) -> Figure:
    """Draw each measure of each held-out picture from records of `kpbench quality`, moving and still pixels apart.

    There is a column for each scene. Pictures are counted along the axis where no camera has more than one.

    Raises:
        FormatError: there is nothing to draw.
    """
    scenes = [record for record in records if record["kind"] == "quality" and record["frames"]]
    if not scenes:
        raise FormatError("no records of kpbench quality to draw; write some with kpbench quality --out")
    width, height = PANEL_INCHES
    size = (1.5 * width * len(scenes), 0.7 * height * len(MEASURES))
    figure = Figure(figsize=size, layout="constrained")
    columns = figure.subplots(len(MEASURES), len(scenes), squeeze=False, sharex="col").T
    for column, record in zip(columns, scenes, strict=True):
        lines: dict[str, list[Record]] = {}
        for frame in record["frames"]:
            lines.setdefault(frame["camera"], []).append(frame)
        is_clip = any(len(line) > 1 for line in lines.values())
        series = list(lines.values()) if is_clip else [record["frames"]]
        for axes, (key, title, unit) in zip(column, MEASURES, strict=True):
            for part, label in (("", "all pixels"), ("moving_", "moving"), ("still_", "still")):
                for number, line in enumerate(series):
                    points = [
                        (frame["frame"] if is_clip else place, unit * frame[part + key])
                        for place, frame in enumerate(line)
                        if frame[part + key] is not None
                    ]
                    if points:
                        axes.plot(*zip(*points, strict=True), ".-", color=PART_COLOURS[part], linewidth=1, markersize=3)
                        axes.lines[-1].set_label(label if number == 0 else "_")
            axes.set(title=f"{record['name']}: {title}")
            axes.grid(color="0.87")
        column[0].legend(fontsize=8)
        column[-1].set(xlabel="frame" if is_clip else "picture")
    return figure


def quality_levels(records: Sequence[Record]) -> Figure:
    """Draw PSNR to the reference against frame time from records of `kpbench player`.

    There is a line for each scene and size through all quality levels but the reference; the default is ringed.

    Raises:
        FormatError: there is nothing to draw.
    """
    lines: dict[str, list[tuple[float, float, bool]]] = {}
    for record in records:
        if record["kind"] == "player" and record["settings"]["quality"] != "reference":
            settings = record["settings"]
            is_default = settings["quality"] == settings["default_quality"]
            point = (median(record, "frame_ms_median") or 0.0, record["accuracy"]["psnr"], is_default)
            lines.setdefault(f"{record['name']}, {settings['size']}", []).append(point)
    if not lines:
        raise FormatError("no records of kpbench player to draw; write some with kpbench player --out")
    figure = Figure(figsize=RATE_PANEL_INCHES, layout="constrained")
    axes = figure.subplots()
    for number, (name, points) in enumerate(lines.items()):
        times, psnrs, _ = zip(*points, strict=True)
        axes.plot(times, psnrs, marker="o", markersize=3, color=f"C{number}", label=name)
        for frame_ms, psnr, is_default in points:
            if is_default:
                axes.plot(frame_ms, psnr, "o", markersize=9, markerfacecolor="none", color=f"C{number}")
    axes.set(xlabel="milliseconds per frame", ylabel="PSNR to the reference, dB")
    _logarithmic(axes)
    axes.legend(fontsize=8)
    return figure


def _logarithmic(axes: Axes) -> None:
    """Make the x axis logarithmic, labelled at 1, 2 and 5 times powers of ten, and draw a grid."""
    axes.set(xscale="log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.grid(color="0.87")


def save(figure: Figure, path: Path) -> None:
    """Write a figure in the format that the suffix of `path` names.

    Raises:
        UsageError: it names no format of SUFFIXES.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise UsageError(f"{path}: plots are {', '.join(SUFFIXES)}")
    with cli.atomic_write(path) as aside:
        figure.savefig(aside, format=suffix[1:], metadata={"Date": None} if suffix == ".svg" else None)


def _dots(line: Sequence[Record], key: str) -> list[tuple[float, float]]:
    """Return seconds of training and value of all repeats that have both."""
    runs = (run for record in line for run in record["repeats"])
    return [(run["train_s"], run[key]) for run in runs if run.get("train_s") and run.get(key) is not None]
