"""Regions of a held-out view, and its metrics over them; ``pixels`` says which pixels count at all."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from shellgs_method.evaluation import Rendering, geometry_errors, image_errors
from shellgs_method.evaluation.pixels import beyond, kept_pixels, occluded, reference_maps
from shellgs_method.geometry.camera import Camera
from shellgs_method.geometry.reference import Reference

REFERENCES = {"shell": "", "truth": "truth_"}
"""Kinds of maps that geometry is measured against, and the prefixes of their metrics."""


def masked_image_errors(
    rgb: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], batch: dict, metres_per_unit: float | None
) -> dict[str, float]:
    """Metrics of :func:`image_errors` over the pixels that the user's mask keeps, and over their :func:`regions`."""
    return image_errors(rgb, target, regions(batch, metres_per_unit, rgb.device), kept_pixels(batch, target))


def reference_errors(
    rendering: Rendering, camera: Camera, batch: dict, metres_per_unit: float | None
) -> dict[str, float]:
    """Metrics of :func:`geometry_errors` against each reference in a batch: the shell, and ``truth_…``.

    Where metres are known, also ``truth_f_score_5cm_…`` over two of the :func:`regions`: on and in front of the shell.
    """
    metrics, found = {}, references(batch, rendering.depth.device)
    for prefix, reference in found.items():
        errors = geometry_errors(rendering, camera, reference, metres_per_unit)
        metrics |= {prefix + name: value for name, value in errors.items()}
    if truth := found.get(REFERENCES["truth"]):
        for name, part in regions(batch, metres_per_unit, rendering.depth.device).items():
            if name in ("on_shell", "before_shell"):  # not by a set, whose order is another in each process
                errors = geometry_errors(rendering, camera, truth._replace(mask=truth.mask & part), metres_per_unit)
                metrics |= {f"truth_{key}_{name}": errors[key] for key in errors.keys() & {"f_score_5cm"}}
    return metrics


def regions(batch: dict, metres_per_unit: float | None, device: torch.device) -> dict[str, Bool[Tensor, "H W 1"]]:
    """Parts of a held-out view that images are measured in, by name; all within what is visible in training views.

    * ``seen``: all of it.
    * ``on_shell``, ``off_shell``: on the shell, or where it is absent, does not count or is larger than the building.
    * ``before_shell``: where the ground truth is nearer than the shell by more than 5 cm (1/200 of its depth where
      metres are unknown) or, without ground truth, photographs show an occluder. These pixels are in neither of the
      above.
    """
    if "seen" not in batch:
        return {}
    seen = batch["seen"].to(device)
    if "shell_depth" not in batch:
        return {"seen": seen, "off_shell": seen}
    shell, on_shell = (batch[f"shell_{name}"].to(device) for name in ("depth", "mask"))
    before = seen & occluded(batch, device)
    if "truth_depth" in batch:
        truth = batch["truth_depth"].to(device)
        gap = 0.05 / metres_per_unit if metres_per_unit else shell / 200
        before = seen & torch.where(truth > 0, truth < shell - gap, before)
    on_shell, rest = on_shell & ~beyond(batch, device), seen & ~before
    return {"seen": seen, "on_shell": rest & on_shell, "off_shell": rest & ~on_shell, "before_shell": before}


def references(batch: dict, device: torch.device) -> dict[str, Reference]:
    """Reference maps of a batch, by the prefixes of their metrics."""
    return {
        prefix: reference_maps(batch, kind, device) for kind, prefix in REFERENCES.items() if f"{kind}_depth" in batch
    }
