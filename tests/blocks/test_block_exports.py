"""What is exported of a block's run: its core, so that all blocks together are the scene."""

from __future__ import annotations

import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from training_runs import data_of, model_of
from two_blocks import HALVES, block_run, coarse_run, cut_in_two, save_config

from shellgs_method.errors import SceneError
from shellgs_method.export.levels import Level
from shellgs_method.export.runs import TrainedRun, mesh_errors
from shellgs_method.files.blocks import BLOCKS
from shellgs_method.geometry.triangles import area_vectors
from shellgs_method.shell import ShellMesh
from shellgs_method.sim.building import Reconstruction


def area(mesh: Any) -> float:
    return float(np.linalg.norm(area_vectors(mesh.vertices, mesh.faces), axis=1).sum())


def test_a_shell_is_cut_at_a_plane_without_loss_of_area_classes_or_files():
    cube = trimesh.creation.box((2.0, 2.0, 2.0))
    classes = np.abs(cube.face_normals[:, 2] * 3).astype(np.uint8)  # top and bottom are of one class, walls of another
    shell = ShellMesh(cube.vertices, cube.faces, classes=classes, source=np.arange(12))
    normal = np.array([0.6, 0.0, 0.8])
    above, below = shell.above(normal, 0.25), shell.above(-normal, -0.25)
    assert (above.vertices @ normal).min() == pytest.approx(0.25)
    assert (below.vertices @ normal).max() == pytest.approx(0.25)
    assert area(above) + area(below) == pytest.approx(area(shell))
    for number, kind in enumerate(classes):
        parts = [part.source == number for part in (above, below)]
        assert all((part.classes[there] == kind).all() for part, there in zip((above, below), parts, strict=True))
    assert {*above.source} | {*below.source} == {*range(12)}


@pytest.fixture(scope="module")
def runs(pristine_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[TrainedRun, list[TrainedRun]]:
    """A coarse run and those of both blocks, the scene of which nobody else has."""
    folder = tmp_path_factory.mktemp("blocks")
    scene = shutil.copytree(pristine_scene, folder / "scene")
    cut_in_two(scene)
    coarse = coarse_run(scene, folder / "coarse", iterations=60)
    trainers = [coarse]
    for name in HALVES:
        trainer = block_run(coarse, name, folder / name, 20)
        save_config(trainer)
        trainer.train()
        trainers.append(trainer)
    whole, *blocks = (TrainedRun(model_of(trainer), data_of(trainer)) for trainer in trainers)
    return whole, blocks


def test_a_block_that_was_cut_anew_is_not_exported(runs):
    _, (west, _) = runs
    scene = west.datamanager.config.dataparser.data
    config = next((scene.parent / "west").rglob("config.yml"))
    assert len(TrainedRun.load(config).splats()) == len(west.splats())
    before = (scene / BLOCKS).read_bytes()
    cut_in_two(scene, overlap=0.7)
    try:
        with pytest.raises(SceneError, match="west has been cut again since the run was trained"):
            TrainedRun.load(config)
    finally:
        (scene / BLOCKS).write_bytes(before)


def test_the_shells_of_all_blocks_are_the_shell(runs):
    whole, blocks = runs
    assert sum(area(run.shell_in_frame) for run in blocks) == pytest.approx(area(whole.shell_in_frame))
    for run in blocks:
        assert run.cell.core(run.shell_in_frame.vertices[run.shell_in_frame.faces].mean(axis=1)).all()


def test_a_block_without_a_shell_has_no_geometry(runs):
    _, (west, _) = runs
    elsewhere = [(normal, offset + 1000.0) for normal, offset in west.cell.planes]
    run = TrainedRun(west.model, west.datamanager)
    vars(run)["cell"] = SimpleNamespace(planes=elsewhere, block=west.cell.block)
    with pytest.raises(SceneError, match="the shell has nothing in west"):
        _ = run.shell_in_frame


def test_the_gaussians_and_the_mesh_of_a_block_are_in_its_core(runs):
    _, blocks = runs
    for run, other in zip(blocks, reversed(blocks), strict=True):
        splats, surface = run.splats(), run.surface(0.5)
        assert 0 < len(splats) < len(run.model.gauss_params["means"])
        for points in (splats.means.numpy(), np.asarray(surface.triangles_center)):
            assert run.cell.core(points).all()
            assert not other.cell.core(points).any()
        assert mesh_errors(run, surface)["rendered"] > 0.5


def test_a_level_of_detail_of_a_block_has_what_its_photographs_show_of_its_core(runs):
    _, blocks = runs
    for run in blocks:
        splats = run.splats()
        level = Level.whole(run, splats)
        assert len(level.splats) == len(level.shown) == len(splats)
        kept = {tuple(mean) for mean in splats[level.shown > 0].means.tolist()}
        assert kept
        assert len(level.reduced(len(splats) // 2).splats) == len(splats) // 2
        area, _ = run.model.coverage(run.datasets[0].camera(0).to(run.model.device))
        shown = run.in_core & (area.cpu() > 1)
        assert {tuple(mean) for mean in splats[shown[run.in_core]].means.tolist()} <= kept


def test_a_block_is_a_building_with_its_name(runs):
    _, blocks = runs
    west = Reconstruction.of(blocks[0], 2000, None, None, None)
    east = Reconstruction.of(blocks[1], 2000, None, None, west.frame)
    assert (west.scene, east.scene) == ("scene west", "scene east")
    assert torch.equal(torch.from_numpy(west.frame.to_national), torch.from_numpy(east.frame.to_national))
    assert max(len(west.views), len(east.views)) < 10
    assert area(west.shell) + area(east.shell) == pytest.approx(area(blocks[0].shell[1]), rel=1e-3)
