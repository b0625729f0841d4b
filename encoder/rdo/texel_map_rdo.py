"""Which texels of a time plane are told, where a map says so: those that are worth what it takes to tell them, and to tell where they are.

A texel that is not told is 1. Whether one is told costs bits too (`kpc.format.coding.texel_map.code_map`), few where it is as those around it, many
where it is alone. So those are sought that make least of

    sum of channels * (worth * (how far it is from 1)^2 in the mean over channels) over texels that are not told
        + channels * UNCHANGED for each that is + MAP_LAM * bits of the map

one after the other, each where the others now are (iterated conditional modes, Besag, J. R. Statist. Soc. B 48, 1986), with bits as the
map before had them.
"""

import numpy as np
from kpc.format.coding.texel_map import MAP_CONTEXTS
from kpc.format.common.jit import compiled, inlined

IDENTITY_TOLERANCE = 0.6
"""Squared steps, as much as they are worth, in the mean over channels: a texel of a time plane that is nearer to 1 is taken for it. Room and
liam: from 0.2 to 0.8 files are the same, half a percent smaller than where all channels have to be within a step, and identity is a third
of the time planes in place of a quarter."""
MAP_LAM = 1.5
"""Squared steps that a bit of a map is worth. Shelf_hand at 33.4 dB of agreement: maps take a fifth to a quarter less, and files are 1.2 % smaller
than where each texel is judged alone; 1.1 % with 4."""
PASSES = 4
"""Over all texels."""
PRIOR = 0.05 + 0.9 * np.array([context.bit_count() for context in range(MAP_CONTEXTS)]) / (MAP_CONTEXTS - 1).bit_count()
"""How likely texels are told, by context, before any is known: most are as those around them."""
PRIOR_COUNT = 1.0
"""Texels that this counts for."""


def choose_coded_texels(away: np.ndarray, worth: np.ndarray, known: np.ndarray) -> np.ndarray:
    """(H, W) bool: those of the (H, W) `known` texels of a time plane that are told, by how far they are from 1, (H, W, M) in steps, and by
    what errors are worth."""
    far = (worth * away**2).mean(axis=2)
    told = known & (far >= IDENTITY_TOLERANCE)
    gain = (away.shape[2] / MAP_LAM) * (far.astype(np.float64) - IDENTITY_TOLERANCE)
    for _ in range(PASSES):
        _improve(told, known, gain, _bits(told))
    return told


def _bits(told: np.ndarray) -> np.ndarray:
    """(MAP_CONTEXTS, 2) bits of a texel that is not told, and of one that is."""
    contexts = _contexts(told)
    counts = np.bincount(2 * contexts + told.ravel(), minlength=2 * MAP_CONTEXTS).reshape(-1, 2)
    shares = counts + PRIOR_COUNT * np.stack([1 - PRIOR, PRIOR], axis=1)
    bits: np.ndarray = -np.log2(shares / shares.sum(1, keepdims=True))
    return bits


@compiled()
def _contexts(told):
    H, W = told.shape
    contexts = np.empty(H * W, np.int64)
    for y in range(H):
        for x in range(W):
            contexts[y * W + x] = map_context(told, y, x)
    return contexts


@inlined
def map_context(told, y, x):
    """Of `kpc.format.coding.texel_map.code_map`: which of the two texels to the left, of five above and of three above those are told."""
    W = told.shape[1]
    context = 0
    for left in range(1, 3):
        if x >= left and told[y, x - left]:
            context |= 1 << left - 1
    if y > 0:
        for u in range(max(x - 2, 0), min(x + 3, W)):
            if told[y - 1, u]:
                context |= 4 << x + 2 - u
    if y > 1:
        for u in range(max(x - 1, 0), min(x + 2, W)):
            if told[y - 2, u]:
                context |= 128 << x + 1 - u
    return context


@compiled()
def _improve(told, known, gain, bits):
    """Of each `known` texel, whether it is `told`, anew: it is where its gain, in bits, is more than the bits that it adds to the map."""
    H, W = told.shape
    for y in range(H):
        for x in range(W):
            if known[y, x]:
                told[y, x] = False
                without = _bits_around(told, y, x, bits)
                told[y, x] = True
                told[y, x] = _bits_around(told, y, x, bits) - gain[y, x] < without


@inlined
def _bits_around(told, y, x, bits):
    """Of a texel and of those whose contexts it is in."""
    H, W = told.shape
    total = 0.0
    for v in range(y, min(y + 3, H)):
        first, last = (x, x + 2) if v == y else (x - 2, x + 2) if v == y + 1 else (x - 1, x + 1)
        for u in range(max(first, 0), min(last + 1, W)):
            total += bits[map_context(told, v, u), 1 if told[v, u] else 0]
    return total
