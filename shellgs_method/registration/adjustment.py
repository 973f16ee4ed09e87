"""Correct bent cameras of a scene by its shell: bundle adjustment with the SfM points that lie on the shell.

A similarity cannot absorb the drift of structure from motion: cameras bend, with hardly any reprojection error, because
of outliers and wrong distortion. The shell's walls are fixed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64, Int64
from threadpoolctl import threadpool_limits

from shellgs_method.errors import SceneError
from shellgs_method.files.colmap import Model
from shellgs_method.geometry.axes import facade_axes
from shellgs_method.geometry.similarity import fit_similarity, scale_of, transformed
from shellgs_method.machine.progress import track
from shellgs_method.registration.bundle import (
    Bundle,
    Objective,
    Observations,
    Planes,
    Positions,
    adjust,
    covariances,
    deviations,
    intersected,
    reprojection_errors,
)
from shellgs_method.registration.bundle_model import adjusted_model, bundle_of, with_distortion, with_finite_points
from shellgs_method.registration.picks import PickedPoint
from shellgs_method.registration.refinement import motions, similarity_by
from shellgs_method.shell.surface import ShellSurface

REACH = 0.3
"""Metres from the shell within which points may be on it before the adjustment: the drift of a walk past a house."""
GATE = 0.05
"""The same in the last rounds: most frames, sills and railings, which a scan lacks, are farther from its planes."""
HELD_OUT = 0.1
"""Share of the tracks that are left out of the adjustment, and checked; more of few (:data:`ENOUGH`)."""
ENOUGH = 200
"""Tracks that are left out, if these are not more than three in ten."""
FEW = 50
"""Number of points on the shell below which the cameras cannot be adjusted or checked."""
SIGNIFICANT = 2.0
"""Standard errors by which held-out points must be likelier with adjusted cameras. True cameras of two scenes do not
reach it, those of the tutorial's film 3.2."""
_FINEST = 0.005
"""Smallest noise of a shell in metres: no scan of a building is better, and no building equals its model."""
_PATCH = 1.0
"""Size in metres of the patches in which a shell's errors are correlated, so that the points of each count as one."""
_PICKED = 0.005
"""Metres: standard deviation of a pick on the shell. Picks are less accurate than that, but SfM points have a common
bias, since many are on frames and sills a centimetre or two off the shell."""
_OUTLYING = 4.0
"""Standard deviations of a keypoint's coordinate from which an observation is wrong. A tenth of a video's are, at edges
that slide along others and at repeated windows; without a robust loss, they bend structure from motion."""
_VIEWS = 3  # observations that are not wrong, which a track needs: nothing checks two
_ROBUST, _GATES, _ROUNDS, _STEPS, _SHIFTS = 4, 7, 24, 3, 10
_LOOSE = 0.3  # metres: a prior that keeps what nothing determines, such as where cameras are along a bare wall
_STILL = 5e-4  # metres that cameras move by in a round, from which they stand still
_WEAK = 0.01  # singular value, relative to the largest, below which a motion of all stays: noise would determine it
_EXPECTATIONS = 50


@dataclass(frozen=True)
class HeldOut:
    """The adjustment judged by held-out tracks, whose points are triangulated.

    Attributes:
        points: how many are near the shell.
        pixels: median reprojection error, before and after.
        metres: median distance from the shell, before and after.
        gain: in the log-likelihood of the points, by its standard error (Vuong 1989), patches of the shell being
            independent.
    """

    points: int
    pixels: tuple[float, float]
    metres: tuple[float, float]
    gain: float

    @property
    def were_straight(self) -> bool:
        """Whether the points are no likelier than by chance afterwards."""
        return not self.gain > SIGNIFICANT


@dataclass(frozen=True)
class _Marks:
    """Picks as the last points of a bundle: where they are seen, and where they are on the shell."""

    seen: Observations
    planes: Planes

    @classmethod
    def of(
        cls, picks: Sequence[PickedPoint], surface: ShellSurface, start: Bundle, seen: Observations, called: list[str]
    ) -> _Marks:
        """The marks of a bundle, whose last points are the picks as they were triangulated."""
        first = len(start.points) - len(picks)
        views = [called.index(view) for pick in picks for view in pick.views]
        points = np.repeat(np.arange(first, len(start.points)), [len(pick.views) for pick in picks])
        of = replace(seen, views=np.array(views, np.int64), points=points, pixels=np.zeros((len(points), 2)))
        pixels, _ = reprojection_errors(start, replace(of, weights=np.ones(len(points))))
        places = transformed(np.array([pick.shell for pick in picks]).reshape(-1, 3), surface.survey_from_shell)
        planes = Planes(
            np.repeat(np.arange(first, len(start.points)), 3),
            np.tile(np.eye(3), (len(picks), 1)),
            np.repeat(places, 3, axis=0),
            np.ones(3 * len(picks)),
            _PICKED,
        )
        return cls(replace(of, pixels=pixels, weights=np.ones(len(points))), planes)


@dataclass(frozen=True)
class Adjustment:
    """Adjusted cameras and points.

    Attributes:
        model: the model, in the scene's frame, kept on average; its points are triangulated without the shell.
        errors: mean reprojection error of each point, in pixels.
        survey_from_scene: the similarity that fits the shell to this model.
        shifted: how far that similarity moved the points on the shell, in metres (root mean square).
        moved: how far each camera moved besides, in metres, by the photograph's name.
        deviations: standard deviation of its centre.
        pixel: noise of a keypoint's coordinate, in pixels.
        noise: noise of the shell, in metres.
        held_out: the judgement by held-out tracks.
    """

    model: Model
    errors: Float64[np.ndarray, " N"]
    survey_from_scene: Float64[np.ndarray, "4 4"]
    shifted: float
    moved: Mapping[str, float]
    deviations: Mapping[str, float]
    pixel: float
    noise: float
    held_out: HeldOut

    @property
    def in_words(self) -> str:
        """How far the cameras moved, or why they are left as they are."""
        held = self.held_out
        if held.were_straight:
            why = (
                f"do not fit the shell significantly better with it ({held.gain:.1f} standard errors; {SIGNIFICANT:g} "
                "are required)"
                if held.points >= FEW
                else f"are too few to decide ({FEW} are needed)"
            )
            return (
                f"The cameras are left as they are: {held.points} points near the shell, held out of the adjustment, "
                f"{why}."
            )
        before, after = (f"{100 * metres:.1f} cm" for metres in held.metres)
        moved, deviation = (100 * np.array([*by.values()]) for by in (self.moved, self.deviations))
        return (
            f"Cameras adjusted to the shell: they moved by {moved.mean():.1f} cm in the mean, {moved.max():.1f} cm "
            f"at most, with a standard deviation of {np.median(deviation):.1f} cm. {held.points} points held out of "
            f"the adjustment are {after} from the shell, {before} before, and {held.pixels[1]:.2f} px from their "
            f"keypoints, {held.pixels[0]:.2f} px before (medians); they fit the shell better by {held.gain:.1f} "
            "standard errors."
        )


@threadpool_limits.wrap(limits=1, user_api="blas")  # threads for small matrices wait for each other most of the time
def adjusted(
    surface: ShellSurface,
    model: Model,
    survey_from_scene: Float64[np.ndarray, "4 4"],
    names: Mapping[int, str],
    known: Mapping[str, Float64[np.ndarray, " 3"]] | None = None,
    sigma: float = 0.03,
    picks: Sequence[PickedPoint] = (),
) -> Adjustment:
    """Adjust cameras, lenses and points of a model to the shell.

    First without the shell, leaving out observations that are outliers by Tukey's biweight. Then points within a gate
    of the shell are drawn onto the planes of their closest triangles, each by the probability that it lies on it
    (:class:`Mixture`). The gate shrinks from :data:`REACH` to :data:`GATE`.

    The pinhole lens of undistorted photographs becomes one that distorts (OPENCV), since a wrongly estimated distortion
    leaves a residual in them, which bends cameras.

    Args:
        surface: the shell.
        model: the model.
        survey_from_scene: the shell's place.
        names: name of each photograph, by its number in the model.
        known: known camera centres in the survey frame, by the photograph's name.
        sigma: standard deviation of these along each axis, in metres.
        picks: points known on the shell, as triangulated from these cameras.

    Raises:
        SceneError: the model has no tracks, its cameras cannot be adjusted, or too few points are on the shell.
    """
    model = with_distortion(with_finite_points(model))
    start, seen = bundle_of(model, survey_from_scene)
    start = intersected(Objective(seen, _noise_of_pixels(start, seen)), start)
    share = min(max(HELD_OUT, ENOUGH / len(start.points)), 0.3)
    fitted = np.random.default_rng(0).random(len(start.points)) >= share
    called = [names[number] for number in model.images]
    priors = dict(zip(called, start.centres, strict=True)) | dict(known or {})
    positions = Positions(
        np.arange(len(called)),
        np.stack([priors[name] for name in called]),
        np.array([sigma if name in (known or {}) else _LOOSE for name in called]),
    )
    picked = transformed(np.array([pick.scene for pick in picks]).reshape(-1, 3), survey_from_scene)
    marked = replace(start, points=np.concatenate([start.points, picked]))
    marks = _Marks.of(picks, surface, marked, seen, called)
    bundle, objective = _drawn_to(surface, seen.of_points(fitted), positions, marked, marks)
    spread = deviations(objective, bundle)
    whole = Objective(seen, objective.pixel)
    final = intersected(whole, replace(bundle, points=bundle.points[: len(start.points)]))
    jump = np.linalg.norm(final.points - start.points, axis=1)
    on = surface.distance(final.points) < GATE
    on &= jump < 3 * np.median(jump[on])  # wrong observations throw points far off before they are left out
    one, other = (np.concatenate([each.points[on], each.centres]) for each in (final, start))
    back = fit_similarity(one, other)
    shifted = transformed(final.points[on], back) - final.points[on]
    moved = np.linalg.norm(transformed(bundle.centres, back) - start.centres, axis=1)
    placed = np.linalg.inv(back) @ survey_from_scene
    lengths = np.linalg.norm(reprojection_errors(final, seen)[0], axis=1)
    counts = np.bincount(seen.points, minlength=len(final.points))
    return Adjustment(
        adjusted_model(model, final, placed),
        np.bincount(seen.points, lengths, len(final.points)) / np.maximum(counts, 1),
        placed,
        float(np.sqrt((shifted**2).sum(axis=1).mean())),
        dict(zip(called, moved.tolist(), strict=True)),
        dict(zip(called, spread.tolist(), strict=True)),
        objective.pixel,
        objective.planes.sigma,
        _held_out(surface, whole, start, final, ~fitted & (counts >= _VIEWS)),
    )


def _drawn_to(
    surface: ShellSurface, seen: Observations, positions: Positions, bundle: Bundle, marks: _Marks
) -> tuple[Bundle, Objective]:
    """Rounds of leaving out wrong observations, looking for the closest planes and adjusting to them."""
    tracks = np.bincount(seen.points, minlength=len(bundle.points)) >= _VIEWS
    if tracks.sum() < FEW:
        raise SceneError(
            f"only {tracks.sum()} SfM points are seen in {_VIEWS} photographs or more, as in models that a network "
            "wrote: too few to adjust the cameras by; triangulate the points with COLMAP"
        )
    seen = seen.of_points(tracks)
    objective = Objective(seen, _noise_of_pixels(bundle, seen), positions=positions, planes=marks.planes)
    gates = [*np.full(_ROBUST, np.inf), *np.geomspace(REACH, GATE, _GATES)]
    gates += [GATE] * (_ROUNDS - len(gates))
    damping, bent = 1e-4, bundle.points
    for turn, gate in enumerate(track(gates, "Adjusting the cameras", len(gates))):
        # Points are triangulated again: those drawn to the shell say nothing of its noise, nor where they belong.
        free = intersected(objective, bundle, steps=5)
        if turn == _ROBUST:
            free = _carried(free, _back(surface, objective.observations, free.points, bent))
        pixel = _noise_of_pixels(free, seen)
        observations = _trusted(free, seen, pixel).joined(marks.seen)
        objective = replace(objective, observations=observations, pixel=pixel)
        free, planes = _placed(surface, objective, free, gate, marks)
        objective = replace(objective, planes=planes)
        before = bundle.centres
        bundle, damping = adjust(objective, free, _STEPS, damping, 1e-6)
        if gate == GATE and np.linalg.norm(bundle.centres - before, axis=1).max() < _STILL:
            break
    return bundle, objective


def _back(
    surface: ShellSurface, seen: Observations, points: Float64[np.ndarray, "N 3"], before: Float64[np.ndarray, "N 3"]
) -> Float64[np.ndarray, "4 4"]:
    """The similarity that brings points near the shell back to where they were.

    The shell was placed by them. Cameras, which keep their places while nothing else is known, may unbend to another
    scale: a wall before them would then be farther off than any gate.
    """
    on = np.intersect1d(seen.points[seen.weights > 0], np.flatnonzero(surface.distance(before) < REACH))
    jump = np.linalg.norm(points[on] - before[on], axis=1)
    on = on[jump <= 3 * np.median(jump)] if len(on) else on
    return fit_similarity(points[on], before[on]) if len(on) >= FEW else np.eye(4)


def _trusted(bundle: Bundle, seen: Observations, pixel: float) -> Observations:
    """The observations with weights: 0 for wrong ones, and where fewer than three of a track are left."""
    error, front = reprojection_errors(bundle, seen)
    distance = np.linalg.norm(error, axis=1) / (_OUTLYING * pixel)
    weights = np.where(front, np.clip(1 - distance**2, 0, None) ** 2, 0.0)
    sound = np.bincount(seen.points, weights > 0.1, len(bundle.points)) >= _VIEWS
    return replace(seen, weights=weights * sound[seen.points])


def _placed(
    surface: ShellSurface, objective: Objective, bundle: Bundle, gate: float, marks: _Marks
) -> tuple[Bundle, Planes]:
    """The bundle moved as a whole to where it fits the shell, picks and positions; and the planes of its points.

    The probabilities of points change with every motion, which the adjustment of all cameras would follow slowly.
    """
    covariance, known = covariances(objective, bundle), objective.positions
    tracks = np.setdiff1d(objective.observations.points[objective.observations.weights > 0], marks.planes.points)
    planes = marks.planes
    for _ in range(_SHIFTS):
        if gate < np.inf:
            planes = _planes(surface, bundle, tracks, covariance, gate).joined(marks.planes)
        normals, of = planes.normals, bundle.points[planes.points]
        axes = np.tile(np.eye(3), (len(known.views), 1))
        arms = np.concatenate([of, np.repeat(bundle.centres[known.views], 3, axis=0)])
        centre, radius = bundle.centres.mean(axis=0), float(bundle.centres.std() + 1.0)
        distance = np.concatenate(
            [
                np.einsum("kd,kd->k", normals, of - planes.feet),
                (bundle.centres[known.views] - known.centres).reshape(-1),
            ]
        )
        variance = np.concatenate(
            [
                np.einsum("ki,kij,kj->k", normals, covariance[planes.points], normals)
                + planes.sigma**2 / np.maximum(planes.weights, 1e-9),
                np.repeat(known.sigma**2, 3),
            ]
        )
        J = motions(arms - centre, np.concatenate([normals, axes]), radius) / np.sqrt(variance)[:, None]
        update = np.linalg.lstsq(J, -distance / np.sqrt(variance), rcond=_WEAK)[0]
        bundle = _carried(bundle, similarity_by(update, centre, radius))
        if np.abs(update).max() < _STILL / 5:
            break
    return bundle, planes


def _carried(bundle: Bundle, similarity: Float64[np.ndarray, "4 4"]) -> Bundle:
    """The bundle moved as a whole."""
    turn = similarity[:3, :3] / scale_of(similarity)
    return replace(
        bundle,
        rotations=bundle.rotations @ turn.T,
        centres=transformed(bundle.centres, similarity),
        points=transformed(bundle.points, similarity),
    )


def _planes(
    surface: ShellSurface, bundle: Bundle, tracks: Int64[np.ndarray, " T"], covariance: np.ndarray, gate: float
) -> Planes:
    """The planes of the points within a gate of the shell."""
    closest = surface.closest(bundle.points[tracks])
    offset = bundle.points[tracks] - closest.point
    close = np.linalg.norm(offset, axis=1) < gate
    near = tracks[close]
    if len(near) < FEW:
        raise SceneError(
            f"only {len(near)} SfM points with tracks are within {gate:.2g} m of the shell: too few to determine how "
            "cameras are bent"
        )
    feet, normals = closest.point[close].astype(np.float64), surface.normals[closest.triangle[close]]
    facing = _facing(normals, bundle)
    distance = np.einsum("nd,nd->n", normals, offset[close])
    found = Mixture.of(distance, _deviation(normals, covariance[near]), facing, gate)
    patch = _patches(feet, facing)
    crowd = np.bincount(patch, found.probability)[patch]
    sigma = float(np.median(found.sigma[facing]))
    weights = found.probability / np.maximum(crowd, 1.0) * (sigma / found.sigma[facing]) ** 2
    return Planes(near, normals, feet, weights, sigma)


def _facing(normals: np.ndarray, bundle: Bundle) -> np.ndarray:
    """The side of the building that each plane belongs to."""
    axes = facade_axes(normals, -bundle.rotations[:, 1].mean(axis=0))
    return (normals @ np.concatenate([axes, -axes]).T).argmax(axis=1)


def _deviation(normals: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Standard deviation of points along their planes' normals."""
    return np.sqrt(np.einsum("ki,kij,kj->k", normals, covariance, normals))


def _patches(feet: np.ndarray, facing: np.ndarray) -> np.ndarray:
    """The patch of the shell that each point belongs to."""
    cells = np.column_stack([np.floor(feet / _PATCH).astype(np.int64), facing])
    return np.unique(cells, axis=0, return_inverse=True)[1].ravel()


@dataclass(frozen=True)
class Mixture:
    """Distances of points from their planes: those of the shell are normal, others equally frequent up to a gate.

    Others are of frames, sills and railings. Each side of the building has its own share of the shell's points, since
    before reveals there are hardly any but those of frames, and its own noise: points of edges seen against the sky or
    at grazing angles scatter more than their tracks imply.

    Attributes:
        probability: of each point to be of the shell.
        likelihood: density of each distance, per metre.
        sigma: noise of each side, in metres.
    """

    probability: Float64[np.ndarray, " N"]
    likelihood: Float64[np.ndarray, " N"]
    sigma: Float64[np.ndarray, " S"]

    @classmethod
    def of(
        cls,
        distance: Float64[np.ndarray, " N"],
        deviation: Float64[np.ndarray, " N"],
        facing: Int64[np.ndarray, " N"],
        gate: float,
    ) -> Mixture:
        """Expectation maximisation (Dempster, Laird and Rubin 1977).

        Args:
            distance: distance of each point from its plane, in metres.
            deviation: standard deviation of that by triangulation.
            facing: the side of the building that it is on.
            gate: largest distance, in metres.
        """
        sides = int(facing.max()) + 1
        share, sigma = np.full(sides, 0.5), np.full(sides, gate / 4)
        count = np.maximum(np.bincount(facing), 1)
        probability = likelihood = np.empty(0)
        for _ in range(_EXPECTATIONS):
            variance = sigma[facing] ** 2 + deviation**2
            of_shell = share[facing] * np.exp(-0.5 * distance**2 / variance) / np.sqrt(2 * np.pi * variance)
            likelihood = of_shell + (1 - share[facing]) / (2 * gate) + 1e-12
            probability = of_shell / likelihood
            total = np.bincount(facing, probability)
            share = total / count
            by_shell = sigma[facing] ** 2 / variance  # of a distance, the part that is the shell's
            noise = np.bincount(facing, probability * ((by_shell * distance) ** 2 + by_shell * deviation**2))
            sigma = np.maximum(np.sqrt(noise / np.maximum(total, 1e-12)), _FINEST)
        return cls(probability, likelihood, sigma)


def _noise_of_pixels(bundle: Bundle, seen: Observations) -> float:
    """Standard deviation of a keypoint's coordinate, from the median residual and the number of unknowns."""
    error, front = reprojection_errors(bundle, seen)
    freedom = 2 * len(error) - 3 * len(np.unique(seen.points)) - 6 * len(bundle.centres)
    return 1.4826 * float(np.median(np.abs(error[front]))) * np.sqrt(2 * len(error) / max(freedom, 1))


def _held_out(surface: ShellSurface, whole: Objective, start: Bundle, final: Bundle, chosen: np.ndarray) -> HeldOut:
    seen, distances = whole.observations, [surface.distance(bundle.points) for bundle in (start, final)]
    chosen = chosen & (np.minimum(*distances) < 2 * GATE)
    pixels, metres = [], []
    for bundle, distance in zip((start, final), distances, strict=True):
        error, front = reprojection_errors(bundle, seen)
        of = chosen[seen.points] & front
        pixels.append(float(np.median(np.linalg.norm(error[of], axis=1))) if of.any() else float("nan"))
        metres.append(float(np.median(distance[chosen])) if chosen.any() else float("nan"))
    gain = _gain(surface, whole, start, final, np.flatnonzero(chosen))
    return HeldOut(int(chosen.sum()), (pixels[0], pixels[1]), (metres[0], metres[1]), gain)


def _gain(surface: ShellSurface, whole: Objective, before: Bundle, after: Bundle, points: np.ndarray) -> float:
    """Gain in log-likelihood of points by its standard error; their likelihoods are those of the best mixtures."""
    if len(points) < FEW:
        return 0.0
    logarithms, patches = [], np.empty(0, np.int64)
    for bundle in (before, after):
        closest = surface.closest(bundle.points[points])
        normals = surface.normals[closest.triangle]
        distance = np.einsum("nd,nd->n", normals, bundle.points[points] - closest.point)
        facing, covariance = _facing(normals, bundle), covariances(whole, bundle)[points]
        found = Mixture.of(distance, _deviation(normals, covariance), facing, 2 * GATE)
        logarithms.append(np.log(found.likelihood))
        patches = _patches(closest.point, facing)
    gains = np.bincount(patches, logarithms[1] - logarithms[0])
    return float(gains.mean() / (gains.std(ddof=1) / np.sqrt(len(gains)) + 1e-12)) if len(gains) > 1 else 0.0
