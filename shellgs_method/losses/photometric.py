"""R: how far the rendered picture is from the photograph."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from kornia.metrics import ssim
from torch import Tensor

from shellgs_method.losses.reduction import weighted_mean


def photometric_loss(
    rgb: Float[Tensor, "H W 3"],
    target: Float[Tensor, "H W 3"],
    mask: Bool[Tensor, "H W 1"] | None = None,
    ssim_weight: float = 0.2,
) -> Float[Tensor, ""]:
    """(1 - w) L1 + w (1 - SSIM), averaged over the pixels that are kept (Kerbl et al. 2023, eq. 7).

    SSIM has the usual 11 x 11 window of sigma 1.5. Its windows reach over the mask's edge: what is rendered there is
    replaced by the photograph, so that no gradient comes from a pixel that is not kept.

    Args:
        rgb: rendered colours in [0, 1].
        target: the photograph, in [0, 1].
        mask: true where a pixel is kept; all of them by default.
        ssim_weight: share w of the structural term.
    """
    if mask is None:
        mask = torch.ones_like(rgb[..., :1], dtype=torch.bool)
    rgb = rgb.where(mask, target)
    # kornia.losses.ssim_loss is half of 1 - SSIM and clamped; the map itself is what the formula asks for.
    similarity = ssim(rgb.permute(2, 0, 1)[None], target.permute(2, 0, 1)[None], window_size=11)[0].permute(1, 2, 0)
    return weighted_mean((1 - ssim_weight) * (rgb - target).abs() + ssim_weight * (1 - similarity), mask)
