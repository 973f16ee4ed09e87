"""Fuse the rendered depth of many views into a triangle mesh, by TSDF fusion (Curless and Levoy 1996)."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from shellgs_method.errors import SceneError
from shellgs_method.geometry.box import Box
from shellgs_method.geometry.camera import Camera
from shellgs_method.machine.open3d import import_open3d

if TYPE_CHECKING:
    import trimesh

TRUNCATION = 6.0
"""Truncation distance in voxels; less leaves holes, more rounds off reveals."""
MIN_VIEWS = 2
"""Minimum number of views that see a voxel."""
SPECK = 100.0
"""Minimum area of a connected component, in faces of a voxel; smaller ones are floaters."""


class DepthView(NamedTuple):
    """Depth and colours rendered from one camera, in the frame of the mesh; on the CPU."""

    depth: Float[Tensor, "H W 1"]
    """Forward z-depth, 0 where there is none."""
    rgb: Float[Tensor, "H W 3"]
    """Colours in [0, 1]."""
    camera: Camera


def fuse(views: Iterable[DepthView], box: Box, voxel: float | None = None) -> trimesh.Trimesh:
    """Fuse views into a coloured mesh of the surface inside a box.

    Open3D's ``VoxelBlockGrid`` has float32 coordinates, so the box must be near the frame's origin. (The older
    ``ScalableTSDFVolume`` of Open3D 0.20 silently returns nothing.)

    Args:
        views: rendered views, taken one at a time.
        box: box around the surface.
        voxel: voxel size; if None, a pixel's size on the surface in the first view that sees the box, but at least a
            thousandth of the box. It is stored in the mesh's ``metadata``.

    Raises:
        SceneError: no surface is left in the box, or the voxel size is not positive.
    """
    if voxel is not None and not voxel > 0:
        raise SceneError(f"a voxel cannot be {voxel} long: give a --voxel above 0")
    grid, seen = None, 0
    for view in views:
        inside = _inside(view, box)
        if not inside.any():
            continue
        if grid is None:
            pixel = (view.depth[..., 0][inside].median() / view.camera.K[0, 0]).item()
            voxel = voxel or max(pixel, box.size / 1000)
            grid = _voxel_grid(voxel)
        _integrate(grid, view, inside)
        seen += 1
    if grid is None or voxel is None:
        raise SceneError("there is no mesh: no view renders an opaque surface inside the facade's box")
    mesh = _extract(grid, min(MIN_VIEWS, seen))
    mesh.update_faces(_without_specks(mesh, SPECK * voxel**2))
    mesh.remove_unreferenced_vertices()
    if len(mesh.faces) == 0:
        raise SceneError(
            f"there is no mesh: the views have no surface in common inside the facade's box, in voxels of {voxel:.3g}; "
            "check the run in ns-viewer, or give a larger --voxel"
        )
    mesh.metadata["voxel"] = voxel
    return mesh


def decimate(mesh: trimesh.Trimesh, faces: int) -> trimesh.Trimesh:
    """Decimate a mesh to about ``faces`` triangles by quadric error (Garland and Heckbert 1997), with its colours.

    Raises:
        SceneError: no triangle is left.
    """
    import trimesh

    if len(mesh.faces) <= faces:
        return mesh
    o3d = import_open3d()
    dense = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(mesh.vertices), o3d.utility.Vector3iVector(mesh.faces.astype(np.int32))
    )
    dense.vertex_colors = o3d.utility.Vector3dVector(mesh.visual.vertex_colors[:, :3] / 255)  # pyright: ignore
    sparse = dense.simplify_quadric_decimation(max(faces, 0))
    if len(sparse.triangles) == 0:
        raise SceneError(f"nothing is left of a mesh of {len(mesh.faces)} triangles decimated to {faces}")
    colours = np.round(255 * np.asarray(sparse.vertex_colors)).clip(0, 255).astype(np.uint8)
    return trimesh.Trimesh(
        np.asarray(sparse.vertices),
        np.asarray(sparse.triangles),
        vertex_colors=colours,
        process=False,
        metadata=mesh.metadata,
    )


def _inside(view: DepthView, box: Box) -> Bool[np.ndarray, "H W"]:
    """Mask of the pixels whose depth lies in the box."""
    camera = view.camera.to(torch.float64)
    to_world = torch.linalg.inv(camera.viewmat)
    points = (view.depth.double() * camera.rays()) @ to_world[:3, :3].T + to_world[:3, 3]
    return (view.depth[..., 0] > 0).numpy() & box.contains(points.numpy())


def _voxel_grid(voxel: float):
    o3d = import_open3d()
    return o3d.t.geometry.VoxelBlockGrid(
        attr_names=("tsdf", "weight", "color"),
        attr_dtypes=(o3d.core.float32,) * 3,
        attr_channels=((1,), (1,), (3,)),
        voxel_size=voxel,
        block_resolution=8,
        block_count=10_000,
    )


def _integrate(grid, view: DepthView, inside: Bool[np.ndarray, "H W"]) -> None:
    """Add one view. Open3D truncates projections to pixels, so its pixel centres are at 0.5, as ours are."""
    o3d = import_open3d()
    kept = np.where(inside[..., None], view.depth.numpy(), 0).astype(np.float32)
    depth, colour = (
        o3d.t.geometry.Image(o3d.core.Tensor(np.ascontiguousarray(image, dtype=np.float32)))
        for image in (kept, view.rgb.numpy())
    )
    K, viewmat = (o3d.core.Tensor(matrix.double().numpy()) for matrix in (view.camera.K, view.camera.viewmat))
    unit, far = 1.0, 2 * float(kept.max())
    blocks = grid.compute_unique_block_coordinates(depth, K, viewmat, unit, far, TRUNCATION)
    grid.integrate(blocks, depth, colour, K, K, viewmat, unit, far, TRUNCATION)


def _extract(grid, views: int) -> trimesh.Trimesh:
    """The zero crossing between voxels that at least ``views`` views saw; without faces if there is none."""
    import trimesh

    try:
        surface = grid.extract_triangle_mesh(weight_threshold=views - 0.5)
    except RuntimeError as error:
        if "colors" not in str(error).lower():  # Open3D fails on the colours of an empty mesh
            raise
        return trimesh.Trimesh()
    colours = np.round(255 * surface.vertex.colors.numpy()).clip(0, 255).astype(np.uint8)
    vertices, faces = surface.vertex.positions.numpy().astype(np.float64), surface.triangle.indices.numpy()
    vertices, faces, colours = _in_order(vertices, faces, colours)
    return trimesh.Trimesh(vertices, faces, vertex_colors=colours, process=False)


def _in_order(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], colours: UInt8[np.ndarray, "V 3"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The same surface, sorted by place.

    Open3D's threads hand it out in another order each time, and what is made of it, thinned say, depends on the order.
    """
    order = np.lexsort((*colours.T, *vertices.T))
    faces = np.argsort(order)[faces]
    first = faces.argmin(1, keepdims=True)
    faces = np.take_along_axis(faces, (first + np.arange(3)) % 3, 1)
    return vertices[order], faces[np.lexsort(faces.T)], colours[order]


def _without_specks(mesh: trimesh.Trimesh, area: float) -> Bool[np.ndarray, " F"]:
    """Mask of the faces in connected components of at least this area."""
    import trimesh

    piece = trimesh.graph.connected_component_labels(mesh.face_adjacency, node_count=len(mesh.faces))
    return np.bincount(piece, weights=mesh.area_faces)[piece] >= area
