"""Coarse registration: propose an alignment from the up direction, the main wall and its outline.

Facades repeat themselves, so feature descriptors can register them a whole number of bays off, with perfect scores.
Instead, the search is exhaustive over all alignments that put the main wall of the SfM points upright on a wall of the
shell: which wall, at which scale, where on it. The best ones are refined and ranked, and close rivals of the best are
reported. The result is a proposal for the user to check.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64
from scipy.ndimage import maximum_filter
from scipy.signal import fftconvolve

from shellgs_method.errors import SceneError
from shellgs_method.geometry.axes import main_direction, wall_axes
from shellgs_method.geometry.nearest import point_tree
from shellgs_method.geometry.planes import fitted_plane, largest_plane
from shellgs_method.geometry.similarity import transformed
from shellgs_method.registration.refinement import FINAL_GATE, refine
from shellgs_method.shell.surface import ShellSurface

AMBIGUOUS = 0.90
"""Share of the best score from which another candidate is reported as a rival."""
_DIFFERENT = 0.5  # metres of mean displacement from which two candidates differ
_PEAKS = 6  # shifts kept per wall and scale, a metre or more apart
_KEPT = 10  # candidates kept per wall
_REFINED = 20  # candidates refined, of all walls
_FEW = 1000  # SfM points that suffice to rank candidates; the result is fitted to all
_SCALE_STEP = 1.04
_FLAT = 0.05  # distance from the SfM wall, relative to the points' extent, within which points are on it
_COARSE, _FIT = 0.50, 0.10  # metres from the shell within which a point fits, before refinement and after
_BESIDE = 0.50  # metres
_REACH = 1.0  # metres


@dataclass(frozen=True)
class Candidate:
    """A candidate alignment.

    Attributes:
        survey_from_scene: similarity.
        score: harmonic mean of the share of the wall's SfM points within 10 cm of the shell and the share of the
            shell's surface with SfM points near it.
        displacement: mean displacement of the shell from the best candidate, in metres.
    """

    survey_from_scene: Float64[np.ndarray, "4 4"]
    score: float
    displacement: float = 0.0


@dataclass(frozen=True)
class _Cloud:
    """SfM points, those on or near their main wall, and right, up and out of that wall, as rows."""

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
    """Propose alignments, the best first, followed by those whose score is within 10 % of it.

    Args:
        surface: the shell.
        points: SfM points in the scene's frame.
        cameras: positions of the cameras, all outside the building.
        scene_up: approximate up direction of the cameras.
        shell_up: up in the shell's frame; if its walls are not aligned with it, their own directions are tried instead.

    Raises:
        SceneError: the SfM points have no main wall, or it fits nowhere.
    """
    cloud = _main_wall(points, cameras, scene_up)
    few = cloud.thinned()
    samples, triangle = surface.samples(20_000)
    normals = surface.normals[triangle]
    spread = _some(samples, 5000)
    starts: list[Candidate] = []
    for up in _upwards(normals, shell_up):
        for axes, wall in _shell_walls(samples, normals, up):
            # The best of each wall: scores by cells are not comparable between walls of different sizes.
            starts += _distinct(_wall_candidates(cloud, axes, wall), spread, _KEPT)
    starts = [replace(s, score=_score(surface, spread, few, s.survey_from_scene, _COARSE)) for s in starts]
    found = _refined(surface, spread, few, _best_first(starts)[:_REFINED], _REACH)
    found = _refined(surface, spread, cloud, _close_to_best(_distinct(found, spread, _KEPT)), 2 * FINAL_GATE)
    found = [candidate for candidate in found if candidate.score > 0]
    if not found:
        size = float(np.ptp(surface.vertices, axis=0).max())
        raise SceneError(
            f"no alignment of the shell was found, which is taken to be {size:.4g} m large: if it is not, give "
            "--metres-per-shell-unit (0.001 for millimetres); if it is, pick points in the photographs and use --picks"
        )
    best, *rivals = _close_to_best(_best_first(found))
    return [best, *(replace(rival, displacement=_displacement(best, rival, spread)) for rival in rivals)]


def _main_wall(points: np.ndarray, cameras: np.ndarray, up: np.ndarray) -> _Cloud:
    rng = np.random.default_rng(0)
    size = float(np.linalg.norm(np.percentile(points, 90, axis=0) - np.percentile(points, 10, axis=0)))
    left = points
    for _ in range(5):
        if len(left) < 50:
            break
        members = largest_plane(left, 0.01 * size, rng)
        if not members.any():
            break
        centre, out = fitted_plane(left[members])
        if abs(out @ up) < 0.5:
            out = out * np.sign((cameras.mean(0) - centre) @ out)
            near = np.abs((points - centre) @ out) < _FLAT * size
            return _Cloud(points, points[near], wall_axes(out, up))
        left = left[~members]
    raise SceneError("the SfM points have no upright wall to start from: pick points and use --picks")


def _upwards(normals: np.ndarray, up: np.ndarray) -> list[np.ndarray]:
    """Up directions of the shell to try: ``up``, or if its walls are not aligned with it, their axes in both signs."""
    first = _main_line(normals)
    across = normals[np.abs(normals @ first) < 0.2]
    if len(across) < 100:
        return [up]
    axes = wall_axes(first, _main_line(across))
    return [up] if np.abs(axes @ up).max() > 0.97 else [*axes, *-axes]


def _main_line(normals: np.ndarray) -> np.ndarray:
    """Direction of the most normals within 20°, which a shell may have in either sign."""
    return main_direction(np.concatenate([normals, -normals]), within=20)


def _shell_walls(samples: np.ndarray, normals: np.ndarray, up: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield right, up and out of up to four walls of the shell, from either side, and surface samples on each."""
    upright = np.abs(normals @ up) < 0.2
    samples, normals = samples[upright], normals[upright]
    for _ in range(4):
        if len(samples) < 1000:
            return
        out = _main_line(normals)
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


def _wall_candidates(cloud: _Cloud, axes: np.ndarray, samples: np.ndarray) -> list[Candidate]:
    """Best candidates on one wall, over all scales and all shifts by whole cells.

    Both walls are grids of cells; their correlation counts, for all shifts at once, the points in the shell's cells
    and the shell's cells that have points.
    """
    flat, wall = cloud.wall @ cloud.axes.T, samples @ axes.T
    middle, target = np.median(flat, axis=0), (wall.min(0) + wall.max(0)) / 2
    boxes = [np.percentile(p[:, :2], [2, 98], axis=0) for p in (wall, flat)]
    sizes = [np.ptp(box, axis=0) for box in boxes]
    margin = 0.2 * sizes[1]  # a few points far out would make large grids of empty cells
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
        best = score.max(axis=2)  # over the shifts normal to the wall
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
    """Dense grid with the number of points in each cell (or 1 if there are any), and the index of its lowest cell."""
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
    """Refine candidates, leaving out those with too few points in reach."""
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
    recall = float(np.isfinite(point_tree(placed).query(spread, distance_upper_bound=_BESIDE)[0]).mean())
    return 2 * precision * recall / max(precision + recall, 1e-9)


def _best_first(candidates: Sequence[Candidate]) -> list[Candidate]:
    return sorted(candidates, key=lambda candidate: -candidate.score)


def _close_to_best(candidates: Sequence[Candidate]) -> list[Candidate]:
    """Candidates whose score is within 10 % of the first, which is the best."""
    return [candidate for candidate in candidates if candidate.score >= AMBIGUOUS * candidates[0].score]


def _distinct(candidates: Sequence[Candidate], spread: np.ndarray, count: int) -> list[Candidate]:
    """Up to ``count`` candidates, best first, each the best of a group of similar ones."""
    kept: list[Candidate] = []
    for candidate in _best_first(candidates):
        if all(_displacement(other, candidate, spread) > _DIFFERENT for other in kept):
            kept.append(candidate)
        if len(kept) == count:
            break
    return kept


def _displacement(one: Candidate, other: Candidate, spread: np.ndarray) -> float:
    """Mean displacement of the shell between two candidates, in metres."""
    some = spread[:200]
    moved = transformed(some, one.survey_from_scene @ np.linalg.inv(other.survey_from_scene))
    return float(np.linalg.norm(moved - some, axis=1).mean())


def _some(points: np.ndarray, count: int) -> np.ndarray:
    """Random subset of up to ``count`` points, the same in each call."""
    return np.random.default_rng(0).permutation(points)[:count]
