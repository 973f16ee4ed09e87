"""Read meshes and point clouds from files, in double precision."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from shellgs_method.errors import SceneError
from shellgs_method.files.readers.contents import Geometry, left_out, splats
from shellgs_method.files.readers.gltf import read_gltf
from shellgs_method.files.readers.meshes import read_obj, read_off, read_stl
from shellgs_method.files.readers.pcd import read_pcd
from shellgs_method.files.readers.ply import read_ply
from shellgs_method.files.readers.scans import read_e57, read_las
from shellgs_method.files.readers.text_clouds import read_text_cloud
from shellgs_method.machine.open3d import reason

READERS: dict[str, Callable[[Path], Geometry]] = {
    ".ply": read_ply,
    ".obj": read_obj,
    **dict.fromkeys((".glb", ".gltf"), read_gltf),
    ".stl": read_stl,
    ".off": read_off,
    ".pcd": read_pcd,
    **dict.fromkeys((".xyz", ".pts", ".txt", ".asc", ".csv"), read_text_cloud),
    **dict.fromkeys((".las", ".laz"), read_las),
    ".e57": read_e57,
}
SPLATS = (".splat", ".ksplat", ".spz", ".sog", ".sogs")
"""Suffixes of formats that hold Gaussian splats only."""


def usual_up(shell: str) -> Float64[np.ndarray, " 3"]:
    """The direction upwards in a shell's file where cameras do not tell: y in glTF, by that format's rule, else z."""
    return np.eye(3)[1 if shell.lower().endswith((".glb", ".gltf")) else 2]


def read_geometry(path: Path) -> Geometry:
    """Read all triangles or points of a file, in the precision it stores.

    What a file holds beside them, or marks as no part of the surface, is left out, with a warning that counts it.

    Raises:
        FileNotFoundError: the file does not exist.
        SceneError: the file is empty, damaged, of an unknown format or holds splats, or its reader is not installed.
    """
    if not path.is_file():
        raise FileNotFoundError(f"the shell {path} does not exist")
    if path.stat().st_size == 0:
        raise SceneError(f"the shell {path} is an empty file: export it again")
    suffix = path.suffix.lower()
    if suffix in SPLATS:
        raise splats(path)
    read = READERS.get(suffix)
    if read is None:
        raise SceneError(
            f"the shell {path} is neither a mesh nor a point cloud that can be read: export it as one of "
            f"{', '.join(READERS)}"
        )
    try:
        geometry = read(path)
    except SceneError:
        raise
    except Exception as error:  # each format's reader raises errors of its own for a damaged file
        raise SceneError(f"the shell {path} cannot be read, it may be cut off or damaged ({reason(error)})") from error
    return geometry if len(geometry.faces) else _without_misses(geometry, path)


def _without_misses(cloud: Geometry, path: Path) -> Geometry:
    """Drop what scanners write where a ray hit nothing: points at exactly 0 0 0, which may be far from all others.

    One among the others is taken for a point of the surface.
    """
    missed = ~cloud.vertices.any(axis=1)
    others = cloud.vertices[~missed]
    among = len(others) and (np.nanmin(others, axis=0) <= 0).all() and (np.nanmax(others, axis=0) >= 0).all()
    if not missed.any() or (missed.sum() == 1 and among):
        return cloud
    left_out(path, int(missed.sum()), len(missed), "points at exactly 0 0 0, which are misses of the scanner")
    return replace(cloud, vertices=others)
