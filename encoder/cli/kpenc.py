"""`kpenc`: a folder of posed videos or images becomes a .kpc file."""

import contextlib
import json
import math
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from kpc.encoder.cli.estimate import Estimate, estimate
from kpc.encoder.cli.grouped import LATER_STEPS, initialise_from, options_of_group, split_into_spans
from kpc.encoder.cli.options import Options, parse
from kpc.encoder.cli.transcode import check_outputs, coding_figures, combine_figures, describe_outcome, transcode
from kpc.encoder.datasets import Dataset, load_dataset
from kpc.encoder.evaluation.ablations import effective_ablations
from kpc.encoder.evaluation.evaluate import evaluate
from kpc.encoder.evaluation.profile import profile
from kpc.encoder.evaluation.validation_rays import VALIDATION_RAYS, ValidationRays
from kpc.encoder.field.bounds import (
    find_box,
    find_contraction_box,
    fit_contraction,
    fit_device_coordinates,
    is_unbounded,
    visible_cells,
)
from kpc.encoder.field.config import TrainConfig
from kpc.encoder.field.field import time_rows
from kpc.encoder.field.occupancy_grid import grid_shape, merge_slots
from kpc.encoder.rdo.codec_model import Model, code, load_checkpoint
from kpc.encoder.rdo.model_checkpoint import save_checkpoint
from kpc.encoder.rdo.prune import Pruned
from kpc.encoder.rdo.sequential_finetune import steps_per_group
from kpc.encoder.training.temporal_resolution import TimeResolution, fit_frames_per_row
from kpc.encoder.training.tight_bounds import trim_box
from kpc.encoder.training.train import Report, Trainer, load_checkpoint_box
from kpc.format.common import cli
from kpc.format.common.errors import DatasetError, TrainingError, UsageError
from kpc.format.common.memory import peak_memory_bytes
from kpc.format.common.progress import Progress
from kpc.format.container import groups, scene_io
from kpc.format.scene.scene import Scene
from kpc.format.scene.space import FAR, Contraction, DeviceCoordinates, SpaceMapping

MOST_CAMERAS = 32
"""Cameras of the dataset that the file names."""

CHECKPOINT = "checkpoint.kpck"

OF_A_GROUP = ("size_bytes", "test_psnr", "steps", "train_s", "peak_memory_bytes")
"""What is said of each group of a clip."""

SPACES = {
    type(None): ("box", "a box, nothing outside it"),
    Contraction: ("contracted", "contracted beyond a box"),
    DeviceCoordinates: ("ndc", "device coordinates of a rig that faces one way"),
}
"""How --space calls a mapping, and what the log says of it."""


def main(argv: list[str] | None = None) -> int:
    with _on_signals(signal.default_int_handler):
        return cli.run(_command, "kpenc", argv)


def _command(argv: list[str]) -> None:
    options, only_plan, as_json = parse(argv)
    if only_plan:
        _print_estimate(dry_run(options), options, as_json)
        return
    result = transcode(options) if options.source.is_file() else encode(options)
    if as_json:
        print(json.dumps(result, indent=1))
    elif options.source.is_file():
        rate = f"{result['bits_per_parameter']:.2f} bits per parameter of {result['parameters']:,}"
        print(f"{options.output}: {rate}; {describe_outcome(result)}")
    else:
        _print_result(result, options)


def _print_result(result: dict[str, Any], options: Options) -> None:
    quality = "no view held out"
    if result["test_psnr"] is not None:
        quality = (
            f"held-out PSNR {result['test_psnr']:.2f} dB, SSIM {result['test_ssim']:.4f} "
            f"over {result['test_pictures']} pictures"
        )
        if result["appearances"]:
            quality += ", right halves, each in an appearance fitted to its left half"
    print(f"{options.output}: {quality} (rendered from the decoded file)")
    print(
        f"{result['size_bytes']:,} bytes, {result['bits_per_parameter']:.2f} bits per parameter of {result['parameters']:,}; "
        f"coding loss {result['coding_loss_db']:.3f} dB"
        + (" on held-out views" if result["test_psnr"] is not None else "")
    )
    print(describe_outcome(result))
    if result["identity_share"] is not None:
        print(f"time-plane texels exactly at identity: {result['identity_share']:.1%}")
    if len(result.get("groups", [])) > 1:
        print(f"{len(result['groups'])} groups: " + ", ".join(_of_group(group) for group in result["groups"]))
    print(
        f"encoded in {result['encode_s']:.0f} s, of which training {result['train_s']:.0f} s ({result['steps']} steps)"
    )


def _of_group(group: dict[str, Any]) -> str:
    quality = "" if group["test_psnr"] is None else f", {group['test_psnr']:.2f} dB"
    return f"{group['size_bytes']:,} bytes{quality}"


def _print_estimate(expected: Estimate, options: Options, as_json: bool) -> None:
    if as_json:
        print(json.dumps(asdict(expected), indent=1))
        return
    total = expected.train_s + expected.rest_s
    print(
        f"{options.output} would take {total:.0f} s, of which training {expected.train_s:.0f} s, and "
        f"{expected.memory_bytes / 1e6:.0f} MB of memory; decoded pixels wait in {options.work_dir}"
    )


def encode(options: Options) -> dict[str, Any]:
    """Train on a dataset and write the .kpc file; what was measured, as a dictionary that JSON can hold.

    Raises:
        DatasetError, MediaError: the dataset cannot be used. TrainingError: training failed.
        KeyboardInterrupt: stopped by the user; the checkpoint is kept.
    """
    if options.group_s is not None:
        return _encode_groups(options)
    return _encode_scene(options, _setting(options))


@dataclass(frozen=True)
class Setting:
    """What is to be encoded, and where.

    Attributes:
        dataset: decoded.
        aabb, mapping: the box, and how space beyond it is held.
        is_final: the box is not to be cut down any more.
        before: the scene to begin with, whose last picture is about the first of this; None to begin anew.
    """

    dataset: Dataset
    aabb: np.ndarray
    mapping: SpaceMapping | None
    is_final: bool
    before: Scene | None = None


def _encode_scene(options: Options, setting: Setting) -> dict[str, Any]:
    started = time.monotonic()
    trainer = _trainer(options, setting)
    dataset, work, checkpoint = trainer.dataset, options.work_dir, options.work_dir / CHECKPOINT
    try:
        _train(trainer, checkpoint, options.time_budget_s)
    except KeyboardInterrupt:
        trainer.save(checkpoint)
        if not _wants_partial(trainer, checkpoint, may_be_asked=options.group_s is None):
            raise

    if trainer.config.summed:
        return _not_written(trainer, options, started)
    scene = to_scene(trainer)
    tune_steps = options.tune_steps
    if tune_steps is None:
        tune_steps = steps_per_group(trainer.step, scene, trainer.config.tune_steps)
    _say(_occupied(scene))
    tuning = f"tuning planes by {tune_steps} steps a group, " if tune_steps else ""
    _say(f"writing: choosing quantisation steps, {tuning}rendering held-out views")
    probe = ValidationRays.from_training_views(trainer.sampler, trainer.background)
    if options.keep_checkpoint is not None:
        save_checkpoint(options.keep_checkpoint, scene, probe)
    coded = code(Model(scene, probe), options.trade, trainer.config.prune_share, tune_steps, shown=True)
    if coded.pruned is not None:
        _say(_left_out(scene, coded.pruned, coded.spare_db))
    size = _write(coded.data, options.output, work)
    decoded = scene_io.read(options.output).dequantise()
    test, before = (
        evaluate(decoded, dataset, most=options.max_test_pictures),
        evaluate(scene, dataset, most=options.max_test_pictures),
    )
    if not options.keep:
        _clear(work)
    return {
        "file": str(options.output),
        "layout": dataset.layout,
        "dynamic": dataset.is_dynamic,
        "preset": options.preset,
        "seed": options.seed,
        "device": str(trainer.device),
        "box": trainer.aabb.tolist(),
        "space": SPACES[type(trainer.mapping)][0],
        "appearance": trainer.config.appearance,
        "appearances": len(trainer.names),
        "test_psnr": test and test.psnr,
        "test_ssim": test and test.ssim,
        "test_pictures": test.pictures if test else 0,
        "coding_loss_db": before.psnr - test.psnr if test and before else coded.loss_db,
        **coding_figures(coded, size, options.trade, "training views"),
        "steps": trainer.step,
        "train_s": trainer.elapsed_s,
        "encode_s": time.monotonic() - started,
        "rays_per_s": trainer.rays_per_second,
        "peak_memory_bytes": peak_memory_bytes(),
    }


def _encode_groups(options: Options) -> dict[str, Any]:
    """Each group as a scene, one after the other, and all of them as one file."""
    started = time.monotonic()
    setting = _setting(options)
    work, spans = options.work_dir, split_into_spans(setting.dataset.clip, float(options.group_s or 0))
    numbers = range(len(spans)) if options.only is None else [options.only]
    if numbers[-1] >= len(spans):
        raise UsageError(f"--only {numbers[-1]}: the clip has {len(spans)} groups, numbered from 0")
    first = _part(work, numbers[0])
    if options.resume and first.with_suffix(".json").exists():
        setting = replace(setting, aabb=scene_io.SceneReader(first).head.aabb, is_final=True)
    elif not setting.is_final:
        setting = _trimmed_for_groups(setting, options, spans)
    found: list[dict[str, Any]] = []
    for number in numbers:
        span, part = spans[number], _part(work, number)
        _say(f"group {number} of {len(spans)}: frames {span.start} to {span.last}")
        told = replace(
            options_of_group(options, number, spans),
            output=part,
            work=part.with_suffix(""),
            keep_checkpoint=options.keep_checkpoint or part.with_suffix(".kpck"),
        )
        if options.resume and part.with_suffix(".json").exists():
            found.append(_finished(part, told))
        else:
            before = None if number == numbers[0] else _part(work, number - 1).with_suffix(".kpck")
            found.append(_encode_group(told, _of_span(setting, span), before))
    size = _joined([groups.GroupInput.of(_part(work, number), spans[number].start) for number in numbers], options)
    if not options.keep:
        _clear(work)
    return _of_all(found, [spans[number] for number in numbers], size, options) | {
        "encode_s": time.monotonic() - started
    }


def _part(work: Path, number: int) -> Path:
    """Where a finished group waits for the others."""
    return work / f"group-{number:04d}.kpc"


def _of_span(setting: Setting, span: groups.Span) -> Setting:
    return replace(setting, dataset=setting.dataset.frame_range(span.start, span.last))


def _trimmed_for_groups(setting: Setting, options: Options, spans: Sequence[groups.Span]) -> Setting:
    """All groups share a box, found from no more frames than one of them has."""
    dataset = setting.dataset.subsample_frames(max(span.count for span in spans))
    budget_s = options_of_group(options, 0, spans).time_budget_s
    assert not isinstance(setting.mapping, Contraction)
    aabb, _ = _trimmed(dataset, options.config(dataset), setting.aabb, budget_s, setting.mapping)
    return replace(setting, aabb=aabb, is_final=True)


def _encode_group(told: Options, setting: Setting, before: Path | None) -> dict[str, Any]:
    """A group, and beside its file what was measured: with that there it is done. It begins where `before` ended, the finished
    checkpoint of the one before."""
    if before is None:
        found = _encode_scene(told, setting)
    else:
        _say(f"it begins where the one before ended, and takes {LATER_STEPS:.0%} of its steps")
        shorter = replace(told, steps=math.ceil(LATER_STEPS * told.config(setting.dataset).steps))
        found = _encode_scene(shorter, replace(setting, before=load_checkpoint(before).scene))
    with cli.atomic_write(told.output.with_suffix(".json")) as aside:
        aside.write_text(json.dumps({"told": _as_told(told), "found": found}))
    if before is not None:
        before.unlink()
    return found


def _finished(part: Path, told: Options) -> dict[str, Any]:
    """What was measured of a group that is done.

    Raises:
        TrainingError: it was told otherwise.
    """
    try:
        kept = json.loads(part.with_suffix(".json").read_text())
        if kept["told"] != _as_told(told):
            raise TrainingError(f"{part}: belongs to a run with other settings; give the same ones or drop --resume")
        found: dict[str, Any] = kept["found"]
    except (OSError, ValueError, KeyError) as error:
        raise TrainingError(
            f"{part}: what was measured of it is gone; delete it to have the group encoded anew"
        ) from error
    _say(f"{part}: is there already")
    return found


def _as_told(told: Options) -> str:
    """All options that what comes out depends on."""
    return repr(replace(told, resume=False, keep=False))


def _joined(parts: Sequence[groups.GroupInput], options: Options) -> int:
    try:
        return groups.write(parts, options.output)
    except OSError as error:
        kept = f"or give another -o with --work {options.work_dir} --resume to keep what is done"
        raise TrainingError(f"{options.output}: {error.strerror}; make room there, {kept}") from error


def _of_all(
    found: Sequence[dict[str, Any]], spans: Sequence[groups.Span], size: int, options: Options
) -> dict[str, Any]:
    """Of all groups together: sums, means over frames or pictures, and those of each group."""

    def mean(name: str, weights: Sequence[float]) -> float | None:
        values = [one[name] for one in found]
        return None if None in values or not sum(weights) else float(np.average(values, weights=weights))

    pictures = [one["test_pictures"] for one in found]
    return found[0] | combine_figures(found, spans, size, options.trade) | {
        "file": str(options.output),
        "test_psnr": mean("test_psnr", pictures), "test_ssim": mean("test_ssim", pictures), "test_pictures": sum(pictures),
        "coding_loss_db": mean("coding_loss_db", [span.count for span in spans]),
        **{key: sum(one[key] for one in found) for key in ("steps", "train_s")},
        "rays_per_s": mean("rays_per_s", [one["train_s"] for one in found]), "peak_memory_bytes": found[-1]["peak_memory_bytes"],
        "groups": [{"frames": [span.start, span.last]} | {key: one[key] for key in OF_A_GROUP}
                   for one, span in zip(found, spans, strict=True)],
    }  # fmt: skip


def _not_written(trainer: Trainer, options: Options, started: float) -> dict[str, Any]:
    """What was measured on a model that no file can hold, as far as `encode` says it of others."""
    test = evaluate(to_scene(trainer), trainer.dataset, most=options.max_test_pictures, field=trainer.field)
    if not options.keep:
        _clear(options.work_dir)
    return {
        "file": str(options.output),
        "device": str(trainer.device),
        "seed": options.seed,
        "steps": trainer.step,
        "test_psnr": test and test.psnr,
        "test_ssim": test and test.ssim,
        "test_pictures": test.pictures if test else 0,
        "train_s": trainer.elapsed_s,
        "encode_s": time.monotonic() - started,
    }


def dry_run(options: Options) -> Estimate:
    """All that `encode` would do up to the first few hundred steps, what it found said on stderr; nothing is written but
    decoded pixels, which wait in the work folder for the run itself.

    Raises:
        As `encode`.
    """
    started = time.monotonic()
    setting = _setting(options)
    groups_count = 1.0
    if options.group_s is not None:
        spans = split_into_spans(setting.dataset.clip, options.group_s)
        groups_count = 1 if options.only is not None else 1 + LATER_STEPS * (len(spans) - 1)
        options, setting = (
            options_of_group(options, options.only or 0, spans),
            _of_span(setting, spans[options.only or 0]),
        )
    trainer = _trainer(options, setting)
    tested = int(trainer.dataset.pictures.is_test.sum())
    found = estimate(
        trainer,
        VALIDATION_RAYS,
        min(tested, options.max_test_pictures or tested),
        time.monotonic() - started - trainer.elapsed_s,
        options.time_budget_s,
        options.tune_steps,
    )
    return replace(found, train_s=groups_count * found.train_s, rest_s=groups_count * found.rest_s)


def profile_steps(options: Options) -> dict[str, Any]:
    """Where the time of a training step goes: `kpc.encoder.evaluation.profile`. Nothing is written but decoded pixels.

    Raises:
        As `encode`.
    """
    return profile(_trainer(options, _setting(options)))


def ablations(options: Options) -> list[str]:
    """The names of the ablations (`kpc.encoder.evaluation.ablations`) that make a difference to a run. Nothing is written but pixels.

    Raises:
        As `encode`.
    """
    _make_work_dir(options.work_dir)
    dataset = load_dataset(options.source, options.work_dir, holdout=options.holdout, downscale=options.downscale)
    return effective_ablations(options.config(dataset))


def _setting(options: Options) -> Setting:
    """The dataset decoded, the space found that it fills."""
    check_outputs(options)
    _device(options.device)
    _make_work_dir(options.work_dir)
    try:
        dataset = load_dataset(options.source, options.work_dir, holdout=options.holdout, downscale=options.downscale)
        aabb, mapping, why = _space_of(dataset, options)
    except BaseException:
        _remove_if_empty(options.work_dir)
        raise
    _say(dataset.describe())
    _say(f"space: {SPACES[type(mapping)][1]} ({why})")
    return Setting(dataset, aabb, mapping, options.box is not None or isinstance(mapping, Contraction))


def _trainer(options: Options, setting: Setting) -> Trainer:
    """The model laid out, the box cut down, an interrupted run taken up: ready for the next step."""
    device, checkpoint = _device(options.device), options.work_dir / CHECKPOINT
    _make_work_dir(options.work_dir)
    dataset, aabb, mapping = setting.dataset, setting.aabb, setting.mapping
    appearance, why = options.appearance_of(dataset)
    _say(f"appearance: {'none' if appearance == 'none' else f'a code for each {appearance}'} ({why})")
    config, in_time = fit_frames_per_row(options.config(dataset), dataset)
    if dataset.is_dynamic:
        _say(_rows_in_time(config, dataset, in_time))
    if setting.before is not None:
        config = replace(config, coarse_until=0.0)  # there is more than a coarse scale to begin with
    resumes, survey_s = options.resume and checkpoint.exists(), 0.0
    if not setting.is_final:
        if resumes:
            aabb = load_checkpoint_box(checkpoint)
        else:
            aabb, survey_s = _trimmed(dataset, config, aabb, options.time_budget_s, mapping)
    trainer = Trainer(dataset, config, aabb, device, elapsed_s=survey_s, mapping=mapping)
    _say(_plan(trainer))
    if resumes:
        trainer.resume(checkpoint)
    elif setting.before is not None:
        initialise_from(trainer.field, setting.before)
    if options.resume:
        _say(f"resumed at step {trainer.step}" if trainer.step else f"{checkpoint}: no checkpoint yet; starting afresh")
    return trainer


def to_scene(trainer: Trainer) -> Scene:
    """The trained field with its final occupancy and a few of the cameras, the most central first."""
    dataset = trainer.dataset
    slots = min(8, dataset.clip.frame_count) if dataset.is_dynamic else 1
    occupancy = merge_slots(
        trainer.grid.sample_slots(trainer.density_at, np.random.default_rng(trainer.config.seed), slots)
    )
    return replace(trainer.scene(occupancy), cameras=tuple(dataset.camera(p) for p in _spread_of_cameras(dataset)))


def _trimmed(
    dataset: Dataset,
    config: TrainConfig,
    aabb: np.ndarray,
    time_budget_s: float | None,
    mapping: DeviceCoordinates | None,
) -> tuple[np.ndarray, float]:
    """The box cut down to where something is, and the seconds that took."""
    with Progress("survey", total=1000, unit="‰") as progress:
        return trim_box(
            dataset, config, aabb, lambda r: _show(progress, r), time_budget_s=time_budget_s, mapping=mapping
        )


def _train(trainer: Trainer, checkpoint: Path, time_budget_s: float | None) -> None:
    """Train to the end, or until Ctrl-C, which waits for the step to be done."""
    requests: list[int] = []
    with Progress("train", total=1000, unit="‰") as progress, _on_signals(lambda number, _: requests.append(number)):
        trainer.run(
            lambda r: _show(progress, r), checkpoint, time_budget_s=time_budget_s, interrupted=lambda: bool(requests)
        )


def _show(progress: Progress, r: Report) -> None:
    """Step, train PSNR, rays/s and samples/ray; the bar runs in per mille of the work."""
    progress.note(
        f"step {r.step}, psnr {r.psnr:.2f}, {r.rays_per_second:,.0f} rays/s, "
        f"{r.samples_per_ray:.1f} samples/ray, {r.occupied:.1%} occupied"
    )
    progress.advance(1000 * min(r.fraction, 1.0) - progress.done)


@contextlib.contextmanager
def _on_signals(handler: Callable[[int, Any], None]) -> Iterator[None]:
    """Ctrl-C and SIGTERM alike go to `handler`, unless they are ignored. Only the main thread may decide that."""
    numbers = [n for n in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(n) is not signal.SIG_IGN]
    if threading.current_thread() is not threading.main_thread():
        numbers = []
    before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier)


def _write(data: bytes, output: Path, work: Path) -> int:
    try:
        return scene_io.save(data, output)
    except OSError as error:
        kept = f", or give another -o with --work {work} --resume to keep what is trained"
        raise TrainingError(f"{output}: {error.strerror}; make room there{kept}") from error


def _wants_partial(trainer: Trainer, checkpoint: Path, may_be_asked: bool) -> bool:
    """After Ctrl-C: on a terminal ask whether to write the scene as it stands; elsewhere only say how to go on."""
    where = f"stopped at step {trainer.step}; {checkpoint} is kept, go on with --resume"
    _say(where)
    if not may_be_asked or not (sys.stdin.isatty() and sys.stderr.isatty()) or trainer.step < 2:
        return False
    print("write the scene as trained so far? [y/N] ", end="", file=sys.stderr, flush=True)
    return sys.stdin.readline().strip().lower() in ("y", "yes")


def _plan(trainer: Trainer) -> str:
    layout, (lo, hi) = trainer.field.layout, trainer.aabb
    corners = " to ".join(" ".join(f"{v:.4g}" for v in corner) for corner in (lo, hi))
    planes = ", ".join("x".join(str(n) for n in row if n) for row in layout.resolution)
    beyond, mapping = "", trainer.mapping
    if isinstance(mapping, Contraction):
        beyond = f" and all around it, even steps up to {mapping.uniform_distance:.4g}, rays to {FAR * mapping.uniform_distance:.4g}"
    elif mapping is not None:
        beyond = f" of device coordinates, near {mapping.near:.4g}, baseline {mapping.baseline:.4g}"
    nodes = (
        ""
        if trainer.field.motion is None
        else (
            f", read where a motion grid of {'x'.join(str(n) for n in trainer.field.motion.shape[3:0:-1])} nodes leads"
        )
    )
    decoder = "hybrid" if trainer.config.hybrid else "explicit"
    return (
        f"box {corners}{beyond}; planes {planes} ({'xyzt' if layout.is_dynamic else 'xyz'}) of {layout.channels} channels, "
        f"{layout.size / 1e6:.2f} M parameters{nodes}; {decoder} decoder; on {trainer.device}"
    )


def _rows_in_time(config: TrainConfig, dataset: Dataset, found: TimeResolution | None) -> str:
    """How far apart the rows of the time planes are, and why."""
    rows = time_rows(dataset.clip.frame_count, config.frames_per_row)
    said = f"time: {rows} rows, one for {config.frames_per_row:g} of {dataset.clip.frame_count} frames"
    if found is None:
        return f"{said} (the preset's; it is measured where cameras stand still)"
    wider = "" if math.isnan(found.next_error) else f", wider apart {found.next_error:.3f}"
    return (
        f"{said} (lines between them miss {found.changing:.1%} of the pixels, those that change, by {found.error:.3f} of the "
        f"full range{wider}; {config.time_tolerance:g} allowed; noise {found.noise:.3f})"
    )


def _occupied(scene: Scene) -> str:
    """How many of the cells a renderer marches, and how often that is told."""
    said, slots = f"occupied: {scene.occupancy.mean():.1%} of all cells", len(scene.occupancy)
    if slots > 1:
        return f"{said} at a time, told in {slots} spans of the clip; {scene.occupancy.any(0).mean():.1%} at any time"
    return f"{said}, told once for the whole clip" if scene.is_dynamic else said


def _left_out(scene: Scene, pruned: Pruned, spare_db: float) -> str:
    """What the scene can do without, and what it cost or would cost."""
    worth, counts = pruned.view_gain_db, [scale["xy"].shape[2] for scale in scene.scales]
    said = "colour: the same from all sides, as trained"
    if worth is not None:
        said = (
            f"colour: by direction, worth {worth:.3f} dB"
            if worth > spare_db
            else (f"colour: the same from all sides, direction is worth {worth:.3f} dB")
        )
    left = " + ".join(f"{len(kept)} of {count}" for kept, count in zip(pruned.kept, counts))
    more = "" if math.isinf(pruned.next_loss_db) else f", {pruned.next_loss_db:.3f} dB with fewer"
    return f"{said}; channels: {left} a scale; costs {pruned.loss_db:.3f} dB{more} ({spare_db:.3f} allowed)"


def _spread_of_cameras(dataset: Dataset) -> list[int]:
    """Pictures of distinct cameras, at most MOST_CAMERAS, the one nearest to their mean position first."""
    _, first = np.unique(dataset.pictures.camera, return_index=True)
    first = np.sort(first)
    if len(first) > MOST_CAMERAS:
        first = first[np.linspace(0, len(first) - 1, MOST_CAMERAS).round().astype(int)]
    centres = dataset.pictures.camera_to_world[first, :3, 3]
    central = int(np.argmin(np.linalg.norm(centres - centres.mean(0), axis=1)))
    return [int(first[central])] + [int(p) for i, p in enumerate(first) if i != central]


def _space_of(dataset: Dataset, options: Options) -> tuple[np.ndarray, SpaceMapping | None, str]:
    """The box asked for or found, (2, 3) float32, within what a file can hold; how space beyond it is held; and why so."""
    beyond, why = is_unbounded(dataset.pictures, dataset.has_alpha)
    space = options.space if options.space != "auto" else "contracted" if beyond else "box"
    if space == "ndc" and options.box is not None:
        raise UsageError(
            "--box is in world units, device coordinates have a box of their own: drop --box or --space ndc"
        )
    mapping: SpaceMapping | None = None
    try:
        if space == "ndc":
            mapping, aabb = fit_device_coordinates(dataset.pictures)
        elif options.box is not None:
            aabb = np.array(options.box, np.float32).reshape(2, 3)
        elif space == "contracted":
            aabb = find_contraction_box(dataset.pictures)
        else:
            aabb = find_box(dataset.pictures, dataset.has_alpha)
    except DatasetError as error:
        raise DatasetError(f"{options.source}: {error}") from error
    if space == "contracted":
        mapping = fit_contraction(dataset.pictures, aabb)
    if not (np.abs(aabb) <= scene_io.BOX_LIMIT).all() or not (aabb[1] - aabb[0] >= 1 / scene_io.BOX_LIMIT).all():
        raise DatasetError(
            f"{options.source}: a box from {aabb[0].tolist()} to {aabb[1].tolist()} is too large or too thin; "
            "give another with --box x0,y0,z0,x1,y1,z1"
        )
    across = options.config(dataset).samples_across / (aabb[1] - aabb[0]).max()
    if isinstance(mapping, Contraction) and mapping.uniform_distance * across > scene_io.SAMPLE_LIMIT:
        raise DatasetError(
            f"{options.source}: the box is too small for cameras that lie {mapping.uniform_distance:.4g} from its far side; "
            "give a larger one with --box x0,y0,z0,x1,y1,z1, or --space box"
        )
    if not visible_cells(dataset.pictures, aabb, grid_shape(aabb, 64), mapping).any():
        raise DatasetError(
            f"{options.source}: the box lies outside every camera's view; give another with --box x0,y0,z0,x1,y1,z1"
        )
    return aabb, mapping, f"{why}; --space overrides" if options.space == "auto" else "as told"


def _make_work_dir(work: Path) -> None:
    try:
        work.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise TrainingError(f"{work}: {error.strerror}; name another folder for decoded pixels with --work") from error


def _clear(work: Path) -> None:
    """Remove what kpenc has put there, and the folder if that was all."""
    of_groups = ("group-*.kpc", "group-*.json", "group-*.kpck")
    for pattern in ("pixels-*.bin", "pixels-*.json", *of_groups, CHECKPOINT, f".{Path(CHECKPOINT).stem}.*"):
        for leftover in work.glob(pattern):
            leftover.unlink(missing_ok=True)
    _remove_if_empty(work)


def _remove_if_empty(work: Path) -> None:
    with contextlib.suppress(OSError):
        work.rmdir()


def _device(name: str) -> str:
    if name == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    if name == "cuda" and not torch.cuda.is_available():
        raise UsageError(
            "--device cuda: this PyTorch sees no CUDA device; use --device cpu, or install a CUDA build of PyTorch"
        )
    return name


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
