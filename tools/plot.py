"""Quality and size against seconds of training, drawn from the records of `kpbench curve`.

python -m kpc.tools.plot docs/bench/curve.json -o docs/curve.svg

One panel for each of PSNR, SSIM and file size; a line for each dataset and preset goes through the medians of its repeats,
which are dots. Time runs on a logarithmic axis. The ending of the name chooses SVG, PNG or PDF. Needs kpc[bench].
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from matplotlib import rcParams
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from kpc.format import cli
from kpc.format.errors import FormatError, UsageError
from kpc.tools import results

PANELS = (("test_psnr", "held-out PSNR, dB", 1.0), ("test_ssim", "held-out SSIM", 1.0), ("size_bytes", "file, KB", 1e3))
"""Keys of a repeat, what they are, and their units."""
ENDINGS = (".svg", ".png", ".pdf")
PANEL_INCHES = (3.6, 3.2)

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
        axes.set(xscale="log", xlabel="training, minutes", title=title)
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda minutes, _: f"{minutes:g}"))
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.grid(color="0.87")
    axes.legend()
    return figure


def _dots(line: Sequence[results.Record], key: str) -> list[tuple[float, float]]:
    """Seconds and values of all repeats that have both."""
    runs = (run for record in line for run in record["repeats"])
    return [(run["train_s"], run[key]) for run in runs if run.get("train_s") and run.get(key) is not None]


def main(argv: list[str] | None = None) -> int:
    return cli.run(_command, "plot", argv)


def _command(argv: list[str]) -> None:
    parser = argparse.ArgumentParser("plot", description="Quality and size against seconds of training.")
    parser.add_argument("records", type=Path, nargs="+", help="files that kpbench curve --out wrote")
    parser.add_argument("-o", "--output", type=Path, required=True, help="the .svg, .png or .pdf file to write")
    options = parser.parse_args(argv)
    kind = options.output.suffix.lower()
    if kind not in ENDINGS:
        raise UsageError(f"{options.output}: plots are {', '.join(ENDINGS)}")
    figure = curves(results.load(options.records))
    with cli.written_aside(options.output) as aside:
        figure.savefig(aside, format=kind[1:], metadata={"Date": None} if kind == ".svg" else None)
    print(options.output)


if __name__ == "__main__":
    sys.exit(main())
