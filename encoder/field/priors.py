"""The priors that keep planes, motion grid and appearance codes smooth, small or sparse, in PyTorch.

`kpc.encoder.training.optimisers.add_prior_gradients` has the gradient of `plane_priors` by the kernels.
"""

import torch
from torch import Tensor

from kpc.encoder.field.config import TrainConfig, Variation
from kpc.encoder.field.field import Field


def plane_priors(field: Field, config: TrainConfig, variation: Variation) -> dict[str, Tensor]:
    """Return the weighted priors of the planes by the name of their weight.

    * space_variation: total variation of the space planes, differences weighed as `variation` says;
    * transient_variation: the same of the space-time planes, along space only;
    * time_smoothness: mean (P[t-1] - 2 P[t] + P[t+1])^2 of the space-time planes (K-Planes, section 3.2);
    * sparse_transients: mean |1 - P| of the space-time planes (K-Planes, section 3.2).

    Each is a mean over a plane's texels and channels, summed over the planes that it concerns.
    """
    table, (neighbours, (in_space, in_time, inner)) = field.theta.view(-1, field.layout.channels), field.texels
    right, below, above = (table.index_select(0, texels) for texels in neighbours)
    along, across = (_penalty((other - table).square(), variation.steep).sum(1) for other in (right, below))
    return {
        "space_variation": variation.space * _weighted_sum(along + across, in_space),
        "transient_variation": variation.transient * _weighted_sum(along, in_time),
        "time_smoothness": config.time_smoothness * _weighted_sum((above - 2 * table + below).square().sum(1), inner),
        "sparse_transients": config.sparse_transients * _weighted_sum((1 - table).abs().sum(1), in_time),
    }


def _penalty(squares: Tensor, steep: float) -> Tensor:
    """Return log(1 + steep d^2) / steep of d^2, or d^2 where `steep` is 0."""
    return torch.log1p(steep * squares) / steep if steep else squares


def _weighted_sum(values: Tensor, weights: Tensor) -> Tensor:
    """Return the sum of values times weights; values of weight 0 do not count, even if they are NaN."""
    return torch.where(weights > 0, values, 0) @ weights


def motion_priors(field: Field, config: TrainConfig) -> dict[str, Tensor]:
    """Return the weighted priors of the motion grid D, which has n numbers; an empty dict where there is none.

    motion_smoothness_time * sum (D[t-1] - 2 D[t] + D[t+1])^2 / n, and motion_smoothness_space * the same along x, y
    and z. Neither penalises what moves, turns or stretches uniformly.
    """
    if field.motion is None:
        return {}
    n = field.motion.numel()
    in_time, along_z, along_y, along_x = (field.motion.diff(n=2, dim=dim).square().sum() / n for dim in range(4))
    return {
        "motion_smoothness_time": config.motion_smoothness_time * in_time,
        "motion_smoothness_space": config.motion_smoothness_space * (along_z + along_y + along_x),
    }


def appearance_priors(field: Field, config: TrainConfig) -> dict[str, Tensor]:
    """Return appearance_decay times the mean square of the appearance codes; an empty dict where there are none.

    Without it codes and b1 could drift together, and codes of few pictures would overfit.
    """
    return {} if field.codes is None else {"appearance_decay": config.appearance_decay * field.codes.square().mean()}
