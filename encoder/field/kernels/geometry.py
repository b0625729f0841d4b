"""Rays and occupancy cells.

`uniform_distance` is that of `kpc.format.scene.space.Contraction`, or 0 where the scene is its box.
"""

import numpy as np

from kpc.encoder.field.kernels.compilation import bare, inlined
from kpc.format.scene.space import FAR


@bare
def box_span(origin, direction, aabb):
    """Return the distances at which a ray enters (at least 0) and leaves the box; leaves <= enters where it misses.

    The distances are always finite, so that marching between them ends.
    """
    near, far = np.float32(0.0), np.float32(np.inf)
    for axis in range(3):
        d = direction[axis]
        if d == 0.0:
            if origin[axis] < aabb[0, axis] or origin[axis] > aabb[1, axis]:
                return np.float32(0.0), np.float32(0.0)
            continue
        t0 = (aabb[0, axis] - origin[axis]) / d
        t1 = (aabb[1, axis] - origin[axis]) / d
        near = max(near, min(t0, t1))
        far = min(far, max(t0, t1))
    if not far < np.inf:  # a direction of 0 or NaN
        return np.float32(0.0), np.float32(0.0)
    return near, far


@inlined
def ray_span(origin, direction, aabb, uniform_distance):
    """Return the s between which a ray takes samples."""
    if uniform_distance == 0:
        return box_span(origin, direction, aabb)
    return np.float32(0.0), np.float32(2.0 - 1.0 / FAR) * uniform_distance


@inlined
def ray_distance(s, uniform_distance):
    """Return the distance along the ray at s: `Contraction.distance`."""
    if uniform_distance == 0:
        return s
    return s if s <= uniform_distance else uniform_distance / (np.float32(2.0) - s / uniform_distance)


@inlined
def inverse_edges(aabb):
    """Return 1 over the box's edges, as three numbers."""
    one = np.float32(1.0)
    return one / (aabb[1, 0] - aabb[0, 0]), one / (aabb[1, 1] - aabb[0, 1]), one / (aabb[1, 2] - aabb[0, 2])


@inlined
def ray_point(origin, direction, t, aabb, inverse, uniform_distance):
    """Return u at distance t of a ray, and what `density_scale` takes; `inverse` as from `inverse_edges`."""
    u = (origin[0] + t * direction[0] - aabb[0, 0]) * inverse[0]
    v = (origin[1] + t * direction[1] - aabb[0, 1]) * inverse[1]
    w = (origin[2] + t * direction[2] - aabb[0, 2]) * inverse[2]
    one = np.float32(1.0)
    if uniform_distance == 0:
        return u, v, w, one
    x, y, z = np.float32(2.0) * u - one, np.float32(2.0) * v - one, np.float32(2.0) * w - one
    radius = max(max(abs(x), abs(y), abs(z)), one)
    scale = np.float32(0.25) * (np.float32(2.0) - one / radius) / radius
    half = np.float32(0.5)
    return x * scale + half, y * scale + half, z * scale + half, radius


@inlined
def density_scale(t, radius, uniform_distance):
    """Return `Contraction.density_scale` at distance t of a ray; `radius` as from `ray_point`."""
    if uniform_distance == 0:
        return np.float32(1.0)
    root = max(t / uniform_distance, np.float32(1.0)) / radius
    return root * root


@inlined
def cell_index(grid, u, v, w):
    """Return the index (z, y, x) of the cell of an (Nz, Ny, Nx) grid that holds a point of [0, 1]^3."""
    nz, ny, nx = grid.shape
    x = min(max(int(u * nx), 0), nx - 1)
    y = min(max(int(v * ny), 0), ny - 1)
    z = min(max(int(w * nz), 0), nz - 1)
    return z, y, x


@inlined
def add_ray_gradient(origin, direction, t, aabb, inverse, uniform_distance, g, g_log_scale, out):
    """Add the gradient of a ray by one of its points, at a distance t that is held fixed: the transpose of `ray_point`.

    Args:
        origin, direction, t, aabb, inverse, uniform_distance: as of `ray_point`.
        g: (4,), that of u and time.
        g_log_scale: that of the logarithm of `density_scale`.
        out: (7,) or more, of origin, direction and time, added to.
    """
    gx, gy, gz = g[0], g[1], g[2]
    one = np.float32(1.0)
    if uniform_distance != 0:
        two = np.float32(2.0)
        x = two * ((origin[0] + t * direction[0] - aabb[0, 0]) * inverse[0]) - one
        y = two * ((origin[1] + t * direction[1] - aabb[0, 1]) * inverse[1]) - one
        z = two * ((origin[2] + t * direction[2] - aabb[0, 2]) * inverse[2]) - one
        radius = max(max(abs(x), abs(y), abs(z)), one)
        scale = np.float32(0.25) * (two - one / radius) / radius
        by_radius = np.float32(0.0)
        if radius > one:  # d scale / d radius, and density_scale goes as radius^-2
            slope = np.float32(0.5) * (one / radius - one) / (radius * radius)
            by_radius = slope * (gx * x + gy * y + gz * z) - two * g_log_scale / radius
        gx, gy, gz = two * gx * scale, two * gy * scale, two * gz * scale
        if abs(x) == radius:
            gx += np.float32(2.0) * (by_radius if x > 0 else -by_radius)
        elif abs(y) == radius:
            gy += np.float32(2.0) * (by_radius if y > 0 else -by_radius)
        elif abs(z) == radius:
            gz += np.float32(2.0) * (by_radius if z > 0 else -by_radius)
    gx, gy, gz = gx * inverse[0], gy * inverse[1], gz * inverse[2]
    out[0] += gx
    out[1] += gy
    out[2] += gz
    out[3] += t * gx
    out[4] += t * gy
    out[5] += t * gz
    out[6] += g[3]
