"""The arithmetic of compositing: one chunk of splats over many tiles at once.

Shapes: G groups of V tiles side by side in the innermost dimension, so that a vector unit works on V tiles and every
pixel of a tile meets the same splat; P pixels of a tile; L splats of a chunk, front to back.

A splat's parameters are u, v, a, b, c, n and its features, the last of which is 1 and composites to alpha. Of a pixel
at (x, y), with dx = x - u and dy = y - v, z = a dx² + b dx dy + c dy² + n is how many times alpha has halved below its
limit: alpha = ALPHA_MAX 2^-max(z, 0).

What the kernels need besides splats and state: x and y of a tile's pixels from its centre, and ``stop``, which is
TRANSMITTANCE_MIN in a tensor whose dimensions are groups and lanes, but not pixels. As a number it would let inductor
merge the loops over pixels and lanes wherever nothing else tells them apart, and not fuse these statements with others.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from shellgs_method.rasterizer.projection import ALPHA_MAX, ALPHA_MIN

TRANSMITTANCE_MIN = 1e-4  # a pixel stops before the splat that would bring it there
N_SHAPE = 6  # parameters of a splat before its features
NULL_SHAPE = (0.0, 0.0, 0.0, 0.0, 0.0, math.inf)  # of a splat whose alpha is 0 everywhere
Z_MAX = math.log2(ALPHA_MAX / ALPHA_MIN)


def forward_chunk(
    transmittance: Float[Tensor, "G P V"],  # 0 once the pixel has stopped
    totals: list[Float[Tensor, "G P V"]],  # composited so far, of each feature
    params: Float[Tensor, "G K L V"],
    x: Float[Tensor, "1 P 1"],
    y: Float[Tensor, "1 P 1"],
    stop: Float[Tensor, "G 1 V"],
) -> tuple[Float[Tensor, "G P V"], list[Float[Tensor, "G P V"]]]:
    """Transmittance and totals behind a chunk from those before it."""
    for splat in params.unbind(2):
        _, _, weight, transmittance = _meet(splat, transmittance, x, y, stop)
        totals = [total + weight * splat[:, N_SHAPE + c, None] for c, total in enumerate(totals)]
    return transmittance, totals


def backward_chunk(
    transmittance: Float[Tensor, "G P V"],  # before the chunk
    behind: Float[Tensor, "G P V"],
    gradients: list[Float[Tensor, "G P V"]],  # of the composited features
    params: Float[Tensor, "G K L V"],
    x: Float[Tensor, "1 P 1"],
    y: Float[Tensor, "1 P 1"],
    stop: Float[Tensor, "G 1 V"],
) -> tuple[Float[Tensor, "G P V"], Float[Tensor, "K L G V"]]:
    """Walk a chunk back to front: the new ``behind``, and the gradients of the parameters, summed over a tile's pixels.

    With g_i = the gradient of the loss by the weight w_i = alpha_i T_i, ``behind`` is the sum of g_j w_j of the splats
    behind a chunk, over their transmittance. It needs no division: behind += alpha_i (g_i - behind), and the loss has
    the gradient T_i (g_i - behind) by alpha_i.
    """
    splats = params.unbind(2)
    met = []
    for splat in splats:
        z, alpha, weight, transmittance = _meet(splat, transmittance, x, y, stop)
        met.append((z, alpha, weight))

    grad_z, weights = [], []
    for splat, (z, alpha, weight) in zip(reversed(splats), reversed(met), strict=True):
        excess = -behind
        for c, grad in enumerate(gradients):
            excess = excess + grad * splat[:, N_SHAPE + c, None]
        behind = behind + alpha * excess
        # d alpha / dz = -ln 2 alpha, and 0 where alpha is at its limit
        grad_z.append(torch.where(z > 0, (-math.log(2)) * weight * excess, 0.0))
        weights.append(weight)

    # u, v, a, b, c and n take the moments of grad_z about the splat's centre, shifted there from the tile's.
    q, w = torch.stack(grad_z[::-1]), torch.stack(weights[::-1])  # [L, G, P, V]
    qx, qy = q * x, q * y
    q, sx, sy, sxx, sxy, syy = (moment.sum(2) for moment in (q, qx, qy, qx * x, qx * y, qy * y))
    u, v, a, b, c = params[:, :5].permute(1, 2, 0, 3)
    mx, my = sx - u * q, sy - v * q
    mxx, mxy, myy = sxx - u * (sx + mx), sxy - u * sy - v * mx, syy - v * (sy + my)
    shape = [-2 * a * mx - b * my, -b * mx - 2 * c * my, mxx, mxy, myy, q]
    return behind, torch.stack([*shape, *((w * grad).sum(2) for grad in gradients)])


def _meet(
    splat: Float[Tensor, "G K V"],
    transmittance: Float[Tensor, "G P V"],
    x: Float[Tensor, "1 P 1"],
    y: Float[Tensor, "1 P 1"],
    stop: Float[Tensor, "G 1 V"],
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The exponent z, alpha (0 where it does not count), the weight, and the transmittance behind a splat."""
    u, v, a, b, c, n = (splat[:, k, None] for k in range(N_SHAPE))
    dx, dy = x - u, y - v
    z = (a * dx + b * dy) * dx + c * dy * dy + n
    alpha = torch.where(z <= Z_MAX, ALPHA_MAX * _halve(torch.relu(z)), 0.0)
    after = transmittance - alpha * transmittance
    counts = after > stop
    alpha = torch.where(counts, alpha, 0.0)
    return z, alpha, alpha * transmittance, torch.where(counts, after, 0.0)


def _halve(z: Tensor) -> Tensor:
    """2^-z for z from 0 to 8: if compiled in float32 to 3e-6, by the minimax polynomial of 2^(-z/8), squared thrice.

    It is what vectorises best; a call of the library's exp2 doubles the time of the kernels.
    """
    if not torch.compiler.is_compiling() or z.dtype != torch.float32:
        return torch.exp2(-z)
    power = -2.8649545e-08 * z + 2.2433135e-06
    for coefficient in (-1.0796821e-04, 3.7526905e-03, -8.6642779e-02, 0.99999994):
        power = power * z + coefficient
    for _ in range(3):
        power = power * power
    return power
