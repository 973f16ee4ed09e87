"""The rasterizer's renders and gradients beside those of the dense reference."""

from __future__ import annotations

from typing import Literal

import torch
from dense_reference import DenseImage, dense_rasterize, dense_rasterize_discs
from random_splats import NAMES
from torch import Tensor

from shellgs_method.geometry.camera import Camera
from shellgs_method.render.rasterizer import rasterize

MAPS = ("inverse_depth", "median_depth", "distortion")
"""Of discs."""


def maps_of(render: DenseImage | dict) -> list[Tensor]:
    """The maps that a render of discs has."""
    return [render[name] if isinstance(render, dict) else getattr(render, name) for name in MAPS]


def compare(
    splats: list[Tensor], camera: Camera, dtype: torch.dtype, margin: float, primitive: Literal["3d", "2d"] = "3d"
) -> tuple[float, dict, float]:
    """Largest error of the values, relative error of each gradient, and share of pixels left out.

    A pixel is left out if a decision is within ``margin`` of its threshold: of alpha (1/255) or transmittance (1e-4).
    """
    dense, gradient, maps = {
        "3d": (dense_rasterize, "means2d", lambda _: []),
        "2d": (dense_rasterize_discs, "gradient_2dgs", maps_of),
    }[primitive]
    splats = [splat.requires_grad_() for splat in splats]
    reference = dense(*splats, viewmat=camera.viewmat, K=camera.K, width=camera.width, height=camera.height)
    counted = reference.margin > margin
    wanted = torch.cat([reference.composited, reference.alpha, *maps(reference)], dim=-1)
    expected = _gradients(splats, wanted, counted, reference.means2d)

    own = [splat.detach().to(dtype).requires_grad_() for splat in splats]
    composited, alpha, info = rasterize(*own, camera=camera, primitive=primitive)
    info[gradient].retain_grad()
    got = torch.cat([composited, alpha, *maps(info)], dim=-1)
    assert got.dtype == dtype
    assert got.shape == wanted.shape
    actual = _gradients(own, got, counted, info[gradient])
    relative = {k: ((actual[k] - expected[k]).norm() / expected[k].norm()).item() for k in expected}
    return (got - wanted)[counted].abs().max().item(), relative, 1 - float(counted.double().mean())


def _gradients(splats: list[Tensor], channels: Tensor, counted: Tensor, means2d: Tensor) -> dict:
    """Gradients of a random linear function of the counted pixels."""
    generator = torch.Generator().manual_seed(5)
    slope = torch.randn(channels.shape, generator=generator, dtype=torch.float64).to(channels)
    (channels * slope)[counted].sum().backward()
    assert means2d.grad is not None
    gradients = {name: splat.grad for name, splat in zip(NAMES, splats, strict=True)}
    return {**gradients, "means2d": means2d.grad.reshape(-1, 2)}
