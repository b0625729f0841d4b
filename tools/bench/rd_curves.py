"""Curves of size against PSNR, by the points that were measured, and how they compare."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.interpolate import PchipInterpolator

Point = dict[str, Any]
"""Of a coding: at least its size_bytes, psnr and loss_db, what that is less than the uncoded scene's."""

WORST_LOSS_DB = 3.0
"""Curves are compared down to this: what is worse nobody wants."""


def bd_rate(ours: Sequence[Point], others: Sequence[Point], size: str = "size_bytes") -> float | None:
    """By what share ours are smaller (below 0) or larger at equal PSNR, on average over what both reach of the PSNR between that of
    the uncoded scene and WORST_LOSS_DB less. `size`: of a point, which bytes to compare.

    Bjøntegaard's measure (ITU-T VCEG-M33, 2001) with piecewise cubic curves that do not overshoot (PCHIP: Fritsch and Carlson,
    SIAM J. Numer. Anal. 17, 1980; as ITU-T JVET-H0030 has it): the mean over PSNR of log(rate ratio). None where the curves have
    fewer than four points each, or no PSNR in common.
    """
    curves = [_rising(points, size) for points in (ours, others)]
    best = max((point["psnr"] + point["loss_db"] for point in ours), default=0.0)
    if min(len(psnr) for psnr, _ in curves) < 4:
        return None
    low, high = max(best - WORST_LOSS_DB, *(psnr[0] for psnr, _ in curves)), min(psnr[-1] for psnr, _ in curves)
    if high - low < 1e-6:
        return None
    at = np.linspace(low, high, 1001)
    mine, theirs = (PchipInterpolator(psnr, rate)(at) for psnr, rate in curves)
    difference = mine - theirs
    return math.exp(float(np.mean((difference[1:] + difference[:-1]) / 2))) - 1


def size_at(points: Sequence[Point], loss_db: float) -> float | None:
    """Bytes at a loss, on the same curve; None beyond its ends."""
    if not points:
        return None
    psnr, rate = _rising(points)
    wanted = points[0]["psnr"] + points[0]["loss_db"] - loss_db
    if len(psnr) < 3 or not psnr[0] <= wanted <= psnr[-1]:
        return None
    return math.exp(float(PchipInterpolator(psnr, rate)(wanted)))


def _rising(points: Sequence[Point], size: str = "size_bytes") -> tuple[np.ndarray, np.ndarray]:
    """PSNR and log sizes of those points that no smaller one equals, by size."""
    best: list[tuple[float, float]] = []
    for point in sorted(points, key=lambda point: (point[size], -point["psnr"])):
        if not best or point["psnr"] > best[-1][0] + 1e-6:
            best.append((point["psnr"], math.log(point[size])))
    psnr, rate = zip(*best) if best else ((), ())
    return np.array(psnr), np.array(rate)
