"""Depth and normal errors in the image plane."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor


class NormalErrors(NamedTuple):
    """Statistics of the unsigned angles between two normal maps over a mask."""

    mean: float
    """Mean angle in degrees."""
    below_10: float
    """Share of the pixels below 10°."""
    below_20: float
    """Share of the pixels below 20°."""


def depth_mae(
    depth: Float[Tensor, "H W 1"], target: Float[Tensor, "H W 1"], mask: Bool[Tensor, "H W 1"]
) -> float | None:
    """Mean absolute depth error after median scaling of the view, in the units of the maps (the paper's D-MAE).

    The scale is the median over pixels of target / depth. Pixels where one of the two is missing are ignored; None if
    no pixel is left.
    """
    valid = mask & (depth > 0) & (target > 0)
    if not valid.any():
        return None
    depth, target = depth[valid].double(), target[valid].double()
    return (depth * (target / depth).median() - target).abs().mean().item()


def angular_error(normal: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W 1"]:
    """Unsigned angle between normals of any length, in degrees; 90, the maximum, where one of them is zero."""
    normal, target = normal.double(), target.double()
    sine = torch.linalg.cross(normal, target).norm(dim=-1, keepdim=True)
    cosine = (normal * target).sum(dim=-1, keepdim=True).abs()
    # The arc cosine alone would lose angles below 0.02° in float32, and those near zero in any precision.
    return torch.rad2deg(torch.atan2(sine, cosine)).where((sine > 0) | (cosine > 0), 90.0).float()


def normal_errors(
    normal: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], mask: Bool[Tensor, "H W 1"]
) -> NormalErrors:
    """Statistics of :func:`angular_error` over a mask that is not empty; a missing normal counts as 90°."""
    angle = angular_error(normal, target)[mask]
    return NormalErrors(*(metric.item() for metric in (angle.mean(), share(angle < 10), share(angle < 20))))


def share(condition: Bool[Tensor, "*shape"]) -> Float[Tensor, ""]:
    """Share of the elements that are true."""
    return condition.float().mean()
