"""What an encode will take, from its first steps: `kpenc --dry-run`."""

import time
from dataclasses import dataclass, replace

import numpy as np
from kpc.encoder.evaluation.evaluate import SceneRenderer
from kpc.encoder.evaluation.validation_rays import ValidationRays
from kpc.encoder.rdo.curvature import RAYS as CURVATURE_RAYS
from kpc.encoder.rdo.curvature import estimate_curvature
from kpc.encoder.rdo.mode_decision import quantise_by_cost
from kpc.encoder.rdo.occupancy_rdo import flip_errors
from kpc.encoder.rdo.prune import max_renderings
from kpc.encoder.rdo.rate_control import RENDERINGS
from kpc.encoder.rdo.sequential_finetune import RAYS, steps_per_group, total_steps
from kpc.encoder.training.train import Trainer
from kpc.format.common.memory import peak_memory_bytes
from kpc.format.scene.scene import Scene

TUNED = 2
"""Codings that are tuned, about."""

STEPS = 6
"""Steps watched, in multiples of the first with an occupancy grid: by then a step takes what it takes to the end."""

COPIES = 4
"""Of the planes, that coding and checking the file add to training: trained, quantised, decoded and rendered."""


@dataclass(frozen=True)
class Estimate:
    """Seconds of training, seconds of all that comes before and after, and bytes of memory at the peak."""

    train_s: float
    rest_s: float
    memory_bytes: int


def estimate(
    trainer: Trainer,
    probe_rays: int,
    tested: int,
    spent_s: float,
    time_budget_s: float | None,
    tune_steps: int | None = None,
) -> Estimate:
    """Take the first steps of a run, the same that it will take, and go on in thought.

    Args:
        probe_rays: rays on which each try of a quantisation is judged.
        tested: held-out pictures that will be rendered.
        spent_s: seconds since the command started, a survey excluded: they will be spent again.
        tune_steps: a group; None: as many as the length of training lets a run have.

    Raises:
        TrainingError: as `Trainer.run`.
    """
    config = trainer.config
    watched = min(config.steps, STEPS * config.occupancy_start)
    a_step = _seconds_a_step(trainer, watched)
    coarse_steps, coarse_s = 0.0, 0.0
    if config.coarse_until > 0 and trainer.step < config.steps:
        coarse_steps = max(0.0, config.coarse_until * config.steps - trainer.step)
        coarse_s = coarse_steps * a_step
        trainer.optimiser.config = replace(config, coarse_until=0.0)
        a_step = _seconds_a_step(trainer, min(config.steps, 2 * watched))
    train_s = time_budget_s or trainer.elapsed_s + coarse_s + a_step * max(
        0.0, config.steps - trainer.step - coarse_steps
    )

    pixels = trainer.dataset.pictures.width.astype(np.int64) * trainer.dataset.pictures.height
    probes = RENDERINGS + (max_renderings(trainer.field.layout.features) if config.prunes else 0)
    rendered = (probes + 1) * probe_rays + 2 * tested * float(pixels.mean())
    fits_s = 2 * tested * _seconds_a_fit(trainer) if trainer.names and tested else 0.0
    memory = peak_memory_bytes() + COPIES * 4 * trainer.field.theta.numel()
    scene = trainer.scene()
    a_coding, a_ray = _seconds_a_coding(scene), _seconds_a_ray(trainer)
    coding_s = RENDERINGS * a_coding + _seconds_of_errors(scene)
    if tune_steps is None:
        trained = (
            config.steps
            if time_budget_s is None
            else trainer.step + max(0.0, time_budget_s - trainer.elapsed_s) / max(a_step, 1e-6)
        )
        tune_steps = steps_per_group(int(trained), scene, config.tune_steps)
    if steps := total_steps(scene, tune_steps):
        a_trained_ray = 1 / trainer.rays_per_second if trainer.rays_per_second else 3 * a_ray
        coding_s += TUNED * (a_coding + steps * RAYS * (a_trained_ray + a_ray))
    return Estimate(train_s, spent_s + rendered * a_ray + coding_s + fits_s, memory)


def _seconds_a_step(trainer: Trainer, to: int) -> float:
    """Of a run, on the second half of its way to a step."""
    ticks: list[float] = []
    trainer.run_until(to, lambda: ticks.append(trainer.elapsed_s))
    half = len(ticks) // 2
    return (trainer.elapsed_s - ticks[half]) / max(1, len(ticks) - 1 - half)


def _seconds_a_coding(scene: Scene) -> float:
    """Choosing its symbols once."""
    steps = [{name: np.full(plane.shape[-1], 2.0**-6) for name, plane in scale.items()} for scale in scene.scales]
    started = time.perf_counter()
    quantise_by_cost(scene, steps)
    return time.perf_counter() - started


def _seconds_of_errors(scene: Scene) -> float:
    """What errors cost, `kpc.encoder.rdo.curvature` and `kpc.encoder.rdo.occupancy_rdo`: by a sixteenth of their rays."""
    probe = ValidationRays.from_cameras(scene, CURVATURE_RAYS // 16)
    estimate_curvature(scene, probe, 2)  # what is done once
    started = time.perf_counter()
    estimate_curvature(scene, probe, CURVATURE_RAYS // 16)
    flip_errors(scene, probe.subset(np.arange(2)), 16)
    return 16 * (time.perf_counter() - started)


def _seconds_a_fit(trainer: Trainer) -> float:
    """Finding the appearance of a held-out picture."""
    renderer, held_out = SceneRenderer(trainer.scene()), np.flatnonzero(trainer.dataset.pictures.is_test)
    started = time.perf_counter()
    renderer.fit_left_half(trainer.dataset, int(held_out[0]))
    return time.perf_counter() - started


def _seconds_a_ray(trainer: Trainer, count: int = 1 << 14) -> float:
    """Rendering, once compiled."""
    batch, _ = trainer.sampler.draw(np.random.default_rng(0), count, trainer.background)
    renderer = SceneRenderer(trainer.scene())
    rays = [a.numpy() for a in (batch.origins, batch.directions, batch.times)]
    renderer.rgb(*(a[:16] for a in rays))
    started = time.perf_counter()
    renderer.rgb(*rays)
    return (time.perf_counter() - started) / count
