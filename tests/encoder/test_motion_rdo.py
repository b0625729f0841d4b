"""Quantisation of a motion grid (`kpc.encoder.rdo.motion_rdo`)."""

import math

import numpy as np
import pytest

from codec_inputs import swaying
from kpc.encoder.coding.motion_codec import encode_motion
from kpc.encoder.evaluation.validation_rays import Fidelity
from kpc.encoder.rdo.motion_rdo import MAX_MULTIPLE, SHARE, coarsen_motion, quantise_motion
from kpc.format.scene.motion import FINEST_STEP
from kpc.format.scene.scene import Scene
from scenes import tiny_scene, with_motion


def errs(scene: Scene, left_out: float = 1e-3):
    """Stand in for rendering: errors grow with the distance from a scene's displacements."""
    return lambda candidate: Fidelity(30.0, left_out + float(np.mean((candidate.motion - scene.motion) ** 2)))


@pytest.mark.parametrize("share", [1e9, 72.0, 12.0, 1.5])
def test_displacements_are_as_coarse_as_the_error_allows(share):
    """`share` of the square of FINEST_STEP; the error of rounding is a twelfth of the square of its step."""
    scene, most = with_motion(tiny_scene()), share * FINEST_STEP**2 / 12 / SHARE
    found = coarsen_motion(scene, np.ones(scene.motion.shape), errs(scene), most)
    symbols = found.motion / np.float32(FINEST_STEP)
    multiple = int(np.gcd.reduce(np.rint(symbols).astype(np.int64), axis=None))
    np.testing.assert_array_equal(symbols, np.rint(symbols))
    assert errs(scene)(found).mse - 1e-3 <= share * FINEST_STEP**2 / 12
    assert math.sqrt(share) / 3 < multiple <= MAX_MULTIPLE or share > 1e6
    assert coarsen_motion(found, np.ones(scene.motion.shape), errs(found), most, own_multiple=MAX_MULTIPLE) is found


@pytest.mark.parametrize("share, expected", [(1e9, 64), (72.0, 8), (12.0, 3), (1.5, 1)])
def test_without_curvature_symbols_are_the_nearest(share, expected):
    scene = with_motion(tiny_scene())
    found = coarsen_motion(scene, None, errs(scene), share * FINEST_STEP**2 / 12 / SHARE)
    step = np.float32(expected * FINEST_STEP)
    np.testing.assert_array_equal(found.motion, np.rint(scene.motion / step) * step)


def test_scenes_without_motion_or_allowed_error_stay_unchanged():
    scene = with_motion(tiny_scene())
    assert coarsen_motion(scene, None, errs(scene), 0.0) is scene
    assert coarsen_motion(scene, None, lambda candidate: Fidelity(math.nan, math.nan), 1e9) is scene
    assert coarsen_motion(tiny_scene(), None, errs(scene), 1e9).motion is None


def test_important_symbols_are_exact_and_others_take_few_bits():
    wanted = swaying(16, 6, 6, 6) / 8
    rounded = np.rint(wanted).astype(np.int16)
    curvature = np.zeros(wanted.shape)
    curvature[:, :, :3] = 1.0
    found = quantise_motion(wanted, curvature)
    assert np.abs(found - wanted)[:, :, :3].mean() < 1.5 * np.abs(rounded - wanted).mean()
    assert len(encode_motion(found.astype(np.int16))) < 0.75 * len(encode_motion(rounded))


def test_important_noise_is_coded_exactly():
    wanted = np.random.default_rng(0).uniform(-3e4, 3e4, (4, 3, 3, 3, 3))
    assert np.abs(quantise_motion(wanted, np.ones(wanted.shape)) - wanted).max() < 2.5


def test_symbols_stay_within_16_bits():
    wanted = np.where(np.random.default_rng(0).random((5, 3, 3, 3, 3)) < 0.5, -32768.4, 32767.4)
    found = quantise_motion(wanted, np.ones(wanted.shape))
    assert found.min() >= -32768 and found.max() <= 32767
