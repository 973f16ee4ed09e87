"""C: smoothness of the rendered normals where the cue's depth is smooth."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from kornia.filters import spatial_gradient
from torch import Tensor
from torch.nn.functional import max_pool2d, pad

from shellgs_method.losses.normal import unit_vector
from shellgs_method.machine.crops import crops
from shellgs_method.machine.elementwise import Vector, dot, elementwise


class SmoothnessLoss:
    """Edge-aware smoothness of the rendered normals, Σ w a / Σ w (Vid2Sim's geometry consistency).

    ``a`` is the mean of 1 - cos between a pixel's normal and those to its left and above; ``w`` falls from 1 at the
    smoothest pixel in the mask to 0 at the steepest.

    Args:
        target_depth: the cue's z-depth.
        mask: true where the target is valid.
    """

    def __init__(self, target_depth: Float[Tensor, "H W 1"], mask: Bool[Tensor, "H W 1"]):
        smoothness = _smoothness(target_depth, mask)
        total = smoothness.sum()
        self._weights = (smoothness / total.where(total > 0, 1.0))[1:, 1:]

    def __call__(self, normal: Float[Tensor, "H W 3"]) -> Float[Tensor, ""]:
        """Loss of one render, given its normals of any length, as composited."""
        height, width, _ = self._weights.shape
        neighbours = crops(normal, height, width, (1, 1), (1, 0), (0, 1))
        return elementwise(_roughness, *neighbours, self._weights)[0].sum()


def _roughness(normal: Vector, left: Vector, above: Vector, weight: Vector) -> list[Vector]:
    normal = unit_vector(normal)
    return [[weight[0] * (1 - (dot(normal, unit_vector(left)) + dot(normal, unit_vector(above))) / 2)]]


@torch.no_grad()
def _smoothness(depth: Float[Tensor, "H W 1"], mask: Bool[Tensor, "H W 1"]) -> Float[Tensor, "H W 1"]:
    """1 - minmax(|∇Z| / Z) where all 3 x 3 pixels of the Sobel window are in the mask, else 0.

    Only there is the gradient known. Both neighbours are in the mask there too, so that this also excludes pairs of
    normals across the mask's edge.
    """
    unsupported = pad((~mask).to(depth.dtype)[None, ..., 0], (1, 1, 1, 1), value=1.0)
    inside = max_pool2d(unsupported, kernel_size=3, stride=1)[0, ..., None] == 0
    gradient = spatial_gradient(depth[None, None, ..., 0], mode="sobel")[0, 0]  # [2, H, W], per pixel
    steepness = gradient.norm(dim=0)[..., None] / depth.where(inside, 1.0)
    low = steepness.where(inside, torch.inf).amin()
    high = steepness.where(inside, -torch.inf).amax()
    # Differences below 1e-5 of the depth per pixel are rounding errors: do not stretch them to [0, 1].
    return (1 - (steepness - low) / (high - low).clamp_min(1e-5)).where(inside, 0.0)
