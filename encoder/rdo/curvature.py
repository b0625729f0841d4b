"""Curvature of the rendering error: what an error in each value of the planes costs, estimated by rendering.

To second order an error e in the planes moves the colours of rays by J e, and their squared differences sum to e' J'J e
(Gauss-Newton). The diagonal of J'J is estimated: for each value its squared derivatives of all three colours, summed,
the mean over rays. Where every colour is given a random sign, the squared gradient of their sum has the diagonal as
its mean, since the cross terms cancel (Hutchinson, Commun. Stat. Simul. Comput. 19, 1990; Bekas, Kokiopoulou and
Saad, Appl. Numer. Math. 57, 2007).

Off the diagonal only the channels of a texel are considered. They produce the same few colours, so that an error in one
channel can compensate errors in others. Their correlation is estimated from products of the same gradients.

The squared gradients that Adam keeps would not do: they are derivatives times the remaining error of the picture, which
coding does not change, and cover the last few hundred steps only.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from kpc.encoder.evaluation.evaluate import SceneRenderer
from kpc.encoder.evaluation.validation_rays import ValidationRays
from kpc.encoder.field.fused import colour_gradients
from kpc.encoder.field.layout import Layout
from kpc.format.common.progress import progress
from kpc.format.scene.scene import Scene

# Figures behind these constants: docs/design/rate-distortion.md, "Curvature".
BLOCK_SIDE = 2  # texels along the side of a block that shares one correlation matrix
RAYS = 1 << 18  # rays that the curvature is estimated on
RAYS_PER_GRADIENT = 1 << 10  # more leave more cross terms to cancel, fewer take longer

# Arrays of planes: one mapping per scale, from the plane's name.
PerPlane = Sequence[Mapping[str, np.ndarray]]


@dataclass(frozen=True)
class Curvature:
    """What errors in planes cost.

    Attributes:
        diagonal: (H, W, M) float32 per plane, not negative: mean squared derivatives of the colours by each value.
        correlation: (ceil(H / BLOCK_SIDE), ceil(W / BLOCK_SIDE), M, M) float32 per plane: correlation, from -1 to 1, of
            the derivatives by two channels of a texel, in each block; 0 for a channel with itself.
        motion: (T, Nz, Ny, Nx, 3) float32, like `diagonal`, for displacements; None where there are none.
    """

    diagonal: PerPlane
    correlation: PerPlane
    motion: np.ndarray | None = None


def estimate_curvature(
    scene: Scene, validation: ValidationRays, rays: int | None = None, *, effort: float = 1.0, shown: bool = False
) -> Curvature:
    """Estimate the curvature for a scene's planes.

    Uses those validation rays that pass through occupied cells, and fills up with random rays of the scene's cameras.
    Takes memory for a copy of the planes and of their gradient per core, and M values per BLOCK_SIDE^2 values of the
    planes.

    Args:
        scene: uncoded.
        validation: rays that are used first.
        rays: number of rays in all; None for a share `effort` of RAYS.
        shown: whether to show progress.
    """
    renderer, rng = SceneRenderer(scene), np.random.default_rng(3)
    field, rays = renderer.field, int(effort * RAYS) if rays is None else rays
    hits = np.flatnonzero(renderer.hits_occupied(*validation.rays))
    validation = validation.subset(rng.permutation(hits)[:rays])
    more = ValidationRays.through_occupied(scene, rays - len(validation.times), seed=2)
    parameters = [field.theta] if field.motion is None else [field.theta, field.motion]
    squares = [np.zeros(tuple(one.shape), np.float32) for one in parameters]
    products = [
        {name: channel_products(np.zeros_like(plane)) for name, plane in scale.items()} for scale in scene.scales
    ]
    batches = [*validation.batches(RAYS_PER_GRADIENT), *more.batches(RAYS_PER_GRADIENT)]
    for batch in progress(batches, "measuring what errors cost", unit="batches", shown=shown):
        codes = renderer.codes(batch.appearances)
        signs = rng.choice(np.array([-1, 1], np.float32), (len(batch.times), 3))
        gradients = colour_gradients(
            field, renderer.batch(*batch.rays), scene, signs, None if codes is None else torch.from_numpy(codes)
        )
        for scale, planes in zip(products, _by_plane(field.layout, scene, gradients[0]), strict=True):
            for name, plane in planes.items():
                scale[name] += channel_products(plane)
        for total, gradient in zip(squares, gradients, strict=True):
            total += np.square(gradient)
    count = max(1, len(validation.times) + len(more.times))
    theta_diagonal, *motion = (total / count for total in squares)
    diagonal = [
        {name: _smooth(_smooth(plane, 0), 1) for name, plane in scale.items()}
        for scale in _by_plane(field.layout, scene, theta_diagonal)
    ]
    correlation = [{name: _correlation(sums) for name, sums in scale.items()} for scale in products]
    return Curvature(diagonal, correlation, *motion)


def _by_plane(layout: Layout, scene: Scene, values: np.ndarray) -> list[dict[str, np.ndarray]]:
    """Split values of all elements of `Field.theta` into planes, without the channels that the scene does not have."""
    planes: list[dict[str, np.ndarray]] = [{} for _ in scene.scales]
    for s, name, start, rows, columns in layout.planes():
        plane = values[start : start + rows * columns * layout.channels].reshape(rows, columns, -1)
        planes[s][name] = plane[..., : scene.scales[s][name].shape[2]]
    return planes


def channel_products(plane: np.ndarray) -> np.ndarray:
    """Sum the products of two channels over each block: (H, W, M) to (blocks down, blocks across, M, M)."""
    rows, columns, M = plane.shape
    down = -(-rows // BLOCK_SIDE)
    padded = np.pad(plane, ((0, -rows % BLOCK_SIDE), (0, -columns % BLOCK_SIDE), (0, 0)))
    blocks = padded.reshape(down, BLOCK_SIDE, -1, BLOCK_SIDE, M).swapaxes(1, 2)
    blocks = blocks.reshape(down, -1, BLOCK_SIDE * BLOCK_SIDE, M)
    return blocks.swapaxes(2, 3) @ blocks


def _correlation(sums: np.ndarray) -> np.ndarray:
    """Normalise sums of products (..., M, M); 0 where nothing is known, and for a channel with itself."""
    roots = np.sqrt(np.einsum("abmm->abm", sums))
    largest = roots[..., None] * roots[..., None, :] * (1 - np.eye(roots.shape[2], dtype=np.float32))
    return np.divide(sums, largest, out=np.zeros_like(sums), where=largest > 0)


def _smooth(plane: np.ndarray, axis: int) -> np.ndarray:
    """Filter by (1 2 1) / 4 along an axis: rays that pass near one texel also pass near the next."""
    padded = np.pad(plane, [(1, 1) if k == axis else (0, 0) for k in range(3)], mode="edge")
    before, after = (np.take(padded, range(k, k + plane.shape[axis]), axis) for k in (0, 2))
    return plane / 2 + (before + after) / 4
