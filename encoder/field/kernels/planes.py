"""Sampling of planes at a point, the product over planes, and the transposes of both."""

import numpy as np

from kpc.encoder.field.kernels.compilation import inlined
from kpc.encoder.field.kernels.geometry import (
    add_displacement_slopes,
    displace,
    scatter_displacement,
    texel_and_fraction,
)

# The axes of the planes xy xz yz xt yt zt along their columns and rows, as positions in "xyzt".
COLUMN_AXIS, ROW_AXIS = (0, 0, 1, 0, 1, 2), (1, 2, 2, 3, 3, 3)


@inlined
def planes_per_scale(table):
    """Return 6, or 3 in a static scene."""
    return 6 if table[0, 3] >= 0 else 3


@inlined
def bilinear_weights(fc, fr):
    """Return the weights of the four texels around a point at fractions fc along columns and fr along rows."""
    w11 = fc * fr
    return np.float32(1.0) - fc - fr + w11, fc - w11, fr - w11, w11


@inlined
def blend_texels(low, high, w00, w01, w10, w11, out):
    """Write the weighted sum of four texels; `low` and `high` (2 M,) hold two neighbours of a row each."""
    M = out.size
    for m in range(M):
        out[m] = w00 * low[m] + w01 * low[M + m] + w10 * high[m] + w11 * high[M + m]


@inlined
def scatter_texels(low, high, w00, w01, w10, w11, g):
    """Add the transpose of `blend_texels`."""
    M = g.size
    for m in range(M):
        low[m] += w00 * g[m]
        low[M + m] += w01 * g[m]
        high[m] += w10 * g[m]
        high[M + m] += w11 * g[m]


@inlined
def multiply_planes(values, out):
    """Write the product of six planes' values (6 M,) to `out` (M,)."""
    M = out.size
    for m in range(M):
        in_space = values[m] * values[M + m] * values[2 * M + m]
        out[m] = in_space * values[3 * M + m] * values[4 * M + m] * values[5 * M + m]


@inlined
def multiply_planes_transpose(values, g, out):
    """Write to `out` (6 M,), for each plane, g (M,) times the product of the five others."""
    M = g.size
    for m in range(M):
        xy, xz, yz = values[m], values[M + m], values[2 * M + m]
        xt, yt, zt = values[3 * M + m], values[4 * M + m], values[5 * M + m]
        in_space = xy * xz
        g_time = g[m] * (xt * yt * zt)
        g_space = g[m] * in_space * yz
        out[m] = g_time * xz * yz
        out[M + m] = g_time * xy * yz
        out[2 * M + m] = g_time * in_space
        out[3 * M + m] = g_space * yt * zt
        out[4 * M + m] = g_space * xt * zt
        out[5 * M + m] = g_space * xt * yt


@inlined
def sample_planes(planes, point, corners, fractions, values):
    """Sample every plane at a point (u, v, w, time) in [0, 1]^4; planes have at least two rows and columns.

    values[(6 s + c) M :][:M] is set to the bilinear sample of plane c at scale s; planes that do not exist keep what
    they have. For `scatter_planes`, corners[6 s + c] is where in theta the texel below begins, and
    fractions[4 s + axis] how far beyond it the point lies.
    """
    theta, table, resolution, M = planes.theta, planes.table, planes.resolution, planes.channels
    for s in range(table.shape[0]):
        x, fractions[4 * s] = texel_and_fraction(point[0], resolution[s, 0])
        y, fractions[4 * s + 1] = texel_and_fraction(point[1], resolution[s, 1])
        z, fractions[4 * s + 2] = texel_and_fraction(point[2], resolution[s, 2])
        t, fractions[4 * s + 3] = texel_and_fraction(point[3], resolution[s, 3])
        texel = (x, y, z, t)
        for c in range(planes_per_scale(table)):
            columns = resolution[s, COLUMN_AXIS[c]]
            corner = table[s, c] + (texel[ROW_AXIS[c]] * columns + texel[COLUMN_AXIS[c]]) * M
            corners[6 * s + c] = corner
            w00, w01, w10, w11 = bilinear_weights(fractions[4 * s + COLUMN_AXIS[c]], fractions[4 * s + ROW_AXIS[c]])
            low, high = theta[corner : corner + 2 * M], theta[corner + columns * M : corner + (columns + 2) * M]
            blend_texels(low, high, w00, w01, w10, w11, values[(6 * s + c) * M : (6 * s + c + 1) * M])


@inlined
def sample_displaced(planes, u, v, w, time, buffers, k):
    """Displace u, sample every plane there, and keep it all as sample k of `buffers`."""
    point = buffers.points[k]
    point[0], point[1], point[2] = displace(planes.motion, u, v, w, time)
    point[3], point[4], point[5], point[6] = time, u, v, w
    sample_planes(planes, point, buffers.corners[k], buffers.fractions[k], buffers.values[k])


@inlined
def combine_planes(values, scales, M, out):
    """Write the features: the product over planes, scale by scale."""
    for s in range(scales):
        multiply_planes(values[6 * s * M : 6 * (s + 1) * M], out[s * M : (s + 1) * M])


@inlined
def add_slope(low, high, fr, per_column, g, along):
    """Add g times the derivative of `blend_texels` with respect to the coordinate along columns, by channel."""
    M = g.size
    er = per_column * (np.float32(1.0) - fr)
    fr = per_column * fr
    for m in range(M):
        along[m] += g[m] * (er * (low[M + m] - low[m]) + fr * (high[M + m] - high[m]))


@inlined
def add_slopes(low, high, fc, fr, per_column, per_row, g, along, across):
    """Do as `add_slope`, and the same for the coordinate along rows."""
    M = g.size
    er, ec = per_column * (np.float32(1.0) - fr), per_row * (np.float32(1.0) - fc)
    fr, fc = per_column * fr, per_row * fc
    for m in range(M):
        a, b, c, d = low[m], low[M + m], high[m], high[M + m]
        along[m] += g[m] * (er * (b - a) + fr * (d - c))
        across[m] += g[m] * (ec * (c - a) + fc * (d - b))


@inlined
def add_plane_slopes(planes, s, c, corner, fc, fr, g, slopes, wants_time):
    """Add the gradient with respect to u, and to time if wanted, by way of plane c of scale s."""
    theta, M = planes.theta, planes.channels
    columns, rows = planes.resolution[s, COLUMN_AXIS[c]], planes.resolution[s, ROW_AXIS[c]]
    low, high = theta[corner : corner + 2 * M], theta[corner + columns * M : corner + (columns + 2) * M]
    along = slopes[COLUMN_AXIS[c] * M : (COLUMN_AXIS[c] + 1) * M]
    per_column = np.float32(columns - 1)
    if c < 3 or wants_time:
        across = slopes[ROW_AXIS[c] * M : (ROW_AXIS[c] + 1) * M]
        add_slopes(low, high, fc, fr, per_column, np.float32(rows - 1), g, along, across)
    else:
        add_slope(low, high, fr, per_column, g, along)


@inlined
def scatter_planes(planes, g_theta, g_features, buffers, k, wants_slopes, wants_time):
    """Add d loss / d theta of sample k, given g_features (F,) = d loss / d features.

    buffers.slopes[axis M :][:M], if wanted, is set to d loss / d u along that axis by channel; axis 3 is time.
    """
    if wants_slopes:
        buffers.slopes[:] = np.float32(0.0)
    table, resolution, M = planes.table, planes.resolution, planes.channels
    corners, fractions, values, g_values = buffers.corners[k], buffers.fractions[k], buffers.values[k], buffers.g_values
    for s in range(table.shape[0]):
        multiply_planes_transpose(values[6 * s * M : 6 * (s + 1) * M], g_features[s * M : (s + 1) * M], g_values)
        for c in range(planes_per_scale(table)):
            columns, corner = resolution[s, COLUMN_AXIS[c]], corners[6 * s + c]
            fc, fr = fractions[4 * s + COLUMN_AXIS[c]], fractions[4 * s + ROW_AXIS[c]]
            w00, w01, w10, w11 = bilinear_weights(fc, fr)
            low, high = g_theta[corner : corner + 2 * M], g_theta[corner + columns * M : corner + (columns + 2) * M]
            g = g_values[c * M : (c + 1) * M]
            scatter_texels(low, high, w00, w01, w10, w11, g)
            if wants_slopes:
                add_plane_slopes(planes, s, c, corner, fc, fr, g, buffers.slopes, wants_time)


@inlined
def point_gradient(buffers, k):
    """Set buffers.g_point to the gradient with respect to displaced u and time of sample k, given its slopes."""
    point, ones, g_point = buffers.points[k], buffers.ones, buffers.g_point
    M = ones.size
    for axis in range(4):
        clamped = point[axis] < np.float32(0.0) or point[axis] > np.float32(1.0)
        slope = dot(buffers.slopes[axis * M : (axis + 1) * M], ones, M)
        g_point[axis] = np.float32(0.0) if clamped else slope


@inlined
def scatter_motion(g_motion, buffers, k):
    """Add the gradient of the motion grid by sample k, given `point_gradient`."""
    point = buffers.points[k]
    scatter_displacement(g_motion, point[4], point[5], point[6], point[3], buffers.g_point)


@inlined
def undisplace_gradient(motion, buffers, k):
    """Turn the gradient with respect to displaced u and time of sample k into that with respect to u and time."""
    point = buffers.points[k]
    add_displacement_slopes(motion, point[4], point[5], point[6], point[3], buffers.g_point)


@inlined
def dot(a, b, n):
    """Return the sum of a[i] b[i] over i < n.

    It is eight sums side by side: one alone would wait for each addition to end, as their order may not be changed.
    """
    s0, s1, s2, s3 = np.float32(0.0), np.float32(0.0), np.float32(0.0), np.float32(0.0)
    s4, s5, s6, s7 = np.float32(0.0), np.float32(0.0), np.float32(0.0), np.float32(0.0)
    whole = n - n % 8
    for i in range(0, whole, 8):
        s0 += a[i] * b[i]
        s1 += a[i + 1] * b[i + 1]
        s2 += a[i + 2] * b[i + 2]
        s3 += a[i + 3] * b[i + 3]
        s4 += a[i + 4] * b[i + 4]
        s5 += a[i + 5] * b[i + 5]
        s6 += a[i + 6] * b[i + 6]
        s7 += a[i + 7] * b[i + 7]
    for i in range(whole, n):
        s0 += a[i] * b[i]
    return ((s0 + s1) + (s2 + s3)) + ((s4 + s5) + (s6 + s7))
