"""The methods inside nerfstudio: outputs, losses, schedules, checkpoints, metrics."""

from __future__ import annotations

import copy
import gc
import json
import math
import shutil
import signal
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from alignments import shifted
from gsplat.strategy import DefaultStrategy
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from scenes import cast, views_of
from scipy.spatial.transform import Rotation
from training_runs import data_of, densify_early, held_out, model_of, render, trainer_of

import benchmarks.step
import shellgs_method.render.view
import shellgs_method.trainer
from dataparsers.cameras import pinhole_camera
from shellgs_method.errors import INTERRUPTED, SceneError
from shellgs_method.evaluation import colours_to_normals
from shellgs_method.geometry.camera import Camera
from shellgs_method.losses.objective import KEPT_BYTES, MAX_KEPT_SHARE
from shellgs_method.machine import cpp, progress
from shellgs_method.machine.progress import Stage
from shellgs_method.render.maps import geometry_channels
from shellgs_method.shell import ALIGNMENT
from shellgs_method.trainer import FacadeTrainer


@pytest.fixture(scope="module")
def trained(pristine_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> FacadeTrainer:
    """A shellgs run of 60 iterations."""
    trainer = trainer_of(pristine_scene, tmp_path_factory.mktemp("run"), iterations=60)
    trainer.train()
    trainer.pipeline.eval()
    return trainer


def test_every_output_of_a_held_out_view_is_an_image(trained):
    outputs = render(trained)
    assert {name: tuple(image.shape) for name, image in outputs.items()} == {
        "rgb": (32, 48, 3),
        "accumulation": (32, 48, 1),
        "background": (32, 48, 3),
        "depth": (32, 48, 1),
        "normal": (32, 48, 3),
    }
    assert all(image.isfinite().all() for image in outputs.values())


def test_rendered_normals_are_unit_and_face_the_camera(trained):
    outputs = render(trained)
    seen = outputs["accumulation"][..., 0] > 0.5
    normal = colours_to_normals(outputs["normal"])[seen]
    rays = pinhole_camera(held_out(trained)[0]).rays()[seen]
    assert seen.sum() > 200
    torch.testing.assert_close(normal.norm(dim=-1), torch.ones(len(normal)))
    # The composite of facing normals faces the pixel's own ray except at grazing angles.
    assert ((normal * rays).sum(dim=-1) < 0).float().mean() > 0.98


def test_held_out_views_are_rendered_by_the_kernels_of_training(compiler, pristine_scene, tmp_path, monkeypatch):
    trainer = trainer_of(pristine_scene, tmp_path, iterations=2)
    trainer.train()
    trainer.pipeline.eval()
    monkeypatch.setattr(cpp, "load_library", None)
    outputs = render(trainer)
    assert not any(output.requires_grad for output in outputs.values())


def graphs() -> int:
    """Number of tensors that a backward pass could start from."""
    gc.collect()
    return sum(issubclass(type(each), torch.Tensor) and each.grad_fn is not None for each in gc.get_objects())


def test_a_render_outside_training_keeps_no_graph(trained):
    model_of(trained).info.clear()
    model_of(trained).geometry = None
    before = graphs()
    render(trained)
    assert graphs() == before


def test_a_training_and_an_evaluation_tell_what_they_are_doing(pristine_scene, tmp_path, monkeypatch, capsys):
    """The launcher shows it."""
    monkeypatch.setattr(progress, "EVERY", 0.0)
    trainer = trainer_of(pristine_scene, tmp_path, "shellgs_metric", iterations=3)
    trainer.train()
    trainer.pipeline.get_average_eval_image_metrics()
    stages = [str(stage) for line in capsys.readouterr().out.splitlines() if (stage := Stage.read(line))]
    views, held_out_views = (
        len(dataset) for dataset in (data_of(trainer).train_dataset, data_of(trainer).eval_dataset)
    )
    expected = [
        f"caching / undistorting train images {views} of {views}",
        f"placing the first Gaussians 1 of {views}",
        "loading kernels",
        "iteration 2 of 3",
        "iteration 3 of 3",
        f"looking for unshaped Gaussians 1 of {views}",
        f"evaluating view 1 of {held_out_views}",
    ]
    assert [stage for stage in dict.fromkeys(stages) if stage in expected] == expected


@pytest.mark.parametrize(("step", "apart"), [(2, [3]), (9, [3]), (10, [None]), (18, [None])])
def test_gradients_that_densify_are_kept_apart_only_until_densification_stops(trained, monkeypatch, step, apart):
    model, (camera, _) = model_of(trained), data_of(trained).next_train(0)
    monkeypatch.setattr(model, "training", True)
    monkeypatch.setattr(model, "step", step)
    monkeypatch.setattr(model.strategy, "refine_stop_iter", 10)
    given, rasterize = [], shellgs_method.render.view.rasterize

    def watched(*args, n_densifying):
        given.append(n_densifying)
        return rasterize(*args, n_densifying=n_densifying)

    monkeypatch.setattr(shellgs_method.render.view, "rasterize", watched)
    outputs = model.get_outputs(camera)
    assert given == apart
    outputs["depth"].sum().backward()
    densifies = model.info["means2d"].grad  # depth densifies nothing
    assert (densifies.norm() == 0) == (step < 10)


def test_metrics_of_training_views_are_computed_in_the_steps_that_log_them(trained, monkeypatch):
    model, (camera, batch) = model_of(trained), data_of(trained).next_train(0)
    monkeypatch.setattr(model, "training", True)
    outputs = model.get_outputs(camera)
    assert model.log_every == trained.config.logging.steps_per_log == 10
    for step, names in ((20, {"psnr", "gaussian_count"}), (21, set()), (29, set()), (30, {"psnr", "gaussian_count"})):
        monkeypatch.setattr(model, "step", step)
        assert set(model.get_metrics_dict(outputs, batch)) == names


def test_losses_of_a_training_view_are_cached_while_there_is_room(trained, monkeypatch):
    model, (_, batch) = model_of(trained), held_out(trained)
    assert len(model.objective._views) == 8  # of 10, two are held out
    monkeypatch.setattr(model.objective, "_views", {})
    held_out_view = model._view(batch)
    assert model._view(batch) is not held_out_view  # its index is also a training view's
    monkeypatch.setattr(model, "training", True)
    kept = model._view(batch)
    assert model._view(batch) is kept
    pixels = batch["image"][..., 0].numel()
    monkeypatch.setattr(model.objective, "_room", None)
    monkeypatch.setattr(
        "shellgs_method.losses.objective.free_memory", lambda device: 2.5 * pixels * KEPT_BYTES / MAX_KEPT_SHARE
    )
    for index in (20, 21):
        new = batch | {"image_idx": index}
        assert model._view(new) is model._view(new)
    full = batch | {"image_idx": 22}
    assert model._view(full) is not model._view(full)


def test_training_improves_image_and_normals(trained, pristine_scene, tmp_path):
    untrained = trainer_of(pristine_scene, tmp_path)
    untrained.pipeline.eval()
    before, after = (
        model_of(trainer).get_image_metrics_and_images(render(trainer), held_out(trainer)[1])[0]
        for trainer in (untrained, trained)
    )
    assert after["psnr"] > before["psnr"] + 0.5
    assert after["normal_deg"] < before["normal_deg"] - 1


def test_the_normal_of_a_gaussian_is_its_shortest_axis_turned_to_the_camera():
    rotation = Rotation.from_rotvec(np.random.default_rng(1).normal(0, 2, (20, 3)))
    quats = torch.from_numpy(rotation.as_quat()[:, [3, 0, 1, 2]]).float()
    scales = torch.tensor([0.0, -3.0, 1.0]).expand(20, 3)
    means = torch.from_numpy(np.random.default_rng(0).uniform(-1, 1, (20, 3))).float() + torch.tensor([0, 0, 5.0])
    camera = Camera(torch.eye(4), torch.eye(3), 4, 4)
    normals, depths = geometry_channels({"means": means, "quats": quats, "scales": scales}, camera, "expected")
    axis = torch.from_numpy(rotation.as_matrix()[:, :, 1]).float()
    torch.testing.assert_close((normals * axis).sum(dim=-1).abs(), torch.ones(20))
    assert ((normals * means).sum(dim=-1) < 0).all()
    torch.testing.assert_close(depths[:, 0], means[:, 2])


def test_a_nerfstudio_camera_looks_along_minus_z_and_ours_along_plus_z():
    pose = torch.tensor([[[1.0, 0, 0, 2], [0, 1, 0, 3], [0, 0, 1, 4]]])
    camera = pinhole_camera(Cameras(pose, fx=5.0, fy=6.0, cx=2.0, cy=1.0, width=4, height=2))
    ahead_right_up = torch.tensor([2.5, 3.25, 3.0, 1.0])  # 0.5 to the right, 0.25 up, 1 ahead
    torch.testing.assert_close(camera.viewmat @ ahead_right_up, torch.tensor([0.5, -0.25, 1.0, 1.0]))


def test_schedules_scale_with_the_run(pristine_scene, tmp_path):
    trainer = trainer_of(pristine_scene, tmp_path, iterations=3000)
    strategy = model_of(trainer).strategy
    assert isinstance(strategy, DefaultStrategy)
    assert (strategy.refine_start_iter, strategy.refine_stop_iter) == (50, 1500)
    assert strategy.reset_every == 1000
    scheduler = trainer.optimizers.schedulers["means"]
    assert isinstance(scheduler, torch.optim.lr_scheduler.LambdaLR)
    factor = scheduler.lr_lambdas[0]
    assert [factor(0), factor(1500), factor(3000)] == pytest.approx([1.0, 0.1, 0.01])


def test_geometry_weights_follow_the_run(trained):
    """With the same rendering and batch, the depth weight falls from 0.5 to 0.1 over the run, the others stay."""
    model = model_of(trained)
    outputs, (_, batch) = render(trained), held_out(trained)
    losses = []
    for model.step in (0, 30, 60):
        losses.append(model.get_loss_dict(outputs, batch))
    start, half, end = ({name: float(value) for name, value in loss.items()} for loss in losses)
    assert half["depth"] / start["depth"] == pytest.approx(0.2**0.5, rel=1e-4)
    assert end["depth"] / start["depth"] == pytest.approx(0.2, rel=1e-4)
    assert start["normal"] == end["normal"]
    assert start["smoothness"] == end["smoothness"]


def test_a_view_without_a_map_trains_with_its_photograph_alone(trained):
    model = model_of(trained)
    outputs, (_, batch) = render(trained), held_out(trained)
    bare = {key: value for key, value in batch.items() if not key.startswith("shell")}
    assert model.get_loss_dict(outputs, bare).keys() == {"photometric"}
    assert model.get_loss_dict(outputs, batch).keys() == {"photometric", "depth", "normal", "smoothness"}


def test_masked_out_pixels_supervise_nothing(trained):
    model = model_of(trained)
    outputs, (_, batch) = render(trained), held_out(trained)
    losses = model.get_loss_dict(outputs, batch | {"mask": torch.zeros(32, 48, 1, dtype=torch.bool)})
    assert all(float(value) == 0 for value in losses.values())


def test_a_compiled_step_is_that_of_plain_torch(compiler, pristine_scene, tmp_path, monkeypatch):
    losses, gradients = [], []
    for compiled in ("1", "0"):
        monkeypatch.setenv("SHELLGS_COMPILE", compiled)
        trainer = trainer_of(pristine_scene, tmp_path, "shellgs_metric")
        model_of(trainer).step_cb(trainer.optimizers, 0)
        _, terms, _ = trainer.pipeline.get_train_loss_dict(step=0)
        parameters = list(model_of(trainer).gauss_params.values())
        losses.append(terms)
        gradients.append(torch.autograd.grad(torch.stack([*terms.values()]).sum(), parameters))
    torch.testing.assert_close(*losses)
    for actual, expected in zip(*gradients, strict=True):
        assert (actual - expected).norm() <= 1e-3 * expected.norm()


def test_photo_gs_renders_no_geometry_while_it_trains(pristine_scene, tmp_path):
    trainer = trainer_of(pristine_scene, tmp_path, "photo_gs")
    trainer.train()
    trainer.pipeline.train()
    camera, _ = trainer.pipeline.datamanager.next_train(0)
    assert "normal" not in trainer.pipeline.model(camera)


def test_the_same_seed_on_one_thread_gives_the_same_run_to_the_last_digit(pristine_scene, tmp_path, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "1")

    def gaussians(folder: str) -> dict[str, torch.Tensor]:
        trainer = trainer_of(pristine_scene, tmp_path / folder, "shellgs_metric", iterations=12, change=densify_early)
        trainer.train()
        return {name: parameter.detach() for name, parameter in model_of(trainer).gauss_params.items()}

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    first, second = gaussians("first"), gaussians("second")
    torch.set_num_threads(before)
    assert all(torch.equal(first[name], second[name]) for name in first)


def test_a_checkpoint_loads_as_weights_only(trained):
    (checkpoint,) = trained.checkpoint_dir.glob("*.ckpt")
    loaded = torch.load(checkpoint, weights_only=True)
    assert loaded["step"] == 59
    assert not any("lpips" in key for key in loaded["pipeline"])


def test_a_resumed_run_trains_the_restored_parameters_to_the_planned_end(pristine_scene, tmp_path):
    first = trainer_of(pristine_scene, tmp_path / "first", iterations=4)
    first.train()
    saved = {name: parameter.detach().clone() for name, parameter in model_of(first).gauss_params.items()}

    second = trainer_of(pristine_scene, tmp_path / "second", iterations=7, load_dir=first.checkpoint_dir)
    model = model_of(second)
    for name, parameter in model.gauss_params.items():
        torch.testing.assert_close(parameter.detach(), saved[name], msg=name)
        assert second.optimizers.optimizers[name].param_groups[0]["params"][0] is parameter
        assert second.optimizers.optimizers[name].state[parameter]["step"] == 4
    second.train()
    assert second.step == 6
    assert (model.opacities.detach() - saved["opacities"]).abs().max() > 0.05


def saving_often(config) -> None:
    densify_early(config)
    config.steps_per_save, config.save_only_latest_checkpoint = 8, False


@pytest.fixture(scope="module")
def whole(pristine_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[FacadeTrainer]:
    """A run of 20 iterations on one thread, with which a seed gives the same numbers again."""
    before = torch.get_num_threads()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("OMP_NUM_THREADS", "1")
        torch.set_num_threads(1)
        trainer = trainer_of(pristine_scene, tmp_path_factory.mktemp("whole"), "shellgs", 20, change=saving_often)
        trainer.train()
        yield trainer
    torch.set_num_threads(before)


def ends_alike(trainer: FacadeTrainer, whole: FacadeTrainer) -> bool:
    """Whether Gaussians and sums of gradients are the same to the last digit."""
    gaussians, sums = model_of(whole).gauss_params, model_of(whole).strategy_state
    return all(torch.equal(each, gaussians[name]) for name, each in model_of(trainer).gauss_params.items()) and all(
        torch.equal(sums[name], each)
        for name, each in model_of(trainer).strategy_state.items()
        if name in ("grad2d", "count")
    )


def test_a_resumed_run_ends_as_one_that_was_never_stopped(whole, pristine_scene, tmp_path):
    """Moments, the order of views and random numbers are those that were saved, too."""
    (tmp_path / "saved").mkdir()
    shutil.copy(whole.checkpoint_dir / "step-000000008.ckpt", tmp_path / "saved")
    resumed = trainer_of(pristine_scene, tmp_path, "shellgs", 20, tmp_path / "saved", change=saving_often)
    assert resumed._start_step == 9
    torch.manual_seed(1)
    resumed.train()
    assert ends_alike(resumed, whole)


def test_ctrl_c_saves_the_iteration_and_the_run_resumes_there(whole, pristine_scene, tmp_path, monkeypatch, capsys):
    def stop_at_12(step: int) -> None:
        if step == 12:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(signal, "getsignal", lambda _: signal.default_int_handler)  # a test's may be another
    stopped = trainer_of(pristine_scene, tmp_path / "s", "shellgs", 20, change=saving_often)
    stopped.callbacks.insert(0, TrainingCallback([TrainingCallbackLocation.BEFORE_TRAIN_ITERATION], stop_at_12))
    with pytest.raises(SystemExit) as end:
        stopped.train()
    assert end.value.code == INTERRUPTED
    saved = stopped.checkpoint_dir
    assert sorted(path.name for path in saved.iterdir()) == ["step-000000008.ckpt", "step-000000012.ckpt"]
    assert f"Stopped after 13 of 20 iterations: resume with --load-dir {saved}." in capsys.readouterr().out
    resumed = trainer_of(pristine_scene, tmp_path / "r", "shellgs", 20, saved, change=saving_often)
    resumed.train()
    assert ends_alike(resumed, whole)


def test_ctrl_c_ends_the_viewer_of_a_finished_run_at_once(trained, monkeypatch):
    monkeypatch.setattr(trained, "training_state", "completed")
    with pytest.raises(KeyboardInterrupt):
        trained._stop()


def test_a_resumed_run_keeps_which_gaussians_are_behind_the_shell(pristine_scene, tmp_path):
    """As the run did that was stopped: those that passed the shell since are told at the next densification."""
    first = trainer_of(pristine_scene, tmp_path / "first", "shellgs_metric", iterations=4)
    first.train()
    (checkpoint,) = first.checkpoint_dir.glob("*.ckpt")
    stored = torch.load(checkpoint)
    surface = stored["pipeline"]["_model.surface"]
    surface[0] = 0.5  # neither behind nor before
    torch.save(stored, checkpoint)
    model = model_of(trainer_of(pristine_scene, tmp_path / "r", "shellgs_metric", 20, first.checkpoint_dir))
    model.update_surface()
    assert model.surface is not None
    assert torch.equal(model.surface, surface)


def test_a_resumed_run_loads_another_number_of_gaussians(pristine_scene, tmp_path):
    first = trainer_of(pristine_scene, tmp_path / "first", iterations=1)
    state = first.pipeline.state_dict()
    fewer = {key: value[:50] if "gauss_params" in key else value for key, value in state.items()}
    first.pipeline.load_pipeline(fewer, 0)
    assert model_of(first).num_points == 50
    first.train()


def test_a_run_is_not_resumed_over_other_cameras(pristine_scene, tmp_path):
    scene = Path(shutil.copytree(pristine_scene, tmp_path / "scene"))
    first = trainer_of(scene, tmp_path / "first", "photo_gs", iterations=4)
    first.train()
    path = scene / "transforms.json"
    cameras = json.loads(path.read_text())
    for frame in cameras["frames"]:
        for row in frame["transform_matrix"][:3]:
            row[3] *= 2  # as of structure from motion that was made again
    path.write_text(json.dumps(cameras))
    with pytest.raises(SystemExit, match=r"is not the scene that the run .*: correct --data, or train again"):
        trainer_of(scene, tmp_path / "second", "photo_gs", 6, first.checkpoint_dir)


@pytest.mark.parametrize(("right", "told"), [(0.0, False), (0.1, True)])
def test_a_run_is_told_of_maps_that_were_cast_again_after_another_alignment(scene, tmp_path, caplog, right, told: bool):
    cast(scene, views_of(scene), shifted())
    first = trainer_of(scene, tmp_path / "first", iterations=2)
    first.train()
    cast(scene, views_of(scene), shifted(right))
    trainer_of(scene, tmp_path / "second", iterations=4, load_dir=first.checkpoint_dir)
    words = f"the shell maps of {scene} were made again since the checkpoint was trained, from another {ALIGNMENT}, and"
    assert (words in caplog.text) is told


@pytest.mark.parametrize(("interval", "told"), [(8, False), (9, True)])
def test_held_out_photographs_that_the_checkpoint_was_trained_on_are_told(
    pristine_scene, tmp_path, caplog, interval, told
):
    def others(config):
        config.pipeline.datamanager.dataparser.eval_interval = interval

    first = trainer_of(pristine_scene, tmp_path / "first", "photo_gs", iterations=2)
    first.train()
    trainer_of(pristine_scene, tmp_path / "second", "photo_gs", 4, first.checkpoint_dir, others)
    words = "1 of the held-out photographs, images/frame_00010.png for example, were trained on until this checkpoint"
    assert (words in caplog.text) is told


@pytest.mark.parametrize(
    ("settings", "told"), [({}, False), ({"cache_images": "cpu"}, False), ({"holdout": "A", "band_width": 1.0}, True)]
)
def test_a_run_that_is_resumed_with_other_settings_is_told(pristine_scene, tmp_path, caplog, settings, told: bool):
    def changed(config):
        vars(config.pipeline.datamanager).update(settings)

    def saved(config):
        config.set_experiment_name()
        config.save_config()

    first = trainer_of(pristine_scene, tmp_path / "first", iterations=2, change=saved)
    first.train()
    again = trainer_of(pristine_scene, tmp_path / "second", "shellgs", 4, first.checkpoint_dir, changed)
    again.train()
    others = "other settings (pipeline.datamanager.holdout: none, now A; pipeline.datamanager.band_width: 2.0, now 1.0)"
    assert (others in caplog.text) is ("other settings" in caplog.text) is told
    assert (f"--load-config {first.config.get_base_dir() / 'config.yml'} --load-dir" in caplog.text) is told


def test_a_resumed_run_has_its_own_learning_rates(pristine_scene, tmp_path):
    def faster(config):
        config.optimizers = copy.deepcopy(config.optimizers)
        for name in ("means", "scales"):
            config.optimizers[name]["optimizer"].lr *= 4

    first = trainer_of(pristine_scene, tmp_path / "first", "photo_gs", iterations=2)
    first.train()
    again = trainer_of(pristine_scene, tmp_path / "second", "photo_gs", 8, first.checkpoint_dir, faster)
    means, scales = (again.optimizers.optimizers[name] for name in ("means", "scales"))
    start, end = (
        again.config.optimizers["means"]["optimizer"].lr,
        again.config.optimizers["means"]["scheduler"].lr_final,
    )
    assert means.param_groups[0]["lr"] == pytest.approx(start * (end / start) ** (2 / 8))
    assert scales.param_groups[0]["lr"] == again.config.optimizers["scales"]["optimizer"].lr
    assert means.state[model_of(again).means]["step"] == 2
    again.train()
    assert means.param_groups[0]["lr"] == pytest.approx(end)


@pytest.mark.parametrize(("turned", "told"), [(0.0, False), (3.0, True)])
def test_a_resumed_run_is_told_of_a_camera_that_has_changed(pristine_scene, tmp_path, caplog, turned, told: bool):
    scene = Path(shutil.copytree(pristine_scene, tmp_path / "scene"))
    first = trainer_of(scene, tmp_path / "first", "photo_gs", iterations=2)
    first.train()
    path = scene / "transforms.json"
    cameras = json.loads(path.read_text())
    pose = np.array(cameras["frames"][5]["transform_matrix"])
    pose[:3, :3] @= Rotation.from_euler("y", turned, degrees=True).as_matrix()
    cameras["frames"][5]["transform_matrix"] = pose.tolist()
    path.write_text(json.dumps(cameras))
    trainer_of(scene, tmp_path / "second", "photo_gs", 4, first.checkpoint_dir)
    name = cameras["frames"][5]["file_path"]
    words = f"the cameras of {scene} are not those that the checkpoint was trained with: that of {name} was turned"
    assert (words in caplog.text) is told


def test_resuming_a_finished_run_changes_nothing(trained, pristine_scene, tmp_path):
    again = trainer_of(pristine_scene, tmp_path, iterations=60, load_dir=trained.checkpoint_dir)
    again.train()
    assert not again.checkpoint_dir.exists()


def test_gaussians_that_training_views_have_not_shaped_are_removed_at_the_end(trained, pristine_scene, tmp_path):
    config = {"iterations": 62, "load_dir": trained.checkpoint_dir}
    plain, planted = (trainer_of(pristine_scene, tmp_path / name, **config) for name in ("plain", "planted"))
    moved = model_of(planted)
    for index, distance, log_scale in (
        (0, -10.0, -10.0),  # behind all cameras, as all look at the facade
        (1, 0.02, math.log(0.02)),  # right in front of one of them
        (2, 0.02, math.log(0.002)),  # the same, but too small to reach it
    ):
        camera = data_of(planted).train_dataset.camera(index)
        moved.means.data[index] = (camera.position + distance * camera.viewmat[2, :3]).float()
        moved.scales.data[index] = log_scale
    # All views barely show these needles, of which the long one reaches cameras.
    for index, length in ((3, 0.5), (4, 0.002)):
        moved.means.data[index] = moved.means.data.mean(dim=0)
        moved.scales.data[index] = torch.tensor([length, 1e-5, 1e-5]).log()
        moved.opacities.data[index] = math.log(0.01)
    for trainer in (plain, planted):
        trainer.train()
    (saved,) = planted.checkpoint_dir.glob("*.ckpt")
    count = len(torch.load(saved)["pipeline"]["_model.gauss_params.means"])
    assert count == moved.num_points == model_of(plain).num_points - 3


def test_what_gaussians_cover_of_a_training_view_adds_up_to_its_opacity(trained, monkeypatch):
    model, (camera, _) = model_of(trained), data_of(trained).next_train(0)
    monkeypatch.setattr(model, "training", True)
    area, in_view = model.coverage(pinhole_camera(camera))
    torch.testing.assert_close(area.sum(), model.get_outputs(camera)["accumulation"].sum().detach())
    assert (area[in_view] > 0).float().mean() > 0.5
    assert not area[~in_view].any()


def test_a_failed_save_leaves_the_last_checkpoint(trained, monkeypatch):
    before = sorted(trained.checkpoint_dir.iterdir())

    def full_disk(_, path):
        Path(path).write_bytes(b"half")
        raise OSError("No space left on device")

    monkeypatch.setattr(torch, "save", full_disk)
    with pytest.raises(SceneError, match=r"No space left.* disk .*--load-dir"):
        trained.save_checkpoint(77)
    assert sorted(trained.checkpoint_dir.iterdir()) == before
    assert not list(trained.base_dir.glob("checkpoint-*"))


def test_the_parts_of_a_step_are_timed_on_a_trained_run(trained, capsys):
    trained.config.save_config()
    benchmarks.step.main(benchmarks.step.Benchmark((trained.config.get_base_dir() / "config.yml",), steps=1))
    printed = capsys.readouterr().out
    assert all(part in printed for part in ("backward", "whole step", "rasterizer alone"))


@pytest.mark.parametrize("method", ["shellgs", "photo_gs"])
def test_every_method_is_measured_against_shell_and_truth(pristine_scene, tmp_path, method):
    trainer = trainer_of(pristine_scene, tmp_path, method, iterations=10)
    trainer.train()
    metrics = trainer.pipeline.get_average_eval_image_metrics(get_std=True)
    geometric = {
        "depth_mae_m",
        "normal_deg",
        "depth_normal_deg",
        "accuracy_m",
        "chamfer_m",
        "f_score_10cm",
        "supported",
    }
    assert {"psnr", "ssim", *geometric, *(f"truth_{name}" for name in geometric)} <= metrics.keys()
    assert np.isfinite(list(metrics.values())).all()


def test_a_held_out_view_without_a_map_has_image_metrics_only(scene, tmp_path):
    (scene / "cues" / "shell" / "images" / "frame_00001.png.npz").unlink()
    trainer = trainer_of(scene, tmp_path, iterations=5)
    trainer.train()
    metrics = trainer.pipeline.get_average_eval_image_metrics()
    assert metrics["normal_deg_views"] == 1
    assert "psnr_views" not in metrics


def test_a_shell_method_on_a_scene_without_shell_maps_ends_with_one_sentence(scene, tmp_path):
    shutil.rmtree(scene / "cues" / "shell")
    with pytest.raises(SystemExit, match=r"this method needs the shell maps .* run `shellgs cast"):
        trainer_of(scene, tmp_path)


def test_photo_gs_needs_no_shell(scene, tmp_path):
    shutil.rmtree(scene / "cues")
    trainer_of(scene, tmp_path, "photo_gs", iterations=2).train()


def test_a_map_of_another_camera_ends_training_with_one_sentence(scene, tmp_path):
    maps = scene / "cues" / "shell" / "images"
    shutil.copy(maps / "frame_00004.png.npz", maps / "frame_00002.png.npz")
    with pytest.raises(SystemExit, match=r"^shellgs: .*frame_00002.png.*shellgs cast"):
        trainer_of(scene, tmp_path)


def test_a_load_dir_without_a_checkpoint_ends_with_one_sentence(pristine_scene, tmp_path):
    with pytest.raises(SystemExit, match="holds no checkpoint"):
        trainer_of(pristine_scene, tmp_path, load_dir=tmp_path)


@pytest.mark.parametrize(("method", "steps"), [("shellgs_metric", [3]), ("photo_gs", [])])
def test_what_is_hardly_shown_goes_once_when_densification_stops(method, steps, pristine_scene, tmp_path, monkeypatch):
    trainer = trainer_of(pristine_scene, tmp_path, method, iterations=6)
    counts, found = [], []

    def five(cameras, coverage) -> torch.Tensor:
        areas = torch.stack([coverage(camera)[0] for camera in cameras])
        assert areas.shape == (len(data_of(trainer).train_dataset), model_of(trainer).num_points)
        counts.append(model_of(trainer).num_points)
        found.append(trainer.step)
        return torch.arange(areas.shape[1]) < 5

    monkeypatch.setattr(shellgs_method.trainer, "hardly_shown", five)
    monkeypatch.setattr(shellgs_method.trainer, "unshaped", lambda means, *_: torch.zeros(len(means), dtype=torch.bool))
    trainer.train()
    assert found == steps
    assert all(model_of(trainer).num_points == count - 5 for count in counts)
