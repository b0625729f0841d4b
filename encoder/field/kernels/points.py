"""Features and densities at given points."""

import numpy as np
from numba import prange

from kpc.encoder.field.kernels.compilation import parallel
from kpc.encoder.field.kernels.marching import BLOCK, decode_density, new_ray_buffers
from kpc.encoder.field.kernels.planes import (
    locate_sample,
    place_sample,
    sample_planes,
    scatter_planes,
)
from kpc.encoder.field.kernels.texels import add_displacement_slopes, displace_transpose


@parallel
def log_densities(planes, density, points, times, workers):
    """Return the clipped log densities at u (N, 3) in [0, 1]^3 and times (N,): (N,) float32; density as in `render`."""
    N = points.shape[0]
    out = np.empty(N, np.float32)
    for worker in prange(workers):
        buffers = new_ray_buffers(planes, BLOCK)
        end = (worker + 1) * N // workers
        for first in range(worker * N // workers, end, BLOCK):
            count = min(BLOCK, end - first)
            for k in range(count):
                i = first + k
                place_sample(buffers, k, points[i, 0], points[i, 1], points[i, 2], times[i])
            for k in range(count):
                locate_sample(planes, buffers, k)
            for k in range(count):
                sample_planes(planes, buffers, k, buffers.features, k)
            for k in range(count):
                out[first + k] = decode_density(buffers.features, k, density)
    return out


@parallel
def features(planes, points, times, workers):
    """Return `kpc.encoder.field.field.Field.features` at u (N, 3) in [0, 1]^3 and times (N,): (N, F) float32."""
    N, F = points.shape[0], planes.places.shape[0] * planes.channels
    out = np.empty((N, F), np.float32)
    for worker in prange(workers):
        buffers = new_ray_buffers(planes, 1)
        for i in range(worker * N // workers, (worker + 1) * N // workers):
            place_sample(buffers, 0, points[i, 0], points[i, 1], points[i, 2], times[i])
            locate_sample(planes, buffers, 0)
            sample_planes(planes, buffers, 0, out, i)
    return out


@parallel
def scatter_features(planes, g_theta, g_motion, g_points, points, times, g):
    """Add the gradients of planes and motion grid, given g (N, F) = d loss / d `features`; set those of points.

    The planes are sampled once more rather than kept from the forward pass: all samples would not fit the cache.

    Args:
        g_theta: (workers, n) float32, a buffer for each worker.
        g_motion: (workers, T, Nz, Ny, Nx, 3) float32, the same of the motion grid.
        g_points: (N, 4) float32, of points and times; (0, 4) where they are not wanted.
    """
    N, workers, wants_motion, wants_points = points.shape[0], g_theta.shape[0], g_motion.size > 0, g_points.size > 0
    for worker in prange(workers):
        buffers = new_ray_buffers(planes, 1)
        for i in range(worker * N // workers, (worker + 1) * N // workers):
            place_sample(buffers, 0, points[i, 0], points[i, 1], points[i, 2], times[i])
            locate_sample(planes, buffers, 0)
            sample_planes(planes, buffers, 0, buffers.features, 0)
            scatter_planes(planes, g_theta[worker], g, i, buffers, 0, wants_motion or wants_points)
            if wants_motion:
                displace_transpose(g_motion[worker], buffers.points, 0, buffers.g_point)
            if wants_points:
                if planes.motion.shape[0] > 0:
                    add_displacement_slopes(planes.motion, buffers.points, 0, buffers.g_point)
                for axis in range(4):  # an array assigned to a row would have its message about shapes compiled
                    g_points[i, axis] = buffers.g_point[axis]
