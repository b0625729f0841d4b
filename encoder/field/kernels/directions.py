"""The colour basis of rays, a small MLP of their directions, and its transpose.

    hidden = relu(w1 e(d) + b1 + code),   basis = w2 hidden + b2,   e(d) = [x, y, z, xx, yy, zz, xy, yz, zx]

as in `kpc.format.scene.scene.Decoder`. Weights are taken transposed, with the biases as their last row: `inner`
(10, H) float32 of w1 and b1, and `outer` (H + 1, 3 F) of w2 and b2.
"""

import numpy as np
from numba import prange

from kpc.encoder.field.kernels.compilation import inlined, parallel
from kpc.encoder.field.kernels.vectors import add_scaled, dot

# Numbers of e(d), and 1 for the bias.
TERMS = 10


@parallel
def colour_basis(directions, codes, numbers, inner, outer, workers):
    """Return the colour basis of N rays, (N, 3 F), and their hidden layer, (N, H).

    Args:
        directions: (N, 3) float32, unit vectors.
        codes: (K, H) float32, appearance codes; K is 0 where there are none.
        numbers: (N,) int64, which of them each ray has; not read where there are none.
        inner, outer: weights. workers: parts into which the rays are divided.
    """
    N, H, width = directions.shape[0], inner.shape[1], outer.shape[1]
    hidden, basis = np.empty((N, H), np.float32), np.empty((N, width), np.float32)
    for worker in prange(workers):
        terms = np.empty(TERMS, np.float32)
        for i in range(worker * N // workers, (worker + 1) * N // workers):
            _encode(directions, i, terms)
            for h in range(H):
                hidden[i, h] = codes[numbers[i], h] if codes.shape[0] > 0 else np.float32(0.0)
            for term in range(TERMS):
                add_scaled(hidden, i * H, terms[term], inner, term * H, H)
            for j in range(width):
                basis[i, j] = outer[H, j]
            for h in range(H):
                if hidden[i, h] <= 0:  # what is no number stays, so that the error of training names it
                    hidden[i, h] = np.float32(0.0)
                else:
                    add_scaled(basis, i * width, hidden[i, h], outer, h * width, width)
    return basis, hidden


@parallel
def colour_basis_transpose(directions, numbers, hidden, inner, outer, g_basis, g_weights, g_rays, wants_rays):
    """Add the gradients of weights, codes and directions, given that of the basis, (N, 3 F).

    Args:
        directions, numbers, inner, outer: as of `colour_basis`. hidden: what it returned.
        g_weights: of inner, outer and codes, each (workers, ...) float32, a buffer for each worker.
        g_rays, wants_rays: as of `Gradients`.
    """
    g_inner, g_outer, g_codes = g_weights
    N, H, width, workers = directions.shape[0], inner.shape[1], outer.shape[1], g_inner.shape[0]
    for worker in prange(workers):
        terms, g_hidden = np.empty(TERMS, np.float32), np.empty((1, H), np.float32)
        for i in range(worker * N // workers, (worker + 1) * N // workers):
            _encode(directions, i, terms)
            add_scaled(g_outer[worker], H * width, np.float32(1.0), g_basis, i * width, width)
            for h in range(H):
                g_hidden[0, h] = np.float32(0.0)
                if hidden[i, h] != 0:
                    add_scaled(g_outer[worker], h * width, hidden[i, h], g_basis, i * width, width)
                    g_hidden[0, h] = dot(g_basis, i * width, outer, h * width, width)
            for term in range(TERMS):
                add_scaled(g_inner[worker], term * H, terms[term], g_hidden, 0, H)
            if g_codes.shape[1] > 0:
                add_scaled(g_codes[worker], numbers[i] * H, np.float32(1.0), g_hidden, 0, H)
            if wants_rays:
                _add_slopes(directions, i, g_hidden, inner, g_rays)


@inlined
def _encode(directions, i, terms):
    """Set terms (10,) to e(d) of direction i, and 1."""
    x, y, z = directions[i, 0], directions[i, 1], directions[i, 2]
    terms[0], terms[1], terms[2] = x, y, z
    terms[3], terms[4], terms[5] = x * x, y * y, z * z
    terms[6], terms[7], terms[8] = x * y, y * z, z * x
    terms[9] = np.float32(1.0)


@inlined
def _add_slopes(directions, i, g_hidden, inner, g_rays):
    """Add the gradient of direction i, given that of its hidden layer, (1, H)."""
    H, two = inner.shape[1], np.float32(2.0)
    for axis in range(3):
        ahead, behind = (axis + 1) % 3, (axis + 2) % 3
        g_rays[i, 3 + axis] += (
            dot(g_hidden, 0, inner, axis * H, H)
            + two * directions[i, axis] * dot(g_hidden, 0, inner, (3 + axis) * H, H)
            + directions[i, ahead] * dot(g_hidden, 0, inner, (6 + axis) * H, H)
            + directions[i, behind] * dot(g_hidden, 0, inner, (6 + behind) * H, H)
        )
