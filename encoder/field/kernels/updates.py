"""Adam, factors of rows and columns, and the gradients of the priors on planes.

Inner loops are functions of slices: within a `prange`, LLVM makes no vectors of them (docs/design/training.md).
"""

import math

import numpy as np
from numba import prange

from kpc.encoder.field.kernels.compilation import inlined, parallel

# Means of Adam below this are set to 0: texels that no ray visits would decay into denormal numbers, which take some
# hundred times as long to compute with.
TINY = np.float32(1e-30)

# Numbers that a thread updates at a time.
BLOCK = 16384


@parallel
def adam(theta, grad, mean, square, lr, beta1, beta2, epsilon, step_number):
    """Do one step of Adam (arXiv:1412.6980, algorithm 1) on theta (n,).

    The gradient is the sum over workers of grad (workers, n), which is cleared.
    """
    n = theta.size
    workers = grad.shape[0]
    correction1 = np.float32(1.0 - beta1**step_number)
    correction2 = np.float32(1.0 - beta2**step_number)
    b1, b2, rate, eps = np.float32(beta1), np.float32(beta2), np.float32(lr), np.float32(epsilon)
    blocks = (n + (BLOCK - 1)) // BLOCK
    for block in prange(blocks):
        lo, hi = block * BLOCK, min((block + 1) * BLOCK, n)
        total = grad[0, lo:hi]
        for worker in range(1, workers):
            _move_to(total, grad[worker, lo:hi])
        _adam_numbers(theta[lo:hi], total, mean[lo:hi], square[lo:hi], (b1, b2, correction1, correction2, rate, eps))


@inlined
def _move_to(total, other):
    """Add `other` (n,) to `total`, and clear it."""
    for i in range(total.size):
        total[i] += other[i]
        other[i] = np.float32(0.0)


@inlined
def _adam_numbers(p, g, m, v, numbers):
    """Do the step of `adam` on some of its numbers (n,), and clear the gradient g."""
    b1, b2, correction1, correction2, rate, eps = numbers
    for i in range(p.size):
        m_i = b1 * m[i] + (np.float32(1.0) - b1) * g[i]
        v_i = b2 * v[i] + (np.float32(1.0) - b2) * g[i] * g[i]
        g[i] = np.float32(0.0)
        m_i = m_i if abs(m_i) > TINY else np.float32(0.0)
        v_i = v_i if v_i > TINY else np.float32(0.0)
        m[i], v[i] = m_i, v_i
        p[i] -= rate * (m_i / correction1) / (math.sqrt(v_i / correction2) + eps)


@parallel
def line_gradients(theta, grad, blocks, M, found, parts):
    """Find the gradients of factors on rows and columns of planes (`kpc.encoder.training.line_steps`).

    Args:
        theta: (n,) float32. grad: (workers, n) float32, whose sum is the gradient.
        blocks: (B, 6) int64, `Layout.line_blocks`.
        M: channels.
        found: (lines, M) float32 zeros, in which those of rows are set.
        parts: (B, columns M) float32 zeros, in which what each block adds to those of its plane's columns is set.
    """
    workers = grad.shape[0]
    for b in prange(len(blocks)):
        start, first, last, columns, line = blocks[b, 0], blocks[b, 1], blocks[b, 2], blocks[b, 3], blocks[b, 5]
        width = columns * M
        part, products = parts[b], np.empty(width, np.float32)
        for row in range(first, last):
            lo = start + row * width
            products[:] = np.float32(0.0)
            for worker in range(workers):
                _add_products(products, theta[lo : lo + width], grad[worker, lo : lo + width])
            for i in range(width):
                part[i] += products[i]
            _add_columns(products, columns, M)
            for c in range(M):
                found[line + row, c] = products[c]


@inlined
def _add_products(total, a, b):
    """Add a b to `total`, each (n,)."""
    for i in range(total.size):
        total[i] += a[i] * b[i]


@inlined
def _add_columns(row, columns, M):
    """Add all columns of a row (columns M,) to its first, halves to halves: loops over M alone are too short."""
    while columns > 1:
        half = columns // 2
        columns -= half
        ahead = row[columns * M :]
        for i in range(half * M):
            row[i] += ahead[i]


@inlined
def _repeat_column(row, columns, M):
    """Set all columns of a row (columns M,) to its first."""
    done = 1
    while done < columns:
        more = min(done, columns - done)
        ahead = row[done * M :]
        for i in range(more * M):
            ahead[i] = row[i]
        done += more


@parallel
def scale_lines(theta, factors, blocks, M):
    """Multiply planes in theta (n,) by 1 + the factors (lines, M) of their rows, and of their columns."""
    flat = factors.reshape(-1)
    for b in prange(len(blocks)):
        start, first, last, columns, line = blocks[b, 0], blocks[b, 1], blocks[b, 2], blocks[b, 3], blocks[b, 5]
        width = columns * M
        of_columns = flat[(line + blocks[b, 4]) * M :]
        of_row = np.empty(width, np.float32)
        for row in range(first, last):
            for c in range(M):
                of_row[c] = factors[line + row, c]
            _repeat_column(of_row, columns, M)
            lo = start + row * width
            _scale_row(theta[lo : lo + width], of_row, of_columns)


@inlined
def _scale_row(texels, of_row, of_columns):
    """Multiply texels (n,) by 1 + each of two factors (n,)."""
    for i in range(texels.size):
        texels[i] *= (np.float32(1.0) + of_row[i]) * (np.float32(1.0) + of_columns[i])


@inlined
def robust_slope(difference, steep):
    """Return half the derivative of log(1 + steep d^2) / steep at a difference d."""
    return difference / (np.float32(1.0) + steep * difference * difference)


@parallel
def add_priors(theta, grad, rows, M, space, transient, time_smoothness, sparse_transients, steep):
    """Add the gradient of the priors on planes, `kpc.encoder.field.priors.plane_priors`.

    All planes are one loop: where other programs keep a core busy, each start of the threads may wait for it.

    Args:
        theta, grad: (n,) float32.
        rows: (R, 5) int64, for each row of a plane where the plane begins in theta, the number of the row, how many
            rows and columns the plane has, and 1 for a space-time plane.
        M: channels.
        space, transient, time_smoothness, sparse_transients: weights.
        steep: of the robust total variation, >= 0.
    """
    steep = np.float32(steep)
    for n in prange(len(rows)):
        start, row, count, width = rows[n, 0], rows[n, 1], rows[n, 2], rows[n, 3] * M
        here, size = start + row * width, count * width
        if rows[n, 4] == 0:
            weight = np.float32(2.0 * space / size)
            _add_variation_along(theta, grad, here, width, M, weight, steep)
            if row > 0:
                _add_variation_across(theta, grad, here, here - width, width, weight, steep)
            if row < count - 1:
                _add_variation_across(theta, grad, here, here + width, width, weight, steep)
        else:
            _add_variation_along(theta, grad, here, width, M, np.float32(2.0 * transient / size), steep)
            weight = np.float32(2.0 * time_smoothness / size)
            for centre in range(max(row - 1, 1), min(row + 2, count - 1)):
                factor = weight * np.float32(-2.0) if centre == row else weight
                _add_time_smoothness(theta, grad, here, start + centre * width, width, factor)
            _add_sparse_transients(
                theta[here : here + width], grad[here : here + width], np.float32(sparse_transients / size)
            )


@inlined
def _add_variation_along(theta, grad, here, width, M, weight, steep):
    """Add the gradient of the (robust) total variation along a row that begins at `here`.

    The loss is the mean over texels and channels of rho(d), d being differences between neighbours, where
    rho(d) = log(1 + steep d^2) / steep, or d^2 where `steep` is 0.
    """
    end = here + width
    _add_variation(grad[here + M : end], theta[here + M : end], theta[here : end - M], weight, steep)
    _add_variation(grad[here : end - M], theta[here : end - M], theta[here + M : end], weight, steep)


@inlined
def _add_variation_across(theta, grad, here, beside, width, weight, steep):
    """Add the same between a row and the one that begins at `beside`."""
    _add_variation(grad[here : here + width], theta[here : here + width], theta[beside : beside + width], weight, steep)


@inlined
def _add_variation(grad, own, neighbours, weight, steep):
    """Add the same to `grad` (n,), given texels and one neighbour of each."""
    for i in range(grad.size):
        grad[i] += weight * robust_slope(own[i] - neighbours[i], steep)


@inlined
def _add_time_smoothness(theta, grad, here, centre, width, factor):
    """Add the gradient of (P[t-1] - 2 P[t] + P[t+1])^2 (K-Planes, section 3.2), t being the row at `centre`."""
    before, after = theta[centre - width : centre], theta[centre + width : centre + 2 * width]
    _add_second_difference(grad[here : here + width], before, theta[centre : centre + width], after, factor)


@inlined
def _add_second_difference(grad, before, own, after, factor):
    """Add the same to `grad` (n,), given texels of three rows."""
    for i in range(grad.size):
        grad[i] += factor * (before[i] - np.float32(2.0) * own[i] + after[i])


@inlined
def _add_sparse_transients(theta, grad, weight):
    """Add the gradient of |1 - P| (K-Planes, section 3.2) of texels (n,); it is 0 at the kink, P = 1."""
    for i in range(grad.size):
        above, below = theta[i] > np.float32(1.0), theta[i] < np.float32(1.0)
        grad[i] += weight * (np.float32(above) - np.float32(below))
