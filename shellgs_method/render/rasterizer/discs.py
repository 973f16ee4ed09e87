"""Project the discs of 2D Gaussian Splatting (Huang et al. 2024) to the screen, exactly in perspective."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from shellgs_method.geometry.camera import Camera
from shellgs_method.machine.compilation import detached, run_fused
from shellgs_method.render.rasterizer.binning import touches
from shellgs_method.render.rasterizer.projection import (
    NEAR_PLANE,
    Projection,
    cross,
    cutoffs,
    dot,
    halvings,
    rotate,
    rotated_axes,
    stack_cameras,
    to_camera,
)

LOW_PASS = 0.5  # variance in px² of the least that a disc is wide
EDGE_ON = 1e-6  # cosine of normal and ray below which rounding decides which side of a disc shows; it is culled
MAPPING_NEAR, MAPPING_FAR = 0.2, 100.0  # depth range of the distortion, as in 2DGS


def project_discs(
    means: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    scales: Float[Tensor, "N 3"],
    opacities: Float[Tensor, "N"],
    cameras: Sequence[Camera],
    with_probe: bool = False,
) -> Projection:
    """Project discs with half-axes s_u t_u and s_v t_v, a splat's first two; means2d and shapes are differentiable.

    A ray z r (r_z = 1) meets the plane through m with normal n = t_u × t_v at depth z = n·m / n·r, where
    u = t_v·(m × r) / (s_u n·r) and v = -t_u·(m × r) / (s_v n·r). With r = m / m_z + e at a pixel at offset e from
    the projected centre, the constant terms of the cross products vanish, which leaves the shapes of
    :mod:`~shellgs_method.render.rasterizer.disc_kernels`.

    The centres in the camera frame are computed from ``means2d`` and depths, so that the gradient w.r.t. ``means2d``
    is the full effect of moving the disc parallel to the screen: hence two kernels, with ``means2d`` between them.
    """
    views = stack_cameras(cameras)
    means2d, depths, in_front = run_fused(_project_centres, means, *views, strided=True)
    shapes, outlines, covars2d, visible = run_fused(
        _project, means2d, depths, quats, scales, opacities, *views, strided=True
    )
    projection = Projection(means2d, shapes, depths.detach(), outlines, covars2d, visible & in_front)
    if not with_probe:
        return projection
    probe = detached(means2d).requires_grad_()
    fixed = (each.detach() for each in (quats, scales, opacities))
    shapes = run_fused(_project, probe, detached(depths), *fixed, *views, strided=True)[0]
    return replace(projection, probe=probe, probed=torch.cat([probe, shapes[..., :-1]], dim=-1))  # all but n


def _project_centres(
    means: Float[Tensor, "N 3"],
    viewmats: Float[Tensor, "B 4 4"],
    intrinsics: Float[Tensor, "B 4 1"],
    size: Float[Tensor, "1 2"],
) -> tuple[Float[Tensor, "B N 2"], Float[Tensor, "B N"], Bool[Tensor, "B N"]]:
    """Means2d, depths, and whether the depth is beyond the near plane; if not, it is set to 1."""
    del size
    fx, fy, cx, cy = intrinsics.unbind(1)
    x, y, z = to_camera(means, viewmats)
    in_front = z.detach() >= NEAR_PLANE
    z = torch.where(in_front, z, 1.0)  # a culled splat must not put a division by 0 into the gradients
    return torch.stack([fx * x / z + cx, fy * y / z + cy], dim=-1), z, in_front


def _project(
    means2d: Float[Tensor, "B N 2"],
    z: Float[Tensor, "B N"],
    quats: Float[Tensor, "N 4"],
    scales: Float[Tensor, "N 3"],
    opacities: Float[Tensor, "N"],
    viewmats: Float[Tensor, "B 4 4"],
    intrinsics: Float[Tensor, "B 4 1"],
    size: Float[Tensor, "1 2"],
) -> tuple[Tensor, ...]:
    fx, fy, cx, cy = intrinsics.unbind(1)
    rays = [(means2d[..., 0] - cx) / fx, (means2d[..., 1] - cy) / fy, torch.ones_like(z)]
    tangents_u, tangents_v, normals = (rotate(axis, viewmats) for axis in rotated_axes(quats))

    facing = dot(normals, rays)
    shows = facing.detach().abs() > EDGE_ON * dot(rays, rays).detach().sqrt()
    facing = torch.where(shows, facing, 1.0)
    u, v = cross(tangents_v, rays), cross(rays, tangents_u)
    scale_u, scale_v = scales[:, 0], scales[:, 1]
    halves = math.sqrt(0.5 / math.log(2))  # exp(-u²/2) = 2^-(halves u)²
    shape_u, shape_v = halves / (scale_u * facing), halves / (scale_v * facing)
    shapes = [shape_u * u[0] / fx, shape_u * u[1] / fy, shape_v * v[0] / fx, shape_v * v[1] / fy]
    inverse_depth = [1 / z, normals[0] / (fx * z * facing), normals[1] / (fy * z * facing)]
    shapes = torch.stack([*shapes, *inverse_depth, halvings(opacities).expand_as(z)], dim=-1)

    axes = ((tangents_u, scale_u), (tangents_v, scale_v))
    half_axes = [[(scale * each).detach() for each in axis] for axis, scale in axes]
    cutoff = cutoffs(opacities)
    x, y = ((z * each).detach() for each in rays[:2])
    outline, covars2d = _outlines(x, y, z.detach(), half_axes, cutoff.sqrt(), intrinsics, size)
    radius = (cutoff / 2).sqrt().expand_as(z)
    conic = [1 / radius.square(), torch.zeros_like(z), 1 / radius.square()]
    low_pass = torch.stack([*means2d.detach().unbind(-1), *conic, radius, radius], dim=-1)
    outlines = torch.stack([outline, low_pass], dim=-2)
    visible = shows & (cutoff > 0) & touches(outlines, size).any(dim=-1)
    return shapes, outlines, covars2d, visible


def disc_maps(
    alpha: Float[Tensor, "*batch 1"], maps: Float[Tensor, "*batch 3"]
) -> dict[str, Float[Tensor, "*batch 1"]]:
    """Geometry maps of a disc render, from its composited 1/z and 1/z² and its median z.

    Distortion is the L2 form of 2DGS, sum over i and j < i of w_i w_j (m_i - m_j)², with depths mapped to
    m = far / (far - near) (1 - near / z). It equals A Σ w m² - (Σ w m)², A = Σ w, in which the constant of the mapping
    cancels; leaving it out avoids rounding errors.
    """
    inverse_depth, square, median_depth = maps.split(1, dim=-1)
    mapping = MAPPING_FAR * MAPPING_NEAR / (MAPPING_FAR - MAPPING_NEAR)
    distortion = mapping**2 * (alpha * square - inverse_depth.square())
    return {"inverse_depth": inverse_depth, "median_depth": median_depth, "distortion": distortion}


def _outlines(
    x: Float[Tensor, "B N"],
    y: Float[Tensor, "B N"],
    z: Float[Tensor, "B N"],
    half_axes: Sequence[Sequence[Float[Tensor, "B N"]]],
    radius: Float[Tensor, "N"],
    intrinsics: Float[Tensor, "B 4 1"],
    size: Float[Tensor, "1 2"],
) -> tuple[Float[Tensor, "B N 7"], Float[Tensor, "B N 3"]]:
    """Ellipses around discs of a radius in half-axes, and the covariances of the discs as if seen from afar.

    Where the whole disc is well in front of the camera, the ellipse is exact, plus a tenth of a pixel in quadrature.
    Else it surrounds the projected box of the disc, clipped at the near plane and at the image border.
    """
    fx, fy, cx, cy = intrinsics.unbind(1)
    # A disc's point (u, v) is at (across, down)·(u, v) / (z + along·(u, v)) from the projected centre.
    along = [axis[2] for axis in half_axes]
    across = [fx * (axis[0] - x / z * axis[2]) for axis in half_axes]
    down = [fy * (axis[1] - y / z * axis[2]) for axis in half_axes]
    xx, xy, yy = dot(across, across), dot(across, down), dot(down, down)
    x_along, y_along, along_squared = dot(across, along), dot(down, along), dot(along, along)
    area = across[0] * down[1] - across[1] * down[0]

    in_front = radius * along_squared.sqrt() < 0.95 * z
    # The dual conic of the circle |(u, v)| = radius.
    scale = radius.square() / torch.where(in_front, z.square() - radius.square() * along_squared, 1.0)
    centre_x, centre_y = fx * x / z + cx - scale * x_along, fy * y / z + cy - scale * y_along
    slack = 0.01
    covar_xx = scale * xx + (scale * x_along).square() + slack
    covar_xy = scale * xy + scale.square() * x_along * y_along
    covar_yy = scale * yy + (scale * y_along).square() + slack
    determinant = (scale * area).square() * (1 + scale * along_squared) + slack * (covar_xx + covar_yy - slack)

    reach_x, reach_y, reach_z = (radius * dot(each, each).sqrt() for each in zip(*half_axes, strict=True))
    nearest, farthest = (z - reach_z).clamp_min(NEAR_PLANE), z + reach_z

    def box(centre: Tensor, reach: Tensor, focal: Tensor, principal: Tensor, size: Tensor) -> tuple[Tensor, Tensor]:
        low, high = centre - reach, centre + reach
        low = focal * torch.minimum(low / nearest, low / farthest) + principal
        high = focal * torch.maximum(high / nearest, high / farthest) + principal
        low, high = (torch.minimum(each.clamp_min(0), size) for each in (low, high))
        return (low + high) / 2, ((high - low) / 2).clamp_min(slack) * math.sqrt(2)

    box_x, box_reach_x = box(x, reach_x, fx, cx, size[:, :1])
    box_y, box_reach_y = box(y, reach_y, fy, cy, size[:, 1:])
    conic = [covar_yy / determinant, -covar_xy / determinant, covar_xx / determinant]
    exact = [centre_x, centre_y, *conic, covar_xx.sqrt(), covar_yy.sqrt()]
    conic = [1 / box_reach_x.square(), torch.zeros_like(z), 1 / box_reach_y.square()]
    around_box = [box_x, box_y, *conic, box_reach_x, box_reach_y]
    outline = [torch.where(in_front, *each) for each in zip(exact, around_box, strict=True)]
    covars2d = torch.stack([xx / z.square() + LOW_PASS, xy / z.square(), yy / z.square() + LOW_PASS], dim=-1)
    return torch.stack(outline, dim=-1), covars2d
