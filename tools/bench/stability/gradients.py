"""Gradients of the fused kernels, and of the reference in PyTorch in float64."""

import numpy as np
import torch

from kpc.encoder.field import fused, kernels
from kpc.encoder.field.field import Field
from kpc.encoder.field.render import Rays, render_reference
from kpc.format.scene.scene import Scene

# Weight of the distortion loss, large enough to matter beside the colour loss.
DISTORTION = 0.3


def backpropagate(
    scene: Scene, rays: Rays, targets: torch.Tensor, workers: int = 2, full_weight: float = 0.0
) -> dict[str, np.ndarray]:
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
        kernels.Gradients(
            grad,
            grad_density,
            grad_basis,
            grad_motion,
            scene.motion is not None,
            grad_rays,
            True,
            np.float32(full_weight),
        ),
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


def reference_gradients(
    scene: Scene, rays: Rays, targets: torch.Tensor, dtype: torch.dtype = torch.float64
) -> dict[str, np.ndarray]:
    """Return the same gradients by autograd through `render_reference`."""
    field = Field.from_scene(scene).to(dtype)
    rays = rays.map(lambda values: values.to(dtype).requires_grad_())
    basis = field.basis(rays.directions).detach().requires_grad_()
    # The kernels give the gradient of the basis, the field goes without one.
    field.ray_terms = lambda directions, codes: basis  # type: ignore

    def colours(latent: torch.Tensor, terms: torch.Tensor, ray: torch.Tensor) -> torch.Tensor:
        return torch.sigmoid(torch.einsum("nf,ncf->nc", latent, terms[ray]))

    field.colours = colours  # type: ignore[method-assign]
    aabb, occupancy = torch.from_numpy(scene.aabb).to(dtype), torch.from_numpy(scene.occupancy)
    rgb, distortion, weights, cells = render_reference(field, rays, aabb, occupancy, scene.step, mapping=scene.mapping)
    rgb.retain_grad()
    squared = (rgb - targets.to(dtype)).square()
    (squared.mean() + DISTORTION * distortion).backward()
    peaks = torch.zeros(scene.occupancy.shape[1:], dtype=dtype)
    peaks.index_put_(tuple(cells.T), torch.zeros(len(cells), dtype=dtype))
    for cell, weight in zip(cells.tolist(), weights.tolist(), strict=True):
        peaks[tuple(cell)] = max(float(peaks[tuple(cell)]), weight)
    times = _gradient(rays.times)[:, None]
    found = {"theta": field.theta, "density": field.density, "basis": basis}
    return {
        **{name: _gradient(values) for name, values in found.items()},
        "rays": np.concatenate([_gradient(rays.origins), _gradient(rays.directions), times, _gradient(rgb)], 1),
        "motion": np.zeros(0) if field.motion is None else _gradient(field.motion),
        "errors": squared.sum(1).detach().numpy(),
        "samples": np.array(len(weights)),
        "peaks": peaks.numpy(),
    }


def _gradient(values: torch.Tensor) -> np.ndarray:
    assert values.grad is not None
    return values.grad.numpy()
