"""A start for the alignment where there is none: a guess from up, the main wall and its outline.

Facades repeat themselves, so that features and their descriptors register them a whole number of bays off, with perfect
scores. What is searched here exhaustively instead is all the places that put the main wall of the SfM points upright on
a wall of the shell: which wall, at which scale, where on it. The best ones are refined and ranked, and those that come
close to the best are named. The outcome is a proposal for people to look at.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64
from scipy.ndimage import maximum_filter
from scipy.signal import fftconvolve
from scipy.spatial import KDTree

from dataparsers.errors import SceneError
from shellgs_method.open3d import import_open3d
from shellgs_method.shell.geometry.similarity import transformed
from shellgs_method.shell.geometry.surface import ShellSurface
from shellgs_method.shell.registration.bays import wall_axes
from shellgs_method.shell.registration.refinement import FINAL_GATE, refine

AMBIGUOUS = 0.90
"""Share of the best score from which another place is named beside it."""
_DIFFERENT = 0.5  # metres of mean displacement from which two places are two
_PEAKS = 6  # shifts that are kept for a wall and a scale, a metre or more apart
_KEPT = 10  # places that are kept on each wall
_REFINED = 20  # places on all walls that are refined
_FEW = 1000  # SfM points tell a good place from a bad one; what is returned is fitted to all
_SCALE_STEP = 1.04
_FLAT = 0.05  # breadth of the SfM wall over its length within which points are on it
_ROUGH, _FIT = 0.50, 0.10  # metres from the shell within which a point fits, before refinement and after
_BESIDE = 0.50  # metres
_REACH = 1.0  # metres


@dataclass(frozen=True)
class Candidate:
    """A place for the shell.

    Attributes:
        survey_from_scene: similarity.
        score: harmonic mean of the share of the wall's SfM points within 10 cm of the shell and the share of the
            shell's surface that has SfM points beside it.
        displacement: mean distance from the best candidate's place, in metres.
    """

    survey_from_scene: Float64[np.ndarray, "4 4"]
    score: float
    displacement: float = 0.0


@dataclass(frozen=True)
class _Cloud:
    """The SfM points, those on their main wall or near it, and right, up and out of that wall, as rows."""

    points: Float64[np.ndarray, "N 3"]
    wall: Float64[np.ndarray, "W 3"]
    axes: Float64[np.ndarray, "3 3"]

    def thinned(self) -> _Cloud:
        return replace(self, points=_some(self.points, _FEW), wall=_some(self.wall, _FEW))


def propose(
    surface: ShellSurface,
    points: Float64[np.ndarray, "N 3"],
    cameras: Float64[np.ndarray, "V 3"],
    scene_up: Float64[np.ndarray, " 3"],
    shell_up: Float64[np.ndarray, " 3"],
) -> list[Candidate]:
    """Places for the shell, the best first, then those whose score is within 10 % of it.

    Args:
        surface: the shell.
        points: SfM points in the scene's frame.
        cameras: positions of the cameras, all on the outside.
        scene_up: up as the cameras hold it, roughly.
        shell_up: up in the shell's axes; where its walls are askew to that, their own directions are tried as well.

    Raises:
        SceneError: the SfM points have no main wall, or it fits nowhere.
    """
    cloud = _main_wall(points, cameras, scene_up)
    few = cloud.thinned()
    samples, normals = surface.samples(20_000)
    spread = _some(samples, 5000)
    starts: list[Candidate] = []
    for up in _upwards(normals, shell_up):
        for axes, wall in _shell_walls(samples, normals, up):
            # Of each wall the best, for by their cells walls of different sizes do not compare.
            starts += _distinct(_places(cloud, axes, wall), spread, _KEPT)
    starts = [replace(s, score=_score(surface, spread, few, s.survey_from_scene, _ROUGH)) for s in starts]
    found = _refined(surface, spread, few, _best_first(starts)[:_REFINED], _REACH)
    if not found:
        raise SceneError("no place was found for the shell: pick points in the photographs and use --picks")
    found = _refined(surface, spread, cloud, _close_to_best(_distinct(found, spread, _KEPT)), 2 * FINAL_GATE)
    best, *rivals = _close_to_best(_best_first(found))
    return [best, *(replace(rival, displacement=_displacement(best, rival, spread)) for rival in rivals)]


def _main_wall(points: np.ndarray, cameras: np.ndarray, up: np.ndarray) -> _Cloud:
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
            near = np.abs((points - centre) @ out) < _FLAT * size
            return _Cloud(points, points[near], wall_axes(out, up))
        left = np.delete(left, inliers, axis=0)
    raise SceneError("the SfM points have no upright wall to start from: pick points and use --picks")


def _upwards(normals: np.ndarray, up: np.ndarray) -> list[np.ndarray]:
    """Up in the shell: as its file has it, or where its walls are askew to that, each of their axes, either way."""
    first = _commonest(normals)
    across = normals[np.abs(normals @ first) < 0.2]
    if len(across) < 100:
        return [up]
    axes = wall_axes(first, _commonest(across))
    return [up] if np.abs(axes @ up).max() > 0.97 else [*axes, *-axes]


def _commonest(normals: np.ndarray) -> np.ndarray:
    """The direction, up to its sign, that most normals have within 20°."""
    some = normals[:: max(1, len(normals) // 1000)]
    alike = np.abs(some @ some.T) > 0.94
    group = some[alike[alike.sum(axis=1).argmax()]]
    return np.linalg.eigh(group.T @ group)[1][:, 2]


def _shell_walls(samples: np.ndarray, normals: np.ndarray, up: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Right, up and out of up to four walls of the shell, seen from either side, and samples of the surface there."""
    upright = np.abs(normals @ up) < 0.2
    samples, normals = samples[upright], normals[upright]
    for _ in range(4):
        if len(samples) < 1000:
            return
        out = _commonest(normals)
        out = out - (out @ up) * up
        out /= np.linalg.norm(out)
        alike = np.abs(normals @ out) > 0.94
        height = samples @ out
        peak, edges = np.histogram(height[alike], bins=np.arange(height.min() - 0.5, height.max() + 1.0, 0.5))
        level = edges[peak.argmax()] + 0.25
        wall = np.abs(height - level) < 1.0
        for side in (out, -out):
            yield wall_axes(side, up), samples[wall]
        samples, normals = samples[~(wall & alike)], normals[~(wall & alike)]


def _places(cloud: _Cloud, axes: np.ndarray, samples: np.ndarray) -> list[Candidate]:
    """The best places on one wall, over all scales and shifts by cells.

    Both walls are boxes of cells; their correlation counts, for every shift at once, the points in the shell's cells
    and the shell's cells that have points.
    """
    flat, wall = cloud.wall @ cloud.axes.T, samples @ axes.T
    middle, target = np.median(flat, axis=0), (wall.min(0) + wall.max(0)) / 2
    boxes = [np.percentile(p[:, :2], [2, 98], axis=0) for p in (wall, flat)]
    sizes = [np.ptp(box, axis=0) for box in boxes]
    margin = 0.2 * sizes[1]  # a few points far out would make for boxes of empty cells
    flat = flat[((flat[:, :2] > boxes[1][0] - margin) & (flat[:, :2] < boxes[1][1] + margin)).all(axis=1)]
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
        best = score.max(axis=2)  # over the shifts out of the wall
        peaks = np.argwhere(best == maximum_filter(best, 2 * round(1.0 / cell) + 1))
        for u, v in peaks[np.argsort(-best[tuple(peaks.T)])][:_PEAKS]:
            index = np.array([u, v, score[u, v].argmax()])
            shift = (index - np.array(counts[0].shape) + 1 + shell_cells[1] - counts[1]) * cell
            similarity = np.eye(4)
            similarity[:3, :3] = scale * axes.T @ cloud.axes
            similarity[:3, 3] = axes.T @ (target + shift - scale * middle)
            found.append(Candidate(similarity, float(best[u, v])))
    return found


def _cells(points: np.ndarray, cell: float, counted: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """A dense box of cells with the points in each (or 1 where there are any), and its lowest cell's index."""
    index = np.floor(points / cell).astype(int)
    inside = np.abs(points[:, 2]) < 2.0
    index = index[inside]
    low = index.min(0)
    grid = np.zeros(index.max(0) - low + 1, np.float32)
    np.add.at(grid, tuple((index - low).T), 1.0)
    return (grid if counted else (grid > 0).astype(np.float32)), low


def _refined(
    surface: ShellSurface, spread: np.ndarray, cloud: _Cloud, starts: Sequence[Candidate], reach: float
) -> list[Candidate]:
    """The places brought closer to the points, without those that are too far off for it."""
    found = []
    for start in starts:
        try:
            similarity = refine(surface, cloud.points, start.survey_from_scene, reach).survey_from_scene
        except SceneError:
            continue
        found.append(Candidate(similarity, _score(surface, spread, cloud, similarity, _FIT)))
    return found


def _score(surface: ShellSurface, spread: np.ndarray, cloud: _Cloud, similarity: np.ndarray, fit: float) -> float:
    placed = transformed(cloud.wall, similarity)
    precision = float((surface.distance(placed) < fit).mean())
    recall = float(np.isfinite(KDTree(placed).query(spread, distance_upper_bound=_BESIDE)[0]).mean())
    return 2 * precision * recall / max(precision + recall, 1e-9)


def _best_first(candidates: Sequence[Candidate]) -> list[Candidate]:
    return sorted(candidates, key=lambda candidate: -candidate.score)


def _close_to_best(candidates: Sequence[Candidate]) -> list[Candidate]:
    """Those within 10 % of the first, which is the best."""
    return [candidate for candidate in candidates if candidate.score >= AMBIGUOUS * candidates[0].score]


def _distinct(candidates: Sequence[Candidate], spread: np.ndarray, count: int) -> list[Candidate]:
    """So many places, best first, each the best of a group that differ by little."""
    kept: list[Candidate] = []
    for candidate in _best_first(candidates):
        if all(_displacement(other, candidate, spread) > _DIFFERENT for other in kept):
            kept.append(candidate)
        if len(kept) == count:
            break
    return kept


def _displacement(one: Candidate, other: Candidate, spread: np.ndarray) -> float:
    """Mean distance between the shell in one place and in another, in the metres of the first."""
    some = spread[:200]
    moved = transformed(some, one.survey_from_scene @ np.linalg.inv(other.survey_from_scene))
    return float(np.linalg.norm(moved - some, axis=1).mean())


def _some(points: np.ndarray, count: int) -> np.ndarray:
    """Not more than so many of the points, by chance, the same ones each time."""
    return np.random.default_rng(0).permutation(points)[:count]
