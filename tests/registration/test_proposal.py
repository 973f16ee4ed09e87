"""Coarse registration: proposals of an alignment, with and without geo-tags, against the true one."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh
from alignments import AXES, TRUTH, degrees_of, displaced, error
from PIL import ExifTags, Image
from scenes import edited, views_of
from scipy.spatial.transform import Rotation

from shellgs_method.errors import SceneError
from shellgs_method.files.bound_cameras import BoundCameras
from shellgs_method.files.photographs import View
from shellgs_method.files.sparse_points import SparsePoints
from shellgs_method.geometry.axes import turn
from shellgs_method.geometry.similarity import affine, scale_of, transformed
from shellgs_method.geometry.triangles import stacked
from shellgs_method.registration import align, proposal
from shellgs_method.registration.align import PROPOSAL, place_by_guess
from shellgs_method.registration.geotags import GeoTags
from shellgs_method.registration.orientations import scene_axes, shell_axes
from shellgs_method.registration.proposal import Candidate
from shellgs_method.registration.sightlines import Sightlines
from shellgs_method.shell import ALIGNMENT, Alignment, ShellMesh
from shellgs_method.shell.surface import ShellSurface
from shellgs_method.synthetic.building import Layout, shell
from shellgs_method.synthetic.frames import SCENE_FROM_BUILDING, SHELL_FROM_BUILDING
from shellgs_method.synthetic.geometry import merge
from shellgs_method.synthetic.scene import FacadeConfig, write_scan, write_scene


def unplaced(shell: str, crs: str = "") -> Alignment:
    """An alignment of a file, but for its similarity."""
    return Alignment(np.eye(4), (shell,), crs=crs)


def turned(axis: str) -> np.ndarray:
    """The motion that turns the shell so that an axis of its file, or none, is up."""
    if axis == "none":
        return displaced(0.0, 50.0, 0.0, seed=7)
    motion = np.eye(4)
    motion[:3, :3] = turn(np.eye(3)[2], np.eye(3)["xyz".index(axis)])
    return motion


@pytest.mark.parametrize("axis", [pytest.param("x", marks=pytest.mark.slow), "none"])
def test_a_proposal_is_right_for_any_up_axis(mesh, surface, views, points, survey_from_scene, axis, monkeypatch):
    monkeypatch.setattr(proposal, "_CELLS", 5000)  # three times as fast
    motion = turned(axis)
    askew = ShellMesh(transformed(mesh.vertices, motion), mesh.faces)
    placement = place_by_guess(askew, views, points, unplaced("shell/facade.ply"))
    found = surface.survey_from_shell @ np.linalg.inv(placement.alignment.shell_to_scene @ motion)
    assert placement.proposed
    assert error(surface, found, survey_from_scene) < 0.02


def with_long_lens(view: View, times: float) -> View:
    """The view from farther back with a longer lens, which shows about the same."""
    camera = view.camera
    viewmat, K = camera.viewmat.clone(), camera.K.clone()
    viewmat[2, 3] += (times - 1) * 10.0 / scale_of(np.linalg.inv(SCENE_FROM_BUILDING))
    K[:2, :2] *= times
    return replace(view, camera=replace(camera, viewmat=viewmat, K=K))


def test_with_a_long_lens_errors_are_as_from_where_a_usual_one_shows_the_same(views, points):
    near, far = (Sightlines.of([with_long_lens(v, times) for v in views], points) for times in (4, 8))
    assert near.distance(np.eye(4)) == pytest.approx(far.distance(np.eye(4)), rel=0.1)


@pytest.mark.slow
def test_a_proposal_is_right_from_afar(mesh, surface, views, points, survey_from_scene):
    far = [with_long_lens(view, 7) for view in views]
    placement = place_by_guess(mesh, far, points, unplaced("shell/facade.ply"))
    found = surface.survey_from_shell @ np.linalg.inv(placement.alignment.shell_to_scene)
    assert error(surface, found, survey_from_scene) < 0.02
    assert all(check.verdict != "refused" for check in placement.checks)


def tagged(folder: Path, views: list[View], noise: float, seed: int = 0, bias: float = 0.0) -> list[View]:
    """The views with photographs that say where they were taken, metres off in UTM 32, by a bias along the facade."""
    images = [folder / f"{Path(view.name).stem}.jpg" for view in views]
    for image, exif in zip(images, geo_tags(views, noise, seed, bias), strict=True):
        Image.new("RGB", (96, 64)).save(image, exif=exif)
    return [replace(view, image=image) for view, image in zip(views, images, strict=True)]


def geo_tags(views: list[View], noise: float, seed: int = 0, bias: float = 0.0) -> list[Image.Exif]:
    """EXIF data that say where photographs were taken, as :func:`tagged` writes them."""
    places = transformed(np.stack([v.camera.position.double().numpy() for v in views]), np.linalg.inv(TRUTH))
    places[:, :2] += np.random.default_rng(seed).normal(0, noise, (len(views), 2))
    places += bias * AXES[:, 0]
    tags = [Image.Exif() for _ in views]
    for exif, (lon, lat, _) in zip(tags, degrees_of(places), strict=True):
        exif[ExifTags.Base.Make] = "phone"  # Pillow writes none into a PNG that has GPS alone
        exif.get_ifd(ExifTags.IFD.GPSInfo).update({1: "N", 2: minutes(lat), 3: "E", 4: minutes(lon), 6: 77.0})
    return tags


def minutes(degrees: float) -> tuple[float, float, float]:
    whole = int(degrees)
    return whole, int(60 * (degrees - whole)), 60 * ((60 * (degrees - whole)) % 1)


def test_geo_tags_are_read_in_the_system_of_the_shell(tmp_path, views, surface, survey_from_scene):
    tags = GeoTags.of(tagged(tmp_path, views, 0.0), "EPSG:25832", surface.survey_from_shell)
    assert tags is not None
    assert tags.apart(survey_from_scene) < 0.1  # seconds as fractions of whole numbers
    assert GeoTags.of(views, "EPSG:25832", surface.survey_from_shell) is None
    some = tagged(tmp_path, views, 0.0)[:3]
    some[0].image.write_bytes(some[0].image.read_bytes()[:60])  # damaged
    assert GeoTags.of(some, "EPSG:25832", surface.survey_from_shell) is None


@pytest.mark.parametrize(
    ("change", "read"),
    [
        ({1: "north ", 3: "e"}, 10),
        ({1: "", 3: "E"}, 9),
        ({2: (0.0, 0.0, 0.0), 4: (99.0, 0.0, 0.0)}, 9),
    ],
)
def test_a_geo_tag_that_cannot_be_used_is_left_out(tmp_path, views, surface, survey_from_scene, change, read):
    shown = tagged(tmp_path, views, 0.0)
    with Image.open(shown[4].image) as image:
        exif = image.getexif()
    exif.get_ifd(ExifTags.IFD.GPSInfo).update(change)
    Image.new("RGB", (96, 64)).save(shown[4].image, exif=exif)
    tags = GeoTags.of(shown, "EPSG:25832", surface.survey_from_shell)
    assert tags is not None
    assert len(tags.places) == read
    assert tags.apart(survey_from_scene) < 0.1


def twins_of(mesh: ShellMesh, metres: float) -> ShellMesh:
    """The shell, and another so far to the right."""
    beside = mesh.vertices + metres * AXES[:, 0]
    return ShellMesh(np.concatenate([mesh.vertices, beside]), np.concatenate([mesh.faces, mesh.faces + len(beside)]))


def upright(normals: np.ndarray, up: object = None) -> list[np.ndarray]:
    """Orientations of a building along its walls: trying others, too, takes longer, and shows nothing of shifts."""
    return [axes for axes in shell_axes(normals) if axes[1, 2] > 0.99]


def test_geo_tags_with_a_bias_leave_a_building_and_its_neighbour_ambiguous(tmp_path, mesh, views, points, monkeypatch):
    monkeypatch.setattr(proposal, "shell_axes", upright)
    apart = float(np.ptp(mesh.vertices @ AXES[:, 0])) + 0.2
    shown = tagged(tmp_path, views, 1.0, bias=0.75 * apart)
    placement = place_by_guess(twins_of(mesh, apart), shown, points, unplaced("s.ply", crs="EPSG:25832"))
    assert any(f"Ambiguous: an alignment {apart:.1f} m from this one" in sentence for sentence in placement.history)


@pytest.mark.slow
def test_geo_tags_that_no_place_agrees_with_are_told(tmp_path, mesh, views, points):
    shown = tagged(tmp_path, views, 1.0, bias=60.0)
    placement = place_by_guess(mesh, shown, points, unplaced("s.ply", crs="EPSG:25832"))
    assert placement.history[1].endswith("check that the building and --crs are the right ones.")


def district_of(mesh: ShellMesh, metres: float) -> ShellMesh:
    """The shell in the midst of houses along streets, which have another heading."""
    random, middle = np.random.default_rng(0), mesh.bounds.mean(axis=0)[:2]
    parts = [(mesh.vertices, mesh.faces)]
    heading = Rotation.from_euler("z", 25, degrees=True)
    for place in np.stack(np.meshgrid(*2 * [np.arange(-metres / 2, metres / 2, 28)]), axis=-1).reshape(-1, 2):
        if np.linalg.norm(place) > 35:
            house = trimesh.creation.box([*random.uniform(9, 20, 2), random.uniform(6, 18)])
            there = [*(middle + heading.apply([*place, 0])[:2]), mesh.bounds[0, 2] - house.bounds[0, 2]]
            parts.append((heading.apply(house.vertices) + there, house.faces))
    return ShellMesh(*stacked(parts))


@pytest.mark.slow
def test_geo_tags_find_a_building_in_a_model_of_its_district(tmp_path, mesh, views, points):
    """All of it at once, its cells are metres wide, and others of its thousands of walls fit as well."""
    district = district_of(mesh, 600)
    placement = place_by_guess(
        district, tagged(tmp_path, views, 3.0, bias=6.0), points, unplaced("s.ply", crs="EPSG:25832")
    )
    assert np.abs(placement.alignment.apply(mesh.vertices) - transformed(mesh.vertices, TRUTH)).max() < 0.1
    assert not any("Ambiguous" in sentence for sentence in placement.history)


def test_geo_tags_bound_the_scale_and_the_shift(tmp_path, views, surface, survey_from_scene):
    tags = GeoTags.of(tagged(tmp_path, views, 3.0), "EPSG:25832", surface.survey_from_shell)
    assert tags is not None
    least, greatest = tags.scales(SCENE_FROM_BUILDING[:3, 2])
    assert least < scale_of(survey_from_scene) < greatest
    shift = tags.shift(survey_from_scene[:3, :3])
    np.testing.assert_allclose(shift, survey_from_scene[:2, 3], atol=3.0)


def test_geo_tags_of_a_phone_that_repeats_its_last_place_leave_the_scale_open(
    tmp_path, mesh, views, points, surface, survey_from_scene, monkeypatch
):
    """Photographs along 60 m with one place, which by themselves would all have been taken within 10 m of it."""
    shown = tagged(tmp_path, views, 3.0)
    for view in shown[1:]:
        view.image.write_bytes(shown[0].image.read_bytes())
    tags = GeoTags.of(shown, "EPSG:25832", surface.survey_from_shell)
    assert tags is not None
    wide = replace(tags, cameras=4 * tags.cameras)
    least, greatest = wide.scales(SCENE_FROM_BUILDING[:3, 2])
    assert least < scale_of(survey_from_scene) < greatest
    monkeypatch.setattr(align, "propose", lambda *_: [Candidate(survey_from_scene, score=0.9)])
    history = place_by_guess(mesh, shown, points, unplaced("s.ply", crs="EPSG:25832")).history
    assert any(sentence.startswith("Most geo-tags repeat each other") for sentence in history)
    for count in (2, 0):
        told = place_by_guess(mesh, shown[:count] + views, points, unplaced("s.ply", crs="EPSG:25832")).history[1:]
        assert [sentence[:37] for sentence in told] == ["Geo-tags of 2 photographs were not us"] * (count > 0)


@pytest.mark.parametrize("metres_per_unit", [1.0, 0.001])
def test_geo_tags_are_told_of_if_a_shell_is_as_far_as_in_a_system(
    tmp_path, mesh, views, points, monkeypatch, metres_per_unit
):
    """A building in millimetres has ten thousands, too, without a system that --crs could name."""
    monkeypatch.setattr(align, "propose", lambda *_: [Candidate(np.eye(4), score=0.9)])
    moved = ShellMesh(mesh.vertices - mesh.vertices.min(0) + 12_000, mesh.faces)
    alignment = replace(unplaced("s.ply"), metres_per_shell_unit=metres_per_unit)
    told = place_by_guess(moved, tagged(tmp_path, views, 3.0), points, alignment).history[1:]
    assert len(told) == (metres_per_unit == 1.0)
    assert place_by_guess(moved, views, points, alignment).history[1:] == []


def test_the_command_proposes_where_photographs_say_that_they_were_taken(tmp_path, shellgs):
    """Of two facades that are the same, whose scan is in UTM 32."""
    scene, scan = tmp_path / "scene", tmp_path / "twins.ply"
    write_scene(scene, FacadeConfig(96, 64, 10, points=1500, supersampling=1, bays=3, storeys=2))
    (scene / ALIGNMENT).unlink()
    one = shell(Layout(3, 2))
    write_scan(scan, merge([one, replace(one, vertices=one.vertices + np.array([40.0, 0, 0]))]))
    views = views_of(scene)
    for view, exif in zip(views, geo_tags(views, 3.0), strict=True):
        Image.open(view.image).save(view.image, exif=exif)
    told = shellgs("align", scene, scan, "--crs", "EPSG:25832")
    assert re.search(r"10 photographs have geo-tags, in the median [1-6]\.\d m away from it\.", told), told
    assert "Ambiguous" not in told  # as it is without them: the other facade scores 100 %
    proposed = Alignment.load(scene / PROPOSAL)
    there = transformed(one.vertices, SHELL_FROM_BUILDING)
    assert np.abs(proposed.apply(there) - transformed(there, TRUTH)).max() < 0.1


@pytest.mark.parametrize(("axis", "within"), [("z", 0.0), ("y", 0.0), ("x", 0.0), ("none", 5.0)])
def test_up_is_asked_of_the_cameras_and_stored(tmp_path, views, axis, within):
    motion = turned(axis)
    alignment = Alignment(TRUTH @ np.linalg.inv(motion), ("shell/facade.obj",), cameras=BoundCameras.of(views))
    assert alignment.up is not None
    cosine = alignment.up @ motion[:3, :3] @ [0.0, 0, 1]
    assert np.degrees(np.arccos(min(cosine, 1.0))) <= within
    path = tmp_path / "alignment.json"
    alignment.save(path)
    assert Alignment.load(path) == alignment
    with edited(path) as older:
        del older["up"]
    up = Alignment.load(path).up
    assert up is not None
    np.testing.assert_array_equal(up, alignment.up)


def test_the_main_wall_is_the_same_in_each_run():
    """Of a wall as rough as Open3D's segment_plane finds another plane in each of ten runs or so."""
    random = np.random.default_rng(0)
    wall = np.stack([random.uniform(0, 20, 3000), random.normal(0, 0.25, 3000), random.uniform(0, 8, 3000)], axis=1)
    ground = np.stack([random.uniform(0, 20, 2500), random.uniform(-9, 0, 2500), random.normal(0, 0.02, 2500)], axis=1)
    cameras, up = np.array([[5.0, -10, 2], [15, -10, 2]]), np.array([0.0, 0, 1])
    found = [scene_axes(np.concatenate([ground, wall]), cameras, up) for _ in range(20)]
    assert len({axes.tobytes() for axes in found}) == 1
    assert np.degrees(np.arccos(-found[0][2, 1])) < 1


@pytest.mark.parametrize("first", [0.0, 20.0])
def test_the_walls_of_both_wings_of_a_bent_building_are_tried(first: float):
    """The larger wing's normals scatter over the neighbouring degrees too, and around 0° over those below 90°."""
    random = np.random.default_rng(0)
    headings = np.radians(random.normal(np.repeat([first, first + 30], [6000, 4000]), 1.5))
    walls = np.stack([np.cos(headings), np.sin(headings), np.zeros_like(headings)], axis=1)
    normals = np.concatenate([walls, np.tile([0.0, 0, 1], (2000, 1))])
    out = np.array([axes[2] for axes in shell_axes(normals) if axes[1, 2] > 0.99])
    for wing in np.radians([first, first + 30]):
        assert np.degrees(np.arccos((out @ [np.cos(wing), np.sin(wing), 0]).clip(-1, 1).max())) < 0.9


def test_a_proposal_that_no_point_supports_is_refused_with_the_shells_size(mesh, views, points, monkeypatch):
    """As a shell in millimetres gives, if taken for one in metres."""
    unsupported = [Candidate(np.eye(4), score=0.0)]
    monkeypatch.setattr(proposal, "shell_axes", lambda *_: [])
    monkeypatch.setattr(proposal._Fit, "refined", lambda *_: unsupported)
    with pytest.raises(SceneError, match=r"taken to be 16\.\d+ m large: .* --metres-per-shell-unit"):
        place_by_guess(mesh, views, points, unplaced("shell/facade.glb"))


@pytest.mark.parametrize("count", [0, 1, 20])
def test_a_proposal_needs_points(mesh, views, points, count):
    with pytest.raises(SceneError, match="no upright wall to start from: pick points"):
        place_by_guess(mesh, views, SparsePoints(points.positions[:count]), unplaced("facade.glb"))


def test_a_flat_wall_is_searched_for_in_about_its_size(views):
    random = np.random.default_rng(0)
    corners = np.array([[0.0, 0, 0], [15, 0, 0], [15, 0, 9], [0, 0, 9]])
    samples, _ = ShellSurface(ShellMesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))).samples(2000)
    seen = samples + random.normal(0, 0.01, samples.shape)
    sight: Any = SimpleNamespace(points=seen, origins=seen - [0.0, 8.0, 0.0])
    found = proposal._Search.of(samples, proposal._Seen(seen, sight, np.eye(3))).placed(np.eye(3))
    best = max(found, key=lambda candidate: candidate.score).survey_from_scene
    np.testing.assert_allclose(best[:3, :3], np.eye(3), atol=0.1)
    np.testing.assert_allclose(best[:3, 3], 0, atol=0.5)


def test_points_exactly_in_a_plane_are_placed_on_a_shell_with_depth(mesh):
    samples, _ = ShellSurface(mesh).samples(5000)
    wall = samples[np.abs(samples[:, 1] - np.median(samples[:, 1])) < 0.1] * [1, 0, 1] / 3
    sight: Any = SimpleNamespace(points=wall, origins=wall - [0.0, 3.0, 0.0])
    found = list(proposal._Search.of(samples, proposal._Seen(wall, sight, np.eye(3))).placed(np.eye(3)))
    assert min(abs(scale_of(candidate.survey_from_scene) / 3 - 1) for candidate in found) < 0.03
    assert len(found) < 3 * 150


def test_a_proposal_names_other_bays_if_the_points_show_no_end_of_the_facade(mesh, views, monkeypatch):
    monkeypatch.setattr(proposal, "shell_axes", upright)
    layout = Layout(5, 3)
    openings = [(o.x0, o.x1, o.z0, o.z1) for o in layout.openings if not o.is_door]
    random = np.random.default_rng(0)
    # Window edges of bays 1 and 3 only, on both sides of the door, and the wall between them.
    corners = [(x, -0.0, z) for x0, x1, z0, z1 in openings for x in (x0, x1) for z in (z0, z1) if 3 < x0 < 12]
    wall = random.uniform([3.0, 0, 0.3], [12.0, 0, 9.5], (1500, 3))
    inside = np.zeros(len(wall), bool)
    for x0, x1, z0, z1 in openings:
        inside |= (wall[:, 0] > x0) & (wall[:, 0] < x1) & (wall[:, 2] > z0) & (wall[:, 2] < z1)
    building = np.concatenate([wall[~inside], np.repeat(np.array(corners), 10, axis=0)])
    building += random.normal(0, 0.01, building.shape)
    points = SparsePoints(transformed(building, SCENE_FROM_BUILDING))
    history = place_by_guess(mesh, views, points, unplaced("shell/facade.ply")).history
    assert any(sentence.startswith("Ambiguous: an alignment") for sentence in history)


def test_a_candidate_stays_where_refining_it_makes_it_worse(surface, views, points, survey_from_scene, monkeypatch):
    """As beside houses that are the same, whose walls are within reach."""
    worse = SimpleNamespace(survey_from_scene=displaced(2.0, 0.0, 0.0, seed=1) @ survey_from_scene)
    monkeypatch.setattr(proposal, "refine", lambda *_, **__: worse)
    seen = proposal._Seen.of(views, points, SCENE_FROM_BUILDING[:3, 2])
    fit = proposal._Fit.of(surface, surface.samples(500)[0], seen)
    (found,) = fit.refined(Candidate(survey_from_scene, 0.0), 250, 3.0, 0.012, 10)
    np.testing.assert_array_equal(found.survey_from_scene, survey_from_scene)
    assert found.score > 0.8


@pytest.mark.parametrize(("of_walls", "right", "up"), [(True, 0.2, 0.8), (False, 0.0, 0.8), (False, 3.0, 0.0)])
def test_a_shift_along_a_bare_wall_is_one_place_and_one_by_a_bay_is_another(
    mesh, surface, views, points, survey_from_scene, of_walls, right, up
):
    corners = np.array([[-30.0, 0, -20], [50, 0, -20], [50, 0, 30], [-30, 0, 30]])
    wall = ShellMesh(transformed(corners, SHELL_FROM_BUILDING), np.array([[0, 1, 2], [0, 2, 3]]))
    placed = surface.survey_from_shell
    shell = ShellSurface(wall, 1.0) if of_walls else surface
    to = shell.survey_from_shell @ np.linalg.inv(placed) @ survey_from_scene
    move = np.eye(4)
    move[:3, 3] = -shell.survey_from_shell[:3, :3] @ AXES @ [right, up, 0]
    seen = proposal._Seen.of(views, points, SCENE_FROM_BUILDING[:3, 2])
    fit = proposal._Fit.of(shell, shell.samples(500)[0], seen)
    best, other = (fit.measured(each, proposal._FIT) for each in (to, move @ to))
    other = replace(other, score=best.score, displacement=fit.apart(other, best))
    assert other.displacement == pytest.approx(np.hypot(right, up), abs=0.05)
    assert fit.is_one_place(other, best) == of_walls
    assert bool(fit.imprecision(best)) == of_walls


@pytest.mark.parametrize("up_in_file", [True, False])
def test_a_candidate_that_turns_a_building_over_is_no_rival_where_the_file_is_upright(
    surface, views, points, survey_from_scene, up_in_file
):
    seen = proposal._Seen.of(views, points, SCENE_FROM_BUILDING[:3, 2])
    over = affine(Rotation.from_rotvec([np.pi, 0, 0]).as_matrix(), np.zeros(3))
    best, other = Candidate(survey_from_scene, 0.8), Candidate(over @ survey_from_scene, 0.79)
    if not up_in_file:
        best, other = replace(other, score=0.8), replace(best, score=0.79)
    fit = proposal._Fit.of(surface, surface.samples(500)[0], seen)
    assert len(fit.ranked([best, other])) == (1 if up_in_file else 2)


@pytest.mark.parametrize(("low", "high", "way"), [(-20.0, 10.8, "upwards"), (0.0, 30.0, "downwards")])
def test_imprecision_says_which_way_a_shell_may_be_moved(surface, views, points, survey_from_scene, low, high, way):
    """A strip of a wall with an edge of what is seen at one end, and none at the other."""
    corners = np.array([[5, 0, low], [10, 0, low], [10, 0, high], [5, 0, high]])
    strip = ShellSurface(ShellMesh(transformed(corners, SHELL_FROM_BUILDING), np.array([[0, 1, 2], [0, 2, 3]])), 1.0)
    x, y, _ = transformed(points.positions, np.linalg.inv(SCENE_FROM_BUILDING)).T
    on = SparsePoints(points.positions[(x > 5) & (x < 10) & (np.abs(y) < 0.1)])
    seen = proposal._Seen.of(views, on, SCENE_FROM_BUILDING[:3, 2])
    fit = proposal._Fit.of(strip, strip.samples(500)[0], seen)
    to = strip.survey_from_shell @ np.linalg.inv(surface.survey_from_shell) @ survey_from_scene
    found = fit.imprecision(fit.measured(to, proposal._FIT))
    assert found.pop(way) == 4.0
    assert max(found.values(), default=0.0) < 4.0


@pytest.mark.parametrize(("up", "verdict"), [(0.8, "doubtful"), (3.5, "refused")])
def test_an_imprecise_place_is_told_with_its_direction(
    mesh, views, points, survey_from_scene, monkeypatch, up, verdict
):
    best = Candidate(survey_from_scene, 0.8, imprecision={"upwards": up, "to the left": 1.0})
    monkeypatch.setattr(align, "propose", lambda *_: [best])
    placement = place_by_guess(mesh, views, points, unplaced("shell/facade.ply"))
    assert placement.history[-1].startswith(
        f"Imprecise: it fits nearly as well up to {up} m upwards, up to 1.0 m to the left;"
    )
    assert [check.verdict for check in placement.checks] == ["good", verdict]


def walked(noise: float = 0.0, spot: bool = False) -> GeoTags:
    """Geo-tags of a walk of 60 m around a corner, in a scene whose unit is half a metre, by a phone."""
    way = np.array([[min(k, 30.0), max(k - 30.0, 0.0), 0.0] for k in range(0, 60, 3)])
    places = (way[:, :2] + np.random.default_rng(0).normal(0, noise, (len(way), 2))) * (not spot)
    return GeoTags(way * 2, places - np.array([0.0, 8.0]))


def test_geo_tags_on_one_spot_tell_no_scale():
    least, greatest = walked(spot=True).scales(np.array([0.0, 0, 1]))
    assert least < 0.5 < greatest


@pytest.mark.parametrize(("of_one_place", "repeated"), [(5, False), (50, True)])
def test_geo_tags_that_the_cameras_of_a_rig_share_are_not_repeated(of_one_place: int, repeated: bool):
    """Five cameras at each of 20 places along 60 m; a phone has two places for all."""
    tags = walked(noise=2.0)
    last = np.arange(100) // of_one_place * of_one_place // 5
    rig = np.random.default_rng(1).normal(np.repeat(tags.cameras, 5, axis=0), 0.2)
    assert GeoTags(rig, tags.places[last]).repeated is repeated


def test_photographs_after_the_signal_was_lost_do_not_bound_the_search(surface, views, points, monkeypatch):
    tags = walked()
    tags.places[11:] = tags.places[11]
    least, greatest = tags.fresh.scales(np.array([0.0, 0, 1]))
    assert least < 0.5 < greatest
    searched = []
    monkeypatch.setattr(proposal, "shell_axes", lambda *_, **__: [])
    monkeypatch.setattr(proposal._Search, "starts", lambda search, *_: searched.append(search.tags) or [])
    seen = proposal._Seen.of(views, points, SCENE_FROM_BUILDING[:3, 2])
    tags = replace(tags, places=tags.places + surface.vertices[0, :2])
    assert proposal._near(tags, surface, seen) == []
    assert len(searched[0].places) == 12
