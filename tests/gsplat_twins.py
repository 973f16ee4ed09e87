"""gsplat's kernels on the CPU: its own projections and binning in plain torch, and compositing as in its .cu files.

Memory that a kernel leaves uninitialised is NaN here.
"""

from __future__ import annotations

import torch
from gsplat.cuda import _torch_impl, _torch_impl_2dgs
from torch import Tensor


def fully_fused_projection(means, covars, quats, scales, viewmats, Ks, width, height, eps2d, near_plane, packed):
    assert len(means), "gsplat 1.5 would divide by zero"
    assert covars is None
    assert not packed
    half = _torch_impl._quat_scale_to_matrix(quats, scales)
    radii, *splats, compensations = _torch_impl._fully_fused_projection(
        means, half @ half.mT, viewmats, Ks, width, height, eps2d, near_plane
    )
    return radii, *(_uninitialise(splat, radii) for splat in splats), compensations


def fully_fused_projection_2dgs(means, quats, scales, viewmats, Ks, width, height, near_plane):
    assert len(means), "gsplat 1.5 would divide by zero"
    scales = torch.cat([scales[:, :2], torch.ones_like(scales[:, 2:])], dim=1)  # the kernel has no third scale
    splats = _torch_impl_2dgs._fully_fused_projection_2dgs(
        means, quats, scales, viewmats, Ks, width, height, near_plane
    )
    radii, means2d, depths, transforms, normals = splats  # pyright: ignore[reportAssignmentType]
    if radii.dim() == 2:  # gsplat 1.4, whose twin returns them transposed
        transforms = transforms.mT
    radii = torch.where((depths < near_plane).view(*depths.shape, *[1] * (radii.dim() - 2)), 0, radii.clamp_min(1))
    return radii, *(_uninitialise(splat, radii) for splat in (means2d, depths, transforms, normals))


def isect_tiles(means2d, radii, depths, tile_size, columns, rows):
    return _torch_impl._isect_tiles(means2d, radii, depths, tile_size, columns, rows)


def isect_offset_encode(tiles, n_cameras, columns, rows):
    return _torch_impl._isect_offset_encode(tiles, n_cameras, columns, rows)


def rasterize_to_pixels(means2d, conics, colors, opacities, width, height, tile_size, offsets, splats):
    means2d, conics, colors, opacities = (x.flatten(0, 1) for x in (means2d, conics, colors, opacities))

    def composite(ids: Tensor, pixels: Tensor) -> Tensor:
        dx, dy = (means2d[ids] - pixels[:, None]).unbind(-1)
        a, b, c = conics[ids].unbind(-1)
        sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
        weights, _ = _weights(opacities[ids], sigma)
        return weights @ torch.cat([colors[ids], torch.ones_like(colors[ids, :1])], dim=-1)

    image = _per_tile(composite, width, height, tile_size, offsets, splats, colors.shape[-1] + 1, means2d)
    return image[..., :-1], image[..., -1:]


def rasterize_to_pixels_2dgs(
    means2d, ray_transforms, colors, opacities, normals, densify, width, height, tile_size, offsets, splats
):
    n = colors.shape[-1]
    assert n & (n - 1) == 0, "gsplat would pad the features with uninitialised memory"
    assert densify.shape == means2d.shape
    splatted = (x.flatten(0, 1) for x in (means2d, ray_transforms, colors, opacities, normals))
    means2d, ray_transforms, colors, opacities, normals = splatted

    def composite(ids: Tensor, pixels: Tensor) -> Tensor:
        u, v, w = ray_transforms[ids].unbind(-2)
        x, y = pixels[:, None, :1], pixels[:, None, 1:]
        cross = torch.linalg.cross(x * w - u, y * w - v)
        on_plane = (cross[..., :2] / cross[..., 2:]).square().sum(-1)
        on_screen = 2 * (means2d[ids] - pixels[:, None]).square().sum(-1)
        weights, before = _weights(opacities[ids], 0.5 * torch.minimum(on_plane, on_screen))
        rank = torch.arange(1, len(ids) + 1)
        median = torch.where((weights > 0) & (before > 0.5), rank, 0).amax(-1)
        depths = torch.cat([torch.zeros_like(colors[:1, -1]), colors[ids, -1]])[median]
        values = torch.cat([colors[ids], normals[ids], torch.ones_like(colors[ids, :1])], dim=-1)
        return torch.cat([weights @ values, depths[:, None]], dim=-1)

    image = _per_tile(composite, width, height, tile_size, offsets, splats, n + 5, means2d)
    colors, normals, alpha, median = image.split_with_sizes([n, 3, 1, 1], dim=-1)
    return colors, alpha, normals, torch.zeros_like(alpha), median


def _uninitialise(splat: Tensor, radii: Tensor) -> Tensor:
    kept = radii > 0 if radii.dim() == 2 else (radii > 0).all(dim=-1)
    return torch.where(kept.view(*kept.shape, *[1] * (splat.dim() - 2)), splat, torch.nan)


def _weights(opacities: Tensor, sigma: Tensor) -> tuple[Tensor, Tensor]:
    """Weights [P, L] of a tile's splats, front to back, at its pixels, and the transmittance before each."""
    alpha = (opacities * torch.exp(-sigma)).clamp(max=0.999)
    alpha = torch.where(alpha >= 1 / 255, alpha, 0.0)
    behind = (1 - alpha).cumprod(-1)
    before = torch.cat([torch.ones_like(behind[:, :1]), behind[:, :-1]], dim=-1)
    return torch.where(behind > 1e-4, alpha * before, 0.0), before


def _per_tile(composite, width, height, tile_size, offsets, splats, n_channels, like):
    n_cameras, rows, columns = offsets.shape
    ends = torch.cat([offsets.flatten()[1:], torch.tensor([len(splats)])]).view_as(offsets)
    v, u = torch.meshgrid(torch.arange(tile_size), torch.arange(tile_size), indexing="ij")
    image = like.new_zeros(n_cameras, rows * tile_size, columns * tile_size, n_channels)
    for camera, row, column in torch.cartesian_prod(*(torch.arange(n) for n in offsets.shape)).tolist():
        ids = splats[offsets[camera, row, column] : ends[camera, row, column]].long()
        if len(ids):
            u_tile, v_tile = u + column * tile_size, v + row * tile_size
            pixels = torch.stack([u_tile, v_tile], dim=-1).flatten(0, 1).to(like) + 0.5
            image[camera, v_tile.flatten(), u_tile.flatten()] = composite(ids, pixels)
    return image[:, :height, :width]
