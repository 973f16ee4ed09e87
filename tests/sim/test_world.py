"""Trials of worlds in MuJoCo, and the command that writes them."""

from __future__ import annotations

import json
import re
import shutil
import tracemalloc
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from scenes import cast, views_of
from training_runs import trainer_of
from worlds import LAYOUT, compliance_errors, load, painted, write_folder

from shellgs_method import cli
from shellgs_method.errors import SceneError
from shellgs_method.export.runs import TrainedRun
from shellgs_method.geometry.axes import turn
from shellgs_method.geometry.similarity import transformed
from shellgs_method.geometry.triangles import Triangles
from shellgs_method.geometry.winding import outward
from shellgs_method.shell import Alignment, load_shell
from shellgs_method.sim.building import Reconstruction
from shellgs_method.sim.collision.collider import THINNEST, Collider, make_collider
from shellgs_method.sim.collision.parts import Part, pieces
from shellgs_method.sim.front import Front
from shellgs_method.sim.ground import Ground
from shellgs_method.sim.look.renders import rendered
from shellgs_method.sim.settings import SimSettings
from shellgs_method.sim.simulate import OUTDATED, simulate
from shellgs_method.sim.trials import trials
from shellgs_method.sim.trials.engine import compiled, import_mujoco, warnings_kept
from shellgs_method.sim.trials.trials import SIZES, Passages, throw, walk
from shellgs_method.synthetic.frames import SCENE_FROM_BUILDING, SHELL_FROM_BUILDING
from shellgs_method.synthetic.path import walk as stroll


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


def test_no_thrown_body_gets_through_sticks_or_gains_energy(street, collider, eyes):
    world, ground = street
    with warnings_kept() as warnings:
        thrown = throw(world / "world.xml", collider.surface, ground, eyes, count=60, seconds=2.5)
    assert not warnings
    assert thrown.hits > 50
    assert (thrown.through, thrown.stuck, thrown.gained) == (0, 0, 0)
    assert thrown.deepest < 0.05


def test_throwing_finds_a_hole_in_the_wall(collider, eyes, tmp_path):
    """Parts are missing from the model, but not from the surface that must not be crossed."""
    holed = [part for part in collider.parts if np.ptp(part.vertices, axis=0).max() < 2]
    write_folder(tmp_path, Collider(holed, 0.0))
    assert throw(tmp_path / "world.xml", collider.surface, Ground.level(), eyes, count=30, seconds=1).through > 3


@pytest.mark.parametrize(("sizes", "thickness", "passed"), [((0.01, 0.02), 0.01, True), (SIZES, THINNEST, False)])
def test_throwing_finds_a_sheet_that_bodies_pass_and_none_of_the_least_thickness(
    sizes, thickness, passed, tmp_path, monkeypatch
):
    """A fast, small body is beyond the middle of a thin sheet before a contact pushes it out, to the other side."""
    monkeypatch.setattr(trials, "SIZES", sizes)
    sheet = Part.hull(np.array([[x, y, z] for x in (0, 4) for y in (0, thickness) for z in (0.3, 2.5)]))
    assert sheet is not None
    collider = Collider([sheet], 0.0)
    write_folder(tmp_path, collider)
    eyes = np.stack([np.linspace(0, 4, 6), np.full(6, -5.0), np.full(6, 1.6)], axis=1)
    thrown = throw(tmp_path / "world.xml", collider.surface, Ground.level(), eyes, seconds=0.8)
    assert thrown.hits > 100
    assert (thrown.through > 0) == passed


def test_a_point_that_comes_out_where_it_went_in_has_not_passed_and_one_that_crosses_at_once_has():
    slab = Part.hull(np.array([[x, y, z] for x in (0.0, 4) for y in (0, 0.03) for z in (0.0, 2)]))
    assert slab is not None
    y = np.array(
        [[-0.01, -0.01, -0.01, -0.01], [0.01, 0.01, 0.04, 0.01], [-0.01, 0.02, 0.05, 0.01], [-0.01, 0.04, 0.06, 0.01]]
    )
    passages = Passages(Triangles(slab.vertices, slab.faces), _at(y[0]))
    for row in y[1:]:
        passages.move(_at(row))
    assert passages.through.tolist() == [False, True, True, False]


def _at(y: np.ndarray) -> np.ndarray:
    return np.stack([1 + 0.1 * np.arange(len(y)), y, np.full(len(y), 0.7)], axis=1)


def test_the_facades_front_is_its_wall(collider, eyes):
    front = Front.of(collider.surface, eyes)
    np.testing.assert_allclose(front.outwards, [0, -1, 0], atol=0.02)
    assert front.length == pytest.approx(LAYOUT.length + 0.8, rel=0.1)


def test_a_capsule_walks_along_the_facade_and_touches_it(street, collider, eyes):
    world, ground = street
    front = Front.of(collider.surface, eyes)
    walked = walk(world / "world.xml", collider.surface, ground, front)
    assert walked.metres > 0.8 * front.length
    assert walked.touching > 0.02
    assert walked.deepest < 0.03


def test_mujoco_renders_what_a_camera_sees(world, collider):
    """Unlit colours of the texture, in the right places, seen by a camera whose principal point is off the middle."""
    camera = stroll(LAYOUT.length, 8, 96, 64, np.random.default_rng(0))[2]
    K = camera.K.clone()
    K[0, 2] += 9
    camera = type(camera)(camera.viewmat, K, 96, 64)
    try:
        (render,) = rendered(world / "world.xml", [camera])
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
    off = np.abs(render.astype(int) - expected).max(axis=-1)[face >= 0]
    assert (face >= 0).mean() > 0.3
    assert np.median(off) < 2
    assert (off < 60).mean() > 0.9


@pytest.fixture(scope="module")
def config(pristine_scene: Path, tmp_path_factory) -> Path:
    """A short run on the tiny scene."""
    trainer = trainer_of(pristine_scene, tmp_path_factory.mktemp("run"), "shellgs_metric", iterations=10)
    trainer.train()
    trainer.save_checkpoint(10)
    trainer.config.save_config()
    return trainer.base_dir / "config.yml"


SMALL = SimSettings(faces=4000)


@pytest.fixture(scope="module")
def reported() -> list:
    """What the report of the folder below was given."""
    return []


@pytest.fixture(scope="module")
def made(config, tmp_path_factory, reported) -> Path:
    """The folder of this run, with fewer and shorter throws; the results of the full trial are tested above."""
    from shellgs_method.sim import report, simulate

    out = tmp_path_factory.mktemp("sim") / "facade sim"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(report, "throw", lambda *args: throw(*args, count=8, seconds=0.5))
        patch.setattr(simulate, "write_report", lambda *given: reported.extend(given) or report.write_report(*given))
        cli.sim((config, out), replace(SMALL, test=True))
    return out


def test_the_command_writes_the_whole_folder(made):
    out, asset = made, made / "facade"
    for name in [
        "world.xml",
        "world.urdf",
        "world.sdf",
        "world.usda",
        "frame.json",
        "metrics.json",
        "README.md",
        "report.html",
    ]:
        assert (out / name).stat().st_size > 0, name
    names = "facade.xml facade.urdf facade.usda model.config model.sdf package.xml visual.glb visual.mtl facade.png"
    for name in f"{names} splats.ply deviations.ply deviations.json".split():
        assert (asset / name).stat().st_size > 0, name
    assert load(out / "world.xml").ngeom > 20
    assert compliance_errors(out / "world.usda") == []
    frame = json.loads((out / "frame.json").read_text())
    assert frame["up"] == "z"
    assert frame["offset"] == [row[3] for row in frame["to_national"][:3]]
    corner = Triangles(*joined_file(asset)).vertices
    building = transformed(transformed(corner, np.array(frame["to_national"])), np.linalg.inv(SHELL_FROM_BUILDING))
    assert building[:, 0].min() > -1.5
    assert building[:, 0].max() < 19.5
    page = (out / "report.html").read_text()
    assert page.count("<img") >= 6
    assert "nan" not in page


def test_the_same_building_is_not_put_into_a_world_twice(config, tmp_path, monkeypatch):
    monkeypatch.setattr("shellgs_method.export.runs.TrainedRun.load", lambda _: pytest.fail("hours of work"))
    again = shutil.copytree(config.parent, tmp_path / "again") / config.name
    with pytest.raises(SceneError, match="are runs of the same building: give one of them"):
        cli.sim((config, again, tmp_path / "sim"), SMALL)
    assert not [*(tmp_path / "sim").iterdir()]


def test_every_file_that_the_readme_names_is_there(made):
    """Its patterns have one match at least; this shell's classes are not known."""
    text = (made / "README.md").read_text()
    table = " ".join(line.split("|")[1] for line in text.splitlines() if line.startswith("| `"))
    names = [name.replace("NAME", "facade") for name in re.findall(r"`([^`]+)`", table) if "visual_wall" not in name]
    assert len(names) > 12
    stem = ""
    for name in names:
        stem, name = (stem, stem + name) if name.startswith(".") else (name.rpartition(".")[0], name)
        assert [*made.glob(name), *(made / "facade").glob(name)], name
    for path in re.findall(r'"(world[^"]+)"', text):
        assert (made / path).is_file()


def test_a_world_with_no_place_to_throw_from_is_kept_and_says_so(made, reported, tmp_path, monkeypatch):
    from shellgs_method.sim import report

    monkeypatch.setattr(report, "throw", lambda world, surface, _, eyes: throw(world, surface, Ground.level(99), eyes))
    metrics = report.write_report(shutil.copytree(made, tmp_path / "sim"), *reported[1:])
    assert "throws" not in metrics
    assert metrics["summary"][0] == (
        "Nothing was thrown: there is no place in front of the building to throw from: are the cameras outside?"
    )


def test_trials_are_made_if_asked_for(made):
    metrics = json.loads((made / "metrics.json").read_text())
    assert metrics["throws"]["thrown"] == 8
    assert np.isfinite(metrics["buildings"]["facade"]["walk"]["metres"])
    said = " ".join(metrics["summary"])
    assert "8 spheres and boxes thrown" in said
    assert "A capsule walked" in said


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
    cast(scene, views_of(scene), Alignment(matrix, ("shell/turned.obj",)))
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


def test_a_folder_of_an_earlier_version_is_refused_and_stays(tmp_path):
    (tmp_path / OUTDATED).write_text("<mujoco/>")
    with pytest.raises(SceneError, match=r"earlier version.*give another folder"):
        simulate([tmp_path / "config.yml"], tmp_path, SMALL)
    assert [path.name for path in tmp_path.iterdir()] == [OUTDATED]


def test_a_world_replaces_the_files_of_an_earlier_one_and_no_others(tmp_path, monkeypatch):
    def write(*names: str) -> None:
        def world(configs, out, *rest):
            for name in names:
                (out / name).mkdir()
                (out / name / f"{name}.xml").write_text("<mujoco/>")
            (out / "frame.json").write_text(json.dumps({"buildings": dict.fromkeys(names, "scene")}))
            return {}, []

        monkeypatch.setattr("shellgs_method.sim.simulate._world", world)
        simulate([tmp_path / "config.yml"], tmp_path / "sim", SMALL)

    write("church", "school", "shop")
    mine = ["shop/robot.xml", "robot/robot.xml", "bank/photo.jpg"]
    for name in mine:
        (tmp_path / "sim" / name).parent.mkdir(exist_ok=True)
        (tmp_path / "sim" / name).write_text("mine")
    write("school", "bank")
    expected = {"bank/bank.xml", "frame.json", "school/school.xml", *mine}
    found = {path.relative_to(tmp_path / "sim").as_posix() for path in (tmp_path / "sim").rglob("*") if path.is_file()}
    assert found == expected
    assert not (tmp_path / "sim" / "church").exists()


def test_a_folder_of_something_else_is_refused_and_stays(tmp_path):
    (tmp_path / "facade" / "images").mkdir(parents=True)
    with pytest.raises(SceneError, match="has other files: give a new folder"):
        simulate([tmp_path / "config.yml"], tmp_path, SMALL)
    assert (tmp_path / "facade" / "images").is_dir()


def test_walls_far_apart_are_reported(collider):
    from shellgs_method.sim.simulate import _report_gaps

    away = [part for part in (Part.hull(p.vertices + np.array([30, 0, 0])) for p in collider.parts) if part]
    said: list[str] = []
    _report_gaps(Collider(collider.parts, 0.0), "street", said.append)
    assert not said
    _report_gaps(Collider([*collider.parts, *away], 0.0), "street", said.append)
    assert "2 pieces" in said[0]


def test_pieces_of_many_parts_are_counted_in_memory_that_is_not_squared():
    tetrahedron = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    places = np.random.default_rng(0).permutation(5000)  # 1.5 m apart, but one gap of 3 m
    parts = [
        Part(tetrahedron + np.array([0, 1.5 * place + 3 * (place >= 2000), 0]), np.empty((0, 3), int), np.empty((0, 4)))
        for place in places
    ]
    tracemalloc.start()
    assert (pieces(parts, 2.0), pieces(parts, 4.0), pieces(parts, 0.1)) == (2, 1, 5000)
    assert tracemalloc.get_traced_memory()[1] < 20e6
    tracemalloc.stop()
