"""Levels of detail of a trained run: the Gaussians that contribute least to its photographs are left out."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from shellgs_method.export.runs import TrainedRun
from shellgs_method.gaussians.pruning import contributions
from shellgs_method.gaussians.seeds import photograph_of
from shellgs_method.losses.reduction import weighted_mean
from shellgs_method.machine.progress import track


def ranked(run: TrainedRun) -> Int[Tensor, "N"]:
    """Indices of a run's Gaussians, the ones that contribute most to a training view first."""
    views = run.datasets[0]
    cameras = track(map(views.camera, range(len(views))), "Ranking the Gaussians", len(views))
    shown = contributions((camera.to(run.model.device) for camera in cameras), run.model.coverage)
    return shown.argsort(descending=True, stable=True)


def psnr_of(run: TrainedRun, chosen: Int[Tensor, "M"]) -> float:
    """Mean PSNR in dB of the held-out photographs, or of all if none is held out, rendered by some Gaussians alone."""
    views = run.datasets[1] if len(run.datasets[1]) else run.datasets[0]
    model, errors = run.model, []
    gaussians = {name: parameter.detach()[chosen] for name, parameter in model.gauss_params.items()}
    black = torch.zeros(3, device=model.device)
    for index in track(range(len(views)), "Rendering a level", len(views)):
        camera = views.camera(index).to(model.device)
        with torch.no_grad():
            image = model.renderer(gaussians, camera, black, model.config.sh_degree, geometry=False).rgb.clamp(0, 1)
        errors.append(_psnr(image.cpu(), views.get_data(index, "uint8")))
    return sum(errors) / len(errors)


def _psnr(image: Float[Tensor, "H W 3"], batch: dict) -> float:
    error = (image - photograph_of(batch)).square()
    kept = batch.get("mask", torch.ones_like(error[..., :1], dtype=torch.bool))
    return float(-10 * weighted_mean(error, kept).log10())
