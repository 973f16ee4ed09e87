"""Find the planes of a triangle mesh, with their outlines."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import shapely
from jaxtyping import Float64, Int64

from shellgs_method.geometry.axes import wall_axes
from shellgs_method.geometry.planes import fitted_plane, largest_plane
from shellgs_method.geometry.triangles import area_vectors

AGREEMENT = np.cos(np.radians(20))
"""Minimum cosine between a triangle's normal and its plane's: scans are noisy."""
LEAST_AREA = 0.02
"""Minimum area of a plane, in square metres."""
LEAST_SHARE = 1e-3
"""Minimum share of the mesh's area for a plane of a scan: smaller ones are ornament or noise."""
SMALL = 0.01
"""Mean area of triangles in square metres below which a mesh is taken for a scan."""


@dataclass(frozen=True, eq=False)
class Plane:
    """A plane with an outline, in a frame whose third axis points up.

    Attributes:
        origin: a point of the plane.
        axes: rows u, v and the unit normal, right-handed; u is horizontal where the plane is not.
        outline: the part of the plane that is covered, in coordinates along u and v.
        faces: indices of the triangles that lie on it.
    """

    origin: Float64[np.ndarray, " 3"]
    axes: Float64[np.ndarray, "3 3"]
    outline: shapely.MultiPolygon
    faces: Int64[np.ndarray, " F"]

    @property
    def normal(self) -> Float64[np.ndarray, " 3"]:
        """Unit normal."""
        return self.axes[2]

    def to_space(self, flat: Float64[np.ndarray, "N 2"], behind: float = 0.0) -> Float64[np.ndarray, "N 3"]:
        """3D points from plane coordinates, moved ``behind`` metres against the normal."""
        return self.origin + flat @ self.axes[:2] - behind * self.normal

    def samples(self, step: float) -> Float64[np.ndarray, "N 3"]:
        """Grid points inside the outline, at least one in each of its pieces."""
        return self.to_space(np.concatenate([grid_in(piece, step) for piece in self.outline.geoms]))


def grid_in(piece: shapely.Polygon, step: float) -> Float64[np.ndarray, "N 2"]:
    """Grid points inside a polygon, or any point inside if there are none."""
    x0, y0, x1, y1 = piece.bounds
    grid = np.stack(np.meshgrid(*(np.arange(a + step / 2, b, step) for a, b in ((x0, x1), (y0, y1)))), -1).reshape(
        -1, 2
    )
    inside = grid[shapely.contains_xy(piece, grid)]
    return inside if len(inside) else np.array(piece.representative_point().coords)


def find_planes(
    vertices: Float64[np.ndarray, "V 3"], faces: Int64[np.ndarray, "F 3"], tolerance: float = 0.02, gap: float = 0.06
) -> tuple[list[Plane], Int64[np.ndarray, " R"]]:
    """The planes of a mesh, the largest first, and the triangles that lie on none.

    Pieces of a plane need not touch, so that all panes of a facade are one.

    Args:
        vertices: in metres.
        faces: vertex indices.
        tolerance: largest distance of a triangle's corners from its plane, in metres.
        gap: cracks up to this width in the outline are closed, in metres.
    """
    corners = vertices[faces]
    vectors = area_vectors(vertices, faces)
    areas = np.linalg.norm(vectors, axis=1)
    normals = vectors / np.maximum(areas, 1e-300)[:, None]
    rng, planes = np.random.default_rng(0), []
    left, rest = np.flatnonzero(areas > 1e-8), []
    scanned = len(left) > 0 and areas[left].mean() < SMALL
    least = LEAST_SHARE * areas.sum() if scanned else 0.0
    # A scan's outlines are as ragged as its triangles are large: smooth them, and leave small pieces to the rest.
    even, crumb = (
        (float(np.clip(1.5 * np.sqrt(2 * areas[left].mean()), tolerance, 0.1)), 0.1) if scanned else (0.0, 0.005)
    )
    while len(left):
        chosen = largest_plane(corners[left], tolerance, rng, normals[left], AGREEMENT, areas[left])
        members = left[chosen]
        if areas[members].sum() < least:
            rest.append(left)
            break
        left = left[~chosen]
        plane = _outlined(corners[members], normals[members], areas[members], members, tolerance, even, gap, crumb)
        if plane is None:
            rest.append(members)
            continue
        planes.append(plane)
        if scanned:
            flat = (corners[members].mean(axis=1) - plane.origin) @ plane.axes[:2].T
            rest.append(members[~shapely.contains_xy(plane.outline.buffer(even), flat)])
    return planes, np.sort(np.concatenate(rest)) if rest else np.empty(0, np.int64)


def _outlined(
    corners: np.ndarray,
    normals: np.ndarray,
    areas: np.ndarray,
    faces: np.ndarray,
    tolerance: float,
    even: float,
    gap: float,
    crumb: float,
) -> Plane | None:
    """The plane of triangles with their union as its outline; None if that is too small."""
    if areas.sum() < LEAST_AREA:
        return None
    origin, normal = fitted_plane(corners, areas)
    if areas @ (normals @ normal) < 0:  # to the side that most of them face
        normal = -normal
    up = [0.0, 0, 1] if np.hypot(*normal[:2]) > 1e-3 else [0.0, normal[2], 0]  # u is along x on level planes
    axes = wall_axes(normal, np.array(up))
    flat = (corners - origin) @ axes[:2].T
    triangles = shapely.buffer(shapely.polygons(flat), gap / 2, join_style="mitre", mitre_limit=2)
    union = shapely.union_all(triangles).buffer(-gap / 2 - even, join_style="mitre", mitre_limit=2)
    smooth = union.buffer(even, join_style="mitre", mitre_limit=2).simplify(max(tolerance, even))
    outline = _pieces(smooth, crumb)
    return None if outline.area < LEAST_AREA else Plane(origin, axes, outline, faces)


def _pieces(shape: shapely.Geometry, least: float) -> shapely.MultiPolygon:
    """The polygons of a shape of at least ``least`` area, without smaller holes."""
    pieces = [part for part in polygons_of(shape) if part.area >= least]
    return shapely.MultiPolygon(
        [shapely.Polygon(p.exterior, [h for h in p.interiors if shapely.Polygon(h).area >= least]) for p in pieces]
    )


def polygons_of(shape: shapely.Geometry) -> Iterator[shapely.Polygon]:
    """The polygons of a shape."""
    for part in getattr(shape, "geoms", [shape]):
        if isinstance(part, shapely.Polygon) and not part.is_empty:
            yield part
