"""Gradients of the fused kernels and of the float64 reference, for the tests that compare them."""

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from kpc.encoder.field import fused, kernels
from kpc.encoder.field.field import Field
from kpc.encoder.field.render import Rays, render_reference
from kpc.encoder.field.sampling import WeightedRowSum, bilinear_corners
from kpc.format.scene.scene import Scene
from scenes import tiny_scene, with_contraction, with_motion

# Whether the scene is dynamic, is contracted, and has a motion grid.
FIELD_KINDS = [
    (True, False, False),
    (True, False, True),
    (False, False, False),
    (True, True, False),
    (True, True, True),
    (False, True, False),
]


def translucent_scene(dynamic: bool = True, contracted: bool = False, moved: bool = False) -> Scene:
    """Return a scene in which every step absorbs at least a tenth, so that no sample is too faint to be shaded."""
    scene = tiny_scene(dynamic=dynamic, time=6)
    weight = scene.decoder.density_weight
    # Within the uniform distance, steps outside the box have a density scale of 1 / r^2, about a tenth.
    bias = 4.5 if contracted else 2.0
    scene = replace(scene, decoder=replace(scene.decoder, density_weight=np.abs(weight) / 16, density_bias=bias))
    scene = with_contraction(scene) if contracted else scene
    return with_motion(scene) if moved else scene


def random_rays(scene: Scene, count: int, seed: int = 0) -> Rays:
    """Return rays through random pixels of the scene's cameras at random times, the last three along the axes."""
    rng = np.random.default_rng(seed)
    origins, directions = (np.concatenate(a) for a in zip(*(c.rays() for c in scene.cameras), strict=True))
    chosen = rng.choice(len(origins), count - 3, replace=False)
    centre = scene.aabb.mean(0) + 0.03  # away from the faces of cells
    origins = np.concatenate([origins[chosen], centre - 3 * np.eye(3)])
    directions = np.concatenate([directions[chosen], np.eye(3)])
    arrays = (origins, directions, rng.random(count), rng.random(count), rng.random((count, 3)))
    return Rays.from_arrays(*arrays)


# Weight of the distortion loss in these tests, large enough to matter beside the colour loss.
DISTORTION = 0.3


def backpropagate(scene: Scene, rays: Rays, targets: torch.Tensor, workers: int = 2) -> dict[str, np.ndarray]:
    """Return the gradients of the fused kernels, summed over workers, with the errors and sample counts of rays."""
    field = Field.from_scene(scene)
    layout, n = field.layout, len(targets)
    grad = np.zeros((workers, layout.size), np.float32)
    grad_density = np.zeros((workers, layout.features + 1), np.float32)
    basis = field.basis(rays.directions).detach().numpy()
    grad_basis = np.zeros((n, 3, layout.features), np.float32)
    planes = fused.planes_of(field)
    grad_motion = np.zeros((workers, *planes.motion.shape), np.float32)
    grad_rays = np.zeros((n, kernels.RAY_GRADIENTS), np.float32)
    peaks = np.zeros((workers, *scene.occupancy.shape[1:]), np.float32)
    errors, counts = kernels.backpropagate(
        planes,
        field.density.detach().numpy(),
        fused.volume_of(scene.aabb, scene.occupancy, scene.step, scene.mapping),
        fused.ray_batch(rays),
        basis,
        targets.numpy(),
        np.float32(DISTORTION),
        kernels.Gradients(grad, grad_density, grad_basis, grad_motion, scene.motion is not None, grad_rays, True),
        peaks,
        fused.max_samples_per_ray(scene.aabb, scene.step, scene.mapping),
    )
    return {
        "theta": grad.sum(0),
        "density": grad_density.sum(0),
        "basis": grad_basis,
        "motion": grad_motion.sum(0),
        "rays": grad_rays,
        "errors": errors,
        "counts": counts,
        "peaks": peaks.max(0),
    }


def reference_gradients(scene: Scene, rays: Rays, targets: torch.Tensor) -> dict[str, np.ndarray]:
    """Return the same gradients by autograd through `render_reference`, in float64."""
    field = Field.from_scene(scene).double()
    rays = rays.map(lambda values: values.double().requires_grad_())
    basis = field.basis(rays.directions).detach().requires_grad_()
    # The kernels give the gradient of the basis, the field goes without one.
    field.ray_terms = lambda directions, codes: basis  # type: ignore[method-assign]
    field.colours = lambda latent, terms, ray: torch.sigmoid(torch.einsum("nf,ncf->nc", latent, terms[ray]))  # type: ignore[method-assign]
    aabb, occupancy = torch.from_numpy(scene.aabb).double(), torch.from_numpy(scene.occupancy)
    rgb, distortion, weights, cells = render_reference(field, rays, aabb, occupancy, scene.step, mapping=scene.mapping)
    rgb.retain_grad()
    squared = (rgb - targets.double()).square()
    (squared.mean() + DISTORTION * distortion).backward()
    peaks = torch.zeros(scene.occupancy.shape[1:], dtype=torch.float64)
    peaks.index_put_(tuple(cells.T), torch.zeros(len(cells), dtype=torch.float64))
    for cell, weight in zip(cells.tolist(), weights.tolist(), strict=True):
        peaks[tuple(cell)] = max(float(peaks[tuple(cell)]), weight)
    return {
        "theta": field.theta.grad.numpy(),
        "density": field.density.grad.numpy(),
        "basis": basis.grad.numpy(),
        "rays": torch.cat([rays.origins.grad, rays.directions.grad, rays.times.grad[:, None], rgb.grad], 1).numpy(),
        "motion": None if field.motion is None else field.motion.grad.numpy(),
        "errors": squared.sum(1).detach().numpy(),
        "samples": len(weights),
        "peaks": peaks.numpy(),
    }


class FieldFunction(torch.nn.Module):
    """A function of a field as a module, for `torch.func.functional_call` to turn into one of its parameters."""

    def __init__(self, field: Field, call: object) -> None:
        super().__init__()
        self.field, self.forward = field, call


def bilinear(plane: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Sample a plane (rows, columns, M) as `Field.features` does, at u (N,) along columns and v along rows: (N, M)."""
    rows, columns, M = plane.shape
    corners, shares = bilinear_corners(u, v, torch.tensor(columns), torch.tensor(rows))
    (values,) = WeightedRowSum.apply(plane.reshape(-1, M), corners[None], shares[None])
    return values
