"""Combine the checks of all views at points on the shell."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from jaxtyping import Bool, Float64, Int64

from shellgs_method.files.atomic import write_whole
from shellgs_method.files.cue_maps import CueMaps
from shellgs_method.files.map_files import Findings
from shellgs_method.files.photographs import View
from shellgs_method.geometry.camera import in_view
from shellgs_method.geometry.surface_classes import SurfaceClass
from shellgs_method.geometry.voxels import cell_means, voxel_cells

CONTRADICTED_PLACES = "cues/checked/contradicted.ply"
"""File in the scene's folder for :meth:`Verdicts.write`, shown by viewers."""
MANY = 6
"""Number of photographs, and at least half of those that see a point, that must contradict it for the building to
differ from its shell there. An occluder farther in front of the shell hides different points in each photograph, and a
pane mirrors others."""
MOVED = 0.004
"""Share of a view's shell above which what moved is worth mentioning."""
UNCLEAR = 0.25
"""Doubtful share of the shell's pixels above which the user is warned: at most a tenth by day, half and more in the
noise of a night."""
_STEP = 4  # stride in pixels of the lifted points
_ACROSS = 300  # points along the longest side of the shell
_SAME = 0.01  # relative difference of depth within which a point is visible in a view's shell map


@dataclass(frozen=True)
class Votes:
    """Votes of the views against points of the shell.

    Attributes:
        count: number of views that contradict each point.
        differs: mask of the points where the building differs from the shell, by :data:`MANY`.
        share: their share of the points that any view sees.
        witness: index of the view that contradicts most of them.
    """

    count: Int64[np.ndarray, " N"]
    differs: Bool[np.ndarray, " N"]
    share: float
    witness: int

    @classmethod
    def of(cls, against: Bool[np.ndarray, "V N"], seen: Int64[np.ndarray, " N"]) -> Votes:
        """Count the votes of all views against points, each of which some number of them sees."""
        count = against.sum(axis=0)
        differs = (count >= MANY) & (2 * count >= seen)
        share = differs.sum() / max((seen > 0).sum(), 1)
        return cls(count, differs, float(share), int(against[:, differs].sum(axis=1).argmax()) if len(against) else 0)


@dataclass(frozen=True)
class Verdicts:
    """Verdicts of the photographs on points of the shell, in the scene's frame and units.

    Attributes:
        places: the points.
        seen: number of views in which each is visible.
        before: votes of the views that show something in front of them, other than what moved.
        behind: votes of the views that show something behind them, through no window of the shell's model.
        distance: median distance of what stands in front of each; NaN where no view shows it.
        views: names of all views.
        moved: share of each view's shell that is hidden by something that moved, since no other view shows it.
        doubted: share of each view's shell that is doubtful.
    """

    places: Float64[np.ndarray, "N 3"]
    seen: Int64[np.ndarray, " N"]
    before: Votes
    behind: Votes
    distance: Float64[np.ndarray, " N"]
    views: list[str]
    moved: Float64[np.ndarray, " V"]
    doubted: Float64[np.ndarray, " V"]

    @property
    def moved_in(self) -> list[str]:
        """Names of the views in which more than :data:`MOVED` of the shell is hidden by what moved, the most first."""
        return [self.views[i] for i in np.argsort(-self.moved) if self.moved[i] > MOVED]

    @property
    def unclear(self) -> float:
        """Mean doubtful share of a view's shell."""
        return float(self.doubted.mean()) if len(self.doubted) else 0.0

    def write(self, path: Path) -> None:
        """Write the points as a ply, redder where more of the views show something in front of them, else magenta."""
        before, behind = (votes.count / np.maximum(self.seen, 1) for votes in (self.before, self.behind))
        colours = 255 - 255 * (before[:, None] * [0.1, 1, 1] + behind[:, None] * [0.2, 1, 0.2])
        content: Any = trimesh.PointCloud(self.places, colours.round().astype(np.uint8)).export(file_type="ply")
        write_whole(path, content)


def shell_verdicts(scene: Path, views: Sequence[View], places: Float64[np.ndarray, "N 3"] | None = None) -> Verdicts:
    """Sum the maps of :func:`~shellgs_method.occlusion.check_views` over the views.

    Args:
        scene: the scene's folder.
        views: its photographs, of any size.
        places: points on the shell, in the scene's frame; None for evenly spread points that the views see.

    Raises:
        FileNotFoundError: the scene has no such maps.
        SceneError: a map is damaged, or of another camera or shell.
    """
    shell, checked = CueMaps.open(scene, "shell"), CueMaps.open(scene, "checked")
    sized = [view for view in views if shell.record(view.name) and checked.record(view.name)]
    if places is None:
        places = _seen_places(sized, shell)
    seen, distances = np.zeros(len(places), np.int64), np.full((len(sized), len(places)), np.nan, np.float32)
    behind = np.zeros(distances.shape, bool)
    moved, doubted = [], []
    for distance, farther, view in zip(distances, behind, sized, strict=True):
        camera = view.camera.shrunk(shell.manifest.max_image_size)
        cue, check = shell.require(view.name, camera), checked.require(view.name, camera)
        inside, pixels, z = in_view(camera, places)
        k = np.flatnonzero(inside)
        columns, rows = pixels.astype(int).T
        visible = np.abs(cue.depth[rows, columns] / z - 1) < _SAME
        seen[k] += visible
        found = Findings.of(check, cue)
        on_shell = max((cue.depth > 0).sum(), 1)
        moved.append(found.moved.sum() / on_shell)
        doubted.append(found.doubtful.sum() / on_shell)
        occluded = visible & found.occluder[rows, columns]
        along = np.linalg.norm(places[k] - camera.position.double().numpy(), axis=1) / z  # per unit of depth
        distance[k[occluded]] = ((cue.depth - check.depth)[rows, columns] * along)[occluded]
        solid = True if cue.classes is None else cue.classes != SurfaceClass.WINDOW
        farther[k] = visible & ((found.behind | found.unbuilt) & solid)[rows, columns]
    median = np.full(len(places), np.nan)
    some = np.isfinite(distances).any(axis=0)
    median[some] = np.nanmedian(distances[:, some], axis=0)
    before, beyond = Votes.of(np.isfinite(distances), seen), Votes.of(behind, seen)
    names = [view.name for view in sized]
    return Verdicts(places, seen, before, beyond, median, names, np.array(moved), np.array(doubted))


def _seen_places(views: Sequence[View], shell: CueMaps) -> Float64[np.ndarray, "N 3"]:
    """Evenly spread points of the shell that are visible in the views."""
    lifted = []
    for view in views:
        camera = view.camera.shrunk(shell.manifest.max_image_size).to(torch.float64)
        depth = shell.require(view.name, camera).depth[::_STEP, ::_STEP, None].astype(np.float64)
        points = (depth * camera.rays().numpy()[::_STEP, ::_STEP])[depth[..., 0] > 0]
        lifted.append((points - camera.viewmat[:3, 3].numpy()) @ camera.viewmat[:3, :3].numpy())
    points = np.concatenate([*lifted, np.empty((0, 3))])
    if not len(points):
        return points
    return cell_means(points, voxel_cells(points, float(np.ptp(points, axis=0).max()) / _ACROSS or 1.0))
