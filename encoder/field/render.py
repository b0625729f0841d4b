"""Differentiable volume rendering of ray batches in PyTorch: the readable reference of `kpc.encoder.field.kernels`.

It also trains where the kernels do not serve: on a GPU, and with the hybrid decoder. There are three parts, each for
any device: which samples rays take (`sample_rays`), what the field holds there (`Field.features`), and how samples
are composited (`weigh_samples`, `shade`). On the CPU `kpc.encoder.field.fused` replaces the first two.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from kpc.encoder.field.field import Field
from kpc.format.scene.scene import TERMINATION
from kpc.format.scene.space import Contraction, SpaceMapping

# Optical thickness of a sample beyond which more makes no difference to what lies behind it: exp(-50) is 2e-22.
OPAQUE_TAU = 50.0


@dataclass(frozen=True)
class Rays:
    """A batch of N rays.

    Attributes:
        origins: (N, 3).
        directions: (N, 3), unit vectors.
        times: (N,) in [0, 1].
        jitters: (N,) in [0, 1), where in its step each sample of a ray lies.
        backgrounds: (N, 3), RGB in [0, 1].
        appearances: (N,) int64, rows of `Field.codes`; None for no code.
    """

    origins: Tensor
    directions: Tensor
    times: Tensor
    jitters: Tensor
    backgrounds: Tensor
    appearances: Tensor | None = None

    @staticmethod
    def from_arrays(*arrays: np.ndarray, appearances: np.ndarray | None = None) -> "Rays":
        """Return rays of the first five members as arrays of any float type, and of appearances (N,) int64."""
        floats = [torch.from_numpy(np.ascontiguousarray(a, np.float32)) for a in arrays]
        return Rays(*floats, None if appearances is None else torch.from_numpy(appearances))  # type: ignore[call-arg]

    def map(self, change: Callable[[Tensor], Tensor]) -> "Rays":
        """Return rays whose members are `change` of these."""
        floats = (self.origins, self.directions, self.times, self.jitters, self.backgrounds)
        appearances = None if self.appearances is None else change(self.appearances)
        return Rays(*map(change, floats), appearances)  # type: ignore[call-arg]


@dataclass(frozen=True)
class Samples:
    """n samples of a batch of rays, ray by ray, and on each ray by distance.

    Attributes:
        ray: (n,) int64, row of the batch.
        points: (n, 3), u in [0, 1]^3 before displacement by the motion grid.
        s: (n,), ray parameter: distance along the ray, contracted where space is.
        length: (n,), of the step, in s.
        density_scale: (n,), `kpc.format.scene.space.Contraction.density_scale`.
        cell: (n, 3) int64, occupancy cell in the order z, y, x.
    """

    ray: Tensor
    points: Tensor
    s: Tensor
    length: Tensor
    density_scale: Tensor
    cell: Tensor


@dataclass(frozen=True)
class RayWeights:
    """The weights of n samples of N rays: all of compositing but the colours.

    Attributes:
        ray: (n,) int64, row of the batch.
        latent: (n, ...), what `Field.colours` takes.
        weights: (n,), transmittance times alpha; 0 behind the end of a ray.
        reached: (n,) bool, False behind the end of a ray.
        opacity: (N,), 1 - transmittance at the end.
        distortion: the mean over rays of D as defined by `kernels.backpropagate`.
    """

    ray: Tensor
    latent: Tensor
    weights: Tensor
    reached: Tensor
    opacity: Tensor
    distortion: Tensor


def render_reference(
    field: Field,
    rays: Rays,
    aabb: Tensor,
    occupancy: Tensor,
    step: float,
    mask: Tensor | None = None,
    mapping: SpaceMapping | None = None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Render a batch of N rays: the reference of `kernels.backpropagate`.

    Args:
        field: any field. aabb: (2, 3). occupancy: (slots, Nz, Ny, Nx) bool. step: in s.
        mask: (F,) factors on the features; None for 1.

    Returns:
        Colours (N, 3); the distortion; of the n samples reached, weights (n,) and cells (n, 3) int64.
    """
    samples = sample_rays(rays, aabb, occupancy, step, mapping)
    weighed = weigh_samples(field, rays, samples, field.features, float((aabb[1] - aabb[0]).max()), mask)
    reached = weighed.reached
    return shade(field, rays, weighed), weighed.distortion, weighed.weights[reached], samples.cell[reached]


def sample_rays(
    rays: Rays,
    aabb: Tensor,
    occupancy: Tensor,
    step: float,
    mapping: SpaceMapping | None = None,
    *,
    most: int | None = None,
    capacity: int | None = None,
) -> Samples:
    """Return the samples of rays in occupied cells.

    Sample k of a ray lies at s = near + (k + jitter) * step. To a gradient of the rays, s is a constant.

    Args:
        rays: N rays. aabb: (2, 3). occupancy: (slots, Nz, Ny, Nx) bool. step: in s.
        most: the most samples that a ray can take; found from the rays where None.
        capacity: the number of samples returned; as many as there are where None. With `most` and `capacity` no shape
            depends on the data, so a GPU need not be waited for: samples beyond `capacity` are dropped, and those that
            fill it up have length 0 and lie on the last ray.
    """
    near, far = (end.detach() for end in ray_spans(rays, aabb, mapping))
    if most is None:
        most = max(1, math.ceil(float((far - near).clamp(min=0).max()) / step))
    k = torch.arange(most, device=near.device)
    s = near[:, None] + (k + rays.jitters[:, None]) * step
    u, scale = plane_coordinates(rays, s, aabb, mapping)
    cell = cell_indices(u, tuple(occupancy.shape[1:]))
    slot = (rays.times * occupancy.shape[0]).long().clamp(max=occupancy.shape[0] - 1)[:, None]
    taken = occupancy[slot, cell[..., 0], cell[..., 1], cell[..., 2]].bool() & (s < far[:, None])
    if capacity is None:
        index = taken.nonzero(as_tuple=True)
        return Samples(index[0], u[index], s[index], torch.full_like(s[index], step), scale[index], cell[index])
    chosen, exists = _first_set(taken.flatten(), capacity)
    return Samples(
        chosen // most,
        u.flatten(0, 1)[chosen],
        s.flatten()[chosen],
        step * exists,
        scale.flatten()[chosen],
        cell.flatten(0, 1)[chosen],
    )


def follow_rays(samples: Samples, rays: Rays, aabb: Tensor, mapping: SpaceMapping | None) -> Samples:
    """Return the samples with points and density scales as differentiable functions of the rays, at constant s."""
    own = replace(rays, origins=rays.origins[samples.ray], directions=rays.directions[samples.ray])
    u, scale = plane_coordinates(own, samples.s[:, None], aabb, mapping)
    return replace(samples, points=u[:, 0], density_scale=scale[:, 0])


def select_reached(samples: Samples, is_reached: Tensor, capacity: int) -> Samples:
    """Return the samples for which is_reached (n,) bool holds, filled up to `capacity` as in `sample_rays`."""
    chosen, exists = _first_set(is_reached, capacity)
    kept = Samples(*(values[chosen] for values in vars(samples).values()))
    return replace(kept, length=kept.length * exists)


def _first_set(is_set: Tensor, capacity: int) -> tuple[Tensor, Tensor]:
    """Return where (n,) bool are set, (capacity,) int64, and which of these are more than padding, (capacity,) bool."""
    n = is_set.numel()
    number = torch.where(is_set, is_set.cumsum(0) - 1, capacity).clamp(max=capacity)
    positions = torch.full((capacity + 1,), n - 1, device=is_set.device)
    positions.scatter_(0, number, torch.arange(n, device=is_set.device))
    return positions[:capacity], torch.arange(capacity, device=is_set.device) < is_set.sum()


def ray_spans(rays: Rays, aabb: Tensor, mapping: SpaceMapping | None) -> tuple[Tensor, Tensor]:
    """Return the s (N,) between which rays take samples; the end is below the start where a ray misses the box."""
    if isinstance(mapping, Contraction):
        return torch.zeros_like(rays.times), torch.full_like(rays.times, mapping.s_end)
    inverse = 1 / rays.directions
    t0, t1 = (aabb[0] - rays.origins) * inverse, (aabb[1] - rays.origins) * inverse
    near = torch.minimum(t0, t1).nan_to_num(-torch.inf).amax(1).clamp(min=0)
    return near, torch.maximum(t0, t1).nan_to_num(torch.inf).amin(1)


def plane_coordinates(rays: Rays, s: Tensor, aabb: Tensor, mapping: SpaceMapping | None) -> tuple[Tensor, Tensor]:
    """Return u (N, K, 3) in [0, 1]^3 at ray parameters s (N, K), and `Contraction.density_scale` there, (N, K)."""
    t = s
    if isinstance(mapping, Contraction):
        uniform = mapping.uniform_distance
        t = torch.where(s <= uniform, s, uniform / (2 - s.clamp(max=mapping.s_end) / uniform))
    u = (rays.origins[:, None] + t[..., None] * rays.directions[:, None] - aabb[0]) / (aabb[1] - aabb[0])
    if not isinstance(mapping, Contraction):
        return u, torch.ones_like(t)
    y = 2 * u - 1
    radius = y.abs().amax(-1).clamp(min=1)
    scale = ((t / mapping.uniform_distance).clamp(min=1) / radius).square()
    return y * ((2 - 1 / radius) / radius / 4)[..., None] + 0.5, scale


def cell_indices(u: Tensor, cells: tuple[int, ...]) -> Tensor:
    """Return the cells z, y, x of a grid (Nz, Ny, Nx) that hold u (..., 3): (..., 3) int64."""
    return torch.stack(
        [(u[..., axis] * n).long().clamp(0, n - 1) for axis, n in zip((2, 1, 0), cells, strict=True)], dim=-1
    )


def weigh_samples(
    field: Field,
    rays: Rays,
    samples: Samples,
    features: Callable[[Tensor, Tensor], Tensor],
    extent: float,
    mask: Tensor | None = None,
) -> RayWeights:
    """Return the weights of samples of N rays.

    tau = sigma * density_scale * length / extent;  alpha = 1 - exp(-tau);  trans = exp(-sum of tau before)
    weight = trans * alpha, or 0 once trans has fallen below TERMINATION

    Args:
        field: decodes the features. rays: N rays. samples: n samples of them.
        features: a function of points (n, 3) and times (n,) to features (n, F).
        extent: longest edge of the box; densities are per this length.
        mask: (F,) factors on the features; None for 1.
    """
    ray, N = samples.ray, len(rays.times)
    f = features(samples.points, rays.times[ray])
    log_density, latent = field.decode(f if mask is None else f * mask)
    counts = torch.zeros_like(rays.times, dtype=torch.int64).index_add(0, ray, torch.ones_like(ray))
    ends = counts.cumsum(0)
    first, last = (ends - counts)[ray], (ends - 1)[ray]
    length = samples.length / extent
    tau = log_density.exp() * length * samples.density_scale
    # The running sum goes over all rays: one huge number in it would swallow all others.
    trans = torch.exp(-_sum_before(tau.clamp(max=OPAQUE_TAU), first, last))
    reached = trans >= TERMINATION
    weights = torch.where(reached, trans * (1 - torch.exp(-tau)), 0)
    opacity = torch.zeros_like(rays.backgrounds[:, 0]).index_add(0, ray, weights)
    along = ((samples.s - samples.s[first]) / extent).to(weights.dtype)
    apart = along * _sum_before(weights, first, last) - _sum_before(weights * along, first, last)
    distortion = (2 * weights * apart + weights.square() * length / 3).sum() / N
    return RayWeights(ray, latent, weights, reached, opacity, distortion)


def shade(field: Field, rays: Rays, weighed: RayWeights, codes: Tensor | None = None) -> Tensor:
    """Return the colours (N, 3) of rays: the sum of weight * colour, plus (1 - opacity) * background.

    `codes`, (N, H) or (H,), are appearance codes to use instead of those that the rays name.
    """
    terms = field.ray_terms(rays.directions, field.appearance_codes(rays.appearances) if codes is None else codes)
    colours = field.colours(weighed.latent, terms, weighed.ray)
    rgb = torch.zeros_like(rays.backgrounds).index_add(0, weighed.ray, weighed.weights[:, None] * colours)
    return rgb + (1 - weighed.opacity)[:, None] * rays.backgrounds


class _SumBefore(torch.autograd.Function):
    """For each of (n,) values, the sum of those before it on its ray, which spans rows first (n,) to last (n,).

    It is one running sum over all rays, in float64, because what is subtracted at the start of a ray is far larger than
    the result. The gradient of a value is the sum over what follows it, computed likewise: PyTorch's own would add at
    random positions.
    """

    @staticmethod
    def forward(ctx, values, first, last):  # type: ignore[no-untyped-def]
        ctx.save_for_backward(last)
        total = torch.cumsum(values.double(), 0) - values
        return (total - total[first]).to(values.dtype)

    @staticmethod
    def backward(ctx, g):  # type: ignore[no-untyped-def]
        (last,) = ctx.saved_tensors
        total = torch.cumsum(g.double(), 0)
        return (total[last] - total).to(g.dtype), None, None


def _sum_before(values: Tensor, first: Tensor, last: Tensor) -> Tensor:
    summed: Tensor = _SumBefore.apply(values, first, last)  # type: ignore[no-untyped-call]
    return summed
