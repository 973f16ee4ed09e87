"""The runs of a street: in which order, from what, and what they need on another machine."""

from __future__ import annotations

import json
import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from nerfstudio.engine.trainer import TrainerConfig
from two_blocks import HALVES, block_run, coarse_run, copied, cut_in_two

from shellgs_method.blocks.street import Street, script, train
from shellgs_method.compare.settings import parsed
from shellgs_method.errors import SceneError
from shellgs_method.files.blocks import BLOCKS, Block, Blocks, Fork
from shellgs_method.files.cue_maps import CueMaps
from shellgs_method.files.scene import ScenePaths
from shellgs_method.launch import cluster
from shellgs_method.runs.checkpoints import find_checkpoint


@pytest.fixture
def cut(scene: Path) -> Path:
    cut_in_two(scene)
    return scene


def planned(scene: Path, output: Path, method: str = "shellgs-metric") -> Street:
    return Street.plan(scene, method, 6, 4, 0.5, 0, output, ScenePaths())


def finish_coarse(street: Street, folder: Path) -> None:
    """Put a finished coarse run where the street has it."""
    street.coarse.settle()
    trained = coarse_run(street.coarse.scene, folder, iterations=4).base_dir
    shutil.copytree(trained, street.coarse.folder, dirs_exist_ok=True)
    street.coarse.metrics().write_text("{}")


def test_blocks_can_be_started_once_the_coarse_run_is_finished_each_with_a_copy_of_it(cut, tmp_path):
    street = planned(cut, tmp_path / "street")
    (line,) = script(street)
    words = tuple(shlex.split(line.partition(" && ")[0])[1:])
    assert parsed(words).pipeline.datamanager.camera_res_scale_factor == 0.5  # pyright: ignore
    finish_coarse(street, tmp_path / "coarse")
    lines = script(street)
    assert len(lines) == 2
    for name, line, run in zip(HALVES, lines, street.blocks, strict=True):
        config = parsed(tuple(shlex.split(line.partition(" && ")[0])[1:]))
        assert config.pipeline.datamanager.dataparser.block == name  # pyright: ignore
        copy = config.pipeline.model.coarse  # pyright: ignore
        assert copy == run.folder / "coarse"
        ours, theirs = (find_checkpoint(each / "nerfstudio_models") for each in (copy, street.coarse.folder))
        assert ours.read_bytes() == theirs.read_bytes()
        moved = run.moved(Path("/node/scene"), Path("/node/runs"))
        assert f"--pipeline.model.coarse /node/runs/runs/scene/{name}" in shlex.join(moved.commands()[0])


def test_a_finished_coarse_run_with_other_settings_is_not_gone_on_from(cut, tmp_path):
    finish_coarse(planned(cut, tmp_path / "street"), tmp_path / "coarse")
    other = Street.plan(cut, "shellgs-metric", 6, 4, 0.25, 0, tmp_path / "street", ScenePaths())
    with pytest.raises(SceneError, match=r"other settings .*res_scale_factor: 0\.5, now 0\.25"):
        script(other)


def test_the_coarse_run_comes_first_and_a_failure_ends_the_street_in_a_sentence(cut, tmp_path):
    street, launched = planned(cut, tmp_path / "street"), []

    def launch(runs):
        launched.append([run.variant.name for run in runs])
        if len(launched) == 1:
            finish_coarse(street, tmp_path / "coarse")
            return {}
        return {runs[1]: "out of memory"}

    with pytest.raises(SceneError, match=r"1 of 2 runs failed, the first is scene/east.*log.txt.*\nout of memory"):
        train(street, launch)
    assert launched == [["coarse"], list(HALVES)]


def test_a_block_that_was_cut_anew_is_not_gone_on_with(cut, tmp_path):
    street = planned(cut, tmp_path / "street")
    finish_coarse(street, tmp_path / "coarse")
    script(street)
    for run in street.blocks:
        shutil.copytree(run.folder / "coarse" / "nerfstudio_models", run.checkpoints)
    assert len(script(planned(cut, tmp_path / "street"))) == 2
    cut_in_two(cut, overlap=0.7)
    with pytest.raises(SceneError, match=r"west has been cut again since .* was trained: remove that folder"):
        script(planned(cut, tmp_path / "street"))


def test_a_plan_that_changes_while_a_street_is_trained_ends_it(cut, tmp_path):
    street = planned(cut, tmp_path / "street")
    finish_coarse(street, tmp_path / "coarse")
    cut_in_two(cut, overlap=0.7)
    with pytest.raises(SceneError, match=r"blocks\.json has changed since the street began"):
        script(street)


@pytest.mark.parametrize(
    ("photographs", "said"),
    [((), "no photograph to train on"), (("nope.png",), "nope.png, which is not"), (None, "has one block")],
)
def test_a_block_that_cannot_be_trained_is_refused_before_the_coarse_run(cut, tmp_path, photographs, said):
    blocks = Blocks.read(cut / BLOCKS)
    assert isinstance(blocks.tree, Fork)
    east = blocks.tree.above
    tree = east if photographs is None else replace(blocks.tree, below=Block("west", photographs))
    replace(blocks, tree=tree).write(cut / BLOCKS)
    with pytest.raises(SceneError, match=said):
        planned(cut, tmp_path / "street")


def test_a_block_is_trained_for_as_long_as_it_has_photographs(cut, tmp_path):
    blocks = Blocks.read(cut / BLOCKS)
    assert isinstance(blocks.tree, Fork)
    assert isinstance(blocks.tree.below, Block)
    few = Block("west", blocks.tree.below.photographs[:3])
    replace(blocks, tree=replace(blocks.tree, below=few)).write(cut / BLOCKS)
    street = Street.plan(cut, "shellgs-metric", 1000, 4, 0.5, 0, tmp_path / "street", ScenePaths())
    assert [run.iterations for run in street.blocks] == [600, 1400]


def test_a_block_that_was_begun_stays_as_long_when_another_is_cut_anew(cut, tmp_path):
    street = planned(cut, tmp_path / "street")
    finish_coarse(street, tmp_path / "coarse")
    script(street)
    east = street.blocks[1]
    shutil.copytree(east.folder / "coarse" / "nerfstudio_models", east.checkpoints)
    blocks = Blocks.read(cut / BLOCKS)
    assert isinstance(blocks.tree, Fork)
    assert isinstance(blocks.tree.below, Block)
    few = Block("west", blocks.tree.below.photographs[:3])
    replace(blocks, tree=replace(blocks.tree, below=few)).write(cut / BLOCKS)
    west_now, east_now = planned(cut, tmp_path / "street").blocks
    assert west_now.iterations < street.blocks[0].iterations
    assert east_now == east


def test_a_block_is_sent_without_photographs_of_others_and_the_shell_and_trains_the_same(cut, tmp_path):
    (cut / "capture").mkdir()
    (cut / "capture" / "database.db").touch()
    west, sent = planned(cut, tmp_path / "street").blocks[0], tmp_path / "node" / "scene"
    cluster._unpack(cluster._packed(cut, lambda piece: piece, west.spared), sent)
    names = [frame.name for frame in west.paths.of(cut).read().frames]
    ours = {*Blocks.read(cut / BLOCKS).cell("west").block.photographs}
    assert {name for name in names if (sent / name).exists()} == ours
    assert CueMaps.open(sent, "shell").names == sorted(ours)
    assert {path.name for path in (sent / "shell").iterdir() if path.is_file()} == {"alignment.json"}
    assert not (sent / "capture").exists()

    coarse, trained = coarse_run(cut, tmp_path / "coarse", iterations=4), []
    for scene in (cut, sent):

        def of_scene(config: TrainerConfig, scene: Path = scene) -> None:
            config.data = config.pipeline.datamanager.data = scene

        trainer = block_run(coarse, "west", tmp_path / scene.parent.name, 4, change=of_scene)
        trainer.train()
        trained.append(copied(trainer.pipeline.model.gauss_params.items()))
    for name, values in trained[0].items():
        assert torch.equal(values, trained[1][name]), name


@pytest.mark.parametrize(
    ("flags", "name"),
    [
        ("--pipeline.datamanager.camera-res-scale-factor .3", "camera-res-scale-factor"),
        ("--pipeline.model.coarse other", r"pipeline\.model\.coarse"),
        ("facade-data --block west", "block"),
    ],
)
def test_what_a_street_sets_is_refused_in_a_method_of_ones_own(cut, tmp_path, flags, name):
    with pytest.raises(SceneError, match=f"mine sets {name}, which .* leave it out"):
        planned(cut, tmp_path, f"mine=shellgs-metric {flags}")


def test_blocks_have_photographs_to_train_on_and_held_out_ones_by_the_methods_own_interval(cut, tmp_path):
    with pytest.raises(SceneError, match="has no photograph that is held out"):
        planned(cut, tmp_path, "mine=shellgs-metric facade-data --eval-interval 1000")


def test_a_method_of_nerfstudio_trains_no_blocks(cut, tmp_path):
    with pytest.raises(SceneError, match="splatfacto trains no blocks"):
        planned(cut, tmp_path, "splatfacto")


def test_a_scene_without_the_maps_of_the_method_is_refused_before_the_coarse_run(cut, tmp_path):
    shutil.rmtree(cut / "cues")
    with pytest.raises(SceneError, match=r"needs the shell maps .* or train photo-gs"):
        planned(cut, tmp_path)
    assert planned(cut, tmp_path, "photo-gs")


@pytest.mark.slow
def test_a_street_is_trained_and_merged_by_one_command(cut, tmp_path, shellgs):
    words = (cut, "--iterations", 6, "--coarse-iterations", 4, "--output", tmp_path / "street")
    assert "Lost at the cuts" in shellgs("street", *words)
    report = json.loads((next((tmp_path / "street" / "merged").rglob("seams.json"))).read_text())
    assert report["elsewhere"]["psnr"] > 5
    logs = {
        run.folder / "log.txt": (run.folder / "log.txt").read_text() for run in planned(cut, tmp_path / "street").blocks
    }
    assert "Lost at the cuts" in shellgs("street", *words)  # merges again, and trains nothing
    assert all(path.read_text() == text for path, text in logs.items())
