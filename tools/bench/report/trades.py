"""The trades that the report shows: benchmark records as charts, a section each.

A section names the kinds of record that it draws. Where there is none of a kind, the page gives the command that makes
it. All figures of all records are in tables at the end of the page, so that nothing is dropped.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from kpc.encoder.evaluation.ablations import BASELINE
from kpc.tools.bench.encoding_commands import DEFAULT_PRESET
from kpc.tools.bench.figures import DEEPEST_DB
from kpc.tools.bench.records import Record, median
from kpc.tools.bench.report.charts import Bar, Bars, Chart, Point, Series
from kpc.tools.bench.report.exponents import exponent
from kpc.tools.bench.tables import is_ours

AnyChart = Chart | Bars

# Levels that draw what the reference draws but for rounding are shown at this PSNR.
MOST_DB = 60.0
DISTANCE = "PSNR to the reference, dB"


@dataclass(frozen=True)
class Section:
    """A part of the page.

    Attributes:
        key: its anchor.
        title: its heading.
        text: what it shows and how to read it.
        kinds: of the records that it draws.
        draw: makes the charts of such records.
    """

    key: str
    title: str
    text: str
    kinds: tuple[str, ...]
    draw: Callable[[Sequence[Record]], list[AnyChart]]


def _by(records: Iterable[Record], key: Callable[[Record], str]) -> dict[str, list[Record]]:
    """Return records by a key, in the order in which it first occurs."""
    found: dict[str, list[Record]] = {}
    for record in records:
        found.setdefault(key(record), []).append(record)
    return found


def _by_name(records: Iterable[Record]) -> dict[str, list[Record]]:
    return _by(records, lambda record: str(record["name"]))


def _point(record: Record, x: str, y: str, unit: float = 1.0, text: str = "", is_default: bool = False) -> list[Point]:
    """Return the point of the medians of two figures, the x in multiples of `unit`; none where one was not measured."""
    at, value = median(record, x), median(record, y)
    if at is None or value is None or not (math.isfinite(at) and math.isfinite(value)) or at <= 0:
        return []
    values = [repeat[y] for repeat in record["repeats"] if repeat.get(y) is not None]
    low, high = (min(values), max(values)) if len(values) > 1 else (None, None)
    return [Point(at / unit, value, text, low, high, is_default)]


def _rising(points: Iterable[Point]) -> list[Point]:
    return sorted(points, key=lambda point: point.x)


def _cores(record: Record) -> str:
    cores = record["machine"]["cores"]
    return f"{cores} core{'s' * (cores != 1)}"


# --- training


def training(records: Sequence[Record]) -> list[AnyChart]:
    """Draw held-out PSNR against training time: a chart a scene, a line a preset, and the presets at their own ends."""
    charts: list[AnyChart] = []
    for name, of_scene in _by_name(records).items():
        series = []
        curves = _by(
            (record for record in of_scene if record["kind"] == "curve"),
            lambda record: f"{record['settings']['preset']} for a given time, {_cores(record)}",
        )
        for line, runs in curves.items():
            points = [
                point
                for run in runs
                for point in _point(run, "train_s", "test_psnr", 60.0, f"{median(run, 'steps') or 0:,.0f} steps")
            ]
            series.append(Series(line, _rising(points)))
        encoded = [record for record in of_scene if record["kind"] == "encode"]
        for line, runs in _by(encoded, lambda record: f"presets, {_cores(record)}").items():
            points = []
            for run in runs:
                settings = run["settings"]
                own = settings.get("steps") is None and settings.get("time_budget_s") is None
                if settings.get("psnr_db") is None:
                    is_default = own and settings["preset"] == DEFAULT_PRESET
                    points += _point(run, "train_s", "test_psnr", 60.0, settings["preset"], is_default)
            series.append(Series(line, _rising(points), is_main=True, is_labelled=True))
        charts.append(Chart(name, "training, minutes", "held-out PSNR, dB", series))
    return charts


def sizes(records: Sequence[Record]) -> list[AnyChart]:
    """Draw PSNR against file size, a chart a scene, a line a coder; what codes KPC's planes with parts left out is not
    among them."""
    charts: list[AnyChart] = []
    for name, of_scene in _by_name(records).items():
        series = []
        for record in of_scene:
            coder = str(record["coder"])
            if record["points"] and (coder == "kpc" or not is_ours(coder)):
                default = record["repeats"][0].get("setting") if coder == "kpc" else None
                points = [
                    Point(p["size_bytes"] / 1e3, p["psnr"], str(p["setting"]), is_default=p["setting"] == default)
                    for p in record["points"]
                ]
                series.append(Series(f"{coder}{_saving(record)}", _rising(points), is_main=coder == "kpc"))
        tops = [point.y for one in series for point in one.points]
        lowest = max(tops) - DEEPEST_DB if tops else None
        charts.append(Chart(name, "file, KB", "PSNR, dB", series, lowest_y=lowest))
    return charts


def _saving(record: Record) -> str:
    rate = record.get("bd_rate")
    return "" if rate is None else f" (kpc {rate:+.0%})"


def coding_parts(records: Sequence[Record]) -> list[AnyChart]:
    """Draw what each part of training, of the coder and of the entropy coder gains, as bars."""
    charts: list[AnyChart] = []
    for name, runs in _by_name(record for record in records if record["kind"] == "ablate").items():
        base = next((run for run in runs if run["settings"]["ablation"] == BASELINE), None)
        for key, label, form, more_is_better in (
            ("test_psnr", "held-out PSNR, change in dB", "{:+.2f} dB", True),
            ("size_bytes", "file size, change in %", "{:+.0f} %", False),
        ):
            before = None if base is None else median(base, key)
            bars = []
            for run in runs:
                after = median(run, key)
                if run is not base and before and after is not None:
                    change = after - before if key == "test_psnr" else 100 * (after / before - 1)
                    bars.append(Bar(run["settings"]["ablation"], change, form.format(change)))
            if bars:
                charts.append(Bars(f"{name}: training", label, bars, more_is_better))
    for name, coders in _by_name(record for record in records if record["kind"] == "codec").items():
        bars = [
            Bar(record["coder"].removeprefix("kpc, "), rate, f"{rate:+.0f} %")
            for record in coders
            if is_ours(record["coder"]) and record.get("bd_rate") is not None
            for rate in [100 * (1 / (1 + record["bd_rate"]) - 1)]
        ]
        if bars:
            charts.append(Bars(f"{name}: coder", "size at equal PSNR without the part, change in %", bars, False))
    for name, variants in _by_name(record for record in records if record["kind"] == "entropy").items():
        before = next((median(v, "plane_bytes") for v in variants if v["settings"]["variant"] == BASELINE), None)
        bars = [
            Bar(variant["settings"]["variant"], change, f"{change:+.1f} %")
            for variant in variants
            if before and variant["settings"]["variant"] != BASELINE
            for change in [100 * ((median(variant, "plane_bytes") or 0) / before - 1)]
        ]
        if bars:
            charts.append(Bars(f"{name}: entropy coder", "bytes of the planes, change in %", bars, False))
    return charts


# --- playing


def levels(records: Sequence[Record]) -> list[AnyChart]:
    """Draw PSNR to the reference against frame time, a chart a scene, a line a size and device."""
    charts: list[AnyChart] = []
    for name, of_scene in _by_name(record for record in records if record["kind"] == "player").items():
        lines = _by(of_scene, lambda r: f"{r['settings']['size']}, {_device(r)}")
        series = [
            Series(line, [point for run in runs for point in _level(run)], is_main=number == 0)
            for number, (line, runs) in enumerate(lines.items())
        ]
        charts.append(Chart(name, "milliseconds per frame", DISTANCE, series))
    for name, of_scene in _by_name(record for record in records if record["kind"] == "web").items():
        lines = _by(of_scene, lambda r: f"{r['settings']['size']}")
        series = [
            Series(
                line,
                [
                    point
                    for run in runs
                    for point in _point(run, "look_ups", "psnr", 1e6, f"{run['settings']['quality']}")
                    if point.y <= MOST_DB
                ],
            )
            for line, runs in lines.items()
        ]
        charts.append(Chart(f"{name}, browser", "million look-ups per frame", DISTANCE, series))
    return charts


def _level(record: Record) -> list[Point]:
    """Return the point of a quality level; none for the reference itself."""
    settings, frame_ms = record["settings"], median(record, "frame_ms_median")
    if settings["quality"] == "reference" or frame_ms is None:
        return []
    psnr = record["accuracy"]["psnr"]
    text = settings["quality"] if psnr <= MOST_DB else f"{settings['quality']}, {psnr:.1f} dB"
    is_default = settings["quality"] == settings["default_quality"]
    return [Point(frame_ms, min(psnr, MOST_DB), text, is_default=is_default)]


def _device(record: Record) -> str:
    """Return the graphics card, or that there is none."""
    renderer = str(record["renderer"])
    return "no graphics card" if "llvmpipe" in renderer else renderer.split(",")[0].split("/")[0]


def loading(records: Sequence[Record]) -> list[AnyChart]:
    """Draw what prefixes of files look like, and the PSNR of each frame of clips in groups."""
    charts: list[AnyChart] = []
    streamed = [record for record in records if record["kind"] == "stream"]
    series = [
        Series(str(record["name"]), [Point(p["bytes"] / 1e3, p["psnr"], "prefix") for p in record["prefixes"][:-1]])
        for record in streamed
    ]
    if any(one.points for one in series):
        charts.append(Chart("Prefixes of files", "received, KB", "PSNR to the whole file, dB", series))
    for record in records:
        if record["kind"] == "groups":
            charts.append(_frames(record, {"": "psnr"}, [join["frame"] - 0.5 for join in record["joins"]]))
    return charts


def frames(records: Sequence[Record]) -> list[AnyChart]:
    """Draw PSNR of each frame, of moving and of still pixels apart."""
    parts = {"moving pixels": "moving_psnr", "still pixels": "still_psnr", "all pixels": "psnr"}
    return [_frames(record, parts) for record in records if record["kind"] == "quality"]


def _frames(record: Record, parts: dict[str, str], marks: Sequence[float] = ()) -> Chart:
    """Return the chart of each frame of a clip; a line for each camera and part of its pictures."""
    cameras = dict.fromkeys(str(frame["camera"]) for frame in record["frames"])
    series = [
        Series(
            ", ".join(filter(None, (camera, part))),
            [
                Point(frame["frame"], frame[key], f"frame {frame['frame']}")
                for frame in record["frames"]
                if str(frame["camera"]) == camera and frame.get(key) is not None
            ],
        )
        for camera in cameras
        for part, key in parts.items()
    ]
    return Chart(f"{record['name']}, each frame", "frame", "PSNR, dB", series, log_x=False, marks=marks)


# --- precision and cost


def precision(records: Sequence[Record]) -> list[AnyChart]:
    """Draw the loss of coding against the bits of a parameter: one chart, a line a scene."""
    coded = [record for record in records if record["kind"] == "codec" and record["coder"] == "kpc"]
    series = [
        Series(
            str(record["name"]),
            _rising(
                Point(
                    p["bits_per_parameter"],
                    p["loss_db"],
                    str(p["setting"]),
                    is_default=p["setting"] == record["repeats"][0].get("setting"),
                )
                for p in record["points"]
                if p["loss_db"] > 0
            ),
        )
        for record in coded
    ]
    bits = Chart("Bits of a parameter", "bits per parameter", "PSNR lost by coding, dB", series, log_y=True)
    return [bits, *(_swept(record) for record in records if record["kind"] == "stability")]


def _swept(record: Record) -> Chart:
    """Return the chart of the errors of a stage's implementations over what is swept; errors of 0 have no logarithm."""
    settings = record["settings"]
    names = dict.fromkeys(name for point in record["points"] for name in point["errors"])
    series = [
        Series(
            name,
            [
                Point(point["value"], point["errors"][name], f"{point['value']:g}")
                for point in record["points"]
                if point["value"] > 0 and point["errors"].get(name)
            ],
        )
        for name in names
    ]
    values = [point.x for one in series for point in one.points]
    ends = [end for end in settings["admitted"] if end and values and min(values) <= end <= max(values)]
    label = f"largest error, {settings['error']}"
    title = f"{record['name']}: {settings['axis']}"
    return Chart(title, settings["axis"], label, series, log_y=True, marks=ends, limits=(settings["bound"],))


def costs(records: Sequence[Record]) -> list[AnyChart]:
    """Draw costs against the size of the work, with the exponent e of cost = constant x size^e."""
    charts: list[AnyChart] = []
    scaled = _by((r for r in records if r["kind"] == "scaling"), lambda r: f"{r['settings']['axis']}")
    units = {"read_s": "reading, s", "train_s": "training, s", "rest_s": "coding and testing, s"}
    memory = {"peak_memory_bytes": "peak memory, MB", "size_bytes": "file, MB"}
    for axis, runs in scaled.items():
        for figures, label, unit in ((units, "seconds", 1.0), (memory, "megabytes", 1e6)):
            series = []
            for key, name in figures.items():
                points = [
                    Point(run["settings"]["amount"], value / unit, f"{run['settings']['amount']:g}")
                    for run in runs
                    if (value := median(run, key))
                ]
                series.append(_with_exponent(name.rpartition(",")[0], _rising(points)))
            charts.append(Chart(f"Encoding: {axis}", axis, label, series, log_y=True))
    drawn = _by((r for r in records if r["kind"] == "player"), lambda r: f"{r['name']}, {_device(r)}")
    for name, runs in drawn.items():
        series = [
            _drawing(level, of_level) for level, of_level in _by(runs, lambda r: r["settings"]["quality"]).items()
        ]
        if any(len({point.x for point in one.points}) > 1 for one in series):
            charts.append(Chart(f"Drawing: {name}", "pixels", "milliseconds per frame", series, log_y=True))
    return charts


def _drawing(level: str, runs: Sequence[Record]) -> Series:
    points = []
    for run in runs:
        width, height = map(int, run["settings"]["size"].split("x"))
        if frame_ms := median(run, "frame_ms_median"):
            points.append(Point(width * height, frame_ms, run["settings"]["size"]))
    return _with_exponent(level, _rising(points))


def _with_exponent(name: str, points: Sequence[Point]) -> Series:
    found = exponent([point.x for point in points], [point.y for point in points])
    return Series(name if found is None else f"{name}, exponent {round(found, 2) + 0.0:.2f}", points)


SECTIONS = (
    Section(
        "time",
        "Training time and fidelity",
        "Held-out PSNR against the time that training takes, for each preset. A ring marks the default of kpenc.",
        ("encode", "curve"),
        training,
    ),
    Section(
        "size",
        "File size and fidelity",
        "PSNR of held-out views against the size of the file, beside general-purpose codecs that code the same planes. "
        "In brackets: by how much KPC's files are larger (+) or smaller at equal PSNR (Bjøntegaard delta rate).",
        ("codec",),
        sizes,
    ),
    Section(
        "levels",
        "Milliseconds and fidelity",
        "Each quality level of the player: how long a frame takes, and how near its pictures are to the reference, "
        f"at most {MOST_DB:g} dB. In a browser, a level is measured by what it looks up, from which the frame rate "
        "of a device follows.",
        ("player", "web"),
        levels,
    ),
    Section(
        "precision",
        "Precision and error",
        "How much PSNR is lost when each number takes fewer bits, and how large the error of each stage of the "
        "arithmetic is, against float64. Dashed lines are the bound of the error and the ends of what the code admits.",
        ("codec", "stability"),
        precision,
    ),
    Section(
        "cost",
        "Cost and the size of the work",
        "What cameras, frames, pixels and channels cost. The exponent e is that of cost = constant x size^e, by least "
        "squares of the logarithms: 1 is proportional, 0 costs nothing more.",
        ("scaling", "player"),
        costs,
    ),
    Section(
        "parts",
        "What each part gains",
        "What changes when one part is left out or changed. Orange bars are losses, blue ones gains.",
        ("ablate", "codec", "entropy"),
        coding_parts,
    ),
    Section(
        "frames",
        "Moving and still pixels",
        "PSNR of each frame of held-out views. A pixel moves where the truth differs from its median over time by more "
        "than 0.04, grown by 3 pixels.",
        ("quality",),
        frames,
    ),
    Section(
        "loading",
        "Playing while loading, and long clips",
        "What the beginning of a file looks like while the rest is on its way, and how steady a clip in groups is; "
        "groups join at the dashed lines.",
        ("stream", "groups"),
        loading,
    ),
)

# The command that makes records of each kind.
COMMANDS = {
    "encode": "kpbench encode DATASET --preset fast --out encode.json",
    "curve": "kpbench curve DATASET --minutes 1,2,5 --out curve.json",
    "ablate": "kpbench ablate DATASET --preset fast --steps 500 --out ablate.json",
    "step": "kpbench step DATASET --out step.json",
    "gpu": "kpbench step DATASET --preset paper --out gpu.json",
    "groups": "kpbench groups DATASET --group 5s --out groups.json",
    "scaling": "kpbench scaling --out scaling.json",
    "player": "kpbench player SCENE.kpc --out player.json",
    "stream": "kpbench stream SCENE.kpc --out stream.json",
    "window": "kpbench window SCENE.kpc --out window.json",
    "steady": "kpbench steady SCENE.kpc --out steady.json",
    "web": "kpbench web SCENE.kpc --out web.json",
    "webload": "kpbench web SCENE.kpc --loading --repeats 3 --out webload.json",
    "codec": "kpbench codec SCENE.kpck --dataset DATASET --ablate --out codec.json",
    "entropy": "kpbench entropy SCENE.kpc --out entropy.json",
    "decode": "kpbench decode SCENE.kpc --out decode.json",
    "quality": "kpbench quality SCENE.kpc DATASET --out quality.json",
    "ceiling": "kpbench ceiling DATASET --preset balanced --out ceiling.json",
    "pictures": "kpbench pictures SCENE.kpc DATASET --out pictures.json",
    "stability": "kpbench stability --out stability.json",
}
