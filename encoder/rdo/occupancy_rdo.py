"""Choice of the occupied cells by rate and distortion, within what pictures and a renderer's time allow.

The boundary of a trained occupancy is ragged by chance, and that takes bits (`kpc.encoder.coding.occupancy_codec`). A
cell may be flipped if that costs less than it saves: one that holds next to nothing may be marched, and then shows
that; one that hardly gives any ray its colour may be empty. Cells are flipped one by one, in several passes, where
that reduces

    bits of all cells + MARCH_BITS * occupied cells + PLANE_BITS * parameters * error / allowed error

with the error in pictures that comes of flipping. The last term is about the bits with which planes would make up for
it. The error is estimated on rays of the scene's cameras, from the weight that each ray has in each cell.
"""

from dataclasses import replace

import numpy as np

from kpc.encoder.coding.occupancy_codec import CONTEXTS, NEIGHBOURS
from kpc.encoder.evaluation.evaluate import SceneRenderer
from kpc.encoder.evaluation.validation_rays import Measure, ValidationRays
from kpc.encoder.field.fused import weigh_cells
from kpc.format.common.progress import progress
from kpc.format.scene.grid import dilate
from kpc.format.scene.scene import Scene
from kpc.jit import compiled, inlined

# Figures behind these constants: docs/design/rate-distortion.md, "Occupancy".
MARCH_BITS = 0.5  # bits that may be spent to have one cell less to march
PLANE_BITS = 0.15  # bits per parameter with which planes make their errors e times smaller
# Mean squared difference of the colour in a cell from that behind it, as a share of the full range; a little more,
# since the errors of neighbouring cells on a ray add up.
CONTRAST = 0.1
SHARE = 0.05  # of the allowed error that this may take
ERROR_GROWTH = 8.0  # factor on the assumed errors for each retry, where SHARE was exceeded
TRIES = 3
RAYS, RAYS_PER_CELL = 1 << 19, 8  # rays that errors of occupied cells are estimated on, at most
FEWER_RAYS = 1 << 18  # rays for empty cells next to occupied ones, at most
RAYS_PER_BATCH = 1 << 12
PASSES = 8
MAX_OWN_BITS = 8.0  # a flip that costs so many bits for the cell itself is not considered further


def optimise_occupancy(scene: Scene, errors: np.ndarray, measure: Measure, mse: float) -> Scene:
    """Flip cells of a scene's occupancy where it pays, if that adds at most SHARE of an error.

    Args:
        scene: whose slots may be several merged slots each of the scene that `errors` are of.
        errors: `flip_errors` of the original scene.
        measure: judges scenes.
        mse: error that coding may bring, on the 8-bit scale.

    Returns:
        The scene with its new occupancy; itself where the added error is too large.
    """
    if mse <= 0:
        return scene
    slots, *cells = scene.occupancy.shape
    known = measure(scene).mse
    lost = PLANE_BITS * scene.parameter_count / mse * errors.reshape(slots, -1, *cells).sum(1)
    for number in range(TRIES):
        candidate = replace(scene, occupancy=flip_cells(scene.occupancy, ERROR_GROWTH**number * lost))
        if measure(candidate).mse - known <= SHARE * mse:
            return candidate
    return scene


def flip_errors(scene: Scene, validation: ValidationRays, ray_divisor: int = 1, shown: bool = False) -> np.ndarray:
    """Estimate the MSE of colours that comes of flipping each cell.

    Args:
        scene: uncoded.
        validation: rays that are used first; random rays of the scene's cameras follow.
        ray_divisor: use this many times fewer rays.
        shown: whether to show progress.

    Returns:
        (slots, Nz, Ny, Nx) float64, on the 8-bit scale; 0 for cells that are neither occupied nor next to such a cell.
    """
    dilated = replace(scene, occupancy=dilate(scene.occupancy))
    rays = RAYS_PER_CELL * int(np.count_nonzero(scene.occupancy))
    removing, adding = (
        removal_errors(one, validation, min(rays, most) // ray_divisor, shown)
        for one, most in ((scene, RAYS), (dilated, FEWER_RAYS))
    )
    return np.where(scene.occupancy, removing, adding)


def removal_errors(scene: Scene, validation: ValidationRays, rays: int, shown: bool = False) -> np.ndarray:
    """Estimate the MSE of colours that comes of not marching each cell, on validation rays and `rays` random ones.

    Returns:
        (slots, Nz, Ny, Nx) float64, on the 8-bit scale.
    """
    renderer, slots = SceneRenderer(scene), len(scene.occupancy)
    validation = validation.subset(np.flatnonzero(renderer.hits_occupied(*validation.rays)))
    more = ValidationRays.through_occupied(scene, rays, seed=5)
    sums = np.zeros(scene.occupancy.size)
    batches = [*validation.batches(RAYS_PER_BATCH), *more.batches(RAYS_PER_BATCH)]
    for batch in progress(batches, "measuring which cells matter", unit="batches", shown=shown):
        ray, cells, weights = weigh_cells(renderer.field, renderer.batch(*batch.rays), scene)
        slot = np.minimum((batch.times * slots).astype(np.int64), slots - 1)[ray]
        cell = np.ravel_multi_index((slot, *cells.T), scene.occupancy.shape)
        # The first of a ray's consecutive samples in each cell; their weights are added up.
        first = np.flatnonzero(np.diff(cell, prepend=-1) | np.diff(ray, prepend=-1))
        if len(first):
            np.add.at(sums, cell[first], np.add.reduceat(weights.astype(np.float64), first) ** 2)
    count = max(1, len(validation.times) + len(more.times))
    error: np.ndarray = 255**2 * CONTRAST * sums.reshape(scene.occupancy.shape) / count
    return error


def flip_cells(occupancy: np.ndarray, lost: np.ndarray) -> np.ndarray:
    """Return the occupancy of least cost.

    Args:
        occupancy: (slots, Nz, Ny, Nx) bool.
        lost: of the same shape, cost of flipping each cell, in bits.

    Returns:
        Of the same shape; cells that are neither occupied nor next to such a cell stay empty.
    """
    cells = np.array(occupancy, np.uint8, order="C")
    occupied = np.where(occupancy, MARCH_BITS - lost, np.where(dilate(occupancy), MARCH_BITS + lost, np.inf))
    for _ in range(PASSES):
        counts = count_contexts(cells, NEIGHBOURS) + 0.4
        if not _flip(cells, -np.log2(counts / counts.sum(1, keepdims=True)), occupied, NEIGHBOURS):
            break
    return cells.view(bool)


@compiled()
def count_contexts(cells, neighbours):
    """Count how often cells are empty, and occupied, in each context: (CONTEXTS, 2)."""
    counts = np.zeros((CONTEXTS, 2))
    for s in range(cells.shape[0]):
        for z in range(cells.shape[1]):
            for y in range(cells.shape[2]):
                for x in range(cells.shape[3]):
                    counts[context_at(cells, s, z, y, x, neighbours), cells[s, z, y, x]] += 1
    return counts


@compiled()
def _flip(cells, bits, occupied, neighbours):
    """Flip cells, one by one, where that saves bits; return how many.

    Args:
        cells: (slots, Nz, Ny, Nx) uint8, updated.
        bits: (CONTEXTS, 2), of an empty and of an occupied cell.
        occupied: (slots, Nz, Ny, Nx), further bits that an occupied cell costs.
        neighbours: of the contexts.
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
                    for k in range(len(neighbours)):  # cells whose contexts this one is part of
                        i, j, v, u = (
                            s - neighbours[k, 0],
                            z - neighbours[k, 1],
                            y - neighbours[k, 2],
                            x - neighbours[k, 3],
                        )
                        if 0 <= i < S and 0 <= j < Z and 0 <= v < Y and 0 <= u < X:
                            theirs, other = context_at(cells, i, j, v, u, neighbours), int(cells[i, j, v, u])
                            more += bits[theirs ^ 1 << len(neighbours) - 1 - k, other] - bits[theirs, other]
                    if more < 0:
                        cells[s, z, y, x] = 1 - is_set
                        count += 1
    return count


@inlined
def context_at(cells, s, z, y, x, neighbours):
    """Return the context of a cell, as in `kpc.encoder.coding.occupancy_codec`."""
    S, Z, Y, X = cells.shape
    context = 0
    for k in range(len(neighbours)):
        i, j, v, u = s + neighbours[k, 0], z + neighbours[k, 1], y + neighbours[k, 2], x + neighbours[k, 3]
        there = 0 <= i < S and 0 <= j < Z and 0 <= v < Y and 0 <= u < X
        context = context << 1 | (int(cells[i, j, v, u]) if there else 0)
    return context
