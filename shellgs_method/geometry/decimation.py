"""Decimate triangles by quadric error (Garland and Heckbert 1997)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from shellgs_method.errors import SceneError
from shellgs_method.geometry.triangles import Triangles
from shellgs_method.machine.open3d import import_open3d

if TYPE_CHECKING:
    import trimesh


MOST = 250_000
"""Triangles above which vertices are merged in voxels first: collapsing a plane of 500 000 took Open3D minutes."""


def decimated(surface: Triangles, faces: int) -> Triangles:
    """About ``faces`` triangles of a surface; the surface itself if it has no more."""
    if len(surface.faces) <= faces:
        return surface
    mesh = _open3d_mesh(surface.vertices, surface.faces).remove_duplicated_vertices()
    if len(surface.faces) > max(MOST, faces):
        o3d = import_open3d()
        voxel = float(np.sqrt(4 * surface.areas.sum() / max(MOST, 4 * faces)))
        mesh = mesh.simplify_vertex_clustering(voxel, o3d.geometry.SimplificationContraction.Quadric)
    mesh = mesh.simplify_quadric_decimation(faces)
    return Triangles(np.asarray(mesh.vertices), np.asarray(mesh.triangles))


def decimated_mesh(mesh: trimesh.Trimesh, faces: int) -> trimesh.Trimesh:
    """The same of a mesh with its colours and metadata.

    Raises:
        SceneError: no triangle is left.
    """
    import trimesh

    if len(mesh.faces) <= faces:
        return mesh
    dense = _open3d_mesh(mesh.vertices, mesh.faces)
    dense.vertex_colors = import_open3d().utility.Vector3dVector(mesh.visual.vertex_colors[:, :3] / 255)  # pyright: ignore
    sparse = dense.simplify_quadric_decimation(max(faces, 0))
    if len(sparse.triangles) == 0:
        raise SceneError(f"nothing is left of a mesh of {len(mesh.faces)} triangles decimated to {faces}")
    colours = np.round(255 * np.asarray(sparse.vertex_colors)).clip(0, 255).astype(np.uint8)
    corners, triangles = np.asarray(sparse.vertices), np.asarray(sparse.triangles)
    return trimesh.Trimesh(corners, triangles, vertex_colors=colours, process=False, metadata=mesh.metadata)


def _open3d_mesh(vertices: np.ndarray, faces: np.ndarray):
    o3d = import_open3d()
    return o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(vertices), o3d.utility.Vector3iVector(faces.astype(np.int32))
    )
