"""Adam, and the gradients of the priors on planes."""

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
            m[i] = m_i if abs(m_i) > TINY else np.float32(0.0)
            v[i] = v_i if v_i > TINY else np.float32(0.0)
            p[i] -= rate * (m[i] / correction1) / (math.sqrt(v[i] / correction2) + eps)


@inlined
def robust_slope(difference, steep):
    """Return half the derivative of log(1 + steep d^2) / steep at a difference d."""
    return difference / (np.float32(1.0) + steep * difference * difference)


@parallel
def add_variation(theta, grad, start, rows, columns, M, along_rows, across_rows, steep):
    """Add the gradient of the (robust) total variation of one plane.

    The loss is the mean over texels and channels of rho(d), d being differences between neighbours, where
    rho(d) = log(1 + steep d^2) / steep, or d^2 where `steep` is 0.

    Args:
        theta, grad: (n,) float32. start, rows, columns, M: which part of theta is the plane, (rows, columns, M).
        along_rows: weight of differences between neighbours in a row. A space-time plane is smoothed along rows alone.
        across_rows: weight of differences between neighbours in a column.
        steep: >= 0.
    """
    width, steep = columns * M, np.float32(steep)
    along, across = np.float32(2.0 * along_rows / (rows * width)), np.float32(2.0 * across_rows / (rows * width))
    for row in prange(rows):
        a = start + row * width
        here = theta[a : a + width]
        out = grad[a : a + width]
        for i in range(M, width):
            out[i] += along * robust_slope(here[i] - here[i - M], steep)
        for i in range(width - M):
            out[i] += along * robust_slope(here[i] - here[i + M], steep)
        if across == 0:
            continue
        if row > 0:
            above = theta[a - width : a]
            for i in range(width):
                out[i] += across * robust_slope(here[i] - above[i], steep)
        if row < rows - 1:
            below = theta[a + width : a + 2 * width]
            for i in range(width):
                out[i] += across * robust_slope(here[i] - below[i], steep)


@parallel
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


@parallel
def add_sparse_transients(theta, grad, start, size, weight):
    """Add the gradient of weight * mean |1 - P| (K-Planes, section 3.2); it is 0 at the kink, P = 1."""
    k = np.float32(weight / size)
    for block in prange((size + (BLOCK - 1)) // BLOCK):
        lo, hi = start + block * BLOCK, start + min((block + 1) * BLOCK, size)
        here, out = theta[lo:hi], grad[lo:hi]
        for i in range(hi - lo):
            if here[i] > np.float32(1.0):
                out[i] += k
            elif here[i] < np.float32(1.0):
                out[i] -= k
