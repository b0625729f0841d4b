"""Sweeps: one quantity from small to large, and the error of each implementation of a stage at each of its values."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from kpc.format.common.progress import in_parts

# One level of an 8-bit picture.
LEVEL = 1 / 255


@dataclass(frozen=True)
class Sweep:
    """A quantity, and what is computed at each of its values.

    Attributes:
        stage: what is computed.
        axis: the quantity that is swept, with its unit.
        values: of it, rising.
        measure: returns the largest error at a value by the name of the implementation, against float64.
        admitted: the least and the largest value that the code lets through.
        kept: how it does that.
        error: what the error is of: pictures have a range of 1, relative errors are shares of the exact number.
        bound: of the error at admitted values.
    """

    stage: str
    axis: str
    values: tuple[float, ...]
    measure: Callable[[float], Mapping[str, float]]
    admitted: tuple[float, float]
    kept: str
    error: str = "picture"
    bound: float = LEVEL

    def settings(self) -> dict[str, Any]:
        """Return what a record says of the sweep; None stands for infinity."""
        return {
            "axis": self.axis,
            "error": self.error,
            "bound": self.bound,
            "admitted": [_finite(value) for value in self.admitted],
            "kept": self.kept,
        }

    def is_admitted(self, value: float) -> bool:
        """Return whether the code lets a value through."""
        low, high = self.admitted
        return low <= value <= high


def run(sweep: Sweep, values: Sequence[float] | None = None) -> dict[str, Any]:
    """Measure all values of a sweep, or some.

    Returns:
        `points`: for each value, `value` and `errors` by implementation (None where not finite); `max_error`: the
        largest at admitted values, None if infinite; `worst`: whose it is; `passes`: the values at which an error
        exceeds the bound.
    """
    points, passes = [], []
    worst, largest = "", 0.0
    for value in in_parts(sweep.values if values is None else values):
        errors = dict(sweep.measure(value))
        points.append({"value": value, "errors": {name: _finite(error) for name, error in errors.items()}})
        name = max(errors, key=lambda name: errors[name])
        if errors[name] > sweep.bound:
            passes.append(value)
        if sweep.is_admitted(value) and errors[name] >= largest:
            worst, largest = name, errors[name]
    return {"points": points, "max_error": _finite(largest), "worst": worst, "passes": passes}


def largest_difference(found: np.ndarray, exact: np.ndarray) -> float:
    """Return the largest absolute difference; infinity where something found is not finite."""
    if not np.isfinite(found).all():
        return math.inf
    return float(np.abs(np.asarray(found, np.float64) - exact).max())


def largest_ratio(found: np.ndarray, exact: np.ndarray | float) -> float:
    """Return the largest difference as a share of the exact number; infinity where something found is not finite."""
    if not np.isfinite(found).all():
        return math.inf
    return float((np.abs(np.asarray(found, np.float64) - exact) / np.maximum(np.abs(exact), 1e-300)).max())


def powers(base: float, exponents: Sequence[float]) -> tuple[float, ...]:
    """Return powers of a base."""
    return tuple(float(base**exponent) for exponent in exponents)


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
