"""Choice of the coded texels of a time plane, and so of its significance map, by rate and distortion.

A texel that is not coded is 1, the identity. Whether a texel is coded takes bits, too, in the significance map
(`kpc.encoder.coding.texel_map.code_map`): few where the texels around it are alike, many where it differs. So the map
is sought that minimises J = D + lambda R,

    sum over texels that are not coded of the sum over channels of weight * (distance from 1)^2
        + channels * IDENTITY_TOLERANCE for each coded texel + MAP_LAM * bits of the map

texel by texel, each with all others fixed (iterated conditional modes, Besag, J. R. Statist. Soc. B 48, 1986), with
bits estimated from the map of the pass before.
"""

import numpy as np

from kpc.encoder.coding.texel_map import MAP_CONTEXTS
from kpc.jit import compiled, inlined

# Figures behind these constants: docs/design/rate-distortion.md, "Significance maps".
IDENTITY_TOLERANCE = 0.6  # weighted squared steps, mean over channels, up to which a texel becomes the identity
MAP_LAM = 1.5  # lambda of the map: squared steps per bit
PASSES = 4  # over all texels
# Prior probability that a texel is coded, by context: most texels are like those around them. It counts as PRIOR_COUNT
# observations.
PRIOR = 0.05 + 0.9 * np.array([context.bit_count() for context in range(MAP_CONTEXTS)]) / (MAP_CONTEXTS - 1).bit_count()
PRIOR_COUNT = 1.0


def choose_coded_texels(away: np.ndarray, weight: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Choose the coded texels of a time plane.

    Args:
        away: (H, W, M), distance of each value from 1 in steps.
        weight: (H, W, M) distortion weights.
        known: (H, W) bool, texels that are looked up; only these may be coded.

    Returns:
        (H, W) bool.
    """
    distance = (weight * away**2).mean(axis=2)
    coded = known & (distance >= IDENTITY_TOLERANCE)
    gain = (away.shape[2] / MAP_LAM) * (distance.astype(np.float64) - IDENTITY_TOLERANCE)
    for _ in range(PASSES):
        _improve(coded, known, gain, _map_bits(coded))
    return coded


def _map_bits(coded: np.ndarray) -> np.ndarray:
    """Return the bits (MAP_CONTEXTS, 2) of a texel that is not coded, and of one that is, by context."""
    contexts = _contexts(coded)
    counts = np.bincount(2 * contexts + coded.ravel(), minlength=2 * MAP_CONTEXTS).reshape(-1, 2)
    shares = counts + PRIOR_COUNT * np.stack([1 - PRIOR, PRIOR], axis=1)
    bits: np.ndarray = -np.log2(shares / shares.sum(1, keepdims=True))
    return bits


@compiled()
def _contexts(coded):
    H, W = coded.shape
    contexts = np.empty(H * W, np.int64)
    for y in range(H):
        for x in range(W):
            contexts[y * W + x] = map_context(coded, y, x)
    return contexts


@inlined
def map_context(coded, y, x):
    """Return the context of a texel as in `kpc.encoder.coding.texel_map.code_map`: a bit for each coded neighbour.

    These are two texels to the left, five above and three in the row above those.
    """
    W = coded.shape[1]
    context = 0
    for left in range(1, 3):
        if x >= left and coded[y, x - left]:
            context |= 1 << left - 1
    if y > 0:
        for u in range(max(x - 2, 0), min(x + 3, W)):
            if coded[y - 1, u]:
                context |= 4 << x + 2 - u
    if y > 1:
        for u in range(max(x - 1, 0), min(x + 2, W)):
            if coded[y - 2, u]:
                context |= 128 << x + 1 - u
    return context


@compiled()
def _improve(coded, known, gain, bits):
    """Update each known texel: it is coded where its gain, in bits, exceeds the bits that it adds to the map."""
    H, W = coded.shape
    for y in range(H):
        for x in range(W):
            if known[y, x]:
                coded[y, x] = False
                without = _bits_around(coded, y, x, bits)
                coded[y, x] = True
                coded[y, x] = _bits_around(coded, y, x, bits) - gain[y, x] < without


@inlined
def _bits_around(coded, y, x, bits):
    """Return the bits of a texel and of those whose contexts it is part of."""
    H, W = coded.shape
    total = 0.0
    for v in range(y, min(y + 3, H)):
        first, last = (x, x + 2) if v == y else (x - 2, x + 2) if v == y + 1 else (x - 1, x + 1)
        for u in range(max(first, 0), min(last + 1, W)):
            total += bits[map_context(coded, v, u), 1 if coded[v, u] else 0]
    return total
