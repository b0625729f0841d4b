"""The significance map of a plane segment: which of its texels are coded (spec/kpc-format.md, "Texel map").

All codecs of plane segments have the same map modes; RAW and ZSTD have no MAP_IMPLIED. That occupancy implies the
maps of space planes saves 0.4 KB a file (shelf_hand, liam).
"""

import numpy as np

from kpc.encoder.coding.rans import code_bit_adaptive, new_models
from kpc.format.container.segments import MAP_ALL, MAP_CODED, MAP_IMPLIED
from kpc.jit import compiled

MAP_CONTEXTS = 1 << 10


def map_mode(coded: np.ndarray, implied: np.ndarray | None) -> int:
    """Return the cheapest mode for a map.

    Args:
        coded: (H, W) bool.
        implied: (H, W) bool, the map that the occupancy implies; None where it is not known.
    """
    if coded.all():
        return MAP_ALL
    return MAP_IMPLIED if implied is not None and np.array_equal(coded, implied) else MAP_CODED


@compiled()
def code_map(coded, state, position, words, trace):
    """Code a (H, W) bool map texel by texel, each in a context of ten coded before: (state, position)."""
    H, W = coded.shape
    models = new_models(MAP_CONTEXTS)
    for y in range(H):
        left, above, higher = 0, 0, 0  # bits of 2 texels left of x, 5 around x one row up, 3 around x two rows up
        for x in range(-2, W):
            above = above << 1 & 31 | (1 if y > 0 and x + 2 < W and coded[y - 1, x + 2] else 0)
            higher = higher << 1 & 7 | (1 if y > 1 and -1 <= x < W - 1 and coded[y - 2, x + 1] else 0)
            if x >= 0:
                bit = 1 if coded[y, x] else 0
                context = higher << 7 | above << 2 | left
                bit, state, position = code_bit_adaptive(bit, models, context, state, position, words, trace)
                coded[y, x] = bit == 1
                left = left << 1 & 3 | bit
        if words is not None and position > words.size:
            break
    return state, position
