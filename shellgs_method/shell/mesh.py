"""Load the shell as a triangle mesh; a point cloud is meshed once, and its mesh is cached."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Int64, UInt8

from shellgs_method.errors import SceneError, notice
from shellgs_method.files.atomic import atomic_write, content_hash
from shellgs_method.files.clouds import Cloud
from shellgs_method.files.readers.contents import Geometry
from shellgs_method.files.readers.points import NO_POINTS
from shellgs_method.files.surfaces import read_geometry, read_surface
from shellgs_method.geometry.camera import Camera, positions
from shellgs_method.geometry.outliers import inliers
from shellgs_method.geometry.precision import NO_STEP, Step, cloud_step, mesh_step, refuse_coarse
from shellgs_method.geometry.surface_classes import NO_CLASSES, classes_of
from shellgs_method.geometry.triangles import area_vectors
from shellgs_method.shell.clouds import VERSION, Mesher, Meshing, mesh_cloud
from shellgs_method.shell.spacing import Sights, as_seen

COMMENT = "comment shellgs "
_FAR = 1e4
"""Times the median distance from the median vertex beyond which a vertex is not the building's, but at the origin of
national coordinates, for example. It would stretch every box and take most of the area."""


@dataclass(frozen=True)
class ShellMesh:
    """A triangle mesh with at least one triangle, finite vertices and indices in range.

    Attributes:
        vertices: positions in the shell's own frame and units, possibly georeferenced.
        faces: three vertex indices per triangle.
        meshing: how a point cloud was meshed; None if the file holds a mesh.
        step: step of the coordinates in the file.
        classes: :class:`~shellgs_method.geometry.surface_classes.SurfaceClass` of each triangle; OTHER if not given.

    Raises:
        SceneError: the arrays are not such a mesh.
    """

    vertices: Float64[np.ndarray, "V 3"]
    faces: Int64[np.ndarray, "F 3"]
    meshing: Meshing | None = None
    step: Step = NO_STEP
    classes: UInt8[np.ndarray, " F"] = field(default_factory=NO_CLASSES.copy)

    def __post_init__(self) -> None:
        """Check what Open3D does not, which accepts indices out of range, and fill in the classes."""
        object.__setattr__(self, "classes", classes_of(self.faces, self.classes))
        if len(self.faces) == 0:
            raise SceneError("the shell has no triangles")
        if self.faces.min() < 0 or self.faces.max() >= len(self.vertices):
            raise SceneError(f"the shell's triangles have vertex indices outside its {len(self.vertices)} vertices")
        if not np.isfinite(self.vertices).all():
            raise SceneError("the shell has NaN or infinite vertices")
        if without_area(self.vertices, self.faces).all():
            raise SceneError("all triangles of the shell are degenerate: their areas are 0")

    @property
    def bounds(self) -> Float64[np.ndarray, "2 3"]:
        """Lowest and highest corner of the bounding box."""
        return np.stack([self.vertices.min(0), self.vertices.max(0)])

    @property
    def centre(self) -> Float64[np.ndarray, " 3"]:
        """Median vertex. What is in float32 is relative to it, so that no vertex far away costs the others theirs."""
        return np.median(self.vertices, axis=0)


def without_area(vertices: Float64[np.ndarray, "V 3"], faces: Int64[np.ndarray, "F 3"]) -> Bool[np.ndarray, " F"]:
    """Mask of the triangles that have no area in single precision, in which rays are cast and distances measured.

    Their normals are not defined, and their points nearest to another are NaN. Their heights are within the rounding of
    their own corners, relative to the median vertex: a vertex far away makes no other triangle flat.
    """
    placed = (vertices - np.median(vertices, axis=0)).astype(np.float32)
    step = np.spacing(np.abs(placed[faces]).max(axis=(1, 2))).astype(np.float64)
    placed = placed.astype(np.float64)
    a, b, c = placed[faces].transpose(1, 0, 2)
    longest = np.sqrt(np.max([((a - b) ** 2).sum(1), ((b - c) ** 2).sum(1), ((c - a) ** 2).sum(1)], axis=0))
    return np.linalg.norm(area_vectors(placed, faces), axis=1) <= step * longest  # area = height * longest / 2


def load_shell(
    path: Path,
    *,
    surface: Geometry | Cloud | None = None,
    cache: Path | None = None,
    cameras: Sequence[Camera] = (),
    mesher: Mesher = "planes",
    spacing: float | None = None,
    metres_per_unit: float = 1.0,
) -> ShellMesh:
    """Load a shell, a triangle mesh or a point cloud, in double precision if the file has it.

    Points and vertices that are NaN, infinite or absurdly far away are dropped, with their triangles, as are triangles
    without area; what is dropped is counted. Vertices of no triangle are dropped. A point cloud is merged by
    :func:`~shellgs_method.shell.spacing.as_seen` and meshed by :func:`~shellgs_method.shell.clouds.mesh_cloud`; its
    mesh is cached as ``<cache>/<file name>.<mesher>.ply`` until the cloud changes, or cameras see other parts of it.

    Args:
        path: a mesh (ply, obj, glb, gltf, stl, off), a building's model (ifc, gml, json; IFC needs the extra ``bim``)
            or a cloud (ply, pcd, xyz, xyzrgb, pts, ptx, txt, asc, csv, las, laz, e57; the last three need the extras
            ``las`` and ``e57``).
        surface: what the file holds, if it was read already.
        cache: folder for the mesh of a point cloud; None for no cache.
        cameras: cameras that see the surface, in the shell's frame and unit. Where they see a large cloud, it is meshed
            as finely as they resolve. They orient the normals of a cloud whose file has no scanner positions.
        mesher: method that meshes a point cloud.
        spacing: size of the voxels in which a point cloud is merged, in metres; None for what the cameras resolve.
        metres_per_unit: 1 for a shell in metres.

    Raises:
        FileNotFoundError: the file does not exist.
        SceneError: the file is empty or damaged, its reader is not installed, it holds no surface, or its coordinates
            were rounded by decimetres.
    """
    path = Path(path)
    cached = None if cache is None else cache / f"{path.name}.{mesher}.ply"
    if cached is not None and path.is_file() and (mesh := _read_cached(cached, path, cameras, spacing)):
        refuse_coarse(mesh.step.scaled(metres_per_unit), f"the coordinates of {path}")
        return mesh
    surface = surface or read_surface(path)
    try:
        if isinstance(surface, Geometry):
            used = _referenced(surface.vertices, surface.faces)
            usable = _without_outliers(*used, path)
            near = _referenced(used[0], used[1][usable])
            mesh = ShellMesh(*near, classes=surface.classes[usable])
            step = NO_STEP if surface.drawn else mesh_step(mesh.vertices, mesh.faces)
            refuse_coarse(step.scaled(metres_per_unit), "the coordinates")
            return replace(_with_area(mesh, path), step=step)
        whole = surface.whole
        step = cloud_step(whole.sample)
        refuse_coarse(step.scaled(metres_per_unit), "the coordinates")
        sights = Sights.of(cameras, whole.points) if cameras and len(whole.points) else None
        cloud = as_seen(surface, sights, spacing and spacing / metres_per_unit, metres_per_unit)
        viewpoints = whole.scanners if len(whole.scanners) else positions(cameras)
        mesh = _with_area(ShellMesh(*mesh_cloud(cloud, viewpoints, mesher), step))
    except SceneError as error:
        raise error if str(path) in str(error) else SceneError(f"{path}: {error}") from error
    if cached is not None:
        _write_cached(mesh, cached, path, {"spacing": spacing, "sights": sights.to_json() if sights else []})
    return mesh


def _write_cached(mesh: ShellMesh, cached: Path, source: Path, made_for: dict[str, Any]) -> None:
    """Write the mesh as a PLY of doubles, with a comment that identifies its source and what it was made for."""
    assert mesh.meshing is not None
    source_record = {"version": VERSION, "sha256": content_hash(source), "meshing": asdict(mesh.meshing)}
    step = {"lengths": mesh.step.lengths.tolist(), "rounded": mesh.step.rounded}
    record = json.dumps(source_record | made_for | {"step": step})
    faces = np.empty(len(mesh.faces), [("count", "u1"), ("indices", "<i4", 3)])
    faces["count"], faces["indices"] = 3, mesh.faces
    header = ["ply", "format binary_little_endian 1.0", COMMENT + record, f"element vertex {len(mesh.vertices)}"]
    header += [*(f"property double {axis}" for axis in "xyz"), f"element face {len(faces)}"]
    header += ["property list uchar int vertex_indices", "end_header\n"]
    cached.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(cached) as file:
        file.write("\n".join(header).encode() + mesh.vertices.astype("<f8").tobytes() + faces.tobytes())


def _read_cached(cached: Path, source: Path, cameras: Sequence[Camera], spacing: float | None) -> ShellMesh | None:
    """Read a cached mesh; None if it is damaged, or was made from another cloud, or for other cameras or spacing."""
    try:
        with cached.open("rb") as file:
            comment = [file.readline(1 << 20).decode(errors="replace") for _ in range(3)][2]
        record = json.loads(comment.removeprefix(COMMENT))
        if (record["version"], record["sha256"], record["spacing"]) != (VERSION, content_hash(source), spacing):
            return None
        if cameras and not Sights.from_json(record["sights"]).covers(Sights.of(cameras, NO_POINTS)):
            return None
        geometry = read_geometry(cached)
        step = Step(np.array(record["step"]["lengths"], np.float64), record["step"]["rounded"])
        return ShellMesh(geometry.vertices, geometry.faces, Meshing(**record["meshing"]), step)
    except (OSError, IndexError, KeyError, TypeError, ValueError):  # missing or damaged: it is made again
        return None


def _without_outliers(vertices: np.ndarray, faces: np.ndarray, path: Path) -> Bool[np.ndarray, " F"]:
    """Mask of the triangles all of whose vertices are finite and not absurdly far away."""
    kept = inliers(vertices, _FAR)
    if kept.all() or len(faces) == 0 or faces.max() >= len(vertices) or faces.min() < 0:
        return np.ones(len(faces), bool)
    usable = kept[faces].all(axis=1)
    if not usable.any():
        raise SceneError("every triangle of the shell has a NaN or infinite vertex")
    place = " ".join(f"{value:g}" for value in vertices[~kept][0])
    notice(
        f"{path}: dropped {(~usable).sum()} of {len(faces)} triangles with a NaN or infinite vertex, or one absurdly "
        f"far away, at {place}."
    )
    return usable


def _referenced(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Drop vertices of no triangle; indices that are out of range are left for :class:`ShellMesh` to refuse."""
    if len(faces) == 0 or faces.min() < 0 or faces.max() >= len(vertices):
        return vertices, faces
    used = np.zeros(len(vertices), bool)
    used[faces] = True
    return vertices[used], (np.cumsum(used) - 1)[faces]


def _with_area(mesh: ShellMesh, path: Path | None = None) -> ShellMesh:
    """Drop triangles without area; those of a file are counted, those that a mesher leaves are nobody's loss."""
    flat = without_area(mesh.vertices, mesh.faces)
    if not flat.any():
        return mesh
    if path is not None:
        notice(f"{path}: dropped {flat.sum()} of {len(flat)} triangles, which have no area.")
    vertices, faces = _referenced(mesh.vertices, mesh.faces[~flat])
    return replace(mesh, vertices=vertices, faces=faces, classes=mesh.classes[~flat])
