"""Skip steps whose gradients are not finite, which would spread to all Gaussians."""

from __future__ import annotations

from typing import Any

import torch
from nerfstudio.engine.optimizers import Optimizers
from torch import Tensor, nn

MAX_SKIPPED = 10
"""Most steps of a run that may be skipped."""
_NOT_SUMMED = "features_rest"
"""Not checked: four fifths of a Gaussian's numbers, with the gradients of ``features_dc`` times the harmonics."""


class GuardedOptimizers(Optimizers):
    """Nerfstudio's optimizers, which skip steps whose gradients are not finite."""

    skipped = False
    """Whether the last step was skipped."""

    @property
    def parameters(self) -> dict[str, list[nn.Parameter]]:
        """The parameters of each group. Nerfstudio's own list keeps those that densification has replaced since."""
        return {
            name: [parameter for group in optimizer.param_groups for parameter in group["params"]]
            for name, optimizer in self.optimizers.items()
        }

    @parameters.setter
    def parameters(self, _: dict[str, list[nn.Parameter]]) -> None:
        """Nerfstudio sets up its list, which is not needed."""

    def optimizer_scaler_step_some(self, grad_scaler, param_groups) -> None:
        """Step all groups or none. An enabled gradient scaler does this by itself."""
        self.skipped = not grad_scaler.is_enabled() and not self._gradients_are_finite()
        if self.skipped:
            self.zero_grad_all()
        else:
            super().optimizer_scaler_step_some(grad_scaler, param_groups)

    def _gradients_are_finite(self) -> bool:
        """Whether the sum of all gradients is finite, which reads each once."""
        gradients = [
            parameter.grad.sum()
            for group, parameters in self.parameters.items()
            if group != _NOT_SUMMED
            for parameter in parameters
            if parameter.grad is not None
        ]
        return not gradients or bool(torch.stack(gradients).sum().isfinite())


def forget_gradients(info: dict[str, Any]) -> None:
    """Zero the gradients of a rendering that densification accumulates."""
    for key in ("means2d", "gradient_2dgs"):
        if isinstance(rendered := info.get(key), Tensor) and rendered.grad is not None:
            rendered.grad.zero_()
