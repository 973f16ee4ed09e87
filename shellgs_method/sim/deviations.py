"""Regions where the photographed building differs from its shell."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Bool, Float64, Int64, UInt8

from shellgs_method.evaluation.colours import deviation_colours
from shellgs_method.files.atomic import write_whole
from shellgs_method.geometry.camera import Camera, in_view
from shellgs_method.geometry.surface_classes import NO_CLASSES, SurfaceClass, classes_of
from shellgs_method.geometry.triangles import Triangles
from shellgs_method.shell.mesh import NO_SOURCES, sources_of
from shellgs_method.sim.collision.clusters import connected

EDGE = 0.15
"""Longest edge in metres of the triangles into which the shell is subdivided."""
REACH = 0.5
"""Search range in front of and behind the shell, in metres."""
FULL = 0.2
"""Distance in metres of the full colours: red in front of the shell, blue behind it."""

Contradicted = Callable[[Float64[np.ndarray, "N 3"]], Float64[np.ndarray, " N"]]
"""Maps points of the shell, in the simulation frame, to the distance in metres at which the photographs show the
building in front of them (positive) or behind them; NaN where the photographs do not contradict the shell."""


@dataclass(frozen=True)
class Region:
    """A region of the shell from which the building differs.

    Attributes:
        what: "before" (the scan lacks something) or "behind" (something is gone or deeper).
        area: area of the shell, in square metres.
        distance: median signed distance in metres, positive in front of the shell.
        centre: centre in the simulation frame.
        photograph: name of the photograph that shows it best.
        part: class of the shell there, such as "window"; "other" if its file knows none.
        file: the shell's file there.
    """

    what: str
    area: float
    distance: float
    centre: tuple[float, float, float]
    photograph: str
    part: str
    file: str


@dataclass(frozen=True, eq=False)
class Deviations:
    """Distance of the building from the shell, at each triangle of the subdivided shell.

    Attributes:
        surface: subdivided shell.
        distance: signed distance in metres at each triangle, positive in front of the shell; NaN where unseen.
        flagged: triangles whose distance exceeds the threshold.
        regions: connected regions of these, the largest first.
    """

    surface: Triangles
    distance: Float64[np.ndarray, " F"]
    flagged: Bool[np.ndarray, " F"]
    regions: list[Region]

    def write(self, path: Path) -> None:
        """Write the coloured shell as ply: red where the building is in front of it, blue behind, grey where unseen."""
        mesh = trimesh.Trimesh(
            self.surface.vertices, self.surface.faces, face_colors=deviation_colours(self.distance, FULL), process=False
        )
        content = mesh.export(file_type="ply")
        write_whole(path, content if isinstance(content, bytes) else str(content))


def find_deviations(
    shell: Triangles,
    fused: Triangles,
    views: Sequence[tuple[str, Camera]],
    threshold: float,
    contradicted: Contradicted | None = None,
    least: float = 0.05,
    classes: UInt8[np.ndarray, " S"] = NO_CLASSES,
    sources: Int64[np.ndarray, " S"] = NO_SOURCES,
    files: Sequence[str] = ("",),
) -> Deviations:
    """Compare the shell with the reconstruction along its normals; a region is of one class and one file.

    Args:
        shell: shell, wound so that normals point outside.
        fused: reconstruction.
        views: names of the photographs, with their cameras.
        threshold: distance in metres above which they differ.
        contradicted: distances from the photographs themselves, used instead of the reconstruction where not NaN.
        least: minimum area of a region in square metres.
        classes: class of each of the shell's triangles; OTHER if not given.
        sources: number of the file that each of the shell's triangles is of; that of the first if not given.
        files: names of the files.
    """
    *cut, whole = trimesh.remesh.subdivide_to_size(shell.vertices, shell.faces, EDGE, max_iter=20, return_index=True)
    small, classes = Triangles(*cut), classes_of(shell.faces, classes)[whole]
    sources = sources_of(shell.faces, sources)[whole]
    centres, best = small.centres, _best_views(shell, small, [camera for _, camera in views])
    distance = np.where(best >= 0, along_normals(small, centres, fused), np.nan)
    if contradicted is not None:
        said = contradicted(centres)
        distance = np.where(np.isfinite(said), said, distance)
    flagged = np.abs(np.nan_to_num(distance)) > threshold
    regions = []

    def add(what: str, part: int, file: int, group: Int64[np.ndarray, " G"]) -> None:
        shown = np.bincount(best[group][best[group] >= 0], minlength=len(views))
        x, y, z = np.median(centres[group], axis=0).round(3).tolist()
        photograph = views[int(shown.argmax())][0] if shown.any() else ""
        area, away = (round(float(value), 3) for value in (small.areas[group].sum(), np.median(distance[group])))
        regions.append(Region(what, area, away, (x, y, z), photograph, SurfaceClass(part).word, files[file]))

    for what, chosen in (("before", flagged & (distance > 0)), ("behind", flagged & (distance < 0))):
        for part, file in np.unique(np.stack([classes[chosen], sources[chosen]], axis=1), axis=0).tolist():
            for group in connected(small.faces, np.flatnonzero(chosen & (classes == part) & (sources == file))):
                if small.areas[group].sum() >= least:
                    add(what, part, file, group)
    return Deviations(small, distance, flagged, sorted(regions, key=lambda region: -region.area))


def _best_views(shell: Triangles, small: Triangles, cameras: Sequence[Camera]) -> Int64[np.ndarray, " F"]:
    """Number of the view that shows each triangle of the subdivided shell best; -1 where none shows it."""
    centres = small.centres
    best, score = np.full(len(centres), -1), np.zeros(len(centres))
    for number, camera in enumerate(cameras):
        eye = camera.position.double().numpy()
        shown, _, depth = in_view(camera, centres)
        inside = np.flatnonzero(shown)[depth > 0.1]
        away = eye - centres[inside]
        length = np.linalg.norm(away, axis=1)
        facing = np.einsum("nc,nc->n", away, small.normals[inside]) / length
        visible = (facing > 0.05) & shell.sees(eye, centres[inside], 0.02)
        quality = np.where(visible, facing / length**2, 0.0)
        better = quality > score[inside]
        score[inside[better]], best[inside[better]] = quality[better], number
    return best


def along_normals(small: Triangles, places: Float64[np.ndarray, "F 3"], other: Triangles) -> Float64[np.ndarray, " F"]:
    """Signed distance of another surface along each triangle's normal, seen from outside; NaN if none is in reach."""
    t = other.cast(places + REACH * small.normals, -small.normals).t
    return np.where(t < 2 * REACH, REACH - t, np.nan)
