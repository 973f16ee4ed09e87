"""Skip steps whose gradients are not finite, which would spread to all Gaussians."""

from __future__ import annotations

import torch
from jaxtyping import Float
from nerfstudio.engine.optimizers import Optimizers
from torch import Tensor, nn

from shellgs_method.machine.constants import constant

MAX_SKIPPED = 10
"""Most steps of a run that may be skipped."""
_NOT_CHECKED = "features_rest"
"""Four fifths of a Gaussian's numbers, with the gradients of ``features_dc`` times the harmonics."""


class GuardedOptimizers(Optimizers):
    """Nerfstudio's optimizers, which skip steps whose gradients are not finite.

    On a GPU the host does not wait to know: a fused optimizer itself skips a step whose ``found_inf`` is 1.
    """

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self._skipped: list[Float[Tensor, ""]] = []

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

    @property
    def last_skipped(self) -> Float[Tensor, ""]:
        """1 if the last step was skipped, else 0."""
        return self._skipped[-1]

    def skipped(self) -> list[bool]:
        """Whether each of the steps since the last call was skipped, for which the host waits."""
        skipped, self._skipped = self._skipped, []
        return torch.stack(skipped).bool().tolist() if skipped else []

    def optimizer_scaler_step_some(self, grad_scaler, param_groups) -> None:
        """Step all groups or none. An enabled gradient scaler does this by itself."""
        gradients = [
            parameter.grad
            for group, parameters in self.parameters.items()
            if group != _NOT_CHECKED
            for parameter in parameters
            if parameter.grad is not None
        ]
        skipped = next(iter(self.parameters.values()))[0].new_zeros(())
        self._skipped.append(skipped)
        if gradients and not grad_scaler.is_enabled():
            one = constant(1.0, like=skipped)[0]
            torch._amp_foreach_non_finite_check_and_unscale_(gradients, skipped, one)  # pyright: ignore
            for optimizer in self.optimizers.values():
                optimizer.found_inf = skipped  # pyright: ignore[reportAttributeAccessIssue]
            if not all(each.defaults.get("fused") for each in self.optimizers.values()) and skipped.item():
                return
        super().optimizer_scaler_step_some(grad_scaler, param_groups)
