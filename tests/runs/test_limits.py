"""Settings that these methods inherit from nerfstudio: each is used, or refused where it is changed."""

from __future__ import annotations

import copy
import sys
from dataclasses import dataclass, is_dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.utils import writer
from training_runs import data_of, model_of, trainer_of

import method_configs
from shellgs_method.errors import SceneError
from shellgs_method.runs.limits import OF_NERFSTUDIO, Setting, check_training, settings
from shellgs_method.trainer import FusedAdamConfig

USED = """
    output_dir experiment_name project_name timestamp vis data relative_model_dir load_scheduler steps_per_save
    steps_per_eval_batch steps_per_eval_image steps_per_eval_all_images max_num_iterations save_only_latest_checkpoint
    load_dir load_step load_config load_checkpoint log_gradients gradient_accumulation_steps start_paused
    machine.seed machine.device_type
    logging.relative_log_dir logging.steps_per_log logging.max_buffer_size logging.profiler
    logging.local_writer.enable logging.local_writer.stats_to_track logging.local_writer.max_log_size
    viewer.websocket_port viewer.websocket_port_default viewer.websocket_host viewer.max_num_display_images
    viewer.quit_on_train_completion viewer.image_format viewer.jpeg_quality viewer.make_share_url
    viewer.camera_frustum_scale viewer.default_composite_depth
    pipeline.datamanager.data pipeline.datamanager.camera_res_scale_factor
    pipeline.datamanager.cache_images_type pipeline.datamanager.train_cameras_sampling_strategy
    pipeline.datamanager.train_cameras_sampling_seed pipeline.datamanager.fps_reset_every
    pipeline.model.warmup_length pipeline.model.refine_every pipeline.model.background_color
    pipeline.model.cull_alpha_thresh pipeline.model.cull_scale_thresh pipeline.model.densify_grad_thresh
    pipeline.model.stop_split_at pipeline.model.sh_degree
    optimizer.lr optimizer.eps optimizer.weight_decay optimizer.max_norm
"""
"""Inherited settings that change what a run does, by the end of their path."""
MANAGED = ("_target", "method_name", "scheduler.max_steps", "optimizer.fused")
"""Inherited or set by the methods, and not on the command line."""
PHOTO_GS = method_configs.photo_gs.config


def inherited() -> list[Setting]:
    """Settings whose class in nerfstudio declares them, without the configs that hold them."""

    def owner(path: str) -> type:
        config: Any = PHOTO_GS
        for name in path.split(".")[:-1]:
            config = config[name] if isinstance(config, dict) else getattr(config, name)
        return type(config)

    def first(cls: type, name: str) -> str:
        return next(base.__module__ for base in reversed(cls.__mro__) if name in vars(base).get("__annotations__", {}))

    found = [each for each in settings(PHOTO_GS) if not is_dataclass(each.value)]
    return [each for each in found if first(owner(each.path), each.field.name).startswith("nerfstudio")]


def changed(value: Any) -> Any:
    """Another value of the same type."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, (int, float)):
        return value + 2
    return {str: "other", tuple: (1,), dict: {"a": 1.0}, Path: Path("other")}.get(type(value), 3)


def with_setting(path: str, value: Any) -> Any:
    """A config of photo-gs with one setting changed."""
    config: Any = copy.deepcopy(PHOTO_GS)
    part: Any = config
    *parts, last = path.split(".")
    for name in parts:
        part = part[name] if isinstance(part, dict) else getattr(part, name)
    setattr(part, last, value)
    return config


def ends(path: str, names) -> bool:
    return any(f".{path}".endswith(f".{name}") for name in names)


UNUSED = [each for each in inherited() if not ends(each.path, [*USED.split(), *MANAGED]) and each.path != "optimizers"]


def test_settings_are_inherited_from_all_parts_of_nerfstudio():
    assert len(inherited()) > 100
    assert {"machine.num_devices", "mixed_precision", "pipeline.model.rasterize_mode"} <= {each.path for each in UNUSED}


@pytest.mark.parametrize("setting", UNUSED, ids=lambda each: each.path)
def test_an_inherited_setting_is_used_or_a_change_of_it_is_refused(setting):
    parent = setting.path.rpartition(".")[0]
    with pytest.raises(SceneError, match=rf"^({setting.path}|{parent}) cannot be .*; leave it out$"):
        check_training(with_setting(setting.path, changed(setting.value)))


def test_the_defaults_of_all_methods_pass():
    for method in ("shellgs", "shellgs_metric", "mono_gs", "photo_gs", "two_dgs"):
        check_training(getattr(method_configs, method).config)


@dataclass
class OfAnotherPlugin:
    """Settings with names of ours and nerfstudio's."""

    eps: float = 0.0
    flattening: float = -1.0


def test_settings_of_other_classes_have_no_bounds():
    assert replace(PHOTO_GS, optimizers={"means": {"optimizer": OfAnotherPlugin(), "scheduler": None}})
    with pytest.raises(SceneError, match=r"optimizers.means.optimizer.eps cannot be 0.0: give a number above 0"):
        replace(PHOTO_GS, optimizers={"means": {"optimizer": FusedAdamConfig(lr=1.0, eps=0.0), "scheduler": None}})


@pytest.mark.parametrize("config", OF_NERFSTUDIO, ids=lambda each: each.__name__)
def test_bounds_of_nerfstudios_classes_name_their_settings(config):
    assert OF_NERFSTUDIO[config].keys() <= vars(config)["__annotations__"].keys()


def test_a_trained_run_with_an_unused_setting_still_loads():
    assert replace(PHOTO_GS, mixed_precision=True).mixed_precision


@pytest.mark.parametrize(
    ("path", "value", "sentence"),
    [
        ("viewer.websocket_port", 99_999, "give a whole number from 1 to 65,535"),
        ("viewer.websocket_host", "999.1.1.1", "the viewer cannot listen at 999.1.1.1 .*websocket-host 127.0.0.1"),
        ("machine.device_type", "mps", "has no float64, which these methods need.*--machine.device-type cpu"),
        ("machine.device_type", "cuda", "torch finds no such device here"),
        ("pipeline.datamanager.dataparser", NerfstudioDataParserConfig(), "does not read scenes by nerfstudio-data"),
        ("gradient_accumulation_steps", {"colours": 2}, "give one of means, features_dc"),
        ("gradient_accumulation_steps", {"means": 0}, "cannot be means 0"),
        ("load_step", 100, "give the --load-dir"),
    ],
)
def test_what_nothing_here_can_follow_is_refused(monkeypatch, path, value, sentence):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(SceneError, match=sentence):
        check_training(with_setting(path, value))


def test_a_run_that_waits_for_the_viewers_button_needs_the_viewer():
    check_training(with_setting("start_paused", True))
    with pytest.raises(SceneError, match=r"start_paused needs the viewer.*--vis viewer\+tensorboard"):
        check_training(replace(with_setting("start_paused", True), vis="tensorboard"))


def test_comet_without_a_key_is_refused(monkeypatch):
    comet = SimpleNamespace(get_config=lambda name: {"comet.api_key": None}[name])
    monkeypatch.setitem(sys.modules, "comet_ml", comet)
    with pytest.raises(SceneError, match="comet has no key: set COMET_API_KEY"):
        check_training(with_setting("vis", "viewer+comet"))


def test_two_scenes_are_refused(tmp_path):
    config = with_setting("pipeline.datamanager.data", tmp_path / "a")
    config.pipeline.datamanager.dataparser.data = tmp_path / "b"
    with pytest.raises(SceneError, match="two scenes are given"):
        check_training(config)


def test_a_refused_setting_leaves_no_folder(tmp_path):
    config = replace(PHOTO_GS, output_dir=tmp_path / "outputs", mixed_precision=True)
    with pytest.raises(SystemExit, match=r"^shellgs: mixed_precision cannot be True"):
        config.save_config()
    assert list(tmp_path.iterdir()) == []


def test_used_settings_of_nerfstudio_do_what_they_say(pristine_scene, tmp_path, monkeypatch):
    logged = set()
    monkeypatch.setattr(writer, "put_dict", lambda name, scalar_dict, step: logged.update({name, *scalar_dict}))

    def change(config):
        config.log_gradients, config.steps_per_eval_batch, config.steps_per_eval_all_images = True, 1, 2
        config.logging.steps_per_log, config.logging.profiler = 1, "none"
        config.gradient_accumulation_steps = {"means": 3}
        config.pipeline.datamanager.train_cameras_sampling_strategy = "fps"
        config.optimizers["quats"]["optimizer"].weight_decay = 0.5
        config.relative_model_dir, config.save_only_latest_checkpoint, config.steps_per_save = Path("kept"), False, 1

    trainer = trainer_of(pristine_scene, tmp_path, "photo_gs", iterations=3, change=change)
    assert data_of(trainer).config.train_cameras_sampling_strategy == "fps"
    before = {name: value.detach().clone() for name, value in model_of(trainer).gauss_params.items()}
    trainer.train()
    second = torch.load(trainer.base_dir / "kept" / "step-000000001.ckpt")["pipeline"]
    moved = {name for name, value in before.items() if not torch.equal(second[f"_model.gauss_params.{name}"], value)}
    assert "quats" in moved
    assert "means" not in moved  # until the third step
    assert not torch.equal(model_of(trainer).means, before["means"])
    assert {"Gradients/Total", "Eval Loss Dict", "Eval Images Metrics Dict (all images)"} <= logged
    assert trainer.optimizers.optimizers["quats"].param_groups[0]["weight_decay"] == 0.5
    assert len(list((trainer.base_dir / "kept").glob("*.ckpt"))) == 2
