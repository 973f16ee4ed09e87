"""Ray casting and distances on triangle meshes near the origin."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, Int64

from shellgs_method.geometry.triangles import Triangles, area_vectors, rays_from, sampled


class Surface(Triangles):
    """A triangle mesh for ray casting and distances, in float32, so the origin must be near.

    Attributes:
        vertices: vertices in metres.
        faces: vertex indices, counter-clockwise seen from outside where the caller needs sides.
        centres: centre of each triangle.
        normals: unit normal of each triangle.
        areas: area of each triangle.
    """

    def __init__(self, vertices: Float64[np.ndarray, "V 3"], faces: Int64[np.ndarray, "F 3"]) -> None:
        self.vertices, self.faces = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
        vectors = area_vectors(self.vertices, self.faces)
        self.areas: Float64[np.ndarray, " F"] = np.linalg.norm(vectors, axis=1)
        self.normals = vectors / np.maximum(self.areas, 1e-300)[:, None]
        self.centres = self.vertices[self.faces].mean(axis=1)
        super().__init__(self.vertices, self.faces)

    def cast(
        self, origins: Float64[np.ndarray, "*N 3"], directions: Float64[np.ndarray, "*N 3"]
    ) -> tuple[Float32[np.ndarray, " *N"], Int32[np.ndarray, " *N"]]:
        """First hit of each ray: the multiple of its direction (inf if none) and the triangle (-1 if none)."""
        hits = self.cast_rays(rays_from(origins, directions))
        return hits.t, hits.triangle

    def sees(
        self, points: Float64[np.ndarray, "*N 3"], targets: Float64[np.ndarray, "*N 3"], slack: float = 1e-3
    ) -> Bool[np.ndarray, " *N"]:
        """Whether nothing is between points and targets, except in the last ``slack`` metres."""
        away = targets - points
        length = np.linalg.norm(away, axis=-1, keepdims=True)
        t, _ = self.cast(np.broadcast_to(points, away.shape), away / np.maximum(length, 1e-9))
        return t >= length[..., 0] - slack

    def signed_distance(self, points: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, " N"]:
        """Distances of points, in metres: positive on the side that the nearest triangle's normal points to."""
        closest = self.closest(points)
        away = points - closest.point
        side = np.einsum("nc,nc->n", away, self.normals[closest.triangle])
        return np.where(side < 0, -1.0, 1.0) * np.linalg.norm(away, axis=1)

    def samples(self, count: int) -> tuple[Float64[np.ndarray, "N 3"], Int64[np.ndarray, " N"]]:
        """Random points, uniform by area, and the triangle of each; the same in each call."""
        return sampled(self.vertices, self.faces, self.areas, count)


def outward(
    surface: Surface, eyes: Float64[np.ndarray, "E 3"], count: int = 24
) -> tuple[Surface, Bool[np.ndarray, " F"]]:
    """Wind triangles so that their normals point to the eyes that see them; also return which are seen.

    Unseen triangles keep their winding.

    Args:
        surface: surface of any winding.
        eyes: positions outside, such as those of cameras.
        count: number of eyes to test, spread over all.
    """
    centres = surface.centres
    votes, seen = np.zeros(len(centres)), np.zeros(len(centres), bool)
    for eye in spread(eyes, count):
        visible = surface.sees(np.broadcast_to(eye, centres.shape), centres, slack=5e-3)
        votes += visible * np.sign(np.einsum("fc,fc->f", eye - centres, surface.normals))
        seen |= visible
    return Surface(surface.vertices, np.where(votes[:, None] < 0, surface.faces[:, ::-1], surface.faces)), seen


def spread(eyes: Float64[np.ndarray, "E 3"], count: int) -> Float64[np.ndarray, "C 3"]:
    """At most ``count`` of the eyes, evenly spaced in their order."""
    return eyes[np.unique(np.linspace(0, len(eyes) - 1, count).round().astype(int))]
