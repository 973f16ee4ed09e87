"""Blocks: which Gaussians are trained, and that all around them stay as the coarse run left them."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scenes import parse
from scipy.spatial.transform import Rotation
from training_runs import data_of, densify_early, model_of
from two_blocks import HALVES, block_run, coarse_run, copied, cut_in_two

from shellgs_method.errors import SceneError
from shellgs_method.export.runs import TrainedRun
from shellgs_method.files.blocks import BLOCKS, Block, Blocks, Cell, Cut
from shellgs_method.gaussians.seeds import SeededView, Seeds, shell_seeds
from shellgs_method.gaussians.surroundings import Region
from shellgs_method.geometry.camera import Camera
from shellgs_method.geometry.reference import Reference
from shellgs_method.trainer import FacadeTrainer


@pytest.fixture(scope="module")
def street(pristine_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The scene with a cut in the middle."""
    scene = Path(shutil.copytree(pristine_scene, tmp_path_factory.mktemp("street") / "scene"))
    cut_in_two(scene)
    return scene


@pytest.fixture(scope="module")
def coarse(street: Path, tmp_path_factory: pytest.TempPathFactory) -> FacadeTrainer:
    return coarse_run(street, tmp_path_factory.mktemp("coarse"))


def test_a_block_has_the_cameras_and_points_of_the_whole_scene(street):
    whole = parse(street)
    for name in HALVES:
        block = parse(street, block=name)
        _, used = block.metadata["split"]
        assert 0 < len(used) < len(whole.image_filenames)
        assert [whole.image_filenames[k] for k in used] == block.image_filenames
        torch.testing.assert_close(block.cameras.camera_to_worlds, whole.cameras.camera_to_worlds[used], rtol=0, atol=0)
        assert block.dataparser_scale == whole.dataparser_scale
        assert torch.equal(block.dataparser_transform, whole.dataparser_transform)
        assert torch.equal(block.metadata["points3D_xyz"], whole.metadata["points3D_xyz"])
        np.testing.assert_array_equal(block.metadata["centre"], whole.metadata["centre"])


def test_a_region_in_the_world_of_the_model_is_that_of_the_scene(street):
    parsed, points = parse(street, block="east"), np.random.default_rng(0).normal(0, 9, (2000, 3))
    cell = Blocks.read(street / BLOCKS).cell("east")
    transform = parsed.dataparser_transform.double().numpy()
    world = parsed.dataparser_scale * (points @ transform[:, :3].T + transform[:, 3])
    for region in ("core", "extended"):
        inside = getattr(cell, region)(points)
        assert 0.2 < inside.mean() < 0.8
        np.testing.assert_array_equal(getattr(parsed.metadata["cell"], region)(world), inside)


def test_all_around_a_block_stays_as_it_is_and_all_in_it_is_trained(coarse, tmp_path):
    trainer = block_run(coarse, "west", tmp_path, change=densify_early)
    model = model_of(trainer)
    assert model.surroundings is not None
    assert model.region is not None
    assert model.exposures is not None
    frozen = copied(model.surroundings.named_buffers()) | copied([("gains", model.exposures.parameter)])
    started = len(model.means)
    trainer.train()
    assert len(model.means) != started
    for name, before in frozen.items():
        after = model.exposures.parameter if name == "gains" else model.surroundings.get_buffer(name)
        assert torch.equal(after, before), name
    assert not model.region.extended(frozen["means"]).any()
    assert model.region.extended(model.means).all()
    assert model.strategy_state["grad2d"].shape == (len(model.means),)


def test_what_is_seen_from_a_block_before_it_is_trained_is_what_the_coarse_run_shows(coarse, tmp_path):
    """But for the seeds that fill its gaps: here none are."""
    trainer = block_run(coarse, "east", tmp_path, change=lambda config: setattr(config.pipeline.model, "init", "sfm"))
    views = data_of(trainer).eval_dataset
    camera = views.cameras[0:1]
    model, whole = model_of(trainer), model_of(coarse)
    for each in (model, whole):
        each.eval()
        each.step = 10_000_000
    with torch.no_grad():
        ours, theirs = model.get_outputs_for_camera(camera), whole.get_outputs_for_camera(camera)
    torch.testing.assert_close(ours["rgb"], theirs["rgb"], atol=1e-4, rtol=0)


def test_gradients_in_a_block_are_those_of_a_model_in_which_all_is_trained(coarse, tmp_path):
    trainer = block_run(coarse, "west", tmp_path)
    block, camera = model_of(trainer), data_of(trainer).train_dataset.camera(0)
    assert block.surroundings is not None
    trained = {name: each.detach() for name, each in block.gauss_params.items()}
    if block._gaussians.get("surface") is not None:
        trained["surface"] = block._gaussians["surface"][: len(block.means)]
    all_of_it = {name: each.requires_grad_() for name, each in block.surroundings.around(trained).items()}
    background = torch.zeros(3)
    for gaussians in (all_of_it, block._gaussians):
        rgb, *_ = block.renderer(gaussians, camera, background, 3, False)
        rgb.square().sum().backward()
    for name, parameter in block.gauss_params.items():
        expected = all_of_it[name].grad
        assert expected is not None
        assert parameter.grad is not None
        torch.testing.assert_close(parameter.grad, expected[: len(parameter)], msg=name)
    assert all(not each.requires_grad for each in block.surroundings.buffers())


def test_a_resumed_block_ends_as_one_that_was_never_stopped(coarse, tmp_path, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "1")

    def change(config: Any) -> None:
        densify_early(config)
        config.steps_per_save, config.save_only_latest_checkpoint = 6, False

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    whole = block_run(coarse, "east", tmp_path / "whole", change=change)
    whole.train()
    for last in whole.checkpoint_dir.glob("step-0000000[01][!6].ckpt"):
        last.unlink()
    resumed = block_run(coarse, "east", tmp_path / "resumed", load_dir=whole.checkpoint_dir, change=change)
    assert resumed._start_step == 7
    resumed.train()
    torch.set_num_threads(before)
    expected = dict(model_of(whole).state_dict())
    state = model_of(resumed).state_dict()
    assert any(name.startswith("surroundings.") for name in state)
    assert all(torch.equal(each, expected[name]) for name, each in state.items())


def test_a_trained_block_is_rendered_without_the_coarse_run(coarse, street, tmp_path):
    trainer = block_run(coarse, "west", tmp_path, iterations=2)
    trainer.config.save_config()
    trainer.train()
    model_of(trainer).config.coarse = tmp_path / "gone"
    trainer.config.save_config()
    loaded, again = TrainedRun.load(trainer.base_dir / "config.yml"), model_of(trainer)
    camera = data_of(trainer).eval_dataset.cameras[0:1]
    for model in (loaded.model, again):
        model.eval()
        model.step = 2
    ours, theirs = loaded.model.get_outputs_for_camera(camera), again.get_outputs_for_camera(camera)
    torch.testing.assert_close(ours["rgb"], theirs["rgb"])


def test_seeds_of_a_block_lie_in_it_where_it_has_no_gaussian_as_near():
    cut = Cut((1.0, 0.0, 0.0), 0.0)
    region = Region(Cell(Block("east", ()), ((cut, True),), 1.0), np.zeros(3), 10.0)
    points = np.array([[5.0, 0, 0], [-0.5, 0, 0], [-2, 0, 0], [20, 0, 0], [3, 0, 0]])
    seeds = Seeds(points, points, points, np.full(5, 0.1))
    lacking = region.lacking(seeds, torch.tensor([[3.05, 0, 0], [5.2, 0, 0]]))
    np.testing.assert_array_equal(lacking.points, points[:2])


def test_what_is_far_from_the_cameras_is_of_no_block():
    """A cell from x = 6, which is trained from 5; what is far begins at 0.8 of 1.5 times the SfM points' distance."""
    cell = Cell(Block("east", ()), ((Cut((1.0, 0.0, 0.0), 6.0), True),), 1.0)
    centre = np.array([4.0, 3, -2])
    region = Region.of(cell, centre, centre + 10 * np.eye(3)[[0, 1, 2] * 40])
    means = torch.tensor([[7.0, 3, -2], [5.5, 3, -2], [3, 3, -2], [15.9, 3, -2], [16.1, 3, -2], [-8.1, 3, -2]])
    assert region.core(means).tolist() == [True, False, False, True, False, False]
    assert region.extended(means).tolist() == [True, True, False, True, False, False]
    assert region.near(means).tolist() == [True, True, True, True, False, False]


def test_the_bound_on_seeds_is_one_on_those_of_the_block_whatever_else_its_photographs_show():
    region = Region(Cell(Block("east", ()), ((Cut((1.0, 0.0, 0.0), 6.0), True),), 1.0), np.zeros(3), 100.0)
    K = torch.tensor([[60.0, 0, 40], [0, 60, 30], [0, 0, 1]], dtype=torch.float64)
    wall = Reference(
        torch.full((60, 80, 1), 12.0, dtype=torch.float64),
        torch.tensor([0.0, 0, -1], dtype=torch.float64).expand(60, 80, 3),
        torch.ones(60, 80, 1, dtype=torch.bool),
    )
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = torch.from_numpy(Rotation.from_euler("xyz", [0.3, 0.1, 0.2]).as_matrix())
    viewmat[:3, 3] = torch.tensor([-0.5, 0.5, 1.0])
    view = SeededView(Camera(viewmat, K, 80, 60), torch.zeros(60, 80, 3), wall)
    everywhere, shown = (shell_seeds([each], 80 * 60, 1.0, 60).points for each in (view, region.shown(view)))
    inside = region.extended(torch.from_numpy(everywhere)).numpy()
    assert region.extended(torch.from_numpy(shown)).all()
    assert 0 < inside.sum() < 20
    assert 40 < len(shown) <= 60


@pytest.mark.parametrize(
    ("broken", "said"),
    [
        ("no block", "name it, by facade-data --block"),
        ("another block", "there is no block 'north'"),
        ("no coarse run", "does not exist"),
        ("another primitive", "has primitive 3d, and this run 2d"),
        ("unfinished", "has 12 of its 99 iterations"),
        ("nothing held out", "no photograph that is held out"),
        ("unknown photograph", "which is not a photograph of the scene"),
        ("another scene", "is not the scene that the run"),
        ("others held out", "was trained on other photographs than .* from images/frame_0000[0-9]"),
        ("another camera of a rig", "was trained on other photographs than .* from images/frame_0000[0-9]"),
    ],
)
def test_what_no_block_can_start_from_is_refused_in_a_sentence(coarse, street, tmp_path, broken, said):
    scene = Path(shutil.copytree(street, tmp_path / "scene"))
    folder = Path(shutil.copytree(coarse.base_dir, tmp_path / "coarse"))
    blocks = json.loads((scene / BLOCKS).read_text())
    east = blocks["tree"]["above"]["photographs"]

    def change(config: Any) -> None:
        config.pipeline.datamanager.data, config.pipeline.model.coarse = scene, folder
        if broken == "no block":
            config.pipeline.datamanager.dataparser.block = None
        elif broken == "another block":
            config.pipeline.datamanager.dataparser.block = "north"
        elif broken == "no coarse run":
            config.pipeline.model.coarse = tmp_path / "nothing"
        elif broken == "another primitive":
            config.pipeline.model.primitive, config.pipeline.model.depth = "2d", "expected"
            config.pipeline.model.trust = "shell"
        elif broken == "another scene":
            config.pipeline.datamanager.dataparser.orientation_method = "none"

    if broken == "unfinished":
        text = (folder / "config.yml").read_text()
        (folder / "config.yml").write_text(text.replace("max_num_iterations: 12", "max_num_iterations: 99"))
    elif broken == "nothing held out":
        east[:] = [name for name in east if "frame_00009" not in name]
    elif broken == "unknown photograph":
        east.append("images/nobody.png")
    elif broken == "others held out":
        transforms = json.loads((scene / "transforms.json").read_text())
        names = sorted(frame["file_path"] for frame in transforms["frames"])
        transforms |= {"test_filenames": [names[0], names[5]], "train_filenames": [*names[1:5], *names[6:]]}
        (scene / "transforms.json").write_text(json.dumps(transforms))
    elif broken == "another camera of a rig":
        (checkpoint,) = folder.rglob("*.ckpt")
        state = torch.load(checkpoint, weights_only=False)
        extra = state["pipeline"]["_extra_state"]
        extra["cameras"] = {
            name.replace("images/", "images/left/"): camera for name, camera in extra["cameras"].items()
        }
        torch.save(state, checkpoint)
    (scene / BLOCKS).write_text(json.dumps(blocks))
    with pytest.raises((SystemExit, SceneError, FileNotFoundError), match=said):
        block_run(coarse, "east", tmp_path, change=change)


def test_a_block_that_was_cut_anew_is_not_resumed(coarse, street, tmp_path):
    scene = Path(shutil.copytree(street, tmp_path / "scene"))

    def change(config: Any) -> None:
        config.pipeline.datamanager.data = scene

    block_run(coarse, "east", tmp_path / "first", 2, change=change).train()
    cut_in_two(scene, overlap=2.0)
    (folder,) = (tmp_path / "first").rglob("nerfstudio_models")
    with pytest.raises((SystemExit, SceneError), match="one of them has changed"):
        block_run(coarse, "east", tmp_path / "second", 4, folder, change=change).train()
