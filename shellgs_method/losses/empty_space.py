"""E: distance in metres between the shell and everything along a ray."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from shellgs_method.losses.normal import unit
from shellgs_method.losses.reduction import mean_weights
from shellgs_method.machine.elementwise import Vector, elementwise

BEHIND = 1.0
"""Distance behind the shell in metres at which the remaining transmittance is assumed to end."""
REACH = 0.2
"""Distance beyond the tolerance in metres at which the loss has half of its largest gradient."""


class EmptySpaceLoss:
    """Mean of log(1 + max(0, e - tolerance) / REACH) REACH, with e the root mean square distance of a pixel's splats.

    The distance is in metres, from the shell's tangent plane at the pixel. Unlike the NCC, the loss depends on scale,
    offset and the amount of a plane's tilt, and unlike one of the mean depth, it sees haze in front of the shell and
    what shows through behind it. As the distance is along the shell's normal, a wall at a grazing angle counts no more
    than a frontal one; the logarithm keeps objects in front of the shell from dominating the gradient. The remaining
    transmittance counts as if it ended a metre (:data:`BEHIND`) behind the shell.

    Args:
        target_depth: the cue's z-depth.
        target_normal: the cue's normals.
        rays: ray through each pixel, z = 1.
        trust: weight of each pixel, 0 where the target is not valid.
        metres_per_unit: metres per unit of the depths.
        tolerance: distance in metres without cost, for errors of the shell's alignment.
    """

    def __init__(
        self,
        target_depth: Float[Tensor, "H W 1"],
        target_normal: Float[Tensor, "H W 3"],
        rays: Float[Tensor, "H W 3"],
        trust: Float[Tensor, "H W 1"],
        metres_per_unit: float = 1.0,
        tolerance: float = 0.0,
    ):
        mask = trust > 0
        slope = metres_per_unit * (unit(target_normal) * rays).sum(dim=-1, keepdim=True)
        self._slope = slope.where(mask, 0.0)  # squared in the loss: its sign is of no account
        self._weights = trust * mean_weights(mask, like=target_depth)
        self._tolerance = target_depth.new_tensor([tolerance])

    def __call__(self, squares: Float[Tensor, "H W 1"], alpha: Float[Tensor, "H W 1"]) -> Float[Tensor, ""]:
        """Loss of one render, given Σ w (z - target)², not divided by alpha, and alpha = Σ w."""
        return elementwise(_beyond, squares, alpha, self._slope, self._weights, self._tolerance)[0].sum()


def _beyond(square: Vector, alpha: Vector, slope: Vector, weight: Vector, tolerance: Vector) -> list[Vector]:
    squared = slope[0] * slope[0] * square[0] + BEHIND**2 * torch.relu(1 - alpha[0])
    beyond = torch.relu(torch.sqrt(torch.clamp_min(squared, 1e-8)) - tolerance[0])
    return [[weight[0] * torch.log(1 + beyond / REACH) * REACH]]
