"""Plane polygons, with or without holes, as triangles."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int, Int64

from shellgs_method.geometry.planes import across


class Triangulation(NamedTuple):
    """Polygons as triangles, which wind as their polygons do.

    Attributes:
        faces: vertex indices of the triangles.
        polygon: index of each triangle's polygon.
        missed: polygons that no triangles cover once: they cross themselves, or have no area.
    """

    faces: Int64[np.ndarray, "F 3"]
    polygon: Int64[np.ndarray, " F"]
    missed: Int64[np.ndarray, " M"]


_MISSED = 1e-3
"""Difference between the area of a polygon and that of its triangles, as a share, from which it crosses itself."""


def triangulated(
    vertices: Float64[np.ndarray, "V 3"],
    sizes: Int[np.ndarray, " R"],
    corners: Int[np.ndarray, " C"],
    holes: Bool[np.ndarray, " R"] | None = None,
) -> Triangulation:
    """Cut polygons into triangles: convex ones into fans, the others by their ears (earcut), in their planes.

    Args:
        vertices: positions, of any origin.
        sizes: number of corners of each ring; rings of fewer than 3 are left out.
        corners: vertex indices of all rings, one after another; a polygon with an index out of range becomes a fan.
        holes: rings that are holes in the last ring before them that is none; none of them, if not given.
    """
    sizes, corners = sizes.astype(np.int64), corners.astype(np.int64)
    starts = np.cumsum(sizes) - sizes
    outer = np.ones(len(sizes), bool) if holes is None else ~holes
    polygon = np.cumsum(outer) - 1
    pierced = np.zeros(len(sizes), bool)
    pierced[np.flatnonzero(outer)[polygon[~outer & (sizes >= 3)]]] = True
    faces, owners, missed = [np.empty((0, 3), np.int64)], [np.empty(0, np.int64)], []
    alone = outer & ~pierced
    cut = list(np.flatnonzero(pierced & (sizes >= 3)))
    for size in np.unique(sizes[alone & (sizes >= 3)]).tolist():
        which = np.flatnonzero(alone & (sizes == size))
        rings = corners[starts[which][:, None] + np.arange(size)]
        fans = np.stack([np.stack([rings[:, 0], rings[:, k], rings[:, k + 1]], 1) for k in range(1, size - 1)], 1)
        known = (rings >= 0).all(axis=1) & (rings < len(vertices)).all(axis=1)
        if size > 3:
            a, b, c = (vertices[fans[known][..., k]] for k in range(3))
            turns = np.cross(b - a, c - a)
            concave = np.zeros(len(rings), bool)
            concave[known] = (np.einsum("pkc,pc->pk", turns, turns.sum(axis=1)) < 0).any(axis=1)
            cut += which[concave].tolist()
            fans, which = fans[~concave], which[~concave]
        faces.append(fans.reshape(-1, 3))
        owners.append(np.repeat(polygon[which], size - 2))
    for ring in sorted(cut):
        last = np.searchsorted(polygon, polygon[ring], "right")
        rings = [corners[starts[k] : starts[k] + sizes[k]] for k in range(ring, last) if sizes[k] >= 3]
        found, covered = _cut(vertices, rings)
        faces.append(found)
        owners.append(np.full(len(found), polygon[ring]))
        if not covered:
            missed.append(polygon[ring])
    return Triangulation(np.concatenate(faces), np.concatenate(owners), np.array(missed, np.int64))


def _cut(
    vertices: Float64[np.ndarray, "V 3"], rings: list[Int64[np.ndarray, " N"]]
) -> tuple[Int64[np.ndarray, "F 3"], bool]:
    """Triangles of a ring with holes, and whether they cover it once."""
    import mapbox_earcut  # training needs none

    corners = np.concatenate(rings)
    placed = vertices[corners] - vertices[corners[0]]
    ends = np.cumsum([len(ring) for ring in rings])
    vectors = [_area_vector(part) for part in np.split(placed, ends[:-1])]
    area = float(np.linalg.norm(vectors[0]))
    if area == 0 or not np.isfinite(area):
        return np.empty((0, 3), np.int64), False
    flat = placed @ _basis(vectors[0] / area).T
    cut = corners[mapbox_earcut.triangulate_float64(flat, ends.astype(np.uint32)).astype(np.int64).reshape(-1, 3)]
    a, b, c = (vertices[cut[:, k]] for k in range(3))
    turns = np.cross(b - a, c - a) @ vectors[0] / (2 * area)
    if turns.sum() < 0:
        cut, turns = cut[:, ::-1], -turns
    left = area - sum(np.linalg.norm(vector) for vector in vectors[1:])
    return cut, bool(abs(np.abs(turns).sum() - left) <= _MISSED * area)


def _area_vector(ring: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, " 3"]:
    """Normal of a ring, with its area as length (Newell)."""
    return np.cross(ring, np.roll(ring, -1, axis=0)).sum(axis=0) / 2


def _basis(normal: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, "2 3"]:
    """Two unit vectors across a normal, with which it is right-handed."""
    u = -across(normal)
    return np.stack([u, np.cross(normal, u)])
