"""Similarities, boxes, outliers and samples, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from shellgs_method.geometry.box import Box
from shellgs_method.geometry.outliers import inliers
from shellgs_method.geometry.similarity import centred, fit_similarity, scale_of, transformed
from shellgs_method.geometry.spread import spread

RNG = np.random.default_rng(0)
TURN = Rotation.from_euler("xyz", [0.4, -1.2, 2.0])


def similarity(scale: float, vector: np.ndarray, moved: np.ndarray) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = scale * Rotation.from_rotvec(vector).as_matrix(), moved
    return matrix


@pytest.mark.parametrize("mirrored", [False, True])
def test_a_fitted_similarity_has_the_least_squares_of_all_that_mirror_nothing(mirrored):
    """Against a general optimizer, from any start."""
    source = RNG.normal(0, [3, 2, 1], (12, 3))
    target = transformed(source, similarity(2.5, TURN.as_rotvec(), np.array([1.0, 2, 3]))) + RNG.normal(0, 0.1, (12, 3))
    if mirrored:
        target *= [1, 1, -1]

    def error(x: np.ndarray) -> float:
        return float(((transformed(source, similarity(np.exp(x[0]), x[1:4], x[4:])) - target) ** 2).sum())

    starts = [
        np.r_[0.9, turn, 1.0, 2, 3] for turn in (*Rotation.from_euler("xyz", RNG.uniform(-3, 3, (12, 3))).as_rotvec(),)
    ]
    least = min(minimize(error, start).fun for start in starts)
    found = fit_similarity(source, target)
    assert ((transformed(source, found) - target) ** 2).sum() == pytest.approx(least, rel=1e-5)
    assert np.linalg.det(found[:3, :3]) > 0


def test_a_similarity_scales_turns_and_moves():
    matrix, points = similarity(0.3, TURN.as_rotvec(), np.array([1.0, 2, 3])), RNG.normal(size=(2, 5, 3))
    np.testing.assert_allclose(
        transformed(points, matrix), 0.3 * np.einsum("ij,abj->abi", TURN.as_matrix(), points) + [1, 2, 3]
    )
    assert scale_of(matrix) == pytest.approx(0.3)
    np.testing.assert_allclose(
        transformed(np.array([[1.0, 2, 3], [2, 2, 3]]), centred(np.array([1.0, 2, 3]), 4)), [[0] * 3, [4, 0, 0]]
    )


def test_a_box_lies_along_its_points_with_a_margin_and_without_strays():
    along = RNG.uniform(-1, 1, (5000, 3)) * [4, 2, 1]
    points = along @ TURN.as_matrix().T + [10, 20, 30]
    box = Box.around(points, margin=0.5)
    assert box.size == pytest.approx(9, abs=0.1)
    assert box.contains(points).all()
    places = np.array([[4.4, 2.4, 1.4], [4.6, 0, 0], [0, -2.6, 0], [0, 0, 1.6]]) @ TURN.as_matrix().T + [10, 20, 30]
    assert box.contains(places).tolist() == [True, False, False, False]
    strays = np.concatenate([points, [[1e3, 0, 0]]])
    assert Box.around(strays, margin=0.5, trim=0.01).size < 10
    assert Box.around(points[:2], margin=0.25).contains(points[:2]).all()


def test_points_that_are_not_finite_or_absurdly_far_are_outliers():
    points = RNG.normal(size=(9, 3)) + 1e4
    points[2, 1], points[4, 0], points[5] = np.nan, -np.inf, 1e9
    assert np.flatnonzero(~inliers(points)).tolist() == [2, 4, 5]
    assert not inliers(np.full((3, 3), np.nan)).any()
    assert inliers(np.array([[1.0, 2, 3]] * 3 + [[1.0, 2, 4]])).all()
    # The median distance is 1: ten times it is near enough, and eleven times not.
    line = np.array([0.0, -1, 1, 1, -1, 10, -11])[:, None] * [1, 0, 0]
    assert inliers(line, far=10).tolist() == [True] * 6 + [False]


def test_a_spread_has_the_first_and_the_last():
    assert spread(11, 3).tolist() == [0, 5, 10]
    assert spread(3, 9).tolist() == [0, 1, 2]
    assert spread(10, 1).tolist() == [0]
