"""Coarse registration: propose an alignment from the SfM points, the cameras and the shell alone.

Facades repeat themselves, so feature descriptors can register them a whole number of bays off, with perfect scores.
Instead, the search is exhaustive: over the orientations that put walls of the SfM points on walls of the shell, over
scales, and, by correlation of coarse grids, over all shifts. The best placements are measured along the cameras'
sightlines, refined, and measured again, ever more finely; close rivals of the best are reported. The result is a
proposal for the user to check.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64
from scipy.fft import irfftn, next_fast_len, rfftn
from scipy.ndimage import uniform_filter

from shellgs_method.errors import SceneError
from shellgs_method.files.photographs import View
from shellgs_method.files.sparse_points import SparsePoints
from shellgs_method.geometry.camera import positions
from shellgs_method.geometry.similarity import scale_of, transformed
from shellgs_method.machine.progress import track
from shellgs_method.registration.geotags import REACH, GeoTags
from shellgs_method.registration.orientations import scene_axes, shell_axes
from shellgs_method.registration.refinement import FINAL_GATE, refine
from shellgs_method.registration.sightlines import Sightlines
from shellgs_method.shell.surface import ShellSurface

AMBIGUOUS = 0.90
"""Share of the best score from which another candidate is reported as a rival."""
_SAMPLES = 20_000  # points of the shell's surface
_CELLS = 20_000  # of the shell's grid
_SCALE_STEP = 1.06
_THINNEST = 1e-3  # of SfM points, relative to their extent: by what is exactly flat, scales would have no end
_LARGEST = 2_000_000  # cells of a grid that the shell is shifted in
_PEAKS = 3  # shifts kept per orientation and scale
_EMPTY = 0.5  # weight of cells that sightlines pass through, against those with points
# Candidates that are measured and refined, and tolerances relative to the distance: errors of SfM points grow with it,
# and what a smaller scale brings nearer to the shell fits no better.
_MEASURED, _POLISHED = 1000, 12
_ROUNDS = ((500, 250, 1, 2, 10), (150, 800, 1, 4, 20))  # candidates, SfM points, how far apart and off in cells, steps
_HOPEFUL = 0.6  # share of the best score from which candidates are refined: rivals that prove a place ambiguous too
_MANY = 4000  # SfM points in the end
_ROUGH, _COARSE, _FIT = 0.04, 0.012, 0.004
_DIFFERENT = 0.5  # metres of mean displacement from which two candidates differ, or that share of the distance:
_DIFFERENT_FROM_AFAR = 0.01


@dataclass(frozen=True)
class Candidate:
    """A candidate alignment.

    Attributes:
        survey_from_scene: similarity.
        score: agreement with the cameras' sightlines; between cells of grids at first.
        displacement: mean displacement of the shell from the best candidate, in metres.
    """

    survey_from_scene: Float64[np.ndarray, "4 4"]
    score: float
    displacement: float = 0.0


def propose(
    surface: ShellSurface,
    points: SparsePoints,
    views: Sequence[View],
    scene_up: Float64[np.ndarray, " 3"],
    tags: GeoTags | None = None,
) -> list[Candidate]:
    """Propose alignments, the best first, and what fits best elsewhere.

    Args:
        surface: the shell, in any orientation.
        points: SfM points in the scene's frame.
        views: photographs, all taken from outside the building.
        scene_up: approximate up direction of the cameras.
        tags: geo-tags of the photographs: only alignments near them are looked at, if there are any; of those that
            fit well, only ones about as near as the nearest, since all tags may have a common bias.

    Raises:
        SceneError: the SfM points have no main wall, or it fits nowhere.
    """
    samples, triangle = surface.samples(_SAMPLES)
    cameras = positions(view.camera for view in views)
    near = _most(points.positions)
    axes = scene_axes(near, cameras, scene_up)
    sight = Sightlines.of(views, points)
    fit = _Fit(surface, np.random.default_rng(0).permutation(near), sight, samples[:200])
    search = _Search.of(samples, near, sight)
    turns = [to.T @ axes for to in shell_axes(surface.normals[triangle])]
    starts = [start for turn in track(turns, "Trying orientations", len(turns)) for start in search.placed(turn)]
    if tags is not None:
        agreeing = [start for start in starts if tags.apart(start.survey_from_scene) < 3 * REACH]
        starts, tags = (agreeing, tags) if agreeing else (starts, None)
    starts = fit.distinct(starts, _MEASURED, search.cell)
    starts = [fit.measured(s.survey_from_scene, _ROUGH) for s in track(starts, "Measuring candidates", len(starts))]
    for number, (count, few, apart, reach, steps) in enumerate(_ROUNDS, 1):
        starts = fit.distinct(starts, count, apart * search.cell)
        starts = [start for start in starts if start.score > _HOPEFUL * starts[0].score]
        hopeful = track(starts, f"Refining candidates, round {number}", len(starts))
        starts = [found for s in hopeful for found in fit.refined(s, few, reach * search.cell, _COARSE, steps)]
    different = max([_DIFFERENT, *(_DIFFERENT_FROM_AFAR * sight.distance(s.survey_from_scene) for s in starts[:1])])
    starts = fit.distinct(starts, _POLISHED, different)
    polished = []
    for start in track(starts, "Refining the best", len(starts)):
        polished += fit.refined(start, _MANY, 2 * _COARSE * sight.distance(start.survey_from_scene), _FIT, 30)
    polished = [candidate for candidate in polished if candidate.score > 0]
    if not polished:
        size = float(np.ptp(surface.vertices, axis=0).max())
        raise SceneError(
            f"no alignment of the shell was found, which is taken to be {size:.4g} m large: if it is not, give "
            "--metres-per-shell-unit (0.001 for millimetres); if it is, pick points in the photographs and use --picks"
        )
    if tags is not None:
        apart = [tags.apart(candidate.survey_from_scene) for candidate in polished]
        least = AMBIGUOUS * max(candidate.score for candidate in polished)
        nearest = min(off for off, candidate in zip(apart, polished, strict=True) if candidate.score >= least)
        polished = [candidate for off, candidate in zip(apart, polished, strict=True) if off <= nearest + REACH]
    best, *others = fit.distinct(polished, _POLISHED, different)
    return [best, *(replace(other, displacement=fit.displacement(best, other)) for other in others)]


@dataclass(frozen=True)
class _Search:
    """The search over scales and shifts.

    Attributes:
        samples: points of the shell's surface.
        points: SfM points.
        empty: points in the air that sightlines pass through.
        cell: length of a cell in metres.
    """

    samples: np.ndarray
    points: np.ndarray
    empty: np.ndarray
    cell: float

    @classmethod
    def of(cls, samples: np.ndarray, points: np.ndarray, sight: Sightlines) -> _Search:
        size = np.ptp(samples, axis=0)
        cell = float(np.prod(np.maximum(size, 0.05 * size.max())) / _CELLS) ** (1 / 3)
        rng = np.random.default_rng(0)
        share = rng.uniform(0.0, 0.95, (12, len(sight.points), 1))
        empty = (sight.origins + share * (sight.points - sight.origins)).reshape(-1, 3)
        low, high = points.min(0), points.max(0)
        return cls(samples, points, empty[((empty > low) & (empty < high)).all(axis=1)], cell)

    def placed(self, turn: np.ndarray) -> Iterator[Candidate]:
        """The best candidates of an orientation: the rotation from the scene's axes to the survey's."""
        points, empty = self.points @ turn.T, self.empty @ turn.T
        boxes = [np.percentile(each, [3, 97], axis=0) for each in (self.samples, points)]
        extent = np.maximum(np.ptp(boxes[0], axis=0), 0.1 * self.cell)  # a shell may be one flat wall
        seen = np.ptp(boxes[1], axis=0)
        ratios = np.sort(extent / np.maximum(seen, max(_THINNEST * seen.max(), 1e-9)))
        lowest, highest = 0.5 * ratios[0], 1.6 * ratios[2]
        steps = int(np.log(highest / lowest) / np.log(_SCALE_STEP)) + 1
        first = np.floor(self.samples.min(0) / self.cell).astype(int) - 1
        shell = _grid(self.samples, first, np.floor(self.samples.max(0) / self.cell).astype(int) + 2, self.cell)
        soft = np.maximum(shell, uniform_filter(shell, 3) * 3).clip(max=1.0)
        spectra: dict[tuple[int, ...], np.ndarray] = {}
        for scale in highest * _SCALE_STEP ** -np.arange(steps):
            placed, passed = scale * points, scale * empty
            low, high = (np.floor(each / self.cell).astype(int) for each in (placed.min(0), placed.max(0)))
            size = high - low + 1
            shape = tuple(int(next_fast_len(int(n), real=True) or n) for n in shell.shape + size)
            if np.prod(shape) > _LARGEST:  # much larger than the shell
                continue
            occupied = _grid(placed, low, high + 1, self.cell)
            free = _grid(passed, low, high + 1, self.cell)
            free[occupied > 0] = 0
            if shape not in spectra:
                spectra[shape] = np.asarray(rfftn(soft, shape))
            weighted = occupied / (occupied.sum() + 0.5 * shell.sum()) - _EMPTY * free / (free.sum() + shell.sum())
            spectrum = np.asarray(rfftn(weighted.astype(np.float32), shape))
            score = np.asarray(irfftn(spectra[shape] * np.conj(spectrum), shape))
            for index, value in _peaks(score):
                shift = np.array([i if i < n else i - m for i, n, m in zip(index, shell.shape, shape, strict=True)])
                similarity = np.eye(4)
                similarity[:3, :3] = scale * turn
                similarity[:3, 3] = (first + shift - low) * self.cell
                yield Candidate(similarity, value)


def _grid(points: np.ndarray, low: np.ndarray, end: np.ndarray, cell: float) -> np.ndarray:
    """Dense grid from one cell to before another: 1 where there are points."""
    index = np.floor(points / cell).astype(int) - low
    index = index[((index >= 0) & (index < end - low)).all(axis=1)]
    grid = np.zeros(end - low, np.float32)
    grid[tuple(index.T)] = 1.0
    return grid


def _peaks(score: np.ndarray) -> Iterator[tuple[tuple[int, ...], float]]:
    """The largest values, a few cells apart, and their indices."""
    for _ in range(_PEAKS):
        index = tuple(int(i) for i in np.unravel_index(score.argmax(), score.shape))
        yield index, float(score[index])
        score[tuple(slice(max(i - 2, 0), i + 3) for i in index)] = -np.inf


@dataclass(frozen=True)
class _Fit:
    """How candidates are measured, refined and distinguished.

    Attributes:
        surface: the shell.
        points: SfM points, in random order.
        sight: sightlines to them.
        spread: some points of the shell, by which it is seen how far candidates are apart.
    """

    surface: ShellSurface
    points: np.ndarray
    sight: Sightlines
    spread: np.ndarray

    def measured(self, similarity: np.ndarray, tolerance: float) -> Candidate:
        return Candidate(similarity, self.sight.agreement(self.surface, similarity, tolerance))

    def refined(self, start: Candidate, few: int, reach: float, tolerance: float, steps: int) -> list[Candidate]:
        """The candidate refined from an error of ``reach`` metres, and measured; none if too few points are in reach.

        Args:
            start: the candidate.
            few: how many of the points are looked at.
            reach: its error in metres.
            tolerance: relative to the distance, of the last step.
            steps: most steps.
        """
        last = max(FINAL_GATE, tolerance * self.sight.distance(start.survey_from_scene))
        points, far = self.points[:few], tolerance > _FIT
        try:
            found = refine(self.surface, points, start.survey_from_scene, reach, last=last, steps=steps, relative=far)
        except SceneError:
            return []
        return [self.measured(found.survey_from_scene, tolerance)]

    def distinct(self, candidates: Sequence[Candidate], count: int, apart: float) -> list[Candidate]:
        """Up to ``count`` candidates, best first, each the best of those less than ``apart`` metres from it."""
        best = sorted(candidates, key=lambda candidate: -candidate.score)
        # Where the shell is in the scene, relative to the size of it there: shells of all scales are compared alike.
        placed = [transformed(self.spread, np.linalg.inv(candidate.survey_from_scene)) for candidate in best]
        metres = [scale_of(candidate.survey_from_scene) for candidate in best]
        kept: list[int] = []
        for k in range(len(best)):
            if kept:
                moved = np.linalg.norm(np.stack([placed[other] for other in kept]) - placed[k], axis=2).mean(axis=1)
                if (moved * metres[k] <= apart).any():
                    continue
            kept.append(k)
            if len(kept) == count:
                break
        return [best[k] for k in kept]

    def displacement(self, one: Candidate, other: Candidate) -> float:
        """Mean displacement of the shell between two candidates, in metres."""
        moved = transformed(self.spread, one.survey_from_scene @ np.linalg.inv(other.survey_from_scene))
        return float(np.linalg.norm(moved - self.spread, axis=1).mean())


def _most(points: np.ndarray) -> np.ndarray:
    """The points that are near the others: a few far out would make large grids of empty cells."""
    if len(points) == 0:
        return points
    low, high = np.percentile(points, [5, 95], axis=0)
    margin = 0.35 * (high - low)
    return points[((points > low - margin) & (points < high + margin)).all(axis=1)]
