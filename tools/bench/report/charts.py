"""Charts of the report: drawn by matplotlib, put into a page as SVG whose colours are those of the page.

The page is light or dark, so a chart names colours of the page (`var(--ink)`) wherever matplotlib wrote one of the
stand-ins below. Each point says in a title what it is, which browsers show under the pointer.
"""

import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any
from xml.etree import ElementTree

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter, NullLocator

# Stand-ins for the colours that the page names: text and axes, quiet text, grid, background, and those of series.
INK, DIM, LINE, PAPER = "#010101", "#010102", "#010103", "#010104"
SERIES = tuple(f"#0102{number:02x}" for number in range(9))
NAMES = {INK: "--ink", DIM: "--dim", LINE: "--line", PAPER: "--card"} | {
    colour: f"--s{number}" for number, colour in enumerate(SERIES)
}
MARKERS = "os^Dv<>Ph"

# A chart is as wide as the narrowest phone shows at the size of its letters; wider screens put charts side by side.
WIDTH, HEIGHT, BAR_HEIGHT, LEGEND_ROW = 4.0, 2.9, 0.21, 0.19  # inches
LEGEND_COLUMN_LETTERS = 27  # names of series longer than this take the whole width
STEPS = (1, 2, 2.5, 5, 10)  # between two ticks of a linear axis, times a power of ten
MOST_DECADES = 7  # labels of an axis that shows whole decades only
SUPERSCRIPTS = str.maketrans("-0123456789", "\u207b\u2070\u00b9\u00b2\u00b3\u2074\u2075\u2076\u2077\u2078\u2079")
STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "kpc",
    "text.parse_math": False,  # names may hold dollars
    "font.size": 9,
    "font.sans-serif": ["DejaVu Sans"],
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": DIM,
    "axes.facecolor": "none",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": LINE,
    "xtick.color": DIM,
    "ytick.color": DIM,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "legend.frameon": False,
    "figure.facecolor": "none",
}
SVG, XLINK = "http://www.w3.org/2000/svg", "http://www.w3.org/1999/xlink"


@dataclass(frozen=True)
class Point:
    """A measured point.

    Attributes:
        x, y: where.
        text: what was set, for the title and the table.
        low, high: the least and greatest y of the repeats, where there are several.
        is_default: whether this is KPC's default; it is ringed.
    """

    x: float
    y: float
    text: str = ""
    low: float | None = None
    high: float | None = None
    is_default: bool = False


@dataclass(frozen=True)
class Series:
    """Points joined by a line, in their order.

    Attributes:
        name: in the legend.
        points: of the line.
        is_main: whether the line is drawn heavier than the others.
        is_joined: whether there is a line.
        is_labelled: whether each point shows its text.
    """

    name: str
    points: Sequence[Point]
    is_main: bool = False
    is_joined: bool = True
    is_labelled: bool = False


@dataclass(frozen=True)
class Chart:
    """Curves in one pair of axes.

    Attributes:
        title: what is shown of which scene.
        x_label, y_label: with units.
        series: of points; those without any are left out.
        log_x, log_y: whether an axis is logarithmic.
        lowest_y: what lies below is left out.
        marks: values of x with a vertical line.
        limits: values of y with a horizontal line.
    """

    title: str
    x_label: str
    y_label: str
    series: Sequence[Series]
    log_x: bool = True
    log_y: bool = False
    lowest_y: float | None = None
    marks: Sequence[float] = ()
    limits: Sequence[float] = ()

    @property
    def table(self) -> list[list[str]]:
        """All points as text, heading first."""
        rows = [
            [series.name, point.text + " (default)" * point.is_default, f"{point.x:.4g}", f"{point.y:.4g}"]
            for series in self.series
            for point in series.points
        ]
        return [["series", "point", self.x_label, self.y_label], *rows]

    def svg(self, number: int) -> str:
        """Return the chart as an SVG element.

        Args:
            number: of the chart in its page, for ids of its own.
        """
        series = [one for one in self.series if one.points]
        with rc_context(STYLE):
            columns = 1 if max((len(one.name) for one in series), default=0) > LEGEND_COLUMN_LETTERS else 2
            rows = -(-len(series) // columns)
            figure = Figure(figsize=(WIDTH, HEIGHT + rows * LEGEND_ROW), layout="constrained")
            axes = figure.subplots()
            titles: dict[str, str] = {}
            for place, one in enumerate(series):
                _draw_series(axes, one, place, self, titles)
            for x in self.marks:
                axes.axvline(x, color=DIM, linestyle="--", linewidth=0.8)
            for y in self.limits:
                axes.axhline(y, color=DIM, linestyle="--", linewidth=0.8)
            axes.set(xlabel=self.x_label, ylabel=self.y_label)
            if self.lowest_y is not None:
                axes.set_ylim(bottom=self.lowest_y)
            for axis, is_log in ((axes.xaxis, self.log_x), (axes.yaxis, self.log_y)):
                _ticks(axes, axis, is_log)
            figure.legend(loc="outside lower left", ncols=columns, fontsize=8, handlelength=1.6, columnspacing=1)
            label = f"{self.title}: {self.y_label} against {self.x_label}"
            return _themed(figure, label, number, titles)


@dataclass(frozen=True)
class Bar:
    """A named value, and its text."""

    name: str
    value: float
    text: str = ""


@dataclass(frozen=True)
class Bars:
    """Horizontal bars from zero, each with its name and value.

    Attributes:
        title: what is shown of which scene.
        label: of the values, with their unit.
        bars: in order, from the top.
        is_more_better: whether bars to the right are good; those of the other side have another colour.
    """

    title: str
    label: str
    bars: Sequence[Bar]
    is_more_better: bool = True

    @property
    def table(self) -> list[list[str]]:
        """All bars as text, heading first."""
        return [["variant", self.label], *([bar.name, bar.text or f"{bar.value:.4g}"] for bar in self.bars)]

    def svg(self, number: int) -> str:
        """Return the chart as an SVG element."""
        with rc_context(STYLE):
            figure = Figure(figsize=(WIDTH, 0.8 + 2 * BAR_HEIGHT * len(self.bars)), layout="constrained")
            axes = figure.subplots()
            titles: dict[str, str] = {}
            for place, bar in enumerate(self.bars):
                is_good = (bar.value >= 0) == self.is_more_better
                (patch,) = axes.barh(place, bar.value, height=0.5, color=SERIES[0 if is_good else 1])
                patch.set_gid(name := f"bar{place}")
                titles[name] = f"{bar.name}: {bar.text or f'{bar.value:.4g}'}"
                label = f"{bar.name}  {bar.text or f'{bar.value:.3g}'}"
                axes.text(0, place - 0.33, label, transform=axes.get_yaxis_transform(), fontsize=8, va="bottom")
            axes.axvline(0, color=DIM, linewidth=0.8)
            axes.set(xlabel=self.label, ylim=(len(self.bars) - 0.5, -0.9))
            axes.yaxis.set_major_locator(NullLocator())
            axes.xaxis.set_major_locator(MaxNLocator(5, steps=STEPS))
            axes.xaxis.set_major_formatter(FuncFormatter(_label))
            axes.spines["left"].set_visible(False)
            return _themed(figure, f"{self.title}: {self.label}", number, titles)


def _draw_series(axes: Axes, series: Series, place: int, chart: Chart, titles: dict[str, str]) -> None:
    colour, marker = SERIES[place % len(SERIES)], MARKERS[place % len(MARKERS)]
    shown = [point for point in series.points if chart.lowest_y is None or point.y >= chart.lowest_y]
    joined = series.points if series.is_joined else ()
    width = 2.2 if series.is_main else 1.2
    axes.plot([p.x for p in joined], [p.y for p in joined], color=colour, linewidth=width, zorder=3 + series.is_main)
    # For the legend alone.
    style = "-" if series.is_joined else ""
    axes.plot([], [], style, marker=marker, markersize=4, linewidth=width, color=colour, label=_shown(series.name))
    for point in shown:
        if point.low is not None and point.high is not None and point.high > point.low:
            axes.plot([point.x, point.x], [point.low, point.high], color=colour, linewidth=1)
        name = f"point{len(titles)}"
        titles[name] = (
            f"{series.name}, {point.text}: {chart.x_label} {point.x:.4g}, {chart.y_label} {point.y:.4g}"
            + ", the default" * point.is_default
        )
        axes.plot(point.x, point.y, marker, markersize=4, color=colour, zorder=5, gid=name)
        if series.is_labelled:
            place_of, beside = (point.x, point.y), (-7, 3)
            axes.annotate(point.text, place_of, beside, "data", "offset points", fontsize=8, color=colour, ha="right")
        if point.is_default:
            axes.plot(point.x, point.y, "o", markersize=11, markerfacecolor="none", color=INK, zorder=6)


def _shown(name: str) -> str:
    """Return the name of a series so that matplotlib lists it, which hides those with an underscore in front."""
    return f"\u200b{name}" if name.startswith("_") else name


def _ticks(axes: Axes, axis: Any, is_log: bool) -> None:
    if not is_log:
        axis.set_major_locator(MaxNLocator(5, steps=STEPS))
        axis.set_major_formatter(FuncFormatter(_label))
        return
    (axes.set_xscale if axis is axes.xaxis else axes.set_yscale)("log")
    low, high = sorted(axis.get_view_interval())
    decades = high / low if low > 0 else 1.0
    subs: tuple[float, ...] = (1, 2, 5) if decades < 40 else (1, 3) if decades < 1000 else (1,)
    if decades < 4:
        subs = (1, 1.5, 2, 3, 4, 5, 6, 8)
    axis.set_major_locator(LogLocator(subs=subs, numticks=12 if len(subs) > 1 else MOST_DECADES))
    axis.set_major_formatter(FuncFormatter(_label))
    axis.set_minor_formatter(NullFormatter())


def _label(value: float, position: object) -> str:
    """Return the text of a tick: a power of ten where digits would be many."""
    if value == 0 or 1e-3 <= abs(value) < 1e6:
        return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:g}"
    mantissa, _, exponent = f"{value:.3e}".partition("e")
    power = "10" + str(int(exponent)).translate(SUPERSCRIPTS)
    return power if float(mantissa) == 1 else f"{float(mantissa):g}\u00b7{power}"


def _themed(figure: Figure, label: str, number: int, titles: dict[str, str]) -> str:
    """Return a figure as an SVG element with the page's colours, ids of its own, and titles by the ids of points.

    Args:
        figure: to be shown.
        label: what it shows, for those who do not see it.
        number: of the figure in its page.
        titles: by id.
    """
    written = io.StringIO()
    figure.savefig(written, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    root = ElementTree.fromstring(written.getvalue())
    for parent in list(root.iter()):
        for child in list(parent):
            if child.tag in (f"{{{SVG}}}metadata", f"{{{SVG}}}style"):
                parent.remove(child)
    for name in ("width", "height"):
        del root.attrib[name]
    root.attrib |= {"role": "img", "aria-label": label}
    for element in list(root.iter()):
        element.tag = element.tag.removeprefix(f"{{{SVG}}}")  # HTML knows the elements without their namespace
        if (address := element.attrib.pop(f"{{{XLINK}}}href", None)) is not None:
            element.set("href", address)
        if (text := titles.get(element.get("id", ""))) is not None:
            element.insert(0, ElementTree.Element("title"))
            element[0].text = text
        for name in ("id", "href", "clip-path", "style"):
            if name in element.attrib:
                element.set(name, _own(name, element.attrib[name], number))
    return ElementTree.tostring(root, encoding="unicode")


def _own(attribute: str, value: str, number: int) -> str:
    """Return the value of an attribute with ids of a page's chart, and with the page's colours."""
    if attribute == "id":
        return f"c{number}-{value}"
    if attribute != "style":
        return re.sub(r"#", f"#c{number}-", value, count=1)
    value = re.sub(r"url\(#", f"url(#c{number}-", value)
    return re.sub(r"#01[0-9a-f]{4}", lambda found: f"var({NAMES[found[0]]})" if found[0] in NAMES else found[0], value)
