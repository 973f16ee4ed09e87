"""Collision geometry, frames, textures and deviations, tested without a simulator."""

from __future__ import annotations

import math
import tracemalloc
import weakref
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import shapely
import torch
import trimesh
from cameras import pinhole
from scipy.spatial import Delaunay
from scipy.spatial.transform import Rotation

from benchmarks.walls import ARCH, GATE, eyes_before, wall_with_bays
from shellgs_method.errors import SceneError
from shellgs_method.evaluation.colours import GREY
from shellgs_method.export.frame import Frame, Z
from shellgs_method.geometry.axes import likely_up, turn
from shellgs_method.geometry.camera import Camera
from shellgs_method.geometry.similarity import transformed
from shellgs_method.geometry.surface_classes import SurfaceClass
from shellgs_method.geometry.triangles import Triangles
from shellgs_method.geometry.winding import outward
from shellgs_method.sim.building import _level_points, moved_into
from shellgs_method.sim.collision.clusters import clusters
from shellgs_method.sim.collision.collider import THINNEST, Collider, depths, leaks, make_collider, standing_before
from shellgs_method.sim.collision.distances import both_ways
from shellgs_method.sim.collision.outside import from_outside
from shellgs_method.sim.collision.parts import Part
from shellgs_method.sim.deviations import find_deviations
from shellgs_method.sim.frame import SimFrame, sim_frame
from shellgs_method.sim.look import texture
from shellgs_method.sim.look.texture import Photo, bake
from shellgs_method.sim.settings import SimSettings
from shellgs_method.sim.simulate import _name
from shellgs_method.synthetic.building import RECESS, Layout, building, shell
from shellgs_method.synthetic.frames import SCENE_FROM_BUILDING, SHELL_FROM_BUILDING
from shellgs_method.synthetic.path import walk

LAYOUT = Layout(bays=2, storeys=2)


def surface_of(mesh: Any) -> Triangles:
    """Convert a mesh of trimesh, whose types are incomplete."""
    return Triangles(np.asarray(mesh.vertices), np.asarray(mesh.faces))


def box(low, high, subdivided: float | None = None) -> Triangles:
    mesh = trimesh.creation.box(bounds=[low, high])
    return surface_of(mesh.subdivide_to_size(subdivided) if subdivided else mesh)


def visible(surface: Triangles, eyes: np.ndarray) -> np.ndarray:
    points, _ = surface.samples(4000)
    return points[np.any([surface.sees(eye, points, 5e-3) for eye in eyes], axis=0)]


@pytest.fixture(scope="module")
def eyes() -> np.ndarray:
    cameras = walk(LAYOUT.length, 12, 64, 48, np.random.default_rng(0))
    return np.stack([camera.position.numpy() for camera in cameras])


@pytest.fixture(scope="module")
def facade(eyes) -> Triangles:
    """The shell of a small building, wound towards the cameras in front of it."""
    mesh = shell(LAYOUT)
    return outward(Triangles(mesh.vertices, mesh.triangles), eyes)[0]


@pytest.fixture(scope="module")
def nothing() -> Triangles:
    """A reconstruction without anything in front of the shell."""
    return Triangles(np.eye(3), np.array([[0, 1, 2]]))


@pytest.fixture(scope="module")
def collider(facade, nothing) -> Collider:
    return make_collider(facade, nothing, np.array([False]))


def test_the_air_in_a_niche_is_its_volume():
    """Two faces of a square groove of 30 x 30 cm, 2 m long: the hull fills half of the square. None around the edge."""
    corners = np.array([[0.3, 0, 0], [0.3, 2, 0], [0, 0, 0], [0, 2, 0], [0, 0, 0.3], [0, 2, 0.3]])
    faces = np.array([[0, 1, 2], [1, 3, 2], [2, 3, 4], [3, 5, 4]])
    groove, edge = Triangles(corners, faces), Triangles(corners, faces[:, ::-1])
    assert clusters(groove, 1)[1] == pytest.approx(0.09, rel=1e-6)
    assert len(clusters(groove, 4)[0]) == 2
    assert clusters(edge, 4)[1] == pytest.approx(0.0, abs=1e-9)
    assert len(clusters(edge, 4)[0]) == 1


def test_clusters_of_a_wall_with_windows_are_convex_and_fill_none():
    holes = [shapely.box(x, z, x + 1, z + 1.5) for x in (1, 3, 5) for z in (1, 4)]
    outline = shapely.Polygon([(0, 0), (7, 0), (7, 6), (3.5, 8), (0, 6)]).difference(shapely.union_all(holes))
    points, faces = trimesh.creation.triangulate_polygon(outline, engine="earcut")
    wall = Triangles(np.insert(points, 1, 0.0, axis=1), faces)
    found, air = clusters(wall, len(faces))
    assert air < 1e-3
    assert len(found) < len(faces) / 2
    hulls = [shapely.MultiPoint(points[faces[group]].reshape(-1, 2)).convex_hull for group in found]
    assert sum(hull.area for hull in hulls) == pytest.approx(outline.area, abs=1e-3)
    assert shapely.union_all(hulls).symmetric_difference(outline).area < 1e-3


@pytest.mark.parametrize("most", [1, 7, 40])
def test_pieces_that_do_not_touch_are_merged_and_none_is_cut_off(most):
    panes = [box([3 * k, 0, 3 * m], [3 * k + 1, 0.1, 3 * m + 1]) for k in range(8) for m in range(5)]
    first = np.cumsum([0] + [len(pane.vertices) for pane in panes[:-1]])
    faces = np.concatenate([pane.faces + offset for pane, offset in zip(panes, first, strict=True)])
    found, _ = clusters(Triangles(np.concatenate([pane.vertices for pane in panes]), faces), most)
    assert len(found) <= most
    np.testing.assert_array_equal(np.sort(np.concatenate(found)), np.arange(len(faces)))


def test_hulls_have_few_corners_and_lose_little():
    ball = np.random.default_rng(0).normal(size=(3000, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    part = Part.hull(ball)
    assert part is not None
    assert len(part.vertices) <= 64
    assert part.contains(ball, 0.13).all()


def test_rooms_are_not_seen_from_outside():
    """A room in a house of 20 cm thick walls, some of whose triangles are wound wrongly."""
    house, room = box([0, 0, 0], [8, 6, 5], subdivided=1.0), box([0.2, 0.2, 0.2], [7.8, 5.8, 4.8], subdivided=1.0)
    faces = np.concatenate([house.faces, room.faces[:, ::-1] + len(house.vertices)])
    wrong = np.arange(len(faces)) % 3 == 0
    faces[wrong] = faces[wrong, ::-1]
    wound, seen = from_outside(
        Triangles(np.concatenate([house.vertices, room.vertices]), faces), np.array([[4.0, -9, 2], [1, -7, 2]])
    )
    inside = np.arange(len(faces)) >= len(house.faces)
    assert not seen[inside].any()
    level = wound.centres[:, 2] > 1e-6
    assert seen[~inside & level].all()
    outwards = np.einsum("fc,fc->f", wound.normals, wound.centres - [4, 3, 2.5])
    assert (outwards[~inside & level] > 0).all()


@pytest.fixture(scope="module")
def bays() -> Triangles:
    return wall_with_bays(0.1)


@pytest.fixture(scope="module")
def of_bays(bays, nothing) -> Collider:
    return make_collider(bays, nothing, np.array([False]))


def test_a_wall_with_bays_arches_and_columns_has_no_hole(bays, of_bays):
    assert leaks(of_bays.surface, bays, eyes_before()).share < 1e-3
    assert len(of_bays.parts) <= 2 * bays.areas.sum()
    assert max(len(part.vertices) for part in of_bays.parts) <= 64


def test_rays_meet_the_collider_where_they_meet_the_wall(bays, of_bays):
    """In front of it by no more, either: bays, niche, windows and gate stay what they are."""
    points, _ = bays.samples(6000)
    origins = eyes_before()[np.arange(len(points)) % 16]
    wall, made = (surface.cast(origins, points - origins) for surface in (bays, of_bays.surface))
    steep = np.abs(np.einsum("nc,nc->n", points - origins, wall.normal)) > 0.2 * np.linalg.norm(
        points - origins, axis=1
    )
    error = np.abs((wall.t - made.t) * np.linalg.norm(points - origins, axis=1))[steep]
    assert np.quantile(error, 0.95) < 0.02
    assert (error > 0.1).mean() < 0.01
    middle, half, springing = GATE
    through = np.array([[middle + x, -3, z] for x in (-0.8 * half, 0, 0.8 * half) for z in (0.2, springing)])
    assert np.isinf(of_bays.surface.cast(through, np.array([0.0, 1, 0])).t).all()
    in_niche = np.array([[ARCH[0], -3, 1.5]])
    assert of_bays.surface.cast(in_niche, np.array([0.0, 1, 0])).t == pytest.approx(3.4, abs=0.01)


def test_a_hole_is_found_where_it_is(bays, of_bays):
    wall = np.array([8.5, 0, 5.0])
    holed = Collider([part for part in of_bays.parts if not part.contains(wall[None], 0.3).any()], 0.0)
    found = leaks(holed.surface, bays, eyes_before())
    assert found.share > 1e-3
    assert found.place is not None
    assert bays.distance(np.array([found.place])) < 0.1
    eye = eyes_before()[found.eye]
    away = np.array(found.place) - eye
    assert holed.surface.cast(eye[None], away[None]).t > 1


@pytest.mark.parametrize(("radius", "leaking"), [(0.99, False), (0.5, True)])
def test_a_ball_leaks_where_its_collider_is_much_smaller_and_not_where_rays_graze_it(radius, leaking):
    ball, smaller = (trimesh.creation.icosphere(4, radius) for radius in (1.0, radius))
    share = leaks(surface_of(smaller), surface_of(ball), np.array([[0, -4.0, 0], [3.0, 2, 1]])).share
    assert (share > 0.3) if leaking else (share == 0)


def test_a_part_contains_the_points_inside_its_hull():
    """Against the Delaunay triangulation of its corners."""
    rng = np.random.default_rng(1)
    corners, points = rng.normal(size=(30, 3)), rng.normal(size=(2000, 3))
    part = Part.hull(corners)
    assert part is not None
    np.testing.assert_array_equal(part.contains(points, 0.0), Delaunay(corners).find_simplex(points) >= 0)
    mesh = trimesh.Trimesh(part.vertices, part.faces)
    assert mesh.is_watertight
    assert mesh.volume > 0  # wound outwards


def test_flat_points_have_no_hull():
    assert Part.hull(np.eye(3)) is None


def test_the_collider_matches_the_visible_shell(collider, facade, eyes):
    both = collider.surface.distance(visible(facade, eyes)), facade.distance(visible(collider.surface, eyes))
    assert np.quantile(both[0], 0.95) < 1e-4
    assert np.quantile(both[1], 0.95) < 3e-3
    assert np.quantile(np.concatenate(both), 0.995) < 0.011  # parts that protrude by up to a centimetre are left out
    assert leaks(collider.surface, facade, eyes).share < 1e-3
    assert collider.filled < 0.01


def test_windows_stay_recesses(collider):
    opening = LAYOUT.openings[0]
    place = np.array([[opening.centre, -5, (opening.z0 + opening.z1) / 2]])
    assert collider.surface.cast(place, np.array([[0, 1.0, 0]])).t == pytest.approx(5 + RECESS, abs=1e-4)


@pytest.mark.parametrize("density", [10, 3])
def test_a_budget_of_parts_is_kept_and_leaves_no_hole(density, facade, nothing, eyes):
    small = make_collider(facade, nothing, np.array([False]), density=density)
    assert len(small.parts) <= np.ceil(density * facade.areas.sum() / 100)
    assert leaks(small.surface, facade, eyes).share == 0


def test_parts_stay_inside_the_wall():
    wall = box([0, 0, 0], [4, 0.1, 3])
    made = make_collider(wall, wall, np.zeros(len(wall.faces), bool))
    assert np.abs(made.surface.vertices - [2, 0.05, 1.5]).max(axis=0) == pytest.approx([2, 0.05, 1.5], abs=0.011)
    front = wall.faces[wall.normals[:, 1] < -0.9]
    inside = wall.vertices[front] + [0, 0.01, 0]
    np.testing.assert_allclose(depths(wall, inside, np.array([0.0, -1, 0])), 0.09, atol=1e-6)


def test_no_part_is_thinner_than_fast_bodies_need():
    """A canopy of 1 cm of sheet, whose edge is seen too."""
    canopy, seen = outward(box([0, -0.3, 3], [4, 0, 3.01]), np.array([[2.0, -5, 1.6]]))
    (part,) = make_collider(canopy, canopy, np.zeros(len(canopy.faces), bool), seen).parts
    thickness = min(np.ptp(part.vertices @ normal) for normal in part.planes[:, :3])
    assert thickness == pytest.approx(THINNEST, abs=1e-4)


def test_surfaces_in_front_of_the_shell_are_in_the_collider_but_not_those_beside_it(facade, eyes):
    """A flower box on the wall, and a flap beyond the building's end."""
    right = LAYOUT.ends[1]
    planter: Any = trimesh.creation.box(bounds=[[2.6, -0.4, 1], [3.4, -0.001, 1.4]]).subdivide_to_size(0.1)
    flap = trimesh.creation.box(bounds=[[right + 0.12, -0.02, 1], [right + 0.5, 0, 5]]).subdivide_to_size(0.1)
    ground = trimesh.creation.box(bounds=[[0, -0.4, -0.02], [6, -0.05, 0.0]]).subdivide_to_size(0.1)
    fused, _ = outward(surface_of(trimesh.util.concatenate([planter, flap, ground])), eyes)
    standing = standing_before(facade, fused, eyes, 0.05)
    of_planter = np.arange(len(fused.faces)) < len(planter.faces)
    front = fused.normals[:, 1] < -0.9
    assert standing[of_planter & front].all()
    assert not standing[~of_planter & front].any()
    made = make_collider(facade, fused, standing)
    before = made.surface.cast(np.array([[3.0, -3, 1.2]]), np.array([[0, 1.0, 0]])).t
    assert before == pytest.approx(2.6, abs=0.02)
    beside = made.surface.cast(np.array([[right + 0.3, -3, 2]]), np.array([[0, 1.0, 0]])).t
    assert np.isinf(beside)


def test_surfaces_without_planes_become_parts_too(eyes):
    ball = trimesh.creation.icosphere(subdivisions=3, radius=1.0).apply_translation([3, 2, 2])
    fused, seen = outward(surface_of(ball), eyes)
    made = make_collider(None, fused, seen, density=500)
    assert 20 < len(made.parts) <= 63
    assert np.quantile(made.surface.distance(visible(fused, eyes)), 0.95) < 0.03


def test_an_empty_collider_is_refused(nothing):
    with pytest.raises(SceneError, match="there is nothing to collide with"):
        make_collider(None, nothing, np.array([False]))


@pytest.mark.parametrize("name", ["parts", "faces", "voxel", "texel", "megabytes"])
@pytest.mark.parametrize("value", [0, -1, math.nan, math.inf])
def test_a_setting_that_nothing_can_be_made_with_is_refused_at_once(name, value):
    with pytest.raises(SceneError, match=rf"--{name} cannot be"):
        SimSettings(**{name: value})


def test_a_ground_that_is_no_height_is_refused():
    with pytest.raises(SceneError, match="--ground cannot be nan: give a number"):
        SimSettings(ground=math.nan)


def test_a_surface_that_a_file_has_twice_keeps_its_door(nothing):
    """Many exports have each side of a wall as triangles of its own."""
    once = wall_with_bays(0.25)
    twice = Triangles(
        np.tile(once.vertices, (2, 1)), np.concatenate([once.faces, once.faces[:, ::-1] + len(once.vertices)])
    )
    eyes = eyes_before()
    made = [
        make_collider(wound, nothing, np.array([False]), outside)
        for wound, outside in (from_outside(surface, eyes) for surface in (once, twice))
    ]
    assert len(made[0].parts) == len(made[1].parts)
    middle, _, springing = GATE
    through = [each.surface.blocked(np.array([[middle, -3, springing / 2]]), np.array([[0, 1.0, 0]])) for each in made]
    assert not np.any(through)


@pytest.mark.parametrize("eyes", [[[0.0, -4, 1.6], [4.4, -4, 1.6]], [[0.0, -4, 1.6], [4.4, -4, 1.6], [2, 4, 1.6]]])
def test_the_gaps_of_a_fence_are_open(eyes):
    """Twenty pickets with gaps of 12 cm, and two rails: their backs are not seen, or from one place alone."""
    pickets = [box([0.22 * k, 0, 0], [0.22 * k + 0.1, 0.04, 1.2]) for k in range(20)]
    rails = [box([0, 0.04, z], [4.28, 0.07, z + 0.08]) for z in (0.3, 0.9)]
    vertices = np.concatenate([each.vertices for each in (*pickets, *rails)])
    faces = np.concatenate([each.faces + 8 * k for k, each in enumerate((*pickets, *rails))])
    fence, seen = outward(Triangles(vertices, faces), np.array(eyes))
    made = make_collider(None, fence, seen, density=2000)
    gaps = np.stack([0.16 + 0.22 * np.arange(19), np.full(19, -3), np.full(19, 0.6)], axis=1)
    assert not made.surface.blocked(gaps, np.array([0, 1.0, 0])).any()
    assert made.surface.blocked(gaps + np.array([0.11, 0, 0]), np.array([0, 1.0, 0])).all()


def test_a_cellar_is_no_ground():
    floors = [box([0, 0, height], [8, 6, height + 0.01]) for height in (-3.0, 0.3)]
    vertices = np.concatenate([floor.vertices for floor in floors])
    faces = np.concatenate([floor.faces + 8 * k for k, floor in enumerate(floors)])
    shell = SimpleNamespace(vertices=vertices, faces=faces)
    run = SimpleNamespace(shell_in_frame=shell, frame=SimpleNamespace(up=np.array([0, 0, 1.0])))
    points = _level_points(run)  # pyright: ignore[reportArgumentType]
    assert len(points) > 50
    assert points[:, 2].min() > 0.29


def test_a_building_is_never_named_as_a_part_of_the_world_or_another():
    assert [_name(scene, ["Town_hall"]) for scene in ("ground", "World", "package", "town hall", "7 b")] == [
        "building_ground",
        "building_World",
        "building_package",  # whose MJCF would be replaced by ROS' package.xml
        "town_hall_2",
        "building_7_b",
    ]


def cameras_of_scene() -> list[Camera]:
    from shellgs_method.synthetic.frames import scene_camera

    return [scene_camera(camera) for camera in walk(LAYOUT.length, 9, 64, 48, np.random.default_rng(0))]


def metric_frame(up: str = "z") -> tuple[Frame, np.ndarray]:
    """The frame of the shell of the synthetic facade, and the shell's points in it."""
    offset = np.array([412300.0, 5123500, 200])
    points = transformed(shell(LAYOUT).vertices, SHELL_FROM_BUILDING)
    to_scene = SCENE_FROM_BUILDING @ np.linalg.inv(SHELL_FROM_BUILDING)
    if up == "y":
        turned = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
        points, to_scene = transformed(points, turned), to_scene @ np.linalg.inv(turned)
        offset = turned[:3, :3] @ offset
    shift = np.eye(4)
    shift[:3, 3] = offset
    return Frame("shell", to_scene @ shift, offset, True, np.eye(3)[1 if up == "y" else 2]), points - offset


@pytest.mark.parametrize("up", ["z", "y"])
def test_the_origin_is_on_the_ground_in_front_of_the_facade(up):
    frame, points = metric_frame(up)
    made, motion = sim_frame(frame, points, cameras_of_scene())
    from_building = np.linalg.inv(made.to_scene) @ SCENE_FROM_BUILDING
    origin = transformed(np.zeros(3), np.linalg.inv(from_building))
    assert -12 < origin[1] < -6
    assert abs(origin[2]) < 1e-3
    np.testing.assert_allclose(from_building[:3, :3] @ [0, 0, 1], [0, 0, 1], atol=1e-9)
    np.testing.assert_allclose(
        transformed(points, motion), transformed(shell(LAYOUT).vertices, from_building), atol=1e-6
    )


def test_national_coordinates_are_recovered():
    frame, points = metric_frame()
    made, motion = sim_frame(frame, points, cameras_of_scene())
    national = transformed(shell(LAYOUT).vertices, SHELL_FROM_BUILDING)
    np.testing.assert_allclose(transformed(transformed(points, motion), made.to_national), national, atol=1e-6)
    np.testing.assert_array_equal(made.to_national[:3, :3], np.eye(3))  # the offset alone is enough
    assert not np.mod(made.offset[:2], 1).any()


def test_coordinates_and_offset_add_up_to_those_of_the_exported_mesh_with_z_up():
    frame, points = metric_frame("y")
    made, motion = sim_frame(frame, points, cameras_of_scene())
    expected = (points + frame.offset) @ turn(frame.up, Z).T
    np.testing.assert_allclose(transformed(points, motion) + made.offset, expected, atol=1e-6)


def test_a_scene_without_a_shell_is_turned_upright():
    points = transformed(shell(LAYOUT).vertices, SCENE_FROM_BUILDING)
    made, _ = sim_frame(
        Frame("scene", np.eye(4), np.zeros(3), False, likely_up(cameras_of_scene())), points, cameras_of_scene()
    )
    up = np.linalg.inv(made.to_scene)[:3, :3] @ SCENE_FROM_BUILDING[:3, :3] @ [0, 0, 1]
    assert up[2] / np.linalg.norm(up) > np.cos(np.radians(3))
    assert not made.metric


def test_the_ground_height_can_be_set():
    frame, points = metric_frame()
    made, _ = sim_frame(frame, points, cameras_of_scene(), ground=215.0)
    assert made.to_national[2, 3] == 215.0
    assert isinstance(made, SimFrame)


def test_the_ground_height_is_in_the_unit_of_the_shell():
    """One in feet had its ground three times too low, without a word."""
    frame, points = metric_frame()
    made, _ = sim_frame(frame, points, cameras_of_scene(), ground=215.0 / 0.3048, unit=0.3048)
    assert made.to_national[2, 3] == pytest.approx(215.0)
    with pytest.raises(
        SceneError, match=r"--ground 215 is 147 m from .* shell, which is at 696\.65 in its own coordinates"
    ):
        sim_frame(frame, points, cameras_of_scene(), ground=215.0, unit=0.3048)


def test_a_second_building_is_moved_into_the_frame_of_the_first():
    """By national coordinates; refused if they are far apart or unknown."""
    frame, points = metric_frame()
    home, to_home = sim_frame(frame, points, cameras_of_scene())
    moved = np.eye(4)
    moved[:3, 3] = [250, 40, 3]
    other, motion = sim_frame(replace(frame, offset=frame.offset + moved[:3, 3]), points, cameras_of_scene())
    placed, into = moved_into(other, motion, home, "b")
    np.testing.assert_allclose(transformed(points, into), transformed(points, to_home) + moved[:3, 3], atol=1e-6)
    there = np.linalg.inv(placed.to_scene) @ other.to_scene  # from its own frame to the world's
    np.testing.assert_allclose(there @ motion, into, atol=1e-6)
    far = sim_frame(replace(frame, offset=frame.offset + 9000), points, cameras_of_scene())
    with pytest.raises(SceneError, match=r"b is \d+ km from the first building"):
        moved_into(*far, home, "b")
    with pytest.raises(SceneError, match="no common frame"):
        moved_into(replace(other, metric=False), motion, home, "b")
    with pytest.raises(
        SceneError, match="the shell of b is in EPSG:25833, and that of the first building in EPSG:25832"
    ):
        moved_into(replace(other, crs="EPSG:25833"), motion, replace(home, crs="EPSG:25832"), "b")


def frontal(x: float, distance: float = 4.0, size: int = 120) -> Camera:
    """A camera in front of the plane y = 0, looking along y."""
    return pinhole(size, size, size, (x, -distance, 1), np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]))


def pattern(points: np.ndarray) -> np.ndarray:
    """Colours of points of the plane: smooth, and different everywhere."""
    x, z = points[..., 0], points[..., 2]
    return 127 + 100 * np.stack([np.sin(1.3 * x), np.cos(1.7 * z), np.sin(x + z)], axis=-1)


def photo_of(camera: Camera, light: float = 1.0) -> Photo:
    """A photograph of the plane."""
    pose = np.linalg.inv(camera.viewmat.numpy())
    rays = camera.rays().numpy() @ pose[:3, :3].T
    points = pose[:3, 3] - rays * (pose[1, 3] / rays[..., 1])[..., None]
    return Photo((light * pattern(points)).clip(0, 255).astype(np.uint8), camera, None)


def texture_at(textured, points: np.ndarray) -> np.ndarray:
    """Colours of the texture at points of a mesh."""
    mesh = trimesh.Trimesh(textured.vertices, textured.faces, process=False)
    near, _, face = trimesh.proximity.closest_point(mesh, points)
    weights = trimesh.triangles.points_to_barycentric(mesh.triangles[face], near)
    uv = np.einsum("nk,nkc->nc", weights, textured.uv[textured.faces[face]])
    image = np.asarray(textured.image)
    column, row = (uv * [image.shape[1], image.shape[0]]).astype(int).T
    return image[image.shape[0] - 1 - row, column].astype(float)


@pytest.fixture(scope="module")
def wall() -> Triangles:
    mesh = trimesh.creation.box(bounds=[[-2, 0, 0], [2, 0.2, 2]]).subdivide_to_size(0.2)
    return surface_of(mesh)


def test_distances_are_measured_where_cameras_look(wall):
    half = box([-2, 0, 0], [0.0, 0.2, 2], subdivided=0.2)  # what is reconstructed: the wall's left half
    left = [frontal(-1.1, 1.5)]  # sees x from -1.85 to -0.35
    assert both_ways(wall, half, None, left, 0.05)["from the collision geometry"].p95 < 1e-6
    both = both_ways(wall, half, None, [*left, frontal(1.0, 1.5)], 0.05)
    assert both["from the collision geometry"].p95 > 1.0
    behind = replace(frontal(-1.1), viewmat=torch.diag(torch.tensor([1.0, 1, -1, 1]).double()) @ frontal(0.0).viewmat)
    assert both_ways(wall, half, None, [behind], 0.05) == {}


def test_distances_leave_out_what_cameras_look_along():
    house, front = box([-1, 0, 0], [0, 6, 2], subdivided=0.5), box([-1, 0, 0], [0, 0.2, 2])
    along = [frontal(0.2)]  # sees the side wall at a slant of 3° at most
    assert both_ways(house, front, None, along, 0.05)["from the collision geometry"].p95 < 1e-6


def places(count: int = 400, width: float = 1.2) -> np.ndarray:
    rng = np.random.default_rng(0)
    return np.stack([rng.uniform(-width, width, count), np.zeros(count), rng.uniform(0.1, 1.9, count)], axis=1)


def test_the_texture_has_the_photographed_colours(wall):
    textured = bake(wall, np.zeros((len(wall.vertices), 3)), lambda: [photo_of(frontal(x)) for x in (-0.8, 0.0, 0.8)])
    error = np.abs(texture_at(textured, places()) - pattern(places()))
    assert np.median(error) < 3
    assert np.quantile(error, 0.95) < 12


class Loading:
    """Loads photographs, and knows how many there were at most at the same time."""

    def __init__(self):
        self.most, self.alive = 0, 0

    def __call__(self, camera: Camera) -> Photo:
        photo = photo_of(camera)
        weakref.finalize(photo.image, self._forget)
        self.alive += 1
        self.most = max(self.most, self.alive)
        return photo

    def _forget(self) -> None:
        self.alive -= 1


def test_a_texture_keeps_no_photographs_in_memory(wall):
    cameras, load = [frontal(x) for x in np.linspace(-1, 1, 6)], Loading()
    bake(wall, np.zeros((len(wall.vertices), 3)), lambda: map(load, cameras))
    assert load.most <= 2  # one is loaded while the last one is still known


def test_a_texture_is_the_same_if_it_is_computed_in_parts(monkeypatch, wall):
    photos, colours = [photo_of(frontal(x)) for x in (-0.8, 0.8)], np.full((len(wall.vertices), 3), 99.0)
    whole = bake(wall, colours, lambda: photos)
    monkeypatch.setattr(texture, "CHUNK", 500)
    assert (np.asarray(bake(wall, colours, lambda: photos).image) == np.asarray(whole.image)).all()


def test_views_blend_into_each_other(wall):
    """Two views of different exposure: no step between neighbouring points is as large as that between the views."""
    photos = [photo_of(frontal(-1.2), 0.8), photo_of(frontal(1.2), 1.0)]
    textured = bake(wall, np.zeros((len(wall.vertices), 3)), lambda: photos)
    line = np.stack([np.linspace(-0.9, 0.9, 200), np.zeros(200), np.ones(200)], axis=1)
    light = (texture_at(textured, line) / pattern(line)).mean(axis=1)
    assert light[:20].mean() < 0.85
    assert light[-20:].mean() > 0.95
    assert np.abs(light[5:] - light[:-5]).max() < 0.1


def test_an_object_that_hides_the_wall_is_not_in_its_texture(wall):
    """A post 50 cm in front of the wall, black in the photograph, and grey where no photograph sees."""
    camera = frontal(0.0)
    post = trimesh.creation.box(bounds=[[-0.1, -0.6, -1], [0.1, -0.5, 3]])
    together = Triangles(
        np.concatenate([wall.vertices, post.vertices]), np.concatenate([wall.faces, post.faces + len(wall.vertices)])
    )
    photo = photo_of(camera)
    pose = np.linalg.inv(camera.viewmat.numpy())
    rays = camera.rays().numpy() @ pose[:3, :3].T
    hit = surface_of(post).cast(pose[:3, 3], rays).triangle >= 0
    black = photo._replace(image=np.where(hit[..., None], 0, photo.image).astype(np.uint8))
    textured = bake(together, np.full((len(together.vertices), 3), 99.0), lambda: [black])
    behind = np.stack([np.zeros(20), np.zeros(20), np.linspace(0.2, 1.8, 20)], axis=1)
    assert np.abs(texture_at(textured, behind) - 99).max() < 3
    masked = bake(wall, np.full((len(wall.vertices), 3), 99.0), lambda: [black._replace(mask=~hit)])
    assert np.abs(texture_at(masked, behind) - 99).max() < 3


def shell_and_bump() -> tuple[Triangles, Triangles]:
    """A wall of 4 x 2 m, and a reconstruction 12 cm in front of it on 0.8 x 0.5 m."""
    flat = surface_of(trimesh.creation.box(bounds=[[-2, 0, 0], [2, 3, 2]]))
    built = [
        trimesh.creation.box(bounds=[[-2, 0.01, 0], [2, 3, 2]]),
        trimesh.creation.box(bounds=[[0.2, -0.12, 1], [1.0, 0.1, 1.5]]),
    ]
    return flat, surface_of(trimesh.util.concatenate(built))


def test_a_deviation_has_the_right_position_and_size():
    flat, built = shell_and_bump()
    found = find_deviations(flat, built, [("a.jpg", frontal(-1.0)), ("b.jpg", frontal(0.6))], 0.05)
    assert [region.what for region in found.regions] == ["before"]
    (region,) = found.regions
    assert region.part == "other"
    assert region.area == pytest.approx(0.4, rel=0.35)
    assert region.distance == pytest.approx(0.12, abs=1e-3)
    assert np.linalg.norm(np.subtract(region.centre, [0.6, 0, 1.25])) < 0.12
    assert region.photograph == "b.jpg"


def test_a_deviation_is_of_the_class_of_the_shell_there():
    flat, built = shell_and_bump()
    left = flat.centres[:, 0] < np.where(np.abs(flat.normals[:, 1]) > 0.5, flat.centres[:, 2] - 1, 0)
    classes = np.where(left, SurfaceClass.WALL, SurfaceClass.WINDOW).astype(np.uint8)
    found = find_deviations(flat, built, [("b.jpg", frontal(0.6))], 0.05, classes=classes)
    front = np.flatnonzero(flat.normals[:, 1] < -0.5)
    assert len({*classes[front]}) == 2
    hit = flat.cast(
        np.array([[region.centre[0], -1, region.centre[2]] for region in found.regions]), np.array([0.0, 1, 0])
    )
    assert [region.part for region in found.regions] == [SurfaceClass(classes[k]).word for k in hit.triangle]


def test_a_deviation_is_of_one_file_of_the_shell():
    flat, built = shell_and_bump()
    fine = Triangles(*trimesh.remesh.subdivide_to_size(flat.vertices, flat.faces, 0.2, max_iter=20))
    sources = (fine.centres[:, 0] > 0.6).astype(np.int64)  # the bump is from 0.2 to 1
    names = ["left.ply", "right.ifc"]
    found = find_deviations(fine, built, [("b.jpg", frontal(0.6))], 0.05, sources=sources, files=names)
    assert {region.file: region.centre[0] > 0.6 for region in found.regions} == {"left.ply": False, "right.ifc": True}


def test_the_memory_of_deviations_does_not_grow_with_the_photographs():
    flat, built = shell_and_bump()
    peaks = []
    for count in (4, 40):
        tracemalloc.start()
        find_deviations(flat, built, [(f"{x}.jpg", frontal(x)) for x in np.linspace(-1, 1, count)], 0.05)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.1 * peaks[0]


def test_distances_are_unknown_where_no_photograph_sees_the_shell(tmp_path):
    flat, built = shell_and_bump()
    found = find_deviations(flat, built, [("a.jpg", frontal(0.0))], 0.05)
    behind = found.surface.centres[:, 1] > 2.9
    assert np.isnan(found.distance[behind]).all()
    found.write(tmp_path / "deviations.ply")
    visual = trimesh.load_mesh(tmp_path / "deviations.ply", process=False).visual
    colours = visual.face_colors[:, :3]  # pyright: ignore
    assert (colours[behind] == GREY).all()
    bump = found.flagged
    assert (colours[bump, 0] > colours[bump, 1] + 50).all()  # red


def test_photographs_take_precedence_over_the_reconstruction():
    flat, built = shell_and_bump()

    def contradicted(points: np.ndarray) -> np.ndarray:
        return np.where(points[:, 0] < -1, -0.3, np.nan)

    found = find_deviations(flat, built, [("a.jpg", frontal(0.0, 6))], 0.05, contradicted)
    assert {region.what for region in found.regions} == {"before", "behind"}


def test_a_turned_building_has_the_same_collider(facade, nothing, collider):
    """Parts hardly depend on the axes: among merges that cost nothing, the order is that of rounding."""
    turn = Rotation.from_euler("z", 31, degrees=True).as_matrix()
    turned = Triangles(facade.vertices @ turn.T, facade.faces)
    made = make_collider(turned, nothing, np.array([False]))
    assert abs(len(made.parts) - len(collider.parts)) <= 0.1 * len(collider.parts)
    points, _ = collider.surface.samples(500)
    assert np.quantile(made.surface.distance(points @ turn.T), 0.95) < 0.011


def test_details_of_the_true_building_are_found_in_front_of_its_shell(facade, eyes):
    """The synthetic building's own railings, as a perfect reconstruction would have them."""
    mesh = building(LAYOUT)
    true, _ = outward(
        surface_of(trimesh.Trimesh(mesh.vertices, mesh.triangles, process=False).subdivide_to_size(0.2)), eyes
    )
    standing = standing_before(facade, true, eyes, 0.05)
    made = make_collider(facade, true, standing)
    alone = make_collider(facade, true, np.zeros(len(standing), bool))
    points = visible(true, eyes)
    before = points[facade.signed_distance(points) > 0.05]
    near, far = made.surface.distance(before), alone.surface.distance(before)
    assert np.median(near) < 0.02 < np.median(far)
