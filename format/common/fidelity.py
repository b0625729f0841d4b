"""How far a picture is from another."""

import math

import numpy as np


def psnr(a: np.ndarray, b: np.ndarray | float) -> float:
    """Of two pictures of one shape, both in [0, 1], or of the difference of two and 0; dB, 100 at most."""
    return psnr_from_mse(float(np.mean(np.square(a - b), dtype=np.float64)))


def psnr_from_mse(error: float) -> float:
    """-10 log10 of a mean squared error of numbers in [0, 1]; dB, 100 at most."""
    return -10 * math.log10(max(error, 1e-10))
