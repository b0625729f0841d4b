"""Which texels of a time plane are told."""

import numpy as np
import pytest
from kpc.encoder.rdo.texel_map_rdo import IDENTITY_TOLERANCE, MAP_LAM, choose_coded_texels, map_context
from kpc.format.coding.rans import SCALE, code_bit_adaptive, new_models
from kpc.format.coding.texel_map import MAP_CONTEXTS, code_map


def bits_of(told):
    """That a file takes for a map."""
    trace = np.empty(told.size, np.int16)
    code_map(told.copy(), 0, 0, None, trace)
    return -np.log2(np.where(trace > 0, trace, SCALE + trace) / SCALE).sum()


def noisy(seed, channels=4):
    """A plane in which a disc changes, some of it hardly, and elsewhere a texel or two by chance: how far in steps, and which is known."""
    rng = np.random.default_rng(seed)
    y, x = np.indices((40, 60))
    far = np.where((y - 20) ** 2 + (x - 25) ** 2 < 150, 1.0, 0.55) * np.exp(0.25 * rng.standard_normal(y.shape))
    return far[..., None] * rng.choice([-1.0, 1.0], (*y.shape, channels)), rng.random(y.shape) < 0.97


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (7, 1), (2, 2), (9, 14)])
def test_contexts_are_those_of_the_file(shape):
    told = np.random.default_rng(3).random(shape) < 0.5
    table, expected, at = new_models(MAP_CONTEXTS), np.empty(told.size, np.int16), 0
    for y, x in np.ndindex(shape):
        _, _, at = code_bit_adaptive(int(told[y, x]), table, map_context(told, y, x), 0, at, None, expected)
    trace = np.empty(told.size, np.int16)
    code_map(told.copy(), 0, 0, None, trace)
    assert np.array_equal(trace, expected)


def test_maps_take_fewer_bits_than_they_cost():
    for seed in range(3):
        away, known = noisy(seed)
        worth = np.ones(away.shape, np.float32)
        far = (away**2).mean(axis=2)
        alone, told = known & (far >= IDENTITY_TOLERANCE), choose_coded_texels(away, worth, known)
        assert not (told & ~known).any()

        def cost(chosen, far=far):
            return 4 * np.where(chosen, IDENTITY_TOLERANCE, far).sum() + MAP_LAM * bits_of(chosen)

        assert bits_of(told) < 0.9 * bits_of(alone) and cost(told) < cost(alone)


def test_what_is_far_is_told_even_alone_and_what_is_1_is_not():
    away = np.zeros((12, 12, 3))
    away[5, 7] = 10.0
    told = choose_coded_texels(away, np.ones(away.shape, np.float32), np.ones((12, 12), bool))
    assert told[5, 7] and told.sum() == 1
