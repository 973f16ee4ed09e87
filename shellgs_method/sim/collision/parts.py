"""Convex parts, described by their corners and by the planes of their faces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError

from shellgs_method.geometry.triangles import stacked

MOST_VERTICES = 64
"""Maximum number of a part's corners: PhysX, in Isaac Sim, cooks no larger hulls."""
FINEST = 1e-3
"""Metres by which points may stick out of a part, and as many times twice as it takes to have few corners."""


@dataclass(frozen=True, eq=False)
class Part:
    """A convex solid.

    Attributes:
        vertices: its corners, in metres, at most 64.
        faces: triangles between them, counter-clockwise seen from outside.
        planes: planes of its faces: n · x + d <= 0 inside.
    """

    vertices: Float64[np.ndarray, "V 3"]
    faces: Int64[np.ndarray, "F 3"]
    planes: Float64[np.ndarray, "P 4"] = field(repr=False)

    @classmethod
    def hull(cls, points: Float64[np.ndarray, "N 3"]) -> Part | None:
        """The convex hull of points, of which those that stick out little are left out; None if it has no volume.

        Quickhull takes the farthest points first, and stops at those nearer than Qhull's option ``W``.
        """
        corners, out = np.arange(len(points)), 0.0
        try:
            hull = ConvexHull(points)
            while len(hull.vertices) > MOST_VERTICES:
                out = max(2 * out, FINEST)
                corners = ConvexHull(points, qhull_options=f"Qt W{out}").vertices
                hull = ConvexHull(points[corners])
        except (QhullError, ValueError):
            return None
        if hull.volume < 1e-7:
            return None
        points = points[corners]
        vertices, faces = points[hull.vertices], np.searchsorted(hull.vertices, hull.simplices)
        corners = vertices[faces]
        inwards = np.einsum(
            "fc,fc->f", np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), hull.equations[:, :3]
        )
        faces = np.where(inwards[:, None] < 0, faces[:, ::-1], faces)
        return cls(vertices, faces, np.unique(hull.equations.round(9), axis=0))

    def contains(self, points: Float64[np.ndarray, "N 3"], margin: float) -> Bool[np.ndarray, " N"]:
        """Whether points are in the part or closer than about ``margin`` to it."""
        near = ((points >= self.vertices.min(0) - margin) & (points <= self.vertices.max(0) + margin)).all(axis=1)
        inside = np.zeros(len(points), bool)
        inside[near] = (points[near] @ self.planes[:, :3].T + self.planes[:, 3] <= margin).all(axis=1)
        return inside


def joined(parts: Sequence[Part]) -> tuple[Float64[np.ndarray, "V 3"], Int64[np.ndarray, "F 3"]]:
    """Vertices and faces of all parts as one mesh."""
    return stacked((part.vertices, part.faces) for part in parts)


def pieces(parts: Sequence[Part], gap: float) -> int:
    """Number of pieces that parts form if those whose boxes are less than a gap in metres apart are joined."""
    low, high = (np.array([end(part.vertices, axis=0) for part in parts]) for end in (np.min, np.max))
    along = int((high.max(axis=0) - low.min(axis=0)).argmax())
    order = low[:, along].argsort()
    low, high = low[order], high[order]
    near = []
    for k, end in enumerate(np.searchsorted(low[:, along], high[:, along] + gap)):  # only these: memory is not squared
        apart = np.maximum(0, np.maximum(low[k + 1 : end] - high[k], low[k] - high[k + 1 : end]))
        near.append(k + 1 + np.flatnonzero(np.linalg.norm(apart, axis=1) < gap))
    starts = np.cumsum([0, *map(len, near)])
    joins = csr_array((np.ones(starts[-1], bool), np.concatenate(near), starts), shape=(len(parts), len(parts)))
    return connected_components(joins, directed=False)[0]
