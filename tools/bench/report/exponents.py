"""How a cost grows with the size of the work."""

import math
from collections.abc import Sequence

import numpy as np


def exponent(amounts: Sequence[float], costs: Sequence[float]) -> float | None:
    """Return e of cost = c amount^e, by least squares of the logarithms.

    Args:
        amounts, costs: of equal length; pairs that are not both above 0 do not count.

    Returns:
        None where there are fewer than two different amounts.
    """
    pairs = [(math.log(x), math.log(y)) for x, y in zip(amounts, costs, strict=True) if x > 0 and y > 0]
    if len({x for x, _ in pairs}) < 2:
        return None
    x, y = np.array(pairs).T
    return float(np.polyfit(x, y, 1)[0])
