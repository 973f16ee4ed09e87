"""Rasterization of splats with any features, differentiable, with the semantics of gsplat's classic mode."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from importlib.metadata import version
from typing import Any, Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from dataparsers.camera import Camera
from shellgs_method.rasterizer import gsplat_backend
from shellgs_method.rasterizer.binning import bin_splats
from shellgs_method.rasterizer.compositing import composite
from shellgs_method.rasterizer.disc_kernels import DISCS
from shellgs_method.rasterizer.discs import disc_maps, project_discs
from shellgs_method.rasterizer.gaussian_kernels import GAUSSIANS
from shellgs_method.rasterizer.kernels import Kernels
from shellgs_method.rasterizer.picture import Picture
from shellgs_method.rasterizer.projection import Projection, project_gaussians


def rasterize(
    means: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    scales: Float[Tensor, "N 3"],
    opacities: Float[Tensor, "N"],
    features: Float[Tensor, "N C"],
    camera: Camera | Sequence[Camera],
    primitive: Literal["3d", "2d"] = "3d",
    backend: gsplat_backend.Backend = "auto",
) -> tuple[Float[Tensor, "*B height width C"], Float[Tensor, "*B height width 1"], dict[str, Any]]:
    """Composite the features of 3D Gaussians or 2D discs front to back, by the depth of their centres.

    Gaussians go through the EWA approximation. Discs, spanned by the first two axes of a splat, are met by each
    pixel's ray where it goes through their planes, and are at least as wide as a pixel by the low-pass of 2DGS.

    A splat's alpha is at most 0.999, and does not count below 1/255; a pixel stops before the splat that would bring
    its transmittance to 1e-4 or less.

    Args:
        means: centres in the world.
        quats: rotations (w, x, y, z) of any norm.
        scales: standard deviations along the rotated axes, in scene units, positive.
        opacities: in (0, 1).
        features: any channels, all composited in one pass.
        camera: one, or B of one size; its tensors are brought to the dtype and device of the means.
        primitive: "3d" for Gaussians, "2d" for discs.
        backend: ``torch`` runs everywhere; ``gsplat`` takes float32 tensors on a CUDA device where its kernels load;
            ``auto`` is gsplat where it runs.

    Returns:
        The sums of weight times feature (not divided by alpha, no background), the sums of the weights, and what
        gsplat's densification strategies need: ``means2d`` [B, N, 2] in pixels, whose gradient can be retained,
        ``radii``, …. The pictures of a sequence of cameras are stacked.

        Of discs there are also, differentiable, [*B, height, width, 1]: ``inverse_depth``, the sum of weight over z of
        the ray's intersection, so that alpha / inverse_depth is the expected depth (the mean is taken of 1/z, which is
        affine on the screen, as every backend can composite it exactly); ``median_depth``, the z of the splat at which
        the transmittance falls to 1/2 or less, 0 where it does not, with a gradient to that splat alone;
        ``distortion``, see :func:`~.discs.disc_maps`. Their ``gradient_2dgs`` is ``means2d``: gsplat's is the gradient
        by the screen position of a centre at fixed depth and axes, as it acts through the intersection; this one has
        what acts through the low-pass added.

    Raises:
        ValueError: if the cameras differ in size, or there are none; if gsplat is asked for and cannot run.
    """
    cameras = [camera] if isinstance(camera, Camera) else list(camera)
    sizes = {(each.width, each.height) for each in cameras}
    if len(sizes) != 1:
        raise ValueError(f"The cameras of a batch need one size in common, not {sorted(sizes)}.")
    ((width, height),) = sizes
    cameras = [each.to(means) for each in cameras]
    on_gsplat = gsplat_backend.runs_on_gsplat(backend, means)
    render = (gsplat_backend.RASTERIZE if on_gsplat else _RASTERIZE)[primitive]
    picture = render(means, quats, scales, opacities, features, cameras)
    info = {
        "means2d": picture.means2d,
        "radii": picture.radii,
        "gaussian_ids": None,
        "width": width,
        "height": height,
        "n_cameras": len(cameras),
    }
    one = isinstance(camera, Camera)
    composited, alpha, maps = (each[0] if one else each for each in (picture.composited, picture.alpha, picture.maps))
    if primitive == "2d":
        info |= {"gradient_2dgs": picture.means2d, **disc_maps(alpha, maps)}
    return composited, alpha, info


def _rasterize(
    project: Callable[..., Projection],
    kernels: Kernels,
    means: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    scales: Float[Tensor, "N 3"],
    opacities: Float[Tensor, "N"],
    features: Float[Tensor, "N C"],
    cameras: Sequence[Camera],
) -> Picture:
    """Rasterize in torch the primitive of a projection and kernels."""
    projection = project(means, quats, scales, opacities, cameras)
    size = cameras[0].width, cameras[0].height
    views = torch.stack([_render(projection, kernels, i, features, *size) for i in range(len(cameras))])
    composited, alpha, maps = views.split([features.shape[1], 1, kernels.n_maps], dim=-1)
    return Picture(composited, alpha, maps, projection.means2d, _radii(projection))


_RASTERIZE = {
    "3d": partial(_rasterize, project_gaussians, GAUSSIANS),
    "2d": partial(_rasterize, project_discs, DISCS),
}


def _render(
    projection: Projection, kernels: Kernels, i: int, features: Float[Tensor, "N C"], width: int, height: int
) -> Float[Tensor, "height width C+1+maps"]:
    """Features, alpha and the primitive's maps as camera ``i`` sees them."""
    visible = projection.visible[i].nonzero().squeeze(1)
    depths = projection.depths[i].index_select(0, visible)
    # The bits of positive numbers are integers of the same order, which are sorted several times as fast.
    depths = depths.view(torch.int32 if depths.dtype == torch.float32 else torch.int64)
    order = visible.index_select(0, depths.sort(stable=True).indices)
    bins = bin_splats(projection.outlines[i].index_select(0, order), width, height)
    picture = composite(projection.means2d[i], projection.shapes[i], features, order, bins, kernels)
    return picture[:height, :width]


def _radii(projection: Projection) -> Int[Tensor, "B N ..."]:
    """Radii of three standard deviations for gsplat 1.4; up to where alpha counts from 1.5."""
    if tuple(map(int, version("gsplat").split(".")[:2])) >= (1, 5):
        reach = projection.outlines[..., 5:].amax(-2)
        return torch.where(projection.visible[..., None], reach.ceil(), 0).int()
    xx, xy, yy = projection.covars2d.unbind(-1)
    variance = (xx + yy) / 2 + (((xx - yy) / 2).square() + xy.square()).sqrt()
    return torch.where(projection.visible, (3 * variance.sqrt()).ceil(), 0).int()
