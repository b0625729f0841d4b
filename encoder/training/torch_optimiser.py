"""One training step in PyTorch: on a GPU; and on the CPU for what `FusedOptimiser` does not serve."""

import contextlib
import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
import torch

from kpc.encoder.field.config import TrainConfig, Variation
from kpc.encoder.field.field import Field
from kpc.encoder.field.fused import fused_features, max_samples_per_ray, sample_rays_fused
from kpc.encoder.field.kernels import RAY_GRADIENTS
from kpc.encoder.field.priors import appearance_priors, motion_priors, plane_priors
from kpc.encoder.field.proposals import ProposalLevel, Proposals, histogram_loss
from kpc.encoder.field.render import Rays, Samples, follow_rays, sample_rays, select_reached, shade, weigh_samples
from kpc.encoder.training.cuda_graphs import GraphCache
from kpc.encoder.training.line_steps import line_steps
from kpc.encoder.training.optimisers import (
    Stopwatch,
    add_prior_gradients,
    decoder_optimiser,
    feature_mask,
    make_adam,
    set_rate,
    total,
)
from kpc.format.scene.space import SpaceMapping

# On a GPU a step has a fixed capacity for samples: CAPACITY times the number in recent steps when it is set. It is set
# anew once it is below MIN_CAPACITY or above MAX_CAPACITY times that number.
CAPACITY, MIN_CAPACITY, MAX_CAPACITY = 1.125, 1.04, 1.35

# Capacities are multiples of this: PyTorch reuses memory of equal sizes.
CAPACITY_UNIT = 8192


class DeferredReadback:
    """Reads small tensors from a GPU LATE calls after they were made, so that nobody waits; from a CPU at once."""

    LATE = 8

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self._waiting: deque[tuple[torch.Tensor, torch.cuda.Event]] = deque()

    def read(self, made: torch.Tensor) -> list[float]:
        """Return the values of what was made LATE calls ago; of the first as long as there have been fewer calls."""
        if self.device.type == "cpu":
            return made.tolist()  # type: ignore[no-any-return]
        host = torch.empty_like(made, device="cpu", pin_memory=True).copy_(made, non_blocking=True)
        done = torch.cuda.Event()
        done.record()
        self._waiting.append((host, done))
        host, done = self._waiting.popleft() if len(self._waiting) > self.LATE else self._waiting[0]
        done.synchronize()
        return host.tolist()  # type: ignore[no-any-return]


@dataclass(frozen=True)
class StepPlan:
    """What a step of `TorchOptimiser` depends on besides tensors.

    Attributes:
        number: of the step where proposals are sampled, for their annealing; else 0.
        step_length, extent: as in `FusedOptimiser.step`.
        moving: whether the motion grid is trained in this step.
        variation: the total variation of the planes; None where their priors take no part in this step.
        most: the most samples that a ray can take.
        capacities: on a GPU, of samples taken and of samples reached; None on the CPU, where shapes depend on the data.
    """

    number: int
    step_length: float
    extent: float
    moving: bool
    variation: Variation | None
    most: int
    capacities: tuple[int, int] | None


class TorchOptimiser:
    """A step in PyTorch on any device; on the CPU with the kernels for the planes where `fused`.

    On a GPU nothing in a step waits for it: shapes do not depend on what it computes, and `step` returns numbers of
    some steps before. Steps that repeat are captured as CUDA graphs (`kpc.encoder.training.cuda_graphs`).

    Attributes:
        timers: seconds spent, by part of a step.
        ray_gradients: as of `FusedOptimiser`; a GPU is waited for, and runs operation by operation, to have them.
    """

    def __init__(
        self,
        field: Field,
        config: TrainConfig,
        cells: tuple[int, int, int],
        mapping: SpaceMapping | None = None,
        *,
        fused: bool = False,
        proposals: Proposals | None = None,
    ) -> None:
        """`cells`: (Nz, Ny, Nx) of the occupancy grid. `proposals`: sample by them rather than by the grid."""
        self.field, self.config, self.mapping, self.proposals = field, config, mapping, proposals
        self.timers = Stopwatch()
        self.device = field.theta.device
        self._on_gpu = self.device.type != "cpu"
        self._refines = config.refine != "none"
        self.ray_gradients = np.zeros((1, RAY_GRADIENTS), np.float32)
        self._captures = self._on_gpu and proposals is None and not self._refines
        self._cells = cells
        self._peaks = torch.zeros(cells, device=self.device)
        self._readback = DeferredReadback(self.device)
        self._taken_per_ray = self._reached_per_ray = math.inf
        self._capacities = (0, 0)
        self._occupancy: tuple[np.ndarray, torch.Tensor] | None = None
        self._aabb: torch.Tensor | None = None
        self.fused = fused
        self.features = fused_features(field) if fused else field.features
        if fused:
            numba.get_num_threads()  # starts numba's threads, which would undo the next line
            torch.set_num_threads(1)  # more threads add gradients in any order: no run would be reproducible
        self.fields: list[Field] = [field] if proposals is None else [field, *proposals.fields]
        for each in self.fields:
            each.mixed = config.mixed_precision and self._on_gpu
        self.planes = make_adam([([each.theta for each in self.fields], config.learning_rate)])
        self.decoder = decoder_optimiser(field, config, [each.density for each in self.fields[1:]])
        self.lines = line_steps(field, config)
        optimisers = self.planes, self.decoder
        self._graphs = GraphCache(
            [p for optimiser in optimisers for group in optimiser.param_groups for p in group["params"]]
        )

    @contextlib.contextmanager
    def eager(self) -> Iterator[None]:
        """Run steps operation by operation, without CUDA graphs, while it lasts."""
        captures, self._captures = self._captures, False
        try:
            yield
        finally:
            self._captures = captures

    def peaks(self) -> np.ndarray:
        """Return what `FusedOptimiser.peaks` does."""
        peaks = self._peaks.cpu().numpy().copy()
        self._peaks.zero_()
        return peaks

    def step(
        self,
        number: int,
        fraction: float,
        rate: float,
        batch: Rays,
        targets: torch.Tensor,
        aabb: np.ndarray,
        occupancy: np.ndarray,
        step_length: float,
        extent: float,
    ) -> tuple[float, float]:
        """Do what `FusedOptimiser.step` does."""
        config, rays = self.config, len(targets)
        variation = config.variation(fraction) if number % config.regularise_every == 0 else None
        most = max_samples_per_ray(aabb, step_length, self.mapping)
        plan = StepPlan(
            number if self.proposals is not None else 0,
            step_length,
            extent,
            self.field.motion is not None and number % config.motion_every == 0,
            variation,
            most,
            self._capacities_for(rays, most) if self._on_gpu else None,
        )
        with self.timers("moves"):
            if self._aabb is None:
                self._aabb = self._to_device(torch.from_numpy(aabb))
            if self._occupancy is None or self._occupancy[0] is not occupancy:
                self._occupancy = occupancy, self._to_device(torch.from_numpy(occupancy))
            mask = feature_mask(self.field, config, number, fraction)
            numbers = [] if batch.appearances is None else [self._to_device(batch.appearances)]
            inputs = [
                self._to_device(_pack(batch, targets)),
                self._to_device(mask),
                self._occupancy[1],
                *numbers,
            ]
        with self.timers("gradient"):
            for optimiser in (self.planes, self.decoder):
                optimiser.zero_grad()
                set_rate(optimiser, rate)

            def work(*inputs: torch.Tensor) -> torch.Tensor:
                return self._backpropagate(plan, *inputs)

            figures = self._graphs.run(plan, inputs, work) if self._captures else work(*inputs)
        with self.timers("priors"):
            for each in self.fields if variation is not None and self.fused else ():
                theta, grad = each.theta.detach().numpy(), each.theta.grad.numpy()  # type: ignore[union-attr]
                add_prior_gradients(each, theta, grad, config, variation, config.regularise_every)  # type: ignore[arg-type]
        if self.lines is not None:
            with self.timers("lines"):
                self.lines.step(rate)
        with self.timers("adam"):
            self.planes.step()
            self.decoder.step()
        squared_error, self._taken_per_ray, self._reached_per_ray = self._readback.read(figures)
        return squared_error, self._reached_per_ray

    def _backpropagate(
        self,
        plan: StepPlan,
        packed: torch.Tensor,
        mask: torch.Tensor,
        occupancy: torch.Tensor,
        appearances: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """Set all gradients and raise the peaks; return the mean squared error, samples per ray taken, and reached."""
        field, config = self.field, self.config
        batch, targets = _unpack(packed, appearances)
        assert self._aabb is not None
        levels: list[ProposalLevel] = []
        fixed = batch
        if self._refines:
            batch = batch.map(lambda values: values.detach().requires_grad_(values.is_floating_point()))
        if self.proposals is None:
            samples = self._sample(plan, fixed, occupancy)
        else:
            samples, edges, levels = self.proposals.sample(
                fixed, self._aabb, self.mapping, self._cells, plan.number, self.fused
            )
        taken = (samples.length > 0).sum()
        if plan.capacities is not None and self.proposals is None:
            # About half of the samples lie behind the end of their ray: they are left out of the gradient.
            with torch.no_grad():
                weighed = weigh_samples(field, batch, samples, self.features, plan.extent, mask)
            samples = select_reached(samples, weighed.reached & (samples.length > 0), plan.capacities[1])
        if self._refines:
            samples = follow_rays(samples, batch, self._aabb, self.mapping)
        weighed = weigh_samples(field, batch, samples, self.features, plan.extent, mask)
        colours = shade(field, batch, weighed)
        if self._refines:
            colours.retain_grad()
        error = (colours - targets).square().mean()
        loss = error + config.distortion * weighed.distortion
        for level in levels:
            loss = loss + config.histogram * histogram_loss(edges, weighed.weights.view(len(targets), -1), level)
        if plan.moving:
            loss = loss + total(motion_priors(field, config))
        if field.codes is not None:
            loss = loss + total(appearance_priors(field, config))
        for each in self.fields if plan.variation is not None and not self.fused else ():
            loss = loss + config.regularise_every * total(plane_priors(each, config, plan.variation))  # type: ignore[arg-type]
        loss.backward()  # type: ignore[no-untyped-call]
        if field.motion is not None and not plan.moving:
            field.motion.grad = None
        if self._refines:
            parts = batch.origins, batch.directions, batch.times, colours
            found = [_gradient(values).view(len(targets), -1) for values in parts]
            self.ray_gradients = torch.cat(found, dim=1).cpu().numpy()
        _, ny, nx = self._cells
        flat = (samples.cell[:, 0] * ny + samples.cell[:, 1]) * nx + samples.cell[:, 2]
        self._peaks.view(-1).scatter_reduce_(0, flat, weighed.weights.detach(), "amax")
        counts = torch.stack([taken, (weighed.reached & (samples.length > 0)).sum()]) / len(targets)
        return torch.cat([error.detach()[None], counts])

    def _sample(self, plan: StepPlan, batch: Rays, occupancy: torch.Tensor) -> Samples:
        """Return the samples of a batch in occupied cells."""
        assert self._aabb is not None
        if self.fused:
            return sample_rays_fused(batch, self._aabb.numpy(), occupancy.numpy(), plan.step_length, self.mapping)
        sizes = {} if plan.capacities is None else {"most": plan.most, "capacity": plan.capacities[0]}
        return sample_rays(batch, self._aabb, occupancy, plan.step_length, self.mapping, **sizes)

    def _capacities_for(self, rays: int, most: int) -> tuple[int, int]:
        """Return the capacities for samples taken and reached, the previous ones while they suit recent numbers."""
        taken = min(self._taken_per_ray * rays, most * rays, 3 * self.config.samples / CAPACITY)
        capacities = []
        for wanted, capacity in zip((taken, min(self._reached_per_ray * rays, taken)), self._capacities, strict=True):
            if not MIN_CAPACITY * wanted <= capacity <= MAX_CAPACITY * wanted:
                capacity = (int(CAPACITY * wanted) // CAPACITY_UNIT + 1) * CAPACITY_UNIT
            capacities.append(capacity)
        self._capacities = capacities[0], min(capacities)
        return self._capacities

    def _to_device(self, values: torch.Tensor) -> torch.Tensor:
        """Return values on the device without waiting for it, for which they have to be in pinned memory."""
        return values.pin_memory().to(self.device, non_blocking=True) if self._on_gpu else values

    def state(self) -> dict[str, Any]:
        """Return what a checkpoint holds of this optimiser."""
        return {
            "planes": self.planes.state_dict(),
            "decoder": self.decoder.state_dict(),
            "peaks": self._peaks,
            "lines": self.lines and self.lines.state(),
            "proposals": self.proposals and self.proposals.state_dict(),
        }

    def load(self, state: dict[str, Any]) -> None:
        """Take over what `state` returned."""
        self._peaks.copy_(state["peaks"])
        self.planes.load_state_dict(state["planes"])
        self.decoder.load_state_dict(state["decoder"])
        if self.lines is not None:
            self.lines.load(state["lines"])
        if self.proposals is not None:
            self.proposals.load_state_dict(state["proposals"])


def _pack(batch: Rays, targets: torch.Tensor) -> torch.Tensor:
    """Return rays and targets in one tensor (N, 14): each copy to a GPU takes its time, however little it copies."""
    columns = (
        batch.origins,
        batch.directions,
        batch.backgrounds,
        targets,
        batch.times[:, None],
        batch.jitters[:, None],
    )
    return torch.cat(columns, dim=1)


def _unpack(packed: torch.Tensor, appearances: torch.Tensor | None) -> tuple[Rays, torch.Tensor]:
    """Return what `_pack` was given."""
    origins, directions, backgrounds, targets, times, jitters = (
        part.contiguous() for part in packed.split([3, 3, 3, 3, 1, 1], dim=1)
    )
    return Rays(origins, directions, times[:, 0], jitters[:, 0], backgrounds, appearances), targets


def _gradient(values: torch.Tensor) -> torch.Tensor:
    """Return the gradient of a tensor; zeros if nothing depends on it."""
    return torch.zeros_like(values) if values.grad is None else values.grad
