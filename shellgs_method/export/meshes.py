"""Mesh files: ply, obj, glb, and USD with a static collider for physics engines."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from jaxtyping import Float32

from shellgs_method.errors import SceneError, check_output
from shellgs_method.export.frame import Frame
from shellgs_method.files.atomic import write_whole
from shellgs_method.files.transfer import linear_of
from shellgs_method.files.usd import USD_FORMATS, add_mesh, import_pxr, make_collider, new_stage
from shellgs_method.geometry.axes import name_of, turn
from shellgs_method.geometry.similarity import affine

if TYPE_CHECKING:
    import trimesh

MESH_FORMATS = (".ply", ".obj", ".glb", *USD_FORMATS)
METRE_FORMATS = (".glb", *USD_FORMATS)
"""Formats whose unit is the metre, even if it is unknown: glTF by its specification, USD as its readers need it."""


def check_mesh_format(path: Path) -> None:
    """Refuse an output that cannot be written, before hours of work.

    Raises:
        SceneError: the format is none of :data:`MESH_FORMATS`, its library is missing, or the path is not writable.
    """
    if path.suffix.lower() not in MESH_FORMATS:
        raise SceneError(f"{path}: a mesh can be written as {', '.join(MESH_FORMATS)}")
    if path.suffix.lower() in USD_FORMATS:
        import_pxr("usd", f"{path}: USD")
    check_output(path)


def write_mesh(path: Path, mesh: trimesh.Trimesh, frame: Frame, facts: dict | None = None) -> None:
    """Write a mesh, and beside it (``.json``) its frame, the offset of georeferenced coordinates, and ``facts``.

    glTF is y-up and in metres by its specification, so coordinates are rotated for it; USD states its up axis, y or z,
    and its unit; ply and obj state neither. Colours of glTF and USD are linear light, those of ply and obj sRGB.
    Coordinates in the files are float32, which is why the frame is near the facade.
    """
    check_mesh_format(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    format, up = path.suffix.lower(), frame.up
    stated = {".glb": ("y",), **dict.fromkeys(USD_FORMATS, ("y", "z"))}.get(format)
    if stated and name_of(up) not in stated:
        to = np.eye(3)["xyz".index(stated[-1])]
        mesh, up = mesh.copy().apply_transform(affine(turn(up, to))), to
    if format in USD_FORMATS:
        _write_usd(path, mesh, "y" if name_of(up) == "y" else "z", frame.metric)
    else:
        content: Any = _glb(mesh) if format == ".glb" else mesh.export(file_type=format[1:])
        write_whole(path, content)
    about = {"up_in_file": name_of(up), "faces": len(mesh.faces)}
    about |= {"unit_in_file": "metre"} if format in METRE_FORMATS else {}
    frame.describe(Path(f"{path}.json"), about | mesh.metadata | (facts or {}))


def _glb(mesh: trimesh.Trimesh) -> bytes:
    """Binary glTF, whose colours are linear light, and whose material is metal where none is given."""
    import trimesh

    plain = trimesh.Trimesh(mesh.vertices, mesh.faces, metadata=mesh.metadata, process=False)
    plain.vertex_attributes["_COLOR_0"] = _linear_colours(mesh)  # as float32: bytes would show steps where it is dark

    def finish(tree: dict) -> None:
        tree["materials"] = [
            {"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0}, "doubleSided": True}
        ]
        for primitive in (each for one in tree["meshes"] for each in one["primitives"]):
            primitive["material"] = 0
            primitive["attributes"]["COLOR_0"] = primitive["attributes"].pop("_COLOR_0")

    content = plain.export(file_type="glb", tree_postprocessor=finish)
    assert isinstance(content, bytes)
    return content


def _linear_colours(mesh: trimesh.Trimesh) -> Float32[np.ndarray, "V 3"]:
    colours = mesh.visual.vertex_colors[:, :3]  # pyright: ignore
    return np.ascontiguousarray(linear_of(colours / 255), dtype=np.float32)


def _write_usd(path: Path, mesh: trimesh.Trimesh, up: Literal["y", "z"], metric: bool) -> None:
    """Write a stage whose default prim is a static collider made of the triangles themselves.

    A convex hull would close the windows and doors.
    """
    pxr = import_pxr("usd", f"{path}: USD")
    with new_stage(pxr, path, up, metric) as stage:
        prim = add_mesh(pxr, stage, "/facade", np.asarray(mesh.vertices), np.asarray(mesh.faces))
        prim.CreateDoubleSidedAttr(True)
        colours = pxr.Vt.Vec3fArray.FromNumpy(_linear_colours(mesh))
        prim.CreateDisplayColorPrimvar(pxr.UsdGeom.Tokens.vertex).Set(colours)
        make_collider(pxr, prim, "none")
