"""Metric distance of the rendered surface from the shell."""

from __future__ import annotations

from jaxtyping import Bool, Float
from torch import Tensor

from shellgs_method.losses.normal import unit
from shellgs_method.losses.reduction import mean_weights
from shellgs_method.machine.compilation import run_fused

BEHIND = 1.0
"""Distance behind the shell in metres at which the remaining transmittance is assumed to end."""
REACH = 0.2
"""Distance beyond the tolerance in metres at which :meth:`PointToPlaneLoss.of_all` has half of its largest gradient."""


class PointToPlaneLoss:
    """:func:`point_to_plane_loss` for many renders of one view."""

    def __init__(
        self,
        target_depth: Float[Tensor, "H W 1"],
        target_normal: Float[Tensor, "H W 3"],
        rays: Float[Tensor, "H W 3"],
        mask: Bool[Tensor, "H W 1"],
        metres_per_unit: float = 1.0,
        tolerance: float = 0.0,
    ):
        slope = (unit(target_normal) * rays).sum(dim=-1, keepdim=True).abs()
        self._target, self._slope = target_depth.where(mask, 0.0), (metres_per_unit * slope).where(mask, 0.0)
        self._weights = mean_weights(mask, like=target_depth)
        self._tolerance = target_depth.new_full((1, 1, 1), tolerance)

    def __call__(self, depth: Float[Tensor, "H W 1"]) -> Float[Tensor, ""]:
        """Loss of one render."""
        return run_fused(_beyond, depth, self._target, self._slope, self._weights, self._tolerance, varying=2)

    def of_all(self, squares: Float[Tensor, "H W 1"], alpha: Float[Tensor, "H W 1"]) -> Float[Tensor, ""]:
        """Loss of the root mean square distance e of all splats of a pixel, instead of that of its mean depth.

        It is log(1 + max(0, e - tolerance) / REACH) REACH, since what is in front of the shell counts more in e. The
        remaining transmittance counts as if it ended a metre (:data:`BEHIND`) behind the shell.

        Args:
            squares: Σ w (z - target)², not divided by alpha.
            alpha: Σ w.
        """
        return run_fused(_all_beyond, squares, alpha, self._slope, self._weights, self._tolerance, varying=2)


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

    Unlike the NCC, it depends on scale, offset and the amount of a plane's tilt. As the distance is along the shell's
    normal, a wall at a grazing angle counts no more than a frontal one; the logarithm keeps objects in front of the
    shell from dominating the gradient.

    Args:
        depth: rendered z-depth.
        target_depth: the cue's z-depth.
        target_normal: the cue's normals.
        rays: ray through each pixel, z = 1.
        mask: true where the target is valid.
        metres_per_unit: metres per unit of the depths.
        tolerance: distance in metres without cost, for errors of the shell's alignment.
    """
    return PointToPlaneLoss(target_depth, target_normal, rays, mask, metres_per_unit, tolerance)(depth)


def _beyond(
    depth: Float[Tensor, "H W 1"],
    target: Float[Tensor, "H W 1"],
    slope: Float[Tensor, "H W 1"],
    weights: Float[Tensor, "H W 1"],
    tolerance: Float[Tensor, "1 1 1"],
) -> Float[Tensor, ""]:
    return (weights * (slope * (depth - target).abs() - tolerance).relu().log1p()).sum()


def _all_beyond(
    squares: Float[Tensor, "H W 1"],
    alpha: Float[Tensor, "H W 1"],
    slope: Float[Tensor, "H W 1"],
    weights: Float[Tensor, "H W 1"],
    tolerance: Float[Tensor, "1 1 1"],
) -> Float[Tensor, ""]:
    squares = slope * slope * squares + BEHIND**2 * (1 - alpha).relu()
    beyond = (squares.clamp_min(1e-8).sqrt() - tolerance).relu()
    return (weights * (beyond / REACH).log1p() * REACH).sum()
