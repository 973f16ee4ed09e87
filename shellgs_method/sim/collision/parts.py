"""Convex parts, described by their corners and by the planes of their faces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import shapely
from jaxtyping import Bool, Float64, Int64
from scipy.spatial import ConvexHull, QhullError

from shellgs_method.sim.collision.planes import Plane


@dataclass(frozen=True, eq=False)
class Part:
    """A convex solid.

    Attributes:
        vertices: its corners, in metres.
        faces: triangles between them, counter-clockwise seen from outside.
        source: origin of the part: a plane of the shell, or a surface that is not planar.
        planes: planes of its faces: n · x + d <= 0 inside.
    """

    vertices: Float64[np.ndarray, "V 3"]
    faces: Int64[np.ndarray, "F 3"]
    source: Literal["plane", "surface"]
    planes: Float64[np.ndarray, "P 4"] = field(repr=False)

    @classmethod
    def hull(cls, points: Float64[np.ndarray, "N 3"], source: Literal["plane", "surface"]) -> Part | None:
        """The convex hull of points; None if they have no volume."""
        try:
            hull = ConvexHull(points)
        except (QhullError, ValueError):
            return None
        if hull.volume < 1e-7:
            return None
        vertices, faces = points[hull.vertices], np.searchsorted(hull.vertices, hull.simplices)
        corners = vertices[faces]
        inwards = np.einsum(
            "fc,fc->f", np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), hull.equations[:, :3]
        )
        faces = np.where(inwards[:, None] < 0, faces[:, ::-1], faces)
        return cls(vertices, faces, source, np.unique(hull.equations.round(9), axis=0))

    def contains(self, points: Float64[np.ndarray, "N 3"], margin: float) -> Bool[np.ndarray, " N"]:
        """Whether points are in the part or closer than about ``margin`` to it."""
        near = ((points >= self.vertices.min(0) - margin) & (points <= self.vertices.max(0) + margin)).all(axis=1)
        inside = np.zeros(len(points), bool)
        inside[near] = (points[near] @ self.planes[:, :3].T + self.planes[:, 3] <= margin).all(axis=1)
        return inside


def prism(plane: Plane, polygon: shapely.Polygon, thickness: float) -> Part | None:
    """Extrude a convex polygon of a plane against its normal."""
    flat = np.array(polygon.exterior.coords)[:-1]
    return Part.hull(np.concatenate([plane.to_space(flat), plane.to_space(flat, thickness)]), "plane")


def joined(parts: Sequence[Part]) -> tuple[Float64[np.ndarray, "V 3"], Int64[np.ndarray, "F 3"]]:
    """Vertices and faces of all parts as one mesh."""
    first = np.cumsum([0] + [len(part.vertices) for part in parts[:-1]])
    return (
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.faces + offset for part, offset in zip(parts, first, strict=True)]),
    )
