"""Ray casting of meshes with materials."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8

from shellgs_method.open3d import import_open3d
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
        self._o3d = import_open3d()
        self._scene = self._o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(mesh.vertices.astype(np.float32), mesh.triangles.astype(np.uint32))
        self._material = np.append(mesh.material, 255).astype(np.uint8)

    def cast(self, origins: Float[np.ndarray, "*N 3"], directions: Float[np.ndarray, "*N 3"]) -> Hits:
        """First hits of rays from ``origins`` (broadcast) along ``directions`` (of any length)."""
        answer = self._scene.cast_rays(self._rays(origins, directions))
        normal = answer["primitive_normals"].numpy()
        away = np.sum(normal * directions, axis=-1, keepdims=True) > 0
        # Open3D marks a miss by the largest integer; clamping selects the table's last entry.
        triangle = np.minimum(answer["primitive_ids"].numpy(), len(self._material) - 1)
        return Hits(answer["t_hit"].numpy(), np.where(away, -normal, normal), self._material[triangle])

    def is_shadowed(
        self, points: Float[np.ndarray, "*N 3"], towards: Float[np.ndarray, " 3"]
    ) -> Bool[np.ndarray, " *N"]:
        """Whether anything is between the points and a light at infinity."""
        return self._scene.test_occlusions(self._rays(points, np.broadcast_to(towards, points.shape))).numpy()

    def _rays(self, origins: np.ndarray, directions: np.ndarray):
        origins = np.broadcast_to(origins, directions.shape)
        return self._o3d.core.Tensor(np.concatenate([origins, directions], axis=-1, dtype=np.float32))
