"""Mesh files: ply, obj, glb, and USD with a static collider for physics engines."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from shellgs_method.errors import SceneError, check_output
from shellgs_method.export.frame import Frame
from shellgs_method.files.atomic import atomic_write, unfinished
from shellgs_method.machine.extras import import_extra

if TYPE_CHECKING:
    import trimesh

USD_FORMATS = (".usd", ".usda", ".usdc")
Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""Turns z-up coordinates into y-up ones."""
MESH_FORMATS = (".ply", ".obj", ".glb", *USD_FORMATS)
METRE_FORMATS = (".glb", *USD_FORMATS)
"""Formats whose unit is the metre, even if it is unknown: glTF by its specification, USD by :func:`set_unit`."""


def check_mesh_format(path: Path) -> None:
    """Refuse an output that cannot be written, before hours of work.

    Raises:
        SceneError: the format is none of :data:`MESH_FORMATS`, its library is missing, or the path is not writable.
    """
    if path.suffix.lower() not in MESH_FORMATS:
        raise SceneError(f"{path}: a mesh can be written as {', '.join(MESH_FORMATS)}")
    if path.suffix.lower() in USD_FORMATS:
        _usd_modules(path)
    check_output(path)


def write_mesh(path: Path, mesh: trimesh.Trimesh, frame: Frame, facts: dict | None = None) -> None:
    """Write a mesh, and beside it (``.json``) its frame, the offset of georeferenced coordinates, and ``facts``.

    glTF is y-up and in metres by its specification, so coordinates are rotated for it; USD states its up axis and unit;
    ply and obj state neither. Coordinates in the files are float32, which is why the frame is near the facade.
    """
    check_mesh_format(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    format, turned = path.suffix.lower(), path.suffix.lower() == ".glb" and frame.up == "z"
    if format in USD_FORMATS:
        _write_usd(path, mesh, frame)
    else:
        placed = mesh.copy().apply_transform(Y_UP) if turned else mesh
        content: Any = placed.export(file_type=format[1:])
        with atomic_write(path) as file:
            file.write(content.encode() if isinstance(content, str) else content)
    about = {"up_in_file": "y" if turned else frame.up, "faces": len(mesh.faces)}
    about |= {"unit_in_file": "metre"} if format in METRE_FORMATS else {}
    frame.describe(path, about | mesh.metadata | (facts or {}))


def set_unit(UsdGeom: Any, stage: Any, metric: bool) -> None:
    """State the metre as the unit of a USD stage, and in its comment whether it is unknown.

    Every reader takes a stage that states none for centimetres.
    """
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    if not metric:
        stage.GetRootLayer().comment = "The unit is unknown: metersPerUnit is 1 because a stage must state it."


def _usd_modules(path: Path) -> tuple[Any, ...]:
    names = "Usd", "UsdGeom", "UsdPhysics", "Vt"
    return tuple(import_extra(f"pxr.{name}", "usd-core", "usd", f"{path}: USD") for name in names)


def _write_usd(path: Path, mesh: trimesh.Trimesh, frame: Frame) -> None:
    """Write a stage whose default prim is a static collider made of the triangles themselves.

    A convex hull, the default of physics engines, would close the windows and doors.
    """
    Usd, UsdGeom, UsdPhysics, Vt = _usd_modules(path)
    temporary = unfinished(path, path.suffix)
    try:
        stage = Usd.Stage.CreateNew(str(temporary))
        UsdGeom.SetStageUpAxis(stage, frame.up.upper())
        set_unit(UsdGeom, stage, frame.metric)
        prim = UsdGeom.Mesh.Define(stage, "/facade")
        stage.SetDefaultPrim(prim.GetPrim())
        points = np.ascontiguousarray(mesh.vertices, dtype=np.float32)
        prim.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
        prim.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(mesh.faces), 3, np.int32)))
        prim.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(mesh.faces.astype(np.int32).ravel()))
        prim.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([points.min(0), points.max(0)])))
        prim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        prim.CreateDoubleSidedAttr(True)
        colours = np.ascontiguousarray(mesh.visual.vertex_colors[:, :3] / 255, dtype=np.float32)  # pyright: ignore
        prim.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex).Set(Vt.Vec3fArray.FromNumpy(colours))
        UsdPhysics.CollisionAPI.Apply(prim.GetPrim())
        collider = UsdPhysics.MeshCollisionAPI.Apply(prim.GetPrim())
        collider.CreateApproximationAttr(UsdPhysics.Tokens.none)
        stage.GetRootLayer().Save()
        os.replace(temporary, path)
    except RuntimeError as error:  # pxr's, whose message says little
        raise SceneError(f"{path} cannot be written: is there room on the disk? ({str(error)[:200]})") from error
    finally:
        temporary.unlink(missing_ok=True)
