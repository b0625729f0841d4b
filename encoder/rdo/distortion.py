"""What errors of symbols cost, alone and together: the part that the ways to choose symbols share (`kpc.encoder.rdo.trellis`, `kpc.encoder.rdo.dct_rdo`).

With u = sqrt(worth) times the error of a number in steps, pictures err by

    sum of u (u + BESIDE * sum of u of the four texels around + ACROSS * sum of u of the four at the corners + others)

    others = c + BESIDE * sum of c of the four texels around + ACROSS * sum of c of the four at the corners
    c = TOGETHER * sum over other channels of the texel of their u times their correlation with this one (`kpc.encoder.rdo.curvature`)

and a bit is worth LAM of that.
"""

import numpy as np
from kpc.encoder.rdo.curvature import BLOCK_SIDE
from kpc.format.common.jit import compiled

PlaneKey = tuple[int, str]
"""A plane: scale and name."""

LAM = 0.5
"""Squared steps that a bit is worth, where an error is worth what it is in the mean. Where steps are fine an error of
(2 step)^2 / 12 / 1.28, that of the trellis, falls to a quarter with a bit more, at the slope of 0.36; errors that make up for each other
allow finer steps at more. Liam: with 0.3 and 0.7 files are one to four percent larger at equal PSNR of held-out views."""
EDGE_COUPLING, CORNER_COUPLING = 1 / 4, 1 / 16
"""What errors of neighbours cost together, of what they cost each. Bilinear weights are products of 1 - |x|; over look-ups anywhere between
two texels their product has the mean 1/6, the square of either about a texel 2/3, and at corners it is so along both axes. Measured for
liam and soldier (off-diagonals of `kpc.encoder.rdo.curvature`): 0.25 to 0.42 and 0.06 to 0.2, next to nothing two texels away; files at equal
error are the same with what is measured."""
CHANNEL_COUPLING = 0.3
"""In what curvature says of two channels. What is left to chance in it, and bits that it takes to make up for others, make less of it
better than all. At equal error of pictures files are smaller by 2.6 % (default scene), 3.5 % (liam) and 3 to 5 % (soldier) than without; with
0.2 to 0.6 liam's by about as much, with 0.5 soldier's hardly."""
MIN_WEIGHT = 0.03
"""Of an error, as a share of the channel's mean: what no ray met may yet be seen, and what lets light through may be made to hide what is
behind. Soldier, held-out views: with 1e-4 squared errors are a tenth larger where steps are fine, and a third where they are coarse, most of
that in one ray of a hundred; with 0.1 files are up to one percent larger (liam: 2 %)."""
NO_CORRELATION = np.zeros((0, 0, 0, 0), np.float32)
"""For what goes together, where channels know nothing of each other."""


def distortion_weights(significant: np.ndarray, known: np.ndarray) -> np.ndarray:
    """(H, W, M) float32: what errors cost, `significant`, as shares of the channel's mean over `known` texels."""
    means = significant[known].mean(0, dtype=np.float64) if known.any() else np.ones(significant.shape[2])
    return np.where(means > 0, np.maximum(significant / np.maximum(means, 1e-30), MIN_WEIGHT), 1.0).astype(np.float32)


def magnitude_bits(counts: np.ndarray, mean: np.ndarray, trust: float = 4.0) -> np.ndarray:
    """(contexts, magnitudes) bits, sign included, of what came so often in each context. What hardly came is taken to be geometrically distributed
    with a (contexts,) mean, as if that had been seen `trust` times."""
    ratio = (mean / (1 + mean))[:, None]
    shares = counts + trust * ((1 - ratio) * ratio ** np.arange(counts.shape[1]) + 1e-4)
    bits: np.ndarray = -np.log2(shares / shares.sum(1, keepdims=True))
    bits[:, 1:] += 1
    return bits


def total_distortion(errors: np.ndarray, together: np.ndarray) -> float:
    """The sum above, of (H, W, M) u. `together`: (blocks down, blocks along, M, M) of blocks of SIDE texels, or ALONE."""
    bordered = np.pad(errors.astype(np.float32), ((1, 1), (1, 1), (0, 0)))
    down = bordered[1:-1] + np.float32(EDGE_COUPLING) * (bordered[:-2] + bordered[2:])
    seen = down[:, 1:-1] + np.float32(EDGE_COUPLING) * (down[:, :-2] + down[:, 2:])
    for m in range(errors.shape[2]):
        seen[..., m] += cross_channel_errors(bordered, together, m)
    return float((errors * seen).sum(dtype=np.float64))


@compiled()
def cross_channel_errors(errors: np.ndarray, together: np.ndarray, m: int) -> np.ndarray:
    """(H, W) float32: what errors in other channels, (H + 2, W + 2, M) with a border, of a texel and around it, make of one in channel m."""
    H, W = errors.shape[0] - 2, errors.shape[1] - 2
    c, out = np.zeros((H + 2, W + 2), np.float32), np.zeros((H, W), np.float32)
    if together.size == 0:
        return out
    for y in range(H):
        for x in range(W):
            c[y + 1, x + 1] = (
                CHANNEL_COUPLING * (together[y // BLOCK_SIDE, x // BLOCK_SIDE, m] * errors[y + 1, x + 1]).sum()
            )
    for y in range(H):
        for x in range(W):
            out[y, x] = (
                c[y + 1, x + 1]
                + EDGE_COUPLING * (c[y, x + 1] + c[y + 2, x + 1] + c[y + 1, x] + c[y + 1, x + 2])
                + CORNER_COUPLING * (c[y, x] + c[y, x + 2] + c[y + 2, x] + c[y + 2, x + 2])
            )
    return out
