"""Normals of a depth map."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from shellgs_method.geometry.camera import Camera
from shellgs_method.machine.crops import crops
from shellgs_method.machine.elementwise import Vector, cross, dot, elementwise


def normals_from_depth(depth: Float[Tensor, "H W 1"], camera: Camera) -> Float[Tensor, "H W 3"]:
    """Unit normals in the camera frame, from central differences of the back-projected depth; differentiable.

    They face the camera without being flipped: for any four positive depths around a pixel, (right - left) x
    (top - bottom) points against the pixel's ray. Zero on the image's border and where the pixel or one of its four
    neighbours has no depth, which the Sobel windows of kornia's ``depth_to_normals`` would take for a surface.
    """
    return normals_along_rays(depth, camera.rays().to(depth))


def normals_along_rays(depth: Float[Tensor, "H W 1"], rays: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W 3"]:
    """:func:`normals_from_depth` given the camera's rays, which are scaled to z = 1."""
    height, width, _ = depth.shape
    if min(height, width) < 3:
        return torch.zeros_like(rays) + 0 * depth
    cross_shaped = crops(depth * rays, height - 2, width - 2, (1, 1), (1, 2), (1, 0), (0, 1), (2, 1))
    (normal,) = elementwise(_normal, *cross_shaped)
    return pad(normal, (0, 0, 1, 1, 1, 1))


def _normal(centre: Vector, right: Vector, left: Vector, top: Vector, bottom: Vector) -> list[Vector]:
    a = [one - other for one, other in zip(right, left, strict=True)]
    b = [one - other for one, other in zip(top, bottom, strict=True)]
    normal = cross(a, b)
    length = torch.sqrt(torch.clamp_min(dot(normal, normal), 1e-36))
    known = (centre[2] > 0) & (right[2] > 0) & (left[2] > 0) & (top[2] > 0) & (bottom[2] > 0)
    return [[torch.where(known, each / length, 0.0) for each in normal]]
