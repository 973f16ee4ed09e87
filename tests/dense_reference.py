"""Reference rasterization: every splat at every pixel, in plain autograd. Shares no code with the package."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass
class DenseImage:
    """A render, and where rounding could have changed a decision.

    Attributes:
        composited: [H, W, C].
        alpha: [H, W, 1].
        means2d: [N, 2], kept in the graph.
        margin: [H, W], smallest relative distance of any decision at a pixel from its threshold.
    """

    composited: Tensor
    alpha: Tensor
    means2d: Tensor
    margin: Tensor


def dense_rasterize(means, quats, scales, opacities, features, viewmat, K, width, height) -> DenseImage:
    """EWA splatting as in gsplat's classic mode, O(N H W) time and memory."""
    n = len(means)
    homogeneous = torch.cat([means, torch.ones_like(means[:, :1])], dim=1)
    camera_means = torch.einsum("ij,nj->ni", viewmat, homogeneous)[:, :3]
    order = [i for i in camera_means[:, 2].argsort(stable=True).tolist() if camera_means[i, 2] >= 0.01]

    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    means2d = torch.stack([torch.zeros(2, dtype=means.dtype)] * n)
    centres, inverses = [], []
    for i in order:
        x, y, z = camera_means[i]
        centres.append(torch.stack([fx * x / z + cx, fy * y / z + cy]))
        x_max, x_min = (width - cx) / fx + 0.15 * width / fx, -(cx / fx + 0.15 * width / fx)
        y_max, y_min = (height - cy) / fy + 0.15 * height / fy, -(cy / fy + 0.15 * height / fy)
        tx, ty = z * (x / z).clamp(x_min, x_max), z * (y / z).clamp(y_min, y_max)
        zero = torch.zeros_like(z)
        J = torch.stack([fx / z, zero, -fx * tx / z**2, zero, fy / z, -fy * ty / z**2]).reshape(2, 3)
        w, a, b, c = quats[i] / quats[i].norm()
        cross = torch.stack([zero, -c, b, c, zero, -a, -b, a, zero]).reshape(3, 3)
        rotation = torch.eye(3, dtype=means.dtype) + 2 * w * cross + 2 * cross @ cross  # Rodrigues
        covariance = rotation @ torch.diag(scales[i] ** 2) @ rotation.T
        projection = J @ viewmat[:3, :3]
        low_pass = 0.3 * torch.eye(2, dtype=means.dtype)
        inverses.append(torch.linalg.inv(projection @ covariance @ projection.T + low_pass))
    if order:
        means2d = means2d.index_copy(0, torch.tensor(order), torch.stack(centres))
    if means2d.requires_grad:
        means2d.retain_grad()

    rows = torch.arange(height, dtype=means.dtype) + 0.5
    columns = torch.arange(width, dtype=means.dtype) + 0.5
    pixels = torch.stack(torch.meshgrid(columns, rows, indexing="xy"), dim=-1)
    composited = torch.zeros(height, width, features.shape[1], dtype=means.dtype)
    alpha_sum = torch.zeros(height, width, dtype=means.dtype)
    transmittance = torch.ones(height, width, dtype=means.dtype)
    stopped = torch.zeros(height, width, dtype=torch.bool)
    margin = torch.full((height, width), torch.inf, dtype=means.dtype)
    for i, inverse in zip(order, inverses, strict=True):
        d = pixels - means2d[i]
        sigma = 0.5 * torch.einsum("hwi,ij,hwj->hw", d, inverse, d)
        alpha = (opacities[i] * torch.exp(-sigma)).clamp(max=0.999)
        counted = (alpha >= 1 / 255) & ~stopped
        behind = transmittance * (1 - alpha)
        with torch.no_grad():
            margin = torch.where(stopped, margin, torch.minimum(margin, (alpha * 255 - 1).abs()))
            margin = torch.where(counted, torch.minimum(margin, (behind / 1e-4 - 1).abs()), margin)
        stopped = stopped | (counted & (behind <= 1e-4))
        counted = counted & ~stopped
        weight = torch.where(counted, alpha * transmittance, 0.0)
        composited = composited + weight[..., None] * features[i]
        alpha_sum = alpha_sum + weight
        transmittance = torch.where(counted, behind, transmittance)
    return DenseImage(composited, alpha_sum[..., None], means2d, margin)


@dataclass
class DenseDiscs(DenseImage):
    """The render of discs, and its maps [H, W, 1]."""

    inverse_depth: Tensor
    median_depth: Tensor
    distortion: Tensor


def dense_rasterize_discs(means, quats, scales, opacities, features, viewmat, K, width, height) -> DenseDiscs:
    """2D Gaussian Splatting by the homographies of Huang et al. 2024, eq. 4 to 11, O(N H W) time and memory."""
    near = 0.01
    homogeneous = torch.cat([means, torch.ones_like(means[:, :1])], dim=1)
    z = torch.einsum("j,nj->n", viewmat[2], homogeneous)
    order = [i for i in z.argsort(stable=True).tolist() if z[i] >= near]
    image_plane = torch.einsum("ij,nj->ni", K @ viewmat[:3], homogeneous)
    means2d = image_plane[:, :2] / torch.where(z >= near, z, 1.0)[:, None]
    if means2d.requires_grad:
        means2d.retain_grad()

    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    x, y = x.to(means), y.to(means)
    composited = torch.zeros(height, width, features.shape[1], dtype=means.dtype)
    zeros = torch.zeros(height, width, dtype=means.dtype)
    alpha_sum, inverse_depth, median, distortion, transmittance = zeros, zeros, zeros, zeros, zeros + 1
    composited_before: list[tuple[Tensor, Tensor]] = []
    stopped = torch.zeros(height, width, dtype=torch.bool)
    margin = torch.full((height, width), torch.inf, dtype=means.dtype)
    for i in order:
        w, a, b, c = quats[i] / quats[i].norm()
        zero = torch.zeros_like(w)
        cross = torch.stack([zero, -c, b, c, zero, -a, -b, a, zero]).reshape(3, 3)
        rotation = torch.eye(3, dtype=means.dtype) + 2 * w * cross + 2 * cross @ cross  # Rodrigues
        axes = K @ viewmat[:3, :3] @ rotation[:, :2] * scales[i, :2]
        centre = torch.cat([means2d[i], torch.ones_like(means2d[i, :1])]) * z[i]
        T = torch.cat([axes, centre[:, None]], dim=1)  # (u, v, 1) to depth times pixel
        k = x[..., None] * T[2] - T[0]
        l = y[..., None] * T[2] - T[1]  # noqa: E741
        q = torch.linalg.cross(k, l)
        parallel = q[..., 2] == 0
        u, v = (q[..., :2] / torch.where(parallel, 1.0, q[..., 2])[..., None]).unbind(-1)
        z_hit = u * T[2, 0] + v * T[2, 1] + T[2, 2]
        hits = ~parallel & (z_hit >= near)
        z_hit = torch.where(hits, z_hit, z[i].detach())
        rho_plane = torch.where(hits, u * u + v * v, torch.inf)
        rho_screen = 2 * ((x - means2d[i, 0]) ** 2 + (y - means2d[i, 1]) ** 2)
        alpha = (opacities[i] * torch.exp(-0.5 * torch.minimum(rho_plane, rho_screen))).clamp(max=0.999)
        counted = (alpha >= 1 / 255) & ~stopped
        behind = transmittance * (1 - alpha)
        with torch.no_grad():
            margin = torch.where(~stopped, torch.minimum(margin, (alpha * 255 - 1).abs()), margin)
            for distance in (z_hit / near - 1, behind / 1e-4 - 1, behind / 0.5 - 1, rho_plane / rho_screen - 1):
                margin = torch.where(counted, torch.minimum(margin, distance.abs()), margin)
        stopped = stopped | (counted & (behind <= 1e-4))
        counted = counted & ~stopped
        weight = torch.where(counted, alpha * transmittance, 0.0)
        composited = composited + weight[..., None] * features[i]
        alpha_sum = alpha_sum + weight
        inverse_depth = inverse_depth + weight / z_hit
        median = torch.where(counted & (transmittance > 0.5) & (behind <= 0.5), z_hit, median)
        mapped = 100 / (100 - 0.2) * (1 - 0.2 / z_hit)
        for weight_before, mapped_before in composited_before:
            distortion = distortion + weight * weight_before * (mapped - mapped_before) ** 2
        composited_before.append((weight, mapped))
        transmittance = torch.where(counted, behind, transmittance)
    maps = (each[..., None] for each in (inverse_depth, median, distortion))
    return DenseDiscs(composited, alpha_sum[..., None], means2d, margin, *maps)
