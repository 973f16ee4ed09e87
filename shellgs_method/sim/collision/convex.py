"""Decompose outlines into convex polygons, and merge these until few are left."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Sequence
from itertools import count

import numpy as np
import shapely
import trimesh

EXACT = 1e-3
"""Area in square metres that merging two polygons may add at no cost."""
NEIGHBOURS = 6
"""Number of nearest pieces of the same plane to try to merge with."""


def convex_pieces(outline: shapely.MultiPolygon) -> list[shapely.Polygon]:
    """Decompose polygons with holes into convex polygons.

    Triangles are merged across common edges, the longest first, while their hull has no more area than they have
    (Hertel and Mehlhorn 1983): at most four times as many pieces as necessary.
    """
    pieces: list[shapely.Polygon] = []
    pairs: set[tuple[int, int]] = set()
    for polygon in outline.geoms:
        vertices, faces = trimesh.creation.triangulate_polygon(polygon, engine="earcut")
        edges: dict[tuple[int, int], int] = {}
        for face in faces:
            for edge in zip(face, (*face[1:], face[0]), strict=True):
                key = (int(min(edge)), int(max(edge)))
                if key in edges:
                    pairs.add((edges[key], len(pieces)))
                edges[key] = len(pieces)
            pieces.append(shapely.Polygon(vertices[face]))
    joined, _ = _merge(pieces, pairs, lambda _, __, ___: np.inf, 0)
    return [piece for piece, _ in joined]


def fewer_pieces(
    planes: Sequence[Sequence[shapely.Polygon]], most: int, cost: Callable[[int, shapely.Geometry], float]
) -> tuple[list[list[shapely.Polygon]], float]:
    """Merge the cheapest pairs of pieces until ``most`` are left; return the pieces of each plane and the total cost.

    A plane keeps at least one piece, so that with many planes more are left.

    Args:
        planes: convex polygons of each plane.
        most: number of pieces over all planes.
        cost: cost of covering an area of the plane with the given index.
    """
    pieces = [piece for plane in planes for piece in plane]
    owner = [index for index, plane in enumerate(planes) for _ in plane]
    pairs: set[tuple[int, int]] = set()
    first = 0
    for plane in planes:
        if len(plane) > 1:
            gaps = shapely.distance(np.array(plane)[:, None], np.array(plane)[None])
            for a, nearest in enumerate(np.argsort(gaps, axis=1)[:, : NEIGHBOURS + 1]):
                pairs |= {(first + min(a, b), first + max(a, b)) for b in nearest.tolist() if b != a}
        first += len(plane)

    def price(hull: shapely.Geometry, one: shapely.Polygon, other: tuple[shapely.Polygon, int]) -> float:
        return cost(owner[other[1]], shapely.difference(hull, shapely.union(one, other[0])))

    left, spent = _merge(pieces, pairs, price, most)
    cut: list[list[shapely.Polygon]] = [[] for _ in planes]
    for piece, origin in left:
        cut[owner[origin]].append(piece)
    return cut, spent


def _merge(
    start: Sequence[shapely.Polygon],
    pairs: set[tuple[int, int]],
    price: Callable[[shapely.Geometry, shapely.Polygon, tuple[shapely.Polygon, int]], float],
    most: int,
) -> tuple[list[tuple[shapely.Polygon, int]], float]:
    """Merge pairs of pieces into their hulls: all that cost nothing, then the cheapest while there are too many.

    Returns the pieces, each with the index of one of its original pieces, and the total cost.
    """
    pieces = dict(enumerate(start))
    origin = {number: number for number in pieces}
    neighbours: dict[int, set[int]] = {number: set() for number in pieces}
    for a, b in pairs:
        neighbours[a].add(b)
        neighbours[b].add(a)
    numbers, spent = count(len(pieces)), 0.0

    def candidate(a: int, b: int) -> tuple[float, float, int, int]:
        one, other = pieces[a], pieces[b]
        hull = shapely.union(one, other).convex_hull
        free = hull.area - one.area - other.area <= EXACT
        common = (one.length + other.length - hull.length) / 2
        return 0.0 if free else price(hull, one, (other, origin[b])), -common, a, b

    queue = [candidate(a, b) for a, b in pairs]
    heapq.heapify(queue)
    while queue:
        cost, _, a, b = heapq.heappop(queue)
        if a not in pieces or b not in pieces:
            continue
        if cost == np.inf or (cost > 0 and len(pieces) <= most):
            break
        new, spent = next(numbers), spent + cost
        hull = shapely.union(pieces[a], pieces[b]).convex_hull
        assert isinstance(hull, shapely.Polygon)
        pieces[new], origin[new] = hull, origin[a]
        neighbours[new] = (neighbours.pop(a) | neighbours.pop(b)) - {a, b}
        del pieces[a], pieces[b]
        for other in neighbours[new]:
            neighbours[other] = (neighbours[other] - {a, b}) | {new}
            heapq.heappush(queue, candidate(other, new))
    return [(piece, origin[number]) for number, piece in pieces.items()], spent
