"""D: patch-wise correlation of rendered and cue inverse depth."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import unfold

from shellgs_method.losses.windows import shifted, window_sums
from shellgs_method.machine.compilation import run_fused


class NccLoss:
    """Mean of 1 - NCC over the patches centred on pixels in the mask, in [0, 2].

    Means and variances are over a patch's valid pixels. The loss is invariant to scale and shift of the rendered
    inverse depth, and a plane's inverse depth is linear in the pixel: the loss depends on the direction of a plane's
    tilt, not on its amount. A patch is ignored if too few of its pixels are valid or if the target has no structure to
    correlate (a frontal plane).

    Args:
        target: the cue's 1/z.
        mask: true where the target is valid.
        window: side of a patch in pixels, odd.
        min_valid: minimum share of valid pixels in a patch.
        eps: smallest standard deviation of a patch, relative to the target's mean in it; 0.001 is 1 cm at 10 m, the
            accuracy of shells and alignments. Below it the target counts as flat, and a flatter render is treated
            as if it had this contrast, which bounds the gradient.
    """

    def __init__(
        self,
        target: Float[Tensor, "H W 1"],
        mask: Bool[Tensor, "H W 1"],
        window: int = 9,
        min_valid: float = 0.5,
        eps: float = 1e-3,
    ):
        self._around, self._window = (window // 2,) * 4, target.new_ones(1, 1, window)
        mask, ones = mask[..., 0], [1.0] * window
        y = target[..., 0].where(mask, 0.0)
        self._valid = F.pad(mask.to(y), self._around)
        n, sums = window_sums([self._valid, F.pad(y, self._around)], ones)
        per_pixel = 1 / n.clamp_min(0.5)
        # Fill pixels outside the mask with values close to those inside, for patches centred there.
        self._target = F.pad(y.where(mask, sums * per_pixel), self._around)
        mean, _, variance, _ = _moments(self._target, self._target, self._valid, per_pixel, window)
        floor = (eps * mean).square()
        used = mask & (n > min_valid * window**2 - 0.5) & (variance > floor)
        self._patches, self._share = (per_pixel, variance, floor, used.to(y)), 1 / used.sum().clamp_min(1).to(y)

    def __call__(self, inverse_depth: Float[Tensor, "H W 1"]) -> Float[Tensor, ""]:
        """Loss of one render, whose 1/z is finite wherever the mask is true."""
        return self._share * _Ncc.apply(inverse_depth[..., 0], self)

    def correlate(self, x: Float[Tensor, "H W"]) -> list[Tensor]:
        """Padded inverse depth, sum of the patches' losses, and the other arguments of :meth:`gradient`."""
        x = F.pad(x, self._around).where(self._valid > 0, self._target)
        return [x, *run_fused(_correlate, x, self._target, self._valid, *self._patches, self._window, varying=2)]

    def gradient(self, x: Float[Tensor, "H+2r W+2r"], *gradient_terms: Float[Tensor, "H W"]) -> Float[Tensor, "H W"]:
        """Gradient of the sum w.r.t. the inverse depth."""
        padded = [F.pad(each, self._around) for each in gradient_terms]
        return run_fused(_gradient, x, self._target, self._valid, *padded, self._window, varying=2)


class _Ncc(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x, view):
        filled, loss, *gradient_terms = view.correlate(x.detach())
        ctx.view = view
        ctx.save_for_backward(filled, *gradient_terms)
        return loss

    @staticmethod
    @once_differentiable
    def backward(ctx, gradient):
        return gradient * ctx.view.gradient(*ctx.saved_tensors), None


def _correlate(
    x: Float[Tensor, "H+2r W+2r"],
    y: Float[Tensor, "H+2r W+2r"],
    valid: Float[Tensor, "H+2r W+2r"],
    per_pixel: Float[Tensor, "H W"],
    variance_y: Float[Tensor, "H W"],
    floor: Float[Tensor, "H W"],
    weights: Float[Tensor, "H W"],
    window: Float[Tensor, "1 1 w"],
) -> tuple[Tensor, ...]:
    """Sum of the patches' losses; and a, a E[y], b and b E[x] of each patch, the terms of the gradient.

    The gradient at a pixel is the sum of a (y - E[y]) + b (x - E[x]) over the patches that contain it.

    Args:
        x: rendered inverse depth.
        y: target inverse depth.
        valid: 1 where a pixel counts, else 0.
        per_pixel: one over the number of valid pixels, per patch, like the following.
        variance_y: variance of the target.
        floor: smallest variance that counts as contrast.
        weights: 1, or 0 for a patch that is ignored.
        window: tensor as wide as a patch.
    """
    mean_x, mean_y, variance_x, covariance = _moments(x, y, valid, per_pixel, window.shape[2])
    # Clamp rather than add the floor: a perfect match is exactly 1, and scale does not matter above the floor.
    product = torch.where(weights > 0, torch.maximum(variance_x, floor) * variance_y, 1.0)
    ncc = covariance / product.sqrt()
    a = -weights * per_pixel / product.sqrt()
    b = torch.where((weights > 0) & (variance_x > floor), weights * per_pixel * ncc / variance_x, 0.0)
    return (weights * (1 - ncc)).sum(), a, a * mean_y, b, b * mean_x


def _moments(
    x: Float[Tensor, "H+2r W+2r"],
    y: Float[Tensor, "H+2r W+2r"],
    valid: Float[Tensor, "H+2r W+2r"],
    per_pixel: Float[Tensor, "H W"],
    size: int,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Means of x and y, variance of x, and covariance, over the valid pixels of each patch.

    E[x²] - E[x]² of nearly equal values loses all digits in float32. To keep the summands small, each row of a patch is
    summed relative to its central value, and the rows relative to the central value of the patch.
    """
    half = size // 2
    x0, y0 = (shifted(each, size, dim=1)[half] for each in (x, y))
    n = sum_x = sum_y = sum_xx = sum_xy = torch.zeros(())
    for xi, yi, mi in zip(*(shifted(each, size, dim=1) for each in (x, y, valid)), strict=True):
        dx, dy = xi - x0, mi * (yi - y0)
        n, sum_x, sum_y = n + mi, sum_x + mi * dx, sum_y + dy
        sum_xx, sum_xy = sum_xx + mi * dx * dx, sum_xy + dx * dy
    rows = zip(*(shifted(each, size, dim=0) for each in (x0, y0, n, sum_x, sum_y, sum_xx, sum_xy)), strict=True)
    x0, y0 = (shifted(each, size, dim=0)[half] for each in (x0, y0))
    sum_x = sum_y = sum_xx = sum_xy = torch.zeros(())
    for xi, yi, ni, xs, ys, xxs, xys in rows:
        dx, dy = xi - x0, yi - y0
        moved_x, moved_y = xs + ni * dx, ys + ni * dy
        sum_x, sum_y = sum_x + moved_x, sum_y + moved_y
        sum_xx, sum_xy = sum_xx + xxs + dx * (xs + moved_x), sum_xy + xys + dx * ys + dy * moved_x
    mean_x, mean_y = sum_x * per_pixel, sum_y * per_pixel
    covariance = sum_xy * per_pixel - mean_x * mean_y
    return x0 + mean_x, y0 + mean_y, sum_xx * per_pixel - mean_x * mean_x, covariance


def _gradient(
    x: Float[Tensor, "H+2r W+2r"],
    y: Float[Tensor, "H+2r W+2r"],
    valid: Float[Tensor, "H+2r W+2r"],
    a: Float[Tensor, "H+2r W+2r"],
    a_mean_y: Float[Tensor, "H+2r W+2r"],
    b: Float[Tensor, "H+2r W+2r"],
    b_mean_x: Float[Tensor, "H+2r W+2r"],
    window: Float[Tensor, "1 1 w"],
) -> Float[Tensor, "H W"]:
    """Gradient from the outputs of :func:`_correlate`."""
    size = window.shape[2]
    x, y, valid = (shifted(shifted(each, size, 0)[size // 2], size, 1)[size // 2] for each in (x, y, valid))
    a, a_mean_y, b, b_mean_x = window_sums([a, a_mean_y, b, b_mean_x], [1.0] * size)
    return valid * (y * a - a_mean_y + x * b - b_mean_x)


def vid2sim_ncc_loss(
    inverse_depth: Float[Tensor, "H W 1"], target: Float[Tensor, "H W 1"], mask: Bool[Tensor, "H W 1"]
) -> Float[Tensor, ""]:
    """Patch NCC as in Vid2Sim's released code, for comparison; :class:`NccLoss` is the intended formula.

    Patches of 3 x 3 pixels are centred by one mean over all patches of the image, pixels outside the mask count as
    zeros, eps is absolute, and the average is over all pixels. A view with an empty mask gives zero.
    """
    maps = torch.stack([inverse_depth[..., 0].where(mask[..., 0], 0.0), target[..., 0].where(mask[..., 0], 0.0)])
    patches = unfold(maps[:, None], kernel_size=3, padding=1)  # [2, 9, H*W]
    patches = patches - patches.mean(dim=(1, 2), keepdim=True)
    # The clamp only makes the root differentiable at zero: it is far below the eps of 1e-5.
    deviation_x, deviation_y = patches.square().mean(dim=1).clamp_min(1e-24).sqrt()
    ncc = (patches[0] * patches[1]).mean(dim=0) / (deviation_x * deviation_y + 1e-5)
    return (1 - ncc).mean() * mask.any()
