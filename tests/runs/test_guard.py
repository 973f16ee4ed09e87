"""What training does about NaN and infinity, invalid settings and full disks."""

from __future__ import annotations

import copy
import math
from types import SimpleNamespace
from typing import Any

import psutil
import pytest
import torch
import tyro
from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.engine.trainer import Trainer
from training_runs import data_of, model_of, render, small_disk, trainer_of

import method_configs
from shellgs_method.files.locks import held
from shellgs_method.runs.guard import MAX_SKIPPED
from shellgs_method.trainer import FacadeTrainer

# NaN and infinity


def all_finite(trainer: FacadeTrainer) -> bool:
    """Whether Gaussians, the optimizers' moments and the densification's sums are finite."""
    model = model_of(trainer)
    moments = [value for adam in trainer.optimizers.optimizers.values() for value in adam.state.values()]
    tensors = [*model.gauss_params.values(), *(each for state in moments for each in state.values())]
    tensors += [each for each in model.strategy_state.values() if isinstance(each, torch.Tensor)]
    return all(bool(tensor.isfinite().all()) for tensor in tensors)


def spoil_map(trainer: FacadeTrainer, views: slice) -> str:
    for batch in data_of(trainer).cached_train[views]:
        batch["shell_depth"][batch["shell_mask"]] = torch.nan
        batch["shell_normal"][..., 0] = math.inf
    return data_of(trainer).train_dataset.views[views.start].name


def spoil_photograph(trainer: FacadeTrainer, views: slice) -> str:
    for batch in data_of(trainer).cached_train[views]:
        batch["image"] = batch["image"] / 255
        batch["image"][3, 5] = torch.nan
    return data_of(trainer).train_dataset.views[views.start].name


def spoil_gradient(trainer: FacadeTrainer, views: slice) -> str:
    names = [view.name for view in data_of(trainer).train_dataset.views]
    spoiled = names[views]
    model_of(trainer).scales.register_hook(
        lambda gradient: gradient * math.nan if trainer.pipeline.last_trained in spoiled else gradient
    )
    return names[views.start]


def densifying_once(config) -> None:
    """Densify at step 4 of 20, and never again."""
    model = config.pipeline.model
    model.warmup_length, model.refine_every, model.stop_split_at = 0, 4, 7500


SPOILED = {"a map": spoil_map, "a photograph": spoil_photograph, "a gradient": spoil_gradient}


@pytest.mark.parametrize("what", SPOILED)
def test_a_view_that_is_not_finite_is_named_and_skipped_and_harms_nothing_else(pristine_scene, tmp_path, capsys, what):
    trainer = trainer_of(pristine_scene, tmp_path, "shellgs", iterations=9)
    name = SPOILED[what](trainer, slice(2, 3))
    trainer.train()
    printed = " ".join(capsys.readouterr().out.split())
    assert f"of {name} is not finite (1 of at most {MAX_SKIPPED})" in printed
    assert all_finite(trainer)
    assert render(trainer)["rgb"].isfinite().all()
    assert [path.name for path in trainer.checkpoint_dir.iterdir()] == ["step-000000008.ckpt"]


def test_a_skipped_photograph_is_named_with_its_brackets(capsys):
    trainer: Any = SimpleNamespace(_unread=[(3, "images/[left] 1.png", {})], _skipped=0, step=3)
    trainer.optimizers = SimpleNamespace(skipped=lambda: [True])
    trainer._remove_broken_gaussians = lambda step: None
    FacadeTrainer._report_skipped(trainer)
    assert "of images/[left] 1.png is not finite" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize("what", SPOILED)
def test_the_guard_also_works_after_a_densification(pristine_scene, tmp_path, capsys, what):
    """Then the parameters are others than those that nerfstudio's optimizers list."""
    trainer = trainer_of(pristine_scene, tmp_path, "shellgs", iterations=20, change=densifying_once)
    first = model_of(trainer).means

    def spoil(step: int) -> None:
        if step == 5:
            assert model_of(trainer).means is not first
            SPOILED[what](trainer, slice(0, 4))  # half of the views

    trainer.callbacks.append(TrainingCallback([TrainingCallbackLocation.BEFORE_TRAIN_ITERATION], spoil))
    trainer.train()
    printed = " ".join(capsys.readouterr().out.split())
    assert f"is not finite (1 of at most {MAX_SKIPPED})" in printed
    assert "were not finite" not in printed  # no Gaussian
    assert all_finite(trainer)


def test_gradients_are_clipped_after_a_densification_too(pristine_scene, tmp_path):
    """By ``max_norm``, which nerfstudio applies to its list."""

    def clipped(config):
        densifying_once(config)
        config.optimizers["means"]["optimizer"].max_norm = 1e-12

    trainer = trainer_of(pristine_scene, tmp_path, "photo_gs", iterations=20, change=clipped)
    trainer.train()
    assert 0 < model_of(trainer).means.grad.norm() < 1.1e-12


@pytest.mark.parametrize("what", ["a map", "a gradient"])
def test_too_many_skipped_steps_end_the_run_with_the_last_good_checkpoint(pristine_scene, tmp_path, what):
    def save_often(config):
        config.steps_per_save = 4

    trainer = trainer_of(pristine_scene, tmp_path, "shellgs", iterations=60, change=save_often)
    SPOILED[what](trainer, slice(0, 7))  # all but one
    with pytest.raises(SystemExit, match=r"^shellgs: training stopped at step \d+ .*frame_\d+.png.*--load-dir"):
        trainer.train()
    (kept,) = trainer.checkpoint_dir.iterdir()
    assert all_finite(trainer)
    again = trainer_of(pristine_scene, tmp_path / "again", "shellgs", 60, load_dir=trainer.checkpoint_dir)
    assert f"step-{again._start_step - 1:09d}.ckpt" == kept.name


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("means", math.nan),
        ("scales", math.inf),
        ("quats", math.nan),
        ("opacities", math.nan),
        ("features_dc", math.inf),
        ("features_rest", math.nan),
    ],
)
def test_a_gaussian_that_is_not_finite_is_removed(pristine_scene, tmp_path, capsys, name, value):
    trainer = trainer_of(pristine_scene, tmp_path, "shellgs", iterations=3)
    model, before = model_of(trainer), model_of(trainer).num_points
    model.gauss_params[name].data[7] = value
    trainer.train()
    assert "1 Gaussians were not finite" in " ".join(capsys.readouterr().out.split())
    assert model.num_points == before - 1
    assert all_finite(trainer)
    assert render(trainer)["rgb"].isfinite().all()


def test_a_run_goes_on_with_the_half_of_its_gaussians_that_is_finite(pristine_scene, tmp_path):
    trainer = trainer_of(pristine_scene, tmp_path, "photo_gs", iterations=2)
    model, half = model_of(trainer), model_of(trainer).num_points // 2
    model.scales.data[half:] = torch.nan
    trainer.train()
    assert model.num_points == half


def lost_to_nan(trainer: FacadeTrainer) -> None:
    model_of(trainer).scales.data[:] = torch.nan


def lost_to_pruning(trainer: FacadeTrainer) -> None:
    model_of(trainer).opacities.data[:] = -20.0


def lost_from_sight(trainer: FacadeTrainer) -> None:
    model_of(trainer).means.data[:, 2] += 1e6  # above


LOST = {"no finite one": lost_to_nan, "all pruned": lost_to_pruning, "none in sight": lost_from_sight}


@pytest.mark.parametrize("how", LOST)
def test_a_run_left_without_gaussians_ends_with_one_sentence_and_saves_none(pristine_scene, tmp_path, how):
    trainer = trainer_of(pristine_scene, tmp_path, "photo_gs", iterations=20, change=densifying_once)
    LOST[how](trainer)
    with pytest.raises(SystemExit, match=r"^shellgs: training stopped .*no Gaussian left.*no checkpoint was saved"):
        trainer.train()
    assert not list(trainer.base_dir.rglob("*.ckpt"))


def test_a_run_that_loses_its_gaussians_keeps_the_checkpoint_before(pristine_scene, tmp_path):
    def save_often(config):
        densifying_once(config)
        config.steps_per_save = 2

    trainer = trainer_of(pristine_scene, tmp_path, "photo_gs", iterations=20, change=save_often)

    def lose(step: int) -> None:
        if step == 4:
            lost_to_pruning(trainer)

    trainer.callbacks.insert(0, TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], lose))
    with pytest.raises(SystemExit, match=r"pruned all.*the last good checkpoint is kept in .*--load-dir"):
        trainer.train()
    assert [path.name for path in trainer.checkpoint_dir.iterdir()] == ["step-000000002.ckpt"]


def test_gaussians_are_removed_only_while_the_viewer_does_not_render(pristine_scene, tmp_path, monkeypatch):
    trainer = trainer_of(pristine_scene, tmp_path, "photo_gs", iterations=2)
    locked = []
    for name in ("_remove_broken_gaussians", "_remove_unshaped_gaussians"):
        remove = getattr(trainer, name)

        def watched(*args, remove=remove) -> None:
            locked.append(trainer.train_lock.locked())
            remove(*args)

        monkeypatch.setattr(trainer, name, watched)
    trainer.train()
    assert len(locked) > 2
    assert all(locked)


# settings


@pytest.mark.parametrize(
    ("flag", "value"),
    [
        ("max-num-iterations", "-5"),
        ("max-num-iterations", "0"),
        ("steps-per-save", "-1"),
        ("logging.steps-per-log", "0"),
        ("optimizers.means.optimizer.lr", "nan"),
        ("optimizers.means.scheduler.lr-final", "0"),
        ("pipeline.datamanager.band-width", "0"),
        ("pipeline.model.sh-degree", "-1"),
        ("pipeline.model.sh-degree", "7"),
        ("pipeline.model.refine-every", "0"),
        ("pipeline.model.cull-alpha-thresh", "1.5"),
        ("pipeline.model.geometry.ncc-window", "8"),
        ("pipeline.model.geometry.ncc-window", "1"),
        ("pipeline.model.geometry.ncc-window", "100001"),
        ("pipeline.model.geometry.depth.initial", "nan"),
        ("pipeline.model.geometry.depth.final", "0"),
        ("pipeline.model.extra.flattening", "-1"),
        ("pipeline.model.extra.empty-space", "1e30"),
        ("pipeline.model.extra.normal_consistency-from", "-1"),
    ],
)
def test_a_setting_out_of_range_is_refused_by_ns_train_before_anything_is_written(
    tmp_path, monkeypatch, capsys, flag, value
):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as end:
        tyro.cli(AnnotatedBaseConfigUnion, args=["shellgs", "--data", "scene", f"--{flag}", value])
    assert end.value.code == 2
    printed = " ".join(capsys.readouterr().err.replace("│", " ").split())
    assert flag.rpartition(".")[2].replace("-", "_") in printed or "a loss weight" in printed
    assert not list(tmp_path.iterdir())


def test_the_viewer_of_our_methods_listens_on_this_machine_alone(pristine_scene, tmp_path):
    def with_viewer(config):
        config.vis = "viewer"
        config.get_base_dir().mkdir(parents=True)

    trainer = trainer_of(pristine_scene, tmp_path, "photo_gs", change=with_viewer)
    addresses = {
        connection.laddr.ip for connection in psutil.Process().net_connections("tcp") if connection.status == "LISTEN"
    }
    trainer.shutdown()
    assert addresses == {"127.0.0.1"}


# resumed runs


@pytest.mark.parametrize("subtracts", [False, True], ids=["anew", "from the start"])
def test_a_resumed_run_ends_at_its_length_however_nerfstudio_counts(pristine_scene, tmp_path, monkeypatch, subtracts):
    """1.1.5 counts ``max_num_iterations`` anew from the checkpoint; a later one may subtract those already done."""
    first = trainer_of(pristine_scene, tmp_path, "photo_gs", iterations=4)
    first.train()
    second = trainer_of(pristine_scene, tmp_path / "second", "photo_gs", 7, load_dir=first.checkpoint_dir)
    train = Trainer.train

    def subtracting(self):
        self.config.max_num_iterations -= self._start_step
        train(self)

    if subtracts:
        monkeypatch.setattr(Trainer, "train", subtracting)
    second.train()
    assert [path.name for path in second.checkpoint_dir.iterdir()] == ["step-000000006.ckpt"]
    assert second.optimizers.optimizers["means"].state[model_of(second).means]["step"] == 7


def test_leftovers_of_killed_saves_are_removed_at_the_next_start_but_not_a_save_in_progress(pristine_scene, tmp_path):
    first = trainer_of(pristine_scene, tmp_path, "photo_gs", iterations=1)
    first.train()
    for name in ("checkpoint-abc", "checkpoint-def"):
        (first.base_dir / name).mkdir()
        (first.base_dir / name / "step-000000000.ckpt").write_bytes(b"half")
    with held(first.base_dir / "checkpoint-def"):
        trainer_of(pristine_scene, tmp_path / "resumed", "photo_gs", 2, load_dir=first.checkpoint_dir)
    assert [path.name for path in first.base_dir.glob("checkpoint-*")] == ["checkpoint-def"]


# disks


def test_a_full_disk_ends_training_and_keeps_the_earlier_checkpoint(pristine_scene, tmp_path):
    first = trainer_of(pristine_scene, tmp_path, "photo_gs", iterations=2)
    first.train()
    before = first.checkpoint_dir / "step-000000001.ckpt"
    content = before.read_bytes()
    second = trainer_of(pristine_scene, tmp_path, "photo_gs", 4, load_dir=first.checkpoint_dir)
    with small_disk(100_000), pytest.raises(SystemExit, match=r"^shellgs: the checkpoint of step 3 .* disk "):
        second.train()
    assert before.read_bytes() == content
    assert [path.name for path in first.checkpoint_dir.iterdir()] == [before.name]
    assert not list(first.base_dir.glob("checkpoint-*"))


def test_a_full_disk_ends_a_run_whose_config_cannot_be_written(tmp_path):
    config = copy.deepcopy(method_configs.photo_gs.config)
    config.output_dir, config.experiment_name, config.timestamp = tmp_path, "facade", "run"
    with small_disk(100), pytest.raises(SystemExit, match=r"^shellgs: .*config.yml cannot be written, the disk"):
        config.save_config()
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]
