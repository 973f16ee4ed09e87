"""Kernels for screen-space Gaussians.

The shape of a Gaussian is a, b, c, n: at a pixel (dx, dy) from its centre, z = a dx² + b dx dy + c dy² + n.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from shellgs_method.render.rasterizer.kernels import Kernels, attenuate, backward_step_groups, look_up

_NULL_SHAPE = (0.0, 0.0, 0.0, 0.0, 0.0, math.inf)
_N_SHAPE = len(_NULL_SHAPE)


def _forward(
    transmittance: Float[Tensor, "G P V"],
    totals: list[Float[Tensor, "G P V"]],
    table: Float[Tensor, "N K"],
    splats: Int[Tensor, "G L V"],
    centres: Float[Tensor, "G 2 V"],
    x: Float[Tensor, "1 P 1"],
    y: Float[Tensor, "1 P 1"],
    stop: Float[Tensor, "G 1 V"],
) -> tuple[Float[Tensor, "G P V"], Float[Tensor, "G V"]]:
    params = look_up(table, splats, centres)
    sums = list(totals)
    for splat in params[:, :, None].unbind(3):
        _, weight, transmittance = attenuate(_exponent(splat, x, y), transmittance, stop)
        values = splat[:, _N_SHAPE:].unbind(1)
        sums = [total + weight * value for total, value in zip(sums, values, strict=True)]
    for total, new in zip(totals, sums, strict=True):
        total.copy_(new)
    return transmittance, transmittance.amax(1)


def _backward(
    transmittance: Float[Tensor, "G P V"],
    behinds: list[Float[Tensor, "G P V"]],
    gradients: list[Float[Tensor, "G P V"]],
    others: list[Float[Tensor, "G P V"]],
    grad_params: Float[Tensor, "G L V K"],
    table: Float[Tensor, "N K"],
    splats: Int[Tensor, "G L V"],
    centres: Float[Tensor, "G 2 V"],
    x: Float[Tensor, "1 P 1"],
    y: Float[Tensor, "1 P 1"],
    stop: Float[Tensor, "G 1 V"],
) -> None:
    params = look_up(table, splats, centres)
    chunk = params[:, :, None].unbind(3)
    recomputed = []
    for splat in chunk:
        z = _exponent(splat, x, y)
        alpha, weight, transmittance = attenuate(z, transmittance, stop)
        recomputed.append((z, alpha, weight))

    befores, grad_z = list(behinds), []
    for splat, (z, alpha, weight) in zip(reversed(chunk), reversed(recomputed), strict=True):
        groups = [gradients, others] if others else [gradients]
        grad_z.append(backward_step_groups(befores, z, alpha, weight, groups, splat[:, _N_SHAPE:].unbind(1)))
    for behind, before in zip(behinds, befores, strict=True):
        behind.copy_(before)

    # u, v, a, b, c and n get moments of the gradient of z about the splat's centre, shifted there from the tile's.
    q, w = (
        torch.stack([of_all for of_all, _ in grad_z[::-1]]),
        torch.stack([weight for *_, weight in recomputed]),
    )  # [L G P V]
    qx, qy = q * x, q * y
    q, sx, sy, sxx, sxy, syy = (moment.sum(2) for moment in (q, qx, qy, qx * x, qx * y, qy * y))
    u, v, a, b, c = params[:, :5].permute(1, 2, 0, 3)
    mx, my = sx - u * q, sy - v * q
    mxx, mxy, myy = sxx - u * (sx + mx), sxy - u * sy - v * mx, syy - v * (sy + my)
    shape = [-2 * a * mx - b * my, -b * mx - 2 * c * my, mxx, mxy, myy, q]
    columns = [*shape, *((w * gradient).sum(2) for gradient in [*gradients, *others])]
    if others:
        q = torch.stack([of_first for _, of_first in grad_z[::-1]])
        sq = q.sum(2)
        mx, my = (q * x).sum(2) - u * sq, (q * y).sum(2) - v * sq
        columns += [-2 * a * mx - b * my, -b * mx - 2 * c * my]
    grad_params.copy_(torch.stack(columns).permute(2, 1, 3, 0))


def _exponent(splat: Float[Tensor, "G K 1 V"], x: Float[Tensor, "1 P 1"], y: Float[Tensor, "1 P 1"]) -> Tensor:
    u, v, a, b, c, n = splat[:, :_N_SHAPE].unbind(1)  # unbinding more takes longer to compile
    dx, dy = x - u, y - v
    return (a * dx + b * dy) * dx + c * dy * dy + n


GAUSSIANS = Kernels(_NULL_SHAPE, 0, _forward, _backward, n_probed=2, n_unweighted=0)
