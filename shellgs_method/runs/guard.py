"""Skip steps whose gradients are not finite, which would spread to all Gaussians."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Float
from nerfstudio.engine.optimizers import Optimizers
from torch import Tensor, nn
from torch.optim.lr_scheduler import LambdaLR

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

    def load_optimizers(self, loaded_state: Mapping[str, Any]) -> None:
        """Load the moments of a checkpoint; learning rates and other settings stay those of this run."""
        for name, state in loaded_state.items():
            optimizer = self.optimizers[name]
            ours = optimizer.state_dict()["param_groups"]
            groups = [then | now for then, now in zip(state["param_groups"], ours, strict=True)]
            optimizer.load_state_dict(state | {"param_groups": groups})

    def load_schedulers(self, loaded_state: Mapping[str, Any]) -> None:
        """Load how far the schedules of a checkpoint are; where they begin and end stays as in this run."""
        for name, state in loaded_state.items():
            scheduler = self.schedulers[name]
            scheduler.load_state_dict(state | {"base_lrs": scheduler.base_lrs})
            rates = scheduler.get_last_lr()
            if isinstance(scheduler, LambdaLR):  # others know their rate as a multiple of the last one only
                pairs = zip(scheduler.base_lrs, scheduler.lr_lambdas, strict=True)
                rates = [base * share(scheduler.last_epoch) for base, share in pairs]
            for group, rate in zip(scheduler.optimizer.param_groups, rates, strict=True):
                group["lr"] = rate
