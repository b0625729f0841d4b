"""Which texels of a time plane are coded."""

import numpy as np
import pytest

from kpc.encoder.coding.rans import SCALE, code_bit_adaptive, new_models
from kpc.encoder.coding.texel_map import MAP_CONTEXTS, code_map
from kpc.encoder.rdo.texel_map_rdo import IDENTITY_TOLERANCE, MAP_LAM, choose_coded_texels, map_context


def bits_of(coded):
    """Return the bits of a significance map in a file."""
    trace = np.empty(coded.size, np.int16)
    code_map(coded.copy(), 0, 0, None, trace)
    return -np.log2(np.where(trace > 0, trace, SCALE + trace) / SCALE).sum()


def noisy(seed, channels=4):
    """Return a plane with a changing disc and a few isolated texels: distance from 1 in steps, and known texels."""
    rng = np.random.default_rng(seed)
    y, x = np.indices((40, 60))
    far = np.where((y - 20) ** 2 + (x - 25) ** 2 < 150, 1.0, 0.55) * np.exp(0.25 * rng.standard_normal(y.shape))
    return far[..., None] * rng.choice([-1.0, 1.0], (*y.shape, channels)), rng.random(y.shape) < 0.97


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (7, 1), (2, 2), (9, 14)])
def test_contexts_match_those_of_the_format(shape):
    coded = np.random.default_rng(3).random(shape) < 0.5
    table, expected, at = new_models(MAP_CONTEXTS), np.empty(coded.size, np.int16), 0
    for y, x in np.ndindex(shape):
        _, _, at = code_bit_adaptive(int(coded[y, x]), table, map_context(coded, y, x), 0, at, None, expected)
    trace = np.empty(coded.size, np.int16)
    code_map(coded.copy(), 0, 0, None, trace)
    assert np.array_equal(trace, expected)


def test_optimised_maps_take_fewer_bits_at_lower_cost():
    for seed in range(3):
        away, known = noisy(seed)
        weight = np.ones(away.shape, np.float32)
        far = (away**2).mean(axis=2)
        alone, coded = known & (far >= IDENTITY_TOLERANCE), choose_coded_texels(away, weight, known)
        assert not (coded & ~known).any()

        def cost(chosen, far=far):
            return 4 * np.where(chosen, IDENTITY_TOLERANCE, far).sum() + MAP_LAM * bits_of(chosen)

        assert bits_of(coded) < 0.9 * bits_of(alone) and cost(coded) < cost(alone)


def test_isolated_changes_are_coded_and_the_identity_is_not():
    away = np.zeros((12, 12, 3))
    away[5, 7] = 10.0
    coded = choose_coded_texels(away, np.ones(away.shape, np.float32), np.ones((12, 12), bool))
    assert coded[5, 7] and coded.sum() == 1
