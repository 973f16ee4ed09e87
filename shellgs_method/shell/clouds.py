"""Mesh point clouds with open windows and flat walls."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float64, Int64
from scipy.spatial import Delaunay, QhullError

from shellgs_method.errors import SceneError, notice
from shellgs_method.files.clouds import VoxelCloud
from shellgs_method.geometry.nearest import point_tree
from shellgs_method.geometry.planes import largest_plane
from shellgs_method.geometry.triangles import Triangles, referenced, stacked
from shellgs_method.machine.open3d import import_open3d, reason

Mesher = Literal["planes", "bpa", "poisson"]

VERSION = 4
"""Version of the meshers and of what the readers of clouds leave out: clouds are meshed again if it changes."""

LONGEST_EDGE = 3.0  # this and the next two lengths are in units of the cloud's spacing
NEIGHBOURHOOD = 2.5
BALLS = 0.9, 1.6
NO_PLANE = -1
FAILURES = 6  # of RANSAC
LEAST_POINTS = 150  # in a plane


@dataclass(frozen=True)
class Meshing:
    """How a point cloud became a mesh; lengths are in the shell's units.

    Attributes:
        mesher: method.
        points: number of points in the file, or of those where cameras see it.
        dropped: number of them that were NaN, infinite or absurdly far away.
        voxel: size of the voxels in which they were merged.
        spacing: mean distance between neighbouring points after that.
        planes: number of planes found by RANSAC.
        triangles: number of triangles of the mesh.
        meshed: share of the points within one spacing of the mesh.
        median: median distance from a point to the mesh.
        p95: 95th percentile of that distance.
    """

    mesher: Mesher
    points: int
    dropped: int
    voxel: float
    spacing: float
    planes: int
    triangles: int
    meshed: float
    median: float
    p95: float

    def __str__(self) -> str:
        """Return one sentence for people."""
        planes = f" and {self.planes} planes" if self.planes else ""
        nan = f" ({self.dropped} NaN or infinite ones dropped)" if self.dropped else ""
        return (
            f"{self.points} points{nan}, {self.spacing:.3g} apart, became {self.triangles} triangles{planes} "
            f"({self.mesher}); {self.meshed:.1%} of the points are within {self.spacing:.3g} of the mesh, at a median "
            f"distance of {self.median:.2g} and a 95th percentile of {self.p95:.2g}."
        )


def mesh_cloud(
    cloud: VoxelCloud,
    viewpoints: Float64[np.ndarray, "V 3"],
    mesher: Mesher = "planes",
) -> tuple[Float64[np.ndarray, "M 3"], Int64[np.ndarray, "F 3"], Meshing]:
    """Mesh the surface of a point cloud.

    ``planes``: RANSAC planes, each with a Delaunay triangulation of the points on it, and ball pivoting for the rest;
    the least noise on buildings. ``bpa``: ball pivoting alone. ``poisson``: Poisson reconstruction, trimmed to the
    neighbourhood of the points; for ornament and other round shapes. None of them closes openings wider than three
    times the spacing of the points.

    Args:
        cloud: merged points in any frame, possibly georeferenced.
        viewpoints: positions of scanners or cameras; a point's normal faces the nearest. Without viewpoints, normals
            agree with those of the file, or else with their neighbours.
        mesher: method.

    Returns:
        Vertices and faces of the mesh, and a report.

    Raises:
        SceneError: the points make no surface.
    """
    if cloud.dropped:
        of = f"{cloud.dropped} of {cloud.total + cloud.dropped}"
        notice(f"dropped {of} points that are NaN or infinite, or absurdly far away")
    if cloud.total == 0:
        raise SceneError("all points are NaN or infinite" if cloud.dropped else "the point cloud has no points")
    origin = np.median(cloud.points, axis=0)  # squares of georeferenced coordinates would lose precision
    try:
        points = _Points.of(cloud.points - origin, viewpoints - origin, cloud.normals)
        parts = list(_MESHERS[mesher](points))
    except RuntimeError as error:  # raised by Open3D, for too few points for example
        raise SceneError(f"the points make no surface with the mesher {mesher!r} ({reason(error)})") from error
    parts = [part for part in parts if len(part.faces)]
    if not parts:
        raise SceneError(f"the points make no surface with the mesher {mesher!r}: try another, or a denser cloud")
    vertices, faces = stacked(referenced(part.vertices, part.faces) for part in parts)
    distance = Triangles(vertices, faces).distance(cloud.sample - origin)
    report = Meshing(
        mesher=mesher,
        points=cloud.total + cloud.dropped,
        dropped=cloud.dropped,
        voxel=cloud.voxel,
        spacing=points.spacing,
        planes=sum(part.is_plane for part in parts),
        triangles=len(faces),
        meshed=float((distance <= points.spacing).mean()),
        median=float(np.median(distance)),
        p95=float(np.percentile(distance, 95)),
    )
    return vertices + origin, faces, report


@dataclass(frozen=True)
class _Part:
    vertices: Float64[np.ndarray, "V 3"]
    faces: Int64[np.ndarray, "F 3"]
    is_plane: bool = False


@dataclass(frozen=True)
class _Points:
    """Evenly thinned points near the origin, with oriented normals and their spacing."""

    points: Float64[np.ndarray, "N 3"]
    normals: Float64[np.ndarray, "N 3"]
    spacing: float
    roughness: float  # standard deviation of the points across the surface

    @classmethod
    def of(cls, points: np.ndarray, viewpoints: np.ndarray, known: np.ndarray | None) -> _Points:
        spread = np.linalg.svd(points - points.mean(0), compute_uv=False) if len(points) > 1 else np.zeros(2)
        if not spread[1] > 1e-6 * spread[0]:
            what = "is a single point" if spread[0] == 0 else "lies on one straight line"
            raise SceneError(f"the point cloud makes no surface: it {what}")
        # On a surface with ρ points per unit of area, the k-th neighbour is √(k / π ρ) away.
        k = min(6, len(points) - 1)
        nearest = point_tree(points).query(points, k + 1)[0][:, k]
        spacing = float(np.median(nearest) * np.sqrt(np.pi / k))
        legacy = _legacy(points)
        search = import_open3d().geometry.KDTreeSearchParamHybrid(NEIGHBOURHOOD * spacing, 30)
        legacy.estimate_covariances(search)
        variances, axes = np.linalg.eigh(np.asarray(legacy.covariances))
        normals = _oriented(points, axes[:, :, 0], viewpoints, known)
        return cls(points, normals, spacing, float(np.sqrt(np.median(variances[:, 0].clip(0)))))


def _oriented(points: np.ndarray, normals: np.ndarray, viewpoints: np.ndarray, known: np.ndarray | None) -> np.ndarray:
    towards = viewpoints[point_tree(viewpoints).query(points)[1]] - points if len(viewpoints) else known
    if towards is not None:
        return np.where(np.einsum("nc,nc->n", normals, towards)[:, None] < 0, -normals, normals)
    # Exactly flat, where Open3D needs tetrahedra of neighbours; any three points are.
    if len(points) > 3 and np.ptp(points @ normals[0]) < 1e-9 * np.ptp(points):
        return np.tile(normals[0], (len(points), 1))
    legacy = _legacy(points, normals)
    legacy.orient_normals_consistent_tangent_plane(min(10, len(points) - 1))
    return np.asarray(legacy.normals)


def _planes(cloud: _Points) -> Iterator[_Part]:
    """Mesh planes one by one, the largest first, then their seams and the remaining points by ball pivoting."""
    rng, points = np.random.default_rng(0), cloud.points.copy()
    plane = np.full(len(points), NO_PLANE)
    least = max(3, min(LEAST_POINTS, len(cloud.points) // 20))
    tolerance = float(np.clip(4 * cloud.roughness, 0.1 * cloud.spacing, cloud.spacing))
    left, failures = np.arange(len(cloud.points)), 0
    while len(left) >= least and failures < FAILURES:
        members = left[largest_plane(cloud.points[left], tolerance, rng, cloud.normals[left])]
        part = _flat(cloud.points[members], LONGEST_EDGE * cloud.spacing) if len(members) >= least else None
        if part is None:
            failures += 1
            continue
        yield part
        points[members], plane[members] = part.vertices, members[0]
        left = np.setdiff1d(left, members, assume_unique=True)
    yield _mesh_seams(replace(cloud, points=points), plane)


def _flat(points: Float64[np.ndarray, "N 3"], longest: float) -> _Part | None:
    """Delaunay triangulation of points in their best-fit plane, without edges longer than ``longest``."""
    centre = points.mean(0)
    axes = np.linalg.svd(points - centre, full_matrices=False)[2][:2]
    flat = (points - centre) @ axes.T
    try:
        faces = Delaunay(flat).simplices
    except QhullError:  # all points on a line
        return None
    corners = flat[faces]
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    faces = faces[edges.max(axis=1) <= longest]
    return _Part(centre + flat @ axes, faces.astype(np.int64), is_plane=True) if len(faces) else None


def _mesh_seams(cloud: _Points, plane: Int64[np.ndarray, " N"]) -> _Part:
    """Mesh the points between planes, and those on no plane, by ball pivoting."""
    neighbours = point_tree(cloud.points).query(cloud.points, min(12, len(plane)))[1]
    seam = (plane == NO_PLANE) | (plane[neighbours] != plane[:, None]).any(axis=1)
    near = seam[neighbours].any(axis=1)
    part = _balls(cloud.points[near], cloud.normals[near], cloud.spacing)
    planes = plane[near][part.faces]
    return _Part(part.vertices, part.faces[(planes == NO_PLANE).any(axis=1) | np.ptp(planes, axis=1).astype(bool)])


def _balls(points: np.ndarray, normals: np.ndarray, spacing: float) -> _Part:
    o3d = import_open3d()
    if len(points) < 3:
        return _Part(points, np.empty((0, 3), np.int64))
    radii = o3d.utility.DoubleVector([spacing * radius for radius in BALLS])
    mesh = o3d.geometry.TriangleMesh.create_from_point_cloud_ball_pivoting(_legacy(points, normals), radii)
    return _Part(np.asarray(mesh.vertices), np.asarray(mesh.triangles, np.int64))


def _poisson(cloud: _Points) -> Iterator[_Part]:
    """Screened Poisson reconstruction (Kazhdan and Hoppe 2013), trimmed by distance: density would fill windows."""
    cells = np.ptp(cloud.points, axis=0).max() / (2 * cloud.spacing)
    depth = int(np.clip(np.round(np.log2(cells)), 5, 10))
    mesh, _ = import_open3d().geometry.TriangleMesh.create_from_point_cloud_poisson(
        _legacy(cloud.points, cloud.normals), depth=depth
    )
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.triangles, np.int64)
    near = point_tree(cloud.points).query(vertices)[0] <= 1.5 * cloud.spacing
    yield _Part(vertices, faces[near[faces].all(axis=1)])


_MESHERS: dict[Mesher, Callable[[_Points], Iterable[_Part]]] = {
    "planes": _planes,
    "bpa": lambda cloud: [_balls(cloud.points, cloud.normals, cloud.spacing)],
    "poisson": _poisson,
}


def _legacy(points: np.ndarray, normals: np.ndarray | None = None):
    """Return Open3D's legacy point cloud, which stores doubles."""
    o3d = import_open3d()
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    if normals is not None:
        cloud.normals = o3d.utility.Vector3dVector(normals)
    return cloud
