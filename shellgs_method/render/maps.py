"""Depth and normals of Gaussians: the channels to composite, and the maps made of them.

A disc of 2D Gaussian Splatting is a Gaussian whose third axis has no length: all but the depth of its ray intersection
is the same for both primitives.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from shellgs_method.geometry.camera import Camera
from shellgs_method.geometry.depth_normals import normals_along_rays
from shellgs_method.machine.elementwise import Vector, dot, elementwise
from shellgs_method.render.rasterizer.projection import rotate, rotated_axes, to_camera

Primitive = Literal["3d", "2d"]
DepthKind = Literal["expected", "median", "plane", "mode"]

DISC_LOG_THICKNESS = -20.0
"""Logarithm of a disc's third scale: negligible, so that splits stay in the plane, yet finite in an exported file."""

MERGED = 0.01
"""Spread of a pixel's depths, relative to the depth, at which its layers count half as separate, and less below."""

GRAZING = 0.01
"""Smallest cosine of normal and ray for a plane depth: the ray meets a plane seen edge-on far away or not at all."""


class DepthMoments(NamedTuple):
    """Composited moments of the centres' depths."""

    origin: Float[Tensor, ""]
    """Constant depth that the moments are about, for accuracy in float32."""
    first: Float[Tensor, "H W 1"]
    """Σ w z."""
    second: Float[Tensor, "H W 1"]
    """Σ w (z - origin)²."""

    def about(self, depth: Float[Tensor, "H W 1"], alpha: Float[Tensor, "H W 1"]) -> Float[Tensor, "H W 1"]:
        """Σ w (z - depth)², positive if splats of a pixel are off the depth even if their mean is not; alpha is Σ w."""
        return elementwise(_about, *self[1:], depth, alpha, self.origin[None])[0]


def _about(first: Vector, second: Vector, depth: Vector, alpha: Vector, origin: Vector) -> list[Vector]:
    d = depth[0] - origin[0]
    return [[second[0] - 2 * d * (first[0] - origin[0] * alpha[0]) + d * d * alpha[0]]]


@dataclass(frozen=True)
class Geometry:
    """Differentiable maps of one rendered view, in the camera frame."""

    depth: Float[Tensor, "H W 1"]
    """Forward z-depth, finite and positive unless the view is empty; its maximum where nothing was rendered."""
    normal: Float[Tensor, "H W 3"]
    """Composited normals, of length at most 1."""
    alpha: Float[Tensor, "H W 1"]
    """Accumulated opacity."""
    camera: Camera
    distortion: Float[Tensor, "H W 1"] | None = None
    """Spread of the splats along each ray; discs only."""
    moments: DepthMoments | None = None
    """Moments of the centres' depths, if requested."""
    surface: Float[Tensor, "H W 1"] | None = None
    """Accumulated opacity of what is not behind the shell, if only this makes up the geometry."""

    @property
    def solid(self) -> Float[Tensor, "H W 1"]:
        """Accumulated opacity of what makes up depth and normals."""
        return self.alpha if self.surface is None else self.surface

    def detached(self) -> Geometry:
        """The same maps without their graph."""
        maps = {name: value.detach() for name, value in vars(self).items() if isinstance(value, Tensor)}
        maps.pop("depth_normal", None)  # of the depth
        moments = self.moments and DepthMoments(*(each.detach() for each in self.moments))
        return replace(self, moments=moments, **maps)

    @cached_property
    def depth_normal(self) -> Float[Tensor, "H W 3"]:
        """Unit normals of the depth, zero on the image border."""
        return normals_along_rays(self.depth, self.camera.rays().to(self.depth))


def geometry_channels(
    gaussians: Mapping[str, Tensor], camera: Camera, depth: DepthKind
) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N 1"]]:
    """Normal and depth channel of each Gaussian, in the camera frame.

    The normal n is the shortest axis, facing the camera. The depth channel is n·m, negative, for plane depth (m is the
    centre), else the forward depth of the centre.
    """
    splats = (gaussians[name] for name in ("means", "quats", "scales"))
    normals, along, depths = elementwise(_normals_and_depths, *splats, camera.viewmat.flatten())
    return normals, along if depth == "plane" else depths


def squared_depths(depths: Float[Tensor, "N 1"]) -> tuple[Float[Tensor, "N 1"], Float[Tensor, ""]]:
    """Squared depths about their median, the second channel of :class:`DepthMoments`, and this origin.

    The median is of some thousand of them, as any depth among them serves: a GPU takes it with few of its cores.
    """
    origin = depths.detach()[:: max(1, len(depths) // 4096)].median()
    return (depths - origin).square(), origin


def depth_powers(
    depths: Float[Tensor, "N 1"], weights: Float[Tensor, "N 1"] | None = None
) -> tuple[Float[Tensor, "N 4"], Float[Tensor, ""]]:
    """Powers 0 to 3 of t = z / (z + median), which is below 1 however far the sky is, times weights; and the median.

    The median is of distances before and behind the camera: in a street more may lie behind it.
    """
    median = depths.detach().abs().median().clamp_min(1e-6)
    z = depths.clamp_min(0)
    t = z / (z + median) - 0.5  # about the median, for accuracy in float32
    powers = torch.cat([torch.ones_like(t), t, t.square(), t**3], dim=-1)
    return powers if weights is None else powers * weights, median


def mode_of_depth(
    expected: Float[Tensor, "H W 1"], powers: Float[Tensor, "H W 4"], median: Float[Tensor, ""]
) -> Float[Tensor, "H W 1"]:
    """Depth of the heavier of two layers, instead of a mean between them.

    The two layers have the first moments of a pixel's splats, in t: mean m, variance σ² and skewness s. They are at
    m + σ (s/2 ± √(1 + s²/4)), the nodes of Gauss quadrature (compare moment-based transparency, Münstermann et al.
    2018), and the heavier one is the nearer to m. Since the splats of one surface are spread too, it counts by
    σ² / (σ² + (z/100)²) only, with σ the spread of z. So a pixel at the edge of a wall has the depth of one side, and
    haze in front of a wall does not displace it.

    Args:
        expected: mean depth.
        powers: the composite of :func:`depth_powers`.
        median: the second output of that.
    """
    total, *sums = powers.double().split(1, dim=-1)
    mean, square, cube = (each / total.clamp_min(1e-9) for each in sums)
    variance = (square - mean.square()).clamp_min(1e-12)
    skewness = (cube - 3 * mean * square + 2 * mean**3) / variance**1.5
    to_heavier = -skewness.sign() * variance.sqrt() * ((1 + skewness.square() / 4).sqrt() - skewness.abs() / 2)
    t = (mean + to_heavier + 0.5).clamp(0, 0.999)
    heavier = median * t / (1 - t)
    spread = variance.sqrt() / ((0.5 + mean) * (0.5 - mean)).clamp_min(1e-6)  # of z, relative to z
    separate = spread.square() / (spread.square() + MERGED**2)
    return torch.lerp(expected.double(), heavier, separate.where(total > 0, 0.0)).to(expected)


def _normals_and_depths(mean: Vector, quat: Vector, scale: Vector, viewmat: Vector) -> list[Vector]:
    """Normal, n·m, and depth of the centre."""
    centre = to_camera(mean, viewmat)
    axes = [rotate(axis, viewmat) for axis in rotated_axes(quat)]
    x, y, z = scale
    first, second = (x <= y) & (x <= z), y <= z
    shortest = [torch.where(first, a, torch.where(second, b, c)) for a, b, c in zip(*axes, strict=True)]
    along = dot(shortest, centre)
    normal = [torch.where(along > 0, -each, each) for each in shortest]
    return [normal, [-torch.abs(along)], [centre[2]]]


def rendered_geometry(
    composited: Float[Tensor, "H W C"],
    alpha: Float[Tensor, "H W 1"],
    info: Mapping[str, Any],
    camera: Camera,
    depth: DepthKind,
    origin: Float[Tensor, ""] | None = None,
) -> Geometry:
    """Depth and normals of a view from the composite of :func:`geometry_channels`.

    * ``expected``: mean depth of the Gaussians' centres; for discs, alpha / Σ w/z of the ray's intersections.
    * ``median``: discs only, the intersection where the transmittance falls to 1/2; expected where it does not.
    * ``plane``: Σ w n·m / (Σ w n · ray), the ray's intersection with the composited plane (PGSR, Chen et al. 2024).
    * ``mode``: expected, from which the caller makes :func:`mode_of_depth`.

    Args:
        composited: normals and depth channel; with ``origin`` also the channel of :func:`squared_depths`; all of them
            times a weight of each Gaussian, and these weights, if they have any.
        alpha: accumulated opacity.
        info: third output of the rasterizer.
        camera: camera of the view.
        depth: kind of depth, as given to :func:`geometry_channels`.
        origin: origin of the squared depths.
    """
    normal, channel, *more = composited.split([3, *[1] * (composited.shape[-1] - 3)], dim=-1)
    moments = None if origin is None else DepthMoments(origin, channel, more.pop(0))
    surface = more.pop() if more else None
    weight = alpha if surface is None else surface
    solid = weight.clamp_min(1e-6)
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
    if surface is not None:
        normal = normal * (alpha / solid)
    return Geometry(z, normal, alpha, camera, info.get("distortion"), moments, surface)
