"""Which Gaussians make up the surface: not those behind it, which show what windows reflect or let through."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import KDTree
from torch import Tensor

from shellgs_method.seeding import Seeds

THICKNESS = 0.1
"""Distance behind the shell in metres up to which Gaussians are part of the surface."""
WEIGHT_BEHIND = 1e-3
"""Weight in depth and normals of those farther behind: not 0, so that views past the building have a depth too."""


class SurfaceWeights:
    """Weights of Gaussians in depth and normals, by the shell as points with normals."""

    def __init__(self, shell: Seeds, metres_per_unit: float | None):
        self._points, self._normals = shell.points, shell.normals
        self._tree = KDTree(shell.points) if len(shell.points) else None
        self._thickness = THICKNESS / (metres_per_unit or 1.0)

    def __call__(self, means: Float[Tensor, "N 3"]) -> Float[Tensor, "N 1"]:
        """1, or :data:`WEIGHT_BEHIND` for centres behind the tangent plane of the nearest point."""
        if self._tree is None:
            return means.new_ones(len(means), 1)
        positions = means.double().cpu().numpy()
        _, nearest = self._tree.query(positions, workers=-1)
        along = np.einsum("ij,ij->i", self._points[nearest] - positions, self._normals[nearest])
        weights = np.where(along > self._thickness, WEIGHT_BEHIND, 1.0)
        return torch.from_numpy(weights[:, None]).to(means)
