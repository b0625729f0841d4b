"""Scenes, rays and functions for the tests of gradients (`kpc.tools.bench.stability.gradients`)."""

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from kpc.encoder.field.field import Field
from kpc.encoder.field.render import Rays
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
