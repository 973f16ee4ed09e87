"""Bundle adjustment: cameras, lenses and points by sparse Levenberg-Marquardt, points eliminated (Schur complement).

Triggs et al., "Bundle Adjustment - A Modern Synthesis", 2000. Besides reprojection errors there are the distances of
points from planes and of camera centres from given positions, which COLMAP's bundle adjustment has not.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy import sparse
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.transform import Rotation

from shellgs_method.geometry.distortion import to_pixels

_LEAST_DAMPING, _MOST_DAMPING = 1e-10, 1e8
_CONVERGED = 1e-8
"""Relative decrease of the cost below which the adjustment has converged."""
_BEHIND = 1e-6
"""Depth below which a point is behind its camera, and has no error there."""


@dataclass(frozen=True)
class Bundle:
    """The unknowns.

    Attributes:
        rotations: from the world to each camera.
        centres: of the cameras, in the world.
        lenses: :data:`~shellgs_method.geometry.distortion.PARAMETERS` of each lens, in pixels.
        points: in the world.
    """

    rotations: Float64[np.ndarray, "V 3 3"]
    centres: Float64[np.ndarray, "V 3"]
    lenses: Float64[np.ndarray, "L 10"]
    points: Float64[np.ndarray, "N 3"]


@dataclass(frozen=True)
class Observations:
    """What photographs show of the points.

    Attributes:
        views: the camera of each observation.
        points: its point.
        pixels: where the point is seen.
        lens_of: lens of each camera.
        fisheye: whether each lens is a fisheye lens.
        free: the parameters that are adjusted of each lens, as the columns of a matrix.
        limits: smallest and largest value of each lens' parameters.
    """

    views: Int64[np.ndarray, " M"]
    points: Int64[np.ndarray, " M"]
    pixels: Float64[np.ndarray, "M 2"]
    lens_of: Int64[np.ndarray, " V"]
    fisheye: Bool[np.ndarray, " L"]
    free: Float64[np.ndarray, "L 10 P"]
    limits: tuple[Float64[np.ndarray, "L 10"], Float64[np.ndarray, "L 10"]]

    def of_points(self, chosen: Bool[np.ndarray, " N"]) -> Observations:
        """The observations of some of the points, which keep their numbers."""
        kept = chosen[self.points]
        return replace(self, views=self.views[kept], points=self.points[kept], pixels=self.pixels[kept])


@dataclass(frozen=True)
class Planes:
    """Planes that points lie on.

    Attributes:
        points: indices of the points.
        normals: unit normal of the plane of each.
        feet: a point of the plane of each.
        sigma: standard deviation of a point's distance from its plane.
        gate: distance from which a plane says nothing about its point.
    """

    points: Int64[np.ndarray, " K"] = field(default_factory=lambda: np.empty(0, np.int64))
    normals: Float64[np.ndarray, "K 3"] = field(default_factory=lambda: np.empty((0, 3)))
    feet: Float64[np.ndarray, "K 3"] = field(default_factory=lambda: np.empty((0, 3)))
    sigma: float = 1.0
    gate: float = 1.0


@dataclass(frozen=True)
class Positions:
    """Known positions of cameras.

    Attributes:
        views: the cameras.
        centres: where they are.
        sigma: standard deviation of each position, along each axis.
    """

    views: Int64[np.ndarray, " K"] = field(default_factory=lambda: np.empty(0, np.int64))
    centres: Float64[np.ndarray, "K 3"] = field(default_factory=lambda: np.empty((0, 3)))
    sigma: Float64[np.ndarray, " K"] = field(default_factory=lambda: np.empty(0))


@dataclass(frozen=True)
class Objective:
    """Half the sum of squared errors by their standard deviations, all but those of positions robust.

    Attributes:
        observations: reprojection errors, with Cauchy's loss.
        pixel: standard deviation of a pixel's coordinate.
        cauchy: scale of the loss, in standard deviations.
        planes: distances of points from planes, with Tukey's loss, which is flat beyond the gate.
        positions: distances of cameras from known positions.
    """

    observations: Observations
    pixel: float = 1.0
    cauchy: float = 2.0
    planes: Planes = field(default_factory=Planes)
    positions: Positions = field(default_factory=Positions)

    def cost(self, bundle: Bundle) -> float:
        """Value of the objective."""
        return _linearised(self, bundle, derivatives=False).cost


@dataclass
class _Linearised:
    """Cost, gradients and Gauss-Newton's Hessian of cameras and lenses (c) and of points (x)."""

    cost: float
    Hcc: np.ndarray
    Hcx: sparse.csr_matrix
    Hxx: np.ndarray
    gc: np.ndarray
    gx: np.ndarray


def reprojection_errors(
    bundle: Bundle, observations: Observations
) -> tuple[Float64[np.ndarray, "M 2"], Bool[np.ndarray, " M"]]:
    """Projected less observed pixels, and which points are in front of their camera; the error of others is 0."""
    error, front, *_ = _project(bundle, observations)
    return error, front


def _project(bundle: Bundle, seen: Observations) -> tuple[np.ndarray, ...]:
    """Errors, which are in front, points in the camera, derivatives of pixels by these and by lenses."""
    rotations = bundle.rotations[seen.views]
    inside = np.einsum("mij,mj->mi", rotations, bundle.points[seen.points] - bundle.centres[seen.views])
    front = inside[:, 2] > _BEHIND
    depth = np.where(front, inside[:, 2], 1.0)
    rays = inside[:, :2] / depth[:, None]
    lens = seen.lens_of[seen.views]
    pixels, by_ray, by_lens = np.zeros((len(rays), 2)), np.zeros((len(rays), 2, 2)), np.zeros((len(rays), 2, 10))
    for fisheye in np.unique(seen.fisheye):
        of = seen.fisheye[lens] == fisheye
        pixels[of], by_ray[of], by_lens[of] = to_pixels(rays[of], bundle.lenses[lens[of]], bool(fisheye))
    by_inside = np.concatenate([by_ray, -np.einsum("mij,mj->mi", by_ray, rays)[..., None]], axis=2)
    by_inside /= depth[:, None, None]
    error = np.where(front[:, None], pixels - seen.pixels, 0.0)
    return error, front, inside, by_inside, by_lens


def _linearised(objective: Objective, bundle: Bundle, derivatives: bool = True) -> _Linearised:
    seen, planes, known = objective.observations, objective.planes, objective.positions
    error, front, inside, by_inside, by_lens = _project(bundle, seen)
    error = error / objective.pixel
    scale = objective.cauchy**2
    squared = (error**2).sum(axis=1)
    weight = np.where(front, 1 / (1 + squared / scale), 0.0)
    distance = np.einsum("kj,kj->k", planes.normals, bundle.points[planes.points] - planes.feet)
    inlying = np.clip(1 - (distance / planes.gate) ** 2, 0, None)
    away = bundle.centres[known.views] - known.centres
    cost = 0.5 * scale * np.log1p(squared / scale).sum()
    cost += (planes.gate / planes.sigma) ** 2 / 6 * (1 - inlying**3).sum()
    cost += 0.5 * ((away / known.sigma[:, None]) ** 2).sum()
    if not derivatives:
        empty = np.empty(0)
        return _Linearised(float(cost), empty, sparse.csr_matrix((0, 0)), empty, empty, empty)

    root = np.sqrt(weight)
    by_inside = by_inside * (root / objective.pixel)[:, None, None]
    by_point = by_inside @ bundle.rotations[seen.views]
    # Turning the camera by the vector w moves a point x in its frame by w x x.
    by_turn = np.cross(inside[:, None], by_inside)
    lens = seen.lens_of[seen.views]
    by_lens = np.einsum("mij,mjp->mip", by_lens * (root / objective.pixel)[:, None, None], seen.free[lens])
    error = error * root[:, None]

    count, cameras, lenses = len(error), len(bundle.centres), len(bundle.lenses)
    width = seen.free.shape[2]
    size = 6 * cameras + width * lenses
    columns = np.concatenate(
        [6 * seen.views[:, None] + np.arange(6), 6 * cameras + width * lens[:, None] + np.arange(width)], axis=1
    )
    Jc = _rows(np.concatenate([by_turn, -by_point, by_lens], axis=2), columns, size)
    Jx = _rows(by_point, 3 * seen.points[:, None] + np.arange(3), 3 * len(bundle.points))
    flat = error.reshape(-1)
    Hcc = (Jc.T @ Jc).toarray()
    gc = Jc.T @ flat
    gx = (Jx.T @ flat).reshape(-1, 3)
    blocks = np.einsum("mki,mkj->mij", by_point, by_point).reshape(count, 9)
    summed = sparse.csr_matrix((np.ones(count), (seen.points, np.arange(count))), (len(bundle.points), count))
    Hxx = (summed @ blocks).reshape(-1, 3, 3)

    stiffness = inlying**2 / planes.sigma**2
    np.add.at(Hxx, planes.points, stiffness[:, None, None] * planes.normals[:, :, None] * planes.normals[:, None])
    np.add.at(gx, planes.points, (stiffness * distance)[:, None] * planes.normals)
    diagonal = 6 * known.views[:, None] + np.arange(3, 6)
    np.add.at(Hcc, (diagonal, diagonal), 1 / known.sigma[:, None] ** 2)
    np.add.at(gc, diagonal, away / known.sigma[:, None] ** 2)
    return _Linearised(float(cost), Hcc, (Jc.T @ Jx).tocsr(), Hxx, gc, gx)


def _rows(derivatives: np.ndarray, columns: np.ndarray, size: int) -> sparse.csr_matrix:
    """A sparse Jacobian of two rows for each observation, with derivatives by the same columns."""
    count, rows, width = derivatives.shape
    indices = np.repeat(columns[:, None], rows, axis=1).reshape(-1)
    starts = np.arange(0, count * rows * width + 1, width)
    return sparse.csr_matrix((derivatives.reshape(-1), indices, starts), (count * rows, size))


def _reduced(system: _Linearised, damping: float, held: np.ndarray) -> tuple[np.ndarray, np.ndarray, sparse.bsr_matrix]:
    """Schur complement of the points, its right side, and the inverse of the points' blocks."""
    Hxx = system.Hxx + damping * system.Hxx * np.eye(3)
    traces = np.einsum("nii->n", Hxx)
    Hxx += (1e-12 * traces + (traces == 0))[:, None, None] * np.eye(3)
    inverse = np.linalg.inv(Hxx)
    count = len(inverse)
    blocks = sparse.bsr_matrix((inverse, np.arange(count), np.arange(count + 1)), (3 * count, 3 * count))
    carried = system.Hcx @ blocks
    S = system.Hcc + np.diag(damping * system.Hcc.diagonal()) - (carried @ system.Hcx.T).toarray()
    right = -(system.gc - carried @ system.gx.reshape(-1))
    S[held], S[:, held], right[held] = 0.0, 0.0, 0.0
    S[held, held] = 1.0
    return S, right, blocks


def _moved(bundle: Bundle, step: np.ndarray, points: np.ndarray, seen: Observations) -> Bundle:
    cameras = len(bundle.centres)
    pose, lens = step[: 6 * cameras].reshape(-1, 6), step[6 * cameras :].reshape(len(bundle.lenses), -1)
    turn = Rotation.from_rotvec(pose[:, :3]).as_matrix()
    lenses = np.clip(bundle.lenses + np.einsum("ljp,lp->lj", seen.free, lens), *seen.limits)
    return Bundle(turn @ bundle.rotations, bundle.centres + pose[:, 3:], lenses, bundle.points + points)


def _held(system: _Linearised, bundle: Bundle, seen: Observations) -> np.ndarray:
    """Unknowns that stay: those without influence, and those of a lens that are pulled beyond their limits."""
    cameras = len(bundle.centres)
    pull = -system.gc[6 * cameras :].reshape(len(bundle.lenses), -1)
    low, high = seen.limits
    at = np.where(bundle.lenses <= low, -1.0, np.where(bundle.lenses >= high, 1.0, 0.0))
    held = system.Hcc.diagonal() == 0
    held[6 * cameras :] |= (np.einsum("lj,ljp->lp", at, seen.free) * pull > 0).reshape(-1)
    return held


def adjust(objective: Objective, bundle: Bundle, steps: int = 50, damping: float = 1e-4) -> tuple[Bundle, float]:
    """Minimise an objective from a start; return the minimum and the damping to go on with.

    Along directions that nothing determines, such as the seven of the frame where only photographs speak, the bundle
    keeps its place: the gradient is 0 there, and damping holds it.
    """
    system = _linearised(objective, bundle)
    for _ in range(steps):
        held = _held(system, bundle, objective.observations)
        while damping < _MOST_DAMPING:
            S, right, blocks = _reduced(system, damping, held)
            try:
                step = cho_solve(cho_factor(S), right)
            except np.linalg.LinAlgError:
                damping *= 10
                continue
            points = -(blocks @ (system.gx.reshape(-1) + system.Hcx.T @ step)).reshape(-1, 3)
            trial = _moved(bundle, step, points, objective.observations)
            cost = objective.cost(trial)
            if cost < system.cost:
                break
            damping *= 10
        else:
            break
        bundle, before = trial, system.cost
        damping = max(damping / 10, _LEAST_DAMPING)
        if before - cost <= _CONVERGED * before:
            break
        system = _linearised(objective, bundle)
    return bundle, min(damping, 1e-2)


def intersected(objective: Objective, bundle: Bundle, steps: int = 20) -> Bundle:
    """Minimise an objective over the points alone: triangulate them from the cameras as they are."""
    damping = np.full(len(bundle.points), 1e-3)
    system = _linearised(objective, bundle)
    cost = _point_costs(objective, bundle)
    for _ in range(steps):
        Hxx = system.Hxx + damping[:, None, None] * system.Hxx * np.eye(3)
        traces = np.einsum("nii->n", Hxx)
        Hxx += (1e-12 * traces + (traces == 0))[:, None, None] * np.eye(3)
        trial = replace(bundle, points=bundle.points - np.linalg.solve(Hxx, system.gx[..., None])[..., 0])
        costs = _point_costs(objective, trial)
        better = costs < cost
        bundle = replace(bundle, points=np.where(better[:, None], trial.points, bundle.points))
        if (cost - np.minimum(cost, costs)).sum() <= _CONVERGED * cost.sum():
            break
        cost = np.minimum(cost, costs)
        damping = np.clip(np.where(better, damping / 10, damping * 10), _LEAST_DAMPING, _MOST_DAMPING)
        system = _linearised(objective, bundle)
    return bundle


def _point_costs(objective: Objective, bundle: Bundle) -> np.ndarray:
    """Costs of the reprojection errors of each point."""
    error, _ = reprojection_errors(bundle, objective.observations)
    scale = (objective.cauchy * objective.pixel) ** 2
    costs = np.log1p((error**2).sum(axis=1) / scale)
    return np.bincount(objective.observations.points, costs, len(bundle.points))


def deviations(objective: Objective, bundle: Bundle) -> Float64[np.ndarray, " V"]:
    """Standard deviation of each camera's centre (root of the trace of its covariance) at the minimum."""
    system = _linearised(objective, bundle)
    held = _held(system, bundle, objective.observations)
    S, _, _ = _reduced(system, 1e-9, held)
    variances = np.linalg.inv(S).diagonal()[: 6 * len(bundle.centres)].reshape(-1, 6)[:, 3:]
    return np.sqrt(variances.sum(axis=1))
