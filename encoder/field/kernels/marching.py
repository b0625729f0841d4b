"""One ray through the field, rendering of batches, and lists of the samples that rays take."""

import numpy as np
from numba import prange

from kpc.encoder.field.kernels.arguments import RayBuffers
from kpc.encoder.field.kernels.compilation import bare, inlined, parallel, plain
from kpc.encoder.field.kernels.geometry import (
    cell_index,
    density_scale,
    inverse_edges,
    ray_distance,
    ray_point,
    ray_span,
)
from kpc.encoder.field.kernels.planes import locate_sample, place_sample, sample_planes
from kpc.encoder.field.kernels.texels import PLACES, POINT
from kpc.encoder.field.kernels.vectors import WIDE, absorb, decode, dot, sigmoids
from kpc.encoder.field.occupancy_grid import STRIDE, STRIDED
from kpc.format.container.scene_layout import SAMPLE_LIMIT
from kpc.format.scene.scene import LOG_DENSITY_LIMIT, TERMINATION

LIMIT = np.float32(LOG_DENSITY_LIMIT)
END_TRANSMITTANCE = np.float32(TERMINATION)

# No ray takes more steps, whatever its numbers are, so that every kernel ends and Ctrl-C is heard.
MOST_STEPS = SAMPLE_LIMIT + 2

# Samples that a ray takes at a time.
BLOCK = WIDE

# A sample of less weight than this gets no colour, nor one of so little that all samples of its ray could not make up
# half of an 8-bit level.
NEGLIGIBLE = np.float32(1e-4)
HALF_LEVEL = np.float32(0.5 / 255)


@plain
def new_ray_buffers(planes, capacity):
    """Return `RayBuffers` for `capacity` samples."""
    S, M = planes.places.shape[0], planes.channels
    capacity += BLOCK
    return RayBuffers(
        np.empty((capacity, S * 6 * M), np.float32),
        np.empty((capacity, S * M), np.float32),
        np.empty((capacity * S, PLACES), np.int32),
        np.empty((capacity * S, 4), np.float32),
        np.empty((1, 4), np.float32),
        np.empty((capacity, POINT), np.float32),
        np.empty(capacity, np.float32),
        np.empty(capacity, np.float32),
        np.empty(capacity, np.float32),
        np.empty(capacity, np.float32),
        np.empty((capacity, 4), np.float32),
        np.empty(capacity, np.float32),
        np.empty(capacity, np.int32),
        np.empty(capacity, np.float32),
        np.empty((1, S * M), np.float32),
        np.empty(4 * S * M, np.float32),
        np.empty(4 * S * M, np.float32),
        np.empty(4, np.float32),
        np.empty(4, np.float32),
    )


@inlined
def decode_density(features, k, density):
    """Return the clipped log density of row k of `features` (n, F); `density` (F + 1,) holds weights and bias."""
    F = density.size - 1
    return min(max(dot(features, k * F, density, 0, F) + density[F], -LIMIT), LIMIT)


@inlined
def set_decoder(buffers, density, basis):
    """Set buffers.decoder to the weights of the log density (F + 1,), without the bias, and of colours (3, F)."""
    F = density.size - 1
    for i in range(F):
        buffers.decoder[i] = density[i]
    for c in range(3):
        for i in range(F):
            buffers.decoder[(c + 1) * F + i] = basis[c, i]


@inlined
def find_samples(volume, occupied, span, origin, direction, time, jitter, buffers, first, k):
    """Write the next occupied samples of a ray, BLOCK at most, to the buffers from `first` on.

    buffers.taus is set to the thickness per density. In a STRIDED cell every STRIDE-th step stands for as many,
    counted from one that varies from ray to ray. `span` is from `ray_span`, `k` the step to begin with.

    Returns:
        The number of samples, and the step to go on with.
    """
    (near, far), inverse, phase = span, inverse_edges(volume.aabb), int(jitter * np.float32(4096.0))
    count, room = 0, min(BLOCK, buffers.weights.size - BLOCK - first)
    while count < room and k < MOST_STEPS:
        s = near + (np.float32(k) + jitter) * volume.step
        k += 1
        if not s < far:
            break
        t = ray_distance(s, volume.uniform_distance)
        u, v, w, radius = ray_point(origin, direction, t, volume.aabb, inverse, volume.uniform_distance)
        cell, length = occupied[cell_index(occupied, u, v, w)], volume.step
        if cell == 0:
            continue
        if cell == STRIDED:
            if (k + phase) % STRIDE != 0:
                continue
            length *= np.float32(STRIDE)
        place_sample(buffers, first + count, u, v, w, time)
        buffers.s[first + count] = s
        scale = density_scale(t, radius, volume.uniform_distance)
        buffers.taus[first + count] = length * scale / volume.extent
        count += 1
    return count, k


@bare
def march_ray(planes, density, basis, volume, rays, i, buffers):
    """March ray i until it leaves the volume or its transmittance falls below TERMINATION; fill the buffers.

    Samples are taken in blocks, each in several passes: one sample after the other, the processor would mostly wait
    for results.

    Args:
        planes, density, volume, rays: as of `render`.
        basis: (3, F) float32, the colour basis of the ray.

    Returns:
        The number of occupied samples, and the transmittance behind them.
    """
    set_decoder(buffers, density, basis)
    origin, direction, time, jitter = rays.origins[i], rays.directions[i], rays.times[i], rays.jitters[i]
    span = ray_span(origin, direction, volume.aabb, volume.uniform_distance)
    slots = volume.occupancy.shape[0]
    occupied = volume.occupancy[min(int(time * slots), slots - 1)]
    trans, count, k = np.float32(1.0), 0, 0
    while True:
        found, k = find_samples(volume, occupied, span, origin, direction, time, jitter, buffers, count, k)
        end = count + found
        for n in range(count, end):
            locate_sample(planes, buffers, n)
        for n in range(count, end):
            sample_planes(planes, buffers, n, buffers.features, n)
        for n in range(count, end):
            decode(buffers.decoder, buffers.features, n, buffers.features.shape[1], buffers.decoded)
            buffers.log_densities[n] = min(max(buffers.decoded[n, 0] + density[-1], -LIMIT), LIMIT)
        absorb(buffers.log_densities, buffers.taus, buffers.weights, count)
        while count < end:
            alpha = buffers.weights[count]
            buffers.weights[count] = trans * alpha
            trans *= np.float32(1.0) - alpha
            count += 1
            if trans < END_TRANSMITTANCE:
                return count, trans
        if found < BLOCK:
            return count, trans


@inlined
def negligible_weight(count):
    """Return the weight up to which samples of a ray with `count` of them get no colour."""
    return min(NEGLIGIBLE, HALF_LEVEL / np.float32(max(count, 1)))


@bare
def shade_ray(buffers, count, red, green, blue):
    """Add the samples of a ray after `march_ray` to a colour; keep their colours in the buffers.

    C = (red, green, blue) + sum_k w_k sigmoid(basis . features_k),   basis (3, F)
    """
    negligible = negligible_weight(count)
    for k in range(count):
        colour, weight = buffers.decoded[k], buffers.weights[k]
        if weight > negligible:
            sigmoids(buffers.decoded, k)
        else:
            colour[1] = colour[2] = colour[3] = np.float32(0.0)
        red += weight * colour[1]
        green += weight * colour[2]
        blue += weight * colour[3]
    return red, green, blue


@parallel
def render(planes, density, volume, rays, basis, capacity, workers):
    """Render rays.

    Args:
        planes: `PlaneSet`.
        density: (F + 1,) float32, the weights of the log density and its bias.
        volume: `Volume`.
        rays: `RayBatch`.
        basis: (N, 3, F) float32, the colour basis of each ray's direction.
        capacity: the most samples that a ray can have.
        workers: parts into which the rays are divided.

    Returns:
        Colours (N, 3), opacities (N,) and mean depths (N,), float32, and the samples that each ray took, (N,) int32.
    """
    N = rays.origins.shape[0]
    rgbs = np.empty((N, 3), np.float32)
    opacities = np.empty(N, np.float32)
    depths = np.empty(N, np.float32)
    counts = np.empty(N, np.int32)
    for worker in prange(workers):
        buffers = new_ray_buffers(planes, capacity)
        for i in range(worker, N, workers):
            count, trans = march_ray(planes, density, basis[i], volume, rays, i, buffers)
            depth = np.float32(0.0)
            rgb = shade_ray(buffers, count, np.float32(0.0), np.float32(0.0), np.float32(0.0))
            for c in range(3):
                rgbs[i, c] = rgb[c] + trans * rays.backgrounds[i, c]
            for k in range(count):
                depth += buffers.weights[k] * ray_distance(buffers.s[k], volume.uniform_distance)
            opacities[i] = np.float32(1.0) - trans
            depths[i] = depth / max(np.float32(1.0) - trans, np.float32(1e-6))
            counts[i] = count
    return rgbs, opacities, depths, counts


@parallel
def weigh_samples(planes, density, volume, rays, starts, cells, weights, capacity, workers):
    """List the weights that the samples of rays have in their colours, and the occupancy cells in which they lie.

    Args:
        planes, density, volume, rays, capacity, workers: as of `render`; backgrounds are not used.
        starts: (N,) int64, where in the lists the samples of each ray begin, which `collect_samples` counts at most.
        cells: (n, 3) int64 to be filled, in the order z, y, x.
        weights: (n,) float32 to be filled.

    Returns:
        (N,) int64, the samples of each ray until hardly any light passes.
    """
    N = rays.origins.shape[0]
    colourless = np.zeros((3, density.size - 1), np.float32)
    counts = np.empty(N, np.int64)
    for worker in prange(workers):
        buffers = new_ray_buffers(planes, capacity)
        for i in range(worker, N, workers):
            counts[i] = march_ray(planes, density, colourless, volume, rays, i, buffers)[0]
            _list_cells(volume.occupancy, buffers, counts[i], cells[starts[i] :], weights[starts[i] :])
    return counts


@inlined
def _list_cells(occupancy, buffers, count, cells, weights):
    """Write cells (n, 3) and weights (n,) of the samples of a ray after `march_ray`."""
    for k in range(count):
        points = buffers.points[k]
        cells[k, 0], cells[k, 1], cells[k, 2] = cell_index(occupancy[0], points[4], points[5], points[6])
        weights[k] = buffers.weights[k]


@inlined
def collect_ray(volume, origin, direction, time, jitter, start, out):
    """Write the occupied samples of one ray to `out` from `start` on, as far as it reaches; return their number."""
    near, far = ray_span(origin, direction, volume.aabb, volume.uniform_distance)
    slots = volume.occupancy.shape[0]
    occupied = volume.occupancy[min(int(time * slots), slots - 1)]
    inverse = inverse_edges(volume.aabb)
    count, k = 0, 0
    while k < MOST_STEPS:
        s = near + (np.float32(k) + jitter) * volume.step
        k += 1
        if not s < far:
            break
        t = ray_distance(s, volume.uniform_distance)
        u, v, w, radius = ray_point(origin, direction, t, volume.aabb, inverse, volume.uniform_distance)
        cell = cell_index(occupied, u, v, w)
        if occupied[cell] == 0:
            continue
        n = start + count
        if n < out.s.size:
            out.points[n, 0], out.points[n, 1], out.points[n, 2] = u, v, w
            out.s[n], out.density_scale[n] = s, density_scale(t, radius, volume.uniform_distance)
            out.cells[n, 0], out.cells[n, 1], out.cells[n, 2] = cell
        count += 1
    return count


@parallel
def collect_samples(volume, rays, starts, out, workers):
    """List the occupied samples of rays, without early termination.

    Args:
        volume: `Volume`; its extent is not used.
        rays: `RayBatch`; their backgrounds are not used.
        starts: (N,) int64, where in `out` the samples of each ray begin.
        out: `SampleArrays` to be filled.
        workers: parts into which the rays are divided.

    Returns:
        (N,) int64, the number of samples of each ray.
    """
    N = rays.origins.shape[0]
    counts = np.empty(N, np.int64)
    for worker in prange(workers):
        for i in range(worker, N, workers):
            # Writes to members of a tuple inside this loop itself would be removed as dead code.
            counts[i] = collect_ray(
                volume, rays.origins[i], rays.directions[i], rays.times[i], rays.jitters[i], starts[i], out
            )
    return counts
