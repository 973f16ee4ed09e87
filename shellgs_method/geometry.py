"""What Gaussians say of the surface: the channels they carry, and the depth and normals these composite to.

A disc of 2D Gaussian Splatting is a Gaussian whose third axis has no length: everything here but the depth of its ray
intersection is the same for both primitives.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from dataparsers.camera import Camera
from shellgs_method.depth_normals import normals_from_depth
from shellgs_method.fusion import run_fused
from shellgs_method.rasterizer import quats_to_rotations
from shellgs_method.rasterizer.projection import to_camera, turn

Primitive = Literal["3d", "2d"]
DepthKind = Literal["expected", "median", "plane"]

DISC_LOG_THICKNESS = -20.0
"""Logarithm of a disc's third scale: nothing, yet finite in an exported file, and splits stay in the plane."""

GRAZING = 0.01
"""Least cosine of normal and ray at which a plane depth is taken: a plane seen edge-on is met nowhere near."""


class DepthMoments(NamedTuple):
    """Composited powers of the centres' depths."""

    origin: Float[Tensor, ""]
    """Depth they are about, a constant, so that little is lost in float32."""
    first: Float[Tensor, "H W 1"]
    """Σ w (z - origin)."""
    second: Float[Tensor, "H W 1"]
    """Σ w (z - origin)²."""

    def about(self, depth: Float[Tensor, "H W 1"], alpha: Float[Tensor, "H W 1"]) -> Float[Tensor, "H W 1"]:
        """Σ w (z - depth)²: how far all that is rendered in a pixel is from a depth, which their mean may well have."""
        d = depth - self.origin
        return self.second - 2 * d * self.first + d.square() * alpha


@dataclass(frozen=True)
class Geometry:
    """Differentiable maps of one rendered view, in the camera frame."""

    depth: Float[Tensor, "H W 1"]
    """Forward z-depth, positive and finite everywhere; the farthest of the view where nothing was rendered."""
    normal: Float[Tensor, "H W 3"]
    """Normals as composited, of length 1 at most."""
    alpha: Float[Tensor, "H W 1"]
    """Accumulated opacity."""
    camera: Camera
    distortion: Float[Tensor, "H W 1"] | None = None
    """Spread of the splats along each ray, of discs only."""
    moments: DepthMoments | None = None
    """Of the centres' depths, where they were asked for."""

    @cached_property
    def depth_normal(self) -> Float[Tensor, "H W 3"]:
        """Unit normals of the depth, zero on the image's border."""
        return normals_from_depth(self.depth, self.camera)


def geometry_channels(
    gaussians: Mapping[str, Tensor], camera: Camera, depth: DepthKind
) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N 1"]]:
    """Of each Gaussian, in the camera frame: its normal, and what its depth is made of.

    The normal is the shortest axis, facing the camera. The other is n·m, which is negative, for plane depth (m the
    centre), else the forward depth of the centre.
    """
    splats = (gaussians[name] for name in ("means", "quats", "scales"))
    normals, along, depths = run_fused(_normals_and_depths, *splats, camera.viewmat[None])
    return normals, along if depth == "plane" else depths


def squared_depths(depths: Float[Tensor, "N 1"]) -> tuple[Float[Tensor, "N 1"], Float[Tensor, ""]]:
    """The channel that :class:`DepthMoments` are made of besides the centres' depths, and its origin, their median."""
    origin = depths.detach().median()
    return (depths - origin).square(), origin


def _normals_and_depths(
    means: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    scales: Float[Tensor, "N 3"],
    viewmat: Float[Tensor, "1 4 4"],
) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N 1"], Float[Tensor, "N 1"]]:
    """Normals, n·m, and depths of the centres."""
    centres = torch.stack(to_camera(means, viewmat), dim=-1)[0]
    axes = torch.stack(turn(quats_to_rotations(quats), viewmat), dim=-2)[0]
    x, y, z = scales.detach().unbind(-1)
    first, second = (x <= y) & (x <= z), y <= z
    shortest = torch.where(first[:, None], axes[..., 0], torch.where(second[:, None], axes[..., 1], axes[..., 2]))
    along = (shortest * centres).sum(dim=-1, keepdim=True)
    return torch.where(along > 0, -shortest, shortest), -along.abs(), centres[:, 2:]


def rendered_geometry(
    composited: Float[Tensor, "H W 4"],
    alpha: Float[Tensor, "H W 1"],
    info: Mapping[str, Any],
    camera: Camera,
    depth: DepthKind,
    origin: Float[Tensor, ""] | None = None,
) -> Geometry:
    """Depth and normals of a view from the composite of :func:`geometry_channels`.

    * ``expected``: mean depth of the Gaussians' centres; of discs, alpha / Σ w/z of the ray's intersections.
    * ``median``: discs only, the intersection where half of the light has been stopped; where it never is, expected.
    * ``plane``: Σ w n·m / (Σ w n · ray), the ray's intersection with the composited plane (PGSR, Chen et al. 2024).

    Args:
        composited: normals and the depth channel; with ``origin`` also that of :func:`squared_depths`.
        alpha: accumulated opacity.
        info: what the rasterizer returned beside them.
        camera: of the view.
        depth: which depth; the channel must have been made for it.
        origin: of the squared depths.
    """
    normal, channel = composited[..., :3], composited[..., 3:4]
    solid = alpha.clamp_min(1e-6)
    if depth == "plane":
        facing = (normal * camera.rays()).sum(dim=-1, keepdim=True)
        z = channel / facing.minimum(-GRAZING * solid)
    elif "inverse_depth" in info:
        z = alpha / info["inverse_depth"].clamp_min(1e-9)
        if depth == "median":
            z = torch.where(info["median_depth"] > 0, info["median_depth"], z)
    else:
        z = channel / solid
    z = torch.where(alpha > 0, z, z.detach().max())
    moments = None if origin is None else DepthMoments(origin, channel - origin * alpha, composited[..., 4:])
    return Geometry(z, normal, alpha, camera, info.get("distortion"), moments)
