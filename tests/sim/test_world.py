"""Worlds for simulators as MJCF, URDF, SDF and USD, and the command that writes them."""

from __future__ import annotations

import json
import shutil
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
import yourdfpy
from PIL import Image
from scenes import cast
from training_runs import trainer_of

from dataparsers.facade import FacadeDataParserConfig, read_views
from shellgs_method import cli
from shellgs_method.errors import SceneError
from shellgs_method.export.runs import TrainedRun
from shellgs_method.export.splats import Splats
from shellgs_method.files.usd import import_pxr
from shellgs_method.geometry.axes import turn
from shellgs_method.geometry.similarity import transformed
from shellgs_method.geometry.surface_classes import SurfaceClass
from shellgs_method.geometry.triangles import Triangles
from shellgs_method.geometry.winding import outward
from shellgs_method.shell import Alignment, load_shell
from shellgs_method.sim.building import Reconstruction
from shellgs_method.sim.collision.collider import Collider, make_collider
from shellgs_method.sim.collision.parts import Part
from shellgs_method.sim.formats.usd import compliance_errors, write_usd_layers, write_usd_world
from shellgs_method.sim.formats.world import Building, write_parts, write_worlds
from shellgs_method.sim.front import Front, places_before
from shellgs_method.sim.look.renders import rendered
from shellgs_method.sim.look.texture import TexturedMesh
from shellgs_method.sim.look.visual import write_visual
from shellgs_method.sim.settings import SimSettings
from shellgs_method.sim.simulate import simulate
from shellgs_method.sim.trials.engine import beams, compiled, import_mujoco, lidar, load, warnings_kept
from shellgs_method.sim.trials.trials import throw, walk
from shellgs_method.synthetic.building import Layout, shell
from shellgs_method.synthetic.frames import SCENE_FROM_BUILDING, SHELL_FROM_BUILDING
from shellgs_method.synthetic.path import walk as stroll

LAYOUT = Layout(bays=2, storeys=1)


@pytest.fixture(scope="module")
def eyes() -> np.ndarray:
    return np.stack([camera.position.numpy() for camera in stroll(LAYOUT.length, 8, 64, 48, np.random.default_rng(0))])


@pytest.fixture(scope="module")
def collider(eyes) -> Collider:
    mesh = shell(LAYOUT)
    facade, _ = outward(Triangles(mesh.vertices, mesh.triangles), eyes)
    return make_collider(facade, facade, np.zeros(len(facade.faces), bool))


def painted(surface: Triangles) -> TexturedMesh:
    """The surface in four colours, by position."""
    uv = (surface.vertices[:, [0, 2]] - surface.vertices[:, [0, 2]].min(0)) / np.ptp(
        surface.vertices[:, [0, 2]], axis=0
    )
    colours = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 0]]], np.uint8)
    image = Image.fromarray(colours).resize((64, 64), Image.Resampling.NEAREST)
    return TexturedMesh(surface.vertices, surface.faces, uv, image, 1.0)


def some_splats(count: int = 5) -> Splats:
    generator = torch.Generator().manual_seed(0)
    shapes = ((3,), (4,), (3,), (1,), (16, 3))
    return Splats(*(torch.randn(count, *shape, generator=generator) for shape in shapes))


def write_building(folder: Path, collider: Collider, name: str = "facade", place: str = "", metric=True) -> Building:
    (folder / place).mkdir(parents=True, exist_ok=True)
    write_parts(folder / place, collider.parts)
    look = painted(collider.surface)
    write_visual(folder / place, look, 30)
    classes = np.where(look.vertices[look.faces].mean(axis=1)[:, 2] > 3, SurfaceClass.WALL, SurfaceClass.DOOR)
    write_usd_layers(folder / place, look, classes.astype(np.uint8), collider.parts, some_splats(), metric)
    return Building(name, place, len(collider.parts))


@pytest.fixture(scope="module")
def world(collider, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("world")
    building = write_building(folder, collider)
    write_worlds(folder, [building])
    write_usd_world(folder / "facade.usda", [building], metric=True, with_splats=True)
    return folder


def test_mujoco_loads_the_world_without_a_warning(world, collider):
    model = load(world / "facade.xml")
    assert model.ngeom == len(collider.parts) + 2  # and the ground, and the visual mesh
    assert model.ntex == 1


def test_a_world_that_mujoco_refuses_is_reported_in_one_sentence(world, tmp_path):
    shutil.copytree(world, tmp_path / "world")
    (tmp_path / "world" / "collision" / "part_000.obj").write_text("v 0 0 0\n")
    with pytest.raises(SceneError, match="MuJoCo refuses it"):
        load(tmp_path / "world" / "facade.xml")


def test_warnings_of_a_simulation_are_still_kept_after_compiling_a_model(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    mujoco = import_mujoco()
    spec = mujoco.MjSpec.from_string(
        "<mujoco><worldbody><body><freejoint/><geom size='1'/></body></worldbody></mujoco>"
    )
    with warnings_kept() as warnings:
        model = compiled(spec, tmp_path)
        data = mujoco.MjData(model)
        data.qvel[0] = np.nan
        mujoco.mj_step(model, data)
    assert len(warnings) == 1
    assert "QVEL" in warnings[0]
    assert not list(tmp_path.iterdir())


def test_no_thrown_body_gets_through_sticks_or_gains_energy(world, collider, eyes):
    with warnings_kept() as warnings:
        thrown = throw(world / "facade.xml", collider.surface, eyes, count=60, seconds=2.5)
    assert not warnings
    assert thrown.hits > 50
    assert (thrown.through, thrown.stuck, thrown.gained) == (0, 0, 0)
    assert thrown.deepest < 0.05


def test_throwing_finds_a_hole_in_the_wall(collider, eyes, tmp_path):
    """Parts are missing from the model, but not from the surface that must not be crossed."""
    holed = [part for part in collider.parts if np.ptp(part.vertices, axis=0).max() < 2]
    write_worlds(tmp_path, [write_building(tmp_path, Collider(holed, 0.0))])
    assert throw(tmp_path / "facade.xml", collider.surface, eyes, count=30, seconds=1).through > 3


def test_a_lidar_in_mujoco_agrees_with_ray_casting(world, collider, eyes):
    surface = collider.surface
    places, rays = places_before(surface, Front.of(surface, eyes), count=3), beams(6, 40)
    measured = lidar(world / "facade.xml", places, rays, group=3)
    exact = surface.cast(np.repeat(places, len(rays), axis=0), np.tile(rays, (3, 1))).t.reshape(3, -1)
    with np.errstate(divide="ignore"):
        ground = np.where(rays[:, 2] < 0, places[:, 2:] / -rays[:, 2], np.inf)
    np.testing.assert_allclose(measured, np.minimum(exact, ground), atol=2e-3)
    assert np.isfinite(exact).mean() > 0.2


def test_the_facades_front_is_its_wall(collider, eyes):
    front = Front.of(collider.surface, eyes)
    np.testing.assert_allclose(front.outwards, [0, -1, 0], atol=0.02)
    assert front.length == pytest.approx(LAYOUT.length + 0.8, rel=0.1)


def test_a_capsule_walks_along_the_facade_and_touches_it(world, collider, eyes):
    front = Front.of(collider.surface, eyes)
    walked = walk(world / "facade.xml", collider.surface, front)
    assert walked.metres > 0.8 * front.length
    assert walked.touching > 0.02
    assert walked.deepest < 0.03


def test_mujoco_renders_what_a_camera_sees(world, collider):
    """Colours of the texture in the right places, seen by a camera whose principal point is off the middle."""
    camera = stroll(LAYOUT.length, 8, 96, 64, np.random.default_rng(0))[2]
    K = camera.K.clone()
    K[0, 2] += 9
    camera = type(camera)(camera.viewmat, K, 96, 64)
    try:
        (render,) = rendered(world / "facade.xml", [camera])
    except SceneError as error:
        pytest.skip(str(error))
    assert render.shape == (64, 96, 3)
    pose = np.linalg.inv(camera.viewmat.numpy())
    rays = camera.rays().numpy() @ pose[:3, :3].T
    surface, look = collider.surface, painted(collider.surface)
    origins = np.broadcast_to(pose[:3, 3], rays.shape)
    t, face, _ = surface.cast(origins, rays)
    hit = origins + np.where(np.isfinite(t), t, 0)[..., None] * rays
    weights = trimesh.triangles.points_to_barycentric(
        surface.vertices[surface.faces[face.ravel()]], hit.reshape(-1, 3)
    ).reshape(*face.shape, 3)
    uv = np.einsum("hwk,hwkc->hwc", weights, look.uv[surface.faces[face]])
    image = np.asarray(look.image)
    column, row = (np.nan_to_num(uv).clip(0, 0.999) * 64).astype(int).transpose(2, 0, 1)
    expected = image[63 - row, column].astype(int)
    alike = np.abs(render.astype(int) - expected).max(axis=-1) < 60
    assert (face >= 0).mean() > 0.3
    assert alike[face >= 0].mean() > 0.9


def files_named(tree: ET.Element) -> set[str]:
    named = {element.get(key) for element in tree.iter() for key in ("file", "filename")}
    return {name for name in named | {element.text for element in tree.iter("uri")} if name}


def test_all_worlds_refer_to_the_same_files_which_exist(world):
    named = {kind: files_named(ET.parse(world / f"facade.{kind}").getroot()) for kind in ("xml", "urdf", "sdf")}
    assert named["urdf"] == named["sdf"] == named["xml"] - {"visual.png"}
    assert all((world / name).is_file() for name in named["xml"])


def test_the_urdf_is_valid(world, collider):
    robot = yourdfpy.URDF.load(str(world / "facade.urdf"))
    assert robot.validate()
    assert len(robot.link_map["facade"].collisions) == len(collider.parts)


def test_the_sdf_is_a_static_world(world, collider):
    root = ET.parse(world / "facade.sdf").getroot()
    assert root.get("version") == "1.9"
    models = root.findall("world/model")
    assert [model.get("name") for model in models] == ["ground", "facade"]
    assert all(model.findtext("static") == "true" for model in models)
    assert len(models[1].findall("link/collision")) == len(collider.parts)


def test_usd_of_an_unknown_unit_states_the_metre_in_every_layer(collider, tmp_path):
    pxr = import_pxr("sim")
    building = write_building(tmp_path, collider, metric=False)
    write_usd_world(tmp_path / "facade.usda", [building], metric=False, with_splats=True)
    layers = [tmp_path / "facade.usda", *(tmp_path / "usd").iterdir()]
    assert len(layers) == 4
    for layer in layers:
        stage = pxr.Usd.Stage.Open(str(layer))
        assert stage.HasAuthoredMetadata("metersPerUnit")
        assert pxr.UsdGeom.GetStageMetersPerUnit(stage) == 1
        assert "unit is unknown" in stage.GetRootLayer().comment


@pytest.mark.parametrize("look", ["mesh", "splats"])
def test_the_usd_is_compliant(world, look):
    pxr = import_pxr("sim")
    stage = pxr.Usd.Stage.Open(str(world / "facade.usda"))
    assert pxr.UsdGeom.GetStageUpAxis(stage) == "Z"
    assert pxr.UsdGeom.GetStageMetersPerUnit(stage) == 1
    assert stage.GetPrimAtPath("/World/facade").GetVariantSet("look").SetVariantSelection(look)
    assert compliance_errors(stage) == []
    assert not [asset for asset in world.rglob(".*") if asset.is_file()]  # no leftovers


def test_the_compliance_checker_finds_faults(tmp_path):
    pxr = import_pxr("sim")
    stage = pxr.Usd.Stage.CreateNew(str(tmp_path / "bad.usda"))
    stage.DefinePrim("/a", "Mesh")
    stage.GetRootLayer().Save()
    assert compliance_errors(stage)


def test_the_usd_labels_each_triangle_once(world):
    stage = import_pxr("sim").Usd.Stage.Open(str(world / "usd" / "visual.usdc"))
    labels = {}
    for name in ("wall", "door"):
        subset = stage.GetPrimAtPath(f"/visual/mesh/{name}")
        assert list(subset.GetAttribute("semantics:labels:class").Get()) == [name]
        labels[name] = np.array(subset.GetAttribute("indices").Get())
    mesh = import_pxr("sim").UsdGeom.Mesh(stage.GetPrimAtPath("/visual/mesh"))
    faces = np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
    heights = np.array(mesh.GetPointsAttr().Get())[faces].mean(axis=1)[:, 2]
    np.testing.assert_array_equal(labels["wall"], np.flatnonzero(heights > 3))
    np.testing.assert_array_equal(labels["door"], np.flatnonzero(heights <= 3))


def test_usd_colliders_are_the_parts(world, collider):
    pxr = import_pxr("sim")
    stage = pxr.Usd.Stage.Open(str(world / "facade.usda"))
    prims = [prim for prim in stage.Traverse() if prim.HasAPI(pxr.UsdPhysics.MeshCollisionAPI)]
    assert len(prims) == len(collider.parts)
    for prim, part in zip(prims, collider.parts, strict=True):
        np.testing.assert_allclose(pxr.UsdGeom.Mesh(prim).GetPointsAttr().Get(), part.vertices, atol=1e-5)
        assert pxr.UsdPhysics.MeshCollisionAPI(prim).GetApproximationAttr().Get() == "convexHull"


def test_splats_in_usd_are_the_gaussians(world):
    pxr = import_pxr("sim")
    splats = some_splats()
    stage = pxr.Usd.Stage.Open(str(world / "usd" / "splats.usdc"))
    prim = stage.GetDefaultPrim()
    assert prim.GetTypeName() == "ParticleField3DGaussianSplat"
    np.testing.assert_allclose(prim.GetAttribute("positions").Get(), splats.means, atol=1e-6)
    np.testing.assert_allclose(prim.GetAttribute("scales").Get(), splats.scales.exp(), rtol=1e-5)
    np.testing.assert_allclose(prim.GetAttribute("opacities").Get(), splats.opacities.sigmoid()[:, 0], rtol=1e-5)
    unit = torch.nn.functional.normalize(splats.quats, dim=-1).numpy()
    turned = [[q.GetReal(), *q.GetImaginary()] for q in prim.GetAttribute("orientations").Get()]
    np.testing.assert_allclose(turned, unit, atol=1e-6)
    coefficients = np.array(prim.GetAttribute("radiance:sphericalHarmonicsCoefficients").Get())
    np.testing.assert_allclose(coefficients.reshape(5, 16, 3), splats.harmonics, atol=1e-6)
    assert prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get() == 3


def test_the_glb_is_upright_textured_and_small_enough(collider, tmp_path):
    noise = np.random.default_rng(0).integers(0, 255, (512, 512, 3), dtype=np.uint8)
    look = painted(collider.surface)
    look = TexturedMesh(look.vertices, look.faces, look.uv, Image.fromarray(noise), 1.0)
    facts = write_visual(tmp_path, look, megabytes=0.1)
    assert (tmp_path / "visual.glb").stat().st_size == facts["glb_bytes"] <= 1e5
    scene = trimesh.load_scene(tmp_path / "visual.glb")
    assert scene.extents[1] == pytest.approx(np.ptp(look.vertices[:, 2]), rel=1e-4)  # glTF is y-up
    (mesh,) = scene.geometry.values()
    assert list(mesh.visual.material.baseColorTexture.size) == facts["texture"]


def test_the_parts_of_an_earlier_collider_are_removed(collider, tmp_path):
    write_parts(tmp_path, collider.parts)
    write_parts(tmp_path, collider.parts[:2])
    assert len(list((tmp_path / "collision").iterdir())) == 2


def test_two_buildings_are_one_world(collider, tmp_path):
    away = Collider(
        [part for part in (Part.hull(p.vertices + np.array([20, 0, 0])) for p in collider.parts) if part], 0
    )
    buildings = [write_building(tmp_path, one, name, name) for one, name in ((collider, "left"), (away, "right"))]
    write_worlds(tmp_path, buildings)
    write_usd_world(tmp_path / "facade.usda", buildings, metric=True, with_splats=True)
    model = load(tmp_path / "facade.xml")
    assert {model.body(k).name for k in range(1, model.nbody)} == {"left", "right"}
    assert yourdfpy.URDF.load(str(tmp_path / "facade.urdf")).validate()
    assert all((tmp_path / name).is_file() for name in files_named(ET.parse(tmp_path / "facade.sdf").getroot()))


@pytest.fixture(scope="module")
def config(pristine_scene: Path, tmp_path_factory) -> Path:
    """A short run on the tiny scene."""
    trainer = trainer_of(pristine_scene, tmp_path_factory.mktemp("run"), "shellgs_metric", iterations=10)
    trainer.train()
    trainer.save_checkpoint(10)
    trainer.config.save_config()
    return trainer.base_dir / "config.yml"


@pytest.fixture
def quick(monkeypatch) -> None:
    """Fewer and shorter throws; the results of the full trial are tested above."""
    from shellgs_method.sim import report

    monkeypatch.setattr(report, "throw", lambda *args: throw(*args, count=8, seconds=0.5))


SMALL = SimSettings(faces=4000)


def test_the_command_writes_the_whole_folder(config, tmp_path, quick, capsys):
    out = tmp_path / "facade sim"
    cli.sim((config, out), SMALL)
    said = capsys.readouterr().out
    assert "convex parts" in said
    assert "8 spheres and boxes thrown" in said
    names = "facade.xml facade.urdf facade.sdf facade.usda visual.glb visual.obj visual.mtl visual.png splats.ply"
    for name in f"{names} frame.json metrics.json README.md report.html deviations.ply deviations.json".split():
        assert (out / name).stat().st_size > 0, name
    assert load(out / "facade.xml").ngeom > 20
    assert compliance_errors(out / "facade.usda") == []
    frame = json.loads((out / "frame.json").read_text())
    assert frame["up"] == "z"
    assert frame["offset"] == [row[3] for row in frame["to_national"][:3]]
    corner = Triangles(*joined_file(out)).vertices
    building = transformed(transformed(corner, np.array(frame["to_national"])), np.linalg.inv(SHELL_FROM_BUILDING))
    assert building[:, 0].min() > -1.5
    assert building[:, 0].max() < 19.5
    assert np.isfinite(json.loads((out / "metrics.json").read_text())["buildings"]["facade"]["walk"]["metres"])
    page = (out / "report.html").read_text()
    assert page.count("<img") >= 6
    assert "nan" not in page


@pytest.mark.parametrize("words", ["run.yml out --parts 8", "--parts 8 run.yml out", "run.yml other.yml out --voxel 1"])
def test_options_stand_before_the_runs_or_after_the_folder(words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["shellgs", "sim", *words.split()])
    with pytest.raises(SystemExit, match=r"^shellgs: run\.yml does not exist"):
        cli.main()


def joined_file(out: Path) -> tuple[np.ndarray, np.ndarray]:
    meshes = [trimesh.load_mesh(path) for path in sorted((out / "collision").glob("*.obj"))]
    mesh: Any = trimesh.util.concatenate(meshes)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


@pytest.mark.parametrize("up", [[0, 1, 0], [-1, 0, 0]])
def test_the_world_stands_whichever_axis_of_the_shell_is_up(scene, tmp_path, up):
    """From an obj, which does not say what is up in it."""
    upright = load_shell(scene / "shell" / "facade.ply")
    motion = np.eye(4)
    motion[:3, :3] = turn(np.array([0.0, 0, 1]), np.array(up, float))
    vertices = transformed(upright.vertices - upright.centre, motion)
    trimesh.Trimesh(vertices, upright.faces, process=False).export(scene / "shell" / "turned.obj", digits=9)
    motion[:3, 3] = -motion[:3, :3] @ upright.centre
    matrix = SCENE_FROM_BUILDING @ np.linalg.inv(motion @ SHELL_FROM_BUILDING)
    cast(scene, read_views(FacadeDataParserConfig(data=scene)), Alignment(matrix, ("shell/turned.obj",)))
    trainer = trainer_of(scene, tmp_path / "run", "shellgs_metric", iterations=2)
    trainer.train()
    trainer.save_checkpoint(2)
    trainer.config.save_config()
    built = Reconstruction.of(TrainedRun.load(trainer.base_dir / "config.yml"), SMALL.faces, None, None, None)
    assert built.shell is not None
    heights = built.shell.vertices[:, 2]
    assert np.ptp(heights) == pytest.approx(np.ptp(upright.vertices[:, 2]), abs=1e-3)
    assert heights.min() == pytest.approx(0, abs=0.05)
    assert built.eyes[:, 2].min() > 0.5


def test_a_run_without_a_shell_reports_its_frame(config, monkeypatch):
    monkeypatch.setattr(TrainedRun, "shell", None)
    built = Reconstruction.of(TrainedRun.load(config), SMALL.faces, None, None, None)
    said: list[str] = []
    built.warn_if_unaligned(said.append)
    assert "has no aligned shell: the frame is the scene's" in said[0]
    assert built.shell is None
    assert not built.frame.metric
    fused, seen = outward(Triangles(np.asarray(built.fused.vertices), np.asarray(built.fused.faces)), built.eyes)
    assert len(make_collider(None, fused, seen, density=5).parts) <= 20


def test_a_missing_config_or_folder_is_refused(tmp_path):
    for configs, out in (((), tmp_path), ((), tmp_path / "config.yml")):
        with pytest.raises(SceneError, match=r"give the config\.yml"):
            simulate(configs, out, SMALL)


def test_walls_far_apart_are_reported(collider):
    from shellgs_method.sim.simulate import _report_gaps

    away = [part for part in (Part.hull(p.vertices + np.array([30, 0, 0])) for p in collider.parts) if part]
    said: list[str] = []
    _report_gaps(Collider(collider.parts, 0.0), "street", said.append)
    assert not said
    _report_gaps(Collider([*collider.parts, *away], 0.0), "street", said.append)
    assert "2 pieces" in said[0]
