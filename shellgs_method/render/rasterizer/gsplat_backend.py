"""Rasterization of 3D Gaussians and 2DGS discs with the CUDA kernels of the installed gsplat, 1.4 or 1.5.

gsplat can be imported everywhere; its kernels are loaded, and if need be compiled, on first use.

A splat has one radius in gsplat 1.4: three standard deviations along its longest axis, the sides of a square. From 1.5
it has two: 3.33 standard deviations along x and along y, the sides of a box. Here they say which splats gsplat culled
and how large the others are; tiles are found, and densification measures, by covariances that are the same for both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch
from gsplat import (
    fully_fused_projection,
    fully_fused_projection_2dgs,
    isect_offset_encode,
    isect_tiles,
    rasterize_to_pixels,
    rasterize_to_pixels_2dgs,
)
from jaxtyping import Bool, Float, Int
from torch import Tensor

from shellgs_method.errors import notice
from shellgs_method.geometry.camera import Camera
from shellgs_method.machine.gsplat_kernels import TORCH_COSTS, kernels_fault
from shellgs_method.render.rasterizer import discs as disc_projection
from shellgs_method.render.rasterizer.projection import LOW_PASS, NEAR_PLANE, cutoffs, three_sigmas
from shellgs_method.render.rasterizer.renders import Renders

Backend = Literal["auto", "torch", "gsplat"]

TILE = 16  # pixels along the side of a tile; gsplat tests no other size


def runs_on_gsplat(backend: Backend, means: Tensor) -> bool:
    """Whether to rasterize with gsplat's kernels; if they cannot run on a CUDA device, log the reason once.

    No Gaussians are rasterized without them: gsplat 1.5 divides by their number, which ends the process.

    Raises:
        ValueError: If ``backend`` is ``gsplat`` and it cannot run.
    """
    if backend == "torch":
        return False
    on_cuda = means.device.type == "cuda"
    if not on_cuda or means.dtype != torch.float32:
        fault = f"its kernels take float32 tensors on a CUDA device, and these are {means.dtype} on {means.device}"
    else:
        fault = kernels_fault()
    if backend == "gsplat" and fault:
        raise ValueError(f'backend="gsplat" cannot run here; use "auto" or "torch": {fault}.')
    if on_cuda and fault:
        notice(f"The rasterizer runs on {means.device} in plain torch, {TORCH_COSTS} than on gsplat: {fault}.")
    return fault is None and means.shape[0] > 0


def rasterize_3d(
    means: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    scales: Float[Tensor, "N 3"],
    opacities: Float[Tensor, "N"],
    features: Float[Tensor, "N C"],
    cameras: Sequence[Camera],
    n_densifying: int | None = None,
) -> Renders:
    """Rasterize Gaussians for cameras of one size; all tensors are float32 on a CUDA device.

    The render equals that of the torch backend, except that gsplat 1.4 culls splats beside the image that reach into it
    only beyond three standard deviations, where alpha is below 0.012.
    """
    viewmats, Ks, width, height = _stack(cameras)
    radii, means2d, depths, conics, _ = fully_fused_projection(
        means, None, quats, scales, viewmats, Ks, width, height, eps2d=LOW_PASS, near_plane=NEAR_PLANE, packed=False
    )
    covars2d = _covariances(radii, conics)
    # A splat is binned to all tiles where its alpha counts: farther out than gsplat does, to avoid visible tile
    # borders; less far if it is faint, to save time.
    reach = (cutoffs(opacities)[:, None] * covars2d[..., ::2]).sqrt()
    visible = _kept(radii) & _touches(means2d, reach, width, height)
    bins = _bin(means2d, _tile_radii(reach, visible, radii), depths, width, height)
    probe, groups = _probed(means2d, features, n_densifying)
    renders = [
        rasterize_to_pixels(
            *(centres, conics, group.expand(len(cameras), -1, -1), opacities.expand(len(cameras), -1)),
            *(width, height, TILE, *bins),
        )
        for centres, group in groups
    ]
    composited, alpha = torch.cat([render for render, _ in renders], dim=-1), renders[-1][1]
    return Renders(composited, alpha, composited[..., :0], probe, three_sigmas(covars2d, visible))


def rasterize_2d(
    means: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    scales: Float[Tensor, "N 3"],
    opacities: Float[Tensor, "N"],
    features: Float[Tensor, "N C"],
    cameras: Sequence[Camera],
    n_densifying: int | None = None,
) -> Renders:
    """Rasterize the discs of 2DGS (Huang et al. 2024).

    gsplat blends the depths of the centres, not of the intersections (its issues #477 and #863). At an intersection,
    1/z = q · ray with a constant q of the disc, see :class:`_Discs`: compositing the vectors q gives the exact sum of
    weight over z, and compositing q qᵀ that of weight over z².

    The render equals that of the torch backend, except that gsplat culls by its radii, and
    that all of a nearly edge-on disc has the depth of its centre in the maps.
    """
    discs = _project_discs(means, quats, scales, opacities, cameras)
    probe, groups = _probed(discs.means2d, features, n_densifying)
    renders = []
    for means2d, group in groups:
        moved = replace(discs, means2d=means2d, ray_transforms=_centred(discs.ray_transforms, means2d))
        # One camera at a time: gsplat 1.4 writes all normals of a batch into those of its first (its issue #425).
        views = [_composite_discs(moved, i, opacities, group, camera) for i, camera in enumerate(cameras)]
        renders.append([torch.cat(view) for view in zip(*views, strict=True)])
    composited = torch.cat([render[0] for render in renders], dim=-1)
    _, alpha, maps = renders[-1]
    return Renders(composited, alpha, maps, probe, discs.radii)


RASTERIZE = {"3d": rasterize_3d, "2d": rasterize_2d}


def _kept(radii: Int[Tensor, "B N ..."]) -> Bool[Tensor, "B N"]:
    """Which splats gsplat has not culled."""
    return radii > 0 if radii.dim() == 2 else (radii > 0).all(dim=-1)


@torch.no_grad()
def _covariances(radii: Int[Tensor, "B N ..."], conics: Float[Tensor, "B N 3"]) -> Float[Tensor, "B N 3"]:
    """Covariances (xx, xy, yy) in px² of Gaussians on the screen, from gsplat's radii and inverse covariances.

    The inverse of a conic (a, b, c) is a multiple of (c, -b, a). Its determinant, lost to rounding for a long and thin
    splat, is not needed: the radii give the size. They are rounded up, and so is the result.
    """
    a, b, c = conics.unbind(-1)
    if radii.dim() == 2:
        longest = (a + c) / 2 + (((a - c) / 2).square() + b.square()).sqrt()
        size = (radii / 3).square() / longest
    else:
        size = (radii / 3.33).square().sum(dim=-1) / (a + c)
    return size[..., None] * torch.stack([c, -b, a], dim=-1)


@torch.no_grad()
def _touches(
    means2d: Float[Tensor, "B N 2"], reach: Float[Tensor, "B N 2"], width: int, height: int
) -> Bool[Tensor, "B N"]:
    """Whether the box that reaches so far around a splat, if it is not too faint to have one, touches the image."""
    size = means2d.new_tensor([width, height])
    return ((reach > 0) & (means2d + reach > 0) & (means2d - reach < size)).all(dim=-1)


def _tile_radii(
    reach: Float[Tensor, "B N 2"], visible: Bool[Tensor, "B N"], radii: Int[Tensor, "B N ..."]
) -> Float[Tensor, "B N ..."]:
    """Radii to bin splats by, as many as gsplat has for each: 0 for those not visible, whose reach may be undefined."""
    reach = torch.where(visible[..., None], reach, 0.0)
    return reach.amax(dim=-1) if radii.dim() == 2 else reach


def _probed(
    means2d: Float[Tensor, "B N 2"], features: Float[Tensor, "N C"], n_densifying: int | None
) -> tuple[Float[Tensor, "B N 2"], list[tuple[Float[Tensor, "B N 2"], Float[Tensor, "N c"]]]]:
    """Means2d whose gradient drives densification, and groups of features with the means2d they are composited at.

    The kernels separate the gradients of features only if these are composited separately; alpha is the last group's.
    """
    if n_densifying is None:
        return means2d, [(means2d, features)]
    probe = means2d.detach().requires_grad_()
    first, rest = features[:, :n_densifying], features[:, n_densifying:]
    return probe, [(means2d + (probe - probe.detach()), first), (means2d, rest)]


def _centred(ray_transforms: Float[Tensor, "B N 3 3"], means2d: Float[Tensor, "B N 2"]) -> Float[Tensor, "B N 3 3"]:
    """Ray transforms of discs with the centres, the last column, recomputed from means2d and depths."""
    depths = ray_transforms[..., 2:, 2]
    centres = torch.cat([means2d * depths, depths], dim=-1)
    return torch.cat([ray_transforms[..., :2], centres[..., None]], dim=-1)


@dataclass(frozen=True)
class _Discs:
    """Discs on the screens of B cameras.

    Attributes:
        means2d: projected centres in pixels.
        ray_transforms: K [s_u t_u | s_v t_v | centre] in the camera frame; equation 8 of 2DGS.
        inverse_planes: q = normal / (normal · centre), so that q · ray = 1/z where a ray meets the plane;
            a steep disc is treated as facing the camera.
        radii: see :class:`Renders`.
        tile_radii: half sides of the boxes, or squares, around the means2d outside of which alpha does not count.
    """

    means2d: Float[Tensor, "B N 2"]
    ray_transforms: Float[Tensor, "B N 3 3"]
    inverse_planes: Float[Tensor, "B N 3"]
    radii: Int[Tensor, "B N"]
    tile_radii: Float[Tensor, "B N ..."]


def _project_discs(
    means: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    scales: Float[Tensor, "N 3"],
    opacities: Float[Tensor, "N"],
    cameras: Sequence[Camera],
) -> _Discs:
    viewmats, Ks, width, height = _stack(cameras)
    splats = fully_fused_projection_2dgs(means, quats, scales, viewmats, Ks, width, height, near_plane=NEAR_PLANE)
    radii, _, _, ray_transforms, normals = splats  # pyright: ignore[reportAssignmentType]
    # gsplat leaves the memory of culled discs uninitialised; none of it may reach a gradient, as 0 times NaN.
    visible = _kept(radii)
    normals = torch.where(visible[..., None], normals, normals.new_tensor([0.0, 0.0, -1.0]))
    ray_transforms = torch.where(visible[..., None, None], ray_transforms, torch.eye(3).to(means))

    # The centres are computed from means2d, so that these get the full gradient of a shift on the screen. gsplat's own
    # are centres of boxes, unlike the torch backend's, and in 1.4 their gradient lacks the mixed terms of tilted discs.
    depths = ray_transforms[..., 2:, 2]
    means2d = ray_transforms[..., :2, 2] / depths
    ray_transforms = _centred(ray_transforms, means2d)

    centres = ray_transforms[..., 2] @ torch.linalg.inv(Ks).mT
    planes = (normals * centres).sum(-1, keepdim=True)
    shows = planes[..., 0].detach().abs() > disc_projection.EDGE_ON * centres.detach().norm(dim=-1)
    # The low-pass shows a steep disc even where the ray meets its plane behind the camera. The centre's depth is right
    # there; with one q per disc, it must also serve where a ray meets the plane in front.
    cutoff = cutoffs(opacities)
    slopes = (normals[..., :2] / torch.stack([Ks[:, 0, 0], Ks[:, 1, 1]], dim=-1)[:, None]).norm(dim=-1)
    steep = planes[..., 0].abs() <= slopes * (cutoff / 2).sqrt() * depths[..., 0]
    facing = torch.cat([torch.zeros_like(means2d), 1 / depths], dim=-1)
    inverse_planes = torch.where(steep[..., None], facing, normals / torch.where(steep[..., None], 1.0, planes))

    reach = _reach_of_discs(means2d, ray_transforms, cutoff, max(width, height))
    visible = visible & shows & (cutoff > 0) & _touches(means2d, reach, width, height)
    sizes = three_sigmas(_covariances_of_discs(means2d, ray_transforms), visible)
    return _Discs(means2d, ray_transforms, inverse_planes, sizes, _tile_radii(reach, visible, radii))


@torch.no_grad()
def _covariances_of_discs(
    means2d: Float[Tensor, "B N 2"], ray_transforms: Float[Tensor, "B N 3 3"]
) -> Float[Tensor, "B N 3"]:
    """Covariances (xx, xy, yy) in px² of discs on the screen as if seen from afar."""
    w = ray_transforms[..., 2:, :]
    half_axes = (ray_transforms[..., :2, :2] - means2d[..., None] * w[..., :2]) / w[..., 2:]
    across, down = half_axes.unbind(dim=-2)
    xx, xy, yy = ((u * v).sum(dim=-1) for u, v in ((across, across), (across, down), (down, down)))
    return torch.stack([xx + disc_projection.LOW_PASS, xy, yy + disc_projection.LOW_PASS], dim=-1)


@torch.no_grad()
def _reach_of_discs(
    means2d: Float[Tensor, "B N 2"],
    ray_transforms: Float[Tensor, "B N 3 3"],
    cutoff: Float[Tensor, "N"],
    image_size: int,
) -> Float[Tensor, "B N 2"]:
    """Half the sides of boxes around the means2d that contain a disc, and its low-pass, up to a cutoff.

    The points (u, v) of a disc with u² + v² = cutoff project to an ellipse, whose box follows from the dual conic
    T diag(cutoff, cutoff, -1) Tᵀ (2DGS, section 4.2), here in pixels relative to the projected centre.
    """
    w = ray_transforms[..., 2:, :]
    rows = ray_transforms[..., :2, :] - means2d[..., None] * w
    signs = torch.stack([cutoff, cutoff, -torch.ones_like(cutoff)], dim=-1)[:, None]
    against = (signs * w * w).sum(-1)
    middle = (signs * rows * w).sum(-1) / against
    half = (middle.square() - (signs * rows * rows).sum(-1) / against).clamp_min(0).sqrt()
    # A disc that reaches behind the camera has no ellipse and may be anywhere in the image.
    on_plane = torch.where(against < 0, middle.abs() + half, means2d.abs() + image_size)
    return torch.maximum(on_plane, (cutoff / 2).sqrt()[:, None])


def _composite_discs(
    discs: _Discs, i: int, opacities: Float[Tensor, "N"], features: Float[Tensor, "N C"], camera: Camera
) -> tuple[Float[Tensor, "1 height width C"], Float[Tensor, "1 height width 1"], Float[Tensor, "1 height width 3"]]:
    """Features, alpha, and the maps of camera ``i``."""
    one = slice(i, i + 1)
    means2d, inverse_planes = discs.means2d[one], discs.inverse_planes[one]
    bins = _bin(means2d, discs.tile_radii[one], discs.ray_transforms[one, :, 2, 2], camera.width, camera.height)
    rows, columns = torch.triu_indices(3, 3, device=means2d.device)
    # Pad with zeros to a power of two: gsplat would pad with uninitialised memory. The kernel returns the last feature
    # of the median disc as its depth: the disc's index here, to look it up.
    n_features = features.shape[-1]
    size = 1 << (n_features + len(rows)).bit_length()
    products = inverse_planes[..., rows] * inverse_planes[..., columns]
    numbers = torch.arange(len(features), dtype=features.dtype, device=features.device)
    filling = features.new_zeros(1, len(features), size - n_features - len(rows) - 1)
    channels = torch.cat([features[None], products, filling, numbers[None, :, None]], dim=-1)
    renders = rasterize_to_pixels_2dgs(
        *(means2d, discs.ray_transforms[one], channels, opacities[None], inverse_planes),
        *(torch.zeros_like(means2d), camera.width, camera.height, TILE, *bins),
    )
    composited, alpha, inverse_plane, _, median = renders  # pyright: ignore[reportAssignmentType]
    composited, products, _ = composited.split([n_features, len(rows), size - n_features - len(rows)], dim=-1)
    rays = camera.rays()
    pairs_of_rays = torch.where(rows == columns, 1, 2) * rays[..., rows] * rays[..., columns]
    inverse_depth = (inverse_plane * rays).sum(-1, keepdim=True)
    square = (products * pairs_of_rays).sum(-1, keepdim=True)
    at_median = (inverse_planes[:, median[0, ..., 0].long()] * rays).sum(-1, keepdim=True)
    halves = alpha >= 0.5
    median_depth = torch.where(halves, 1 / torch.where(halves, at_median, 1.0), 0.0)
    return composited, alpha, torch.cat([inverse_depth, square, median_depth], dim=-1)


@torch.no_grad()
def _bin(
    means2d: Float[Tensor, "B N 2"],
    radii: Float[Tensor, "B N ..."],
    depths: Float[Tensor, "B N"],
    width: int,
    height: int,
) -> tuple[Int[Tensor, "B rows columns"], Int[Tensor, "entries"]]:
    """Bin splats to tiles, front to back: offset of each tile in the list of splats, and the list."""
    columns, rows = -(-width // TILE), -(-height // TILE)
    _, tiles, splats = isect_tiles(means2d, radii.ceil().int(), depths, TILE, columns, rows)
    return isect_offset_encode(tiles, len(means2d), columns, rows), splats


def _stack(cameras: Sequence[Camera]) -> tuple[Float[Tensor, "B 4 4"], Float[Tensor, "B 3 3"], int, int]:
    """Viewmats, Ks, and the common width and height."""
    viewmats = torch.stack([camera.viewmat for camera in cameras])
    return viewmats, torch.stack([camera.K for camera in cameras]), cameras[0].width, cameras[0].height
