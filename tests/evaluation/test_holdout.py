"""Bands of a facade: the same wall in every view, and different ones for training and evaluation."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scenes import views_of
from training_runs import data_of, model_of, trainer_of

from shellgs_method.evaluation.holdout import Holdout, facade_holdout
from shellgs_method.files.cue_maps import CueMaps
from shellgs_method.files.map_files import CueMap
from shellgs_method.files.photographs import View
from shellgs_method.synthetic.frames import SCENE_FROM_BUILDING, UNITS_PER_METRE

WIDTH = 2 * UNITS_PER_METRE  # width of a band, in scene units


@pytest.fixture(scope="module")
def views(pristine_scene) -> list[View]:
    return views_of(pristine_scene)


@pytest.fixture(scope="module")
def half(pristine_scene, views) -> Holdout:
    return facade_holdout(CueMaps.open(pristine_scene, "shell"), training(views), 2.0, "A")


def training(views: list[View]) -> list[View]:
    return [view for i, view in enumerate(views) if i % 8]


def shell_of(scene, view: View) -> CueMap:
    cue = CueMaps.open(scene, "shell").read(view.name, view.camera)
    assert cue is not None
    return cue


def world_points(view: View, depth: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Surface points in the scene, in float64, by inverse projection."""
    v, u = np.nonzero(mask)
    pixels = np.stack([u + 0.5, v + 0.5, np.ones(len(u))], axis=-1) * depth[mask][:, None].astype(np.float64)
    in_camera = pixels @ np.linalg.inv(view.camera.K.numpy()).T
    pose = np.linalg.inv(view.camera.viewmat.numpy())
    return in_camera @ pose[:3, :3].T + pose[:3, 3]


def test_bands_run_vertically_up_the_wall(half):
    """Their axis is the facade's horizontal, far from any axis of the world."""
    along_the_facade = SCENE_FROM_BUILDING[:3, 0] / UNITS_PER_METRE
    assert abs(half.axis.numpy() @ along_the_facade) == pytest.approx(1, abs=1e-3)
    assert half.width == pytest.approx(WIDTH)


def test_bands_do_not_depend_on_the_order_of_the_calls_or_on_a_sign(pristine_scene, views, half):
    again = facade_holdout(CueMaps.open(pristine_scene, "shell"), training(views), 2.0, "B").rest
    assert torch.equal(again.axis, half.axis)
    for view in views:
        shell = shell_of(pristine_scene, view)
        assert (again.mask(shell, view.camera) == half.mask(shell, view.camera)).all()


def test_the_halves_are_disjoint_and_cover_the_shell(pristine_scene, views, half):
    for view in views:
        shell = shell_of(pristine_scene, view)
        a, b = half.mask(shell, view.camera), half.rest.mask(shell, view.camera)
        assert not (a & b).any()
        assert ((a | b) == shell.mask).all()


def test_a_band_is_the_same_wall_in_two_views(pristine_scene, views, half):
    """A pixel's surface point lies in the same half in another view."""
    first, second = views[4], views[5]
    shell, other = shell_of(pristine_scene, first), shell_of(pristine_scene, second)
    points = world_points(first, shell.depth, shell.mask)
    labels = half.mask(shell, first.camera)[shell.mask]
    in_camera = points @ second.camera.viewmat[:3, :3].numpy().T + second.camera.viewmat[:3, 3].numpy()
    u, v = np.floor((in_camera @ second.camera.K.numpy().T)[:, :2] / in_camera[:, 2:]).astype(int).T
    inside = (u > 0) & (u < 47) & (v > 0) & (v < 31)
    u, v, z, labels = u[inside], v[inside], in_camera[inside, 2], labels[inside]
    there = half.mask(other, second.camera)
    # Pixels are about 30 cm wide here: those at a band's edge may show both halves.
    clear = np.stack([there[v, u] == there[v, u + step] for step in (-1, 1)]).all(0)
    same = clear & other.mask[v, u] & (np.abs(other.depth[v, u] / z - 1) < 0.02)
    assert same.sum() > 200
    assert 0.2 < labels[same].mean() < 0.8
    assert (there[v, u] == labels)[same].all()


@pytest.mark.parametrize("holdout", ["A", "B"])
def test_supervised_and_evaluated_wall_are_disjoint(pristine_scene, views, half, tmp_path, holdout):
    def hold_out(config):
        config.pipeline.datamanager.holdout = holdout

    trainer = trainer_of(pristine_scene, tmp_path, change=hold_out)
    datamanager = data_of(trainer)
    by_name = {view.name: view for view in views}
    halves = []
    for dataset, images in (
        (datamanager.train_dataset, datamanager.cached_train),
        (datamanager.eval_dataset, datamanager.cached_eval),
    ):
        coordinates = []
        for view, batch in zip(dataset.views, images, strict=True):
            for kind in dataset.cues:  # the shell, and in the held-out views the truth
                mask = batch[f"{kind}_mask"][..., 0].numpy()
                depth = shell_of(pristine_scene, view).depth
                assert (depth[mask] > 0).all()
                coordinates.append(world_points(by_name[view.name], depth, mask) @ half.axis.numpy())
        halves.append(np.concatenate(coordinates) % (2 * WIDTH) // WIDTH)  # 0 in A, 1 in B
    supervised, evaluated = halves
    assert len(supervised) > 1000
    assert len(evaluated) > 200
    assert (supervised == (holdout == "A")).all()
    assert (evaluated == (holdout == "B")).all()


def test_a_run_with_a_holdout_trains_and_is_evaluated(pristine_scene, tmp_path):
    def hold_out(config):
        config.pipeline.datamanager.holdout = "B"

    whole = trainer_of(pristine_scene, tmp_path / "whole", iterations=3)
    half = trainer_of(pristine_scene, tmp_path / "half", iterations=3, change=hold_out)
    half.train()
    metrics = [trainer.pipeline.get_average_eval_image_metrics() for trainer in (whole, half)]
    assert 0 < metrics[1]["supported"] < 0.8 * metrics[0]["supported"]
    assert model_of(half).step == 2


def test_a_method_without_a_shell_is_held_out_at_another_size_than_the_maps(pristine_scene, tmp_path):
    """Its held-out views are measured against the maps all the same."""

    def hold_out(config):
        config.pipeline.datamanager.holdout = "A"
        config.pipeline.datamanager.dataparser.max_image_size = 24

    trainer = trainer_of(pristine_scene, tmp_path, "photo_gs", change=hold_out)
    assert data_of(trainer).cached_eval[0]["shell_mask"].shape == (16, 24, 1)


def test_a_holdout_does_not_mask_the_photographs(pristine_scene, tmp_path):
    def hold_out(config):
        config.pipeline.datamanager.holdout = "B"

    trainer = trainer_of(pristine_scene, tmp_path, change=hold_out)
    assert all("mask" not in batch for batch in data_of(trainer).cached_train)


def test_a_holdout_without_shell_maps_is_an_error(scene, tmp_path):
    def hold_out(config):
        config.pipeline.datamanager.holdout = "B"

    (scene / "cues" / "shell" / "manifest.json").unlink()
    with pytest.raises(SystemExit, match=r"holdout needs the shell maps .* run `shellgs cast"):
        trainer_of(scene, tmp_path, "photo_gs", change=hold_out)
