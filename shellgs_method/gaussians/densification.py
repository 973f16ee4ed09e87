"""Densification by gradient, also of wide Gaussians and of those far away."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from gsplat.strategy import DefaultStrategy
from gsplat.strategy.ops import reset_opa
from torch import nn
from torch.optim import Optimizer
from typing_extensions import Self

from shellgs_method.losses.schedules import PAPER_ITERATIONS
from shellgs_method.machine.constants import constant
from shellgs_method.machine.elementwise import Vector, elementwise
from shellgs_method.render.maps import DISC_LOG_THICKNESS

WIDE = 0.05
"""Radius in a view, in units of its longer side, above which a Gaussian counts as wide."""
LEAST_RESET = 0.01
"""Least opacity of a reset, whose logit must be finite."""
MIN_RESET_EVERY = 1000
"""Fewest iterations between two opacity resets: opacities recover no faster in a short run."""


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

    def for_run(self, iterations: int) -> Self:
        """The same strategy, whose schedule is scaled from a run of 30 000 iterations to another.

        How often it refines stays: a Gaussian that was just split needs time to settle in a short run too, or all
        split again.
        """
        shrink = iterations / PAPER_ITERATIONS
        return replace(
            self,
            refine_start_iter=round(self.refine_start_iter * shrink),
            refine_stop_iter=round(self.refine_stop_iter * shrink),
            reset_every=max(round(self.reset_every * shrink), min(MIN_RESET_EVERY, self.reset_every)),
        )

    def pause(self, step: int) -> int:
        """Iterations without densification after an opacity reset, until each photograph was trained on again.

        As in splatfacto, but at most half of the reset interval: splatfacto never densifies a scene of many
        photographs. There is no pause before the first reset, where gsplat would also wait.
        """
        return min(self.pause_refine_after_reset, self.reset_every // 2) if step >= self.reset_every else 0

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
        if step < self.refine_stop_iter:
            self._gather(params, state, info)
            settled = step % self.reset_every >= self.pause(step)
            if step > self.refine_start_iter and step % self.refine_every == 0 and settled:
                self._grow_gs(params, optimizers, state, step)
                self._prune_gs(params, optimizers, state, step)
                for gathered in ("grad2d", "count", "radii"):
                    state[gathered].zero_()
                torch.cuda.empty_cache()  # tensors of other sizes follow
            if step > 0 and step % self.reset_every == 0:
                reset_opa(params, optimizers, state, value=max(2 * self.prune_opa, LEAST_RESET))
        if self.key_for_gradient == "gradient_2dgs":  # of discs: a split divides all scales
            params["scales"].data[:, 2] = DISC_LOG_THICKNESS

    @torch.no_grad()
    def _gather(self, params: nn.ParameterDict, state: dict[str, Any], info: dict[str, Any]) -> None:
        """Add gradients, in units of half the image, and radii of a rendering by our rasterizer to the state."""
        centres, radii = info[self.key_for_gradient], info["radii"]
        for gathered in ("grad2d", "count", "radii"):
            if state[gathered] is None:
                state[gathered] = centres.new_zeros(len(params["means"]))
        trained = radii.shape[1] - info.get("frozen", 0)
        if trained != len(params["means"]):
            return  # broken ones were removed since, and nobody knows which of these are left
        gradients, radii = centres.grad[0, :trained], radii[0, :trained].to(centres)
        half = (size / 2 for size in (info["width"], info["height"]))
        scale = constant(*half, 1 / max(info["width"], info["height"]), like=gradients)
        skipped = info.get("skipped", constant(0.0, like=gradients)[0])[None]
        sums = (state[gathered][:, None] for gathered in ("grad2d", "count", "radii"))
        added = elementwise(_added, gradients, radii[:, None], scale, skipped, *sums)
        state["grad2d"], state["count"], state["radii"] = (each[:, 0] for each in added)

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


def _added(
    gradient: Vector, radius: Vector, scale: Vector, skipped: Vector, grad2d: Vector, count: Vector, largest: Vector
) -> list[Vector]:
    """What is gathered of a Gaussian, with one more view; a step that was skipped adds no gradient."""
    x, y = gradient[0] * scale[0], gradient[1] * scale[1]
    shown = radius[0] > 0
    norm = torch.where(skipped[0] > 0, 0.0, torch.sqrt(x * x + y * y))
    return [
        [grad2d[0] + torch.where(shown, norm, 0.0)],
        [count[0] + torch.where(shown, 1.0, 0.0)],
        [torch.maximum(largest[0], radius[0] * scale[2])],
    ]


@dataclass
class SkyboxStrategy(GradientStrategy):
    """Densification of a run that began on a shell and a skybox.

    The size above which Gaussians are pruned grows with their distance: the cameras are within 1 of the origin; farther
    away the limit is that at 1 times the distance, since the Gaussians of a skybox are large.
    """

    wide_gradient: float = 4.0
    """Since the seeds already resolve the wall, the limit of the gradient is high: what is beside the building would be
    a blur."""

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
