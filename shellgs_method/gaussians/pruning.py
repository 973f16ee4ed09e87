"""Gaussians that are removed besides those that densification prunes: broken, hardly shown, and shaped by no view."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import reduce

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from shellgs_method.geometry.camera import Camera

ONE_VIEW = 1.5
"""Effective number of views that show a Gaussian, below which it counts as shown by one."""
BARELY = 0.001
"""Share of an image below which a Gaussian of any size is barely visible in it."""
HARDLY = 0.5
"""Area in pixels below which, in every training view, a Gaussian is hardly shown."""

Coverage = Callable[[Camera], tuple[Float[Tensor, " N"], Bool[Tensor, " N"]]]
"""Area in pixels that each Gaussian covers of a camera's view, and whether it reaches into the view."""


def broken(gaussians: nn.ParameterDict) -> Bool[Tensor, " N"]:
    """Gaussians with a parameter that is not finite."""
    means = gaussians["means"]
    if all(bool(parameter.detach().sum().isfinite()) for parameter in gaussians.values()):  # reads each once
        return torch.zeros(len(means), dtype=torch.bool, device=means.device)
    finite = [parameter.detach().flatten(1).isfinite().all(dim=1) for parameter in gaussians.values()]
    return ~torch.stack(finite).all(dim=0)


def contributions(cameras: Iterable[Camera], coverage: Coverage) -> Float[Tensor, " N"]:
    """Largest area in pixels that each Gaussian covers of a training view, by the sum of compositing weights.

    As in RadSplat (Niemeyer et al. 2024), which takes the largest contribution to a pixel.

    Args:
        cameras: cameras of the training views, at least one.
        coverage: what Gaussians cover of a view.
    """
    return reduce(torch.maximum, (coverage(camera)[0] for camera in cameras))


def hardly_shown(cameras: Iterable[Camera], coverage: Coverage) -> Bool[Tensor, " N"]:
    """Gaussians that contribute less than :data:`HARDLY` to every training view, see :func:`contributions`."""
    return contributions(cameras, coverage) < HARDLY


def unshaped(
    means: Float[Tensor, "N 3"], scales: Float[Tensor, "N 3"], cameras: Iterable[Camera], coverage: Coverage
) -> Bool[Tensor, " N"]:
    """Gaussians that training views have not shaped, and that may spoil others.

    No view shows them; or views show little of them, though they reach a camera: the edge of something wide. A single
    one in front of a held-out camera displaced the depth of that view by 15 cm.

    Args:
        means: centres in the cameras' world.
        scales: standard deviations along the axes, in the same units.
        cameras: cameras of the training views.
        coverage: what Gaussians cover of a view.
    """
    total = squares = largest = means.new_zeros(len(means))  # of the shares of images that they cover
    shown, distance = total > 0, total + torch.inf
    for camera in cameras:
        camera = camera.to(means)
        area, in_view = coverage(camera)
        share = area / (camera.width * camera.height)
        total, squares, largest = total + share, squares + share.square(), largest.maximum(share)
        shown, distance = shown | in_view, distance.minimum((means - camera.position).norm(dim=-1))
    n_views = total.square() / squares.clamp_min(1e-30)  # effective number of views
    deviations = distance / scales.amax(dim=-1)  # from the nearest camera
    return ~shown | (deviations < 2) & (n_views < ONE_VIEW) | (deviations < 5) & (largest < BARELY)
