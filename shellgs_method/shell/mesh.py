"""The shell as a triangle mesh, read from the file it came in."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64

from dataparsers.errors import SceneError

log = logging.getLogger(__name__)

FORMATS = (".ply", ".obj", ".glb", ".gltf", ".stl", ".off")


@dataclass(frozen=True)
class ShellMesh:
    """A triangle mesh with at least one triangle, finite vertices and indices in range.

    Attributes:
        vertices: in the shell's own frame and units, georeferenced as they came.
        faces: three vertex indices for each triangle.

    Raises:
        SceneError: the arrays make no such mesh.
    """

    vertices: Float64[np.ndarray, "V 3"]
    faces: Int64[np.ndarray, "F 3"]

    def __post_init__(self) -> None:
        """Check what Open3D does not: it reads out of range indices without a word."""
        if len(self.faces) == 0:
            raise SceneError("the shell has no triangles")
        if self.faces.min() < 0 or self.faces.max() >= len(self.vertices):
            raise SceneError(f"the shell's triangles refer to vertices beyond the {len(self.vertices)} there are")
        if not np.isfinite(self.vertices).all():
            raise SceneError("the shell has NaN or infinite vertices")
        if not self._areas().any():
            raise SceneError("all triangles of the shell are degenerate: none has an area")

    @property
    def bounds(self) -> Float64[np.ndarray, "2 3"]:
        """Lowest and highest corner of the box around the vertices."""
        return np.stack([self.vertices.min(0), self.vertices.max(0)])

    def _areas(self) -> np.ndarray:
        """Area of each triangle relative to the shell's size squared; 0 where it is no more than rounding."""
        extent = np.ptp(self.bounds, axis=0).max()
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2 / max(extent, np.finfo(float).tiny) ** 2
        return np.where(areas > 1e-14, areas, 0.0)


def load_shell(path: Path) -> ShellMesh:
    """Read a shell mesh (ply, obj, glb, gltf, stl, off) in full double precision where the file has it.

    Triangles with a NaN or infinite vertex are dropped, and the number of them is logged.

    Raises:
        FileNotFoundError: there is no such file.
        SceneError: the file is empty, damaged, a point cloud, or holds no usable triangle.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"the shell {path} does not exist")
    if path.stat().st_size == 0:
        raise SceneError(f"the shell {path} is an empty file: export it again")
    if path.suffix.lower() not in FORMATS:
        raise SceneError(f"the shell {path} is no mesh file that can be read: export it as one of {', '.join(FORMATS)}")
    vertices, faces = _read(path)
    if len(faces) == 0 and len(vertices) > 0:
        raise SceneError(f"the shell {path} is a point cloud ({len(vertices)} points): a triangle mesh is needed here")
    try:
        mesh = ShellMesh(*_without_nan(vertices, faces, path))
    except SceneError as error:
        raise SceneError(f"{path}: {error}") from error
    _warn_of_float32(mesh, path)
    return mesh


def _read(path: Path) -> tuple[Float64[np.ndarray, "V 3"], Int64[np.ndarray, "F 3"]]:
    """All triangles of a file, the nodes of a scene graph placed and joined."""
    import trimesh

    try:
        # process=False: merging vertices would round them. trimesh, unlike Open3D's tensor reader, keeps doubles.
        loaded = trimesh.load(path, process=False, skip_materials=True)
    except Exception as error:  # each format's reader has its own kinds of error for a damaged file
        raise SceneError(f"the shell {path} cannot be read, it may be cut off or damaged ({error})") from error
    scene = loaded if isinstance(loaded, trimesh.Scene) else trimesh.Scene(loaded)
    vertices, faces, count = [np.empty((0, 3))], [np.empty((0, 3), np.int64)], 0
    for node in scene.graph.nodes_geometry:
        pose, name = scene.graph[node]
        geometry = scene.geometry[name]
        points = np.asarray(geometry.vertices, np.float64)  # pyright: ignore[reportAttributeAccessIssue]
        vertices.append(trimesh.transform_points(points, pose))
        faces.append(np.asarray(getattr(geometry, "faces", faces[0]), np.int64) + count)  # a point cloud has none
        count += len(points)
    return np.concatenate(vertices), np.concatenate(faces)


def _without_nan(vertices: np.ndarray, faces: np.ndarray, path: Path) -> tuple[np.ndarray, np.ndarray]:
    """The mesh without the triangles that touch a NaN or infinite vertex."""
    finite = np.isfinite(vertices).all(axis=1)
    if finite.all() or len(faces) == 0 or faces.max() >= len(vertices) or faces.min() < 0:
        return vertices, faces
    usable = finite[faces].all(axis=1)
    if not usable.any():
        raise SceneError("every triangle of the shell has a NaN or infinite vertex")
    log.warning("%s: dropped %d of %d triangles with a NaN or infinite vertex", path, (~usable).sum(), len(faces))
    renumbered = np.cumsum(finite) - 1
    return vertices[finite], renumbered[faces[usable]]


def _warn_of_float32(mesh: ShellMesh, path: Path) -> None:
    """Georeferenced coordinates that a file stores as float32 were rounded before we could read them."""
    single = mesh.vertices.astype(np.float32)
    step = float(np.spacing(np.abs(single).max()))
    extent = np.ptp(mesh.bounds, axis=0).max()
    if step > 1e-4 * extent and np.array_equal(single, mesh.vertices):
        log.warning(
            "%s stores large coordinates in single precision, in steps of %.2g units: export the shell as double "
            "precision PLY or OBJ, or move it near the origin first",
            path,
            step,
        )
