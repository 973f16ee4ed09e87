"""N: agreement of the rendered normals with a cue's."""

from __future__ import annotations

from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from shellgs_method.fusion import run_fused
from shellgs_method.losses.reduction import mean_weights


def unit(normal: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W 3"]:
    """Normals of length one; those shorter than 1e-3, where hardly anything was composited, stay short.

    The bound is also the gradient's: a thousand times the incoming one at most.
    """
    return normalize(normal, dim=-1, eps=1e-3)


class NormalLoss:
    """:func:`normal_loss` for many renderings of one view."""

    def __init__(self, target: Float[Tensor, "H W 3"], mask: Bool[Tensor, "H W 1"]):
        weights = mean_weights(mask, like=target)
        self._target, self._total = unit(target).where(mask, 0.0) * weights, weights.sum()

    def __call__(self, normal: Float[Tensor, "H W 3"]) -> Float[Tensor, ""]:
        """The loss of one rendering."""
        return self._total - run_fused(_cosines, normal, self._target, varying=2)


def normal_loss(
    normal: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], mask: Bool[Tensor, "H W 1"]
) -> Float[Tensor, ""]:
    """Mean of 1 - cos of the angle between two maps of normals in the same frame, in [0, 2].

    Signed: a normal that points away from the camera costs 2. Evaluation is unsigned.

    Args:
        normal: rendered normals of any length, as composited.
        target: the cue's normals.
        mask: true where the target is valid.
    """
    return NormalLoss(target, mask)(normal)


def _cosines(normal: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"]) -> Float[Tensor, ""]:
    return (unit(normal) * target).sum()
