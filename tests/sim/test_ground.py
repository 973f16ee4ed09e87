"""The ground in front of a building."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
import torch
from worlds import compliance_errors, frame_at, uneven

from benchmarks.lidar import lidar
from shellgs_method.files.usd import import_pxr
from shellgs_method.geometry.camera import Camera
from shellgs_method.geometry.triangles import Triangles
from shellgs_method.sim.building import MOST_GROUND, ground_step
from shellgs_method.sim.formats.asset import Asset
from shellgs_method.sim.formats.ground import MESH
from shellgs_method.sim.formats.readme import write_readme
from shellgs_method.sim.formats.world import write_world
from shellgs_method.sim.ground import AROUND, CELL, EXTENT, LEAST, LEVEL, Ground, _Grid, _streets

EYES = np.stack([np.linspace(-5, 5, 12), np.full(12, -4.0), np.full(12, 1.6)], axis=1)


def street(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A street that falls by 3 % along x, with a pavement 12 cm above it and two stairs of 18 cm at the wall."""
    kerb = np.where(y > -2, 0.12, 0.0) + np.where(y > -0.6, 0.18, 0.0) + np.where(y > -0.3, 0.18, 0.0)
    return -0.03 * x + kerb


def points_of_street(count: int = 60_000, noise: float = 0.01) -> np.ndarray:
    """Points of it with noise, with a gap, and those of a wall, a flower box and a car's roof."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-8, 8, count), rng.uniform(-8, 0, count)
    ground = np.stack([x, y, street(x, y) + rng.normal(0, noise, count)], axis=1)
    ground = ground[np.hypot(x - 2, y + 6) > 1.0]
    wall = np.stack([rng.uniform(-8, 8, 8000), rng.normal(0.05, 0.01, 8000), rng.uniform(0.4, 6, 8000)], axis=1)
    flowers = np.stack([rng.uniform(3, 4, 2000), rng.uniform(-1.5, -1, 2000), rng.normal(0.7, 0.01, 2000)], axis=1)
    under = (ground[:, 0] > 3) & (ground[:, 0] < 4) & (ground[:, 1] > -1.5) & (ground[:, 1] < -1)
    car = np.stack([rng.uniform(-4, 0, 4000), rng.uniform(-7, -5.5, 4000), rng.normal(1.4, 0.02, 4000)], axis=1)
    return np.concatenate([ground[~under], wall, flowers, car])


@pytest.mark.parametrize(("views", "step"), [(10, 2), (1000, 11)])
def test_of_many_photographs_fewer_pixels_each_are_taken_for_the_ground(views, step):
    camera = Camera(torch.eye(4), torch.eye(3), 1920, 1080)
    assert ground_step([camera] * views) == step
    assert views * 1920 * 1080 / step**2 < MOST_GROUND


@pytest.fixture(scope="module")
def ground() -> Ground:
    return Ground.of(points_of_street(), EYES)


def test_the_ground_has_the_heights_kerbs_and_steps_of_a_street(ground):
    x, y = (grid.ravel() for grid in np.meshgrid(np.linspace(-7, 7, 71), np.linspace(-7.5, -0.1, 75)))
    edge = np.min([np.abs(y + 2), np.abs(y + 0.6), np.abs(y + 0.3)], axis=0) < 1.5 * CELL
    away = ~edge & (np.hypot(x - 2, y + 6) > 1) & (np.abs([x - 3.5, y + 1.25]).max(axis=0) > 0.6)
    error = np.abs(ground.at(np.stack([x, y], axis=1)) - street(x, y))[away]
    assert np.quantile(error, 0.95) < 0.02
    assert error.max() < 0.05


def test_what_stands_on_the_ground_is_not_ground(ground):
    """A flower box 60 cm high: the ground goes on below it. A car's roof above the street: the same."""
    assert ground.at(np.array([3.5, -1.25])) == pytest.approx(street(np.array(3.5), np.array(-1.25)), abs=0.05)
    assert ground.at(np.array([-2.0, -6.2])) == pytest.approx(street(np.array(-2.0), np.array(-6.2)), abs=0.02)


def test_the_ground_goes_on_below_cars_and_beside_a_street_that_is_no_plane():
    """One that is level, and then rises by 8 %: its plane is a metre off, at the bend and at the ends."""
    x, y = np.random.default_rng(0).uniform((-30, -6), (30, 6), (60_000, 2)).T
    cars = (np.abs(y - 4) < 1) & (x % 12 < 4.5)
    points = np.stack([x, y, 0.08 * np.maximum(x, 0)], axis=1)[~cars]
    eyes = np.array([[at, 0, 0.08 * max(at, 0) + 1.6] for at in range(-30, 31, 4)])
    made = Ground.of(points, eyes)
    x, y = (each.ravel() for each in np.meshgrid(np.linspace(-28, 28, 200), np.linspace(-8, 8, 60)))
    off = np.abs(made.at(np.stack([x, y], axis=1)) - 0.08 * np.maximum(x, 0))
    assert off[np.abs(y) < 6].max() < 0.1
    assert off.max() < 0.35


def test_a_hill_is_one_street_in_the_large_cells_of_a_large_site(monkeypatch):
    """From one cell of 4.6 m to the next its slope of up to 12 % is higher than a stair."""
    monkeypatch.setattr("shellgs_method.sim.ground.CELLS", 600)
    x, y = np.random.default_rng(0).uniform((-100, -6), (100, 6), (40_000, 2)).T
    along = np.arange(-100, 101, 4.0)
    eyes = np.stack([along, 0 * along, 1.6 - 6e-4 * along**2], axis=1)
    made = Ground.of(np.stack([x, y, -6e-4 * x**2], axis=1), eyes)
    assert made.cell > 4
    assert made.at(eyes) == pytest.approx(eyes[:, 2] - 1.6, abs=0.3)


def test_the_ground_is_a_plane_where_nothing_is_known(ground):
    rows, columns = np.indices(ground.heights.shape)
    x, y = ground.origin[0] + ground.cell * columns, ground.origin[1] + ground.cell * rows
    assert not ground.known[np.hypot(x - 2, y + 6) < 0.5].any()
    far = (np.abs(x) > 16) | (y < -16)
    assert not ground.known[far].any()
    design = np.stack([x[far], y[far], np.ones(far.sum())], axis=1)
    plane, *_ = np.linalg.lstsq(design, ground.heights[far], rcond=None)
    assert np.abs(design @ plane - ground.heights[far]).max() < 0.02
    assert plane[0] == pytest.approx(-0.03, abs=0.01)


@pytest.mark.parametrize("size", [1.5, 4.0])
def test_a_small_slope_beside_the_wall_does_not_tilt_the_street(size):
    """A gutter, or noise: 8 % over a few metres would bury the doors at the other end."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(0, size, (2, 4000))
    made = Ground.of(np.stack([x, y - 4, 0.08 * x + rng.normal(0, 0.005, 4000)], axis=1), EYES)
    assert np.abs(made.at(np.array([[-15.0, -4], [15, -4], [0, -20]]))).max() < 0.35
    assert made.is_level == (size**2 < LEAST)


def turned(points: np.ndarray, degrees: float) -> np.ndarray:
    cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return points @ np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])


@pytest.mark.parametrize("degrees", [0, 30, 45])
def test_a_strip_along_the_wall_does_not_tilt_the_street_whatever_way_the_wall_runs(degrees):
    """Walls rarely run along an axis of national coordinates: a gutter of 20 % was 1.9 m deep below the cameras."""
    strip, eyes = level_points((-8, 8), (-1.5, 0), 0.0), EYES - np.array([0, 8, 0])
    strip[:, 2] += 0.2 * (strip[:, 1] + 0.75)
    assert np.abs(Ground.of(turned(strip, degrees), turned(eyes, degrees)).at(turned(eyes, degrees))).max() < 0.35


def test_a_hedge_above_a_street_does_not_begin_the_street_again_with_the_plane_of_its_top():
    """Such a plane, of the top alone, lifted the ground to 3 m above the cameras of a walk."""
    road, pavement = level_points((-8, 8), (-6, -4), 0.0), level_points((-8, 8), (-4, 0), 0.15)
    hedge = level_points((-8, 8), (-5, -4), 1.04)
    hedge[:, 2] -= 0.5 * (hedge[:, 1] + 4)
    points = np.concatenate([road, pavement, hedge])
    streets = list(_streets(points, points[:, 2] < 1.6, _Grid.around(points[:, :2])))
    assert sum(np.nanmedian(street.measured) < 0.5 for street in streets) == 1


def test_ground_that_is_exactly_flat_has_its_height_in_the_world(tmp_path):
    """The yard of a BIM, a step below the foot of the shell."""
    x, y = np.random.default_rng(0).uniform((-8, -8), (8, 0), (20_000, 2)).T
    made = Ground.of(np.stack([x, y, np.full(len(x), -0.4)], axis=1), EYES)
    assert np.ptp(made.heights) == 0
    write_world(tmp_path, [], frame_at(), made)
    places = np.array([[0.0, -4, 2], [5, -2, 2]])
    measured = lidar(tmp_path / "world.xml", places, np.array([[0.0, 0, -1]]), 0)
    np.testing.assert_allclose(measured, 2.4, atol=1e-5)
    for name in ("world.sdf", "world.urdf"):
        assert MESH in (tmp_path / name).read_text()


def test_without_points_the_ground_is_level_and_nothing_is_known():
    for points in (np.empty((0, 3)), np.array([[0.0, 0, 9], [1, 0, 9], [0, 1, 9]])):
        made = Ground.of(points, EYES)
        assert made.is_level
        assert not made.known.any()
        assert made.at(np.array([[3.0, 4.0]])) == 0


def test_the_surface_has_the_heights(ground):
    places = np.random.default_rng(1).uniform(-7, -0.5, (500, 2))
    origins = np.insert(places, 2, 5.0, axis=1)
    met = 5 - ground.surface.cast(origins, np.array([0.0, 0, -1])).t
    error = np.abs(met - ground.at(places))
    assert np.quantile(error, 0.9) < 0.005  # at kerbs a cell's two triangles are not its bilinear patch
    assert (ground.surface.normals[:, 2] > 0).all()


def test_triangles_of_the_ground_are_told_from_others(ground):
    x, y = np.array([-5.0, -4, -5]), np.array([-5.0, -5, -4])
    street_, sill = np.stack([x, y, street(x, y)], axis=1), np.stack([x, y, street(x, y) + 0.5], axis=1)
    wall = np.array([[-5.0, -4, 0.12], [-4, -4, 0.12], [-5, -4, 1]])
    corners = np.concatenate([street_, sill, wall])
    np.testing.assert_array_equal(ground.has(Triangles(corners, np.arange(9).reshape(3, 3))), [True, False, False])
    np.testing.assert_array_equal(LEVEL.has(Triangles(corners, np.arange(9).reshape(3, 3))), [False, False, False])


@pytest.fixture(scope="module")
def folder(ground, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("street")
    write_world(out, [], frame_at(), ground)
    return out


def test_a_robot_stands_on_the_ground_of_a_slope_by_the_lines_of_the_readme(tmp_path):
    """The origin is at the height of the shell's lower edge, which is at the foot of the slope."""
    write_readme(tmp_path, [Asset("facade", 1)], frame_at(), uneven(), {"summary": []})
    text = (tmp_path / "README.md").read_text()
    height = uneven().at(np.zeros((1, 2)))[0]
    assert f"a height of {height:.2f}." in text
    assert f"add_frame(pos=[0, 0, {height + 0.1:.2f}])" in text


PLACES = np.random.default_rng(2).uniform([-7, -7.5], [7, -0.4], (300, 2))


def test_mujocos_height_field_is_the_ground(ground, folder):
    down = lidar(folder / "world.xml", np.insert(PLACES, 2, 5.0, axis=1), np.array([[0.0, 0, -1]]), group=0)
    error = np.abs(5 - down[:, 0] - ground.at(PLACES))
    assert np.quantile(error, 0.9) < 0.005
    assert error.max() < 0.1


def test_the_mesh_of_the_other_formats_is_the_ground(ground, folder):
    """And they refer to it: PyBullet's rays meet it."""
    pybullet = pytest.importorskip("pybullet")
    client = pybullet.connect(pybullet.DIRECT)
    pybullet.loadURDF(str(folder / "world.urdf"), useFixedBase=True, physicsClientId=client)
    high, deep = (np.insert(PLACES, 2, z, axis=1).tolist() for z in (5.0, -5.0))
    met = np.array([hit[3][2] for hit in pybullet.rayTestBatch(high, deep, physicsClientId=client)])
    pybullet.disconnect(client)
    error = np.abs(met - ground.at(PLACES))
    assert np.median(error) < 0.01
    assert np.quantile(error, 0.9) < 0.03
    stage = import_pxr("sim").Usd.Stage.Open(str(folder / "world.usda"))
    assert stage.GetPrimAtPath("/World/ground").GetTypeName() == "Mesh"
    assert compliance_errors(stage) == []
    assert ET.parse(folder / "world.sdf").getroot().findtext(".//collision[@name='ground']//uri") == MESH


def test_level_ground_of_a_small_site_stays_as_it_is(ground):
    near = np.array([[EXTENT / 2 - AROUND, -20, 5], [0, 0, 90]])
    assert LEVEL.under(near) is LEVEL
    assert LEVEL.extent == EXTENT
    assert ground.under(near + 1000) is ground  # a height field


@pytest.mark.parametrize("away", [300.0, 5000.0])
def test_level_ground_goes_on_below_a_building_that_is_far_from_the_origin(tmp_path, away):
    made = LEVEL.under(np.array([[0, 0, 3.0], [0, -away, 9.0]]))
    assert made.extent == 2 * (away + AROUND)
    write_world(tmp_path, [], frame_at(), made)
    box = ET.parse(tmp_path / "world.urdf").getroot().find(".//collision/geometry/box")
    assert box is not None
    assert box.get("size") == f"{made.extent} {made.extent} 1.0"
    size = ET.parse(tmp_path / "world.sdf").getroot().findtext(".//collision[@name='ground']//size", "")
    stage = import_pxr("sim").Usd.Stage.Open(str(tmp_path / "world.usda"))
    plane = stage.GetPrimAtPath("/World/ground")
    sides = [*map(float, size.split()), plane.GetAttribute("width").Get(), plane.GetAttribute("length").Get()]
    assert sides == [made.extent] * 4
    assert np.isfinite(made.surface.cast(np.array([[40, -away - 40, 5]]), np.array([[0.0, 0, -1]])).t).all()


def test_bodies_stay_on_level_ground_far_from_the_origin(tmp_path):
    pybullet = pytest.importorskip("pybullet", reason="it has no wheel for this Python")
    write_world(tmp_path, [], frame_at(), LEVEL.under(np.array([[5000.0, 300, 0]])))
    client = pybullet.connect(pybullet.DIRECT)
    try:
        pybullet.setGravity(0, 0, -9.81)
        pybullet.loadURDF(str(tmp_path / "world.urdf"), useFixedBase=True)
        shapes = [
            pybullet.createCollisionShape(pybullet.GEOM_SPHERE, radius=0.1),
            pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=[0.1] * 3),
        ]
        places = [(0, -6), (-310, 300), (5040, 300)]
        bodies = [pybullet.createMultiBody(1, shape, -1, [*at, 0.5]) for at in places for shape in shapes]
        for _ in range(240):
            pybullet.stepSimulation()
        heights = [pybullet.getBasePositionAndOrientation(body)[0][2] for body in bodies]
    finally:
        pybullet.disconnect(client)
    assert heights == pytest.approx([0.1] * len(bodies), abs=0.005)


def level_points(x: tuple[float, float], y: tuple[float, float], z: float, density: int = 300) -> np.ndarray:
    rng = np.random.default_rng(3)
    low, high = np.array([x, y]).T
    places = rng.uniform(low, high, (int(density * np.prod(high - low)), 2))
    return np.insert(places, 2, z + rng.normal(0, 0.01, len(places)), axis=1)


def test_stairs_of_three_metres_are_climbed():
    """Sixteen stairs of 18 cm to a terrace, between the street and a wall."""
    treads = [level_points((-2, 2), (-6 + 0.3 * k, -5.7 + 0.3 * k), 0.18 * (k + 1)) for k in range(16)]
    terrace, pavement = level_points((-6, 6), (-1.2, 2), 0.18 * 16), level_points((-8, 8), (-12, -6), 0.0)
    made = Ground.of(np.concatenate([pavement, *treads, terrace]), EYES - np.array([0, 5, 0]))
    stairs = np.array([[0.0, -5.85 + 0.3 * k] for k in range(16)])
    assert made.at(stairs) == pytest.approx(0.18 * np.arange(1, 17), abs=0.12)
    assert made.at(np.array([[4.0, 0], [4.0, -8]])) == pytest.approx([2.88, 0], abs=0.03)


def test_a_street_and_that_above_its_wall_are_both_ground_where_cameras_stand_on_both():
    streets = np.concatenate([level_points((-8, 8), (-12, -6), 0.0), level_points((-8, 8), (-6, -1), 4.0)])
    below, above = EYES - np.array([0, 5, 0]), EYES + np.array([0, 0, 4])
    places = np.array([[0.0, -9], [0.0, -3]])
    assert Ground.of(streets, np.concatenate([below, above])).at(places) == pytest.approx([0, 4], abs=0.03)
    assert Ground.of(streets, above).at(places)[1] == pytest.approx(4, abs=0.03)


def test_what_errors_of_the_depth_put_below_the_ground_is_not_it():
    street = level_points((-8, 8), (-12, 0), 0.0)
    below = [level_points((x, x + 2), (y, y + 4), z) for x, y, z in ((-9, -16, -4.0), (-2, -16, -6.0), (5, -16, -8.0))]
    made = Ground.of(np.concatenate([street, *below]), EYES + np.array([0, 0, 18]))
    assert abs(made.at(np.array([[0.0, -4]]))[0]) < 0.03


def test_a_flat_roof_below_a_drone_is_not_the_ground():
    roof, street = level_points((-8, 8), (0, 14), 9.0), level_points((-8, 8), (-5, 0), 0.0)
    made = Ground.of(np.concatenate([roof, street]), EYES + np.array([0, 4, 18]))
    assert made.at(np.array([[0.0, -3], [0.0, 7]])) == pytest.approx([0, 0], abs=0.05)
