"""Functions by vectors, `kpc.vectors`."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numba import njit, types
from numba.extending import intrinsic

from kpc.vectors import EXPONENTS, INDEX, array_of, exponential, load, store

WIDE = 8


@intrinsic
def exponentials(_: Any, x: Any, out: Any) -> Any:
    """Set out[:8] to exp(x[:8])."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Sequence[Any]) -> Any:
        x, out = (array_of(context, builder, signature, arguments, n).data for n in range(2))
        store(builder, exponential(builder, load(builder, x, INDEX(0), WIDE), WIDE), out, INDEX(0))
        return context.get_dummy_value()

    return types.void(x, out), generate


@njit
def exponentials_of(x, out):
    """Set out (n, 8) to exp(x)."""
    for row in range(len(x)):
        exponentials(x[row], out[row])


def exponential_of(x: np.ndarray) -> np.ndarray:
    """Return exp(x), float32; the number of elements is a multiple of eight."""
    rows = np.ascontiguousarray(x, np.float32).reshape(-1, WIDE)
    out = np.empty_like(rows)
    exponentials_of(rows, out)
    return out.reshape(x.shape)


def test_the_exponential_is_exact_to_rounding() -> None:
    x = np.linspace(*EXPONENTS, 80_000, dtype=np.float32)
    exact = np.exp(x.astype(np.float64))
    assert np.max(np.abs(exponential_of(x) / exact - 1)) < 3e-7


def test_the_exponential_beyond_its_range() -> None:
    x = np.array([-np.inf, -1e30, -88, 0, -0.0, 89, np.inf, np.nan], np.float32)
    low, high = (np.exp(np.float32(limit)) for limit in EXPONENTS)
    np.testing.assert_allclose(exponential_of(x), [low, low, low, 1, 1, high, high, np.nan], rtol=3e-7)
