"""A start for the alignment where there is none: a guess from up, the main wall and its outline.

Facades repeat themselves, so that features and their descriptors register them a whole number of bays off, with perfect
scores. What is searched here exhaustively instead is all the places that put the main wall of the SfM points upright on
a wall of the shell: which wall, at which scale, where on it. The best ones are refined and ranked, and those that come
close to the best are named. The outcome is a proposal for people to look at.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.ndimage import maximum_filter
from scipy.signal import fftconvolve
from scipy.spatial import KDTree

from dataparsers.errors import SceneError
from shellgs_method.open3d import import_open3d
from shellgs_method.shell.refinement import refine
from shellgs_method.shell.similarity import transformed
from shellgs_method.shell.surface import ShellSurface

AMBIGUOUS = 0.90
"""Share of the best score from which another place is named beside it."""
_DIFFERENT = 0.5  # metres of mean displacement from which two places are two
_REFINED = 10  # places on each wall that are refined
_PEAKS = 6  # shifts that are kept for a wall and a scale, a metre or more apart
_SCALE_STEP = 1.04
_FLAT = 0.05  # breadth of the SfM wall over its length within which points are on it
_FIT = 0.10  # metres
_REACH = 1.0  # metres


@dataclass(frozen=True)
class Candidate:
    """A place for the shell.

    Attributes:
        survey_from_scene: similarity.
        score: harmonic mean of the share of the wall's SfM points within 10 cm of the shell and the share of the
            shell's wall that has SfM points beside it.
        displacement: mean distance from the best candidate's place, in metres.
    """

    survey_from_scene: Float64[np.ndarray, "4 4"]
    score: float
    displacement: float = 0.0


def propose(
    surface: ShellSurface,
    points: Float64[np.ndarray, "N 3"],
    cameras: Float64[np.ndarray, "V 3"],
    scene_up: Float64[np.ndarray, " 3"],
    shell_up: Float64[np.ndarray, " 3"],
) -> list[Candidate]:
    """Places for the shell, the best first, then those whose score is within 10 % of it.

    Args:
        surface: the shell, which must face out of the building on one side at least.
        points: SfM points in the scene's frame.
        cameras: positions of the cameras, all on the outside.
        scene_up: up as the cameras hold it, roughly.
        shell_up: up in the shell's axes.

    Raises:
        SceneError: the SfM points have no main wall, or it fits nowhere.
    """
    scene_wall, wall_points = _main_wall(points, cameras, scene_up)
    starts: list[np.ndarray] = []  # of each wall, for the scores of walls of different sizes do not compare
    for axes, samples in _shell_walls(surface, shell_up):
        starts += _distinct(_places(scene_wall, wall_points, axes, samples), surface.vertices)
    found: list[Candidate] = []
    for start in starts:
        try:
            refined = refine(surface, points, start, _REACH).survey_from_scene
        except ValueError:
            continue
        found.append(Candidate(refined, _score(surface, transformed(wall_points, refined))))
    if not found:
        raise SceneError("no place was found for the shell: pick points in the photographs and use --picks")
    found.sort(key=lambda candidate: -candidate.score)
    best, rivals = found[0], []
    for candidate in found:
        displacement = _displacement(best.survey_from_scene, candidate.survey_from_scene, surface.vertices)
        if displacement > _DIFFERENT and candidate.score >= AMBIGUOUS * best.score:
            rivals.append(Candidate(candidate.survey_from_scene, candidate.score, displacement))
    return [best, *rivals]


def _main_wall(points: np.ndarray, cameras: np.ndarray, up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Right, up and out of the plane that most points lie on, as rows, and the points on it or near it."""
    o3d = import_open3d()
    o3d.utility.random.seed(0)
    size = float(np.linalg.norm(np.percentile(points, 90, axis=0) - np.percentile(points, 10, axis=0)))
    left = points
    for _ in range(5):
        if len(left) < 50:
            break
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(left))
        plane, inliers = cloud.segment_plane(0.01 * size, 3, 1000)
        out = plane[:3] / np.linalg.norm(plane[:3])
        if abs(out @ up) < 0.5:
            centre = left[inliers].mean(0)
            out = out * np.sign((cameras.mean(0) - centre) @ out)
            up = up - (up @ out) * out
            up /= np.linalg.norm(up)
            near = np.abs((points - centre) @ out) < _FLAT * size
            return np.stack([np.cross(up, out), up, out]), points[near]
        left = np.delete(left, inliers, axis=0)
    raise SceneError("the SfM points have no upright wall to start from: pick points and use --picks")


def _shell_walls(surface: ShellSurface, up: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Right, up and out of up to four walls of the shell, seen from either side, and samples of the surface there."""
    samples, normals = surface.samples(20_000)
    upright = np.abs(normals @ up) < 0.2
    samples, normals = samples[upright], normals[upright]
    for _ in range(4):
        if len(samples) < 1000:
            return
        some = normals[:: max(1, len(normals) // 1000)]
        out = some[(np.abs(some @ some.T) > 0.98).sum(axis=1).argmax()]
        out = out - (out @ up) * up
        out /= np.linalg.norm(out)
        alike = np.abs(normals @ out) > 0.98
        height = samples @ out
        peak, edges = np.histogram(height[alike], bins=np.arange(height.min() - 0.5, height.max() + 1.0, 0.5))
        level = edges[peak.argmax()] + 0.25
        wall = np.abs(height - level) < 1.0
        for side in (out, -out):
            yield np.stack([np.cross(up, side), up, side]), samples[wall]
        samples, normals = samples[~(wall & alike)], normals[~(wall & alike)]


def _places(
    scene_axes: np.ndarray, points: np.ndarray, axes: np.ndarray, samples: np.ndarray
) -> list[tuple[float, np.ndarray]]:
    """Scores and similarities of the best places on one wall, over all scales and shifts by cells.

    Both walls are boxes of cells; their correlation counts, for every shift at once, the points in the shell's cells
    and the shell's cells that have points.
    """
    flat, wall = points @ scene_axes.T, samples @ axes.T
    middle, target = np.median(flat, axis=0), (wall.min(0) + wall.max(0)) / 2
    sizes = [np.ptp(np.percentile(p, [2, 98], axis=0), axis=0)[:2] for p in (wall, flat)]
    ratios = sizes[0] / np.maximum(sizes[1], 1e-9)
    cell = max(0.25, float(sizes[0].max()) / 300)
    steps = int(np.log(1.6 * ratios.max() / (0.6 * ratios.min())) / np.log(_SCALE_STEP))
    found = []
    shell_cells = _cells(wall - target, cell)
    for scale in 0.6 * ratios.min() * _SCALE_STEP ** np.arange(steps + 1):
        scaled = scale * (flat - middle)
        if np.ptp(scaled, axis=0)[:2].max() > 4 * sizes[0].max():
            break
        counts, occupied = (_cells(scaled, cell, counted) for counted in (True, False))
        hits, covered = (fftconvolve(shell_cells[0], c[::-1, ::-1, ::-1]) for c in (counts[0], occupied[0]))
        precision, recall = hits / counts[0].sum(), covered / shell_cells[0].sum()
        score = 2 * precision * recall / np.maximum(precision + recall, 1e-9)
        peaks = np.flatnonzero(score == maximum_filter(score, 2 * round(1.0 / cell) + 1))
        for peak in peaks[np.argsort(-score.flat[peaks])][:_PEAKS]:
            index = np.array(np.unravel_index(peak, score.shape))
            shift = (index - np.array(counts[0].shape) + 1 + shell_cells[1] - counts[1]) * cell
            similarity = np.eye(4)
            similarity[:3, :3] = scale * axes.T @ scene_axes
            similarity[:3, 3] = axes.T @ (target + shift - scale * middle)
            found.append((float(score.flat[peak]), similarity))
    return found


def _cells(points: np.ndarray, cell: float, counted: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """A dense box of cells with the points in each (or 1 where there are any), and its lowest cell's index."""
    index = np.floor(points / cell).astype(int)
    inside = np.abs(points[:, 2]) < 2.0
    index = index[inside]
    low = index.min(0)
    grid = np.zeros(index.max(0) - low + 1)
    np.add.at(grid, tuple((index - low).T), 1.0)
    return (grid if counted else (grid > 0).astype(float)), low


def _score(surface: ShellSurface, points: np.ndarray) -> float:
    precision = float((surface.distance(points) < _FIT).mean())
    samples, _ = surface.samples(5000)
    recall = float((KDTree(points).query(samples)[0] < 5 * _FIT).mean())
    return 2 * precision * recall / max(precision + recall, 1e-9)


def _displacement(one: np.ndarray, other: np.ndarray, vertices: np.ndarray) -> float:
    """Mean distance between the shell in one place and in another, in the metres of the first."""
    moved = transformed(vertices, one @ np.linalg.inv(other))
    return float(np.linalg.norm(moved - vertices, axis=1).mean())


def _distinct(starts: Sequence[tuple[float, np.ndarray]], vertices: np.ndarray) -> list[np.ndarray]:
    """The best of each group of places that differ by little, as far as they are refined."""
    kept: list[np.ndarray] = []
    for _, start in sorted(starts, key=lambda start: -start[0]):
        if all(_displacement(other, start, vertices) > _DIFFERENT for other in kept):
            kept.append(start)
        if len(kept) == _REFINED:
            break
    return kept
