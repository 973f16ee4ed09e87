"""Coarse registration: propose an alignment from the SfM points, the cameras and the shell alone.

Facades repeat themselves, so feature descriptors can register them a whole number of bays off, with perfect scores.
Instead, the search is exhaustive: over the orientations that put walls of the SfM points on walls of the shell, over
scales, and, by correlation of coarse grids, over all shifts. The best placements are measured along the cameras'
sightlines, refined, and measured again, ever more finely; close rivals of the best are reported. The result is a
proposal for the user to check.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float64
from scipy.fft import irfftn, next_fast_len, rfftn
from scipy.ndimage import uniform_filter

from shellgs_method.errors import SceneError
from shellgs_method.files.photographs import View
from shellgs_method.files.sparse_points import SparsePoints
from shellgs_method.geometry.camera import positions
from shellgs_method.geometry.similarity import affine, scale_of, transformed
from shellgs_method.geometry.triangles import Triangles
from shellgs_method.machine.progress import track
from shellgs_method.registration.geotags import REACH, GeoTags
from shellgs_method.registration.orientations import scene_axes, shell_axes
from shellgs_method.registration.refinement import FINAL_GATE, refine
from shellgs_method.registration.repetition import SHORTEST
from shellgs_method.registration.sightlines import Sightlines
from shellgs_method.registration.validation import LIMITS
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
_ONE_PLACE = 4.0  # metres of displacement, below which two candidates may be the same place
_STEEP = 0.97  # share of a candidate's score, below which it is another place if the shell fits worse on the way to it
_FLAT = 0.95  # share of the best score from which a shell fits as well; 10 to 20 cm beside its place, a scan has less
_UPRIGHT = 0.9  # cosine of the building's up direction and an axis of the shell's file
_NEAR = 3 * REACH  # metres from geo-tags


@dataclass(frozen=True)
class Candidate:
    """A candidate alignment.

    Attributes:
        survey_from_scene: similarity.
        score: agreement with the cameras' sightlines; between cells of grids at first.
        displacement: mean displacement of what is seen of the shell from the best candidate, in metres.
        imprecision: of the best candidate, which ways and by less than how many metres the shell may be moved along the
            main wall and fits nearly as well, as on bare walls.
    """

    survey_from_scene: Float64[np.ndarray, "4 4"]
    score: float
    displacement: float = 0.0
    imprecision: Mapping[str, float] = field(default_factory=dict)


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
        tags: geo-tags of the photographs, for a shell whose z axis is up. The search is near them, in a shell that may
            be of a whole district, and elsewhere only if the shell does not fit there.

    Raises:
        SceneError: the SfM points have no main wall, or it fits nowhere.
    """
    seen = _Seen.of(views, points, scene_up)
    near = _near(tags, surface, seen) if tags is not None else []
    if near and near[0].score > LIMITS["agreement"].refused:
        return near
    anywhere = _anywhere(surface, seen)
    if near and (not anywhere or near[0].score > AMBIGUOUS * anywhere[0].score):
        return near
    if not anywhere:
        size = float(np.ptp(surface.vertices, axis=0).max())
        raise SceneError(
            f"no alignment of the shell was found, which is taken to be {size:.4g} m large: if it is not, give "
            "--metres-per-shell-unit (0.001 for millimetres); if it is, pick points in the photographs and use --picks"
        )
    return anywhere


@dataclass(frozen=True)
class _Seen:
    """What the photographs show, in the scene's frame.

    Attributes:
        points: SfM points, without those far out.
        sight: sightlines to some.
        axes: right, up and out of the main wall, as rows.
    """

    points: np.ndarray
    sight: Sightlines
    axes: np.ndarray

    @classmethod
    def of(cls, views: Sequence[View], points: SparsePoints, up: np.ndarray) -> _Seen:
        near = _most(points.positions)
        axes = scene_axes(near, positions(view.camera for view in views), up)
        return cls(near, Sightlines.of(views, points), axes)


def _anywhere(surface: Triangles, seen: _Seen) -> list[Candidate]:
    """Alignments in any orientation and of any scale, the best first."""
    samples, triangle = surface.samples(_SAMPLES)
    search, fit = _Search.of(samples, seen), _Fit.of(surface, samples, seen)
    return fit.ranked(fit.polished(search.starts(shell_axes(surface.normals[triangle]), seen.axes), search.cell))


def _near(tags: GeoTags, surface: Triangles, seen: _Seen) -> list[Candidate]:
    """Upright alignments within 30 m of geo-tags, the best first.

    Of those that fit well, only ones about as near as the nearest are left: all tags may have a common bias.
    """
    tags = tags.fresh
    scales = tags.scales(seen.axes[1])
    away = np.linalg.norm(seen.sight.points - np.median(tags.cameras, axis=0), axis=1)
    reach = _NEAR + scales[1] * np.percentile(away, 95)
    low, high = np.median(tags.places, axis=0) + reach * np.array([[-1], [1]])  # by the median: some may be far off
    part = surface.within(low, high)
    if not len(part.faces):
        return []
    samples, triangle = part.samples(_SAMPLES)
    inside = ((samples[:, :2] > low) & (samples[:, :2] < high)).all(axis=1)
    if not inside.any():
        return []
    search, fit = _Search.of(samples[inside], seen, scales, tags), _Fit.of(part, samples[inside], seen)
    turns = shell_axes(part.normals[triangle[inside]], up=np.array([0.0, 0.0, 1.0]))
    starts = [start for start in search.starts(turns, seen.axes) if tags.apart(start.survey_from_scene) < _NEAR]
    found = fit.polished(starts, search.cell)
    apart = [tags.apart(candidate.survey_from_scene) for candidate in found]
    least = AMBIGUOUS * max((candidate.score for candidate in found), default=0.0)
    nearest = min((off for off, each in zip(apart, found, strict=True) if each.score >= least), default=0.0)
    return fit.ranked([each for off, each in zip(apart, found, strict=True) if off <= nearest + REACH])


@dataclass(frozen=True)
class _Search:
    """The search over scales and shifts.

    Attributes:
        samples: points of the shell's surface.
        points: SfM points.
        empty: points in the air that sightlines pass through.
        cell: length of a cell in metres.
        scales: least and greatest scale.
        tags: geo-tags that cameras are near, if there are any.
    """

    samples: np.ndarray
    points: np.ndarray
    empty: np.ndarray
    cell: float
    scales: tuple[float, float]
    tags: GeoTags | None

    @classmethod
    def of(
        cls,
        samples: np.ndarray,
        seen: _Seen,
        scales: tuple[float, float] = (0.0, np.inf),
        tags: GeoTags | None = None,
    ) -> _Search:
        size = np.ptp(samples, axis=0)
        cell = float(np.prod(np.maximum(size, 0.05 * size.max())) / _CELLS) ** (1 / 3)
        if tags is not None:  # a small part of a district is seen
            cell = float(np.clip(1.0, cell / 1.8, cell))
        rng = np.random.default_rng(0)
        sight, points = seen.sight, seen.points
        low, high = points.min(0), points.max(0)
        back = sight.origins - sight.points
        back *= np.minimum(1.0, np.linalg.norm(high - low) / np.linalg.norm(back, axis=1, keepdims=True))
        empty = (sight.points + rng.uniform(0.05, 1.0, (12, len(back), 1)) * back).reshape(-1, 3)
        inside = ((empty > low) & (empty < high)).all(axis=1)
        return cls(samples, points, empty[inside], cell, scales, tags)

    def starts(self, shell_axes: Sequence[np.ndarray], scene_axes: np.ndarray) -> list[Candidate]:
        """The best candidates of all orientations: those that turn the scene's axes to some of the shell's."""
        turns = track([to.T @ scene_axes for to in shell_axes], "Trying orientations", len(shell_axes))
        return [start for turn in turns for start in self.placed(turn)]

    def placed(self, turn: np.ndarray) -> Iterator[Candidate]:
        """The best candidates of an orientation: the rotation from the scene's axes to the survey's."""
        points, empty = self.points @ turn.T, self.empty @ turn.T
        boxes = [np.percentile(each, [3, 97], axis=0) for each in (self.samples, points)]
        extent = np.maximum(np.ptp(boxes[0], axis=0), 0.1 * self.cell)  # a shell may be one flat wall
        seen = np.ptp(boxes[1], axis=0)
        ratios = np.sort(extent / np.maximum(seen, max(_THINNEST * seen.max(), 1e-9)))
        smaller = 0.5 if self.tags is None else 0.15  # a district is also higher than the building that is seen of it
        lowest, highest = np.clip([smaller * ratios[0], 1.6 * ratios[2]], *self.scales)
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
            # Shifts before the first are at the end.
            shifts = [np.r_[:n, n - m : 0] for n, m in zip(shell.shape, shape, strict=True)]
            moves = [(first[k] - low[k] + shifts[k]) * self.cell for k in range(3)]
            if self.tags is not None:
                east, north = self.tags.shift(scale * turn)
                score[np.hypot.outer(moves[0] - east, moves[1] - north) > _NEAR] = -np.inf
            for index, value in _peaks(score):
                yield Candidate(affine(scale * turn, [moves[k][i] for k, i in enumerate(index)]), value)


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
        if score[index] == -np.inf:
            return
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
        axes: right, up and out of the main wall in the scene, as rows.
    """

    surface: Triangles
    points: np.ndarray
    sight: Sightlines
    spread: np.ndarray
    axes: np.ndarray

    @classmethod
    def of(cls, surface: Triangles, samples: np.ndarray, seen: _Seen) -> _Fit:
        return cls(surface, np.random.default_rng(0).permutation(seen.points), seen.sight, samples[:200], seen.axes)

    def polished(self, starts: Sequence[Candidate], cell: float) -> list[Candidate]:
        """The best candidates, refined ever more finely.

        Args:
            starts: what to start from.
            cell: how far they may be off, in metres.
        """
        starts = self.distinct(starts, _MEASURED, cell)
        measured = track(starts, "Measuring candidates", len(starts))
        starts = [self.measured(start.survey_from_scene, _ROUGH) for start in measured]
        for number, (count, few, apart, reach, steps) in enumerate(_ROUNDS, 1):
            starts = self.distinct(starts, count, apart * cell)
            starts = [start for start in starts if start.score > _HOPEFUL * starts[0].score]
            hopeful = track(starts, f"Refining candidates, round {number}", len(starts))
            starts = [found for s in hopeful for found in self.refined(s, few, reach * cell, _COARSE, steps)]
        starts = [self.measured(start.survey_from_scene, _FIT) for start in starts]  # of far views, many fit coarsely
        starts, polished = self.distinct(starts, _POLISHED, self.different(starts)), []
        for start in track(starts, "Refining the best", len(starts)):
            reach = 2 * _COARSE * self.sight.distance(start.survey_from_scene)
            polished += self.refined(start, _MANY, reach, _FIT, 30)
        return [candidate for candidate in polished if candidate.score > 0]

    def ranked(self, candidates: Sequence[Candidate]) -> list[Candidate]:
        """Candidates a bay or more apart, the best first, how imprecise it is, and how far the others are from it."""
        kept = self.distinct(candidates, _POLISHED, max(SHORTEST, self.different(candidates)))
        best = [replace(each, imprecision=self.imprecision(each)) for each in kept[:1]]
        others = (replace(other, displacement=self.apart(other, kept[0])) for other in kept[1:])
        rivals = (other for other in others if not self.is_upside_down(other, kept[0]))
        return [*best, *(rival for rival in rivals if not self.is_one_place(rival, kept[0]))]

    def different(self, candidates: Sequence[Candidate]) -> float:
        """Metres from which candidates differ: the farther away the cameras are, the more."""
        distances = [_DIFFERENT_FROM_AFAR * self.sight.distance(each.survey_from_scene) for each in candidates[:1]]
        return max([_DIFFERENT, *distances])

    def measured(self, similarity: np.ndarray, tolerance: float) -> Candidate:
        return Candidate(similarity, self.sight.agreement(self.surface, similarity, tolerance))

    def refined(self, start: Candidate, few: int, reach: float, tolerance: float, steps: int) -> list[Candidate]:
        """The candidate refined from an error of ``reach`` metres, and measured; none if too few points are in reach.

        As it was, where it agreed far better: walls beside the right one, within reach, pull it off.

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
        after, before = (self.measured(each.survey_from_scene, tolerance) for each in (found, start))
        return [after if after.score > AMBIGUOUS * before.score else before]

    def distinct(self, candidates: Sequence[Candidate], count: int, apart: float) -> list[Candidate]:
        """Up to ``count`` candidates, best first, each the best of those less than ``apart`` metres from it."""
        best = sorted(candidates, key=lambda candidate: -candidate.score)
        # Where the shell is in the scene, relative to the size of it there: shells of all scales are compared alike.
        placed = [transformed(self.spread, np.linalg.inv(candidate.survey_from_scene)) for candidate in best]
        middles = np.array([each.mean(axis=0) for each in placed])  # no farther apart than the points in the mean
        kept: list[int] = []
        for k in range(len(best)):
            reach = apart / scale_of(best[k].survey_from_scene)
            near = np.array(kept, int)[np.linalg.norm(middles[kept] - middles[k], axis=1) <= reach]
            if all(np.linalg.norm(placed[other] - placed[k], axis=1).mean() > reach for other in near):
                kept.append(k)
                if len(kept) == count:
                    break
        return [best[k] for k in kept]

    def apart(self, other: Candidate, best: Candidate) -> float:
        """Mean displacement of the points between two candidates, in metres."""
        points, to = self.points[:_MANY], best.survey_from_scene
        moved = transformed(points, np.linalg.inv(other.survey_from_scene) @ to) - points
        return scale_of(to) * float(np.linalg.norm(moved, axis=1).mean())

    def is_upside_down(self, other: Candidate, best: Candidate) -> bool:
        """Whether another candidate turns the building over, where the best has z or y of the shell's file up."""
        placed = (each.survey_from_scene for each in (best, other))
        up, down = (to[:3, :3] @ self.axes[1] / scale_of(to) for to in placed)
        return max(up[1:]) > _UPRIGHT and up @ down < -_UPRIGHT

    def is_one_place(self, other: Candidate, best: Candidate) -> bool:
        """Whether a rival is where the best candidate is, imprecise as bare walls are: it fits as well all the way."""
        if other.displacement >= _ONE_PLACE or other.score < AMBIGUOUS * best.score:
            return False
        # In fifths, since halfway there may be the bay in between. So near, the mean of two similarities is one.
        to, end = best.survey_from_scene, other.survey_from_scene
        way = (to + share * (end - to) for share in (0.2, 0.4, 0.6, 0.8))
        return all(self.measured(each, _FIT).score >= _STEEP * other.score for each in way)

    def imprecision(self, best: Candidate) -> dict[str, float]:
        """Metres, at most 4, from which the shell fits worse if it is moved; without ways in which it does at once."""
        turn = best.survey_from_scene[:3, :3] / scale_of(best.survey_from_scene)
        right, up, _ = self.axes @ turn.T
        step, found = self.different([best]), {}
        for way, direction in {"upwards": up, "downwards": -up, "to the right": right, "to the left": -right}.items():
            length = step
            while length < _ONE_PLACE:
                moved = affine(np.eye(3), -length * direction) @ best.survey_from_scene  # the scene, the other way
                if self.measured(moved, _FIT).score < _FLAT * best.score:
                    break
                length += step
            if length > step:
                found[way] = length
        return found


def _most(points: np.ndarray) -> np.ndarray:
    """The points that are near the others: a few far out would make large grids of empty cells."""
    if len(points) == 0:
        return points
    low, high = np.percentile(points, [5, 95], axis=0)
    margin = 0.35 * (high - low)
    return points[((points > low - margin) & (points < high + margin)).all(axis=1)]
