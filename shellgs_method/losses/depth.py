"""D: agreement of the rendered inverse depth with a cue's, patch by patch."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, unfold

from shellgs_method.losses.reduction import weighted_mean


def ncc_loss(
    inverse_depth: Float[Tensor, "H W 1"],
    target: Float[Tensor, "H W 1"],
    mask: Bool[Tensor, "H W 1"],
    window: int = 9,
    min_valid: float = 0.5,
    eps: float = 1e-3,
) -> Float[Tensor, ""]:
    """Mean of 1 - NCC over the patches centred on supported pixels, in [0, 2].

    Means and variances are those of a patch's valid pixels. The loss does not change when the rendered inverse depth
    is scaled or shifted, and a plane's inverse depth is linear in the pixel: it sees which way a plane tilts, not how
    far. A patch is left out where too few of its pixels are valid and where the target has no structure to correlate
    (a frontal plane).

    Args:
        inverse_depth: rendered 1/z, finite wherever the mask is true.
        target: the cue's 1/z.
        mask: true where the target is valid.
        window: side of a patch in pixels, odd.
        min_valid: share of a patch's pixels that must be valid.
        eps: smallest standard deviation of a patch, relative to the target's mean in it; 0.001 is 1 cm at 10 m, what
            shells and alignments are good for. Below it the target counts as flat, and a flatter rendering is treated
            as if it had this much contrast, which bounds the gradient.
    """
    # E[x²] - E[x]² of nearly equal inverse depths loses all digits in float32, hence the moments in float64.
    m, x, y = mask.double(), inverse_depth.double().where(mask, 0.0), target.double().where(mask, 0.0)
    moments = _box_mean(torch.cat([m, x, y, x * x, y * y, x * y], dim=-1), window)
    valid, *moments = moments.split(1, dim=-1)
    count = valid.clamp_min(0.5 / window**2)
    mean_x, mean_y, mean_xx, mean_yy, mean_xy = (moment / count for moment in moments)

    floor = (eps * mean_y).square()
    variance_x, variance_y = mean_xx - mean_x.square(), mean_yy - mean_y.square()
    used = mask & (valid > min_valid - 1e-6) & (variance_y > floor)
    # Clamped rather than floor added: a perfect match is exactly 1 and scale does not matter above the floor.
    scale = (variance_x.maximum(floor) * variance_y).where(used, 1.0).sqrt()
    return weighted_mean(1 - (mean_xy - mean_x * mean_y) / scale, used).to(inverse_depth.dtype)


def vid2sim_ncc_loss(
    inverse_depth: Float[Tensor, "H W 1"], target: Float[Tensor, "H W 1"], mask: Bool[Tensor, "H W 1"]
) -> Float[Tensor, ""]:
    """The patch NCC that Vid2Sim released, kept for comparison; :func:`ncc_loss` is what it is meant to be.

    Patches of 3 x 3 pixels are centred by one mean over all patches of the image, unsupported pixels take part as
    zeros, eps is absolute, and the average is over all pixels. A view with an empty mask gives zero.
    """
    maps = torch.stack([inverse_depth[..., 0].where(mask[..., 0], 0.0), target[..., 0].where(mask[..., 0], 0.0)])
    patches = unfold(maps[:, None], kernel_size=3, padding=1)  # [2, 9, H*W]
    patches = patches - patches.mean(dim=(1, 2), keepdim=True)
    # The clamp only keeps the root differentiable at zero: it is far below the eps of 1e-5.
    deviation_x, deviation_y = patches.square().mean(dim=1).clamp_min(1e-24).sqrt()
    ncc = (patches[0] * patches[1]).mean(dim=0) / (deviation_x * deviation_y + 1e-5)
    return (1 - ncc).mean() * mask.any()


def _box_mean(maps: Float[Tensor, "H W C"], window: int) -> Float[Tensor, "H W C"]:
    """Mean over a square window around each pixel, zeros outside the image."""
    half = window // 2
    rows = avg_pool2d(maps.permute(2, 0, 1), (1, window), stride=1, padding=(0, half))
    return avg_pool2d(rows, (window, 1), stride=1, padding=(half, 0)).permute(1, 2, 0)
