"""Weighted averages for the losses."""

from __future__ import annotations

from jaxtyping import Bool, Float
from torch import Tensor


def weighted_mean(values: Float[Tensor, "*shape"], weights: Tensor) -> Float[Tensor, ""]:
    """Average of ``values`` with non-negative ``weights`` (or a boolean mask) that broadcast to their shape.

    Values of weight zero are ignored, even if not finite. If all weights are zero, the result is a zero in the graph of
    ``values``, so that a view with an empty mask can be trained like any other.
    """
    weights = weights.to(values.dtype).expand_as(values)
    total = weights.sum()
    return (weights * values.where(weights > 0, 0.0)).sum() / total.where(total > 0, 1.0)


def mean_weights(mask: Bool[Tensor, "*shape"], like: Tensor) -> Float[Tensor, "*shape"]:
    """Weights that sum to 1 over a mask, or are all 0 if it is empty, in the dtype of ``like``."""
    return mask.to(like) / mask.sum().clamp_min(1)
