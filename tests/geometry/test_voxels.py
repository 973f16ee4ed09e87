"""Voxels of points that arrive piece by piece, against a dictionary of cells."""

from __future__ import annotations

import numpy as np
import pytest

from shellgs_method.geometry import voxels
from shellgs_method.geometry.voxels import Cells, VoxelMeans

ORIGIN = np.array([410_000.0, 5_413_000.0, 250.0])


def wall(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform([-9, -0.1, 0], [9, 0.1, 6], (count, 3)) + ORIGIN


def cell(point: np.ndarray, voxel: float, thirds: int) -> tuple:
    return tuple(np.floor((point - ORIGIN) / voxel + thirds / 3))


def check(means: VoxelMeans, points: np.ndarray) -> None:
    """The origin is a third of a voxel from a boundary, before or behind it."""
    thirds = round(3 * (means._shift % 1))
    assert thirds in (1, 2)
    cells: dict[tuple, list[np.ndarray]] = {}
    for point in points:
        cells.setdefault(cell(point, means.voxel, thirds), []).append(point)
    found, _, counts = means.means()
    assert len(found) == len(cells)
    for point, count in zip(found, counts, strict=True):
        members = cells[cell(point, means.voxel, thirds)]
        assert count == len(members)
        np.testing.assert_allclose(point, np.mean(members, axis=0), rtol=0, atol=1e-8)


@pytest.fixture(autouse=True)
def short_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(voxels, "_PIECE", 64)


@pytest.mark.parametrize("pieces", [1, 7, 100])
def test_the_means_are_those_of_all_points_however_they_arrive(pieces: int):
    points, means = wall(2000), VoxelMeans(ORIGIN, 0.5, 10_000)
    for piece in np.array_split(points, pieces):
        assert means.add(piece).all()
    assert means.voxel == 0.5
    check(means, points)


def test_voxels_double_where_there_would_be_more():
    points, means = wall(3000), VoxelMeans(ORIGIN, 0.1, 300)
    for piece in np.array_split(points, 20):
        means.add(piece)
    assert len(means.means()[0]) <= 2 * means.most
    assert np.log2(means.voxel / 0.1) == round(np.log2(means.voxel / 0.1)) > 0
    check(means, points)


def test_voxels_double_where_later_points_are_beyond_the_lattice():
    near, far = wall(500), wall(500) + np.array([1e5, 0, 0])
    means = VoxelMeans(ORIGIN, 0.01, 10_000)
    means.add(near)
    assert means.add(far).all()
    assert means.voxel > 0.01
    check(means, np.concatenate([near, far]))


def test_nan_and_absurd_points_are_not_added():
    points, means = wall(500), VoxelMeans(ORIGIN, 0.5, 10_000)
    spoilt = np.concatenate([points, [[np.nan, 0, 0], [0, np.inf, 0], [1e30, 0, 0]]])
    np.testing.assert_array_equal(means.add(spoilt), np.arange(503) < 500)
    check(means, points)


def test_values_are_averaged_with_their_points():
    points, means = wall(1000), VoxelMeans(ORIGIN, 0.5, 10_000, 3)
    for piece in np.array_split(points, 9):
        means.add(piece, piece - ORIGIN)
    places, values, _ = means.means()
    np.testing.assert_allclose(places - ORIGIN, values, atol=1e-8)


def test_an_extent_of_many_voxels_is_sorted_like_a_short_one():
    """Where indices and order do not fit into one number."""
    points = np.random.default_rng(0).uniform(-6, 9, (3000, 3)) * 1e5 + ORIGIN
    means = VoxelMeans(ORIGIN, 1.0, 10_000)
    means.add(points)
    assert means.voxel == 1.0
    check(means, points)


def test_memory_is_of_the_occupied_voxels():
    means = VoxelMeans(ORIGIN, 0.5, 10_000)
    for seed in range(50):
        means.add(wall(1000, seed))
    held = sum(array.nbytes for run in means._runs for array in run)
    assert held < 2.5 * 40 * len(means.means()[0])


def test_points_are_in_chosen_cells():
    chosen = np.zeros((3, 2, 1), bool)
    chosen[2, 1, 0] = True
    cells = Cells(ORIGIN, 2.0, chosen)
    points = np.array([[5.0, 3, 1], [3, 3, 1], [5, 3, 2.5], [-1, 3, 1], [99, 3, 1], [np.nan, 3, 1]]) + ORIGIN
    np.testing.assert_array_equal(cells.contains(points), [True, False, False, False, False, False])


@pytest.mark.parametrize("doublings", range(5))
def test_a_wall_at_the_origin_is_merged_in_one_layer(doublings: int):
    means = VoxelMeans(ORIGIN, 0.1, 10_000)
    points = wall(5000)
    points[:, 1] = ORIGIN[1] + np.random.default_rng(1).normal(0, 0.005, 5000)
    means.add(points)
    for _ in range(doublings):
        means._merge(1)
        means._double()
    found, _, _ = means.means()
    cells = np.floor((found - ORIGIN) / means.voxel + means._shift)[:, [0, 2]]
    assert len(np.unique(cells, axis=0)) == len(found)
