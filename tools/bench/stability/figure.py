"""Draw records of kpbench stability: a panel for each sweep, a line for each implementation."""

import math
from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

from kpc.format.common.errors import FormatError
from kpc.tools.bench.records import Record

COLUMNS = 4
PANEL_INCHES = (3.3, 2.5)
# The least error that is drawn.
FLOOR = 1e-9
# Values whose largest is so many times their least are drawn on a logarithmic axis.
WIDE = 100
NAMES = ("numpy", "kernels", "processor", "glsl", "torch", "folded", "stored")
COLOURS = {name: f"C{number}" for number, name in enumerate(NAMES)}


def draw(records: Sequence[Record]) -> Figure:
    """Draw errors against what is swept; values that the code does not let through are shaded.

    Raises:
        FormatError: there is nothing to draw.
    """
    sweeps = [record for record in records if record["kind"] == "stability"]
    if not sweeps:
        raise FormatError("no records of kpbench stability to draw; write some with kpbench stability --out")
    rows = math.ceil(len(sweeps) / COLUMNS)
    figure = Figure(figsize=(COLUMNS * PANEL_INCHES[0], rows * PANEL_INCHES[1]), layout="constrained")
    panels = figure.subplots(rows, COLUMNS, squeeze=False).ravel()
    lines = {}
    for axes, record in zip(panels, sweeps, strict=False):
        names = dict.fromkeys(name for point in record["points"] for name in point["errors"])
        for name in names:
            points = [(p["value"], p["errors"][name]) for p in record["points"] if name in p["errors"]]
            values = _placed([value for value, _ in points])
            errors = [math.nan if error is None else max(error, FLOOR) for _, error in points]
            (lines[name],) = axes.plot(values, errors, color=COLOURS.get(name, "0.3"), linewidth=1)
        axes.axhline(record["settings"]["bound"], color="0.4", linestyle="--", linewidth=1)
        axes.set(yscale="log", ylim=(FLOOR, 2))
        axes.yaxis.set_major_locator(LogLocator(numticks=6))
        if _is_wide([point["value"] for point in record["points"]]):
            axes.set_xscale("log")
            axes.xaxis.set_major_locator(LogLocator(numticks=6))
        axes.minorticks_off()
        _shade(axes, record["settings"]["admitted"])
        axes.set_title(record["name"], fontsize=9)
        axes.set_xlabel(record["settings"]["axis"], fontsize=8)
        axes.tick_params(labelsize=7)
        axes.grid(color="0.9")
    for axes in panels[len(sweeps) :]:
        axes.set_axis_off()
    figure.legend(list(lines.values()), list(lines), loc="outside lower center", ncols=len(lines), fontsize=8)
    return figure


def _placed(values: Sequence[float]) -> list[float]:
    """Return where values are drawn: 0 on a logarithmic axis, where they need one, at a tenth of the next."""
    if not _is_wide(values):
        return list(values)
    least = min(value for value in values if value > 0) / 10
    return [max(value, least) for value in values]


def _is_wide(values: Sequence[float]) -> bool:
    return min(values) >= 0 and max(values) > WIDE * min(value for value in values if value > 0)


def _shade(axes: Axes, admitted: Sequence[float | None]) -> None:
    """Shade what lies outside the admitted values."""
    low, high = axes.get_xlim()
    for first, last in ((low, admitted[0]), (admitted[1], high)):
        if first is not None and last is not None and first < last:
            axes.axvspan(first, last, color="0.93", zorder=0)
    axes.set_xlim(low, high)
