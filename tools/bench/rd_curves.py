"""Rate-distortion curves through measured points, and how they compare."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.interpolate import PchipInterpolator

# One coding: at least its size_bytes, psnr, and loss_db, the PSNR lost relative to the uncoded scene.
Point = dict[str, Any]

# Curves are compared down to this loss; more is of no practical use.
WORST_LOSS_DB = 3.0


def bd_rate(ours: Sequence[Point], others: Sequence[Point], size: str = "size_bytes") -> float | None:
    """Return the Bjøntegaard delta rate: by what share ours are smaller (negative) or larger at equal PSNR.

    It is exp of the mean over PSNR of log(our rate / other rate), minus 1 (ITU-T VCEG-M33, 2001), from the PSNR of the
    uncoded scene and WORST_LOSS_DB less, as far as both curves reach. The curves are monotone piecewise cubics (PCHIP:
    Fritsch and Carlson, SIAM J. Numer. Anal. 17, 1980), as in ITU-T JVET-H0030.

    Args:
        size: the key of a point that holds the bytes to compare.

    Returns:
        None where a curve has fewer than four points, or the curves have no PSNR in common.
    """
    curves = [_rising(points, size) for points in (ours, others)]
    best = max((point["psnr"] + point["loss_db"] for point in ours), default=0.0)
    if min(len(psnr) for psnr, _ in curves) < 4:
        return None
    low, high = max(best - WORST_LOSS_DB, *(psnr[0] for psnr, _ in curves)), min(psnr[-1] for psnr, _ in curves)
    if high - low < 1e-6:
        return None
    at = np.linspace(low, high, 1001)
    our_rate, other_rate = (PchipInterpolator(psnr, rate)(at) for psnr, rate in curves)
    difference = our_rate - other_rate
    return math.exp(float(np.mean((difference[1:] + difference[:-1]) / 2))) - 1


def size_at(points: Sequence[Point], loss_db: float) -> float | None:
    """Return the bytes at a loss on the curve of `bd_rate`; None beyond its ends."""
    if not points:
        return None
    psnr, rate = _rising(points)
    wanted = points[0]["psnr"] + points[0]["loss_db"] - loss_db
    if len(psnr) < 3 or not psnr[0] <= wanted <= psnr[-1]:
        return None
    return math.exp(float(PchipInterpolator(psnr, rate)(wanted)))


def _rising(points: Sequence[Point], size: str = "size_bytes") -> tuple[np.ndarray, np.ndarray]:
    """Return PSNR and log size of the points on the Pareto front, by increasing size."""
    best: list[tuple[float, float]] = []
    for point in sorted(points, key=lambda point: (point[size], -point["psnr"])):
        if not best or point["psnr"] > best[-1][0] + 1e-6:
            best.append((point["psnr"], math.log(point[size])))
    psnr, rate = zip(*best, strict=True) if best else ((), ())
    return np.array(psnr), np.array(rate)
