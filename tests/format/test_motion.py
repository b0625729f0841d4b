"""The motion grid: displacement in numpy and PyTorch against the formula, quantisation, and reached cells."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from kpc.encoder.field import sampling
from kpc.format.common.errors import FormatError
from kpc.format.scene.grid import sample_linear
from kpc.format.scene.motion import (
    DISPLACEMENT_LIMIT,
    FINEST_STEP,
    QuantisedMotion,
    _fill_boxes,
    displace,
    quantise_motion,
    reached_cells,
)

RNG = np.random.default_rng(0)


def displace_reference(u: np.ndarray, time: float, offsets: np.ndarray) -> np.ndarray:
    """Return u + the sum over nodes of products of hat functions, clamped, in float64."""
    rows, nz, ny, nx, _ = offsets.shape

    def hats(x: float, size: int) -> np.ndarray:
        return np.maximum(0, 1 - np.abs(x * (size - 1) - np.arange(size)))

    weights = (hats(time, rows), hats(u[2], nz), hats(u[1], ny), hats(u[0], nx))
    return np.clip(u + np.einsum("t,z,y,x,tzyxc->c", *weights, offsets.astype(np.float64)), 0, 1)


@pytest.mark.parametrize("most", [0.05, 2.0])
def test_displacement_equals_the_formula_in_numpy_and_pytorch(most: float) -> None:
    offsets = RNG.uniform(-most, most, (5, 3, 2, 4, 3)).astype(np.float32)
    u = RNG.random((300, 3), np.float32)
    u[:8] = list(np.ndindex(2, 2, 2))
    times = RNG.random(300, np.float32)
    times[:3] = 0, 1, 0.25  # also exactly on rows
    wanted = np.array([displace_reference(*a, offsets) for a in zip(u.astype(np.float64), times, strict=True)])
    ours = np.array([displace(p, sample_linear(offsets, float(t))) for p, t in zip(u, times, strict=True)])
    np.testing.assert_allclose(ours, wanted, atol=1e-6 * (1 + most))
    theirs = sampling.displace(*map(torch.from_numpy, (u, times, offsets))).numpy()
    np.testing.assert_allclose(theirs, wanted, atol=1e-6 * (1 + most))
    clamped = np.mean((wanted == 0) | (wanted == 1))
    assert clamped > 0.2 if most > 1 else clamped < 0.2


def test_the_gradient_in_pytorch_matches_finite_differences() -> None:
    points, times = torch.rand(20, 3, dtype=torch.float64) * 0.6 + 0.2, torch.rand(20, dtype=torch.float64)
    motion = (0.1 * torch.randn(3, 2, 3, 2, 3, dtype=torch.float64)).requires_grad_()
    assert torch.autograd.gradcheck(lambda motion: sampling.displace(points, times, motion), (motion,))


@pytest.mark.parametrize("most", [1e-9, 0.1, 3.0, DISPLACEMENT_LIMIT / 2])
def test_quantisation_error_is_at_most_half_a_step(most: float) -> None:
    offsets = RNG.uniform(-most, most, (3, 2, 2, 2, 3)).astype(np.float32)
    offsets[0, 0, 0, 0] = most, -most, 0
    rounded = quantise_motion(offsets)
    assert rounded.step == FINEST_STEP or most > 32767 * FINEST_STEP
    # Half a step, plus the rounding of the product to float32.
    assert np.abs(rounded.dequantise() - offsets).max() <= rounded.step / 2 + most * 2.0**-23


@pytest.mark.parametrize("multiple", [1, 3, 16])
def test_multiples_of_several_steps_get_a_coarser_step(multiple: int) -> None:
    offsets = np.random.default_rng(0).integers(-30, 30, (2, 3, 2, 2, 3)).astype(np.float32) * np.float32(
        multiple * FINEST_STEP
    )
    rounded = quantise_motion(offsets)
    assert rounded.step == multiple * FINEST_STEP and np.abs(rounded.symbols).max() <= 30
    np.testing.assert_array_equal(rounded.dequantise(), offsets)


def test_the_widest_stored_grid_can_be_quantised_again() -> None:
    widest = QuantisedMotion(np.resize(np.int16([-32768, 32767, 0]), (2, 2, 2, 2, 3)), DISPLACEMENT_LIMIT / 32768)
    again = quantise_motion(widest.dequantise())
    assert again.step == widest.step
    np.testing.assert_array_equal(again.symbols, widest.symbols)


@pytest.mark.parametrize("value", [np.nan, np.inf, np.nextafter(np.float32(-DISPLACEMENT_LIMIT), np.float32(-np.inf))])
def test_displacements_beyond_the_limit_are_refused(value: float) -> None:
    offsets = np.zeros((2, 2, 2, 2, 3), np.float32)
    offsets[1, 1, 0, 1, 2] = value
    with pytest.raises(FormatError, match="motion"):
        quantise_motion(offsets)


@given(seed=st.integers(0, 2**32 - 1), stretch=st.floats(0, 0.9))
@settings(max_examples=30, deadline=None)
def test_no_reached_cell_is_missed(seed: int, stretch: float) -> None:
    """As long as the displacement stretches distances by less than 2."""
    rng = np.random.default_rng(seed)
    nodes = rng.integers(2, 5, 4)
    offsets = rng.uniform(-1, 1, (*nodes, 3)).astype(np.float32)
    offsets *= np.float32(stretch / (6 * max(nodes[1:])))  # the slopes over three axes sum to at most `stretch`
    offsets += rng.uniform(-0.3, 0.3, (nodes[0], 1, 1, 1, 3)).astype(np.float32)  # plus any common motion
    occupancy = rng.random(rng.integers(1, 9, 4)) < 0.1
    reached = reached_cells(occupancy, offsets)
    slots, shape = len(occupancy), np.array(occupancy.shape[1:])
    for slot, *cell in np.argwhere(occupancy):
        for _ in range(5):
            u, time = ((cell + rng.random(3)) / shape)[::-1], (slot + rng.random()) / slots
            reached_u = displace(u.astype(np.float32), sample_linear(offsets, time))
            assert reached[slot][tuple(np.minimum((reached_u[::-1] * shape).astype(int), shape - 1))]


def test_reached_cells_of_an_empty_grid_and_without_motion() -> None:
    still = np.zeros((2, 2, 2, 2, 3), np.float32)
    assert not reached_cells(np.zeros((2, 4, 5, 6), bool), still).any()
    occupancy = np.zeros((1, 8, 8, 8), bool)
    occupancy[0, 3, 4, 5] = True
    assert reached_cells(occupancy, still).sum() == 27


def test_boxes_are_filled() -> None:
    grid = np.zeros((3, 4, 5), bool)
    _fill_boxes(grid, np.array([[0, 1, 2], [2, 3, 4]]), np.array([[1, 1, 4], [2, 3, 4]]))
    assert grid.sum() == 7 and grid[:2, 1, 2:].all() and grid[2, 3, 4]
