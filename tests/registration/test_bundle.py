"""Bundle adjustment against finite differences, scipy and COLMAP."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from shellgs_method.errors import SceneError
from shellgs_method.files.colmap import (
    KEYPOINT,
    ColmapCamera,
    ColmapImage,
    Model,
    Points,
    read_model,
    tracks_of,
    write_model,
)
from shellgs_method.geometry.distortion import PARAMETERS, to_pixels
from shellgs_method.geometry.similarity import fit_similarity, transformed
from shellgs_method.registration.bundle import (
    Bundle,
    Objective,
    Observations,
    Planes,
    Positions,
    adjust,
    deviations,
    intersected,
    reprojection_errors,
)
from shellgs_method.registration.bundle_model import adjusted_model, bundle_of, with_distortion, with_finite_points

LENS = np.array([500.0, 510, 320, 240, 0.02, -0.01, 0.001, -0.002, 0.003, 0.001])


def problem(
    views: int = 5, points: int = 30, noise: float = 0.5, fisheye: tuple[bool, ...] = (False, True)
) -> tuple[Bundle, Observations]:
    """Cameras in a row before points near a plane, and noisy observations; lenses alternate."""
    random = np.random.default_rng(0)
    positions = random.uniform([-4, -2, -0.3], [4, 2, 0.3], (points, 3))
    centres = np.column_stack([np.linspace(-4, 4, views), random.normal(0, 0.3, views), random.normal(-8, 0.5, views)])
    turns = Rotation.from_rotvec(random.normal(0, 0.05, (views, 3))).as_matrix()
    lenses = np.tile(LENS, (len(fisheye), 1))
    free = np.zeros((len(fisheye), 10, 2))
    free[:, :2, 0] = free[:, PARAMETERS.index("k1"), 1] = 1.0
    bundle = Bundle(turns, centres, lenses, positions)
    view, point = (index.ravel() for index in np.mgrid[:views, :points])
    lens_of, kinds = np.arange(views) % len(fisheye), np.array(fisheye)
    nowhere, limits = np.zeros((len(view), 2)), (lenses - 50, lenses + 50)
    seen = Observations(view, point, nowhere, np.ones(len(view)), lens_of, kinds, free, limits)
    pixels = reprojection_errors(bundle, seen)[0]
    return bundle, replace(seen, pixels=pixels + random.normal(0, noise, pixels.shape))


def moved(bundle: Bundle, seen: Observations, step: np.ndarray) -> Bundle:
    """The bundle moved by a vector of turns and shifts of cameras, lens parameters and shifts of points."""
    views, lenses = len(bundle.centres), seen.free.shape[2] * len(bundle.lenses)
    pose, lens, points = np.split(step, [6 * views, 6 * views + lenses])
    turns = Rotation.from_rotvec(pose.reshape(-1, 6)[:, :3]).as_matrix()
    shift = np.einsum("ljp,lp->lj", seen.free, lens.reshape(len(bundle.lenses), -1))
    return Bundle(
        turns @ bundle.rotations,
        bundle.centres + pose.reshape(-1, 6)[:, 3:],
        bundle.lenses + shift,
        bundle.points + points.reshape(-1, 3),
    )


def disturbed(bundle: Bundle, size: float = 0.05) -> Bundle:
    random = np.random.default_rng(1)
    turns = Rotation.from_rotvec(random.normal(0, size / 5, (len(bundle.centres), 3))).as_matrix()
    centres, points = (at + random.normal(0, size, at.shape) for at in (bundle.centres, bundle.points))
    return replace(bundle, rotations=turns @ bundle.rotations, centres=centres, points=points)


def with_all_terms(bundle: Bundle, seen: Observations) -> Objective:
    """Reprojection errors, points on a plane, which count differently, and two known positions."""
    wall, weights = np.arange(20), np.linspace(0, 1, 20)
    planes = Planes(wall, np.tile([0.0, 0, 1], (20, 1)), np.zeros((20, 3)), weights, sigma=0.05)
    return Objective(
        seen, 0.5, planes=planes, positions=Positions(np.array([0, 3]), bundle.centres[[0, 3]], np.array([0.01, 0.02]))
    )


@pytest.mark.parametrize("fisheye", [False, True])
def test_the_derivatives_of_a_lens_are_those_of_finite_differences(fisheye: bool):
    rays = np.random.default_rng(0).uniform(-0.8, 0.8, (20, 2))
    lenses = np.tile(LENS, (20, 1))
    _, by_ray, by_lens = to_pixels(rays, lenses, fisheye)
    for analytic, at in ((by_ray, 0), (by_lens, 1)):
        for k in range(analytic.shape[2]):
            step = np.zeros(analytic.shape[2])
            step[k] = 1e-5
            ends = [
                to_pixels(*((rays + s * step, lenses) if at == 0 else (rays, lenses + s * step)), fisheye)[0]
                for s in (1, -1)
            ]
            np.testing.assert_allclose(analytic[:, :, k], (ends[0] - ends[1]) / 2e-5, rtol=1e-6, atol=1e-5)


@pytest.mark.parametrize("fisheye", [False, True])
def test_lenses_distort_as_those_of_opencv(fisheye: bool):
    import cv2

    rays = np.random.default_rng(0).uniform(-0.8, 0.8, (20, 2))
    ours, _, _ = to_pixels(rays, np.tile(LENS, (20, 1)), fisheye)
    K = np.array([[LENS[0], 0, LENS[2]], [0, LENS[1], LENS[3]], [0, 0, 1]])
    k1, k2, p1, p2, k3, k4 = LENS[4:]
    if fisheye:
        theirs = cv2.fisheye.distortPoints(rays[:, None], K, np.array([k1, k2, k3, k4]))
    else:
        at_one = np.append(rays, np.ones((20, 1)), axis=1)
        theirs, _ = cv2.projectPoints(at_one, np.zeros(3), np.zeros(3), K, np.array([k1, k2, p1, p2]))
    np.testing.assert_allclose(ours, theirs[:, 0], rtol=1e-9)


def test_where_the_gradient_is_zero_the_cost_is_stationary():
    bundle, seen = problem()
    objective = with_all_terms(bundle, seen)
    found, _ = adjust(objective, disturbed(bundle), steps=200, converged=1e-15)
    size = 6 * 5 + 2 * 2 + 3 * 30
    slopes = []
    for k in range(size):
        step = np.zeros(size)
        step[k] = 1e-6
        slopes.append((objective.cost(moved(found, seen, step)) - objective.cost(moved(found, seen, -step))) / 2e-6)
    assert np.abs(slopes).max() < 1e-3 * objective.cost(disturbed(bundle))


def test_the_minimum_is_that_of_scipy():
    bundle, seen = problem()
    objective = with_all_terms(bundle, seen)

    def residuals(step: np.ndarray) -> np.ndarray:
        """Smooth roots of the robust term and the others, whose sum of squares is twice the cost."""
        at = moved(bundle, seen, step)
        error = reprojection_errors(at, seen)[0] / objective.pixel
        squared = np.maximum((error**2).sum(axis=1, keepdims=True), 1e-12) / objective.cauchy**2
        cauchy = error * np.sqrt(np.log1p(squared) / squared)
        planes = objective.planes
        distance = np.einsum("kj,kj->k", planes.normals, at.points[planes.points] - planes.feet)
        off = distance * np.sqrt(planes.weights) / planes.sigma
        known = objective.positions
        away = (at.centres[known.views] - known.centres) / known.sigma[:, None]
        return np.concatenate([cauchy.ravel(), off, away.ravel()])

    found, _ = adjust(objective, disturbed(bundle, 0.02), steps=200, converged=1e-15)
    reference = least_squares(residuals, np.zeros(6 * 5 + 4 + 90), x_scale="jac", max_nfev=40)
    assert objective.cost(found) == pytest.approx(reference.cost, rel=5e-4)
    assert 2 * objective.cost(bundle) == pytest.approx((residuals(np.zeros(124)) ** 2).sum())


def test_without_planes_the_minimum_is_that_of_colmap(tmp_path: Path):
    bundle, seen = problem(views=8, points=100, noise=0.3, fisheye=(False,))
    write_model(tmp_path / "start", as_model(disturbed(bundle, 0.02), seen), np.zeros(100))
    script = f"""
import zlib, json, pycolmap
model = pycolmap.Reconstruction({str(tmp_path / "start")!r})
options = pycolmap.BundleAdjustmentOptions(print_summary=False)
options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
options.ceres.loss_function_scale = 1.0
pycolmap.bundle_adjustment(model, options)
model.write({str(tmp_path)!r})
"""
    subprocess.run([sys.executable, "-c", script], check=True, capture_output=True)
    start, seen = bundle_of(read_model(tmp_path / "start"), np.eye(4))
    theirs, _ = bundle_of(read_model(tmp_path), np.eye(4))
    objective = Objective(seen, pixel=1.0, cauchy=1.0)
    ours, _ = adjust(objective, start, steps=200, converged=1e-12)
    assert objective.cost(start) > 2 * objective.cost(ours)
    assert objective.cost(ours) == pytest.approx(objective.cost(theirs), rel=1e-4)
    back = fit_similarity(ours.centres, theirs.centres)
    np.testing.assert_allclose(transformed(ours.centres, back), theirs.centres, atol=2e-3)
    np.testing.assert_allclose(ours.lenses[:, :2], theirs.lenses[:, :2], rtol=1e-3)


def as_model(bundle: Bundle, seen: Observations) -> Model:
    """A COLMAP model of one OPENCV lens."""
    views, points = len(bundle.centres), len(bundle.points)
    features = np.empty((views, points), KEYPOINT)
    features["xy"][seen.views, seen.points], features["point"] = seen.pixels, np.arange(1, points + 1)
    images = {k + 1: ColmapImage((1, 0, 0, 0), (0, 0, 0), 1, f"{k}.png", features[k]) for k in range(views)}
    point = np.repeat(np.arange(points), views)
    tracks = tracks_of(point, np.tile(np.arange(1, views + 1), points), point)
    cameras = {1: ColmapCamera("OPENCV", 640, 480, tuple(LENS[:8]))}
    colours = np.zeros((points, 3), np.uint8)
    known = Points(bundle.points, colours, tracks, np.arange(1, points + 1))
    return adjusted_model(Model(cameras, images, known), bundle, np.eye(4))


def test_photographs_whose_numbers_a_binary_model_cannot_hold_are_refused_before_the_adjustment():
    """Scripts number them by time stamps."""
    model = two_lenses()
    stamped = {1700000000000 + number: image for number, image in model.images.items()}
    with pytest.raises(SceneError, match="numbers a photograph or camera 17000000000"):
        bundle_of(replace(model, images=stamped), np.eye(4))


def two_lenses() -> Model:
    """Two photographs by lenses of two models, in closed form; each has a keypoint less than the tracks say."""
    random = np.random.default_rng(5)
    points = random.uniform([-2, -1, 5], [2, 1, 8], (20, 3))
    turns = Rotation.from_rotvec(random.normal(0, 0.1, (2, 3)))
    shifts = random.normal(0, 0.3, (2, 3))
    cameras = {
        7: ColmapCamera("SIMPLE_RADIAL", 640, 480, (500.0, 320, 240, 0.05)),
        3: ColmapCamera("OPENCV_FISHEYE", 640, 480, (400.0, 410, 321, 239, 0.02, -0.01, 0.003, 0.001)),
    }
    images = {}
    for number, lens, turn, shift in zip((9, 4), (3, 7), turns, shifts, strict=True):
        x, y, z = (turn.apply(points) + shift).T
        u, v = x / z, y / z
        r = np.hypot(u, v)
        features = np.empty(19, KEYPOINT)
        if lens == 7:
            f, cx, cy, k = cameras[7].params
            xy = np.stack([f * u * (1 + k * r**2) + cx, f * v * (1 + k * r**2) + cy], axis=1)
        else:
            fx, fy, cx, cy, *ks = cameras[3].params
            angle = np.arctan(r)
            bent = angle * (1 + sum(k * angle ** (2 * i + 2) for i, k in enumerate(ks))) / r
            xy = np.stack([fx * u * bent + cx, fy * v * bent + cy], axis=1)
        features["xy"], features["point"] = xy[:19], np.arange(1, 20)
        quaternion = tuple(turn.as_quat()[[3, 0, 1, 2]].tolist())
        images[number] = ColmapImage(quaternion, tuple(shift.tolist()), lens, f"{number}.png", features)
    point = np.repeat(np.arange(20), 2)
    known = Points(points, np.zeros((20, 3), np.uint8), tracks_of(point, np.tile([4, 9], 20), point), np.arange(1, 21))
    return Model(cameras, images, known)


def test_a_model_in_another_frame_projects_as_before_and_comes_back():
    model, placed = two_lenses(), np.eye(4)
    placed[:3, :3] = 2.5 * Rotation.from_rotvec([0.5, -0.3, 0.8]).as_matrix()
    placed[:3, 3] = [10, -20, 3]
    bundle, seen = bundle_of(model, placed)
    error, front = reprojection_errors(bundle, seen)
    assert len(error) == 38
    assert front.all()
    np.testing.assert_allclose(error, 0, atol=1e-9)
    np.testing.assert_allclose(bundle.points, transformed(model.points.positions, placed))
    adjusted = [{PARAMETERS[k] for k in np.flatnonzero(free.any(axis=1))} for free in seen.free]
    assert adjusted == [{"fx", "fy", "k1"}, {"fx", "fy", "k1", "k2", "k3", "k4"}]
    np.testing.assert_allclose((seen.limits[1] - seen.limits[0])[1], [40, 41, 40, 41, *[0.1] * 6])
    back = adjusted_model(model, bundle, placed)
    np.testing.assert_allclose(back.points.positions, model.points.positions)
    for number, image in model.images.items():
        other = back.images[number]
        np.testing.assert_allclose(np.abs(np.dot(other.quaternion, image.quaternion)), 1)
        np.testing.assert_allclose(other.translation, image.translation)
    for number, camera in model.cameras.items():
        np.testing.assert_allclose(back.cameras[number].params, camera.params)


def test_lenses_of_different_numbers_of_parameters_are_adjusted_together():
    bundle, seen = bundle_of(two_lenses(), np.eye(4))
    start, objective = disturbed(bundle, 0.01), Objective(seen)
    assert objective.cost(start) > 10
    assert objective.cost(adjust(objective, start)[0]) < 1e-3


def test_an_adjustment_is_the_same_in_a_turned_world():
    bundle, seen = problem()
    start, objective = disturbed(bundle), Objective(seen, 0.5)
    turn = Rotation.from_rotvec([1, 2, -1.5]).as_matrix()
    turned = Bundle(start.rotations @ turn.T, start.centres @ turn.T, start.lenses, start.points @ turn.T)
    costs = [objective.cost(adjust(objective, each, steps=4)[0]) for each in (start, turned)]
    assert costs[1] == pytest.approx(costs[0], rel=1e-3)


def test_pinhole_lenses_of_many_photographs_may_distort_and_those_of_none_are_left_out():
    model = two_lenses()
    shared = {1: 10, 2: 9, 3: 1, 4: 10, 5: 0}
    params = (500.0, 510.0, 320.0, 240.0)
    cameras = {number: ColmapCamera("PINHOLE", 640, 480, params) for number in shared}
    cameras[4] = ColmapCamera("SIMPLE_PINHOLE", 640, 480, (500.0, 320.0, 240.0))
    cameras[3] = model.cameras[3]
    numbers = [number for number, count in shared.items() for _ in range(count)]
    images = {k: model.images[9]._replace(camera=number) for k, number in enumerate(numbers)}
    found = with_distortion(replace(model, cameras=cameras, images=images)).cameras
    assert found == {
        1: ColmapCamera("OPENCV", 640, 480, (*params, 0.0, 0.0, 0.0, 0.0)),
        2: cameras[2],
        3: cameras[3],
        4: ColmapCamera("OPENCV", 640, 480, (500.0, 500.0, 320.0, 240.0, 0.0, 0.0, 0.0, 0.0)),
    }


def test_points_that_are_not_finite_begin_amidst_the_others():
    model = two_lenses()
    positions = np.array([[1.0, 2, 3], [np.nan, 5, 6], [3, 4, 9], [50, 6, 5]])
    found = with_finite_points(replace(model, points=replace(model.points, positions=positions))).points.positions
    np.testing.assert_array_equal(found[1], [3, 4, 5])
    np.testing.assert_array_equal(found[[0, 2, 3]], positions[[0, 2, 3]])


def test_joined_planes_cost_what_both_do():
    bundle, seen = problem()
    walls = [
        Planes(np.arange(k, k + 5), np.tile([0.0, 0, 1], (5, 1)), np.zeros((5, 3)), np.linspace(0.2, 1, 5), sigma)
        for k, sigma in ((0, 0.05), (10, 0.02))
    ]
    none, *each, both = (Objective(seen, planes=p).cost(bundle) for p in (Planes(), *walls, walls[0].joined(walls[1])))
    assert both - none == pytest.approx(sum(each) - 2 * none)
    assert min(each) > none


def test_what_is_behind_a_camera_does_not_count():
    bundle, seen = problem()
    points = bundle.points.copy()
    points[3, 2] = -30
    behind, others = replace(bundle, points=points), np.arange(len(points)) != 3
    error, front = reprojection_errors(behind, seen)
    assert not error[seen.points == 3].any()
    np.testing.assert_array_equal(front, seen.points != 3)
    assert Objective(seen).cost(behind) == pytest.approx(Objective(seen.of_points(others)).cost(behind))


def test_what_nothing_determines_stays():
    """A bare wall that is 10 cm farther away moves points along its normal, or makes all larger; not along it."""
    bundle, seen = problem(points=60)
    bundle = replace(bundle, points=bundle.points * [1, 1, 0])
    exact = replace(seen, pixels=seen.pixels + reprojection_errors(bundle, seen)[0])
    wall = Planes(np.arange(60), np.tile([0.0, 0, 1], (60, 1)), np.tile([0.0, 0, 0.1], (60, 1)), np.ones(60), 0.01)
    loose = Positions(np.arange(5), bundle.centres, np.ones(5))
    found, _ = adjust(Objective(exact, 0.5, planes=wall, positions=loose), bundle, steps=100)
    np.testing.assert_allclose(found.points[:, 2], 0.1, atol=1e-4)
    grown = fit_similarity(bundle.points, found.points)
    np.testing.assert_allclose(grown[:3, :3], grown[0, 0] * np.eye(3), atol=1e-4)
    assert np.abs((found.centres - bundle.centres)[:, :2].mean(axis=0)).max() < 0.002


def test_points_are_triangulated_to_a_minimum_and_cameras_stay():
    bundle, seen = problem()
    objective = Objective(seen, 0.5)
    start = replace(bundle, points=disturbed(bundle).points)
    found = intersected(objective, start, steps=50)
    np.testing.assert_array_equal(found.centres, bundle.centres)
    error = objective.cost(found)
    # No point can be moved to where its error is smaller.
    random = np.random.default_rng(2)
    for _ in range(20):
        other = replace(found, points=found.points + random.normal(0, 1e-3, found.points.shape))
        assert objective.cost(other) > error


def test_deviations_are_those_of_repeated_trials():
    bundle, clean = problem(views=6, points=40, noise=0.0)
    known = Positions(np.array([0, 2, 5]), bundle.centres[[0, 2, 5]], np.full(3, 1e-3))
    random = np.random.default_rng(3)
    errors = []
    for _ in range(30):
        seen = replace(clean, pixels=clean.pixels + random.normal(0, 0.5, clean.pixels.shape))
        # Cauchy's scale is far off: the residuals are normal.
        found, _ = adjust(Objective(seen, 0.5, cauchy=50, positions=known), bundle, steps=15)
        errors.append(((found.centres - bundle.centres) ** 2).sum(axis=1))
    expected = deviations(Objective(clean, 0.5, cauchy=50, positions=known), bundle)
    measured = np.sqrt(np.mean(errors, axis=0))
    np.testing.assert_allclose(measured[[1, 3, 4]], expected[[1, 3, 4]], rtol=0.4)


def test_lenses_stay_within_their_limits():
    bundle, seen = problem(noise=0.1)
    wrong = replace(bundle, lenses=bundle.lenses - np.array([40.0, 40, *[0] * 8]))
    limits = (wrong.lenses - 10, wrong.lenses + 10)
    known = Positions(np.arange(5), bundle.centres, np.full(5, 1e-3))
    found, _ = adjust(Objective(replace(seen, limits=limits), 0.5, positions=known), wrong)
    assert (found.lenses <= limits[1]).all()
    assert (found.lenses[:, 0] == limits[1][:, 0]).any()
