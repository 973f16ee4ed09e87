"""Appearance metrics: PSNR, SSIM, LPIPS, of a render and of one whose colours are fitted to the photograph."""

from __future__ import annotations

import os
import threading
import urllib.request
from collections.abc import Mapping
from contextlib import suppress
from functools import cache
from typing import TYPE_CHECKING

import torch
from jaxtyping import Bool, Float
from kornia.metrics import psnr, ssim
from torch import Tensor

from shellgs_method.errors import notice
from shellgs_method.machine.doctor import lpips_weights

if TYPE_CHECKING:
    from torchmetrics import Metric

SMALLEST_LPIPS_IMAGE = 31
"""Smallest side in pixels that AlexNet's strides can process."""

CLIPPED = 0.5 / 255
"""Distance from black or white within which a colour is clipped."""


def image_errors(
    rgb: Float[Tensor, "H W 3"],
    target: Float[Tensor, "H W 3"],
    regions: Mapping[str, Bool[Tensor, "H W 1"]] | None = None,
    kept: Bool[Tensor, "H W 1"] | None = None,
) -> dict[str, float]:
    """PSNR in dB (at most 100, so that an exact image can be averaged), SSIM, and LPIPS if available.

    Colours are in [0, 1]; a render's may be larger, and are clipped once they are corrected. SSIM is as in the loss,
    with a Gaussian window of 11 pixels and sigma 1.5; LPIPS uses the AlexNet backbone. PSNR and SSIM of each region
    that is not empty are ``psnr_…`` and ``ssim_…`` with its name. The same metrics of the :func:`colour_corrected`
    render are ``cc_psnr`` and so on; it is corrected over the region ``seen`` if there is one: pixels that no training
    view shows say nothing about a photograph's exposure.

    Pixels outside ``kept`` are ignored: they are set to the target, so that no window differs there, and excluded from
    all means. LPIPS, whose mean is over all pixels, is divided by the share of kept pixels.
    """
    kept = torch.ones_like(target[..., :1], dtype=torch.bool) if kept is None else kept
    if not kept.any():
        return {}
    rgb, regions = rgb.detach(), regions or {}
    corrected = colour_corrected(rgb, target, kept & regions.get("seen", kept))
    metrics = _errors(rgb.clamp(0, 1), target, regions, kept)
    return metrics | {f"cc_{name}": value for name, value in _errors(corrected, target, regions, kept).items()}


def colour_corrected(
    rgb: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], where: Bool[Tensor, "H W 1"]
) -> Float[Tensor, "H W 3"]:
    """The affine map of a render's colours that is closest to its photograph in least squares, clamped to [0, 1].

    This removes differences of exposure, white balance and camera colours, which a method cannot know for a held-out
    photograph. Nerfstudio's metrics of this name fit a quadratic map, five times in a row, which removes more; gsplat
    has both.

    Args:
        rgb: render, in [0, 1] or not clipped.
        target: photograph, in [0, 1].
        where: pixels to fit; those that are clipped in either do not count. If too few are left, the map stays close to
            the identity.
    """
    clipped = ((rgb <= CLIPPED) | (rgb >= 1 - CLIPPED) | (target <= CLIPPED) | (target >= 1 - CLIPPED)).any(dim=-1)
    plain = where[..., 0] & ~clipped
    colours = torch.cat([rgb, torch.ones_like(rgb[..., :1])], dim=-1).double()
    x, y = colours[plain], target[plain].double()
    identity = torch.eye(4, 3, dtype=x.dtype, device=x.device)
    ridge = 1e-6 * torch.eye(4, dtype=x.dtype, device=x.device)
    affine = identity + torch.linalg.solve(x.T @ x + ridge, x.T @ (y - x @ identity))
    return (colours @ affine).to(rgb).clamp(0, 1)


def _errors(
    rgb: Float[Tensor, "H W 3"],
    target: Float[Tensor, "H W 3"],
    regions: Mapping[str, Bool[Tensor, "H W 1"]],
    kept: Bool[Tensor, "H W 1"],
) -> dict[str, float]:
    rgb = rgb.where(kept, target)
    rgb, target, kept = rgb.permute(2, 0, 1)[None], target.permute(2, 0, 1)[None], kept[..., 0]
    similarity = ssim(rgb, target, window_size=11)[0]
    parts = {"": kept} | {f"_{name}": mask[..., 0] & kept for name, mask in regions.items()}
    metrics = {}
    for suffix, region in parts.items():
        if region.any():
            metrics[f"psnr{suffix}"] = min(psnr(rgb[..., region], target[..., region], max_val=1.0).item(), 100.0)
            metrics[f"ssim{suffix}"] = similarity[:, region].mean().item()
    network = lpips_network()
    if not isinstance(network, str) and min(rgb.shape[-2:]) >= SMALLEST_LPIPS_IMAGE:
        with torch.no_grad():
            metrics["lpips"] = network.to(rgb.device)(rgb, target).item() / kept.float().mean().item()
    return metrics


@cache
def lpips_network() -> Metric | str:
    """Return the LPIPS network, or why there is none; the backbone is downloaded unless torch.hub has it cached.

    Tried once per process, so that a machine without network waits once and warns once.
    """
    url, cached = lpips_weights()
    if not os.path.exists(cached) and not _reachable(url):
        obstacle = f"the weights of AlexNet are not at {cached}, and {url} cannot be reached"
    else:
        try:
            from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

            return LearnedPerceptualImagePatchSimilarity(net_type="alex", normalize=True)
        except Exception as error:  # incomplete download, damaged file, full disk: continue without LPIPS
            obstacle = f"the weights of AlexNet cannot be loaded from {cached}: {error}"
    notice(f"LPIPS is not available: {obstacle}.")
    return obstacle


def _reachable(url: str, seconds: float = 5.0) -> bool:
    """Whether a server answers in time; asked in a thread, as a name server can take minutes."""
    answered = threading.Event()

    def ask() -> None:
        with suppress(OSError), urllib.request.urlopen(urllib.request.Request(url, method="HEAD"), timeout=seconds):
            answered.set()

    thread = threading.Thread(target=ask, daemon=True)
    thread.start()
    thread.join(seconds)
    return answered.is_set()
