"""Rasterization of 3D Gaussians with any features, differentiable, with the semantics of gsplat's classic mode."""

from __future__ import annotations

from importlib.metadata import version
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from dataparsers.camera import Camera
from shellgs_method.rasterizer.binning import bin_splats
from shellgs_method.rasterizer.compositing import composite
from shellgs_method.rasterizer.kernels import pack
from shellgs_method.rasterizer.projection import Projection, project


def rasterize(
    means: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    scales: Float[Tensor, "N 3"],
    opacities: Float[Tensor, "N"],
    features: Float[Tensor, "N C"],
    camera: Camera,
) -> tuple[Float[Tensor, "height width C"], Float[Tensor, "height width 1"], dict[str, Any]]:
    """Composite the features of 3D Gaussians front to back, by the depth of their centres.

    A splat's alpha is at most 0.999, and does not count below 1/255; a pixel stops before the splat that would bring
    its transmittance to 1e-4 or less.

    Args:
        means: centres in the world.
        quats: rotations (w, x, y, z) of any norm.
        scales: standard deviations along the rotated axes, in scene units, positive.
        opacities: in (0, 1).
        features: any channels, all composited in one pass.
        camera: its tensors are brought to the dtype and device of the means.

    Returns:
        The sums of weight times feature (not divided by alpha, no background), the sums of the weights, and what
        gsplat's densification strategies need: ``means2d`` [1, N, 2] in pixels, whose gradient can be retained,
        ``radii``, ….
    """
    projection = project(means, quats, scales, opacities, camera.to(means))
    means2d = projection.means2d[None]
    info = {
        "means2d": means2d,
        "radii": _radii(projection)[None],
        "gaussian_ids": None,
        "width": camera.width,
        "height": camera.height,
        "n_cameras": 1,
    }

    visible = projection.visible.nonzero().squeeze(1)
    order = visible[projection.depths[visible].argsort(stable=True)]
    centres, conics, opacities, features = (
        splats.index_select(0, order) for splats in (means2d[0], projection.conics, opacities, features)
    )
    bins = bin_splats(centres, conics, projection.cutoff[order], projection.reach[order], camera.width, camera.height)
    composited = composite(pack(centres, conics, opacities, features), bins)[: camera.height, : camera.width]
    return composited[..., :-1], composited[..., -1:], info


def _radii(projection: Projection) -> Int[Tensor, "N ..."]:
    """Radii in pixels as the installed gsplat has them, 0 where a splat is invisible.

    One of three standard deviations in gsplat 1.4; from 1.5 one each along x and y, up to where alpha counts.
    """
    if tuple(map(int, version("gsplat").split(".")[:2])) >= (1, 5):
        return torch.where(projection.visible[:, None], projection.reach.ceil(), 0).int()
    xx, xy, yy = projection.covars2d.unbind(-1)
    variance = (xx + yy) / 2 + (((xx - yy) / 2).square() + xy.square()).sqrt()
    return torch.where(projection.visible, (3 * variance.sqrt()).ceil(), 0).int()
