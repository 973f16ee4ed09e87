"""Meshes of rendered depth: their surface against closed forms, their frame and files against known lengths."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from scenes import edited
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from splat_files import glb_attributes
from training_runs import data_of, model_of, trainer_of

from dataparsers.cameras import pinhole_camera
from shellgs_method import cli
from shellgs_method.errors import SceneError
from shellgs_method.export.frame import Frame, scene_frame, shell_frame
from shellgs_method.export.meshes import write_mesh
from shellgs_method.export.runs import TrainedRun, mesh_errors
from shellgs_method.geometry import tsdf
from shellgs_method.geometry.box import Box
from shellgs_method.geometry.camera import Camera
from shellgs_method.geometry.decimation import decimated_mesh
from shellgs_method.geometry.similarity import transformed
from shellgs_method.geometry.tsdf import DepthView, fuse
from shellgs_method.shell import ALIGNMENT, Alignment, ShellCaster, ShellMesh, load_shell
from shellgs_method.sim.building import Reconstruction
from shellgs_method.synthetic.building import Layout, building
from shellgs_method.synthetic.frames import SCENE_FROM_BUILDING, SHELL_FROM_BUILDING

ROOM = Box(np.eye(3), np.full(3, -3.0), np.full(3, 3.0))
FRAME = Frame(
    "shell", np.eye(4), np.array([400_000.0, 5_000_000.0, 0.0]), metric=True, up=np.eye(3)[2], crs="EPSG:25832"
)
K = torch.tensor([[80.0, 0, 48], [0, 80, 32], [0, 0, 1]], dtype=torch.float64)


def camera_at(angle: float, distance: float = 5.0) -> Camera:
    """A camera on a circle around the origin, looking at it."""
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = torch.from_numpy(Rotation.from_rotvec([0, angle, 0]).as_matrix())
    viewmat[2, 3] = distance
    return Camera(viewmat, K, 96, 64)


def view_of_sphere(camera: Camera, radius: float = 1.5) -> DepthView:
    """Depth of a sphere about the origin: the smaller root of |z ray - c|² = r², c its centre in the camera's frame."""
    rays, centre = camera.rays(), camera.viewmat[:3, 3]
    a, b = rays.square().sum(-1), rays @ centre
    root = (b**2 - a * (centre @ centre - radius**2)).clamp_min(0).sqrt()
    depth = torch.where(root > 0, (b - root) / a, 0.0)[..., None].float()
    return DepthView(depth, torch.tensor([1.0, 0.5, 0.0]).expand(64, 96, 3), camera)


@pytest.fixture(scope="module")
def sphere() -> trimesh.Trimesh:
    return fuse((view_of_sphere(camera_at(angle)) for angle in np.linspace(-0.6, 0.6, 7)), ROOM, 0.05)


def counted_tiles(monkeypatch: pytest.MonkeyPatch, most: int) -> list[object]:
    """The grid of each tile, as tiles of ``most`` blocks are begun."""
    grids, make = [], tsdf._voxel_grid
    monkeypatch.setattr(tsdf, "_MOST", most)
    monkeypatch.setattr(tsdf, "_voxel_grid", lambda voxel: grids.append(make(voxel)) or grids[-1])
    return grids


def test_tiles_of_one_lattice_meet_without_a_seam(sphere, monkeypatch):
    """The mesh of many tiles has the triangles of that of one."""
    tiles = counted_tiles(monkeypatch, most=60)
    tiled = fuse((view_of_sphere(camera_at(angle)) for angle in np.linspace(-0.6, 0.6, 7)), ROOM, 0.05)
    assert len(tiles) > 3
    assert len(tiled.faces) == len(sphere.faces)
    assert len(tiled.vertices) == len(sphere.vertices)
    assert KDTree(tiled.triangles_center).query(sphere.triangles_center)[0].max() < 1e-6
    assert tiled.area == pytest.approx(sphere.area)


def test_a_view_with_hardly_any_depth_adds_nothing(sphere):
    """Open3D looks at every fourth pixel, and fails where none of these has a depth."""
    angles = np.linspace(-0.6, 0.6, 7)
    hardly = view_of_sphere(camera_at(0.0))
    depth = torch.zeros_like(hardly.depth)
    depth[33, 49] = hardly.depth[33, 49]
    assert depth.max() > 0
    views = [hardly._replace(depth=depth), *(view_of_sphere(camera_at(angle)) for angle in angles)]
    assert len(fuse(views, ROOM, 0.05).faces) == len(sphere.faces)


def test_views_with_hardly_any_depth_alone_are_refused():
    view = view_of_sphere(camera_at(0.0))
    depth = torch.zeros_like(view.depth)
    depth[33, 49] = view.depth[33, 49]
    with pytest.raises(SceneError, match="there is no mesh"):
        fuse([view._replace(depth=depth)], ROOM, 0.05)


def view_of_street(x: float) -> DepthView:
    """Depth of the wall z = 0.1 sin(x), from 5 before it, by fixed-point iteration along the rays."""
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, 3] = torch.tensor([-x, 0, 5])
    camera = Camera(viewmat, K, 96, 64)
    rays = camera.rays()
    depth = torch.full((64, 96), 5.0, dtype=torch.float64)
    for _ in range(30):
        depth = 5 + 0.1 * torch.sin(x + depth * rays[..., 0])
    return DepthView(depth[..., None].float(), torch.ones(64, 96, 3), camera)


def test_a_long_street_is_meshed_as_finely_as_a_house_of_it(monkeypatch):
    street, house = (Box(np.eye(3), np.array([-2.0, -1, -1]), np.array([end, 1.0, 1])) for end in (58.0, 6.0))
    views = [view_of_street(x) for x in np.arange(0, 57, 1.0)]
    part = fuse(views, house)
    tiles = counted_tiles(monkeypatch, most=400)
    whole = fuse(views, street)
    assert len(tiles) > 2
    assert whole.metadata["voxel"] == pytest.approx(part.metadata["voxel"])
    errors = [np.abs(mesh.vertices[:, 2] - 0.1 * np.sin(mesh.vertices[:, 0])) for mesh in (whole, part)]
    assert np.quantile(errors[0], 0.95) == pytest.approx(np.quantile(errors[1], 0.95), rel=0.2)
    assert np.quantile(errors[0], 0.95) < 0.02
    here = whole.vertices[whole.vertices[:, 0] < 5]
    assert KDTree(here).query(part.vertices[part.vertices[:, 0] < 4.9])[0].max() < 1e-5


def test_views_of_a_sphere_fuse_to_a_sphere(sphere):
    radius = np.linalg.norm(sphere.vertices, axis=1)
    assert abs(np.median(radius) - 1.5) < 0.01
    assert np.quantile(np.abs(radius - 1.5), 0.95) < 0.05
    # A camera 5 away sees the cap more than 1.5²/5 from the centre; the cameras on the arc together see more.
    assert 0.3 < sphere.area / (4 * np.pi * 1.5**2) < 0.7


def test_the_mesh_has_the_colour_of_the_images(sphere):
    colours = np.asarray(sphere.visual.vertex_colors)[:, :3]
    np.testing.assert_allclose(np.median(colours, axis=0), [255, 128, 0], atol=1)


def test_the_mesh_ends_at_the_box():
    box = Box(np.eye(3), np.array([-3.0, 0.2, -3.0]), np.full(3, 3.0))
    half = fuse([view_of_sphere(camera_at(angle)) for angle in (-0.1, 0.0, 0.1)], box, 0.05)
    assert 0.2 <= half.vertices[:, 1].min() < 0.3
    assert half.vertices[:, 1].max() > 1


def test_a_voxel_is_a_pixel_on_the_surface_by_default():
    mesh = fuse([view_of_sphere(camera_at(angle)) for angle in (-0.1, 0.0, 0.1)], ROOM)
    # 80 pixels of focal length; the sphere is 3.5 to 4.8 away.
    assert 3.5 / 80 < mesh.metadata["voxel"] < 4.8 / 80


def test_the_same_views_fuse_to_the_same_mesh_to_the_last_bit(sphere):
    again = fuse((view_of_sphere(camera_at(angle)) for angle in np.linspace(-0.6, 0.6, 7)), ROOM, 0.05)
    assert again.export(file_type="ply") == sphere.export(file_type="ply")


def test_views_that_see_nothing_of_the_box_are_refused():
    empty = view_of_sphere(camera_at(0.0))._replace(depth=torch.zeros(64, 96, 1))
    with pytest.raises(SceneError, match="no view renders an opaque surface"):
        fuse([empty, empty], ROOM)


def test_views_without_a_common_surface_are_refused():
    with pytest.raises(SceneError, match="no surface in common"):
        fuse([view_of_sphere(camera_at(0.0), 1.0), view_of_sphere(camera_at(np.pi), 1.0)], ROOM, 0.02)


def test_decimation_keeps_the_surface_and_its_colours(sphere):
    small = decimated_mesh(sphere, 2000)
    assert len(small.faces) <= 2000 < len(sphere.faces)
    assert abs(np.median(np.linalg.norm(small.vertices, axis=1)) - 1.5) < 0.02
    np.testing.assert_allclose(np.median(small.visual.vertex_colors[:, :3], axis=0), [255, 128, 0], atol=2)  # pyright: ignore
    assert small.metadata == sphere.metadata


def test_a_mesh_without_triangles_and_voxels_of_negative_size_are_refused(sphere):
    with pytest.raises(SceneError, match="nothing is left"):
        decimated_mesh(sphere, 0)
    with pytest.raises(SceneError, match="a voxel cannot be -1"):
        fuse([], ROOM, -1)


def test_a_box_has_the_size_of_a_turned_cuboid():
    corners = np.stack(np.meshgrid([0, 18.0], [0, 10.0], [0, 1.0]), -1).reshape(-1, 3)
    turned = corners @ Rotation.from_euler("zyx", [31, 12, -50], degrees=True).as_matrix().T + [5, 6, 7]
    box = Box.around(turned, 0.5)
    np.testing.assert_allclose(np.sort(box.high - box.low), [2, 11, 19])
    assert box.contains(turned).all()
    assert not box.contains(turned.mean(axis=0) + 10 * (turned[0] - turned[-1])).any()


def test_a_camera_in_the_frame_has_the_same_view_with_depth_in_metres():
    """A shell in millimetres, in a scene whose unit is 2.5 metres."""
    rotation = Rotation.from_euler("xyz", [20, -40, 70], degrees=True).as_matrix()
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = 0.0004 * rotation, [3, -1, 2]
    vertices = np.array([[7e6, 2e6, 1e4], [7.01e6, 2e6, 1e4], [7e6, 2.01e6, 2e4]])
    alignment = Alignment(matrix, ("shell.ply",), metres_per_shell_unit=0.001)
    frame = shell_frame(alignment, ShellMesh(vertices, np.array([[0, 1, 2]])))
    np.testing.assert_array_equal(frame.offset, [7000, 2000, 0])

    camera = Camera(torch.from_numpy(np.linalg.inv(matrix)), K, 96, 64)  # any rigid pose does
    camera.viewmat[:3, :3] *= 0.0004
    camera.viewmat[:3, 3] *= 0.0004
    in_scene = transformed(alignment.apply(vertices), camera.viewmat.numpy())
    in_metres = transformed(vertices * 0.001 - frame.offset, frame.camera(camera).viewmat.numpy())
    np.testing.assert_allclose(in_metres, 2.5 * in_scene, atol=1e-6)


def test_a_shell_near_its_origin_is_not_shifted():
    mesh = ShellMesh(np.array([[0.0, 0, 0], [30, 0, 0], [0, 0, 20]]), np.array([[0, 1, 2]]))
    frame = shell_frame(Alignment(np.diag([2.0, 2, 2, 1]), ("shell.obj",)), mesh)
    np.testing.assert_array_equal(frame.offset, 0)


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".glb"])
def test_a_mesh_file_is_read_back_unchanged(sphere, tmp_path, suffix):
    write_mesh(tmp_path / f"mesh{suffix}", sphere, FRAME)
    read = load_shell(tmp_path / f"mesh{suffix}")
    # glTF is y-up: z of the survey becomes y, and y, which is into the page of a map, becomes -z.
    turn = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]) if suffix == ".glb" else np.eye(3)
    np.testing.assert_allclose(read.vertices, sphere.vertices @ turn.T, atol=1e-6)
    np.testing.assert_array_equal(read.faces, sphere.faces)
    about = json.loads((tmp_path / f"mesh{suffix}.json").read_text())
    assert about["offset"] == [400_000, 5_000_000, 0]
    assert about["crs"] == "EPSG:25832"
    assert (about["unit"], about["up"], about["faces"]) == ("metre", "z", len(sphere.faces))
    assert about["up_in_file"] == ("y" if suffix == ".glb" else "z")


@pytest.mark.parametrize("suffix", [".usd", ".usda"])
def test_usd_is_a_static_collider_of_the_triangles_in_metres(sphere, tmp_path, suffix):
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom, UsdPhysics  # pyright: ignore[reportMissingImports]

    write_mesh(tmp_path / f"mesh{suffix}", sphere, FRAME)
    stage = Usd.Stage.Open(str(tmp_path / f"mesh{suffix}"))  # pyright: ignore
    prim = stage.GetDefaultPrim()
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1  # pyright: ignore
    assert UsdGeom.GetStageUpAxis(stage) == "Z"  # pyright: ignore
    assert prim.HasAPI(UsdPhysics.CollisionAPI)  # pyright: ignore
    assert not prim.HasAPI(UsdPhysics.RigidBodyAPI)  # pyright: ignore
    assert UsdPhysics.MeshCollisionAPI(prim).GetApproximationAttr().Get() == "none"  # pyright: ignore
    points = np.array(UsdGeom.Mesh(prim).GetPointsAttr().Get())  # pyright: ignore
    np.testing.assert_allclose(points, sphere.vertices, atol=1e-6)
    assert len(list(tmp_path.iterdir())) == 2


def test_colours_of_gltf_and_usd_are_linear_light_and_not_metal(sphere, tmp_path):
    """Viewers show sRGB in their place washed out, and the material of glTF's default black."""
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom  # pyright: ignore[reportMissingImports]

    mesh, grey = sphere.copy(), np.linspace(0, 255, len(sphere.vertices)).round()
    mesh.visual.vertex_colors = np.stack([grey, grey, grey, np.full_like(grey, 255)], axis=1).astype(np.uint8)
    for suffix in (".glb", ".usda"):
        write_mesh(tmp_path / f"mesh{suffix}", mesh, FRAME)
    light = np.where(grey <= 10, grey / 255 / 12.92, ((grey / 255 + 0.055) / 1.055) ** 2.4)  # IEC 61966-2-1

    document, attributes = glb_attributes(tmp_path / "mesh.glb")
    np.testing.assert_allclose(attributes["COLOR_0"], np.stack([light] * 3, axis=1), atol=1e-6)
    assert document["materials"][document["meshes"][0]["primitives"][0]["material"]]["pbrMetallicRoughness"] == {
        "metallicFactor": 0.0,
        "roughnessFactor": 1.0,
    }
    stage = Usd.Stage.Open(str(tmp_path / "mesh.usda"))  # pyright: ignore
    colours = UsdGeom.Mesh(stage.GetDefaultPrim()).GetDisplayColorAttr().Get()  # pyright: ignore
    np.testing.assert_allclose(colours, np.stack([light] * 3, axis=1), atol=1e-6)


@pytest.mark.parametrize("suffix", [".usda", ".glb"])
def test_a_mesh_of_unknown_unit_is_in_metres_where_its_format_states_one_and_says_so(sphere, tmp_path, suffix):
    """USD that states none is read in centimetres; glTF is in metres by its specification."""
    write_mesh(tmp_path / f"mesh{suffix}", sphere, scene_frame())
    about = json.loads((tmp_path / f"mesh{suffix}.json").read_text())
    assert (about["unit"], about["unit_in_file"]) == ("unknown", "metre")
    if suffix == ".usda":
        header = (tmp_path / "mesh.usda").read_text().split("def Mesh")[0]
        assert "metersPerUnit = 1\n" in header
        assert "The unit is unknown" in header


@pytest.fixture(scope="module")
def run(pristine_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> TrainedRun:
    """A run that renders the true building instead of its Gaussians."""
    trainer = trainer_of(pristine_scene, tmp_path_factory.mktemp("run"), iterations=1)
    model, outputs = model_of(trainer), data_of(trainer).train_dataparser_outputs
    rescaled = np.eye(4)
    rescaled[:3] = outputs.dataparser_scale * outputs.dataparser_transform.double().numpy()
    truth = building(Layout(6, 3))
    caster = ShellCaster(ShellMesh(truth.vertices, truth.triangles.astype(np.int64)), rescaled @ SCENE_FROM_BUILDING)

    def render(camera):
        cue = caster.cast(pinhole_camera(camera))
        seen = torch.from_numpy(cue.mask)[..., None].float()
        return {"depth": torch.from_numpy(cue.depth)[..., None], "accumulation": seen, "rgb": seen.expand(-1, -1, 3)}

    model.get_outputs_for_camera = render  # pyright: ignore[reportAttributeAccessIssue]
    return TrainedRun(model, data_of(trainer))


@pytest.fixture(scope="module")
def facade(run: TrainedRun) -> trimesh.Trimesh:
    return fuse(run.views(), run.box(0.5), 0.1)


def test_the_mesh_of_a_run_is_the_building_in_metres_in_the_shells_frame(run, facade):
    """The building is 18.8 m long and its wall the plane y = 0 of its own frame; photographs have 0.2 m pixels."""
    place = transformed(facade.vertices + run.frame.offset, np.linalg.inv(SHELL_FROM_BUILDING))
    left, right = np.quantile(place[:, 0], [0.001, 0.999])
    assert right - left == pytest.approx(18.8, abs=0.6)
    on_wall = place[np.abs(place[:, 1]) < 0.07]
    assert len(on_wall) > 0.3 * len(place)
    assert abs(on_wall[:, 1].mean()) < 0.01


def test_the_mesh_of_the_true_building_is_near_the_truth_and_the_shell(run, facade):
    metrics = mesh_errors(run, facade)
    assert metrics["truth_chamfer_m"] < 0.15  # of pixels of 0.2
    assert metrics["truth_f_score_20cm"] > 0.8
    assert metrics["truth_rendered"] > 0.8
    assert metrics["chamfer_m"] < 0.2
    assert metrics["area_near_shell"] > 0.8
    flap = np.add(facade.vertices, [0, 0, 30])
    faces = np.concatenate([facade.faces, facade.faces + len(flap)])
    both = trimesh.Trimesh(np.concatenate([facade.vertices, flap]), faces, process=False)
    assert mesh_errors(run, both)["area_near_shell"] == pytest.approx(metrics["area_near_shell"] / 2, abs=1e-3)


def test_surfaces_far_from_the_shell_are_not_part_of_the_facade(run, facade):
    lifted = trimesh.Trimesh(np.add(facade.vertices, [0, 0, 30]), facade.faces, process=False)
    both = trimesh.util.concatenate([facade, lifted])
    kept = run.facade(both, 0.5)
    assert len(kept.faces) == len(run.facade(facade, 0.5).faces) > 0.9 * len(facade.faces)
    np.testing.assert_array_equal(kept.bounds, kept.bounds.clip(*facade.bounds))
    with pytest.raises(SceneError, match=r"within 0\.5 m of the shell"):
        run.facade(lifted, 0.5)


def test_the_resolution_is_a_pixel_on_the_facade_in_the_nearest_view(run):
    pixels = [
        np.median(view.depth[view.depth > 0]) / view.camera.K[0, 0].item() for view in run.views() if view.depth.any()
    ]
    assert run.resolution(run.box(0.5)) == pytest.approx(min(pixels), rel=0.2)


def test_voxels_finer_than_half_of_what_the_photographs_resolve_are_refused(run):
    resolved = run.resolution(run.box(0.5))
    with pytest.raises(SceneError, match=rf"finer than the photographs resolve, whose pixels are {resolved:.2g} m"):
        run.surface(0.5, 0.49 * resolved)
    assert len(run.surface(0.5, 0.55 * resolved, list(run.views())[:4]).faces) > 1000


def test_simulations_refuse_such_voxels_too(run):
    with pytest.raises(SceneError, match="finer than the photographs resolve"):
        Reconstruction.of(run, 1000, 0.003, None, None)


def test_a_scene_without_alignment_is_meshed_in_its_own_frame(run, pristine_scene, monkeypatch):
    alone = TrainedRun(run.model, run.datamanager)
    monkeypatch.setitem(vars(alone), "shell", None)
    assert not alone.frame.metric
    box = alone.box(0.5)
    points = transformed(load_shell(pristine_scene / "shell/facade.ply").vertices, SCENE_FROM_BUILDING)
    assert box.size < 3 * np.ptp(points, axis=0).max()
    mesh = fuse(alone.views(), box)
    assert mesh_errors(alone, mesh)["truth_chamfer_units"] < 0.1


def test_a_trained_run_becomes_a_mesh_with_metrics_where_its_maps_and_their_unit_are_known(scene, tmp_path, capsys):
    trainer = trainer_of(scene, tmp_path, iterations=5)
    trainer.train()
    trainer.config.save_config()
    config = trainer.base_dir / "config.yml"
    cli.mesh(config, tmp_path / "facade.obj", voxel=0.3, faces=500)
    assert "The mesh in the held-out views" in capsys.readouterr().out
    about = json.loads((tmp_path / "facade.obj.json").read_text())
    assert about["faces"] <= 500
    assert {"chamfer_m", "f_score_5cm", "truth_chamfer_m"} <= about.keys()
    assert len(load_shell(tmp_path / "facade.obj").faces) == about["faces"]
    (tmp_path / "link.ply").symlink_to(scene / "shell/facade.ply")
    for write, path in ((cli.mesh, scene / "shell/facade.ply"), (cli.splats, tmp_path / "link.ply")):
        with pytest.raises(SceneError, match=f"{path} is a file of the shell"):
            write(config, path)
    shutil.copytree(scene / "cues/shell", scene / "cues/checked")
    with edited(scene / ALIGNMENT) as alignment:
        alignment["shell_to_scene"][0][3] += 0.1
    loaded = TrainedRun.load(config)
    for work in (lambda: cli.mesh(config), lambda: Reconstruction.of(loaded, 500, None, None, None)):
        with pytest.raises(SceneError, match="has changed since; run `shellgs cast"):
            work()
    assert "Rendering view" not in capsys.readouterr().out  # refused before
    (scene / ALIGNMENT).unlink()
    cli.mesh(config, voxel=0.05, faces=500)
    told = capsys.readouterr().out
    assert "in units of unknown size" in " ".join(told.split())
    assert "The mesh in the held-out views" not in told


@pytest.mark.parametrize(
    ("config", "output", "sentence"),
    [
        ("nowhere/config.yml", "mesh.ply", "config.yml of a trained run"),
        ("config.yml", "mesh.fbx", "can be written as"),
    ],
)
def test_a_mistake_is_refused_before_anything_is_loaded(tmp_path, config, output, sentence):
    with pytest.raises((SceneError, FileNotFoundError), match=sentence):
        cli.mesh(tmp_path / config, tmp_path / output)


def test_the_scene_frame_is_not_metric():
    assert not scene_frame().metric
