"""One ray through the field, rendering of batches, and lists of the samples that rays take."""

import math

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
from kpc.encoder.field.kernels.planes import combine_planes, dot, sample_displaced
from kpc.format.container.scene_layout import SAMPLE_LIMIT
from kpc.format.scene.scene import LOG_DENSITY_LIMIT, TERMINATION

LIMIT = np.float32(LOG_DENSITY_LIMIT)
END_TRANSMITTANCE = np.float32(TERMINATION)

# No ray takes more steps, whatever its numbers are, so that every kernel ends and Ctrl-C is heard.
MOST_STEPS = SAMPLE_LIMIT + 2

# A sample of less weight than this gets no colour, nor one of so little that all samples of its ray could not make up
# half of an 8-bit level.
NEGLIGIBLE = np.float32(1e-4)
HALF_LEVEL = np.float32(0.5 / 255)


@plain
def new_ray_buffers(table, M, capacity):
    """Return `RayBuffers` for `capacity` samples."""
    S = table.shape[0]
    return RayBuffers(
        np.ones((capacity, S * 6 * M), np.float32),
        np.empty((capacity, S * M), np.float32),
        np.empty((capacity, 7), np.float32),
        np.empty((capacity, S * 6), np.int64),
        np.empty((capacity, S * 4), np.float32),
        np.empty(capacity, np.float32),
        np.empty(capacity, np.float32),
        np.empty(capacity, np.float32),
        np.empty(capacity, np.float32),
        np.empty((capacity, 3), np.float32),
        np.empty(capacity, np.float32),
        np.empty(S * M, np.float32),
        np.empty(6 * M, np.float32),
        np.empty(4 * M, np.float32),
        np.empty(4, np.float32),
        np.ones(M, np.float32),
    )


@inlined
def decode_density(features, density):
    """Return the clipped log density of features (F,); `density` (F + 1,) holds the weights and the bias."""
    F = density.size - 1
    return min(max(dot(features, density, F) + density[F], -LIMIT), LIMIT)


@inlined
def sigmoid(x):
    """Return 1 / (1 + exp(-x))."""
    return np.float32(1.0) / (np.float32(1.0) + math.exp(-x))


@bare
def march_ray(planes, density, volume, origin, direction, time, jitter, buffers):
    """March a ray until it leaves the volume or its transmittance falls below TERMINATION; fill the buffers.

    Returns:
        The number of occupied samples, and the transmittance behind them.
    """
    near, far = ray_span(origin, direction, volume.aabb, volume.uniform_distance)
    slots = volume.occupancy.shape[0]
    occupied = volume.occupancy[min(int(time * slots), slots - 1)]
    inverse = inverse_edges(volume.aabb)
    trans = np.float32(1.0)
    count = 0
    k = 0
    while count < buffers.weights.size and k < MOST_STEPS:
        s = near + (np.float32(k) + jitter) * volume.step
        k += 1
        if not s < far:
            break
        t = ray_distance(s, volume.uniform_distance)
        u, v, w, radius = ray_point(origin, direction, t, volume.aabb, inverse, volume.uniform_distance)
        if occupied[cell_index(occupied, u, v, w)] == 0:
            continue
        sample_displaced(planes, u, v, w, time, buffers, count)
        combine_planes(buffers.values[count], planes.table.shape[0], planes.channels, buffers.features[count])
        log_density = decode_density(buffers.features[count], density)
        scale = density_scale(t, radius, volume.uniform_distance)
        tau = math.exp(log_density) * (volume.step * scale) / volume.extent
        alpha = np.float32(1.0) - math.exp(-tau)
        buffers.s[count], buffers.log_densities[count], buffers.taus[count] = s, log_density, tau
        buffers.weights[count] = trans * alpha
        trans *= np.float32(1.0) - alpha
        count += 1
        if trans < END_TRANSMITTANCE:
            break
    return count, trans


@inlined
def negligible_weight(count):
    """Return the weight up to which samples of a ray with `count` of them get no colour."""
    return min(NEGLIGIBLE, HALF_LEVEL / np.float32(max(count, 1)))


@bare
def shade_ray(buffers, count, basis, red, green, blue):
    """Add the samples of a ray after `march_ray` to a colour; keep their colours in the buffers.

    C = (red, green, blue) + sum_k w_k sigmoid(basis . features_k),   basis (3, F)
    """
    F, negligible = buffers.g_features.size, negligible_weight(count)
    for k in range(count):
        colour, weight = buffers.colours[k], buffers.weights[k]
        if weight > negligible:
            for c in range(3):
                colour[c] = sigmoid(dot(buffers.features[k], basis[c], F))
        else:
            colour[0] = colour[1] = colour[2] = np.float32(0.0)
        red += weight * colour[0]
        green += weight * colour[1]
        blue += weight * colour[2]
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
        buffers = new_ray_buffers(planes.table, planes.channels, capacity)
        for i in range(worker, N, workers):
            count, trans = march_ray(
                planes, density, volume, rays.origins[i], rays.directions[i], rays.times[i], rays.jitters[i], buffers
            )
            depth = np.float32(0.0)
            rgb = shade_ray(buffers, count, basis[i], np.float32(0.0), np.float32(0.0), np.float32(0.0))
            for c in range(3):
                rgbs[i, c] = rgb[c] + trans * rays.backgrounds[i, c]
            for k in range(count):
                depth += buffers.weights[k] * ray_distance(buffers.s[k], volume.uniform_distance)
            opacities[i] = np.float32(1.0) - trans
            depths[i] = depth / max(np.float32(1.0) - trans, np.float32(1e-6))
            counts[i] = count
    return rgbs, opacities, depths, counts


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
