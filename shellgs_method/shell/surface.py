"""The shell as a surface to measure distances to, in metres and near the origin."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Float64, Int64

from shellgs_method.geometry.similarity import centred, transformed
from shellgs_method.geometry.triangles import Triangles, area_vectors, rays_from, sampled
from shellgs_method.shell.mesh import ShellMesh


class ShellSurface(Triangles):
    """A shell in its *survey frame*: the shell's axes, in metres, with the origin at its median vertex.

    Open3D computes in float32, which is accurate to a micrometre there, and to decimetres in national coordinates.

    Args:
        mesh: the shell in its own frame.
        metres_per_shell_unit: 1 for a shell in metres.

    Attributes:
        survey_from_shell: similarity from the shell's own frame.
        bounds: lowest and highest corner of the bounding box.
    """

    def __init__(self, mesh: ShellMesh, metres_per_shell_unit: float = 1.0) -> None:
        self.survey_from_shell = centred(mesh.centre, metres_per_shell_unit)
        self.vertices = transformed(mesh.vertices, self.survey_from_shell)
        self.faces: Int64[np.ndarray, "F 3"] = mesh.faces
        self.bounds = np.stack([self.vertices.min(0), self.vertices.max(0)])
        super().__init__(self.vertices, self.faces)

    def first_hit(self, origins: np.ndarray, direction: np.ndarray) -> Float32[np.ndarray, " *N"]:
        """Return the distance along parallel rays to the surface, in metres; inf where they miss it."""
        return self.cast_rays(rays_from(origins, direction)).t

    def samples(self, count: int) -> tuple[Float64[np.ndarray, "N 3"], Float64[np.ndarray, "N 3"]]:
        """Sample points uniformly on the surface, with their normals; the same points in each call."""
        vectors = area_vectors(self.vertices, self.faces)
        areas = np.linalg.norm(vectors, axis=1)
        points, triangle = sampled(self.vertices, self.faces, areas, count)
        return points, vectors[triangle] / areas[triangle, None]
