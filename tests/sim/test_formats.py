"""Assets and worlds in MJCF, URDF, SDF and USD, loaded by the programs that they are for."""

from __future__ import annotations

import ctypes.util
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
import yourdfpy
from PIL import Image
from worlds import (
    check_rays,
    compliance_errors,
    frame_at,
    load,
    painted,
    some_splats,
    uneven,
    write_building,
    write_folder,
)

from benchmarks.engines import newton_lidar, newton_model
from benchmarks.lidar import lidar
from shellgs_method.errors import SceneError
from shellgs_method.files.usd import import_pxr
from shellgs_method.geometry.surface_classes import SurfaceClass
from shellgs_method.sim.collision.collider import Collider
from shellgs_method.sim.collision.parts import Part
from shellgs_method.sim.formats.asset import FRICTION
from shellgs_method.sim.formats.mjcf import STIFF
from shellgs_method.sim.formats.world import write_world
from shellgs_method.sim.front import Front
from shellgs_method.sim.look.texture import TexturedMesh
from shellgs_method.sim.look.visual import visual_file, without_specks, write_visual
from shellgs_method.sim.trials.engine import compiled, import_mujoco, read_spec

ROBOT = """
<mujoco model="robot">
  <compiler angle="radian" meshdir="assets"/>
  <default>
    <default class="robot">
      <default class="visual"><geom type="mesh" group="2" contype="0" conaffinity="0"/></default>
      <default class="collision"><geom group="3" rgba="1 0 0 1"/>
        <default class="foot">
          <geom type="sphere" size="0.05" solref="0.03 0.9" friction="0.4 0.02 0.01" condim="6"/>
        </default>
      </default>
    </default>
  </default>
  <asset><material name="metal" rgba="0.9 0.9 0.9 1"/><mesh name="visual" file="leg.obj"/></asset>
  <worldbody>
    <body name="base" childclass="robot" pos="0 0 0.049"><freejoint/>
      <geom class="visual" mesh="visual" material="metal"/><geom name="foot" class="foot"/>
    </body>
  </worldbody>
</mujoco>
"""
"""A robot with the classes of MuJoCo Menagerie's, whose foot touches the ground."""


@pytest.fixture
def robot(tmp_path) -> Path:
    """The robot in a folder of its own, with meshes in another below."""
    (tmp_path / "robot" / "assets").mkdir(parents=True)
    trimesh.creation.box([0.1, 0.1, 0.1]).export(tmp_path / "robot" / "assets" / "leg.obj")
    (tmp_path / "robot" / "robot.xml").write_text(ROBOT)
    return tmp_path / "robot" / "robot.xml"


def test_mujoco_loads_asset_and_world_without_a_warning(world, collider):
    asset, model = load(world / "facade" / "facade.xml"), load(world / "world.xml")
    assert asset.ngeom == len(collider.parts) + 2  # and a visual mesh of each class
    assert (asset.nlight, asset.nq, asset.nu) == (0, 0, 0)
    assert model.ngeom == asset.ngeom + 1
    assert model.ntex == 1


def test_a_world_that_mujoco_refuses_is_reported_in_one_sentence(world, tmp_path):
    shutil.copytree(world, tmp_path / "world")
    (tmp_path / "world" / "facade" / "collision" / "part_000.obj").write_text("v 0 0 0\n")
    with pytest.raises(SceneError, match="MuJoCo refuses it"):
        load(tmp_path / "world" / "world.xml")


@pytest.mark.parametrize("how", ["attach", "include"])
def test_an_asset_stands_beside_a_robot_of_another_folder_with_its_own_classes(world, collider, robot, how):
    file = world / "facade" / "facade.xml"
    relative = f"{'../' * len(robot.parent.parts[1:])}{file.relative_to('/')}"
    attached = (
        f'<asset><model name="facade" file="{relative}"/></asset>'
        '<worldbody><attach model="facade" prefix="facade/"/></worldbody>'
    )
    scene = robot.parent / "scene.xml"
    beside = attached if how == "attach" else f'<include file="{relative}"/>'
    scene.write_text(f'<mujoco><include file="robot.xml"/>{beside}</mujoco>')
    model, alone = load(scene), load(robot)
    assert model.ngeom == alone.ngeom + len(collider.parts) + 2
    foot, own = model.geom("foot"), alone.geom("foot")
    for name in ("solref", "friction", "condim", "group", "contype", "rgba", "priority"):
        np.testing.assert_array_equal(getattr(foot, name), getattr(own, name))
    prefix = "facade/" if how == "attach" else ""
    part = model.geom(f"{prefix}facade_000")
    assert (part.group[0], part.contype[0]) == (3, 1)
    look = model.geom(f"{prefix}facade_visual_wall")
    assert (look.group[0], look.contype[0], look.matid[0] >= 0) == (2, 0, True)


def test_a_robots_foot_decides_about_its_contact_with_the_ground_and_a_wall_about_those_with_it(
    world, collider, eyes, robot
):
    mujoco, spec = import_mujoco(), read_spec(world / "world.xml")
    spec.attach(read_spec(robot), prefix="robot/", frame=spec.worldbody.add_frame(pos=[0, -5, 0]))
    ball = spec.worldbody.add_body(pos=Front.of(collider.surface, eyes).before(collider.surface, 0.5, 0.09, 0.5))
    ball.add_freejoint()
    ball.add_geom(name="ball", size=[0.1, 0, 0])
    model = compiled(spec, world)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    of = {name: [c for c in data.contact if model.geom(name).id in c.geom] for name in ("robot/foot", "ball")}
    (standing,) = of["robot/foot"]
    assert {model.geom(k).name for k in standing.geom} == {"robot/foot", "ground"}
    np.testing.assert_allclose(standing.solref, [0.03, 0.9])
    np.testing.assert_allclose(standing.friction, [0.4, 0.4, 0.02, 0.01, 0.01])
    assert standing.dim == 6
    assert of["ball"]
    assert all(contact.solref[0] == pytest.approx(STIFF, rel=0.05) for contact in of["ball"])


def test_a_lidar_in_mujoco_agrees_with_ray_casting(street, collider, lidar_rays):
    (world, ground), (origins, rays) = street, lidar_rays
    measured = lidar(world / "world.xml", origins[::240], rays[:240], group=3).ravel()
    check_rays(measured, collider.surface, ground, origins, rays)


def test_a_lidar_in_pybullet_agrees_with_ray_casting(street, collider, lidar_rays):
    bullet = pytest.importorskip("pybullet", reason="it has no wheel for this Python")
    (world, ground), (origins, rays) = street, lidar_rays
    client = bullet.connect(bullet.DIRECT)
    try:
        body = bullet.loadURDF(str(world / "world.urdf"), useFixedBase=True)
        links = [bullet.getCollisionShapeData(body, link) for link in range(bullet.getNumJoints(body))]
        assert sorted(map(len, links)) == [1, len(collider.parts)]
        assert {bullet.getDynamicsInfo(body, link)[1] for link in range(len(links))} == {FRICTION}
        hits = bullet.rayTestBatch(origins.tolist(), (origins + 90 * rays).tolist())
        bullet.resetSimulation()
        alone = bullet.loadURDF(str(world / "facade" / "facade.urdf"), useFixedBase=True)
        assert [len(bullet.getCollisionShapeData(alone, 0))] == [len(collider.parts)]
    finally:
        bullet.disconnect(client)
    share = np.array([hit[2] for hit in hits])
    check_rays(np.where(share < 1, 90 * share, np.inf), collider.surface, ground, origins, rays)


@pytest.mark.slow
def test_a_lidar_in_newton_agrees_with_ray_casting(street, collider, lidar_rays):
    """From the USD; ``pip install newton newton-usd-schemas``, and a minute the first time, for its kernels."""
    newton = pytest.importorskip("newton")
    (world, ground), (origins, rays) = street, lidar_rays
    model = newton_model(world / "world.usda")
    kinds = model.shape_type.numpy().tolist()
    assert kinds.count(newton.GeoType.CONVEX_MESH) == len(kinds) - 1 == len(collider.parts)
    np.testing.assert_allclose(model.shape_material_mu.numpy(), FRICTION)
    check_rays(newton_lidar(model, origins, rays), collider.surface, ground, origins, rays)


def files_named(path: Path) -> set[Path]:
    """The files that an XML file refers to."""
    tree = ET.parse(path).getroot()
    named = {element.get(key) for element in tree.iter() for key in ("file", "filename")}
    named |= {element.text for element in tree.iter("uri")}
    packages = {f"{start}facade/": f"{path.parent.parent}/facade/" for start in ("package://", "model://")}
    found = set()
    for name in filter(None, named):
        for start, folder in packages.items():
            name = name.replace(start, folder)
        found.add((path.parent / name).resolve())
    return found


def test_all_formats_refer_to_the_same_files_which_exist(world):
    named = {name: files_named(world / "facade" / name) for name in ("facade.xml", "facade.urdf", "model.sdf")}
    texture = world.resolve() / "facade" / "facade.png"
    plugins = {each for each in named["model.sdf"] if "gz-sim" in each.name}
    assert named["facade.urdf"] == named["model.sdf"] - plugins == named["facade.xml"] - {texture}
    assert all(file.is_file() for file in named["facade.xml"])


def test_the_urdf_is_valid(world, collider):
    alone, whole = (yourdfpy.URDF.load(str(world / name)) for name in ("facade/facade.urdf", "world.urdf"))
    assert alone.validate()
    assert whole.validate()
    assert len(alone.link_map["facade"].collisions) == len(collider.parts)
    assert {*whole.link_map} - {*alone.link_map} == {"ground"}
    assert len(alone.scene.geometry) == 2  # the visual meshes of two classes, found by their package
    assert len(whole.scene.geometry) == 3


@pytest.mark.skipif(not shutil.which("check_urdf"), reason="needs liburdfdom-tools")
@pytest.mark.parametrize("name", ["world.urdf", "facade/facade.urdf"])
def test_the_parser_of_ros_takes_the_urdf(world, name):
    subprocess.run(["check_urdf", world / name], check=True, capture_output=True)


SDFORMAT = next(filter(None, (ctypes.util.find_library(f"sdformat{version}") for version in range(12, 20))), None)


def sdformat(command: str, path: Path) -> str:
    """What libsdformat, the parser of Gazebo, writes; a process of its own, since it writes to stdout itself."""
    code = "import ctypes, sys; sys.exit(ctypes.CDLL(sys.argv[1])[sys.argv[2]](sys.argv[3].encode()))"
    models = {"SDF_PATH": str(path.parent), "GZ_SIM_RESOURCE_PATH": str(path.parent)}
    done = subprocess.run(
        [sys.executable, "-c", code, str(SDFORMAT), command, path], env=models, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert "Error" not in done.stdout + done.stderr
    return done.stdout


@pytest.mark.skipif(SDFORMAT is None, reason="needs libsdformat")
@pytest.mark.parametrize("name", ["world.sdf", "facade/model.sdf"])
def test_gazebos_parser_takes_the_sdf(world, name):
    assert "Valid" in sdformat("cmdCheck", world / name)


@pytest.mark.skipif(SDFORMAT is None, reason="needs libsdformat")
def test_gazebos_parser_keeps_all_of_the_urdf(world, collider):
    kept = ET.fromstring(sdformat("cmdPrint", world / "world.urdf"))
    assert len(kept.findall(".//collision")) == len(collider.parts) + 1
    assert len(kept.findall(".//visual")) == 3  # two classes, and the ground
    assert {joint.findtext("parent") for joint in kept.iter("joint")} == {"world"}


def test_the_sdf_is_a_static_model_of_convex_parts_in_a_world_with_sensors(world, collider):
    model = ET.parse(world / "facade" / "model.sdf").getroot().find("model")
    assert model is not None
    assert model.findtext("static") == "true"
    meshes = model.findall("link/collision/geometry/mesh")
    assert [mesh.get("optimization") for mesh in meshes] == ["convex_hull"] * len(collider.parts)
    assert [label.text for label in model.iter("label")] == ["1", "3"]  # SurfaceClass
    site = ET.parse(world / "world.sdf").getroot().find("world")
    assert site is not None
    assert [each.get("name") for each in site.findall("model")] == ["ground"]
    assert site.findtext("include/uri") == "model://facade"
    assert "gz-sim-sensors-system" in {plugin.get("filename") for plugin in site.findall("plugin")}
    assert site.find("spherical_coordinates") is None  # nobody knows where it is
    config = ET.parse(world / "facade" / "model.config").getroot()
    assert (world / "facade" / str(config.findtext("sdf"))).is_file()


def test_a_world_with_a_reference_system_has_its_place_on_earth(collider, tmp_path):
    """In UTM, the grid's north is off the meridian by the convergence, Δλ sin φ (to first order), to its east."""
    write_world(tmp_path, [], frame_at((650_000, 5_400_000, 412.5), "EPSG:25832"))
    place = ET.parse(tmp_path / "world.sdf").getroot().find("world/spherical_coordinates")
    assert place is not None
    latitude, longitude, elevation, heading = (
        float(place.findtext(name, "nan")) for name in ("latitude_deg", "longitude_deg", "elevation", "heading_deg")
    )
    metres = np.radians([latitude, (longitude - 9) * np.cos(np.radians(latitude))]) * 6.38e6
    np.testing.assert_allclose(metres, [5_400_000, 150_000], rtol=0.005)
    assert elevation == 412.5
    assert heading == pytest.approx((longitude - 9) * np.sin(np.radians(latitude)), rel=2e-3)


def test_a_place_outside_its_reference_system_is_left_out_and_said(tmp_path, caplog):
    write_world(tmp_path, [], frame_at((1e9, 1e9, 0), "EPSG:25832"))
    assert "spherical" not in (tmp_path / "world.sdf").read_text()
    assert "is outside ETRS89 / UTM zone 32N" in caplog.text


def test_usd_of_an_unknown_unit_states_the_metre_in_every_layer(collider, tmp_path):
    pxr = import_pxr("sim")
    write_folder(tmp_path, collider, frame_at(metric=False))
    layers = [*tmp_path.rglob("*.usd?")]
    assert len(layers) == 5
    for layer in layers:
        stage = pxr.Usd.Stage.Open(str(layer))
        assert stage.HasAuthoredMetadata("metersPerUnit")
        assert pxr.UsdGeom.GetStageMetersPerUnit(stage) == 1
        assert "unit is unknown" in stage.GetRootLayer().comment


@pytest.mark.parametrize("name", ["world.usda", "facade/facade.usda"])
@pytest.mark.parametrize("look", ["mesh", "splats", "both"])
def test_the_usd_is_compliant(world, name, look):
    pxr = import_pxr("sim")
    stage = pxr.Usd.Stage.Open(str(world / name))
    assert pxr.UsdGeom.GetStageUpAxis(stage) == "Z"
    assert pxr.UsdGeom.GetStageMetersPerUnit(stage) == 1
    root = "/World/facade" if name == "world.usda" else "/facade"
    assert stage.GetPrimAtPath(root).GetVariantSet("look").SetVariantSelection(look)
    assert compliance_errors(stage) == []
    assert not [asset for asset in world.rglob(".*") if asset.is_file()]  # no leftovers


def test_the_compliance_checker_finds_faults(tmp_path):
    pxr = import_pxr("sim")
    stage = pxr.Usd.Stage.CreateNew(str(tmp_path / "bad.usda"))
    stage.DefinePrim("/a", "Mesh")
    stage.GetRootLayer().Save()
    assert compliance_errors(stage)


def test_a_usd_asset_brings_no_second_scene_ground_or_light(world):
    """Referenced by a scene of a robot's own."""
    pxr = import_pxr("sim")
    stage = pxr.Usd.Stage.CreateInMemory()
    pxr.UsdPhysics.Scene.Define(stage, "/physics")
    stage.DefinePrim("/facade").GetReferences().AddReference(str(world / "facade" / "facade.usda"))
    prims = [*stage.Traverse()]
    assert sum(prim.IsA(pxr.UsdPhysics.Scene) for prim in prims) == 1
    assert not any(prim.IsA(pxr.UsdGeom.Plane) or prim.HasAPI(pxr.UsdLux.LightAPI) for prim in prims)
    assert not any(prim.HasAPI(pxr.UsdPhysics.RigidBodyAPI) for prim in prims)  # static
    facade = stage.GetPrimAtPath("/facade")
    assert pxr.Usd.ModelAPI(facade).GetKind() == "component"
    assert list(pxr.UsdSemantics.LabelsAPI(facade, "class").GetLabelsAttr().Get()) == ["building"]
    whole = pxr.Usd.Stage.Open(str(world / "world.usda"))
    assert whole.GetPrimAtPath("/World/facade").IsModel()  # all prims above it are groups
    assert sum(prim.IsA(pxr.UsdPhysics.Scene) for prim in whole.Traverse()) == 1


def test_the_look_of_both_shows_the_mesh_to_depth_sensors_and_splats_to_cameras(world):
    pxr = import_pxr("sim")
    stage = pxr.Usd.Stage.Open(str(world / "world.usda"))
    stage.GetPrimAtPath("/World/facade").GetVariantSet("look").SetVariantSelection("both")
    purpose = {
        name: pxr.UsdGeom.Imageable(stage.GetPrimAtPath(f"/World/facade/{name}")).ComputePurpose()
        for name in ("visual/mesh", "splats", "collision/part_000")
    }
    assert purpose == {"visual/mesh": "proxy", "splats": "render", "collision/part_000": "guide"}


def test_the_usd_labels_each_triangle_once(world):
    stage = import_pxr("sim").Usd.Stage.Open(str(world / "facade" / "usd" / "visual.usdc"))
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


def test_usd_colliders_are_the_parts_each_with_its_friction(world, collider):
    pxr = import_pxr("sim")
    stage = pxr.Usd.Stage.Open(str(world / "world.usda"))
    prims = [prim for prim in stage.Traverse() if prim.HasAPI(pxr.UsdPhysics.MeshCollisionAPI)]
    assert len(prims) == len(collider.parts)
    for prim, part in zip(prims, collider.parts, strict=True):
        np.testing.assert_allclose(pxr.UsdGeom.Mesh(prim).GetPointsAttr().Get(), part.vertices, atol=1e-5)
        assert pxr.UsdPhysics.MeshCollisionAPI(prim).GetApproximationAttr().Get() == "convexHull"
        material = pxr.UsdShade.MaterialBindingAPI(prim).GetDirectBinding("physics").GetMaterial()
        assert pxr.UsdPhysics.MaterialAPI(material).GetDynamicFrictionAttr().Get() == pytest.approx(FRICTION)


def test_splats_in_usd_are_the_gaussians(world):
    pxr = import_pxr("sim")
    splats = some_splats()
    stage = pxr.Usd.Stage.Open(str(world / "facade" / "usd" / "splats.usdc"))
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


@pytest.fixture
def noisy(collider) -> TexturedMesh:
    """The building with a texture that is large as a JPEG."""
    noise = np.random.default_rng(0).integers(0, 255, (512, 512, 3), dtype=np.uint8)
    look = painted(collider.surface)
    return TexturedMesh(look.vertices, look.faces, look.uv, Image.fromarray(noise), 1.0)


def test_the_glb_is_upright_textured_and_small_enough(noisy, tmp_path, caplog):
    facts = write_visual(tmp_path, noisy, np.zeros(len(noisy.faces), np.uint8), megabytes=0.1)
    assert (tmp_path / "visual.glb").stat().st_size == facts["glb_bytes"] <= 1e5
    scene = trimesh.load_scene(tmp_path / "visual.glb")
    assert scene.extents[1] == pytest.approx(np.ptp(noisy.vertices[:, 2]), rel=1e-4)  # glTF is y-up
    (mesh,) = scene.geometry.values()
    assert list(mesh.visual.material.baseColorTexture.size) == facts["glb_texture"]
    assert max(facts["glb_texture"]) < 512
    assert not caplog.text


@pytest.mark.parametrize("megabytes", [0.1, 0.001])
def test_simulators_have_the_whole_texture_however_small_the_glb_is(noisy, tmp_path, megabytes):
    facts = write_visual(tmp_path, noisy, np.zeros(len(noisy.faces), np.uint8), megabytes)
    assert facts["texture"] == [512, 512]
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / f"{tmp_path.name}.png")), np.asarray(noisy.image))


def test_a_glb_whose_triangles_alone_are_too_large_is_told(noisy, tmp_path, caplog):
    facts = write_visual(tmp_path, noisy, np.zeros(len(noisy.faces), np.uint8), megabytes=0.001)
    assert (tmp_path / "visual.glb").stat().st_size == facts["glb_bytes"] > 1e3
    assert f"has {facts['glb_bytes'] / 1e6:.3g} MB, more than 0.001" in caplog.text
    assert "give fewer --faces" in caplog.text


def test_there_is_an_obj_for_each_class_of_surface(world, collider):
    meshes = {file.stem: trimesh.load_mesh(file) for file in (world / "facade").glob("visual*.obj")}
    assert {*meshes} == {"visual_wall", "visual_door"}
    assert sum(len(mesh.faces) for mesh in meshes.values()) == len(collider.surface.faces)
    assert meshes["visual_wall"].triangles_center[:, 2].min() > 3 >= meshes["visual_door"].triangles_center[:, 2].max()


@pytest.mark.parametrize("count", [1, 10])
def test_a_class_of_surface_that_mujoco_refuses_is_none(collider, tmp_path, count):
    """One triangle, and several without area."""
    mujoco, look = import_mujoco(), painted(collider.surface)
    look.vertices[look.faces[1:count]] = look.vertices[0]
    classes = np.full(len(look.faces), SurfaceClass.WALL, np.uint8)
    classes[slice(1) if count == 1 else slice(1, count)] = SurfaceClass.DOOR

    def model(used: np.ndarray):
        write_visual(tmp_path, look, used, 30)
        spec = mujoco.MjSpec()
        for each in map(SurfaceClass, np.unique(used)):
            kind = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
            spec.add_mesh(name=each.word, file=str(tmp_path / visual_file(each)), inertia=kind)
        return spec.compile()

    with pytest.raises(ValueError, match=r"vertices required|too small"):
        model(classes)
    assert model(without_specks(look, classes)).nmesh == 1


def test_two_buildings_are_one_world(collider, tmp_path):
    away = Collider(
        [part for part in (Part.hull(p.vertices + np.array([20, 0, 0])) for p in collider.parts) if part], 0
    )
    assets = [write_building(tmp_path, one, name) for one, name in ((collider, "left"), (away, "right"))]
    write_world(tmp_path, assets, frame_at(), uneven())
    model = load(tmp_path / "world.xml")
    assert {model.body(k).name for k in range(1, model.nbody)} == {"left/left", "right/right"}
    assert {*yourdfpy.URDF.load(str(tmp_path / "world.urdf")).link_map} == {"world", "ground", "left", "right"}
    assert compliance_errors(tmp_path / "world.usda") == []
    if SDFORMAT:
        assert "Valid" in sdformat("cmdCheck", tmp_path / "world.sdf")
    assert {path.name for path in tmp_path.rglob("*.png")} == {"left.png", "right.png"}  # Gazebo compares no folders
