"""Ray casting of meshes with materials."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8

from shellgs_method.geometry.triangles import Triangles, rays_from
from shellgs_method.synthetic.geometry import Mesh


@dataclass(frozen=True)
class Hits:
    """First hits of rays.

    Attributes:
        t: distance to the hit in multiples of the ray's direction; inf without a hit.
        normal: unit normal facing the ray's origin; 0 without a hit.
        material: material of the triangle; 255 without a hit.
    """

    t: Float[np.ndarray, " *N"]
    normal: Float[np.ndarray, "*N 3"]
    material: UInt8[np.ndarray, " *N"]


class World:
    """A mesh in metres, prepared for ray casting in float32."""

    def __init__(self, mesh: Mesh):
        self._triangles = Triangles(mesh.vertices, mesh.triangles)
        self._material = np.append(mesh.material, 255).astype(np.uint8)

    def cast(self, origins: Float[np.ndarray, "*N 3"], directions: Float[np.ndarray, "*N 3"]) -> Hits:
        """First hits of rays from ``origins`` (broadcast) along ``directions`` (of any length)."""
        hits = self._triangles.cast_rays(rays_from(origins, directions))
        away = np.sum(hits.normal * directions, axis=-1, keepdims=True) > 0
        return Hits(hits.t, np.where(away, -hits.normal, hits.normal), self._material[hits.triangle])

    def is_shadowed(
        self, points: Float[np.ndarray, "*N 3"], towards: Float[np.ndarray, " 3"]
    ) -> Bool[np.ndarray, " *N"]:
        """Whether anything is between the points and a light at infinity."""
        return self._triangles.blocked(rays_from(points, towards))
