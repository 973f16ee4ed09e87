"""The training loss: which terms, over which pixels, with which weights, when. Terms of weight 0 are not computed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated, Literal, NamedTuple, Optional

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from shellgs_method.bounds import Bounds, Count, Weight
from shellgs_method.evaluation.pixels import kept_pixels, photometric_pixels, reference_maps, shell_trust
from shellgs_method.files.cue_maps import tolerated
from shellgs_method.geometry.reference import Reference
from shellgs_method.losses import (
    PAPER_ITERATIONS,
    EmptySpaceLoss,
    ExponentialDecay,
    NccLoss,
    NormalLoss,
    PhotometricLoss,
    SmoothnessLoss,
    flattening_loss,
    normal_consistency_loss,
    vid2sim_ncc_loss,
)
from shellgs_method.losses.reduction import mean_weights
from shellgs_method.machine.memory import free_memory
from shellgs_method.render.maps import Geometry

Cues = Literal["none", "mono", "shell"]
Trust = Literal["shell", "photographs"]

MAX_KEPT_SHARE = 0.1
"""Share of the device's free memory that losses of training views may take, which are made in their first step."""
KEPT_BYTES = 120
"""Bytes that the losses of a pixel take, of all terms: 118 of `shellgs-metric`."""
SOLID = 0.5
"""Opacity that the shell must have where it may be seen through."""
DISTORTION_FROM = 3000
"""First iteration of the distortion, as in 2DGS."""


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
    ncc_window: Annotated[int, Bounds(3, 101, int, odd=True)] = 9
    """Patch side of the local NCC in pixels."""


@dataclass(frozen=True)
class ExtraLossConfig:
    """Terms beyond the paper's objective, each off at 0. Lengths are in scene units if metres are unknown."""

    normal_consistency: Weight = 0.0
    """Weight of the normal consistency of 2DGS: composited normals against those of the rendered depth (2DGS: 0.05).
    Only of pixels without a cue, so that walls continue beyond the shell, but not on occluders."""
    normal_consistency_from: Count = 7000
    """First iteration of that term, of a run of 30 000: it scales with the length of the run."""
    distortion: Weight = 0.0
    """Weight of the depth distortion of 2DGS; discs only."""
    depth_normal: Weight = 0.0
    """Weight of the normal loss on normals of the rendered depth, which moves Gaussians; N only rotates them."""
    empty_space: Weight = 0.0
    """Weight of E, the logarithm of the distance in metres of all splats of a pixel from the cue."""
    tolerance: Optional[Weight] = None
    """Distance without cost in E, in metres. If not set: the shell's error by the metrics of its alignment, clamped to
    5 to 15 cm; 5 cm if it was not validated."""
    flattening: Weight = 0.0
    """Weight of the mean smallest scale of visible Gaussians, in units of the rescaled world (Vid2Sim: 100)."""

    def tolerance_for(self, shell_error: float | None) -> float:
        """Tolerance for a shell with an error in metres, None if unknown."""
        return tolerated(shell_error) if self.tolerance is None else self.tolerance


class ViewLosses(NamedTuple):
    """Losses of one view against its photograph, itself and its cue."""

    photometric: PhotometricLoss
    own: SelfLosses
    cue: CueLosses | None


class Objective:
    """The loss of a run, for batches of its views.

    Args:
        cues: maps that supervise the geometry.
        trust: which of the two is trusted where photographs contradict the shell.
        paper: terms against the cues.
        extra: terms beyond the paper.
        metres_per_unit: metres per unit of the world; None if unknown.
        shell_error: error of the shell's alignment in metres; None if unknown.

    Attributes:
        light: factor of photographs and renders in R: above 1 for dark photographs, so that R has as much weight
            against the other terms, and densifies as much, as by day.
    """

    def __init__(
        self,
        cues: Cues,
        trust: Trust,
        paper: GeometryLossConfig,
        extra: ExtraLossConfig,
        metres_per_unit: float | None,
        shell_error: float | None = None,
    ):
        self.cues, self.trust, self.paper, self.extra = cues, trust, paper, extra
        self.metres_per_unit, self.shell_error = metres_per_unit, shell_error
        self.light = 1.0
        self._views: dict[int, ViewLosses] = {}
        self._room: float | None = None

    @property
    def needs_geometry(self) -> bool:
        """Whether a term is of depth or normals."""
        return self.cues != "none" or self.extra.normal_consistency > 0 or self.extra.distortion > 0

    def view(self, batch: dict, photograph: Callable[[], Float[Tensor, "H W 3"]], keep: bool) -> ViewLosses:
        """Losses of a batch's view; with ``keep``, cached by its index while there is room."""
        index = batch["image_idx"]
        if keep and index in self._views:
            return self._views[index]
        target = photograph()
        kept = photometric_pixels(batch, target, ignore_transients=self.trust == "photographs")
        cue = with_cue = None
        if f"{self.cues}_depth" in batch:
            with_cue = batch[f"{self.cues}_mask"].to(target.device)
            maps = reference_maps(batch, self.cues, target.device, everywhere=True)
            doubted = self.cues == "shell" and self.trust == "photographs"
            trust = shell_trust(batch, maps.mask) if doubted else maps.mask.to(target)
            cue = CueLosses(maps, trust, self.paper, self.extra, self.metres_per_unit, self.shell_error)
        own = SelfLosses(kept_pixels(batch, target), with_cue, self.extra)
        view = ViewLosses(PhotometricLoss(self.as_by_day(target), kept), own, cue)
        if keep and self._has_room(target):
            self._views[index] = view
        return view

    def as_by_day(self, image: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W 3"]:
        """A photograph or render as R compares it, which may exceed 1."""
        return image if self.light == 1 else self.light * image

    def _has_room(self, image: Float[Tensor, "H W 3"]) -> bool:
        """Whether the losses of one more view may be kept; if so, they count."""
        if self._room is None:
            self._room = MAX_KEPT_SHARE * free_memory(image.device)
        needed = KEPT_BYTES * image[..., 0].numel()
        if needed > self._room:
            return False
        self._room -= needed
        return True

    def __call__(
        self,
        view: ViewLosses,
        rgb: Float[Tensor, "H W 3"],
        geometry: Geometry | None,
        progress: float,
        transient: Bool[Tensor, "H W 1"] | None = None,
    ) -> dict[str, Tensor]:
        """Weighted terms of a rendered view, at ``progress`` in [0, 1] of the run.

        R leaves out the pixels that are ``transient``.
        """
        losses = {"photometric": view.photometric(self.as_by_day(rgb), transient)}
        if geometry is not None:
            losses |= view.own(geometry, progress)
            if view.cue is not None:
                losses |= view.cue(geometry, progress)
        return losses

    def of_shapes(self, log_scales: Float[Tensor, "N 3"], radii: Int[Tensor, " N"]) -> dict[str, Tensor]:
        """Weighted terms of the Gaussians' shapes in the rescaled world, over those with a radius in a view."""
        weight = self.extra.flattening
        return {"flattening": weight * flattening_loss(log_scales.exp(), radii > 0)} if weight > 0 else {}


class CueLosses:
    """Weighted terms that compare renders of one view with a cue's maps; what depends on these alone is computed once.

    If metres are unknown, lengths are in units of nerfstudio's rescaled world.

    Args:
        cue: the maps.
        trust: weight of each pixel in E, 0 where there is no cue; the other terms are of pixels with a weight of 1.
        paper: terms against the cue.
        extra: terms beyond the paper.
        metres_per_unit: metres per unit of the world; None if unknown.
        shell_error: error of the shell's alignment in metres; None if unknown.
    """

    def __init__(
        self,
        cue: Reference,
        trust: Float[Tensor, "H W 1"],
        paper: GeometryLossConfig,
        extra: ExtraLossConfig,
        metres_per_unit: float | None,
        shell_error: float | None = None,
    ):
        self.cue, self.trust = cue._replace(mask=trust == 1), trust
        self.paper, self.extra, self.metres = paper, extra, metres_per_unit or 1.0
        self.tolerance = extra.tolerance_for(shell_error)
        self._splats: EmptySpaceLoss | None = None

    def __call__(self, geometry: Geometry, progress: float) -> dict[str, Tensor]:
        """Weighted terms of one render, at ``progress`` in [0, 1] of the run."""
        paper, extra = self.paper, self.extra
        terms = {
            "depth": (paper.depth(progress), lambda: self._ncc(1 / geometry.depth.clamp_min(1e-6))),
            "normal": (paper.normal(progress), lambda: self._normal(geometry.normal)),
            "smoothness": (paper.smoothness(progress), lambda: self._smoothness(geometry.normal)),
            "depth_normal": (
                extra.depth_normal,
                lambda: NormalLoss(self.cue.normal, self.cue.mask & _known(geometry))(geometry.depth_normal),
            ),
            "empty_space": (extra.empty_space, lambda: self._empty_space(geometry)),
        }
        return {name: weight * term() for name, (weight, term) in terms.items() if weight > 0}

    @cached_property
    def _ncc(self) -> Callable[[Tensor], Tensor]:
        mask = self.cue.mask
        inverse_depth = torch.where(mask, 1 / self.cue.depth, 0.0)
        if self.paper.ncc == "vid2sim":
            return lambda x: vid2sim_ncc_loss(x, inverse_depth, mask)
        return NccLoss(inverse_depth, mask, self.paper.ncc_window)

    @cached_property
    def _normal(self) -> NormalLoss:
        return NormalLoss(self.cue.normal, self.cue.mask)

    @cached_property
    def _smoothness(self) -> SmoothnessLoss:
        return SmoothnessLoss(self.cue.depth, self.cue.mask)

    def _empty_space(self, geometry: Geometry) -> Tensor:
        if self._splats is None:
            depth, normal, _ = self.cue
            rays = geometry.camera.rays()
            self._splats = EmptySpaceLoss(depth, normal, rays, self.trust, self.metres, self.tolerance)
        assert geometry.moments is not None
        return self._splats(geometry.moments.about(self.cue.depth, geometry.solid), _opacity(geometry))


class SelfLosses:
    """Weighted terms of 2DGS on the rendered geometry of one view, without a cue.

    Args:
        kept: pixels kept by the user's mask, over which the terms are means.
        with_cue: pixels with a cue, believed or not, where normal consistency is 0; None in a view without a map.
        extra: the terms.
    """

    def __init__(self, kept: Bool[Tensor, "H W 1"], with_cue: Bool[Tensor, "H W 1"] | None, extra: ExtraLossConfig):
        self.kept, self.with_cue, self.extra = kept, with_cue, extra

    def __call__(self, geometry: Geometry, progress: float) -> dict[str, Tensor]:
        """Weighted terms of one render, at ``progress`` in [0, 1] of the run."""
        extra, iteration = self.extra, progress * PAPER_ITERATIONS
        losses = {}
        if extra.normal_consistency > 0 and iteration >= extra.normal_consistency_from:
            consistency = normal_consistency_loss(
                geometry.normal, geometry.depth_normal, geometry.alpha, self._without_cue
            )
            losses["normal_consistency"] = extra.normal_consistency * consistency
        if extra.distortion > 0 and iteration >= DISTORTION_FROM:
            assert geometry.distortion is not None
            losses["distortion"] = extra.distortion * (self._weights * geometry.distortion).sum()
        return losses

    @cached_property
    def _weights(self) -> Float[Tensor, "H W 1"]:
        return mean_weights(self.kept, like=self.kept.float())

    @cached_property
    def _without_cue(self) -> Float[Tensor, "H W 1"]:
        """Weights of normal consistency: a pixel weighs the same however few are without a cue."""
        return self._weights if self.with_cue is None else self._weights.where(~self.with_cue, 0.0)


def _opacity(geometry: Geometry) -> Tensor:
    """Opacity; 1 where windows let through what is behind them, but no more than they may."""
    return geometry.alpha if geometry.surface is None else 1 - (SOLID - geometry.surface).relu()


def _known(geometry: Geometry) -> Bool[Tensor, "H W 1"]:
    return (geometry.depth_normal != 0).any(dim=-1, keepdim=True)
