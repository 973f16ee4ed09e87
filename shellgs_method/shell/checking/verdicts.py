"""What the photographs of all views together say of places on the shell."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import trimesh
from jaxtyping import Bool, Float64, Int64

from dataparsers.camera import project
from dataparsers.cue_maps import CueMaps
from dataparsers.files import atomic_write
from dataparsers.photograph import View
from shellgs_method.voxels import cell_means, voxel_cells

CONTRADICTED_PLACES = "cues/checked/contradicted.ply"
"""Where in a scene :meth:`Verdicts.write` puts the places for viewers."""
MANY = 6
"""Photographs, and at least half of those that see it, that contradict a place where the building differs from its
shell. What stands farther before it hides another place in each."""
_STEP = 4  # from pixel to pixel of what is lifted
_ACROSS = 300  # places along the longest side of the shell
_SAME = 0.01  # share of its depth by which a place may miss the map of a view that sees it


@dataclass(frozen=True)
class Verdicts:
    """What the photographs say of places on the shell, in the scene's frame and units.

    Attributes:
        places: the places.
        seen: number of views that see each.
        contradicted: number of these that show something before it.
        distance: median distance before it at which they do; NaN where none does.
        views: names of all views.
        differs: places that many of them contradict.
        by_view: number of these places that each view contradicts.
    """

    places: Float64[np.ndarray, "N 3"]
    seen: Int64[np.ndarray, " N"]
    contradicted: Int64[np.ndarray, " N"]
    distance: Float64[np.ndarray, " N"]
    views: list[str]
    differs: Bool[np.ndarray, " N"]
    by_view: Int64[np.ndarray, " V"]

    @property
    def share(self) -> float:
        """Of the places that are seen, those where the building differs."""
        return float(self.differs.sum() / max((self.seen > 0).sum(), 1))

    @property
    def witness(self) -> str:
        """The view that contradicts most of them."""
        return self.views[int(self.by_view.argmax())]

    def write(self, path: Path) -> None:
        """The places as a ply, the redder the more of the views that see them contradict them."""
        red = self.contradicted / np.maximum(self.seen, 1)
        colours = 255 - 255 * red[:, None] * [0.1, 1, 1]
        content = trimesh.PointCloud(self.places, colours.round().astype(np.uint8)).export(file_type="ply")
        with atomic_write(path) as file:
            file.write(content if isinstance(content, bytes) else str(content).encode())


def shell_verdicts(scene: Path, views: Sequence[View], places: Float64[np.ndarray, "N 3"] | None = None) -> Verdicts:
    """Sum the maps of :func:`~shellgs_method.shell.check_views` over the views.

    Args:
        scene: the scene's folder.
        views: its photographs, of any size.
        places: on the shell, in the scene's frame; if None, some that the views see, evenly spread.

    Raises:
        FileNotFoundError: the scene has no such maps.
        SceneError: a map is damaged, or of another camera or shell.
    """
    shell, checked = CueMaps.open(scene, "shell"), CueMaps.open(scene, "checked")
    sized = [view for view in views if shell.record(view.name) and checked.record(view.name)]
    if places is None:
        places = _seen_places(sized, shell)
    seen, distances = np.zeros(len(places), np.int64), np.full((len(sized), len(places)), np.nan, np.float32)
    for distance, view in zip(distances, sized, strict=True):
        camera = view.camera.shrunk(shell.manifest.max_image_size)
        cue, said = shell.read(view.name, camera), checked.read(view.name, camera)
        assert cue is not None
        assert said is not None
        pixels, z = project(camera, places)
        inside = (z > 0) & ((pixels >= 0) & (pixels < [camera.width, camera.height])).all(axis=1)
        k = np.flatnonzero(inside)
        columns, rows = pixels[k].astype(int).T
        visible = np.abs(cue.depth[rows, columns] / z[k] - 1) < _SAME
        seen[k] += visible
        before = visible & said.mask[rows, columns]
        along = np.linalg.norm(places[k] - camera.position.double().numpy(), axis=1) / z[k]  # for a depth of 1
        distance[k[before]] = ((cue.depth - said.depth)[rows, columns] * along)[before]
    contradicted = np.isfinite(distances).sum(axis=0)
    median = np.full(len(places), np.nan)
    some = contradicted > 0
    median[some] = np.nanmedian(distances[:, some], axis=0)
    differs = (contradicted >= MANY) & (2 * contradicted >= seen)
    by_view = np.isfinite(distances[:, differs]).sum(axis=1)
    return Verdicts(places, seen, contradicted, median, [view.name for view in sized], differs, by_view)


def _seen_places(views: Sequence[View], shell: CueMaps) -> Float64[np.ndarray, "N 3"]:
    """Places of the shell that views see, evenly spread over it."""
    lifted = []
    for view in views:
        camera = view.camera.shrunk(shell.manifest.max_image_size).to(torch.float64)
        cue = shell.read(view.name, camera)
        assert cue is not None
        depth = cue.depth[::_STEP, ::_STEP, None].astype(np.float64)
        points = (depth * camera.rays().numpy()[::_STEP, ::_STEP])[depth[..., 0] > 0]
        lifted.append((points - camera.viewmat[:3, 3].numpy()) @ camera.viewmat[:3, :3].numpy())
    points = np.concatenate([*lifted, np.empty((0, 3))])
    if not len(points):
        return points
    return cell_means(points, voxel_cells(points, float(np.ptp(points, axis=0).max()) / _ACROSS or 1.0))
