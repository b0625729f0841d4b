"""Quality and size against seconds of training, from records of `kpbench curve`; rate against distortion, from `kpbench codec`;
PSNR frame by frame, from `kpbench groups`; milliseconds a frame against nearness to the reference, from `kpbench player`.

python -m kpc.tools.bench.plot docs/bench/curve.json -o docs/curve.svg
python -m kpc.tools.bench.plot docs/bench/codec.json -o docs/codec.svg
python -m kpc.tools.bench.plot docs/bench/groups.json -o docs/groups.svg
python -m kpc.tools.bench.plot docs/bench/player.json -o docs/player.svg

Of training: one panel for each of PSNR, SSIM and file size; a line for each dataset and preset goes through the medians of its repeats,
which are dots. Time runs on a logarithmic axis. The ending of the name chooses SVG, PNG or PDF. Needs kpc[bench].
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from kpc.format.common import cli
from kpc.format.common.errors import FormatError, UsageError
from kpc.tools.bench import results
from matplotlib import rcParams
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

PANELS = (("test_psnr", "held-out PSNR, dB", 1.0), ("test_ssim", "held-out SSIM", 1.0), ("size_bytes", "file, KB", 1e3))
"""Keys of a repeat, what they are, and their units."""
ENDINGS = (".svg", ".png", ".pdf")
PANEL_INCHES = (3.6, 3.2)
RATE_PANEL_INCHES = (4.6, 4.0)
DASHES = ("-", "--", ":", "-.", (0, (1, 3)))
"""Of our own coder, whole and with something left out, in one colour."""
DEEPEST_DB = 3.5
"""Of loss that is drawn; kpbench codec compares down to 3 dB."""

rcParams["svg.fonttype"] = "none"  # text stays text
rcParams["svg.hashsalt"] = "kpc"  # the same records give the same file


def curves(records: Sequence[results.Record]) -> Figure:
    """The plot of records of `kpbench curve`; a panel for which no run has a value is left out.

    Raises:
        FormatError: there is nothing to draw.
    """
    lines: dict[str, list[results.Record]] = {}
    for record in records:
        if record["kind"] == "curve":
            lines.setdefault(f"{record['name']}, {record['settings']['preset']}", []).append(record)
    panels = [panel for panel in PANELS if any(_dots(line, panel[0]) for line in lines.values())]
    if not panels:
        raise FormatError("no records of kpbench curve to draw; write some with kpbench curve --out")
    width, height = PANEL_INCHES
    figure = Figure(figsize=(width * len(panels), height), layout="constrained")
    for axes, (key, title, unit) in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels):
        for number, (name, line) in enumerate(lines.items()):
            dots = [(seconds / 60, value / unit) for seconds, value in _dots(line, key)]
            medians = sorted((results.median(record, "train_s"), results.median(record, key)) for record in line
                             if _dots([record], key))  # fmt: skip
            axes.plot([s / 60 for s, _ in medians], [v / unit for _, v in medians], color=f"C{number}", label=name)
            axes.plot(*zip(*dots), "o", markersize=4, color=f"C{number}") if dots else None
        axes.set(xlabel="training, minutes", title=title)
        _logarithmic(axes)
    axes.legend()
    return figure


def rate_distortion(records: Sequence[results.Record]) -> Figure:
    """The plot of records of `kpbench codec`: a panel a scene, PSNR against bits per parameter, a line a coder, down to DEEPEST_DB below
    the best.

    Raises:
        FormatError: there is nothing to draw.
    """
    scenes: dict[str, list[results.Record]] = {}
    for record in records:
        if record["kind"] == "codec" and record["points"]:
            scenes.setdefault(record["name"], []).append(record)
    if not scenes:
        raise FormatError("no records of kpbench codec to draw; write some with kpbench codec --out")
    names = list(dict.fromkeys(record["coder"] for coders in scenes.values() for record in coders))
    ours = [name for name in names if results.is_ours(name)]
    looks = {name: {"color": "C0", "linestyle": DASHES[number % len(DASHES)]} for number, name in enumerate(ours)}
    looks |= {name: {"color": f"C{1 + number}"} for number, name in enumerate(n for n in names if n not in ours)}
    lines = {}
    width, height = RATE_PANEL_INCHES
    figure = Figure(figsize=(width * len(scenes), height), layout="constrained")
    for axes, (name, coders) in zip(figure.subplots(1, len(scenes), squeeze=False)[0], scenes.items()):
        for record in coders:
            points = sorted(record["points"], key=lambda point: float(point["size_bytes"]))
            is_whole = record["coder"] == "kpc"
            lines[record["coder"]], = axes.plot(
                [p["bits_per_parameter"] for p in points], [p["psnr"] for p in points], marker="o", markersize=3,
                linewidth=2.2 if is_whole else 1, zorder=3 if is_whole else 2, **looks[record["coder"]])  # fmt: skip
        best = max(p["psnr"] for record in coders for p in record["points"])
        axes.set(xlabel="bits per parameter", ylabel="PSNR, dB", title=name, ylim=(best - DEEPEST_DB, best + 0.1))
        _logarithmic(axes)
    axes.legend([lines[name] for name in names], names, fontsize=8)
    return figure


def per_frame(records: Sequence[results.Record]) -> Figure:
    """The plot of records of `kpbench groups`: a panel a clip, held-out PSNR of each frame, and how much its error changed from the
    frame before; groups join at the upright lines.

    Raises:
        FormatError: there is nothing to draw.
    """
    clips = [record for record in records if record["kind"] == "groups" and record["frames"]]
    if not clips:
        raise FormatError("no records of kpbench groups to draw; write some with kpbench groups --out")
    width, height = RATE_PANEL_INCHES
    figure = Figure(figsize=(2 * width * len(clips), 1.5 * height), layout="constrained")
    for column, record in zip(figure.subplots(2, len(clips), squeeze=False, sharex="col").T, clips):
        for camera in sorted({frame["camera"] for frame in record["frames"]}):
            frames = [frame for frame in record["frames"] if frame["camera"] == camera]
            column[0].plot([f["frame"] for f in frames], [f["psnr"] for f in frames], label=camera)
            changed = [f for f in frames if f["change"] is not None]
            column[1].plot([f["frame"] for f in changed], [255 * f["change"] for f in changed])
        for axes, title in zip(column, ("held-out PSNR, dB", "change of the error from frame to frame, 8-bit levels")):
            for join in record["joins"]:
                axes.axvline(join["frame"] - 0.5, color="0.6", linestyle="--", linewidth=1)
            axes.set(title=f"{record['name']}: {title}")
            axes.grid(color="0.87")
        column[0].legend()
        column[1].set(xlabel="frame", ylim=(0, None))
    return figure


def qualities(records: Sequence[results.Record]) -> Figure:
    """The plot of records of `kpbench player`: PSNR to the reference against milliseconds a frame, a line for each scene and size
    through the rungs of the ladder, the default ringed. The reference itself is left out.

    Raises:
        FormatError: there is nothing to draw.
    """
    lines: dict[str, list[tuple[float, float, bool]]] = {}
    for record in records:
        if record["kind"] == "player" and record["settings"]["quality"] != "reference":
            settings = record["settings"]
            lines.setdefault(f"{record['name']}, {settings['size']}", []).append(
                (
                    results.median(record, "frame_ms_median") or 0.0,
                    record["accuracy"]["psnr"],
                    settings["quality"] == settings["default"],
                )
            )
    if not lines:
        raise FormatError("no records of kpbench player to draw; write some with kpbench player --out")
    figure = Figure(figsize=RATE_PANEL_INCHES, layout="constrained")
    axes = figure.subplots()
    for number, (name, points) in enumerate(lines.items()):
        axes.plot(
            [ms for ms, *_ in points],
            [psnr for _, psnr, _ in points],
            marker="o",
            markersize=3,
            color=f"C{number}",
            label=name,
        )
        axes.plot(*zip(*[(ms, psnr) for ms, psnr, default in points if default]), "o", markersize=9, markerfacecolor="none",
                  color=f"C{number}")  # fmt: skip
    axes.set(xlabel="milliseconds a frame", ylabel="PSNR to the reference, dB")
    _logarithmic(axes)
    axes.legend(fontsize=8)
    return figure


def _logarithmic(axes: Axes) -> None:
    """Along x, with plain numbers at 1, 2 and 5; and a grid."""
    axes.set(xscale="log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.grid(color="0.87")


def save(figure: Figure, path: Path) -> None:
    """Write a plot as its ending says.

    Raises:
        UsageError: the ending is of no kind that can be written.
    """
    kind = path.suffix.lower()
    if kind not in ENDINGS:
        raise UsageError(f"{path}: plots are {', '.join(ENDINGS)}")
    with cli.atomic_write(path) as aside:
        figure.savefig(aside, format=kind[1:], metadata={"Date": None} if kind == ".svg" else None)


def _dots(line: Sequence[results.Record], key: str) -> list[tuple[float, float]]:
    """Seconds and values of all repeats that have both."""
    runs = (run for record in line for run in record["repeats"])
    return [(run["train_s"], run[key]) for run in runs if run.get("train_s") and run.get(key) is not None]


def main(argv: list[str] | None = None) -> int:
    return cli.run(_command, "plot", argv)


def _command(argv: list[str]) -> None:
    parser = argparse.ArgumentParser(
        "plot", description="Quality and size against training, rate against distortion, or time against truth."
    )
    parser.add_argument(
        "records", type=Path, nargs="+", help="files that kpbench curve, codec, groups or player --out wrote"
    )
    parser.add_argument("-o", "--output", type=Path, required=True, help="the .svg, .png or .pdf file to write")
    options = parser.parse_args(argv)
    records = results.load(options.records)
    draw = {"codec": rate_distortion, "groups": per_frame, "player": qualities}.get(
        records[0]["kind"] if records else "", curves
    )
    save(draw(records), options.output)
    print(options.output)


if __name__ == "__main__":
    sys.exit(main())
