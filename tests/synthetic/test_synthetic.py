"""The synthetic facade: its geometry against closed forms, and the contents of its images and files."""

from __future__ import annotations

import filecmp
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
import torch
from PIL import Image
from scipy.stats import theilslopes

from shellgs_method.files.cue_maps import CueMaps
from shellgs_method.geometry.camera import Camera
from shellgs_method.geometry.similarity import transformed
from shellgs_method.shell import Alignment
from shellgs_method.shell.loading import load_shell
from shellgs_method.shell.raycast import ShellCaster
from shellgs_method.synthetic import FacadeConfig, write_scene
from shellgs_method.synthetic.appearance import rays
from shellgs_method.synthetic.building import RECESS, Layout, building, shell
from shellgs_method.synthetic.frames import SCENE_FROM_BUILDING, UNITS_PER_METRE, scene_camera
from shellgs_method.synthetic.geometry import Material
from shellgs_method.synthetic.scene import Facade
from shellgs_method.synthetic.sfm import NOISE, features, triangulate

CONFIG = FacadeConfig(width=96, height=54, views=10, points=300, supersampling=1)


@pytest.fixture(scope="module")
def facade() -> Facade:
    return Facade.build(CONFIG)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("synthetic") / "scene"
    write_scene(folder, CONFIG)
    return folder


def pose(frame: dict) -> np.ndarray:
    """World to camera, OpenCV axes, from a frame of transforms.json."""
    return np.linalg.inv(np.array(frame["transform_matrix"]) @ np.diag([1.0, -1.0, -1.0, 1.0]))


def read_camera(scene, index: int) -> tuple[str, Camera]:
    """Name and camera of a photograph, read from transforms.json without this package."""
    meta = json.loads((scene / "transforms.json").read_text())
    frame = meta["frames"][index]
    K = torch.tensor([[meta["fl_x"], 0, meta["cx"]], [0, meta["fl_y"], meta["cy"]], [0, 0, 1]], dtype=torch.float64)
    return frame["file_path"], Camera(torch.from_numpy(pose(frame)), K, meta["w"], meta["h"])


def files(folder) -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())


def points_of(facade: Facade):
    """Simulated SfM points of the facade, from images of noise."""
    rng = np.random.default_rng(0)
    noise = rng.uniform(0, 255, (CONFIG.height, CONFIG.width, 3)).astype(np.uint8)
    found = [features(facade.daylight.world, camera, noise, 200, rng) for camera in facade.cameras]
    return triangulate(facade.daylight.world, facade.cameras, found, 10_000, rng)


def test_same_seed_writes_the_same_files(scene, tmp_path):
    write_scene(tmp_path / "again", CONFIG)
    assert files(tmp_path / "again") == files(scene)
    _, mismatch, errors = filecmp.cmpfiles(scene, tmp_path / "again", files(scene), shallow=False)
    # npz files store the time of writing; their arrays are compared below.
    assert not errors
    assert all(name.endswith(".npz") for name in mismatch)
    for name in mismatch:
        with np.load(scene / name) as one, np.load(tmp_path / "again" / name) as other:
            assert all(np.array_equal(one[key], other[key]) for key in one.files)


def test_another_seed_moves_the_walk_but_not_the_building(facade):
    other = Facade.build(replace(CONFIG, seed=1))
    assert other.layout == facade.layout
    assert not torch.equal(other.cameras[0].viewmat, facade.cameras[0].viewmat)


def test_depth_on_the_wall_is_the_depth_of_its_plane(facade):
    """The wall is y = 0: with rays of z = 1 in the camera, depth = -origin.y / direction.y."""
    for camera in facade.cameras:
        origin, directions = rays(camera)
        cue, world = facade.truth(camera), facade.daylight.world
        hits = world.cast(origin, directions)
        point_y = origin[1] + hits.t * directions[..., 1]
        of_wall = world.material[hits.triangle] == Material.WALL
        wall = of_wall & (np.abs(point_y) < 1e-3) & (np.abs(hits.normal[..., 1]) > 0.9)
        assert wall.mean() > 0.1
        expected = UNITS_PER_METRE * -origin[1] / directions[..., 1]
        np.testing.assert_allclose(cue.depth[wall], expected[wall], rtol=1e-5)


def test_normals_of_the_panes_are_the_facades_in_the_camera_frame(facade):
    for camera in facade.cameras:
        origin, directions = rays(camera)
        world = facade.daylight.world
        glass = world.material[world.cast(origin, directions).triangle] == Material.GLASS
        expected = camera.viewmat[:3, :3].numpy() @ [0.0, -1.0, 0.0]
        np.testing.assert_allclose(facade.truth(camera).normal[glass], np.tile(expected, (glass.sum(), 1)), atol=1e-3)


def test_panes_lie_at_the_recess_in_building_and_shell():
    layout = Layout(3, 2)
    for mesh in (building(layout), shell(layout)):
        panes = mesh.vertices[mesh.triangles[mesh.material == Material.GLASS]]
        assert (panes[..., 1] == RECESS).all()


def test_true_normals_face_the_camera_and_the_mask_excludes_street_and_sky(facade):
    for camera in facade.cameras:
        cue = facade.truth(camera)
        world = facade.daylight.world
        material = world.material[world.cast(*rays(camera)).triangle]
        assert (np.sum(cue.normal * camera.rays().numpy(), axis=-1)[cue.mask] < 0).all()
        assert not cue.mask[material > Material.RAILING].any()
        assert (cue.depth[material == 255] == 0).all()


def test_predictions_are_affine_in_the_true_disparity_up_to_errors_of_some_percent(scene):
    """A robust line is fitted to both on the building; blurred edges are the outliers."""
    truth = CueMaps.open(scene, "truth")
    lines = []
    for i in range(CONFIG.views):
        name, camera = read_camera(scene, i)
        cue = truth.read(name, camera)
        assert cue is not None
        predicted = np.load(scene / "predictions" / f"{Path(name).stem}.npy")[cue.mask]
        inverse_depth = 1 / cue.depth[cue.mask]
        scale, shift, *_ = theilslopes(predicted[::7], inverse_depth[::7])
        lines.append((scale, shift))
        error = np.abs((predicted - shift) / scale / inverse_depth - 1)
        assert 0.005 < np.median(error) < 0.1
    assert np.std(lines, axis=0).min() > 0  # no two views share their scale and shift


def test_backprojected_truth_of_one_view_agrees_with_another(scene):
    """Only the files are used: pose, intrinsics, depth and units must be consistent."""
    truth = CueMaps.open(scene, "truth")
    (name_a, a), (name_b, b) = read_camera(scene, 3), read_camera(scene, 4)
    map_a, map_b = truth.read(name_a, a), truth.read(name_b, b)
    assert map_a is not None
    assert map_b is not None
    in_a = (map_a.depth[..., None] * a.rays().numpy())[map_a.mask]
    to_b = (b.viewmat @ torch.linalg.inv(a.viewmat)).numpy()
    in_b = in_a @ to_b[:3, :3].T + to_b[:3, 3]
    u, v = (in_b / in_b[:, 2:] @ b.K.numpy().T)[:, :2].T
    inside = (u > 0) & (u < b.width) & (v > 0) & (v < b.height) & (in_b[:, 2] > 0)
    pixels = v[inside].astype(int), u[inside].astype(int)
    both = map_b.mask[pixels]
    assert both.sum() > 500
    # A pixel is at most 6 % of a radian wide here: the median point agrees much better, edges need not.
    ratio = map_b.depth[pixels][both] / in_b[inside, 2][both]
    assert np.median(np.abs(ratio - 1)) < 0.01


def test_shell_has_less_detail_than_the_building(facade):
    assert len(shell(facade.layout).triangles) < len(building(facade.layout).triangles) / 3


def test_stored_shell_agrees_with_the_truth_on_its_surfaces(scene):
    """Georeferenced file, alignment and cameras against the true maps: most pixels within 0.1 mm."""
    alignment = Alignment.load(scene / "shell" / "alignment.json")
    mesh = load_shell(scene / alignment.shells[0])
    assert mesh.bounds.min() > 1e2
    caster, truth = ShellCaster(mesh, alignment.shell_to_scene), CueMaps.open(scene, "truth")
    assert alignment.metres_per_unit == pytest.approx(1 / UNITS_PER_METRE)
    assert truth.manifest.metres_per_unit == pytest.approx(alignment.metres_per_unit)
    for index in range(CONFIG.views):
        name, camera = read_camera(scene, index)
        cast, true = caster.cast(camera), truth.read(name, camera)
        assert true is not None
        both = cast.mask & true.mask
        metres = alignment.metres_per_unit * np.abs(cast.depth - true.depth)[both]
        assert np.mean(metres < 1e-4) > 0.75
        # The shell lacks details in front of it, but has nothing that the building lacks.
        assert (cast.depth - true.depth)[both].min() > -1e-4


def test_cameras_of_the_scene_are_the_buildings_up_to_scale(facade):
    points = np.array([[3.0, 0.0, 2.0], [7.5, 0.25, 5.0]])
    for camera in facade.cameras:
        moved = scene_camera(camera).viewmat.numpy()
        in_scene = transformed(transformed(points, SCENE_FROM_BUILDING), moved)
        np.testing.assert_allclose(in_scene, UNITS_PER_METRE * transformed(points, camera.viewmat.numpy()), atol=1e-12)
        np.testing.assert_allclose(moved[:3, :3] @ moved[:3, :3].T, np.eye(3), atol=1e-12)


def test_glass_changes_with_the_view_and_plaster_does_not(facade):
    rng = np.random.default_rng(0)
    bay = facade.layout.openings[0]
    across = rng.uniform(-0.3, 0.3, 200)
    pane = np.stack([bay.centre + across, np.full(200, RECESS), rng.uniform(1.0, 1.8, 200)], axis=-1)
    plaster = pane + np.array([1.5, -RECESS, 0.0])
    standpoints = np.array([[1.0, -7.0, 1.6], [3.0, -7.0, 1.6]], dtype=np.float32)
    change = {}
    for name, points in (("pane", pane), ("plaster", plaster)):
        one, other = (facade.daylight.radiance(eye, (points - eye).astype(np.float32)) for eye in standpoints)
        change[name] = np.abs(one - other).mean()
    assert change["plaster"] < 1e-3
    assert change["pane"] > 0.02


def test_images_are_named_in_the_order_of_the_walk(scene):
    meta = json.loads((scene / "transforms.json").read_text())
    names = [frame["file_path"] for frame in meta["frames"]]
    assert names == sorted(names)
    assert sorted(path.name for path in (scene / "images").iterdir()) == [
        name.removeprefix("images/") for name in names
    ]
    assert Image.open(scene / names[0]).size == (CONFIG.width, CONFIG.height)


def test_sfm_points_lie_on_surfaces_within_their_noise(facade):
    points = points_of(facade)
    true = points.positions[~points.is_mirrored]
    assert len(true) > 200
    surface = o3d.t.geometry.RaycastingScene()
    # Only the building: leaves and ground would make it easier.
    mesh = building(facade.layout)
    surface.add_triangles(
        o3d.core.Tensor.from_numpy(mesh.vertices.astype(np.float32)),
        o3d.core.Tensor.from_numpy(mesh.triangles.astype(np.uint32)),
    )
    near = np.abs(true[:, 1]) < 0.5
    distance = surface.compute_distance(true[near].astype(np.float32)).numpy()
    # One coordinate of normal noise of 0.2 % at 7 to 11 m: median 0.67 * (1.4 to 2.2 cm).
    assert NOISE * 5 * 0.2 < np.median(distance) < NOISE * 12


def test_wrong_points_are_mirror_images_in_the_panes(facade):
    """Mirrored back at the plane y = RECESS they lie on something in front of the glass, up to 0.2 % of 35 m."""
    points = points_of(facade)
    wrong = points.positions[points.is_mirrored]
    assert wrong[:, 1].max() > 10.0
    mirrored = (wrong * [1, -1, 1] + [0, 2 * RECESS, 0]).astype(np.float32)
    distance = facade.daylight.world.distance(mirrored)
    assert distance.max() < 4 * NOISE * 35


def test_stored_points_are_in_the_scenes_frame(scene):
    cloud = o3d.io.read_point_cloud(scene / "sparse_pc.ply")
    assert len(cloud.points) == CONFIG.points
    assert len(cloud.colors) == CONFIG.points
    in_building = transformed(np.asarray(cloud.points), np.linalg.inv(SCENE_FROM_BUILDING))
    assert abs(np.median(in_building[:, 1])) < 0.3


def test_existing_folder_is_refused_and_undisturbed(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(ValueError, match="not an empty folder"):
        write_scene(tmp_path, CONFIG)
    assert files(tmp_path) == ["notes.txt"]


def test_failure_leaves_nothing_behind(tmp_path, monkeypatch):
    monkeypatch.setattr("shellgs_method.synthetic.scene.triangulate", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        write_scene(tmp_path / "scene", replace(CONFIG, views=3))
    assert list(tmp_path.iterdir()) == []


def test_invalid_configuration_is_refused():
    with pytest.raises(ValueError, match="--views cannot be 2: give a whole number from 3"):
        FacadeConfig(views=2)
