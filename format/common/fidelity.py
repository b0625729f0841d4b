"""Peak signal-to-noise ratio of pictures."""

import math

import numpy as np

# A mean squared error below this counts as this much: PSNR is at most 100 dB.
MIN_MSE = 1e-10


def psnr(a: np.ndarray, b: np.ndarray | float) -> float:
    """Return the PSNR in dB, at most 100, of two pictures of the same shape with values in [0, 1].

    The difference of two pictures may be compared with 0 instead.
    """
    return psnr_from_mse(float(np.mean(np.square(a - b), dtype=np.float64)))


def psnr_from_mse(mse: float) -> float:
    """Return -10 log10(mse), in dB and at most 100, of a mean squared error of values in [0, 1]."""
    return -10 * math.log10(max(mse, MIN_MSE))
