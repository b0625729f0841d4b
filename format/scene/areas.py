"""The part of the box in which a scale's features are other than 0, found from its texels.

A scale that describes only what moves is 0 elsewhere (`kpc.encoder.field.layout`).
"""

from collections.abc import Mapping

import numpy as np

from kpc.format.scene.scene import SPACE_PLANES

AXES = "xyz"


def area_texels(used: Mapping[str, np.ndarray]) -> np.ndarray | None:
    """Return the texels between which the product of a scale's space planes may be other than 0.

    Args:
        used: of each space plane (rows, columns) bool, whether a texel is other than 0 in a channel.

    Returns:
        (3, 2) int64, the first and the last texel along x, y and z that count; None where all products are 0.
    """
    found = []
    for axis in AXES:
        one, other = (np.any(used[name], axis=0 if name[0] == axis else 1) for name in SPACE_PLANES if axis in name)
        found.append(np.flatnonzero(one & other))
    if not all(map(len, found)):
        return None
    return np.array([[texels[0], texels[-1]] for texels in found])
