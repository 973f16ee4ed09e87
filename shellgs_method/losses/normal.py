"""N: agreement of the rendered normals with a cue's."""

from __future__ import annotations

from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from shellgs_method.losses.reduction import weighted_mean


def unit(normal: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W 3"]:
    """Normals of length one; those shorter than 1e-3, where hardly anything was composited, stay short.

    The bound is also the gradient's: a thousand times the incoming one at most.
    """
    return normalize(normal, dim=-1, eps=1e-3)


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
    return weighted_mean(1 - (unit(normal) * unit(target)).sum(dim=-1, keepdim=True), mask)
