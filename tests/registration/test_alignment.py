"""Alignments and their validation: closed forms, known truths, and mistakes that must be caught."""

from __future__ import annotations

import json
import re
import unicodedata
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyproj
import pytest
import torch
import trimesh
from cameras import pinhole
from PIL import ExifTags, Image
from scenes import cast, views_of, write_colmap
from scipy.spatial.transform import Rotation

from shellgs_method.capture.sources import find_photographs
from shellgs_method.commands import cast as casting
from shellgs_method.errors import SceneError
from shellgs_method.export.runs import TrainedRun
from shellgs_method.files.bound_cameras import BoundCameras
from shellgs_method.files.cue_maps import CueMaps
from shellgs_method.files.photographs import View, to_camera
from shellgs_method.files.sparse_points import SparsePoints
from shellgs_method.files.undistortion import undistort
from shellgs_method.geometry.axes import facade_axes, turn
from shellgs_method.geometry.camera import Camera
from shellgs_method.geometry.lens import Lens
from shellgs_method.geometry.precision import mesh_step
from shellgs_method.geometry.similarity import fit_similarity, scale_of, transformed
from shellgs_method.registration import proposal
from shellgs_method.registration.align import PROPOSAL, REPORT, Placement, place_by_guess, refined
from shellgs_method.registration.correspondences import fit_robustly
from shellgs_method.registration.geotags import GeoTags
from shellgs_method.registration.orientations import scene_axes, shell_axes
from shellgs_method.registration.picks import Pick, align_picks, read_picks, triangulate
from shellgs_method.registration.positions import SurveyedPositions, align_positions, read_positions
from shellgs_method.registration.proposal import Candidate
from shellgs_method.registration.refinement import refine
from shellgs_method.registration.repetition import mirrored_fit, scan_shifts
from shellgs_method.registration.report import shell_edges, write_report
from shellgs_method.registration.validation import LIMITS, Limit, validate
from shellgs_method.shell import ALIGNMENT, Alignment, ShellMesh, load_shell
from shellgs_method.shell import alignment as alignment_module
from shellgs_method.shell.raycast import ShellCaster
from shellgs_method.shell.surface import ShellSurface
from shellgs_method.synthetic.building import BAY, STOREY, Layout, shell
from shellgs_method.synthetic.frames import SCENE_FROM_BUILDING, SHELL_FROM_BUILDING, scene_camera
from shellgs_method.synthetic.geometry import merge
from shellgs_method.synthetic.path import walk
from shellgs_method.synthetic.scene import FacadeConfig, write_scan, write_scene

OPAQUE = Path(__file__).parents[2] / "docs/picture.jpg"
"""Any photograph: validation looks whether it is transparent."""
TRUTH = SCENE_FROM_BUILDING @ np.linalg.inv(SHELL_FROM_BUILDING)
AXES = SHELL_FROM_BUILDING[:3, :3] @ np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]).T  # columns: right, up, out


def unplaced(shell: str, crs: str = "") -> Alignment:
    """An alignment of a file, but for its similarity."""
    return Alignment(np.eye(4), (shell,), crs=crs)


@pytest.fixture(scope="module")
def mesh() -> ShellMesh:
    """The shell of a facade of five bays and three storeys, in national coordinates."""
    triangles = shell(Layout(5, 3))
    return ShellMesh(transformed(triangles.vertices, SHELL_FROM_BUILDING), triangles.triangles)


@pytest.fixture(scope="module")
def surface(mesh: ShellMesh) -> ShellSurface:
    return ShellSurface(mesh)


@pytest.fixture(scope="module")
def survey_from_scene(surface: ShellSurface) -> np.ndarray:
    """The true similarity, which every start must converge to."""
    return surface.survey_from_shell @ np.linalg.inv(TRUTH)


@pytest.fixture(scope="module")
def points(mesh: ShellMesh, surface: ShellSurface, survey_from_scene: np.ndarray) -> SparsePoints:
    """1500 points of the front with 1.5 cm of noise, and 150 of the street in front of it, in the scene's frame."""
    random = np.random.default_rng(1)
    samples, _ = surface.samples(20_000)
    in_scene = transformed(samples, np.linalg.inv(survey_from_scene))
    front = transformed(in_scene, np.linalg.inv(SCENE_FROM_BUILDING))
    front = front[front[:, 1] < 0.26][:1500]
    noisy = front + random.normal(0, 0.015, front.shape)
    clutter = random.uniform([0, -9, -0.1], [15, -1, 3], (150, 3))
    return SparsePoints(transformed(np.concatenate([noisy, clutter]), SCENE_FROM_BUILDING))


@pytest.fixture(scope="module")
def views() -> list[View]:
    """Ten views of 96 x 64 pixels, without photographs."""
    cameras = walk(15.0, 10, 96, 64, np.random.default_rng(0))
    return [View(f"images/{k}.png", OPAQUE, scene_camera(camera)) for k, camera in enumerate(cameras)]


def displaced(metres: float, degrees: float, growth: float, seed: int) -> np.ndarray:
    """A similarity that shifts, turns and grows by these amounts, in random directions."""
    random = np.random.default_rng(seed)
    shift, turn = (v / np.linalg.norm(v) for v in random.normal(size=(2, 3)))
    matrix = np.eye(4)
    matrix[:3, :3] = (1 + growth) * Rotation.from_rotvec(np.radians(degrees) * turn).as_matrix()
    matrix[:3, 3] = metres * shift
    return matrix


def error(surface: ShellSurface, found: np.ndarray, truth: np.ndarray) -> float:
    """Mean displacement of the shell, in metres."""
    moved = transformed(surface.vertices, found @ np.linalg.inv(truth))
    return float(np.linalg.norm(moved - surface.vertices, axis=1).mean())


def shifted(right: float = 0.0, up: float = 0.0, out: float = 0.0) -> Alignment:
    """The true alignment, with the shell moved by metres."""
    move = np.eye(4)
    move[:3, 3] = AXES @ [right, up, out]
    return Alignment(TRUTH @ move, ("shell/facade.ply",))


def in_its_own_frame(points: SparsePoints) -> tuple[Placement, np.ndarray]:
    """A scene in the shell's national coordinates: the exact placement, and the SfM points."""
    return Placement(Alignment(np.eye(4), ("facade.ply",))), transformed(points.positions, np.linalg.inv(TRUTH))


# Similarities and refinement


def test_refinement_does_not_follow_points_in_single_precision(mesh, views, points):
    placement, exact = in_its_own_frame(points)
    rounded = SparsePoints(exact.astype(np.float32).astype(np.float64))
    with pytest.raises(
        SceneError, match=r"--refine .* the SfM points are stored in steps of 0\.031 x 0\.5 x 1\.5e-05 m"
    ):
        refined(placement, mesh, views, rounded, 0.3)
    assert "Refined" in refined(placement, mesh, views, SparsePoints(exact), 0.3).history[-1]


def test_points_beyond_the_last_gate_by_rounding_count(surface, points, survey_from_scene):
    exact = refine(surface, points.positions, survey_from_scene, 0.1).evidence.points
    assert refine(surface, points.positions, survey_from_scene, 0.1, rounding=0.02).evidence.points > exact


def test_decimetres_of_a_shell_are_never_good(mesh, views, points):
    vertices = mesh.vertices.round(1)
    rounded = replace(mesh, vertices=vertices, step=mesh_step(vertices, mesh.faces))
    validation = validate(rounded, shifted(), views, points)
    assert any("Steps of the coordinates of shell/facade.ply: 0.1 x 0.1" in reason for reason in validation.reasons)
    assert (validation.metrics()["rounding_m"] or 0.0) >= 0.05


def test_an_alignment_is_refused_if_its_cameras_were_rounded_to_metres(mesh, views, points):
    placement, exact = in_its_own_frame(points)
    moved = []
    for view in views:
        viewmat = view.camera.viewmat @ torch.from_numpy(TRUTH)
        viewmat[:3] /= np.cbrt(np.linalg.det(TRUTH[:3, :3]))
        viewmat[:3, 3] = viewmat[:3, 3].float().double()
        moved.append(replace(view, camera=replace(view.camera, viewmat=viewmat)))
    validation = validate(mesh, placement.alignment, moved, SparsePoints(exact))
    assert validation.verdict == "refused"
    assert validation.reasons[0].startswith("Steps of the cameras: 0.")


def test_a_similarity_is_found_from_exact_points():
    random = np.random.default_rng(0)
    points = random.normal(size=(4, 3))
    truth = displaced(3.0, 70.0, 1.5, seed=3)
    np.testing.assert_allclose(fit_similarity(points, transformed(points, truth)), truth, atol=1e-12)


def test_mirrored_points_give_no_mirroring():
    points = np.random.default_rng(0).normal(size=(5, 3))
    assert np.linalg.det(fit_similarity(points, points * [1, 1, -1])[:3, :3]) > 0


@pytest.mark.parametrize("growth", [-0.01, 0.01])
def test_refinement_returns_from_30_cm_1_degree_and_1_percent(surface, points, survey_from_scene, growth):
    start = displaced(0.3, 1.0, growth, seed=5) @ survey_from_scene
    assert error(surface, start, survey_from_scene) > 0.25
    found = refine(surface, points.positions, start, reach=1.0)
    assert error(surface, found.survey_from_scene, survey_from_scene) < 0.006  # 1.5 cm of noise in 1500 points
    assert not found.evidence.weak.any()


def test_a_bare_wall_determines_three_directions_and_leaves_the_other_four_unchanged():
    corners = np.array([[-8.0, 0, -4], [8, 0, -4], [8, 0, 4], [-8, 0, 4]])
    surface = ShellSurface(ShellMesh(corners, np.array([[0, 1, 2], [0, 2, 3]])))
    random = np.random.default_rng(0)
    points = random.uniform([-6, 0, -3], [6, 0, 3], (500, 3)) + random.normal(0, 0.01, (500, 1)) * [0, 1, 0]
    # 20 cm along the wall, which the points do not determine, and 10 cm out of it, which they do.
    start = np.eye(4)
    start[:3, 3] = [0.2, 0.1, 0.0]
    found = refine(surface, points, start, reach=0.5)
    assert found.evidence.weak.sum() == 4
    np.testing.assert_allclose(found.survey_from_scene[:3, 3], [0.2, 0, 0], atol=0.005)
    assert np.cbrt(np.linalg.det(found.survey_from_scene[:3, :3])) == pytest.approx(1, abs=1e-4)
    words = " ".join(found.evidence.in_words(np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])))
    assert all(word in words for word in ("along the facade", "upwards", "roll", "scale"))
    assert all(word not in words for word in ("out of the facade", "tilt", "turn"))


def test_points_of_something_else_are_refused(surface, survey_from_scene):
    with pytest.raises(SceneError, match="only 0 SfM points are within 1 m"):
        refine(surface, np.full((50, 3), 1000.0), survey_from_scene, reach=1.0)


# Coarse registration


def test_a_proposal_is_right_if_the_ends_of_the_facade_are_visible(mesh, surface, views, points, survey_from_scene):
    placement = place_by_guess(mesh, views, points, unplaced("shell/facade.ply"))
    found = surface.survey_from_shell @ np.linalg.inv(placement.alignment.shell_to_scene)
    assert placement.proposed
    assert error(surface, found, survey_from_scene) < 0.02


def turned(axis: str) -> np.ndarray:
    """The motion that turns the shell so that an axis of its file, or none, is up."""
    if axis == "none":
        return displaced(0.0, 50.0, 0.0, seed=7)
    motion = np.eye(4)
    motion[:3, :3] = turn(np.eye(3)[2], np.eye(3)["xyz".index(axis)])
    return motion


@pytest.mark.parametrize("axis", ["x", "none"])
def test_a_proposal_is_right_for_any_up_axis(mesh, surface, views, points, survey_from_scene, axis):
    motion = turned(axis)
    askew = ShellMesh(transformed(mesh.vertices, motion), mesh.faces)
    alignment = place_by_guess(askew, views, points, unplaced("shell/facade.ply")).alignment
    found = surface.survey_from_shell @ np.linalg.inv(alignment.shell_to_scene @ motion)
    assert error(surface, found, survey_from_scene) < 0.02


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


def test_geo_tags_with_a_bias_leave_a_building_and_its_neighbour_ambiguous(tmp_path, mesh, views, points):
    apart = float(np.ptp(mesh.vertices @ AXES[:, 0])) + 0.2
    shown = tagged(tmp_path, views, 1.0, bias=0.75 * apart)
    placement = place_by_guess(twins_of(mesh, apart), shown, points, unplaced("s.ply", crs="EPSG:25832"))
    assert any(f"Ambiguous: an alignment {apart:.1f} m from this one" in sentence for sentence in placement.history)


def test_geo_tags_that_no_place_agrees_with_are_told(tmp_path, mesh, views, points):
    """As of a building elsewhere, and of one in a model of a whole district, in which it is too small to be found."""
    shown = tagged(tmp_path, views, 1.0, bias=60.0)
    placement = place_by_guess(mesh, shown, points, unplaced("s.ply", crs="EPSG:25832"))
    assert placement.history[1].endswith("crop a shell of a whole district to what photographs show.")


def test_geo_tags_tell_a_building_from_its_twin(tmp_path, mesh, views, points):
    twins = twins_of(mesh, 40)
    placement = place_by_guess(twins, tagged(tmp_path, views, 3.0), points, unplaced("s.ply", crs="EPSG:25832"))
    assert np.abs(placement.alignment.apply(mesh.vertices) - transformed(mesh.vertices, TRUTH)).max() < 0.1
    assert re.search(r"10 photographs have geo-tags, in the median [23]\.\d m away from it\.", placement.history[1])
    assert not any("Ambiguous" in sentence for sentence in placement.history)


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
    older = json.loads(path.read_text())
    del older["up"]
    path.write_text(json.dumps(older))
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
    found = proposal._Search.of(samples, seen, sight).placed(np.eye(3))
    best = max(found, key=lambda candidate: candidate.score).survey_from_scene
    np.testing.assert_allclose(best[:3, :3], np.eye(3), atol=0.1)
    np.testing.assert_allclose(best[:3, 3], 0, atol=0.5)


def test_points_exactly_in_a_plane_are_placed_on_a_shell_with_depth(mesh):
    samples, _ = ShellSurface(mesh).samples(5000)
    wall = samples[np.abs(samples[:, 1] - np.median(samples[:, 1])) < 0.1] * [1, 0, 1] / 3
    sight: Any = SimpleNamespace(points=wall, origins=wall - [0.0, 3.0, 0.0])
    found = list(proposal._Search.of(samples, wall, sight).placed(np.eye(3)))
    assert min(abs(scale_of(candidate.survey_from_scene) / 3 - 1) for candidate in found) < 0.03
    assert len(found) < 3 * 150


def test_a_proposal_names_other_bays_if_the_points_show_no_end_of_the_facade(mesh, views):
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


# Picks


def rig(count: int = 3) -> tuple[list[View], np.ndarray]:
    """Views along a baseline that look along +z, 1000 pixels wide, and their 3x4 projections."""
    views = []
    for k in range(count):
        turn = Rotation.from_euler("y", 10.0 * k - 10, degrees=True).as_matrix()
        camera = pinhole(800, 1000, 800, (2.0 * k - 2, 0.1 * k, 0.0), turn)
        views.append(View(f"images/{k}.png", Path(f"{k}.png"), camera))
    return views, np.stack([(v.camera.K @ v.camera.viewmat[:3]).numpy() for v in views])


def project(projections: np.ndarray, point: np.ndarray) -> np.ndarray:
    homogeneous = projections @ np.append(point, 1.0)
    return homogeneous[:, :2] / homogeneous[:, 2:]


def test_exact_pixels_triangulate_to_their_point():
    views, projections = rig()
    point = np.array([0.3, -0.7, 9.0])
    viewmats, Ks = (np.stack([getattr(v.camera, name).numpy() for v in views]) for name in ("viewmat", "K"))
    found, errors = triangulate(viewmats, Ks, project(projections, point))
    np.testing.assert_allclose(found, point, atol=1e-10)
    np.testing.assert_allclose(errors, 0, atol=1e-8)


def test_two_parallel_cameras_triangulate_the_depth_of_the_textbook_formula():
    # Baseline 2, focal length 800, disparity 160 pixels: depth = 800 * 2 / 160 = 10.
    views, _ = rig(2)
    viewmats, Ks = np.stack([np.eye(4)] * 2), np.stack([v.camera.K.numpy() for v in views])
    viewmats[1, 0, 3] = -2.0
    found, _ = triangulate(viewmats, Ks, np.array([[580.0, 400.0], [420.0, 400.0]]))
    np.testing.assert_allclose(found, [1.0, 0.0, 10.0], atol=1e-10)


def test_noisy_pixels_are_triangulated_to_the_least_squares_point():
    from scipy.optimize import least_squares

    views, projections = rig()
    pixels = project(projections, np.array([0.3, -0.7, 9.0])) + np.array([[1.0, -2], [0, 1.5], [-1, 0.5]])
    reference = least_squares(lambda x: (project(projections, x) - pixels).ravel(), [0.0, 0, 8], xtol=1e-15, gtol=1e-12)
    viewmats, Ks = (np.stack([getattr(v.camera, name).numpy() for v in views]) for name in ("viewmat", "K"))
    np.testing.assert_allclose(triangulate(viewmats, Ks, pixels)[0], reference.x, atol=1e-5)


@pytest.fixture
def rigged(tmp_path: Path) -> tuple[list[View], np.ndarray]:
    """The rig with photographs on disk, in whose pixels picks are given."""
    views, projections = rig()
    Image.new("RGB", (1000, 800)).save(tmp_path / "0.png")
    return [replace(view, image=tmp_path / "0.png") for view in views], projections


def picked(projections: np.ndarray, count: int = 8, noise: float = 0.2) -> tuple[list[Pick], np.ndarray]:
    """Picks on a shell in national coordinates, and its true alignment."""
    random = np.random.default_rng(2)
    scene = random.uniform([-3, -2, 8], [3, 2, 11], (count, 3))
    truth = displaced(1.0, 50.0, -0.6, seed=1)
    truth[:3, 3] -= truth[:3, :3] @ [410_000.0, 5_413_000.0, 250.0]
    on_shell = transformed(scene, np.linalg.inv(truth)) + random.normal(0, 0.005, scene.shape)
    picks = []
    for k, (point, image) in enumerate(zip(on_shell, scene, strict=True)):
        pixels = project(projections, image) + random.normal(0, noise, (3, 2))
        picks.append(Pick(f"p{k}", point, {f"images/{v}.png": (x, y) for v, (x, y) in enumerate(pixels.tolist())}))
    return picks, truth


def far_off(matrix: np.ndarray, truth: np.ndarray, picks: list[Pick]) -> float:
    """Largest distance between the picks under two alignments, in shell units."""
    points = np.stack([pick.shell for pick in picks])
    scale = np.cbrt(np.linalg.det(truth[:3, :3]))
    return float(np.linalg.norm(transformed(points, matrix) - transformed(points, truth), axis=1).max() / scale)


def test_noisy_picks_give_the_alignment(rigged):
    views, projections = rigged
    picks, truth = picked(projections)
    matrix, points = align_picks(picks, views)
    assert far_off(matrix, truth, picks) < 0.05
    assert all(point.is_used for point in points)
    assert all(point.left_out_residual > point.residual for point in points)  # a fit without it misses it by more


def test_picks_that_agree_in_a_mirror_are_of_a_left_handed_shell(rigged):
    views, projections = rigged
    picks = [replace(pick, shell=pick.shell[[1, 0, 2]]) for pick in picked(projections)[0]]  # northing before easting
    with pytest.raises(SceneError, match=r"8 of 8 picks agree .* once they are mirrored.*left-handed"):
        align_picks(picks, views)


def test_one_pick_more_that_agrees_in_a_mirror_does_so_by_chance():
    random = np.random.default_rng(2)  # of 5 careless picks on a wall, 3 agree as they are, and 4 in a mirror
    shell = random.uniform(0, [12, 0.1, 9], (5, 3))
    careless = shell + random.normal(scale=0.1, size=(5, 3))
    assert fit_robustly(shell, careless, np.ones(5, bool), 1.0, "picks", "").used.sum() == 3


def test_a_pick_that_is_2_m_off_is_left_out_and_comes_first(rigged):
    views, projections = rigged
    picks, truth = picked(projections)
    picks[4] = replace(picks[4], shell=picks[4].shell + np.array([2.0, 0, 0]))
    matrix, points = align_picks(picks, views)
    assert far_off(matrix, truth, [p for p in picks if p.name != "p4"]) < 0.05
    assert points[0].name == "p4"
    assert points[0].residual == pytest.approx(2.0, abs=0.1)
    assert [point.name for point in points if not point.is_used] == ["p4"]


@pytest.mark.parametrize("per_pixel", [0.012, 0.18], ids=["street", "air"])
def test_picks_agree_within_15_cm_or_five_pixels_on_the_surface(rigged, per_pixel):
    """From the air, picks 1.3 pixels off were left out."""
    views, projections = rigged
    metres = per_pixel / 0.012  # of photographs of 800 pixels' focal length, 10 m away
    picks = [replace(pick, shell=metres * pick.shell) for pick in picked(projections, noise=0.3)[0]]
    picks[4] = replace(picks[4], shell=picks[4].shell + np.array([max(0.25, 16 * per_pixel), 0, 0]))
    _, points = align_picks(picks, views)
    assert [point.name for point in points if not point.is_used] == ["p4"]


def test_a_pick_with_a_wrong_pixel_is_flagged_and_left_out(rigged):
    views, projections = rigged
    picks, truth = picked(projections)
    x, y = picks[3].pixels["images/2.png"]
    picks[3] = replace(picks[3], pixels={**picks[3].pixels, "images/2.png": (x, y + 60)})
    matrix, points = align_picks(picks, views)
    blurred = next(point for point in points if point.name == "p3")
    assert not blurred.is_sharp
    assert not blurred.is_used
    assert blurred.reprojection > 10
    assert far_off(matrix, truth, picks) < 0.05


def test_pixels_of_larger_photographs_are_refused(rigged):
    views, projections = rigged
    picks, _ = picked(projections)
    larger = [replace(pick, pixels={v: (4 * x, 4 * y) for v, (x, y) in pick.pixels.items()}) for pick in picks]
    words = r"of the pick p0 is outside images/\d.png, which has 1000x800: pixels must be of photographs of that size"
    with pytest.raises(SceneError, match=words):
        align_picks(larger, views)


def test_check_points_are_measured_and_not_fitted(rigged):
    views, projections = rigged
    picks, _ = picked(projections)
    picks[0] = replace(picks[0], name="check-corner", shell=picks[0].shell + np.array([0.12, 0, 0]))
    _, points = align_picks(picks, views)
    check = next(point for point in points if point.held_out)
    assert not check.is_used
    assert check.residual == pytest.approx(0.12, abs=0.05)


@pytest.mark.parametrize("count", [2, 5])
def test_too_few_picks_and_picks_on_a_line_are_refused(rigged, count):
    views, projections = rigged
    line = np.linspace([-2.0, 0, 9], [2, 0, 9], count)
    picks = [
        Pick(str(k), p, {f"images/{v}.png": tuple(xy) for v, xy in enumerate(project(projections, p).tolist())})
        for k, p in enumerate(line)
    ]
    with pytest.raises(SceneError, match="at least 3 are needed" if count == 2 else "on one line"):
        align_picks(picks, views)


def test_a_picks_file_is_read_in_opendronemaps_format(rigged, tmp_path):
    views, _ = rigged
    views = [replace(view, image=Path(view.name).with_name(f"photo {k}.png")) for k, view in enumerate(views)]
    file = tmp_path / "gcp_list.txt"
    file.write_text(
        "EPSG:25832\n"
        '410000.5 5413000.25 251 10.5 20 "photo 0.png" door  # its left top corner\n'
        "410000.5 5413000.25 251 30 40 images/1.png door\n\n"
        "1 2 3 50 60 images/0.png\n1 2 3 70 80 images/1.png\n"
    )
    door, nameless = read_picks(file, views)
    assert door.name == "door"
    assert door.pixels == {"images/0.png": (10.5, 20), "images/1.png": (30, 40)}
    np.testing.assert_array_equal(door.shell, [410000.5, 5413000.25, 251])
    assert nameless.pixels["images/1.png"] == (70, 80)


def test_picks_without_a_name_are_of_one_point_however_its_numbers_are_written(rigged, tmp_path):
    (tmp_path / "picks.txt").write_text("1 2.50 -0 4 5 images/0.png\n1.0 2.5 0 6 7 images/1.png\n")
    (pick,) = read_picks(tmp_path / "picks.txt", rigged[0])
    assert pick.name == "1 2.50 -0"
    assert pick.pixels == {"images/0.png": (4, 5), "images/1.png": (6, 7)}


def test_names_from_before_the_capture_are_told_once_and_other_spellings_are_none(rigged, tmp_path, caplog):
    views = [replace(view, name=f"images/Façade {k}.png") for k, view in enumerate(rigged[0])]
    file = tmp_path / "picks.txt"
    macos = [unicodedata.normalize("NFD", f"Façade {k}.PNG") for k in range(3)]  # as macOS writes it
    file.write_text("".join(f"1 2 3 4 5 '{name}' a\n" for name in macos))
    assert len(read_picks(file, views)[0].pixels) == 3
    assert not caplog.messages
    file.write_text("".join(f"1 2 3 4 5 'Façade {k}.heic' a\n" for k in range(3)))
    views = [replace(view, name=view.name.replace(" ", "_")) for view in views]
    assert len(read_picks(file, views)[0].pixels) == 3
    (told,) = caplog.messages
    assert "before the capture (Façade 0.heic is images/Façade_0.png, for example)" in told


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("1 2 3 4 5", "line 2: expected X Y Z"),
        ("1 2 3 4 x images/0.png", "line 2: expected X Y Z"),
        (
            "1 2 3 4 5 nowhere.png a",
            "photographs that are not in the scene, nowhere.png for example, and no point is left in two that are",
        ),
        ("1 2 9 4 5 images/1.png a", "line 2: the point a has other coordinates"),
        ("1 2 3 4 5 images/0.png a", "line 2: the point a is picked twice"),
        ("1 2 3 4 5 images/1.png 'a", "line 2"),
    ],
)
def test_an_invalid_line_of_a_picks_file_is_refused_with_its_number(rigged, tmp_path, line, sentence):
    (tmp_path / "picks.txt").write_text(f"1 2 3 4 5 images/0.png a\n{line}\n")
    with pytest.raises(SceneError, match=re.escape(sentence)):
        read_picks(tmp_path / "picks.txt", rigged[0])


def test_a_list_of_several_flights_is_used_as_far_as_its_photographs_are_in_the_scene(rigged, tmp_path, caplog):
    lines = [f"{k} 2 3 4 5 {image}.png p{k}" for k in range(4) for image in ("images/0", "elsewhere/7", "images/1")]
    lines += ["5 2 3 4 5 images/0.png half", "5 2 3 4 5 elsewhere/7.png half", "6 2 3 4 5 elsewhere/7.png other"]
    (tmp_path / "gcp_list.txt").write_text("\n".join(lines))
    picks = read_picks(tmp_path / "gcp_list.txt", rigged[0])
    assert [(pick.name, len(pick.pixels)) for pick in picks] == [(f"p{k}", 2) for k in range(4)]
    (told,) = caplog.messages
    assert "6 lines of" in told
    assert "not in the scene, elsewhere/7.png for example, and are left out, and with them 2 points" in told


@pytest.mark.parametrize(
    "first",
    [
        "1,5 2 3 4 5 images/0.png a",
        "1.5; 2 3 4 5 images/0.png a",
        "x1 2 3 4 5 images/0.png a",
        "1.0m 2.0m 3.0m 4px 5px images/0.png a",
        "-1m -.5m +3m images/0.png",
    ],
)
def test_a_slip_in_the_first_line_of_a_picks_file_is_no_header(rigged, tmp_path, first):
    (tmp_path / "picks.txt").write_text(f"{first}\n1 2 3 4 5 images/1.png a\n")
    with pytest.raises(SceneError, match="line 1: expected X Y Z of the shell"):
        read_picks(tmp_path / "picks.txt", rigged[0])


@pytest.mark.parametrize(
    "first",
    [
        "WGS84 UTM 32N",
        "+proj=tmerc +lat_0=0 +towgs84=598.1,73.7,418.2 +units=m",
        "X,Y,Z,x,y,image,name",
        "ETRS89 / UTM zone 33N",
        pyproj.CRS("EPSG:25832").to_wkt("WKT1_GDAL"),
    ],
)
def test_a_header_of_a_picks_file_is_skipped(rigged, tmp_path, first):
    (tmp_path / "picks.txt").write_text(f"{first}\n1 2 3 4 5 images/1.png a\n")
    assert [pick.name for pick in read_picks(tmp_path / "picks.txt", rigged[0])] == ["a"]


@pytest.mark.parametrize(
    "header", ["EPSG:99999", "UTM 33N", "CRS: my own", "+proj=nothing", 'PROJCS["ETRS89 / UTM 32N",GEOGCS["ETRS89"]]']
)
def test_a_header_of_a_system_that_proj_does_not_know_is_refused(rigged, tmp_path, header):
    (tmp_path / "picks.txt").write_text(f"{header}\n1 2 3 4 5 images/1.png a\n")
    with pytest.raises(SceneError, match=re.escape(f"cannot read the system {header}: write it as EPSG:25832")):
        read_picks(tmp_path / "picks.txt", rigged[0], "EPSG:25832")


def test_lines_whose_names_begin_as_comments_do_are_counted(rigged, tmp_path, caplog):
    (tmp_path / "geo.txt").write_text("#1 1 2 3\n#2,4,5,6\n# 7 8 9\n#by hand\n'images/0.png' 1 2 3\n")
    read_positions(tmp_path / "geo.txt", rigged[0])
    assert "geo.txt: 2 lines of numbers begin with #, and are skipped" in caplog.text


@pytest.mark.parametrize("header", ["EPSG:4326", "+proj=longlat +datum=WGS84", "lon,lat,z,x,y,image"])
def test_a_header_of_degrees_is_refused(rigged, tmp_path, header):
    (tmp_path / "picks.txt").write_text(f"{header}\n7.86 46.25 3 4 5 images/1.png a\n")
    with pytest.raises(SceneError, match=r"picks.txt is in degrees \(.*\): say with --crs"):
        read_picks(tmp_path / "picks.txt", rigged[0])


@pytest.mark.parametrize("name", ["architect's-corner", "l'angle-d'en-haut", "5'-6\"", "p#1", "C:\\corner"])
def test_signs_inside_a_name_are_part_of_it(rigged, tmp_path, name):
    (tmp_path / "picks.txt").write_text(f"1 2 3 4 5 images/1.png {name}  # a comment, it's one\n")
    assert [pick.name for pick in read_picks(tmp_path / "picks.txt", rigged[0])] == [name]


def test_picks_are_pixels_of_the_photograph_on_disk(tmp_path):
    # A pinhole ray through Brown's model with k1 = -0.1: x' = x (1 + k1 r²).
    calibrated = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]], dtype=torch.float64)
    lens = Lens(calibrated, 640, 480, (-0.1, 0, 0, 0, 0, 0))
    K, image = undistort(lens, np.zeros((480, 640, 3), np.uint8))
    camera = Camera(torch.eye(4, dtype=torch.float64), torch.from_numpy(K).double(), image.shape[1], image.shape[0])
    Image.new("RGB", (1280, 960)).save(tmp_path / "a.png")  # twice the calibrated size
    view = View("a.png", tmp_path / "a.png", camera, lens)
    x, y = 0.3, -0.2
    factor = 1 - 0.1 * (x * x + y * y)
    stored = 2 * np.array([[500 * factor * x + 320, 500 * factor * y + 240]])
    expected = [camera.K[0, 0] * x + camera.K[0, 2], camera.K[1, 1] * y + camera.K[1, 2]]
    np.testing.assert_allclose(to_camera(view, stored)[0], expected, atol=1e-3)


# Camera positions


ORIGIN = np.array([410_000.0, 5_413_000.0, 250.0])


def surveyed(count: int = 20, noise: float = 0.02, bow: float = 2.0) -> tuple[SurveyedPositions, np.ndarray]:
    """Cameras on a walk of 24 m that deviates from a line by ``bow`` metres, in national coordinates, and the truth."""
    random = np.random.default_rng(4)
    along = np.linspace(-1, 1, count)
    walk = np.stack([12 * along, bow * along**2, 0.1 * bow * np.sin(7 * along)], axis=1)
    truth = displaced(1.0, 50.0, -0.6, seed=1)
    truth[:3, 3] -= truth[:3, :3] @ ORIGIN
    views = []
    for k, position in enumerate(transformed(walk + ORIGIN, truth)):
        viewmat = torch.eye(4, dtype=torch.float64)
        viewmat[:3, 3] = torch.from_numpy(-position)
        views.append(View(f"images/{k}.jpg", Path(f"{k}.jpg"), Camera(viewmat, torch.eye(3), 8, 8)))
    shell = walk + ORIGIN + random.normal(0, noise, walk.shape)
    return SurveyedPositions(views, shell, ()), truth


def at_the_wall(found: np.ndarray, truth: np.ndarray) -> float:
    """Largest displacement of a wall of 20 x 10 m, 12 m from the walk, in shell units."""
    wall = np.array([[x, 12.0, z] for x in (-10.0, 10.0) for z in (0.0, 10.0)]) + ORIGIN
    scale = np.cbrt(np.linalg.det(truth[:3, :3]))
    return float(np.linalg.norm(transformed(wall, found) - transformed(wall, truth), axis=1).max() / scale)


def test_exact_camera_positions_give_the_alignment_to_a_tenth_of_a_millimetre():
    positions, truth = surveyed(noise=0.0)
    found, cameras, play = align_positions(positions)
    assert at_the_wall(found, truth) < 1e-4  # doubles in national coordinates are good to a nanometre
    assert cameras[0].residual < 1e-6
    assert play < 1e-5


def test_rtk_camera_positions_give_the_alignment_within_their_play():
    positions, truth = surveyed(noise=0.02)
    found, cameras, play = align_positions(positions)
    assert all(camera.is_used for camera in cameras)
    # 2 cm over a breadth of 0.6 m (root mean square) and 20 cameras: 0.02 / (0.6 √20) = 0.4°.
    assert play == pytest.approx(0.4, rel=0.3)
    assert at_the_wall(found, truth) < 2.5 * np.radians(play) * np.hypot(12, 10)


def test_the_play_is_the_standard_deviation_of_the_rotation_about_the_path():
    turns, plays = [], []
    for seed in range(40):
        positions, truth = surveyed(count=10, noise=0.0)
        noise = np.random.default_rng(seed).normal(0, 0.02, positions.shell.shape)
        found, _, play = align_positions(replace(positions, shell=positions.shell + noise))
        both = np.linalg.inv(found)[:3, :3] @ truth[:3, :3]
        turns.append(Rotation.from_matrix(both / np.cbrt(np.linalg.det(both))).as_rotvec(degrees=True)[0])
        plays.append(play)
    assert np.std(turns) == pytest.approx(np.mean(plays), rel=0.35)  # of 40: 11 % standard error


def test_a_camera_that_lost_its_fix_is_left_out_and_comes_first():
    positions, truth = surveyed()
    positions.shell[7] += [3.0, -1.0, 0.5]
    found, cameras, play = align_positions(positions)
    assert [camera.name for camera in cameras if not camera.is_used] == ["images/7.jpg"]
    assert cameras[0].name == "images/7.jpg"
    assert cameras[0].residual == pytest.approx(np.linalg.norm([3.0, -1.0, 0.5]), abs=0.1)
    assert at_the_wall(found, truth) < 2.5 * np.radians(play) * np.hypot(12, 10)


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"bow": 0.0}, "camera positions lie on one line, about which the shell can turn: add photographs"),
        ({"bow": 0.0, "noise": 0.3}, "lie on one line"),  # by the cameras in the scene, which are exact
        ({"count": 2}, "2 photographs of the scene have a position: at least 3 are needed"),
        ({"noise": 2.0}, "of 20 camera positions agree with the photographs within 0.15 m: they must be accurate"),
    ],
    ids=["a straight walk", "a straight walk and a poor survey", "two", "a telephone"],
)
def test_camera_positions_that_do_not_determine_the_alignment_are_refused(settings, sentence):
    with pytest.raises(SceneError, match=sentence):
        align_positions(surveyed(**settings)[0])


@pytest.mark.parametrize("first", ["EPSG:25832\n", "WGS84 UTM 32N\n", "+proj=utm +zone=32 +ellps=GRS80 +no_defs\n", ""])
def test_a_file_of_positions_is_read_in_opendronemaps_format(tmp_path, first):
    views = [replace(view, image=Path(view.name).with_name(f"photo {k}.jpg")) for k, view in enumerate(rig()[0])]
    (tmp_path / "geo.txt").write_text(
        first + '"photo 0.jpg" 410000.125 5413000.25 251 0 0 0 0.02 0.03\n\n'
        "images/2.png 410001 5413000 251  # the last one\nlost.jpg 1 2 3\n"
    )
    positions = read_positions(tmp_path / "geo.txt", views)
    assert [view.name for view in positions.views] == ["images/0.png", "images/2.png"]
    np.testing.assert_array_equal(positions.shell, [[410000.125, 5413000.25, 251], [410001, 5413000, 251]])
    assert positions.unknown == ["lost.jpg"]


@pytest.mark.parametrize("above", ["/home/user/flight/", "C:\\flight\\", "./"])
def test_positions_and_picks_may_name_photographs_by_whole_paths(tmp_path, above):
    """As exiftool's lists do, on the machine that the photographs were on."""
    views = [replace(view, image=Path(view.name)) for view in rig()[0]]
    (tmp_path / "geo.txt").write_text(
        "SourceFile,X,Y,Z\n" + "".join(f"{above}{k}.png,{k},5,6\n" for k in (0, 2)) + f"{above}other/0.png,7,7,7\n"
    )
    positions = read_positions(tmp_path / "geo.txt", views)
    assert [view.name for view in positions.views] == ["images/0.png", "images/2.png"]
    assert [name.replace("\\", "/") for name in positions.unknown] == [f"{above}other/0.png".replace("\\", "/")]
    (tmp_path / "picks.txt").write_text("".join(f"1 2 3 4 {k} {above}{k}.png a\n" for k in (0, 2)))
    (pick,) = read_picks(tmp_path / "picks.txt", views)
    assert [*pick.pixels] == ["images/0.png", "images/2.png"]


def test_excels_line_of_its_separator_is_no_header(rigged, tmp_path):
    (tmp_path / "geo.txt").write_text("sep=;\nimage;Y;X;Z\nimages/0.png;5;4;6\n")
    np.testing.assert_array_equal(read_positions(tmp_path / "geo.txt", rigged[0]).shell, [[4, 5, 6]])


@pytest.mark.parametrize(
    "header",
    [
        "imageName X Y Z Omega Phi Kappa",  # of Pix4D
        "filename,pose.position.x,pose.position.y,pose.position.z,pose.orientation.x,a,b",  # of ROS
        "#PhotoID, X, Y, Z, Omega, Phi, Kappa",  # of Metashape
        "Image Name,Position X,Position Y,Position Z,a,b,c",
    ],
)
def test_headers_of_other_programs_name_the_columns_of_positions(rigged, tmp_path, header):
    (tmp_path / "geo.txt").write_text(header + "\nimages/0.png 410000.5 5413000.25 251 9 9 9\n".replace(" ", ","))
    np.testing.assert_array_equal(read_positions(tmp_path / "geo.txt", rigged[0]).shell, [[410000.5, 5413000.25, 251]])


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("EPSG:4326", "is in degrees (EPSG:4326): say with --crs"),
        ("#name,lat,lon,alt\nimages/0.png,1,2,3", "is in degrees (name, lat, lon, alt): say with --crs"),
        ("images/0.png,12,5,0,25,3,125", "line 1: its commas separate columns, or are decimal"),
        ("image,X,Y\nimages/0.png,1,2", "its header, image, X, Y, must name one column each of image, X, Y and Z"),
        ("EPSG:25832\n# EPSG:25833\nimages/0.png 1 2 3", "names two systems, EPSG:25832 and EPSG:25833"),
        ("# EPSG:25832\nimage lat lon h\nimages/0.png 47 8 3", "names EPSG:25832, and columns of degrees"),
        ("images/0.png 1,5 2 3", "line 1: expected the image"),
        ("EPSG:25832\nimages/0.png 1 2", "line 2: expected the image, then X Y Z"),
        ("EPSG:25832\nimages/0.png 1 2 nan", "line 2: expected the image"),
        ("images/0.png 1 2 3\nimages/0.png 1 2 3", "line 2: images/0.png has a position already"),
        ("images/0.png 1 2 3\n'images/1.png 1 2 3", "line 2"),
    ],
)
def test_an_invalid_line_of_a_positions_file_is_refused_with_its_number(rigged, tmp_path, line, sentence):
    (tmp_path / "geo.txt").write_text(line)
    with pytest.raises(SceneError, match=re.escape(sentence)):
        read_positions(tmp_path / "geo.txt", rigged[0])


USERS_NAMES = {
    "IMG 0001 #2.JPG": '"IMG 0001 #2.JPG"',
    "west wing/IMG_0002.HEIC": "'west wing\\IMG_0002.heic'",
    "IMG_0003.JPG": "img_0003.jpg",
    "east/IMG_0004.jpg": "east/IMG_0004.jpg",
    "Gru\u0308n.jpg": "gr\u00fcn.jpg",
}
"""Photographs before `shellgs capture`, and how a user's file may call them."""


@pytest.fixture
def captured_views(tmp_path) -> list[View]:
    folder = tmp_path / "photographs"
    for name in USERS_NAMES:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()
    names = {path: name for name, path in find_photographs(folder).items()}
    scene = [f"images/{names[folder / name]}" for name in USERS_NAMES]
    return [replace(view, name=name, image=Path(name)) for view, name in zip(rig(len(scene))[0], scene, strict=True)]


def test_names_from_before_a_capture_still_mean_their_photographs(captured_views, tmp_path, caplog):
    (tmp_path / "geo.txt").write_text("".join(f"{name} {k} 2 3\n" for k, name in enumerate(USERS_NAMES.values())))
    (tmp_path / "gcp_list.txt").write_text("".join(f"1 2 3 {k} 5 {n} a\n" for k, n in enumerate(USERS_NAMES.values())))
    positions = read_positions(tmp_path / "geo.txt", captured_views)
    (pick,) = read_picks(tmp_path / "gcp_list.txt", captured_views)
    assert positions.unknown == []
    assert [view.name for view in positions.views] == [view.name for view in captured_views]
    assert "IMG 0001 #2.JPG is images/IMG_0001__2.JPG, for example): pixels must be" in caplog.text
    assert pick.pixels == {view.name: (k, 5) for k, view in enumerate(captured_views)}


@pytest.mark.parametrize(
    ("line", "sentence"), [("IMG 0001 #2.JPG 1 2 3", "quote a name with spaces"), ("IMG.jpg 1 2 3", "several")]
)
def test_a_name_that_may_mean_several_photographs_or_none_is_refused_with_its_line(rigged, tmp_path, line, sentence):
    views = [replace(v, name=f"images/{n}") for v, n in zip(rigged[0], ("a/IMG.JPG", "b/IMG.JPG"), strict=False)]
    (tmp_path / "geo.txt").write_text(line)
    with pytest.raises(SceneError, match=f"line 1: .*{sentence}"):
        read_positions(tmp_path / "geo.txt", views)


# The repetition test


def test_the_sizes_of_bays_and_storeys_are_measured_on_the_shell(surface, points, survey_from_scene):
    along, upwards = scan_shifts(surface, transformed(points.positions, survey_from_scene), AXES.T)
    assert along.period in (pytest.approx(BAY, abs=0.1), pytest.approx(2 * BAY, abs=0.1))  # columns: every second bay
    assert upwards.period == pytest.approx(STOREY, abs=0.1)


def test_a_shell_shifted_by_a_bay_fits_better_a_bay_back(surface, points, survey_from_scene):
    placed = transformed(points.positions, survey_from_scene)
    along, _ = scan_shifts(surface, placed, AXES.T)
    assert along.elsewhere[1] < 0.9
    along, _ = scan_shifts(surface, placed + BAY * AXES[:, 0], AXES.T)
    shift, fit = along.elsewhere
    assert shift == pytest.approx(BAY, abs=0.15)
    assert fit > 1.1


def test_the_axes_of_a_facade_are_upright_even_if_the_cameras_look_up():
    normals = np.array([[0.0, -1, 0]] * 8 + [[1.0, 0, 0]] * 3 + [[0, 0, 1.0]] * 20)
    axes = facade_axes(normals, np.array([0.0, 0.3, 0.95]))
    np.testing.assert_allclose(axes, [[1, 0, 0], [0, 0, 1], [0, -1, 0]], atol=1e-12)


# The verdict


@pytest.mark.parametrize(
    ("alignment", "verdict", "reason"),
    [
        (shifted(), "good", None),
        (shifted(out=-0.05), "doubtful", "Bias along the normal"),
        (shifted(right=0.05), "doubtful", "Motion that would fit the points better"),
        (shifted(right=BAY), "refused", "along the facade"),
        (shifted(right=-2 * BAY), "refused", "along the facade"),
        (shifted(up=STOREY), "refused", "upwards"),
        (replace(shifted(), metres_per_shell_unit=1000.0), "refused", "units"),
        (replace(shifted(), metres_per_shell_unit=0.001), "refused", "units"),
        (
            Alignment(TRUTH @ np.diag([1000.0, 1000, 1000, 1]), ("shell/facade.ply",)),
            "refused",
            "Views that see the shell",
        ),
    ],
    ids=["true", "5 cm in", "5 cm aside", "a bay", "two bays", "a storey", "kilometres", "millimetres", "1000 x"],
)
def test_the_verdict_names_what_is_wrong(mesh, views, points, alignment, verdict, reason):
    validation = validate(mesh, alignment, views, points)
    assert validation.verdict == verdict, validation.reasons
    assert reason is None or any(reason in sentence for sentence in validation.reasons)


def test_a_shell_that_is_mirrored_front_to_back_is_refused_and_a_flat_one_is_not(mesh, views, points):
    # Picks on the wall's plane place the mirror image as they do the shell.
    mirror = SHELL_FROM_BUILDING @ np.diag([1.0, -1, 1, 1]) @ np.linalg.inv(SHELL_FROM_BUILDING)
    corners, faces = np.array([[0.0, 0, 0], [15, 0, 0], [15, 0, 11], [0, 0, 11]]), np.array([[0, 1, 2], [0, 2, 3]])
    wall, opposite = (
        ShellMesh(transformed(corners - [0, distance, 0], SHELL_FROM_BUILDING), faces) for distance in (0, 30)
    )
    left_handed = ShellMesh(
        np.concatenate([transformed(mesh.vertices, mirror), opposite.vertices]),
        np.concatenate([mesh.faces, faces + len(mesh.vertices)]),
    )
    refused = [check for check in validate(left_handed, shifted(), views, points).checks if check.verdict == "refused"]
    assert any("mirrored" in check.name and "left-handed" in check.why for check in refused)
    assert not any("mirrored" in reason for reason in validate(wall, shifted(), views, points).reasons)


@pytest.mark.parametrize(
    ("panes", "railings"), [(0.2, 400), (0.1, 0)], ids=["railings before windows", "windows 10 cm before their panes"]
)
def test_neither_what_stands_before_a_shell_nor_its_inner_side_tells_that_it_is_mirrored(panes, railings):
    # A wall of 30 cm with two sides, whose strips take turns with panes in its depth.
    corners = np.array([[x, y, z] for x in range(10) for y in (0, panes, 0.3) for z in (0, 3)], np.float64)
    strips = [6 * x + 2 * y for x in range(9) for y in ((1,) if x % 2 else (0, 2))]
    faces = np.array([[[k, k + 6, k + 7], [k, k + 7, k + 1]] for k in strips]).reshape(-1, 3)
    surface, rng = ShellSurface(ShellMesh(corners, faces)), np.random.default_rng(0)
    points = [
        np.stack([2 * rng.integers(4, size=n) + strip + rng.random(n), np.full(n, behind), 3 * rng.random(n)], axis=1)
        for n, strip, behind in ((500, 0, 0.0), (400 - railings // 2, 1, 0.2), (railings, 1, -0.2))
    ]
    placed = transformed(np.concatenate(points), surface.survey_from_shell)
    axes = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    fit = mirrored_fit(surface, placed, axes)
    assert fit is not None
    assert fit < 1
    assert mirrored_fit(surface, placed + np.array([0.0, 0.0, 50.0]), axes) is None


def test_limits_work_from_both_sides_and_refuse_nan():
    below, above = Limit(0.1, 0.5, ""), Limit(0.6, 0.3, "")
    assert [below.verdict(v) for v in (0.1, 0.2, 0.6, np.nan)] == ["good", "doubtful", "refused", "refused"]
    assert [above.verdict(v) for v in (0.6, 0.5, 0.2, np.nan)] == ["good", "doubtful", "refused", "refused"]
    assert all(limit.why for limit in LIMITS.values())


def test_the_bias_is_the_distance_of_the_wall(mesh, views, points):
    # The shell is 5 cm deeper: wall points are 5 cm in front of it, points of reveals and undersides of slabs on it.
    assert 0.03 < validate(mesh, shifted(out=-0.05), views, points).bias < 0.05
    assert validate(mesh, shifted(), views, points).bias == pytest.approx(0.0, abs=0.003)


# Report and command


def test_edges_are_at_outlines_steps_and_bends_but_not_on_a_slanted_plane():
    aside = pinhole(60, 64, 48, turn=Rotation.from_euler("y", 40, degrees=True).as_matrix())
    plane = ShellMesh(
        np.array([[-99.0, -99, 9], [99, -99, 9], [99, 99, 9], [-99, 99, 9]]), np.array([[0, 1, 2], [0, 2, 3]])
    )
    assert not shell_edges(ShellCaster(plane, np.eye(4)).cast(aside), 1.0).any()
    # A plate 10 cm in front of the plane, from -1 to 1: with a focal length of 60 and a depth of 9 it ends at 32 ± 6.7.
    corners = np.array([[-1.0, -1, 8.9], [1, -1, 8.9], [1, 1, 8.9], [-1, 1, 8.9]])
    both = ShellMesh(np.concatenate([plane.vertices, corners]), np.concatenate([plane.faces, plane.faces + 4]))
    edges = shell_edges(ShellCaster(both, np.eye(4)).cast(pinhole(60, 64, 48)), 1.0)
    assert set(np.flatnonzero(edges[24])) == {24, 25, 38, 39}


def test_a_crease_is_an_edge_and_the_noise_of_triangles_beside_it_is_not():
    # Two walls of 2 x 2 m that meet at a right angle in the middle of the image, in triangles of 4 cm, 3 pixels.
    u, v = np.meshgrid(np.linspace(-2, 2, 101), np.linspace(-2, 2, 101))
    noise = np.random.default_rng(0).normal(0, 0.01, u.shape)
    vertices = np.stack([u / np.sqrt(2), v, 8 - np.abs(u) / np.sqrt(2) + noise], axis=-1).reshape(-1, 3)
    corner = np.arange(101 * 100).reshape(100, 101)[:, :-1].ravel()
    faces = np.concatenate([corner[:, None] + [0, 1, 101], corner[:, None] + [1, 102, 101]])
    cue = ShellCaster(ShellMesh(vertices, faces), np.eye(4)).cast(pinhole(600, 160, 120))
    edges = shell_edges(cue, 1.0)
    neighbours = np.einsum("hwc,hwc->hw", cue.normal[:, 1:].astype(float), cue.normal[:, :-1].astype(float))
    beside = np.abs(np.arange(160) - 79.5) > 8
    assert (neighbours < np.cos(np.radians(25)))[:, beside[1:]].mean() > 0.1  # edges of a threshold alone
    assert edges[:, beside].mean() < 0.02
    assert edges[1:-1, 76:84].any(axis=1).mean() > 0.7


def test_a_matrix_is_validated_reported_and_written(scene, shellgs):
    true = Alignment.load(scene / ALIGNMENT)
    shift = np.array([412_000.0, 5_123_000.0, 0.0])
    unshifted = true.shell_to_scene.copy()
    unshifted[:3, 3] += unshifted[:3, :3] @ shift  # for coordinates minus the shift, as CloudCompare has them
    (scene / "matrix.txt").write_text("\n".join(" ".join(f"{value:.12f}" for value in row) for row in unshifted))
    (scene / ALIGNMENT).unlink()
    shell = scene / true.shells[0]
    output = shellgs("align", scene, shell, "--matrix", scene / "matrix.txt", "--global-shift", *(-shift))
    assert "Verdict: good" in output or "Verdict: doubtful" in output
    written = Alignment.load(scene / ALIGNMENT)
    np.testing.assert_allclose(
        written.apply(load_shell(shell).vertices), true.apply(load_shell(shell).vertices), atol=1e-4
    )
    assert written.verdict in output
    assert (written.metrics["within_10cm"] or 0) > 0.5
    page = (scene / REPORT / "index.html").read_text()
    assert f"Verdict: <b>{written.verdict}</b>" in page
    assert re.findall(r'(?:src|href)="(?!data:)', page) == []
    assert "http" not in page
    overlays = list((scene / REPORT).glob("view_*.png"))
    assert len(overlays) >= 6
    assert all(Image.open(overlay).size == (640, 427) for overlay in overlays)  # of photographs of 48 x 32
    assert json.loads((scene / REPORT / "validation.json").read_text())["verdict"] == written.verdict


FEET_UP = (1, 1, 1 / 0.3048)


def pick_corners(scene: Path, scaled: Sequence[float] = (1, 1, 1), moved: int = 0) -> Path:
    """Exact picks of the corners of openings, of a shell whose axes are scaled; the first ones are metres off."""
    corners = [(o.x0, 0.0, o.z0) for o in Layout(6, 3).openings] + [(o.x1, 0.0, o.z1) for o in Layout(6, 3).openings]
    building = np.array(corners)
    on_shell = transformed(building, SHELL_FROM_BUILDING) * scaled
    on_shell[:moved] += np.random.default_rng(0).normal(0, 3, (moved, 3))
    lines = []
    for view in views_of(scene):
        projection = (view.camera.K @ view.camera.viewmat[:3]).numpy()
        for k, point in enumerate(transformed(building, SCENE_FROM_BUILDING)):
            x, y, z = projection @ np.append(point, 1)
            if z > 0 and 0 < x / z < view.camera.width and 0 < y / z < view.camera.height:
                lines.append((k, f"{' '.join(map(str, on_shell[k]))} {x / z} {y / z} {view.name} p{k}"))
    seen = [k for k, _ in lines]
    picks = scene / "picks.txt"
    picks.write_text("\n".join(line for k, line in lines if seen.count(k) >= 4))
    return picks


def test_picks_of_which_less_than_half_agree_are_refused(scene, shellgs):
    shell = scene / Alignment.load(scene / ALIGNMENT).shells[0]
    said = shellgs("align", scene, shell, "--picks", pick_corners(scene, moved=28))
    assert re.search(r"refused: shellgs: only \d+ of 31 picks of .* agree .* as three may by chance", said)


def test_picks_of_a_shell_whose_heights_are_in_another_unit_are_refused(scene, shellgs, tmp_path):
    shell = load_shell(*Alignment.load(scene / ALIGNMENT).files(scene))
    trimesh.Trimesh(shell.vertices * FEET_UP, shell.faces, process=False).export(tmp_path / "feet.obj")
    said = shellgs("align", scene, tmp_path / "feet.obj", "--picks", pick_corners(scene, scaled=FEET_UP))
    assert re.search(r"refused: shellgs: only \d+ of 31 picks .*agree .* all axes of the shell in one unit\?", said)


def test_picks_and_refinement_give_the_alignment_and_residuals(scene, shellgs):
    true = Alignment.load(scene / ALIGNMENT)
    picks = pick_corners(scene)
    (scene / ALIGNMENT).unlink()
    output = shellgs("align", scene, scene / true.shells[0], "--picks", picks, "--refine", 0.3)
    assert "picks are used" in output
    assert "Refined against" in output
    written = Alignment.load(scene / ALIGNMENT)
    vertices = load_shell(scene / true.shells[0]).vertices
    moved = np.linalg.norm(written.apply(vertices) - true.apply(vertices), axis=1).mean() * true.metres_per_unit
    assert moved < 0.05  # 300 SfM points, some of them on parts missing in the shell: flowers, railings, frames
    assert "Points known in both frames, worst first" in (scene / REPORT / "index.html").read_text()


def test_camera_positions_give_the_alignment_and_name_missing_photographs(scene, shellgs):
    true = Alignment.load(scene / ALIGNMENT)
    lines = ["EPSG:25832", "IMG_0001.jpg 0 0 0"]
    for k, view in enumerate(views_of(scene)):
        position = transformed(view.camera.position.double().numpy(), np.linalg.inv(true.shell_to_scene))
        position[0] += 2.0 if k == 3 else 0.0
        lines.append(f"{Path(view.name).name} {' '.join(map(str, position))}")
    (scene / "geo.txt").write_text("\n".join(lines))
    (scene / ALIGNMENT).unlink()
    output = shellgs("align", scene, scene / true.shells[0], "--positions", scene / "geo.txt")
    assert "9 of 10 camera positions are used" in output
    assert "In geo.txt but not in the scene: IMG_0001.jpg" in output
    assert "left out" in output
    written = Alignment.load(scene / ALIGNMENT)
    np.testing.assert_allclose(written.shell_to_scene, true.shell_to_scene, rtol=1e-6)
    assert written.source == "camera positions in geo.txt"
    assert "Points known in both frames, worst first" in (scene / REPORT / "index.html").read_text()


def test_a_refused_alignment_does_not_replace_the_saved_one(scene, shellgs):
    before = (scene / ALIGNMENT).read_bytes()
    true = Alignment.load(scene / ALIGNMENT)
    (scene / "off.json").write_text(json.dumps((true.shell_to_scene @ np.diag([1e3, 1e3, 1e3, 1])).tolist()))
    output = shellgs("align", scene, scene / true.shells[0], "--matrix", scene / "off.json")
    assert f"the alignment is refused, and {scene / ALIGNMENT} is unchanged" in " ".join(output.split())
    assert (scene / ALIGNMENT).read_bytes() == before
    assert "Verdict: <b>refused</b>" in (scene / REPORT / "index.html").read_text()
    (scene / ALIGNMENT).unlink()
    output = shellgs("align", scene, scene / true.shells[0], "--matrix", scene / "off.json")
    assert "the alignment is refused, and nothing is written: " in output
    assert not (scene / ALIGNMENT).exists()


def test_a_proposal_becomes_the_alignment_with_accept(scene, shellgs):
    (scene / ALIGNMENT).rename(scene / PROPOSAL)
    assert not (scene / ALIGNMENT).exists()
    assert "Written" in shellgs("align", scene, "--accept")
    assert Alignment.load(scene / ALIGNMENT).places_like(Alignment.load(scene / PROPOSAL))


def test_validating_a_cast_alignment_writes_its_metrics_and_the_maps_error(scene, shellgs):
    before = Alignment.load(scene / ALIGNMENT)
    assert before.error is None
    assert "Written" in shellgs("align", scene)
    validated = Alignment.load(scene / ALIGNMENT)
    assert validated.verdict in ("good", "doubtful")
    assert validated.places_like(before)
    maps = CueMaps.open(scene, "shell")
    assert maps.manifest.error == validated.error is not None
    for view in views_of(scene):
        assert maps.read(view.name, view.camera) is not None
    assert "0 views cast, 10 already there" in shellgs("cast", scene)


def test_another_alignment_makes_the_maps_stale(scene, shellgs):
    moved = Alignment.load(scene / ALIGNMENT).shell_to_scene.copy()
    moved[0, 3] += 0.01
    np.save(scene / "matrix.npy", moved)
    assert "Written" in shellgs("align", scene, scene / "shell" / "facade.ply", "--matrix", scene / "matrix.npy")
    view = views_of(scene)[0]
    with pytest.raises(SceneError, match=r"shell/alignment.json has changed since; run `shellgs cast"):
        CueMaps.open(scene, "shell").read(view.name, view.camera)


def move_cameras(scene: Path, motion: np.ndarray, digits: int = 17) -> None:
    """Apply a similarity to the scene's frame, as another run of structure from motion does."""
    transforms = json.loads((scene / "transforms.json").read_text())
    for frame in transforms["frames"]:
        pose = motion @ np.array(frame["transform_matrix"])
        pose[:3, :3] /= np.cbrt(np.linalg.det(pose[:3, :3]))
        frame["transform_matrix"] = [[float(f"{x:.{digits}g}") for x in row] for row in pose.tolist()]
    (scene / "transforms.json").write_text(json.dumps(transforms))
    cloud = trimesh.load(scene / "sparse_pc.ply")
    cloud.apply_transform(motion).export(scene / "sparse_pc.ply")


ANOTHER_FRAME = displaced(2.0, 30.0, 0.5, seed=3)


def test_an_alignment_is_not_cast_for_other_cameras(scene, shellgs):
    move_cameras(scene, ANOTHER_FRAME)
    before = (scene / ALIGNMENT).read_bytes()
    refusal = shellgs("cast", scene, "--no-check")
    assert "was found for other cameras" in refusal
    assert f"run `shellgs align {scene}`" in refusal
    assert (scene / ALIGNMENT).read_bytes() == before


def test_maps_of_an_alignment_to_other_cameras_are_refused_even_if_they_are_of_these(scene):
    """As training reads them."""
    bound = (scene / ALIGNMENT).read_bytes()
    move_cameras(scene, displaced(0.1, 1.0, 0.0, seed=3))
    views = views_of(scene)
    cast(scene, views, replace(Alignment.load(scene / ALIGNMENT), cameras=BoundCameras()))
    (scene / ALIGNMENT).write_bytes(bound)
    maps = CueMaps.open(scene, "shell")
    with pytest.raises(SceneError, match=r"aligned to other cameras: .* run `shellgs align .* then `shellgs cast"):
        maps.check(views[0].name, views[0].camera)


def change_shell(scene: Path) -> None:
    """Leave out one triangle of it."""
    mesh = shell(Layout(6, 3))
    write_scan(scene / "shell/facade.ply", replace(mesh, triangles=mesh.triangles[:-1]))


def run_of(scene: Path) -> TrainedRun:
    """A run of a scene, without a model."""
    views = views_of(scene)
    halves = [SimpleNamespace(views=views[:5]), SimpleNamespace(views=views[5:])]
    config = SimpleNamespace(dataparser=SimpleNamespace(data=scene))
    data: Any = SimpleNamespace(config=config, train_dataset=halves[0], eval_dataset=halves[1])
    model: Any = None
    return TrainedRun(model, data)


def test_a_run_is_not_exported_in_the_frame_of_other_cameras(scene):
    move_cameras(scene, ANOTHER_FRAME)
    with pytest.raises(SceneError, match="was found for other cameras"):
        _ = run_of(scene).shell


def test_a_shell_that_has_changed_is_used_once_it_is_validated_again(scene, shellgs):
    assert run_of(scene).shell is not None
    change_shell(scene)
    changed = r"shell/facade\.ply has changed since it was aligned: run `shellgs align"
    with pytest.raises(SceneError, match=changed):
        _ = run_of(scene).shell
    assert re.search(changed, shellgs("cast", scene))
    maps, view = CueMaps.open(scene, "shell"), views_of(scene)[0]
    first = r"facade\.ply has changed since: run `shellgs align .*` first, .*; run `shellgs cast"
    with pytest.raises(SceneError, match=first):
        maps.read(view.name, view.camera)
    assert "facade.ply has changed since it was aligned" in shellgs("align", scene)
    assert run_of(scene).shell is not None
    with pytest.raises(SceneError, match=r"facade\.ply has changed since; run `shellgs cast"):
        CueMaps.open(scene, "shell").read(view.name, view.camera)
    assert "views cast" in shellgs("cast", scene)


def test_an_alignment_of_an_older_version_knows_no_hashes_and_is_used(scene):
    fields = json.loads((scene / ALIGNMENT).read_text())
    del fields["hashes"]
    (scene / ALIGNMENT).write_text(json.dumps(fields))
    (scene / "shell/facade.ply").touch()
    assert run_of(scene).shell is not None


def test_a_gltf_has_changed_if_the_file_of_its_vertices_has(tmp_path):
    trimesh.Scene(trimesh.creation.box()).export(tmp_path / "a.gltf")
    bound = Alignment(np.eye(4), ("a.gltf",)).bound(tmp_path, [])
    assert bound.changed_file(tmp_path) is None
    buffer = max(tmp_path.glob("*.bin"), key=lambda file: file.stat().st_size)
    buffer.write_bytes(buffer.read_bytes()[::-1])
    assert bound.changed_file(tmp_path) == tmp_path / "a.gltf"
    assert not bound.places_like(bound.bound(tmp_path, []))


def test_hashes_that_are_edited_by_hand_are_read_or_refused_with_a_remedy(scene):
    def edit(hashes: Any) -> Alignment:
        fields = json.loads((scene / ALIGNMENT).read_text())
        (scene / ALIGNMENT).write_text(json.dumps(fields | {"hashes": hashes}))
        return Alignment.load(scene / ALIGNMENT)

    known = Alignment.load(scene / ALIGNMENT).hashes
    assert edit(known[0].upper()).hashes == known
    with pytest.raises(SceneError, match=r"alignment\.json: .* has 2 hashes of 1 files: align the shell again"):
        edit([*known, *known])


def test_a_proposal_for_a_shell_that_has_changed_is_not_accepted(scene, shellgs):
    (scene / ALIGNMENT).rename(scene / PROPOSAL)
    change_shell(scene)
    assert "facade.ply has changed since" in shellgs("align", scene, "--accept")
    assert not (scene / ALIGNMENT).exists()


def test_an_alignment_that_fits_other_cameras_too_is_validated_for_them(scene, shellgs):
    move_cameras(scene, displaced(0.02, 0.0, 0.0, seed=3))
    output = shellgs("align", scene)
    assert "It was found for other cameras than these" in output
    assert "Written" in output
    assert Alignment.load(scene / ALIGNMENT).cameras.changed(views_of(scene)) is None


def test_a_proposal_for_other_cameras_is_not_accepted(scene, shellgs):
    (scene / ALIGNMENT).rename(scene / PROPOSAL)
    move_cameras(scene, ANOTHER_FRAME)
    assert "was proposed for other cameras" in shellgs("align", scene, "--accept")


def test_photographs_come_and_go_without_harm_to_the_alignment(scene):
    found = Alignment.load(scene / ALIGNMENT)
    views = views_of(scene)
    added = replace(views[0], name="images/new.png", camera=replace(views[0].camera, width=7))
    assert found.cameras.changed([*views[3:], added]) is None
    assert found.cameras.changed(views[4:5]) is None
    assert "of their 10 photographs, 1 are in the scene" in (found.cameras.changed([views[0], added]) or "")


def test_photographs_in_another_folder_are_the_same(views):
    before = BoundCameras.of(views)
    smaller = [
        replace(view, name=view.name.replace("images/", "images_2/"), camera=view.camera.resized(32, 24))
        for view in views
    ]
    assert before.changed(smaller) is None
    smaller[3] = replace(smaller[3], camera=smaller[4].camera)
    assert "stood" in (before.changed(smaller) or "")
    converted = [replace(view, name=view.name.replace(".png", ".heic")) for view in views]
    assert {view.name for view in converted}.isdisjoint(before.cameras)
    assert before.changed(converted) is None
    by_drones = [replace(view, name=f"drone_{k % 2}/{k // 2}.jpg") for k, view in enumerate(views)]
    assert "0 are in the scene" in (BoundCameras.of(by_drones).changed([replace(views[0], name="2/0.jpg")]) or "")


@pytest.mark.parametrize("digits", [6, 8])
def test_cameras_printed_again_are_the_same(scene, digits):
    move_cameras(scene, np.eye(4), digits)
    assert Alignment.load(scene / ALIGNMENT).cameras.changed(views_of(scene)) is None


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda c: replace(c, viewmat=c.viewmat + torch.tensor([0, 0, 0, 0.1])[:, None].T), "scene units away"),
        (lambda c: replace(c, viewmat=torch.from_numpy(displaced(0, 1, 0, 3)) @ c.viewmat), "turned by 1°"),
        (lambda c: replace(c, K=c.K * torch.tensor([1.01, 1.01, 1])[:, None]), "differ by"),
    ],
    ids=["position", "rotation", "intrinsics"],
)
def test_a_camera_that_changed_is_named(views, change, words):
    before = BoundCameras.from_json(json.loads(json.dumps(BoundCameras.of(views).to_json())))
    assert before.changed([replace(view, camera=view.camera.resized(48, 32)) for view in views]) is None
    changed = [*views[:4], replace(views[4], camera=change(views[4].camera)), *views[5:]]
    assert re.search(f"{views[4].name}.* {words}", before.changed(changed) or "")


def test_an_alignment_of_an_older_version_is_cast_and_says_so(scene, shellgs):
    fields = json.loads((scene / ALIGNMENT).read_text())
    del fields["cameras"]
    (scene / ALIGNMENT).write_text(json.dumps(fields))
    scene = scene.rename(scene.with_name("my scene"))
    told = shellgs("cast", scene, "--no-check")
    assert f"does not say which cameras it was found for: `shellgs align '{scene}'` records them" in told
    assert "Written" in shellgs("align", scene)
    assert "does not say" not in shellgs("cast", scene, "--no-check")


@pytest.fixture
def scanned(scene: Path) -> Path:
    """The scene with a point cloud as its shell, sparse enough for fast meshing."""
    alignment = Alignment.load(scene / ALIGNMENT)
    samples, _ = ShellSurface(load_shell(scene / alignment.shells[0])).samples(4000)
    survey = ShellSurface(load_shell(scene / alignment.shells[0])).survey_from_shell
    np.savetxt(scene / "shell" / "scan.xyz", transformed(samples, np.linalg.inv(survey)), fmt="%.4f")
    np.save(scene / "matrix.npy", alignment.shell_to_scene)
    return scene


def test_holes_in_the_mesh_of_a_scan_are_told(scanned, shellgs, monkeypatch):
    monkeypatch.setattr(casting, "HOLES", -1.0)
    command = ("cast", scanned, "--shell", scanned / "shell/scan.xyz", "--matrix", scanned / "matrix.npy", "--no-check")
    told = " ".join(shellgs(*command).split())
    assert "far behind, through holes of a few pixels in the mesh" in told
    assert "--mesher poisson` closes most" in told
    assert "a denser scan is needed" in " ".join(shellgs(*command, "--mesher", "poisson").split())


def test_the_mesher_belongs_to_the_alignment(scanned, shellgs, monkeypatch):
    """The validated mesh is cast and loaded; another mesher removes the verdict."""
    used: list[str] = []
    load = alignment_module.load_shell
    monkeypatch.setattr(
        alignment_module, "load_shell", lambda *args, **named: used.append(named["mesher"]) or load(*args, **named)
    )
    shell = scanned / "shell" / "scan.xyz"
    shellgs("align", scanned, shell, "--matrix", scanned / "matrix.npy", "--mesher", "bpa")
    validated = Alignment.load(scanned / ALIGNMENT)
    assert (validated.mesher, bool(validated.verdict)) == ("bpa", True)
    assert "10 views cast" in shellgs("cast", scanned)
    validated.load_shell(scanned, views_of(scanned))
    assert set(used) == {"bpa"}
    assert "validated with another mesher" in shellgs("cast", scanned, "--mesher", "planes")
    assert Alignment.load(scanned / ALIGNMENT) == replace(validated, mesher="planes", verdict="", metrics={})


def test_a_cloud_is_meshed_again_once_its_cameras_are_known(scanned):
    """A proposal's mesh, made without viewpoints, is not the one that is cast."""
    shell, cache = scanned / "shell" / "scan.xyz", scanned / "shell"
    views = views_of(scanned)
    alignment = Alignment(np.load(scanned / "matrix.npy"), ("shell/scan.xyz",))
    load_shell(shell, cache=cache)
    guessed = (cache / "scan.xyz.planes.ply").read_bytes()
    alignment.load_shell(scanned, views)
    seen = (cache / "scan.xyz.planes.ply").read_bytes()
    assert seen != guessed
    nearby = replace(alignment, shell_to_scene=shifted(right=0.3).shell_to_scene)
    nearby.load_shell(scanned, views)
    assert (cache / "scan.xyz.planes.ply").read_bytes() == seen
    behind = replace(alignment, shell_to_scene=shifted(out=40.0).shell_to_scene)
    behind.load_shell(scanned, views)
    assert (cache / "scan.xyz.planes.ply").read_bytes() != seen


def test_chosen_folders_reach_every_command(scene, shellgs):
    """Photographs and cameras in folders of other names, which the maps' manifest names too."""
    write_colmap(scene, views_of(scene), list(range(1, 11)))
    cloud = trimesh.load(scene / "sparse_pc.ply")
    lines = [
        f"{k} {x} {y} {z} 9 9 9 0.1 {k % 10 + 1} 0"
        for k, (x, y, z) in enumerate(cloud.vertices.tolist())  # pyright: ignore[reportAttributeAccessIssue]
    ]
    (scene / "sparse" / "0" / "points3D.txt").write_text("\n".join(lines))
    (scene / "sparse" / "0").rename(scene / "model")
    (scene / "sparse").rmdir()
    (scene / "images").rename(scene / "photos")
    paths = ("--images-path", "photos", "--colmap-path", "model")
    assert "holds no cameras" in shellgs("align", scene)
    assert "Written" in shellgs("align", scene, *paths)
    assert "10 views cast" in shellgs("cast", scene, *paths)
    command = CueMaps.open(scene, "shell").manifest.command
    assert command == "shellgs cast {scene} --images-path photos --colmap-path model"
    printed = shellgs("mono", scene, *paths, "from", scene / "predictions")
    assert "maps made" in printed or "no view has a monocular map that can be trusted" in printed


@pytest.mark.parametrize(
    "words", [["--matrix", "m.txt"], ["shell.ply", "--matrix", "m", "--picks", "p"], ["--positions", "g"]]
)
def test_starts_that_contradict_each_other_are_refused(scene, shellgs, words):
    assert "give a shell, alone or with one of --matrix" in shellgs("align", scene, *words)


@pytest.mark.parametrize("words", [["--global-shift", 1, 2, 3], ["--metres-per-shell-unit", 0.001]])
@pytest.mark.parametrize("command", ["align", "cast"])
def test_settings_of_a_matrix_are_refused_without_it(scene, shellgs, command, words):
    before = (scene / ALIGNMENT).read_bytes()
    assert re.match(f"refused: .*{words[0]}.* (give|go with)", shellgs(command, scene, *words))
    assert (scene / ALIGNMENT).read_bytes() == before


def test_a_global_shift_is_cast(scene, shellgs):
    true = Alignment.load(scene / ALIGNMENT)
    shift = np.eye(4)
    shift[:3, 3] = [-412_000.0, -5_123_000.0, 0.0]
    np.save(scene / "matrix.npy", true.shell_to_scene @ np.linalg.inv(shift))
    words = ("--shell", scene / true.shells[0], "--matrix", scene / "matrix.npy", "--global-shift", *shift[:3, 3])
    shellgs("cast", scene, *words, "--no-check")
    np.testing.assert_allclose(Alignment.load(scene / ALIGNMENT).shell_to_scene, true.shell_to_scene, atol=1e-6)


def test_a_matrix_is_of_the_unit_and_system_of_the_shell_for_cast_as_for_align(scene, shellgs, tmp_path, caplog):
    true, foot = Alignment.load(scene / ALIGNMENT), 1200 / 3937
    mesh, size = load_shell(*true.files(scene)), CueMaps.open(scene, "shell").manifest.metres_per_unit
    middle = mesh.vertices.mean(axis=0)
    to_feet = np.diag([1 / foot, 1 / foot, 1 / foot, 1])
    to_feet[:3, 3] = [980_000, 200_000, 50] - middle / foot
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in transformed(mesh.vertices, to_feet)]
    lines += [f"f {a} {b} {c}" for a, b, c in mesh.faces + 1]
    (tmp_path / "feet.obj").write_text("\n".join(lines) + "\n")
    (tmp_path / "feet.prj").write_text(pyproj.CRS("EPSG:2263").to_wkt("WKT1_ESRI"))
    np.save(tmp_path / "matrix.npy", true.shell_to_scene @ np.linalg.inv(to_feet))
    placed = "--matrix", tmp_path / "matrix.npy"
    (scene / ALIGNMENT).unlink()
    shellgs("cast", scene, "--shell", tmp_path / "feet.obj", *placed, "--no-check")
    cast_there = Alignment.load(scene / ALIGNMENT)
    assert "is in US survey foot: its unit is taken as 0.30480061 m" in caplog.text
    assert cast_there.metres_per_shell_unit == pytest.approx(foot)
    assert CueMaps.open(scene, "shell").manifest.metres_per_unit == pytest.approx(size)
    assert "Long_Island" in cast_there.crs or cast_there.crs == "EPSG:2263"
    (scene / ALIGNMENT).unlink()
    shellgs("align", scene, tmp_path / "feet.obj", *placed)
    aligned = Alignment.load(scene / ALIGNMENT)
    assert cast_there.places_like(aligned)
    assert cast_there.crs == aligned.crs
    before = (scene / ALIGNMENT).read_bytes()
    for flag in ("--shell", "--truth"):
        told = shellgs("cast", scene, flag, tmp_path / "feet.obj", *placed, "--crs", "EPSG:3857")
        assert re.match("refused: .*is a projection of the whole Earth", told)
    assert (scene / ALIGNMENT).read_bytes() == before


def test_a_matrix_to_the_frame_that_an_applied_transform_leads_to_is_told(scene, shellgs, tmp_path):
    true, path = Alignment.load(scene / ALIGNMENT), scene / "transforms.json"
    (scene / ALIGNMENT).unlink()
    applied = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    path.write_text(json.dumps(json.loads(path.read_text()) | {"applied_transform": applied[:3].tolist()}))
    placed, why = ("--matrix", tmp_path / "matrix.npy"), "multiply it from the left by the inverse of that"
    np.save(tmp_path / "matrix.npy", true.shell_to_scene)  # as the poses and points of the file show it
    assert re.match(f"refused: .*the alignment is refused.*{why}", shellgs("align", scene, *true.files(scene), *placed))
    told = shellgs("cast", scene, "--shell", *true.files(scene), *placed, "--no-check")
    assert "Hardly any pixel shows the shell" in told
    assert why in told
    np.save(tmp_path / "matrix.npy", np.linalg.inv(applied) @ true.shell_to_scene)
    told = shellgs("cast", scene, "--shell", *true.files(scene), *placed, "--no-check")
    assert "Hardly any pixel" not in told
    assert re.search(r"covers [5-9]\d% of their pixels", told)


def test_an_alignment_without_a_verdict_is_read(tmp_path):
    fields = {"shell_to_scene": np.eye(4).tolist(), "shell": "a.ply", "metres_per_shell_unit": 1.0, "source": "matrix"}
    (tmp_path / "alignment.json").write_text(json.dumps(fields))
    assert Alignment.load(tmp_path / "alignment.json") == Alignment(np.eye(4), ("a.ply",))
    validated = Alignment(np.eye(4), ("a.ply",), verdict="good", metrics={"bias_m": 0.01, "pull_m": None})
    validated.save(tmp_path / "alignment.json")
    assert Alignment.load(tmp_path / "alignment.json") == validated


def test_a_report_is_written_even_if_no_camera_sees_the_shell(mesh, views, points, tmp_path):
    validation = validate(mesh, Alignment(displaced(1e4, 0, 0, 1) @ TRUTH, ("<shell>.ply",)), views, points)
    page = write_report(tmp_path / "report", mesh, validation).read_text()
    assert "&lt;shell&gt;.ply: refused" in page


def degrees_of(points: np.ndarray) -> np.ndarray:
    """Longitude, latitude and height of points in UTM 32, by PROJ."""
    back = pyproj.Transformer.from_crs("EPSG:25832", "EPSG:4326", always_xy=True)
    return np.stack(back.transform(*np.asarray(points).T), axis=-1)


@pytest.mark.parametrize(
    ("header", "order"),
    [
        ("EPSG:4326", [0, 1, 2]),
        ("image,latitude,longitude,height", [1, 0, 2]),
        ("image lat(deg) lng. height", [1, 0, 2]),
        ("WGS84", [0, 1, 2]),
    ],
)
def test_positions_in_degrees_are_converted_to_the_system_of_the_shell(tmp_path, header, order):
    views, truth = rig()[0], np.array([[410000.5, 5413000.25, 251.0], [410003.5, 5413001.25, 252.0]])
    lines = [
        f"{view.name} {x:.10f} {y:.10f} {z}"
        for view, (x, y, z) in zip(views, degrees_of(truth)[:, order], strict=False)
    ]
    (tmp_path / "geo.txt").write_text("\n".join([header, *lines]))
    np.testing.assert_allclose(read_positions(tmp_path / "geo.txt", views, "EPSG:25832").shell, truth, atol=1e-3)
    # of a compound system, too, whose heights are kept
    np.testing.assert_allclose(read_positions(tmp_path / "geo.txt", views, "EPSG:5555").shell, truth, atol=1e-3)


def test_picks_in_another_zone_are_converted_and_those_in_the_shells_own_are_kept_exactly(rigged, tmp_path):
    point = np.array([[800000.0, 5413000.25, 251.0]])
    zone_33 = pyproj.Transformer.from_crs("EPSG:25832", "EPSG:25833", always_xy=True)
    x, y, z = (float(value[0]) for value in zone_33.transform(*point.T))
    (tmp_path / "picks.txt").write_text(f"EPSG:25833\n{x:.6f} {y:.6f} {z} 5 6 images/0.png a\n")
    (pick,) = read_picks(tmp_path / "picks.txt", rigged[0], "EPSG:25832")
    np.testing.assert_allclose(pick.shell, point[0], atol=1e-4)
    (pick,) = read_picks(tmp_path / "picks.txt", rigged[0], "EPSG:25833")
    np.testing.assert_array_equal(pick.shell, [round(x, 6), round(y, 6), z])


@pytest.mark.parametrize(
    ("header", "line"),
    [
        ("X,Y,Z,photo,u,v", "410000.5,5413000.25,251,images/1.png,30,40"),
        ("photo;name;u;v;Northing [m];Easting [m];Height [m]", "images/1.png;a;30;40;5413000.25;410000.5;251"),
        ("x y image X Y Z", "30 40 images/1.png 410000.5 5413000.25 251"),
        ("image x y x y z", "images/1.png 30 40 410000.5 5413000.25 251"),
        ("x y z X Y image", "410000.5 5413000.25 251 30 40 images/1.png"),
        ("E N H x y image", "410000.5 5413000.25 251 30 40 images/1.png"),
        ("image image_x image_y x y z", "images/1.png 30 40 410000.5 5413000.25 251"),
        ('"X","Y","Z","photo","u","v"', '"410000.5","5413000.25","251","images/1.png","30","40"'),
        ('"";"X";"Y";"Z";"photo";"u";"v"', '"1";"410000.5";"5413000.25";"251";"images/1.png";30;40'),  # of R
        ("'X'\t'Y'\t'Z'\t'photo'\t'u'\t'v'", "'410000.5'\t5413000.25\t251\t'images/1.png'\t'30'\t'40'"),
        ("", '"410000.5","5413000.25","251","30","40","images/1.png"'),
        ("# name X Y Z image u v", "a 410000.5 5413000.25 251 images/1.png 30 40"),
        ("EPSG:25832\nimage u v Y X Z", "images/1.png 30 40 5413000.25 410000.5 251"),
        ("# X Y Z of the shell   x y in the photograph   image   name", "410000.5 5413000.25 251 30 40 images/1.png a"),
    ],
)
def test_a_header_of_picks_chooses_the_columns(rigged, tmp_path, header, line):
    (tmp_path / "picks.txt").write_text(f"{header}\n{line}\n")
    (pick,) = read_picks(tmp_path / "picks.txt", rigged[0], "EPSG:25832")
    np.testing.assert_array_equal(pick.shell, [410000.5, 5413000.25, 251])
    assert pick.pixels == {"images/1.png": (30, 40)}


@pytest.mark.parametrize(
    "text", ["name,lat,lon,height\n{image},{lat},{lon},{h}", "# EPSG:4326\n{image} {lon} {lat} {h}",
             "EPSG:4326\nheight lon lat file\n{h} {lon} {lat} {image}",
             "# coordinate system EPSG:4326\n{image} {lon} {lat} {h}",
             "#Label,X/Longitude,Y/Latitude,Z/Altitude\n{image},{lon},{lat},{h}",
             "# CoordinateSystem: " + pyproj.CRS("EPSG:4326").to_wkt("WKT1_GDAL") + "\n{image},{lon},{lat},{h}",
             "SourceFile,GPSLatitude,GPSLongitude,GPSAltitude\n{image},{lat},{lon},{h}",
             "name,lat,lon,altitude_error,alt\n{image},{lat},{lon},0.2,{h}"]
)  # fmt: skip
def test_a_header_or_comment_of_positions_chooses_columns_and_system(tmp_path, text):
    view, truth = rig()[0][0], np.array([[410000.5, 5413000.25, 251.0]])
    lon, lat, h = degrees_of(truth)[0]
    (tmp_path / "geo.txt").write_text(text.format(image=view.name, lon=f"{lon:.10f}", lat=f"{lat:.10f}", h=h))
    np.testing.assert_allclose(read_positions(tmp_path / "geo.txt", [view], "EPSG:25832").shell, truth, atol=1e-3)


def test_latitudes_in_place_of_longitudes_are_refused(tmp_path):
    views = rig()[0]
    (tmp_path / "geo.txt").write_text(f"EPSG:4326\n{views[0].name} 48.9 190 251\n")
    with pytest.raises(SceneError, match=r"48.9 190 251 cannot be converted .*: is the longitude first"):
        read_positions(tmp_path / "geo.txt", views, "EPSG:25832")


def test_a_shell_in_the_frame_of_the_cameras_needs_no_matrix_and_its_system_is_kept(scene, shellgs, tmp_path):
    alignment = Alignment.load(scene / ALIGNMENT)
    mesh = load_shell(*alignment.files(scene))
    placed = trimesh.Trimesh(alignment.apply(mesh.vertices), mesh.faces, process=False)
    placed.export(tmp_path / "placed.ply")
    words = (
        "align",
        scene,
        tmp_path / "placed.ply",
        "--same-frame",
        "--metres-per-shell-unit",
        alignment.metres_per_unit,
    )
    told = shellgs(*words, "--crs", "EPSG:28991")  # whose origin is in its area
    assert "Verdict: doubtful" in told  # its coordinates are in single precision
    found = Alignment.load(scene / ALIGNMENT)
    np.testing.assert_array_equal(found.shell_to_scene, np.eye(4))
    assert found.crs == "EPSG:28991"
    for again in (("align", scene), words):  # validated, and aligned
        shellgs(*again)
        assert Alignment.load(scene / ALIGNMENT).crs == "EPSG:28991"
    elsewhere = trimesh.Trimesh(placed.vertices + 1e5, placed.faces, process=False)
    elsewhere.export(tmp_path / "elsewhere.ply")
    assert "a shift" in shellgs("align", scene, tmp_path / "elsewhere.ply", "--same-frame")
