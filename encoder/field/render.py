"""Rendering of ray batches in PyTorch, with gradients: the readable reference of `kpc.encoder.field.kernels`, and what trains where those
do not serve: on a GPU, and with the hybrid decoder.

Three parts, each with a plain version for any device: which samples rays take (`sample_rays`), what the field holds there
(`Field.features`), and what becomes of it (`weigh_samples`, `shade`). On the CPU `sample_rays_fused` and `FusedFeatures` stand in for the first two.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numba
import numpy as np
import torch
from kpc.encoder.field import kernels
from kpc.encoder.field.field import Field, Layout, SummedField
from kpc.format.scene.scene import TERMINATION, Scene
from kpc.format.scene.space import Contraction, SpaceMapping
from torch import Tensor

OPAQUE_TAU = 50.0
"""Optical thickness of a sample beyond which more makes no difference to what lies behind it."""


@dataclass(frozen=True)
class Rays:
    """A batch of rays; every member has N rows. Directions are unit vectors, times and jitters lie in [0, 1). `appearances`, int64,
    are rows of `Field.codes`; None for the look without a code."""

    origins: Tensor
    directions: Tensor
    times: Tensor
    jitters: Tensor
    backgrounds: Tensor
    appearances: Tensor | None = None

    @staticmethod
    def from_arrays(*arrays: np.ndarray, appearances: np.ndarray | None = None) -> "Rays":
        """Of the first five members as arrays of any float type, and of int64 appearances."""
        floats = (torch.from_numpy(np.ascontiguousarray(a, np.float32)) for a in arrays)
        return Rays(*floats, None if appearances is None else torch.from_numpy(appearances))

    def map(self, change: Callable[[Tensor], Tensor]) -> "Rays":
        """The same with every member changed."""
        return Rays(*(None if value is None else change(value) for value in vars(self).values()))


@dataclass(frozen=True)
class Samples:
    """Where n samples of a batch of rays lie; ray by ray, and along each from its origin outwards.

    Attributes:
        ray: (n,) int64, of the batch.
        points: (n, 3) in [0, 1]^3; s: (n,) as in `kpc.encoder.field.kernels`; length: (n,) of the step, in s; stretch: (n,) what a unit
            of it counts.
        cell: (n, 3) int64, of the occupancy grid, in the order z, y, x.
    """

    ray: Tensor
    points: Tensor
    s: Tensor
    length: Tensor
    stretch: Tensor
    cell: Tensor


@dataclass(frozen=True)
class RayWeights:
    """What N rays meet, but for its colour: n samples, in the order of their rays.

    Attributes:
        ray: (n,) int64. latent: (n, ...) what `Field.colours` takes.
        weights: (n,), 0 of those behind the end of their ray. reached: (n,) bool, those that are not behind it.
        opacity: (N,) 1 - what is left of the transmittance at the end.
        distortion: the mean over rays of D that `kernels.backpropagate` states.
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
    kept: Tensor | None = None,
    mapping: SpaceMapping | None = None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Colours of a batch of rays, in plain PyTorch: the reference of `kernels.backpropagate`.

    `occupancy` (slots, Nz, Ny, Nx). `kept` (F,), where given, multiplies the features.

    Returns:
        Colours (N, 3); the distortion; of the n samples reached their weights (n,), and their cells (n, 3) int64.
    """
    samples = sample_rays(rays, aabb, occupancy, step, mapping)
    met = weigh_samples(field, rays, samples, field.features, float((aabb[1] - aabb[0]).max()), kept)
    return shade(field, rays, met), met.distortion, met.weights[met.reached], samples.cell[met.reached]


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
    """The samples of rays where the occupancy grid (slots, Nz, Ny, Nx) is set.

    Sample k of a ray lies at s = near + (k + jitter) * step, which is its distance unless there is a mapping.

    How many there are is known only where they are counted, and a GPU would have to be waited for. With `most`, samples that a
    ray can take, and `capacity` nobody waits: there are `capacity` samples, those left over are of no length, on the last ray,
    and those beyond are lost.
    """
    near, far = ray_spans(rays, aabb, mapping)
    if most is None:
        most = max(1, math.ceil(float((far - near).clamp(min=0).max()) / step))
    k = torch.arange(most, device=near.device)
    s = near[:, None] + (k + rays.jitters[:, None]) * step
    u, stretch = plane_coordinates(rays, s, aabb, mapping)
    cell = cell_indices(u, tuple(occupancy.shape[1:]))
    slot = (rays.times * occupancy.shape[0]).long().clamp(max=occupancy.shape[0] - 1)[:, None]
    taken = occupancy[slot, cell[..., 0], cell[..., 1], cell[..., 2]].bool() & (s < far[:, None])
    if capacity is None:
        index = taken.nonzero(as_tuple=True)
        return Samples(index[0], u[index], s[index], torch.full_like(s[index], step), stretch[index], cell[index])
    chosen, there = _places_of(taken.flatten(), capacity)
    return Samples(
        chosen // most,
        u.flatten(0, 1)[chosen],
        s.flatten()[chosen],
        step * there,
        stretch.flatten()[chosen],
        cell.flatten(0, 1)[chosen],
    )


def select_reached(samples: Samples, is_reached: Tensor, capacity: int) -> Samples:
    """Those samples that are reached (n,) bool, with room for `capacity` as in `sample_rays`."""
    chosen, there = _places_of(is_reached, capacity)
    kept = Samples(*(values[chosen] for values in vars(samples).values()))
    return replace(kept, length=kept.length * there)


def _places_of(is_set: Tensor, capacity: int) -> tuple[Tensor, Tensor]:
    """Where (n,) bool are set, one after another: (capacity,) int64, the last place of all where there are no more, and whether
    there were, (capacity,) bool."""
    n = is_set.numel()
    number = torch.where(is_set, is_set.cumsum(0) - 1, capacity).clamp(max=capacity)
    positions = torch.full((capacity + 1,), n - 1, device=is_set.device)
    positions.scatter_(0, number, torch.arange(n, device=is_set.device))
    return positions[:capacity], torch.arange(capacity, device=is_set.device) < is_set.sum()


def ray_spans(rays: Rays, aabb: Tensor, mapping: SpaceMapping | None) -> tuple[Tensor, Tensor]:
    """s where the samples of rays begin and end, (N,) each; they end before they begin where a ray misses the box."""
    if isinstance(mapping, Contraction):
        return torch.zeros_like(rays.times), torch.full_like(rays.times, mapping.s_end)
    inverse = 1 / rays.directions
    t0, t1 = (aabb[0] - rays.origins) * inverse, (aabb[1] - rays.origins) * inverse
    near = torch.minimum(t0, t1).nan_to_num(-torch.inf).amax(1).clamp(min=0)
    return near, torch.maximum(t0, t1).nan_to_num(torch.inf).amin(1)


def plane_coordinates(rays: Rays, s: Tensor, aabb: Tensor, mapping: SpaceMapping | None) -> tuple[Tensor, Tensor]:
    """Of samples at s (N, K) on N rays: their places (N, K, 3) in [0, 1]^3, and what a unit of s there counts (N, K),
    `kpc.format.scene.space.Contraction.stretch`."""
    t = s
    if isinstance(mapping, Contraction):
        t = torch.where(
            s <= mapping.uniform_distance,
            s,
            mapping.uniform_distance / (2 - s.clamp(max=mapping.s_end) / mapping.uniform_distance),
        )
    u = (rays.origins[:, None] + t[..., None] * rays.directions[:, None] - aabb[0]) / (aabb[1] - aabb[0])
    if not isinstance(mapping, Contraction):
        return u, torch.ones_like(t)
    y = 2 * u - 1
    radius = y.abs().amax(-1).clamp(min=1)
    stretch = ((t / mapping.uniform_distance).clamp(min=1) / radius).square()
    return y * ((2 - 1 / radius) / radius / 4)[..., None] + 0.5, stretch


def cell_indices(u: Tensor, cells: tuple[int, ...]) -> Tensor:
    """The cells z, y, x of a grid (Nz, Ny, Nx) that hold places (..., 3): (..., 3) int64."""
    return torch.stack([(u[..., axis] * n).long().clamp(0, n - 1) for axis, n in zip((2, 1, 0), cells)], dim=-1)


def weigh_samples(
    field: Field,
    rays: Rays,
    samples: Samples,
    features: Callable[[Tensor, Tensor], Tensor],
    extent: float,
    kept: Tensor | None = None,
) -> RayWeights:
    """Spend the light of N rays on their samples, front to back.

    With tau = sigma * stretch * length / extent: alpha = 1 - exp(-tau), weight = trans * alpha; a ray ends once its transmittance
    falls below TERMINATION.

    Args:
        features: of points (n, 3) and times (n,), (n, F). kept: (F,) factors on them.
    """
    ray, N = samples.ray, len(rays.times)
    f = features(samples.points, rays.times[ray])
    log_density, latent = field.decode(f if kept is None else f * kept)
    counts = torch.zeros_like(rays.times, dtype=torch.int64).index_add(0, ray, torch.ones_like(ray))
    ends = counts.cumsum(0)
    first, last = (ends - counts)[ray], (ends - 1)[ray]
    length = samples.length / extent
    tau = log_density.exp() * length * samples.stretch
    # A running sum over all rays must not meet numbers so large that the rest is lost beside them.
    trans = torch.exp(-_before(tau.clamp(max=OPAQUE_TAU), first, last))
    lit = trans >= TERMINATION
    weights = torch.where(lit, trans * (1 - torch.exp(-tau)), 0)
    opacity = torch.zeros_like(rays.backgrounds[:, 0]).index_add(0, ray, weights)
    along = ((samples.s - samples.s[first]) / extent).to(weights.dtype)
    apart = along * _before(weights, first, last) - _before(weights * along, first, last)
    distortion = (2 * weights * apart + weights.square() * length / 3).sum() / N
    return RayWeights(ray, latent, weights, lit, opacity, distortion)


def shade(field: Field, rays: Rays, met: RayWeights, codes: Tensor | None = None) -> Tensor:
    """Colours (N, 3): sum of weight * colour + what is left * background.

    `codes`: (N, H) or (H,) of appearances in place of those that the rays name.
    """
    terms = field.ray_terms(rays.directions, field.appearance_codes(rays.appearances) if codes is None else codes)
    colours = field.colours(met.latent, terms, met.ray)
    rgb = torch.zeros_like(rays.backgrounds).index_add(0, met.ray, met.weights[:, None] * colours)
    return rgb + (1 - met.opacity)[:, None] * rays.backgrounds


class _SumBefore(torch.autograd.Function):
    """For each of (n,) values the sum of those before it on its ray, which goes from number `first` (n,) to number `last` (n,).

    One running sum over all rays, in float64: what is taken off at the start of a ray is far larger than what is wanted. The
    gradient of a value is the sum of what comes after it, likewise; left to PyTorch it would be a sum at random places.
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


def _before(values: Tensor, first: Tensor, last: Tensor) -> Tensor:
    summed: Tensor = _SumBefore.apply(values, first, last)  # type: ignore[no-untyped-call]
    return summed


def count_samples(
    rays: Rays, aabb: np.ndarray, occupancy: np.ndarray, step: float, mapping: SpaceMapping | None = None
) -> np.ndarray:
    """(N,) int64: how many of `sample_rays` each ray takes, on the CPU, by the kernel."""
    counts: np.ndarray = kernels.collect(
        *_as_collected(rays, aabb, occupancy, step, mapping), None, None, None, None, None, 8 * numba.get_num_threads()
    )
    return counts


def sample_rays_fused(
    rays: Rays, aabb: np.ndarray, occupancy: np.ndarray, step: float, mapping: SpaceMapping | None = None
) -> Samples:
    """`sample_rays` on the CPU, by the kernel."""
    counts = count_samples(rays, aabb, occupancy, step, mapping)
    ends = np.cumsum(counts)
    n = int(ends[-1]) if len(ends) else 0
    points, s, stretch = np.empty((n, 3), np.float32), np.empty(n, np.float32), np.empty(n, np.float32)
    cell = np.empty((n, 3), np.int64)
    kernels.collect(
        *_as_collected(rays, aabb, occupancy, step, mapping),
        ends - counts,
        points,
        s,
        stretch,
        cell,
        8 * numba.get_num_threads(),
    )
    ray = np.repeat(np.arange(len(counts)), counts)
    return Samples(*(torch.from_numpy(a) for a in (ray, points, s, np.full_like(s, step), stretch, cell)))


def _as_collected(
    rays: Rays, aabb: np.ndarray, occupancy: np.ndarray, step: float, mapping: SpaceMapping | None
) -> tuple[Any, ...]:
    """As `kernels.collect` is told of rays and of where they go."""
    where = (a.numpy() for a in (rays.origins, rays.directions, rays.times, rays.jitters))
    return aabb, kernels.even_of(mapping), occupancy.view(np.uint8), np.float32(step), *where


def march_scene(field: Field, rays: Rays, scene: Scene) -> tuple[Samples, RayWeights]:
    """The samples that rays take of a scene as it is drawn, and what they meet there in its field, by the kernels on the CPU."""
    samples = sample_rays_fused(rays, scene.aabb, scene.occupancy, scene.step, scene.mapping)
    return samples, weigh_samples(field, rays, samples, fused_features(field), scene.extent)


class FusedFeatures(torch.autograd.Function):
    """`Field.features` on the CPU, by the kernels: theta, motion or None, points and times to (n, F). Of points and times there
    is no gradient."""

    @staticmethod
    def forward(ctx, theta, motion, layout, points, times):  # type: ignore[no-untyped-def]
        arrays = [None if a is None else a.detach().numpy() for a in (theta, motion, points, times)]
        ctx.layout, ctx.arrays = layout, arrays
        return torch.from_numpy(
            kernels.features(
                arrays[0], layout.table, layout.resolution, layout.channels, *arrays[1:], 8 * numba.get_num_threads()
            )
        )

    @staticmethod
    def backward(ctx, g):  # type: ignore[no-untyped-def]
        layout: Layout = ctx.layout
        theta, motion, points, times = ctx.arrays
        workers = numba.get_num_threads()
        grad = np.zeros((workers, theta.size), np.float32)
        grad_motion = None if motion is None else np.zeros((workers, *motion.shape), np.float32)
        kernels.scatter(
            theta,
            grad,
            layout.table,
            layout.resolution,
            layout.channels,
            motion,
            grad_motion,
            points,
            times,
            g.contiguous().numpy(),
        )
        return (
            torch.from_numpy(grad.sum(0)),
            None if grad_motion is None else torch.from_numpy(grad_motion.sum(0)),
            None,
            None,
            None,
        )


def fused_features(field: Field) -> Callable[[Tensor, Tensor], Tensor]:
    """`Field.features` of a field on the CPU."""
    if isinstance(field, SummedField):
        return field.features
    return lambda points, times: FusedFeatures.apply(  # type: ignore[no-any-return,no-untyped-call]
        field.theta, field.motion, field.layout, points, times
    )
