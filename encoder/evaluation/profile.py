"""Profile of a training step: where its time goes, and how close the kernels come to the machine's limits.

Used by `kpbench step`.
"""

import copy
import math
import os
import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from kpc.encoder.field.layout import Layout
from kpc.encoder.training.torch_optimiser import TorchOptimiser
from kpc.encoder.training.train import Trainer

# Steps before the profile, in multiples of the first step with an occupancy grid: by then the grid has formed and has
# been split in time.
STEPS = 8
ROUNDS = 3
FUSED_STEPS = 50  # steps with the fused optimiser in a round; one step in plain PyTorch on a like batch follows


def profile(trainer: Trainer) -> dict[str, Any]:
    """Train until the occupancy grid has settled, then measure steps.

    On a CPU the fused optimiser and plain PyTorch take turns, on the same field, grid and number of rays, with all
    cores. On a GPU there is only one optimiser; its memory traffic is compared with the GPU's copy rate.

    Returns:
        The measurements, in SI units per step, as a dictionary that JSON can hold.

    Raises:
        ValueError: the run has too few steps.
        TrainingError: as for `Trainer.run`.
    """
    config = trainer.config
    if trainer.device.type != "cpu":
        return _profile_on_gpu(trainer)
    if config.steps < STEPS * config.occupancy_start + ROUNDS * FUSED_STEPS:
        raise ValueError(f"{config.steps} steps are too few to profile one")
    trainer.optimiser.config = replace(config, coarse_until=0.0)  # as in most of the run
    trainer.run_until(STEPS * config.occupancy_start)
    plain = TorchOptimiser(copy.deepcopy(trainer.field), config, trainer.grid.visible.shape, trainer.mapping)
    fused_s, plain_s, parts, samples, rays = [], [], [], [], 0
    for _ in range(ROUNDS):
        before = dict(trainer.timers.seconds)
        started = trainer.elapsed_s
        trainer.run_until(trainer.step + FUSED_STEPS)
        fused_s.append((trainer.elapsed_s - started) / FUSED_STEPS)
        parts.append({name: (s - before.get(name, 0.0)) / FUSED_STEPS for name, s in trainer.timers.seconds.items()})
        rays = trainer.rays_per_step
        samples.append(trainer.samples_per_ray)
        plain_s.append(_plain_step(trainer, plain, rays))
    flops, bytes_ = least_work(trainer.field.layout, rays * statistics.median(samples))
    kernel_s = statistics.median(part["kernel"] for part in parts)
    return {
        "device": "cpu",
        "rays": rays, "samples_per_ray": statistics.median(samples), "parameters": trainer.field.theta.numel(),
        "step_s": statistics.median(fused_s), "plain_step_s": statistics.median(plain_s),
        "rays_per_s": rays / statistics.median(fused_s), "plain_rays_per_s": rays / statistics.median(plain_s),
        "parts_s": {name: statistics.median(part[name] for part in parts) for name in parts[0]},
        "kernel_gflops": flops / kernel_s / 1e9, "kernel_gb_s": bytes_ / kernel_s / 1e9,
    }  # fmt: skip


def _profile_on_gpu(trainer: Trainer) -> dict[str, Any]:
    """Profile on a GPU. `bytes`: memory traffic of a step (`Traffic`); `memory_gb_s`: the device's copy rate."""
    config, optimiser = trainer.config, trainer.optimiser
    assert isinstance(optimiser, TorchOptimiser)
    if config.steps < STEPS * config.occupancy_start + (ROUNDS + 1) * FUSED_STEPS:
        raise ValueError(f"{config.steps} steps are too few to profile one")
    trainer.run_until(STEPS * config.occupancy_start)
    steps_s, moved = [], []
    for _ in range(ROUNDS):
        torch.cuda.synchronize()
        started = time.perf_counter()
        trainer.run_until(trainer.step + FUSED_STEPS)
        torch.cuda.synchronize()
        steps_s.append((time.perf_counter() - started) / FUSED_STEPS)
    rays = trainer.rays_per_step
    for _ in range(config.regularise_every):
        step = _prepare_step(trainer, optimiser, rays)
        with Traffic() as traffic, optimiser.eager():
            step()
        trainer.step += 1
        moved.append(traffic.bytes)
    step_s, bytes_ = statistics.median(steps_s), statistics.mean(moved)
    _, least = least_work(trainer.field.layout, rays * trainer.samples_per_ray)
    limit = _copy_rate()
    return {
        "device": torch.cuda.get_device_name(),
        "rays": rays, "samples_per_ray": trainer.samples_per_ray, "parameters": trainer.field.theta.numel(),
        "step_s": step_s, "rays_per_s": rays / step_s, "bytes": bytes_, "least_bytes": least,
        "memory_gb_s": limit / 1e9, "share_of_memory": bytes_ / step_s / limit,
        "least_share_of_memory": least / step_s / limit,
        "gpu_memory_bytes": torch.cuda.max_memory_allocated(),
    }  # fmt: skip


def _copy_rate() -> float:
    """Return the bytes a second that the GPU reads and writes when it copies more than fits its caches."""
    one = torch.empty(1 << 28, device="cuda")
    other, seconds = torch.empty_like(one), []
    for _ in range(10):
        torch.cuda.synchronize()
        started = time.perf_counter()
        other.copy_(one)
        torch.cuda.synchronize()
        seconds.append(time.perf_counter() - started)
    return 2 * one.nbytes / min(seconds)


class Traffic(TorchDispatchMode):
    """Counts the memory traffic of operations, as if no cache kept anything between two of them.

    Each operation's inputs are counted once and its outputs once; of a table only the rows that are looked up.

    Attributes:
        bytes: traffic so far.
    """

    LOOK_UPS = ("index", "index_select", "gather", "_embedding_bag", "_embedding_bag_forward_only")

    def __init__(self) -> None:
        super().__init__()
        self.bytes = 0.0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):  # type: ignore[no-untyped-def]
        out = func(*args, **(kwargs or {}))
        name = func.overloadpacket.__name__
        outputs = [a for a in tree_leaves(out) if isinstance(a, torch.Tensor)]
        inputs = [a for a in tree_leaves((args, kwargs)) if isinstance(a, torch.Tensor)]
        sparse = [a for a in inputs if a.layout == torch.sparse_csr]
        if func.is_view or any(a.layout == torch.sparse_csr for a in outputs):
            return out
        if sparse:  # each entry reads a row of the dense factor, its column index and its value
            self.bytes += sparse[0]._nnz() * (outputs[0].shape[1] + 2) * 4 + outputs[0].nbytes
        elif name in self.LOOK_UPS:
            rows_per_output = inputs[1].numel() / len(outputs[0]) if name.startswith("_embedding_bag") else 1
            self.bytes += sum(map(_bytes, inputs[1:])) + (1 + rows_per_output) * _bytes(outputs[0])
        else:
            self.bytes += sum(map(_bytes, [*inputs, *outputs]))
        return out


def _bytes(tensor: torch.Tensor) -> int:
    """Return the bytes of memory that a tensor covers; repeated elements (stride 0) count once."""
    numbers = math.prod(size for size, stride in zip(tensor.shape, tensor.stride(), strict=True) if stride)
    return numbers * tensor.element_size()


def least_work(layout: Layout, samples: float) -> tuple[float, float]:
    """Return a lower bound on what `kernels.backpropagate` has to do.

    With P planes per scale and F = S M features, a sample takes 8 P F operations to interpolate and as many to scatter
    the gradient, P F to multiply, 14 F for the product's derivatives, 6 F for the density and 18 F for three colours,
    each with its gradient. It reads four texels of 4 F bytes per plane, and reads and writes as much of the gradient.

    Args:
        layout: of the field.
        samples: number of samples along all rays.

    Returns:
        Floating-point operations, and bytes of texels read or written.
    """
    planes, F = (6 if layout.is_dynamic else 3), layout.features
    return samples * F * (17 * planes + 38), samples * 48 * planes * F


def _plain_step(trainer: Trainer, plain: TorchOptimiser, count: int) -> float:
    """Return the seconds of a step with `count` rays in plain PyTorch, with as many threads as there are cores."""
    step, threads = _prepare_step(trainer, plain, count), torch.get_num_threads()
    torch.set_num_threads(os.cpu_count() or 1)
    try:
        started = time.perf_counter()
        step()
        return time.perf_counter() - started
    finally:
        torch.set_num_threads(threads)


def _prepare_step(trainer: Trainer, optimiser: TorchOptimiser, count: int) -> Callable[[], object]:
    """Draw `count` rays and return a function that takes one step with them."""
    batch, targets = trainer.sampler.draw(trainer.rng, count, None if trainer.dataset.has_alpha else trainer.background)
    return partial(
        optimiser.step,
        trainer.step,
        1.0,
        1e-3,
        batch,
        targets,
        trainer.aabb,
        trainer.grid.active,
        trainer.step_length,
        trainer.extent,
    )
