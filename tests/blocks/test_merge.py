"""Runs of blocks as one: which Gaussians it has, that other commands take it, and what is refused."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from training_runs import model_of
from two_blocks import HALVES, block_run, coarse_run, cut_in_two, save_config

from shellgs_method.blocks import seams
from shellgs_method.blocks.merge import merge
from shellgs_method.blocks.seams import CRITERIA, from_cuts, judged, on_another
from shellgs_method.errors import SceneError
from shellgs_method.export.runs import TrainedRun
from shellgs_method.files.blocks import BLOCKS, Block, Blocks, Cut, Fork
from shellgs_method.runs.checkpoints import find_checkpoint, load_checkpoint
from shellgs_method.runs.run_folder import open_run, written_config
from shellgs_method.trainer import FacadeTrainer


@pytest.fixture(scope="module")
def street(pristine_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    scene = Path(shutil.copytree(pristine_scene, tmp_path_factory.mktemp("street") / "scene"))
    cut_in_two(scene)
    return scene


@pytest.fixture(scope="module")
def coarse(street: Path, tmp_path_factory: pytest.TempPathFactory) -> FacadeTrainer:
    return coarse_run(street, tmp_path_factory.mktemp("coarse"), iterations=6)


@pytest.fixture(scope="module")
def configs(coarse: FacadeTrainer, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Runs of both blocks of six iterations."""
    return [trained_block(coarse, name, tmp_path_factory.mktemp("blocks")) for name in HALVES]


def trained_block(coarse: FacadeTrainer, name: str, folder: Path, **kwargs: Any) -> Path:
    trainer = block_run(coarse, name, folder, **{"iterations": 6, **kwargs})
    return finished(trainer, train=True)


def finished(trainer: FacadeTrainer, train: bool) -> Path:
    """The config of a run that was trained to its end, or that is said to be."""
    save_config(trainer)
    if train:
        trainer.train()
    else:
        trainer.save_checkpoint(trainer.config.max_num_iterations - 1)
    return trainer.base_dir / "config.yml"


def gaussians(config: Path) -> dict[str, torch.Tensor]:
    state = load_checkpoint(find_checkpoint(config.parent / "nerfstudio_models"))["pipeline"]
    return {name.rpartition(".")[2]: each for name, each in state.items() if ".gauss_params." in name}


def in_order(parameters: dict[str, torch.Tensor]) -> torch.Tensor:
    """A row for each Gaussian, sorted."""
    rows = torch.cat([each.flatten(1) for _, each in sorted(parameters.items())], dim=1)
    return rows[np.lexsort(rows.numpy().T[::-1])]


def test_blocks_that_were_not_trained_merge_into_the_coarse_run(street, tmp_path):
    coarse = coarse_run(street, tmp_path / "coarse", "photo_gs", 4)
    blocks = [finished(block_run(coarse, name, tmp_path / name, 4), train=False) for name in HALVES]
    merged = merge(blocks, tmp_path / "merged")
    assert torch.equal(in_order(gaussians(merged)), in_order(gaussians(coarse.base_dir / "config.yml")))


def test_a_merged_run_has_of_each_block_its_core_and_of_the_coarse_run_what_is_far(configs, coarse, street, tmp_path):
    merged = TrainedRun.load(merge(configs, tmp_path / "merged"))
    cells = [cell.moved(merged.datamanager.scene_to_world) for cell in Blocks.read(street / BLOCKS).cells]
    means = merged.model.means.detach().double().numpy()
    metadata = merged.datamanager.train_dataparser_outputs.metadata
    region = block_run(coarse, "west", tmp_path).pipeline.model.region
    assert region is not None
    near = region.near(merged.model.means).numpy()
    assert 0 < near.sum() < len(near)
    for cell, config in zip(cells, configs, strict=True):
        trained = gaussians(config)["means"].double().numpy()
        distances = np.linalg.norm(trained - metadata["centre"], axis=1)
        expected = trained[cell.core(trained) & (distances < region.far)]
        np.testing.assert_array_equal(means[near & cell.core(means)], expected)
    everything = model_of(coarse).means.detach()
    assert torch.equal(merged.model.means[~near], everything[~region.near(everything)])
    exposures, theirs = merged.model.exposures, model_of(coarse).exposures
    assert exposures is not None
    assert theirs is not None
    torch.testing.assert_close(exposures.log_gains, theirs.log_gains)
    torch.testing.assert_close(exposures.log_gains.mean(dim=0), torch.zeros(3), atol=1e-6, rtol=0)
    assert merged.model.surroundings is None


def test_a_merge_says_what_its_maps_were_of_and_leaves_nothing_of_one_before_it_nor_overwrites_a_trained_run(
    configs, coarse, tmp_path
):
    folder = merge(configs, tmp_path / "merged").parent
    (checkpoint,) = folder.rglob("*.ckpt")
    of_block = find_checkpoint(configs[0].parent / "nerfstudio_models")
    maps = [load_checkpoint(path)["pipeline"]["_extra_state"]["maps"] for path in (checkpoint, of_block)]
    assert maps[0] == maps[1] != {}
    shutil.copyfile(checkpoint, checkpoint.with_name("step-000099999.ckpt"))
    (folder / "seams.json").touch()
    merge(configs, folder)
    assert list(folder.rglob("*.ckpt")) == [checkpoint]
    assert not (folder / "seams.json").exists()
    with pytest.raises(SceneError, match="is the folder of a run that was trained"):
        merge(configs, coarse.base_dir)


def test_a_merged_run_in_its_scene_finds_it(configs, street, tmp_path):
    scene = Path(shutil.copytree(street, tmp_path / "scene"))
    runs = scene / "street" / "blocks" / "runs" / "scene"
    given = []
    for config, name in zip(configs, HALVES, strict=True):
        moved = Path(shutil.copytree(config.parent, runs / name / "shellgs-metric" / "seed-0")) / "config.yml"
        run = open_run(config)
        run.output_dir, run.experiment_name, run.timestamp = runs, name, "seed-0"
        run.data = run.pipeline.datamanager.data = scene  # pyright: ignore[reportAttributeAccessIssue]
        moved.write_text(written_config(run))
        given.append(moved)
    merged = merge(given, scene / "street" / "merged" / "scene" / "shellgs-metric" / "seed-0")
    assert open_run(merged).pipeline.datamanager.data == scene  # pyright: ignore[reportAttributeAccessIssue]


def test_other_commands_take_a_merged_run(configs, tmp_path, shellgs, in_process):
    config = merge(configs, tmp_path / "merged")
    output = "--output-path", tmp_path / "eval.json", "--render-output-path", tmp_path / "views"
    in_process("ns-eval", "--load-config", config, *output)
    for picture in ("img", "depth", "normal", "normal_error"):
        assert (tmp_path / "views" / f"eval_{picture}_0000.png").is_file()
    assert np.isfinite(json.loads((tmp_path / "eval.json").read_text())["results"]["psnr"])
    assert "Gaussians" in shellgs("splats", config)
    extra = load_checkpoint(find_checkpoint(config.parent / "nerfstudio_models"))["pipeline"]["_extra_state"]
    assert len(extra["cameras"]) > 1
    assert (tmp_path / "merged" / "splats.ply").is_file()


def test_the_seams_are_reported_beside_the_run(configs, tmp_path, shellgs):
    printed = shellgs("merge", *configs, "--output", tmp_path / "merged")
    assert "Lost at the cuts (near: within 1 m of one)" in printed
    report = json.loads((tmp_path / "merged" / "seams.json").read_text())
    for of in (report, report["coarse"]):
        for part in ("near", "elsewhere"):
            assert {"psnr", "normal_deg", "chamfer_m", "holes"} <= of[part].keys()
    assert report["doubles"]["count"] >= 0
    assert report["lost"].keys() == {criterion.key for criterion in CRITERIA}


def test_near_a_cut_is_within_the_overlap_where_metres_are_unknown(configs, street, tmp_path, monkeypatch):
    run = TrainedRun.load(merge(configs, tmp_path / "merged"))
    monkeypatch.setattr(run.model, "metres_per_unit", None)
    monkeypatch.setattr(seams, "_doubles", lambda *given: (given[-1], 1))
    within = Blocks.read(street / BLOCKS).overlap * run.model_scale
    assert seams.doubles(run)["count"] == pytest.approx(within)


COARSE = {
    "near": {"psnr": 22.0, "normal_deg": 12.0, "chamfer_m": 0.06, "gap_mm": 20.0, "holes": 0.01},
    "elsewhere": {"psnr": 24.0, "normal_deg": 8.0, "chamfer_m": 0.03, "gap_mm": 10.0, "holes": 0.0},
}


def test_what_the_coarse_run_has_near_the_cuts_too_is_not_lost_there():
    smaller = {"normal_deg": 0.25, "chamfer_m": 0.25, "gap_mm": -0.25}
    better = {
        part: of | {"psnr": of["psnr"] + 3} | {key: factor * of[key] for key, factor in smaller.items()}
        for part, of in COARSE.items()
    }
    for merged in (COARSE, better):
        seams = judged(merged, COARSE)
        np.testing.assert_allclose([seam.lost for seam in seams], 0, atol=1e-9)
        assert all(seam.good for seam in seams)


@pytest.mark.parametrize(
    ("key", "change", "good"),
    [
        ("psnr", -0.5, False),
        ("psnr", 0.5, True),
        ("chamfer_m", 0.01, False),
        ("chamfer_m", -0.01, True),
        ("gap_mm", 4.0, False),
        ("gap_mm", -4.0, True),
        ("holes", 0.01, False),
    ],
)
def test_what_is_worse_near_the_cuts_than_in_the_coarse_run_is_lost_there(key, change, good):
    merged = COARSE | {"near": COARSE["near"] | {key: COARSE["near"][key] + change}}
    for seam in judged(merged, COARSE):
        assert seam.lost == pytest.approx(abs(change) * (1 if not good else -1) if seam.criterion.key == key else 0)
        assert seam.good == (good or seam.criterion.key != key)


def test_of_a_scene_whose_shell_is_not_seen_nothing_is_judged():
    assert judged({"near": {}, "elsewhere": {}}, {"near": {}, "elsewhere": {}}) == []


def test_the_nearest_cut_is_one_that_bounds_the_core_of_a_point():
    east, north = Cut((1.0, 0.0, 0.0), 0.0), Cut((0.0, 1.0, 0.0), 0.0)
    blocks = Blocks(Fork(east, Block("west", ()), Fork(north, Block("south", ()), Block("north", ()))), 1.0)
    points = np.array([[-3.0, 0.1, 0], [3, 0.1, 0], [0.2, -7, 0]])
    np.testing.assert_allclose(from_cuts(points, blocks.cells), [3, 0.1, 0.2])


def test_gaussians_of_two_blocks_in_one_place_are_doubles_and_those_of_one_block_are_not():
    points = np.array([[0.0, 0, 0], [0.01, 0, 0], [1, 0, 0], [1.01, 0, 0], [2, 0, 0]])
    blocks = np.array([0, 1, 0, 0, 1])
    np.testing.assert_array_equal(on_another(points, np.full(5, 0.2), blocks), [True, True, False, False, False])


@pytest.mark.parametrize(
    ("broken", "said"),
    [
        ("missing", "no run of east"),
        ("twice", "3 runs of 2 blocks"),
        ("of the whole scene", "not a run of a block"),
        ("unfinished", "6 of its 99 iterations"),
        ("cut again", "has been cut again"),
        ("another coarse run", "another coarse run"),
        ("moved cameras", "cameras of .* have changed since .*: that of .*stood"),
        ("other settings", "has other settings than .*sh_degree"),
        ("into a run", "folder of a run that was trained: name another one"),
        ("into the scene", "folder of a scene: name another one"),
    ],
)
def test_what_cannot_be_merged_is_refused_in_a_sentence(configs, coarse, street, tmp_path, broken, said):
    given, output = list(configs), tmp_path / "merged"
    if broken == "missing":
        given = given[:1]
    elif broken == "twice":
        given.append(given[0])
    elif broken == "of the whole scene":
        given.append(coarse.base_dir / "config.yml")
    elif broken.startswith("into"):
        output = street if broken == "into the scene" else given[0].parent
    else:
        folder = Path(shutil.copytree(given[1].parent, tmp_path / "east"))
        given[1] = folder / "config.yml"
        text = given[1].read_text()
        if broken == "unfinished":
            given[1].write_text(text.replace("max_num_iterations: 6", "max_num_iterations: 99"))
        elif broken == "other settings":
            given[1].write_text(text.replace("sh_degree: 3", "sh_degree: 2"))
        else:
            (path,) = (folder / "nerfstudio_models").glob("*.ckpt")
            state = torch.load(path, weights_only=True)
            extra = state["pipeline"]["_extra_state"]
            if broken == "moved cameras":
                for camera in extra["cameras"].values():
                    camera[9] += 0.1
            else:
                extra["block"]["region" if broken == "cut again" else "coarse"] = "another"
            torch.save(state, path)
    with pytest.raises(SceneError, match=said):
        merge(given, output)
    assert not (tmp_path / "merged").exists()
