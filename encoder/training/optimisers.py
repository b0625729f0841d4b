"""What both optimisers share: feature masks, Adam's groups and learning rates, the gradient of the priors, timers."""

import contextlib
import time
from collections.abc import Iterator, Sequence

import numpy as np
import torch

from kpc.encoder.field import kernels
from kpc.encoder.field.adam import Adam
from kpc.encoder.field.config import TrainConfig, Variation
from kpc.encoder.field.field import Field

# Adam's constants as Instant-NGP sets them for grids (arXiv:2201.05989, section 4).
BETA1, BETA2, EPSILON = 0.9, 0.99, 1e-15


class Stopwatch:
    """Seconds of wall clock by name: `with timers("name"): ...`.

    Attributes:
        seconds: the total of each name.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextlib.contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        started = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - started


def feature_mask(field: Field, config: TrainConfig, step: int, fraction: float) -> torch.Tensor:
    """Return the factors on the features in one step, at a fraction of the run: (F,) float32 on the CPU.

    They are 0 where `channel_dropout` drops a channel at all scales, `scale_dropout` a scale and all finer ones, or
    `coarse_until` all scales but the coarsest. The remaining channels are scaled up so that the mean over steps is 1;
    remaining scales are not, as coarse scales are to make a picture by themselves.
    """
    M, scales = field.layout.channels, len(field.layout.resolution)
    dropped = min(round(config.channel_dropout * M), M - 1) if fraction < config.dropout_until else 0
    if not dropped and not config.scale_dropout and fraction >= config.coarse_until:
        return torch.ones(scales * M)
    rng = np.random.default_rng((config.seed, step))
    factors = np.full((scales, M), M / (M - dropped), np.float32)
    factors[:, rng.permutation(M)[:dropped]] = 0
    if scales > 1 and rng.random() < config.scale_dropout:
        factors[rng.integers(1, scales) :] = 0
    if fraction < config.coarse_until:
        factors[1:] = 0
    return torch.from_numpy(factors.ravel())


def add_prior_gradients(
    field: Field, theta: np.ndarray, grad: np.ndarray, config: TrainConfig, variation: Variation, factor: float
) -> None:
    """Add `factor` times the gradient of `kpc.encoder.field.priors.plane_priors` at theta (n,) to grad (n,)."""
    kernels.add_priors(
        theta,
        grad,
        field.layout.plane_rows,
        field.layout.channels,
        factor * variation.space,
        factor * variation.transient,
        factor * config.time_smoothness,
        factor * config.sparse_transients,
        variation.steep,
    )


def add_motion_prior_gradients(motion: torch.nn.Parameter, config: TrainConfig) -> None:
    """Add the gradient of `kpc.encoder.field.priors.motion_priors` to that of the motion grid (T, Nz, Ny, Nx, 3)."""
    grid = motion.detach()
    assert motion.grad is not None
    for axis, weight in enumerate([config.motion_smoothness_time] + 3 * [config.motion_smoothness_space]):
        inner = grid.shape[axis] - 2
        if inner < 1:
            continue
        slope = grid.diff(n=2, dim=axis).mul_(2 * weight / grid.numel())
        for first, factor in enumerate((1, -2, 1)):
            motion.grad.narrow(axis, first, inner).add_(slope, alpha=factor)


def total(weighted: dict[str, torch.Tensor]) -> torch.Tensor:
    """Return the sum of weighted losses, of which there is at least one."""
    return torch.stack(list(weighted.values())).sum()


def decoder_optimiser(
    field: Field, config: TrainConfig, others: Sequence[torch.nn.Parameter] = ()
) -> Adam | torch.optim.Adam:
    """Return Adam for all parameters but the planes, and for `others` at the decoder's learning rate."""
    decoder = [*field.decoder_parameters(config.view_dependent), *others]
    motion = [] if field.motion is None else [([field.motion], config.motion_learning_rate)]
    codes = [] if field.codes is None else [([field.codes], config.appearance_learning_rate)]
    return make_adam([(decoder, config.decoder_learning_rate), *motion, *codes])


def make_adam(groups: list[tuple[list[torch.nn.Parameter], float]]) -> Adam | torch.optim.Adam:
    """Return Adam for groups of parameters, each with its peak learning rate."""
    described = [{"params": parameters, "peak": peak, "lr": peak} for parameters, peak in groups]
    if groups[0][0][0].is_cuda:
        return torch.optim.Adam(described, betas=(BETA1, BETA2), eps=EPSILON, fused=True)
    return Adam(described, betas=(BETA1, BETA2), eps=EPSILON)


def set_rate(optimiser: Adam | torch.optim.Adam, rate: float) -> None:
    """Set the learning rates to a share of their peaks."""
    for group in optimiser.param_groups:
        group["lr"] = group["peak"] * rate
