"""What tensorboard and wandb log while a method trains."""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from matplotlib import colormaps
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from training_runs import trainer_of

from shellgs_method.evaluation.colours import GREY, MAX_ERROR
from shellgs_method.trainer import FacadeTrainer

LAST = 30
ALL, ONE, IMAGES = "Eval Images Metrics Dict (all images)/", "Eval Images Metrics/", "Eval Images/"
MAPS = {f"{of}{what}" for of in ("", "truth_") for what in ("depth", "normal", "normal_error")}


def watched(scene: Path, folder: Path, vis: Literal["tensorboard", "wandb"]) -> FacadeTrainer:
    """A shellgs run that logs at its last step."""

    def watch(config):
        config.vis, config.logging.steps_per_log = vis, LAST
        config.steps_per_eval_image = config.steps_per_eval_all_images = LAST

    trainer = trainer_of(scene, folder, iterations=LAST + 1, change=watch)
    trainer.train()
    return trainer


@pytest.fixture(scope="module")
def tensorboard(pristine_scene, tmp_path_factory) -> tuple[FacadeTrainer, EventAccumulator]:
    """A run and its tensorboard events."""
    trainer = watched(pristine_scene, tmp_path_factory.mktemp("run"), "tensorboard")
    return trainer, EventAccumulator(str(trainer.base_dir)).Reload()


def last(events: EventAccumulator, prefix: str) -> dict[str, float]:
    found = {tag: events.Scalars(tag)[-1] for tag in events.Tags()["scalars"] if tag.startswith(prefix)}
    return {tag.removeprefix(prefix): event.value for tag, event in found.items() if event.step == LAST}


def test_tensorboard_gets_every_term_of_the_loss(tensorboard):
    _, events = tensorboard
    terms = last(events, "Train Loss Dict/")
    assert terms.keys() == {"photometric", "depth", "normal", "smoothness"}
    assert sum(terms.values()) == pytest.approx(last(events, "Train Loss")[""], rel=1e-5)


def test_tensorboard_gets_all_held_out_metrics(tensorboard):
    trainer, events = tensorboard
    expected = trainer.pipeline.get_average_eval_image_metrics()
    timing = {"num_rays_per_sec", "fps"}
    assert {"psnr", "normal_deg", "chamfer_m", "truth_depth_mae_m"} <= expected.keys()
    logged = last(events, ALL)
    assert logged.keys() == expected.keys()
    assert logged == pytest.approx(expected | {name: logged[name] for name in timing}, rel=1e-4)
    of_some = {name for name in expected if f"{name}_views" in expected}  # a view may have nothing off the shell, say
    counts = {f"{name}_views" for name in of_some}
    assert last(events, ONE).keys() | of_some == expected.keys() - timing - counts | {"num_rays"}


def test_tensorboard_gets_images_of_depth_normals_and_error_for_both_references(tensorboard):
    _, events = tensorboard
    assert set(events.Tags()["images"]) == {IMAGES + name for name in MAPS | {"img"}}
    for name in MAPS | {"img"}:
        (event,) = events.Images(IMAGES + name)
        assert (event.width, event.height) == ((48, 32) if name.endswith("error") else (96, 32))  # side by side


def test_the_error_image_agrees_with_the_metric(tensorboard):
    """The share of its pixels below 20° is the metric of that name, of the same view."""
    _, events = tensorboard
    for prefix in ("", "truth_"):
        (event,) = events.Images(f"{IMAGES}{prefix}normal_error")
        pixels = np.asarray(Image.open(io.BytesIO(event.encoded_image_string)))
        scale = np.concatenate([255 * colormaps["inferno"](np.arange(256))[:, :3], [[GREY] * 3]])
        level = np.linalg.norm(pixels[..., None, :] - scale, axis=-1).argmin(axis=-1)
        share = (level[level < 256] / 255 * MAX_ERROR < 20).mean()
        assert share == pytest.approx(last(events, ONE)[f"{prefix}normal_below_20deg"], abs=0.01)
        assert share > 0.03


@pytest.mark.usefixtures("offline_wandb")
def test_wandb_offline_gets_all_that_tensorboard_gets(tensorboard, pristine_scene, tmp_path):
    import wandb  # slow

    trainer = watched(pristine_scene, tmp_path, "wandb")
    wandb.teardown()  # finish does not wait for the process that writes the file
    (run,) = trainer.base_dir.glob("wandb/offline-run-*")
    logged = dict(recorded(run))
    tags = tensorboard[1].Tags()
    random = {
        f"Eval Images Metrics/{kind}_off_shell" for kind in ("psnr", "ssim", "cc_psnr", "cc_ssim")
    }  # not every view has such pixels
    assert set(tags["scalars"]) - random <= logged.keys()
    for tag in tags["images"]:
        (path,) = run.glob(f"files/media/images/{tag}_{LAST}_*.png")
        (theirs,) = tensorboard[1].Images(tag)
        with Image.open(path) as image:
            assert image.size == (theirs.width, theirs.height)
            assert np.asarray(image).std() > 5


def recorded(run: Path) -> Iterator[tuple[str, str]]:
    """Names and values that an offline run has recorded."""
    from wandb.proto.wandb_internal_pb2 import Record
    from wandb.sdk.internal.datastore import DataStore

    store = DataStore()
    store.open_for_scan(str(next(run.glob("*.wandb"))))
    while data := store.scan_data():
        record: Any = Record()  # whose fields pyright cannot know
        record.ParseFromString(data)
        for item in record.history.item:
            yield item.nested_key[0] if item.nested_key else item.key, item.value_json


def test_wandb_without_a_key_ends_with_one_sentence(pristine_scene, tmp_path, monkeypatch):
    from wandb.errors import UsageError

    def refuse(**_):
        raise UsageError("No API key configured.")

    monkeypatch.setattr("wandb.init", refuse)
    with pytest.raises(SystemExit, match=r"^shellgs: .*No API key configured.*WANDB_MODE=offline"):
        watched(pristine_scene, tmp_path, "wandb")
