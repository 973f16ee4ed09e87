"""Load the shell's files as one triangle mesh; what takes long, clouds and IFC models, is done once and cached."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, replace
from itertools import combinations
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from jaxtyping import Bool

from shellgs_method.errors import SceneError, notice
from shellgs_method.files.atomic import atomic_write, content_hash, write_whole
from shellgs_method.files.clouds import Cloud
from shellgs_method.files.readers.contents import Geometry, refuse_degrees
from shellgs_method.files.readers.points import NO_POINTS
from shellgs_method.files.surfaces import read_geometry, read_surface
from shellgs_method.geometry.camera import Camera, positions
from shellgs_method.geometry.outliers import inliers
from shellgs_method.geometry.precision import NO_STEP, Step, cloud_step, mesh_step, refuse_coarse
from shellgs_method.geometry.triangles import referenced
from shellgs_method.shell.clouds import VERSION, Mesher, Meshing, mesh_cloud
from shellgs_method.shell.mesh import ShellMesh, joined, without_area
from shellgs_method.shell.spacing import Sights, as_seen

COMMENT = "comment shellgs "
_SLOW = (".ifc", ".ifczip")
"""Suffixes of models whose solids are cut and triangulated, two seconds for each megabyte."""
_READER = 7
"""Version of their reader: they are read again if it changes."""
_FAR = 1e4
"""Times the median distance from the median vertex beyond which a vertex is not the building's, but at the origin of
national coordinates, for example. It would stretch every box and take most of the area."""


def load_shell(
    *paths: Path,
    surfaces: Sequence[Geometry | Cloud] = (),
    cache: Path | None = None,
    cameras: Sequence[Camera] = (),
    mesher: Mesher = "planes",
    spacing: float | None = None,
    metres_per_unit: float = 1.0,
) -> ShellMesh:
    """Load a shell from its files, triangle meshes and point clouds, in double precision if they have it.

    Points and vertices that are NaN, infinite or absurdly far away are dropped, with their triangles, as are triangles
    without area; what is dropped is counted. Vertices of no triangle are dropped. A point cloud is merged by
    :func:`~shellgs_method.shell.spacing.as_seen` and meshed by :func:`~shellgs_method.shell.clouds.mesh_cloud`; its
    mesh is cached as ``<cache>/<file name>.<mesher>.ply`` until the cloud changes, or cameras see other parts of it.
    So is what is read of an IFC model, as ``<cache>/<file name>.npz``.
    Several files are in one frame, and their triangles are one mesh: see :func:`~shellgs_method.shell.mesh.joined`.

    Args:
        paths: the files, each a mesh (ply, obj, glb, gltf, stl, off), a building's model (ifc, gml, json; IFC needs the
            extra ``bim``) or a cloud (ply, pcd, xyz, xyzrgb, pts, ptx, txt, asc, csv, las, laz, e57; the last three
            need the extras ``las`` and ``e57``).
        surfaces: what the files hold, if they were read already.
        cache: folder for what is cached; None for no cache.
        cameras: cameras that see the surface, in the shell's frame and unit. Where they see a large cloud, it is meshed
            as finely as they resolve. They orient the normals of a cloud whose file has no scanner positions.
        mesher: method that meshes a point cloud.
        spacing: size of the voxels in which a point cloud is merged, in metres; None for what the cameras resolve.
        metres_per_unit: 1 for a shell in metres.

    Raises:
        FileNotFoundError: a file does not exist.
        SceneError: a file is empty or damaged, its reader is not installed, it holds no surface, or its coordinates
            were rounded by decimetres; or a file is given twice, or is in another frame than the others.
    """
    _refuse_twice(paths)
    names = [path.name for path in paths]
    meshes = []
    for k, path in enumerate(paths):
        folder = cache / str(k + 1) if cache and path.name in names[:k] else cache  # files of one name do not share it
        cached = folder / f"{path.name}.{mesher}.ply" if folder else None
        surface = surfaces[k] if surfaces else None
        if surface is None and folder and path.suffix.lower() in _SLOW:
            surface = _read_model(path, folder / f"{path.name}.npz")
        meshes.append(_load_file(path, surface, cached, cameras, mesher, spacing, metres_per_unit))
    return joined(meshes, paths, metres_per_unit)


def _refuse_twice(paths: Sequence[Path]) -> None:
    """Refuse a file that is given twice, under whatever name.

    Raises:
        SceneError: there is one.
    """
    for one, other in combinations([path for path in paths if path.is_file()], 2):
        if one.resolve() == other.resolve():
            raise SceneError(f"{other} is given twice: give each of the shell's files once")
        if one.stat().st_size == other.stat().st_size and content_hash(one) == content_hash(other):
            raise SceneError(f"{other} is a copy of {one}: give each of the shell's files once")


def _load_file(
    path: Path,
    surface: Geometry | Cloud | None,
    cached: Path | None,
    cameras: Sequence[Camera],
    mesher: Mesher,
    spacing: float | None,
    metres_per_unit: float,
) -> ShellMesh:
    """Load one file; the mesh of a point cloud is that at ``cached``, if it is still valid."""
    spacing = spacing and spacing / metres_per_unit  # from here on in the shell's unit, as the cached mesh is
    if cached is not None and path.is_file() and (mesh := _read_cached(cached, path, cameras, spacing)):
        refuse_coarse(mesh.step.scaled(metres_per_unit), f"the coordinates of {path}")
        return mesh
    surface = surface or read_surface(path)
    try:
        if isinstance(surface, Geometry):
            used = referenced(surface.vertices, surface.faces)
            usable = _without_outliers(*used, path)
            near = referenced(used[0], used[1][usable])
            mesh = ShellMesh(*near, classes=surface.classes[usable])
            refuse_degrees(mesh.vertices, path)
            step = NO_STEP if surface.drawn else mesh_step(mesh.vertices, mesh.faces)
            refuse_coarse(step.scaled(metres_per_unit), "the coordinates")
            return replace(_with_area(mesh, path), step=step)
        whole = surface.whole
        if len(whole.sample):
            refuse_degrees(whole.sample, path)
        step = cloud_step(whole.sample)
        refuse_coarse(step.scaled(metres_per_unit), "the coordinates")
        sights = Sights.of(cameras, whole.points) if cameras and len(whole.points) else None
        cloud = as_seen(surface, sights, spacing, metres_per_unit)
        viewpoints = whole.scanners if len(whole.scanners) else positions(cameras)
        vertices, faces, meshing = mesh_cloud(cloud, viewpoints, mesher)
        mesh = _with_area(ShellMesh(vertices, faces, (meshing,), step))
    except SceneError as error:
        raise error if str(path) in str(error) else SceneError(f"{path}: {error}") from error
    if cached is not None:
        _write_cached(mesh, cached, path, {"spacing": spacing, "sights": sights.to_json() if sights else []})
    return mesh


def _read_model(path: Path, cached: Path) -> Geometry | Cloud:
    """Read a model, or what was read of it before."""
    version = f"{_READER} {content_hash(path)}" if path.is_file() else ""
    try:
        with np.load(cached, allow_pickle=False) as arrays:
            if str(arrays["version"]) == version:
                return Geometry(arrays["vertices"], arrays["faces"], classes=arrays["classes"], drawn=True)
    except (OSError, KeyError, ValueError, BadZipFile):  # missing or damaged: it is read again
        pass
    surface = read_surface(path)
    if isinstance(surface, Geometry):
        cached.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(cached) as file:
            np.savez(file, version=version, vertices=surface.vertices, faces=surface.faces, classes=surface.classes)
    return surface


def _write_cached(mesh: ShellMesh, cached: Path, source: Path, made_for: dict[str, Any]) -> None:
    """Write the mesh as a PLY of doubles, with a comment that identifies its source and what it was made for."""
    (meshing,) = mesh.meshing
    source_record = {"version": VERSION, "sha256": content_hash(source), "meshing": asdict(meshing)}
    step = {"lengths": mesh.step.lengths.tolist(), "rounded": mesh.step.rounded}
    record = json.dumps(source_record | made_for | {"step": step})
    faces = np.empty(len(mesh.faces), [("count", "u1"), ("indices", "<i4", 3)])
    faces["count"], faces["indices"] = 3, mesh.faces
    header = ["ply", "format binary_little_endian 1.0", COMMENT + record, f"element vertex {len(mesh.vertices)}"]
    header += [*(f"property double {axis}" for axis in "xyz"), f"element face {len(faces)}"]
    header += ["property list uchar int vertex_indices", "end_header\n"]
    cached.parent.mkdir(parents=True, exist_ok=True)
    write_whole(cached, "\n".join(header).encode() + mesh.vertices.astype("<f8").tobytes() + faces.tobytes())


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
        return ShellMesh(geometry.vertices, geometry.faces, (Meshing(**record["meshing"]),), step)
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


def _with_area(mesh: ShellMesh, path: Path | None = None) -> ShellMesh:
    """Drop triangles without area; those of a file are counted, those that a mesher leaves are nobody's loss."""
    flat = without_area(mesh.vertices, mesh.faces)
    if not flat.any():
        return mesh
    if path is not None:
        notice(f"{path}: dropped {flat.sum()} of {len(flat)} triangles, which have no area.")
    vertices, faces = referenced(mesh.vertices, mesh.faces[~flat])
    return replace(mesh, vertices=vertices, faces=faces, classes=mesh.classes[~flat], source=mesh.source[~flat])
