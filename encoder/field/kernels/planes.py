"""Sampling of planes at a point, the product over planes, and the transposes of both."""

import numpy as np

from kpc.encoder.field.kernels.compilation import inlined
from kpc.encoder.field.kernels.texels import (
    POINT,
    add_slopes,
    displace,
    fetch_scale,
    locate_scale,
    sample_scale,
    scatter_scale,
)


@inlined
def is_part(planes, s):
    """Return whether scale s covers a part of the box only."""
    return planes.areas[s, 3] > np.float32(0.0)


@inlined
def is_moving(planes, s):
    """Return whether scale s has planes in space and time."""
    return planes.intervals[s, 3] > np.float32(0.0)


@inlined
def find_local(planes, buffers, k, s):
    """Set buffers.local to sample k in the area of scale s; return whether it lies there."""
    inside = True
    for axis in range(3):
        u = (buffers.points[k, axis] - planes.areas[s, axis]) * planes.areas[s, 4 + axis]
        buffers.local[0, axis] = u
        inside = inside and u >= np.float32(0.0) and u <= np.float32(1.0)
    buffers.local[0, 3] = buffers.points[k, 3]
    return inside


@inlined
def place_sample(buffers, k, u, v, w, time):
    """Make a point (u, v, w) at a time sample k of the buffers, not yet displaced."""
    point = buffers.points[k]
    point[0], point[1], point[2], point[3] = u, v, w, time
    point[4], point[5], point[6], point[7] = u, v, w, time


@inlined
def locate_sample(planes, buffers, k):
    """Displace sample k of the buffers, find the texels around it, and have the processor fetch them.

    Planes have two rows and columns at least. buffers.texels is -1 at a scale in whose area the sample does not lie.
    """
    if planes.motion.shape[0] > 0:
        displace(planes.motion, buffers.points, k)
    grid, scales = (planes.theta, planes.places, planes.intervals), planes.places.shape[0]
    around = buffers.texels, buffers.shares, buffers.values
    for s in range(scales):
        sample, point = k * scales + s, (buffers.points, POINT * k)
        if is_part(planes, s):
            if not find_local(planes, buffers, k, s):
                buffers.texels[sample, 0] = -1
                continue
            point = buffers.local, 0
        locate_scale(grid, s, point, planes.channels, around, sample)
    fetch_texels(planes, planes.theta, buffers, k)


@inlined
def fetch_texels(planes, numbers, buffers, k):
    """Have the processor fetch the texels around a sample that was located, or their gradients: `numbers` (n,)."""
    grid, scales = (numbers, planes.places, planes.intervals), planes.places.shape[0]
    around = buffers.texels, buffers.shares, buffers.values
    for s in range(scales):
        sample = k * scales + s
        if buffers.texels[sample, 0] < 0:
            continue
        if is_moving(planes, s):
            fetch_scale(grid, s, around, sample, planes.channels, 6)
        else:
            fetch_scale(grid, s, around, sample, planes.channels, 3)


@inlined
def sample_planes(planes, buffers, k, features, row):
    """Sample every plane at a sample that was located, and write the products over planes to a row of features (n, F).

    buffers.values[k, (6 s + c) M :][:M] is set to what plane c of scale s holds there.
    """
    grid, M, scales = (planes.theta, planes.places, planes.intervals), planes.channels, planes.places.shape[0]
    around = buffers.texels, buffers.shares, buffers.values
    for s in range(scales):
        sample, products = k * scales + s, (features, (row * scales + s) * M)
        if buffers.texels[sample, 0] < 0:
            for m in range(M):
                features[row, s * M + m] = np.float32(0.0)
        elif is_moving(planes, s):
            sample_scale(grid, s, around, sample, M, 6, products)
        else:
            sample_scale(grid, s, around, sample, M, 3, products)


@inlined
def scatter_planes(planes, g_theta, g_features, row, buffers, k, wants_point):
    """Add d loss / d theta of sample k, given a row of g_features (n, F), d loss / d features.

    If wanted, buffers.g_point is set to the gradient with respect to displaced u and time.
    """
    grid = planes.theta, planes.places, planes.intervals
    g_grid, M, scales = (g_theta, planes.places, planes.intervals), planes.channels, planes.places.shape[0]
    around = buffers.texels, buffers.shares, buffers.values
    points, g_point, g_local = buffers.points, buffers.g_point, buffers.g_local
    if wants_point:
        g_point[:] = np.float32(0.0)
    for s in range(scales):
        sample, g_products = k * scales + s, (g_features, (row * scales + s) * M)
        if buffers.texels[sample, 0] < 0:
            continue
        g_local[:] = np.float32(0.0)
        if is_moving(planes, s):
            scatter_scale(g_grid, s, around, sample, M, 6, g_products)
            if wants_point:
                add_slopes(grid, s, around, sample, M, 6, g_products, g_local)
        else:
            scatter_scale(g_grid, s, around, sample, M, 3, g_products)
            if wants_point:
                add_slopes(grid, s, around, sample, M, 3, g_products, g_local)
        if wants_point:
            for axis in range(3):
                g_point[axis] += planes.areas[s, 4 + axis] * g_local[axis]
            g_point[3] += g_local[3]
    if wants_point:
        for axis in range(4):
            if points[k, axis] < np.float32(0.0) or points[k, axis] > np.float32(1.0):  # clamped
                g_point[axis] = np.float32(0.0)
