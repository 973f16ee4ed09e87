"""Geometric loss terms, weighted for the iteration. Terms of weight 0 are not computed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal, Optional

import torch
from jaxtyping import Bool
from torch import Tensor

from shellgs_method.geometry.reference import Reference
from shellgs_method.losses import (
    PAPER_ITERATIONS,
    ExponentialDecay,
    NccLoss,
    NormalLoss,
    PointToPlaneLoss,
    SmoothnessLoss,
    normal_consistency_loss,
    normal_loss,
    vid2sim_ncc_loss,
)
from shellgs_method.losses.reduction import weighted_mean
from shellgs_method.render.maps import Geometry

SOLID = 0.5
"""Opacity that the shell must have where what is behind it may be seen through it."""
TOLERANCES = (0.05, 0.15)
"""Smallest and largest tolerance in metres: with less, images of Herz-Jesu lost more than its surface gained."""


@dataclass
class GeometryLossConfig:
    """Weights of D, N and C over the iterations (paper, section 3.4); initial 0 switches a term off."""

    depth: ExponentialDecay = field(default_factory=lambda: ExponentialDecay(0.5, 0.1))
    """Weight α(t) of the inverse-depth NCC."""
    normal: ExponentialDecay = field(default_factory=lambda: ExponentialDecay(0.1, 0.1))
    """Weight β(t) of the normal loss."""
    smoothness: ExponentialDecay = field(default_factory=lambda: ExponentialDecay(0.1, 0.1))
    """Weight γ(t) of normal smoothness."""
    ncc: Literal["local", "vid2sim"] = "local"
    """local: the paper's equation; vid2sim: as in the baseline's released code."""
    ncc_window: int = 9
    """Patch side of the local NCC in pixels."""
    ncc_eps: float = 1e-3
    """Contrast of a patch, relative to its depth, below which the local NCC treats it as flat."""


@dataclass(frozen=True)
class ExtraLossConfig:
    """Terms beyond the paper's objective, each off at 0. Lengths are in scene units if metres are unknown."""

    normal_consistency: float = 0.0
    """Weight of the normal consistency of 2DGS: composited normals against those of the rendered depth (2DGS: 0.05)."""
    normal_consistency_from: int = 7000
    """First iteration of that term."""
    normal_consistency_on: Literal["everywhere", "without_cue"] = "everywhere"
    """Pixels of that term: all, or those without a cue, so that walls continue beyond the shell, but not what
    photographs show in front of it."""
    distortion: float = 0.0
    """Weight of the depth distortion of 2DGS; discs only."""
    distortion_from: int = 3000
    """First iteration of that term."""
    depth_normal: float = 0.0
    """Weight of the normal loss on normals of the rendered depth, which moves Gaussians; N only rotates them."""
    point_to_plane: float = 0.0
    """Weight of the logarithm of the distance from the cue's tangent plane, in metres."""
    empty_space: float = 0.0
    """Weight of the same loss on all splats of a pixel instead of their mean depth, which may be right with splats in
    front of and behind the shell."""
    empty_space_from: int = 0
    """First iteration of that term."""
    tolerance: Optional[float] = None
    """Distance from the plane without cost, in metres. If not set: the shell's error by the metrics of its alignment,
    clamped to 5 to 15 cm; 5 cm if it was not validated."""
    occlusion_gate: float = 0.0
    """Distance in metres in front of the cue beyond which a pixel's rendered depth counts as an occluder's."""
    occlusion_gate_from: int = 3000
    """First iteration of all cue terms if there is a gate; by then the photographs have shaped the occluders."""
    flattening: float = 0.0
    """Weight of the mean smallest scale of visible Gaussians, in units of the rescaled world (Vid2Sim: 100)."""

    def tolerance_for(self, shell_error: float | None) -> float:
        """Tolerance for a shell with an error in metres, None if unknown."""
        if self.tolerance is not None:
            return self.tolerance
        low, high = TOLERANCES
        return min(max(shell_error or 0.0, low), high)


class CueLosses:
    """:func:`cue_losses` for many renders of one view; what depends on its maps alone is computed once."""

    def __init__(
        self,
        cue: Reference,
        paper: GeometryLossConfig,
        extra: ExtraLossConfig,
        metres_per_unit: float | None,
        shell_error: float | None = None,
    ):
        self.cue, self.paper, self.extra, self.metres = cue, paper, extra, metres_per_unit or 1.0
        self.shell_error = shell_error
        self._from_plane: PointToPlaneLoss | None = None

    def __call__(self, geometry: Geometry, progress: float) -> dict[str, Tensor]:
        """Weighted terms of one render, at ``progress`` in [0, 1] of the run."""
        paper, extra = self.paper, self.extra
        if extra.occlusion_gate > 0:
            return self._gated(geometry, progress)
        terms = {
            "depth": (paper.depth(progress), lambda: self._ncc(1 / geometry.depth.clamp_min(1e-6))),
            "normal": (paper.normal(progress), lambda: self._normal(geometry.normal)),
            "smoothness": (paper.smoothness(progress), lambda: self._smoothness(geometry.normal)),
            "depth_normal": (
                extra.depth_normal,
                lambda: normal_loss(geometry.depth_normal, self.cue.normal, self.cue.mask & _known(geometry)),
            ),
            "point_to_plane": (extra.point_to_plane, lambda: self._point_to_plane(geometry)(geometry.depth)),
            "empty_space": (
                extra.empty_space if progress >= extra.empty_space_from / PAPER_ITERATIONS else 0.0,
                lambda: self._point_to_plane(geometry).of_all(self._squares(geometry), _opacity(geometry)),
            ),
        }
        return {name: weight * term() for name, (weight, term) in terms.items() if weight > 0}

    def _gated(self, geometry: Geometry, progress: float) -> dict[str, Tensor]:
        """Weighted terms over the pixels without an occluder in front of the cue."""
        gate = self.extra.occlusion_gate
        if progress < self.extra.occlusion_gate_from / PAPER_ITERATIONS:
            return {}
        near = self.metres * (self.cue.depth - geometry.depth.detach()) < gate
        without_gate = replace(self.extra, occlusion_gate=0.0)
        unoccluded = self.cue._replace(mask=self.cue.mask & near)
        return CueLosses(unoccluded, self.paper, without_gate, self.metres, self.shell_error)(geometry, progress)

    @cached_property
    def _ncc(self) -> Callable[[Tensor], Tensor]:
        mask = self.cue.mask
        inverse_depth = torch.where(mask, 1 / self.cue.depth, 0.0)
        if self.paper.ncc == "vid2sim":
            return lambda x: vid2sim_ncc_loss(x, inverse_depth, mask)
        return NccLoss(inverse_depth, mask, self.paper.ncc_window, eps=self.paper.ncc_eps)

    @cached_property
    def _normal(self) -> NormalLoss:
        return NormalLoss(self.cue.normal, self.cue.mask)

    @cached_property
    def _smoothness(self) -> SmoothnessLoss:
        return SmoothnessLoss(self.cue.depth, self.cue.mask)

    def _squares(self, geometry: Geometry) -> Tensor:
        assert geometry.moments is not None
        return geometry.moments.about(self.cue.depth, geometry.solid)

    def _point_to_plane(self, geometry: Geometry) -> PointToPlaneLoss:
        if self._from_plane is None:
            depth, normal, mask = self.cue
            rays, tolerance = geometry.camera.rays(), self.extra.tolerance_for(self.shell_error)
            self._from_plane = PointToPlaneLoss(depth, normal, rays, mask, self.metres, tolerance)
        return self._from_plane


def cue_losses(
    geometry: Geometry,
    cue: Reference,
    paper: GeometryLossConfig,
    extra: ExtraLossConfig,
    progress: float,
    metres_per_unit: float | None,
) -> dict[str, Tensor]:
    """Weighted terms that compare rendered geometry with a cue's maps, at ``progress`` in [0, 1] of the run.

    If metres are unknown, ``extra``'s lengths are in units of nerfstudio's rescaled world.
    """
    return CueLosses(cue, paper, extra, metres_per_unit)(geometry, progress)


def self_losses(
    geometry: Geometry,
    extra: ExtraLossConfig,
    progress: float,
    kept: Bool[Tensor, "H W 1"],
    with_cue: Bool[Tensor, "H W 1"] | None = None,
) -> dict[str, Tensor]:
    """Weighted terms of 2DGS on the rendered geometry, without a cue, at ``progress`` in [0, 1] of the run.

    They are means over the pixels kept by the user's mask; normal consistency may be 0 in those ``with_cue``.
    """
    iteration = progress * PAPER_ITERATIONS
    losses = {}
    if extra.normal_consistency > 0 and iteration >= extra.normal_consistency_from:
        where = kept
        if extra.normal_consistency_on == "without_cue" and with_cue is not None:
            where = kept & ~with_cue
        share = where.sum() / kept.sum().clamp_min(1)  # a pixel weighs the same however few count
        losses["normal_consistency"] = (
            extra.normal_consistency
            * share
            * normal_consistency_loss(geometry.normal, geometry.depth_normal, geometry.alpha, where)
        )
    if extra.distortion > 0 and iteration >= extra.distortion_from:
        assert geometry.distortion is not None
        losses["distortion"] = extra.distortion * weighted_mean(geometry.distortion, kept)
    return losses


def _opacity(geometry: Geometry) -> Tensor:
    """Opacity; 1 where windows let through what is behind them, but no more than they may."""
    return geometry.alpha if geometry.surface is None else 1 - (SOLID - geometry.surface).relu()


def _known(geometry: Geometry) -> Bool[Tensor, "H W 1"]:
    return (geometry.depth_normal != 0).any(dim=-1, keepdim=True)
