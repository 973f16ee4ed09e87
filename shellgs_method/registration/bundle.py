"""Bundle adjustment: cameras, lenses and points by sparse Levenberg-Marquardt, points eliminated (Schur complement).

Triggs et al., "Bundle Adjustment - A Modern Synthesis", 2000. Besides reprojection errors there are the distances of
points from planes and of camera centres from given positions, which COLMAP's bundle adjustment does not have.
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
_OF_EACH = ("views", "points", "pixels", "weights")
"""What :class:`Observations` have of each."""


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
        weights: how much each observation counts.
        lens_of: lens of each camera.
        fisheye: whether each lens is a fisheye lens.
        free: the parameters that are adjusted of each lens, as the columns of a matrix.
        limits: smallest and largest value of each lens' parameters.
    """

    views: Int64[np.ndarray, " M"]
    points: Int64[np.ndarray, " M"]
    pixels: Float64[np.ndarray, "M 2"]
    weights: Float64[np.ndarray, " M"]
    lens_of: Int64[np.ndarray, " V"]
    fisheye: Bool[np.ndarray, " L"]
    free: Float64[np.ndarray, "L 10 P"]
    limits: tuple[Float64[np.ndarray, "L 10"], Float64[np.ndarray, "L 10"]]

    def of_points(self, chosen: Bool[np.ndarray, " N"]) -> Observations:
        """The observations of some of the points, which keep their numbers."""
        kept = chosen[self.points]
        return replace(self, **{name: getattr(self, name)[kept] for name in _OF_EACH})

    def joined(self, other: Observations) -> Observations:
        """These and the other observations, by the same cameras."""
        return replace(self, **{name: np.concatenate([getattr(self, name), getattr(other, name)]) for name in _OF_EACH})


@dataclass(frozen=True)
class Planes:
    """Planes that points lie on.

    Attributes:
        points: indices of the points.
        normals: unit normal of the plane of each.
        feet: a point of the plane of each.
        weights: how much each plane counts.
        sigma: standard deviation of a point's distance from its plane.
    """

    points: Int64[np.ndarray, " K"] = field(default_factory=lambda: np.empty(0, np.int64))
    normals: Float64[np.ndarray, "K 3"] = field(default_factory=lambda: np.empty((0, 3)))
    feet: Float64[np.ndarray, "K 3"] = field(default_factory=lambda: np.empty((0, 3)))
    weights: Float64[np.ndarray, " K"] = field(default_factory=lambda: np.empty(0))
    sigma: float = 1.0

    def joined(self, other: Planes) -> Planes:
        """These and the other planes, by the standard deviation of these."""
        ours = self.points, self.normals, self.feet, self.weights
        theirs = other.points, other.normals, other.feet, other.weights * (self.sigma / other.sigma) ** 2
        return Planes(*map(np.concatenate, zip(ours, theirs, strict=True)), sigma=self.sigma)


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
    """Half the sum of squared errors by their standard deviations, reprojection errors with Cauchy's loss.

    Attributes:
        observations: reprojection errors.
        pixel: standard deviation of a pixel's coordinate.
        cauchy: scale of the loss, in standard deviations.
        planes: distances of points from planes.
        positions: distances of cameras from known positions.
    """

    observations: Observations
    pixel: float = 1.0
    cauchy: float = 2.0
    planes: Planes = field(default_factory=Planes)
    positions: Positions = field(default_factory=Positions)

    def cost(self, bundle: Bundle) -> float:
        """Value of the objective."""
        return _residuals(self, bundle)[-1]


@dataclass
class _Linearised:
    """Cost, gradients and Gauss-Newton's Hessian of cameras and lenses (c) and of points (x)."""

    cost: float
    Hcc: np.ndarray
    Hcx: sparse.csr_matrix
    Hxx: np.ndarray
    gc: np.ndarray
    gx: np.ndarray


@dataclass
class _Reprojection:
    """Errors by their standard deviation, weights and costs of observations, and derivatives of the errors.

    Errors and weights of points that are not in front of their camera are 0. Derivatives are by the place of the point
    inside its camera's frame, and by the parameters of the lens.
    """

    error: np.ndarray
    front: np.ndarray
    weight: np.ndarray
    cost: np.ndarray
    inside: np.ndarray
    by_inside: np.ndarray
    by_lens: np.ndarray

    @classmethod
    def of(cls, objective: Objective, bundle: Bundle) -> _Reprojection:
        seen, scale = objective.observations, objective.cauchy**2
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
        error, by_inside, by_lens = (each / objective.pixel for each in (error, by_inside, by_lens))
        squared = (error**2).sum(axis=1)
        weight = np.where(front, seen.weights / (1 + squared / scale), 0.0)
        cost = 0.5 * scale * seen.weights * np.log1p(squared / scale)
        return cls(error, front, weight, cost, inside, by_inside, by_lens)


def reprojection_errors(
    bundle: Bundle, observations: Observations
) -> tuple[Float64[np.ndarray, "M 2"], Bool[np.ndarray, " M"]]:
    """Projected less observed pixels, and which points are in front of their camera; the error of others is 0."""
    at = _Reprojection.of(Objective(observations), bundle)
    return at.error, at.front


def _residuals(objective: Objective, bundle: Bundle) -> tuple[_Reprojection, np.ndarray, np.ndarray, float]:
    """Errors of the observations, distances from planes and positions, and the cost of all."""
    planes, known, at = objective.planes, objective.positions, _Reprojection.of(objective, bundle)
    distance = np.einsum("kj,kj->k", planes.normals, bundle.points[planes.points] - planes.feet)
    away = bundle.centres[known.views] - known.centres
    of_planes = 0.5 * (planes.weights / planes.sigma**2 * distance**2).sum()
    of_positions = 0.5 * ((away / known.sigma[:, None]) ** 2).sum()
    return at, distance, away, float(at.cost.sum() + of_planes + of_positions)


def _linearised(objective: Objective, bundle: Bundle) -> _Linearised:
    seen, planes, known = objective.observations, objective.planes, objective.positions
    at, distance, away, cost = _residuals(objective, bundle)
    root = np.sqrt(at.weight)[:, None, None]
    by_inside, error = at.by_inside * root, at.error[..., None] * root
    by_point = by_inside @ bundle.rotations[seen.views]
    # Turning the camera by the vector w moves a point x in its frame by w x x.
    by_turn = np.cross(at.inside[:, None], by_inside)
    by_pose = np.concatenate([by_turn, -by_point], axis=2)
    lens = seen.lens_of[seen.views]
    by_lens = np.einsum("mij,mjp->mip", at.by_lens * root, seen.free[lens])

    cameras, lenses, count = len(bundle.centres), len(bundle.lenses), len(bundle.points)
    Hpp, Hpl, gp = _blocks(seen.views, cameras, by_pose, by_pose, by_lens, error)
    Hll, gl = _blocks(lens, lenses, by_lens, by_lens, error)
    Hxx, gx = _blocks(seen.points, count, by_point, by_point, error)
    poses = np.arange(6 * cameras).reshape(-1, 6)
    own = 6 * cameras + np.arange(gl.size).reshape(lenses, -1)
    of_view = own[seen.lens_of]
    Hcc = np.zeros((6 * cameras + own.size,) * 2)
    Hcc[poses[:, :, None], poses[:, None]] = Hpp
    Hcc[own[:, :, None], own[:, None]] = Hll
    Hcc[poses[:, :, None], of_view[:, None]] = Hpl
    Hcc[of_view[:, :, None], poses[:, None]] = Hpl.transpose(0, 2, 1)
    gc, gx = np.concatenate([gp.ravel(), gl.ravel()]), gx[..., 0]
    of_poses = _mixed(by_pose, by_point, seen.views, cameras, seen.points, count)
    of_lenses = _mixed(by_lens, by_point, lens, lenses, seen.points, count)
    Hcx = sparse.csr_matrix(sparse.vstack([of_poses, of_lenses]))

    stiffness = planes.weights / planes.sigma**2
    np.add.at(Hxx, planes.points, stiffness[:, None, None] * planes.normals[:, :, None] * planes.normals[:, None])
    np.add.at(gx, planes.points, (stiffness * distance)[:, None] * planes.normals)
    diagonal = 6 * known.views[:, None] + np.arange(3, 6)
    np.add.at(Hcc, (diagonal, diagonal), 1 / known.sigma[:, None] ** 2)
    np.add.at(gc, diagonal, away / known.sigma[:, None] ** 2)
    return _Linearised(cost, Hcc, Hcx, Hxx, gc, gx)


def _blocks(index: np.ndarray, count: int, one: np.ndarray, *others: np.ndarray) -> list[np.ndarray]:
    """Products of derivatives (observation, pixel coordinate, unknown), summed over observations of the same index."""
    summed = sparse.csr_matrix((np.ones(len(index)), (index, np.arange(len(index)))), (count, len(index)))
    products = (np.matmul(one.transpose(0, 2, 1), other) for other in others)
    return [(summed @ each.reshape(len(each), -1)).reshape(-1, *each.shape[1:]) for each in products]


def _mixed(
    one: np.ndarray, other: np.ndarray, rows: np.ndarray, height: int, columns: np.ndarray, width: int
) -> sparse.csr_matrix:
    """The products of derivatives as blocks of a matrix, those of the same row and column summed."""
    order = np.argsort(rows, kind="stable")
    products = np.matmul(one.transpose(0, 2, 1), other)[order]
    starts = np.searchsorted(rows[order], np.arange(height + 1))
    shape = (height * products.shape[1], width * products.shape[2])
    blocks = sparse.csr_matrix(sparse.bsr_matrix((products, columns[order], starts), shape))
    blocks.sum_duplicates()
    return blocks


def _reduced(system: _Linearised, damping: float, held: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Schur complement of the points, its right side, and the inverses of the points' blocks."""
    inverses = np.linalg.inv(_damped(system.Hxx, damping))
    Hcx = system.Hcx
    triples = np.matmul(Hcx.data.reshape(-1, 1, 3), inverses[Hcx.indices[::3] // 3])  # a row has all three of a point
    carried = sparse.csr_matrix((triples.reshape(-1), Hcx.indices, Hcx.indptr), Hcx.shape)
    S = system.Hcc + np.diag(damping * system.Hcc.diagonal()) - (carried @ Hcx.T).toarray()
    right = carried @ system.gx.reshape(-1) - system.gc
    S[held], S[:, held], right[held] = 0.0, 0.0, 0.0
    S[held, held] = 1.0
    return S, right, inverses


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


def adjust(
    objective: Objective, bundle: Bundle, steps: int = 50, damping: float = 1e-4, converged: float = _CONVERGED
) -> tuple[Bundle, float]:
    """Minimise an objective from a start; return the minimum and the damping to continue with.

    Along directions that nothing determines, such as the seven of the frame where only photographs speak, the bundle
    keeps its place: the gradient is 0 there, and damping holds it.
    """
    system = _linearised(objective, bundle)
    for _ in range(steps):
        held = _held(system, bundle, objective.observations)
        while damping < _MOST_DAMPING:
            S, right, inverses = _reduced(system, damping, held)
            try:
                step = cho_solve(cho_factor(S), right)
            except np.linalg.LinAlgError:
                damping *= 10
                continue
            gradient = system.gx + (system.Hcx.T @ step).reshape(-1, 3)
            points = -np.matmul(inverses, gradient[..., None])[..., 0]
            trial = _moved(bundle, step, points, objective.observations)
            cost = objective.cost(trial)
            if cost < system.cost:
                break
            damping *= 10
        else:
            break
        bundle, before = trial, system.cost
        damping = max(damping / 10, _LEAST_DAMPING)
        if before - cost <= converged * before:
            break
        system = _linearised(objective, bundle)
    return bundle, min(damping, 1e-2)


def intersected(objective: Objective, bundle: Bundle, steps: int = 20) -> Bundle:
    """Minimise the reprojection errors over the points alone: triangulate them from the cameras as they are."""
    damping, cost = np.full(len(bundle.points), 1e-3), _point_costs(objective, bundle)
    for _ in range(steps):
        Hxx, gx = _of_points(objective, bundle)
        step = np.linalg.solve(_damped(Hxx, damping[:, None, None]), gx)[..., 0]
        trial = replace(bundle, points=bundle.points - step)
        costs = _point_costs(objective, trial)
        better = costs < cost
        bundle = replace(bundle, points=np.where(better[:, None], trial.points, bundle.points))
        decrease = np.where(better, cost - costs, 0.0).sum()
        if decrease <= _CONVERGED * cost.sum():
            break
        cost = np.where(better, costs, cost)
        damping = np.clip(np.where(better, damping / 10, damping * 10), _LEAST_DAMPING, _MOST_DAMPING)
    return bundle


def _of_points(objective: Objective, bundle: Bundle) -> list[np.ndarray]:
    """Hessian and gradient of the reprojection errors by each point."""
    seen, at = objective.observations, _Reprojection.of(objective, bundle)
    by_point = at.by_inside @ bundle.rotations[seen.views]
    weighed = at.weight[:, None, None] * by_point
    return _blocks(seen.points, len(bundle.points), weighed, by_point, at.error[..., None])


def covariances(objective: Objective, bundle: Bundle) -> Float64[np.ndarray, "N 3 3"]:
    """Covariance of each triangulated point, the cameras being exact."""
    return np.linalg.inv(_damped(_of_points(objective, bundle)[0], 0.0))


def _damped(blocks: np.ndarray, damping: float | np.ndarray) -> np.ndarray:
    """Blocks of points with a larger diagonal; that of a point without observations is 1."""
    blocks = blocks * (1 + damping * np.eye(3))
    traces = np.einsum("nii->n", blocks)
    return blocks + (1e-12 * traces + (traces == 0))[:, None, None] * np.eye(3)


def _point_costs(objective: Objective, bundle: Bundle) -> np.ndarray:
    """Costs of the reprojection errors of each point."""
    cost = _Reprojection.of(objective, bundle).cost
    return np.bincount(objective.observations.points, cost, len(bundle.points))


def deviations(objective: Objective, bundle: Bundle) -> Float64[np.ndarray, " V"]:
    """Standard deviation of each camera's centre (root of the trace of its covariance) at the minimum."""
    system = _linearised(objective, bundle)
    held = _held(system, bundle, objective.observations)
    S, _, _ = _reduced(system, 1e-9, held)
    variances = np.linalg.inv(S).diagonal()[: 6 * len(bundle.centres)].reshape(-1, 6)[:, 3:]
    return np.sqrt(variances.sum(axis=1))
