"""Sweeps of single stages, and of gradients: the product over planes, compositing, the truncated exponential."""

from collections.abc import Iterator
from functools import cache

import numpy as np
import torch

from kpc.encoder.field import kernels
from kpc.encoder.field.field import Field
from kpc.encoder.field.fused import planes_of
from kpc.encoder.field.layout import Layout
from kpc.encoder.field.render import Rays
from kpc.format.coding.quantise import VALUE_LIMIT
from kpc.format.scene.scene import LOG_DENSITY_LIMIT, Scene
from kpc.tools.bench.stability.gradients import backpropagate, reference_gradients
from kpc.tools.bench.stability.scenes import OUTSIDE, soft_scene
from kpc.tools.bench.stability.sweeps import Sweep, largest_ratio, powers

# Share of the largest gradient of its kind by which gradients may be off: samples without colour have none.
GRADIENT = 0.02
# A product of six float32 numbers, and its derivatives, round at most a dozen times.
ROUNDED = 1e-6


def sweeps() -> list[Sweep]:
    """Return all sweeps of stages and gradients."""
    everywhere = (-np.inf, np.inf)
    return [
        Sweep(
            "product over planes",
            "size of all six numbers",
            powers(10, range(-7, 7)),
            _products,
            (1e-6, VALUE_LIMIT),
            "files hold 2,048; a product below 1e-38 is 0",
            "relative",
            ROUNDED,
        ),
        Sweep(
            "gradient of the product",
            "size of all six numbers",
            powers(10, range(-7, 7)),
            _product_gradients,
            (1e-6, VALUE_LIMIT),
            "files hold 2,048",
            "relative",
            ROUNDED,
        ),
        Sweep(
            "gradient of the exponential",
            "log density that is added",
            (-40, -20, -10, -5, 0, 5, 10, 20, 40),
            lambda log_density: _gradients(soft_scene(log_density=log_density)),
            everywhere,
            f"log density is clipped to {LOG_DENSITY_LIMIT:g}, where the gradient ends",
            "of the largest",
            GRADIENT,
        ),
        Sweep(
            "gradient of compositing",
            "samples along an edge",
            (4, 16, 64, 256, 512),
            lambda samples: _gradients(soft_scene(samples=int(samples))),
            (1, 512),
            "presets take 64 to 512",
            "of the largest",
            GRADIENT,
        ),
    ]


def _products(value: float) -> dict[str, float]:
    """Return the relative error of the product of six equal numbers."""
    field, exact = _constant_field(value)
    points, times = np.full((1, 3), 0.3, np.float32), np.full(1, 0.3, np.float32)
    found = kernels.features(planes_of(field), points, times, 1)
    with torch.no_grad():
        by_torch = field.features(torch.from_numpy(points), torch.from_numpy(times)).numpy()
    return {"kernels": largest_ratio(found, exact), "torch": largest_ratio(by_torch, exact)}


def _product_gradients(value: float) -> dict[str, float]:
    """Return the relative error of the derivatives of the product by its six numbers."""
    field, exact = _constant_field(value)
    planes, layout = planes_of(field), field.layout
    corner = np.zeros((1, 3), np.float32), np.zeros(1, np.float32)
    found = np.zeros((1, layout.size), np.float32)
    nothing = np.zeros((0, 4), np.float32)
    kernels.scatter_features(planes, found, planes.motion[None], nothing, *corner, np.ones((1, 1), np.float32))
    field.features(*map(torch.from_numpy, corner)).sum().backward()  # type: ignore[no-untyped-call]
    by_torch = field.theta.grad
    assert by_torch is not None
    at = [start for _, _, start, *_ in layout.planes()]
    derivative = exact / float(np.float32(value))
    return {
        "kernels": largest_ratio(found[0, at], np.full(6, derivative)),
        "torch": largest_ratio(by_torch.numpy()[at], np.full(6, derivative)),
    }


def _constant_field(value: float) -> tuple[Field, float]:
    """Return a field whose planes hold one number, and the product of all six in float64."""
    field = Field(Layout.of(np.array([[2, 2, 2, 2]]), 1), 1)
    with torch.no_grad():
        for _, name, *_ in field.layout.planes():
            field.plane(0, name).fill_(value)
    return field, float(np.float64(np.float32(value)) ** 6)


@cache
def _usual_gradients() -> dict[str, np.ndarray]:
    scene = soft_scene()
    return reference_gradients(scene, *_batch(scene))


def _batch(scene: Scene) -> tuple[Rays, torch.Tensor]:
    """Return the rays of a picture, and colours that they should have."""
    origins, directions = OUTSIDE.rays()
    n = len(origins)
    rays = Rays.from_arrays(origins, directions, np.full(n, 0.4), np.full(n, 0.5), np.tile(scene.background, (n, 1)))
    return rays, torch.rand(n, 3, generator=torch.Generator().manual_seed(0))


def _gradients(scene: Scene) -> dict[str, float]:
    """Return the errors of gradients of a picture, as shares of the largest of their kind, here or in a usual scene."""
    rays, targets = _batch(scene)
    exact, usual = reference_gradients(scene, rays, targets), _usual_gradients()

    def errors(found: dict[str, np.ndarray]) -> Iterator[float]:
        for kind in ("theta", "density", "basis"):
            most = max(float(np.abs(gradients[kind]).max()) for gradients in (exact, usual))
            yield float(np.abs(found[kind] - exact[kind]).max()) / most if np.isfinite(found[kind]).all() else np.inf

    return {
        "kernels": max(errors(backpropagate(scene, rays, targets))),
        "torch": max(errors(reference_gradients(scene, rays, targets, torch.float32))),
    }
