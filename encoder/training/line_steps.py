"""Steps that whole rows and columns of planes take together, besides those that each texel takes by itself.

Adam moves each texel by its own gradient, so what a row of texels has in common is found no sooner than what they have
not. A factor 1 + a on a row or column has the gradient

    dL/da = sum over its texels of P dL/dP        (at a = 0),

one for each channel. Each step is a step of Adam on all a from 0, which the planes then take over: P (1 + a).

Scales of six planes do without: a space-time plane is such a factor on all that has the same x, y or z. Scenes that do
not move gain nothing either (docs/design/training.md).
"""

import functools
from typing import Any

import numpy as np
import torch

from kpc.encoder.field import kernels
from kpc.encoder.field.config import TrainConfig
from kpc.encoder.field.field import Field
from kpc.encoder.training.optimisers import make_adam, set_rate


def line_steps(field: Field, config: TrainConfig) -> "LineSteps | None":
    """Return the steps of lines for a field; None where there are none."""
    return LineSteps(field, config) if config.line_rate and field.layout.lined_planes else None


class LineSteps:
    """Adam on factors of rows and columns of a field's planes.

    Attributes:
        factors: (lines, M), of each plane those of its rows, then those of its columns.
    """

    def __init__(self, field: Field, config: TrainConfig) -> None:
        self.field = field
        self.factors = torch.nn.Parameter(torch.zeros(field.layout.lines, field.layout.channels).to(field.theta))
        self.adam = make_adam([([self.factors], config.line_rate * config.learning_rate)])

    @functools.cached_property
    def _planes_of_blocks(self) -> list[tuple[int, int, int, int, int]]:
        """For each plane its first line, its rows and columns, its first block and the one after its last."""
        blocks = self.field.layout.line_blocks
        lines, starts = np.unique(blocks[:, 5], return_index=True)
        ends = [*starts[1:].tolist(), len(blocks)]
        return [
            (line, int(blocks[first, 4]), int(blocks[first, 3]), first, last)
            for line, first, last in zip(lines.tolist(), starts.tolist(), ends, strict=True)
        ]

    @torch.no_grad()
    def step(self, rate: float, grad: np.ndarray | None = None) -> None:
        """Do one step, at a share of the peak learning rate.

        Args:
            grad: (workers, n) float32, whose sum is the gradient of theta (n,); None where PyTorch holds it. On a CPU.
        """
        field = self.field
        on_cpu = field.theta.device.type == "cpu"
        if grad is None and on_cpu:
            assert field.theta.grad is not None
            grad = field.theta.grad.numpy()[None]
        found = self.gradient() if grad is None else self.gradient_by_kernel(grad)
        # What is not finite would spread along whole lines, and the error could not name the plane that it came from.
        self.factors.grad = found.nan_to_num(0.0, 0.0, 0.0)
        set_rate(self.adam, rate)
        self.factors.zero_()
        self.adam.step()
        if on_cpu:
            layout = field.layout
            kernels.scale_lines(field.theta.numpy(), self.factors.numpy(), layout.line_blocks, layout.channels)
        else:
            self.scale()

    def gradient_by_kernel(self, grad: np.ndarray) -> torch.Tensor:
        """Return what `gradient` does, of a gradient as in `step`."""
        layout = self.field.layout
        blocks, M = layout.line_blocks, layout.channels
        found = np.zeros((layout.lines, M), np.float32)
        parts = np.zeros((len(blocks), int(blocks[:, 3].max()) * M), np.float32)
        kernels.line_gradients(self.field.theta.detach().numpy(), grad, blocks, M, found, parts)
        for line, rows, columns, first, last in self._planes_of_blocks:
            found[line + rows : line + rows + columns] = parts[first:last, : columns * M].sum(0).reshape(columns, M)
        return torch.from_numpy(found)

    def gradient(self) -> torch.Tensor:
        """Return the gradient of the factors, (lines, M)."""
        found = []
        for each, grad in zip(self._planes(self.field.theta), self._planes(self.field.theta.grad), strict=True):
            product = each * grad
            found += [product.sum(1), product.sum(0)]
        return torch.cat(found)

    def scale(self) -> None:
        """Multiply the planes by their rows' and columns' factors."""
        line = 0
        for each in self._planes(self.field.theta):
            rows, columns, _ = each.shape
            each *= 1 + self.factors[line : line + rows, None]
            each *= 1 + self.factors[line + rows : line + rows + columns]
            line += rows + columns

    def _planes(self, values: torch.Tensor | None) -> list[torch.Tensor]:
        """Return views (rows, columns, M) of the planes in values (n,)."""
        assert values is not None
        M = self.field.layout.channels
        return [
            values[start : start + rows * columns * M].view(rows, columns, M)
            for start, rows, columns in self.field.layout.lined_planes
        ]

    def state(self) -> dict[str, Any]:
        """Return what a checkpoint holds of this."""
        return self.adam.state_dict()

    def load(self, state: dict[str, Any]) -> None:
        """Take over what `state` returned."""
        self.adam.load_state_dict(state)
