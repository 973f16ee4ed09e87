"""Terms without a cue: consistency of the rendered geometry, and the shape of the Gaussians."""

from __future__ import annotations

from jaxtyping import Bool, Float
from torch import Tensor

from shellgs_method.losses.reduction import weighted_mean
from shellgs_method.machine.elementwise import Vector, dot, elementwise


def normal_consistency_loss(
    normal: Float[Tensor, "H W 3"],
    depth_normal: Float[Tensor, "H W 3"],
    alpha: Float[Tensor, "H W 1"],
    weights: Float[Tensor, "H W 1"],
) -> Float[Tensor, ""]:
    """Sum of 1 - <N, A n>: composited normals against those of the rendered depth (Huang et al. 2024, eq. 14).

    Alpha A is only a weight, without gradient. N is not normalised, so that splats behind one another lower the loss by
    having the same normal.

    Args:
        normal: N, composited and not normalised.
        depth_normal: n, unit normals of the rendered depth, zero where there are none.
        alpha: accumulated opacity A.
        weights: weight of each pixel, of sum 1 for a mean.
    """
    return elementwise(_disagreement, normal, depth_normal, alpha.detach(), weights)[0].sum()


def _disagreement(normal: Vector, depth_normal: Vector, alpha: Vector, weight: Vector) -> list[Vector]:
    return [[weight[0] * (1 - alpha[0] * dot(normal, depth_normal))]]


def flattening_loss(scales: Float[Tensor, "N 3"], visible: Bool[Tensor, " N"]) -> Float[Tensor, ""]:
    """Mean of the visible Gaussians' smallest standard deviations, in the units of the scales."""
    return weighted_mean(scales.amin(dim=-1), visible)
