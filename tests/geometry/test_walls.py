"""Walls of buildings whose plans are known."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from cameras import pinhole

from shellgs_method.geometry.camera import Camera
from shellgs_method.geometry.triangles import Triangles
from shellgs_method.geometry.walls import find_walls
from shellgs_method.geometry.winding import outward
from shellgs_method.synthetic.building import Layout, building

UP = np.array([0.0, 0, 1])


def block(low: list[float], high: list[float]) -> trimesh.Trimesh:
    return trimesh.creation.box(bounds=[low, high])


def walls_of(mesh: trimesh.Trimesh, shots: list[tuple[list[float], list[float]]], up: np.ndarray = UP):
    """Walls in photographs of 90 degrees from places, in directions."""
    cameras = [camera_at(np.array(eye), np.array(forward), up) for eye, forward in shots]
    surface, _ = outward(Triangles(mesh.vertices, mesh.faces), np.array([eye for eye, _ in shots]))
    return find_walls(surface, cameras, up)


def camera_at(eye: np.ndarray, forward: np.ndarray, up: np.ndarray) -> Camera:
    right = np.cross(forward, up)
    return pinhole(50, 100, 100, eye, np.stack([right, np.cross(forward, right), forward]))


def test_walls_are_those_that_are_seen_the_largest_first():
    walls = walls_of(block([0, 0, 0], [10, 6, 5]), [([5, -20, 2], [0, 1, 0]), ([30, 3, 2], [-1, 0, 0])])
    np.testing.assert_allclose([wall.axes[2] for wall in walls], [[0, -1, 0], [1, 0, 0]], atol=1e-9)
    np.testing.assert_allclose([wall.size[:2] for wall in walls], [[10, 5], [6, 5]], rtol=0.01)
    np.testing.assert_allclose([wall.plane for wall in walls], [0, 10], atol=1e-6)


@pytest.mark.parametrize("up", [[0.0, 1, 0], [1.0, 0, 0]])
def test_walls_are_upright_whatever_points_up(up):
    turn = np.asarray(trimesh.geometry.align_vectors(UP, up))
    mesh = block([0, 0, 0], [10, 6, 5]).apply_transform(turn)
    shot = (turn[:3, :3] @ [5, -20, 2]).tolist(), (turn[:3, :3] @ [0, 1, 0]).tolist()
    (wall,) = walls_of(mesh, [shot], np.array(up))
    np.testing.assert_allclose(wall.axes[1:], [up, turn[:3, :3] @ [0, -1, 0]], atol=1e-9)
    np.testing.assert_allclose(wall.size[:2], [10, 5], rtol=0.01)


def test_neither_reveals_that_face_each_other_nor_sides_out_of_view_are_walls():
    facade = building(Layout(6, 3))
    mesh = trimesh.Trimesh(facade.vertices, facade.triangles, process=False)
    (wall,) = walls_of(mesh, [([x, -12.0, 5.0], [0, 1, 0]) for x in np.linspace(-4, 22, 9)])
    np.testing.assert_allclose(wall.axes[2], [0, -1, 0], atol=0.01)
    assert wall.plane == pytest.approx(0, abs=0.01)


def test_houses_that_face_one_direction_are_one_wall_and_those_across_the_street_another():
    near = [block([x, 0, 0], [x + 8, 8, 6 + x / 10]) for x in (0, 10, 20)]
    far = [block([x, -22, 0], [x + 8, -14, 7]) for x in (0, 15)]
    mesh = trimesh.util.concatenate([*near, *far])
    assert isinstance(mesh, trimesh.Trimesh)
    walls = walls_of(mesh, [([x, -7, 1.6], [0, side, 0]) for x in np.linspace(-5, 33, 10) for side in (-1, 1)])
    near_side, far_side = (next(wall for wall in walls if wall.axes[2, 1] * side > 0.999) for side in (-1, 1))
    assert (near_side.plane, far_side.plane) == pytest.approx((0, -14), abs=1e-6)
    assert (near_side.size[0], far_side.size[0]) == pytest.approx((28, 23), rel=0.01)


def test_a_narrow_alley_takes_no_wall_that_faces_nearly_its_direction():
    """The wall in the alley is the largest; in front of all of it, another is nearer than what counts as free."""
    alley = [block([0, 0, 0], [24, 1, 6]), block([-1, -4, 0], [25, -3, 6])]
    angles = {-30: 20.0, 32: -20.0}
    turned = [
        block([0, 0, 0], [5, 1, 6]).apply_transform(
            trimesh.transformations.rotation_matrix(np.radians(angle), UP, [0, 0, 0])
        )
        for angle in angles.values()
    ]
    mesh = trimesh.util.concatenate(
        [*alley, *(each.apply_translation([x, 0, 0]) for x, each in zip(angles, turned, strict=True))]
    )
    assert isinstance(mesh, trimesh.Trimesh)
    places = [*((x, -2.9) for x in range(1, 24, 2)), (-28, -8), (34, -8)]
    walls = walls_of(mesh, [([x, y, 2], [0, 1, 0]) for x, y in places])
    across = np.radians(20) * np.array([[1], [-1]])
    expected = np.hstack([np.sin(across), -np.cos(across)])
    found = np.array([wall.axes[2, :2] for wall in sorted(walls, key=lambda wall: -wall.axes[2, 0])])
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert all(wall.low[2] - 0.1 < wall.plane < wall.high[2] + 0.1 for wall in walls)
