"""Fused CPU kernels of the K-Planes field: march, look up, composite and back-propagate a ray in one go.

A batch of rays never becomes a batch of samples: each worker marches its rays one by one, keeps the few occupied samples of
the present ray in a scratch that fits the cache, and adds the gradient to a buffer of its own, so there is nothing to lock.
`kpc.encoder.field.field` holds the same mathematics in plain PyTorch; the tests hold the two together.

Naming, throughout this module
    M   channels of a plane
    S   scales;  F = S * M features
    theta      (n,) float32, all planes one after the other, each (rows, columns, M)
    table      (S, 6) int64, where in theta a plane starts, in the order xy xz yz xt yt zt; -1 where there is none
    resolution (S, 4) int64, texels along x, y, z and t
    density    (F + 1,) float32, the weights of the density and its bias
    basis      (rays, 3, F) float32, the colour basis of each ray's direction
    occupancy  (slots, Nz, Ny, Nx) uint8
    even       float32, of `kpc.format.scene.space.Contraction`; or None: the scene is its box, and code for that alone is compiled
    motion     (T, Nz, Ny, Nx, 3) float32, the displacements of `kpc.format.scene.motion`; or None: nothing is displaced
    s          where a sample lies on its ray: its distance, contracted as space is
"""

import math

import numpy as np
from kpc.format.scene.scene import LOG_DENSITY_LIMIT, TERMINATION
from kpc.format.scene.space import FAR, Contraction, SpaceMapping
from numba import njit, prange

_LIMIT = np.float32(LOG_DENSITY_LIMIT)
_TERMINATION = np.float32(TERMINATION)
_NEGLIGIBLE = np.float32(1e-4)
"""A sample of less weight gets no colour; 4096 of them could not make up an 8-bit level and a half."""

_TINY = np.float32(1e-30)
"""Adam's means below this are 0."""

_ALONG_COLUMNS, _ALONG_ROWS = (0, 0, 1, 0, 1, 2), (1, 2, 2, 3, 3, 3)
"""Axes of the planes xy xz yz xt yt zt, as numbers of x y z t."""

# Not "reassoc": the order of sums would differ between code compiled in this process and the same code from numba's cache,
# and the first training run on a machine would end elsewhere than the second.
_FASTMATH = {"nsz", "arcp", "contract", "afn"}
_bare = njit(fastmath=_FASTMATH, error_model="numpy", cache=True, nogil=True, _nrt=False)
"""For what makes and returns no array: without counting who holds one, which is atomic and takes a sixth of a step; numba has no public
name for that."""
_inlined = njit(fastmath=_FASTMATH, error_model="numpy", cache=True, nogil=True, _nrt=False, forceinline=True)
"""The same for what runs many times a sample: an array is some eight arguments, and passing them costs as much as the work."""
# The innermost loops run over the channels of one plane. Their number is no constant: LLVM would unroll a loop of eight before
# it could turn it into one of vectors. And they read and write few arrays: it gives up on telling apart more than a handful.
_parallel = njit(fastmath=_FASTMATH, error_model="numpy", cache=True, parallel=True)


def even_of(mapping: SpaceMapping | None) -> np.float32 | None:
    """`even`, as the kernels take it. Rays in device coordinates come as such: to the kernels those are a box."""
    return np.float32(mapping.uniform_distance) if isinstance(mapping, Contraction) else None


@_bare
def _box_span(origin, direction, aabb):
    """Distances at which a ray enters (at least 0) and leaves the box; leaves <= enters where it misses."""
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
    return near, far


@_inlined
def _span(origin, direction, aabb, even):
    """Where the samples of a ray begin and end, in s."""
    if even is None:
        return _box_span(origin, direction, aabb)
    return np.float32(0.0), np.float32(2.0 - 1.0 / FAR) * even


@_inlined
def _distance(s, even):
    """Distance along the ray, `Contraction.distance`."""
    if even is None:
        return s
    return s if s <= even else even / (np.float32(2.0) - s / even)


@_inlined
def _inverse_edges(aabb):
    """One over the edges of the box: three numbers, no array."""
    one = np.float32(1.0)
    return one / (aabb[1, 0] - aabb[0, 0]), one / (aabb[1, 1] - aabb[0, 1]), one / (aabb[1, 2] - aabb[0, 2])


@_inlined
def _place(origin, direction, t, aabb, inv, even):
    """Where in the planes' [0, 1]^3 a point of a ray lies, and what a step there counts, `Contraction.stretch`."""
    u = (origin[0] + t * direction[0] - aabb[0, 0]) * inv[0]
    v = (origin[1] + t * direction[1] - aabb[0, 1]) * inv[1]
    w = (origin[2] + t * direction[2] - aabb[0, 2]) * inv[2]
    one = np.float32(1.0)
    if even is None:
        return u, v, w, one
    x, y, z = np.float32(2.0) * u - one, np.float32(2.0) * v - one, np.float32(2.0) * w - one
    radius = max(max(abs(x), abs(y), abs(z)), one)
    scale = np.float32(0.25) * (np.float32(2.0) - one / radius) / radius
    stretch = max(t / even, one) / radius
    half = np.float32(0.5)
    return x * scale + half, y * scale + half, z * scale + half, stretch * stretch


@_inlined
def _tap(u, size):
    """Lower texel and fraction of a corner-aligned coordinate u in [0, 1]."""
    position = u * np.float32(size - 1)
    lower = min(max(int(position), 0), max(size - 2, 0))
    return lower, min(max(position - np.float32(lower), np.float32(0.0)), np.float32(1.0))


@_inlined
def _node(motion, u, v, w, time):
    """Of the motion grid about a place: lower nodes along t, z, y, x, and the fractions towards the next."""
    rows, nz, ny, nx, _ = motion.shape
    t, ft = _tap(time, rows)
    z, fz = _tap(w, nz)
    y, fy = _tap(v, ny)
    x, fx = _tap(u, nx)
    return t, z, y, x, ft, fz, fy, fx


@_inlined
def _corner(i, ft, fz, fy, fx):
    """The corner i of 0 to 15 of a cell of the motion grid: its steps along t, z, y, x, and its weight."""
    dt, dz, dy, dx = i >> 3, i >> 2 & 1, i >> 1 & 1, i & 1
    one = np.float32(1.0)
    weight = (ft if dt else one - ft) * (fz if dz else one - fz) * (fy if dy else one - fy) * (fx if dx else one - fx)
    return dt, dz, dy, dx, weight


@_inlined
def _moved(motion, u, v, w, time):
    """Where in the planes to look for what is at a place, `kpc.format.scene.motion.displace`; `_tap` keeps it within [0, 1]."""
    if motion is None:
        return u, v, w
    t, z, y, x, ft, fz, fy, fx = _node(motion, u, v, w, time)
    for i in range(16):
        dt, dz, dy, dx, weight = _corner(i, ft, fz, fy, fx)
        offset = motion[t + dt, z + dz, y + dy, x + dx]
        u += weight * offset[0]
        v += weight * offset[1]
        w += weight * offset[2]
    return u, v, w


@_inlined
def _spread_motion(grad_motion, place, time, g):
    """The transpose of `_moved`: g = d loss / d (u, v, w) of the moved place."""
    t, z, y, x, ft, fz, fy, fx = _node(grad_motion, place[0], place[1], place[2], time)
    for i in range(16):
        dt, dz, dy, dx, weight = _corner(i, ft, fz, fy, fx)
        out = grad_motion[t + dt, z + dz, y + dy, x + dx]
        out[0] += weight * g[0]
        out[1] += weight * g[1]
        out[2] += weight * g[2]


@_inlined
def _slope(low, high, fr, per_column, g, along):
    """Add g times what a sample between four texels, low and high holding two each, grows along columns, at fr between rows."""
    M = g.size
    er = per_column * (np.float32(1.0) - fr)
    fr = per_column * fr
    for m in range(M):
        along[m] += g[m] * (er * (low[M + m] - low[m]) + fr * (high[M + m] - high[m]))


@_inlined
def _slopes(low, high, fc, fr, per_column, per_row, g, along, across):
    """As `_slope`, and the same along rows, at fc between columns."""
    M = g.size
    er, ec = per_column * (np.float32(1.0) - fr), per_row * (np.float32(1.0) - fc)
    fr, fc = per_column * fr, per_row * fc
    for m in range(M):
        a, b, c, d = low[m], low[M + m], high[m], high[M + m]
        along[m] += g[m] * (er * (b - a) + fr * (d - c))
        across[m] += g[m] * (ec * (c - a) + fc * (d - b))


@_inlined
def _weights(fc, fr):
    """Of the four texels about a sample, at fractions fc along columns and fr along rows."""
    w11 = fc * fr
    return np.float32(1.0) - fc - fr + w11, fc - w11, fr - w11, w11


@_inlined
def _blend(low, high, w00, w01, w10, w11, out):
    """out = the weighted sum of four texels, low and high holding two each."""
    M = out.size
    for m in range(M):
        out[m] = w00 * low[m] + w01 * low[M + m] + w10 * high[m] + w11 * high[M + m]


@_inlined
def _spread(low, high, w00, w01, w10, w11, g):
    """The transpose of `_blend`."""
    M = g.size
    for m in range(M):
        low[m] += w00 * g[m]
        low[M + m] += w01 * g[m]
        high[m] += w10 * g[m]
        high[M + m] += w11 * g[m]


@_inlined
def _product(values, out):
    """out = the product of six planes' values, which lie one after the other."""
    M = out.size
    for m in range(M):
        in_space = values[m] * values[M + m] * values[2 * M + m]
        out[m] = in_space * values[3 * M + m] * values[4 * M + m] * values[5 * M + m]


@_inlined
def _product_gradient(values, g, out):
    """The transpose of `_product`: for each plane, g times the product of the five others."""
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


@_inlined
def _sample_planes(theta, table, resolution, point, M, corners, fractions, values):
    """Sample every plane at a point (u, v, w, time) in [0, 1]^4.

    values[(6 s + c) M :][:M] = bilinear sample of plane c at scale s, which has at least two rows and columns; planes that do
    not exist leave their part as it is. For `_scatter_planes` corners[6 s + c] = where in theta its lower left texel starts,
    and fractions[4 s + axis] = how far beyond it the point lies.
    """
    for s in range(table.shape[0]):
        x, fractions[4 * s] = _tap(point[0], resolution[s, 0])
        y, fractions[4 * s + 1] = _tap(point[1], resolution[s, 1])
        z, fractions[4 * s + 2] = _tap(point[2], resolution[s, 2])
        t, fractions[4 * s + 3] = _tap(point[3], resolution[s, 3])
        texel = (x, y, z, t)
        for c in range(_planes(table)):
            columns = resolution[s, _ALONG_COLUMNS[c]]
            corner = table[s, c] + (texel[_ALONG_ROWS[c]] * columns + texel[_ALONG_COLUMNS[c]]) * M
            corners[6 * s + c] = corner
            w00, w01, w10, w11 = _weights(fractions[4 * s + _ALONG_COLUMNS[c]], fractions[4 * s + _ALONG_ROWS[c]])
            low, high = theta[corner : corner + 2 * M], theta[corner + columns * M : corner + (columns + 2) * M]
            _blend(low, high, w00, w01, w10, w11, values[(6 * s + c) * M : (6 * s + c + 1) * M])


@_inlined
def _scatter_planes(grad, table, resolution, M, corners, fractions, values, g, scratch, theta, slopes, sloping):
    """Add d loss / d theta, given g = d loss / d features and what `_sample_planes` has left.

    slopes[M axis :][:M], if `sloping` and slopes is not None, gains d loss / d place by axis (x, y, z) and channel.
    """
    for s in range(table.shape[0]):
        _product_gradient(values[6 * s * M : 6 * (s + 1) * M], g[s * M : (s + 1) * M], scratch)
        for c in range(_planes(table)):
            across, down = _ALONG_COLUMNS[c], _ALONG_ROWS[c]
            columns, corner = resolution[s, across], corners[6 * s + c]
            fc, fr = fractions[4 * s + across], fractions[4 * s + down]
            w00, w01, w10, w11 = _weights(fc, fr)
            low, high = grad[corner : corner + 2 * M], grad[corner + columns * M : corner + (columns + 2) * M]
            _spread(low, high, w00, w01, w10, w11, scratch[c * M : (c + 1) * M])
            if slopes is not None:
                if sloping:
                    low, high = theta[corner : corner + 2 * M], theta[corner + columns * M : corner + (columns + 2) * M]
                    along, per_column = slopes[across * M : (across + 1) * M], np.float32(columns - 1)
                    if c < 3:
                        _slopes(
                            low,
                            high,
                            fc,
                            fr,
                            per_column,
                            np.float32(resolution[s, down] - 1),
                            scratch[c * M : (c + 1) * M],
                            along,
                            slopes[down * M : (down + 1) * M],
                        )
                    else:
                        _slope(low, high, fr, per_column, scratch[c * M : (c + 1) * M], along)


@_inlined
def _planes(table):
    """Planes of each scale: six, or three where nothing moves."""
    return 6 if table[0, 3] >= 0 else 3


@_inlined
def _features(values, scales, M, out):
    """out = the product over planes, scale by scale."""
    for s in range(scales):
        _product(values[6 * s * M : 6 * (s + 1) * M], out[s * M : (s + 1) * M])


@_inlined
def _dot(a, b, n):
    """Eight sums side by side: one alone would wait for each addition to end, since their order may not be changed."""
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


@_inlined
def _sigmoid(x):
    return np.float32(1.0) / (np.float32(1.0) + math.exp(-x))


@_inlined
def _cell(grid, u, v, w):
    """Index (z, y, x) of the cell of an (Nz, Ny, Nx) grid that holds a point in [0, 1]^3."""
    nz, ny, nx = grid.shape
    x = min(max(int(u * nx), 0), nx - 1)
    y = min(max(int(v * ny), 0), ny - 1)
    z = min(max(int(w * nz), 0), nz - 1)
    return z, y, x


@_bare
def _march(
    theta,
    table,
    resolution,
    density,
    M,
    motion,
    aabb,
    even,
    occupancy,
    origin,
    direction,
    time,
    jitter,
    step,
    extent,
    values,
    features,
    points,
    corners,
    fractions,
    weights,
    logs,
    places,
):
    """March one ray; fill the scratch for each occupied sample.

    Returns (samples, transmittance left). weights[k] = transmittance before sample k times alpha k; logs[k] = log density;
    places[k] = s; points[k] = u, v, w (moved) and time; unless `even` is None, what the step counts; u, v, w.
    """
    near, far = _span(origin, direction, aabb, even)
    slots = occupancy.shape[0]
    slot = min(int(time * slots), slots - 1)
    inv = _inverse_edges(aabb)
    F = density.size - 1
    trans = np.float32(1.0)
    count = 0
    k = 0
    while count < weights.size:
        s = near + (np.float32(k) + jitter) * step
        k += 1
        if not s < far:
            break
        u, v, w, stretch = _place(origin, direction, _distance(s, even), aabb, inv, even)
        if occupancy[slot][_cell(occupancy[slot], u, v, w)] == 0:
            continue
        point = points[count]
        point[0], point[1], point[2] = _moved(motion, u, v, w, time)
        point[3], point[5], point[6], point[7] = time, u, v, w
        if even is not None:
            point[4] = stretch
        _sample_planes(theta, table, resolution, point, M, corners[count], fractions[count], values[count])
        _features(values[count], table.shape[0], M, features[count])
        log_density = min(max(_dot(features[count], density, F) + density[F], -_LIMIT), _LIMIT)
        alpha = np.float32(1.0) - math.exp(-math.exp(log_density) * (step * stretch) / extent)
        logs[count] = log_density
        weights[count] = trans * alpha
        places[count] = s
        trans *= np.float32(1.0) - alpha
        count += 1
        if trans < _TERMINATION:
            break
    return count, trans


@njit(fastmath=_FASTMATH, error_model="numpy", cache=True, nogil=True)
def _scratch(table, M, capacity):
    S = table.shape[0]
    values = np.ones((capacity, S * 6 * M), np.float32)  # ones: the planes a static scene does not have
    features = np.empty((capacity, S * M), np.float32)
    points = np.empty((capacity, 8), np.float32)
    corners = np.empty((capacity, S * 6), np.int64)
    fractions = np.empty((capacity, S * 4), np.float32)
    weights = np.empty(capacity, np.float32)
    logs = np.empty(capacity, np.float32)
    places = np.empty(capacity, np.float32)
    return values, features, points, corners, fractions, weights, logs, places


@_parallel
def render(
    theta,
    table,
    resolution,
    density,
    M,
    motion,
    aabb,
    even,
    occupancy,
    step,
    extent,
    origins,
    directions,
    times,
    basis,
    basis_index,
    background,
    capacity,
    workers,
):
    """Colour, opacity and depth of rays: (N, 3), (N,), (N,) float32, and the samples each of them took.

    `basis[basis_index[i]]` is the colour basis of ray i. Samples lie at (k + 1/2) * step from where the ray enters the box; in
    contracted space in s, from its origin.
    """
    N = origins.shape[0]
    rgbs = np.empty((N, 3), np.float32)
    opacities = np.empty(N, np.float32)
    depths = np.empty(N, np.float32)
    counts = np.empty(N, np.int32)
    F = density.size - 1
    for worker in prange(workers):
        values, features, points, corners, fractions, weights, logs, places = _scratch(table, M, capacity)
        for ray in range(worker, N, workers):
            count, trans = _march(
                theta,
                table,
                resolution,
                density,
                M,
                motion,
                aabb,
                even,
                occupancy,
                origins[ray],
                directions[ray],
                times[ray],
                np.float32(0.5),
                step,
                extent,
                values,
                features,
                points,
                corners,
                fractions,
                weights,
                logs,
                places,
            )
            b = basis[basis_index[ray]]
            red, green, blue, depth = np.float32(0), np.float32(0), np.float32(0), np.float32(0)
            for k in range(count):
                depth += weights[k] * _distance(places[k], even)
                if weights[k] > _NEGLIGIBLE:
                    red += weights[k] * _sigmoid(_dot(features[k], b[0], F))
                    green += weights[k] * _sigmoid(_dot(features[k], b[1], F))
                    blue += weights[k] * _sigmoid(_dot(features[k], b[2], F))
            rgbs[ray, 0] = red + trans * background[0]
            rgbs[ray, 1] = green + trans * background[1]
            rgbs[ray, 2] = blue + trans * background[2]
            opacities[ray] = np.float32(1.0) - trans
            depths[ray] = depth / max(np.float32(1.0) - trans, np.float32(1e-6))
            counts[ray] = count
    return rgbs, opacities, depths, counts


@_bare
def _distortion_gradient(weights, places, count, step, extent, factor, out):
    """out[k] = factor * d D / d w_k of `backpropagate`, in one pass each way over the sums of w and w s before sample k."""
    total, total_s = np.float32(0.0), np.float32(0.0)
    for k in range(count):
        total += weights[k]
        total_s += weights[k] * (places[k] - places[0]) / extent
    before, before_s = np.float32(0.0), np.float32(0.0)
    for k in range(count):
        s = (places[k] - places[0]) / extent
        apart = s * (np.float32(2.0) * before - total) + total_s - np.float32(2.0) * before_s
        out[k] = factor * (np.float32(2.0) * apart + np.float32(2.0 / 3.0) * weights[k] * step / extent)
        before += weights[k]
        before_s += weights[k] * s


@_parallel
def backpropagate(
    theta,
    grad,
    table,
    resolution,
    density,
    grad_density,
    M,
    motion,
    grad_motion,
    moving,
    aabb,
    even,
    occupancy,
    step,
    extent,
    origins,
    directions,
    times,
    jitters,
    basis,
    grad_basis,
    targets,
    backgrounds,
    peaks,
    distortion,
    capacity,
):
    """Render a batch, and add the gradient of its loss to grad, grad_density, grad_motion and grad_basis.

    loss = mean over rays and colour channels of (C - target)^2 + distortion * mean over rays of D
    C = sum_k w_k c_k + trans * background
    D = sum_ij w_i w_j |s_i - s_j| + 1/3 sum_i w_i^2 d,   s over the extent, d = step / extent (arXiv:2111.12077, eq. 15)
    d D / d w_k = 2 sum_j w_j |s_k - s_j| + 2/3 w_k d
    d C / d tau_k = trans_{k+1} c_k - sum_{j>k} w_j c_j - trans_end * background,   tau = sigma * stretch * step / extent

    Args:
        grad: (workers, n) float32, one buffer a worker; grad_density: (workers, F + 1); grad_motion: (workers, as motion).
        basis, grad_basis: (rays, 3, F); or, where colour is the same from everywhere, (1, 3, F) and (workers, 3, F).
        moving: whether grad_motion is wanted in this step; it takes a fifth of the time.
        jitters: (rays,) float32 in [0, 1), where in each step the samples of a ray lie.
        targets, backgrounds: (rays, 3) float32.
        peaks: (workers, Nz, Ny, Nx) float32, raised to the largest weight that a sample in a cell has had.

    Returns:
        squared errors (rays,) float32, summed over colour, and samples taken (rays,) int32.
    """
    N = origins.shape[0]
    workers = grad.shape[0]
    F = density.size - 1
    errors = np.empty(N, np.float32)
    counts = np.empty(N, np.int32)
    scale = np.float32(2.0 / (3.0 * N))
    shared = basis.shape[0] == 1
    for worker in prange(workers):
        values, features, points, corners, fractions, weights, logs, places = _scratch(table, M, capacity)
        colours = np.empty((capacity, 3), np.float32)
        spread = np.empty(capacity, np.float32)
        g_features = np.empty(F, np.float32)
        plane_scratch = np.empty(6 * M, np.float32)
        slopes = None if motion is None else np.empty(3 * M, np.float32)
        ones, g_place = np.ones(M, np.float32), np.empty(3, np.float32)
        g_theta = grad[worker]
        g_density = grad_density[worker]
        for ray in range(worker, N, workers):
            count, trans = _march(
                theta,
                table,
                resolution,
                density,
                M,
                motion,
                aabb,
                even,
                occupancy,
                origins[ray],
                directions[ray],
                times[ray],
                jitters[ray],
                step,
                extent,
                values,
                features,
                points,
                corners,
                fractions,
                weights,
                logs,
                places,
            )
            b = basis[0] if shared else basis[ray]
            g_b = grad_basis[worker] if shared else grad_basis[ray]
            rgb0 = trans * backgrounds[ray, 0]
            rgb1 = trans * backgrounds[ray, 1]
            rgb2 = trans * backgrounds[ray, 2]
            for k in range(count):
                if weights[k] > _NEGLIGIBLE:
                    for c in range(3):
                        colours[k, c] = _sigmoid(_dot(features[k], b[c], F))
                else:
                    colours[k] = np.float32(0.0)
                rgb0 += weights[k] * colours[k, 0]
                rgb1 += weights[k] * colours[k, 1]
                rgb2 += weights[k] * colours[k, 2]
            e0, e1, e2 = rgb0 - targets[ray, 0], rgb1 - targets[ray, 1], rgb2 - targets[ray, 2]
            errors[ray] = e0 * e0 + e1 * e1 + e2 * e2
            counts[ray] = count
            g0, g1, g2 = scale * e0, scale * e1, scale * e2

            _distortion_gradient(weights, places, count, step, extent, np.float32(distortion / N), spread)
            after = trans * (g0 * backgrounds[ray, 0] + g1 * backgrounds[ray, 1] + g2 * backgrounds[ray, 2])
            beyond = trans  # transmittance after sample k, walking backwards
            for k in range(count - 1, -1, -1):
                weight = weights[k]
                seen = g0 * colours[k, 0] + g1 * colours[k, 1] + g2 * colours[k, 2] + spread[k]  # d loss / d w_k
                tau = math.exp(logs[k]) * (step if even is None else step * points[k, 4]) / extent
                g_log = (beyond * seen - after) * tau
                if logs[k] >= _LIMIT or logs[k] <= -_LIMIT:
                    g_log = np.float32(0.0)
                cell = _cell(peaks[worker], points[k, 5], points[k, 6], points[k, 7])
                peaks[worker][cell] = max(peaks[worker][cell], weight)
                after += weight * seen
                beyond += weight
                feature = features[k]
                for i in range(F):
                    g_features[i] = g_log * density[i]
                    g_density[i] += g_log * feature[i]
                g_density[F] += g_log
                if weight > _NEGLIGIBLE:
                    for c in range(3):
                        colour = colours[k, c]
                        g_c = g0 if c == 0 else (g1 if c == 1 else g2)
                        g_c *= weight * colour * (np.float32(1.0) - colour)
                        for i in range(F):
                            g_features[i] += g_c * b[c, i]
                            g_b[c, i] += g_c * feature[i]
                if motion is not None:
                    slopes[:] = np.float32(0.0)
                _scatter_planes(
                    g_theta,
                    table,
                    resolution,
                    M,
                    corners[k],
                    fractions[k],
                    values[k],
                    g_features,
                    plane_scratch,
                    theta,
                    slopes,
                    moving,
                )
                if motion is not None and moving:
                    for axis in range(3):
                        clamped = points[k, axis] < np.float32(0.0) or points[k, axis] > np.float32(1.0)
                        g_place[axis] = np.float32(0.0) if clamped else _dot(slopes[axis * M : (axis + 1) * M], ones, M)
                    _spread_motion(grad_motion[worker], points[k, 5:], times[ray], g_place)
    return errors, counts


@_parallel
def log_densities(theta, table, resolution, density, M, motion, points, times, workers):
    """Log density at (N, 3) points in [0, 1]^3 and (N,) times: (N,) float32."""
    N = points.shape[0]
    out = np.empty(N, np.float32)
    F = density.size - 1
    for worker in prange(workers):
        values, features, at, corners, fractions, _, _, _ = _scratch(table, M, 1)
        point = at[0]
        for i in range(worker, N, workers):
            point[0], point[1], point[2] = _moved(motion, points[i, 0], points[i, 1], points[i, 2], times[i])
            point[3] = times[i]
            _sample_planes(theta, table, resolution, point, M, corners[0], fractions[0], values[0])
            _features(values[0], table.shape[0], M, features[0])
            out[i] = min(max(_dot(features[0], density, F) + density[F], -_LIMIT), _LIMIT)
    return out


@_parallel
def features(theta, table, resolution, M, motion, points, times, workers):
    """Features at (N, 3) points in [0, 1]^3 and (N,) times, `kpc.encoder.field.field.Field.features`: (N, F) float32."""
    N, S = points.shape[0], table.shape[0]
    out = np.empty((N, S * M), np.float32)
    for worker in prange(workers):
        values, _, at, corners, fractions, _, _, _ = _scratch(table, M, 1)
        point = at[0]
        for i in range(worker * N // workers, (worker + 1) * N // workers):
            point[0], point[1], point[2] = _moved(motion, points[i, 0], points[i, 1], points[i, 2], times[i])
            point[3] = times[i]
            _sample_planes(theta, table, resolution, point, M, corners[0], fractions[0], values[0])
            _features(values[0], S, M, out[i])
    return out


@_parallel
def scatter(theta, grad, table, resolution, M, motion, grad_motion, points, times, g):
    """The transpose of the derivative of `features`: add to grad (workers, n), and to grad_motion (workers, as motion) unless
    that is None, what g (N, F) = d loss / d features makes of them. The features are looked up once more, not kept: they lie
    in the cache by then, and all of them would not."""
    N, workers = points.shape[0], grad.shape[0]
    for worker in prange(workers):
        values, _, at, corners, fractions, _, _, _ = _scratch(table, M, 1)
        point = at[0]
        plane_scratch = np.empty(6 * M, np.float32)
        slopes = None if motion is None else np.empty(3 * M, np.float32)
        ones, g_place = np.ones(M, np.float32), np.empty(3, np.float32)
        for i in range(worker * N // workers, (worker + 1) * N // workers):
            point[0], point[1], point[2] = _moved(motion, points[i, 0], points[i, 1], points[i, 2], times[i])
            point[3] = times[i]
            _sample_planes(theta, table, resolution, point, M, corners[0], fractions[0], values[0])
            if motion is not None:
                slopes[:] = np.float32(0.0)
            _scatter_planes(
                grad[worker],
                table,
                resolution,
                M,
                corners[0],
                fractions[0],
                values[0],
                g[i],
                plane_scratch,
                theta,
                slopes,
                True,
            )
            if motion is not None:
                for axis in range(3):
                    clamped = point[axis] < np.float32(0.0) or point[axis] > np.float32(1.0)
                    g_place[axis] = np.float32(0.0) if clamped else _dot(slopes[axis * M : (axis + 1) * M], ones, M)
                _spread_motion(grad_motion[worker], points[i], times[i], g_place)


@_parallel
def collect(
    aabb, even, occupancy, step, origins, directions, times, jitters, starts, points, places, stretches, cells, workers
):
    """The occupied samples of rays, none of them ended early: (N,) int64, how many each ray has.

    Unless `points` is None, those of ray i are written from starts[i] on: points (n, 3) in [0, 1]^3, places (n,) their s,
    stretches (n,) what the step counts, cells (n, 3) int64 z, y, x.
    """
    N, slots = origins.shape[0], occupancy.shape[0]
    inv = _inverse_edges(aabb)
    counts = np.empty(N, np.int64)
    for worker in prange(workers):
        for ray in range(worker, N, workers):
            near, far = _span(origins[ray], directions[ray], aabb, even)
            occupied = occupancy[min(int(times[ray] * slots), slots - 1)]
            count, k = 0, 0
            while True:
                s = near + (np.float32(k) + jitters[ray]) * step
                k += 1
                if not s < far:
                    break
                u, v, w, stretch = _place(origins[ray], directions[ray], _distance(s, even), aabb, inv, even)
                cell = _cell(occupied, u, v, w)
                if occupied[cell] == 0:
                    continue
                if points is not None:
                    at = starts[ray] + count
                    points[at, 0], points[at, 1], points[at, 2] = u, v, w
                    places[at], stretches[at] = s, stretch
                    cells[at, 0], cells[at, 1], cells[at, 2] = cell
                count += 1
            counts[ray] = count
    return counts


@_parallel
def adam(theta, grad, mean, square, lr, beta1, beta2, epsilon, step_number):
    """One step of Adam (arXiv:1412.6980, algorithm 1) on theta with the sum over workers of grad, which is cleared."""
    n = theta.size
    workers = grad.shape[0]
    correction1 = np.float32(1.0 - beta1**step_number)
    correction2 = np.float32(1.0 - beta2**step_number)
    b1, b2, rate, eps = np.float32(beta1), np.float32(beta2), np.float32(lr), np.float32(epsilon)
    blocks = (n + 16383) // 16384
    for block in prange(blocks):
        lo, hi = block * 16384, min((block + 1) * 16384, n)
        p, m, v = theta[lo:hi], mean[lo:hi], square[lo:hi]
        total = grad[0, lo:hi]
        for worker in range(1, workers):
            other = grad[worker, lo:hi]
            for i in range(hi - lo):
                total[i] += other[i]
                other[i] = np.float32(0.0)
        for i in range(hi - lo):
            g = total[i]
            total[i] = np.float32(0.0)
            m_i = b1 * m[i] + (np.float32(1.0) - b1) * g
            v_i = b2 * v[i] + (np.float32(1.0) - b2) * g * g
            # Texels that no ray visits decay into denormal numbers, which are some hundred times slower to compute with.
            m[i] = m_i if abs(m_i) > _TINY else np.float32(0.0)
            v[i] = v_i if v_i > _TINY else np.float32(0.0)
            p[i] -= rate * (m[i] / correction1) / (math.sqrt(v[i] / correction2) + eps)


@_inlined
def _pull(difference, steep):
    """Half the slope of log(1 + steep d^2) / steep."""
    return difference / (np.float32(1.0) + steep * difference * difference)


@_parallel
def add_variation(theta, grad, start, rows, columns, M, along_rows, across_rows, steep):
    """Add the gradient of the mean over (i, j, m) of log(1 + steep d^2) / steep, d differences between neighbours; of d^2 where `steep` is 0.

    Those in the same row count `along_rows`, those in the same column `across_rows`: a space-time plane is smoothed along
    space alone, its rows.
    """
    width, steep = columns * M, np.float32(steep)
    along, across = np.float32(2.0 * along_rows / (rows * width)), np.float32(2.0 * across_rows / (rows * width))
    for row in prange(rows):
        a = start + row * width
        here = theta[a : a + width]
        out = grad[a : a + width]
        for i in range(M, width):
            out[i] += along * _pull(here[i] - here[i - M], steep)
        for i in range(width - M):
            out[i] += along * _pull(here[i] - here[i + M], steep)
        if across == 0:
            continue
        if row > 0:
            above = theta[a - width : a]
            for i in range(width):
                out[i] += across * _pull(here[i] - above[i], steep)
        if row < rows - 1:
            below = theta[a + width : a + 2 * width]
            for i in range(width):
                out[i] += across * _pull(here[i] - below[i], steep)


@_parallel
def add_time_smoothness(theta, grad, start, rows, columns, M, weight):
    """Add the gradient of weight * mean of (P[t-1] - 2 P[t] + P[t+1])^2 (K-Planes, section 3.2)."""
    width = columns * M
    k = np.float32(2.0 * weight / (rows * columns * M))
    for row in prange(rows):
        out = grad[start + row * width : start + (row + 1) * width]
        for centre in range(max(row - 1, 1), min(row + 2, rows - 1)):
            c = start + centre * width
            before, here, after = theta[c - width : c], theta[c : c + width], theta[c + width : c + 2 * width]
            factor = k * np.float32(-2.0) if centre == row else k
            for i in range(width):
                out[i] += factor * (before[i] - np.float32(2.0) * here[i] + after[i])


@_parallel
def add_sparse_transients(theta, grad, start, size, weight):
    """Add the gradient of weight * mean |1 - P| (K-Planes, section 3.2); it is 0 at the kink, P = 1."""
    k = np.float32(weight / size)
    for block in prange((size + 16383) // 16384):
        lo, hi = start + block * 16384, start + min((block + 1) * 16384, size)
        here, out = theta[lo:hi], grad[lo:hi]
        for i in range(hi - lo):
            if here[i] > np.float32(1.0):
                out[i] += k
            elif here[i] < np.float32(1.0):
                out[i] -= k
