"""What an error in each number of each plane costs, found by rendering: so coding knows where it matters.

To second order an error e in the planes moves the colours of rays by J e, and so their squared differences come to e' J'J e
(Gauss-Newton). Of J'J the diagonal is taken: for each number its squared derivatives of all three colours, summed, the mean over rays.
Where every colour is given a random sign, the squared gradient of their sum has it as its mean, for cross terms cancel (Hutchinson,
Commun. Stat. Simul. Comput. 19, 1990; Bekas, Kokiopoulou and Saad, Appl. Numer. Math. 57, 2007).

The squared gradients that Adam keeps are something else: derivatives times how wrong the picture still is, which coding does not
change, and of the last few hundred steps alone.
"""

from collections.abc import Mapping, Sequence

import numpy as np
import torch

from kpc.encoder.evaluate import SceneRenderer
from kpc.encoder.field import Layout
from kpc.encoder.probe import Probe
from kpc.encoder.render import marched, shade
from kpc.format.scene import Scene

Curvature = Sequence[Mapping[str, np.ndarray]]
"""One mapping a scale, plane name -> (rows, columns, M) float32, none negative."""

RAYS = 1 << 17
"""That planes are judged by. Room and liam, files at equal error of held-out views: with 1 << 16 a percent or two larger, with 1 << 18 a
percent smaller."""
RAYS_AT_ONCE = 1 << 10
"""In one gradient: the more, the more cross terms have to cancel; the fewer, the longer it takes."""


def curvature(scene: Scene, probe: Probe, rays: int = RAYS) -> list[dict[str, np.ndarray]]:
    """Of a scene's planes, for each number the mean squared derivative of colours, by a probe and by random rays of its cameras.

    Takes one copy of the planes and of their gradient per core, and nothing that grows with `rays`.
    """
    renderer, rng = SceneRenderer(scene), np.random.default_rng(3)
    field = renderer.field
    more = Probe.of_cameras(scene, max(0, rays - len(probe.times)), seed=2)
    squares = torch.zeros_like(field.theta)
    for one in (probe, more):
        order = rng.permutation(len(one.times))[:rays]
        for start in range(0, len(order), RAYS_AT_ONCE):
            some = order[start : start + RAYS_AT_ONCE]
            batch = renderer.batch(*(a[some] for a in one.rays))
            _, met = marched(field, batch, scene)
            codes = renderer.codes(None if one.appearances is None else one.appearances[some])
            colours = shade(field, batch, met, None if codes is None else torch.from_numpy(codes))
            signs = torch.from_numpy(rng.choice(np.float32([-1, 1]), tuple(colours.shape)))
            gradient, = torch.autograd.grad((signs * colours).sum(), field.theta)
            squares += gradient.square_()
    return _by_plane(field.layout, scene, squares.numpy() / rays)


def _by_plane(layout: Layout, scene: Scene, squares: np.ndarray) -> list[dict[str, np.ndarray]]:
    """Numbers of every element of `Field.theta`, smoothed, as far as the scene has them."""
    planes: list[dict[str, np.ndarray]] = [{} for _ in scene.scales]
    for s, name, start, rows, columns in layout.planes():
        plane = squares[start : start + rows * columns * layout.channels].reshape(rows, columns, -1)
        plane = plane[..., : scene.scales[s][name].shape[2]]
        planes[s][name] = _smoothed(_smoothed(plane, 0), 1)
    return planes


def _smoothed(plane: np.ndarray, axis: int) -> np.ndarray:
    """The mean of each texel and those between it and its neighbours: rays that pass near one pass near the next."""
    padded = np.pad(plane, [(1, 1) if k == axis else (0, 0) for k in range(3)], mode="edge")
    before, after = (np.take(padded, range(k, k + plane.shape[axis]), axis) for k in (0, 2))
    return plane / 2 + (before + after) / 4
