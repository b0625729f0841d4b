"""Work on a GPU that is done over and over, recorded once and then replayed: its kernels start one after the other, and none waits until
Python has named it. (CUDA graphs, https://pytorch.org/blog/accelerating-pytorch-with-cuda-graphs.)"""

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

Work = Callable[..., Tensor]
"""Of tensors on the device, with no host in between: leaves gradients with parameters and returns a tensor."""


@dataclass(frozen=True)
class CapturedGraph:
    """What was recorded: it reads `inputs` and writes `result` and `gradients`, always the same memory."""

    graph: torch.cuda.CUDAGraph
    inputs: list[Tensor]
    result: Tensor
    gradients: list[Tensor | None]


class GraphCache:
    """Does work that a key names: as it is when the key, with inputs of such shapes, comes up first, then recorded.

    A key has to tell all else that work goes by.
    """

    MOST = 8
    """Recordings kept. When there would be more, all are dropped: what steps are like has changed."""

    def __init__(self, parameters: Sequence[torch.nn.Parameter]) -> None:
        """`parameters`: all that work may give a gradient to."""
        self.parameters = list(parameters)
        self._seen: set[Hashable] = set()
        self._recordings: dict[Hashable, CapturedGraph] = {}

    def run(self, key: Hashable, inputs: Sequence[Tensor], work: Work) -> Tensor:
        """work(*inputs), with parameters that have no gradient yet. The result, and gradients, hold until the next call."""
        key = key, tuple(value.shape for value in inputs)
        if key not in self._recordings:
            if key not in self._seen:
                self._seen.add(key)
                return work(*inputs)
            self._recordings[key] = self._recorded(inputs, work)
        recording = self._recordings[key]
        for there, value in zip(recording.inputs, inputs, strict=True):
            there.copy_(value, non_blocking=True)
        recording.graph.replay()  # type: ignore[no-untyped-call]
        for parameter, gradient in zip(self.parameters, recording.gradients, strict=True):
            parameter.grad = gradient
        return recording.result

    def _recorded(self, inputs: Sequence[Tensor], work: Work) -> CapturedGraph:
        if len(self._recordings) >= self.MOST:
            self._recordings.clear()
            self._seen.clear()
        pool = next(iter(self._recordings.values())).graph.pool() if self._recordings else None  # type: ignore[no-untyped-call]
        graph, there = torch.cuda.CUDAGraph(), [value.to(self.parameters[0].device, copy=True) for value in inputs]
        with torch.cuda.graph(graph, pool=pool):  # one pool: what one leaves there is used before the next begins
            result = work(*there)
        return CapturedGraph(graph, there, result, [parameter.grad for parameter in self.parameters])
