"""Normals of a depth map."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize, pad

from dataparsers.camera import Camera


def normals_from_depth(depth: Float[Tensor, "H W 1"], camera: Camera) -> Float[Tensor, "H W 3"]:
    """Unit normals in the camera frame, from central differences of the back-projected depth; differentiable.

    They face the camera without being flipped: for any four positive depths around a pixel, (right - left) x
    (top - bottom) points against the pixel's ray. Zero on the image's border and where the pixel or one of its four
    neighbours has no depth, which the Sobel windows of kornia's ``depth_to_normals`` would take for a surface.
    """
    points = depth * camera.rays().to(depth)
    horizontal = points[1:-1, 2:] - points[1:-1, :-2]
    vertical = points[:-2, 1:-1] - points[2:, 1:-1]
    normal = normalize(torch.linalg.cross(horizontal, vertical), dim=-1, eps=1e-20)
    known = depth > 0
    complete = known[1:-1, 1:-1] & known[1:-1, 2:] & known[1:-1, :-2] & known[:-2, 1:-1] & known[2:, 1:-1]
    return pad(normal.where(complete, 0.0), (0, 0, 1, 1, 1, 1))
