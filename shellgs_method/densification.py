"""Densification as Markov chain Monte Carlo (Kheradmand et al. 2024) in plain torch, on any device.

gsplat's ``MCMCStrategy`` calls CUDA kernels for the relocation and for the covariances of the noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from gsplat.strategy import Strategy
from gsplat.strategy.ops import _multinomial_sample, _update_param_with_optimizer
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.optim import Optimizer

from shellgs_method.rasterizer import quats_to_rotations

MAX_COPIES = 51
"""Most Gaussians that one is divided into at a time, as in the authors' code: more would change nothing visible."""


@dataclass(frozen=True)
class MCMCConfig:
    """Densification as Markov chain Monte Carlo, with its authors' numbers."""

    cap_max: int = 1_000_000
    """Most Gaussians; SfM points beyond it are left out."""
    noise: float = 5e5
    """Size of the noise on the centres."""
    opacity: float = 0.01
    """Weight of the mean opacity, which makes Gaussians that are not needed fade."""
    scale: float = 0.01
    """Weight of the mean scale."""


@dataclass
class MCMCStrategy(Strategy):
    """Gaussians too faint to see are moved to where others are, some are added up to a cap, and all are shaken.

    The numbers are the authors'. Neither moving nor adding changes the image: a Gaussian is divided into copies in
    its place that together are what it was.
    """

    cap_max: int
    """Most Gaussians."""
    refine_start_iter: int
    refine_stop_iter: int
    refine_every: int
    noise: float = 5e5
    """Size of the noise on the centres, as a multiple of their learning rate and covariance."""
    min_opacity: float = 0.005
    """A Gaussian of this opacity or less is moved."""
    growth: float = 0.05
    """Share of Gaussians that are added at a time."""

    def initialize_state(self, scene_scale: float = 1.0) -> dict[str, Any]:
        """Nothing is carried from step to step."""
        del scene_scale
        return {}

    @torch.no_grad()
    def step_post_backward(
        self,
        params: nn.ParameterDict,
        optimizers: dict[str, Optimizer],
        state: dict[str, Any],
        step: int,
        info: dict[str, Any],
        packed: bool = False,
    ) -> None:
        """Move, add and shake, after the optimizers' step."""
        del state, info, packed
        in_window = self.refine_start_iter < step < self.refine_stop_iter
        if in_window and step % self.refine_every == 0:
            self._move(params, optimizers)
            self._add(params, optimizers)
        means = params["means"]
        shake = self.noise * optimizers["means"].param_groups[0]["lr"]
        # Opaque Gaussians stay where they are: the factor falls from 1 to 0 around an opacity of 0.005.
        faint = torch.sigmoid(100 * (0.005 - params["opacities"].sigmoid()))
        axes = quats_to_rotations(params["quats"]) * params["scales"].exp()[:, None]
        means += shake * faint * (axes @ (axes.mT @ torch.randn_like(means)[..., None])).squeeze(-1)

    def _move(self, params: nn.ParameterDict, optimizers: dict[str, Optimizer]) -> None:
        opacities = params["opacities"].sigmoid().flatten()
        dead = (opacities <= self.min_opacity).nonzero().squeeze(1)
        if 0 < len(dead) < len(opacities):
            chances = opacities.index_fill(0, dead, 0.0)
            self._divide(params, optimizers, _multinomial_sample(chances, len(dead)), dead)

    def _add(self, params: nn.ParameterDict, optimizers: dict[str, Optimizer]) -> None:
        count = len(params["means"])
        new = min(self.cap_max, int((1 + self.growth) * count)) - count
        if new > 0:
            _update_param_with_optimizer(
                lambda _, p: nn.Parameter(torch.cat([p, p[:1].expand(new, *p.shape[1:])])),
                lambda _, v: torch.cat([v, v.new_zeros(new, *v.shape[1:])]),
                params,
                optimizers,
            )
            opacities = params["opacities"].sigmoid().flatten()[:count]
            places = torch.arange(count, count + new, device=opacities.device)
            self._divide(params, optimizers, _multinomial_sample(opacities, new), places)

    def _divide(
        self,
        params: nn.ParameterDict,
        optimizers: dict[str, Optimizer],
        sources: Int[Tensor, "M"],
        places: Int[Tensor, "M"],
    ) -> None:
        """Turn each source into itself and its copies, which are written over the Gaussians at ``places``."""
        copies = torch.bincount(sources)[sources] + 1
        opacities = params["opacities"][sources].sigmoid()
        opacity, shrink = relocated(opacities.flatten(), copies.clamp_max(MAX_COPIES))
        eps = torch.finfo(opacity.dtype).eps
        params["opacities"][sources] = opacity.clamp(self.min_opacity, 1 - eps).logit().view_as(opacities)
        params["scales"][sources] += shrink.log()[:, None]
        touched = torch.cat([sources, places])
        for name, parameter in params.items():
            parameter[places] = parameter[sources]
            for moment in optimizers[name].state[parameter].values():
                if moment.dim() > 0:  # not the count of steps
                    moment[touched] = 0


def relocated(opacities: Float[Tensor, "M"], copies: Int[Tensor, "M"]) -> tuple[Float[Tensor, "M"], Float[Tensor, "M"]]:
    """Opacity of each of N copies that are in one place what one Gaussian was, and the factor of their scales.

    o' = 1 - (1 - o)^(1/N), and s'/s = o / Σ_{i=1..N} Σ_{k<i} C(i-1, k) (-1)^k o'^(k+1) / √(k+1) (Kheradmand et al.
    2024, eq. 9). Summed over i first, the binomials are C(N, k+1).
    """
    order = torch.arange(1, MAX_COPIES + 1, dtype=torch.float64, device=opacities.device)
    n = copies.double()[:, None]
    log_binomials = torch.lgamma(n + 1) - torch.lgamma(order + 1) - torch.lgamma((n - order).clamp_min(0) + 1)
    binomials = torch.where(order <= n, log_binomials.exp(), 0.0)
    opacities = opacities.clamp_max(1 - torch.finfo(opacities.dtype).eps)
    opacity = 1 - (1 - opacities.double()) ** (1 / copies.double())
    signs = 1 - 2 * ((order - 1) % 2)
    integral = (signs * binomials * opacity[:, None] ** order / order.sqrt()).sum(dim=-1)
    return opacity.to(opacities.dtype), (opacities / integral).to(opacities.dtype)
