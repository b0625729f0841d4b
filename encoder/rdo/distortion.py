"""The Lagrangian cost of quantisation, J = D + lambda R, in the units that all searches for symbols share.

The searches are those of `kpc.encoder.rdo.trellis`, `kpc.encoder.rdo.dct_rdo` and `kpc.encoder.rdo.motion_rdo`. With
u = sqrt(weight) times the error of a value in steps, where the weight is the value's curvature relative to the mean
of its channel (`distortion_weights`), the distortion of pictures is

    D = sum of u (u + EDGE_COUPLING * sum of u of the four adjacent texels
                    + CORNER_COUPLING * sum of u of the four diagonal texels + cross)

    cross = c + EDGE_COUPLING * sum of c of the four adjacent texels
              + CORNER_COUPLING * sum of c of the four diagonal texels
    c     = CHANNEL_COUPLING * sum over the other channels of a texel of their u, times their correlation with this
            channel (`kpc.encoder.rdo.curvature`)

R is in bits, and lambda is LAM.
"""

import numpy as np

from kpc.encoder.rdo.curvature import BLOCK_SIDE
from kpc.jit import compiled

PlaneKey = tuple[int, str]  # a plane: scale and name

# Figures behind these constants: docs/design/rate-distortion.md, "Distortion".
LAM = 0.5  # lambda: squared steps per bit, at a weight of 1
# Distortion of two neighbouring errors together, relative to that of each alone: the mean over look-ups of the
# product of their bilinear weights, over the mean square of one.
EDGE_COUPLING, CORNER_COUPLING = 1 / 4, 1 / 16
CHANNEL_COUPLING = 0.3  # share of the estimated correlation of channels that is relied on
MIN_WEIGHT = 0.03  # least distortion weight: values that no ray has met may yet be seen
NO_CORRELATION = np.zeros((0, 0, 0, 0), np.float32)  # channels are independent


def distortion_weights(significant: np.ndarray, coded: np.ndarray) -> np.ndarray:
    """Return the cost of a squared error in each value, relative to the mean of its channel over coded texels.

    Args:
        significant: (H, W, M), cost of a squared error in each value; not negative.
        coded: (H, W) bool.

    Returns:
        (H, W, M) float32, at least MIN_WEIGHT.
    """
    means = significant[coded].mean(0, dtype=np.float64) if coded.any() else np.ones(significant.shape[2])
    relative = np.maximum(significant / np.maximum(means, 1e-30), MIN_WEIGHT)
    return np.where(means > 0, relative, 1.0).astype(np.float32)


def magnitude_bits(counts: np.ndarray, mean: np.ndarray, prior_count: float = 4.0) -> np.ndarray:
    """Estimate the bits of magnitudes, sign included, from their counts in each context.

    The prior is a geometric distribution, which counts as `prior_count` observations.

    Args:
        counts: (contexts, magnitudes).
        mean: (contexts,), expected magnitudes of the prior.
        prior_count: weight of the prior.

    Returns:
        (contexts, magnitudes) float64.
    """
    ratio = (mean / (1 + mean))[:, None]
    shares = counts + prior_count * ((1 - ratio) * ratio ** np.arange(counts.shape[1]) + 1e-4)
    bits: np.ndarray = -np.log2(shares / shares.sum(1, keepdims=True))
    bits[:, 1:] += 1
    return bits


def total_distortion(errors: np.ndarray, correlation: np.ndarray) -> float:
    """Return D of a plane.

    Args:
        errors: (H, W, M), the weighted errors u.
        correlation: (blocks down, blocks across, M, M) of blocks of BLOCK_SIDE texels, or NO_CORRELATION.
    """
    bordered = np.pad(errors.astype(np.float32), ((1, 1), (1, 1), (0, 0)))
    down = bordered[1:-1] + np.float32(EDGE_COUPLING) * (bordered[:-2] + bordered[2:])
    coupled = down[:, 1:-1] + np.float32(EDGE_COUPLING) * (down[:, :-2] + down[:, 2:])
    correlation = np.ascontiguousarray(correlation)
    for m in range(errors.shape[2]):
        coupled[..., m] += cross_channel_errors(bordered, correlation, m)
    return float((errors * coupled).sum(dtype=np.float64))


@compiled()
def cross_channel_errors(
    errors: np.ndarray,  # (H + 2, W + 2, M) float32
    correlation: np.ndarray,  # (blocks down, blocks across, M, M) float32
    m: int,
) -> np.ndarray:
    """Return `cross` for channel m, (H, W) float32, from the weighted errors u with a border."""
    H, W = errors.shape[0] - 2, errors.shape[1] - 2
    c, out = np.zeros((H + 2, W + 2), np.float32), np.zeros((H, W), np.float32)
    if correlation.size == 0:
        return out
    for y in range(H):
        for x in range(W):
            coupled = correlation[y // BLOCK_SIDE, x // BLOCK_SIDE, m] * errors[y + 1, x + 1]
            c[y + 1, x + 1] = CHANNEL_COUPLING * coupled.sum()
    for y in range(H):
        for x in range(W):
            out[y, x] = (
                c[y + 1, x + 1]
                + EDGE_COUPLING * (c[y, x + 1] + c[y + 2, x + 1] + c[y + 1, x] + c[y + 1, x + 2])
                + CORNER_COUPLING * (c[y, x] + c[y, x + 2] + c[y + 2, x] + c[y + 2, x + 2])
            )
    return out
