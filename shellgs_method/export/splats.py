"""Gaussians in another frame."""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Float64
from scipy.spatial.transform import Rotation
from torch import Tensor

from shellgs_method.files.splats import Splats
from shellgs_method.geometry.similarity import scale_of
from shellgs_method.render.rasterizer import spherical_harmonics


def moved(splats: Splats, similarity: Float64[np.ndarray, "4 4"]) -> Splats:
    """Apply a similarity to Gaussians, in float64.

    The harmonics rotate with the Gaussians, so that renders stay the same.
    """
    scale = scale_of(similarity)
    rotation = similarity[:3, :3] / scale
    turned = Rotation.from_matrix(rotation) * Rotation.from_quat(splats.quats.double().numpy()[:, [1, 2, 3, 0]])
    bands = harmonics_rotation(torch.from_numpy(rotation), splats.degree)
    return Splats(
        splats.means.double() @ torch.from_numpy(similarity[:3, :3].T) + torch.from_numpy(similarity[:3, 3]),
        torch.from_numpy(turned.as_quat()[:, [3, 0, 1, 2]]),
        splats.scales.double() + math.log(scale),
        splats.opacities,
        torch.einsum("kj,njc->nkc", bands, splats.harmonics.double()),
        discs=splats.discs,
    )


def harmonics_rotation(rotation: Float64[Tensor, "3 3"], degree: int) -> Float64[Tensor, "K K"]:
    """The matrix D that rotates harmonics coefficients c by R: Y(d) D c = Y(Rᵀ d) c for every direction d.

    A rotation maps the harmonics of each degree to each other, so that Y(d) D = Y(Rᵀ d) has an exact solution, found
    by least squares from more directions than unknowns.
    """
    count = (degree + 1) ** 2
    directions = torch.randn(16 * count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    each = torch.eye(count, dtype=torch.float64).expand(len(directions), count, count)
    turned = spherical_harmonics(degree, directions @ rotation, each)
    return torch.linalg.lstsq(spherical_harmonics(degree, directions, each), turned).solution
