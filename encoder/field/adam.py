"""Adam on a CPU without TorchDynamo, which the first object of `torch.optim` imports for 1.4 s."""

from typing import Any

import torch
from torch.optim.adam import adam


class Adam:
    """PyTorch's Adam for parameters on a CPU, with the part of the interface of `torch.optim.Adam` that training uses.

    Attributes:
        param_groups: for each group its "params", "lr" and what else it was given, as in `torch.optim`.
    """

    def __init__(
        self, groups: list[dict[str, Any]], betas: tuple[float, float] = (0.9, 0.999), eps: float = 1e-8
    ) -> None:
        given: dict[str, Any] = {"betas": betas, "eps": eps, "weight_decay": 0, "fused": True}
        self.param_groups = [given | group for group in groups]
        self._state: dict[torch.Tensor, dict[str, torch.Tensor]] = {}

    def zero_grad(self) -> None:
        """Remove all gradients."""
        for group in self.param_groups:
            for parameter in group["params"]:
                parameter.grad = None

    @torch.no_grad()
    def step(self) -> None:
        """Step all parameters that have a gradient."""
        for group in self.param_groups:
            parameters = [parameter for parameter in group["params"] if parameter.grad is not None]
            states = [self._state_of(parameter) for parameter in parameters]
            adam(
                parameters,
                [parameter.grad.contiguous() for parameter in parameters],  # `fused` reads them as if they were
                [state["exp_avg"] for state in states],
                [state["exp_avg_sq"] for state in states],
                [],
                [state["step"] for state in states],
                fused=group["fused"],
                amsgrad=False,
                beta1=group["betas"][0],
                beta2=group["betas"][1],
                lr=group["lr"],
                weight_decay=0,
                eps=group["eps"],
                maximize=False,
            )

    def state_dict(self) -> dict[str, Any]:
        """Return the state in the layout of `torch.optim`, which numbers the parameters."""
        numbers = {parameter: number for number, parameter in enumerate(self._parameters())}
        groups = [group | {"params": [numbers[each] for each in group["params"]]} for group in self.param_groups]
        return {"state": {numbers[each]: state for each, state in self._state.items()}, "param_groups": groups}

    def load_state_dict(self, found: dict[str, Any]) -> None:
        """Take over a copy of what `state_dict` returned, here or of `torch.optim.Adam`."""
        parameters = self._parameters()
        self._state = {
            parameters[number]: {name: torch.as_tensor(value).clone() for name, value in state.items()}
            for number, state in found["state"].items()
        }
        self.param_groups = [
            group | saved | {"params": group["params"]}
            for saved, group in zip(found["param_groups"], self.param_groups, strict=True)
        ]

    def _parameters(self) -> list[torch.Tensor]:
        return [parameter for group in self.param_groups for parameter in group["params"]]

    def _state_of(self, parameter: torch.Tensor) -> dict[str, torch.Tensor]:
        if parameter not in self._state:
            self._state[parameter] = {
                "step": torch.zeros((), dtype=torch.float32),
                "exp_avg": torch.zeros_like(parameter),
                "exp_avg_sq": torch.zeros_like(parameter),
            }
        return self._state[parameter]
