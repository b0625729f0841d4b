"""Rendering of ray batches in PyTorch, with gradients: the readable reference of `kpc.encoder.kernels`, and what trains where those
do not serve: on a GPU, and with the hybrid decoder.

Three parts, each with a plain version for any device: which samples rays take (`samples_of`), what the field holds there
(`Field.features`), and what becomes of them (`composite`). On the CPU `collected` and `FusedFeatures` stand in for the first two.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numba
import numpy as np
import torch
from torch import Tensor

from kpc.encoder import kernels
from kpc.encoder.field import Field, Layout
from kpc.format.scene import TERMINATION
from kpc.format.space import Contraction, SpaceMapping


@dataclass(frozen=True)
class Rays:
    """A batch of rays; every member has N rows. Directions are unit vectors, times and jitters lie in [0, 1)."""

    origins: Tensor
    directions: Tensor
    times: Tensor
    jitters: Tensor
    backgrounds: Tensor


@dataclass(frozen=True)
class Samples:
    """Where n samples of a batch of rays lie; ray by ray, and along each from its origin outwards.

    Attributes:
        ray: (n,) int64, of the batch.
        points: (n, 3) in [0, 1]^3; s: (n,) as in `kpc.encoder.kernels`; stretch: (n,) what a step there counts.
        cell: (n, 3) int64, of the occupancy grid, in the order z, y, x.
    """

    ray: Tensor
    points: Tensor
    s: Tensor
    stretch: Tensor
    cell: Tensor


@dataclass(frozen=True)
class Composite:
    """What N rays met.

    Attributes:
        rgb: (N, 3). opacity: (N,) 1 - what is left of the transmittance at the end.
        weights: (n,) of the samples; 0 of those behind the end of their ray. reached: (n,) bool, those that are not behind it.
        distortion: the mean over rays of D that `kernels.backpropagate` states.
    """

    rgb: Tensor
    opacity: Tensor
    weights: Tensor
    reached: Tensor
    distortion: Tensor


def render_reference(
    field: Field, rays: Rays, aabb: Tensor, occupancy: Tensor, step: float, kept: Tensor | None = None,
    mapping: SpaceMapping | None = None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Colours of a batch of rays, in plain PyTorch: the reference of `kernels.backpropagate`.

    `occupancy` (slots, Nz, Ny, Nx). `kept` (F,), where given, multiplies the features.

    Returns:
        Colours (N, 3); the distortion; of the n samples reached their weights (n,), and their cells (n, 3) int64.
    """
    samples = samples_of(rays, aabb, occupancy, step, mapping)
    met = composite(field, rays, samples, field.features, step, float((aabb[1] - aabb[0]).max()), kept)
    return met.rgb, met.distortion, met.weights[met.reached], samples.cell[met.reached]


def samples_of(rays: Rays, aabb: Tensor, occupancy: Tensor, step: float, mapping: SpaceMapping | None = None) -> Samples:
    """The samples of rays where the occupancy grid (slots, Nz, Ny, Nx) is set.

    Sample k of a ray lies at s = near + (k + jitter) * step, which is its distance unless there is a mapping.
    """
    inverse = 1 / rays.directions
    t0, t1 = (aabb[0] - rays.origins) * inverse, (aabb[1] - rays.origins) * inverse
    near = torch.minimum(t0, t1).nan_to_num(-torch.inf).amax(1).clamp(min=0)
    far = torch.maximum(t0, t1).nan_to_num(torch.inf).amin(1)
    if isinstance(mapping, Contraction):
        near, far = torch.zeros_like(near), torch.full_like(far, mapping.end)
        longest = mapping.end
    else:
        longest = float(torch.linalg.vector_norm(aabb[1] - aabb[0]))  # not the rays' own: a GPU would have to be waited for
    k = torch.arange(max(1, math.ceil(longest / step)) + 1, device=near.device)
    s = near[:, None] + (k + rays.jitters[:, None]) * step
    t = s
    if isinstance(mapping, Contraction):
        t = torch.where(s <= mapping.even, s, mapping.even / (2 - s.clamp(max=mapping.end) / mapping.even))
    u, stretch = place(rays.origins[:, None] + t[..., None] * rays.directions[:, None], t, aabb, mapping)
    size = torch.tensor(occupancy.shape[:0:-1], device=u.device)
    cell = (u.detach() * size).long().clamp(min=0).minimum(size - 1).flip(-1)
    slot = (rays.times * occupancy.shape[0]).long().clamp(max=occupancy.shape[0] - 1)[:, None]
    taken = occupancy[slot, cell[..., 0], cell[..., 1], cell[..., 2]].bool() & (s < far[:, None])
    index = taken.nonzero(as_tuple=True)
    return Samples(index[0], u[index], s[index], stretch[index], cell[index])


def place(points: Tensor, t: Tensor, aabb: Tensor, mapping: SpaceMapping | None) -> tuple[Tensor, Tensor]:
    """Places (..., 3) of world points in [0, 1]^3, and what a step there counts, `kpc.format.space.Contraction.stretch`.

    `t` (...): how far along their rays they lie.
    """
    u = (points - aabb[0]) / (aabb[1] - aabb[0])
    if not isinstance(mapping, Contraction):
        return u, torch.ones_like(t)
    y = 2 * u - 1
    radius = y.abs().amax(-1).clamp(min=1)
    stretch = ((t / mapping.even).clamp(min=1) / radius).square()
    return y * ((2 - 1 / radius) / radius / 4)[..., None] + 0.5, stretch


def composite(
    field: Field, rays: Rays, samples: Samples, features: Callable[[Tensor, Tensor], Tensor], step: float, extent: float,
    kept: Tensor | None = None,
) -> Composite:
    """Spend the light of N rays on their samples, front to back.

    With tau = sigma * stretch * step / extent: alpha = 1 - exp(-tau), weight = trans * alpha; a ray ends once its transmittance
    falls below TERMINATION.

    Args:
        features: of points (n, 3) and times (n,), (n, F). kept: (F,) factors on them.
    """
    ray, N = samples.ray, len(rays.times)
    f = features(samples.points, rays.times[ray])
    log_density, latent = field.decode(f if kept is None else f * kept)
    # Samples side by side, a row for each ray: sums along rays are sums along rows.
    counts = torch.bincount(ray, minlength=N)
    number = torch.arange(len(ray), device=ray.device) - (counts.cumsum(0) - counts)[ray]
    index, shape = (ray, number), (N, max(1, int(counts.max())))
    zeros = log_density.new_zeros(shape)
    tau = zeros.index_put(index, log_density.exp() * (step / extent) * samples.stretch)
    trans = torch.exp(-torch.cumsum(torch.nn.functional.pad(tau, (1, 0)), dim=1))
    lit = trans[:, :-1] >= TERMINATION
    weights = torch.where(lit, trans[:, :-1] * (1 - torch.exp(-tau)), 0)
    colours = field.colours(latent, field.once_a_ray(rays.directions), ray)
    rgb = torch.zeros_like(rays.backgrounds).index_add(0, ray, weights[index][:, None] * colours)
    opacity = weights.sum(1)
    rgb = rgb + (1 - opacity)[:, None] * rays.backgrounds
    along = zeros.index_put(index, (samples.s / extent).to(zeros.dtype))
    before, before_s = (torch.cumsum(x, 1) - x for x in (weights, weights * along))
    distortion = (2 * weights * (along * before - before_s) + weights.square() * (step / extent / 3)).sum(1).mean()
    return Composite(rgb, opacity, weights[index], lit[index], distortion)


def collected(
    rays: Rays, aabb: np.ndarray, occupancy: np.ndarray, step: float, mapping: SpaceMapping | None = None
) -> Samples:
    """`samples_of` on the CPU, by the kernel."""
    where = [a.numpy() for a in (rays.origins, rays.directions, rays.times, rays.jitters)]
    told = (aabb, kernels.even_of(mapping), occupancy.view(np.uint8), np.float32(step), *where)
    workers = 8 * numba.get_num_threads()
    counts = kernels.collect(*told, None, None, None, None, None, workers)
    ends = np.cumsum(counts)
    n = int(ends[-1]) if len(ends) else 0
    points, s, stretch = np.empty((n, 3), np.float32), np.empty(n, np.float32), np.empty(n, np.float32)
    cell = np.empty((n, 3), np.int64)
    kernels.collect(*told, ends - counts, points, s, stretch, cell, workers)
    ray = np.repeat(np.arange(len(counts)), counts)
    return Samples(*(torch.from_numpy(a) for a in (ray, points, s, stretch, cell)))


class FusedFeatures(torch.autograd.Function):
    """`Field.features` on the CPU, by the kernels: theta, motion or None, points and times to (n, F). Of points and times there
    is no gradient."""

    @staticmethod
    def forward(ctx, theta, motion, layout, points, times):  # type: ignore[no-untyped-def]
        arrays = [None if a is None else a.detach().numpy() for a in (theta, motion, points, times)]
        ctx.layout, ctx.arrays = layout, arrays
        return torch.from_numpy(kernels.features(arrays[0], layout.table, layout.resolution, layout.channels, *arrays[1:],
                                                 8 * numba.get_num_threads()))

    @staticmethod
    def backward(ctx, g):  # type: ignore[no-untyped-def]
        layout: Layout = ctx.layout
        theta, motion, points, times = ctx.arrays
        workers = numba.get_num_threads()
        grad = np.zeros((workers, theta.size), np.float32)
        grad_motion = None if motion is None else np.zeros((workers, *motion.shape), np.float32)
        kernels.scatter(theta, grad, layout.table, layout.resolution, layout.channels, motion, grad_motion, points, times,
                        g.contiguous().numpy())
        return (torch.from_numpy(grad.sum(0)), None if grad_motion is None else torch.from_numpy(grad_motion.sum(0)),
                None, None, None)


def fused_features(field: Field) -> Callable[[Tensor, Tensor], Tensor]:
    """`Field.features` of a field on the CPU."""
    return lambda points, times: FusedFeatures.apply(  # type: ignore[no-any-return,no-untyped-call]
        field.theta, field.motion, field.layout, points, times)
