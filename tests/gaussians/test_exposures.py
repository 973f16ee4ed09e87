"""Exposures of photographs, learned with a run: their mean, their start, checkpoints, and what is exported."""

from __future__ import annotations

import copy
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scenes import views_of
from training_runs import data_of, model_of, render, trainer_of

from shellgs_method.compare.measure import measure
from shellgs_method.export.runs import TrainedRun
from shellgs_method.gaussians.exposures import Exposures
from shellgs_method.occlusion.exposure import exposed
from shellgs_method.trainer import FacadeTrainer, PerViewAdamConfig

STOPS = np.log(2)
GAINS = 0.6 * STOPS * np.sin(np.arange(10))[:, None] * [1.0, 0.9, 1.1]
TRAINED = [k for k in range(10) if k % 8]
MEAN = GAINS[TRAINED].mean(axis=0)
RELATIVE = GAINS - MEAN


def learned(config) -> None:
    config.pipeline.model.exposure = "learned"


@pytest.fixture(scope="module")
def changing(pristine_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The scene with another exposure and white balance in each photograph."""
    scene = Path(shutil.copytree(pristine_scene, tmp_path_factory.mktemp("changing") / "scene"))
    for view, gain in zip(views_of(scene), GAINS, strict=True):
        image = torch.from_numpy(np.array(Image.open(view.image))) / 255
        image = exposed(image, torch.from_numpy(gain).float()).clamp(0, 1)
        Image.fromarray((255 * image).round().byte().numpy()).save(view.image)
    return scene


@pytest.fixture(scope="module")
def trained(changing: Path, tmp_path_factory: pytest.TempPathFactory) -> FacadeTrainer:
    """A shellgs-metric run of 60 iterations in changing light."""
    trainer = trainer_of(changing, tmp_path_factory.mktemp("run"), "shellgs_metric", iterations=60)
    trainer.train()
    trainer.pipeline.eval()
    return trainer


def log_gains(trainer: FacadeTrainer) -> np.ndarray:
    exposures = model_of(trainer).exposures
    assert exposures is not None
    return exposures.log_gains.detach().numpy()


@pytest.mark.parametrize("method", ["shellgs_metric", "photo_gs"])
def test_a_run_starts_from_the_exposures_of_its_photographs(changing, tmp_path, method):
    trainer = trainer_of(changing, tmp_path, method, change=learned)
    np.testing.assert_allclose(log_gains(trainer), RELATIVE[TRAINED], atol=0.15 * STOPS)


def test_seeds_have_the_mean_exposure(changing, pristine_scene, tmp_path):
    """Their colours differ less from those of the scene in constant light than the photographs do."""
    colours = {}
    for name, scene in {"changing": changing, "constant": pristine_scene}.items():
        trainer = trainer_of(scene, tmp_path / name, "shellgs_metric")
        colours[name] = model_of(trainer).colors.detach()
    count = min(map(len, colours.values()))
    mean = torch.from_numpy(MEAN).float()
    expected = exposed(colours["constant"][:count], mean)
    assert (colours["changing"][:count] - expected).abs().median() < 0.03


def test_gains_stay_near_the_true_ones_and_have_a_mean_of_zero(trained):
    found = log_gains(trained)
    np.testing.assert_allclose(found.mean(axis=0), 0, atol=1e-7)
    np.testing.assert_allclose(found, RELATIVE[TRAINED], atol=0.2 * STOPS)


def test_their_mean_is_zero_whatever_the_optimizer_does():
    exposures = Exposures(7)
    exposures.start(np.random.default_rng(0).normal(3, 1, (7, 3)))
    optimizer = torch.optim.Adam(exposures.parameters(), lr=0.5)
    for view in range(7):
        (exposures.log_gains[view] ** 2).sum().backward()
        optimizer.step()
    torch.testing.assert_close(exposures.log_gains.double().mean(dim=0), torch.zeros(3).double(), atol=1e-6, rtol=0)


@pytest.mark.parametrize("num_views", [8, 150])
def test_a_step_moves_a_photographs_gain_by_its_learning_rate_however_many_there_are(num_views):
    exposures = Exposures(num_views)
    optimizer = PerViewAdamConfig(lr=0.02, eps=1e-15).setup([exposures.parameter])
    for _ in range(5):
        before = exposures.parameter.detach().clone()
        for view in range(num_views):
            optimizer.zero_grad()
            (exposures.parameter[view] * torch.tensor([1.0, 0.1, 3.0])).sum().backward()
            optimizer.step()
    moved = (before - exposures.parameter.detach()).mean(dim=0)
    torch.testing.assert_close(moved, torch.full((3,), 0.02), rtol=0.1, atol=0)


def test_a_photograph_is_compared_with_the_render_at_its_exposure(trained):
    model, (camera, batch) = model_of(trained), data_of(trained).next_train(0)
    exposures = model.exposures
    assert exposures is not None
    at_mean = model.get_outputs_for_camera(camera)["rgb"]
    model.train()
    in_training = model.get_outputs(camera)["rgb"]
    model.eval()
    gain = exposures.log_gains[batch["image_idx"]].detach()
    inside = (at_mean < 0.95).all(dim=-1)
    expected = exposed(at_mean, gain).clamp(0, 1)
    torch.testing.assert_close(in_training.detach()[inside], expected[inside], atol=2e-3, rtol=0)


def test_held_out_views_and_splats_do_not_depend_on_the_exposures(trained):
    """Their mean is 0, so that what is rendered and exported has the mean exposure of the photographs."""
    model = model_of(trained)
    assert model.exposures is not None
    run = TrainedRun(model, data_of(trained))
    before, parameter = (render(trained), run.splats()), copy.deepcopy(model.exposures.parameter.data)
    model.exposures.parameter.data = torch.randn_like(parameter)
    after = render(trained), run.splats()
    model.exposures.parameter.data = parameter
    torch.testing.assert_close(before[0]["rgb"], after[0]["rgb"])
    torch.testing.assert_close(before[1].harmonics, after[1].harmonics)


def test_renders_are_as_bright_as_the_photographs_at_their_mean_exposure(trained):
    model, dataset, apart = model_of(trained), data_of(trained).train_dataset, []
    for index, gain in enumerate(RELATIVE[TRAINED]):
        photograph = torch.from_numpy(dataset.get_numpy_image(index)) / 255
        render = model.get_outputs_for_camera(dataset.cameras[index : index + 1])["rgb"]
        apart.append((render - exposed(photograph, -torch.from_numpy(gain).float()).clamp(0, 1)).median())
    assert max(abs(difference) for difference in apart) < 0.04


def test_photographs_of_a_texture_are_brought_to_the_mean_exposure(trained):
    """Those of training views by their learned exposures, held-out ones by their renders."""
    found = TrainedRun(model_of(trained), data_of(trained)).log_gains()
    np.testing.assert_allclose(found[:8], log_gains(trained), atol=1e-6)
    np.testing.assert_allclose(found[8:], RELATIVE[[0, 8]], atol=0.5 * STOPS)


def test_what_is_masked_out_does_not_change_the_exposure_of_a_held_out_photograph(trained, tmp_path, monkeypatch):
    run, held_out = TrainedRun(model_of(trained), data_of(trained)), data_of(trained).eval_dataset
    before, view = run.log_gains(), held_out.views[0]
    image = held_out.get_numpy_image(0)
    width = image.shape[1] * 2 // 3
    car = image.copy()
    car[:, :width] = 220
    kept = np.full(image.shape[:2], 255, np.uint8)
    kept[:, :width] = 0
    Image.fromarray(car).save(tmp_path / "car.png")
    Image.fromarray(kept).save(tmp_path / "mask.png")
    masked = replace(view, image=tmp_path / "car.png", mask=tmp_path / "mask.png")
    monkeypatch.setitem(held_out._dataparser_outputs.metadata, "views", [masked, *held_out.views[1:]])
    np.testing.assert_allclose(run.log_gains()[8], before[8], atol=0.2 * STOPS)


def test_photographs_keep_their_exposures_when_one_is_taken_out_of_the_scene(changing, tmp_path):
    """And a run without it, which ended in an IndexError, compares it with its render once it is there again."""
    scene = Path(shutil.copytree(changing, tmp_path / "scene"))
    runs = {}
    for name in ("with", "without"):
        trainer = trainer_of(scene, tmp_path / name, "shellgs_metric", iterations=4)
        trainer.config.save_config()
        trainer.train()
        runs[name] = log_gains(trainer), trainer.base_dir / "config.yml"
        (scene / "images/frame_00003.png").rename(tmp_path / "out.png") if name == "with" else None
    before, config = runs["with"]
    assert runs["without"][0].shape == (7, 3)
    np.testing.assert_array_equal(TrainedRun.load(config).log_gains()[:7], np.delete(before, 1, axis=0))
    (tmp_path / "out.png").rename(scene / "images/frame_00003.png")
    without, config = runs["without"]
    again = TrainedRun.load(config).log_gains()[:8]
    np.testing.assert_array_equal(np.delete(again, 1, axis=0), without)
    assert np.isfinite(again[1]).all()


def test_photographs_of_one_name_in_two_folders_keep_their_own_exposures(changing, tmp_path):
    """As of two cameras of a rig, whose names are as one without the folder."""
    scene = Path(shutil.copytree(changing, tmp_path / "scene"))
    cameras = json.loads((scene / "transforms.json").read_text())
    for number, frame in enumerate(sorted(cameras["frames"], key=lambda frame: frame["file_path"])):
        moved = f"{'left' if number < 5 else 'right'}/{number % 5}.png"
        (scene / moved).parent.mkdir(exist_ok=True)
        (scene / frame["file_path"]).rename(scene / moved)
        frame["file_path"] = moved
    (scene / "transforms.json").write_text(json.dumps(cameras))
    trainer = trainer_of(scene, tmp_path / "run", "photo_gs", iterations=4, change=learned)
    trainer.config.save_config()
    trainer.train()
    again = TrainedRun.load(trainer.base_dir / "config.yml").log_gains()[:8]
    np.testing.assert_array_equal(again, log_gains(trainer))


def test_a_resumed_run_has_the_same_exposures(changing, tmp_path, trained):
    half = trainer_of(changing, tmp_path / "half", "shellgs_metric", 60)
    half.config.steps_per_save = 30
    half._last_step = 30
    half.train()
    resumed = trainer_of(changing, tmp_path / "resumed", "shellgs_metric", 60, load_dir=half.checkpoint_dir)
    np.testing.assert_array_equal(log_gains(resumed), log_gains(half))
    resumed.train()
    np.testing.assert_allclose(log_gains(resumed), log_gains(trained), atol=1e-5)


@pytest.mark.parametrize(
    ("before", "after", "message"), [("fixed", "learned", "has no exposures"), ("learned", "fixed", "exposure learned")]
)
def test_a_checkpoint_with_the_other_setting_is_refused_in_a_sentence(pristine_scene, tmp_path, before, after, message):
    def chosen(name):
        return lambda config: setattr(config.pipeline.model, "exposure", name)

    old = trainer_of(pristine_scene, tmp_path / "old", "photo_gs", 2, change=chosen(before))
    old.train()
    with pytest.raises(SystemExit, match=message):
        trainer_of(pristine_scene, tmp_path / "new", "photo_gs", 4, load_dir=old.checkpoint_dir, change=chosen(after))


@pytest.mark.parametrize("interval", [3, 9])  # fewer; as many, but others
def test_a_checkpoint_of_other_photographs_is_refused_for_training(pristine_scene, tmp_path, interval):
    old = trainer_of(pristine_scene, tmp_path / "old", "photo_gs", 2, change=learned)
    old.train()

    def others(config):
        learned(config)
        config.pipeline.datamanager.dataparser.eval_interval = interval

    with pytest.raises(SystemExit, match="exposures of 8 photographs, which are not the"):
        trainer_of(pristine_scene, tmp_path / "new", "photo_gs", 4, load_dir=old.checkpoint_dir, change=others)


def test_the_log_has_their_spread(trained):
    model, (camera, batch) = model_of(trained), data_of(trained).next_train(0)
    model.train()
    model.step = 0
    metrics = model.get_metrics_dict(model.get_outputs(camera), batch)
    model.eval()
    stops = log_gains(trained).mean(axis=1) / STOPS
    assert float(metrics["exposure_stops"]) == pytest.approx(stops.std(), rel=1e-4)


def test_a_measured_run_has_them_in_stops(trained):
    trained.config.save_config()
    measured = measure(trained.config.get_base_dir() / "config.yml")
    np.testing.assert_allclose(measured["exposure_stops"], log_gains(trained) / STOPS, rtol=1e-5)
