"""Project the discs of 2D Gaussian Splatting (Huang et al. 2024) to the screen, exactly in perspective."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from shellgs_method.geometry.camera import Camera
from shellgs_method.machine.elementwise import Value, Vector, cross, dot, elementwise
from shellgs_method.render.rasterizer.binning import touches
from shellgs_method.render.rasterizer.projection import (
    NEAR_PLANE,
    Projection,
    cutoffs,
    halvings,
    parameters_of,
    rotate,
    rotated_axes,
    to_camera,
)
from shellgs_method.render.rasterizer.renders import Ellipsoids

LOW_PASS = 0.5  # variance in px² of the least that a disc is wide
EDGE_ON = 1e-6  # cosine of normal and ray below which rounding decides which side of a disc shows; it is culled
MAPPING_NEAR, MAPPING_FAR = 0.2, 100.0  # depth range of the distortion, as in 2DGS


def project_discs(splats: Ellipsoids, camera: Camera, with_probe: bool = False) -> Projection:
    """Project discs with half-axes s_u t_u and s_v t_v, a splat's first two; means2d and shapes are differentiable.

    A ray z r (r_z = 1) meets the plane through m with normal n = t_u × t_v at depth z = n·m / n·r, where
    u = t_v·(m × r) / (s_u n·r) and v = -t_u·(m × r) / (s_v n·r). With r = m / m_z + e at a pixel at offset e from
    the projected centre, the constant terms of the cross products vanish, which leaves the shapes of
    :mod:`~shellgs_method.render.rasterizer.disc_kernels`.

    The centres in the camera frame are computed from ``means2d`` and depths, so that the gradient w.r.t. ``means2d``
    is the full effect of moving the disc parallel to the screen: hence two kernels, with ``means2d`` between them.
    """
    (means, quats, scales, opacities), view = splats, parameters_of(camera)
    opacities = opacities[:, None]
    means2d, depths, in_front = elementwise(_project_centres, means, *view[:2])
    found = elementwise(_project, means2d, depths, quats, scales, opacities, *view)
    shapes, outlines, covars2d, visible = (each.squeeze(0) for each in found)
    visible = (visible[:, 0] > 0) & (in_front[0, :, 0] > 0)
    outlines = outlines.unflatten(-1, (2, 7))
    projection = Projection(means2d, shapes, depths[0, :, 0].detach(), outlines, covars2d, visible)
    if not with_probe:
        return projection
    probe = means2d.detach().requires_grad_()
    fixed = (each.detach() for each in (depths, quats, scales, opacities))
    shapes = elementwise(_project, probe, *fixed, *view)[0]
    probed = torch.cat([probe, shapes[..., :-1]], dim=-1)  # all but n
    return replace(projection, probe=probe, probed=probed.squeeze(0))


def _project_centres(mean: Vector, viewmat: Vector, intrinsics: Vector) -> list[Vector]:
    """Means2d, depth, and whether the depth is beyond the near plane, 1 or 0; if not, it is set to 1."""
    fx, fy, cx, cy = intrinsics
    x, y, z = to_camera(mean, viewmat)
    in_front = z >= NEAR_PLANE
    z = torch.where(in_front, z, 1.0)  # a culled splat must not put a division by 0 into the gradients
    return [[fx * x / z + cx, fy * y / z + cy], [z], [torch.where(in_front, 1.0, 0.0)]]


def _project(
    mean2d: Vector,
    depth: Vector,
    quat: Vector,
    scale: Vector,
    opacity: Vector,
    viewmat: Vector,
    intrinsics: Vector,
    size: Vector,
) -> list[Vector]:
    """Shape, two outlines, covariance, and whether the disc is visible, 1 or 0."""
    (z,), (opacity,), (fx, fy, cx, cy) = depth, opacity, intrinsics
    rays = [(mean2d[0] - cx) / fx, (mean2d[1] - cy) / fy, 1.0]
    tangents_u, tangents_v, normals = (rotate(axis, viewmat) for axis in rotated_axes(quat))

    facing = dot(normals, rays)
    shows = torch.abs(facing.detach()) > EDGE_ON * torch.sqrt(dot(rays, rays).detach())
    facing = torch.where(shows, facing, 1.0)
    u, v = cross(tangents_v, rays), cross(rays, tangents_u)
    scale_u, scale_v, *_ = scale
    halves = math.sqrt(0.5 / math.log(2))  # exp(-u²/2) = 2^-(halves u)²
    shape_u, shape_v = halves / (scale_u * facing), halves / (scale_v * facing)
    shape = [shape_u * u[0] / fx, shape_u * u[1] / fy, shape_v * v[0] / fx, shape_v * v[1] / fy]
    inverse_depth = [1 / z, normals[0] / (fx * z * facing), normals[1] / (fy * z * facing)]
    shape = [*shape, *inverse_depth, halvings(opacity)]

    axes = ((tangents_u, scale_u), (tangents_v, scale_v))
    half_axes = [[(length * each).detach() for each in axis] for axis, length in axes]
    cutoff, z = cutoffs(opacity), z.detach()
    x, y = ((z * each).detach() for each in rays[:2])
    outline, covars2d = _outline(x, y, z, half_axes, torch.sqrt(cutoff), intrinsics, size)
    radius, none = torch.sqrt(cutoff / 2), 0 * cutoff
    conic = 1 / (radius * radius)
    low_pass = [*(each.detach() for each in mean2d), conic, none, conic, radius, radius]
    visible = shows & (cutoff > 0)
    reached = torch.where(touches(outline, size), 1.0, torch.where(touches(low_pass, size), 1.0, 0.0))
    return [shape, [*outline, *low_pass], covars2d, [torch.where(visible, reached, 0.0)]]


def disc_maps(
    alpha: Float[Tensor, "height width 1"],
    inverse_depth: Float[Tensor, "height width 1"],
    square: Float[Tensor, "height width 1"],
    median_depth: Float[Tensor, "height width 1"],
) -> dict[str, Float[Tensor, "height width 1"]]:
    """Geometry maps of a disc render, from its composited 1/z and 1/z² and its median z.

    Distortion is the L2 form of 2DGS, sum over i and j < i of w_i w_j (m_i - m_j)², with depths mapped to
    m = far / (far - near) (1 - near / z). It equals A Σ w m² - (Σ w m)², A = Σ w, in which the constant of the mapping
    cancels; leaving it out avoids rounding errors.
    """
    (distortion,) = elementwise(_distortion, alpha, inverse_depth, square)
    return {"inverse_depth": inverse_depth, "median_depth": median_depth, "distortion": distortion}


def _distortion(alpha: Vector, inverse_depth: Vector, square: Vector) -> list[Vector]:
    mapping = MAPPING_FAR * MAPPING_NEAR / (MAPPING_FAR - MAPPING_NEAR)
    return [[mapping**2 * (alpha[0] * square[0] - inverse_depth[0] * inverse_depth[0])]]


def _outline(
    x: Value, y: Value, z: Value, half_axes: Sequence[Vector], radius: Value, intrinsics: Vector, size: Vector
) -> tuple[list[Value], list[Value]]:
    """Ellipse around a disc of a radius in half-axes, and the covariance of the disc as if seen from afar.

    Where the whole disc is well in front of the camera, the ellipse is exact, plus a tenth of a pixel in quadrature.
    Else it surrounds the projected box of the disc, clipped at the near plane and at the image border.
    """
    (fx, fy, cx, cy), (width, height) = intrinsics, size
    # A disc's point (u, v) is at (across, down)·(u, v) / (z + along·(u, v)) from the projected centre.
    along = [axis[2] for axis in half_axes]
    across = [fx * (axis[0] - x / z * axis[2]) for axis in half_axes]
    down = [fy * (axis[1] - y / z * axis[2]) for axis in half_axes]
    xx, xy, yy = dot(across, across), dot(across, down), dot(down, down)
    x_along, y_along, along_squared = dot(across, along), dot(down, along), dot(along, along)
    area = across[0] * down[1] - across[1] * down[0]

    in_front = radius * torch.sqrt(along_squared) < 0.95 * z
    # The dual conic of the circle |(u, v)| = radius.
    scale = radius * radius / torch.where(in_front, z * z - radius * radius * along_squared, 1.0)
    centre_x, centre_y = fx * x / z + cx - scale * x_along, fy * y / z + cy - scale * y_along
    slack = 0.01
    shift_x, shift_y = scale * x_along, scale * y_along
    covar_xx = scale * xx + shift_x * shift_x + slack
    covar_xy = scale * xy + shift_x * shift_y
    covar_yy = scale * yy + shift_y * shift_y + slack
    scaled = scale * area
    determinant = scaled * scaled * (1 + scale * along_squared) + slack * (covar_xx + covar_yy - slack)

    reach_x, reach_y, reach_z = (radius * torch.sqrt(dot(each, each)) for each in zip(*half_axes, strict=True))
    nearest, farthest = torch.clamp_min(z - reach_z, NEAR_PLANE), z + reach_z

    def box(centre: Value, reach: Value, focal: Value, principal: Value, size: Value) -> tuple[Value, Value]:
        low, high = centre - reach, centre + reach
        low = focal * torch.minimum(low / nearest, low / farthest) + principal
        high = focal * torch.maximum(high / nearest, high / farthest) + principal
        low, high = (torch.minimum(torch.relu(each), size) for each in (low, high))
        return (low + high) / 2, torch.clamp_min((high - low) / 2, slack) * math.sqrt(2)

    box_x, box_reach_x = box(x, reach_x, fx, cx, width)
    box_y, box_reach_y = box(y, reach_y, fy, cy, height)
    conic = [covar_yy / determinant, -covar_xy / determinant, covar_xx / determinant]
    exact = [centre_x, centre_y, *conic, torch.sqrt(covar_xx), torch.sqrt(covar_yy)]
    conic = [1 / (box_reach_x * box_reach_x), 0 * z, 1 / (box_reach_y * box_reach_y)]
    around_box = [box_x, box_y, *conic, box_reach_x, box_reach_y]
    outline = [torch.where(in_front, *each) for each in zip(exact, around_box, strict=True)]
    return outline, [xx / (z * z) + LOW_PASS, xy / (z * z), yy / (z * z) + LOW_PASS]
