"""N: angle between rendered and cue normals."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from shellgs_method.losses.reduction import mean_weights
from shellgs_method.machine.elementwise import Value, Vector, dot, elementwise

SHORTEST = 1e-3
"""Length of the shortest normal that is normalized."""


def unit(normal: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W 3"]:
    """Normalize normals; those shorter than :data:`SHORTEST`, where hardly anything was composited, stay shorter than
    1.

    This also bounds the gradient to a thousand times the incoming one.
    """
    return normalize(normal, dim=-1, eps=SHORTEST)


class NormalLoss:
    """Mean of 1 - cos of the angle between two normal maps in the same frame, in [0, 2].

    The angle is signed: a normal opposite to the target costs 2. Evaluation uses unsigned angles.

    Args:
        target: the cue's normals.
        mask: true where the target is valid.
    """

    def __init__(self, target: Float[Tensor, "H W 3"], mask: Bool[Tensor, "H W 1"]):
        weights = mean_weights(mask, like=target)
        self._target, self._total = unit(target).where(mask, 0.0) * weights, weights.sum()

    def __call__(self, normal: Float[Tensor, "H W 3"]) -> Float[Tensor, ""]:
        """Loss of one render, given its normals of any length, as composited."""
        return self._total - elementwise(_cosines, normal, self._target)[0].sum()


def _cosines(normal: Vector, target: Vector) -> list[Vector]:
    return [[dot(unit_vector(normal), target)]]


def unit_vector(normal: Vector) -> list[Value]:
    """:func:`unit` of one normal, by its coordinates."""
    length = torch.sqrt(torch.clamp_min(dot(normal, normal), SHORTEST**2))
    return [each / length for each in normal]
