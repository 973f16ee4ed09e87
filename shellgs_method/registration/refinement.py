"""Refine an alignment against the SfM points: robust point-to-plane Gauss-Newton over a similarity."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from shellgs_method.errors import SceneError
from shellgs_method.geometry.similarity import scale_of, transformed
from shellgs_method.geometry.triangles import Triangles

FINAL_GATE = 0.05
"""Metres from the shell beyond which a point has no weight in the last steps: SfM points on a wall scatter by 1 to 3
cm, while parts missing in the shell (frames, sills, railings) are 5 to 20 cm off it and would bias the result."""
WEAK = 1e-3
"""Eigenvalue of the normal equations, relative to the largest, below which a direction is weak. A facade with recessed
windows has 2e-3 and more in every direction, a bare wall less than 1e-6 in four of the seven."""
MOTIONS = ("along the facade", "upwards", "out of the facade", "tilt", "turn", "roll", "scale")
"""The seven degrees of freedom in the facade's axes: shifts along right, up, out; rotations about these; scale."""
_STEPS = 40


@dataclass(frozen=True)
class Evidence:
    """How well the points near the shell determine each direction of motion.

    Attributes:
        directions: orthonormal rows of (shift, rotation, scale); a unit moves the points by about a metre.
        strengths: mean squared distance from the shell's planes, in m², per unit along each; descending.
        centre: fixed point of rotation and scale, in the survey frame.
        radius: root-mean-square distance of the points from it, in metres.
        points: number of points within the gate.
    """

    directions: Float64[np.ndarray, "7 7"]
    strengths: Float64[np.ndarray, " 7"]
    centre: Float64[np.ndarray, " 3"]
    radius: float
    points: int

    @property
    def weak(self) -> np.ndarray:
        """Mask of the directions that the points do not determine."""
        return self.strengths < WEAK * max(self.strengths[0], 1e-30)

    @property
    def condition(self) -> float:
        """Largest over smallest strength."""
        return float(self.strengths[0] / max(self.strengths[-1], 1e-30))

    def in_words(self, axes: Float64[np.ndarray, "3 3"]) -> list[str]:
        """Describe each weak direction by its main motions.

        Args:
            axes: right, up and out of the facade, as rows.
        """
        turn = np.kron(np.eye(2), axes)
        words = []
        for direction in self.directions[self.weak]:
            share = np.append(turn @ direction[:6], direction[6]) ** 2
            main = [k for k in np.argsort(-share) if share[k] > 0.15]
            words.append(" with ".join(MOTIONS[k] for k in main))
        return words


@dataclass(frozen=True)
class Refinement:
    """A refined alignment.

    Attributes:
        survey_from_scene: refined similarity.
        evidence: evidence of the last step.
        moved: root-mean-square motion, from start to end, of the points within the last gate, in metres.
    """

    survey_from_scene: Float64[np.ndarray, "4 4"]
    evidence: Evidence
    moved: float


def refine(
    surface: Triangles,
    points: Float64[np.ndarray, "N 3"],
    survey_from_scene: Float64[np.ndarray, "4 4"],
    reach: float,
    rounding: float = 0.0,
    last: float = FINAL_GATE,
    steps: int = _STEPS,
    relative: bool = False,
) -> Refinement:
    """Refine an alignment by fitting the SfM points to the shell.

    Each step applies the similarity that best moves the points onto the planes of their closest triangles (Chen and
    Medioni 1991, with a scale), weighted by Tukey's biweight, whose limit shrinks from ``reach`` to
    ``last`` and the rounding of the coordinates. Directions that the points do not determine stay unchanged.

    Args:
        surface: the shell.
        points: SfM points in the scene's frame; points off the shell do no harm.
        survey_from_scene: initial similarity.
        reach: largest error of the initial similarity, in metres.
        rounding: largest error of the points and the shell by the rounding of their coordinates, in metres.
        last: the last limit, in metres.
        steps: most steps.
        relative: measure distances relative to the scale, for a start whose scale is far off: in metres they would
            shrink with the points.

    Raises:
        SceneError: fewer than 7 points are within reach of the shell.
    """
    start = transformed(points, survey_from_scene)
    similarity = survey_from_scene
    last += rounding
    gates = np.geomspace(max(reach, last), last, steps // 2)
    evidence, used = None, np.ones(len(points), bool)
    for gate in np.append(gates, np.full(steps - len(gates), last)):
        evidence, step, used = _solve(surface, transformed(points, similarity), gate, relative)
        similarity = step @ similarity
        if gate == last and np.abs(step - np.eye(4)).max() < 1e-7:
            break
    assert evidence is not None
    if not relative and evidence.weak.any():
        similarity = _held(similarity @ np.linalg.inv(survey_from_scene), evidence) @ survey_from_scene
    moved = transformed(points[used], similarity) - start[used]
    return Refinement(similarity, evidence, float(np.sqrt((moved**2).sum(axis=1).mean())))


def _held(motion: np.ndarray, evidence: Evidence) -> np.ndarray:
    """A motion without its part along directions that the points do not determine: those beyond the last limit did."""
    scale = scale_of(motion)
    turn = Rotation.from_matrix(motion[:3, :3] / scale).as_rotvec()
    centre = transformed(evidence.centre[None], np.linalg.inv(motion))[0]
    shift = evidence.centre - centre
    update = np.concatenate([shift, evidence.radius * turn, [evidence.radius * np.log(scale)]])
    weak = evidence.directions[evidence.weak]
    return similarity_by(update - weak.T @ (weak @ update), centre, evidence.radius)


def _solve(
    surface: Triangles, points: np.ndarray, gate: float, relative: bool
) -> tuple[Evidence, np.ndarray, np.ndarray]:
    """One step: its evidence, the similarity to apply, and the mask of points within the gate."""
    closest = surface.closest(points)
    offset = points - closest.point
    used = np.linalg.norm(offset, axis=1) < gate
    if used.sum() < 7:
        raise SceneError(
            f"only {used.sum()} SfM points are within {gate:.2g} m of the shell: the start is too far off, or the "
            "points show something else"
        )
    points, normal = points[used], closest.normal[used]
    distance = np.einsum("nd,nd->n", normal, offset[used])
    weight = (1 - (distance / gate) ** 2) ** 2
    centre = np.average(points, axis=0, weights=weight)
    arm = points - centre
    radius = float(np.sqrt(np.average((arm**2).sum(axis=1), weights=weight)))
    J = motions(arm, normal, radius)
    J[:, 6] -= relative * distance / radius
    strengths, directions = np.linalg.eigh(J.T @ (weight[:, None] * J) / weight.sum())
    evidence = Evidence(directions.T[::-1], np.maximum(strengths[::-1], 0.0), centre, radius, int(used.sum()))
    gradient = evidence.directions @ (J.T @ (weight * distance) / weight.sum())
    known = ~evidence.weak
    update = -(gradient[known] / evidence.strengths[known]) @ evidence.directions[known]
    return evidence, similarity_by(update, centre, radius), used


def motions(
    arm: Float64[np.ndarray, "N 3"], normal: Float64[np.ndarray, "N 3"], radius: float
) -> Float64[np.ndarray, "N 7"]:
    """Derivatives, by (shift, rotation, scale), of distances from planes with these normals.

    All seven are in metres at the radius, so that their strengths can be compared.

    Args:
        arm: the points, from the centre of rotation and scale.
        normal: normals of the planes.
        radius: typical length of an arm.
    """
    scale = np.einsum("nd,nd->n", normal, arm)[:, None]
    return np.concatenate([normal, np.cross(arm, normal) / radius, scale / radius], axis=1)


def similarity_by(
    update: Float64[np.ndarray, " 7"], centre: Float64[np.ndarray, " 3"], radius: float
) -> Float64[np.ndarray, "4 4"]:
    """The similarity of (shift, rotation, scale) about a centre, in the units of :func:`motions`."""
    matrix = np.eye(4)
    matrix[:3, :3] = np.exp(update[6] / radius) * Rotation.from_rotvec(update[3:6] / radius).as_matrix()
    matrix[:3, 3] = centre + update[:3] - matrix[:3, :3] @ centre
    return matrix
