"""Fuse the rendered depth of many views into a triangle mesh, by TSDF fusion (Curless and Levoy 1996)."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from shellgs_method.errors import SceneError
from shellgs_method.geometry.box import Box
from shellgs_method.geometry.camera import Camera
from shellgs_method.geometry.triangles import stacked
from shellgs_method.machine.open3d import import_open3d
from shellgs_method.machine.progress import track

if TYPE_CHECKING:
    import trimesh

TRUNCATION = 6.0
"""Truncation distance in voxels; less leaves holes, more rounds off reveals."""
MIN_VIEWS = 2
"""Minimum number of views that see a voxel."""
FINEST = 1000
"""Voxels along the second longest side of a box: a street has those of its houses, however long it is."""
SPECK = 100.0
"""Minimum area of a connected component, in faces of a voxel; smaller ones are floaters."""


_BLOCK = 8  # voxels along a side of a block, which is stored if a surface is near
_MOST = 150_000  # blocks of a tile: 1.5 GB
_AT_ONCE = 10_000  # blocks that are added at once: Open3D makes room for all of them, there already or not


class DepthView(NamedTuple):
    """Depth and colours rendered from one camera, in the frame of the mesh; on the CPU."""

    depth: Float[Tensor, "H W 1"]
    """Forward z-depth, 0 where there is none."""
    rgb: Float[Tensor, "H W 3"]
    """Colours in [0, 1]."""
    camera: Camera


def fuse(views: Iterable[DepthView], box: Box, voxel: float | None = None) -> trimesh.Trimesh:
    """Fuse views into a coloured mesh of the surface inside a box.

    Where a surface is too large for memory, the box is fused in tiles of one lattice, whose meshes meet without a seam;
    the views are kept on disk meanwhile.

    Open3D's ``VoxelBlockGrid`` has float32 coordinates, so the box must be near the frame's origin. (The older
    ``ScalableTSDFVolume`` of Open3D 0.20 silently returns nothing.)

    Args:
        views: rendered views, taken one at a time.
        box: box around the surface.
        voxel: voxel size; if None, a pixel's size on the surface in the first view that sees the box, but at least
            :func:`least_voxel`. It is stored in the mesh's ``metadata``.

    Raises:
        SceneError: no surface is left in the box, or the voxel size is not positive.
    """
    if voxel is not None and not voxel > 0:
        raise SceneError(f"a voxel cannot be {voxel} long: give a --voxel above 0")
    shown = _inside(views, box)
    if (first := next(shown, None)) is None:
        raise SceneError("there is no mesh: no view renders an opaque surface inside the facade's box")
    if voxel is None:
        pixel = (first.depth[first.depth > 0].median() / first.camera.K[0, 0]).item()
        voxel = max(pixel, least_voxel(box))
    axis, low, parts = _longest(box), -np.inf, []
    with tempfile.TemporaryDirectory() as folder:
        kept = _Kept(Path(folder))
        taken = kept.keeping(chain([first], shown))
        while low < np.inf:
            part, high = _tile(taken, voxel, axis, low)
            parts.append(part)
            low, taken = high, track(kept, "Fusing the next part, view", len(kept))
    mesh = _joined(parts)
    mesh.update_faces(_without_specks(mesh, SPECK * voxel**2))
    mesh.remove_unreferenced_vertices()
    if len(mesh.faces) == 0:
        raise SceneError(
            f"there is no mesh: the views have no surface in common inside the facade's box, in voxels of {voxel:.3g}; "
            "check the run in ns-viewer, or give a larger --voxel"
        )
    mesh.metadata["voxel"] = voxel
    return mesh


def least_voxel(box: Box) -> float:
    """Size of the smallest voxels that are worth their memory."""
    return float(np.sort(box.high - box.low)[1]) / FINEST


def _inside(views: Iterable[DepthView], box: Box) -> Iterator[DepthView]:
    """The views that show something in the box, with depth there alone."""
    for view in views:
        camera = view.camera.to(torch.float64)
        to_world = torch.linalg.inv(camera.viewmat)
        points = (view.depth.double() * camera.rays()) @ to_world[:3, :3].T + to_world[:3, 3]
        inside = (view.depth[..., 0] > 0) & torch.from_numpy(box.contains(points.numpy()))
        if inside.any():
            yield view._replace(depth=view.depth.where(inside[..., None], 0.0))


def _tile(
    views: Iterable[DepthView], voxel: float, axis: int, low: float
) -> tuple[tuple[trimesh.Trimesh, Bool[np.ndarray, " F"]], float]:
    """Fuse a tile that begins at block ``low`` along an axis: its mesh, which faces are its own, and where it ends."""
    grid, high, seen = _voxel_grid(voxel), np.inf, 0
    for view in views:
        _integrate(grid, view, axis, low, high)
        seen += 1
        if grid.hashmap().size() > _MOST:
            high = _shortened(grid, axis)
    mesh = _extract(grid, min(MIN_VIEWS, seen))
    middle = mesh.triangles_center[:, axis] / (_BLOCK * voxel) if len(mesh.faces) else np.empty(0)
    return (mesh, (middle >= low) & (middle < high)), high


def _longest(box: Box) -> int:
    """The axis of the lattice along which the box is longest."""
    corners = np.stack(np.meshgrid(*zip(box.low, box.high, strict=True)), axis=-1).reshape(-1, 3) @ box.axes
    return int(np.ptp(corners, axis=0).argmax())


def _shortened(grid, axis: int) -> float:
    """End a tile at its median block, if there is one after its first, and remove what is beyond; the new end."""
    o3d = import_open3d()
    blocks = grid.hashmap()
    taken = blocks.active_buf_indices().numpy()
    places = blocks.key_tensor().numpy()[taken]
    along = places[:, axis]
    end = max(int(np.median(along)), int(along.min()) + 1)
    beyond = along > end  # what is at the end stays, as the last triangles reach into it
    for name in ("tsdf", "weight", "color"):
        grid.attribute(name).numpy()[taken[beyond]] = 0  # Open3D does not when it uses their places again
    if beyond.any():
        blocks.erase(o3d.core.Tensor(places[beyond]))
    return float(end)


class _Kept:
    """Views on disk."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.cameras = folder, []

    def keeping(self, views: Iterable[DepthView]) -> Iterator[DepthView]:
        """The views, kept one after another as they are taken."""
        for view in views:
            rgb = (255 * view.rgb).round().clamp(0, 255).byte()
            np.savez(self.folder / f"{len(self)}.npz", depth=view.depth.float().numpy(), rgb=rgb.numpy())
            self.cameras.append(view.camera)
            yield view

    def __len__(self) -> int:
        return len(self.cameras)

    def __iter__(self) -> Iterator[DepthView]:
        for number, camera in enumerate(self.cameras):
            with np.load(self.folder / f"{number}.npz") as images:
                yield DepthView(torch.from_numpy(images["depth"]), torch.from_numpy(images["rgb"]) / 255, camera)


def _voxel_grid(voxel: float):
    o3d = import_open3d()
    return o3d.t.geometry.VoxelBlockGrid(
        attr_names=("tsdf", "weight", "color"),
        attr_dtypes=(o3d.core.float32,) * 3,
        attr_channels=((1,), (1,), (3,)),
        voxel_size=voxel,
        block_resolution=_BLOCK,
        block_count=_AT_ONCE,
    )


def _integrate(grid, view: DepthView, axis: int, low: float, high: float) -> None:
    """Add one view to the blocks of a tile, and to the first ones beyond it, which its last triangles reach.

    Open3D truncates projections to pixels, so its pixel centres are at 0.5, as ours are.
    """
    o3d = import_open3d()
    depth, colour = (
        o3d.t.geometry.Image(o3d.core.Tensor(np.ascontiguousarray(image, dtype=np.float32)))
        for image in (view.depth.numpy(), view.rgb.numpy())
    )
    K, viewmat = (o3d.core.Tensor(matrix.double().numpy()) for matrix in (view.camera.K, view.camera.viewmat))
    unit, far = 1.0, 2 * float(view.depth.max())
    try:
        blocks = grid.compute_unique_block_coordinates(depth, K, viewmat, unit, far, TRUNCATION).numpy()
    except RuntimeError as error:
        if "No block is touched" not in str(error):
            raise
        return  # the view has hardly any depth
    blocks = blocks[(blocks[:, axis] >= low) & (blocks[:, axis] <= high)]
    for start in range(0, len(blocks), _AT_ONCE):
        some = o3d.core.Tensor(blocks[start : start + _AT_ONCE])
        grid.integrate(some, depth, colour, K, K, viewmat, unit, far, TRUNCATION)


def _extract(grid, views: int) -> trimesh.Trimesh:
    """The zero crossing between voxels that at least ``views`` views saw; without faces if there is none."""
    import trimesh

    if grid.hashmap().size() == 0:
        return trimesh.Trimesh()
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


def _joined(parts: list[tuple[trimesh.Trimesh, Bool[np.ndarray, " F"]]]) -> trimesh.Trimesh:
    """The chosen faces of meshes in one, whose vertices on the cuts are the same numbers in both neighbours."""
    import trimesh

    if len(parts) == 1:
        return parts[0][0]
    vertices, faces = stacked((mesh.vertices, mesh.faces[chosen]) for mesh, chosen in parts)
    colours = np.concatenate([np.asarray(mesh.visual.vertex_colors)[:, :3] for mesh, _ in parts])  # pyright: ignore
    places, first, index = np.unique(vertices, axis=0, return_index=True, return_inverse=True)
    return trimesh.Trimesh(places, index[faces], vertex_colors=colours[first], process=False)


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
