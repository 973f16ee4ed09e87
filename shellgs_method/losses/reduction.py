"""The one average behind every loss."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor


def weighted_mean(values: Float[Tensor, "*shape"], weights: Tensor) -> Float[Tensor, ""]:
    """Average of ``values`` under non-negative ``weights`` (or a boolean mask) that broadcast to their shape.

    A value of no weight has no part in the result, whatever it is. Where all weights are zero the result is a zero
    that still belongs to the graph of ``values``, so that a view without support can be trained like any other.
    """
    weights = weights.to(values.dtype).expand_as(values)
    total = weights.sum()
    return (weights * values.where(weights > 0, 0.0)).sum() / total.where(total > 0, 1.0)
