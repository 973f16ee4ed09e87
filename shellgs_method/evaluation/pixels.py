"""Which pixels of a view count: for the photometric loss, for losses against a cue, and for metrics.

A batch is nerfstudio's dictionary of a view, as :class:`~shellgs_method.dataset.FacadeDataset` makes it.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import max_pool2d

from shellgs_method.geometry.reference import Reference

MARGIN = 2
"""Margin in pixels around occluders, which their splats also cover."""
DOUBTED = 0.2
"""Weight of the shell where it is doubtful: enough on plain walls, where no other term acts, and too little where
photographs show an occluder."""


def kept_pixels(batch: dict, image: Float[Tensor, "H W 3"]) -> Bool[Tensor, "H W 1"]:
    """Pixels of an image that the user's mask keeps; all where there is none."""
    if "mask" in batch:
        return batch["mask"].to(image.device)
    return torch.ones_like(image[..., :1], dtype=torch.bool)


def photometric_pixels(
    batch: dict, image: Float[Tensor, "H W 3"], ignore_transients: bool
) -> Bool[Tensor, "H W 1"] | None:
    """Pixels of a photograph to train on, None for all: :func:`kept_pixels`, without detected moving objects."""
    if ignore_transients and "transient" in batch and batch["transient"].any():
        return kept_pixels(batch, image) & ~_with_margin(batch["transient"].to(image.device))
    return kept_pixels(batch, image) if "mask" in batch else None


def reference_maps(batch: dict, kind: str, device: torch.device, everywhere: bool = False) -> Reference:
    """Maps of one kind in a batch; pixels that the user masked out are not supported.

    Neither is the shell where photographs show something else, with a margin, unless ``everywhere`` is set.
    """
    depth, normal, mask = (batch[f"{kind}_{name}"].to(device) for name in ("depth", "normal", "mask"))
    if kind == "shell" and not everywhere:
        mask = mask & ~_with_margin(_hidden(batch, device))
    if "mask" in batch:
        mask = mask & batch["mask"].to(device)
    return Reference(depth, normal.float(), mask)


def shell_trust(batch: dict, mask: Bool[Tensor, "H W 1"]) -> Float[Tensor, "H W 1"]:
    """Weight of the shell in a training view, from 0 to 1, by the mask of its :func:`reference_maps` everywhere.

    It is 0 where photographs show something else, and :data:`DOUBTED` in a margin around that and where they may.
    """
    hidden = _hidden(batch, mask.device)
    doubtful = _with_margin(hidden)
    if "doubtful" in batch:
        doubtful |= batch["doubtful"].to(mask.device)
    return torch.where(doubtful, DOUBTED, 1.0).where(mask & ~hidden, 0.0)


def _hidden(batch: dict, device: torch.device) -> Bool[Tensor, "H W 1"]:
    """Pixels where photographs show something in front of the shell, or the background."""
    return occluded(batch, device) | beyond(batch, device)


def occluded(batch: dict, device: torch.device) -> Bool[Tensor, "H W 1"]:
    """Pixels where photographs show something in front of the shell; none if they were not compared."""
    other = _other_depth(batch)
    return ((other > 0) & (other < batch["shell_depth"])).to(device)


def seen_through(batch: dict, device: torch.device) -> Bool[Tensor, "H W 1"]:
    """Pixels where photographs show something behind the shell, in windows; none if they were not compared."""
    return (_other_depth(batch) > batch["shell_depth"]).to(device)


def beyond(batch: dict, device: torch.device) -> Bool[Tensor, "H W 1"]:
    """Pixels of the shell where photographs show the background; none if they were not compared."""
    return batch.get("beyond", torch.zeros_like(batch["shell_mask"])).to(device)


def _other_depth(batch: dict) -> Float[Tensor, "H W 1"]:
    return batch.get("other_depth", torch.zeros_like(batch["shell_depth"]))


def _with_margin(mask: Bool[Tensor, "H W 1"]) -> Bool[Tensor, "H W 1"]:
    return max_pool2d(mask.float().permute(2, 0, 1), 2 * MARGIN + 1, 1, MARGIN).bool().permute(1, 2, 0)
