"""Columns of the tables of benchmark records, by kind of record.

A cell is the median over the repeats of a run.
"""

import statistics
from collections.abc import Callable

from kpc.tools.bench.records import Record, median

Cell = Callable[[Record], str]
Column = tuple[str, Cell]

# --- cells


def number(key: str, text: str, unit: float = 1.0) -> Cell:
    """Show the median of `key` in multiples of `unit`, formatted by `text`."""

    def cell(record: Record) -> str:
        value = median(record, key)
        return "-" if value is None else text.format(value / unit)

    return cell


def accuracy(key: str, text: str, unit: float = 1.0) -> Cell:
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


def _admitted(record: Record) -> str:
    low, high = record["settings"]["admitted"]
    if high is None:
        return "all"
    return f"up to {high:.3g}" if not low else f"{low:.3g} to {high:.3g}"


def _passes(record: Record) -> str:
    """Show the values nearest to those admitted at which the error passes its bound, the least that was tried first."""
    low, high = record["settings"]["admitted"]
    below = [value for value in record["passes"] if low is not None and value < low]
    above = [value for value in record["passes"] if high is not None and value > high]
    within = [value for value in record["passes"] if value not in below + above]
    return ", ".join(f"{value:.3g}" for value in (*below[-1:], *within, *above[:1])) or "-"


# --- columns

ENCODED: list[Column] = [
    ("dataset", _name),
    ("preset", _preset),
    ("PSNR dB", number("test_psnr", "{:.2f}")),
    ("SSIM", number("test_ssim", "{:.3f}")),
    ("file KB", number("size_bytes", "{:.0f}", 1e3)),
]

# All pixels, those that move, and the others: what headings and keys of their measures begin with.
PARTS = ("", "moving ", "still ")


def _of_parts(heading: str, key: str, text: str, unit: float = 1.0) -> list[Column]:
    """Return the columns of one measure of all, moving and still pixels."""
    return [(part + heading, number(part.replace(" ", "_") + key, text, unit)) for part in PARTS]


COLUMNS: dict[str, list[Column]] = {
    "encode": [
        *ENCODED,
        ("bits/param", number("bits_per_parameter", "{:.2f}")),
        ("identity", number("identity_share", "{:.0%}")),
        ("coding loss dB", number("coding_loss_db", "{:.2f}")),
        ("training", number("train_s", "{:.0f} s")),
        ("total", number("encode_s", "{:.0f} s")),
        ("rays/s", number("rays_per_s", "{:,.0f}")),
        ("peak MB", number("peak_memory_bytes", "{:.0f}", 1e6)),
    ],
    "curve": [
        *ENCODED,
        ("training", number("train_s", "{:.0f} s")),
        ("total", number("encode_s", "{:.0f} s")),
        ("steps", number("steps", "{:,.0f}")),
    ],
    "ablate": [
        ENCODED[0],
        ("variant", _setting("ablation")),
        *ENCODED[2:],
        ("identity", number("identity_share", "{:.0%}")),
        ("training", number("train_s", "{:.0f} s")),
    ],
    "step": [
        *ENCODED[:2],
        ("M param", number("parameters", "{:.2f}", 1e6)),
        ("samples/ray", number("samples_per_ray", "{:.1f}")),
        ("rays/s", number("rays_per_s", "{:,.0f}")),
        ("plain PyTorch", number("plain_rays_per_s", "{:,.0f}")),
        ("speedup", _ratio("rays_per_s", "plain_rays_per_s", "{:.0f}x")),
        ("ms per step", number("step_s", "{:.1f}", 1e-3)),
        *((name, _part(name)) for name in ("kernel", "adam", "priors", "decoder", "rays", "occupancy")),
        ("kernel GFLOP/s", _against("kernel_gflops", "gflops")),
        ("kernel GB/s", _against("kernel_gb_s", "cache_gb_s")),
        ("memory GB/s", _limit("memory_gb_s")),
        ("peak MB", number("peak_memory_bytes", "{:.0f}", 1e6)),
    ],
    "gpu": [
        *ENCODED[:2],
        ("M param", number("parameters", "{:.2f}", 1e6)),
        ("samples/ray", number("samples_per_ray", "{:.1f}")),
        ("rays/s", number("rays_per_s", "{:,.0f}")),
        ("ms per step", number("step_s", "{:.1f}", 1e-3)),
        ("GB per step", number("bytes", "{:.1f}", 1e9)),
        ("lower bound", number("least_bytes", "{:.1f}", 1e9)),
        ("GB/s", _ratio("bytes", "step_s", "{:.0f}", 1e9)),
        ("copying GB/s", number("memory_gb_s", "{:.0f}")),
        ("ratio", number("share_of_memory", "{:.0%}")),
        ("GPU memory GB", number("gpu_memory_bytes", "{:.1f}", 1e9)),
    ],
    "player": [
        ("scene", _name),
        ("quality", _quality),
        ("size", _setting("size")),
        ("first frame ms", number("first_frame_ms", "{:.0f}")),
        ("median ms", number("frame_ms_median", "{:.1f}")),
        ("p95 ms", number("frame_ms_p95", "{:.1f}")),
        ("CPU ms", number("cpu_ms_median", "{:.1f}")),
        ("fps", number("fps", "{:.1f}")),
        ("fragment, compute ms", _by_shader),
        ("G texels", number("texels_per_frame", "{:.2f}", 1e9)),
        ("of peak texel rate", number("share_of_texel_rate", "{:.0%}")),
        ("speedup", number("speedup_over_reference", "{:.1f}x")),
        ("samples/ray", accuracy("samples_per_ray", "{:.1f}")),
        ("textures MB", number("gpu_memory_bytes", "{:.1f}", 1e6)),
        ("peak MB", number("peak_memory_bytes", "{:.0f}", 1e6)),
        ("PSNR to reference dB", accuracy("psnr", "{:.1f}")),
        ("worst frame", accuracy("psnr_min", "{:.1f}")),
        ("moving camera", accuracy("psnr_moving", "{:.1f}")),
        ("within 1/255", accuracy("within_one_level", "{:.2%}")),
        ("folding only: worst frame dB", accuracy("folding_psnr", "{:.1f}")),
        ("largest error of 255", accuracy("folding_max_error", "{:.0f}", 1 / 255)),
    ],
    "stream": [
        ("scene", _name),
        ("file KB", number("size_bytes", "{:.0f}", 1e3)),
        ("first picture from disk ms", number("disk_first_picture_ms", "{:.0f}")),
        ("link", lambda r: f"{r['settings']['rate']}, {r['settings']['delay']}"),
        ("first picture ms", number("network_first_picture_ms", "{:.0f}")),
        ("after KB", number("network_first_picture_bytes", "{:.0f}", 1e3)),
        ("full detail ms", number("network_full_detail_ms", "{:.0f}")),
        ("complete ms", number("network_complete_ms", "{:.0f}")),
        ("seek ms", number("seek_ms", "{:.0f}")),
        ("of which waiting", number("seek_wait_ms", "{:.0f}")),
        ("share of the file: PSNR to the whole", _prefixes),
    ],
    "steady": [
        ("scene", _name),
        ("window", _setting("size")),
        ("frames", _setting("frames", "{:,}")),
        ("fps", number("fps", "{:.0f}")),
        ("GPU objects created", number("gpu_objects_created", "{:.0f}")),
        ("MB at start", number("first_bytes", "{:.1f}", 1e6)),
        ("MB at end", number("last_bytes", "{:.1f}", 1e6)),
        ("KB per 1,000 frames", number("bytes_per_1000_frames", "{:.1f}", 1e3)),
    ],
    "window": [
        ("scene", _name),
        ("window", _setting("size")),
        ("degrees/s", _setting("turn", "{:g}")),
        ("fps", number("fps", "{:.0f}")),
        ("p95 ms", number("frame_ms_p95", "{:.0f}")),
        ("raster", lambda r: r["repeats"][0]["raster"]),
        ("raster changes/min", number("raster_changes_per_minute", "{:.0f}")),
        ("PSNR to reference dB", number("psnr", "{:.1f}")),
        ("worst frame", number("psnr_min", "{:.1f}")),
    ],
    "web": [
        ("scene", _name),
        ("size", _setting("size")),
        ("quality", _setting("quality")),
        ("raster", lambda r: r["repeats"][0]["raster"]),
        ("samples/ray", number("samples_per_ray", "{:.1f}")),
        ("cells/ray", number("cells_per_ray", "{:.1f}")),
        ("texels/pixel", number("texels_per_pixel", "{:.0f}")),
        ("M look-ups", number("look_ups", "{:.1f}", 1e6)),
        ("MB", number("bytes", "{:.0f}", 1e6)),
        ("PSNR to reference dB", number("psnr", "{:.1f}")),
        ("when still", number("psnr_still", "{:.1f}")),
        ("fps at 5 G/s", number("phone_fps", "{:.0f}")),
        ("10 G/s", number("integrated_fps", "{:.0f}")),
        ("100 G/s", number("card_fps", "{:.0f}")),
        ("auto's choice on", lambda r: ", ".join(r["repeats"][0]["chosen_on"]) or "-"),
        ("software: CPU ms", number("cpu_ms", "{:.0f}")),
        ("fps", number("software_fps", "{:.1f}")),
        ("at rest: CPU ms", number("resting_cpu_ms", "{:.0f}")),
        ("fps", number("resting_software_fps", "{:.1f}")),
        ("PSNR", number("resting_psnr", "{:.1f}")),
    ],
    "webload": [
        ("scene", _name),
        ("player", _setting("player")),
        ("shows", _setting("shows")),
        ("scene KB", number("scene_bytes", "{:.0f}", 1e3)),
        ("all KB", number("bytes", "{:.0f}", 1e3)),
        ("first picture ms", number("first_picture_ms", "{:.0f}")),
        ("longest task ms", number("longest_task_ms", "{:.0f}")),
        ("of the processor", number("longest_task_cpu_ms", "{:.0f}")),
        ("seek ms", number("seek_unbuffered_ms", "{:.0f}")),
        ("buffered seek ms", number("seek_buffered_ms", "{:.0f}")),
        ("fps", number("fps", "{:.1f}")),
        ("load of the machine", lambda r: f"{r['load_average']:.1f}"),
    ],
    "codec": [
        ("scene", _name),
        ("coder", lambda r: r["coder"]),
        ("KB at 0.15 dB loss", number("size_at_default_loss", "{:.0f}", 1e3)),
        ("kpc is smaller by, its planes by", _savings),
        ("nearest setting: KB", number("size_bytes", "{:.0f}", 1e3)),
        ("bits/param", number("bits_per_parameter", "{:.2f}")),
        ("PSNR loss dB", number("loss_db", "{:.2f}")),
        ("encode s", number("encode_s", "{:.1f}")),
        ("decode s", number("decode_s", "{:.2f}")),
        ("chunks", _shares),
    ],
    "groups": [
        ("dataset", _name),
        ("preset", _setting("preset")),
        ("group length", _setting("group_s", "{:g} s")),
        ("groups", number("groups", "{:.0f}")),
        ("file KB", number("size_bytes", "{:.0f}", 1e3)),
        ("PSNR dB", number("test_psnr", "{:.2f}")),
        ("encoded in s", number("encode_s", "{:.0f}")),
        ("peak MB, one group", number("first_group_peak_memory_bytes", "{:.0f}", 1e6)),
        ("peak MB, all", number("peak_memory_bytes", "{:.0f}", 1e6)),
        ("joins: PSNR before, after; error change", _joins),
        ("other frames: median, 95th percentile", _typical_change),
    ],
    "entropy": [
        ("scene", _name),
        ("variant", _setting("variant")),
        ("planes KB", number("plane_bytes", "{:.1f}", 1e3)),
        ("decoding ms", number("decode_ms", "{:.0f}")),
        ("file KB", number("file_bytes", "{:.1f}", 1e3)),
        ("reading ms", number("read_ms", "{:.0f}")),
    ],
    "quality": [
        ("scene", _name),
        ("dataset", _setting("dataset")),
        ("pictures", number("pictures", "{:.0f}")),
        ("moves", number("moving_share", "{:.0%}")),
        *_of_parts("PSNR", "psnr", "{:.2f}"),
        *_of_parts("SSIM", "ssim", "{:.3f}"),
        *_of_parts("FLIP", "flip", "{:.3f}"),
        *_of_parts("flicker", "flicker", "{:.2f}", 1 / 255),
    ],
    "ceiling": [
        ("dataset", _name),
        ("preset", _setting("preset")),
        ("pictures", number("pictures", "{:.0f}")),
        ("moves", number("moving_share", "{:.0%}")),
        *_of_parts("PSNR", "psnr", "{:.2f}"),
        *_of_parts("SSIM", "ssim", "{:.3f}"),
        *_of_parts("FLIP", "flip", "{:.3f}"),
    ],
    "stability": [
        ("stage", _name),
        ("swept", _setting("axis")),
        ("admitted", _admitted),
        ("error of", _setting("error")),
        ("error", number("max_error", "{:.1e}")),
        ("by", lambda r: r["repeats"][0]["worst"]),
        ("passes at", _passes),
        ("bound", _setting("bound", "{:.1e}")),
        ("kept by", _setting("kept")),
    ],
    "decode": [
        ("scene", _name),
        ("segments", number("segments", "{:.0f}")),
        ("symbols", number("symbols", "{:.0f}")),
        ("one thread ms", number("decode_ms", "{:.1f}")),
        ("two threads ms", number("two_threads_ms", "{:.1f}")),
        ("slowest segment ms", number("slowest_segment_ms", "{:.1f}")),
        ("slowest time segment ms", number("slowest_time_segment_ms", "{:.1f}")),
    ],
    "scaling": [
        ("by", _setting("axis")),
        ("amount", _setting("amount", "{:g}")),
        ("preset", _setting("preset")),
        ("reading s", number("read_s", "{:.2f}")),
        ("training s", number("train_s", "{:.1f}")),
        ("the rest s", number("rest_s", "{:.1f}")),
        ("M param", number("parameters", "{:.2f}", 1e6)),
        ("file KB", number("size_bytes", "{:.0f}", 1e3)),
        ("peak MB", number("peak_memory_bytes", "{:.0f}", 1e6)),
    ],
    "pictures": [
        ("scene", _name),
        ("dataset", _setting("dataset")),
        ("views", lambda r: str(len(r["views"]))),
        ("PSNR dB", number("psnr", "{:.2f}")),
        ("moving", number("moving_psnr", "{:.2f}")),
        ("still", number("still_psnr", "{:.2f}")),
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
    "quality": ("scene", "pictures", "PSNR", "moving PSNR", "FLIP", "flicker"),
    "ceiling": ("dataset", "pictures", "PSNR", "moving PSNR", "still PSNR", "FLIP"),
    "stability": ("stage", "swept", "admitted", "error", "by", "passes at"),
    "decode": ("scene", "segments", "symbols", "one thread ms", "slowest segment ms", "slowest time segment ms"),
    "scaling": ("by", "amount", "reading s", "training s", "the rest s", "peak MB"),
    "pictures": ("scene", "dataset", "views", "PSNR dB", "moving", "still"),
}
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
    "scaling": "Encoding by the size of the work",
    "pictures": "Pictures beside truth",
    "stability": "Numerical stability",
    "quality": "Quality of held-out views, moving and still pixels apart",
    "ceiling": "Frames trained alone, moving and still pixels of the clip apart",
}
