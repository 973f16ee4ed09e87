"""The shell as a surface to measure distances to, in metres and near the origin."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int64

from shellgs_method.open3d import import_open3d
from shellgs_method.shell.geometry.mesh import ShellMesh
from shellgs_method.shell.geometry.similarity import centred, transformed

_FEW = 2000
"""Number of points below which more threads cost more than they save, many times more on busy cores."""


@dataclass(frozen=True)
class Closest:
    """Closest points of the surface.

    Attributes:
        foot: closest point of the surface to each query point.
        normal: unit normal of its triangle, by the triangle's winding.
    """

    foot: Float64[np.ndarray, "N 3"]
    normal: Float64[np.ndarray, "N 3"]


class ShellSurface:
    """A shell in its *survey frame*: the shell's axes, in metres, with the origin at the centre of its bounding box.

    Open3D computes in float32, which is accurate to a micrometre there, and to decimetres in national coordinates.

    Args:
        mesh: the shell in its own frame.
        metres_per_shell_unit: 1 for a shell in metres.

    Attributes:
        survey_from_shell: similarity from the shell's own frame.
        bounds: lowest and highest corner of the bounding box.
    """

    def __init__(self, mesh: ShellMesh, metres_per_shell_unit: float = 1.0) -> None:
        self._o3d = import_open3d()
        self.survey_from_shell = centred(mesh.bounds.mean(axis=0), metres_per_shell_unit)
        self.vertices = transformed(mesh.vertices, self.survey_from_shell)
        self.faces: Int64[np.ndarray, "F 3"] = mesh.faces
        self.bounds = np.stack([self.vertices.min(0), self.vertices.max(0)])
        tensor = self._o3d.core.Tensor
        self._scene = self._o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(tensor(self.vertices.astype(np.float32)), tensor(self.faces.astype(np.uint32)))

    def closest(self, points: Float64[np.ndarray, "N 3"]) -> Closest:
        """Return the closest point of the surface to each point, in the survey frame."""
        threads = 1 if len(points) < _FEW else 0  # 0: all threads
        answer = self._scene.compute_closest_points(self._o3d.core.Tensor(points.astype(np.float32)), threads)
        foot, normal = answer["points"].numpy(), answer["primitive_normals"].numpy()
        return Closest(foot.astype(np.float64), normal.astype(np.float64))

    def distance(self, points: Float64[np.ndarray, "N 3"]) -> Float32[np.ndarray, " N"]:
        """Return the unsigned distance of each point from the surface, in metres."""
        return self._scene.compute_distance(self._o3d.core.Tensor(points.astype(np.float32))).numpy()

    def first_hit(self, origins: np.ndarray, direction: np.ndarray) -> Float32[np.ndarray, " *N"]:
        """Return the distance along parallel rays to the surface, in metres; inf where they miss it."""
        rays = np.empty((*origins.shape[:-1], 6), np.float32)
        rays[..., :3], rays[..., 3:] = origins, direction
        return self._scene.cast_rays(self._o3d.core.Tensor(rays))["t_hit"].numpy()

    def samples(self, count: int) -> tuple[Float64[np.ndarray, "N 3"], Float64[np.ndarray, "N 3"]]:
        """Sample points uniformly on the surface, with their normals; the same points in each call."""
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        normal = np.cross(b - a, c - a)
        area = np.linalg.norm(normal, axis=1)
        random = np.random.default_rng(0)
        chosen = random.choice(len(area), count, p=area / area.sum())
        weights = random.dirichlet(np.ones(3), count)
        points = np.einsum("nk,nkd->nd", weights, np.stack([a, b, c], axis=1)[chosen])
        return points, (normal / np.maximum(area, 1e-300)[:, None])[chosen]
