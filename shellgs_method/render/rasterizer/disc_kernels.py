"""Kernels for discs, evaluated where each pixel's ray intersects their planes.

A function linear on a plane is, at a pixel (dx, dy) from the projected centre, affine in dx, dy times depth. The shape
of a disc is a, b, c, d, p, q, r, n: local coordinates, in units that make the exponent s² + t², and inverse depth are

    s = (a dx + b dy) / i,  t = (c dx + d dy) / i,  i = p + q dx + r dy,

and the exponent with the low-pass of 2DGS, which keeps a disc seen edge-on or from afar as wide as a pixel, is
z = min(s² + t², (dx² + dy²) / ln 2) + n. Where the ray does not meet the plane in front of the near plane, only the
low-pass counts, at the depth of the centre, which is a constant there.

The maps are the weighted sums of inverse depth and of its square, and the median depth: that of the splat at which the
transmittance falls to 1/2 or less, with a gradient to that splat's depth alone.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from shellgs_method.render.rasterizer.kernels import Kernels, attenuate, backward_step_groups, look_up
from shellgs_method.render.rasterizer.projection import NEAR_PLANE

_LOW_PASS = 1 / math.log(2)  # exponent over squared distance in pixels: rho = 2 |x - c|², alpha ~ exp(-rho / 2)
_NULL_SHAPE = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, math.inf)
_N_SHAPE, _N_MAPS = len(_NULL_SHAPE), 3
_N_PROBED = _N_SHAPE - 1  # all but n


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
    *sums, median = totals
    for splat in params[:, :, None].unbind(3):
        z, _, _, _, depth, inverse_depth, _ = _intersect(splat, x, y)
        before = transmittance
        _, weight, transmittance = attenuate(z, before, stop)
        values = [*splat[:, _N_SHAPE:].unbind(1), inverse_depth, inverse_depth * inverse_depth]
        sums = [total + weight * value for total, value in zip(sums, values, strict=True)]
        median = torch.where(_crosses_half(before, transmittance), depth, median)
    for total, new in zip(totals, [*sums, median], strict=True):
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
    *groups, (*last, grad_median) = [gradients, others] if others else [gradients]
    groups = [*groups, last]
    grad_inverse, grad_square = last[-2:]
    recomputed = []
    for splat in chunk:
        intersection = _intersect(splat, x, y)
        before = transmittance
        alpha, weight, transmittance = attenuate(intersection[0], before, stop)
        recomputed.append(
            (intersection, alpha, weight, torch.where(_crosses_half(before, transmittance), grad_median, 0.0))
        )

    befores, grad_z = list(behinds), []
    for splat, (intersection, alpha, weight, _) in zip(reversed(chunk), reversed(recomputed), strict=True):
        z, *_, inverse_depth, _ = intersection
        values = [*splat[:, _N_SHAPE:].unbind(1), inverse_depth, inverse_depth * inverse_depth]
        grad_z.append(backward_step_groups(befores, z, alpha, weight, groups, values))
    for behind, before in zip(behinds, befores, strict=True):
        behind.copy_(before)

    # All splats at once, [L, G, P, V]. Recomputing the intersections is cheaper than storing them.
    of_all, of_first = zip(*grad_z[::-1], strict=True)
    grad_z = torch.stack(of_all)
    w = torch.stack([weight for _, _, weight, _ in recomputed])
    grad_median = torch.stack([each for *_, each in recomputed])
    _, ahead, s, t, depth, inverse_depth, hits = _intersect(params.permute(2, 0, 1, 3)[:, :, :, None], x, y)
    grad_i = hits * (w * (grad_inverse + 2 * inverse_depth * grad_square) - depth * depth * grad_median)
    u, v, a, b, c, d, _, q, r = params[:, : _N_SHAPE - 1].permute(1, 2, 0, 3)

    def moments(gradient: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Sum and first moments about the splat's centre, shifted there from the tile's."""
        total = gradient.sum(2)
        return total, (gradient * x).sum(2) - u * total, (gradient * y).sum(2) - v * total

    def shape_gradients(grad_z: Tensor, grad_i: Tensor | float) -> list[Tensor]:
        # w.r.t. the numerators of s and t, the inverse depth, and the exponent where the low-pass decides
        grad_radius = torch.where(ahead > 0, 2 * grad_z * depth, 0.0)
        grad_s, grad_t, grad_screen = grad_radius * s, grad_radius * t, torch.where(ahead > 0, 0.0, grad_z)
        grad_i = grad_i - (grad_s * s + grad_t * t)
        of_s, of_t, of_i, (_, nx, ny) = (moments(each) for each in (grad_s, grad_t, grad_i, grad_screen))
        grad_u = -(a * of_s[0] + c * of_t[0] + q * of_i[0] + 2 * _LOW_PASS * nx)
        grad_v = -(b * of_s[0] + d * of_t[0] + r * of_i[0] + 2 * _LOW_PASS * ny)
        return [grad_u, grad_v, *of_s[1:], *of_t[1:], *of_i, grad_z.sum(2)]

    columns = shape_gradients(grad_z, grad_i)
    columns += [(w * gradient).sum(2) for gradient in [each for group in groups for each in group][:-2]]
    if others:
        columns += shape_gradients(torch.stack(of_first), 0.0)[:_N_PROBED]
    grad_params.copy_(torch.stack(columns).permute(2, 1, 3, 0))


def _intersect(
    splat: Float[Tensor, "*L G K 1 V"], x: Float[Tensor, "1 P 1"], y: Float[Tensor, "1 P 1"]
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Exponent, low-pass minus plane exponent (``ahead``), s, t, depth, inverse depth, and whether the ray hits.

    The intersection decides where ``ahead`` is positive. Hits are numbers, 1 or 0: stored booleans do not vectorise.
    """
    u, v, a, b, c, d, p, q, r, n = splat[..., :_N_SHAPE, :, :].unbind(-3)
    dx, dy = x - u, y - v
    inverse_depth = p + q * dx + r * dy
    in_front = (inverse_depth > 0) & (inverse_depth <= 1 / NEAR_PLANE)
    inverse_depth = torch.where(in_front, inverse_depth, p)
    depth = 1 / inverse_depth
    s, t = (a * dx + b * dy) * depth, (c * dx + d * dy) * depth
    plane, screen = s * s + t * t, (dx * dx + dy * dy) * _LOW_PASS
    ahead = torch.where(in_front, screen - plane, -1.0)
    z = torch.where(ahead > 0, plane, screen) + n
    return z, ahead, s, t, depth, inverse_depth, torch.where(in_front, 1.0, 0.0)


def _crosses_half(before: Tensor, behind: Tensor) -> Tensor:
    """Whether the transmittance crosses 1/2."""
    return (before > 0.5) & (behind <= 0.5)


DISCS = Kernels(_NULL_SHAPE, _N_MAPS, _forward, _backward, _N_PROBED, n_unweighted=1)
