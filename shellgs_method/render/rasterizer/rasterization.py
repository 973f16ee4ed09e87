"""Differentiable rasterization of splats with arbitrary features, with the semantics of gsplat's classic mode."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from shellgs_method.geometry.camera import Camera
from shellgs_method.render.rasterizer import gsplat_backend
from shellgs_method.render.rasterizer.binning import bin_splats, stable_order
from shellgs_method.render.rasterizer.compositing import composite
from shellgs_method.render.rasterizer.disc_kernels import DISCS
from shellgs_method.render.rasterizer.discs import disc_maps, project_discs
from shellgs_method.render.rasterizer.gaussian_kernels import GAUSSIANS
from shellgs_method.render.rasterizer.kernels import Kernels
from shellgs_method.render.rasterizer.projection import Projection, project_gaussians, three_sigma
from shellgs_method.render.rasterizer.renders import Ellipsoids, Renders


def rasterize(
    means: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    scales: Float[Tensor, "N 3"],
    opacities: Float[Tensor, " N"],
    features: Float[Tensor, "N C"],
    camera: Camera,
    primitive: Literal["3d", "2d"] = "3d",
    backend: gsplat_backend.Backend = "auto",
    n_densifying: int | None = None,
) -> tuple[Float[Tensor, "height width C"], Float[Tensor, "height width 1"], dict[str, Any]]:
    """Composite the features of 3D Gaussians or 2D discs front to back, sorted by the depth of their centres.

    Gaussians are projected by the EWA approximation. Discs, spanned by the first two axes of a splat, are intersected
    with each pixel's ray; the low-pass of 2DGS keeps them at least as wide as a pixel.

    Alpha is at most 0.999, and ignored below 1/255; a pixel stops before the splat that would bring its transmittance
    to 1e-4 or less.

    Args:
        means: centres in the world.
        quats: rotations (w, x, y, z) of any norm.
        scales: standard deviations along the rotated axes, in scene units, positive.
        opacities: opacities in (0, 1).
        features: any channels, all composited in one pass.
        camera: moved to the dtype and device of the means.
        primitive: "3d" for Gaussians, "2d" for discs.
        backend: ``torch`` runs everywhere; ``gsplat`` takes float32 tensors on a CUDA device where its kernels load;
            ``auto`` is gsplat where it runs.
        n_densifying: if given, the gradient of ``info["means2d"]``, by which gsplat's strategies densify, is that of
            the first ``n_densifying`` features alone; all other gradients are unchanged.

    Returns:
        Sums of weight times feature (not divided by alpha, no background), sums of the weights, and the ``info`` of
        gsplat's densification strategies: ``means2d`` [1, N, 2] in pixels, whose gradient can be retained, ``radii``
        [1, N] as in :class:`Renders` with every backend (those of gsplat 1.5 take ``radii[..., None]``), ….

        For discs, ``info`` also has differentiable maps ``[H, W, 1]``: ``inverse_depth``, the sum of weight over z
        of the ray's intersection, so that alpha / inverse_depth is the expected depth (1/z is averaged because it is
        affine on the screen: every backend can composite it exactly); ``median_depth``, the z of the splat at which
        the transmittance falls to 1/2 or less, 0 where it does not, with a gradient to that splat alone; and
        ``distortion``, see :func:`~.discs.disc_maps`. ``gradient_2dgs`` is ``means2d``: gsplat's is the gradient w.r.t.
        the screen position of a centre at fixed depth and axes, through the intersection alone; here that through the
        low-pass is added.

    Raises:
        ValueError: If ``backend`` is ``gsplat`` and it cannot run.
    """
    on_gsplat = gsplat_backend.runs_on_gsplat(backend, means)
    render = (gsplat_backend.RASTERIZE if on_gsplat else _RASTERIZE)[primitive]
    renders = render(Ellipsoids(means, quats, scales, opacities), features, camera.to(means), n_densifying)
    info = {
        "means2d": renders.means2d,
        "radii": renders.radii,
        "gaussian_ids": None,
        "width": camera.width,
        "height": camera.height,
        "n_cameras": 1,
    }
    if primitive == "2d":
        info |= {"gradient_2dgs": renders.means2d, **disc_maps(renders.alpha, *renders.maps)}
    return renders.composited, renders.alpha, info


def _rasterize(
    project: Callable[..., Projection],
    kernels: Kernels,
    splats: Ellipsoids,
    features: Float[Tensor, "N C"],
    camera: Camera,
    n_densifying: int | None,
) -> Renders:
    """Rasterize in torch the primitive given by ``project`` and ``kernels``."""
    projection = project(splats, camera, with_probe=n_densifying is not None)
    visible = projection.visible.nonzero().squeeze(1)
    depths = projection.depths.index_select(0, visible)
    # The bits of positive floats are integers of the same order, which sort several times faster.
    depths = depths.view(torch.int32 if depths.dtype == torch.float32 else torch.int64)
    order = visible.index_select(0, stable_order(depths))
    bins = bin_splats(projection.outlines.index_select(0, order), camera.width, camera.height)
    canvas = composite(projection, features, order, bins, kernels, n_densifying or 0)
    composited, alpha, *maps = canvas.split([features.shape[1], 1, *[1] * kernels.n_maps], dim=-1)
    radii = three_sigma(projection.covars2d.unbind(-1), projection.visible).int()[None]
    centres = projection.means2d if projection.probe is None else projection.probe
    return Renders(composited, alpha, tuple(maps), centres, radii)


_RASTERIZE = {
    "3d": partial(_rasterize, project_gaussians, GAUSSIANS),
    "2d": partial(_rasterize, project_discs, DISCS),
}
