"""Encode one scene: train, code, write the file, and measure it on held-out pictures."""

import contextlib
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from kpc.encoder.cli.metadata import describe, describe_origin, hash_dataset, reserve_figures, with_figures
from kpc.encoder.cli.options import Options
from kpc.encoder.cli.prepare import Setting, prepare_trainer
from kpc.encoder.cli.report import (
    SPACES,
    describe_corrections,
    describe_occupancy,
    describe_overfitting,
    describe_pruning,
    log,
    show_progress,
)
from kpc.encoder.cli.transcode import coding_figures
from kpc.encoder.cli.work_folder import CHECKPOINT, clear_work_folder, save_scene
from kpc.encoder.datasets import Dataset
from kpc.encoder.evaluation.evaluate import Quality, SceneRenderer, evaluate, training_psnr
from kpc.encoder.evaluation.preview import Preview
from kpc.encoder.evaluation.testing_time import affordable_pictures, picture_seconds
from kpc.encoder.evaluation.validation_rays import ValidationRays
from kpc.encoder.field.occupancy_grid import merge_slots
from kpc.encoder.rdo.codec_model import CodedModel, Model, check_size, code
from kpc.encoder.rdo.model_checkpoint import save_checkpoint
from kpc.encoder.rdo.sequential_finetune import steps_per_group
from kpc.encoder.rdo.sharing import Sharing
from kpc.encoder.training.refinement import Correction
from kpc.encoder.training.train import Report, Trainer
from kpc.format.common import interrupts
from kpc.format.common.compiling import working_s
from kpc.format.common.memory import peak_memory_bytes
from kpc.format.common.progress import Progress
from kpc.format.common.text import counted
from kpc.format.container import scene_io
from kpc.format.container.rewriting import with_metadata
from kpc.format.scene.scene import Scene

MAX_CAMERAS = 32  # cameras of the dataset that the file holds
MAX_SLOTS = 8  # time slots of the occupancy, before they are merged
TRAINING_PICTURES = 8  # that are compared with as many held-out ones


class Abandoned(KeyboardInterrupt):
    """Ctrl-C came in the first training step, or again in a later one, whose changes are not to be saved."""


def encode_scene(options: Options, setting: Setting) -> dict[str, Any]:
    """Train on a dataset and write the file; return what was measured."""
    started = time.monotonic()
    trainer = prepare_trainer(options, setting)
    started -= trainer.elapsed_s  # of runs that were interrupted
    if options.preview is not None:
        log(f"preview: {options.preview}, with the box, beside what was filmed")
    _check_size(options, setting, trainer)
    checkpoint = options.work_dir / CHECKPOINT
    try:
        _train(trainer, checkpoint, options)
    except Abandoned:
        raise
    except KeyboardInterrupt:
        trainer.save(checkpoint)
        if not _wants_partial(trainer, checkpoint, may_ask=options.group_s is None):
            raise
        options = replace(options, keep=True)  # what training goes on from
    try:
        return _write(options, setting, trainer, started)
    except KeyboardInterrupt:
        if checkpoint.exists():
            log(f"stopped after training; {checkpoint} is kept, go on with --resume")
        raise


def _check_size(options: Options, setting: Setting, trainer: Trainer) -> None:
    """Refuse before training a target size that is less than what neither training nor coding changes.

    How small the smallest file of a model is depends on its decoder, so it is known only once it is trained.

    Raises:
        TrainingError: it is.
    """
    if options.trade.target_bytes is not None:
        dataset, pictures = trainer.dataset, _select_cameras(trainer.dataset)
        metadata = describe_origin(options, dataset, pictures, "0" * 64)  # a checksum takes no less
        cameras = tuple(map(dataset.camera, pictures))
        scene = replace(trainer.scene(), cameras=cameras, sound=setting.sound, metadata=metadata)
        check_size(scene, reserve_figures(options).trade, is_coded=False)


def _write(options: Options, setting: Setting, trainer: Trainer, started: float) -> dict[str, Any]:
    """Code a model that is trained, write the file and test it; return what was measured."""
    corrections = _align(trainer)
    dataset, work = trainer.refined_dataset(), options.work_dir
    if trainer.config.summed:
        return _evaluate_unwritable(trainer, options, started)
    scene, pictures = to_scene(trainer), _select_cameras(dataset)
    refine = trainer.config.refine if setting.refined == "none" else setting.refined
    described = replace(
        options,
        audio=setting.sound_from,
        refine=Options.refine if refine == "none" else refine,
        # Ctrl-C or the time budget may have ended training at another step.
        steps=options.steps if trainer.step == trainer.config.steps else trainer.step,
    )
    dataset_sha256 = setting.dataset_sha256 or hash_dataset(setting.dataset)
    metadata = describe(described, dataset, scene, pictures, dataset_sha256)
    scene = replace(scene, metadata=metadata, sound=setting.sound)
    coding_from_s = working_s()
    coded = _code(trainer, scene, reserve_figures(options), setting.sharing)
    coding_s = working_s() - coding_from_s
    save_scene(coded.data, options.output, work)
    decoded = scene_io.read(options.output).dequantise()
    most = _most_tested(options, SceneRenderer(decoded), trainer)
    test = evaluate(decoded, dataset, most=most, label="testing the coded file", parts=True)
    uncoded = evaluate(scene, dataset, most=most, label="testing the model")
    if test is not None and not decoded.appearances:
        trained_psnr = training_psnr(decoded, dataset, min(test.pictures, TRAINING_PICTURES))
        if warning := describe_overfitting(test.psnr, trained_psnr):
            log(warning)
    figures = {
        **_test_figures(test, dataset),
        "coding_loss_db": uncoded.psnr - test.psnr if test and uncoded else coded.loss_db,
    }
    data = with_metadata(coded.data, with_figures(metadata, figures))
    size = save_scene(data, options.output, work)
    if not options.keep:
        clear_work_folder(work, options.cache)
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
        "refine": refine,
        "corrections": [asdict(one) for one in corrections],
        "sound": None if setting.sound is None else setting.sound_from,
        **figures,
        **coding_figures(coded, size, options.trade, "training views"),
        "steps": trainer.step,
        "train_s": trainer.elapsed_s,
        "coding_s": coding_s,
        "encode_s": time.monotonic() - started,
        "rays_per_s": trainer.rays_per_second,
        "peak_memory_bytes": peak_memory_bytes(),
    }


def _align(trainer: Trainer) -> list[Correction]:
    """Align held-out cameras with the scene, and log the corrections of all, where cameras are refined."""
    if trainer.cameras is None:
        return []
    trainer.align_held_out()
    corrections = trainer.cameras.corrections()
    log(*describe_corrections(corrections, 1 / trainer.dataset.clip.fps).split("\n"))
    return corrections


def _most_tested(options: Options, renderer: SceneRenderer, trainer: Trainer) -> int:
    """Return the most held-out pictures to test; log where the training time limits them."""
    if options.test_views is not None:
        return options.test_views
    most = affordable_pictures(trainer.elapsed_s, picture_seconds(renderer, trainer.dataset))
    total = int(trainer.dataset.pictures.is_test.sum())
    if most < total:
        log(f"testing {most} of {total} held-out pictures, to save time; --test-views all tests them all")
    return most


def _test_figures(test: Quality | None, dataset: Dataset) -> dict[str, Any]:
    return {
        "test_psnr": test and test.psnr,
        "test_ssim": test and test.ssim,
        "test_psnr_moving": test and test.moving_psnr,
        "test_psnr_still": test and test.still_psnr,
        "test_pictures": test.pictures if test else 0,
        "held_out_pictures": int(dataset.pictures.is_test.sum()),
    }


def _code(trainer: Trainer, scene: Scene, options: Options, sharing: Sharing | None) -> CodedModel:
    """Code a trained scene, and keep its finished checkpoint where asked for."""
    tune_steps = options.tune_steps
    if tune_steps is None:
        settled = () if sharing is None else sharing.settled.keys()
        tune_steps = steps_per_group(trainer.step, scene, trainer.config.tune_steps, settled)
    log(describe_occupancy(scene))
    if tune_steps:
        log(f"fine-tuning: {counted(tune_steps, 'step')} after each group of planes that is coded")
    effort = trainer.config.coding_effort(trainer.step)
    if effort < 1:
        log(f"coding: at {effort:.0%} of the usual effort, after {trainer.step:,} steps of {options.preset}")
    validation = ValidationRays.from_training_views(trainer.sampler, trainer.background, effort)
    if options.keep_checkpoint is not None:
        save_checkpoint(options.keep_checkpoint, scene, validation)
    coded = code(
        Model(scene, validation, shown=True, effort=effort, sharing=sharing),
        options.trade,
        trainer.config.prune_share,
        tune_steps,
    )
    if coded.pruned is not None:
        log(*describe_pruning(scene, coded.pruned, coded.spare_db).split("\n"))
    return coded


def _evaluate_unwritable(trainer: Trainer, options: Options, started: float) -> dict[str, Any]:
    """Return what was measured on a model that no file can hold; fewer figures than `encode_scene` returns."""
    scene = to_scene(trainer)
    most = _most_tested(options, SceneRenderer(scene, trainer.field), trainer)
    test = evaluate(
        scene, trainer.refined_dataset(), most=most, field=trainer.field, label="testing the model", parts=True
    )
    if not options.keep:
        clear_work_folder(options.work_dir, options.cache)
    return {
        "file": str(options.output),
        "device": str(trainer.device),
        "seed": options.seed,
        "steps": trainer.step,
        **_test_figures(test, trainer.dataset),
        "refine": trainer.config.refine,
        "train_s": trainer.elapsed_s,
        "encode_s": time.monotonic() - started,
    }


def to_scene(trainer: Trainer) -> Scene:
    """Return the trained field with its final occupancy and a selection of the cameras, the most central first."""
    dataset = trainer.refined_dataset()
    slots = min(MAX_SLOTS, dataset.clip.frame_count) if dataset.is_dynamic else 1
    occupancy = merge_slots(
        trainer.grid.sample_slots(trainer.density_at, np.random.default_rng(trainer.config.seed), slots)
    )
    return replace(trainer.scene(occupancy), cameras=tuple(dataset.camera(p) for p in _select_cameras(dataset)))


def _select_cameras(dataset: Dataset) -> list[int]:
    """Return pictures of distinct cameras, at most MAX_CAMERAS, the one nearest to their mean position first."""
    _, first = np.unique(dataset.pictures.camera, return_index=True)
    first = np.sort(first)
    if len(first) > MAX_CAMERAS:
        first = first[np.linspace(0, len(first) - 1, MAX_CAMERAS).round().astype(int)]
    centres = dataset.pictures.camera_to_world[first, :3, 3]
    central = int(np.argmin(np.linalg.norm(centres - centres.mean(0), axis=1)))
    return [int(first[central])] + [int(p) for i, p in enumerate(first) if i != central]


def _train(trainer: Trainer, checkpoint: Path, options: Options) -> None:
    """Train to the end, or until Ctrl-C, which waits for the current step, but not for the first and its kernels.

    Raises:
        Abandoned: Ctrl-C came in the first step, or a second one before the step's end.
        KeyboardInterrupt: the step has ended after a Ctrl-C.
    """
    requests: list[int] = []
    begun = trainer.step
    preview = None if options.preview is None else Preview(trainer.dataset, options.preview)

    def note(number: int, _: Any) -> None:
        if requests:
            raise Abandoned
        if trainer.step == begun:
            interrupts.handle()
        else:
            interrupts.heard()
            requests.append(number)

    def report(state: Report) -> None:
        if preview is not None:
            preview.update(trainer, state.step)
        show_progress(progress, state)  # after the first preview, whose time must not be extrapolated

    with Progress("training", total=100, unit="%") as progress, handle_signals(note):
        try:
            trainer.run(report, checkpoint, time_budget_s=options.time_budget_s, interrupted=lambda: bool(requests))
        except KeyboardInterrupt as error:
            if requests:
                raise
            raise Abandoned from error
    if preview is not None:
        preview.write(trainer, trainer.step)


def _wants_partial(trainer: Trainer, checkpoint: Path, may_ask: bool) -> bool:
    """After Ctrl-C, log how to resume; on a terminal, ask whether to write the scene as trained so far."""
    log(f"stopped at step {trainer.step}; {checkpoint} is kept, go on with --resume")
    if not may_ask or not (sys.stdin.isatty() and sys.stderr.isatty()) or trainer.step < 2:
        return False
    print("write the scene as trained so far? [y/N] ", end="", file=sys.stderr, flush=True)
    return sys.stdin.readline().strip().lower() in ("y", "yes")


@contextlib.contextmanager
def handle_signals(handler: Callable[[int, Any], None]) -> Iterator[None]:
    """Send Ctrl-C and SIGTERM alike to `handler`, unless they are ignored. Has an effect in the main thread only."""
    numbers = [n for n in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(n) is not signal.SIG_IGN]
    if threading.current_thread() is not threading.main_thread():
        numbers = []
    before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier)
