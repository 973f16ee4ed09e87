"""Normals of a depth map."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from shellgs_method.geometry.camera import Camera


def normals_from_depth(depth: Float[Tensor, "H W 1"], camera: Camera) -> Float[Tensor, "H W 3"]:
    """Unit normals in the camera frame, from central differences of the back-projected depth; differentiable.

    They face the camera without being flipped: for any four positive depths around a pixel, (right - left) x
    (top - bottom) points against the pixel's ray. Zero on the image's border and where the pixel or one of its four
    neighbours has no depth, which the Sobel windows of kornia's ``depth_to_normals`` would take for a surface.
    """
    return normals_along_rays(depth, camera.rays().to(depth))


def normals_along_rays(depth: Float[Tensor, "H W 1"], rays: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W 3"]:
    """:func:`normals_from_depth` given the camera's rays, which are scaled to z = 1; a kernel for ``run_fused``."""
    # Coordinate by coordinate, since loops are vectorised along the last dimension, which should be long.
    points = [pad(depth[..., 0] * ray, (1, 1, 1, 1)) for ray in rays.unbind(-1)]
    a = [each[1:-1, 2:] - each[1:-1, :-2] for each in points]  # right - left
    b = [each[:-2, 1:-1] - each[2:, 1:-1] for each in points]  # top - bottom
    normal = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
    length = (normal[0].square() + normal[1].square() + normal[2].square()).clamp_min(1e-36).sqrt()
    known = points[2] > 0
    complete = known[1:-1, 1:-1] & known[1:-1, 2:] & known[1:-1, :-2] & known[:-2, 1:-1] & known[2:, 1:-1]
    return torch.stack([torch.where(complete, each / length, 0.0) for each in normal], dim=-1)
