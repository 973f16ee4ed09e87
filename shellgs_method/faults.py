"""Steps whose gradients are no numbers: left out, rather than spread over all Gaussians."""

from __future__ import annotations

from typing import Any

import torch
from gsplat.strategy.ops import remove
from nerfstudio.engine.optimizers import Optimizers
from torch import Tensor, nn

MAX_FAULTS = 10
"""Steps of a run that may be left out."""
_NOT_SUMMED = "features_rest"
"""Four fifths of a Gaussian's numbers, whose gradients are those of ``features_dc`` times the harmonics."""


class GuardedOptimizers(Optimizers):
    """Nerfstudio's optimizers, which take no step on gradients that are no numbers."""

    left_out = False
    """Whether the last step was left out."""

    def optimizer_scaler_step_some(self, grad_scaler, param_groups) -> None:
        """Step the groups, or none of them. A gradient scaler that is on does this by itself."""
        self.left_out = not grad_scaler.is_enabled() and not self._gradients_are_numbers()
        if self.left_out:
            self.zero_grad_all()
        else:
            super().optimizer_scaler_step_some(grad_scaler, param_groups)

    def _gradients_are_numbers(self) -> bool:
        """By their sum, which costs one look at each."""
        gradients = [
            parameter.grad.sum()
            for group, parameters in self.parameters.items()
            if group != _NOT_SUMMED
            for parameter in parameters
            if parameter.grad is not None
        ]
        return not gradients or bool(torch.stack(gradients).sum().isfinite())


def forget_gradients(info: dict[str, Any]) -> None:
    """Let densification see no gradients of a rendering."""
    for key in ("means2d", "gradient_2dgs"):
        if isinstance(rendered := info.get(key), Tensor) and rendered.grad is not None:
            rendered.grad.zero_()


def remove_broken(
    gaussians: nn.ParameterDict, optimizers: dict[str, torch.optim.Optimizer], state: dict[str, Any]
) -> int:
    """Take out Gaussians with a parameter that is no number; how many these were. All stay where none is whole."""
    if all(bool(parameter.detach().sum().isfinite()) for parameter in gaussians.values()):
        return 0
    broken: Tensor = sum(  # pyright: ignore[reportAssignmentType]
        (~parameter.detach().flatten(1).isfinite().all(dim=1)).long() for parameter in gaussians.values()
    )
    broken = broken > 0
    if not broken.all():
        remove(gaussians, optimizers, state, broken)  # pyright: ignore[reportArgumentType]
    return int(broken.sum())
