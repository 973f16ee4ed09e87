"""Polygons with holes as triangles."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from shapely import Point, Polygon

from shellgs_method.geometry.polygons import triangulated
from shellgs_method.geometry.triangles import area_vectors

NATIONAL = np.array([410_000.0, 5_413_000.0, 250.0])
TURN = Rotation.from_rotvec([0.4, -1.1, 2.0])


def star(rng: np.random.Generator, corners: int, centre: tuple[float, float], low: float, high: float) -> np.ndarray:
    """A ring around a centre, not convex."""
    angles = np.sort(rng.uniform(0, 2 * np.pi, corners))
    return np.stack([np.cos(angles), np.sin(angles)], 1) * rng.uniform(low, high, (corners, 1)) + centre


def in_space(flat: np.ndarray) -> np.ndarray:
    return TURN.apply(np.pad(flat, ((0, 0), (0, 1)))) + NATIONAL


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("clockwise", [False, True])
def test_the_triangles_of_a_polygon_cover_it_once_and_none_of_its_holes(seed: int, clockwise: bool):
    rng = np.random.default_rng(seed)
    ring = star(rng, 40, (0, 0), 4, 9)
    holes = [star(rng, 7, centre, 0.3, 0.9) for centre in ((-2, 0), (1.5, 1), (0, -2))][: seed % 4]
    exact = Polygon(ring, holes)
    assert exact.is_valid
    rings = [part[::-1] if clockwise else part for part in (ring, *holes)]
    vertices = in_space(np.concatenate(rings))
    sizes = np.array([len(part) for part in rings])
    cut = triangulated(vertices, sizes, np.arange(len(vertices)), np.arange(len(rings)) > 0)
    vectors = area_vectors(vertices, cut.faces)
    assert np.linalg.norm(vectors, axis=1).sum() == pytest.approx(exact.area)
    np.testing.assert_allclose(vectors.sum(axis=0), TURN.apply([0, 0, exact.area * (1 - 2 * clockwise)]), rtol=1e-6)
    flat = np.concatenate(rings)
    points = [Point(place) for place in rng.uniform(-9, 9, (60, 2))]
    covers = [sum(Polygon(flat[face]).contains(point) for face in cut.faces) for point in points]
    assert covers == [int(exact.contains(point)) for point in points]
    assert (cut.polygon == 0).all()
    assert len(cut.missed) == 0


def test_each_triangle_knows_its_polygon():
    quad = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    dart = np.array([[0, 0], [2, 1], [0, 4], [0.5, 1]]) + np.array([5, 0])
    hole = 0.5 * quad + np.array([9.2, 0.2])
    flat = np.concatenate([quad, quad[:2], dart, quad[:3] + np.array([7, 0]), quad + np.array([9, 0]), hole])
    sizes = np.array([4, 2, 4, 3, 4, 4])
    cut = triangulated(in_space(flat), sizes, np.arange(len(flat)), np.arange(6) == 5)
    areas = np.linalg.norm(area_vectors(in_space(flat), cut.faces), axis=1)
    np.testing.assert_allclose(np.bincount(cut.polygon, areas), [1, 0, 3, 0.5, 0.75], rtol=1e-6)


def test_polygons_that_cross_themselves_are_named():
    bow = np.array([[0, 0], [2, 2], [2, 0], [0, 1.0]])
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
    line = np.array([[0, 0], [1, 0], [2, 0], [1, 0.0]])
    flat = np.concatenate([square, bow, line])
    cut = triangulated(in_space(flat), np.full(3, 4), np.arange(12))
    assert 1 in cut.missed
    assert 0 not in cut.missed


def test_a_ring_with_a_seam_to_its_hole_leaves_the_hole_open():
    """OBJ and OFF have no holes: exporters go to the hole and back along the same line."""
    outer, inner = np.array([[0, 0], [6, 0], [6, 6], [0, 6.0]]), np.array([[2, 2], [2, 4], [4, 4], [4, 2.0]])
    flat = np.concatenate([outer, outer[:1], inner, inner[:1]])
    cut = triangulated(in_space(flat), np.array([len(flat)]), np.arange(len(flat)))
    assert np.linalg.norm(area_vectors(in_space(flat), cut.faces), axis=1).sum() == pytest.approx(32)
