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

from shellgs_method.machine.elementwise import Value, Vector
from shellgs_method.render.rasterizer.kernels import Evaluated, Kernels
from shellgs_method.render.rasterizer.projection import NEAR_PLANE

_LOW_PASS = 1 / math.log(2)  # exponent over squared distance in pixels: rho = 2 |x - c|², alpha ~ exp(-rho / 2)
_NULL_SHAPE = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, math.inf)


def _evaluate(shape: Vector, x: Value, y: Value) -> Evaluated:
    """The rest are the low-pass minus the plane's exponent (``ahead``), s, t, and whether the ray hits, 1 or 0.

    The intersection decides where ``ahead`` is positive.
    """
    u, v, a, b, c, d, p, q, r, n = shape
    dx, dy = x - u, y - v
    inverse_depth = p + q * dx + r * dy
    in_front = (inverse_depth > 0) & (inverse_depth <= 1 / NEAR_PLANE)
    inverse_depth = torch.where(in_front, inverse_depth, p)
    depth = 1 / inverse_depth
    s, t = (a * dx + b * dy) * depth, (c * dx + d * dy) * depth
    plane, screen = s * s + t * t, (dx * dx + dy * dy) * _LOW_PASS
    ahead = torch.where(in_front, screen - plane, -1.0)
    z, hits = torch.where(ahead > 0, plane, screen) + n, torch.where(in_front, 1.0, 0.0)
    return Evaluated(z, (inverse_depth, inverse_depth * inverse_depth), depth, (ahead, s, t, hits))


def _moments(
    at: Evaluated, x: Value, y: Value, grad_z: Value, grad_maps: Vector, grad_depth: Value | None
) -> list[Value]:
    """Sums and first moments of the gradients w.r.t. the numerators of s and t, and the inverse depth; of that w.r.t.
    the exponent where the low-pass decides; and the sum of that w.r.t. the exponent.
    """
    assert at.depth is not None
    inverse_depth, (ahead, s, t, hits) = at.maps[0], at.rest
    grad_radius = torch.where(ahead > 0, 2 * grad_z * at.depth, 0.0)
    grad_s, grad_t, grad_screen = grad_radius * s, grad_radius * t, torch.where(ahead > 0, 0.0, grad_z)
    grad_i = -(grad_s * s + grad_t * t)
    if grad_maps:
        of_inverse, of_square = grad_maps
        grad_i = grad_i + hits * (of_inverse + 2 * inverse_depth * of_square - at.depth * at.depth * grad_depth)
    return [each * by for each in (grad_s, grad_t, grad_i, grad_screen) for by in (1.0, x, y)] + [grad_z]


def _gradients(shape: Vector, sums: Vector) -> list[Value]:
    """Gradients by moments about the splat's centre, shifted there from the tile's."""
    u, v, a, b, c, d, _, q, r, _ = shape
    of_s, of_t, of_i, (_, nx, ny) = (
        (total, sx - u * total, sy - v * total) for total, sx, sy in (sums[i : i + 3] for i in range(0, 12, 3))
    )
    grad_u = -(a * of_s[0] + c * of_t[0] + q * of_i[0] + 2 * _LOW_PASS * nx)
    grad_v = -(b * of_s[0] + d * of_t[0] + r * of_i[0] + 2 * _LOW_PASS * ny)
    return [grad_u, grad_v, *of_s[1:], *of_t[1:], *of_i, sums[12]]


DISCS = Kernels(_NULL_SHAPE, 3, _evaluate, _moments, _gradients, n_moments=13, n_probed=len(_NULL_SHAPE) - 1)  # but n
