"""Densification by gradient, also of wide Gaussians and of those far away, and MCMC densification, on any device.

gsplat's ``MCMCStrategy`` needs CUDA kernels for the relocation and for the covariances of the noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from gsplat.strategy import DefaultStrategy, Strategy
from gsplat.strategy.ops import _multinomial_sample, _update_param_with_optimizer, reset_opa
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.optim import Optimizer

from shellgs_method.errors import SceneError
from shellgs_method.render.rasterizer import quats_to_rotations

WIDE = 0.05
"""Radius in a view, in units of its longer side, above which a Gaussian counts as wide."""
MAX_COPIES = 51
"""Maximum number of Gaussians that one is divided into, as in the authors' code: more would make no visible change."""


@dataclass
class GradientStrategy(DefaultStrategy):
    """gsplat's default densification, except that the gradient of wide Gaussians can count more.

    What such a Gaussian blurs pulls it in many directions, which cancel: its gradient is small although its error is
    large (compare AbsGS, Ye et al. 2024).

    When to densify, and when to reset the opacities, is decided here, and so is what is gathered of a view: gsplat 1.4
    resets the opacities at step 0 (its pull request #735), 1.5.3 never does (#776), and each expects radii of its own
    (#629).
    """

    wide_gradient: float = 1.0
    """Factor on the gradient of Gaussians that were wide (:data:`WIDE`) in a view since the last refinement."""

    def initialize_state(self, scene_scale: float = 1.0) -> dict[str, Any]:
        """Return what is gathered from one refinement to the next.

        ``grad2d`` and ``count``: sum of the gradients' norms, and number of views, that show a Gaussian; ``radii``: its
        largest radius in a view, in units of the longer side.
        """
        return {"grad2d": None, "count": None, "radii": None, "scene_scale": scene_scale}

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
        """Gather gradients and radii, refine and reset the opacities when it is time, after the optimizers' step."""
        del packed
        if step >= self.refine_stop_iter:
            return
        self._gather(params, state, info)
        settled = step % self.reset_every >= self.pause_refine_after_reset
        if step > self.refine_start_iter and step % self.refine_every == 0 and settled:
            self._grow_gs(params, optimizers, state, step)
            self._prune_gs(params, optimizers, state, step)
            for gathered in ("grad2d", "count", "radii"):
                state[gathered].zero_()
            torch.cuda.empty_cache()  # tensors of other sizes follow
        if step > 0 and step % self.reset_every == 0:
            reset_opa(params, optimizers, state, value=2 * self.prune_opa)

    @torch.no_grad()
    def _gather(self, params: nn.ParameterDict, state: dict[str, Any], info: dict[str, Any]) -> None:
        """Add gradients, in units of half the image, and radii of a rendering by our rasterizer to the state."""
        centres, radii = info[self.key_for_gradient], info["radii"]
        for gathered in ("grad2d", "count", "radii"):
            if state[gathered] is None:
                state[gathered] = centres.new_zeros(len(params["means"]))
        if radii.shape[1] != len(params["means"]):
            return  # broken ones were removed since, and nobody knows which of these are left
        size = radii.new_tensor([info["width"], info["height"]])
        gradients = (centres.absgrad if self.absgrad else centres.grad) * size / 2 * len(radii)
        state["grad2d"] += torch.where(radii > 0, gradients.norm(dim=-1), 0.0).sum(dim=0)
        state["count"] += (radii > 0).sum(dim=0)
        state["radii"] = state["radii"].maximum(radii.amax(dim=0) / size.amax())

    @torch.no_grad()
    def _grow_gs(
        self,
        params: nn.ParameterDict,
        optimizers: dict[str, Optimizer],
        state: dict[str, Any],
        step: int,
    ) -> tuple[int, int]:
        state["grad2d"][state["radii"] > WIDE] *= self.wide_gradient
        return super()._grow_gs(params, optimizers, state, step)


@dataclass
class SkyboxStrategy(GradientStrategy):
    """Densification by gradient, except that the size above which Gaussians are pruned grows with their distance.

    The cameras are within 1 of the origin. Farther away the limit is that at 1 times the distance, since the Gaussians
    of a skybox are large.
    """

    @torch.no_grad()
    def _prune_gs(
        self,
        params: nn.ParameterDict,
        optimizers: dict[str, Optimizer],
        state: dict[str, Any],
        step: int,
    ) -> int:
        scene_scale = state["scene_scale"]
        state["scene_scale"] = params["means"].norm(dim=-1).clamp_min(1)
        count = super()._prune_gs(params, optimizers, state, step)
        state["scene_scale"] = scene_scale
        return count


@dataclass(frozen=True)
class MCMCConfig:
    """MCMC densification, with the authors' defaults."""

    cap_max: int = 1_000_000
    """Maximum number of Gaussians; further SfM points are ignored."""
    noise: float = 5e5
    """Scale of the noise on the centres."""
    opacity: float = 0.01
    """Weight of the mean opacity, which makes unneeded Gaussians fade."""
    scale: float = 0.01
    """Weight of the mean scale."""


@dataclass
class MCMCStrategy(Strategy):
    """Relocate faint Gaussians onto others, add Gaussians up to a cap, and add noise to all centres.

    The defaults are the authors'. Neither relocation nor addition changes the image: a Gaussian is divided into copies
    at its centre that together look as it did.
    """

    cap_max: int
    """Maximum number of Gaussians."""
    refine_start_iter: int
    refine_stop_iter: int
    refine_every: int
    noise: float = 5e5
    """Scale of the noise on the centres, as a multiple of their learning rate and covariance."""
    min_opacity: float = 0.005
    """Gaussians of this opacity or less are relocated."""
    growth: float = 0.05
    """Share of Gaussians added at each refinement."""

    def initialize_state(self, scene_scale: float = 1.0) -> dict[str, Any]:
        """Return an empty state: nothing is kept between steps."""
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
        """Relocate, add Gaussians and add noise, after the optimizers' step.

        Raises:
            SceneError: all Gaussians are faint, so that there is none to divide.
        """
        del state, info, packed
        in_window = self.refine_start_iter < step < self.refine_stop_iter
        if in_window and step % self.refine_every == 0:
            self._relocate(params, optimizers, step)
            self._add(params, optimizers)
        means = params["means"]
        noise = self.noise * optimizers["means"].param_groups[0]["lr"]
        # Opaque Gaussians get no noise: the factor falls from 1 to 0 around an opacity of 0.005.
        faint = torch.sigmoid(100 * (0.005 - params["opacities"].sigmoid()))
        axes = quats_to_rotations(params["quats"]) * params["scales"].exp()[:, None]
        means += noise * faint * (axes @ (axes.mT @ torch.randn_like(means)[..., None])).squeeze(-1)

    def _relocate(self, params: nn.ParameterDict, optimizers: dict[str, Optimizer], step: int) -> None:
        opacities = params["opacities"].sigmoid().flatten()
        dead = (opacities <= self.min_opacity).nonzero().squeeze(1)
        if 0 < len(dead) == len(opacities):
            raise SceneError(
                f"training stopped at step {step}, because all Gaussians are transparent: lower the learning rate of "
                "the opacities or --pipeline.model.mcmc.opacity; where a checkpoint was saved, --load-dir resumes it"
            )
        if len(dead):
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
        """Divide each source into itself and its copies, which replace the Gaussians at ``places``.

        As in gsplat's operations, new tensors of parameters say that these are no longer the same Gaussians.
        """
        copies = torch.bincount(sources)[sources] + 1
        opacities = params["opacities"][sources].sigmoid()
        opacity, shrink = relocated(opacities.flatten(), copies.clamp_max(MAX_COPIES))
        eps = torch.finfo(opacity.dtype).eps
        params["opacities"][sources] = opacity.clamp(self.min_opacity, 1 - eps).logit().view_as(opacities)
        params["scales"][sources] += shrink.log()[:, None]
        _update_param_with_optimizer(
            lambda _, p: nn.Parameter(p.index_copy(0, places, p[sources])),
            lambda _, v: v.index_fill(0, torch.cat([sources, places]), 0.0),
            params,
            optimizers,
        )


def relocated(opacities: Float[Tensor, "M"], copies: Int[Tensor, "M"]) -> tuple[Float[Tensor, "M"], Float[Tensor, "M"]]:
    """Opacity and scale factor of N copies that in one place together look like one Gaussian.

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
