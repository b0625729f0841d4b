"""Quality and size against seconds of training, drawn as SVG from the records of `kpbench curve`.

python -m kpc.tools.plot docs/bench/curve.json -o docs/curve.svg

One panel for each of PSNR, SSIM and file size; a line for each dataset and preset goes through the medians of its repeats,
which are dots. Time runs on a logarithmic axis. Text, not pixels: small, sharp at any size, and plain in a diff.
"""

import argparse
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

from kpc.format import cli
from kpc.format.errors import FormatError
from kpc.tools import results

WIDTH, HEIGHT = 270, 230
"""Of a panel's axes, in CSS pixels; MARGIN lies left of and below each, LINE is a line of text."""
MARGIN, LINE = 58, 16

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")
"""Told apart by colour-blind people, too (Okabe and Ito 2008)."""

STEPS = (1, 2, 5, 10)
"""Ticks are these multiples of a power of ten apart."""


@dataclass(frozen=True)
class Panel:
    """What is drawn: a key of the repeats, in multiples of `unit`."""

    key: str
    title: str
    unit: float = 1.0


PANELS = (Panel("test_psnr", "held-out PSNR, dB"), Panel("test_ssim", "held-out SSIM"), Panel("size_bytes", "file, KB", 1e3))


@dataclass(frozen=True)
class Axis:
    """Maps values to [0, 1]; `ticks` lie within."""

    low: float
    high: float
    ticks: tuple[float, ...]
    logarithmic: bool = False

    def at(self, value: float) -> float:
        low, high, value = (math.log(v) if self.logarithmic else v for v in (self.low, self.high, value))
        return (value - low) / (high - low)


def linear_axis(values: Sequence[float]) -> Axis:
    """Holds all values, from tick to tick; at most six of those, at round numbers."""
    low, high = min(values), max(values)
    span = (high - low) or abs(high) or 1.0
    power = 10.0 ** math.floor(math.log10(span / 5))
    step = next(power * n for n in STEPS if power * n >= span / 5 * (1 - 1e-9))
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    last = max(last, first + 1)
    return Axis(first * step, last * step, tuple(n * step for n in range(first, last + 1)))


def time_axis(seconds: Sequence[float]) -> Axis:
    """Holds all times on a logarithmic scale, with ticks at 1, 2 and 5 times powers of ten of minutes."""
    low, high = min(seconds) / 1.15, max(seconds) * 1.15
    powers = range(math.floor(math.log10(low / 60)), math.ceil(math.log10(high / 60)) + 1)
    ticks = (60 * n * 10.0**power for power in powers for n in STEPS[:3])
    return Axis(low, high, tuple(tick for tick in ticks if low <= tick <= high), logarithmic=True)


def svg(records: Sequence[results.Record]) -> str:
    """The plot of records of `kpbench curve`; a panel for which no run has a value is left out.

    Raises:
        FormatError: there is nothing to draw.
    """
    lines: dict[str, list[results.Record]] = {}
    for record in records:
        if record["kind"] == "curve":
            lines.setdefault(f"{record['name']}, {record['settings']['preset']}", []).append(record)
    runs = [run for line in lines.values() for record in line for run in record["repeats"]]
    runs = [run for run in runs if run.get("train_s")]
    panels = [panel for panel in PANELS if any(run.get(panel.key) is not None for run in runs)]
    if not panels:
        raise FormatError("no records of kpbench curve to draw; write some with kpbench curve --out")
    time = time_axis([run["train_s"] for run in runs])
    legend = LINE * (1 + len(lines))
    width, height = len(panels) * (MARGIN + WIDTH) + LINE, legend + LINE + HEIGHT + MARGIN
    parts = [f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}" '
             'font-family="sans-serif" font-size="12">', f'<rect width="{width}" height="{height}" fill="#fff"/>']  # fmt: skip
    for number, name in enumerate(lines):
        y, colour = LINE * (number + 1), COLOURS[number % len(COLOURS)]
        parts.append(f'<path d="M{MARGIN} {y}h24" stroke="{colour}" stroke-width="2"/>')
        parts.append(_text(MARGIN + 30, y + 4, name, "start"))
    for number, panel in enumerate(panels):
        parts += _panel(panel, lines, time, MARGIN + number * (MARGIN + WIDTH), legend + LINE)
    return "\n".join([*parts, "</svg>", ""])


def _panel(panel: Panel, lines: dict[str, list[results.Record]], time: Axis, left: int, top: int) -> list[str]:
    """Axes, ticks and lines; `left` and `top` are the corner of the axes."""
    bottom = top + HEIGHT
    dots = {
        name: [(run["train_s"], run[panel.key] / panel.unit) for record in line for run in record["repeats"]
               if run.get("train_s") and run.get(panel.key) is not None]
        for name, line in lines.items()
    }  # fmt: skip
    axis = linear_axis([value for line in dots.values() for _, value in line])

    def x(seconds: float) -> str:
        return f"{left + WIDTH * time.at(seconds):.1f}"

    def y(value: float) -> str:
        return f"{bottom - HEIGHT * axis.at(value):.1f}"

    parts = [_text(left + WIDTH / 2, top - 6, panel.title, "middle")]
    for tick in axis.ticks:
        parts.append(f'<path d="M{left} {y(tick)}h{WIDTH}" stroke="#ddd"/>')
        parts.append(_text(left - 6, float(y(tick)) + 4, f"{tick:.6g}", "end"))
    for tick in time.ticks:
        parts.append(f'<path d="M{x(tick)} {top}v{HEIGHT}" stroke="#ddd"/>')
        parts.append(_text(float(x(tick)), bottom + LINE, f"{tick / 60:.6g}", "middle"))
    parts.append(_text(left + WIDTH / 2, bottom + 2.2 * LINE, "training, minutes", "middle"))
    parts.append(f'<path d="M{left} {top}v{HEIGHT}h{WIDTH}" fill="none" stroke="#000"/>')
    for number, (name, line) in enumerate(lines.items()):
        colour = COLOURS[number % len(COLOURS)]
        medians = [(results.median(record, "train_s"), results.median(record, panel.key)) for record in line]
        corners = sorted((seconds, value / panel.unit) for seconds, value in medians if seconds and value is not None)
        path = " ".join(f"{x(seconds)},{y(value)}" for seconds, value in corners)
        parts.append(f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="2"/>')
        parts += [f'<circle cx="{x(seconds)}" cy="{y(value)}" r="3" fill="{colour}"/>' for seconds, value in dots[name]]
    return parts


def _text(x: float, y: float, text: str, anchor: str) -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(text)}</text>'


def main(argv: list[str] | None = None) -> int:
    return cli.run(_command, "plot", argv)


def _command(argv: list[str]) -> None:
    parser = argparse.ArgumentParser("plot", description="Quality and size against seconds of training, as SVG.")
    parser.add_argument("records", type=Path, nargs="+", help="files that kpbench curve --out wrote")
    parser.add_argument("-o", "--output", type=Path, required=True, help="the .svg file to write")
    options = parser.parse_args(argv)
    drawing = svg(results.load(options.records))
    with cli.written_aside(options.output) as aside:
        aside.write_text(drawing)
    print(options.output)


if __name__ == "__main__":
    sys.exit(main())
