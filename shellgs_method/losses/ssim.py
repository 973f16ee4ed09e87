"""Structural similarity, with the photograph's moments computed once."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from kornia.filters import filter2d_separable
from torch import Tensor
from torch.autograd.function import once_differentiable

from shellgs_method.losses.windows import window_sums
from shellgs_method.machine.elementwise import Vector, elementwise, in_loops

RADIUS = 5
_GAUSSIAN = [math.exp(-0.5 * (i / 1.5) ** 2) for i in range(-RADIUS, RADIUS + 1)]
TAPS = tuple(tap / sum(_GAUSSIAN) for tap in _GAUSSIAN)
C1, C2 = 0.01**2, 0.03**2


# Images are [height, width * channels] here, see windows.py.


@dataclass(frozen=True)
class SsimTarget:
    """A photograph with its moments.

    Attributes:
        padded: photograph padded by reflection.
        mean: mean of each window.
        variance: variance of each window.
    """

    padded: Float[Tensor, "H+10 X+30"]
    mean: Float[Tensor, "H X"]
    variance: Float[Tensor, "H X"]

    @property
    def photograph(self) -> Float[Tensor, "H W 3"]:
        """The photograph without the padding; a view of ``padded``."""
        return self.padded.unflatten(1, (-1, 3))[RADIUS:-RADIUS, RADIUS:-RADIUS]

    @classmethod
    def of(cls, photograph: Float[Tensor, "H W 3"]) -> SsimTarget:
        """Compute the moments."""
        padded = _reflected(photograph)
        mean, mean_square = _blur(padded, padded.square())
        return cls(padded, mean, mean_square - mean.square())


def ssim(rgb: Float[Tensor, "H W 3"], target: SsimTarget) -> Float[Tensor, "H W 3"]:
    """SSIM (Wang et al. 2004) of each pixel's Gaussian window, 11 x 11 of sigma 1.5, of colours in [0, 1].

    Equals ``kornia.metrics.ssim``, with reflected borders; that one recomputes the photograph's moments in each call,
    and its convolutions are many times slower in training on a CPU.
    """
    return _Ssim.apply(_reflected(rgb), target.padded, target.mean, target.variance).view_as(rgb)


class _Ssim(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x, y, mean, variance):
        moments = [*_blur(x, x * x, x * y), mean, variance]
        similarity, *grad_moments = (
            each[..., 0] for each in elementwise(_similarity, *(moment[..., None] for moment in moments))
        )
        ctx.save_for_backward(x, y, *grad_moments)
        return similarity

    @staticmethod
    @once_differentiable
    def backward(ctx, gradient):
        x, y, *grad_moments = ctx.saved_tensors
        around = (6 * RADIUS, 6 * RADIUS, 2 * RADIUS, 2 * RADIUS)
        grad_moments = [F.pad(gradient * each, around) for each in grad_moments]
        # W.r.t. the padded image from those w.r.t. the windows' means, blurred by the same, symmetric window.
        grad_x, grad_xx, grad_xy = _blur(*grad_moments)
        return grad_x + 2 * x * grad_xx + y * grad_xy, None, None, None


def _similarity(mean_x: Vector, mean_xx: Vector, mean_xy: Vector, mean_y: Vector, variance_y: Vector) -> list[Vector]:
    """SSIM, and its derivatives w.r.t. the windows' means of x, x² and x y."""
    (x,), (xx,), (xy,), (y,), (yy,) = mean_x, mean_xx, mean_xy, mean_y, variance_y
    cross, squares = 2 * x * y + C1, x * x + y * y + C1
    covariance, variances = 2 * (xy - x * y) + C2, xx - x * x + yy + C2
    similarity = cross * covariance / (squares * variances)
    grad_xx, grad_xy = -similarity / variances, 2 * cross / (squares * variances)
    grad_x = 2 * (y * covariance / variances - x * similarity) / squares - y * grad_xy - 2 * x * grad_xx
    return [[similarity], [grad_x], [grad_xx], [grad_xy]]


def _blur(*images: Float[Tensor, "H+10 X+30"]) -> Sequence[Float[Tensor, "H X"]]:
    """Gaussian means of the windows inside images: compiled loops, or kornia's convolutions."""
    if in_loops(*images):
        return window_sums(images, TAPS, channels=3)
    taps = images[0].new_tensor([TAPS])
    stacked = torch.stack(images).unflatten(2, (-1, 3)).permute(0, 3, 1, 2)
    return filter2d_separable(stacked, taps, taps, padding="valid").permute(0, 2, 3, 1).flatten(2).unbind(0)


def _reflected(image: Float[Tensor, "H W 3"]) -> Float[Tensor, "H+10 X+30"]:
    padded = F.pad(image.permute(2, 0, 1)[None], (RADIUS,) * 4, mode="reflect")
    return padded[0].permute(1, 2, 0).flatten(1)
