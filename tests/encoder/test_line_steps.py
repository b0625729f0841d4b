"""Steps of whole rows and columns: their gradient is that of factors on the planes, and both implementations agree."""

import numpy as np
import pytest
import torch

from kpc.encoder.field import kernels
from kpc.encoder.field.config import TrainConfig
from kpc.encoder.field.field import Field
from kpc.encoder.field.layout import Layout
from kpc.encoder.training.line_steps import LineSteps, line_steps

WORKERS = 3
SPANS = np.array([[[0, 5], [0, 19], [0, 35]], [[2, 4], [3, 20], [0, 33]]])

LAYOUTS = {
    "one that moves": Layout.of(np.array([[5, 19, 35, 0], [2, 2, 2, 0], [4, 4, 4, 2]]), 8),
    "an area": Layout.of(np.array([[5, 19, 35, 0], [9, 33, 40, 4]]), 3, SPANS),
}


@pytest.fixture(params=LAYOUTS)
def lines(request: pytest.FixtureRequest) -> LineSteps:
    field = Field(LAYOUTS[request.param], 16, torch.Generator().manual_seed(0))
    return LineSteps(field, TrainConfig())


def some_gradient(lines: LineSteps) -> np.ndarray:
    return np.random.default_rng(1).normal(size=(WORKERS, lines.field.layout.size)).astype(np.float32)


def test_the_gradient_is_that_of_factors_on_rows_and_columns(lines: LineSteps) -> None:
    """The loss, in float64, is the sum of sin(3 P (1 + row)(1 + column)) times a weight for each texel."""
    field, layout = lines.field, lines.field.layout
    theta = field.theta.detach().double().requires_grad_()
    weights = torch.randn(layout.size, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    loss, factors = torch.zeros((), dtype=torch.float64), []
    for scale, _, start, rows, columns in layout.planes():
        if layout.resolution[scale, 3]:
            continue
        shapes = (rows, layout.channels), (columns, layout.channels)
        row, column = (torch.zeros(*shape, dtype=torch.float64, requires_grad=True) for shape in shapes)
        size = rows * columns * layout.channels
        texels = theta[start : start + size].view(rows, columns, -1) * (1 + row[:, None]) * (1 + column)
        loss = loss + (weights[start : start + size] * torch.sin(3 * texels).reshape(-1)).sum()
        factors += [row, column]
    loss.backward()
    field.theta.grad = theta.grad.float()
    expected = torch.cat([factor.grad for factor in factors])
    assert expected.abs().median() > 0.5
    torch.testing.assert_close(lines.gradient().detach().double(), expected, rtol=1e-4, atol=1e-5)


def test_the_kernels_equal_pytorch(lines: LineSteps) -> None:
    field, layout, grad = lines.field, lines.field.layout, some_gradient(lines)
    field.theta.grad = torch.from_numpy(grad.sum(0))
    with torch.no_grad():
        torch.testing.assert_close(lines.gradient_by_kernel(grad), lines.gradient(), rtol=1e-4, atol=1e-5)
        lines.factors.copy_(0.3 * torch.randn(lines.factors.shape, generator=torch.Generator().manual_seed(3)))
        scaled = field.theta.numpy().copy()
        kernels.scale_lines(scaled, lines.factors.numpy(), layout.line_blocks, layout.channels)
        lines.scale()
    torch.testing.assert_close(torch.from_numpy(scaled), field.theta.detach(), rtol=1e-6, atol=0)


def test_a_step_moves_each_line_by_the_rate_against_its_gradient(lines: LineSteps) -> None:
    """The first step of Adam is the learning rate times the sign of the gradient."""
    field, before = lines.field, lines.field.theta.detach().clone()
    grad = some_gradient(lines)
    signs = lines.gradient_by_kernel(grad).sign()
    lines.step(0.5, grad)
    config = TrainConfig()
    rate = 0.5 * config.line_rate * config.learning_rate
    line = 0
    for scale, _, start, rows, columns in field.layout.planes():
        part = slice(start, start + rows * columns * field.layout.channels)
        factor = 1.0
        if not field.layout.resolution[scale, 3]:
            row, column = signs[line : line + rows, None], signs[line + rows : line + rows + columns]
            factor = ((1 - rate * row) * (1 - rate * column)).reshape(-1)
            line += rows + columns
        torch.testing.assert_close(field.theta.detach()[part], before[part] * factor, rtol=1e-5, atol=0)


def test_a_rate_of_0_changes_no_texel(lines: LineSteps) -> None:
    before = lines.field.theta.detach().clone()
    lines.step(0.0, some_gradient(lines))
    assert torch.equal(lines.field.theta.detach(), before)


def test_a_run_that_goes_on_from_its_state_ends_the_same(lines: LineSteps) -> None:
    field, grad = lines.field, some_gradient(lines)
    lines.step(1.0, grad)
    kept, at = lines.state(), field.theta.detach().clone()
    other = LineSteps(field, TrainConfig())
    other.load(kept)
    lines.step(1.0, grad[::-1] * 2)
    ended = field.theta.detach().clone()
    with torch.no_grad():
        field.theta.copy_(at)
    other.step(1.0, grad[::-1] * 2)
    assert torch.equal(field.theta.detach(), ended)


def test_only_scales_without_space_time_planes_among_others_have_lines() -> None:
    for rows in (0, 4):  # of a scene that does not move, and of one that does everywhere
        field = Field(Layout.of(np.array([[5, 19, 35, rows]]), 3), 16, torch.Generator().manual_seed(0))
        assert line_steps(field, TrainConfig()) is None
    mixed = Field(LAYOUTS["an area"], 16, torch.Generator().manual_seed(0))
    found = line_steps(mixed, TrainConfig())
    assert found is not None and len(found.factors) == 2 * (5 + 19 + 35)
    assert line_steps(mixed, TrainConfig(line_rate=0.0)) is None
