"""Distance of the rendered surface from the shell, in metres."""

from __future__ import annotations

from jaxtyping import Bool, Float
from torch import Tensor

from shellgs_method.losses.normal import unit
from shellgs_method.losses.reduction import weighted_mean


def point_to_plane_loss(
    depth: Float[Tensor, "H W 1"],
    target_depth: Float[Tensor, "H W 1"],
    target_normal: Float[Tensor, "H W 3"],
    rays: Float[Tensor, "H W 3"],
    mask: Bool[Tensor, "H W 1"],
    metres_per_unit: float = 1.0,
    tolerance: float = 0.0,
) -> Float[Tensor, ""]:
    """Mean of log(1 + max(0, d - tolerance)), d the distance in metres to the shell's tangent plane at the pixel.

    Metric where the NCC is blind: to scale, to offset and to how far a plane tilts. Measured along the shell's normal,
    a wall seen at a grazing angle counts no more than one seen from the front; the logarithm keeps what stands before
    the shell from pulling hardest.

    Args:
        depth: rendered z-depth.
        target_depth: the cue's z-depth.
        target_normal: the cue's normals.
        rays: ray through each pixel, z = 1.
        mask: true where the target is valid.
        metres_per_unit: of the depths.
        tolerance: metres that the shell's alignment may be off, which cost nothing.
    """
    slope = (unit(target_normal) * rays).sum(dim=-1, keepdim=True).abs()
    distance = metres_per_unit * slope * (depth - target_depth).abs()
    return weighted_mean((distance - tolerance).clamp_min(0).log1p(), mask)
