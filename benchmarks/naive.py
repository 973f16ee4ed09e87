"""A naive twin of the rasterizer: the same renders, tile by tile in eager torch, differentiated by autograd."""

from __future__ import annotations

import math
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from shellgs_method.geometry.camera import Camera
from shellgs_method.render.rasterizer.discs import disc_maps, project_discs
from shellgs_method.render.rasterizer.kernels import TRANSMITTANCE_MIN, Z_MAX
from shellgs_method.render.rasterizer.projection import ALPHA_MAX, NEAR_PLANE, Projection, project_gaussians
from shellgs_method.render.rasterizer.renders import Ellipsoids

TILE = 16
PROJECT = {"3d": project_gaussians, "2d": project_discs}


def rasterize(
    means: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    scales: Float[Tensor, "N 3"],
    opacities: Float[Tensor, " N"],
    features: Float[Tensor, "N C"],
    camera: Camera,
    primitive: Literal["3d", "2d"] = "3d",
) -> tuple[Float[Tensor, "height width C"], Float[Tensor, "height width 1"], dict[str, Tensor]]:
    """Same as :func:`shellgs_method.render.rasterizer.rasterize`, with only the maps in the info."""
    projection = PROJECT[primitive](Ellipsoids(means, quats, scales, opacities), camera)
    values = torch.cat([features, torch.ones_like(features[:, :1])], dim=1)
    rows = []
    for top in range(0, camera.height, TILE):
        row = []
        for left in range(0, camera.width, TILE):
            width, height = min(TILE, camera.width - left), min(TILE, camera.height - top)
            row.append(_tile(projection, values, primitive, left, top, width, height))
        rows.append(torch.cat(row, dim=1))
    image = torch.cat(rows)
    composited, alpha, maps = image.tensor_split([features.shape[1], features.shape[1] + 1], dim=-1)
    return composited, alpha, disc_maps(alpha, *maps.split(1, dim=-1)) if primitive == "2d" else {}


def count_pairs(projection: Projection, primitive: Literal["3d", "2d"], width: int, height: int) -> int:
    """Number of (splat, pixel) pairs inside a footprint, whether or not the pixel has stopped before the splat."""
    pairs = 0
    for top in range(0, height, TILE):
        for left in range(0, width, TILE):
            splats = _touching(projection, left, top, TILE, TILE)
            z, _ = _meet(projection, splats, primitive, left, top, min(TILE, width - left), min(TILE, height - top))
            pairs += int((z <= Z_MAX).sum())
    return pairs


def _tile(
    projection: Projection,
    values: Float[Tensor, "N C"],
    primitive: Literal["3d", "2d"],
    left: int,
    top: int,
    width: int,
    height: int,
) -> Float[Tensor, "height width C+maps"]:
    splats = _touching(projection, left, top, width, height)
    splats = splats[projection.depths[splats].argsort(stable=True)]
    z, inverse_depth = _meet(projection, splats, primitive, left, top, width, height)
    alpha = torch.where(z <= Z_MAX, ALPHA_MAX * torch.exp2(-z.relu()), 0.0)
    behind = (1 - alpha).cumprod(dim=1)
    before = torch.cat([torch.ones_like(behind[:, :1]), behind[:, :-1]], dim=1)
    weights = torch.where(behind > TRANSMITTANCE_MIN, alpha * before, 0.0)
    channels = [weights @ values[splats]]
    if primitive == "2d":
        median = torch.where((before > 0.5) & (behind <= 0.5), 1 / inverse_depth, 0.0)
        maps = [weights * inverse_depth, weights * inverse_depth.square(), median]
        channels += [each.sum(dim=1, keepdim=True) for each in maps]
    return torch.cat(channels, dim=1).view(height, width, -1)


def _touching(projection: Projection, left: int, top: int, width: int, height: int) -> Tensor:
    """Indices of the splats with an outline whose box touches a tile."""
    low, high = torch.tensor([left, top]), torch.tensor([left + width, top + height])

    outlines = projection.outlines
    centres, reach = outlines[..., :2], outlines[..., 5:]
    touch = ((centres + reach > low) & (centres - reach < high)).all(dim=-1)
    return (touch.any(dim=1) & projection.visible).nonzero().squeeze(1)


def _meet(
    projection: Projection,
    splats: Tensor,
    primitive: Literal["3d", "2d"],
    left: int,
    top: int,
    width: int,
    height: int,
) -> tuple[Float[Tensor, "pixels splats"], Float[Tensor, "pixels splats"]]:
    """Exponents as in the kernels, and inverse depths, which are 1 for Gaussians."""
    y, x = torch.meshgrid(torch.arange(top, top + height) + 0.5, torch.arange(left, left + width) + 0.5, indexing="ij")
    u, v = projection.means2d[0, splats].unbind(-1)
    dx, dy = x.reshape(-1, 1) - u, y.reshape(-1, 1) - v
    if primitive == "3d":
        a, b, c, n = projection.shapes[splats].unbind(-1)
        return a * dx * dx + b * dx * dy + c * dy * dy + n, torch.ones_like(dx)
    a, b, c, d, p, q, r, n = projection.shapes[splats].unbind(-1)
    inverse_depth = p + q * dx + r * dy
    in_front = (inverse_depth > 0) & (inverse_depth <= 1 / NEAR_PLANE)
    inverse_depth = torch.where(in_front, inverse_depth, p)
    plane = ((a * dx + b * dy) / inverse_depth).square() + ((c * dx + d * dy) / inverse_depth).square()
    screen = (dx * dx + dy * dy) / math.log(2)
    return torch.where(in_front, torch.minimum(plane, screen), screen) + n, inverse_depth
