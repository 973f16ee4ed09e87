"""Ray casting against triangles and distances from them: Embree, through Open3D."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int, Int32, Int64

from shellgs_method.machine.open3d import import_open3d

_FEW = 2000
"""Number of points below which waking other threads costs more than it saves, many times over on busy cores."""


class Hits(NamedTuple):
    """First hits of rays.

    Attributes:
        t: multiple of the ray's direction at the hit; inf where the ray misses.
        triangle: index of the triangle; -1 where the ray misses.
        normal: unit normal of the triangle, by its winding; 0 where the ray misses.
    """

    t: Float32[np.ndarray, " *N"]
    triangle: Int32[np.ndarray, " *N"]
    normal: Float32[np.ndarray, "*N 3"]


class Closest(NamedTuple):
    """Points of the surface that are nearest to given points.

    Attributes:
        point: the nearest point.
        triangle: index of its triangle.
        normal: unit normal of the triangle, by its winding.
    """

    point: Float32[np.ndarray, "N 3"]
    triangle: Int32[np.ndarray, " N"]
    normal: Float32[np.ndarray, "N 3"]


class Triangles:
    """Triangles prepared for queries.

    Embree computes in float32: coordinates must be relative to an origin near the triangles.

    Attributes:
        vertices: positions in any unit.
        faces: indices of three vertices each, counter-clockwise seen from outside where the caller needs sides.
        areas: area of each triangle.
        normals: unit normal of each triangle, by its winding.
        scene: Open3D's ray casting scene.

    Raises:
        SceneError: Open3D cannot be loaded.
    """

    def __init__(self, vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> None:
        o3d = import_open3d()
        self.vertices: Float64[np.ndarray, "V 3"] = np.asarray(vertices, np.float64)
        self.faces: Int64[np.ndarray, "F 3"] = np.asarray(faces, np.int64)
        self.normals: Float64[np.ndarray, "F 3"] = area_vectors(self.vertices, self.faces)
        self.areas: Float64[np.ndarray, " F"] = np.linalg.norm(self.normals, axis=1)
        self.normals /= np.maximum(self.areas, np.finfo(float).tiny)[:, None]
        self._tensor = o3d.core.Tensor.from_numpy
        self.scene = o3d.t.geometry.RaycastingScene()
        self.scene.add_triangles(
            self._tensor(np.ascontiguousarray(vertices, np.float32)),
            self._tensor(np.ascontiguousarray(faces, np.uint32)),
        )

    @cached_property
    def centres(self) -> Float64[np.ndarray, "F 3"]:
        """Centre of each triangle."""
        return self.vertices[self.faces].mean(axis=1)

    def within(self, low: Float64[np.ndarray, " K"], high: Float64[np.ndarray, " K"]) -> Triangles:
        """The whole triangles whose bounding boxes reach into a box along the first K axes."""
        corners = self.vertices[self.faces, : len(low)]
        inside = (corners.max(axis=1) >= low).all(axis=1) & (corners.min(axis=1) <= high).all(axis=1)
        return Triangles(*referenced(self.vertices, self.faces[inside]))

    def cast(self, origins: Float[np.ndarray, "*#N 3"], directions: Float[np.ndarray, "*#N 3"]) -> Hits:
        """First hits of rays; origins and directions, of any length, are broadcast."""
        return self.cast_rays(rays_from(origins, directions))

    def cast_rays(self, rays: Float32[np.ndarray, "*N 6"]) -> Hits:
        """First hits of rays, made by :func:`rays_from`."""
        answer = self.scene.cast_rays(self._tensor(rays))
        return Hits(answer["t_hit"].numpy(), _index(answer), answer["primitive_normals"].numpy())

    def blocked(
        self, origins: Float[np.ndarray, "*#N 3"], directions: Float[np.ndarray, "*#N 3"]
    ) -> Bool[np.ndarray, " *N"]:
        """Whether rays hit anything at all."""
        return self.scene.test_occlusions(self._tensor(rays_from(origins, directions))).numpy()

    def sees(
        self, points: Float[np.ndarray, "*#N 3"], targets: Float[np.ndarray, "*#N 3"], slack: float
    ) -> Bool[np.ndarray, " *N"]:
        """Whether nothing is between points and targets, except in the last ``slack`` units before the target."""
        away = targets - points
        length = np.linalg.norm(away, axis=-1, keepdims=True)
        return self.cast(points, away / np.maximum(length, 1e-9)).t >= length[..., 0] - slack

    def closest(self, points: Float[np.ndarray, "N 3"]) -> Closest:
        """The nearest point of the surface to each point."""
        threads = 1 if len(points) < _FEW else 0  # 0: all
        answer = self.scene.compute_closest_points(self._tensor(np.ascontiguousarray(points, np.float32)), threads)
        return Closest(answer["points"].numpy(), _index(answer), answer["primitive_normals"].numpy())

    def distance(self, points: Float[np.ndarray, "N 3"]) -> Float32[np.ndarray, " N"]:
        """Unsigned distance of each point from the surface."""
        return self.scene.compute_distance(self._tensor(np.ascontiguousarray(points, np.float32))).numpy()

    def signed_distance(self, points: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, " N"]:
        """Distance of each point, positive on the side that the nearest triangle's normal points to."""
        closest = self.closest(points)
        away = points - closest.point
        side = np.einsum("nc,nc->n", away, self.normals[closest.triangle])
        return np.where(side < 0, -1.0, 1.0) * np.linalg.norm(away, axis=1)

    def samples(self, count: int) -> tuple[Float64[np.ndarray, "N 3"], Int64[np.ndarray, " N"]]:
        """Random points, uniform by area, and the triangle of each; the same in each call."""
        return sampled(self.vertices, self.faces, self.areas, count)


def _index(answer) -> Int32[np.ndarray, " *N"]:
    """Triangles of an answer of Open3D's, which marks a miss by 2³² - 1: as signed integers, without a copy, by -1."""
    return answer["primitive_ids"].numpy().view(np.int32)


def stacked(
    meshes: Iterable[tuple[Float64[np.ndarray, "V 3"], Int[np.ndarray, "F 3"]]],
) -> tuple[Float64[np.ndarray, "W 3"], Int[np.ndarray, "G 3"]]:
    """Vertices and faces of meshes as those of one."""
    vertices, faces = zip(*meshes, strict=True)
    starts = np.cumsum([0, *(len(each) for each in vertices[:-1])])
    return np.concatenate(vertices), np.concatenate([each + start for each, start in zip(faces, starts, strict=True)])


def referenced(
    vertices: Float64[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> tuple[Float64[np.ndarray, "W 3"], Int[np.ndarray, "F 3"]]:
    """A mesh without the vertices of no triangle; as it is if it has no triangles, or indices that are out of range."""
    if len(faces) == 0 or faces.min() < 0 or faces.max() >= len(vertices):
        return vertices, faces
    used = np.zeros(len(vertices), bool)
    used[faces] = True
    return vertices[used], (np.cumsum(used) - 1)[faces]


def area_vectors(vertices: Float64[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> Float64[np.ndarray, "F 3"]:
    """Normals of triangles, by their winding, with the triangles' areas as lengths."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    vectors = np.cross(b - a, c - a)
    vectors /= 2  # in place: shells have millions of triangles
    return vectors


def sampled(
    vertices: Float64[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], areas: Float64[np.ndarray, " F"], count: int
) -> tuple[Float64[np.ndarray, "N 3"], Int64[np.ndarray, " N"]]:
    """Random points on triangles, uniform by area, and the triangle of each; the same in each call."""
    rng = np.random.default_rng(0)
    chosen = rng.choice(len(areas), count, p=areas / areas.sum())
    weights = rng.dirichlet(np.ones(3), count)
    return np.einsum("nk,nkd->nd", weights, vertices[faces[chosen]]), chosen


def rays_from(
    origins: Float[np.ndarray, "*#N 3"], directions: Float[np.ndarray, "*#N 3"]
) -> Float32[np.ndarray, "*N 6"]:
    """Origins and directions of rays side by side, in float32; both are broadcast."""
    rays = np.empty((*np.broadcast_shapes(origins.shape, directions.shape)[:-1], 6), np.float32)
    rays[..., :3], rays[..., 3:] = origins, directions
    return rays
