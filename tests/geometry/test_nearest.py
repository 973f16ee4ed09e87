"""The tree of nearest points."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from shellgs_method.geometry.nearest import point_tree


def test_the_nearest_points_are_found_beside_an_outlier_and_among_equal_ones():
    rng = np.random.default_rng(0)
    wall = rng.uniform(-10, 10, (200, 3)) * [1, 0, 1]
    points = np.concatenate([wall, wall[:50], [[1e7, -1e7, 1e7]]])
    queries = rng.uniform(-60, 60, (100, 3))
    away = np.linalg.norm(queries[:, None] - points, axis=2)
    distance, nearest = point_tree(points).query(queries)
    np.testing.assert_allclose(distance, away.min(axis=1))
    np.testing.assert_allclose(away[np.arange(100), nearest], away.min(axis=1))


def test_all_nearest_points_are_found_with_one_tree():
    """Scipy's default takes minutes where this takes a second."""
    folder = Path(__file__).parents[2] / "shellgs_method"
    users = [
        file.name for file in folder.rglob("*.py") if re.search(r"scipy.spatial.*\bc?KDTree", file.read_text("utf8"))
    ]
    assert users == ["nearest.py"]
