"""Which maps training and evaluation read: those that they do not need cannot stop them."""

from __future__ import annotations

import copy
import json
import logging
from pathlib import Path

import numpy as np
import psutil
import pytest
import torch
from PIL import Image
from scenes import views_of
from training_runs import data_of, model_of, render, trainer_of

import method_configs
from shellgs_method import cli
from shellgs_method.datamanager import FacadeDataManagerConfig
from shellgs_method.errors import SceneError
from shellgs_method.files.cue_maps import CueMaps
from shellgs_method.files.map_files import CueMap, resampled
from shellgs_method.runs.limits import check_settings
from shellgs_method.shell import ALIGNMENT, Alignment, ShellCaster, load_shell


def spoil(scene: Path, kind: str) -> None:
    """Write maps that belong to other cameras."""
    views = views_of(scene)
    maps = CueMaps.create(scene, kind, command=f"shellgs {kind} {{scene}}")
    nothing = CueMap(np.zeros((32, 48), np.float32), np.zeros((32, 48, 3), np.float16), np.zeros((32, 48), bool))
    for one, other in zip(views, views[1:] + views[:1], strict=True):
        maps.write(one.name, nothing, other.camera)
    manifest = maps.folder / "manifest.json"
    manifest.write_text(json.dumps(json.loads(manifest.read_text()) | {"sources": {"a": "b"}}))


@pytest.mark.parametrize("kind", ["mono", "shell", "truth"])
def test_maps_that_a_method_does_not_train_on_do_not_stop_it(scene, tmp_path, kind, caplog):
    spoil(scene, kind)
    trainer = trainer_of(scene, tmp_path, "photo_gs", iterations=2)
    trainer.train()
    assert not any(key.startswith(("shell", "mono", "truth")) for key in data_of(trainer).cached_train[0])
    metrics = trainer.pipeline.get_average_eval_image_metrics()
    assert {"psnr", "psnr_seen"} <= metrics.keys()
    assert ("normal_deg" in metrics, "truth_normal_deg" in metrics) == (kind != "shell", kind != "truth")
    warnings = [record.message for record in caplog.records if "No metrics against" in record.message]
    assert len(warnings) == (kind != "mono")
    assert all(f"the {kind} maps" in message for message in warnings)


def test_what_photographs_say_against_another_shell_is_refused_before_anything_is_cached(scene, tmp_path):
    spoil(scene, "checked")
    with pytest.raises(SystemExit, match=r"^shellgs: the checked map of view 'images/frame_\d+.png'.*run `shellgs"):
        trainer_of(scene, tmp_path, "shellgs")


def test_what_photographs_say_against_another_shell_stops_no_method_without_a_shell(scene, tmp_path, caplog):
    spoil(scene, "checked")
    metrics = trainer_of(scene, tmp_path, "photo_gs").pipeline.get_average_eval_image_metrics()
    assert "No metrics against the shell maps" in caplog.text
    assert "truth_normal_deg" in metrics
    assert "normal_deg" not in metrics


def with_all_maps(scene: Path) -> None:
    """Check the shell, mask two photographs, and take the maps of a third; two others are transparent on the left."""
    for name in ("frame_00007", "frame_00008"):
        with Image.open(scene / "images" / f"{name}.png") as photograph:
            pixels = np.array(photograph.convert("RGBA"))
        pixels[:, :12, 3] = 0
        Image.fromarray(pixels).save(scene / "images" / f"{name}.png")
    cli.cast(scene)
    assert CueMaps.open(scene, "checked").names
    for name in ("frame_00002", "frame_00005"):
        (scene / "masks").mkdir(exist_ok=True)
        kept = np.full((32, 48), 255, np.uint8)
        kept[:9] = 0
        Image.fromarray(kept).save(scene / "masks" / f"{name}.png.png")
    CueMaps.open(scene, "shell").remove("images/frame_00003.png")


@pytest.mark.parametrize(("method", "warned"), [("shellgs_metric", True), ("shellgs", False)])
def test_a_run_says_which_photographs_were_not_compared(scene, tmp_path, caplog, method, warned):
    trainer_of(scene, tmp_path / "before", method)
    assert ("8 of the 8 training views were not compared" in caplog.text) == warned  # the paper's trusts the shell
    caplog.clear()
    cli.cast(scene)
    trainer_of(scene, tmp_path / "after", method)
    assert "not compared" not in caplog.text
    CueMaps.open(scene, "checked").remove("images/frame_00003.png")
    trainer_of(scene, tmp_path / "partly", method)
    assert ("1 of the 8 training views were not compared" in caplog.text) == warned


@pytest.mark.parametrize("image_type", ["uint8", "float32"])
@pytest.mark.parametrize("change", [with_all_maps, lambda _: None], ids=["all maps", "shell alone"])
def test_the_memory_that_photographs_and_maps_take_is_known_before_they_are_read(scene, tmp_path, change, image_type):
    change(scene)

    def cached(config):
        config.pipeline.datamanager.cache_images_type = image_type

    data = data_of(trainer_of(scene, tmp_path, "shellgs", change=cached))
    for dataset, batches in ((data.train_dataset, data.cached_train), (data.eval_dataset, data.cached_eval)):
        held = sum(each.nbytes for batch in batches for each in batch.values() if isinstance(each, torch.Tensor))
        assert dataset.nbytes(image_type) == pytest.approx(held, rel=1e-4)


def test_only_what_is_trained_on_is_held_in_memory(scene, tmp_path):
    batch = data_of(trainer_of(scene, tmp_path)).cached_train[0]
    assert {key for key in batch if key.endswith("_depth")} == {"shell_depth"}


def test_a_cast_at_another_size_does_not_stop_metrics_against_the_truth(scene, tmp_path):
    cli.cast(scene, max_image_size=24)
    trainer = trainer_of(scene, tmp_path, "shellgs", iterations=2)
    trainer.train()
    metrics = trainer.pipeline.get_average_eval_image_metrics()
    assert {"normal_deg", "truth_normal_deg", "truth_chamfer_m"} <= metrics.keys()


@pytest.mark.parametrize("method", ["shellgs", "shellgs_metric"])
def test_a_run_at_half_the_resolution_uses_maps_of_full_size(pristine_scene, tmp_path, method):
    def halve(config):
        config.pipeline.datamanager.camera_res_scale_factor = 0.5

    trainer = trainer_of(pristine_scene, tmp_path, method, iterations=2, change=halve)
    trainer.train()
    assert data_of(trainer).cached_train[0]["shell_depth"].shape == (16, 24, 1)
    assert render(trainer)["rgb"].shape == (16, 24, 3)
    assert {"psnr", "normal_deg", "truth_chamfer_m"} <= trainer.pipeline.get_average_eval_image_metrics().keys()


@pytest.mark.parametrize("factor", [0.0, -0.5, 2.0, float("nan")])
def test_a_scale_of_the_resolution_beyond_its_limits_is_refused(factor):
    config = copy.deepcopy(method_configs.photo_gs.config)
    assert isinstance(config.pipeline.datamanager, FacadeDataManagerConfig)
    config.pipeline.datamanager.camera_res_scale_factor = factor
    with pytest.raises(SceneError, match=r"camera_res_scale_factor cannot be .*: give a number above 0 to 1"):
        check_settings(config)


@pytest.mark.parametrize("size", [(24, 16), (36, 24), (96, 64)])
def test_a_resampled_map_equals_one_cast_at_that_size(scene, size):
    """On planes to float32's rounding; at edges the nearest pixel is taken."""
    alignment = Alignment.load(scene / ALIGNMENT)
    caster = ShellCaster(load_shell(scene / alignment.shells[0]), alignment.shell_to_scene)
    camera = views_of(scene)[4].camera
    wanted = camera.resized(*size)
    resized, expected = resampled(caster.cast(camera), wanted), caster.cast(wanted)
    both = resized.mask & expected.mask
    relative = np.abs(resized.depth / np.where(both, expected.depth, 1) - 1)[both]
    assert (resized.mask == expected.mask).mean() > 0.93
    assert np.median(relative) < 1e-5
    assert (relative < 0.01).mean() > 0.75
    assert resized.depth.dtype == np.float32
    assert resized.depth[resized.mask].all()


@pytest.mark.parametrize(
    ("empty", "said"), [(False, "has a manifest and no maps"), (True, "none of the 8 training views has a shell map")]
)
def test_missing_maps_of_all_views_are_refused_before_training(scene, tmp_path, empty, said):
    for path in (scene / "cues" / "shell").rglob("*.npz"):
        path.unlink()
    if empty:
        spoilt = CueMaps.open(scene, "shell")
        for view in views_of(scene):
            shape = (view.camera.height, view.camera.width)
            nothing = CueMap(np.zeros(shape, np.float32), np.zeros((*shape, 3), np.float16), np.zeros(shape, bool))
            spoilt.write(view.name, nothing, view.camera)
    with pytest.raises(SystemExit, match=rf"{said}.*run `shellgs cast"):
        trainer_of(scene, tmp_path)


def test_training_views_without_a_map_are_counted(scene, tmp_path, caplog):
    (scene / "cues" / "shell" / "images" / "frame_00003.png.npz").unlink()
    trainer_of(scene, tmp_path)
    assert "1 of the 8 training views have no shell map" in caplog.text


def test_memory_is_reported_and_maps_that_do_not_fit_are_read_in_every_step(scene, tmp_path, monkeypatch, capsys):
    held, read = (trainer_of(scene, tmp_path / name, "shellgs_metric", iterations=2) for name in ("a", "b"))
    data_of(held).cached_train  # noqa: B018
    assert "of memory" not in capsys.readouterr().out
    monkeypatch.setattr("shellgs_method.datamanager.MIN_REPORTED_BYTES", 1e5)
    monkeypatch.setattr(psutil, "virtual_memory", lambda: type("Memory", (), {"available": 1e5})())
    data_of(read).train_dataset.held = True
    data_of(read).__dict__.pop("cached_train", None)
    printed = data_of(read).cached_train and " ".join(capsys.readouterr().out.split())
    assert "10 photographs and their shell maps take 0.0 GB of memory" in printed
    assert "read from disk in every step" in printed
    assert "shell_depth" not in data_of(read).cached_train[0]
    for step in range(20):  # more than twice around the views
        (_, one), (_, other) = data_of(held).next_train(step), data_of(read).next_train(step)
        assert one["image_idx"] == other["image_idx"]
        torch.testing.assert_close(one["shell_depth"], other["shell_depth"])
        assert [*data_of(read)._ahead] == data_of(read).train_unseen_cameras[: len(data_of(read)._ahead)]
    assert len(model_of(held).gauss_params["means"]) == len(model_of(read).gauss_params["means"])


def test_a_map_of_another_size_is_refused_with_the_command_for_the_wanted_size(scene):
    cli.cast(scene, max_image_size=40)
    view = views_of(scene)[0]
    with pytest.raises(
        SceneError, match=r"it is 40x27 pixels, the camera 24x16; run `shellgs cast .* --max-image-size 24`"
    ):
        CueMaps.open(scene, "shell").read(view.name, view.camera.shrunk(24))


@pytest.fixture(autouse=True)
def _warnings(caplog):
    caplog.set_level(logging.WARNING)
