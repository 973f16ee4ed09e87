"""R: difference between rendered image and photograph."""

from __future__ import annotations

from functools import cached_property

from jaxtyping import Bool, Float
from torch import Tensor

from shellgs_method.losses.reduction import weighted_mean
from shellgs_method.losses.ssim import SsimTarget, ssim

SSIM_WEIGHT = 0.2
"""Weight w of the structural term."""


class PhotometricLoss:
    """(1 - w) L1 + w (1 - SSIM), averaged over the masked pixels (Kerbl et al. 2023, eq. 7).

    SSIM's windows extend beyond the mask; there the render is replaced by the photograph, so that pixels outside the
    mask get no gradient.

    Args:
        target: photograph, in [0, 1].
        mask: true where a pixel counts; all pixels by default.
    """

    def __init__(self, target: Float[Tensor, "H W 3"], mask: Bool[Tensor, "H W 1"] | None = None):
        self.target, self.mask = target, mask

    @cached_property
    def _ssim_target(self) -> SsimTarget:
        made = SsimTarget.of(self.target)
        self.target = made.photograph  # one copy in memory
        return made

    def __call__(
        self, rgb: Float[Tensor, "H W 3"], transient: Bool[Tensor, "H W 1"] | None = None
    ) -> Float[Tensor, ""]:
        """Loss of one render, of colours in [0, 1], without the pixels that are ``transient``."""
        mask = self.mask
        if transient is not None:
            mask = ~transient if mask is None else mask & ~transient
        if mask is not None:
            rgb = rgb.where(mask, self.target)
        l1, dissimilarity = (rgb - self.target).abs(), 1 - ssim(rgb, self._ssim_target)
        errors = (1 - SSIM_WEIGHT) * l1 + SSIM_WEIGHT * dissimilarity
        return errors.mean() if mask is None else weighted_mean(errors, mask)
