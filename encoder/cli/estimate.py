"""Estimate of what an encode will take, from its first steps: `kpenc --dry-run`."""

import time
from dataclasses import dataclass, replace

import numpy as np

from kpc.encoder.evaluation.evaluate import SceneRenderer
from kpc.encoder.evaluation.testing_time import TIMED_RAYS, affordable_pictures, picture_seconds, ray_seconds
from kpc.encoder.evaluation.validation_rays import ValidationRays
from kpc.encoder.rdo.curvature import RAYS as CURVATURE_RAYS
from kpc.encoder.rdo.curvature import estimate_curvature
from kpc.encoder.rdo.mode_decision import quantise_by_cost
from kpc.encoder.rdo.occupancy_rdo import flip_errors
from kpc.encoder.rdo.prune import max_renderings
from kpc.encoder.rdo.rate_control import RENDERINGS
from kpc.encoder.rdo.sequential_finetune import RAYS, steps_per_group, total_steps
from kpc.encoder.training.train import Trainer
from kpc.format.common.compiling import MONITOR
from kpc.format.common.memory import peak_memory_bytes
from kpc.format.scene.scene import Scene

TUNED_CODINGS = 2  # codings that are fine-tuned, about
STEPS = 6  # steps watched, in multiples of the first with an occupancy grid: by then the time per step has settled
COPIES = 4  # copies of the planes that coding adds to training: trained, quantised, decoded and rendered


@dataclass(frozen=True)
class Estimate:
    """An estimate of an encode.

    Attributes:
        train_s: seconds of training.
        test_s: seconds of testing on held-out pictures.
        rest_s: seconds of all else that comes before and after.
        memory_bytes: peak memory.
        test_pictures: held-out pictures that are tested.
        held_out_pictures: all held-out pictures.
        disk_bytes: decoded pixels.
    """

    train_s: float
    test_s: float
    rest_s: float
    memory_bytes: int
    test_pictures: int
    held_out_pictures: int
    disk_bytes: int = 0


def estimate(
    trainer: Trainer,
    validation_rays: int,
    test_views: int | None,
    spent_s: float,
    time_budget_s: float | None,
    tune_steps: int | None = None,
) -> Estimate:
    """Take the first steps of a run, as the run itself would, and extrapolate.

    Args:
        trainer: ready for the first step.
        validation_rays: rays on which each attempt at a quantisation is judged.
        test_views: as in `Options`.
        spent_s: seconds since the command started, without a survey: they will be spent again.
        time_budget_s: of training; None for `TrainConfig.steps` steps.
        tune_steps: steps of fine-tuning per group of planes; None for as many as the length of training permits.

    Raises:
        TrainingError: as for `Trainer.run`.
    """
    config = trainer.config
    train_s, step_s = _estimate_training(trainer, time_budget_s)
    renderings = RENDERINGS + (max_renderings(trainer.field.layout.features) if config.prunes else 0)
    memory = peak_memory_bytes() + COPIES * 4 * trainer.field.theta.numel()
    scene = trainer.scene()
    coding_s, ray_s = _time_coding(scene), _time_ray(trainer)
    trained = float(config.steps)
    if time_budget_s is not None:
        trained = trainer.step + max(0.0, time_budget_s - trainer.elapsed_s) / max(step_s, 1e-6)
    effort = config.coding_effort(trained)
    all_coding_s = RENDERINGS * coding_s + effort * _time_curvature(scene)
    all_coding_s += effort * (renderings + 1) * validation_rays * ray_s
    if tune_steps is None:
        tune_steps = steps_per_group(int(trained), scene, config.tune_steps)
    if steps := total_steps(scene, tune_steps):
        trained_ray_s = 1 / trainer.rays_per_second if trainer.rays_per_second else 3 * ray_s
        all_coding_s += TUNED_CODINGS * (coding_s + steps * RAYS * (trained_ray_s + ray_s))
    picture_s = picture_seconds(SceneRenderer(scene), trainer.dataset)
    held_out = int(trainer.dataset.pictures.is_test.sum())
    tested = min(held_out, affordable_pictures(train_s, picture_s) if test_views is None else test_views)
    disk_bytes = trainer.dataset.pixels.disk_bytes
    return Estimate(train_s, tested * picture_s, spent_s + all_coding_s, memory, tested, held_out, disk_bytes)


def _estimate_training(trainer: Trainer, time_budget_s: float | None) -> tuple[float, float]:
    """Train a little; return the seconds of the whole training, and of a late step."""
    config = trainer.config
    watched = min(config.steps, STEPS * config.occupancy_start)
    step_s = _time_step(trainer, watched)
    coarse_steps, coarse_s = 0.0, 0.0
    if config.coarse_until > 0 and trainer.step < config.steps:
        coarse_steps = max(0.0, config.coarse_until * config.steps - trainer.step)
        coarse_s = coarse_steps * step_s
        trainer.optimiser.config = replace(config, coarse_until=0.0)
        step_s = _time_step(trainer, min(config.steps, 2 * watched))
    remaining = max(0.0, config.steps - trainer.step - coarse_steps)
    return time_budget_s or trainer.elapsed_s + coarse_s + step_s * remaining, step_s


def _time_step(trainer: Trainer, until: int) -> float:
    """Train until a step; return the seconds of a step in the second half of the way."""
    ticks: list[float] = []
    trainer.run_until(until, lambda: ticks.append(trainer.elapsed_s))
    half = len(ticks) // 2
    return (trainer.elapsed_s - ticks[half]) / max(1, len(ticks) - 1 - half)


def _time_coding(scene: Scene) -> float:
    """Return the seconds of choosing a scene's symbols once."""
    steps = [{name: np.full(plane.shape[-1], 2.0**-6) for name, plane in scale.items()} for scale in scene.scales]
    started, compiling_s = time.perf_counter(), MONITOR.spent_s
    quantise_by_cost(scene, steps)
    return time.perf_counter() - started - (MONITOR.spent_s - compiling_s)


def _time_curvature(scene: Scene) -> float:
    """Return the seconds of estimating what errors cost (planes and occupancy), from a sixteenth of the rays."""
    validation = ValidationRays.from_cameras(scene, CURVATURE_RAYS // 16)
    estimate_curvature(scene, validation, 2)  # compiles
    started = time.perf_counter()
    estimate_curvature(scene, validation, CURVATURE_RAYS // 16)
    flip_errors(scene, validation.subset(np.arange(2)), 16)
    return 16 * (time.perf_counter() - started)


def _time_ray(trainer: Trainer) -> float:
    """Return the seconds of rendering a ray."""
    batch, _ = trainer.sampler.draw(np.random.default_rng(0), TIMED_RAYS, trainer.background)
    return ray_seconds(
        SceneRenderer(trainer.scene()), *(a.numpy() for a in (batch.origins, batch.directions, batch.times))
    )
