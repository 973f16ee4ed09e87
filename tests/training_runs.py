"""Set up runs of the methods as ns-train does, and render them."""

from __future__ import annotations

import copy
import resource
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.utils import writer
from torch import Tensor

import method_configs
from shellgs_method.datamanager import FacadeDataManager
from shellgs_method.model import FacadeModel
from shellgs_method.trainer import FacadeTrainer, FacadeTrainerConfig

Method = Literal["shellgs", "shellgs_metric", "mono_gs", "photo_gs", "two_dgs"]


def trainer_of(
    scene: Path,
    folder: Path,
    method: Method = "shellgs",
    iterations: int = 6,
    load_dir: Path | None = None,
    change: Callable[[FacadeTrainerConfig], object] = lambda _: None,
) -> FacadeTrainer:
    """A trainer as ns-train sets it up; ``change`` edits its config, as flags would."""
    config = copy.deepcopy(getattr(method_configs, method).config)
    config.pipeline.datamanager.data = scene
    config.output_dir, config.timestamp, config.vis = folder, "run", "tensorboard"
    config.max_num_iterations, config.load_dir = iterations, load_dir
    config.steps_per_eval_image = 0
    config.logging.local_writer.enable = False
    change(config)
    torch.manual_seed(0)
    for leftovers in (writer.EVENT_WRITERS, writer.EVENT_STORAGE):  # of other runs: a process of ns-train has one
        leftovers.clear()
    trainer = config.setup()
    trainer.setup()
    return trainer


def densify_early(config) -> None:
    """Change a config so that a run of a dozen iterations densifies."""
    model = config.pipeline.model
    model.warmup_length, model.refine_every, model.densify_grad_thresh = 2000, 3, 1e-6


def model_of(trainer: FacadeTrainer) -> FacadeModel:
    model = trainer.pipeline.model
    assert isinstance(model, FacadeModel)
    return model


def data_of(trainer: FacadeTrainer) -> FacadeDataManager:
    datamanager = trainer.pipeline.datamanager
    assert isinstance(datamanager, FacadeDataManager)
    return datamanager


def held_out(trainer: FacadeTrainer) -> tuple[Cameras, dict]:
    return data_of(trainer).fixed_indices_eval_dataloader[0]


def render(trainer: FacadeTrainer) -> dict[str, Tensor]:
    return model_of(trainer).get_outputs_for_camera(held_out(trainer)[0])


@contextmanager
def small_disk(largest: int) -> Iterator[None]:
    """Limit files to ``largest`` bytes, as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (largest, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
