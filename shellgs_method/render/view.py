"""Gaussians to the image and the geometry of one view."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from shellgs_method.geometry.camera import Camera
from shellgs_method.render.maps import (
    DepthKind,
    Geometry,
    Primitive,
    depth_powers,
    geometry_channels,
    mode_of_depth,
    rendered_geometry,
    squared_depths,
)
from shellgs_method.render.rasterizer import rasterize, spherical_harmonics
from shellgs_method.render.rasterizer.gsplat_backend import Backend

Gaussians = Mapping[str, Tensor]
"""The parameters, and ``surface``, the weight of each Gaussian in depth and normals, if they differ in it."""


PAST = 0.1
"""Share of a pixel's opacity below which what is not behind the shell is not a surface, but haze."""


class Rendered(NamedTuple):
    """A rendered view."""

    rgb: Float[Tensor, "H W 3"]
    """Colours over the background; above 1 where they are brighter than white."""
    alpha: Float[Tensor, "H W 1"]
    geometry: Geometry | None
    info: dict[str, Any]
    """What the rasterizer knows of the splats."""


@dataclass(frozen=True)
class ViewRenderer:
    """Renders views of Gaussians in one way."""

    primitive: Primitive
    depth: DepthKind
    moments: bool = False
    """Whether geometry has the moments of the splats' depths."""
    backend: Backend = "auto"
    """Of the rasterizer."""

    def __call__(
        self,
        gaussians: Gaussians,
        camera: Camera,
        background: Float[Tensor, "3"],
        degree: int,
        geometry: bool = True,
        densifies: bool = False,
    ) -> Rendered:
        """Render a view.

        Args:
            gaussians: what to render.
            camera: where from.
            background: colour behind them.
            degree: highest degree of the spherical harmonics.
            geometry: whether to render geometry too.
            densifies: keep the gradients of colours apart, for densification: those of the geometry do not count.
                Telling them apart costs gsplat a second pass.
        """
        # Colours minus the background, so that the photometric gradient of alpha comes through the colours too.
        features, origin = view_colours(gaussians, camera, degree) - background, None
        if geometry:
            of_geometry, origin = self._channels(gaussians, camera)
            features = torch.cat([features, *of_geometry], dim=-1)
        composited, alpha, info = self._rasterize(gaussians, features, camera, 3 if geometry and densifies else None)
        rgb, maps = composited, None
        if geometry:
            rgb, channels = composited.split([3, composited.shape[-1] - 3], dim=-1)
            maps = rendered_geometry(channels, alpha, info, camera, self.depth, origin)
        return Rendered(rgb + background, alpha, maps, info)

    def view_of_geometry(
        self, geometry: Geometry, gaussians: Gaussians, camera: Camera
    ) -> tuple[Float[Tensor, "H W 1"], Float[Tensor, "H W 3"]]:
        """Depth and normals of a view outside training, given those that are supervised.

        Where hardly anything of what a pixel shows is the surface (:data:`PAST`), the view goes past it: depth and
        normals are of all splats.
        """
        depth, normal = self._mode_of_depth(geometry.depth, gaussians, camera), geometry.normal
        if geometry.surface is None or not bool((past := geometry.surface < PAST * geometry.alpha).any()):
            return depth, normal
        everything = {**gaussians, "surface": torch.ones_like(gaussians["surface"])}
        whole = self(everything, camera, depth.new_zeros(3), degree=0).geometry
        assert whole is not None
        depth = torch.where(past, self._mode_of_depth(whole.depth, everything, camera), depth)
        return depth, torch.where(past, whole.normal, normal)

    def _mode_of_depth(
        self, expected: Float[Tensor, "H W 1"], gaussians: Gaussians, camera: Camera
    ) -> Float[Tensor, "H W 1"]:
        """:func:`~.maps.mode_of_depth` of a view, given its expected depth, if this is what is rendered."""
        if self.depth != "mode":
            return expected
        _, depths = geometry_channels(gaussians, camera, "expected")
        powers, median = depth_powers(depths, gaussians.get("surface"))
        padding = self._n_features(gaussians) - powers.shape[1]
        composited, _, _ = self._rasterize(gaussians, torch.nn.functional.pad(powers, (0, padding)), camera)
        return mode_of_depth(expected, composited[..., : powers.shape[1]], median)

    def coverage(
        self, gaussians: Gaussians, camera: Camera, geometry: bool
    ) -> tuple[Float[Tensor, " N"], Bool[Tensor, " N"]]:
        """Area of a view that each Gaussian covers, and whether it reaches into the view, occluded or not.

        The area is the sum of its compositing weights over the pixels. ``geometry`` is as in training.
        """
        features = torch.zeros_like(gaussians["means"][:, :1]).repeat(1, self._n_features(gaussians, geometry))
        composited, _, info = self._rasterize(gaussians, features.requires_grad_(), camera)
        (weights,) = torch.autograd.grad(composited[..., 0].sum(), features)
        return weights[:, 0], info["radii"][0] > 0

    def _channels(self, gaussians: Gaussians, camera: Camera) -> tuple[list[Tensor], Float[Tensor, ""] | None]:
        """Channels of the geometry to composite, and the origin of the squared depths if these are among them."""
        channels, origin = [*geometry_channels(gaussians, camera, self.depth)], None
        if self.moments:
            squares, origin = squared_depths(channels[-1])
            channels.append(squares)
        if "surface" in gaussians:
            surface = gaussians["surface"]
            channels = [*(channel * surface for channel in channels), surface]
        return channels, origin

    def _n_features(self, gaussians: Gaussians, geometry: bool = True) -> int:
        """Number of features of a view, for which the kernels are compiled."""
        return 3 + geometry * (4 + self.moments + ("surface" in gaussians))

    def _rasterize(
        self,
        gaussians: Gaussians,
        features: Float[Tensor, "N C"],
        camera: Camera,
        n_densifying: int | None = None,
    ) -> tuple[Float[Tensor, "H W C"], Float[Tensor, "H W 1"], dict[str, Any]]:
        return rasterize(
            gaussians["means"],
            gaussians["quats"],
            gaussians["scales"].exp(),
            gaussians["opacities"].sigmoid().squeeze(-1),
            features,
            camera,
            self.primitive,
            self.backend,
            n_densifying=n_densifying,
        )


def view_colours(gaussians: Gaussians, camera: Camera, degree: int) -> Float[Tensor, "N 3"]:
    """View-dependent colours, of harmonics up to a degree."""
    coefficients = gaussians["features_dc"][:, None], gaussians["features_rest"]
    return (spherical_harmonics(degree, gaussians["means"] - camera.position, *coefficients) + 0.5).clamp_min(0)
