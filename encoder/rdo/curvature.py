"""What an error in each number of each plane costs, found by rendering: so coding knows where it matters.

To second order an error e in the planes moves the colours of rays by J e, and so their squared differences come to e' J'J e
(Gauss-Newton). Of J'J the diagonal is taken: for each number its squared derivatives of all three colours, summed, the mean over rays.
Where every colour is given a random sign, the squared gradient of their sum has it as its mean, for cross terms cancel (Hutchinson,
Commun. Stat. Simul. Comput. 19, 1990; Bekas, Kokiopoulou and Saad, Appl. Numer. Math. 57, 2007).

Of what is off the diagonal, the channels of a texel are looked at, too: they make the same few colours, so that an error in one can undo
what others err, here in this direction and there in that. It is found from products of the same gradients.

The squared gradients that Adam keeps are something else: derivatives times how wrong the picture still is, which coding does not
change, and of the last few hundred steps alone.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from kpc.encoder.evaluation.evaluate import SceneRenderer
from kpc.encoder.evaluation.validation_rays import ValidationRays
from kpc.encoder.field.field import Layout
from kpc.encoder.field.render import march_scene, shade
from kpc.format.scene.scene import Scene

BLOCK_SIDE = 2
"""Texels along that of a block. Default scene, at equal error of pictures: files are 1 % larger with 4 or 8."""
RAYS = 1 << 18
"""That planes are judged by. Room and soldier, files at equal error of held-out views: with 1 << 17 one to two percent larger."""
RAYS_PER_GRADIENT = 1 << 10
"""In one gradient: the more, the more cross terms have to cancel; the fewer, the longer it takes."""


PerPlane = Sequence[Mapping[str, np.ndarray]]
"""One mapping a scale, plane name -> array."""


@dataclass(frozen=True)
class Curvature:
    """What errors in planes cost.

    Attributes:
        diagonal: (rows, columns, M) float32, none negative: mean squared derivatives of colours by each number.
        correlation: (blocks down, blocks along, M, M) float32: of each block of SIDE x SIDE texels, the correlation of derivatives by two
            channels of a texel, from -1 to 1, and 0 for a channel with itself.
        motion: (T, Nz, Ny, Nx, 3) float32: as `diagonal`, of displacements; None where there are none.
    """

    diagonal: PerPlane
    correlation: PerPlane
    motion: np.ndarray | None = None


def estimate_curvature(scene: Scene, probe: ValidationRays, rays: int | None = None) -> Curvature:
    """Of a scene's planes, by a probe and by random rays of its cameras, as far as they pass where anything may be; in all RAYS, if not said.

    Takes one copy of the planes and of their gradient per core, M numbers for SIDE^2 of them, and nothing that grows with `rays`.
    """
    renderer, rng = SceneRenderer(scene), np.random.default_rng(3)
    field, rays = renderer.field, RAYS if rays is None else rays
    probe = probe.subset(rng.permutation(np.flatnonzero(renderer.hits_occupied(*probe.rays)))[:rays])
    more = ValidationRays.through_occupied(scene, rays - len(probe.times), seed=2)
    learnt = [field.theta] if field.motion is None else [field.theta, field.motion]
    squares = [torch.zeros_like(one) for one in learnt]
    products = [{name: _products(np.zeros_like(plane)) for name, plane in scale.items()} for scale in scene.scales]
    for one in (probe, more):
        for some in one.batches(RAYS_PER_GRADIENT):
            batch = renderer.batch(*some.rays)
            _, met = march_scene(field, batch, scene)
            codes = renderer.codes(some.appearances)
            colours = shade(field, batch, met, None if codes is None else torch.from_numpy(codes))
            signs = torch.from_numpy(rng.choice(np.float32([-1, 1]), tuple(colours.shape)))
            gradients = torch.autograd.grad((signs * colours).sum(), learnt)
            for scale, planes in zip(products, _by_plane(field.layout, scene, gradients[0].numpy()), strict=True):
                for name, plane in planes.items():
                    scale[name] += _products(plane)
            for total, gradient in zip(squares, gradients, strict=True):
                total += gradient.square_()
    of_planes, *of_motion = (total.numpy() / max(1, len(probe.times) + len(more.times)) for total in squares)
    alone = [
        {name: _smoothed(_smoothed(plane, 0), 1) for name, plane in scale.items()}
        for scale in _by_plane(field.layout, scene, of_planes)
    ]
    together = [{name: _correlation(sums) for name, sums in scale.items()} for scale in products]
    return Curvature(alone, together, *of_motion)


def _by_plane(layout: Layout, scene: Scene, numbers: np.ndarray) -> list[dict[str, np.ndarray]]:
    """Numbers of every element of `Field.theta`, as far as the scene has them."""
    planes: list[dict[str, np.ndarray]] = [{} for _ in scene.scales]
    for s, name, start, rows, columns in layout.planes():
        plane = numbers[start : start + rows * columns * layout.channels].reshape(rows, columns, -1)
        planes[s][name] = plane[..., : scene.scales[s][name].shape[2]]
    return planes


def _products(plane: np.ndarray) -> np.ndarray:
    """(blocks down, blocks along, M, M): of a (rows, columns, M) plane, products of channels, summed over the texels of each block."""
    rows, columns, M = plane.shape
    whole = np.pad(plane, ((0, -rows % BLOCK_SIDE), (0, -columns % BLOCK_SIDE), (0, 0)))
    blocks = (
        whole.reshape(-(-rows // BLOCK_SIDE), BLOCK_SIDE, -1, BLOCK_SIDE, M)
        .swapaxes(1, 2)
        .reshape(-(-rows // BLOCK_SIDE), -1, BLOCK_SIDE * BLOCK_SIDE, M)
    )
    return blocks.swapaxes(2, 3) @ blocks


def _correlation(sums: np.ndarray) -> np.ndarray:
    """Of sums of products; 0 where nothing is known, and of channels with themselves."""
    roots = np.sqrt(np.einsum("abmm->abm", sums))
    largest = roots[..., None] * roots[..., None, :] * (1 - np.eye(roots.shape[2], dtype=np.float32))
    return np.divide(sums, largest, out=np.zeros_like(sums), where=largest > 0)


def _smoothed(plane: np.ndarray, axis: int) -> np.ndarray:
    """The mean of each texel and those between it and its neighbours: rays that pass near one pass near the next."""
    padded = np.pad(plane, [(1, 1) if k == axis else (0, 0) for k in range(3)], mode="edge")
    before, after = (np.take(padded, range(k, k + plane.shape[axis]), axis) for k in (0, 2))
    return plane / 2 + (before + after) / 4
