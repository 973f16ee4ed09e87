"""Rasterization of 3D Gaussians and 2DGS discs with the CUDA kernels of the installed gsplat, 1.4 or 1.5.

gsplat can be imported everywhere; its kernels are loaded, and if need be compiled, on first use.

A splat has one radius in gsplat 1.4: three standard deviations along its longest axis, the sides of a square. From 1.5
it has two: 3.33 standard deviations along x and along y, the sides of a box. Here they say which splats gsplat culled
and how large the others are; tiles are found, and densification measures, by covariances that are the same for both.
"""

from __future__ import annotations

import functools
import operator
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
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import embedding

from shellgs_method.errors import notice
from shellgs_method.geometry.camera import Camera
from shellgs_method.machine.constants import constant
from shellgs_method.machine.elementwise import Function, Value, Vector, dot, elementwise
from shellgs_method.machine.gsplat_kernels import TORCH_COSTS, kernels_fault
from shellgs_method.render.rasterizer import discs as disc_projection
from shellgs_method.render.rasterizer.binning import touches
from shellgs_method.render.rasterizer.projection import LOW_PASS, NEAR_PLANE, cutoffs, three_sigma
from shellgs_method.render.rasterizer.renders import Ellipsoids, Renders

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
    splats: Ellipsoids, features: Float[Tensor, "N C"], camera: Camera, n_densifying: int | None
) -> Renders:
    """Rasterize Gaussians; all tensors are float32 on a CUDA device.

    The render equals that of the torch backend, except that gsplat 1.4 culls splats beside the image that reach into it
    only beyond three standard deviations, where alpha is below 0.012.
    """
    (means, quats, scales, opacities), (width, height) = splats, (camera.width, camera.height)
    radii, means2d, depths, conics, _ = fully_fused_projection(
        *(means, None, quats, scales, camera.viewmat[None], camera.K[None], width, height),
        eps2d=LOW_PASS,
        near_plane=NEAR_PLANE,
        packed=False,
    )
    tile_radii, sizes = _extents(means2d, conics, radii, opacities, width, height)
    bins = _bin(means2d, tile_radii, depths, width, height)
    probe, groups = _probed(means2d, features, n_densifying)
    renders = [
        rasterize_to_pixels(centres, conics, group[None], opacities[None], width, height, TILE, *bins)
        for centres, group in groups
    ]
    composited = _joined([render.squeeze(0) for render, _ in renders])
    return Renders(composited, renders[-1][1].squeeze(0), (), probe, sizes)


def rasterize_2d(
    splats: Ellipsoids, features: Float[Tensor, "N C"], camera: Camera, n_densifying: int | None
) -> Renders:
    """Rasterize the discs of 2DGS (Huang et al. 2024).

    gsplat blends the depths of the centres, not of the intersections (its issues #477 and #863). At an intersection,
    1/z = q · ray with a constant q of the disc, see :class:`_Discs`: compositing the vectors q gives the exact sum of
    weight over z, and compositing q qᵀ that of weight over z².

    The render equals that of the torch backend, except that gsplat culls by its radii, and
    that all of a nearly edge-on disc has the depth of its centre in the maps.
    """
    discs = _project_discs(splats, camera)
    probe, groups = _probed(discs.means2d, features, n_densifying)
    bins = _bin(discs.means2d, discs.tile_radii, discs.depths, camera.width, camera.height)
    *others, (_, last) = groups
    composited = [_composite_discs(discs.moved(to), bins, each, camera) for to, each in others]
    rendered, alpha, *maps = _composite_with_maps(discs, bins, last, camera)
    return Renders(_joined([*composited, rendered]), alpha, tuple(maps), probe, discs.radii)


RASTERIZE = {"3d": rasterize_3d, "2d": rasterize_2d}


def _joined(parts: Sequence[Float[Tensor, "height width _"]]) -> Float[Tensor, "height width C"]:
    return parts[0] if len(parts) == 1 else torch.cat([*parts], dim=-1)


@torch.no_grad()
def _extents(
    means2d: Float[Tensor, "1 N 2"],
    conics: Float[Tensor, "1 N 3"],
    radii: Int[Tensor, "1 N ..."],
    opacities: Float[Tensor, " N"],
    width: int,
    height: int,
) -> tuple[Float[Tensor, "1 N ..."], Int[Tensor, "1 N"]]:
    """Radii to bin Gaussians by, as many as gsplat has for each, and sizes, see :class:`Renders`; 0 if not visible.

    A splat is binned to all tiles where its alpha counts: farther out than gsplat does, to avoid visible tile borders;
    less far if it is faint, to save time.
    """
    size = constant(width, height, like=means2d)
    tile_radii, sizes = elementwise(_extent, means2d, conics, _floats(radii), opacities[:, None], size)
    return tile_radii.view_as(radii), sizes[..., 0].int()


def _floats(radii: Int[Tensor, "1 N ..."]) -> Float[Tensor, "1 N r"]:
    return (radii[..., None] if radii.dim() == 2 else radii).float()


def _extent(mean2d: Vector, conic: Vector, radii: Vector, opacity: Vector, size: Vector) -> list[Vector]:
    """The inverse of a conic (a, b, c) is a multiple of (c, -b, a). Its determinant, lost to rounding for a long and
    thin splat, is not needed: gsplat's radii give the size. They are rounded up, and so is the result.
    """
    a, b, c = conic
    if len(radii) == 1:
        half = (a - c) / 2
        spread = radii[0] / 3 * (radii[0] / 3) / ((a + c) / 2 + torch.sqrt(half * half + b * b))
    else:
        spread = dot(radii, radii) / (3.33**2 * (a + c))
    covar2d = [spread * c, -spread * b, spread * a]
    cutoff = cutoffs(opacity[0])
    reach = [torch.sqrt(cutoff * covar2d[0]), torch.sqrt(cutoff * covar2d[2])]
    visible = _kept(radii) & _touches(mean2d, reach, size)
    return [_tile_radii(reach, visible, radii), [three_sigma(covar2d, visible)]]


def _kept(radii: Vector) -> Value:
    """Which splats gsplat has not culled."""
    return functools.reduce(operator.and_, [each > 0 for each in radii])


def _touches(mean2d: Vector, reach: Vector, size: Vector) -> Value:
    """Whether the box that reaches so far around a splat, if it is not too faint to have one, touches the image."""
    return (reach[0] > 0) & (reach[1] > 0) & touches([*mean2d, *reach], size)


def _tile_radii(reach: Vector, visible: Value, radii: Vector) -> list[Value]:
    """Radii to bin splats by: 0 for those not visible, whose reach may be undefined."""
    reach = [torch.maximum(*reach)] if len(radii) == 1 else [*reach]
    return [torch.where(visible, torch.ceil(each), 0.0) for each in reach]


def _probed(
    means2d: Float[Tensor, "1 N 2"], features: Float[Tensor, "N C"], n_densifying: int | None
) -> tuple[Float[Tensor, "1 N 2"], list[tuple[Float[Tensor, "1 N 2"], Float[Tensor, "N c"]]]]:
    """Means2d whose gradient drives densification, and groups of features with the means2d they are composited at.

    The kernels separate the gradients of features only if these are composited separately; alpha is the last group's.
    """
    if n_densifying is None:
        return means2d, [(means2d, features)]
    probe = means2d.detach().requires_grad_()
    first, rest = features.split([n_densifying, features.shape[1] - n_densifying], dim=1)
    return probe, [(_Tapped.apply(means2d, probe), first), (means2d, rest)]


class _Tapped(torch.autograd.Function):
    """The first of two equal tensors, whose gradient both get."""

    @staticmethod
    def forward(ctx, x, probe):
        return x.view_as(x)

    @staticmethod
    def backward(ctx, gradient):
        return gradient, gradient


@dataclass(frozen=True)
class _Discs:
    """Discs on the screen of a camera, with a dimension for it, as gsplat's kernels take them.

    Attributes:
        means2d: projected centres in pixels.
        ray_transforms: K [s_u t_u | s_v t_v | centre] in the camera frame, row by row; equation 8 of 2DGS.
        inverse_planes: q = normal / (normal · centre), so that q · ray = 1/z where a ray meets the plane;
            a steep disc is treated as facing the camera.
        radii: see :class:`Renders`.
        tile_radii: half sides of the boxes, or squares, around the means2d outside of which alpha does not count.
        opacities: of each disc.
    """

    means2d: Float[Tensor, "1 N 2"]
    ray_transforms: Float[Tensor, "1 N 9"]
    inverse_planes: Float[Tensor, "1 N 3"]
    radii: Int[Tensor, "1 N"]
    tile_radii: Float[Tensor, "1 N ..."]
    opacities: Float[Tensor, "1 N"]

    @property
    def depths(self) -> Float[Tensor, "1 N"]:
        """Depths of the centres."""
        return self.ray_transforms[..., 8]

    def moved(self, means2d: Float[Tensor, "1 N 2"]) -> _Discs:
        """The same with the centres, the last column, recomputed from means2d and depths."""
        return replace(self, means2d=means2d, ray_transforms=elementwise(_recentred, self.ray_transforms, means2d)[0])


def _recentred(transform: Vector, mean2d: Vector) -> list[Vector]:
    t, depth = transform, transform[8]
    return [[t[0], t[1], mean2d[0] * depth, t[3], t[4], mean2d[1] * depth, t[6], t[7], depth]]


def _project_discs(splats: Ellipsoids, camera: Camera) -> _Discs:
    (means, quats, scales, opacities), (width, height) = splats, (camera.width, camera.height)
    viewmats, Ks = camera.viewmat[None], camera.K[None]
    found = fully_fused_projection_2dgs(means, quats, scales, viewmats, Ks, width, height, near_plane=NEAR_PLANE)
    radii, _, _, ray_transforms, normals = found  # pyright: ignore[reportAssignmentType]
    sides = _floats(radii)
    # The centres are computed from means2d, so that these get the full gradient of a shift on the screen. gsplat's own
    # are centres of boxes, unlike the torch backend's, and in 1.4 their gradient lacks the mixed terms of tilted discs.
    means2d, ray_transforms = elementwise(_centres, ray_transforms.flatten(2), sides)
    size = constant(width, height, like=means)
    ray_transforms, inverse_planes, tile_radii, sizes = elementwise(
        _disc, *(means2d, ray_transforms, normals, sides, opacities[:, None], Ks.flatten(1)[:, None], size)
    )
    radii, tile_radii = sizes[..., 0].int(), tile_radii.view_as(radii)
    return _Discs(means2d, ray_transforms, inverse_planes, radii, tile_radii, opacities[None])


def _centres(transform: Vector, radii: Vector) -> list[Vector]:
    """Projected centre, and the ray transform; that of a disc in front of the camera for one that gsplat culled.

    gsplat leaves the memory of culled discs uninitialised; none of it may reach a gradient, as 0 times NaN.
    """
    kept = _kept(radii)
    t = [torch.where(kept, each, 1.0 if i in (0, 4, 8) else 0.0) for i, each in enumerate(transform)]
    return [[t[2] / t[8], t[5] / t[8]], t]


def _disc(
    mean2d: Vector, transform: Vector, normal: Vector, radii: Vector, opacity: Vector, K: Vector, size: Vector
) -> list[Vector]:
    """Ray transform, inverse plane, tile radii, and size of a disc, see :class:`_Discs`."""
    kept, cutoff, (fx, _, cx, _, fy, cy, *_) = _kept(radii), cutoffs(opacity[0]), K
    normal = [torch.where(kept, each, facing) for each, facing in zip(normal, (0.0, 0.0, -1.0), strict=True)]
    (transform,) = _recentred(transform, mean2d)
    x, y, z = transform[2::3]
    centre = [(x - cx * z) / fx, (y - cy * z) / fy, z]
    plane = dot(normal, centre)
    shows = torch.abs(plane.detach()) > disc_projection.EDGE_ON * torch.sqrt(dot(centre, centre).detach())
    # The low-pass shows a steep disc even where the ray meets its plane behind the camera. The centre's depth is right
    # there; with one q per disc, it must also serve where a ray meets the plane in front.
    slope = [(normal[0] / fx).detach(), (normal[1] / fy).detach()]
    steep = torch.abs(plane.detach()) <= torch.sqrt(dot(slope, slope)) * torch.sqrt(cutoff / 2) * z.detach()
    safe = torch.where(steep, 1.0, plane)
    facing = [0.0, 0.0, 1 / z]
    inverse_plane = [torch.where(steep, flat, each / safe) for flat, each in zip(facing, normal, strict=True)]

    mean2d, flat = [each.detach() for each in mean2d], [each.detach() for each in transform]
    u, v, w = flat[:3], flat[3:6], flat[6:]
    reach = [_reach(row, centre, w, cutoff, size) for row, centre in zip((u, v), mean2d, strict=True)]
    visible = kept & shows & (cutoff > 0) & _touches(mean2d, reach, size)
    # As if seen from afar.
    across, down = (
        [(row[i] - centre * w[i]) / w[2] for i in (0, 1)] for row, centre in zip((u, v), mean2d, strict=True)
    )
    low_pass = disc_projection.LOW_PASS
    covar2d = [dot(across, across) + low_pass, dot(across, down), dot(down, down) + low_pass]
    return [transform, inverse_plane, _tile_radii(reach, visible, radii), [three_sigma(covar2d, visible)]]


def _reach(row: Vector, centre: Value, w: Vector, cutoff: Value, size: Vector) -> Value:
    """Half a side of the box around a centre that contains a disc, and its low-pass, up to a cutoff.

    The points (u, v) of a disc with u² + v² = cutoff project to an ellipse, whose box follows from the dual conic
    T diag(cutoff, cutoff, -1) Tᵀ (2DGS, section 4.2), here in pixels relative to the projected centre.
    """

    def product(a: Vector, b: Vector) -> Value:
        return cutoff * (a[0] * b[0] + a[1] * b[1]) - a[2] * b[2]

    row = [each - centre * other for each, other in zip(row, w, strict=True)]
    against = product(w, w)
    middle = product(row, w) / against
    half = torch.sqrt(torch.relu(middle * middle - product(row, row) / against))
    # A disc that reaches behind the camera has no ellipse and may be anywhere in the image.
    anywhere = torch.abs(centre) + torch.maximum(*size)
    return torch.maximum(torch.where(against < 0, torch.abs(middle) + half, anywhere), torch.sqrt(cutoff / 2))


def _composite_discs(
    discs: _Discs, bins: tuple[Tensor, Tensor], features: Float[Tensor, "N C"], camera: Camera
) -> Float[Tensor, "height width C"]:
    """Features alone."""
    (channels,) = elementwise(_padded(1 << features.shape[1].bit_length()), features)
    return _run_discs(discs, bins, channels[None], camera)[0][..., : features.shape[1]]


def _composite_with_maps(
    discs: _Discs, bins: tuple[Tensor, Tensor], features: Float[Tensor, "N C"], camera: Camera
) -> tuple[Tensor, ...]:
    """Features, alpha, and the maps, see :class:`Renders`."""
    n_features = features.shape[1]
    # A power of two: gsplat would pad with uninitialised memory. The kernel returns the last feature of the median disc
    # as its depth: the disc's number here, to look it up.
    size = 1 << (n_features + 6).bit_length()
    (channels,) = elementwise(_with_products(size), features, discs.inverse_planes, _numbers(features))
    composited, alpha, inverse_plane, median = _run_discs(discs, bins, channels, camera)
    rays = camera.rays()
    rendered, inverse_depth, square = elementwise(_maps(n_features), composited, inverse_plane, rays)
    (median_depth,) = elementwise(_median, embedding(_numbered(median[..., 0]), discs.inverse_planes[0]), rays, alpha)
    return rendered, alpha, inverse_depth, square, median_depth


_BITS_OF_TWO = 1 << 30


def _numbers(features: Float[Tensor, "N C"]) -> Float[Tensor, "N 1"]:
    """A number for each disc: in the bits of floats from 2 on, as float32 has only 16.8 million whole numbers."""
    bits = torch.arange(_BITS_OF_TWO, _BITS_OF_TWO + len(features), dtype=torch.int32, device=features.device)
    return bits.view(torch.float32)[:, None].to(features)


def _numbered(medians: Float[Tensor, "height width"]) -> Int[Tensor, "height width"]:
    """The discs of such numbers; the first where there is none, which is 0."""
    return medians.float().view(torch.int32) & (_BITS_OF_TWO - 1)


def _run_discs(
    discs: _Discs, bins: tuple[Tensor, Tensor], channels: Float[Tensor, "1 N c"], camera: Camera
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Composited channels, alpha and inverse planes of an image, and the last channel of the median disc."""
    transforms = discs.ray_transforms.unflatten(-1, (3, 3))
    renders = rasterize_to_pixels_2dgs(
        *(discs.means2d, transforms, channels, discs.opacities, discs.inverse_planes),
        *(torch.zeros_like(discs.means2d), camera.width, camera.height, TILE, *bins),
    )
    composited, alpha, inverse_plane, _, median = (each.squeeze(0) for each in renders)  # pyright: ignore
    return composited, alpha, inverse_plane, median


@functools.cache
def _padded(size: int) -> Function:
    """The function that appends zeros to features."""

    def padded(features: Vector) -> list[Vector]:
        return [[*features, *[0 * features[0]] * (size - len(features))]]

    return padded


@functools.cache
def _with_products(size: int) -> Function:
    """The function that appends to features the products of a plane's coordinates, zeros, and the disc's index."""

    def with_products(features: Vector, inverse_plane: Vector, index: Vector) -> list[Vector]:
        products = [inverse_plane[i] * inverse_plane[j] for i, j in _PAIRS]
        filling = [0 * index[0]] * (size - len(features) - len(products) - 1)
        return [[*features, *products, *filling, index[0]]]

    return with_products


@functools.cache
def _maps(n_features: int) -> Function:
    """The function that takes composited channels and planes, and the ray: features, and sums of weight over z and
    over z².
    """

    def maps(channels: Vector, inverse_plane: Vector, ray: Vector) -> list[Vector]:
        products = channels[n_features : n_features + len(_PAIRS)]
        pairs_of_ray = [(1 if i == j else 2) * ray[i] * ray[j] for i, j in _PAIRS]
        return [[*channels[:n_features]], [dot(inverse_plane, ray)], [dot(products, pairs_of_ray)]]

    return maps


_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def _median(inverse_plane: Vector, ray: Vector, alpha: Vector) -> list[Vector]:
    """Depth at which a ray meets the plane of the median disc, 0 where there is none."""
    halves = alpha[0] >= 0.5
    return [[torch.where(halves, 1 / torch.where(halves, dot(inverse_plane, ray), 1.0), 0.0)]]


@torch.no_grad()
def _bin(
    means2d: Float[Tensor, "1 N 2"],
    radii: Float[Tensor, "1 N ..."],
    depths: Float[Tensor, "1 N"],
    width: int,
    height: int,
) -> tuple[Int[Tensor, "1 rows columns"], Int[Tensor, " entries"]]:
    """Bin splats to tiles, front to back: offset of each tile in the list of splats, and the list."""
    columns, rows = -(-width // TILE), -(-height // TILE)
    _, tiles, splats = isect_tiles(means2d, radii.int(), depths, TILE, columns, rows)
    return isect_offset_encode(tiles, len(means2d), columns, rows), splats
