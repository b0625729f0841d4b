"""CUDA graphs: repeated work on a GPU is captured once and then replayed, without Python launching each operation.

See https://pytorch.org/blog/accelerating-pytorch-with-cuda-graphs.
"""

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

# A function of tensors on the device that never waits for it, leaves gradients with parameters and returns a tensor.
Work = Callable[..., Tensor]


@dataclass(frozen=True)
class CapturedGraph:
    """A captured graph, which reads `inputs` and writes `result` and `gradients`, always the same memory."""

    graph: torch.cuda.CUDAGraph
    inputs: list[Tensor]
    result: Tensor
    gradients: list[Tensor | None]


class GraphCache:
    """Runs work by key: eagerly the first time that a key comes with inputs of certain shapes, captured from then on.

    A key identifies everything that the work depends on besides its inputs and the parameters.

    Attributes:
        captured: graphs by key and shapes.
    """

    # Graphs kept. When there would be more, all are dropped: what steps are like has changed.
    MOST = 8

    def __init__(self, parameters: Sequence[torch.nn.Parameter]) -> None:
        """`parameters`: all that work may give a gradient to."""
        self.parameters = list(parameters)
        self.captured: dict[Hashable, CapturedGraph] = {}
        self._known: set[Hashable] = set()

    def run(self, key: Hashable, inputs: Sequence[Tensor], work: Work) -> Tensor:
        """Return work(*inputs); parameters have no gradient before. Result and gradients hold until the next call."""
        key = key, tuple(value.shape for value in inputs)
        if key not in self.captured:
            if key not in self._known:
                self._known.add(key)
                return work(*inputs)
            self.captured[key] = self._capture(inputs, work)
        captured = self.captured[key]
        for memory, value in zip(captured.inputs, inputs, strict=True):
            memory.copy_(value, non_blocking=True)
        captured.graph.replay()  # type: ignore[no-untyped-call]
        for parameter, gradient in zip(self.parameters, captured.gradients, strict=True):
            parameter.grad = gradient
        return captured.result

    def _capture(self, inputs: Sequence[Tensor], work: Work) -> CapturedGraph:
        if len(self.captured) >= self.MOST:
            self.captured.clear()
            self._known.clear()
        # All graphs share one memory pool: what one leaves there has been used before the next begins.
        pool = next(iter(self.captured.values())).graph.pool() if self.captured else None  # type: ignore[no-untyped-call]
        graph, memory = torch.cuda.CUDAGraph(), [value.to(self.parameters[0].device, copy=True) for value in inputs]
        with torch.cuda.graph(graph, pool=pool):
            result = work(*memory)
        return CapturedGraph(graph, memory, result, [parameter.grad for parameter in self.parameters])
