"""The largest plane among points, of known planes."""

from __future__ import annotations

import numpy as np
import pytest

from shellgs_method.geometry.planes import across, fitted_plane, largest_plane

RNG = np.random.default_rng(0)
NORMAL = np.array([0.6, 0.0, -0.8])
RIGHT, UP = np.array([0.8, 0.0, 0.6]), np.array([0.0, 1.0, 0.0])


def on_plane(count: int, noise: float = 0.0) -> np.ndarray:
    """Points on the plane n · x = 5."""
    u, v = RNG.uniform(-2, 2, (2, count, 1))
    return 5 * NORMAL + u * RIGHT + v * UP + noise * RNG.normal(size=(count, 1)) * NORMAL


def test_the_largest_plane_has_all_points_within_the_tolerance():
    points = np.concatenate([on_plane(600, noise=0.002), RNG.uniform(-6, 6, (900, 3))])
    found = largest_plane(points, 0.02, np.random.default_rng(1))
    off = np.abs(points @ NORMAL - 5)
    assert found[off < 0.015].all()
    assert not found[off > 0.025].any()


def test_no_plane_through_what_was_found_has_more_points():
    points = np.concatenate([on_plane(300, noise=0.05), RNG.uniform(-6, 6, (900, 3))])
    for seed in range(5):
        found = largest_plane(points, 0.05, np.random.default_rng(seed))
        centre, normal = fitted_plane(points[found])
        assert (np.abs((points - centre) @ normal) <= 0.05).sum() <= found.sum()
        assert found[:300].sum() > 170  # 68 % lie within a standard deviation


def test_points_whose_normals_disagree_are_not_on_it():
    """Two crossing walls: where they meet, each point is on the one that its normal is of."""
    points = np.concatenate([on_plane(400), 5 * NORMAL + RNG.uniform(-2, 2, (200, 2)) @ np.stack([NORMAL, UP])])
    normals = np.repeat([NORMAL, RIGHT], [400, 200], axis=0) * np.sign(RNG.normal(size=(600, 1)))
    found = largest_plane(points, 0.2, np.random.default_rng(1), normals)
    assert found.tolist() == [True] * 400 + [False] * 200


def test_points_on_a_line_are_on_no_plane():
    assert not largest_plane(np.linspace(0, 1, 50)[:, None] * NORMAL, 0.1, np.random.default_rng(0)).any()


def test_a_fitted_plane_has_the_least_squares():
    points = on_plane(200, noise=0.3)
    centre, normal = fitted_plane(points)
    np.testing.assert_allclose(centre, points.mean(axis=0))
    _, _, axes = np.linalg.svd(points - centre)
    assert abs(normal @ axes[2]) == pytest.approx(1)


def test_a_vector_across_another_is_of_length_one_and_at_a_right_angle():
    for vector in [*RNG.normal(0, 9, (20, 3)), *np.eye(3), -np.eye(3)[1]]:
        assert np.linalg.norm(across(vector)) == pytest.approx(1)
        assert across(vector) @ vector == pytest.approx(0, abs=1e-12)
