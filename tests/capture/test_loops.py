"""Loops of a walk: which pairs a coarse model proposes, and which matches it contradicts."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from shellgs_method.capture.loops import (
    CONFIRMED,
    DRIFT,
    View,
    agree,
    along_the_walk,
    astray,
    bridges,
    explained,
    loops,
    shared,
    weakest_cut,
)

BAY = 3.0
EXTENT = np.array([0.65, 0.4])


def wall() -> np.ndarray:
    """Points of a wall at y = 0, half a metre apart."""
    x, z = np.meshgrid(np.arange(-20, 60, 0.5), np.arange(0, 10, 0.5))
    return np.stack([x, 0 * x, z], axis=-1).reshape(-1, 3)


def facing(x: float, distance: float, points: np.ndarray, drift: float = 0.0, shifted: float = 0.0) -> View:
    """A camera before the wall, whose model is off by ``drift`` and whose features are ``shifted`` along the wall."""
    R = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    true, modelled = (View(np.c_[R, -R @ [u, -distance, 4.0]], EXTENT, points, points) for u in (x, x + drift))
    features, depth = true.project(points)
    seen = (depth > 0) & (np.abs(features) < EXTENT).all(axis=1)
    features += np.array([shifted / distance, 0])
    return View(modelled.viewmat, EXTENT, features, np.where(seen, np.arange(len(points)), -1))


def test_views_share_what_both_must_see():
    points = wall()
    shares = shared([facing(x, d, points) for x, d in ((0, 8), (5.2, 8), (40, 8), (0, 16), (0, 40))], points)
    np.testing.assert_allclose(np.diag(shares), 1)
    assert shares[0, 1] == pytest.approx(0.5, abs=0.1)  # a field of 10.4 m, half of it on
    assert shares[0, 2] == 0
    assert shares[0, 3] == 1
    assert shares[3, 0] == pytest.approx(0.3, abs=0.15)
    assert shares[0, 4] == 0  # five times as far: features have other scales


def test_a_view_behind_the_wall_shares_nothing():
    points = wall()
    behind = facing(0, -8, points)
    assert shared([facing(0, 8, points), behind], points)[0, 1] == 0


def test_the_way_back_is_matched_with_the_way_out():
    points = wall()
    out = [facing(x, 8, points) for x in np.arange(0, 30, 1.0)]
    views = out + out[::-1]
    matched = {(i, j) for i in range(60) for j in range(i + 1, 60) if j - i <= 10}
    found = loops(shared(views, points), matched, 3)
    assert not matched & set(found)
    assert all(i < 30 <= j and abs(59 - j - i) <= 6 for i, j in found)
    assert {k for pair in found for k in pair} >= set(range(24)) | set(range(36, 60))  # the turn is matched


def matches(first: View, second: View) -> np.ndarray:
    both = np.flatnonzero((first.points >= 0) & (second.points >= 0))
    return np.stack([both, both], axis=1)


@pytest.mark.parametrize("distance", [5, 10, 20])
def test_matches_that_are_a_bay_off_are_contradicted_and_drift_is_not(distance):
    points = wall()
    first, second = facing(0, distance, points), facing(1, distance, points, drift=0.5 * DRIFT * distance)
    assert agree(first, second, points, matches(first, second))
    confused = facing(1, distance, points, shifted=BAY)
    assert not agree(first, confused, points, matches(first, second))


@pytest.mark.parametrize(("share", "is_believed"), [(0.1, True), (0.4, False)])
def test_a_pair_whose_matches_are_of_two_windows_is_not_believed(share: float, is_believed: bool):
    points = wall()
    first, second = facing(0, 8, points), facing(1, 8, points)
    mixed = matches(first, second)
    index = {tuple(point): k for k, point in enumerate(points)}
    for k in range(int(share * len(mixed))):
        mixed[k, 1] = index[tuple(points[mixed[k, 0]] + [BAY, 0, 0])]
    assert agree(first, second, points, mixed) == is_believed


def test_matches_beside_epipolar_lines_are_not_explained_by_the_cameras():
    points = wall()
    first, second = facing(0, 8, points), facing(1, 8, points)
    both = matches(first, second)
    assert explained(first, second, both).all()
    assert not explained(first, replace(second, features=second.features + np.array([0, 0.02])), both).any()


def test_a_walk_is_weakest_where_its_model_takes_the_same_for_different_points():
    """Pairs of up to three steps share 50 matches a pair; the model confirms 30, across a tear 2."""
    pairs = np.array([(i, j) for i in range(12) for j in range(i + 1, min(i + 4, 12))])
    matched, torn = np.full(len(pairs), 50), (pairs[:, 0] <= 6) & (pairs[:, 1] > 6)
    share, _ = weakest_cut(pairs, np.full(len(pairs), 30), matched)
    assert share == pytest.approx(0.6)
    share, k = weakest_cut(pairs, np.where(torn, 2, 30), matched)
    assert (share, k) == (pytest.approx(0.04), 6)
    assert share < CONFIRMED


def test_where_a_walk_has_hardly_any_matches_nothing_is_said_of_its_model():
    """A video that is cut, or two passes in two folders."""
    pairs, confirmed, matched = np.array([[0, 1], [1, 2], [2, 3]]), np.array([90, 0, 90]), np.array([200, 20, 200])
    assert weakest_cut(pairs, confirmed, matched)[0] == pytest.approx(0.45)
    none = np.zeros((0, 2), int), np.zeros(0, int), np.zeros(0, int)
    assert weakest_cut(*none)[0] == 1


def test_matches_without_points_are_not_believed():
    points = wall()
    first, second = facing(0, 8, points), facing(1, 8, points)
    none = np.flatnonzero((first.points < 0) & (second.points < 0))[:50]
    assert not agree(first, second, points, np.stack([none, none], axis=1))


def test_groups_are_bridged_by_views_that_are_spread_over_each():
    first, second, third = ([f"{group}{k:02d}" for k in range(n)] for group, n in (("a", 100), ("b", 30), ("c", 2)))
    pairs = bridges([first, second, third], 4)
    assert len(pairs) == len(set(pairs)) == 4 * 4 + 4 * 2 + 4 * 2
    assert {a for a, _ in pairs if a in first} == {"a00", "a33", "a66", "a99"}
    assert all(a < b for a, b in pairs)


def test_a_walk_goes_folder_by_folder_with_numbers_in_their_order():
    walk = ["f1.jpg", "f2.jpg", "f010.jpg", "f10.jpg", "f10b.jpg", "pass 2/9.jpg", "pass 10/1.jpg", "pass 10/x.jpg"]
    assert sorted(sorted(walk), key=along_the_walk) == walk
    apart = ["01/1", "01/2", "1/1", "1/2"]
    assert sorted(["1/2", "01/1", "1/1", "01/2"], key=along_the_walk) == apart


def test_seconds_since_1970_have_decimals():
    """As robots name images by their times; Python writes no zeros at the end, ROS nanoseconds with all of theirs."""
    seconds = [f"{1700000000 + k / 30}.jpg" for k in range(60)]
    assert sorted(sorted(seconds), key=along_the_walk) == seconds
    nanoseconds = [f"{1700000000 + k // 30}.{k % 30 * 33333333:09d}.jpg" for k in range(60)]
    assert sorted(sorted(nanoseconds), key=along_the_walk) == nanoseconds
    assert along_the_walk("walk1.9.jpg") < along_the_walk("walk1.10.jpg")


def test_a_view_of_two_groups_is_not_matched_with_itself():
    assert bridges([["a", "b"], ["b", "c"]], 2) == [("a", "b"), ("a", "c"), ("b", "c")]


@pytest.mark.parametrize("distance", [7.0, 30.0])
def test_a_window_that_is_a_bay_off_is_not_where_the_steps_between_move_it(distance: float):
    """Ten steps of 0.6 m along a wall with windows every 3 m, in pictures of 960 pixels that shake a little."""
    focal, bay, random = 720.0, 3.0, np.random.default_rng(0)
    K = np.array([[focal, 0, 480], [0, focal, 270], [0, 0, 1]])
    shake = [Rotation.from_rotvec(random.normal(0, 0.01, 3)).as_matrix() for _ in range(11)]
    cameras = [K @ turn @ np.array([[1, 0, -0.6 * k], [0, 1, 0], [0, 0, distance]]) for k, turn in enumerate(shake)]
    steps = [after @ np.linalg.inv(before) for before, after in pairwise(cameras)]
    X = np.column_stack([random.uniform(2, 6, 50), random.uniform(-2, 2, 50), np.ones(50)])

    def seen(camera: np.ndarray, points: np.ndarray) -> np.ndarray:
        x = points @ camera.T
        return x[:, :2] / x[:, 2:]

    first = seen(cameras[0], X)
    relief = seen(cameras[-1], X) * [1.01, 1.0]
    assert not astray(steps, first, relief, 960)
    assert astray(steps, first, seen(cameras[-1], X + np.array([bay, 0, 0])), 960)
