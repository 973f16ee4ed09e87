"""The geometric terms of the objective, weighted for the iteration. A term of no weight is not computed."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Literal

import torch
from jaxtyping import Bool
from torch import Tensor

from shellgs_method.evaluation import Reference
from shellgs_method.geometry import Geometry
from shellgs_method.losses import (
    PAPER_ITERATIONS,
    ExponentialDecay,
    agreement_loss,
    consistency_loss,
    ncc_loss,
    normal_loss,
    point_to_plane_loss,
    vid2sim_ncc_loss,
)


@dataclass
class GeometryLossConfig:
    """Weights of D, N and C from the first iteration to the last (paper, section 3.4); initial 0 leaves a term out."""

    depth: ExponentialDecay = field(default_factory=lambda: ExponentialDecay(0.5, 0.1))
    """Weight α(t) of the inverse-depth NCC."""
    normal: ExponentialDecay = field(default_factory=lambda: ExponentialDecay(0.1, 0.1))
    """Weight β(t) of the normal loss."""
    consistency: ExponentialDecay = field(default_factory=lambda: ExponentialDecay(0.1, 0.1))
    """Weight γ(t) of the consistency of neighbouring normals."""
    ncc: Literal["local", "vid2sim"] = "local"
    """local: the paper's equation; vid2sim: the form of the released baseline."""
    ncc_window: int = 9
    """Side of the patches of the local NCC in pixels."""
    ncc_eps: float = 1e-3
    """Contrast of a patch, relative to its depth, below which the local NCC takes it for flat."""


@dataclass(frozen=True)
class ExtraLossConfig:
    """Terms beyond the paper's objective, each off at 0. Lengths are scene units where metres are unknown."""

    agreement: float = 0.0
    """Weight of the normal consistency of 2DGS: composited normals against those of the rendered depth (there 0.05)."""
    agreement_from: int = 7000
    """First iteration of that term."""
    distortion: float = 0.0
    """Weight of the depth distortion of 2DGS; discs only."""
    distortion_from: int = 3000
    """First iteration of that term."""
    depth_normal: float = 0.0
    """Weight of the normal loss on normals of the rendered depth, which moves Gaussians where N turns them."""
    point_to_plane: float = 0.0
    """Weight of the distance from the cue's tangent plane, in metres, under a logarithm."""
    tolerance: float = 0.05
    """Distance from the plane that costs nothing, in metres: how far the alignment may be off."""
    occlusion_gate: float = 0.0
    """Metres that a pixel's rendered depth may be in front of the cue before it is taken for an occluder's."""
    occlusion_gate_from: int = 3000
    """First iteration of all cue terms with a gate; by then the photographs have put occluders in their place."""
    flattening: float = 0.0
    """Weight of the mean smallest scale of visible Gaussians, in units of the rescaled world (Vid2Sim: 100)."""


def cue_losses(
    geometry: Geometry,
    cue: Reference,
    paper: GeometryLossConfig,
    extra: ExtraLossConfig,
    progress: float,
    metres_per_unit: float | None,
) -> dict[str, Tensor]:
    """Terms that compare the rendered geometry with a cue's maps, at the share ``progress`` of the run.

    Where metres are unknown, ``extra``'s lengths are in units of nerfstudio's rescaled world.
    """
    metres = metres_per_unit or 1.0
    mask = cue.mask
    if extra.occlusion_gate > 0:
        if progress < extra.occlusion_gate_from / PAPER_ITERATIONS:
            return {}
        mask = mask & (metres * (cue.depth - geometry.depth.detach()) < extra.occlusion_gate)
    ncc = {"local": partial(ncc_loss, window=paper.ncc_window, eps=paper.ncc_eps), "vid2sim": vid2sim_ncc_loss}
    inverse_depth = 1 / geometry.depth.clamp_min(1e-6)
    terms = {
        "depth": (
            paper.depth(progress),
            lambda: ncc[paper.ncc](inverse_depth, torch.where(mask, 1 / cue.depth, 0.0), mask),
        ),
        "normal": (paper.normal(progress), lambda: normal_loss(geometry.normal, cue.normal, mask)),
        "consistency": (paper.consistency(progress), lambda: consistency_loss(geometry.normal, cue.depth, mask)),
        "depth_normal": (
            extra.depth_normal,
            lambda: normal_loss(geometry.depth_normal, cue.normal, mask & _known(geometry)),
        ),
        "point_to_plane": (
            extra.point_to_plane,
            lambda: point_to_plane_loss(
                geometry.depth, cue.depth, cue.normal, geometry.camera.rays(), mask, metres, extra.tolerance
            ),
        ),
    }
    return {name: weight * term() for name, (weight, term) in terms.items() if weight > 0}


def self_losses(geometry: Geometry, extra: ExtraLossConfig, progress: float) -> dict[str, Tensor]:
    """Terms of the rendered geometry that need no cue, those of 2DGS, at the share ``progress`` of the run."""
    iteration = progress * PAPER_ITERATIONS
    losses = {}
    if extra.agreement > 0 and iteration >= extra.agreement_from:
        losses["agreement"] = extra.agreement * agreement_loss(geometry.normal, geometry.depth_normal, geometry.alpha)
    if extra.distortion > 0 and iteration >= extra.distortion_from:
        assert geometry.distortion is not None
        losses["distortion"] = extra.distortion * geometry.distortion.mean()
    return losses


def _known(geometry: Geometry) -> Bool[Tensor, "H W 1"]:
    return (geometry.depth_normal != 0).any(dim=-1, keepdim=True)
