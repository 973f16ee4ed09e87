"""Validate an alignment from the SfM points and the cameras alone: metrics, limits, verdict.

All metrics are measured before training, on data that do not depend on the alignment; no limit is tuned on results.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from jaxtyping import Float64

from shellgs_method.errors import SceneError
from shellgs_method.files.photographs import View
from shellgs_method.geometry.axes import facade_axes, likely_up
from shellgs_method.geometry.camera import positions
from shellgs_method.geometry.nearest import point_tree
from shellgs_method.geometry.precision import COARSEST, FINE, REMEDY, Step, camera_step
from shellgs_method.geometry.similarity import transformed
from shellgs_method.registration.adjustment import Adjustment
from shellgs_method.registration.correspondences import LEFT_HANDED, Correspondence
from shellgs_method.registration.picks import PickedPoint
from shellgs_method.registration.refinement import Refinement, refine
from shellgs_method.registration.repetition import BETTER, RIVALRY, ShiftScan, mirrored_fit, scan_shifts
from shellgs_method.registration.support import NEAR, OCCLUDING, ViewSupport, look
from shellgs_method.shell.alignment import Alignment
from shellgs_method.shell.mesh import ShellMesh
from shellgs_method.shell.raycast import ShellCaster
from shellgs_method.shell.surface import ShellSurface

if TYPE_CHECKING:
    from shellgs_method.files.sparse_points import SparsePoints

Verdict = Literal["good", "doubtful", "refused"]
_ORDER: tuple[Verdict, ...] = ("good", "doubtful", "refused")


@dataclass(frozen=True)
class Limit:
    """Limits of a metric: good up to ``good``, refused beyond ``refused``, doubtful in between."""

    good: float
    refused: float
    why: str

    def verdict(self, value: float) -> Verdict:
        """Return the verdict on a value; NaN is refused."""
        sign = 1 if self.good <= self.refused else -1
        if sign * value <= sign * self.good:
            return "good"
        return "doubtful" if sign * value <= sign * self.refused else "refused"


LIMITS = {
    "distance": Limit(300.0, 2000.0, "facades are photographed from metres away, not millimetres or kilometres"),
    "closeness": Limit(0.5, 0.1, "facades are photographed from metres away, not millimetres or kilometres"),
    "views": Limit(0.25, 0.01, "the shell supervises only the views that it is visible in"),
    "points": Limit(200, 30, "fewer SfM points near the shell prove little"),
    "share": Limit(0.55, 0.30, "SfM points of a wall scatter by 1 to 3 cm; a misplaced wall has 10 to 25 % near it"),
    "bias": Limit(
        0.025, 0.15, "5 cm along the normal is 3 times the scatter; sills and frames shift the median by 1 cm"
    ),
    "pull": Limit(
        0.03,
        0.25,
        "the shell is offset from the SfM points: --refine moves it onto them; leave it where picks with small "
        "residuals placed it, which are more accurate than points on frames and sills that it lacks",
    ),
    "picks": Limit(
        0.10,
        0.50,
        "picks that agree on where the shell is place it more accurately than SfM points on what it lacks: leave "
        "--refine out",
    ),
    "weak": Limit(0, 7, "points of a bare wall do not determine shifts along it: only images or picked points do"),
    "rival": Limit(RIVALRY, BETTER, "repeated windows and bare walls fit almost as well further along"),
    "mirrored": Limit(1.05, 1.2, LEFT_HANDED),
    "agreement": Limit(
        0.65, 0.55, "a shell elsewhere shows walls where photographs show none, and hides what they show"
    ),
    "elsewhere": Limit(0.8, 0.93, "if the shell fits as well elsewhere, neither place is certain"),
    "imprecise": Limit(0.15, 3.0, "a bare wall fits as well farther along itself: pick points at corners"),
    "step": Limit(FINE, COARSEST, f"an error of half a step does not average out; {REMEDY}"),
    "check": Limit(0.10, 0.50, "careful picks are accurate to 3 to 5 cm"),
    "bent_pixels": Limit(1.05, 1.2, "held-out points fit worse if the adjustment bends the cameras"),
    "bent_check": Limit(0.02, 0.05, "check points fit worse if the adjustment bends the cameras"),
}
"""All thresholds of the verdict, with their reasons."""

OFF_PICKS = "pull_off_picks_m"
"""The metric of the motion that would fit the points better, at picks that agree on where the shell is."""
LIKELIER = "likelier_metres_per_shell_unit"
"""The metric of a unit that is more likely than the shell's own."""

SHOWN = 0.005
"""Metres from which a step of coordinates is shown in the report."""
_REACH = 0.25  # metres: reach of the test refinement


@dataclass(frozen=True)
class Check:
    """One metric with its verdict."""

    name: str
    value: str
    limits: str
    verdict: Verdict
    why: str


@dataclass(frozen=True)
class Validation:
    """All metrics of an alignment.

    Attributes:
        alignment: the alignment.
        checks: metrics with a verdict each.
        views: the visible part of the shell in each view.
        axes: right, up and out of the facade in the survey frame, as rows.
        signed: signed distances in metres of the SfM points within :data:`NEAR`, positive in front of the shell.
        near: share of these among all SfM points.
        scans: fit at shifts along the facade and upwards.
        mirrored: fit of the shell mirrored front to back, relative to its own; None if too little of it is seen.
        test: test refinement of the alignment; None if too few points are near the shell.
        correspondences: picks or camera positions and their residuals, if any.
        steps: steps of the coordinates in metres, by what they are of.
        unbending: how the cameras were adjusted to the shell, if they were.
        survey_from_scene: the place of the scene in the survey frame.
        likelier: metres of a unit that the shell has more likely than its own; None if it has its own.
    """

    alignment: Alignment
    checks: Sequence[Check]
    views: Sequence[ViewSupport] = ()
    axes: Float64[np.ndarray, "3 3"] = field(default_factory=lambda: np.eye(3))
    signed: Float64[np.ndarray, " N"] = field(default_factory=lambda: np.empty(0))
    near: float = 0.0
    scans: Sequence[ShiftScan] = ()
    mirrored: float | None = None
    test: Refinement | None = None
    correspondences: Sequence[Correspondence] = ()
    steps: Mapping[str, Step] = field(default_factory=dict)
    unbending: Unbending | None = None
    survey_from_scene: Float64[np.ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))
    likelier: float | None = None

    @property
    def verdict(self) -> Verdict:
        """Worst verdict of the checks."""
        return _ORDER[max(_ORDER.index(check.verdict) for check in self.checks)]

    @property
    def reasons(self) -> list[str]:
        """Checks that are not good, the worst first, in words."""
        not_good = sorted((c for c in self.checks if c.verdict != "good"), key=lambda c: -_ORDER.index(c.verdict))
        return [f"{check.name}: {check.value} ({check.limits}); {check.why}" for check in not_good]

    def with_checks(self, checks: Sequence[Check]) -> Validation:
        """This validation with more checks."""
        return replace(self, checks=[*self.checks, *checks])

    def after(self, adjustment: Adjustment, before: Validation) -> Validation:
        """This validation, of adjusted cameras, with what was held out of the adjustment."""
        unbending = Unbending(adjustment, before)
        return replace(self, checks=[*self.checks, *unbending.checks(self)], unbending=unbending)

    def share_within(self, metres: float) -> float:
        """Share of the points near the shell that are less than ``metres`` from it."""
        return float((np.abs(self.signed) < metres).mean()) if len(self.signed) else 0.0

    @property
    def bias(self) -> float:
        """Median signed distance of the points within 30 cm, in metres; NaN if there are none."""
        close = self.signed[np.abs(self.signed) < OCCLUDING]
        return float(np.median(close)) if len(close) else float("nan")

    @property
    def picks(self) -> tuple[float, float]:
        """Median residuals in metres of the picks that are fitted, now and in a fit without each; NaN if unknown."""
        both = [(point.residual, point.left_out_residual) for point in self._picks]
        now, without = np.median(both, axis=0) if both else (np.nan, np.nan)
        return float(now), float(without)

    @property
    def off_picks(self) -> float:
        """Metres by which the test refinement takes the shell off picks that agree on where it is; NaN if unknown.

        Without picks, it is what was measured when they placed the shell.
        """
        if not self._picks:
            before = self.alignment.metrics.get(OFF_PICKS)
            return np.nan if before is None else before
        if self.test is None or not np.max(self.picks) <= LIMITS["check"].good:
            return np.nan
        scene = np.stack([point.scene for point in self._picks])
        moved = transformed(scene, self.test.survey_from_scene) - transformed(scene, self.survey_from_scene)
        return float(np.median(np.linalg.norm(moved, axis=1)))

    @property
    def contradicts_picks(self) -> bool:
        """Whether the SfM points would take the shell off picks that agree on where it is."""
        return self.off_picks > LIMITS["picks"].good

    @property
    def _picks(self) -> list[PickedPoint]:
        return [point for point in self.correspondences if isinstance(point, PickedPoint) and point.is_used]

    @property
    def check_points(self) -> float:
        """Median residual of the check points in metres; NaN if there are none."""
        residuals = [point.residual for point in self.correspondences if point.held_out]
        return float(np.median(residuals)) if residuals else float("nan")

    def metrics(self) -> dict[str, float | None]:
        """Main metrics, for json."""
        values = {f"within_{round(100 * d)}cm": self.share_within(d) for d in (0.05, 0.10, 0.20)}
        values |= {"bias_m": self.bias, "near": self.near, "metres_per_unit": self.alignment.metres_per_unit}
        if self.test is not None:
            values |= {"pull_m": self.test.moved, "condition": self.test.evidence.condition}
        values["rounding_m"] = rounding_of(self.steps)
        values |= {f"best_elsewhere_{scan.name.replace(' ', '_')}": scan.elsewhere[1] for scan in self.scans}
        for name, value in (("check_points_m", self.check_points), (OFF_PICKS, self.off_picks)):
            if not np.isnan(value):
                values[name] = value
        if self.likelier is not None:
            values[LIKELIER] = self.likelier
        return {name: None if np.isnan(value) else float(f"{value:.4g}") for name, value in values.items()}


@dataclass(frozen=True)
class Unbending:
    """Cameras that were adjusted to the shell.

    Attributes:
        adjustment: how.
        before: the validation of the cameras as they were.
    """

    adjustment: Adjustment
    before: Validation

    def checks(self, after: Validation) -> Iterator[Check]:
        """What was held out of the adjustment: it must not be worse than before."""
        before, now = self.adjustment.held_out.pixels
        name = "Bent: reprojection error of tracks held out, relative to the one before"
        yield check_of("bent_pixels", now / before if before else 1.0, name, "{:.2f}")
        farther = after.check_points - self.before.check_points
        if not np.isnan(farther):
            name = "Bent: check points, median residual, minus the one before"
            yield check_of("bent_check", farther, name, "{:+.3f} m")


def validate(
    mesh: ShellMesh,
    alignment: Alignment,
    views: Sequence[View],
    points: SparsePoints,
    correspondences: Sequence[Correspondence] = (),
) -> Validation:
    """Validate an alignment.

    Args:
        mesh: the shell in its own frame.
        alignment: the alignment.
        views: all photographs.
        points: the SfM points.
        correspondences: picks or camera positions with their residuals, if any.
    """
    surface = ShellSurface(mesh, alignment.metres_per_shell_unit)
    survey_from_scene = surface.survey_from_shell @ np.linalg.inv(alignment.shell_to_scene)
    caster = ShellCaster(mesh, alignment.shell_to_scene)
    steps = steps_in_metres(mesh, alignment, views, points)
    supports = [look(caster, view, points, survey_from_scene) for view in views]
    seeing = [support for support in supports if len(support.hits)]
    sight = check_of("views", len(seeing) / max(len(views), 1), "Views that see the shell", "{:.0%}")
    if not seeing:
        return Validation(alignment, [sight])
    distance = float(np.median([support.distance for support in seeing]))
    key = "closeness" if distance < LIMITS["closeness"].good else "distance"
    size = check_of(key, distance, "Distance from cameras to shell, median (units)", "{:.3g} m")
    if size.verdict == "refused":
        return Validation(alignment, [sight, size], supports)
    cameras = transformed(positions(view.camera for view in views), survey_from_scene)
    up = survey_from_scene[:3, :3] @ likely_up(view.camera for view in views)
    axes = facade_axes(np.concatenate([support.normals for support in seeing]), up)
    placed = transformed(points.positions, survey_from_scene)
    signed = _signed_distances(surface, placed, cameras)
    near = np.abs(signed) < NEAR
    try:
        test = refine(surface, points.positions, survey_from_scene, _REACH, rounding_of(steps))
    except SceneError:
        test = None
    measured = Validation(
        alignment=alignment,
        checks=[sight, size],
        views=supports,
        axes=axes,
        signed=signed[near],
        near=float(near.mean()),
        scans=scan_shifts(surface, placed, axes),
        mirrored=mirrored_fit(surface, placed[near], axes),
        test=test,
        correspondences=correspondences,
        steps=steps,
        survey_from_scene=survey_from_scene,
    )
    return replace(measured, checks=[sight, size, *_checks(measured)])


def steps_in_metres(
    mesh: ShellMesh, alignment: Alignment, views: Sequence[View], points: SparsePoints
) -> dict[str, Step]:
    """Steps of all coordinates of an alignment in metres, by what they are of."""
    return {
        f"the coordinates of {alignment.named}": mesh.step.scaled(alignment.metres_per_shell_unit),
        "the SfM points": points.step.scaled(alignment.metres_per_unit),
        "the cameras": camera_step(view.camera for view in views).scaled(alignment.metres_per_unit),
    }


def rounding_of(steps: Mapping[str, Step]) -> float:
    """Largest error by rounding, half of the coarsest step, in metres."""
    return max((step.coarsest / 2 for step in steps.values() if step.rounded), default=0.0)


def _checks(measured: Validation) -> Iterator[Check]:
    for what, step in measured.steps.items():
        if step.coarsest >= SHOWN:
            name = f"Steps of {what}" + ("" if step.rounded else ", if they were rounded")
            check = check_of("step", step.coarsest, name, step.in_words())
            yield check if step.rounded or check.verdict == "good" else replace(check, verdict="doubtful")
    yield check_of("points", len(measured.signed), "SfM points within 1 m of the shell", "{:.0f}")
    yield check_of("share", measured.share_within(0.10), "SfM points within 1 m, share within 10 cm", "{:.0%}")
    yield check_of("bias", abs(measured.bias), "Bias along the normal, median", f"{measured.bias:+.3f} m")
    if measured.test is not None:
        evidence = measured.test.evidence
        if not measured.alignment.model:  # adjusted cameras fit picks and weighted tracks better than points alone tell
            check = check_of("pull", measured.test.moved, "Motion that would fit the points better", "{:.3f} m")
            doubted = replace(check, verdict="doubtful", why=LIMITS["picks"].why)
            yield doubted if measured.contradicts_picks and check.verdict != "good" else check
        words = "; ".join(evidence.in_words(measured.axes))
        name = "Directions the points do not determine"
        yield check_of("weak", int(evidence.weak.sum()), name, f"{{:.0f}} {words}".strip())
    for scan in measured.scans if len(measured.signed) else ():
        shift, fit = scan.elsewhere
        yield check_of("rival", fit, f"Relative fit, shifted {shift:+.1f} m {scan.name}", "{:.3f}")
    if measured.mirrored is not None:
        yield check_of("mirrored", measured.mirrored, "Relative fit, mirrored front to back", "{:.2f}")
    now, without = measured.picks
    if now > without:
        yield check_of("picks", now - without, "Picks, median residual, minus that in a fit without each", "{:.3f} m")
    if not np.isnan(measured.check_points):
        yield check_of("check", measured.check_points, "Check points, median residual", "{:.3f} m")


def check_of(key: str, value: float, name: str, form: str) -> Check:
    """The check of a value by the :data:`LIMITS` of a key: what it is called, and how it is shown."""
    limit = LIMITS[key]
    sign = "≤" if limit.good <= limit.refused else "≥"
    percent = "%" in form
    good, refused = (f"{value:.0%}" if percent else f"{value:g}" for value in (limit.good, limit.refused))
    limits = f"good {sign} {good}, refused beyond {refused}"
    return Check(name, form.format(value), limits, limit.verdict(value), limit.why)


def _signed_distances(surface: ShellSurface, points: np.ndarray, cameras: np.ndarray) -> np.ndarray:
    """Distance of each point from the shell, positive on the side of the nearest camera."""
    closest = surface.closest(points)
    towards = cameras[point_tree(cameras).query(closest.point)[1]] - closest.point
    normal = closest.normal * np.sign(np.einsum("nd,nd->n", closest.normal, towards))[:, None]
    offset = points - closest.point
    side = np.where(np.einsum("nd,nd->n", normal, offset) < 0, -1.0, 1.0)
    return side * np.linalg.norm(offset, axis=1)
