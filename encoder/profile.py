"""Where the time of a training step goes, and how near the kernels come to what the machine can do: `kpbench step`."""

import copy
import os
import statistics
import time
from dataclasses import replace
from typing import Any

import torch

from kpc.encoder.field import Layout
from kpc.encoder.optimisers import PlainOptimiser
from kpc.encoder.train import Trainer

STEPS = 8
"""Steps before the profile, in multiples of the first with an occupancy grid: the grid has formed, and been split in time."""
ROUNDS = 3
FUSED_STEPS = 50
"""Each round takes so many steps as training does, then one in plain PyTorch on the same kind of batch."""


def profile(trainer: Trainer) -> dict[str, Any]:
    """Train for a while, then watch; what was found, in SI units and a step each, as a dictionary that JSON can hold.

    Both optimisers work on the same field, grid and number of rays, by turns, with all cores.

    Raises:
        ValueError: the run has fewer steps than that takes. TrainingError: as `Trainer.run`.
    """
    config = trainer.config
    if config.steps < STEPS * config.occupancy_start + ROUNDS * FUSED_STEPS:
        raise ValueError(f"{config.steps} steps are too few to profile one")
    trainer.optimiser.config = replace(config, coarse_until=0.0)  # as in most of the run
    trainer.run_to(STEPS * config.occupancy_start)
    plain = PlainOptimiser(copy.deepcopy(trainer.field), config, trainer.grid.seen.shape, trainer.mapping)
    fused_s, plain_s, parts, samples, rays = [], [], [], [], 0
    for _ in range(ROUNDS):
        before = dict(trainer.watch.seconds)
        started = trainer.elapsed_s
        trainer.run_to(trainer.step + FUSED_STEPS)
        fused_s.append((trainer.elapsed_s - started) / FUSED_STEPS)
        parts.append({name: (s - before.get(name, 0.0)) / FUSED_STEPS for name, s in trainer.watch.seconds.items()})
        rays = trainer.rays_a_step
        samples.append(trainer.samples_per_ray)
        plain_s.append(_plain_step(trainer, plain, rays))
    flops, bytes_ = work(trainer.field.layout, rays * statistics.median(samples))
    kernel_s = statistics.median(part["kernel"] for part in parts)
    return {
        "rays": rays, "samples_per_ray": statistics.median(samples), "parameters": trainer.field.theta.numel(),
        "step_s": statistics.median(fused_s), "plain_step_s": statistics.median(plain_s),
        "rays_per_s": rays / statistics.median(fused_s), "plain_rays_per_s": rays / statistics.median(plain_s),
        "parts_s": {name: statistics.median(part[name] for part in parts) for name in parts[0]},
        "kernel_gflops": flops / kernel_s / 1e9, "kernel_gb_s": bytes_ / kernel_s / 1e9,
    }  # fmt: skip


def work(layout: Layout, samples: float) -> tuple[float, float]:
    """What `kernels.backpropagate` has to do for so many samples at least: float operations, and bytes of texels read or written.

    With P planes a scale and F = S M features, a sample takes 8 P F to interpolate and as many to give the gradient back, P F to
    multiply, 14 F for the product's derivatives, 6 F for the density and 18 F for three colours, each with its gradient. It reads
    four texels of 4 F bytes a plane, and reads and writes as much of the gradient.
    """
    planes, F = (6 if layout.is_dynamic else 3), layout.features
    return samples * F * (17 * planes + 38), samples * 48 * planes * F


def _plain_step(trainer: Trainer, plain: PlainOptimiser, count: int) -> float:
    """Seconds of a step with `count` rays, the field's decoder included, by as many threads as the machine has cores."""
    batch, targets = trainer.sampler.draw(trainer.rng, count, None if trainer.dataset.has_alpha else trainer.background)
    threads = torch.get_num_threads()
    torch.set_num_threads(os.cpu_count() or 1)
    try:
        started = time.perf_counter()
        plain.step(trainer.step, 1.0, 1e-3, batch, targets, trainer.aabb, trainer.grid.marched, trainer.step_length, trainer.extent)
        return time.perf_counter() - started
    finally:
        torch.set_num_threads(threads)
