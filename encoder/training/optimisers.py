"""One training step, on the CPU with the kernels alone or in PyTorch: render a batch, weigh what is wrong, move the field."""

import contextlib
import math
import time
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
import torch
from kpc.encoder.field import kernels
from kpc.encoder.field.config import TrainConfig, Variation
from kpc.encoder.field.field import Field, appearance_priors, motion_priors, priors
from kpc.encoder.field.proposals import ProposalLevel, Proposals, histogram_loss
from kpc.encoder.field.render import (
    Rays,
    Samples,
    fused_features,
    sample_rays,
    sample_rays_fused,
    select_reached,
    shade,
    weigh_samples,
)
from kpc.encoder.training.cuda_graphs import GraphCache
from kpc.format.scene.scene import SPACE_PLANES
from kpc.format.scene.space import Contraction, SpaceMapping

ROOM, LEAST_ROOM, MOST_ROOM = 1.125, 1.04, 1.35
"""Samples that a step on a GPU has room for, in multiples of those that there were some steps before: when it is set, and at which it is set
anew."""
ROOM_UNIT = 8192
"""Room for samples is a multiple of this: memory of a few sizes is used again."""

BETA1, BETA2, EPSILON = 0.9, 0.99, 1e-15
"""Adam's constants as Instant-NGP sets them for grids (arXiv:2201.05989, section 4)."""


class Stopwatch:
    """Seconds of wall clock by what they went to: `with watch("name"): ...`."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextlib.contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        started = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - started


def feature_mask(field: Field, config: TrainConfig, step: int, fraction: float) -> torch.Tensor:
    """Factors on the features for one step, at a fraction of the run, (F,) float32 on the CPU: 0 where `channel_dropout` leaves a
    channel out, at all scales alike, `scale_dropout` a scale and all finer ones, or `coarse_until` all but the coarsest.

    Of channels the others carry the weight: its mean over steps is 1. Not so of scales: what is coarse is to be a picture by itself.
    """
    M, scales = field.layout.channels, len(field.layout.resolution)
    rng = np.random.default_rng((config.seed, step))
    dropped = min(round(config.channel_dropout * M), M - 1) if fraction < config.dropout_until else 0
    factors = np.full((scales, M), M / (M - dropped), np.float32)
    factors[:, rng.permutation(M)[:dropped]] = 0
    if scales > 1 and rng.random() < config.scale_dropout:
        factors[rng.integers(1, scales) :] = 0
    if fraction < config.coarse_until:
        factors[1:] = 0
    return torch.from_numpy(factors.ravel())


class FusedOptimiser:
    """A step on the CPU: fused kernels for the planes, PyTorch for the small decoder."""

    def __init__(
        self, field: Field, config: TrainConfig, cells: tuple[int, int, int], mapping: SpaceMapping | None = None
    ) -> None:
        self.field, self.config, self.mapping = field, config, mapping
        self.watch = Stopwatch()
        self.workers = numba.get_num_threads()  # starts numba's threads, which would undo the next line
        torch.set_num_threads(
            1
        )  # the decoder is so small that sharing it out costs more, a hundredfold on a busy machine
        self.theta = field.theta.detach().numpy()
        self.grad = np.zeros((self.workers, self.theta.size), np.float32)
        self.mean, self.square = np.zeros_like(self.theta), np.zeros_like(self.theta)
        self._peaks = np.zeros((self.workers, *cells), np.float32)
        self.decoder = _decoder_optimiser(field, config)

    def peaks(self) -> np.ndarray:
        """The largest weight in each cell since the last call: (Nz, Ny, Nx) float32."""
        peaks = self._peaks.max(0)
        self._peaks[:] = 0
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
        """Mean squared error a colour channel, and samples a ray, of step `number` at a fraction of the run, with learning rates times
        `rate`."""
        layout, config = self.field.layout, self.config
        with self.watch("decoder"):
            kept = feature_mask(self.field, config, number, fraction)
            scales = int(kept.view(-1, layout.channels).any(1).sum())  # the finer ones take no part, nor any time
            F = scales * layout.channels
            kept = kept[:F]
            basis = self.field.b2[None]
            if config.view_dependent:
                basis = self.field.basis(batch.directions, self.field.appearance_codes(batch.appearances))
            basis = (basis[..., :F] * kept).contiguous()
            density = torch.cat([self.field.density.detach()[:F] * kept, self.field.density.detach()[-1:]])
            grad_basis = np.zeros((len(basis) if config.view_dependent else self.workers, *basis.shape[1:]), np.float32)
            grad_density = np.zeros((self.workers, F + 1), np.float32)
            motion = motion_array(self.field)
            grad_motion = None if motion is None else np.zeros((self.workers, *motion.shape), np.float32)
            moving = motion is not None and number % config.motion_every == 0
        with self.watch("kernel"):
            errors, counts = kernels.backpropagate(
                self.theta,
                self.grad,
                layout.table[:scales],
                layout.resolution[:scales],
                density.numpy(),
                grad_density,
                layout.channels,
                motion,
                grad_motion,
                moving,
                aabb,
                kernels.even_of(self.mapping),
                occupancy.view(np.uint8),
                np.float32(step_length),
                np.float32(extent),
                batch.origins.numpy(),
                batch.directions.numpy(),
                batch.times.numpy(),
                batch.jitters.numpy(),
                basis.detach().numpy(),
                grad_basis,
                targets.numpy(),
                batch.backgrounds.numpy(),
                self._peaks,
                np.float32(config.distortion),
                max_samples_per_ray(aabb, step_length, self.mapping),
            )
        with self.watch("priors"):
            if number % config.regularise_every == 0:
                add_prior_gradients(
                    self.field, self.theta, self.grad[0], config, config.variation(fraction), config.regularise_every
                )
        with self.watch("decoder"):
            self.decoder.zero_grad()
            basis.backward(torch.from_numpy(grad_basis if config.view_dependent else grad_basis.sum(0, keepdims=True)))
            by_weight = torch.from_numpy(grad_density.sum(0))
            self.field.density.grad = torch.zeros_like(self.field.density)
            self.field.density.grad[:F] = by_weight[:-1] * kept
            self.field.density.grad[-1] = by_weight[-1]
            if self.field.codes is not None:
                _total(appearance_priors(self.field, config)).backward()
            if moving:
                _total(motion_priors(self.field, config)).backward()
                self.field.motion.grad += torch.from_numpy(grad_motion.sum(0))
            _set_rate(self.decoder, rate)
            self.decoder.step()
        with self.watch("adam"):
            kernels.adam(
                self.theta,
                self.grad,
                self.mean,
                self.square,
                config.learning_rate * rate,
                BETA1,
                BETA2,
                EPSILON,
                number + 1,
            )
        return float(errors.mean(dtype=np.float64)) / 3, float(counts.mean())

    def state(self) -> dict[str, Any]:
        return {
            "mean": torch.from_numpy(self.mean),
            "square": torch.from_numpy(self.square),
            "peaks": torch.from_numpy(self._peaks.max(0)),
            "decoder": self.decoder.state_dict(),
        }

    def load(self, state: dict[str, Any]) -> None:
        self.mean[:], self.square[:] = state["mean"].numpy(), state["square"].numpy()
        self._peaks[:] = state["peaks"].numpy()
        self.decoder.load_state_dict(state["decoder"])


class DeferredReadback:
    """Small tensors from a device, read LATE steps after they were made, so that nobody waits; on the CPU at once."""

    LATE = 8

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self._waiting: deque[tuple[torch.Tensor, torch.cuda.Event]] = deque()

    def of(self, made: torch.Tensor) -> list[float]:
        """The numbers of `made`, or of what was made LATE calls ago; of the first, as long as there is none."""
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
    """What a step of `TorchOptimiser` goes by besides tensors.

    Attributes:
        number: of the step where proposals are sampled, whose schedule it sets; else 0.
        step_length, extent: as in `FusedOptimiser.step`. moving: whether the motion grid takes part.
        variation: None where the planes' priors take no part.
        most: samples that a ray can take. rooms: on a GPU, for how many samples that are taken, and that are reached; elsewhere for as many as there are, None.
    """

    number: int
    step_length: float
    extent: float
    moving: bool
    variation: Variation | None
    most: int
    rooms: tuple[int, int] | None


class TorchOptimiser:
    """A step in plain PyTorch, on any device that PyTorch knows; or `fused`, on the CPU: kernels for the planes.

    On a GPU nothing in a step waits for it: shapes do not depend on what it computes, and `step` returns numbers that it worked
    out a few steps before. What is the same in many steps is recorded, `kpc.encoder.training.cuda_graphs`.
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
        self.field, self.config, self.mapping, self.proposals = field, config, mapping, proposals
        self.watch = Stopwatch()
        self.device = field.theta.device
        self._on_gpu = self.device.type != "cpu"
        self._records = self._on_gpu and proposals is None
        self._peaks = torch.zeros(cells, device=self.device)
        self._figures = DeferredReadback(self.device)
        self._taken_a_ray = self._reached_a_ray = math.inf
        self._rooms = (0, 0)
        self._occupancy: tuple[np.ndarray, torch.Tensor] | None = None
        self._aabb: torch.Tensor | None = None
        self.fused = fused
        self.features = fused_features(field) if fused else field.features
        if fused:
            numba.get_num_threads()  # starts numba's threads, which would undo the next line
            torch.set_num_threads(1)  # several add up gradients in any order: no run would end where another did
        self.fields: list[Field] = [field] if proposals is None else [field, *proposals.fields]
        for each in self.fields:
            each.mixed = config.mixed_precision and self._on_gpu
        self.planes = _adam([([each.theta for each in self.fields], config.learning_rate)])
        self.decoder = _decoder_optimiser(field, config, [each.density for each in self.fields[1:]])
        self._recorder = GraphCache(
            [
                p
                for optimiser in (self.planes, self.decoder)
                for group in optimiser.param_groups
                for p in group["params"]
            ]
        )

    @contextlib.contextmanager
    def eager(self) -> Iterator[None]:
        """While it lasts, steps are not replayed but done operation by operation."""
        records, self._records = self._records, False
        try:
            yield
        finally:
            self._records = records

    def peaks(self) -> np.ndarray:
        """As `FusedOptimiser.peaks`."""
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
        """As `FusedOptimiser.step`."""
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
            self._rooms_for(rays, most) if self._on_gpu else None,
        )
        with self.watch("moves"):
            if self._aabb is None:
                self._aabb = self._there(torch.from_numpy(aabb))
            if self._occupancy is None or self._occupancy[0] is not occupancy:
                self._occupancy = occupancy, self._there(torch.from_numpy(occupancy))
            kept = feature_mask(self.field, config, number, fraction)
            numbers = [] if batch.appearances is None else [self._there(batch.appearances)]
            inputs = [self._there(_packed(batch, targets)), self._there(kept), self._occupancy[1], *numbers]
        with self.watch("gradient"):
            for optimiser in (self.planes, self.decoder):
                optimiser.zero_grad()
                _set_rate(optimiser, rate)

            def work(*inputs: torch.Tensor) -> torch.Tensor:
                return self._backpropagate(plan, *inputs)

            if self._records:
                figures = self._recorder.run(plan, inputs, work)
            else:
                figures = work(*inputs)
        with self.watch("priors"):
            for each in self.fields if variation is not None and self.fused else ():
                theta, grad = each.theta.detach().numpy(), each.theta.grad.numpy()
                add_prior_gradients(each, theta, grad, config, variation, config.regularise_every)
        with self.watch("adam"):
            self.planes.step()
            self.decoder.step()
        squared_error, self._taken_a_ray, self._reached_a_ray = self._figures.of(figures)
        return squared_error, self._reached_a_ray

    def _backpropagate(
        self,
        plan: StepPlan,
        packed: torch.Tensor,
        kept: torch.Tensor,
        occupancy: torch.Tensor,
        appearances: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """Give every parameter its gradient, and cells their peaks. Returns the mean squared error, and samples a ray, taken and reached."""
        field, config = self.field, self.config
        batch, targets = _unpacked(packed, appearances)
        assert self._aabb is not None
        levels: list[ProposalLevel] = []
        if self.proposals is None:
            samples = self._samples(plan, batch, occupancy)
        else:
            samples, edges, levels = self.proposals.sample(
                batch, self._aabb, self.mapping, tuple(self._peaks.shape), plan.number, self.fused
            )
        taken = (samples.length > 0).sum()
        if plan.rooms is not None and self.proposals is None:
            # What lies behind the end of its ray takes no part: half of the samples, of which the gradient is spared.
            with torch.no_grad():
                seen = weigh_samples(field, batch, samples, self.features, plan.extent, kept).reached & (
                    samples.length > 0
                )
            samples = select_reached(samples, seen, plan.rooms[1])
        met = weigh_samples(field, batch, samples, self.features, plan.extent, kept)
        error = (shade(field, batch, met) - targets).square().mean()
        loss = error + config.distortion * met.distortion
        for level in levels:
            loss = loss + config.histogram * histogram_loss(edges, met.weights.view(len(targets), -1), level)
        if plan.moving:
            loss = loss + _total(motion_priors(field, config))
        if field.codes is not None:
            loss = loss + _total(appearance_priors(field, config))
        for each in self.fields if plan.variation is not None and not self.fused else ():
            loss = loss + config.regularise_every * _total(priors(each, config, plan.variation))
        loss.backward()  # type: ignore[no-untyped-call]
        if field.motion is not None and not plan.moving:
            field.motion.grad = None
        _, ny, nx = self._peaks.shape
        flat = (samples.cell[:, 0] * ny + samples.cell[:, 1]) * nx + samples.cell[:, 2]
        self._peaks.view(-1).scatter_reduce_(0, flat, met.weights.detach(), "amax")
        counts = torch.stack([taken, (met.reached & (samples.length > 0)).sum()]) / len(targets)
        return torch.cat([error.detach()[None], counts])

    def _samples(self, plan: StepPlan, batch: Rays, occupancy: torch.Tensor) -> Samples:
        assert self._aabb is not None
        if self.fused:
            return sample_rays_fused(batch, self._aabb.numpy(), occupancy.numpy(), plan.step_length, self.mapping)
        if plan.rooms is None:
            return sample_rays(batch, self._aabb, occupancy, plan.step_length, self.mapping)
        return sample_rays(
            batch, self._aabb, occupancy, plan.step_length, self.mapping, most=plan.most, capacity=plan.rooms[0]
        )

    def _rooms_for(self, rays: int, most: int) -> tuple[int, int]:
        """For how many samples that are taken, and that are reached, there is room, given how many there lately were: as before as long as
        that will do, so that steps are like each other."""
        taken = min(self._taken_a_ray * rays, most * rays, 3 * self.config.samples / ROOM)
        rooms = []
        for wanted, room in zip((taken, min(self._reached_a_ray * rays, taken)), self._rooms, strict=True):
            if not LEAST_ROOM * wanted <= room <= MOST_ROOM * wanted:
                room = (int(ROOM * wanted) // ROOM_UNIT + 1) * ROOM_UNIT
            rooms.append(room)
        self._rooms = rooms[0], min(rooms)
        return self._rooms

    def _there(self, values: torch.Tensor) -> torch.Tensor:
        """On the device, without waiting for it: only pinned memory can be copied behind one's back."""
        return values.pin_memory().to(self.device, non_blocking=True) if self._on_gpu else values

    def state(self) -> dict[str, Any]:
        return {
            "planes": self.planes.state_dict(),
            "decoder": self.decoder.state_dict(),
            "peaks": self._peaks,
            "proposals": self.proposals and self.proposals.state_dict(),
        }

    def load(self, state: dict[str, Any]) -> None:
        self._peaks.copy_(state["peaks"])
        self.planes.load_state_dict(state["planes"])
        self.decoder.load_state_dict(state["decoder"])
        if self.proposals is not None:
            self.proposals.load_state_dict(state["proposals"])


def _packed(batch: Rays, targets: torch.Tensor) -> torch.Tensor:
    """Rays and their targets in one tensor (N, 14): each move to a device takes its time, however little it moves."""
    columns = (
        batch.origins,
        batch.directions,
        batch.backgrounds,
        targets,
        batch.times[:, None],
        batch.jitters[:, None],
    )
    return torch.cat(columns, dim=1)


def _unpacked(packed: torch.Tensor, appearances: torch.Tensor | None) -> tuple[Rays, torch.Tensor]:
    origins, directions, backgrounds, targets, times, jitters = (
        part.contiguous() for part in packed.split([3, 3, 3, 3, 1, 1], dim=1)
    )
    return Rays(origins, directions, times[:, 0], jitters[:, 0], backgrounds, appearances), targets


def _total(weighed: dict[str, torch.Tensor]) -> torch.Tensor:
    return torch.stack(list(weighed.values())).sum()


def add_prior_gradients(
    field: Field, theta: np.ndarray, grad: np.ndarray, config: TrainConfig, variation: Variation, times: float
) -> None:
    """Add `times` the gradient of `kpc.encoder.field.field.priors` to grad."""
    M = field.layout.channels
    space, transient, steep = times * variation.space, times * variation.transient, variation.steep
    for _, name, start, rows, columns in field.layout.planes():
        if name in SPACE_PLANES:
            kernels.add_variation(theta, grad, start, rows, columns, M, space, space, steep)
            continue
        kernels.add_variation(theta, grad, start, rows, columns, M, transient, 0.0, steep)
        kernels.add_time_smoothness(theta, grad, start, rows, columns, M, times * config.time_smoothness)
        size = rows * columns * field.layout.channels
        kernels.add_sparse_transients(theta, grad, start, size, times * config.sparse_transients)


def log_densities(field: Field, points: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Log densities at (N, 3) points in [0, 1]^3 and (N,) times, on the CPU."""
    layout = field.layout
    return kernels.log_densities(
        field.theta.detach().numpy(),
        layout.table,
        layout.resolution,
        field.density.detach().numpy(),
        layout.channels,
        motion_array(field),
        np.asarray(points, np.float32),
        np.asarray(times, np.float32),
        8 * numba.get_num_threads(),
    )


def motion_array(field: Field) -> np.ndarray | None:
    """The motion grid as the kernels take it."""
    return None if field.motion is None else field.motion.detach().numpy()


def max_samples_per_ray(aabb: np.ndarray, step_length: float, mapping: SpaceMapping | None = None) -> int:
    """Samples a ray can take at most: the box's diagonal in steps, or all of a ray through contracted space."""
    longest = (
        np.linalg.norm(np.asarray(aabb[1] - aabb[0], np.float64))
        if not isinstance(mapping, Contraction)
        else mapping.s_end
    )
    return int(longest / step_length) + 2


def _decoder_optimiser(
    field: Field, config: TrainConfig, others: Sequence[torch.nn.Parameter] = ()
) -> torch.optim.Adam:
    """Of all but the planes."""
    decoder = [*field.decoder_parameters(config.view_dependent), *others]
    motion = [] if field.motion is None else [([field.motion], config.motion_learning_rate)]
    codes = [] if field.codes is None else [([field.codes], config.appearance_learning_rate)]
    return _adam([(decoder, config.decoder_learning_rate), *motion, *codes])


def _adam(groups: list[tuple[list[torch.nn.Parameter], float]]) -> torch.optim.Adam:
    """For groups of parameters and the peak of the learning rate of each."""
    on_gpu = groups[0][0][0].is_cuda
    return torch.optim.Adam(
        [{"params": parameters, "peak": peak, "lr": peak} for parameters, peak in groups],
        betas=(BETA1, BETA2),
        eps=EPSILON,
        fused=on_gpu,
    )


def _set_rate(optimiser: torch.optim.Adam, rate: float) -> None:
    """`rate`: a share of the peaks."""
    for group in optimiser.param_groups:
        group["lr"] = group["peak"] * rate
