"""Proposal sampling: two small fields learn where along a ray to take samples.

mip-NeRF 360 (arXiv:2111.12077, section 3.1), with K-Planes as proposal networks (arXiv:2301.10241, section 3.4). It is
for scenes in which an occupancy grid does not help, because most cells hold something or because details are much finer
than cells. Proposals serve in training only: the stored scene is marched through the occupancy grid that was formed
meanwhile.
"""

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor, nn

from kpc.encoder.field.config import TrainConfig
from kpc.encoder.field.field import Field
from kpc.encoder.field.fused import fused_features
from kpc.encoder.field.layout import plan_layout
from kpc.encoder.field.render import Rays, Samples, cell_indices, plane_coordinates, ray_spans
from kpc.format.scene.scene import Clip
from kpc.format.scene.space import SpaceMapping

# Added to each weight before resampling, so that no part of a ray is given up for good.
WEIGHT_PADDING = 0.01

# Scale, in steps, of the annealing of weights from uniform to those of the proposals, which know nothing at first.
ANNEAL_STEPS = 500

# N rays in K intervals: edges (N, K + 1), s rising along each ray, and weights (N, K).
ProposalLevel = tuple[Tensor, Tensor]


class Proposals(nn.Module):
    """Two fields of one scale each, with a density and no colour.

    Attributes:
        fields: coarse, then fine.
        counts: samples per ray, of both and of the main field.
    """

    def __init__(self, config: TrainConfig, aabb: np.ndarray, clip: Clip, is_dynamic: bool) -> None:
        super().__init__()
        fields = []
        for level, texels in enumerate(config.proposal_resolutions):
            shape = replace(config, resolutions=(texels,), channels=config.proposal_channels, moving_area=None)
            generator = torch.Generator().manual_seed(config.seed + 1 + level)
            fields.append(Field(plan_layout(shape, aabb, clip, is_dynamic), 1, generator))
        self.fields = nn.ModuleList(fields)
        self.counts = config.proposal_samples

    def sample(
        self,
        rays: Rays,
        aabb: Tensor,
        mapping: SpaceMapping | None,
        cells: tuple[int, int, int],
        step: int,
        fused: bool,
    ) -> tuple[Samples, Tensor, list[ProposalLevel]]:
        """Return samples for the main field, K on each ray; their edges (N, K + 1); and what each proposal found.

        Args:
            rays: N rays. aabb: (2, 3). cells: (Nz, Ny, Nx) of the occupancy grid.
            step: number of the training step, for annealing.
            fused: whether the kernels sample the planes.
        """
        near, far = ray_spans(rays, aabb, mapping)
        extent = (aabb[1] - aabb[0]).max()
        exponent = min(1.0, 10 * step / (9 * step + ANNEAL_STEPS))  # mip-NeRF 360's schedule: fast at first
        edges = _uniform_edges(near, far, self.counts[0], rays.jitters)
        levels: list[ProposalLevel] = []
        for field, count in zip(self.fields, self.counts[1:], strict=True):
            assert isinstance(field, Field)
            samples = _midpoints(rays, edges, aabb, mapping, cells)
            features = fused_features(field) if fused else field.features
            log_density, _ = field.decode(features(samples.points, rays.times[samples.ray]))
            tau = (log_density.exp() * samples.length * samples.density_scale / extent).view(len(near), -1)
            trans = torch.exp(torch.cumsum(tau, 1).neg() + tau)
            weights = trans * (1 - torch.exp(-tau))
            levels.append((edges, weights))
            edges = resample_edges(edges, weights.detach() ** exponent, count, rays.jitters)
        return _midpoints(rays, edges, aabb, mapping, cells), edges, levels


def _uniform_edges(near: Tensor, far: Tensor, count: int, jitters: Tensor) -> Tensor:
    """Return edges (N, count + 1) of equal intervals from near to far (N,), inner ones jittered by half an interval."""
    at = torch.arange(count + 1, device=near.device, dtype=near.dtype) / count
    moved = at + (jitters[:, None] - 0.5) / count * ((at > 0) & (at < 1))
    return near[:, None] + moved * (far - near).clamp(min=0)[:, None]


def _midpoints(
    rays: Rays, edges: Tensor, aabb: Tensor, mapping: SpaceMapping | None, cells: tuple[int, int, int]
) -> Samples:
    """Return samples in the middle of each interval of edges (N, K + 1)."""
    middle = (edges[:, 1:] + edges[:, :-1]) / 2
    u, scale = plane_coordinates(rays, middle, aabb, mapping)
    u = u.clamp(0, 1)
    ray = torch.arange(len(middle), device=middle.device)[:, None].expand_as(middle).flatten()
    return Samples(
        ray,
        u.flatten(0, 1),
        middle.flatten(),
        (edges[:, 1:] - edges[:, :-1]).flatten(),
        scale.flatten(),
        cell_indices(u, cells).flatten(0, 1),
    )


def resample_edges(edges: Tensor, weights: Tensor, count: int, jitters: Tensor) -> Tensor:
    """Return edges (N, count + 1) of intervals with equal shares of weights (N, K) between edges (N, K + 1).

    It is the inverse of the cumulative weights at uniform steps, jittered by (N,) in [0, 1). There is no gradient.
    """
    with torch.no_grad():
        padded = weights + WEIGHT_PADDING / weights.shape[1]
        cumulative = torch.nn.functional.pad(torch.cumsum(padded / padded.sum(1, keepdim=True), 1), (1, 0)).clamp(max=1)
        at = torch.arange(count + 1, device=edges.device, dtype=edges.dtype) / count
        at = (at + (jitters[:, None] - 0.5) / count * ((at > 0) & (at < 1))).contiguous()
        upper = torch.searchsorted(cumulative, at, right=True).clamp(1, edges.shape[1] - 1)
        low, high = (torch.gather(cumulative, 1, i) for i in (upper - 1, upper))
        share = ((at - low) / (high - low).clamp(min=1e-9)).clamp(0, 1)
        start, end = (torch.gather(edges, 1, i) for i in (upper - 1, upper))
        return start + share * (end - start)


def histogram_loss(edges: Tensor, weights: Tensor, level: ProposalLevel) -> Tensor:
    """Return by how much a proposal underestimateds weights (mip-NeRF 360, arXiv:2111.12077, eq. 13).

    mean over rays of sum_i max(0, w_i - bound_i)^2 / w_i, where bound_i is the sum of the proposal's weights in all its
    intervals that overlap interval i. Only the proposal gets a gradient.

    Args:
        edges: (N, K + 1). weights: (N, K), of the main field. level: of the proposal.
    """
    proposed, estimated = level
    edges, weights = edges.detach(), weights.detach()
    cumulative = torch.nn.functional.pad(torch.cumsum(estimated, 1), (1, 0))
    last = estimated.shape[1]
    first = (torch.searchsorted(proposed.contiguous(), edges[:, :-1].contiguous(), right=True) - 1).clamp(0, last - 1)
    beyond = torch.searchsorted(proposed.contiguous(), edges[:, 1:].contiguous()).clamp(1, last)
    bound = torch.gather(cumulative, 1, torch.maximum(beyond, first + 1)) - torch.gather(cumulative, 1, first)
    return ((weights - bound).clamp(min=0).square() / (weights + 1e-7)).sum(1).mean()
