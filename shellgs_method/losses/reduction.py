"""The one average behind every loss."""

from __future__ import annotations

from jaxtyping import Bool, Float
from torch import Tensor


def weighted_mean(values: Float[Tensor, "*shape"], weights: Tensor) -> Float[Tensor, ""]:
    """Average of ``values`` under non-negative ``weights`` (or a boolean mask) that broadcast to their shape.

    A value of no weight has no part in the result, whatever it is. Where all weights are zero the result is a zero
    that still belongs to the graph of ``values``, so that a view without support can be trained like any other.
    """
    weights = weights.to(values.dtype).expand_as(values)
    total = weights.sum()
    return (weights * values.where(weights > 0, 0.0)).sum() / total.where(total > 0, 1.0)


def mean_weights(mask: Bool[Tensor, "*shape"], like: Tensor) -> Float[Tensor, "*shape"]:
    """Weights of sum 1 that make a mean over a mask of a sum; all 0 where it is empty. In the dtype of ``like``."""
    return mask.to(like) / mask.sum().clamp_min(1)
