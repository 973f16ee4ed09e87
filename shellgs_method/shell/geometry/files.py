"""Read meshes and point clouds from files, in double precision."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float64, Int64

from dataparsers.errors import SceneError
from dataparsers.headers import check_las, check_ply
from shellgs_method.open3d import reason

log = logging.getLogger(__name__)

NO_FACES = np.empty((0, 3), np.int64)
NO_POINTS = np.empty((0, 3))


@dataclass(frozen=True)
class Geometry:
    """Unchecked contents of a file, in its own frame and units.

    Attributes:
        vertices: vertices of the mesh, or points of the cloud.
        faces: three vertex indices per triangle; empty for a point cloud.
        scanners: scanner positions, if the file has them.
    """

    vertices: Float64[np.ndarray, "V 3"]
    faces: Int64[np.ndarray, "F 3"]
    scanners: Float64[np.ndarray, "S 3"]


def up_axis(shell: str) -> Literal["y", "z"]:
    """The axis of a shell's file that points up: y in glTF, by that format's convention, else z."""
    return "y" if shell.lower().endswith((".glb", ".gltf")) else "z"


def read_geometry(path: Path) -> Geometry:
    """Read all triangles or points of a file, in the precision it stores.

    Raises:
        FileNotFoundError: the file does not exist.
        SceneError: the file is empty, damaged or of an unknown format, or its reader is not installed.
    """
    if not path.is_file():
        raise FileNotFoundError(f"the shell {path} does not exist")
    if path.stat().st_size == 0:
        raise SceneError(f"the shell {path} is an empty file: export it again")
    read = READERS.get(path.suffix.lower())
    if read is None:
        raise SceneError(
            f"the shell {path} is neither a mesh nor a point cloud that can be read: export it as one of "
            f"{', '.join(READERS)}"
        )
    try:
        geometry = read(path)
    except ModuleNotFoundError as error:
        extra = "e57" if path.suffix.lower() == ".e57" else "las"
        raise SceneError(f"the shell {path} needs {error.name}: run `pip install 'shellgs[{extra}]'`") from error
    except Exception as error:  # each format's reader raises errors of its own for a damaged file
        raise SceneError(f"the shell {path} cannot be read, it may be cut off or damaged ({reason(error)})") from error
    _warn_of_float32(geometry.vertices, path)
    return geometry


def _read_mesh(path: Path) -> Geometry:
    """Read a file with trimesh, and join the nodes of its scene graph, each in its place."""
    import trimesh

    if path.suffix.lower() == ".ply":
        check_ply(path)
    # process=False: merging vertices would round them. Unlike Open3D's tensor reader, trimesh keeps doubles.
    loaded = trimesh.load(path, process=False, skip_materials=True)
    scene = loaded if isinstance(loaded, trimesh.Scene) else trimesh.Scene(loaded)
    vertices, faces, count = [NO_POINTS], [NO_FACES], 0
    for node in scene.graph.nodes_geometry:
        pose, name = scene.graph[node]
        geometry = scene.geometry[name]
        points = np.asarray(geometry.vertices, np.float64)  # pyright: ignore[reportAttributeAccessIssue]
        vertices.append(trimesh.transform_points(points, pose))
        faces.append(np.asarray(getattr(geometry, "faces", NO_FACES), np.int64) + count)  # a point cloud has none
        count += len(points)
    return Geometry(np.concatenate(vertices), np.concatenate(faces), NO_POINTS)


def _read_pcd(path: Path) -> Geometry:
    from shellgs_method.open3d import import_open3d

    cloud = import_open3d().t.io.read_point_cloud(str(path))
    if "positions" not in cloud.point:
        raise ValueError("it has no points")
    return Geometry(cloud.point.positions.numpy().astype(np.float64), NO_FACES, NO_POINTS)


def _read_xyz(path: Path) -> Geometry:
    separator = "," if "," in path.open(errors="replace").readline() else None
    points = np.loadtxt(path, usecols=(0, 1, 2), comments=("#", "//"), delimiter=separator, ndmin=2)
    return Geometry(points, NO_FACES, NO_POINTS)


def _read_las(path: Path) -> Geometry:
    import laspy

    if path.suffix.lower() == ".laz":
        import lazrs  # noqa: F401  # laspy would not say which of its backends to install
    check_las(path)
    with laspy.open(path) as file:  # in chunks: points that a damaged file only claims to hold take no memory
        pieces = [np.stack([np.array(piece[x]) for x in "xyz"], axis=1) for piece in file.chunk_iterator(1_000_000)]
        claimed = file.header.point_count
    points = np.concatenate([NO_POINTS, *pieces])
    if len(points) != claimed:
        raise ValueError(f"it holds {len(points)} of {claimed} points")
    return Geometry(points, NO_FACES, NO_POINTS)


def _read_e57(path: Path) -> Geometry:
    import pye57

    file = pye57.E57(str(path))
    points, scanners = [NO_POINTS], [NO_POINTS]
    for k in range(file.scan_count):
        scan = file.read_scan(k, ignore_missing_fields=True)  # moved by the scan's pose, without invalid points
        points.append(np.stack([scan[f"cartesian{axis}"] for axis in "XYZ"], axis=1))
        header = file.get_header(k)
        if header.has_pose():
            scanners.append(np.asarray(header.translation, np.float64)[None])
    return Geometry(np.concatenate(points), NO_FACES, np.concatenate(scanners))


READERS: dict[str, Callable[[Path], Geometry]] = {
    **dict.fromkeys((".ply", ".obj", ".glb", ".gltf", ".stl", ".off"), _read_mesh),
    ".pcd": _read_pcd,
    ".xyz": _read_xyz,
    **dict.fromkeys((".las", ".laz"), _read_las),
    ".e57": _read_e57,
}


def _warn_of_float32(vertices: np.ndarray, path: Path) -> None:
    """Warn of georeferenced coordinates stored as float32: they were rounded when the file was written."""
    vertices = vertices[np.isfinite(vertices).all(axis=1)]
    if not len(vertices):
        return
    single = vertices.astype(np.float32)
    step = float(np.spacing(np.abs(single).max()))
    extent = np.ptp(vertices, axis=0).max()
    if step > 1e-4 * extent and np.array_equal(single, vertices):
        log.warning(
            "%s stores large coordinates in single precision, in steps of %.2g units: export the shell in double "
            "precision (PLY, OBJ, LAS or E57), or move it near the origin first",
            path,
            step,
        )
