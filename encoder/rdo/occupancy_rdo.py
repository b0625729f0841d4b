"""Which cells are told as occupied: so few bits as the pictures, and a renderer's time, allow.

Where density ends a grid is ragged by chance, and what is ragged takes bits (`kpc.format.coding.occupancy_codec`). A cell may be told otherwise than it is if
that costs less than it saves: one that holds next to nothing may be marched, and then shows that; one that hardly gives any ray
its colour may be left out. Cells are flipped one by one, over and over, where that makes less of

    bits of all cells + MARCHED * cells that are occupied + BITS * parameters * error / most

with the error in pictures that comes of flipping them, as a share of the most that coding may bring: about what planes would take to make
up for it. The error is found by rays of the scene's cameras, from the weight that each ray has in each cell.
"""

from dataclasses import replace

import numpy as np
import torch
from kpc.encoder.evaluation.evaluate import SceneRenderer
from kpc.encoder.evaluation.validation_rays import Measure, ValidationRays
from kpc.encoder.field.fused import march_scene
from kpc.format.coding.occupancy_codec import CONTEXTS, NEIGHBOURS
from kpc.format.common.jit import compiled, inlined
from kpc.format.scene.grid import dilate
from kpc.format.scene.scene import Scene

MARCH_BITS = 0.5
"""Bits that a cell less to march is worth. With 1 soldier has 2 % fewer cells to march, and 3 % more bytes to tell them."""
PLANE_BITS = 0.15
"""Of planes, a parameter, that make errors e times smaller: 0.12 to 0.25 for the default scene, soldier, liam and room."""
CONTRAST = 0.1
"""Mean squared difference in colour, as a share of the full range, between what is in a cell and what is behind it; and as neighbours on a
ray err together, some more."""
SHARE = 0.05
"""Of the error that coding may bring, how much may come of this."""
ERROR_GROWTH = 8.0
"""How much more errors are taken to cost, where that was exceeded; and how often that is tried."""
TRIES = 3
RAYS, RAYS_A_CELL = 1 << 19, 8
"""That look for errors, at most. With a quarter of them cells are left out that other rays need: pictures of room then err forty times as much."""
FEWER_RAYS = 1 << 18
"""At most, that look for what empty cells would show. Those are marched that are next to occupied ones; where they hide others, it is not known what these show."""
RAYS_AT_ONCE = 1 << 12
PASSES = 8
MAX_OWN_BITS = 8.0
"""Bits more that a flipped cell itself would take, for which what it does to others is not looked at."""


def optimise_occupancy(scene: Scene, errors: np.ndarray, measure: Measure, most: float) -> Scene:
    """The scene with cells of its occupancy flipped, where it pays and pictures lose no more than SHARE of `most`; else itself.

    Args:
        errors: `flip_errors` of the scene, or of one whose slots this one's stand for, several each.
        measure: of pictures, by which it is known what they lose. most: the error that coding may bring, in squares of 8-bit levels.
    """
    if most <= 0:
        return scene
    slots, *cells = scene.occupancy.shape
    known, lost = (
        measure(scene).mse,
        PLANE_BITS * scene.parameter_count / most * errors.reshape(slots, -1, *cells).sum(1),
    )
    for number in range(TRIES):
        candidate = replace(scene, occupancy=flip_cells(scene.occupancy, ERROR_GROWTH**number * lost))
        if measure(candidate).mse - known <= SHARE * most:
            return candidate
    return scene


def flip_errors(scene: Scene, probe: ValidationRays, share: int = 1) -> np.ndarray:
    """(slots, Nz, Ny, Nx) float64: mean squared error of colours, in squares of 8-bit levels, that comes of flipping a cell; 0 of those that are
    neither occupied nor next to one. By one in `share` of the rays that it takes."""
    wide = replace(scene, occupancy=dilate(scene.occupancy))
    rays = RAYS_A_CELL * int(np.count_nonzero(scene.occupancy))
    own, next_to_it = (
        removal_errors(one, probe, min(rays, most) // share) for one, most in ((scene, RAYS), (wide, FEWER_RAYS))
    )
    return np.where(scene.occupancy, own, next_to_it)


def removal_errors(scene: Scene, probe: ValidationRays, rays: int) -> np.ndarray:
    """(slots, Nz, Ny, Nx) float64: mean squared error of colours, in squares of 8-bit levels, that comes of not marching a cell.

    By a probe and so many random rays of the scene's cameras.
    """
    renderer, slots = SceneRenderer(scene), len(scene.occupancy)
    probe = probe.subset(np.flatnonzero(renderer.hits_occupied(*probe.rays)))
    more = ValidationRays.through_occupied(scene, rays, seed=5)
    sums = np.zeros(scene.occupancy.size)
    for one in (probe, more):
        for some in one.batches(RAYS_AT_ONCE):
            with torch.no_grad():
                samples, met = march_scene(renderer.field, renderer.batch(*some.rays), scene)
            ray, weights = samples.ray.numpy(), met.weights.numpy().astype(np.float64)
            slot = np.minimum((some.times * slots).astype(np.int64), slots - 1)[ray]
            cell = np.ravel_multi_index((slot, *samples.cell.numpy().T), scene.occupancy.shape)
            first = np.flatnonzero(
                np.diff(cell, prepend=-1) | np.diff(ray, prepend=-1)
            )  # of a ray's samples in one cell
            sums += np.bincount(cell[first], np.add.reduceat(weights, first) ** 2 if len(first) else None, sums.size)
    error: np.ndarray = (
        255**2 * CONTRAST * sums.reshape(scene.occupancy.shape) / max(1, len(probe.times) + len(more.times))
    )
    return error


def flip_cells(occupancy: np.ndarray, lost: np.ndarray) -> np.ndarray:
    """(slots, Nz, Ny, Nx) bool `occupancy`, as it is cheapest to tell; `lost`: bits that errors of flipping a cell are worth. Cells that
    are neither occupied nor next to one stay empty."""
    cells = np.array(occupancy, np.uint8, order="C")
    occupied = np.where(occupancy, MARCH_BITS - lost, np.where(dilate(occupancy), MARCH_BITS + lost, np.inf))
    for _ in range(PASSES):
        counts = count_contexts(cells, NEIGHBOURS) + 0.4
        if not _flip(cells, -np.log2(counts / counts.sum(1, keepdims=True)), occupied, NEIGHBOURS):
            break
    return cells.view(bool)


@compiled()
def count_contexts(cells, neighbours):
    """(CONTEXTS, 2): how often a cell is empty, and how often occupied, in each context."""
    counts = np.zeros((CONTEXTS, 2))
    for s in range(cells.shape[0]):
        for z in range(cells.shape[1]):
            for y in range(cells.shape[2]):
                for x in range(cells.shape[3]):
                    counts[context_at(cells, s, z, y, x, neighbours), cells[s, z, y, x]] += 1
    return counts


@compiled()
def _flip(cells, bits, occupied, neighbours):
    """Flip cells one by one where that costs less than it saves: how many.

    Args:
        bits: (CONTEXTS, 2) of a cell that is empty, or occupied. occupied: what it costs that a cell is, besides.
    """
    S, Z, Y, X = cells.shape
    count = 0
    for s in range(S):
        for z in range(Z):
            for y in range(Y):
                for x in range(X):
                    is_set = int(cells[s, z, y, x])
                    context = context_at(cells, s, z, y, x, neighbours)
                    more = (
                        bits[context, 1 - is_set]
                        - bits[context, is_set]
                        + (-occupied[s, z, y, x] if is_set else occupied[s, z, y, x])
                    )
                    if not more < MAX_OWN_BITS:
                        continue
                    for k in range(len(neighbours)):  # those in whose contexts it is
                        i, j, v, u = (
                            s - neighbours[k, 0],
                            z - neighbours[k, 1],
                            y - neighbours[k, 2],
                            x - neighbours[k, 3],
                        )
                        if 0 <= i < S and 0 <= j < Z and 0 <= v < Y and 0 <= u < X:
                            theirs, told = context_at(cells, i, j, v, u, neighbours), int(cells[i, j, v, u])
                            more += bits[theirs ^ 1 << len(neighbours) - 1 - k, told] - bits[theirs, told]
                    if more < 0:
                        cells[s, z, y, x] = 1 - is_set
                        count += 1
    return count


@inlined
def context_at(cells, s, z, y, x, neighbours):
    """The context of a cell, as `kpc.format.coding.occupancy_codec.walk` finds it."""
    S, Z, Y, X = cells.shape
    context = 0
    for k in range(len(neighbours)):
        i, j, v, u = s + neighbours[k, 0], z + neighbours[k, 1], y + neighbours[k, 2], x + neighbours[k, 3]
        there = 0 <= i < S and 0 <= j < Z and 0 <= v < Y and 0 <= u < X
        context = context << 1 | (int(cells[i, j, v, u]) if there else 0)
    return context
