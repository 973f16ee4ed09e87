"""Random splats and cameras, the same in every run."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from shellgs_method.geometry.camera import Camera

NAMES = ("means", "quats", "scales", "opacities", "features")


def make_camera(width: int, height: int, dtype: torch.dtype = torch.float64) -> Camera:
    """A camera near the origin that looks roughly along z."""
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = torch.linalg.qr(torch.eye(3).double() + 0.1 * torch.arange(9.0).double().view(3, 3).sin())[0]
    viewmat[:3, :3] *= viewmat[:3, :3].diagonal().sign()
    viewmat[:3, 3] = torch.tensor([0.05, -0.03, 0.1])
    K = torch.tensor([[0.8 * width, 0, 0.47 * width], [0, 0.83 * width, 0.53 * height], [0, 0, 1]])
    return Camera(viewmat.to(dtype), K.to(dtype), width, height)


def make_splats(n: int, n_features: int, seed: int) -> list[Tensor]:
    """Splats of every kind: in front and behind, off screen, sub-pixel to screen-filling, faint and opaque."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    means = normal(n, 3) * torch.tensor([2.0, 1.5, 2.0]) + torch.tensor([0.0, 0.0, 3.0])
    scales = (normal(n, 3) - 2.5).exp()
    scales[: n // 10] *= 30
    scales[n // 10 : n // 5] *= 0.01
    opacities = torch.sigmoid(3 * normal(n))
    opacities[::7], opacities[1::7] = 0.9999, 0.003
    return [means, 3 * normal(n, 4), scales, opacities, normal(n, n_features)]


def orbit(camera: Camera, n: int) -> list[Camera]:
    """Cameras side by side, each turned a little further about its y axis, with a longer focal length."""
    cameras = []
    for i in range(n):
        angle = torch.tensor(0.15 * i, dtype=camera.viewmat.dtype)
        turn = torch.eye(4, dtype=camera.viewmat.dtype)
        turn[0, 0], turn[0, 2], turn[2, 0], turn[2, 2] = angle.cos(), angle.sin(), -angle.sin(), angle.cos()
        turn[0, 3] = 0.1 * i
        zoom = camera.K.new_tensor([1 + 0.2 * i, 1 + 0.1 * i, 1.0])
        cameras.append(replace(camera, viewmat=turn @ camera.viewmat, K=zoom[:, None] * camera.K))
    return cameras


def make_discs(n: int, n_features: int, seed: int) -> list[Tensor]:
    """Discs tilted by up to 37 degrees from z, none of which reaches from in front of the camera to behind it."""
    means, quats, scales, opacities, features = make_splats(n, n_features, seed)
    means[:, 2] = 3 + means[:, 2].abs()
    means[: n // 8, 2] *= -1
    quats[:, 0] = 3 * quats[:, 1:].norm(dim=1)
    return [means, quats, scales.clamp(1e-3, 0.4), opacities, features]
