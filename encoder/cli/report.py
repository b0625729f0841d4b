"""What kpenc prints: log lines on stderr while it runs, and the results on stdout."""

import itertools
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from kpc.encoder.cli.estimate import Estimate
from kpc.encoder.cli.options import Options
from kpc.encoder.cli.transcode import describe_copy, describe_outcome
from kpc.encoder.datasets import Dataset
from kpc.encoder.field.config import TrainConfig
from kpc.encoder.field.layout import time_rows
from kpc.encoder.rdo.prune import Pruned
from kpc.encoder.training.refinement import Correction
from kpc.encoder.training.temporal_resolution import TimeResolution
from kpc.encoder.training.train import Report, Trainer
from kpc.format.common.cli import print_json
from kpc.format.common.progress import Progress
from kpc.format.common.text import counted, escaped, notice
from kpc.format.scene.scene import Scene
from kpc.format.scene.space import FAR, Contraction, DeviceCoordinates

# How --space names a mapping of space, and how the log describes it.
SPACES = {
    type(None): ("box", "a box, nothing outside it"),
    Contraction: ("contracted", "contracted beyond a box"),
    DeviceCoordinates: ("ndc", "device coordinates of a rig that faces one way"),
}

# How the log describes what --refine names.
REFINED = {
    "none": "not refined",
    "cameras": "poses, focal lengths and distortion are refined",
    "all": "poses, focal lengths, distortion, clocks and exposures are refined",
}

# The most cameras of which a table is printed.
TABLE_ROWS = 40

# How far in dB held-out pictures may be behind those that were trained on before a warning says so.
OVERFITTED_DB = 3.0


def log(*lines: str) -> None:
    """Print lines on stderr, at once."""
    for line in lines:
        notice(line)


def show_progress(progress: Progress, report: Report) -> None:
    """Show step, training PSNR and speed; the bar counts percents of the work."""
    progress.note(f"step {report.step:,}, {report.psnr:.1f} dB, {report.rays_per_second:,.0f} rays/s")
    progress.advance(100 * min(report.fraction, 1.0) - progress.done)


def describe_model(trainer: Trainer) -> str:
    """Describe the box, the planes and the decoder that are trained."""
    layout, (lo, hi) = trainer.field.layout, trainer.aabb
    corners = " to ".join(" ".join(f"{v:.4g}" for v in corner) for corner in (lo, hi))
    planes = ", ".join("x".join(str(n) for n in row if n) for row in layout.resolution)
    beyond, mapping = "", trainer.mapping
    if isinstance(mapping, Contraction):
        uniform = mapping.uniform_distance
        beyond = f" and all around it, uniform steps up to {uniform:.4g}, rays to {FAR * uniform:.4g}"
    elif mapping is not None:
        beyond = f" of device coordinates, near {mapping.near:.4g}, baseline {mapping.baseline:.4g}"
    motion = ""
    if trainer.field.motion is not None:
        nodes = "x".join(str(n) for n in trainer.field.motion.shape[3:0:-1])
        motion = f", displaced by a motion grid of {nodes} nodes"
    decoder = "hybrid" if trainer.config.hybrid else "explicit"
    return (
        f"box: {corners}{beyond}\n"
        f"planes: {planes} ({'xyzt' if layout.is_dynamic else 'xyz'}) of {layout.channels} channels{motion}\n"
        f"{layout.size / 1e6:.2f} M parameters, {decoder} decoder, on {trainer.device}"
    )


def describe_time_rows(config: TrainConfig, dataset: Dataset, found: TimeResolution | None) -> str:
    """Describe the temporal resolution of the planes, and why it was chosen."""
    rows = time_rows(dataset.clip.frame_count, config.frames_per_row)
    each = "each" if config.frames_per_row == 1 else f"every {config.frames_per_row:g}"
    text = f"time: {rows} rows, one for {each} of {dataset.clip.frame_count} frames"
    if found is None:
        return f"{text} (the preset's)"
    return f"{text}: error {found.error:.3f} between rows, {config.time_tolerance:g} allowed"


def describe_occupancy(scene: Scene) -> str:
    """Describe the share of occupied cells, and the number of time slots."""
    text, slots = f"occupied: {scene.occupancy.mean():.1%} of all cells", len(scene.occupancy)
    if slots > 1:
        return f"{text} at a time, in {slots} time slots; {scene.occupancy.any(0).mean():.1%} at any time"
    return f"{text}, one time slot for the whole clip" if scene.is_dynamic else text


def describe_pruning(scene: Scene, pruned: Pruned, spare_db: float) -> str:
    """Describe what was pruned of a scene, and what it costs or would cost."""
    gain, counts = pruned.view_gain_db, [scale["xy"].shape[2] for scale in scene.scales]
    text = "colour: view-independent, as trained"
    if gain is not None and gain > spare_db:
        text = f"colour: view-dependent, which gains {gain:.3f} dB"
    elif gain is not None:
        text = f"colour: view-independent, as view dependence would gain only {gain:.3f} dB"
    kept = " + ".join(f"{len(kept)} of {count}" for kept, count in zip(pruned.kept, counts, strict=True))
    return f"{text}\nchannels kept: {kept}, a loss of {pruned.loss_db:.3f} dB, {spare_db:.3f} allowed"


def describe_corrections(corrections: Sequence[Correction], frame_s: float) -> str:
    """Describe how far cameras were moved, in a table; of more than TABLE_ROWS the median and the largest.

    `frame_s` is the time of a frame.
    """
    numbers = np.array(
        [
            [c.turned_degrees, 100 * c.moved_share, 100 * (c.focal - 1), 1000 * frame_s * c.late_frames]
            + [100 * (gain - 1) for gain in c.exposure]
            for c in corrections
        ]
    )
    if len(numbers) > TABLE_ROWS:
        sizes = np.abs(numbers)
        numbers, names = np.stack([np.median(sizes, axis=0), sizes.max(0)]), ["median", "largest"]
    else:
        names = [escaped(c.camera) for c in corrections]
    heads = ("turned", "moved", "focal", "clock", "red", "green", "blue")
    units = ("degrees", "% of rig", "%", "ms", "%", "%", "%")
    shown = [k for k in range(len(heads)) if k < 3 or numbers[:, k].any()]
    rows = [["camera", *(f"{heads[k]} {units[k]}" for k in shown)]]
    rows += [[name, *(f"{row[k]:.3f}" for k in shown)] for name, row in zip(names, numbers, strict=True)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
    return "\n".join(["corrections of the cameras:", *lines])


def describe_overfitting(test_psnr: float, training_psnr: float) -> str:
    """Return a warning where held-out pictures are far behind those that were trained on, else an empty text."""
    behind = training_psnr - test_psnr
    if behind <= OVERFITTED_DB:
        return ""
    return (
        f"warning: held-out pictures are {behind:.1f} dB behind those trained on ({training_psnr:.1f} dB): the model "
        "is overfitted; more cameras or pictures help, for one moving camera slower motion, too"
    )


def print_result(result: dict[str, Any], options: Options, as_json: bool) -> None:
    """Print the result of an encode, or of a transcode where the source is a file."""
    if as_json:
        print_json(result)
    elif result.get("is_copy"):
        print(escaped(f"{options.output}: {describe_copy(result)}"))
    elif options.source.is_file():
        rate = f"{result['bits_per_parameter']:.2f} bits per parameter of {result['parameters']:,}"
        print(escaped(f"{options.output}: {rate}; {describe_outcome(result)}"))
    else:
        _print_encode(result, options)


def _print_encode(result: dict[str, Any], options: Options) -> None:
    quality, tested = "no view held out", result["test_psnr"] is not None
    if tested:
        quality = (
            f"held-out PSNR {result['test_psnr']:.2f} dB{_describe_parts(result)}, SSIM {result['test_ssim']:.4f} over "
            f"{result['test_pictures']} of {counted(result['held_out_pictures'], 'picture')}"
        )
        if _share_frames(result):
            quality += " (those of frames that two groups share count twice)"
        if result["appearances"]:
            quality += ", right halves, each in an appearance fitted to its left half"
        if result["refine"] != "none":
            quality += ", their cameras aligned with the scene"
    print(escaped(f"{options.output}: {quality} (rendered from the decoded file)"))
    print(
        f"{result['size_bytes']:,} bytes, {result['bits_per_parameter']:.2f} bits per parameter of "
        f"{result['parameters']:,}; coding loss {result['coding_loss_db']:.3f} dB" + (" on held-out views" * tested)
    )
    print(describe_outcome(result))
    if result["identity_share"] is not None:
        print(f"time-plane texels exactly at identity: {result['identity_share']:.1%}")
    if len(result.get("groups", [])) > 1:
        print(f"{len(result['groups'])} groups: " + ", ".join(_describe_group(group) for group in result["groups"]))
    steps = counted(result["steps"], "step")
    print(
        f"encoded in {result['encode_s']:.0f} s, of which training {result['train_s']:.0f} s ({steps}) "
        f"and coding {result['coding_s']:.0f} s; the rest is reading, testing and, the first time, compiling"
    )
    if result["coding_s"] > result["train_s"]:
        parameters = f"{result['parameters']:,} parameters"
        print(f"coding took longer than training: however few the steps are, all {parameters} are coded")


def _share_frames(result: dict[str, Any]) -> bool:
    """Return whether groups have frames in common, each of which tests its pictures of them."""
    frames = [group["frames"] for group in result.get("groups", [])]
    return any(after[0] <= before[1] for before, after in itertools.pairwise(frames))


def _describe_parts(result: dict[str, Any]) -> str:
    """Describe the PSNR of moving and still pixels, where anything is known to move."""
    if result["test_psnr_moving"] is None:
        return ""
    return f" (moving {result['test_psnr_moving']:.2f}, still {result['test_psnr_still']:.2f})"


def _describe_group(group: dict[str, Any]) -> str:
    quality = "" if group["test_psnr"] is None else f", {group['test_psnr']:.2f} dB"
    return f"{group['size_bytes']:,} bytes{quality}"


def print_estimate(expected: Estimate, options: Options, as_json: bool) -> None:
    """Print what an encode would take."""
    if as_json:
        print_json(asdict(expected))
        return
    total = expected.train_s + expected.test_s + expected.rest_s
    print(
        f"would take {total:.0f} s, of which training {expected.train_s:.0f} s and testing {expected.test_pictures} of "
        f"{expected.held_out_pictures} held-out pictures {expected.test_s:.0f} s; {expected.memory_bytes / 1e6:.0f} MB "
        f"of memory, {expected.disk_bytes / 1e6:.3g} MB of disk for decoded pixels"
    )
