"""Compositing of discs, met by each pixel's ray where it goes through their planes.

At a pixel (dx, dy) from the projected centre, what is linear along a plane is affine over its depth. The shape of a
disc is a, b, c, d, p, q, r, n: its local coordinates, in units that make the exponent s² + t², and inverse depth are

    s = (a dx + b dy) / i,  t = (c dx + d dy) / i,  i = p + q dx + r dy,

and the exponent with the low-pass of 2DGS, which keeps a disc seen edge-on or from afar as wide as a pixel, is
z = min(s² + t², (dx² + dy²) / ln 2) + n. Where the ray meets the plane behind the near plane, if at all, only the
low-pass counts, at the depth of the centre, which is a constant there.

Its maps are the weighted sums of inverse depth and of its square; and the median depth, that of the splat at which the
transmittance falls to 1/2 or less, whose gradient goes to that splat's depth alone.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from shellgs_method.rasterizer.kernels import Kernels, attenuate, look_up, walk_back_groups
from shellgs_method.rasterizer.projection import NEAR_PLANE

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
        median = torch.where(_halves(before, transmittance), depth, median)
    for total, new in zip(totals, [*sums, median], strict=True):
        total.copy_(new)
    return transmittance, transmittance.amax(1)


def _backward(
    transmittance: Float[Tensor, "G P V"],
    behinds: list[Float[Tensor, "G P V"]],
    gradients: list[Float[Tensor, "G P V"]],
    others: list[Float[Tensor, "G P V"]],
    by_params: Float[Tensor, "G L V K"],
    table: Float[Tensor, "N K"],
    splats: Int[Tensor, "G L V"],
    centres: Float[Tensor, "G 2 V"],
    x: Float[Tensor, "1 P 1"],
    y: Float[Tensor, "1 P 1"],
    stop: Float[Tensor, "G 1 V"],
) -> None:
    params = look_up(table, splats, centres)
    chunk = params[:, :, None].unbind(3)
    *groups, (*last, by_median) = [gradients, others] if others else [gradients]
    groups = [*groups, last]
    by_inverse, by_square = last[-2:]
    met = []
    for splat in chunk:
        intersection = _intersect(splat, x, y)
        before = transmittance
        alpha, weight, transmittance = attenuate(intersection[0], before, stop)
        met.append((intersection, alpha, weight, torch.where(_halves(before, transmittance), by_median, 0.0)))

    befores, by_z = list(behinds), []
    for splat, (intersection, alpha, weight, _) in zip(reversed(chunk), reversed(met), strict=True):
        z, *_, inverse_depth, _ = intersection
        values = [*splat[:, _N_SHAPE:].unbind(1), inverse_depth, inverse_depth * inverse_depth]
        by_z.append(walk_back_groups(befores, z, alpha, weight, groups, values))
    for behind, before in zip(behinds, befores, strict=True):
        behind.copy_(before)

    # All splats at once, [L, G, P, V]. Meeting them again is cheaper than storing what was met.
    of_all, of_first = zip(*by_z[::-1], strict=True)
    by_z = torch.stack(of_all)
    w = torch.stack([weight for _, _, weight, _ in met])
    by_median = torch.stack([each for *_, each in met])
    _, ahead, s, t, depth, inverse_depth, hits = _intersect(params.permute(2, 0, 1, 3)[:, :, :, None], x, y)
    by_i = hits * (w * (by_inverse + 2 * inverse_depth * by_square) - depth * depth * by_median)
    u, v, a, b, c, d, _, q, r = params[:, : _N_SHAPE - 1].permute(1, 2, 0, 3)

    def moments(gradient: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Sum, and first moments about the splat's centre, shifted there from the tile's."""
        total = gradient.sum(2)
        return total, (gradient * x).sum(2) - u * total, (gradient * y).sum(2) - v * total

    def by_shape(by_z: Tensor, by_i: Tensor | float) -> list[Tensor]:
        # by the numerators of s and t, by inverse depth, and by the exponent where the low-pass decides
        by_radius = torch.where(ahead > 0, 2 * by_z * depth, 0.0)
        by_s, by_t, by_screen = by_radius * s, by_radius * t, torch.where(ahead > 0, 0.0, by_z)
        by_i = by_i - (by_s * s + by_t * t)
        of_s, of_t, of_i, (_, nx, ny) = (moments(each) for each in (by_s, by_t, by_i, by_screen))
        by_u = -(a * of_s[0] + c * of_t[0] + q * of_i[0] + 2 * _LOW_PASS * nx)
        by_v = -(b * of_s[0] + d * of_t[0] + r * of_i[0] + 2 * _LOW_PASS * ny)
        return [by_u, by_v, *of_s[1:], *of_t[1:], *of_i, by_z.sum(2)]

    columns = by_shape(by_z, by_i)
    columns += [(w * gradient).sum(2) for gradient in [each for group in groups for each in group][:-2]]
    if others:
        columns += by_shape(torch.stack(of_first), 0.0)[:_N_PROBED]
    by_params.copy_(torch.stack(columns).permute(2, 1, 3, 0))


def _intersect(
    splat: Float[Tensor, "*L G K 1 V"], x: Float[Tensor, "1 P 1"], y: Float[Tensor, "1 P 1"]
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """The exponent, how far the low-pass is behind the plane's point, s, t, depth, inverse depth, and if the ray hits.

    The point decides where the second is positive. That the ray hits is a number, 1 or 0, since stored truth values do
    not vectorise.
    """
    u, v, a, b, c, d, p, q, r, n, *_ = splat.unbind(-3)
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


def _halves(before: Tensor, behind: Tensor) -> Tensor:
    """Whether the transmittance crosses 1/2."""
    return (before > 0.5) & (behind <= 0.5)


DISCS = Kernels(_NULL_SHAPE, _N_MAPS, _forward, _backward, _N_PROBED)
