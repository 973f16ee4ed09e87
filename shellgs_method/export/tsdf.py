"""Rendered depth of many views -> one triangle mesh: a truncated signed distance field (Curless and Levoy 1996)."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from dataparsers.camera import Camera
from dataparsers.errors import SceneError
from shellgs_method.evaluation import normals_from_depth
from shellgs_method.export.frame import Box
from shellgs_method.shell.raycast import import_open3d

if TYPE_CHECKING:
    import trimesh

TRUNCATION = 4.0
"""Voxels on each side of the surface in which the distance is kept."""
GRAZING = 0.1
"""Least cosine of a ray and the depth's normal: what is steeper is the bridge between an edge and what is behind it."""
VIEWS = 3
"""Views that must agree on a voxel."""
SPECK = 100
"""Voxels' faces that a separate piece of surface must be as large as to stay."""


class DepthView(NamedTuple):
    """What one camera sees, in the frame of the mesh to be made."""

    depth: Float[Tensor, "H W 1"]
    """Forward z-depth, 0 where there is none."""
    rgb: Float[Tensor, "H W 3"]
    """Colours in [0, 1]."""
    camera: Camera


def fuse(views: Iterable[DepthView], box: Box, voxel: float | None = None) -> trimesh.Trimesh:
    """Fuse views into a coloured mesh of what they see inside a box.

    Open3D's ``VoxelBlockGrid`` does it, near the frame's origin: its coordinates are float32. (The older
    ``ScalableTSDFVolume`` of Open3D 0.20 returns nothing without a word.)

    Args:
        views: rendered views, taken one at a time.
        box: where the surface is wanted.
        voxel: size of a voxel; if not given, the size of a pixel on the surface in the first view that sees the box,
            but no less than a thousandth of the box.

    Raises:
        SceneError: no surface is left in the box.
    """
    import trimesh

    grid, seen = None, 0
    for view in views:
        inside = _usable(view, box)
        if not inside.any():
            continue
        if grid is None:
            pixel = (view.depth[..., 0][inside].median() / view.camera.K[0, 0].cpu()).item()
            voxel = voxel or max(pixel, box.size / 1000)
            grid = _voxel_grid(voxel)
        _integrate(grid, view, inside)
        seen += 1
    if grid is None or voxel is None:
        raise SceneError("there is no mesh: none of the views renders an opaque surface inside the facade's box")
    mesh = _extract(grid, min(VIEWS, seen))
    if mesh is not None:
        mesh.update_faces(box.contains(mesh.vertices)[mesh.faces].all(axis=1))
        mesh.update_faces(_without_specks(mesh, SPECK * voxel**2))
        mesh.remove_unreferenced_vertices()
    if mesh is None or len(mesh.faces) == 0:
        raise SceneError(
            f"there is no mesh: the {seen} views that see the facade's box agree on no surface in voxels of "
            f"{voxel:.3g}; render more views, or give a larger --voxel"
        )
    mesh.metadata["voxel"] = voxel
    assert isinstance(mesh, trimesh.Trimesh)
    return mesh


def decimate(mesh: trimesh.Trimesh, faces: int) -> trimesh.Trimesh:
    """The mesh with at most about ``faces`` triangles, by quadric error (Garland and Heckbert 1997); colours stay."""
    import trimesh

    if len(mesh.faces) <= faces:
        return mesh
    o3d = import_open3d()
    dense = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(mesh.vertices), o3d.utility.Vector3iVector(mesh.faces.astype(np.int32))
    )
    dense.vertex_colors = o3d.utility.Vector3dVector(mesh.visual.vertex_colors[:, :3] / 255)  # pyright: ignore
    sparse = dense.simplify_quadric_decimation(faces)
    colours = np.round(255 * np.asarray(sparse.vertex_colors)).clip(0, 255).astype(np.uint8)
    return trimesh.Trimesh(
        np.asarray(sparse.vertices),
        np.asarray(sparse.triangles),
        vertex_colors=colours,
        process=False,
        metadata=mesh.metadata,
    )


def _usable(view: DepthView, box: Box) -> Bool[np.ndarray, "H W"]:
    """Pixels with depth inside the box, seen at an angle that tells something."""
    depth, camera = view.depth.cpu().double(), view.camera.to("cpu", torch.float64)
    rays = camera.rays()
    facing = (normals_from_depth(depth, camera) * normalize(rays, dim=-1)).sum(dim=-1).abs() > GRAZING
    to_world = torch.linalg.inv(camera.viewmat)
    points = (depth * rays) @ to_world[:3, :3].T + to_world[:3, 3]
    return (facing & (depth[..., 0] > 0)).numpy() & box.contains(points.numpy())


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


def _integrate(grid, view: DepthView, usable: Bool[np.ndarray, "H W"]) -> None:
    """Add one view. Open3D's projection truncates to the pixel: its centres are at 0.5 as ours."""
    o3d = import_open3d()
    tensor, image = o3d.core.Tensor, o3d.t.geometry.Image
    kept = np.where(usable[..., None], view.depth.cpu().numpy(), 0).astype(np.float32)
    depth = image(tensor(kept))
    colour = image(tensor(np.ascontiguousarray(view.rgb.cpu().numpy(), dtype=np.float32)))
    K = tensor(view.camera.K.cpu().double().numpy())
    viewmat = tensor(view.camera.viewmat.cpu().double().numpy())
    scale, far = 1.0, 2 * float(kept.max())
    blocks = grid.compute_unique_block_coordinates(depth, K, viewmat, scale, far, TRUNCATION)
    grid.integrate(blocks, depth, colour, K, K, viewmat, scale, far, TRUNCATION)


def _extract(grid, views: int) -> trimesh.Trimesh | None:
    """The zero crossing between voxels that ``views`` views saw; Open3D raises where there is none."""
    import trimesh

    try:
        surface = grid.extract_triangle_mesh(weight_threshold=views - 0.5)
    except RuntimeError:
        return None
    colours = np.round(255 * surface.vertex.colors.numpy()).clip(0, 255).astype(np.uint8)
    vertices, faces = surface.vertex.positions.numpy().astype(np.float64), surface.triangle.indices.numpy()
    return trimesh.Trimesh(vertices, faces, vertex_colors=colours, process=False)


def _without_specks(mesh: trimesh.Trimesh, area: float) -> Bool[np.ndarray, " F"]:
    """Faces that hang together with enough others."""
    import trimesh

    piece = trimesh.graph.connected_component_labels(mesh.face_adjacency, node_count=len(mesh.faces))
    return np.bincount(piece, weights=mesh.area_faces)[piece] >= area
