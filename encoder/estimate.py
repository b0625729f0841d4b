"""What an encode will take, from its first steps: `kpenc --dry-run`."""

import time
from dataclasses import dataclass

import numpy as np

from kpc.encoder.compress import PROBES
from kpc.encoder.evaluate import SceneRenderer
from kpc.encoder.prune import renderings
from kpc.encoder.train import Trainer
from kpc.format.memory import peak_memory_bytes

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


def estimate(trainer: Trainer, probe_rays: int, tested: int, spent_s: float, time_budget_s: float | None) -> Estimate:
    """Take the first steps of a run, the same that it will take, and go on in thought.

    Args:
        probe_rays: rays on which each try of a quantisation is judged.
        tested: held-out pictures that will be rendered.
        spent_s: seconds since the command started, a survey excluded: they will be spent again.

    Raises:
        TrainingError: as `Trainer.run`.
    """
    config = trainer.config
    watched = min(config.steps, STEPS * config.occupancy_start)
    ticks: list[float] = []
    trainer.run_to(watched, lambda: ticks.append(trainer.elapsed_s))
    half = len(ticks) // 2
    a_step = (trainer.elapsed_s - ticks[half]) / max(1, len(ticks) - 1 - half)
    train_s = time_budget_s or trainer.elapsed_s + a_step * (config.steps - trainer.step)

    pixels = trainer.dataset.pictures.width.astype(np.int64) * trainer.dataset.pictures.height
    probes = PROBES + (renderings(trainer.field.layout.features) if config.prunes else 0)
    rendered = (probes + 1) * probe_rays + 2 * tested * float(pixels.mean())
    fits_s = 2 * tested * _seconds_a_fit(trainer) if trainer.names and tested else 0.0
    memory = peak_memory_bytes() + COPIES * 4 * trainer.field.theta.numel()
    return Estimate(train_s, spent_s + rendered * _seconds_a_ray(trainer) + fits_s, memory)


def _seconds_a_fit(trainer: Trainer) -> float:
    """Finding the appearance of a held-out picture."""
    renderer, held_out = SceneRenderer(trainer.scene()), np.flatnonzero(trainer.dataset.pictures.is_test)
    started = time.perf_counter()
    renderer.code_of_left_half(trainer.dataset, int(held_out[0]))
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
