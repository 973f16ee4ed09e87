"""Kernels for screen-space Gaussians.

The shape of a Gaussian is a, b, c, n: at a pixel (dx, dy) from its centre, z = a dx² + b dx dy + c dy² + n.
"""

from __future__ import annotations

import math

from shellgs_method.machine.elementwise import Value, Vector
from shellgs_method.render.rasterizer.kernels import Evaluated, Kernels


def _evaluate(shape: Vector, x: Value, y: Value) -> Evaluated:
    u, v, a, b, c, n = shape
    dx, dy = x - u, y - v
    return Evaluated((a * dx + b * dy) * dx + c * dy * dy + n)


def _moments(
    at: Evaluated, x: Value, y: Value, grad_z: Value, grad_maps: Vector, grad_depth: Value | None
) -> list[Value]:
    del at, grad_maps, grad_depth
    qx, qy = grad_z * x, grad_z * y
    return [grad_z, qx, qy, qx * x, qx * y, qy * y]


def _gradients(shape: Vector, sums: Vector) -> list[Value]:
    """Gradients of u, v, a, b, c and n by moments about the splat's centre, shifted there from the tile's."""
    u, v, a, b, c, _ = shape
    q, sx, sy, sxx, sxy, syy = sums
    mx, my = sx - u * q, sy - v * q
    mxx, mxy, myy = sxx - u * (sx + mx), sxy - u * sy - v * mx, syy - v * (sy + my)
    return [-2 * a * mx - b * my, -b * mx - 2 * c * my, mxx, mxy, myy, q]


GAUSSIANS = Kernels((0.0, 0.0, 0.0, 0.0, 0.0, math.inf), 0, _evaluate, _moments, _gradients, n_moments=6, n_probed=2)
