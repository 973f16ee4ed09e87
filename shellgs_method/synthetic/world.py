"""Ray casting of meshes with materials."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, UInt8

from shellgs_method.geometry.triangles import Hits, Triangles
from shellgs_method.synthetic.geometry import Mesh


class World(Triangles):
    """A mesh in metres, with materials.

    Attributes:
        material: material of each triangle, and last 255, so that it is that of index -1, where a ray hits nothing.
    """

    def __init__(self, mesh: Mesh):
        super().__init__(mesh.vertices, mesh.triangles)
        self.material: UInt8[np.ndarray, "F+1"] = np.append(mesh.material, 255).astype(np.uint8)

    def cast(self, origins: Float[np.ndarray, "*#N 3"], directions: Float[np.ndarray, "*#N 3"]) -> Hits:
        """First hits of rays, with normals that face their origins."""
        hits = super().cast(origins, directions)
        away = np.sum(hits.normal * directions, axis=-1, keepdims=True) > 0
        return hits._replace(normal=np.where(away, -hits.normal, hits.normal))
