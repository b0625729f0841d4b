"""The CPU kernels as functions of torch fields and rays: what stands in for `kpc.encoder.field.render` on the CPU."""

import functools
from collections.abc import Callable

import numba
import numpy as np
import torch
from torch import Tensor

from kpc.encoder.field import kernels
from kpc.encoder.field.field import Field, SummedField
from kpc.encoder.field.layout import Layout
from kpc.encoder.field.render import Rays, RayWeights, Samples, shade, weigh_samples
from kpc.format.scene.scene import Scene
from kpc.format.scene.space import Contraction, SpaceMapping

# Parts into which a batch is divided, per thread: threads that are done early take another.
PARTS_PER_THREAD = 8


def parts() -> int:
    """Return the number of parts into which kernels without buffers per thread divide a batch."""
    return PARTS_PER_THREAD * numba.get_num_threads()


def plane_set(
    theta: np.ndarray, layout: Layout, motion: np.ndarray | None, scales: int | None = None
) -> kernels.PlaneSet:
    """Return planes (n,) and motion grid as the kernels take them, with the coarsest `scales` only where given."""
    if motion is None:
        motion = np.zeros((0, 1, 1, 1, 3), np.float32)
    places, intervals, areas = (array[:scales] for array in _places(layout))
    return kernels.PlaneSet(theta, places, intervals, layout.channels, areas, motion)


@functools.lru_cache(maxsize=8)
def _places(layout: Layout) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return `places`, `intervals` and `areas` of a `PlaneSet`."""
    scales = len(layout.table)
    places = np.zeros((scales, 2, kernels.PLACES), np.int32)
    places[:, 0, : len(kernels.AXES)] = np.maximum(layout.table, 0)
    columns = [column_axis for column_axis, _ in kernels.AXES]
    places[:, 1, : len(kernels.AXES)] = layout.held[:, columns] * layout.channels
    intervals = (layout.held - 1).astype(np.float32)
    return places.reshape(scales, -1), intervals, layout.areas.reshape(scales, -1)


def planes_of(field: Field, scales: int | None = None) -> kernels.PlaneSet:
    """Return a field's planes and motion grid, which are not copied, as `plane_set`."""
    motion = None if field.motion is None else field.motion.detach().numpy()
    return plane_set(field.theta.detach().numpy(), field.layout, motion, scales)


def volume_of(aabb: np.ndarray, occupancy: np.ndarray, step: float, mapping: SpaceMapping | None) -> kernels.Volume:
    """Return where rays take samples; aabb (2, 3) float32, occupancy (slots, Nz, Ny, Nx) bool, step in s."""
    uniform = np.float32(mapping.uniform_distance if isinstance(mapping, Contraction) else 0)
    extent = np.max(aabb[1] - aabb[0])
    return kernels.Volume(aabb, uniform, occupancy.view(np.uint8), np.float32(step), np.float32(extent))


def ray_batch(rays: Rays) -> kernels.RayBatch:
    """Return rays as the kernels take them; appearances are left out."""
    return kernels.RayBatch(
        *(a.detach().numpy() for a in (rays.origins, rays.directions, rays.times, rays.jitters, rays.backgrounds))
    )


def max_samples_per_ray(aabb: np.ndarray, step: float, mapping: SpaceMapping | None = None) -> int:
    """Return the most samples that a ray can take: the box's diagonal, or a whole contracted ray, in steps."""
    longest = (
        mapping.s_end if isinstance(mapping, Contraction) else np.linalg.norm(np.asarray(aabb[1] - aabb[0], np.float64))
    )
    return int(longest / step) + 2


def render_rays(
    field: Field, scene: Scene, rays: Rays, codes: Tensor | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Render rays of a scene whose planes and decoder `field` holds.

    Args:
        field: with the explicit decoder.
        scene: for box, mapping, occupancy and step.
        rays: N rays.
        codes: (N, H) or (H,) appearance codes; None for 0.

    Returns:
        Colours (N, 3), opacities (N,) and mean depths (N,), float32.
    """
    basis = field.basis(rays.directions, codes).detach().numpy()
    colours, opacities, depths, _ = kernels.render(
        planes_of(field),
        field.density.detach().numpy(),
        volume_of(scene.aabb, scene.occupancy, scene.step, scene.mapping),
        ray_batch(rays),
        basis,
        max_samples_per_ray(scene.aabb, scene.step, scene.mapping),
        parts(),
    )
    return colours, opacities, depths


def log_densities(field: Field, points: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Return the clipped log densities (N,) at u (N, 3) in [0, 1]^3 and times (N,), of the explicit decoder."""
    density = field.density.detach().numpy()
    at = np.asarray(points, np.float32), np.asarray(times, np.float32)
    return kernels.log_densities(planes_of(field), density, *at, parts())


def count_samples(
    rays: Rays, aabb: np.ndarray, occupancy: np.ndarray, step: float, mapping: SpaceMapping | None = None
) -> np.ndarray:
    """Return how many samples `sample_rays` finds on each ray, (N,) int64."""
    starts = np.zeros(len(rays.times), np.int64)
    counts: np.ndarray = kernels.collect_samples(
        volume_of(aabb, occupancy, step, mapping), ray_batch(rays), starts, _sample_arrays(0), parts()
    )
    return counts


def _sample_arrays(n: int) -> kernels.SampleArrays:
    """Return room for n samples."""
    return kernels.SampleArrays(
        np.empty((n, 3), np.float32), np.empty(n, np.float32), np.empty(n, np.float32), np.empty((n, 3), np.int64)
    )


def sample_rays_fused(
    rays: Rays, aabb: np.ndarray, occupancy: np.ndarray, step: float, mapping: SpaceMapping | None = None
) -> Samples:
    """Return what `kpc.encoder.field.render.sample_rays` does, by the kernels."""
    counts = count_samples(rays, aabb, occupancy, step, mapping)
    ends = np.cumsum(counts)
    out = _sample_arrays(int(ends[-1]) if len(ends) else 0)
    volume = volume_of(aabb, occupancy, step, mapping)
    kernels.collect_samples(volume, ray_batch(rays), ends - counts, out, parts())
    ray = np.repeat(np.arange(len(counts)), counts)
    arrays = ray, out.points, out.s, np.full_like(out.s, step), out.density_scale, out.cells
    return Samples(*(torch.from_numpy(a) for a in arrays))


def march_scene(field: Field, rays: Rays, scene: Scene) -> tuple[Samples, RayWeights]:
    """Return the samples that rays take of a scene whose planes `field` holds, and their weights."""
    samples = sample_rays_fused(rays, scene.aabb, scene.occupancy, scene.step, scene.mapping)
    return samples, weigh_samples(field, rays, samples, fused_features(field), scene.extent)


def weigh_cells(field: Field, rays: Rays, scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return what `march_scene` finds of each sample until hardly any light passes: its ray, its cell and its weight.

    Returns:
        Numbers of rays (n,) int64, cells z, y, x (n, 3) int64, and weights (n,) float32.
    """
    if type(field) is not Field:
        with torch.no_grad():
            samples, weighed = march_scene(field, rays, scene)
        return samples.ray.numpy(), samples.cell.numpy(), weighed.weights.numpy()
    most = count_samples(rays, scene.aabb, scene.occupancy, scene.step, scene.mapping)
    ends = np.cumsum(most)
    cells, weights = np.zeros((most.sum(), 3), np.int64), np.zeros(most.sum(), np.float32)
    counts = kernels.weigh_samples(
        planes_of(field),
        field.density.detach().numpy(),
        volume_of(scene.aabb, scene.occupancy, scene.step, scene.mapping),
        ray_batch(rays),
        ends - most,
        cells,
        weights,
        max_samples_per_ray(scene.aabb, scene.step, scene.mapping),
        parts(),
    )
    reached = np.arange(len(weights)) < np.repeat(ends - most + counts, most)
    return np.repeat(np.arange(len(most)), most)[reached], cells[reached], weights[reached]


# Colours that are so far from targets hardly matter to the difference.
FAR = 1e6


def colour_gradients(
    field: Field, rays: Rays, scene: Scene, factors: np.ndarray, codes: Tensor | None = None
) -> list[np.ndarray]:
    """Return the gradients of the sum of factors (N, 3) times the colours of N rays.

    The kernel gives those of squared errors, 2 (C - T) d C / d theta / 3 N. With targets T = -FAR * factors, C - T is
    FAR * factors to within 1 / FAR.

    Returns:
        The gradient of theta (n,), and that of the motion grid where there is one, float32.
    """
    if type(field) is not Field:
        _, weighed = march_scene(field, rays, scene)
        colours = shade(field, rays, weighed, codes)
        wanted = [field.theta] if field.motion is None else [field.theta, field.motion]
        return [each.numpy() for each in torch.autograd.grad((torch.from_numpy(factors) * colours).sum(), wanted)]
    planes, basis = planes_of(field), field.basis(rays.directions, codes).detach().numpy()
    workers, (N, _, F) = numba.get_num_threads(), basis.shape
    gradients = kernels.Gradients(
        np.zeros((workers, planes.theta.size), np.float32),
        np.zeros((workers, F + 1), np.float32),
        np.zeros((N, 3, F), np.float32),
        np.zeros((workers, *planes.motion.shape), np.float32),
        field.motion is not None,
        np.zeros((1, kernels.RAY_GRADIENTS), np.float32),
        False,
        np.float32(0),
    )
    kernels.backpropagate(
        planes,
        field.density.detach().numpy(),
        volume_of(scene.aabb, scene.occupancy, scene.step, scene.mapping),
        ray_batch(rays),
        basis,
        np.float32(-FAR * factors),
        np.float32(0),
        gradients,
        np.zeros((workers, *scene.occupancy.shape[1:]), np.float32),
        max_samples_per_ray(scene.aabb, scene.step, scene.mapping),
    )
    found = [gradients.theta] if field.motion is None else [gradients.theta, gradients.motion]
    return [gradient.sum(0) * np.float32(1.5 * N / FAR) for gradient in found]


class FusedFeatures(torch.autograd.Function):
    """`Field.features` by the kernels."""

    @staticmethod
    def forward(ctx, theta, motion, layout, points, times):  # type: ignore[no-untyped-def]
        theta, motion, *at = (None if a is None else a.detach().numpy() for a in (theta, motion, points, times))
        ctx.planes, ctx.at = plane_set(theta, layout, motion), at
        return torch.from_numpy(kernels.features(ctx.planes, *at, parts()))

    @staticmethod
    def backward(ctx, g):  # type: ignore[no-untyped-def]
        planes, workers = ctx.planes, numba.get_num_threads()
        g_theta = np.zeros((workers, planes.theta.size), np.float32)
        g_motion = np.zeros((workers, *planes.motion.shape), np.float32)
        wants_points = any(ctx.needs_input_grad[3:])
        g_points = np.zeros((len(g) if wants_points else 0, 4), np.float32)
        kernels.scatter_features(planes, g_theta, g_motion, g_points, *ctx.at, g.contiguous().numpy())
        summed = (torch.from_numpy(a.sum(0)) if a.size else None for a in (g_theta, g_motion))
        at = torch.from_numpy(g_points)
        return *summed, None, *((at[:, :3], at[:, 3]) if wants_points else (None, None))


def fused_features(field: Field) -> Callable[[Tensor, Tensor], Tensor]:
    """Return a function of points (n, 3) and times (n,) that gives a CPU field's features (n, F) by the kernels."""
    if isinstance(field, SummedField):  # the kernels multiply planes
        return field.features
    return lambda points, times: FusedFeatures.apply(  # type: ignore[no-any-return,no-untyped-call]
        field.theta, field.motion, field.layout, points, times
    )


class ColourBasis:
    """The colour basis of a batch of rays by the kernels, times a mask on the features, and its transpose.

    Attributes:
        values: (N, 3, F) float32, of each ray; (1, 3, F) of all where colour is view-independent.
    """

    def __init__(self, field: Field, rays: Rays, mask: np.ndarray, view_dependent: bool) -> None:
        """`mask`: factors (F,) float32 on the first F features of the field."""
        self.field, self.mask, self.view_dependent = field, mask, view_dependent
        F = len(mask)
        w1, b1, w2, b2 = (p.detach().numpy() for p in (field.w1, field.b1, field.w2, field.b2))
        if not view_dependent:
            self.values = np.ascontiguousarray(b2[None, :, :F] * mask)
            return
        self.inner = np.ascontiguousarray(np.concatenate([w1, b1[:, None]], axis=1).T)
        outer = np.concatenate([w2[:, :F], b2[:, :F, None]], axis=2) * mask[:, None]
        self.outer = np.ascontiguousarray(outer.reshape(3 * F, -1).T)
        codes, numbers = np.zeros((0, len(b1)), np.float32), np.zeros(0, np.int64)
        if field.codes is not None and rays.appearances is not None:
            codes, numbers = field.codes.detach().numpy(), rays.appearances.numpy()
        self.rays = rays.directions.numpy(), codes, numbers
        basis, self.hidden = kernels.colour_basis(*self.rays, self.inner, self.outer, parts())
        self.values = basis.reshape(-1, 3, F)

    def set_gradients(self, g: np.ndarray, g_rays: np.ndarray, wants_rays: bool) -> None:
        """Set the gradients of the field's parameters on which the basis depends, and add to those of directions.

        Args:
            g: gradient of `values` (N, 3, F); or, where there is one for all rays, parts (workers, 3, F) of its sum.
            g_rays: (N, RAY_GRADIENTS) float32, used if `wants_rays`.
        """
        field, F = self.field, len(self.mask)
        if not self.view_dependent:
            field.b2.grad = self._masked(g.sum(0)[..., None])[..., 0]
            return
        directions, codes, numbers = self.rays
        workers = numba.get_num_threads()
        g_weights = tuple(np.zeros((workers, *a.shape), np.float32) for a in (self.inner, self.outer, codes))
        weights, g_basis = (self.inner, self.outer), g.reshape(len(g), -1)
        kernels.colour_basis_transpose(
            directions, numbers, self.hidden, *weights, g_basis, g_weights, g_rays, wants_rays
        )
        g_inner, g_outer, g_codes = (a.sum(0) for a in g_weights)
        inner, outer = torch.from_numpy(g_inner), self._masked(g_outer.T.reshape(3, F, -1))
        field.w1.grad, field.b1.grad = inner[:-1].T, inner[-1]
        field.w2.grad, field.b2.grad = outer[..., :-1], outer[..., -1]
        if field.codes is not None and len(g_codes):
            field.codes.grad = torch.from_numpy(g_codes)

    def _masked(self, g: np.ndarray) -> Tensor:
        """Return the gradient of weights of all features (3, features, n), given that of masked ones, (3, F, n)."""
        whole = np.zeros((3, self.field.layout.features, g.shape[2]), np.float32)
        whole[:, : len(self.mask)] = g * self.mask[:, None]
        return torch.from_numpy(whole)
