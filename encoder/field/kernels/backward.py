"""The gradient of a batch's loss."""

import numpy as np
from numba import prange

from kpc.encoder.field.kernels.arguments import Gradients
from kpc.encoder.field.kernels.compilation import bare, inlined, parallel
from kpc.encoder.field.kernels.geometry import add_ray_gradient, cell_index, inverse_edges, ray_distance
from kpc.encoder.field.kernels.marching import (
    LIMIT,
    march_ray,
    negligible_weight,
    new_ray_buffers,
    shade_ray,
)
from kpc.encoder.field.kernels.planes import fetch_texels, scatter_planes
from kpc.encoder.field.kernels.texels import add_displacement_slopes, displace_transpose
from kpc.encoder.field.kernels.vectors import add_decoder_gradient, decode_transpose
from kpc.encoder.field.occupancy_grid import OccupancyGrid

# Smaller weights of samples make no cell matter.
LEAST_PEAK = np.float32(OccupancyGrid.MIN_PEAK)


@bare
def distortion_gradient(buffers, count, volume, factor):
    """Set g_weights[k] = factor * d D / d w_k of `backpropagate`, from running sums of w and w s before sample k."""
    weights, s, step, extent = buffers.weights, buffers.s, volume.step, volume.extent
    total, total_s = np.float32(0.0), np.float32(0.0)
    for k in range(count):
        total += weights[k]
        total_s += weights[k] * (s[k] - s[0]) / extent
    before, before_s = np.float32(0.0), np.float32(0.0)
    for k in range(count):
        along = (s[k] - s[0]) / extent
        apart = along * (np.float32(2.0) * before - total) + total_s - np.float32(2.0) * before_s
        buffers.g_weights[k] = factor * (np.float32(2.0) * apart + np.float32(2.0 / 3.0) * weights[k] * step / extent)
        before += weights[k]
        before_s += weights[k] * along


@inlined
def end_decoder(buffers, g_density, g_basis):
    """Add the gradient of the decoder's weights over a ray."""
    F = g_density.size - 1
    for i in range(F):
        g_density[i] += buffers.g_decoder[i]
    for c in range(3):
        for i in range(F):
            g_basis[c, i] += buffers.g_decoder[(c + 1) * F + i]


@inlined
def decoder_gradient(buffers, k, g_log, g_rgb):
    """Set buffers.g_features, and add to buffers.g_decoder, by sample k, given d loss / d C times its weight.

    log density = density . (features, 1);  colour_c = sigmoid(basis_c . features), 0 where the sample got none
    """
    F, one = buffers.features.shape[1], np.float32(1.0)
    red, green, blue = buffers.decoded[k, 1], buffers.decoded[k, 2], buffers.decoded[k, 3]
    g = (
        g_log,
        g_rgb[0] * red * (one - red),
        g_rgb[1] * green * (one - green),
        g_rgb[2] * blue * (one - blue),
    )
    decode_transpose(buffers.decoder, g, F, buffers.g_features)
    add_decoder_gradient(buffers.g_decoder, g, F, buffers.features, k)


@inlined
def first_draw(buffers, volume):
    """Return a number in [0, 1) that varies from ray to ray like a random one: digits of where samples begin."""
    return buffers.s[0] / volume.step * np.float32(64.0) % np.float32(1.0)


@inlined
def drawn_share(weight, full_weight):
    """Return the share of the cases in which a sample of this weight is drawn."""
    return weight / full_weight if weight < full_weight else np.float32(1.0)


@bare
def draw_samples(planes, volume, buffers, count, trans, g_rgb, g_background, gradients, peaks):
    """Draw the samples of a ray whose gradients are computed, and have the processor fetch what these are added to.

    buffers.drawn is set to them, from the last one to the first, and buffers.g_log_taus to the gradients of the
    logarithms of their thicknesses, divided by `drawn_share`. The other parameters are those of `backpropagate_ray`.

    Returns:
        The number of samples drawn.
    """
    behind = g_background  # d loss / d C times the colour that comes from behind sample k
    trans_after = trans  # transmittance after sample k
    shares, drawn = first_draw(buffers, volume), 0
    for k in range(count - 1, -1, -1):
        weight, colour = buffers.weights[k], buffers.decoded[k]
        g_weight = g_rgb[0] * colour[1] + g_rgb[1] * colour[2] + g_rgb[2] * colour[3] + buffers.g_weights[k]
        g_log_tau = (trans_after * g_weight - behind) * buffers.taus[k]
        if weight > LEAST_PEAK:
            cell = cell_index(peaks, buffers.points[k, 4], buffers.points[k, 5], buffers.points[k, 6])
            peaks[cell] = max(peaks[cell], weight)
        behind += weight * g_weight
        trans_after += weight
        if is_unclipped(buffers, k):
            gradients.density[-1] += g_log_tau
        share = drawn_share(weight, gradients.full_weight)
        shares += share
        if shares < np.float32(1.0):
            continue
        shares -= np.float32(1.0)
        fetch_texels(planes, gradients.theta, buffers, k)
        buffers.drawn[drawn], buffers.g_log_taus[drawn] = k, g_log_tau / share
        drawn += 1
    return drawn


@inlined
def is_unclipped(buffers, k):
    """Return whether the log density of sample k lies within its limits."""
    return abs(buffers.log_densities[k]) < LIMIT


@bare
def backpropagate_ray(planes, volume, origin, direction, buffers, count, trans, g_rgb, g_background, gradients, peaks):
    """Add the gradients of one ray after `march_ray` and `shade_ray`, from its last sample to its first.

    Its parameters are those of a ray one by one, since kernels take no nested tuples.

    Args:
        planes, volume, origin, direction, buffers: as of `march_ray`.
        count, trans: what `march_ray` returned.
        g_rgb: d loss / d C, three numbers.
        g_background: trans * g_rgb . background.
        gradients: `Gradients` of this worker and ray: (n,), (F + 1,), (3, F), (T, Nz, Ny, Nx, 3), (RAY_GRADIENTS,).
        peaks: (Nz, Ny, Nx), raised to the weights above LEAST_PEAK of the samples in each cell.
    """
    inverse, negligible = inverse_edges(volume.aabb), negligible_weight(count)
    if gradients.wants_rays:
        gradients.rays[7], gradients.rays[8], gradients.rays[9] = g_rgb
    buffers.g_decoder[:] = np.float32(0.0)
    drawn = draw_samples(planes, volume, buffers, count, trans, g_rgb, g_background, gradients, peaks)
    for n in range(drawn):
        k, g_log_tau = buffers.drawn[n], buffers.g_log_taus[n]
        weight = buffers.weights[k]
        factor = weight / drawn_share(weight, gradients.full_weight)
        g_log = g_log_tau if is_unclipped(buffers, k) else np.float32(0.0)
        decoder_gradient(buffers, k, g_log, (factor * g_rgb[0], factor * g_rgb[1], factor * g_rgb[2]))
        wants_ray = gradients.wants_rays and weight > negligible  # as for colours: others hardly move a picture
        wants_point = wants_ray or gradients.wants_motion
        scatter_planes(planes, gradients.theta, buffers.g_features, 0, buffers, k, wants_point)
        if gradients.wants_motion:
            displace_transpose(gradients.motion, buffers.points, k, buffers.g_point)
        if wants_ray:
            if planes.motion.shape[0] > 0:
                add_displacement_slopes(planes.motion, buffers.points, k, buffers.g_point)
            add_ray_gradient(
                origin,
                direction,
                ray_distance(buffers.s[k], volume.uniform_distance),
                volume.aabb,
                inverse,
                volume.uniform_distance,
                buffers.g_point,
                g_log_tau,
                gradients.rays,
            )
    end_decoder(buffers, gradients.density, gradients.basis)


@parallel
def backpropagate(planes, density, volume, rays, basis, targets, distortion, gradients, peaks, capacity):
    """Render a batch, and add the gradient of its loss.

    loss = mean over rays and colour channels of (C - target)^2 + distortion * mean over rays of D
    C = sum_k w_k c_k + trans * background
    D = sum_ij w_i w_j |s_i - s_j| + 1/3 sum_i w_i^2 d,   with s over the extent, d = step / extent
    d D / d w_k = 2 sum_j w_j |s_k - s_j| + 2/3 w_k d
    d C / d tau_k = trans_{k+1} c_k - sum_{j>k} w_j c_j - trans_end * background,   tau = sigma * scale * step / extent

    A sample with a weight w below gradients.full_weight is drawn in a share w / full_weight of the cases, and its
    gradients are divided by that share: their mean stays the same, and most samples of a ray, on which a picture hardly
    depends, take no time. Samples are drawn where a running sum of shares along the ray passes a whole number, so that
    those between stand for each other.

    D is the distortion loss of mip-NeRF 360 (arXiv:2111.12077, eq. 15). The gradient of a ray is that of its samples'
    points and times, which stay where they are along the ray; that of its direction is without the basis.

    Args:
        planes: `PlaneSet`.
        density: (F + 1,) float32, the weights of the log density and its bias.
        volume: `Volume`.
        rays: `RayBatch`.
        basis: (N, 3, F) float32, the colour basis of each ray; or (1, 3, F), of all, where colour is view-independent.
        targets: (N, 3) float32.
        distortion: float32, weight of the distortion loss.
        gradients: `Gradients`, added to; it has as many workers as the batch is divided among.
        peaks: (workers, Nz, Ny, Nx) float32, raised to the largest weight above LEAST_PEAK of a sample in each cell.
        capacity: the most samples that a ray can have.

    Returns:
        Squared errors (N,) float32, summed over colour channels, and the samples that each ray took, (N,) int32.
    """
    N = rays.origins.shape[0]
    workers = gradients.theta.shape[0]
    errors = np.empty(N, np.float32)
    counts = np.empty(N, np.int32)
    scale = np.float32(2.0 / (3.0 * N))
    shared = basis.shape[0] == 1
    for worker in prange(workers):
        buffers = new_ray_buffers(planes, capacity)
        for i in range(worker, N, workers):
            b, background = (basis[0] if shared else basis[i]), rays.backgrounds[i]
            count, trans = march_ray(planes, density, b, volume, rays, i, buffers)
            red, green, blue = shade_ray(
                buffers, count, trans * background[0], trans * background[1], trans * background[2]
            )
            e0, e1, e2 = red - targets[i, 0], green - targets[i, 1], blue - targets[i, 2]
            errors[i] = e0 * e0 + e1 * e1 + e2 * e2
            counts[i] = count
            g_rgb = (scale * e0, scale * e1, scale * e2)
            g_background = trans * (g_rgb[0] * background[0] + g_rgb[1] * background[1] + g_rgb[2] * background[2])
            distortion_gradient(buffers, count, volume, np.float32(distortion / N))
            own = Gradients(
                gradients.theta[worker],
                gradients.density[worker],
                gradients.basis[worker] if shared else gradients.basis[i],
                gradients.motion[worker],
                gradients.wants_motion,
                gradients.rays[i if gradients.wants_rays else 0],
                gradients.wants_rays,
                gradients.full_weight,
            )
            backpropagate_ray(
                planes,
                volume,
                rays.origins[i],
                rays.directions[i],
                buffers,
                count,
                trans,
                g_rgb,
                g_background,
                own,
                peaks[worker],
            )
    return errors, counts
