"""Read meshes, building models and point clouds from files, in double precision."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from shellgs_method.errors import SceneError
from shellgs_method.files.clouds import Cloud, damaged
from shellgs_method.files.readers.citygml import read_citygml
from shellgs_method.files.readers.cityjson import read_cityjson
from shellgs_method.files.readers.contents import Geometry, splats
from shellgs_method.files.readers.gltf import read_gltf
from shellgs_method.files.readers.ifc import read_ifc
from shellgs_method.files.readers.meshes import read_obj, read_off, read_stl
from shellgs_method.files.readers.pcd import read_pcd
from shellgs_method.files.readers.ply import holds_splats, ply_points, read_ply
from shellgs_method.files.readers.points import NO_POINTS, Points
from shellgs_method.files.readers.scans import read_e57, read_las
from shellgs_method.files.readers.text_clouds import read_ptx, read_text_cloud

MESHES: dict[str, Callable[[Path], Geometry]] = {
    ".ply": read_ply,
    ".obj": read_obj,
    **dict.fromkeys((".glb", ".gltf"), read_gltf),
    ".stl": read_stl,
    ".off": read_off,
    **dict.fromkeys((".ifc", ".ifczip"), read_ifc),
    **dict.fromkeys((".gml", ".citygml", ".xml"), read_citygml),
    **dict.fromkeys((".json", ".cityjson", ".jsonl"), read_cityjson),
}
CLOUDS: dict[str, Callable[[Path], Iterator[Points]]] = {
    ".pcd": read_pcd,
    **dict.fromkeys((".xyz", ".xyzrgb", ".pts", ".txt", ".asc", ".csv"), read_text_cloud),
    ".ptx": read_ptx,
    **dict.fromkeys((".las", ".laz"), read_las),
    ".e57": read_e57,
}
COLOURED: dict[str, Callable[[Path], Iterator[Points]]] = {
    **dict.fromkeys((".las", ".laz"), partial(read_las, coloured=True)),
    ".e57": partial(read_e57, coloured=True),
}
SPLATS = (".splat", ".ksplat", ".spz", ".sog", ".sogs")
"""Suffixes of formats that hold Gaussian splats only."""


def usual_up(shells: Sequence[str]) -> Float64[np.ndarray, " 3"]:
    """Up in a shell's files, if cameras do not determine it: y in glTF, by definition of that format, else z."""
    return np.eye(3)[1 if all(shell.lower().endswith((".glb", ".gltf")) for shell in shells) else 2]


def read_surface(path: Path) -> Geometry | Cloud:
    """Read all triangles of a file, in the precision it stores; or open a point cloud, whose points are not yet read.

    What a file holds beside them, or marks as no part of the surface, is left out, with a warning that counts it.

    Raises:
        FileNotFoundError: the file does not exist.
        SceneError: the file is empty, damaged, of an unknown format or holds splats, or its reader is not installed.
    """
    if not path.is_file():
        problem = "is a folder: give the files in it" if path.is_dir() else "does not exist"
        raise FileNotFoundError(f"the shell {path} {problem}")
    if path.stat().st_size == 0:
        raise SceneError(f"the shell {path} is an empty file: export it again")
    suffix = path.suffix.lower()
    if suffix in SPLATS:
        raise splats(path)
    if suffix in CLOUDS:
        return Cloud(path, CLOUDS[suffix], COLOURED.get(suffix))
    read = MESHES.get(suffix)
    if read is None:
        raise SceneError(
            f"the shell {path} is neither a mesh, a building's model nor a point cloud that can be read: unpack it, "
            f"or export it in a local or national system as one of {', '.join([*MESHES, *CLOUDS])}"
        )
    try:
        if suffix == ".ply" and holds_splats(path):
            raise splats(path)
        if suffix == ".ply" and ply_points(path) is not None:
            return Cloud(path, ply_points, partial(ply_points, coloured=True))
        geometry = read(path)
    except SceneError:
        raise
    except Exception as error:  # each format's reader raises errors of its own for a damaged file
        raise damaged(path, error) from error
    if len(geometry.faces) or not len(geometry.vertices):
        return geometry
    return Cloud(path, lambda _: iter([Points(geometry.vertices, colours=geometry.colours)]))


def read_geometry(path: Path) -> Geometry:
    """All triangles or points of a file at once; see :func:`read_surface`.

    Raises:
        FileNotFoundError: the file does not exist.
        SceneError: as :func:`read_surface`.
    """
    surface = read_surface(path)
    if isinstance(surface, Geometry):
        return surface
    pieces = [Points(NO_POINTS), *surface]
    positions, scanners = ([getattr(piece, name) for piece in pieces] for name in ("positions", "scanners"))
    return Geometry(np.concatenate(positions), scanners=np.concatenate(scanners))
