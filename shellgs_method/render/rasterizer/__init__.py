"""Features composited over 3D Gaussians or 2D discs, in pure PyTorch or on gsplat's CUDA kernels."""

from __future__ import annotations

from shellgs_method.render.rasterizer.projection import quats_to_rotations
from shellgs_method.render.rasterizer.rasterization import rasterize
from shellgs_method.render.rasterizer.spherical_harmonics import spherical_harmonics

__all__ = ["quats_to_rotations", "rasterize", "spherical_harmonics"]
