"""Cluster the triangles of a surface into few pieces whose convex hulls hold little air.

Hierarchical face clustering (Garland, Willmott and Heckbert, "Hierarchical face clustering on polygonal surfaces", I3D
2001), with another cost: the air that the hull of a piece adds in front of its triangles. On a plane that is the
convex decomposition of Hertel and Mehlhorn (1983), and around convex corners merging is free.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64, Int64
from scipy.spatial import ConvexHull, QhullError
from trimesh.geometry import faces_to_edges
from trimesh.graph import connected_component_labels

from shellgs_method.geometry.nearest import point_tree
from shellgs_method.geometry.triangles import Triangles

WELDED = 1e-3
"""Vertices in the same cube of this size, in metres, are one."""
DEEP = 0.25
"""Depth of the air, in metres, that a hull is taken to fill where a piece has no triangles: in openings, say. Of a
piece that is deeper itself, all is taken for air: its open sides may be in front of other pieces."""
FREE = 1e-4
"""Cubic metres of air that a merge may add however many parts there may be."""
ROUND = 0.3
"""Ratio of the length of the area vector to the area below which a piece faces all ways, and has no front."""
NEIGHBOURS = 6
"""Number of nearest pieces to merge with where pieces that touch are not enough."""
FINE = 2e-3
"""Corners that stick out of a piece's hull by less than this, in metres, are not kept while merging."""


@dataclass(frozen=True, slots=True, eq=False)
class _Piece:
    """A cluster: its triangles, the corners of its hull, and sums over its triangles, which add up when merging.

    Attributes:
        faces: indices of triangles.
        points: corners of its hull.
        area: Σ |A|, of the triangles' area vectors A.
        vector: Σ A.
        moment: Σ A cᵀ, of their centres c.
        air: cubic metres of air in its hull in front of its triangles.
    """

    faces: list[Int64[np.ndarray, " _"]]
    points: Float64[np.ndarray, "P 3"]
    area: float
    vector: Float64[np.ndarray, " 3"]
    moment: Float64[np.ndarray, "3 3"]
    air: float

    @property
    def front(self) -> Float64[np.ndarray, " 3"] | None:
        """Unit normal of the piece; None if it faces all ways."""
        length = float(np.linalg.norm(self.vector))
        return self.vector / length if length > ROUND * self.area else None

    def with_(self, other: _Piece) -> _Piece:
        points = np.concatenate([self.points, other.points])
        area, vector, moment = self.area + other.area, self.vector + other.vector, self.moment + other.moment
        both = _Piece([*self.faces, *other.faces], points, area, vector, moment, 0.0)
        return replace(both, air=_air(both))


def _air(piece: _Piece) -> float:
    """Cubic metres between the front of a piece's hull and its triangles.

    Both volumes are over the same level below the piece: that of the hull of its corners and their projections to that
    level, and Σ (A·n) (c·n - level) of the triangles, by the divergence theorem.
    """
    n = piece.front
    if n is None:
        return _volume(np.concatenate([piece.points, piece.points + DEEP * flattest(piece.points)]))
    heights = piece.points @ n
    if np.ptp(heights) > DEEP:
        return _volume(piece.points)
    level = heights.min() - DEEP
    hull = _volume(np.concatenate([piece.points, piece.points - (heights - level)[:, None] * n]))
    return max(hull - float(n @ piece.moment @ n - level * (n @ piece.vector)), 0.0)


def _volume(points: Float64[np.ndarray, "P 3"]) -> float:
    try:
        return ConvexHull(points).volume
    except QhullError:  # flat
        return 0.0


def flattest(points: Float64[np.ndarray, "P 3"]) -> Float64[np.ndarray, " 3"]:
    """The direction in which points extend least."""
    return np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][-1]


def clusters(surface: Triangles, most: int) -> tuple[list[Int64[np.ndarray, " _"]], float]:
    """Clusters of triangles, at most ``most``, and the cubic metres of air that their hulls fill.

    Triangles that touch are merged first, then the nearest pieces.

    Args:
        surface: wound so that normals point outside.
        most: maximum number of clusters, at least 1.
    """
    kept = np.flatnonzero(surface.areas > 1e-8)
    vectors = surface.normals * surface.areas[:, None]
    moments = vectors[:, :, None] * surface.centres[:, None]
    pieces = [
        _Piece([np.array([k])], surface.vertices[surface.faces[k]], surface.areas[k], vectors[k], moments[k], 0.0)
        for k in kept
    ]
    pieces = _merged(pieces, *_shared_edges(surface, kept), most)
    while len(pieces) > most:
        pairs = _nearest(pieces)
        pieces = _merged(pieces, pairs, np.zeros(len(pairs)), most)
    return [np.concatenate(piece.faces) for piece in pieces], sum(piece.air for piece in pieces)


def welded(surface: Triangles) -> Int64[np.ndarray, " V"]:
    """A number of each vertex, the same for those at the same place (:data:`WELDED`)."""
    _, number = np.unique(np.round(surface.vertices / WELDED).astype(np.int64), axis=0, return_inverse=True)
    return number.ravel()


def _shared_edges(
    surface: Triangles, kept: Int64[np.ndarray, " K"]
) -> tuple[Int64[np.ndarray, "E 2"], Float64[np.ndarray, " E"]]:
    """Pairs of triangles with a common edge, and the lengths of these edges."""
    corners = surface.faces[kept]
    ends = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    keys = np.sort(welded(surface)[ends], axis=1)
    order = np.lexsort(keys.T)
    same = np.flatnonzero((keys[order[1:]] == keys[order[:-1]]).all(axis=1))
    pairs = np.stack([order[same], order[same + 1]], axis=1)
    length = np.linalg.norm(np.diff(surface.vertices[ends[pairs[:, 0]]], axis=1)[:, 0], axis=1)
    return pairs % len(kept), length


def _nearest(pieces: list[_Piece]) -> Int64[np.ndarray, "E 2"]:
    """Pairs of each piece and the nearest others, by the middles of their corners."""
    middles = np.stack([piece.points.mean(axis=0) for piece in pieces])
    near = np.asarray(point_tree(middles).query(middles, min(NEIGHBOURS + 1, len(pieces)))[1])
    pairs = np.stack([np.repeat(np.arange(len(pieces)), near.shape[1]), near.ravel()], axis=1)
    return np.unique(np.sort(pairs[pairs[:, 0] != pairs[:, 1]], axis=1), axis=0)


def _merged(
    start: list[_Piece], pairs: Int64[np.ndarray, "E 2"], lengths: Float64[np.ndarray, " E"], most: int
) -> list[_Piece]:
    """Merge pairs of pieces: all that add no air, those of the longest common edge first; then the cheapest.

    A pair of a new piece keeps the price of its parts' pair until it is the cheapest, and is only then computed.
    """
    pieces: dict[int, _Piece] = dict(enumerate(start))
    common: list[dict[int, tuple[float, float]]] = [{} for _ in start]  # length of the common edge, last known price
    queue: list[tuple[float, float, int, int, _Piece | None]] = []

    def link(a: int, b: int, length: float, price: float) -> None:
        common[a][b] = common[b][a] = length, price
        heapq.heappush(queue, (price, -length, a, b, None))

    for (a, b), length in zip(pairs.tolist(), lengths.tolist(), strict=True):
        if a != b:
            link(a, b, length + common[a].get(b, (0.0, 0.0))[0], FREE)
    while queue:
        price, edge, a, b, both = heapq.heappop(queue)
        if a not in pieces or b not in pieces:
            continue
        if price > FREE and len(pieces) <= most:
            break
        if both is None:
            both = pieces[a].with_(pieces[b])
            price = max(both.air - pieces[a].air - pieces[b].air, FREE)
            common[a][b] = common[b][a] = -edge, price
            heapq.heappush(queue, (price, edge, a, b, both))
            continue
        new, one, other = len(common), common[a], common[b]
        del pieces[a], pieces[b]
        pieces[new] = _trimmed(both)
        common.append({})
        for k in (one.keys() | other.keys()) - {a, b}:
            known = [near[k] for near in (one, other) if k in near]
            for gone in (a, b):
                common[k].pop(gone, None)
            link(new, k, sum(length for length, _ in known), min(price for _, price in known))
    return list(pieces.values())


def _trimmed(piece: _Piece) -> _Piece:
    """The piece without points that are not corners of its hull."""
    n = piece.front
    behind = piece.points - 0.02 * (np.array([0.0, 0, 1]) if n is None else n)
    try:
        corners = ConvexHull(np.concatenate([piece.points, behind]), qhull_options=f"Qt W{FINE}").vertices
    except QhullError:
        return piece
    return replace(piece, points=piece.points[np.unique(corners % len(behind))])


def connected(faces: Int64[np.ndarray, "F 3"], chosen: Int64[np.ndarray, " C"]) -> list[Int64[np.ndarray, " G"]]:
    """Connected components of the chosen triangles, by shared vertices."""
    if not len(chosen):
        return []
    corners = faces[chosen]
    label = connected_component_labels(faces_to_edges(corners), node_count=int(corners.max()) + 1)[corners[:, 0]]
    order = np.argsort(label, kind="stable")
    return np.split(chosen[order], np.flatnonzero(np.diff(label[order])) + 1)
