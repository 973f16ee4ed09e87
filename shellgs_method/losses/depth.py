"""D: patch-wise correlation of rendered and cue inverse depth."""

from __future__ import annotations

import functools
import operator

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import unfold

from shellgs_method.losses.windows import window_sums, windows
from shellgs_method.machine.elementwise import Vector, elementwise


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
        self._around, self._ones = (window // 2,) * 4, (1.0,) * window
        mask = mask[..., 0]
        y = target[..., 0].where(mask, 0.0)
        self._valid = F.pad(mask.to(y), self._around)
        n, sums = window_sums([self._valid, F.pad(y, self._around)], self._ones)
        per_pixel = 1 / n.clamp_min(0.5)
        # Fill pixels outside the mask with values close to those inside, for patches centred there.
        self._target = F.pad(y.where(mask, sums * per_pixel), self._around)
        rows = _row_sums(self._target, self._target, self._valid, window)
        mean, _, variance, _ = (each[..., 0] for each in elementwise(_moments, *rows, per_pixel[..., None]))
        floor = (eps * mean).square()
        used = mask & (n > min_valid * window**2 - 0.5) & (variance > floor)
        self._patches = [each[..., None] for each in (per_pixel, variance, floor, used.to(y))]
        self._share = 1 / used.sum().clamp_min(1).to(y)

    def __call__(self, inverse_depth: Float[Tensor, "H W 1"]) -> Float[Tensor, ""]:
        """Loss of one render, whose 1/z is finite wherever the mask is true."""
        return self._share * _Ncc.apply(inverse_depth[..., 0], self)

    def correlate(self, x: Float[Tensor, "H W"]) -> list[Tensor]:
        """Padded inverse depth, sum of the patches' losses, and the other arguments of :meth:`gradient`."""
        x = F.pad(x, self._around).where(self._valid > 0, self._target)
        rows = _row_sums(x, self._target, self._valid, len(self._ones))
        losses, *gradient_terms = (each[..., 0] for each in elementwise(_correlate, *rows, *self._patches))
        return [x, losses.sum(), *gradient_terms]

    def gradient(self, x: Float[Tensor, "H+2r W+2r"], *gradient_terms: Float[Tensor, "H W"]) -> Float[Tensor, "H W"]:
        """Gradient of the sum w.r.t. the inverse depth."""
        sums = window_sums([F.pad(each, self._around) for each in gradient_terms], self._ones)
        r = self._around[0]
        inside = [each[r:-r, r:-r] if r else each for each in (x, self._target, self._valid)]
        return elementwise(_gradient, *(each[..., None] for each in (*inside, *sums)))[0][..., 0]


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


def _row_sums(
    x: Float[Tensor, "H+2r W+2r"], y: Float[Tensor, "H+2r W+2r"], valid: Float[Tensor, "H+2r W+2r"], size: int
) -> list[Float[Tensor, "H W size"]]:
    """Sums over the rows of each patch, as arguments of :func:`_moments`."""
    half = size // 2
    sums = (each[..., 0] for each in elementwise(_of_row, *windows([x, y, valid], size, dim=1)))
    inside = slice(half, x.shape[1] - half)
    return [*windows([x[:, inside], y[:, inside], *sums], size, dim=0)]


def _of_row(xs: Vector, ys: Vector, valid: Vector) -> list[Vector]:
    """Number of valid pixels of a row, and sums of x, y, x² and x y relative to its central value.

    E[x²] - E[x]² of nearly equal values loses all digits in float32. To keep the summands small, each row of a patch is
    summed relative to its central value, and the rows relative to the central value of the patch.
    """
    x0, y0 = xs[len(xs) // 2], ys[len(ys) // 2]
    terms = []
    for x, y, m in zip(xs, ys, valid, strict=True):
        dx, dy = m * (x - x0), m * (y - y0)
        terms.append((m, dx, dy, dx * (x - x0), dx * (y - y0)))
    return [[functools.reduce(operator.add, each)] for each in zip(*terms, strict=True)]


def _moments(*values: Vector) -> list[Vector]:
    """Means of x and y, variance of x, and covariance, over the valid pixels of a patch, from its rows' sums."""
    xs, ys, *sums, (per_pixel,) = values
    x0, y0 = xs[len(xs) // 2], ys[len(ys) // 2]
    terms = []
    for x, y, n, sum_x, sum_y, sum_xx, sum_xy in zip(xs, ys, *sums, strict=True):
        dx, dy = x - x0, y - y0
        moved_x, moved_y = sum_x + n * dx, sum_y + n * dy
        terms.append((moved_x, moved_y, sum_xx + dx * (sum_x + moved_x), sum_xy + dx * sum_y + dy * moved_x))
    x, y, xx, xy = (per_pixel * functools.reduce(operator.add, each) for each in zip(*terms, strict=True))
    return [[x0 + x], [y0 + y], [xx - x * x], [xy - x * y]]


def _correlate(*values: Vector) -> list[Vector]:
    """Loss of a patch; and a, a E[y], b and b E[x] of it, the terms of the gradient.

    The gradient at a pixel is the sum of a (y - E[y]) + b (x - E[x]) over the patches that contain it. After the rows'
    sums of the rendered (x) and the target's (y) inverse depth come one over the number of valid pixels, the target's
    variance, the smallest variance that counts as contrast, and a weight: 1, or 0 for a patch that is ignored.
    """
    *rows, (per_pixel,), (variance_y,), (floor,), (weight,) = values
    (mean_x,), (mean_y,), (variance_x,), (covariance,) = _moments(*rows, [per_pixel])
    # Clamp rather than add the floor: a perfect match is exactly 1, and scale does not matter above the floor.
    product = torch.sqrt(torch.where(weight > 0, torch.maximum(variance_x, floor) * variance_y, 1.0))
    ncc = covariance / product
    a = -weight * per_pixel / product
    b = torch.where((weight > 0) & (variance_x > floor), weight * per_pixel * ncc / variance_x, 0.0)
    return [[weight * (1 - ncc)], [a], [a * mean_y], [b], [b * mean_x]]


def _gradient(
    x: Vector, y: Vector, valid: Vector, a: Vector, a_mean_y: Vector, b: Vector, b_mean_x: Vector
) -> list[Vector]:
    """Gradient at a pixel, from the window sums of the last four outputs of :func:`_correlate`."""
    return [[valid[0] * (y[0] * a[0] - a_mean_y[0] + x[0] * b[0] - b_mean_x[0])]]


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
